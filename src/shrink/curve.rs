//! Circle to curve: the two-dimensional form of shrinking, for fields of dimension 2.
//!
//! `method: adaptive` contours the field on a lattice that is refined towards the zero set, where the topology is plain to
//! see, puts the crossings and the corners exactly, and samples the loop by arc length: the curve is closed, and simple unless
//! the samples are too few for a gap (the report says). `method: paper` is the paper's loop, the baseline: it promises
//! nothing. Both are judged against the same contour of the field. Work is done in a frame in which the longer side of
//! the domain is 2; results are in scene units.

mod contour;
mod paper;
mod polyline;
#[cfg(test)]
mod tests;

use super::{Method, ShrinkError};
use crate::field::{Counts, Frame, Sampler};
use crate::settings::Progress;
use contour::{Contour, Loop};
use glam::{DVec2, DVec3};
use polyline::{Segments, perimeter, self_intersections, turning};

/// Fewest samples of a curve.
pub const MIN_SAMPLES: u32 = 8;
/// Most samples of a curve.
pub const MAX_SAMPLES: u32 = 10_000;

/// What to make of a two-dimensional field.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields, default)]
pub struct CurveSpec {
    /// How the circle is contracted.
    pub method: Method,
    /// Samples of the curve; taken to the nearest number from [`MIN_SAMPLES`] to [`MAX_SAMPLES`].
    pub samples: u32,
}

impl Default for CurveSpec {
    fn default() -> Self {
        Self { method: Method::Adaptive, samples: 400 }
    }
}

/// A closed curve with a parameter: the polygon through `positions`, the last one joined to the first.
#[derive(Clone, Debug, PartialEq)]
pub struct Curve {
    /// Sample positions in scene units, counter-clockwise (the solid on the left).
    pub positions: Vec<[f64; 2]>,
    /// Unit outward normals: the field's gradient, at a corner the mean of both sides'.
    pub normals: Vec<[f64; 2]>,
    /// Arc length from the first sample in parts of the whole, in [0, 1), rising.
    pub parameters: Vec<f64>,
    /// Whether the sample is a corner of the zero set.
    pub corners: Vec<bool>,
    /// What was measured.
    pub report: CurveReport,
}

/// Everything measured about a curve.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, serde::Deserialize, utoipa::ToSchema)]
pub struct CurveReport {
    /// Samples.
    pub samples: u64,
    /// Whether the polygon goes once around counter-clockwise without a sample on top of the one before it.
    pub closed: bool,
    /// Whether no two edges of the polygon meet that are not neighbours.
    pub simple: bool,
    /// Pairs of edges that meet and are not neighbours.
    pub self_intersections: u64,
    /// Corners of the zero set that are samples.
    pub corners: u64,
    /// Length of the polygon, scene units.
    pub length: f64,
    /// From the polygon (vertices and edge midpoints) to the zero set, in parts of its bounding-box diagonal.
    pub to_zero_set: CurveDistance,
    /// From the zero set to the polygon, in the same parts.
    pub from_zero_set: CurveDistance,
    /// Field evaluations spent to make the curve (measuring not counted).
    pub evaluations: Counts,
}

/// Mean and largest distance.
#[derive(Clone, Copy, Debug, Default, PartialEq, serde::Serialize, serde::Deserialize, utoipa::ToSchema)]
pub struct CurveDistance {
    /// Mean over samples.
    pub mean: f64,
    /// Largest.
    pub max: f64,
}

/// Positions, normals and parameters of a curve in the frame.
struct Samples {
    positions: Vec<DVec2>,
    normals: Vec<DVec2>,
    parameters: Vec<f64>,
    corners: Vec<bool>,
}

