//! The base surface: the contracted front, remeshed to an even triangulation on the zero level set. Every vertex stays on
//! its own sheet, so thin walls and narrow gaps keep their two sides.

use super::contract::Front;
use super::remesh::remesh;
use super::rings::Mesh;
use super::tips::{Plane, part, reach_tips};
use super::zero::own_sheet;
use crate::field::Sampler;
use crate::settings::Canceled;
use glam::DVec3;

/// Remeshing, and a step onto the zero level set and its tips.
struct Round {
    remeshings: usize,
    /// Cosine of the largest angle that a triangle may turn by while it is remeshed.
    turn: f64,
    /// The same for the step.
    guard: f64,
    /// A collapse may move the surface by this many edges.
    loss: f64,
}

/// The front's own staircase may turn freely and be shaved; then vertices are on the features that they are to keep.
const ROUNDS: [Round; 2] = [
    Round { remeshings: 2, turn: -0.2, guard: -0.5, loss: 0.2 },
    Round { remeshings: 1, turn: 0.3, guard: 0.0, loss: 0.1 },
];
/// Cosine of the largest angle that a triangle may turn by when a vertex goes to a tip.
const TIP_TURN: f64 = 0.0;
/// Share of the way to the middle of its star that a vertex slides at once.
const SMOOTHING: f64 = 0.6;

/// Remeshes `front` to about `vertices` vertices on the zero level set.
pub fn base(front: Front, vertices: usize, sampler: &Sampler<'_>) -> Result<Mesh, Canceled> {
    even(front.mesh, vertices, sampler)
}

/// A mesh near the zero level set remeshed to about `vertices` vertices on it.
fn even(mut mesh: Mesh, vertices: usize, sampler: &Sampler<'_>) -> Result<Mesh, Canceled> {
    // the front's staircase makes its area about 5 % too large
    let area = 0.95 * mesh.area();
    let target = (area * 2.0 / (3f64.sqrt() * vertices as f64)).sqrt();
    let cancel = sampler.settings().cancel;
    for round in ROUNDS {
        for _ in 0..round.remeshings {
            remesh(&mut mesh, target, SMOOTHING, round.turn, round.loss, cancel)?;
        }
        let planes = onto_zero(&mut mesh, sampler, target, round.guard)?;
        reach_tips(&mut mesh, &planes, target, TIP_TURN, sampler)?;
    }
    part(&mut mesh, cancel)?;
    Ok(mesh)
}

