//! What the octahedral lattice's own cells ask of the map. Its triangles have equal areas on the sphere and not equal sides;
//! so a surface is mapped a little longer where they are long, and they land on it with sides that are more alike.

use super::density::averaged;
use super::energy::{add_outer, larger_axis, tangents};
use super::rings::Mesh;
use glam::{DMat2, DMat3, DVec2, DVec3};
use std::f64::consts::FRAC_PI_2;

/// How much of the cells' shape is made up for, as a power of their ratio of sides: the sphere's own shapes count, too.
const POWER: f64 = 0.7;
/// Factor on the weight of areas in the map, which is what a change of shape costs.
pub const AREA: f64 = 1.2;

/// What edges of `mesh` are multiplied by before they are mapped, at every vertex: matrices that keep areas in the tangent
/// plane and lengthen what lies along the longer sides of the lattice's triangles at the vertex's direction.
pub fn fit(mesh: &Mesh, directions: &[DVec3]) -> Vec<DMat3> {
    let fit = averaged(mesh, (0..directions.len()).map(|v| fit_at(mesh, directions, v)).collect());
    // the mean of matrices with other axes is a little larger
    fit.into_iter().map(|m| m * m.determinant().powf(-0.5)).collect()
}

fn fit_at(mesh: &Mesh, directions: &[DVec3], v: usize) -> DMat3 {
    let (direction, normal) = (directions[v], mesh.vertex_normal(v as u32));
    let on_sphere = tangents(direction);
    let on_surface = tangents(normal);
    let plane = |(e1, e2): (DVec3, DVec3), w: DVec3| DVec2::new(e1.dot(w), e2.dot(w));
    // the map's derivative, up to a positive factor and a change of scale along some axis, which do not turn it
    let mut derivative = DMat2::ZERO;
    for &u in mesh.rings.ring(v as u32) {
        let from = plane(on_surface, mesh.positions[u as usize] - mesh.positions[v]);
        let to = plane(on_sphere, directions[u as usize] - direction);
        derivative += DMat2::from_cols(to * from.x, to * from.y);
    }
    let [[a, b], [c, d]] = derivative.to_cols_array_2d();
    let turn = DVec2::new(a + d, b - c).normalize_or(DVec2::X);

    let cell = cell(direction);
    let (along_1, along_2) = (plane(on_sphere, cell * on_sphere.0), plane(on_sphere, cell * on_sphere.1));
    let (mean, radius) = (
        0.5 * (along_1.x + along_2.y),
        (0.25 * (along_1.x - along_2.y) * (along_1.x - along_2.y) + along_1.y * along_1.y).sqrt(),
    );
    let axis = larger_axis(along_1.x, along_1.y, along_2.y, mean + radius);
    // squares of the sides
    let ratio = ((mean + radius) / (mean - radius).max(1e-3 * mean)).powf(0.5 * POWER);
    // back from the sphere
    let axis = DVec2::new(turn.dot(axis), turn.perp_dot(axis));
    let along = axis.x * on_surface.0 + axis.y * on_surface.1;
    let across = normal.cross(along);
    let mut fit = DMat3::ZERO;
    add_outer(&mut fit, along, along, ratio.sqrt());
    add_outer(&mut fit, across, across, 1.0 / ratio.sqrt());
    add_outer(&mut fit, normal, normal, 1.0);
    fit
}

/// The linear map that takes an equilateral triangle to the lattice's triangle at a direction, times its transpose, up to a
/// factor: from the two steps along the square of the lattice's equal-area map, whose third side is their difference.
fn cell(direction: DVec3) -> DMat3 {
    let sign = DVec3::new(1f64.copysign(direction.x), 1f64.copysign(direction.y), 1f64.copysign(direction.z));
    // within one octant, the lower half as the mirror image of the upper
    let p = direction.abs();
    let r = (1.0 - p.z).max(1e-12).sqrt();
    let angle = p.y.atan2(p.x);
    let root = (2.0 - r * r).sqrt();
    let (ring, ring_rise) = (r * root, (2.0 - 2.0 * r * r) / root);
    let by_r = DVec3::new(ring_rise * angle.cos(), ring_rise * angle.sin(), -2.0 * r);
    let by_angle = DVec3::new(-ring * angle.sin(), ring * angle.cos(), 0.0);
    // r = a + b and angle = pi/2 b/r
    let step_a = sign * (by_r - angle / r * by_angle);
    let step_b = sign * (by_r + (FRAC_PI_2 - angle) / r * by_angle);
    let mut gram = DMat3::ZERO;
    for (u, v, weight) in [(step_a, step_a, 1.0), (step_b, step_b, 1.0), (step_a, step_b, -0.5), (step_b, step_a, -0.5)]
    {
        add_outer(&mut gram, u, v, weight);
    }
    gram
}

#[cfg(test)]
mod tests {
    use super::super::lattice::{LatticeSpec, SphereLattice};
    use super::super::rings::Rings;
    use super::*;

    /// The lattice itself as a surface.
    fn lattice_mesh() -> (Mesh, Vec<[u32; 3]>) {
        let lattice = SphereLattice::new(LatticeSpec::Octahedral { n: 24 });
        let triangles = lattice.triangles(&vec![false; lattice.quads.len()]);
        let rings = Rings::new(lattice.directions.len(), &triangles).expect("closed");
        (Mesh { positions: lattice.directions, rings }, triangles)
    }

    /// Mean over triangles of the longest over the shortest side, where the surface's edges are `edge` of the lattice's.
    fn unevenness(mesh: &Mesh, triangles: &[[u32; 3]], edge: impl Fn(usize, DVec3) -> DVec3) -> f64 {
        let one = |t: &[u32; 3]| {
            let sides = [0, 1, 2].map(|c| {
                let (u, v) = (t[c] as usize, t[(c + 1) % 3] as usize);
                edge(u, mesh.positions[v] - mesh.positions[u]).length()
            });
            sides.into_iter().fold(0.0, f64::max) / sides.into_iter().fold(f64::INFINITY, f64::min)
        };
        triangles.iter().map(one).sum::<f64>() / triangles.len() as f64
    }

    #[test]
    fn triangles_land_with_sides_that_are_more_alike() {
        let (mesh, triangles) = lattice_mesh();
        let fit = fit(&mesh, &mesh.positions);
        let before = unevenness(&mesh, &triangles, |_, e| e);
        let after = unevenness(&mesh, &triangles, |v, e| fit[v].inverse() * e);
        assert!(before > 1.3 && after < 1.0 + 0.5 * (before - 1.0), "{before} to {after}");
        for (v, m) in fit.iter().enumerate() {
            let n = mesh.positions[v];
            let (e1, e2) = tangents(n);
            let area = (*m * e1).cross(*m * e2).length();
            assert!((area - 1.0).abs() < 0.01, "areas are kept: {area}");
        }
    }

    #[test]
    fn a_surface_that_is_turned_has_its_matrices_turned() {
        let (mesh, _) = lattice_mesh();
        let turn = DMat3::from_axis_angle(DVec3::new(1.0, 2.0, -0.5).normalize(), 1.1);
        let turned = Mesh { positions: mesh.positions.iter().map(|&p| turn * p).collect(), rings: mesh.rings.clone() };
        let (plain, other) = (fit(&mesh, &mesh.positions), fit(&turned, &mesh.positions));
        for (a, b) in plain.iter().zip(&other) {
            assert!((turn * *a * turn.transpose()).abs_diff_eq(*b, 1e-9));
        }
    }
}
