use super::*;
use crate::field::{Field, Gradients, Points};
use glam::DVec3;
use std::collections::HashMap as Map;
use std::path::PathBuf;

/// A sphere of triangles: an icosahedron split `levels` times, vertices on the sphere.
pub(super) fn icosphere(center: DVec3, radius: f64, levels: usize) -> TriangleMesh {
    let phi = (1.0 + 5f64.sqrt()) / 2.0;
    let mut vertices: Vec<DVec3> = [
        (-1.0, phi, 0.0),
        (1.0, phi, 0.0),
        (-1.0, -phi, 0.0),
        (1.0, -phi, 0.0),
        (0.0, -1.0, phi),
        (0.0, 1.0, phi),
        (0.0, -1.0, -phi),
        (0.0, 1.0, -phi),
        (phi, 0.0, -1.0),
        (phi, 0.0, 1.0),
        (-phi, 0.0, -1.0),
        (-phi, 0.0, 1.0),
    ]
    .map(|(x, y, z)| DVec3::new(x, y, z).normalize())
    .to_vec();
    let mut triangles: Vec<[u32; 3]> = vec![
        [0, 11, 5],
        [0, 5, 1],
        [0, 1, 7],
        [0, 7, 10],
        [0, 10, 11],
        [1, 5, 9],
        [5, 11, 4],
        [11, 10, 2],
        [10, 7, 6],
        [7, 1, 8],
        [3, 9, 4],
        [3, 4, 2],
        [3, 2, 6],
        [3, 6, 8],
        [3, 8, 9],
        [4, 9, 5],
        [2, 4, 11],
        [6, 2, 10],
        [8, 6, 7],
        [9, 8, 1],
    ];
    for _ in 0..levels {
        let mut middles: Map<(u32, u32), u32> = Map::new();
        let mut finer = Vec::with_capacity(4 * triangles.len());
        for [a, b, c] in triangles {
            let mut middle = |i: u32, j: u32| {
                *middles.entry((i.min(j), i.max(j))).or_insert_with(|| {
                    vertices.push((vertices[i as usize] + vertices[j as usize]).normalize());
                    vertices.len() as u32 - 1
                })
            };
            let (ab, bc, ca) = (middle(a, b), middle(b, c), middle(c, a));
            finer.extend([[a, ab, ca], [b, bc, ab], [c, ca, bc], [ab, bc, ca]]);
        }
        triangles = finer;
    }
    TriangleMesh { vertices: vertices.iter().map(|v| (center + radius * *v).to_array()).collect(), triangles }
}

/// The cube of half extent `h`, two triangles a side.
fn cube(h: f64) -> TriangleMesh {
    let vertices = (0..8).map(|i| [0, 1, 2].map(|axis| if i >> axis & 1 == 1 { h } else { -h })).collect();
    let sides = [[0, 4, 6, 2], [1, 3, 7, 5], [0, 1, 5, 4], [2, 6, 7, 3], [0, 2, 3, 1], [4, 5, 7, 6]];
    let triangles = sides.iter().flat_map(|&[a, b, c, d]| [[a, b, c], [a, c, d]]).collect();
    TriangleMesh { vertices, triangles }
}

/// A signed distance to the cube of half extent `h`.
fn cube_distance(p: DVec3, h: f64) -> f64 {
    let q = p.abs() - DVec3::splat(h);
    q.max(DVec3::ZERO).length() + q.max_element().min(0.0)
}

/// The `i`-th of a fixed sequence of points in the cube of half extent 1 (Halton, bases 2, 3 and 5).
pub(super) fn point(i: u32) -> DVec3 {
    let digits = |base: u32| {
        let (mut n, mut f, mut r) = (i + 1, 1.0, 0.0);
        while n > 0 {
            f /= f64::from(base);
            r += f * f64::from(n % base);
            n /= base;
        }
        2.0 * r - 1.0
    };
    DVec3::new(digits(2), digits(3), digits(5))
}

struct Answer {
    p: DVec3,
    value: f64,
    gradient: DVec3,
}

