//! The paper's loop for curves, as printed: a circle whose samples move against the normalized gradient by a fifth of the
//! distance, with momentum, resampled by arc length after every step. The baseline: folds and self-intersections stay.

use super::polyline::even_places;
use super::{Samples, ShrinkError};
use crate::field::Sampler;
use glam::{DVec2, DVec3};

/// Share of the distance that a sample moves in one step; the paper's.
const STEP: f64 = 0.2;
/// Share of the last move that is added to the next; the paper gives no figure. Half damps the oscillation that the
/// step of 0.2 would have at the usual 0.9.
const MOMENTUM: f64 = 0.5;
/// Steps; the paper's number for surfaces.
const ITERATIONS: usize = 100;

/// Runs the loop from the unit circle of the frame.
pub(super) fn shrink(sampler: &Sampler<'_>, count: usize) -> Result<Samples, ShrinkError> {
    let angle = |i: usize| std::f64::consts::TAU * i as f64 / count as f64;
    let mut points: Vec<DVec2> = (0..count).map(|i| DVec2::from_angle(angle(i))).collect();
    let mut moves = vec![DVec2::ZERO; count];
    let mut lifted = vec![DVec3::ZERO; count];
    for _ in 0..ITERATIONS {
        lift(&points, &mut lifted);
        let (s, g) = sampler.gradients(&lifted)?;
        for i in 0..count {
            let downhill = -s[i] * g[i].truncate().normalize_or_zero();
            moves[i] = MOMENTUM * moves[i] + STEP * downhill;
            points[i] += moves[i];
        }
        let places = even_places(&points, count);
        let at = |values: &[DVec2]| -> Vec<DVec2> {
            places.iter().map(|&(i, t)| values[i].lerp(values[(i + 1) % count], t)).collect()
        };
        (points, moves) = (at(&points), at(&moves));
    }
    lift(&points, &mut lifted);
    let (values, g) = sampler.gradients(&lifted)?;
    Ok(Samples {
        normals: g.iter().map(|g| g.truncate().normalize_or(DVec2::X)).collect(),
        parameters: (0..count).map(|i| i as f64 / count as f64).collect(),
        corners: vec![false; count],
        reaches: Vec::new(),
        slopes: g.iter().map(|g| g.length()).collect(),
        values,
        positions: points,
    })
}

fn lift(points: &[DVec2], lifted: &mut [DVec3]) {
    for (q, p) in lifted.iter_mut().zip(points) {
        *q = p.extend(0.0);
    }
}
