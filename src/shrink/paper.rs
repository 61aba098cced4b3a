//! `method: paper`: the loop of "Shrinking: Reconstruction of Parameterized Surfaces from Signed Distance Fields" as
//! printed, with the sign of the update mended (a point outside moves against the gradient). The baseline: it folds over
//! wherever a shape is not nearly round.

use super::lattice::{LatticeSpec, SphereLattice};
use super::{ShrinkError, ShrinkSpec, Wrap};
use crate::field::{Frame, Sampler};
use crate::settings::{Front, Progress};
use glam::DVec3;

/// Step of the update, as printed.
const STEP: f64 = 0.2;
/// Iterations with resampling, then with full steps and none.
const ITERATIONS: (usize, usize) = (100, 10);
/// A vertex that comes to rest within this of zero, in half sides of the domain, has found the zero level set.
const NEAR: f64 = 0.01;

/// Runs the loop on either lattice; on the octahedral one the lines that are resampled are the grid's.
pub fn run(scene: &Sampler<'_>, spec: &ShrinkSpec) -> Result<Wrap, ShrinkError> {
    let settings = *scene.settings();
    let lattice = SphereLattice::new(spec.lattice);
    let domain = scene.domain();
    let (lo, hi) = (DVec3::from(domain.min), DVec3::from(domain.max));
    let frame = Frame { center: 0.5 * (lo + hi), scale: 0.5 * (hi - lo).max_element() };
    let sampler = scene.framed(frame);
    scene.tally().stage("shrink");
    let mut positions = lattice.directions.clone();
    let diagonals = vec![false; lattice.quads.len()];
    let triangles = lattice.triangles(&diagonals);
    let total = ITERATIONS.0 + ITERATIONS.1;
    let (mut low, mut high) = (f64::INFINITY, f64::NEG_INFINITY);
    for iteration in 0..total {
        let (values, gradients) = sampler.gradients(&positions)?;
        let step = if iteration < ITERATIONS.0 { STEP } else { 1.0 };
        let mut farthest = 0.0f64;
        for i in 0..positions.len() {
            positions[i] -= step * values[i] * gradients[i].normalize_or_zero();
            farthest = farthest.max(values[i].abs());
            (low, high) = (low.min(values[i]), high.max(values[i]));
        }
        if iteration < ITERATIONS.0 {
            resample(&lattice, &mut positions, iteration % 2 == 0);
        }
        let front = (iteration % 5 == 0).then(|| Front {
            positions: positions.iter().map(|&p| frame.to_scene(p).as_vec3().to_array()).collect(),
            triangles: triangles.clone(),
            places: lattice.directions.iter().map(|d| d.as_vec3().to_array()).collect(),
        });
        (settings.progress)(Progress {
            stage: "shrink",
            iteration: iteration as u32,
            iterations: total as u32,
            fraction: (iteration + 1) as f32 / total as f32,
            max_distance: Some(farthest * frame.scale),
            front,
            ..Progress::default()
        });
    }
    let (values, gradients) = sampler.gradients(&positions)?;
    if low > 0.0 && values.iter().all(|v| v.abs() > NEAR) {
        return Err(ShrinkError::Empty { min: low * frame.scale, max: high * frame.scale });
    }
    Ok(Wrap {
        positions: positions.into_iter().map(|q| frame.to_scene(q)).collect(),
        values: values.into_iter().map(|v| v * frame.scale).collect(),
        gradients,
        diagonals,
        lattice,
    })
}

/// Spaces the vertices of every row (or every column) evenly by arc length. Rows of the lat-long lattice are closed
/// loops; columns run from pole to pole. Poles and grid borders stay.
fn resample(lattice: &SphereLattice, positions: &mut [DVec3], rows: bool) {
    let at = |row: usize, column: usize| lattice.grid[row * lattice.columns + column] as usize;
    let (lines, length) = if rows { (lattice.rows, lattice.columns) } else { (lattice.columns, lattice.rows) };
    // the lat-long seam column is column 0 again, and its polar rows are points
    let latlong = matches!(lattice.spec, LatticeSpec::Latlong { .. });
    let range = match (latlong, rows) {
        (true, true) => 1..lines - 1,
        (true, false) => 0..lines - 1,
        (false, _) => 1..lines - 1,
    };
    let (mut line, mut arc) = (Vec::with_capacity(length), Vec::with_capacity(length));
    for l in range {
        line.clear();
        arc.clear();
        for k in 0..length {
            let p = positions[if rows { at(l, k) } else { at(k, l) }];
            arc.push(match line.last() {
                None => 0.0,
                Some(q) => arc[k - 1] + p.distance(*q),
            });
            line.push(p);
        }
        let total = arc[length - 1];
        if total < 1e-12 {
            continue;
        }
        let mut segment = 0;
        for k in 1..length - 1 {
            let target = total * k as f64 / (length - 1) as f64;
            while segment + 2 < length && arc[segment + 1] < target {
                segment += 1;
            }
            let t = (target - arc[segment]) / (arc[segment + 1] - arc[segment]).max(1e-300);
            positions[if rows { at(l, k) } else { at(k, l) }] =
                line[segment].lerp(line[segment + 1], t.clamp(0.0, 1.0));
        }
    }
}
