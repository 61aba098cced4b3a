//! The algorithm's view of a field: batches on the pool, counted by stage, closed at the domain box, in a chosen frame.

use super::{Domain, Field, Gradients, Points};
use crate::settings::{Canceled, Settings};
use glam::DVec3;
use rayon::prelude::*;
use std::collections::BTreeMap;
use std::sync::Mutex;

/// Points per batch: large enough for the kernels, small enough that cancel is seen soon. Fixed, so that the results do
/// not depend on the number of threads.
const BATCH: usize = 512;

/// A similarity from the frame an algorithm works in to scene units: `scene = center + scale * q`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Frame {
    /// Scene position of the frame's origin.
    pub center: DVec3,
    /// Scene units per frame unit; positive.
    pub scale: f64,
}

impl Frame {
    /// The frame that is the scene itself.
    pub const SCENE: Frame = Frame { center: DVec3::ZERO, scale: 1.0 };
    /// From the frame to the scene.
    pub fn to_scene(self, q: DVec3) -> DVec3 {
        self.center + self.scale * q
    }
    /// From the scene to the frame.
    pub fn from_scene(self, p: DVec3) -> DVec3 {
        (p - self.center) / self.scale
    }
}

/// Evaluations of a field: how many values alone, how many values with gradients.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize, utoipa::ToSchema)]
pub struct Counts {
    /// Points evaluated for the value alone.
    pub value: u64,
    /// Points evaluated for value and gradient.
    pub gradient: u64,
}

impl Counts {
    /// Both kinds together.
    pub fn total(self) -> u64 {
        self.value + self.gradient
    }
}

/// Evaluates a field for an algorithm. Every evaluation of a run goes through one sampler (or its [`Sampler::framed`]
/// views), so its counts are the run's cost.
pub struct Sampler<'a> {
    field: &'a dyn Field,
    settings: Settings<'a>,
    frame: Frame,
    domain: Domain,
    counts: &'a Tally,
}

/// Counts by stage, shared by all samplers of a run.
#[derive(Debug, Default)]
pub struct Tally(Mutex<(&'static str, BTreeMap<&'static str, Counts>)>);

impl Tally {
    /// An empty tally.
    pub fn new() -> Self {
        Self::default()
    }
    /// Names the stage that evaluations are counted under from now on.
    pub fn stage(&self, name: &'static str) {
        self.0.lock().unwrap_or_else(|e| e.into_inner()).0 = name;
    }
    fn add(&self, value: usize, gradient: usize) {
        let mut guard = self.0.lock().unwrap_or_else(|e| e.into_inner());
        let stage = guard.0;
        let entry = guard.1.entry(stage).or_default();
        entry.value += value as u64;
        entry.gradient += gradient as u64;
    }
    /// Counts of every stage so far.
    pub fn by_stage(&self) -> BTreeMap<&'static str, Counts> {
        self.0.lock().unwrap_or_else(|e| e.into_inner()).1.clone()
    }
    /// Counts of all stages together.
    pub fn total(&self) -> Counts {
        self.by_stage()
            .values()
            .fold(Counts::default(), |a, c| Counts { value: a.value + c.value, gradient: a.gradient + c.gradient })
    }
}

