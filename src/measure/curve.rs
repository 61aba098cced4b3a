//! The certificate of a curve: closed, simple, once around, on the zero set both ways, and how evenly its parameter runs. Shares no
//! code with what made the curve. Definitions are in `docs/metrics.md`.

mod polygon;
mod zeros;

use super::nearest::Nearest;
use super::report::{Closeness, Evaluations, Flips, MAX_DISTANCE, Seconds};
use super::tallied::Tallied;
use super::verdict::{Verdict, too_far};
use super::zero_set::trace;
use super::{diagonal, map_chunks};
use crate::field::sampler::Tally;
use crate::field::{Counts, Metric, Sampler};
use crate::settings::Canceled;
use crate::shrink::curve::{Curve, LeftOut};
use crate::shrink::{Method, ShrinkSpec};
use glam::{DVec2, DVec3};
use polygon::{crossings, turning_number};
use std::collections::{BTreeMap, BTreeSet};
use zeros::Zeros;

/// Largest deviation of |du/ds| from 1 at which the parameter still is arc length.
pub const MAX_DEVIATION: f64 = 0.05;
/// Places listed at most, of each kind.
const PLACES: usize = 16;
/// Points at which all edges together are looked at, and those of one edge at least and at most.
const PROBES: usize = 16_000;
const PIECES: (usize, usize) = (2, 256);
/// How far from an edge the zero set is looked for along the gradient, in parts of the diagonal. Beyond, the nearest point
/// that the grid found counts.
const REACH: f64 = 0.05;

/// Everything measured about a curve. Members have the names of a surface's report where they mean the same.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize, utoipa::ToSchema)]
pub struct CurveReport {
    /// 2: of a curve.
    pub dimension: u8,
    /// Samples.
    pub vertices: u64,
    /// Edges of the polygon through them.
    pub edges: u64,
    /// Field evaluations spent to make the curve (measuring not counted).
    pub evaluations: Evaluations,
    /// Whether the polygon has at least three vertices, the last joined to the first, and no edge without length.
    pub closed: bool,
    /// Whether no two edges meet in more than the vertex they share.
    pub simple: bool,
    /// Euler characteristic V - E.
    pub euler: i64,
    /// How often the direction of travel turns around, counter-clockwise positive.
    pub turning_number: i64,
    /// Edges that run the wrong way: on the curve (outward normal against the field's gradient), and in the parameter,
    /// on the circle and on the interval.
    pub flips: Flips,
    /// Pairs of edges that meet in more than the vertex they share, by exact predicates.
    pub self_intersections: u64,
    /// Edges of exactly no length.
    pub degenerate: u64,
    /// Distances between curve and zero set, and how edge normals agree with the field's gradients.
    #[serde(flatten)]
    pub closeness: Closeness,
    /// How the parameter runs along the zero set.
    pub arc_length: ArcLength,
    /// Samples that are corners of the zero set.
    pub corners: u64,
    /// What the curve was asked not to follow.
    pub left_out: LeftOut,
    /// Wall-clock seconds by part of the job; filled in by the caller, who has a clock.
    pub seconds: Seconds,
    /// Threads of the pool.
    pub threads: u64,
    /// How it was shrunk.
    pub method: Method,
    /// Every option it was made with.
    pub options: ShrinkSpec,
    /// Version of shrinkd.
    pub version: String,
    /// Attempts that were made; `evaluations` and `seconds` are those of all of them.
    pub attempts: u32,
    /// Whether it succeeds, and if not, why.
    pub verdict: Verdict,
}

/// The parameter against the length of the zero set between successive samples.
#[derive(Clone, Copy, Debug, Default, PartialEq, serde::Serialize, serde::Deserialize, utoipa::ToSchema)]
pub struct ArcLength {
    /// Length of the zero set along the curve, scene units.
    pub length: f64,
    /// Largest deviation of |du/ds| from 1, s being length in parts of the whole.
    pub deviation_max: f64,
    /// Root mean square of the deviation, by length.
    pub deviation_rms: f64,
    /// Shortest step between successive samples, in parts of the mean.
    pub step_min: f64,
    /// Longest step between successive samples, in parts of the mean.
    pub step_max: f64,
}

