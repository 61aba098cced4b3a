//! How the surface is to be sampled: evenly by area, more where it is curved and there more across the curvature than along
//! it, or more where the solid or the space beside it is thin, so that tips and limbs keep their shape.

use super::energy::{add_outer, larger_axis, tangents};
use super::points::Points;
use super::rings::Mesh;
use crate::field::{Domain, Sampler};
use crate::settings::{Canceled, Settings};
use glam::{DMat3, DVec3};
use rayon::prelude::*;
use std::ops::{Add, Mul};

/// Largest density over the smallest.
const RANGE: f64 = 2.0;
/// Curvature, in units of the sphere of equal area, from which on more samples are asked for.
const CALM: f64 = 2.0;
/// Largest ratio of the lengths that a sample stands for along and across the curvature.
const ELONGATION: f64 = 2.0;
/// Largest weight over the smallest that is heeded: with less than this share of the samples nothing keeps its shape.
const WEIGHTS: f64 = 16.0;
/// Rounds of averaging over neighbours, so that the map is not asked for jumps.
const ROUNDS: usize = 4;

/// How the surface is to be sampled, at every vertex.
pub struct Sampling {
    /// Samples per area, up to a common factor.
    pub density: Vec<f64>,
    /// What edges are multiplied by before they are mapped: symmetric matrices that keep areas in the tangent plane and
    /// lengthen what turns the normal. The sum of squares of what normals change by from sample to sample is least where
    /// samples are apart as one over the curvature (normals as the signal of Sander et al. 2002, "Signal-specialized
    /// parametrization").
    pub stretch: Vec<DMat3>,
}

impl Sampling {
    /// By area alone.
    pub fn even(vertices: usize) -> Self {
        Self { density: vec![1.0; vertices], stretch: vec![DMat3::IDENTITY; vertices] }
    }

    /// More where the surface is curved, and closer together across the curvature than along it; density from 1 to [`RANGE`].
    pub fn by_curvature(mesh: &Mesh) -> Self {
        let (normals, unit) = (normals(mesh), unit(mesh));
        let turns = turns(mesh, &normals);
        let density = turns.iter().map(|turn| rise((0.5 * trace(turn)).sqrt(), unit)).collect();
        let turns = averaged(mesh, turns).into_iter().map(|turn| turn * (unit * unit));
        let stretch = normals.iter().zip(turns).map(|(&normal, turn)| stretch(normal, &turn)).collect();
        Self { density: averaged(mesh, density), stretch }
    }

    /// More where the solid or the space beside it is thin; density from 1 to [`RANGE`].
    pub fn by_reach(mesh: &Mesh, settings: &Settings<'_>) -> Self {
        let unit = unit(mesh);
        let reach = reach(mesh, &normals(mesh), unit / CALM, settings);
        let density = reach.into_iter().map(|radius| rise(1.0 / radius, unit)).collect();
        Self { density: averaged(mesh, density), ..Self::even(mesh.positions.len()) }
    }

    /// In proportion to a weight, whose values are taken at the vertices' `places` in its scene or, outside its domain, at the
    /// nearest place of that. What is below a 16th of the largest value counts as that. `None` when no value is
    /// positive.
    pub fn by_weight(
        mesh: &Mesh,
        places: impl Iterator<Item = DVec3>,
        weight: &Sampler<'_>,
    ) -> Result<Option<Self>, Canceled> {
        let Domain { min, max } = weight.domain();
        let places: Vec<DVec3> = places.map(|p| p.clamp(min.into(), max.into())).collect();
        let values = weight.values(&places)?;
        let largest = values.iter().copied().fold(0.0, f64::max);
        if largest <= 0.0 {
            return Ok(None);
        }
        let density = values.into_iter().map(|value| value.max(largest / WEIGHTS)).collect();
        Ok(Some(Self { density: averaged(mesh, density), ..Self::even(mesh.positions.len()) }))
    }
}

fn normals(mesh: &Mesh) -> Vec<DVec3> {
    (0..mesh.positions.len() as u32).map(|v| mesh.vertex_normal(v)).collect()
}

/// Radius of the sphere of equal area.
fn unit(mesh: &Mesh) -> f64 {
    (mesh.area() / (4.0 * std::f64::consts::PI)).sqrt()
}

/// The density for a curvature.
fn rise(curvature: f64, unit: f64) -> f64 {
    (curvature * unit / CALM).clamp(1.0, RANGE)
}

/// Every vertex's mean with its ring, again and again.
pub fn averaged<T: Copy + Add<Output = T> + Mul<f64, Output = T>>(mesh: &Mesh, mut values: Vec<T>) -> Vec<T> {
    for _ in 0..ROUNDS {
        values = (0..values.len())
            .map(|v| {
                let ring = mesh.rings.ring(v as u32);
                let rest = ring[1..].iter().fold(values[ring[0] as usize], |sum, &u| sum + values[u as usize]);
                (values[v] + rest * (1.0 / ring.len() as f64)) * 0.5
            })
            .collect();
    }
    values
}

