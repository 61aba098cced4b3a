//! The report: every figure of a result, measured.

use crate::field::Counts;
use crate::shrink::Method;
use crate::shrink::lattice::LatticeSpec;
use std::collections::BTreeMap;

/// Everything measured about one result; the same object in `report.json`, over HTTP and in the GLB's extras.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize, utoipa::ToSchema)]
pub struct Report {
    /// Welded vertices.
    pub vertices: u64,
    /// Triangles.
    pub triangles: u64,
    /// Field evaluations spent to make the surface (measuring not counted).
    pub evaluations: Evaluations,
    /// Whether every edge has exactly two triangles, oppositely oriented.
    pub closed: bool,
    /// Euler characteristic V - E + F.
    pub euler: i64,
    /// Connected charts in the UV square.
    pub charts: u64,
    /// Folded triangles: on the surface (normal against the field's gradient), on the sphere, in the chart.
    pub flips: Flips,
    /// Pairs of triangles that intersect and share no vertex.
    pub self_intersections: u64,
    /// Distances between surface and truth, in parts of the truth's bounding-box diagonal, both ways.
    pub distance: Distance,
    /// Mean of |n . n'| over both directions, face normals.
    pub normal_consistency: f64,
    /// Distortion of the parameterization.
    pub distortion: Distortions,
    /// Wall-clock seconds by part of the job; filled in by the caller, who has a clock.
    pub seconds: Seconds,
    /// Threads of the pool.
    pub threads: u64,
    /// How it was shrunk.
    pub method: Method,
    /// The lattice.
    pub lattice: LatticeSpec,
    /// Version of shrinkd.
    pub version: String,
}

/// Field evaluations.
#[derive(Clone, Debug, Default, PartialEq, serde::Serialize, serde::Deserialize, utoipa::ToSchema)]
pub struct Evaluations {
    /// Values alone.
    pub value: u64,
    /// Values with gradients.
    pub gradient: u64,
    /// Both, per welded vertex.
    pub per_vertex: f64,
    /// By stage.
    pub by_stage: BTreeMap<String, Counts>,
}

/// Folded triangles.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize, utoipa::ToSchema)]
pub struct Flips {
    /// Triangles whose normal opposes the field's gradient at the centroid.
    pub surface: u64,
    /// Sphere triangles of negative orientation.
    pub sphere: u64,
    /// Chart triangles of negative area.
    pub uv: u64,
}

/// Distances, in parts of the bounding-box diagonal of the truth.
#[derive(Clone, Copy, Debug, Default, PartialEq, serde::Serialize, serde::Deserialize, utoipa::ToSchema)]
pub struct Distance {
    /// Mean of the two directions' means.
    pub mean: f64,
    /// Root of the mean of the two directions' mean squares.
    pub rms: f64,
    /// Largest of both directions.
    pub max: f64,
    /// From samples of the surface to the truth.
    pub surface_to_truth: OneWay,
    /// From samples of the truth to the surface.
    pub truth_to_surface: OneWay,
}

/// Distances in one direction, in parts of the bounding-box diagonal of the truth, and normals there.
#[derive(Clone, Copy, Debug, Default, PartialEq, serde::Serialize, serde::Deserialize, utoipa::ToSchema)]
pub struct OneWay {
    /// Mean, by area.
    pub mean: f64,
    /// Root mean square, by area.
    pub rms: f64,
    /// Largest, vertices included.
    pub max: f64,
    /// Mean of |n . n'|, face normals.
    pub normal_consistency: f64,
    /// Mean of n . n', face normals.
    pub normal_consistency_signed: f64,
}

/// Distortion of sphere -> surface and of UV -> surface.
#[derive(Clone, Copy, Debug, Default, PartialEq, serde::Serialize, serde::Deserialize, utoipa::ToSchema)]
pub struct Distortions {
    /// From the unit sphere.
    pub sphere: Distortion,
    /// From the UV square.
    pub uv: Distortion,
}

/// Distortion of one map, areas matched globally; s1 >= s2 are the singular values per triangle.
#[derive(Clone, Copy, Debug, Default, PartialEq, serde::Serialize, serde::Deserialize, utoipa::ToSchema)]
pub struct Distortion {
    /// Area-weighted mean of s1 / s2.
    pub qc: f64,
    /// Root mean square of log(area on the surface / area in the domain).
    pub log_area_rms: f64,
    /// Smallest area ratio.
    pub area_min: f64,
    /// Largest area ratio.
    pub area_max: f64,
    /// 1st percentile of the area ratio over triangles.
    pub area_p1: f64,
    /// 99th percentile of the area ratio over triangles.
    pub area_p99: f64,
    /// Area-weighted mean of s1^2 + s2^2 + s1^-2 + s2^-2 (ideal 4).
    pub symmetric_dirichlet: f64,
    /// L2 stretch: root of the area-weighted mean of (s1^2 + s2^2) / 2.
    pub l2_stretch: f64,
}

/// Wall-clock seconds.
#[derive(Clone, Copy, Debug, Default, PartialEq, serde::Serialize, serde::Deserialize, utoipa::ToSchema)]
pub struct Seconds {
    /// Reading and preparing the field.
    pub load: f64,
    /// Shrinking.
    pub shrink: f64,
    /// Normals, forms, measuring.
    pub finish: f64,
    /// Writing outputs.
    pub write: f64,
}
