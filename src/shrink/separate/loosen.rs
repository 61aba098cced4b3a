//! Smoothing and unfolding of what is bad, together with what is around it.

use super::super::energy::Reference;
use super::super::unfold::{Problem, grow, mix_targets, relax, smooth};
use super::super::untangle::masked;
use super::super::zero::step_to_zero;
use super::{Repair, State, written};
use crate::settings::Canceled;
use glam::DVec3;

impl Repair<'_> {
    /// Smooths what is bad and some rings around it, and takes it back to the zero level set.
    pub(super) fn loosen(&mut self, mask: &mut [bool], rings: usize) -> Result<(), Canceled> {
        grow(mask, &self.state.triangles, rings - 1);
        if rings.is_multiple_of(2) {
            self.unfold(mask);
        } else {
            for _ in 0..rings + 1 {
                smooth(&mut self.state.at.positions, &self.state.triangles, &self.corners, mask, 0.5);
            }
        }
        let moved = masked(mask);
        let points: Vec<DVec3> = moved.iter().map(|&v| self.state.at.positions[v as usize]).collect();
        let (values, gradients) = self.sampler.gradients(&points)?;
        for (k, &v) in moved.iter().enumerate() {
            let reach = 0.5 * self.edge(v);
            let step = step_to_zero(values[k], gradients[k], reach);
            self.state.at.positions[v as usize] = written(points[k] + step);
            // the value after the step is not known; what is missing of it is
            self.state.at.values[v as usize] = values[k] + gradients[k].dot(step);
            self.state.at.gradients[v as usize] = gradients[k];
        }
        let mut stars: Vec<u32> = moved.iter().flat_map(|&v| self.corners.at(v)).map(|&c| c / 3).collect();
        stars.sort_unstable();
        stars.dedup();
        self.judge(&stars)?;
        self.note(&stars);
        Ok(())
    }

    /// Relaxes what a mask holds towards equilateral triangles that face along the field's normals.
    fn unfold(&mut self, mask: &[bool]) {
        let active = masked(mask);
        let edge = active.iter().map(|&v| self.edge(v)).sum::<f64>() / active.len().max(1) as f64;
        let State { at, triangles, targets, .. } = &mut self.state;
        let normals: Vec<DVec3> = at.gradients.iter().map(|g| g.normalize_or(DVec3::Z)).collect();
        let mut wanted = targets.clone();
        mix_targets(&mut wanted, triangles, mask, &normals);
        let problem = Problem {
            triangles,
            corners: &self.corners,
            reference: &|_, _| Reference::equilateral(edge),
            targets: &wanted,
            normals: &normals,
            anchors: None,
            epsilon: 0.1,
        };
        relax(&problem, &mut at.positions, &active, 4);
    }

    /// Mean length of the edges around a vertex.
    fn edge(&self, v: u32) -> f64 {
        let list = self.corners.at(v);
        let next = |&c: &u32| self.state.triangles[c as usize / 3][(c as usize + 1) % 3];
        let here = self.state.at.positions[v as usize];
        list.iter().map(|c| self.state.at.positions[next(c) as usize].distance(here)).sum::<f64>() / list.len() as f64
    }
}