/// Where points land on the zero set, and the unit gradients there.
struct Landed {
    ends: Vec<DVec3>,
    normals: Vec<DVec3>,
}

/// Measures a curve against the field behind `sampler`. `spent` are the evaluations that made it, by stage; those that
/// measuring takes are counted into a tally of its own and forgotten. `seconds` are left at 0 for the caller.
///
/// A field without any zero to compare has a distance of 1 (the whole diagonal) and consistency 0.
///
/// # Errors
/// When the token is raised.
pub fn measure(
    curve: &Curve,
    sampler: &Sampler<'_>,
    spent: &BTreeMap<&'static str, Counts>,
    spec: &ShrinkSpec,
) -> Result<CurveReport, Canceled> {
    let own = Tally::new();
    let settings = *sampler.settings();
    let sampler = Sampler::new(sampler.field(), settings, &own);
    let polygon: Vec<DVec2> = curve.positions.iter().map(|&p| DVec2::from(p)).collect();
    let n = polygon.len();
    let ends = |i: usize| [polygon[i], polygon[(i + 1) % n]];
    let degenerate = (0..n).filter(|&i| ends(i)[0] == ends(i)[1]).count() as u64;
    let crossing = crossings(&polygon, &settings)?;
    let middle = |i: usize| (0.5 * (ends(i)[0] + ends(i)[1])).extend(0.0);
    let backwards = backwards(&polygon, &sampler)?;

    let zeros = followed(zeros::find(&sampler)?, &polygon, curve.left_out, &sampler)?;
    let (size, compared) = (diagonal(&zeros.points), !zeros.points.is_empty());
    let pieces = (PROBES / n.max(1)).clamp(PIECES.0, PIECES.1);
    let probes: Vec<DVec3> = (0..n)
        .flat_map(|i| (0..pieces).map(move |k| (i, k as f64 / pieces as f64)))
        .map(|(i, t)| ends(i)[0].lerp(ends(i)[1], t).extend(0.0))
        .collect();
    let mut worst = Vec::new();
    let (mut there, mut back) = (Tallied::default(), Tallied::default());
    let mut arc_length = ArcLength::default();
    if compared && n > 0 {
        let landed = land(&probes, &zeros, REACH * size, &sampler)?;
        let normals: Vec<DVec3> = (0..n).map(|i| outward(ends(i))).collect();
        let bar = MAX_DISTANCE * size;
        for (k, (p, end)) in probes.iter().zip(&landed.ends).enumerate() {
            let i = k / pieces;
            let weight = ends(i)[0].distance(ends(i)[1]) / pieces as f64;
            there.add(weight, p.distance(*end), normals[i].dot(landed.normals[k]));
        }
        there.extremes(bar, probes.iter().zip(&landed.ends).map(|(p, end)| (p.distance(*end), *p)));
        let lifted: Vec<DVec3> = polygon.iter().map(|p| p.extend(0.0)).collect();
        // triangles without area are their edges
        let edges: Vec<[u32; 3]> = (0..n as u32).map(|i| [i, (i + 1) % n as u32, (i + 1) % n as u32]).collect();
        let hits = Nearest::new(&lifted, &edges).closest_all(&zeros.points, &settings)?;
        for (i, hit) in hits.iter().enumerate() {
            let cosine = normals[hit.triangle as usize].dot(zeros.normals[i]);
            back.add(zeros.weights[i], hit.distance(), cosine);
        }
        back.extremes(bar, hits.iter().map(|hit| hit.distance()).zip(zeros.points.iter().copied()));
        worst.extend([&there, &back].iter().filter(|tallied| tallied.max > bar).map(|tallied| tallied.worst));
        arc_length = along(&curve.parameters, &probes, &landed.ends, pieces);
    }
    let closeness =
        if compared { Closeness::both(there.one_way(size), back.one_way(size)) } else { Closeness::nothing() };
    let mut crossed: Vec<usize> = crossing.iter().map(|pair| pair.0 as usize).collect();
    crossed.dedup();
    let places = Places {
        crossing: crossed.into_iter().take(PLACES).map(middle).collect(),
        backwards: backwards.iter().take(PLACES).map(|&i| middle(i)).collect(),
        far: worst,
    };
    let falling = falling(&curve.parameters);
    let mut report = CurveReport {
        dimension: 2,
        vertices: n as u64,
        edges: n as u64,
        evaluations: Evaluations::new(spent, n as u64),
        closed: n >= 3 && degenerate == 0,
        simple: crossing.is_empty() && degenerate == 0,
        euler: 0,
        turning_number: turning_number(&polygon),
        flips: Flips { surface: backwards.len() as u64, sphere: falling, uv: falling },
        self_intersections: crossing.len() as u64,
        degenerate,
        closeness,
        arc_length,
        corners: curve.corners.iter().filter(|c| **c).count() as u64,
        left_out: curve.left_out,
        seconds: Seconds::default(),
        threads: settings.pool.current_num_threads() as u64,
        method: spec.method,
        options: spec.clone(),
        version: env!("CARGO_PKG_VERSION").to_owned(),
        attempts: 1,
        verdict: Verdict::default(),
    };
    report.verdict = judge(&report, &places);
    Ok(report)
}

