//! Takes folds out of a lattice on the zero level set by relaxing patches around them.

use super::energy::Reference;
use super::unfold::{Corners, Problem, grow, mix_targets, relax, smooth};
use super::zero::{OnZero, step_to_zero};
use crate::field::Sampler;
use crate::settings::Canceled;
use glam::DVec3;

/// Triangles whose unit normal times the field's unit gradient is at most this are worked on.
const DOUBTFUL: f64 = 0.1;
/// Triangles at most this far from opposing the field count as folded: a triangle across the mouth of a notch is
/// perpendicular to the gradient, and rounding must not decide about it.
pub const FOLD: f64 = 1e-3;

/// The lattice surface while it is untangled.
pub struct Tangle<'a> {
    sampler: &'a Sampler<'a>,
    triangles: &'a [[u32; 3]],
    corners: Corners,
    /// Typical edge: the root of the mean area.
    edge: f64,
}

impl<'a> Tangle<'a> {
    /// Over the triangles of a lattice.
    pub fn new(sampler: &'a Sampler<'a>, triangles: &'a [[u32; 3]], positions: &[DVec3]) -> Self {
        let area: f64 = triangles.iter().map(|&t| 0.5 * normal(positions, t).length()).sum();
        let corners = Corners::new(positions.len(), triangles);
        Self { sampler, triangles, corners, edge: (area / triangles.len() as f64).sqrt() }
    }

    /// Agreement of every triangle with the field at its centroid. The corners' gradients answer for triangles that no
    /// corner doubts; the field is asked about the others. Returns the field's unit normals too.
    pub fn agreement(&self, at: &OnZero) -> Result<(Vec<f64>, Vec<DVec3>), Canceled> {
        /// A triangle that agrees this well with each of its corners is not folded, if the corners agree among themselves.
        const SURE: f64 = 0.35;
        /// Length of the mean of three unit normals above which they agree.
        const EVEN: f64 = 0.98;
        let unit: Vec<DVec3> = at.gradients.iter().map(|g| g.normalize_or_zero()).collect();
        let (mut along, mut targets) = (Vec::new(), Vec::new());
        let (mut asked, mut points) = (Vec::new(), Vec::new());
        for (i, &t) in self.triangles.iter().enumerate() {
            let n = normal(&at.positions, t).normalize_or_zero();
            let least = t.iter().map(|&v| n.dot(unit[v as usize])).fold(f64::INFINITY, f64::min);
            let sum = t.iter().map(|&v| unit[v as usize]).sum::<DVec3>() / 3.0;
            let mean = sum.normalize_or_zero();
            if least < SURE || sum.length() < EVEN {
                asked.push(i);
                points.push(centroid(&at.positions, t));
            }
            along.push(n.dot(mean));
            targets.push(mean);
        }
        let (_, gradients) = self.sampler.gradients(&points)?;
        for (&i, g) in asked.iter().zip(gradients) {
            targets[i] = g.normalize_or_zero();
            along[i] = normal(&at.positions, self.triangles[i]).normalize_or_zero().dot(targets[i]);
        }
        Ok((along, targets))
    }