fn ask(field: &dyn Field, points: impl Iterator<Item = DVec3>) -> Vec<Answer> {
    let points: Vec<DVec3> = points.collect();
    let column = |axis: usize| points.iter().map(|p| p[axis] as f32).collect::<Vec<f32>>();
    let (x, y, z) = (column(0), column(1), column(2));
    let mut values = vec![0.0; x.len()];
    let (mut gx, mut gy, mut gz) = (values.clone(), values.clone(), values.clone());
    let batch = Points { x: &x, y: &y, z: &z };
    field.gradients(batch, &mut values, Gradients { x: &mut gx, y: &mut gy, z: &mut gz });
    let mut alone = vec![0.0; x.len()];
    field.values(batch, &mut alone);
    assert_eq!(values, alone, "a value does not depend on whether the gradient is asked for");
    (0..x.len())
        .map(|i| Answer {
            p: DVec3::new(x[i].into(), y[i].into(), z[i].into()),
            value: values[i].into(),
            gradient: DVec3::new(gx[i].into(), gy[i].into(), gz[i].into()),
        })
        .collect()
}

fn joined(parts: &[TriangleMesh]) -> TriangleMesh {
    let mut whole = TriangleMesh::default();
    for part in parts {
        let first = whole.vertices.len() as u32;
        whole.vertices.extend(&part.vertices);
        whole.triangles.extend(part.triangles.iter().map(|t| t.map(|i| i + first)));
    }
    whole
}

