//! Circle to curve: the two-dimensional form of shrinking, for fields of dimension 2.
//!
//! `method: adaptive` contours the field on a triangulation that is refined towards the zero set, where the topology is plain to
//! see, puts crossings and corners exactly, and samples the loop by arc length: the curve is closed, and simple unless
//! the samples are too few for a gap. `method: paper` is the paper's loop, the baseline: it promises nothing. What a
//! curve is worth is measured in [`crate::measure::curve`]. Work is done in a frame in which the longer side of the domain is
//! 2; results are in scene units, rounded to single precision as they are written.

mod bisection;
mod contour;
mod corners;
mod paper;
mod polyline;
mod spread;
#[cfg(test)]
mod tests;

use super::{Component, Effort, Method, OnTopology, ShrinkError, ShrinkSpec};
use crate::field::{Frame, Sampler};
use crate::settings::Progress;
use contour::Loop;
use glam::{DVec2, DVec3};
use polyline::{contains, double_area, perimeter};

/// Fewest samples of a curve.
pub const MIN_SAMPLES: u32 = 8;
/// Most samples of a curve.
pub const MAX_SAMPLES: u32 = 100_000;

/// What to make of a two-dimensional field.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct CurveSpec {
    /// How the circle is contracted.
    pub method: Method,
    /// Samples of the curve; taken to the nearest number from [`MIN_SAMPLES`] to [`MAX_SAMPLES`].
    pub samples: u32,
    /// What to do with a solid that has holes.
    pub on_topology: OnTopology,
    /// Which component to take where there are several; without it several are refused.
    pub component: Option<Component>,
}

impl Default for CurveSpec {
    fn default() -> Self {
        Self { method: Method::Adaptive, samples: 400, on_topology: OnTopology::Refuse, component: None }
    }
}

impl From<&ShrinkSpec> for CurveSpec {
    /// As many samples as are asked for; otherwise as a row of the lattice has.
    fn from(spec: &ShrinkSpec) -> Self {
        let samples = spec.curve_samples();
        Self { method: spec.method, samples, on_topology: spec.on_topology, component: spec.component }
    }
}

/// A closed curve with a parameter: the polygon through `positions`, the last one joined to the first.
#[derive(Clone, Debug, PartialEq)]
pub struct Curve {
    /// Sample positions in scene units, counter-clockwise (the solid on the left), single-precision numbers.
    pub positions: Vec<[f64; 2]>,
    /// Unit outward normals: the field's gradient, at a corner the mean of both sides'.
    pub normals: Vec<[f64; 2]>,
    /// Arc length from the first sample in parts of the whole, in [0, 1), rising.
    pub parameters: Vec<f64>,
    /// Whether the sample is a corner of the zero set.
    pub corners: Vec<bool>,
    /// The field's value at every sample, scene units.
    pub values: Vec<f64>,
    /// Length of the field's gradient at every sample.
    pub gradient_norms: Vec<f64>,
    /// What was left out on request.
    pub left_out: LeftOut,
}

/// Parts of the zero set that a curve does not follow, because it was asked to.
#[derive(Clone, Copy, Debug, Default, PartialEq, serde::Serialize, serde::Deserialize, utoipa::ToSchema)]
pub struct LeftOut {
    /// Components other than the one that was chosen.
    pub components: u64,
    /// Holes of the chosen component that the curve goes around.
    pub holes: u64,
    /// Area of these holes, squared scene units.
    pub hole_area: f64,
}

/// How closely a contour is looked at, in the frame.
#[derive(Clone, Copy, Debug)]
struct Detail {
    /// Triangles near the zero set are no larger anywhere, ...
    coarsest: f64,
    /// ... and no smaller than about half of this where that does not explain the values.
    finest: f64,
}

impl Detail {
    /// Of an attempt, from 0. Where nothing bounds the field, thin things between the vertices go unnoticed more easily.
    fn of(attempt: u32, bounded: bool) -> Self {
        let halvings = 2f64.powi(-(attempt.min(2) as i32));
        let coarsest = if bounded { 0.012 } else { 0.006 } * halvings;
        Self { coarsest, finest: 4e-4 * halvings.powi(2) }
    }
}

/// Positions, normals and parameters of a curve in the frame.
#[derive(Default)]
struct Samples {
    positions: Vec<DVec2>,
    normals: Vec<DVec2>,
    parameters: Vec<f64>,
    corners: Vec<bool>,
    /// Longest step towards the zero set.
    reaches: Vec<f64>,
    values: Vec<f64>,
    slopes: Vec<f64>,
}

impl Samples {
    fn with_capacity(count: usize) -> Self {
        Self {
            positions: Vec::with_capacity(count),
            normals: Vec::with_capacity(count),
            parameters: Vec::with_capacity(count),
            corners: Vec::with_capacity(count),
            reaches: Vec::with_capacity(count),
            ..Self::default()
        }
    }
}