impl<'a> Sampler<'a> {
    /// A sampler of `field` in scene units, counting into `tally`.
    pub fn new(field: &'a dyn Field, settings: Settings<'a>, tally: &'a Tally) -> Self {
        Self { field, settings, frame: Frame::SCENE, domain: field.domain(), counts: tally }
    }
    /// The same field and counts in another frame: positions in frame units, values divided by the frame's scale.
    pub fn framed(&self, frame: Frame) -> Sampler<'a> {
        Sampler { frame, ..*self }
    }
    /// The frame that positions and values are in.
    pub fn frame(&self) -> Frame {
        self.frame
    }
    /// The field's domain box, in scene units.
    pub fn domain(&self) -> Domain {
        self.domain
    }
    /// The field behind.
    pub fn field(&self) -> &'a dyn Field {
        self.field
    }
    /// What the computation runs with.
    pub fn settings(&self) -> &Settings<'a> {
        &self.settings
    }
    /// The counts it adds to.
    pub fn tally(&self) -> &'a Tally {
        self.counts
    }

    /// Values at `points`, in frame units.
    pub fn values(&self, points: &[DVec3]) -> Result<Vec<f64>, Canceled> {
        let mut values = vec![0.0; points.len()];
        self.run(points, &mut values, None)?;
        self.counts.add(points.len(), 0);
        Ok(values)
    }

    /// Values and gradients at `points`, in frame units (gradients have no unit).
    pub fn gradients(&self, points: &[DVec3]) -> Result<(Vec<f64>, Vec<DVec3>), Canceled> {
        let (mut values, mut gradients) = (vec![0.0; points.len()], vec![DVec3::ZERO; points.len()]);
        self.run(points, &mut values, Some(&mut gradients))?;
        self.counts.add(0, points.len());
        Ok((values, gradients))
    }

    fn run(&self, points: &[DVec3], values: &mut [f64], gradients: Option<&mut [DVec3]>) -> Result<(), Canceled> {
        let cancel = self.settings.cancel;
        let work = |p: &[DVec3], v: &mut [f64], g: Option<&mut [DVec3]>| -> Result<(), Canceled> {
            cancel.check()?;
            self.batch(p, v, g);
            Ok(())
        };
        if points.len() <= BATCH {
            return work(points, values, gradients);
        }
        self.settings.pool.install(|| match gradients {
            None => points.par_chunks(BATCH).zip(values.par_chunks_mut(BATCH)).try_for_each(|(p, v)| work(p, v, None)),
            Some(g) => points
                .par_chunks(BATCH)
                .zip(values.par_chunks_mut(BATCH))
                .zip(g.par_chunks_mut(BATCH))
                .try_for_each(|((p, v), g)| work(p, v, Some(g))),
        })
    }

    fn batch(&self, points: &[DVec3], values: &mut [f64], gradients: Option<&mut [DVec3]>) {
        let n = points.len();
        let mut buffer = [0.0f32; 7 * BATCH];
        let (x, rest) = buffer.split_at_mut(BATCH);
        let (y, rest) = rest.split_at_mut(BATCH);
        let (z, rest) = rest.split_at_mut(BATCH);
        let (s, rest) = rest.split_at_mut(BATCH);
        let (gx, rest) = rest.split_at_mut(BATCH);
        let (gy, gz) = rest.split_at_mut(BATCH);
        let (lo, hi) = (DVec3::from(self.domain.min), DVec3::from(self.domain.max));
        for (i, &q) in points.iter().enumerate() {
            let p = self.frame.to_scene(q).clamp(lo, hi);
            (x[i], y[i], z[i]) = (p.x as f32, p.y as f32, p.z as f32);
        }
        let batch = Points { x: &x[..n], y: &y[..n], z: &z[..n] };
        let with_gradient = gradients.is_some();
        if with_gradient {
            let g = Gradients { x: &mut gx[..n], y: &mut gy[..n], z: &mut gz[..n] };
            self.field.gradients(batch, &mut s[..n], g);
        } else {
            self.field.values(batch, &mut s[..n]);
        }
        let mut out = gradients;
        let flat = self.field.dimension() == 2;
        for (i, &q) in points.iter().enumerate() {
            let mut p = self.frame.to_scene(q);
            if flat {
                p.z = 0.5 * (lo.z + hi.z);
            }
            let gradient = DVec3::new(f64::from(gx[i]), f64::from(gy[i]), f64::from(gz[i]));
            let (value, gradient) = close_at_box(p, lo, hi, flat, f64::from(s[i]), gradient);
            values[i] = value / self.frame.scale;
            if let Some(out) = out.as_deref_mut() {
                out[i] = gradient;
            }
        }
    }
}

/// The field cut off at its box: inside, the larger of the field and the (negative) distance to the box; outside, the
/// distance to the box on top of what the field is at the nearest point of the box. Continuous, and positive outside.
pub(super) fn close_at_box(p: DVec3, lo: DVec3, hi: DVec3, flat: bool, value: f64, gradient: DVec3) -> (f64, DVec3) {
    let beyond = p - p.clamp(lo, hi);
    let distance = beyond.length();
    if distance > 0.0 {
        let normal = beyond / distance;
        if value <= 0.0 {
            return (distance, normal);
        }
        // the field only varies along the faces there
        let along = DVec3::select(beyond.cmpeq(DVec3::ZERO), gradient, DVec3::ZERO);
        return (distance + value, normal + along);
    }
    let (below, above) = (lo - p, p - hi);
    let mut best = (f64::NEG_INFINITY, DVec3::ZERO);
    for axis in 0..if flat { 2 } else { 3 } {
        for (d, sign) in [(below[axis], -1.0), (above[axis], 1.0)] {
            if d > best.0 {
                let mut normal = DVec3::ZERO;
                normal[axis] = sign;
                best = (d, normal);
            }
        }
    }
    if value >= best.0 { (value, gradient) } else { best }
}