/// A shared mesh, or `None` (with a message) where the data are not there.
fn shared(name: &str) -> Option<Vec<u8>> {
    let root = std::env::var_os("SHRINKD_DATA")
        .map_or_else(|| PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../shared/data"), PathBuf::from);
    let read = std::fs::read(root.join("meshes").join(name));
    if read.is_err() {
        println!("skipped: no shared mesh {name}");
    }
    read.ok()
}

#[test]
fn the_distance_to_a_cube_is_exact_with_its_sign_and_gradient_around_faces_edges_and_corners() {
    let field = MeshField::new(cube(0.5)).unwrap();
    assert!(field.soundness().bounds_a_solid());
    assert_eq!(field.domain().max, [0.62; 3]);
    for Answer { p, value, gradient } in ask(&field, (0..5000).map(point)) {
        let expected = cube_distance(p, 0.5);
        // one rounding to f32
        assert!((value - expected).abs() <= 1e-7 * expected.abs().max(0.1), "{value} {expected} at {p}");
        assert!((gradient.length() - 1.0).abs() < 1e-6);
        let h = 1e-6;
        let difference = DVec3::from([0, 1, 2].map(|axis| {
            let step = h * DVec3::AXES[axis];
            (cube_distance(p + step, 0.5) - cube_distance(p - step, 0.5)) / (2.0 * h)
        }));
        // inside, the nearest face changes across diagonals, where a central difference straddles the crease
        if (difference.length() - 1.0).abs() < 1e-6 {
            assert!(gradient.distance(difference) < 1e-4, "{gradient} {difference} at {p}");
        }
    }
}

#[test]
fn on_the_surface_the_gradient_is_the_pseudo_normal() {
    let field = MeshField::new(cube(0.5)).unwrap();
    let corner = DVec3::splat(0.5);
    let places =
        [(DVec3::new(0.5, 0.1, 0.2), DVec3::X), (DVec3::new(0.5, 0.5, 0.25), DVec3::new(1.0, 1.0, 0.0).normalize())];
    for (p, normal) in places.into_iter().chain([(corner, corner.normalize())]) {
        let answer = &ask(&field, [p].into_iter())[0];
        assert_eq!(answer.value, 0.0);
        assert!(answer.gradient.distance(normal) < 1e-6, "{} at {p}", answer.gradient);
    }
}

#[test]
fn an_inside_out_mesh_and_one_with_turned_triangles_are_put_right() {
    let mut mesh = icosphere(DVec3::ZERO, 0.7, 3);
    for triangle in &mut mesh.triangles {
        triangle.swap(0, 1);
    }
    mesh.triangles[7].swap(0, 1);
    let total = mesh.triangles.len() as u64;
    let field = MeshField::new(mesh).unwrap();
    assert!(field.soundness().bounds_a_solid());
    assert_eq!(field.soundness().turned, total - 1);
    assert_eq!(field.soundness().euler, 2);
    for Answer { p, value, .. } in ask(&field, (0..1000).map(point)) {
        // the sagitta of the triangles
        assert!((value - (p.length() - 0.7)).abs() < 0.01, "{value} at {p}");
    }
}

#[test]
fn two_spheres_that_run_into_each_other_are_inside_where_either_is() {
    let (left, right) = (DVec3::new(-0.3, 0.0, 0.0), DVec3::new(0.3, 0.02, 0.01));
    let field = MeshField::new(joined(&[icosphere(left, 0.5, 4), icosphere(right, 0.45, 4)])).unwrap();
    assert!(field.soundness().closed);
    assert!(field.soundness().self_intersecting > 0);
    for Answer { p, value, .. } in ask(&field, (0..3000).map(point)) {
        let union = (p.distance(left) - 0.5).min(p.distance(right) - 0.45);
        if union.abs() > 0.01 {
            assert_eq!(value > 0.0, union > 0.0, "{value} {union} at {p}");
        }
        assert!(value < 0.0 || (value - union).abs() < 0.01, "{value} {union} at {p}");
    }
    // the left sphere's wall deep inside the right one bounds nothing: the nearest boundary is the right sphere's
    let wall = left + DVec3::new(0.5, 0.0, 0.0);
    let value = ask(&field, std::iter::once(wall)).remove(0).value;
    assert!((value - (wall.distance(right) - 0.45)).abs() < 0.01, "{value}");
}

#[test]
fn a_mesh_with_a_hole_has_a_sign_and_says_that_it_is_no_more() {
    let mut mesh = icosphere(DVec3::ZERO, 0.7, 3);
    mesh.triangles.truncate(mesh.triangles.len() - 40);
    let field = MeshField::new(mesh).unwrap();
    assert_eq!(field.metric(), crate::field::Metric::Sign);
    assert!(field.soundness().boundary_edges > 0);
    let answers = ask(&field, [DVec3::ZERO, DVec3::splat(0.9)].into_iter());
    assert!(answers[0].value < 0.0 && answers[1].value > 0.0);
}

#[test]
fn an_answer_does_not_depend_on_the_batch_around_it() {
    let field = MeshField::new(cube(0.5)).unwrap();
    // a lattice on the cube's symmetries has many points with several nearest triangles
    let lattice =
        || (0..729).map(|i| DVec3::new(f64::from(i % 9), f64::from(i / 9 % 9), f64::from(i / 81)) / 8.0 - 0.5);
    let together = ask(&field, lattice());
    for (i, p) in lattice().enumerate() {
        let alone = &ask(&field, std::iter::once(p))[0];
        assert_eq!((alone.value, alone.gradient), (together[i].value, together[i].gradient), "at {p}");
    }
}

#[test]
fn triangles_without_area_do_no_harm() {
    let mut mesh = cube(0.5);
    // the triangle over the edge from 0 to 1 is halved, and one without area fills up to the old edge
    let index = mesh.triangles.iter().position(|t| (0..3).any(|k| t[k] == 0 && t[(k + 1) % 3] == 1)).unwrap();
    let tip = mesh.triangles[index].into_iter().find(|&v| v > 1).unwrap();
    mesh.vertices.push([0.0, -0.5, -0.5]);
    mesh.triangles[index] = [0, 8, tip];
    mesh.triangles.extend([[8, 1, tip], [0, 1, 8]]);
    let field = MeshField::new(mesh).unwrap();
    for Answer { p, value, gradient } in ask(&field, (0..2000).map(point)) {
        assert!((value - cube_distance(p, 0.5)).abs() < 1e-6, "{value} at {p}");
        assert!(gradient.is_finite());
    }
}

#[test]
fn meshes_that_are_no_surface_are_refused() {
    let no_triangle = TriangleMesh { vertices: vec![[0.0; 3]], triangles: vec![] };
    let no_vertex = TriangleMesh { vertices: vec![[0.0; 3]], triangles: vec![[0, 1, 2]] };
    let one_place = TriangleMesh { vertices: vec![[0.0; 3]; 3], triangles: vec![[0, 1, 2]] };
    let not_finite = TriangleMesh { vertices: vec![[0.0; 3], [f64::NAN; 3], [1.0; 3]], triangles: vec![[0, 1, 2]] };
    for mesh in [no_triangle, no_vertex, one_place, not_finite] {
        assert!(matches!(MeshField::new(mesh), Err(FieldError::Malformed { .. })));
    }
}

#[test]
fn shared_meshes_are_read_and_found_as_their_manifest_says() {
    let Some(manifest) = shared("manifest.json") else { return };
    let manifest: serde_json::Value = serde_json::from_slice(&manifest).unwrap();
    for entry in manifest.as_array().unwrap() {
        let name = entry["file"].as_str().unwrap();
        let number = |member: &str| entry[member].as_u64().unwrap();
        let Some(bytes) = shared(name) else { continue };
        let mesh = TriangleMesh::read(&bytes).unwrap();
        let found = (mesh.vertices.len() as u64, mesh.triangles.len() as u64);
        assert_eq!(found, (number("vertices"), number("faces")), "{name}");
        let field = MeshField::new(mesh).unwrap();
        let soundness = field.soundness();
        assert!(soundness.closed && soundness.components == 1 && soundness.turned == 0, "{name}: {soundness:?}");
        assert_eq!(soundness.euler, 2 - 2 * number("genus") as i64, "{name}");
    }
}

#[test]
fn triangles_that_cross_others_are_counted() {
    // not cad/twelve.ply, where the manifest's tool counts 152 and this one none: its faces lie in one plane with their
    // neighbours, which may be what that tool counts
    for (name, count) in [
        ("paper/duck.ply", 5),
        ("paper/bunny.ply", 0),
        ("organic/human_man.ply", 80),
        ("organic/human_woman.ply", 126),
        ("organic/horse.ply", 9),
        ("organic/triceratops.ply", 5),
    ] {
        let Some(bytes) = shared(name) else { return };
        let field = MeshField::new(TriangleMesh::read(&bytes).unwrap()).unwrap();
        assert_eq!(field.soundness().self_intersecting, count, "{name}");
    }
}

#[test]
fn pseudo_normals_and_winding_numbers_agree_on_sound_meshes() {
    for name in ["paper/spot.ply", "paper/bunny.ply", "cad/fandisk.ply", "organic/koala.ply"] {
        let Some(bytes) = shared(name) else { return };
        let field = MeshField::new(TriangleMesh::read(&bytes).unwrap()).unwrap();
        if !field.soundness().bounds_a_solid() {
            println!("{name} meets itself");
            continue;
        }
        let (low, high) = (DVec3::from(field.domain().min), DVec3::from(field.domain().max));
        let points = (0..4000).map(|i| low + (high - low) * (0.5 * point(i) + 0.5));
        for Answer { p, value, .. } in ask(&field, points) {
            assert_eq!(value < 0.0, field.wrapped_at(p), "{name}: {value} at {p}");
        }
    }
}

#[test]
fn meshes_that_meet_themselves_have_the_sign_of_their_winding_number() {
    for name in ["paper/duck.ply", "organic/human_man.ply", "organic/human_woman.ply", "cad/twelve.ply"] {
        let Some(bytes) = shared(name) else { return };
        let field = MeshField::new(TriangleMesh::read(&bytes).unwrap()).unwrap();
        let size = (DVec3::from(field.domain().max) - DVec3::from(field.domain().min)).max_element();
        // points about the surface, some very near
        let near = (0u32..3000).map(|i| {
            let corners = field.mesh().triangles[i as usize * 7919 % field.mesh().triangles.len()];
            let middle = corners.iter().map(|&v| DVec3::from(field.mesh().vertices[v as usize])).sum::<DVec3>() / 3.0;
            middle + size * [1e-1, 1e-2, 1e-3, 1e-4][i as usize % 4] * point(i)
        });
        let mut wrong = 0;
        for Answer { p, value, .. } in ask(&field, near) {
            wrong += u32::from((value < 0.0) != field.wrapped_at(p));
        }
        assert_eq!(wrong, 0, "{name}");
    }
}

/// Nanoseconds that this thread has run: on a busy machine the clock on the wall measures the others.
pub(in crate::field) fn thread_time() -> f64 {
    let text = std::fs::read_to_string("/proc/thread-self/schedstat").unwrap_or_default();
    text.split_whitespace().next().and_then(|n| n.parse().ok()).unwrap_or(f64::NAN)
}

/// Not a claim but a measure: `cargo test --release --lib mesh_query_speed -- --ignored --nocapture`.
#[test]
#[ignore = "prints times, claims nothing"]
fn mesh_query_speed() {
    for name in ["paper/bunny.ply", "paper/duck.ply", "organic/human_man.ply"] {
        let Some(bytes) = shared(name) else { return };
        let start = thread_time();
        let field = MeshField::new(TriangleMesh::read(&bytes).unwrap()).unwrap();
        println!("{name}: read and prepared in {:.0} ms", (thread_time() - start) / 1e6);
        let (low, high) = (DVec3::from(field.domain().min), DVec3::from(field.domain().max));
        let size = (high - low).max_element();
        let triangles = field.mesh().triangles.iter().cycle();
        let near = |share: f64| -> Vec<DVec3> {
            let at = |(i, t): (u32, &[u32; 3])| {
                let middle = t.iter().map(|&v| DVec3::from(field.mesh().vertices[v as usize])).sum::<DVec3>() / 3.0;
                middle + share * size * point(i)
            };
            (0u32..).zip(triangles.clone()).take(20_000).map(at).collect()
        };
        let mut shuffled = near(0.01);
        shuffled.sort_by_key(|p| (p.x.to_bits() ^ p.y.to_bits()).wrapping_mul(0x9E37_79B9_7F4A_7C15));
        let anywhere = (0..20_000).map(|i| low + (high - low) * (0.5 * point(i) + 0.5)).collect();
        let sets = [("within 0.1 %", near(0.001)), ("within 1 %", near(0.01)), ("the same, shuffled", shuffled)];
        for (label, points) in sets.into_iter().chain([("anywhere in the domain", anywhere)]) {
            let column = |axis: usize| points.iter().map(|p: &DVec3| p[axis] as f32).collect::<Vec<f32>>();
            let (x, y, z) = (column(0), column(1), column(2));
            let mut values = vec![0.0; x.len()];
            let mut best = f64::INFINITY;
            for _ in 0..5 {
                let start = thread_time();
                field.values(Points { x: &x, y: &y, z: &z }, &mut values);
                best = best.min((thread_time() - start) / 1e3 / x.len() as f64);
            }
            println!("{name}, {label}: {best:.2} us a point");
        }
    }
}

#[test]
fn what_is_buried_where_a_mesh_meets_itself_is_no_truth() {
    // two boxes that overlap in a cube of side 1
    let (mut mesh, other) = (block([-1.0; 3], [1.0; 3]), block([0.0; 3], [2.0; 3]));
    let first = mesh.vertices.len() as u32;
    mesh.vertices.extend(other.vertices);
    mesh.triangles.extend(other.triangles.iter().map(|t| t.map(|v| v + first)));
    let area = |mesh: &TriangleMesh| -> f64 {
        let corners = |t: &[u32; 3]| t.map(|v| DVec3::from(mesh.vertices[v as usize]));
        mesh.triangles.iter().map(corners).map(|[a, b, c]| 0.5 * (b - a).cross(c - a).length()).sum()
    };
    assert_eq!(area(&mesh), 48.0);
    let field = MeshField::new(mesh).unwrap();
    let truth = field.truth().unwrap();
    // three unit squares of either box are inside the other
    assert!((area(truth) - 42.0).abs() < 0.02 * 42.0, "{}", area(truth));
    assert_eq!(area(field.mesh()), 48.0, "the mesh itself stays whole");
    let buried = truth.vertices.iter().filter(|v| v.iter().all(|&c| c > 0.3 && c < 0.7)).count();
    assert_eq!(buried, 0);
}

/// A box of triangles, two to a side.
fn block(low: [f64; 3], high: [f64; 3]) -> TriangleMesh {
    let vertices = (0..8).map(|k| [0, 1, 2].map(|a| if k >> a & 1 == 1 { high[a] } else { low[a] })).collect();
    let sides = [[0, 4, 6, 2], [1, 3, 7, 5], [0, 1, 5, 4], [2, 6, 7, 3], [0, 2, 3, 1], [4, 5, 7, 6]];
    let triangles = sides.iter().flat_map(|&[a, b, c, d]| [[a, b, c], [a, c, d]]).collect();
    TriangleMesh { vertices, triangles }
}