/// The square of the shape operator at every vertex, as a matrix in space: its eigenvalues are the squared principal
/// curvatures, from how normals change along the edges.
fn turns(mesh: &Mesh, normals: &[DVec3]) -> Vec<DMat3> {
    (0..normals.len())
        .map(|v| {
            let (mut sum, mut squared) = (DMat3::ZERO, 0.0);
            for &u in mesh.rings.ring(v as u32) {
                let turn = normals[u as usize] - normals[v];
                add_outer(&mut sum, turn, turn, 1.0);
                squared += mesh.positions[u as usize].distance_squared(mesh.positions[v]);
            }
            // edges in all directions alike have half of their squares along each axis of the plane
            sum * (2.0 / squared.max(1e-30))
        })
        .collect()
}

fn trace(m: &DMat3) -> f64 {
    m.x_axis.x + m.y_axis.y + m.z_axis.z
}

/// The matrix of [`Sampling::stretch`] for squared curvatures in units of the sphere of equal area.
fn stretch(normal: DVec3, turn: &DMat3) -> DMat3 {
    let (e1, e2) = tangents(normal);
    let (a, b, c) = (e1.dot(*turn * e1), e1.dot(*turn * e2), e2.dot(*turn * e2));
    let (mean, radius) = (0.5 * (a + c), (0.25 * (a - c) * (a - c) + b * b).sqrt());
    let (large, small) = (mean + radius, (mean - radius).max(0.0));
    let axis = larger_axis(a, b, c, large);
    let along = axis.x * e1 + axis.y * e2;
    // what is as flat as the sphere of equal area has no direction
    let side = ((1.0 + large) / (1.0 + small)).sqrt().min(ELONGATION).sqrt();
    let mut m = DMat3::ZERO;
    add_outer(&mut m, along, along, side);
    add_outer(&mut m, normal.cross(along), normal.cross(along), 1.0 / side);
    add_outer(&mut m, normal, normal, 1.0);
    m
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
    use crate::measure::fixtures::with_settings;
    use crate::shrink::lattice::{LatticeSpec, SphereLattice};

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

    fn nearest(mesh: &Mesh, q: DVec3) -> usize {
        let distance = |v: &usize| mesh.positions[*v].distance_squared(q);
        (0..mesh.positions.len()).min_by(|a, b| distance(a).total_cmp(&distance(b))).unwrap()
    }

    #[test]
    fn a_plate_is_dense_at_its_rim_by_curvature_and_everywhere_by_reach() {
        let plate = block(DVec3::new(1.0, 1.0, 0.05), 16);
        let middle = nearest(&plate, DVec3::new(0.0, 0.0, 0.05));
        let rim = nearest(&plate, DVec3::new(1.0, 0.0, 0.05));
        let by_curvature = Sampling::by_curvature(&plate).density;
        assert_eq!(by_curvature[middle], 1.0);
        assert!(by_curvature[rim] > 1.5, "{}", by_curvature[rim]);
        let by_reach = with_settings(2, |settings| Sampling::by_reach(&plate, settings).density);
        assert!(by_reach[middle] > 0.95 * RANGE, "{}", by_reach[middle]);
    }

    #[test]
    fn edges_around_a_limb_are_lengthened_edges_along_it_shortened_and_areas_kept() {
        // a needle along z, ten times as long as it is thick, its edges around and along alike
        let lattice = SphereLattice::new(LatticeSpec::Latlong { n_theta: 16, n_phi: 80 });
        let triangles = lattice.triangles(&vec![false; lattice.quads.len()]);
        let positions: Vec<DVec3> = lattice.directions.iter().map(|&d| DVec3::new(0.1, 0.1, 1.0) * d).collect();
        let rings = Rings::new(positions.len(), &triangles).expect("a closed mesh");
        let needle = Mesh { positions, rings };
        let middle = nearest(&needle, 0.1 * DVec3::X);
        let stretch = Sampling::by_curvature(&needle).stretch[middle];
        let side = ELONGATION.sqrt();
        for (edge, expected) in [(DVec3::Y, side), (DVec3::Z, 1.0 / side), (DVec3::X, 1.0)] {
            let found = stretch * edge;
            assert!(found.distance(expected * edge) < 0.01, "{edge} became {found}");
        }
    }

    #[test]
    fn a_cube_is_thin_nowhere_and_its_reach_is_half_its_width_or_more() {
        let cube = block(DVec3::ONE, 16);
        let normals = normals(&cube);
        let middle = nearest(&cube, DVec3::Z);
        let reach = with_settings(1, |settings| reach(&cube, &normals, 10.0, settings)[middle]);
        assert!((reach - 1.0).abs() < 0.02, "the ball that fills the cube has radius 1, not {reach}");
    }
}
