//! From the base surface and its sphere map to a lattice: where the poles go and where every lattice vertex
//! lands.

use super::lattice::{LatticeSpec, SphereLattice};
use super::locate::locate;
use super::rings::Mesh;
use crate::settings::{Canceled, Settings};
use glam::{DMat3, DVec3};
use rayon::prelude::*;
use std::f64::consts::PI;

/// The directions of a map turned so that a lattice's singular points lie where the surface is flat and evenly sampled.
/// Only the lat-long lattice has such points.
pub fn orient(mesh: &Mesh, directions: &[DVec3], spec: LatticeSpec, settings: &Settings<'_>) -> Vec<DVec3> {
    match spec {
        LatticeSpec::Octahedral { .. } => directions.to_vec(),
        LatticeSpec::Latlong { .. } => {
            let turn = pole_rotation(mesh, directions, settings);
            directions.iter().map(|&d| turn * d).collect()
        }
    }
}

/// The rotation that takes the best axis to z: over both polar caps the surface's normals agree and its area is even.
fn pole_rotation(mesh: &Mesh, directions: &[DVec3], settings: &Settings<'_>) -> DMat3 {
    /// Half opening of a cap.
    const CAP: f64 = 10.0 * PI / 180.0;
    /// Axes tried.
    const AXES: usize = 300;
    struct Facet {
        direction: DVec3,
        normal: DVec3,
        stretch: f64,
        solid_angle: f64,
    }
    let triangles = mesh.rings.triangles();
    let area = mesh.area();
    let facets: Vec<Facet> = triangles
        .iter()
        .map(|&t| {
            let [a, b, c] = t.map(|v| directions[v as usize]);
            let normal = mesh.normal(t);
            // volume of the tetrahedron with the centre, a fair share of the sphere for small triangles
            let solid_angle = a.dot(b.cross(c)).max(1e-12);
            Facet {
                direction: (a + b + c).normalize_or(DVec3::Z),
                normal: normal.normalize_or_zero(),
                stretch: normal.length().max(1e-12) / area / solid_angle,
                solid_angle,
            }
        })
        .collect();
    let total: f64 = facets.iter().map(|f| f.solid_angle).sum();
    let score = |axis: DVec3| -> f64 {
        [1.0, -1.0]
            .into_iter()
            .map(|sign| {
                let (mut normal, mut weight, mut uneven, mut count) = (DVec3::ZERO, 0.0, 0.0, 0.0);
                for f in facets.iter().filter(|f| sign * f.direction.dot(axis) > CAP.cos()) {
                    normal += f.normal * f.solid_angle;
                    weight += f.solid_angle;
                    uneven += (0.5 * f.stretch * total).ln().abs();
                    count += 1.0;
                }
                if count == 0.0 { 9.0 } else { 1.0 - normal.length() / weight + 0.2 * uneven / count }
            })
            .fold(0.0, f64::max)
    };
    // a spiral of even density (Fibonacci)
    let scored = |i: usize| {
        let z = 1.0 - (i as f64 + 0.5) / AXES as f64;
        let (angle, radius) = (PI * (1.0 + 5f64.sqrt()) * (i as f64 + 0.5), (1.0 - z * z).sqrt());
        let axis = DVec3::new(angle.cos() * radius, angle.sin() * radius, z);
        (score(axis), axis)
    };
    let scores: Vec<(f64, DVec3)> = settings.pool.install(|| (0..AXES).into_par_iter().map(scored).collect());
    let axis = scores.into_iter().min_by(|a, b| a.0.total_cmp(&b.0)).map_or(DVec3::Z, |best| best.1);
    let (x, y) = super::energy::tangents(axis);
    DMat3::from_cols(x, y, axis).transpose()
}

/// Where every lattice vertex lands on the base mesh, by linear interpolation in its triangle, and the mesh's unit normals
/// there.
pub fn land(
    mesh: &Mesh,
    directions: &[DVec3],
    lattice: &SphereLattice,
    settings: &Settings<'_>,
) -> Result<(Vec<DVec3>, Vec<DVec3>), Canceled> {
    let places = locate(mesh, directions, &lattice.directions, settings)?;
    let normals: Vec<DVec3> = (0..mesh.positions.len() as u32).map(|v| mesh.vertex_normal(v)).collect();
    let mix =
        |list: &[DVec3], (t, w): &([u32; 3], [f64; 3])| -> DVec3 { (0..3).map(|c| w[c] * list[t[c] as usize]).sum() };
    Ok(places.iter().map(|place| (mix(&mesh.positions, place), mix(&normals, place).normalize_or_zero())).unzip())
}
