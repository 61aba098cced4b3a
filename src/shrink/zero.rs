//! Steps onto the zero level set that can be trusted on fields that are not distances.

use crate::field::Sampler;
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

/// Where points with the outward normals of a surface go on the zero level set: the Newton step, unless the gradient belongs
/// to another sheet, across a narrow gap or through a thin wall. Such a point goes along its normal to the nearest place
/// where the field changes from inside to outside, or stays when there is none within `reach`.
pub fn own_sheet(
    sampler: &Sampler<'_>,
    points: &[DVec3],
    normals: &[DVec3],
    reach: f64,
) -> Result<Vec<DVec3>, Canceled> {
    /// A gradient that agrees with the normal less than this belongs to another sheet.
    const OWN: f64 = 0.1;
    /// Samples along the normal on either side.
    const SAMPLES: usize = 8;
    let (values, gradients) = sampler.gradients(points)?;
    let (mut targets, mut strayed) = (Vec::with_capacity(points.len()), Vec::new());
    for i in 0..points.len() {
        if gradients[i].dot(normals[i]) < OWN * gradients[i].length() {
            strayed.push(i);
        }
        targets.push(points[i] + step_to_zero(values[i], gradients[i], reach));
    }
    let offset = |k: usize| reach * (k as f64 - SAMPLES as f64) / SAMPLES as f64;
    let count = 2 * SAMPLES + 1;
    let line: Vec<DVec3> =
        strayed.iter().flat_map(|&i| (0..count).map(move |k| points[i] + offset(k) * normals[i])).collect();
    let along = sampler.values(&line)?;
    for (&i, s) in strayed.iter().zip(along.chunks_exact(count)) {
        let crossing = |k: usize| {
            (s[k] <= 0.0 && s[k + 1] > 0.0).then(|| offset(k) + (offset(k + 1) - offset(k)) * s[k] / (s[k] - s[k + 1]))
        };
        let nearest = (0..count - 1).filter_map(crossing).min_by(|a, b| a.abs().total_cmp(&b.abs()));
        targets[i] = points[i] + nearest.unwrap_or(0.0) * normals[i];
    }
    Ok(targets)
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

/// Takes `positions` to the zero level set: Newton steps for those whose distance is above `tolerance`. A step is at most `reach`; one that does not bring the value down is halved instead of taken.
pub fn project(sampler: &Sampler<'_>, positions: Vec<DVec3>, reach: f64, tolerance: f64) -> Result<OnZero, Canceled> {
    /// Steps at most.
    const STEPS: usize = 5;
    let mut at = positions;
    let (mut values, mut gradients) = sampler.gradients(&at)?;
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