/// Contracts a circle onto the zero set of the sampler's two-dimensional field. Later attempts look more closely, and place the
/// samples where the curve bends.
///
/// # Errors
/// [`ShrinkError::Dimension`] for a field of dimension 3, [`ShrinkError::Canceled`] when the run was canceled, and for
/// `method: adaptive` [`ShrinkError::Empty`], [`ShrinkError::Components`] and [`ShrinkError::Holes`] when the
/// zero set is not one loop. `method: paper` returns what comes out, as long as there is a zero set.
pub fn shrink_curve(sampler: &Sampler<'_>, spec: &CurveSpec, effort: &Effort) -> Result<Curve, ShrinkError> {
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
    report("contract", 0.0);
    let (samples, left_out) = match spec.method {
        Method::Adaptive => {
            sampler.tally().stage("contract");
            let detail = Detail::of(effort.attempt, sampler.field().lipschitz().is_some());
            let loops = contour::contour(&framed, detail)?;
            let (mut the_loop, left_out) = chosen(loops, spec, frame)?;
            sampler.tally().stage("resample");
            report("resample", 0.7);
            spread::resolve_bends(&framed, &mut the_loop)?;
            (spread::spread(&framed, &the_loop, count, f64::from(effort.attempt))?, left_out)
        }
        Method::Paper => {
            sampler.tally().stage("paper");
            (paper::shrink(&framed, count)?, LeftOut::default())
        }
    };
    let single = |v: DVec2| v.as_vec2().as_dvec2().to_array();
    Ok(Curve {
        positions: samples.positions.iter().map(|q| single(frame.to_scene(q.extend(0.0)).truncate())).collect(),
        normals: samples.normals.iter().map(|n| n.to_array()).collect(),
        parameters: samples.parameters,
        corners: samples.corners,
        values: samples.values.iter().map(|s| s * frame.scale).collect(),
        gradient_norms: samples.slopes,
        left_out,
    })
}

/// A component of the solid: its outer boundary and its holes, as indices.
struct Part {
    outer: usize,
    holes: Vec<usize>,
    area: f64,
}

/// The components, largest area first.
fn parts(loops: &[Loop]) -> Vec<Part> {
    let areas: Vec<f64> = loops.iter().map(|l| 0.5 * double_area(&l.points)).collect();
    let outers = (0..loops.len()).filter(|&i| areas[i] > 0.0);
    let mut parts: Vec<Part> = outers.map(|i| Part { outer: i, holes: Vec::new(), area: areas[i] }).collect();
    for hole in (0..loops.len()).filter(|&i| areas[i] <= 0.0) {
        let Some(&place) = loops[hole].points.first() else { continue };
        // the smallest boundary around it
        let around = parts.iter_mut().filter(|p| contains(&loops[p.outer].points, place));
        if let Some(part) = around.min_by(|a, b| areas[a.outer].total_cmp(&areas[b.outer])) {
            part.holes.push(hole);
        }
    }
    for part in &mut parts {
        part.area += part.holes.iter().map(|&h| areas[h]).sum::<f64>();
    }
    parts.sort_by(|a, b| b.area.total_cmp(&a.area).then(a.outer.cmp(&b.outer)));
    parts
}

/// The loop to follow, and what is left out with it.
fn chosen(mut loops: Vec<Loop>, spec: &CurveSpec, frame: Frame) -> Result<(Loop, LeftOut), ShrinkError> {
    let parts = parts(&loops);
    let places = |which: &mut dyn Iterator<Item = usize>, side: f64| -> Vec<[f64; 3]> {
        which.take(16).map(|i| frame.to_scene(beside(&loops[i], side).extend(0.0)).to_array()).collect()
    };
    let part = match (spec.component, &parts[..]) {
        (None, [only]) => Some(only),
        (None, _) => None,
        (Some(Component::Largest), all) => all.first(),
        (Some(Component::Index(i)), all) => all.get(i as usize),
    };
    let Some(part) = part else {
        let (count, places) = (parts.len(), places(&mut parts.iter().map(|p| p.outer), -1.0));
        return Err(match spec.component {
            Some(Component::Index(index)) => ShrinkError::NoComponent { index, count, places },
            _ => ShrinkError::Components { solids: count, voids: 0, places },
        });
    };
    if !part.holes.is_empty() && spec.on_topology == OnTopology::Refuse {
        let holes = &mut part.holes.iter().copied();
        return Err(ShrinkError::Holes { count: part.holes.len(), places: places(holes, 1.0) });
    }
    let area = |&h: &usize| -0.5 * double_area(&loops[h].points) * frame.scale * frame.scale;
    let left_out = LeftOut {
        components: parts.len() as u64 - 1,
        holes: part.holes.len() as u64,
        hole_area: part.holes.iter().map(area).fold(0.0, |sum, hole| sum + hole),
    };
    Ok((loops.swap_remove(part.outer), left_out))
}

/// A point beside the loop's rightmost point, on the side of the gradient (1) or of the solid (-1).
fn beside(l: &Loop, side: f64) -> DVec2 {
    let rightmost = (0..l.points.len()).max_by(|&a, &b| l.points[a].x.total_cmp(&l.points[b].x)).unwrap_or(0);
    let normal = (l.normals[rightmost][0] + l.normals[rightmost][1]).normalize_or(DVec2::X);
    // no farther than the loop itself is wide
    let width = double_area(&l.points).abs() / perimeter(&l.points);
    l.points[rightmost] + side * (0.25 * l.sizes[rightmost]).min(0.5 * width) * normal
}
