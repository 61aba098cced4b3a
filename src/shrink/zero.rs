//! Steps onto the zero level set that can be trusted on fields that are not distances.

use super::tips::Plane;
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

/// A gradient that agrees with a surface's normal less than this belongs to another sheet, across a narrow gap or through a
/// thin wall.
const OWN: f64 = 0.1;

/// Where points with the outward normals of a surface go on the zero level set, and its tangent planes there: the Newton
/// step, or, where the gradient belongs to another sheet, along the normal to the sheet of their own, without a plane.
pub fn own_sheet(
    sampler: &Sampler<'_>,
    points: &[DVec3],
    normals: &[DVec3],
    reach: f64,
) -> Result<Vec<Plane>, Canceled> {
    let (values, gradients) = sampler.gradients(points)?;
    let plane = |i: usize| Plane {
        point: points[i] + step_to_zero(values[i], gradients[i], reach),
        normal: gradients[i].normalize_or_zero(),
    };
    let mut planes: Vec<Plane> = (0..points.len()).map(plane).collect();
    let strayed: Vec<usize> = (0..points.len()).filter(|&i| is_stray(gradients[i], normals[i])).collect();
    for (&i, found) in strayed.iter().zip(along_normals(sampler, points, normals, &strayed, reach)?) {
        planes[i] = Plane { point: found.unwrap_or(points[i]), normal: DVec3::ZERO };
    }
    Ok(planes)
}

fn is_stray(gradient: DVec3, normal: DVec3) -> bool {
    gradient.dot(normal) < OWN * gradient.length()
}

/// For every point of `list` the nearest place on the line along its normal, within `reach`, where the field changes from
/// inside to outside.
fn along_normals(
    sampler: &Sampler<'_>,
    points: &[DVec3],
    normals: &[DVec3],
    list: &[usize],
    reach: f64,
) -> Result<Vec<Option<DVec3>>, Canceled> {
    /// Samples on either side.
    const SAMPLES: usize = 8;
    const COUNT: usize = 2 * SAMPLES + 1;
    let offset = |k: usize| reach * (k as f64 - SAMPLES as f64) / SAMPLES as f64;
    let line: Vec<DVec3> =
        list.iter().flat_map(|&i| (0..COUNT).map(move |k| points[i] + offset(k) * normals[i])).collect();
    let values = sampler.values(&line)?;
    let find = |(&i, s): (&usize, &[f64])| {
        let crossing = |k: usize| {
            let changes = s[k] <= 0.0 && s[k + 1] > 0.0;
            changes.then(|| offset(k) + (offset(k + 1) - offset(k)) * s[k] / (s[k] - s[k + 1]))
        };
        let nearest = (0..COUNT - 1).filter_map(crossing).min_by(|a, b| a.abs().total_cmp(&b.abs()));
        nearest.map(|t| points[i] + t * normals[i])
    };
    Ok(list.iter().zip(values.chunks_exact(COUNT)).map(find).collect())
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

/// Takes `positions` with the outward `normals` of the surface that they are on to the zero level set: Newton steps for
/// those whose distance is above `tolerance`. A step is at most `reach`; one that does not bring the value down is halved
/// instead of taken. Points whose gradient belongs to another sheet go to their own, or stay where they are. Where values
/// are distances a short step ends in the closest point, where the gradient is the same, and the field is not asked again.
pub fn project(
    sampler: &Sampler<'_>,
    positions: Vec<DVec3>,
    normals: &[DVec3],
    reach: f64,
    tolerance: f64,
) -> Result<OnZero, Canceled> {
    /// Steps at most.
    const STEPS: usize = 5;
    /// A step of at most this share of the reach is short.
    const SHORT: f64 = 0.1;
    let mut at = positions;
    let (mut values, mut gradients) = sampler.gradients(&at)?;
    let strayed: Vec<usize> = (0..at.len()).filter(|&i| is_stray(gradients[i], normals[i])).collect();
    let found = along_normals(sampler, &at, normals, &strayed, reach)?;
    let (moved, places): (Vec<usize>, Vec<DVec3>) =
        strayed.iter().zip(found).filter_map(|(&i, place)| Some((i, place?))).unzip();
    let (new_values, new_gradients) = sampler.gradients(&places)?;
    for (k, &i) in moved.iter().enumerate() {
        (at[i], values[i], gradients[i]) = (places[k], new_values[k], new_gradients[k]);
    }
    if sampler.field().metric() == Metric::Exact {
        for i in 0..at.len() {
            let unit = (gradients[i].length() - 1.0).abs() < 1e-3;
            if unit && values[i].abs() <= SHORT * reach && !is_stray(gradients[i], normals[i]) {
                at[i] -= values[i] * gradients[i];
                values[i] = 0.0;
            }
        }
    }
    let mut active: Vec<u32> = (0..at.len() as u32).collect();
    let mut fraction = vec![1.0f64; at.len()];
    for _ in 0..STEPS {
        active.retain(|&i| {
            let i = i as usize;
            values[i].abs() > tolerance * gradients[i].length().max(1e-9) && !is_stray(gradients[i], normals[i])
        });
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
            if trial_values[k].abs() < values[i].abs() && !is_stray(trial_gradients[k], normals[i]) {
                (at[i], values[i], gradients[i]) = (trial[k], trial_values[k], trial_gradients[k]);
            } else {
                fraction[i] *= 0.5;
            }
        }
    }
    Ok(OnZero { positions: at, values, gradients })
}
