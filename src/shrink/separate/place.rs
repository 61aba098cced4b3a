//! Moving one vertex to the best of some places.

use super::super::collide::{Bounds, meet, overlap};
use super::{Repair, fold_cost, unit, written};
use crate::settings::Canceled;
use glam::DVec3;

impl Repair<'_> {
    /// Moves one vertex to the best of some places around it.
    pub(super) fn place(&mut self, v: u32, earlier: &[&[DVec3]]) -> Result<(), Canceled> {
        /// Places shown to the field.
        const SHOWN: usize = 3;
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
        for _ in 0..self.tries {
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

/// A small cost of slivers.
fn thinness(k: [DVec3; 3]) -> f64 {
    /// Twice the area over the longest edge squared from which a triangle costs nothing.
    const DECENT: f64 = 0.1;
    let longest = k[0].distance_squared(k[1]).max(k[1].distance_squared(k[2])).max(k[2].distance_squared(k[0]));
    let shape = (k[1] - k[0]).cross(k[2] - k[0]).length() / longest.max(1e-300);
    (DECENT - shape).max(0.0)
}
