//! Claims about scenes: known values and metrics here, random trees and faults beside.

mod faults;
mod properties;

use super::{KINDS, Kind, Scene};
use crate::field::{Field, Gradients, Metric, Points};
use serde_json::{Value, json};

fn scene(value: &Value) -> Scene {
    Scene::from_value(value).unwrap_or_else(|e| panic!("{e}: {value}"))
}

fn value(scene: &Scene, p: [f32; 3]) -> f32 {
    let mut v = [0.0];
    scene.values(Points { x: &[p[0]], y: &[p[1]], z: &[p[2]] }, &mut v);
    v[0]
}

fn gradient(scene: &Scene, p: [f32; 3]) -> (f32, [f32; 3]) {
    let (mut v, mut x, mut y, mut z) = ([0.0], [0.0], [0.0], [0.0]);
    let g = Gradients { x: &mut x, y: &mut y, z: &mut z };
    scene.gradients(Points { x: &[p[0]], y: &[p[1]], z: &[p[2]] }, &mut v, g);
    (v[0], [x[0], y[0], z[0]])
}

fn norm(v: [f32; 3]) -> f32 {
    (v[0] * v[0] + v[1] * v[1] + v[2] * v[2]).sqrt()
}

#[test]
fn batches_of_any_length_give_the_bits_of_single_points() {
    let scene = scene(&json!({"smooth_union": {"k": 0.2, "of": [
        {"ellipsoid": {"radii": [0.5, 0.3, 0.2]}},
        {"translate": {"by": [0.2, 0.1, 0.0], "of": {"rotate": {"axis": [1, 1, 0], "angle": 30, "of": {"box": {"half_extents": [0.2, 0.3, 0.1]}}}}}},
        {"extrude": {"polygon": [[0, 0], [0.5, 0], [0.1, 0.6]], "half_height": 0.2}}
    ]}}));
    let n = 1000;
    let c = |k: usize, f: f32| (0..n).map(|i| ((i * k) as f32 * f).sin()).collect::<Vec<_>>();
    let (x, y, z) = (c(3, 0.31), c(7, 0.17), c(11, 0.23));
    let (mut v, mut gx, mut gy, mut gz) = (vec![0.0; n], vec![0.0; n], vec![0.0; n], vec![0.0; n]);
    let points = Points { x: &x, y: &y, z: &z };
    scene.gradients(points, &mut v, Gradients { x: &mut gx, y: &mut gy, z: &mut gz });
    for i in 0..n {
        let (single, g) = gradient(&scene, [x[i], y[i], z[i]]);
        assert_eq!((single, g), (v[i], [gx[i], gy[i], gz[i]]), "point {i}");
    }
}

