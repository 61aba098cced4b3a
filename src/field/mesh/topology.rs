//! How a mesh hangs together: neighbours over edges, orientation, closedness.

use super::TriangleMesh;
use glam::DVec3;

/// Stands for "no triangle" or "no single triangle" across an edge.
pub(super) const NONE: u32 = u32::MAX;

/// What is known of a mesh's fitness to bound a solid.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize, utoipa::ToSchema)]
pub struct Soundness {
    /// Every edge has exactly two triangles that run along it in opposite directions.
    pub closed: bool,
    /// Edges with one triangle.
    pub boundary_edges: u64,
    /// Edges with three triangles or more.
    pub non_manifold_edges: u64,
    /// Triangles that cross or touch a triangle they do not share that place with.
    pub self_intersecting: u64,
    /// Triangles that were turned round so that all are counter-clockwise outward.
    pub turned: u64,
    /// Parts connected over edges.
    pub components: u64,
    /// Vertices - edges + triangles: 2 for one closed surface without handles.
    pub euler: i64,
}

impl Soundness {
    /// Whether the sign of the distance can be told from the nearest feature's pseudo-normal: the mesh is closed,
    /// consistently wound, and does not meet itself.
    pub fn bounds_a_solid(&self) -> bool {
        self.closed && self.self_intersecting == 0
    }
}

/// Turns triangles so that neighbours agree and the enclosed volume is positive, and says what was found.
/// `self_intersecting` is left at 0. Returns per triangle the neighbour across edge `k` (corners `k`, `k + 1`).
pub(super) fn orient(mesh: &mut TriangleMesh) -> (Vec<[u32; 3]>, Soundness) {
    let mut sides: Vec<(u32, u32, u32)> = Vec::with_capacity(3 * mesh.triangles.len());
    for (triangle, corners) in (0u32..).zip(&mesh.triangles) {
        for edge in 0..3 {
            let (a, b) = (corners[edge], corners[(edge + 1) % 3]);
            sides.push((a.min(b), a.max(b), 3 * triangle + edge as u32));
        }
    }
    sides.sort_unstable();
    let mut soundness = Soundness::default();
    let mut neighbours = vec![[NONE; 3]; mesh.triangles.len()];
    let mut edges = 0i64;
    for group in sides.chunk_by(|s, t| (s.0, s.1) == (t.0, t.1)) {
        edges += 1;
        match group {
            [_] => soundness.boundary_edges += 1,
            [(.., s), (.., t)] => {
                neighbours[*s as usize / 3][*s as usize % 3] = *t / 3;
                neighbours[*t as usize / 3][*t as usize % 3] = *s / 3;
            }
            _ => soundness.non_manifold_edges += 1,
        }
    }
    drop(sides);
    soundness.euler = mesh.vertices.len() as i64 - edges + mesh.triangles.len() as i64;

    let one_sided = agree(mesh, &mut neighbours, &mut soundness);
    soundness.closed = soundness.boundary_edges == 0 && soundness.non_manifold_edges == 0 && !one_sided;
    if volume(mesh) < 0.0 {
        for (corners, across) in mesh.triangles.iter_mut().zip(&mut neighbours) {
            turn(corners, across);
        }
        soundness.turned = mesh.triangles.len() as u64 - soundness.turned;
    }
    (neighbours, soundness)
}

/// Walks every component from its first triangle and turns those that disagree with the one they were reached from.
/// Returns whether a component cannot be made to agree (it is one-sided).
fn agree(mesh: &mut TriangleMesh, neighbours: &mut [[u32; 3]], soundness: &mut Soundness) -> bool {
    let mut reached = vec![false; mesh.triangles.len()];
    let (mut members, mut turned) = (Vec::new(), Vec::new());
    let mut one_sided = false;
    for seed in 0..mesh.triangles.len() {
        if std::mem::replace(&mut reached[seed], true) {
            continue;
        }
        soundness.components += 1;
        members.clear();
        turned.clear();
        members.push(seed);
        let mut next = 0;
        while let Some(&here) = members.get(next) {
            next += 1;
            for edge in 0..3 {
                let there = neighbours[here][edge];
                if there == NONE {
                    continue;
                }
                let there = there as usize;
                let corners = mesh.triangles[here];
                let (a, b) = (corners[edge], corners[(edge + 1) % 3]);
                let runs_along = |t: [u32; 3]| (0..3).any(|k| t[k] == a && t[(k + 1) % 3] == b);
                let disagrees = runs_along(mesh.triangles[there]);
                if !reached[there] {
                    reached[there] = true;
                    members.push(there);
                    if disagrees {
                        turn(&mut mesh.triangles[there], &mut neighbours[there]);
                        turned.push(there);
                    }
                } else if disagrees {
                    one_sided = true;
                }
            }
        }
        // the first triangle may be the odd one out: the smaller party turns
        if 2 * turned.len() > members.len() {
            for &member in &members {
                turn(&mut mesh.triangles[member], &mut neighbours[member]);
            }
            soundness.turned += (members.len() - turned.len()) as u64;
        } else {
            soundness.turned += turned.len() as u64;
        }
    }
    one_sided
}

fn turn(corners: &mut [u32; 3], across: &mut [u32; 3]) {
    corners.swap(1, 2);
    across.swap(0, 2);
}

/// Signed volume about the first vertex, which keeps it precise far from the origin.
fn volume(mesh: &TriangleMesh) -> f64 {
    let origin = mesh.vertices.first().map_or(DVec3::ZERO, |&v| DVec3::from(v));
    mesh.triangles
        .iter()
        .map(|corners| {
            let [a, b, c] = corners.map(|i| DVec3::from(mesh.vertices[i as usize]) - origin);
            a.dot(b.cross(c)) / 6.0
        })
        .sum()
}

/// Unit normals of the faces (zero where a face has no area) and angle-weighted unit normals of the vertices
/// (J. A. Baerentzen and H. Aanaes, Signed distance computation using the angle weighted pseudonormal, 2005).
pub(super) fn normals(vertices: &[DVec3], triangles: &[[u32; 3]]) -> (Vec<DVec3>, Vec<DVec3>) {
    let mut at_vertices = vec![DVec3::ZERO; vertices.len()];
    let at_faces = triangles
        .iter()
        .map(|corners| {
            let places = corners.map(|i| vertices[i as usize]);
            let normal = (places[1] - places[0]).cross(places[2] - places[0]).normalize_or_zero();
            for k in 0..3 {
                let (to, from) = (places[(k + 1) % 3] - places[k], places[(k + 2) % 3] - places[k]);
                // atan2 keeps its precision at very small and very flat angles, where acos loses it
                let angle = to.cross(from).length().atan2(to.dot(from));
                at_vertices[corners[k] as usize] += angle * normal;
            }
            normal
        })
        .collect();
    for normal in &mut at_vertices {
        *normal = normal.normalize_or_zero();
    }
    (at_faces, at_vertices)
}