/// Where a curve is at fault.
struct Places {
    crossing: Vec<DVec3>,
    backwards: Vec<DVec3>,
    far: Vec<DVec3>,
}

/// Judges a curve: closed, simple, once around with the solid on its left, no edge the wrong way, nowhere farther than
/// [`MAX_DISTANCE`] of the diagonal from the zero set, both ways, and its parameter arc length to [`MAX_DEVIATION`].
fn judge(report: &CurveReport, places: &Places) -> Verdict {
    let mut verdict = Verdict { passed: true, ..Verdict::default() };
    let mut demand = |holds: bool, code: &str, detail: String, places: &[DVec3]| {
        if !holds {
            verdict.fail(code, detail, places);
        }
    };
    demand(report.closed, "not_closed", "the curve is not closed".to_owned(), &[]);
    let turns = report.turning_number;
    demand(turns == 1, "turning", format!("the curve turns around {turns} times instead of once"), &[]);
    let Flips { surface, uv, .. } = report.flips;
    demand(surface == 0, "folded", format!("{surface} edges run against the zero set"), &places.backwards);
    demand(uv == 0, "chart_turned", format!("the parameter does not rise along {uv} edges"), &[]);
    let crossing = report.self_intersections;
    demand(crossing == 0, "self_intersections", format!("{crossing} pairs of edges intersect"), &places.crossing);
    let far = too_far(report.closeness.distance.max);
    demand(far.is_none(), "distance", far.unwrap_or_default(), &places.far);
    let deviation = report.arc_length.deviation_max;
    let off =
        format!("the parameter is off arc length by {:.1} %, over {} %", 100.0 * deviation, 100.0 * MAX_DEVIATION);
    demand(deviation <= MAX_DEVIATION, "arc_length", off, &[]);
    verdict
}

/// Unit normal of an edge, away from what is on its left.
fn outward([a, b]: [DVec2; 2]) -> DVec3 {
    (-(b - a).perp()).normalize_or_zero().extend(0.0)
}

/// Edges whose outward normal opposes the field's gradient at their middle.
fn backwards(polygon: &[DVec2], sampler: &Sampler<'_>) -> Result<Vec<usize>, Canceled> {
    let n = polygon.len();
    let ends = |i: usize| [polygon[i], polygon[(i + 1) % n]];
    let middles: Vec<DVec3> = (0..n).map(|i| (0.5 * (ends(i)[0] + ends(i)[1])).extend(0.0)).collect();
    let (_, gradients) = sampler.gradients(&middles)?;
    Ok((0..n).filter(|&i| outward(ends(i)).dot(gradients[i]) < 0.0).collect())
}

/// Edges along which the parameter does not rise; the last one rises to 1.
fn falling(parameters: &[f64]) -> u64 {
    let ends = parameters.iter().copied().skip(1).chain([1.0]);
    parameters.iter().zip(ends).filter(|(a, b)| *a >= b).count() as u64
}

