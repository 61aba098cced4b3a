//! The report: every figure of a result, measured. Definitions are in `docs/metrics.md`.

use super::certificate::{certify, uv_flips};
use super::distance::{Comparison, to_truth};
use super::distortion::distortions;
use super::moved::Moved;
use super::verdict::{Figures, Verdict, judge};
use crate::field::network::family::Detected;
use crate::field::sampler::Tally;
use crate::field::{Counts, Sampler};
use crate::settings::Canceled;
use crate::shrink::Method;
use crate::shrink::ShrinkSpec;
use crate::shrink::lattice::LatticeSpec;
use crate::shrink::study::Topology;
use crate::surface::Surface;
use std::collections::BTreeMap;

/// Largest distance, in parts of the truth's diagonal, at which a shape still succeeds.
pub const MAX_DISTANCE: f64 = 0.01;

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
    /// Pairs of triangles that meet in more than the vertices or the edge they share, by exact predicates.
    pub self_intersections: u64,
    /// Triangles of exactly no area.
    pub degenerate: u64,
    /// Distances between surface and truth, and how the normals agree.
    #[serde(flatten)]
    pub closeness: Closeness,
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
    /// Every option that it was made with.
    pub options: ShrinkSpec,
    /// What the shape was found to be, where `component` or `on_topology: wrap` asked for a look. All figures are then
    /// against the field as it was mended: without other components, with plugs across handles and bridges.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub topology: Option<Topology>,
    /// What a network's file was taken for, and what it does not say; filled in by the caller, who opened it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub network: Option<Detected>,
    /// What became of the warm start, where one was asked for.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub warm_start: Option<WarmStart>,
    /// Attempts that were made at the surface, each with more effort, a warm start before them included; `evaluations` and
    /// `seconds` are those of all.
    pub attempts: u32,
    /// Whether the result succeeds, and if not, why not and where.
    pub verdict: Verdict,
    /// Version of shrinkd.
    pub version: String,
    /// Distance of every triangle from the truth, scene units, see
    /// [`Comparison::by_triangle`](super::distance::Comparison::by_triangle); written with the surface, not with the report.
    #[serde(skip)]
    #[schema(ignore)]
    pub by_triangle: Vec<f32>,
}

/// Measures a surface against the field behind `sampler`. `spent` are the evaluations that made the surface, by stage;
/// those that measuring takes are counted into a tally of its own and forgotten. `seconds` are left at 0 for the caller,
/// who has a clock.
///
/// A surface or a field without any zero to compare has a distance of 1 (the whole diagonal) and consistency 0.
///
/// # Errors
/// When the token is raised.
pub fn measure(
    surface: &Surface,
    sampler: &Sampler<'_>,
    spent: &BTreeMap<&'static str, Counts>,
    spec: &ShrinkSpec,
) -> Result<Report, Canceled> {
    let own = Tally::new();
    let sampler = Sampler::new(sampler.field(), *sampler.settings(), &own);
    let certificate = certify(surface, &sampler)?;
    let comparison = to_truth(surface, &sampler)?.unwrap_or_else(Comparison::nothing);
    let vertices = surface.positions.len() as u64;
    Ok(Report {
        vertices,
        triangles: surface.triangles.len() as u64,
        evaluations: Evaluations::new(spent, vertices),
        closed: certificate.topology.closed,
        euler: certificate.topology.euler,
        charts: certificate.charts,
        flips: certificate.flips,
        self_intersections: certificate.self_intersections,
        degenerate: certificate.degenerate,
        closeness: comparison.closeness,
        distortion: distortions(surface),
        seconds: Seconds::default(),
        threads: sampler.settings().pool.current_num_threads() as u64,
        method: spec.method,
        lattice: spec.lattice,
        options: spec.clone(),
        topology: None,
        network: None,
        warm_start: None,
        attempts: 1,
        verdict: judge(&certificate, &comparison, vertices),
        version: env!("CARGO_PKG_VERSION").to_owned(),
        by_triangle: comparison.by_triangle,
    })
}

impl Report {
    /// Measures the chart anew, after it was relaxed: its flips, its distortion, and the verdict on both.
    pub fn measure_chart(&mut self, surface: &Surface) {
        self.flips.uv = uv_flips(surface);
        self.distortion = distortions(surface);
        let code = "chart_turned";
        self.verdict.faults.retain(|fault| fault.code != code);
        self.verdict.passed = self.verdict.faults.is_empty();
        let figures = Figures { flips: Flips { uv: self.flips.uv, ..Flips::default() }, ..Figures::SOUND };
        for (code, detail) in figures.misses() {
            self.verdict.fail(code, detail, &[]);
        }
    }
}

/// Whether a result succeeds by the whole bar, also where its lattice is too coarse to be held to it: closed, Euler 2, one
/// chart, no flip of any kind, no self-intersection, and nowhere farther than [`MAX_DISTANCE`] of the diagonal from the truth,
/// both ways.
///
/// # Errors
/// One sentence for every condition that does not hold.
pub fn passes(report: &Report) -> Result<(), Vec<String>> {
    let Verdict { faults, warnings, .. } = &report.verdict;
    let misses: Vec<String> = faults.iter().chain(warnings).map(|finding| finding.detail.clone()).collect();
    if misses.is_empty() { Ok(()) } else { Err(misses) }
}

