//! How densely the surface is to be sampled: evenly by area, more where it is curved, or more where the solid or the space
//! beside it is thin, so that tips and limbs keep their shape.

use super::Density;
use super::points::Points;
use super::rings::Mesh;
use crate::settings::Settings;
use glam::DVec3;
use rayon::prelude::*;

/// Largest density over the smallest.
const RANGE: f64 = 3.0;
/// Curvature, in units of the sphere of equal area, from which on more samples are asked for.
const CALM: f64 = 2.0;
/// Density grows with this power of the curvature, or of one over the reach.
const POWER: f64 = 0.5;
/// Rounds of averaging over neighbours, so that the map is not asked for jumps.
const ROUNDS: usize = 4;

/// The density at every vertex, from 1 to [`RANGE`].
pub fn density(mesh: &Mesh, kind: Density, settings: &Settings<'_>) -> Vec<f64> {
    let n = mesh.positions.len() as u32;
    let normals: Vec<DVec3> = (0..n).map(|v| mesh.vertex_normal(v)).collect();
    let unit = (mesh.area() / (4.0 * std::f64::consts::PI)).sqrt();
    let narrowness = match kind {
        Density::Area => return vec![1.0; n as usize],
        Density::Curvature => curvature(mesh, &normals),
        Density::Reach => reach(mesh, &normals, unit / CALM, settings).into_iter().map(|r| 1.0 / r).collect(),
    };
    let mut density: Vec<f64> =
        narrowness.into_iter().map(|k| (k * unit / CALM).powf(POWER).clamp(1.0, RANGE)).collect();
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

/// Root mean square of the normal curvatures along a vertex's edges.
fn curvature(mesh: &Mesh, normals: &[DVec3]) -> Vec<f64> {
    (0..mesh.positions.len() as u32)
        .map(|v| {
            let ring = mesh.rings.ring(v);
            let squared: f64 = ring
                .iter()
                .map(|&u| {
                    let turn = normals[u as usize].distance_squared(normals[v as usize]);
                    turn / mesh.positions[u as usize].distance_squared(mesh.positions[v as usize]).max(1e-30)
                })
                .sum();
            (squared / ring.len() as f64).sqrt()
        })
        .collect()
}

/// Radius, at most `largest`, of the largest ball that touches the surface at every vertex from either side and holds no
/// other vertex: the distance to the medial axis, of the solid or of the space around it (the shrinking ball of Ma, Bae and
/// Choi 2012, "3D medial axis point approximation using nearest neighbors and the normal field").
fn reach(mesh: &Mesh, normals: &[DVec3], largest: f64, settings: &Settings<'_>) -> Vec<f64> {
    /// Balls at most; each one is smaller than the one before.
    const SHRINKS: usize = 12;
    /// Vertices per piece of parallel work.
    const CHUNK: usize = 256;
    let points = Points::new(mesh.positions.clone());
    let ball = |v: usize, outward: DVec3| {
        let p = mesh.positions[v];
        let mut radius = largest;
        for _ in 0..SHRINKS {
            let q = points.nearest(p + radius * outward);
            let apart = q - p;
            let height = apart.dot(outward);
            // a vertex below the tangent plane, or the vertex itself, does not shrink the ball
            let smaller = apart.length_squared() / (2.0 * height);
            if height <= 0.0 || smaller > 0.99 * radius {
                break;
            }
            radius = smaller;
        }
        radius
    };
    let both = |v: usize| ball(v, normals[v]).min(ball(v, -normals[v]));
    settings.pool.install(|| (0..mesh.positions.len()).into_par_iter().with_min_len(CHUNK).map(both).collect())
}
