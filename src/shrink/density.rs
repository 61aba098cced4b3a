//! How densely the surface is to be sampled: evenly by area, and more where it is curved, so that tips and limbs keep
//! their shape.

use super::Density;
use super::rings::Mesh;
use glam::DVec3;

/// Largest density over the smallest.
const RANGE: f64 = 3.0;
/// Curvature, in units of the sphere of equal area, from which on more samples are asked for.
const CALM: f64 = 2.0;
/// Density grows with this power of the curvature.
const POWER: f64 = 0.5;
/// Rounds of averaging over neighbours, so that the map is not asked for jumps.
const ROUNDS: usize = 4;

/// The density at every vertex, from 1 to [`RANGE`].
pub fn density(mesh: &Mesh, kind: Density) -> Vec<f64> {
    if kind == Density::Area {
        return vec![1.0; mesh.positions.len()];
    }
    let radius = (mesh.area() / (4.0 * std::f64::consts::PI)).sqrt();
    let n = mesh.positions.len() as u32;
    let normals: Vec<DVec3> = (0..n).map(|v| mesh.vertex_normal(v)).collect();
    let mut density: Vec<f64> = (0..n)
        .map(|v| {
            let ring = mesh.rings.ring(v);
            let squared: f64 = ring
                .iter()
                .map(|&u| {
                    let turn = normals[u as usize].distance_squared(normals[v as usize]);
                    turn / mesh.positions[u as usize].distance_squared(mesh.positions[v as usize]).max(1e-30)
                })
                .sum();
            let curvature = (squared / ring.len() as f64).sqrt() * radius;
            (curvature / CALM).powf(POWER).clamp(1.0, RANGE)
        })
        .collect();
    for _ in 0..ROUNDS {
        density = (0..n)
            .map(|v| {
                let ring = mesh.rings.ring(v);
                let around: f64 = ring.iter().map(|&u| density[u as usize]).sum();
                0.5 * (density[v as usize] + around / ring.len() as f64)
            })
            .collect();
    }
    density
}
