//! The last repair: vertices of triangles that cross or are folded are moved one at a time, and diagonals turned, to places
//! where fewer do. Crossings are counted on the positions as they will be written (single precision), without asking
//! the field; only the few best places of each vertex are shown to it. Where a sheet and its neighbour are closer than the
//! chords of the lattice, being apart comes before being exactly on the zero level set.

mod loosen;
mod mix;
mod place;
mod turn;

use super::Wrap;
use super::collide::{Bounds, Index, crossings};
use super::lattice::SphereLattice;
use super::unfold::{Corners, grow};
use super::untangle::{FOLD, Random, Tangle, masked};
use super::zero::OnZero;
use crate::field::Sampler;
use crate::settings::Canceled;
use glam::DVec3;

/// A triangle whose unit normal times the field's unit gradient is at most this is not left as it is.
const SAFE: f64 = 0.02;
/// Cost of a folded triangle; that of a crossing is 1 and what it overlaps in edges.
const FOLDED: f64 = 3.0;

/// Farthest that a repaired vertex may be from the zero level set, in diagonals of the surface's bounding box.
const OFF: f64 = 4e-3;

/// What is wrong with a surface.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Faults {
    /// Folded triangles.
    pub folds: usize,
    /// Pairs of triangles that cross.
    pub crossings: usize,
}

impl Faults {
    fn total(self) -> usize {
        self.folds + self.crossings
    }
}

/// Where things are wrong.
#[derive(Clone)]
struct Found {
    pairs: Vec<(u32, u32)>,
    folded: Vec<u32>,
}

impl Found {
    fn faults(&self) -> Faults {
        Faults { folds: self.folded.len(), crossings: self.pairs.len() }
    }
    /// Triangles that take part, in ascending order.
    fn triangles(&self) -> Vec<u32> {
        let mut list: Vec<u32> = self.pairs.iter().flat_map(|&(i, j)| [i, j]).chain(self.folded.clone()).collect();
        list.sort_unstable();
        list.dedup();
        list
    }
}

/// What is changed in a repair.
#[derive(Clone)]
struct State {
    at: OnZero,
    diagonals: Vec<bool>,
    triangles: Vec<[u32; 3]>,
    /// Agreement of every triangle with the field, and the field's unit normal there.
    along: Vec<f64>,
    targets: Vec<DVec3>,
}

/// A lattice surface in scene units while it is repaired.
struct Repair<'a> {
    sampler: &'a Sampler<'a>,
    lattice: &'a SphereLattice,
    state: State,
    corners: Corners,
    index: Index,
    /// Crossing pairs when they were last looked for, and triangles that changed since.
    pairs: Vec<(u32, u32)>,
    changed: Vec<u32>,
    /// Farthest that a vertex may be from the zero level set.
    limit: f64,
    random: Random,
    /// Random places that are tried for a vertex.
    tries: usize,
}

/// Repairs a surface in scene units. `earlier` are positions that its vertices had before, any of which they may go back
/// to. Triangles at `places` are shown to the field even if their corners do not doubt them. On return all positions are
/// single-precision numbers. Another `seed` tries other places, and a larger one more of them: what earlier repairs left is
/// hard. Returns what is left.
pub fn separate(
    sampler: &Sampler<'_>,
    wrap: &mut Wrap,
    earlier: &[&[DVec3]],
    places: &[DVec3],
    seed: u32,
) -> Result<Faults, Canceled> {
    /// Rounds of a cycle, which starts with smoothing what is bad, from the second cycle on.
    const CYCLE: usize = 3;
    const CYCLES: usize = 6;
    /// One in so many vertices is moved at most, counting every move; a surface that needs more is past repair.
    const SHARE: usize = 6;
    /// Moves that even the smallest lattice has.
    const FEWEST: usize = 1000;
    /// With more wrong triangles than this a cycle that brings nothing is the last.
    const MANY: usize = 60;
    /// Random places for a vertex in the first repair, and how often they are doubled at most.
    const TRIES: usize = 16;
    const DOUBLINGS: u32 = 5;
    let positions: Vec<DVec3> = wrap.positions.iter().map(|&p| written(p)).collect();
    let at = OnZero { positions, values: wrap.values.clone(), gradients: wrap.gradients.clone() };
    let triangles = wrap.lattice.triangles(&wrap.diagonals);
    let (along, targets) = Tangle::new(sampler, &triangles, &at.positions).agreement(&at)?;
    let diagonal = Bounds::around(at.positions.iter().copied()).diagonal();
    let mut repair = Repair {
        sampler,
        lattice: &wrap.lattice,
        corners: Corners::new(at.positions.len(), &triangles),
        index: Index::new(&at.positions, &triangles),
        pairs: Vec::new(),
        changed: (0..triangles.len() as u32).collect(),
        state: State { at, diagonals: wrap.diagonals.clone(), triangles, along, targets },
        limit: OFF * diagonal,
        random: Random::new(seed),
        tries: TRIES << seed.min(DOUBLINGS),
    };
    repair.look_at(places)?;
    let mut found = repair.find()?;
    let mut best = (found.clone(), repair.state.clone());
    let mut budget = (wrap.positions.len() / SHARE).max(FEWEST);
    for cycle in 0..CYCLES {
        let before = best.0.faults().total();
        if before == 0 || budget == 0 {
            break;
        }
        if cycle > 0 {
            let mut mask = repair.mask(&best.0.triangles());
            repair.loosen(&mut mask, cycle)?;
            found = repair.find()?;
        }
        for round in 0..CYCLE {
            sampler.settings().cancel.check()?;
            let wrong = found.triangles();
            repair.turn(&wrong)?;
            let mut mask = repair.mask(&wrong);
            if round == 1 && wrong.len() <= MANY {
                grow(&mut mask, &repair.state.triangles, 1);
            }
            for v in masked(&mask) {
                if budget > 0 {
                    repair.place(v, earlier)?;
                    budget -= 1;
                }
            }
            found = repair.find()?;
            if found.faults().total() == 0 {
                break;
            }
        }
        if found.faults().total() > 0 && cycle > 0 {
            // at every place the better of both
            repair.mix(&best.1, &best.0, &found);
            found = repair.find()?;
        }
        if found.faults().total() < before {
            best = (found.clone(), repair.state.clone());
        } else {
            repair.set(&best.1, &best.0);
            if cycle > 0 && best.0.triangles().len() > MANY {
                break;
            }
        }
    }
    let (found, State { at, diagonals, .. }) = best;
    (wrap.positions, wrap.values, wrap.gradients, wrap.diagonals) = (at.positions, at.values, at.gradients, diagonals);
    Ok(found.faults())
}

