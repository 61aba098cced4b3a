//! Points with their distances, for training and for judging it.

use super::spec::{FitSpec, GRID, Sampling};
use super::{CHUNK, Place};
use crate::field::mesh::MeshField;
use crate::field::sampler::Tally;
use crate::field::{Field, Sampler};
use crate::measure::sampling::{Splitmix, by_area};
use crate::settings::{Canceled, Settings};
use glam::DVec3;
use std::f64::consts::TAU;

/// Shares of the samples that lie on the surface, near it and a little farther; the rest is all over the domain.
const SHARES: [f64; 3] = [0.1, 0.4, 0.3];
/// Standard deviations of how far from the surface, in parts of the domain's longest half side.
const NEAR: [f64; 3] = [0.0, 0.01, 0.05];

/// Points of one mesh in the cube that training takes place in, with distances and their gradients.
pub struct Samples {
    pub points: [Vec<f32>; 3],
    pub distances: Vec<f32>,
    pub gradients: [Vec<f32>; 3],
}

impl Samples {
    pub fn len(&self) -> usize {
        self.distances.len()
    }

    /// Samples of mesh number `index`, at least a chunk.
    pub fn of(
        mesh: &MeshField,
        place: Place,
        spec: &FitSpec,
        index: usize,
        settings: &Settings<'_>,
    ) -> Result<Self, Canceled> {
        let seed = spec.seed ^ (index as u64 + 1).wrapping_mul(0xd1b5_4a32_d192_ed03);
        let mut points = match spec.sampling {
            Sampling::Points => around(mesh, place.scale, spec.samples as usize, seed),
            Sampling::Grid => grid(mesh),
        };
        // enough for a chunk, whatever was asked for
        while points.len() < CHUNK {
            points.extend_from_within(..);
        }
        let tally = Tally::new();
        let (distances, gradients) = Sampler::new(mesh, *settings, &tally).gradients(&points)?;
        let column = |list: &[DVec3], axis: usize| list.iter().map(|p| p[axis] as f32).collect();
        let inner: Vec<DVec3> = points.iter().map(|p| (*p - place.center) / place.scale).collect();
        Ok(Self {
            points: std::array::from_fn(|axis| column(&inner, axis)),
            distances: distances.iter().map(|d| (d / place.scale) as f32).collect(),
            gradients: std::array::from_fn(|axis| column(&gradients, axis)),
        })
    }
}

/// `count` points on a mesh, near it and all over its domain; `scale` is the half side that distances are parts of.
pub fn around(mesh: &MeshField, scale: f64, count: usize, seed: u64) -> Vec<DVec3> {
    let mut random = Splitmix::new(seed);
    let domain = mesh.domain();
    let (low, high) = (DVec3::from(domain.min), DVec3::from(domain.max));
    let vertices: Vec<DVec3> = mesh.mesh().vertices.iter().map(|&v| DVec3::from(v)).collect();
    let mut points = Vec::with_capacity(count);
    for (share, deviation) in SHARES.into_iter().zip(NEAR) {
        let on = by_area(&vertices, &mesh.mesh().triangles, (share * count as f64) as usize, random.bits());
        points.extend(on.points.into_iter().map(|p| (p + deviation * scale * normal(&mut random)).clamp(low, high)));
    }
    while points.len() < count {
        points.push(low + (high - low) * DVec3::new(random.unit(), random.unit(), random.unit()));
    }
    points
}

/// The nodes of the paper's grid.
fn grid(mesh: &MeshField) -> Vec<DVec3> {
    let domain = mesh.domain();
    let (low, high) = (DVec3::from(domain.min), DVec3::from(domain.max));
    let node = |i: usize| DVec3::new((i % GRID) as f64, (i / GRID % GRID) as f64, (i / GRID / GRID) as f64);
    (0..GRID.pow(3)).map(|i| low + (high - low) * node(i) / (GRID - 1) as f64).collect()
}

/// Three numbers of the standard normal distribution (Box and Muller 1958).
fn normal(random: &mut Splitmix) -> DVec3 {
    let mut pair = || {
        let (radius, angle) = ((-2.0 * (1.0 - random.unit()).ln()).sqrt(), TAU * random.unit());
        (radius * angle.cos(), radius * angle.sin())
    };
    let ((x, y), (z, _)) = (pair(), pair());
    DVec3::new(x, y, z)
}