#[test]
fn shapes_have_the_distances_of_geometry() {
    let root2 = 2f32.sqrt();
    let cases: &[(Value, [f32; 3], f32)] = &[
        (json!({"sphere": {"radius": 0.5}}), [0.0, 3.0, 4.0], 4.5),
        (json!({"ellipsoid": {"radii": [3, 2, 1]}}), [0.0, 0.0, 0.0], -1.0),
        (json!({"ellipsoid": {"radii": [3, 2, 1]}}), [5.0, 0.0, 0.0], 2.0),
        (json!({"ellipsoid": {"radii": [2, 2, 2]}}), [0.0, 0.0, 1.0], -1.0),
        // the centre of curvature of an ellipse's tip, (a^2 - b^2)/a from the centre, is b^2/a from it
        (json!({"ellipsoid": {"radii": [2, 1, 1]}}), [1.5, 0.0, 0.0], -0.5),
        (json!({"box": {"half_extents": [1, 2, 3]}}), [2.0, 3.0, 0.0], root2),
        (json!({"box": {"half_extents": [1, 2, 3]}}), [0.5, 0.0, 0.0], -0.5),
        (json!({"rounded_box": {"half_extents": [1, 2, 3], "radius": 0.5}}), [2.0, 0.0, 0.0], 1.0),
        (json!({"rounded_box": {"half_extents": [1, 1, 1], "radius": 0.5}}), [1.5, 1.5, 0.0], root2 - 0.5),
        (json!({"capsule": {"from": [0, 0, 0], "to": [2, 0, 0], "radius": 0.5}}), [1.0, 1.0, 0.0], 0.5),
        (json!({"capsule": {"from": [0, 0, 0], "to": [2, 0, 0], "radius": 0.5}}), [5.0, 4.0, 0.0], 4.5),
        (json!({"cylinder": {"radius": 1, "half_height": 2}}), [2.0, 0.0, 3.0], root2),
        (json!({"cone": {"radius": 1, "top_radius": 0, "half_height": 1}}), [0.0, 0.0, 2.0], 1.0),
        (json!({"cone": {"radius": 1, "top_radius": 1, "half_height": 1}}), [0.0, 0.0, 0.5], -0.5),
        (json!({"cone": {"radius": 2, "top_radius": 1, "half_height": 1}}), [0.0, 3.0, -1.0], 1.0),
        (json!({"torus": {"major": 2, "minor": 0.5}}), [0.0, 0.0, 0.0], 1.5),
        (json!({"half_space": {"normal": [0, 0, 2], "offset": 1}}), [5.0, 0.0, 3.0], 2.0),
        (json!({"octahedron": {"size": 1}}), [2.0, 0.0, 0.0], 1.0),
        (json!({"octahedron": {"size": 1}}), [1.0, 1.0, 0.0], 0.5 * root2),
        (json!({"octahedron": {"size": 1}}), [0.0, 0.0, 0.0], -1.0 / 3f32.sqrt()),
        (json!({"hex_prism": {"radius": 1, "half_height": 1}}), [2.0, 0.0, 0.0], 1.0),
        (json!({"hex_prism": {"radius": 1, "half_height": 1}}), [0.0, 1.0, 0.0], 1.0 - 0.75f32.sqrt()),
        (json!({"extrude": {"polygon": [[0, 0], [1, 0], [1, 1], [0, 1]], "half_height": 1}}), [2.0, 0.5, 2.0], root2),
        (json!({"revolve": {"polygon": [[-1, -1], [1, -1], [1, 1], [-1, 1]], "offset": 3}}), [0.0, 0.0, 0.0], 2.0),
        (json!({"circle": {"radius": 0.5}}), [3.0, 4.0, 99.0], 4.5),
        (json!({"rectangle": {"half_extents": [1, 2]}}), [2.0, 3.0, 99.0], root2),
        (json!({"polygon": {"points": [[0, 0], [0, 1], [1, 1], [1, 0]]}}), [0.5, 0.25, 99.0], -0.25),
        (json!({"capsule": {"from": [0, 0], "to": [2, 0], "radius": 0.5}}), [1.0, 1.0, 99.0], 0.5),
        (json!({"half_space": {"normal": [0, 1], "offset": 1}}), [5.0, 3.0, 99.0], 2.0),
    ];
    for (shape, p, distance) in cases {
        let found = value(&scene(shape), *p);
        assert!((found - distance).abs() < 1e-5 * distance.abs().max(1.0), "{shape} at {p:?}: {found}, not {distance}");
    }
}

