//! Turning diagonals.

use super::super::collide::{Bounds, meet, overlap};
use super::super::unfold::Corners;
use super::{Repair, fold_cost};
use crate::settings::Canceled;

impl Repair<'_> {
    /// Turns the diagonals of quads with wrong triangles where that takes crossings away and folds nothing.
    pub(super) fn turn(&mut self, wrong: &[u32]) -> Result<(), Canceled> {
        let mut quads: Vec<usize> = wrong.iter().map(|&t| t as usize / 2).collect();
        quads.dedup();
        let mut changed = false;
        for q in quads {
            if q >= self.lattice.quads.len() || !self.lattice.free[q] {
                continue;
            }
            let k = self.lattice.quads[q].map(|c| self.lattice.chart[c as usize]);
            let pick = |other: bool| {
                if other { [[k[0], k[1], k[3]], [k[1], k[2], k[3]]] } else { [[k[0], k[1], k[2]], [k[0], k[2], k[3]]] }
            };
            let pair = [2 * q as u32, 2 * q as u32 + 1];
            let (now, then) = (pick(self.state.diagonals[q]), pick(!self.state.diagonals[q]));
            let before =
                self.pair_cost(pair, now) + pair.map(|t| fold_cost(self.state.along[t as usize])).iter().sum::<f64>();
            let free = self.pair_cost(pair, then);
            if free >= before {
                continue;
            }
            let (along, targets) = self.agree(&then.map(|t| t.map(|v| self.state.at.positions[v as usize])))?;
            if free + along.iter().map(|&a| fold_cost(a)).sum::<f64>() < before - 1e-6 {
                self.state.diagonals[q] = !self.state.diagonals[q];
                changed = true;
                for i in 0..2 {
                    let t = pair[i] as usize;
                    (self.state.triangles[t], self.state.along[t], self.state.targets[t]) =
                        (then[i], along[i], targets[i]);
                }
                self.note(&pair);
            }
        }
        if changed {
            self.corners = Corners::new(self.state.at.positions.len(), &self.state.triangles);
        }
        Ok(())
    }

    /// Crossings of the two triangles of a quad when they are `these`.
    fn pair_cost(&self, pair: [u32; 2], these: [[u32; 3]; 2]) -> f64 {
        let positions = &self.state.at.positions;
        let mut cost = f64::from(meet(positions, these[0], these[1]));
        for t in these {
            let k = t.map(|v| positions[v as usize]);
            let size = k[0].distance(k[1]).max(k[1].distance(k[2]));
            self.index.near(&Bounds::around(k), |u| {
                if !pair.contains(&u) && meet(positions, t, self.state.triangles[u as usize]) {
                    cost += 1.0 + (overlap(k, self.corners_of(u)) / size).min(1.0);
                }
            });
        }
        cost
    }
}
