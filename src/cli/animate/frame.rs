//! What an animation's report says of one frame, and of all.

use crate::extract::path::Stop;
use crate::field::network::family::Detected;
use crate::measure::moved::Lengths;
use crate::measure::report::Flips;
use crate::measure::verdict::Finding;
use crate::shrink::ShrinkSpec;
use serde::Serialize;

/// A frame in the report.
#[derive(Clone, Debug, Serialize)]
pub struct Frame {
    /// Its number, from 0.
    pub frame: usize,
    /// Its latent code.
    pub latent: Vec<f32>,
    /// Whether its surface was made from that of the frame before.
    pub warm: bool,
    /// Fields between the frame before and this one that were wrapped on the way.
    pub between: u32,
    /// Surfaces that were made for it, those that did not pass included.
    pub attempts: u32,
    /// Field evaluations of all of them, values and gradients together.
    pub evaluations: u64,
    /// The same per vertex.
    pub evaluations_per_vertex: f64,
    /// Mean and largest distance to the zero level set, both ways, in parts of the diagonal.
    pub distance: MeanMax,
    /// Mean of |n . n'|, both ways.
    pub normal_consistency: f64,
    /// Folded triangles.
    pub flips: Flips,
    /// Pairs of triangles that cross.
    pub self_intersections: u64,
    /// How far vertices are from where they were in the frame before, in parts of the diagonal.
    pub moved: Lengths,
    /// How far they are from the place straight ahead.
    pub drift: Lengths,
    /// Whether it passed every check.
    pub passed: bool,
    /// Those that it did not pass.
    pub faults: Vec<Finding>,
}

/// A mean and a maximum.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct MeanMax {
    /// Mean.
    pub mean: f64,
    /// Largest.
    pub max: f64,
}

impl Frame {
    /// What is reported of a stop.
    pub fn new(frame: usize, latent: &[f32], stop: &Stop) -> Self {
        let report = &stop.report;
        let distance = &report.closeness.distance;
        let moved = report.warm_start.as_ref().map(|warm_start| warm_start.moved).unwrap_or_default();
        Self {
            frame,
            latent: latent.to_vec(),
            warm: report.warm_start.as_ref().is_some_and(|warm_start| warm_start.used),
            between: stop.between,
            attempts: report.attempts,
            evaluations: report.evaluations.value + report.evaluations.gradient,
            evaluations_per_vertex: report.evaluations.per_vertex,
            distance: MeanMax { mean: distance.mean, max: distance.max },
            normal_consistency: report.closeness.normal_consistency,
            flips: report.flips,
            self_intersections: report.self_intersections,
            moved: moved.moved,
            drift: moved.drift,
            passed: report.verdict.passed,
            faults: report.verdict.faults.clone(),
        }
    }
}

/// The report of an animation.
#[derive(Clone, Debug, Serialize)]
pub struct Report {
    /// Every frame, in order.
    pub frames: Vec<Frame>,
    /// All frames after the first together; means are over frames.
    pub later: Later,
    /// Whether every frame passed every check.
    pub passed: bool,
    /// Vertices of every frame.
    pub vertices: u64,
    /// Every option that the frames were made with.
    pub options: ShrinkSpec,
    /// What the network's file was taken for.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub network: Option<Detected>,
    /// Version of shrinkd.
    pub version: String,
}

/// What the frames after the first cost, and how good they are.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct Later {
    /// Frames that were made from the one before.
    pub warm: usize,
    /// Evaluations per vertex.
    pub evaluations_per_vertex: f64,
    /// Mean and largest distance to the zero level set, in parts of the diagonal.
    pub distance: MeanMax,
    /// Mean of |n . n'|.
    pub normal_consistency: f64,
    /// Mean and largest way from the frame before, in parts of the diagonal.
    pub moved: MeanMax,
    /// Mean and largest drift, in parts of the diagonal.
    pub drift: MeanMax,
}

impl Later {
    /// Of all frames but the first.
    pub fn of(frames: &[Frame]) -> Self {
        let later = frames.get(1..).unwrap_or_default();
        let mean = |of: &dyn Fn(&Frame) -> f64| later.iter().map(of).sum::<f64>() / later.len().max(1) as f64;
        let max = |of: &dyn Fn(&Frame) -> f64| later.iter().map(of).fold(0.0, f64::max);
        Self {
            warm: later.iter().filter(|frame| frame.warm).count(),
            evaluations_per_vertex: mean(&|frame| frame.evaluations_per_vertex),
            distance: MeanMax { mean: mean(&|frame| frame.distance.mean), max: max(&|frame| frame.distance.max) },
            normal_consistency: mean(&|frame| frame.normal_consistency),
            moved: MeanMax { mean: mean(&|frame| frame.moved.mean), max: max(&|frame| frame.moved.max) },
            drift: MeanMax { mean: mean(&|frame| frame.drift.mean), max: max(&|frame| frame.drift.max) },
        }
    }
}
