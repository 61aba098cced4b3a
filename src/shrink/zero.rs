//! Steps onto the zero level set that can be trusted on fields that are not distances.

use crate::field::{Metric, Sampler};
use crate::settings::Canceled;
use glam::DVec3;

/// The Newton step from a point with this value and gradient, never longer than `reach`.
pub fn step_to_zero(value: f64, gradient: DVec3, reach: f64) -> DVec3 {
    let squared = gradient.length_squared();
    if squared < 1e-18 {
        return DVec3::ZERO;
    }
    (gradient * (-value / squared)).clamp_length_max(reach)
}

/// Points on the zero level set with the field there.
#[derive(Clone, Debug)]
pub struct OnZero {
    /// Positions, in frame units.
    pub positions: Vec<DVec3>,
    /// Values at them.
    pub values: Vec<f64>,
    /// Gradients at them.
    pub gradients: Vec<DVec3>,
}

/// Takes `positions` to the zero level set: Newton steps for those whose distance is above `tolerance`. A step is at most
/// `reach`; one that does not bring the value down is halved instead of taken. Where values are distances a short step
/// ends in the closest point, where the gradient is the same, and the field is not asked again.
pub fn project(sampler: &Sampler<'_>, positions: Vec<DVec3>, reach: f64, tolerance: f64) -> Result<OnZero, Canceled> {
    /// Steps at most.
    const STEPS: usize = 5;
    /// A step of at most this share of the reach is short.
    const SHORT: f64 = 0.1;
    let mut at = positions;
    let (mut values, mut gradients) = sampler.gradients(&at)?;
    if sampler.field().metric() == Metric::Exact {
        for i in 0..at.len() {
            let unit = (gradients[i].length() - 1.0).abs() < 1e-3;
            if unit && values[i].abs() <= SHORT * reach {
                at[i] -= values[i] * gradients[i];
                values[i] = 0.0;
            }
        }
    }
    let mut active: Vec<u32> = (0..at.len() as u32).collect();
    let mut fraction = vec![1.0f64; at.len()];
    for _ in 0..STEPS {
        active.retain(|&i| values[i as usize].abs() > tolerance * gradients[i as usize].length().max(1e-9));
        if active.is_empty() {
            break;
        }
        let trial: Vec<DVec3> = active
            .iter()
            .map(|&i| {
                let i = i as usize;
                at[i] + fraction[i] * step_to_zero(values[i], gradients[i], reach)
            })
            .collect();
        let (trial_values, trial_gradients) = sampler.gradients(&trial)?;
        for (k, &i) in active.iter().enumerate() {
            let i = i as usize;
            if trial_values[k].abs() < values[i].abs() {
                (at[i], values[i], gradients[i]) = (trial[k], trial_values[k], trial_gradients[k]);
            } else {
                fraction[i] *= 0.5;
            }
        }
    }
    Ok(OnZero { positions: at, values, gradients })
}