/// Moves every vertex onto its own sheet of the zero level set; returns the tangent planes there.
fn onto_zero(mesh: &mut Mesh, sampler: &Sampler<'_>, reach: f64, turn: f64) -> Result<Vec<Plane>, Canceled> {
    let normals: Vec<DVec3> = (0..mesh.positions.len() as u32).map(|v| mesh.vertex_normal(v)).collect();
    let planes = own_sheet(sampler, &mesh.positions, &normals, reach)?;
    for (v, plane) in planes.iter().enumerate() {
        mesh.move_vertex(v as u32, plane.point, turn);
    }
    Ok(planes)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::field::sampler::Tally;
    use crate::field::{Field, Metric};
    use crate::measure::fixtures::{Formula, with_settings};
    use crate::shrink::lattice::{LatticeSpec, SphereLattice};
    use crate::shrink::rings::Rings;

    /// A cone with a round tip about the z axis: the hull of two balls, of radius [`BOTTOM`] at 0 and [`TIP`] at 1 (exact
    /// distance after Quilez, "distance functions"). With `side` -1 it is the solid around such a pit.
    struct Cone {
        side: f64,
    }
    const BOTTOM: f64 = 0.4;
    const TIP: f64 = 0.01;

    impl Cone {
        fn at(&self, p: DVec3) -> (f64, DVec3) {
            let (sine, radial) = (BOTTOM - TIP, p.truncate());
            let cosine = (1.0 - sine * sine).sqrt();
            let along = p.z * cosine - radial.length() * sine;
            let (s, n) = if along < 0.0 {
                (p.length() - BOTTOM, p.normalize_or(DVec3::NEG_Z))
            } else if along > cosine {
                ((p - DVec3::Z).length() - TIP, (p - DVec3::Z).normalize_or(DVec3::Z))
            } else {
                let outward = radial.normalize_or_zero();
                (radial.length() * cosine + p.z * sine - BOTTOM, (outward * cosine).extend(sine))
            };
            (self.side * s, self.side * n)
        }
    }

    const HALF: f64 = 0.6;

    /// A cube of half side [`HALF`]: the distance, but a bound beyond its edges.
    fn cube(p: DVec3) -> (f64, DVec3) {
        let axis = (0..3).max_by(|&a, &b| p[a].abs().total_cmp(&p[b].abs())).unwrap_or(0);
        let mut normal = DVec3::ZERO;
        normal[axis] = p[axis].signum();
        (p[axis].abs() - HALF, normal)
    }

    fn with_sampler<R>(field: &dyn Field, work: impl FnOnce(&Sampler<'_>) -> R) -> R {
        let tally = Tally::new();
        with_settings(2, |settings| work(&Sampler::new(field, *settings, &tally)))
    }

    /// A sphere lattice's directions, turned off the axes, at these distances from `center`.
    fn shell(center: DVec3, n: u32, inside_out: bool, distance: impl Fn(DVec3) -> f64) -> Mesh {
        let lattice = SphereLattice::new(LatticeSpec::Octahedral { n });
        let turn = glam::DMat3::from_euler(glam::EulerRot::XYZ, 0.3, 0.5, 0.7);
        let positions = lattice.directions.iter().map(|&d| turn * d).map(|d| center + distance(d) * d).collect();
        let mut triangles = lattice.triangles(&vec![false; lattice.quads.len()]);
        if inside_out {
            triangles.iter_mut().for_each(|t| t.reverse());
        }
        Mesh { positions, rings: Rings::new(lattice.directions.len(), &triangles).unwrap() }
    }

    /// Distance of a place from a mesh, in usual edges of it.
    fn missed(mesh: &Mesh, place: DVec3) -> f64 {
        let triangles = mesh.rings.triangles();
        let edge = (mesh.area() * 4.0 / (3f64.sqrt() * triangles.len() as f64)).sqrt();
        let distance = |t: &[u32; 3]| {
            let corners = t.map(|v| mesh.positions[v as usize]);
            crate::field::mesh::closest_on_triangle(place, corners).distance(place)
        };
        triangles.iter().map(distance).fold(f64::INFINITY, f64::min) / edge
    }

    /// The cone as a front sees it, its tip a little blunt.
    fn blunt_cone(cone: &Cone) -> Mesh {
        let center = DVec3::Z * 0.3;
        shell(center, 30, cone.side < 0.0, |d| {
            let (mut near, mut far) = (0.0, 1.0);
            for _ in 0..40 {
                let middle = 0.5 * (near + far);
                let q = center + middle * d;
                let outside = cone.side * cone.at(q).0 > 0.0 || q.z > 0.96;
                (near, far) = if outside { (near, middle) } else { (middle, far) };
            }
            near
        })
    }

    #[test]
    fn a_tip_and_the_bottom_of_a_pit_are_reached_though_the_front_was_short_of_them() {
        let top = DVec3::Z * (1.0 + TIP);
        for side in [1.0, -1.0] {
            let cone = Cone { side };
            let field = Formula { at: |p| cone.at(p), metric: Metric::Exact };
            let mesh = with_sampler(&field, |sampler| even(blunt_cone(&cone), 800, sampler).unwrap());
            let missed = missed(&mesh, top);
            assert!(missed < 0.1, "side {side}: missed by {missed} edges");
        }
    }

    #[test]
    fn every_corner_and_every_edge_of_a_cube_is_kept() {
        let field = Formula { at: cube, metric: Metric::Bound };
        let mesh = with_sampler(&field, |sampler| {
            let cube = shell(DVec3::ZERO, 30, false, |d| HALF / d.abs().max_element());
            even(cube, 800, sampler).unwrap()
        });
        let signs = [-1.0, 1.0];
        for (x, y, z) in signs.iter().flat_map(|&x| signs.map(|y| (x, y))).flat_map(|(x, y)| signs.map(|z| (x, y, z))) {
            let missed = missed(&mesh, DVec3::new(x, y, z) * HALF);
            assert!(missed < 0.1, "the corner {x} {y} {z} is missed by {missed} edges");
        }
        for k in -5..=5 {
            let missed = missed(&mesh, DVec3::new(0.1 * f64::from(k), HALF, HALF));
            assert!(missed < 0.25, "the edge is missed by {missed} edges at {k}");
        }
    }
}
