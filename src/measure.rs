//! Measurement: distances, normals, distortion, flips, self-intersections, and the report. Shares no code with the
//! optimiser in `shrink`, so that it can certify what that made.

pub mod certificate;
pub mod distance;
pub mod distortion;
pub mod marching_cubes;
pub mod nearest;
pub mod report;
pub mod sampling;

pub use report::Report;