/// A position as it will be written.
fn written(p: DVec3) -> DVec3 {
    p.as_vec3().as_dvec3()
}

impl Repair<'_> {
    /// Crossing pairs and folded triangles. Only what changed since the last time is looked at.
    fn find(&mut self) -> Result<Found, Canceled> {
        let mut changed = std::mem::take(&mut self.changed);
        changed.sort_unstable();
        changed.dedup();
        let State { at, triangles, along, .. } = &self.state;
        let fresh = crossings(&self.index, &at.positions, triangles, &changed, self.sampler.settings())?;
        let old = |t: u32| changed.binary_search(&t).is_err();
        self.pairs.retain(|&(i, j)| old(i) && old(j));
        self.pairs.extend(fresh);
        self.pairs.sort_unstable();
        let folded = (0..along.len() as u32).filter(|&t| along[t as usize] <= FOLD).collect();
        Ok(Found { pairs: self.pairs.clone(), folded })
    }

    /// Notes that triangles are now elsewhere.
    fn note(&mut self, triangles: &[u32]) {
        for &t in triangles {
            self.index.update(t, self.corners_of(t));
        }
        self.changed.extend_from_slice(triangles);
    }

    /// Vertices of triangles.
    fn mask(&self, triangles: &[u32]) -> Vec<bool> {
        let mut mask = vec![false; self.state.at.positions.len()];
        for v in triangles.iter().flat_map(|&t| self.state.triangles[t as usize]) {
            mask[v as usize] = true;
        }
        mask
    }

    /// Goes back to a state and what was found in it.
    fn set(&mut self, state: &State, found: &Found) {
        let different = |&t: &u32| {
            let (now, then) = (self.state.triangles[t as usize], state.triangles[t as usize]);
            now != then || then.iter().any(|&v| self.state.at.positions[v as usize] != state.at.positions[v as usize])
        };
        let back: Vec<u32> = (0..state.triangles.len() as u32).filter(different).collect();
        self.state.clone_from(state);
        self.corners = Corners::new(state.at.positions.len(), &state.triangles);
        self.note(&back);
        self.changed.clear();
        self.pairs.clone_from(&found.pairs);
    }

    /// Shows the triangles at some places to the field.
    fn look_at(&mut self, places: &[DVec3]) -> Result<(), Canceled> {
        /// Triangles at most this many edges away are at a place.
        const REACH: f64 = 2.0;
        let mut seen = Vec::new();
        for &p in places {
            let size = |t: u32| {
                let k = self.corners_of(t);
                k[0].distance(k[1]).max(k[1].distance(k[2]))
            };
            let center = |&t: &u32| self.corners_of(t).iter().sum::<DVec3>() / 3.0;
            let nearest = (0..self.state.triangles.len() as u32)
                .min_by(|a, b| center(a).distance_squared(p).total_cmp(&center(b).distance_squared(p)));
            let Some(nearest) = nearest else { continue };
            let reach = REACH * size(nearest);
            self.index.near(&Bounds::around([p - reach, p + reach]), |t| seen.push(t));
        }
        seen.sort_unstable();
        seen.dedup();
        self.judge(&seen)
    }

    /// Asks the field about triangles.
    fn judge(&mut self, list: &[u32]) -> Result<(), Canceled> {
        let (along, targets) = self.agree(&list.iter().map(|&t| self.corners_of(t)).collect::<Vec<_>>())?;
        for (k, &t) in list.iter().enumerate() {
            (self.state.along[t as usize], self.state.targets[t as usize]) = (along[k], targets[k]);
        }
        Ok(())
    }

    fn corners_of(&self, t: u32) -> [DVec3; 3] {
        self.state.triangles[t as usize].map(|v| self.state.at.positions[v as usize])
    }

    /// Agreement of triangles with the field at their centroids.
    fn agree(&self, triangles: &[[DVec3; 3]]) -> Result<(Vec<f64>, Vec<DVec3>), Canceled> {
        let centroids: Vec<DVec3> = triangles.iter().map(|k| (k[0] + k[1] + k[2]) / 3.0).collect();
        let targets: Vec<DVec3> =
            self.sampler.gradients(&centroids)?.1.into_iter().map(|g| g.normalize_or_zero()).collect();
        Ok((triangles.iter().zip(&targets).map(|(k, g)| unit(*k).dot(*g)).collect(), targets))
    }
}

fn unit([a, b, c]: [DVec3; 3]) -> DVec3 {
    (b - a).cross(c - a).normalize_or_zero()
}

/// Cost of a triangle with this agreement.
fn fold_cost(along: f64) -> f64 {
    /// Agreement from which a triangle costs nothing.
    const GOOD: f64 = 0.15;
    (if along <= SAFE { FOLDED } else { 0.0 }) + (GOOD - along).max(0.0)
}

#[cfg(test)]
mod tests;