    /// Relaxes patches around doubtful triangles against the triangles of `landed`, the lattice before it was projected,
    /// whose shape keeps limbs from being drawn in. Returns how many folded triangles are left.
    pub fn relax_patches(&self, at: &mut OnZero, landed: &[DVec3], rings: usize) -> Result<usize, Canceled> {
        const ROUNDS: usize = 16;
        /// Pull towards the place where a vertex was found, so that tips stay.
        const PULL: f64 = 0.3;
        let anchors = at.positions.clone();
        let reference = |t: usize, c: usize| {
            let k = [0, 1, 2].map(|i| landed[self.triangles[t][(c + i) % 3] as usize]);
            Reference::new(k, 1.0, 0.1)
        };
        let mut best: Option<(usize, OnZero)> = None;
        for round in 0..ROUNDS {
            self.sampler.settings().cancel.check()?;
            let (along, mut targets) = self.agreement(at)?;
            let folded = along.iter().filter(|&&a| a <= FOLD).count();
            if best.as_ref().is_none_or(|b| folded < b.0) {
                best = Some((folded, at.clone()));
            }
            let doubtful = along.iter().any(|&a| a <= DOUBTFUL);
            if !doubtful || (folded == 0 && round > 0) {
                break;
            }
            let mut mask = vec![false; at.positions.len()];
            for (t, _) in self.triangles.iter().zip(&along).filter(|(_, a)| **a <= DOUBTFUL) {
                for &v in t {
                    mask[v as usize] = true;
                }
            }
            let stage = round / 4;
            if round % 4 == 3 {
                for _ in 0..2 {
                    smooth(&mut at.positions, self.triangles, &self.corners, &mask, 0.6);
                }
            } else {
                grow(&mut mask, self.triangles, rings + stage);
                let normals: Vec<DVec3> = at.gradients.iter().map(|g| g.normalize_or(DVec3::Z)).collect();
                mix_targets(&mut targets, self.triangles, &mask, &normals);
                let problem = Problem {
                    triangles: self.triangles,
                    corners: &self.corners,
                    reference: &reference,
                    targets: &targets,
                    normals: &normals,
                    anchors: Some((&anchors, PULL * 0.5f64.powi(stage as i32))),
                    epsilon: 0.1 * [1.0, 0.3, 3.0][stage % 3],
                };
                relax(&problem, &mut at.positions, &masked(&mask), 3);
            }
            self.settle(at, &masked(&mask))?;
        }
        let (folded, kept) = best.expect("at least one round was judged");
        *at = kept;
        Ok(folded)
    }

    /// A Newton step for the vertices that moved, and the field at the new places.
    fn settle(&self, at: &mut OnZero, moved: &[u32]) -> Result<(), Canceled> {
        for _ in 0..2 {
            let points: Vec<DVec3> = moved.iter().map(|&v| at.positions[v as usize]).collect();
            let (values, gradients) = self.sampler.gradients(&points)?;
            for (k, &v) in moved.iter().enumerate() {
                let v = v as usize;
                (at.values[v], at.gradients[v]) = (values[k], gradients[k]);
                at.positions[v] = points[k] + step_to_zero(values[k], gradients[k], self.edge);
            }
        }
        let points: Vec<DVec3> = moved.iter().map(|&v| at.positions[v as usize]).collect();
        let (values, gradients) = self.sampler.gradients(&points)?;
        for (k, &v) in moved.iter().enumerate() {
            (at.values[v as usize], at.gradients[v as usize]) = (values[k], gradients[k]);
        }
        Ok(())
    }
}

/// Vertices that a mask holds.
pub fn masked(mask: &[bool]) -> Vec<u32> {
    (0..mask.len() as u32).filter(|&v| mask[v as usize]).collect()
}

/// Normal of a triangle, as long as twice its area.
pub(super) fn normal(positions: &[DVec3], t: [u32; 3]) -> DVec3 {
    let [a, b, c] = t.map(|v| positions[v as usize]);
    (b - a).cross(c - a)
}

fn centroid(positions: &[DVec3], t: [u32; 3]) -> DVec3 {
    t.iter().map(|&v| positions[v as usize]).sum::<DVec3>() / 3.0
}

/// A small generator (splitmix64, Steele et al. 2014) with a seed that is given, so that results do not change from run to run.
pub struct Random(u64);

impl Random {
    /// The sequence of this number.
    pub fn new(seed: u32) -> Self {
        Self(0x9e37_79b9_7f4a_7c15u64.wrapping_mul(1 + u64::from(seed)))
    }
    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }
    /// A number below `n`.
    pub fn below(&mut self, n: u64) -> usize {
        (self.next() % n) as usize
    }
    fn unit(&mut self) -> f64 {
        ((self.next() >> 11) as f64 + 0.5) / (1u64 << 53) as f64
    }
    /// Three independent normal numbers (Box and Muller).
    pub fn normal(&mut self) -> DVec3 {
        let mut one = || (-2.0 * self.unit().ln()).sqrt() * (2.0 * std::f64::consts::PI * self.unit()).cos();
        DVec3::new(one(), one(), one())
    }
}
