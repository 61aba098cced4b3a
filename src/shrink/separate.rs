//! The last repair: vertices of triangles that cross or are folded are moved one at a time, and diagonals turned, to places
//! where fewer do. Crossings are counted on the positions as they will be written (single precision), without asking
//! the field; only the few best places of each vertex are shown to it. Where a sheet and its neighbour are closer than the
//! chords of the lattice, being apart comes before being exactly on the zero level set.

use super::Wrap;
use super::collide::{Bounds, Index, crossings, meet, overlap};
use super::energy::Reference;
use super::lattice::SphereLattice;
use super::unfold::{Corners, Problem, grow, mix_targets, relax, smooth};
use super::untangle::{FOLD, Random, Tangle, masked};
use super::zero::{OnZero, step_to_zero};
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
}

/// Repairs a surface in scene units. `earlier` are positions that its vertices had before, any of which they may go back
/// to. Triangles at `places` are shown to the field even if their corners do not doubt them. On return all positions are
/// single-precision numbers. Returns what is left.
pub fn separate(
    sampler: &Sampler<'_>,
    wrap: &mut Wrap,
    earlier: &[&[DVec3]],
    places: &[DVec3],
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
        random: Random::new(),
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

    /// Takes every connected piece in which this state and `other` differ from the one in which less is wrong.
    fn mix(&mut self, other: &State, other_found: &Found, found: &Found) {
        let n = self.state.at.positions.len();
        let mut parent: Vec<u32> = (0..n as u32).collect();
        fn root(parent: &mut [u32], mut v: u32) -> u32 {
            while parent[v as usize] != v {
                parent[v as usize] = parent[parent[v as usize] as usize];
                v = parent[v as usize];
            }
            v
        }
        let mut join = |t: &[u32]| {
            for &v in &t[1..] {
                let (a, b) = (root(&mut parent, t[0]), root(&mut parent, v));
                parent[b as usize] = a;
            }
        };
        let moved = |v: u32| self.state.at.positions[v as usize] != other.at.positions[v as usize];
        for (t, o) in self.state.triangles.iter().zip(&other.triangles) {
            if t != o || t.iter().any(|&v| moved(v)) {
                join(t);
                join(o);
                join(&[t[0], o[0]]);
            }
        }
        for (pairs, triangles) in [(&found.pairs, &self.state.triangles), (&other_found.pairs, &other.triangles)] {
            for &(i, j) in pairs {
                let (s, t) = (triangles[i as usize], triangles[j as usize]);
                join(&[s[0], s[1], s[2], t[0], t[1], t[2]]);
            }
        }
        let mut balance = vec![0i64; n];
        for t in found.triangles() {
            balance[root(&mut parent, self.state.triangles[t as usize][0]) as usize] += 1;
        }
        for t in other_found.triangles() {
            balance[root(&mut parent, other.triangles[t as usize][0]) as usize] -= 1;
        }
        let worse: Vec<bool> = (0..n as u32).map(|v| balance[root(&mut parent, v) as usize] > 0).collect();
        let mut back = Vec::new();
        for (t, &now) in self.state.triangles.iter().enumerate() {
            let then = other.triangles[t];
            if worse[now[0] as usize] && (now != then || now.iter().any(|&v| moved(v))) {
                back.push(t as u32);
            }
        }
        let state = &mut self.state;
        for v in (0..n).filter(|&v| worse[v]) {
            state.at.positions[v] = other.at.positions[v];
            state.at.values[v] = other.at.values[v];
            state.at.gradients[v] = other.at.gradients[v];
        }
        for t in 0..state.triangles.len() {
            if worse[state.triangles[t][0] as usize] || worse[other.triangles[t][0] as usize] {
                state.triangles[t] = other.triangles[t];
                state.along[t] = other.along[t];
                state.targets[t] = other.targets[t];
                if let Some(diagonal) = state.diagonals.get_mut(t / 2) {
                    *diagonal = other.diagonals[t / 2];
                }
            }
        }
        self.corners = Corners::new(n, &self.state.triangles);
        self.note(&back);
    }

    fn corners_of(&self, t: u32) -> [DVec3; 3] {
        self.state.triangles[t as usize].map(|v| self.state.at.positions[v as usize])
    }

    /// Turns the diagonals of quads with wrong triangles where that takes crossings away and folds nothing.
    fn turn(&mut self, wrong: &[u32]) -> Result<(), Canceled> {
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

    /// Agreement of triangles with the field at their centroids.
    fn agree(&self, triangles: &[[DVec3; 3]]) -> Result<(Vec<f64>, Vec<DVec3>), Canceled> {
        let centroids: Vec<DVec3> = triangles.iter().map(|k| (k[0] + k[1] + k[2]) / 3.0).collect();
        let targets: Vec<DVec3> =
            self.sampler.gradients(&centroids)?.1.into_iter().map(|g| g.normalize_or_zero()).collect();
        Ok((triangles.iter().zip(&targets).map(|(k, g)| unit(*k).dot(*g)).collect(), targets))
    }

    /// Smooths what is bad and some rings around it, and takes it back to the zero level set.
    fn loosen(&mut self, mask: &mut [bool], rings: usize) -> Result<(), Canceled> {
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

    /// Moves one vertex to the best of some places around it.
    fn place(&mut self, v: u32, earlier: &[&[DVec3]]) -> Result<(), Canceled> {
        /// Places shown to the field.
        const SHOWN: usize = 3;
        const RANDOM_PLACES: usize = 16;
        let star: Vec<u32> = self.corners.at(v).iter().map(|&c| c / 3).collect();
        let here = self.state.at.positions[v as usize];
        let mut around: Vec<DVec3> = Vec::with_capacity(star.len());
        for &c in self.corners.at(v) {
            let t = self.state.triangles[c as usize / 3];
            around.push(self.state.at.positions[t[(c as usize % 3 + 1) % 3] as usize]);
        }
        let edge = around.iter().map(|p| p.distance(here)).sum::<f64>() / around.len() as f64;
        let center = around.iter().sum::<DVec3>() / around.len() as f64;
        let normal = self.state.at.gradients[v as usize].normalize_or_zero();
        let mut places = vec![here];
        places.extend(earlier.iter().flat_map(|e| [0.5, 1.0].map(|t| here.lerp(e[v as usize], t))));
        places.extend([0.3, 0.6, 1.0].map(|t| here.lerp(center, t)));
        let tangential = (center - here) - normal * normal.dot(center - here);
        places.extend([0.5, 1.0].map(|t| here + t * tangential));
        places.extend(around.iter().map(|&p| here.lerp(p, 0.4)));
        places.extend([-0.5, -0.25, -0.1, 0.1, 0.25, 0.5].map(|t| here + t * edge * normal));
        for _ in 0..RANDOM_PLACES {
            let reach = [0.1, 0.3, 0.7][self.random.below(3)] * edge;
            places.push(here + (reach * self.random.normal()).clamp_length_max(edge));
        }
        for p in &mut places {
            *p = written(*p);
        }
        // what any of the places could meet
        let reach = Bounds::around(places.iter().chain(&around).copied());
        let mut near = Vec::new();
        self.index.near(&reach, |t| {
            if !star.contains(&t) {
                near.push(t);
            }
        });
        near.sort_unstable();
        let expected = |t: u32| self.state.targets[t as usize];
        let free: Vec<f64> = {
            let mut positions = std::mem::take(&mut self.state.at.positions);
            let (mut bar, mut least) = (f64::INFINITY, [f64::INFINITY; SHOWN]);
            let costs = places
                .iter()
                .map(|&to| {
                    positions[v as usize] = to;
                    let mut cost = 1e-3 * to.distance(here) / edge;
                    for &t in &star {
                        let k = self.state.triangles[t as usize].map(|u| positions[u as usize]);
                        cost += fold_cost(unit(k).dot(expected(t))) + thinness(k);
                    }
                    cost = self.star_cost(&positions, &star, &near, edge, cost, bar);
                    // the present place comes first; nothing is looked at further that is dearer than it or than as many
                    // others as the field is shown
                    if bar.is_infinite() {
                        least = [cost; SHOWN];
                    } else if cost < least[SHOWN - 1] {
                        least[SHOWN - 1] = cost;
                        least.sort_by(f64::total_cmp);
                    }
                    bar = least[SHOWN - 1];
                    cost
                })
                .collect();
            positions[v as usize] = here;
            self.state.at.positions = positions;
            costs
        };
        let mut ranks: Vec<usize> = (1..places.len()).filter(|&k| free[k] < free[0]).collect();
        ranks.sort_by(|&a, &b| free[a].total_cmp(&free[b]).then(a.cmp(&b)));
        ranks.truncate(SHOWN);
        if ranks.is_empty() {
            return Ok(());
        }
        let mut asked: Vec<DVec3> = ranks.iter().map(|&k| places[k]).collect();
        let triangle = |t: u32, to: DVec3| {
            self.state.triangles[t as usize].map(|u| if u == v { to } else { self.state.at.positions[u as usize] })
        };
        let mut shapes = Vec::new();
        for &k in &ranks {
            shapes.extend(star.iter().map(|&t| triangle(t, places[k])));
        }
        asked.extend(shapes.iter().map(|k| (k[0] + k[1] + k[2]) / 3.0));
        let (values, gradients) = self.sampler.gradients(&asked)?;
        let (n, m) = (ranks.len(), star.len());
        let agreement = |i: usize, j: usize| unit(shapes[i * m + j]).dot(gradients[n + i * m + j].normalize_or_zero());
        let off = |value: f64, gradient: DVec3| value.abs() / gradient.length().max(1e-9);
        let farthest = self.limit.max(off(self.state.at.values[v as usize], self.state.at.gradients[v as usize]));
        let before = free[0] + 0.5 * off(self.state.at.values[v as usize], self.state.at.gradients[v as usize]) / edge
            - star.iter().map(|&t| fold_cost(unit(triangle(t, here)).dot(expected(t)))).sum::<f64>()
            + star.iter().map(|&t| fold_cost(self.state.along[t as usize])).sum::<f64>();
        let cost = |i: usize| {
            let distance = off(values[i], gradients[i]);
            if distance > farthest {
                return f64::INFINITY;
            }
            let guess: f64 = (0..m).map(|j| fold_cost(unit(shapes[i * m + j]).dot(expected(star[j])))).sum();
            let seen: f64 = (0..m).map(|j| fold_cost(agreement(i, j))).sum();
            free[ranks[i]] - guess + seen + 0.5 * distance / edge
        };
        let (best, least) =
            (0..n).map(|i| (i, cost(i))).min_by(|a, b| a.1.total_cmp(&b.1)).unwrap_or((0, f64::INFINITY));
        if least >= before - 1e-6 {
            return Ok(());
        }
        let kept: Vec<(f64, DVec3)> =
            (0..m).map(|j| (agreement(best, j), gradients[n + best * m + j].normalize_or_zero())).collect();
        self.state.at.positions[v as usize] = places[ranks[best]];
        (self.state.at.values[v as usize], self.state.at.gradients[v as usize]) = (values[best], gradients[best]);
        for (j, &t) in star.iter().enumerate() {
            (self.state.along[t as usize], self.state.targets[t as usize]) = kept[j];
        }
        self.note(&star);
        Ok(())
    }

    /// Adds to `cost` the crossings of the triangles of a star with each other and with those near it, until it is above
    /// `bar`.
    fn star_cost(&self, positions: &[DVec3], star: &[u32], near: &[u32], edge: f64, cost: f64, bar: f64) -> f64 {
        let corners = |t: u32| self.state.triangles[t as usize].map(|v| positions[v as usize]);
        let pair = |s: u32, t: u32| {
            if meet(positions, self.state.triangles[s as usize], self.state.triangles[t as usize]) {
                1.0 + (overlap(corners(s), corners(t)) / edge).min(1.0)
            } else {
                0.0
            }
        };
        let mut cost = cost;
        for (i, &s) in star.iter().enumerate() {
            let bounds = Bounds::around(corners(s));
            for &t in &star[i + 1..] {
                cost += pair(s, t);
            }
            for &t in near {
                if self.index.bounds(t).meets(&bounds) {
                    cost += pair(s, t);
                    if cost > bar {
                        return cost;
                    }
                }
            }
        }
        cost
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

/// A small cost of slivers.
fn thinness(k: [DVec3; 3]) -> f64 {
    /// Twice the area over the longest edge squared from which a triangle costs nothing.
    const DECENT: f64 = 0.1;
    let longest = k[0].distance_squared(k[1]).max(k[1].distance_squared(k[2])).max(k[2].distance_squared(k[0]));
    let shape = (k[1] - k[0]).cross(k[2] - k[0]).length() / longest.max(1e-300);
    (DECENT - shape).max(0.0)
}

#[cfg(test)]
mod tests;
