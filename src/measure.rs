//! Measurement: distances, normals, distortion, flips, self-intersections, and the report. Shares no code with the
//! optimiser in `shrink`, so that it can certify what that made.
//!
//! Every definition is in `docs/metrics.md`. Nothing here depends on the number of threads: work is cut into fixed chunks
//! whose results are gathered in order.

pub mod baseline;
pub mod bvh;
pub mod certificate;
pub mod chamfer;
pub mod chart;
pub mod curve;
pub mod distance;
pub mod distortion;
pub mod evaluation;
pub mod intersection;
pub mod marching_cubes;
pub mod moved;
pub mod nearest;
pub mod predicates;
pub mod report;
pub mod sampling;
mod tallied;
pub mod truth;
pub mod verdict;
pub mod zero_set;

pub use report::Report;
pub use verdict::Verdict;

use crate::settings::{Canceled, Settings};
use glam::DVec3;
use rayon::prelude::*;

/// What is measured about a result: of a surface, or of the curve that a 2-D field gives.
#[derive(Clone, Debug, PartialEq, serde::Serialize, utoipa::ToSchema)]
#[serde(untagged)]
pub enum AnyReport {
    /// Of a surface.
    Surface(Box<Report>),
    /// Of a curve: it has the member `dimension`.
    Curve(Box<curve::CurveReport>),
}

/// Items per chunk of a parallel query: enough to pay for the scheduling, few enough that cancel is seen within a few
/// milliseconds. Fixed, so that no result depends on the number of threads.
const CHUNK: usize = 256;

/// Maps every item on the pool, in fixed chunks, results in order.
pub(crate) fn map_chunks<T: Sync, R: Send>(
    items: &[T],
    settings: &Settings<'_>,
    f: impl Fn(usize, &T) -> R + Sync,
) -> Result<Vec<R>, Canceled> {
    let chunks: Vec<Vec<R>> = settings.pool.install(|| {
        items
            .par_chunks(CHUNK)
            .enumerate()
            .map(|(c, chunk)| {
                settings.cancel.check()?;
                Ok(chunk.iter().enumerate().map(|(i, item)| f(c * CHUNK + i, item)).collect())
            })
            .collect::<Result<_, Canceled>>()
    })?;
    let mut all = Vec::with_capacity(items.len());
    all.extend(chunks.into_iter().flatten());
    Ok(all)
}

/// The corners of a triangle.
pub(crate) fn corners(vertices: &[DVec3], triangle: [u32; 3]) -> [DVec3; 3] {
    triangle.map(|v| vertices[v as usize])
}

/// Twice the area times the unit normal.
pub(crate) fn doubled_normal([a, b, c]: [DVec3; 3]) -> DVec3 {
    (b - a).cross(c - a)
}

/// Diagonal of the axis-aligned bounding box of `vertices`; 0 when there are none.
pub fn diagonal(vertices: &[DVec3]) -> f64 {
    let (lo, hi) = vertices.iter().fold((DVec3::INFINITY, DVec3::NEG_INFINITY), |(lo, hi), &p| (lo.min(p), hi.max(p)));
    if vertices.is_empty() { 0.0 } else { (hi - lo).length() }
}

#[cfg(test)]
pub(crate) mod fixtures;