#[test]
fn operators_do_what_their_formulas_say() {
    let sphere = |r: f64| json!({"sphere": {"radius": r}});
    let smooth = |kind: &str, k: f64, a: f64, b: f64| json!({kind: {"k": k, "of": [sphere(a), sphere(b)]}});
    let at = [0.0, 0.0, 2.0];
    // |a - b| = 0.5, k = 1: h = 0.5, h^2 k/4 = 0.0625
    let cases = [
        (smooth("smooth_union", 1.0, 1.0, 0.5), 1.0 - 0.0625),
        (smooth("smooth_intersection", 1.0, 1.0, 0.5), 1.5 + 0.0625),
        (smooth("smooth_difference", 0.1, 1.0, 0.5), 1.0),
        (json!({"difference": {"of": [sphere(1.0), sphere(3.0)]}}), 1.0),
        (json!({"round": {"radius": 0.25, "of": sphere(1.0)}}), 0.75),
        (json!({"shell": {"thickness": 0.5, "of": sphere(3.0)}}), 0.75),
        (
            json!({"displace": {"amplitude": 0.5, "frequency": [0, 0, 0.25], "of": sphere(1.0)}}),
            1.0 + 0.5 * 0.5f32.sin(),
        ),
        (json!({"translate": {"by": [0, 0, 0.5], "of": sphere(1.0)}}), 0.5),
        (json!({"scale": {"factor": 2, "of": sphere(0.5)}}), 1.0),
        (
            json!({"rotate": {"axis": [1, 0, 0], "angle": 90, "of": {"translate": {"by": [0, 1, 0], "of": sphere(0.5)}}}}),
            0.5,
        ),
        (json!({"mirror": {"axis": "z", "of": {"translate": {"by": [0, 0, 1], "of": sphere(0.5)}}}}), 0.5),
        (json!({"repeat": {"spacing": [1, 1, 1], "count": [1, 1, 4], "of": sphere(0.25)}}), 0.25),
        (json!({"repeat": {"spacing": [1, 1, 1], "count": [1, 1, 3], "of": sphere(0.25)}}), 0.75),
    ];
    for (node, expected) in cases {
        let found = value(&scene(&node), at);
        assert!((found - expected).abs() < 1e-6, "{node}: {found}, not {expected}");
    }
}

#[test]
fn degenerate_points_have_unit_gradients() {
    for shape in [
        json!({"sphere": {"radius": 0.5}}),
        json!({"ellipsoid": {"radii": [0.5, 0.4, 0.3]}}),
        json!({"ellipsoid": {"radii": [0.4, 0.4, 0.4]}}),
        json!({"ellipsoid": {"radii": [0.3, 0.4, 0.3]}}),
        json!({"box": {"half_extents": [0.5, 0.5, 0.5]}}),
        json!({"capsule": {"from": [-1, -1, -1], "to": [1, 1, 1], "radius": 0.2}}),
        json!({"capsule": {"from": [0, 0, 0], "to": [0, 0, 0], "radius": 0.2}}),
        json!({"cylinder": {"radius": 0.5, "half_height": 0.5}}),
        json!({"cone": {"radius": 0.5, "top_radius": 0, "half_height": 0.5}}),
        json!({"torus": {"major": 0.5, "minor": 0.1}}),
        json!({"octahedron": {"size": 0.5}}),
        json!({"hex_prism": {"radius": 0.5, "half_height": 0.5}}),
    ] {
        let scene = scene(&shape);
        for p in [
            [0.0; 3],
            [-0.0; 3],
            [0.5, 0.0, 0.0],
            [0.0, 0.0, 0.5],
            [0.5, 0.5, 0.5],
            [1e-30, 0.0, 0.0],
            [0.25, -0.0, 0.0],
        ] {
            let (v, g) = gradient(&scene, p);
            assert!(v.is_finite() && (norm(g) - 1.0).abs() < 1e-5, "{shape} at {p:?}: {v} {g:?}");
        }
    }
}

#[test]
fn normals_next_to_the_surface_keep_their_digits() {
    let square = json!({"polygon": {"points": [[0.1, 0.1], [0.9, 0.1], [0.9, 0.9], [0.1, 0.9]]}});
    let (_, g) = gradient(&scene(&square), [0.9 + 1e-7, 0.4, 0.0]);
    assert_eq!(g, [1.0, 0.0, 0.0]);
    let ellipsoid = scene(&json!({"ellipsoid": {"radii": [0.8, 0.5, 0.3]}}));
    let p = [0.8 * 0.6, 0.5 * 0.48, 0.3 * 0.64];
    let (v, g) = gradient(&ellipsoid, p);
    let n = [0.6 / 0.8, 0.48 / 0.5, 0.64 / 0.3];
    assert!(v.abs() < 1e-7 && (0..3).all(|k| (g[k] - n[k] / norm(n)).abs() < 1e-6), "{v} {g:?}");
}