/// The zeros that the curve has to follow: all of them, unless some were to be left out; then those of the loops that are the nearest
/// to some of its vertices.
fn followed(zeros: Zeros, polygon: &[DVec2], left_out: LeftOut, sampler: &Sampler<'_>) -> Result<Zeros, Canceled> {
    if left_out.components + left_out.holes == 0 || zeros.points.is_empty() {
        return Ok(zeros);
    }
    let lifted: Vec<DVec3> = polygon.iter().map(|p| p.extend(0.0)).collect();
    let hits = Nearest::of_points(&zeros.points).closest_all(&lifted, sampler.settings())?;
    let touched: BTreeSet<usize> = hits.iter().filter_map(|hit| zeros.loops[hit.triangle as usize]).collect();
    let kept = |&i: &usize| zeros.loops[i].is_some_and(|l| touched.contains(&l));
    let kept: Vec<usize> = (0..zeros.points.len()).filter(kept).collect();
    Ok(Zeros {
        points: kept.iter().map(|&i| zeros.points[i]).collect(),
        normals: kept.iter().map(|&i| zeros.normals[i]).collect(),
        weights: kept.iter().map(|&i| zeros.weights[i]).collect(),
        loops: kept.iter().map(|&i| zeros.loops[i]).collect(),
    })
}

/// From every start to the zero set: straight where the field is an exact distance, otherwise along the gradient until the sign
/// changes; or to the nearest of the zeros where that is nearer, or where no zero was met.
fn land(starts: &[DVec3], zeros: &Zeros, reach: f64, sampler: &Sampler<'_>) -> Result<Landed, Canceled> {
    if sampler.field().metric() == Metric::Exact {
        let (values, gradients) = sampler.gradients(starts)?;
        let ends = starts.iter().zip(&values).zip(&gradients).map(|((p, s), g)| *p - *s * g.normalize_or_zero());
        return Ok(Landed { ends: ends.collect(), normals: gradients.iter().map(|g| g.normalize_or_zero()).collect() });
    }
    let traced = trace(starts, reach, sampler)?;
    let tree = Nearest::of_points(&zeros.points);
    let ends = map_chunks(starts, sampler.settings(), |i, &start| {
        let within = traced[i].map_or(f64::INFINITY, |end| end.distance(start));
        let nearer = tree.closest_within(start, within).map(|hit| hit.point);
        nearer.or(traced[i]).unwrap_or(start)
    })?;
    let (_, gradients) = sampler.gradients(&ends)?;
    Ok(Landed { ends, normals: gradients.iter().map(|g| g.normalize_or_zero()).collect() })
}

/// The parameter against the length of the polygon through the places on the zero set beside `pieces` probes of every edge.
fn along(parameters: &[f64], probes: &[DVec3], ends: &[DVec3], pieces: usize) -> ArcLength {
    let (n, m) = (parameters.len(), probes.len());
    // what lands farther from its edge than the edge is long belongs to something else
    let edge = |i: usize| probes[i * pieces].distance(probes[(i + 1) % n * pieces]);
    let place =
        |k: usize| if ends[k % m].distance(probes[k % m]) < edge(k % m / pieces) { ends[k % m] } else { probes[k % m] };
    let lengths: Vec<f64> =
        (0..n).map(|i| (i * pieces..(i + 1) * pieces).map(|k| place(k).distance(place(k + 1))).sum()).collect();
    let total: f64 = lengths.iter().sum();
    let mean = total / n as f64;
    let mut found = ArcLength { length: total, step_min: f64::INFINITY, ..ArcLength::default() };
    let mut squares = 0.0;
    for (i, &length) in lengths.iter().enumerate() {
        let rise = parameters.get(i + 1).copied().unwrap_or(1.0) - parameters[i];
        let deviation = rise * total / length.max(f64::MIN_POSITIVE) - 1.0;
        squares += length * deviation * deviation;
        found.deviation_max = found.deviation_max.max(deviation.abs());
        (found.step_min, found.step_max) = (found.step_min.min(length / mean), found.step_max.max(length / mean));
    }
    found.deviation_rms = (squares / total.max(f64::MIN_POSITIVE)).sqrt();
    found
}