/// What became of a warm start: of beginning from an earlier surface.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize, utoipa::ToSchema)]
pub struct WarmStart {
    /// Whether the surface was made from the earlier one. If not, it was made as if there had been none: every place on the sphere
    /// may be anywhere else on the surface than it was.
    pub used: bool,
    /// What the certificate said of the surface that the earlier one became, where that was not used.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub reason: Option<String>,
    /// How far vertices are from where they were on the earlier surface, whether it was used or not.
    #[serde(flatten)]
    pub moved: Moved,
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

impl Evaluations {
    /// Sums what was spent by stage.
    pub fn new(spent: &BTreeMap<&'static str, Counts>, vertices: u64) -> Self {
        let (value, gradient) = spent.values().fold((0, 0), |sum, c| (sum.0 + c.value, sum.1 + c.gradient));
        Self {
            value,
            gradient,
            per_vertex: (value + gradient) as f64 / vertices.max(1) as f64,
            by_stage: spent.iter().map(|(stage, counts)| ((*stage).to_owned(), *counts)).collect(),
        }
    }
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

/// How close a surface or a curve and its truth are, and how their normals agree, both ways.
#[derive(Clone, Copy, Debug, Default, PartialEq, serde::Serialize, serde::Deserialize, utoipa::ToSchema)]
pub struct Closeness {
    /// Distances, in parts of the truth's bounding-box diagonal, both ways.
    pub distance: Distance,
    /// Mean of |n . n'| over both directions: normals of faces, or of a curve's edges.
    pub normal_consistency: f64,
    /// Mean of n . n' over both directions.
    pub normal_consistency_signed: f64,
}

impl Closeness {
    /// Puts both directions together.
    pub fn both(surface_to_truth: OneWay, truth_to_surface: OneWay) -> Self {
        let (a, b) = (surface_to_truth, truth_to_surface);
        Self {
            distance: Distance {
                mean: 0.5 * (a.mean + b.mean),
                rms: (0.5 * (a.rms * a.rms + b.rms * b.rms)).sqrt(),
                max: a.max.max(b.max),
                surface_to_truth,
                truth_to_surface,
            },
            normal_consistency: 0.5 * (a.normal_consistency + b.normal_consistency),
            normal_consistency_signed: 0.5 * (a.normal_consistency_signed + b.normal_consistency_signed),
        }
    }

    /// Of nothing that could be compared: the whole diagonal away, no normals that agree.
    pub fn nothing() -> Self {
        let far = OneWay { mean: 1.0, rms: 1.0, max: 1.0, ..OneWay::default() };
        Self::both(far, far)
    }
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
    /// From the UV square before `relax_uv`: where the vertices' places on the sphere are. Only where it was asked for.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub uv_before: Option<Distortion>,
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

#[cfg(test)]
mod tests {
    use super::super::fixtures::*;
    use super::*;
    use glam::DVec3;

    fn report(surface: &Surface, threads: usize) -> Report {
        with_settings(threads, |settings| {
            let (field, tally) = (Balls::one(0.5), Tally::new());
            let sampler = Sampler::new(&field, *settings, &tally);
            let spent = BTreeMap::from([("resample", Counts { value: 1000, gradient: 500 })]);
            let report = measure(surface, &sampler, &spent, &ShrinkSpec::default()).unwrap();
            assert_eq!(tally.total(), Counts::default(), "measuring is not counted");
            report
        })
    }

    #[test]
    fn a_sphere_on_its_field_passes() {
        let surface = sphere_surface(LatticeSpec::default(), 0.5);
        let found = report(&surface, 2);
        assert_eq!(passes(&found), Ok(()));
        assert!(found.closeness.distance.max < 5e-4 && found.closeness.normal_consistency_signed > 0.999, "{found:?}");
        assert_eq!((found.evaluations.value, found.evaluations.gradient), (1000, 500));
        assert!((found.evaluations.per_vertex - 1500.0 / 19802.0).abs() < 1e-12);
        let one = Report { threads: 2, ..report(&surface, 1) };
        assert_eq!(one, found, "the number of threads changes nothing else");
    }

    #[test]
    fn every_broken_condition_is_named() {
        let mut surface = sphere_surface(LatticeSpec::Octahedral { n: 20 }, 0.5);
        surface.positions[400] = (1.3 * DVec3::from_array(surface.positions[400].map(f64::from))).as_vec3().to_array();
        surface.triangles[3].swap(0, 1);
        let faults = passes(&report(&surface, 1)).unwrap_err();
        for part in ["not closed", "folded over on the surface", "turned over on the sphere", "largest distance"] {
            assert!(faults.iter().any(|f| f.contains(part)), "{part}: {faults:?}");
        }
    }

    #[test]
    fn the_report_survives_json() {
        let found = report(&sphere_surface(LatticeSpec::Octahedral { n: 8 }, 0.5), 1);
        let text = serde_json::to_string(&found).unwrap();
        let back: Report = serde_json::from_str(&text).unwrap();
        assert_eq!(back.flips, found.flips);
        assert!((back.closeness.distance.mean - found.closeness.distance.mean).abs() < 1e-15);
    }
}