#[test]
fn the_metric_follows_the_rules() {
    let cases = [
        (json!({"ellipsoid": {"radii": [0.5, 0.4, 0.3]}}), Metric::Exact, Some(1.0)),
        (json!({"torus": {"major": 0.1, "minor": 0.3}}), Metric::Bound, Some(1.0)),
        (
            json!({"union": {"of": [{"sphere": {"radius": 1}}, {"box": {"half_extents": [1, 1, 1]}}]}}),
            Metric::Bound,
            Some(1.0),
        ),
        (
            json!({"union": {"of": [{"sphere": {"radius": 1}}, {"translate": {"by": [3, 0, 0], "of": {"sphere": {"radius": 1}}}}]}}),
            Metric::Exact,
            Some(1.0),
        ),
        (json!({"round": {"radius": 0.1, "of": {"box": {"half_extents": [1, 1, 1]}}}}), Metric::Exact, Some(1.0)),
        (json!({"round": {"radius": 0.1, "of": {"torus": {"major": 1, "minor": 0.2}}}}), Metric::Bound, Some(1.0)),
        (
            json!({"displace": {"amplitude": 0.1, "frequency": [3, 4, 0], "of": {"sphere": {"radius": 1}}}}),
            Metric::Bound,
            Some(1.4),
        ),
        (
            json!({"repeat": {"spacing": [2, 0, 0], "count": [900, 1, 1], "of": {"sphere": {"radius": 1}}}}),
            Metric::Exact,
            Some(1.0),
        ),
        (
            json!({"repeat": {"spacing": [2, 0, 0], "count": [900, 1, 1], "of": {"displace": {"amplitude": 0.1, "frequency": [1, 1, 1], "of": {"sphere": {"radius": 1}}}}}}),
            Metric::Sign,
            None,
        ),
    ];
    for (node, metric, lipschitz) in cases {
        let scene = scene(&node);
        assert_eq!((scene.metric(), scene.lipschitz()), (metric, lipschitz), "{node}");
    }
}

#[test]
fn a_half_space_has_no_fitted_domain_and_a_cut_sphere_has() {
    assert_eq!(scene(&json!({"half_space": {"normal": [0, 0, 1], "offset": 0}})).fit_domain(), None);
    let cut = json!({"intersection": {"of": [{"sphere": {"radius": 1}}, {"half_space": {"normal": [0, 0, 1], "offset": 0}}]}});
    let domain = scene(&cut).fit_domain().unwrap();
    assert!((domain.max[2] - 0.1).abs() < 1e-9 && (domain.min[2] + 1.1).abs() < 1e-9, "{domain:?}");
    let flat = scene(&json!({"translate": {"by": [1, 2], "of": {"circle": {"radius": 0.5}}}})).fit_domain().unwrap();
    assert!((flat.min[0] - 0.45).abs() < 1e-9 && (flat.max[1] - 2.55).abs() < 1e-9, "{flat:?}");
}

#[test]
fn the_schema_lists_the_kinds_and_members_that_the_parser_knows() {
    let schema: Value = serde_json::from_str(include_str!("../../../docs/scene.schema.json")).unwrap();
    for (definition, dimension) in [("node", 3), ("planar_node", 2)] {
        let kinds: Vec<&Kind> = KINDS.iter().filter(|k| if dimension == 3 { k.space } else { k.plane }).collect();
        let properties = schema["$defs"][definition]["properties"].as_object().unwrap();
        let mut listed: Vec<&str> = properties.keys().map(String::as_str).collect();
        let mut known: Vec<&str> = kinds.iter().map(|k| k.name).collect();
        listed.sort_unstable();
        known.sort_unstable();
        assert_eq!(listed, known, "{definition}");
        for kind in kinds {
            let body = &properties[kind.name];
            let members = |list: Vec<&str>| {
                let mut list: Vec<String> = list.into_iter().map(str::to_owned).collect();
                list.sort();
                list
            };
            let planar_rotation = kind.name == "rotate" && dimension == 2;
            let expected = kind.members.iter().copied().filter(|m| !(planar_rotation && *m == "axis")).collect();
            let required = body["required"].as_array().unwrap().iter().filter_map(Value::as_str).collect();
            assert_eq!(members(required), members(expected), "{}", kind.name);
            let properties = body["properties"].as_object().unwrap();
            assert_eq!(properties.len(), body["required"].as_array().unwrap().len(), "{}", kind.name);
            assert_eq!(body["additionalProperties"], false, "{}", kind.name);
        }
    }
}
