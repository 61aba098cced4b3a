//! Marching cubes on the same field, measured against the same truth as the surface: the figures to beat.

use super::bvh::Aabb;
use super::distance::Mesh;
use super::marching_cubes::{Cubes, marching_cubes};
use super::report::Closeness;
use super::truth::Truth;
use crate::settings::Canceled;
use glam::DVec3;

/// Share of the cube's edge that the longest side of the shape takes (the NDC protocol: 0.9 in a cube of edge 1).
pub const FILL: f64 = 0.9;
/// Samples per side of the paper's comparison.
pub const PAPER_SIDE: usize = 27;
/// Samples per side at most: 2^24 field values if none can be left out. Only a shape that fills next to nothing of its cube
/// asks for more.
pub const MAX_SIDE: usize = 256;

/// A mesh of marching cubes, measured.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub struct Baseline {
    /// Samples per side of the cube about the shape, whose edge is the shape's longest side over [`FILL`].
    pub side: usize,
    /// Vertices.
    pub vertices: u64,
    /// Triangles.
    pub triangles: u64,
    /// Field values that the whole grid takes, `side^3`.
    pub values: u64,
    /// Distances, in parts of the truth's diagonal, and how face normals agree.
    #[serde(flatten)]
    pub closeness: Closeness,
}

/// Edge of the cube about a box, and the cube's smallest corner.
fn cube(bounds: Aabb) -> (f64, DVec3) {
    let edge = (bounds.max - bounds.min).max_element() / FILL;
    (edge, 0.5 * (bounds.min + bounds.max) - 0.5 * edge)
}

/// The smallest number of samples per side that gives about `vertices` vertices or more (at most [`MAX_SIDE`]); `None`
/// when there is no truth.
pub fn side_for(truth: &Truth<'_, '_>, vertices: u64) -> Option<usize> {
    let (edge, _) = cube(truth.bounds()?);
    let spacing = (truth.crossings() / vertices.max(1) as f64).sqrt();
    let side = (edge / spacing).ceil() + 1.0;
    side.is_finite().then(|| (side as usize).clamp(2, MAX_SIDE))
}

/// The mesh of marching cubes with `side` samples per side of the cube about the truth; `None` when there is no truth.
///
/// # Errors
/// When the token is raised.
pub fn cubes_at(truth: &Truth<'_, '_>, side: usize) -> Result<Option<Cubes>, Canceled> {
    let Some(bounds) = truth.bounds() else { return Ok(None) };
    let (edge, corner) = cube(bounds);
    marching_cubes(truth.sampler(), corner, corner + edge, side).map(Some)
}

/// Marches with `side` samples per side and compares with the truth; `None` when there is no truth or nothing was met.
///
/// # Errors
/// When the token is raised.
pub fn baseline(truth: &Truth<'_, '_>, side: usize) -> Result<Option<Baseline>, Canceled> {
    let Some(cubes) = cubes_at(truth, side)? else { return Ok(None) };
    let mesh = Mesh { vertices: &cubes.vertices, triangles: &cubes.triangles };
    Ok(truth.compare(mesh)?.map(|comparison| Baseline {
        side,
        vertices: cubes.vertices.len() as u64,
        triangles: cubes.triangles.len() as u64,
        values: cubes.values,
        closeness: comparison.closeness,
    }))
}

#[cfg(test)]
mod tests {
    use super::super::fixtures::*;
    use super::*;
    use crate::field::Sampler;
    use crate::field::sampler::Tally;

    #[test]
    fn the_side_gives_the_vertices_that_were_asked_for() {
        with_settings(2, |settings| {
            let (field, tally) = (Balls::one(0.6), Tally::new());
            let sampler = Sampler::new(&field, *settings, &tally);
            let truth = Truth::of(&sampler).unwrap();
            for wanted in [1000, 6000] {
                let side = side_for(&truth, wanted).unwrap();
                let found = baseline(&truth, side).unwrap().unwrap();
                let ratio = found.vertices as f64 / wanted as f64;
                assert!((0.97..1.12).contains(&ratio), "{wanted}: {found:?}");
                assert!(
                    found.closeness.distance.max < 0.01 && found.closeness.normal_consistency_signed > 0.99,
                    "{found:?}"
                );
            }
        });
    }

    #[test]
    fn a_field_without_a_surface_has_no_baseline() {
        with_settings(1, |settings| {
            let field = Balls { balls: vec![(glam::Vec3::ZERO, -0.5)], ..Balls::one(0.5) };
            let tally = Tally::new();
            let sampler = Sampler::new(&field, *settings, &tally);
            let truth = Truth::of(&sampler).unwrap();
            assert_eq!(side_for(&truth, 1000), None);
            assert_eq!(baseline(&truth, 27).unwrap(), None);
        });
    }
}