/// Contracts a circle onto the zero set of the sampler's two-dimensional field.
///
/// # Errors
/// [`ShrinkError::Dimension`] for a field of dimension 3, [`ShrinkError::Canceled`] when the run was canceled, and for
/// `method: adaptive` [`ShrinkError::Empty`], [`ShrinkError::Components`] and [`ShrinkError::Genus`] (the number of holes) when the
/// zero set is not one loop. `method: paper` returns what comes out, as long as there is a zero set.
pub fn shrink_curve(sampler: &Sampler<'_>, spec: &CurveSpec) -> Result<Curve, ShrinkError> {
    let found = sampler.field().dimension();
    if found != 2 {
        return Err(ShrinkError::Dimension { found, wanted: 2 });
    }
    let domain = sampler.domain();
    let (lo, hi) = (DVec3::from(domain.min), DVec3::from(domain.max));
    let sides = (hi - lo).truncate();
    let frame = Frame { center: 0.5 * (lo + hi), scale: 0.5 * sides.max_element() };
    let framed = sampler.framed(frame);
    let count = spec.samples.clamp(MIN_SAMPLES, MAX_SAMPLES) as usize;
    let report = |stage, fraction| {
        (sampler.settings().progress)(Progress { stage, fraction, ..Progress::default() });
    };

    let before = sampler.tally().total();
    report("contract", 0.0);
    let (samples, contour) = match spec.method {
        Method::Adaptive => {
            sampler.tally().stage("contract");
            let contour = Contour::new(&framed)?;
            let the_loop = contour.only_loop(frame)?;
            sampler.tally().stage("resample");
            report("resample", 0.7);
            (adaptive(&framed, the_loop, count, contour.spacing)?, Some(contour))
        }
        Method::Paper => {
            sampler.tally().stage("paper");
            (paper::shrink(&framed, count)?, None)
        }
    };
    let after = sampler.tally().total();
    sampler.tally().stage("measure");
    report("measure", 0.9);
    let contour = match contour {
        Some(contour) => contour,
        None => Contour::new(&framed)?,
    };
    let evaluations = Counts { value: after.value - before.value, gradient: after.gradient - before.gradient };
    let report = measure(&samples, &contour, frame.scale, evaluations);
    Ok(Curve {
        positions: samples.positions.iter().map(|q| frame.to_scene(q.extend(0.0)).truncate().to_array()).collect(),
        normals: samples.normals.iter().map(|n| n.to_array()).collect(),
        parameters: samples.parameters,
        corners: samples.corners,
        report,
    })
}

/// Samples `the_loop` by arc length with its corners among the samples: between two corners the samples are evenly
/// spaced, as many as the length there asks for.
fn adaptive(sampler: &Sampler<'_>, the_loop: &Loop, count: usize, reach: f64) -> Result<Samples, ShrinkError> {
    let n = the_loop.points.len();
    let mut anchors: Vec<usize> = (0..n).filter(|&i| the_loop.corners[i]).collect();
    // half of the samples stay free to be even
    let most = count / 2;
    if anchors.len() > most {
        // the sharpest stay
        let sharpness = |i: &usize| {
            let p = |k: usize| the_loop.points[k % n];
            let (a, b) = (p(i + n) - p(i + n - 1), p(i + 1) - p(i + n));
            a.normalize_or_zero().dot(b.normalize_or_zero())
        };
        anchors.sort_by(|a, b| sharpness(a).total_cmp(&sharpness(b)).then(a.cmp(b)));
        anchors.truncate(most);
        anchors.sort_unstable();
    }
    let rightmost = |a: &usize, b: &usize| the_loop.points[*a].x.total_cmp(&the_loop.points[*b].x).then(b.cmp(a));
    if anchors.is_empty() {
        anchors.extend((0..n).max_by(rightmost));
    }
    // the parameter starts at the rightmost anchor
    if let Some(first) = (0..anchors.len()).max_by(|&a, &b| rightmost(&anchors[a], &anchors[b])) {
        anchors.rotate_left(first);
    }
    let start = anchors[0];
    let order: Vec<usize> = (0..=n).map(|k| (start + k) % n).collect();
    let mut arc = vec![0.0; n + 1];
    for k in 0..n {
        arc[k + 1] = arc[k] + the_loop.points[order[k]].distance(the_loop.points[order[k + 1]]);
    }
    let total = arc[n];
    let mut stops: Vec<usize> = anchors.iter().map(|&a| (a + n - start) % n).collect();
    stops.push(n);
    let shares: Vec<f64> = stops.windows(2).map(|w| arc[w[1]] - arc[w[0]]).collect();
    let counts = apportion(&shares, count);

    let mut out = Samples { positions: vec![], normals: vec![], parameters: vec![], corners: vec![] };
    for (w, &pieces) in stops.windows(2).zip(&counts) {
        let mut k = w[0];
        for piece in 0..pieces {
            let s = arc[w[0]] + (arc[w[1]] - arc[w[0]]) * piece as f64 / pieces as f64;
            while k + 1 < w[1] && arc[k + 1] <= s {
                k += 1;
            }
            let t = ((s - arc[k]) / (arc[k + 1] - arc[k])).clamp(0.0, 1.0);
            let (a, b) = (order[k], order[k + 1]);
            out.positions.push(the_loop.points[a].lerp(the_loop.points[b], t));
            out.normals.push(the_loop.normals[a].lerp(the_loop.normals[b], t).normalize_or(DVec2::X));
            out.parameters.push(s / total);
            out.corners.push(piece == 0 && the_loop.corners[a]);
        }
    }
    settle(sampler, &mut out, reach)?;
    Ok(out)
}

