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

#[cfg(test)]
mod tests {
    use super::super::rings::Rings;
    use super::*;
    use crate::settings::{CancelToken, Progress};

    /// A box of these half sides, every face a grid of `n` x `n`.
    fn block(half: DVec3, n: i32) -> Mesh {
        let mut numbers = std::collections::HashMap::new();
        let (mut positions, mut triangles) = (Vec::new(), Vec::new());
        for (axis, side) in [(0, -1), (0, 1), (1, -1), (1, 1), (2, -1), (2, 1)] {
            let mut vertex = |i: i32, j: i32| {
                let mut key = [0; 3];
                (key[axis], key[(axis + 1) % 3], key[(axis + 2) % 3]) = (side * n, 2 * i - n, 2 * j - n);
                *numbers.entry(key).or_insert_with(|| {
                    positions.push(DVec3::from_array(key.map(|k| f64::from(k) / f64::from(n))) * half);
                    positions.len() as u32 - 1
                })
            };
            for i in 0..n {
                for j in 0..n {
                    let mut quad = [vertex(i, j), vertex(i + 1, j), vertex(i + 1, j + 1), vertex(i, j + 1)];
                    if side < 0 {
                        quad.reverse();
                    }
                    triangles.extend([[quad[0], quad[1], quad[2]], [quad[0], quad[2], quad[3]]]);
                }
            }
        }
        let rings = Rings::new(positions.len(), &triangles).expect("a closed mesh");
        Mesh { positions, rings }
    }

    fn made(mesh: &Mesh, kind: Density) -> Vec<f64> {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(2).build().unwrap();
        let cancel = CancelToken::new();
        density(mesh, kind, &Settings { pool: &pool, cancel: &cancel, progress: &|_: Progress| {} })
    }

    fn nearest(mesh: &Mesh, q: DVec3) -> usize {
        let distance = |v: &usize| mesh.positions[*v].distance_squared(q);
        (0..mesh.positions.len()).min_by(|a, b| distance(a).total_cmp(&distance(b))).unwrap()
    }

    #[test]
    fn a_plate_is_dense_at_its_rim_by_curvature_and_everywhere_by_reach() {
        let plate = block(DVec3::new(1.0, 1.0, 0.05), 16);
        let middle = nearest(&plate, DVec3::new(0.0, 0.0, 0.05));
        let rim = nearest(&plate, DVec3::new(1.0, 0.0, 0.05));
        assert!(made(&plate, Density::Area).iter().all(|&d| d == 1.0));
        let by_curvature = made(&plate, Density::Curvature);
        assert_eq!(by_curvature[middle], 1.0);
        assert!(by_curvature[rim] > 1.5, "{}", by_curvature[rim]);
        let by_reach = made(&plate, Density::Reach);
        assert!(by_reach[middle] > 2.0, "{}", by_reach[middle]);
    }

    #[test]
    fn a_cube_is_thin_nowhere_and_its_reach_is_half_its_width_or_more() {
        let cube = block(DVec3::ONE, 16);
        let normals: Vec<DVec3> = (0..cube.positions.len() as u32).map(|v| cube.vertex_normal(v)).collect();
        let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
        let cancel = CancelToken::new();
        let settings = Settings { pool: &pool, cancel: &cancel, progress: &|_: Progress| {} };
        let middle = nearest(&cube, DVec3::Z);
        let reach = reach(&cube, &normals, 10.0, &settings)[middle];
        assert!((reach - 1.0).abs() < 0.02, "the ball that fills the cube has radius 1, not {reach}");
    }
}