/// Splits `count` into whole parts proportional to `shares`, each at least 1 (largest remainders; `count` >= the number of shares).
fn apportion(shares: &[f64], count: usize) -> Vec<usize> {
    let total: f64 = shares.iter().sum();
    let spare = (count - shares.len()) as f64;
    let wanted: Vec<f64> = shares.iter().map(|s| spare * s / total.max(f64::MIN_POSITIVE)).collect();
    let mut parts: Vec<usize> = wanted.iter().map(|w| 1 + *w as usize).collect();
    let mut order: Vec<usize> = (0..shares.len()).collect();
    order.sort_by(|&a, &b| wanted[b].fract().total_cmp(&wanted[a].fract()).then(a.cmp(&b)));
    let left = count.saturating_sub(parts.iter().sum());
    for &i in order.iter().cycle().take(left) {
        parts[i] += 1;
    }
    parts
}

/// Moves samples between corners onto the zero set by Newton steps no longer than `reach`, each kept only where the value
/// falls, and takes the normals there.
fn settle(sampler: &Sampler<'_>, samples: &mut Samples, reach: f64) -> Result<(), ShrinkError> {
    /// One step leaves the chord's error squared, the second is for fields that are no distances.
    const STEPS: usize = 2;
    let free: Vec<usize> = (0..samples.positions.len()).filter(|&i| !samples.corners[i]).collect();
    let mut q: Vec<DVec3> = free.iter().map(|&i| samples.positions[i].extend(0.0)).collect();
    let (mut s, mut g) = sampler.gradients(&q)?;
    for _ in 0..STEPS {
        let moved: Vec<DVec3> = (0..q.len())
            .map(|i| {
                let step = -s[i] * g[i] / g[i].length_squared().max(f64::MIN_POSITIVE);
                q[i] + step.clamp_length_max(reach)
            })
            .collect();
        let (after, slopes) = sampler.gradients(&moved)?;
        for i in 0..q.len() {
            if after[i].abs() < s[i].abs() {
                (q[i], s[i], g[i]) = (moved[i], after[i], slopes[i]);
            }
        }
    }
    for (&i, (q, g)) in free.iter().zip(q.iter().zip(&g)) {
        samples.positions[i] = q.truncate();
        samples.normals[i] = g.truncate().normalize_or(samples.normals[i]);
    }
    Ok(())
}

fn measure(samples: &Samples, contour: &Contour, scale: f64, evaluations: Counts) -> CurveReport {
    let polygon = &samples.positions;
    let n = polygon.len();
    let mut probes = polygon.clone();
    probes.extend((0..n).map(|i| 0.5 * (polygon[i] + polygon[(i + 1) % n])));
    let truth: Vec<&[DVec2]> = contour.loops.iter().map(|l| l.points.as_slice()).collect();
    let all = truth.iter().flat_map(|l| l.iter());
    let lo = all.clone().fold(DVec2::INFINITY, |a, &p| a.min(p));
    let hi = all.clone().fold(DVec2::NEG_INFINITY, |a, &p| a.max(p));
    let distance = |from: &mut dyn Iterator<Item = DVec2>, to: &Segments| {
        let (mut sum, mut max, mut count) = (0.0, 0f64, 0);
        for p in from {
            let d = to.distance(p) / (hi - lo).length();
            (sum, max, count) = (sum + d, max.max(d), count + 1);
        }
        CurveDistance { mean: sum / f64::from(count.max(1)), max }
    };
    let crossings = self_intersections(polygon);
    let apart = (0..n).all(|i| polygon[i] != polygon[(i + 1) % n]);
    CurveReport {
        samples: n as u64,
        closed: apart && (turning(polygon) - 1.0).abs() < 1e-6,
        simple: crossings == 0 && apart,
        self_intersections: crossings,
        corners: samples.corners.iter().filter(|c| **c).count() as u64,
        length: scale * perimeter(polygon),
        to_zero_set: distance(&mut probes.into_iter(), &Segments::new(&truth)),
        from_zero_set: distance(&mut all.copied(), &Segments::new(&[polygon])),
        evaluations,
    }
}
