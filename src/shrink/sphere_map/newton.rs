//! The second-order finish: truncated Newton steps of the whole map at once, with conjugate gradients inside (Nocedal and
//! Wright 2006, "Numerical optimization", algorithm 7.1), on the product of unit spheres.
//!
//! Vertex sweeps take rough errors away and leave smooth ones; a Newton step sees the whole map and takes both. The energy
//! is infinite where a triangle is not positive, so the line search keeps the bijection. A single triangle that a step would
//! turn over must not hold a whole limb back: it is made stiffer and the step is asked for again.

use super::super::energy::{Objective, tangents};
use super::level::Level;
use super::system::{System, Triangle};
use crate::settings::{Canceled, Progress, Settings};
use glam::{DVec2, DVec3};
use std::f64::consts::PI;

/// When to stop a descent.
#[derive(Clone, Copy, Debug)]
pub struct Effort {
    /// Newton steps at most.
    pub steps: usize,
    /// Products with the Hessian in each, at most, while steps are far from what they promise.
    pub products: usize,
    /// Share of the energy that may be left to gain.
    pub tolerance: f64,
}

/// How a descent went.
#[derive(Clone, Copy, Debug, Default)]
pub struct Descent {
    /// Newton steps taken.
    pub steps: usize,
    /// Products with the Hessian.
    pub products: usize,
    /// Energy at the end.
    pub energy: f64,
    /// Half the last step's slope over the energy: about the share of the energy that was still to be gained.
    pub decrement: f64,
}

/// A triangle keeps at least this share of its determinant in a step.
const KEPT: f64 = 0.1;
/// Vertex steps go on around vertices that gained more than this share of a vertex's energy.
const NOTABLE: f64 = 0.01;

/// Takes Newton steps until the energy that is left to gain is small, each followed by a sweep of vertex steps. The energy
/// never rises.
pub fn descend(
    level: &Level,
    places: &mut Vec<DVec3>,
    objective: &Objective,
    effort: Effort,
    settings: &Settings<'_>,
) -> Result<Descent, Canceled> {
    /// A step that gains this share of what it promises deserves to be known better: the next may take twice the products.
    const KEPT_PROMISE: f64 = 0.5;
    /// Products at most, for one of `effort`.
    const MOST: usize = 4;
    let mut descent = Descent { energy: level.energy(places, objective, settings), ..Descent::default() };
    let mut products = effort.products;
    for _ in 0..effort.steps {
        settings.cancel.check()?;
        let step = Step::new(level, places, objective, products, settings)?;
        descent.products += step.products;
        descent.decrement = -0.5 * step.slope / descent.energy;
        if step.slope.is_nan() || step.slope >= 0.0 || descent.decrement < effort.tolerance {
            break;
        }
        let Some((to, energy)) = step.search(descent.energy) else {
            break;
        };
        let kept = descent.energy - energy > KEPT_PROMISE * -0.5 * step.slope;
        products = if kept { (2 * products).min(MOST * effort.products) } else { effort.products };
        *places = to;
        descent.energy = energy;
        descent.steps += 1;
        // a step may leave single triangles nearly flat, and only vertex steps see them
        let notable = NOTABLE * energy / level.len() as f64;
        descent.energy -= level.sweep(places, objective, notable, settings)?;
        (settings.progress)(Progress {
            stage: "map",
            iteration: descent.steps as u32,
            energy: Some(descent.energy / (4.0 * PI)),
            ..Progress::default()
        });
    }
    Ok(descent)
}

/// A direction of descent of the whole map.
struct Step<'a> {
    level: &'a Level,
    places: &'a [DVec3],
    objective: &'a Objective,
    settings: &'a Settings<'a>,
    frames: Vec<[DVec3; 2]>,
    /// Determinant of every triangle before.
    before: Vec<f64>,
    direction: Vec<DVec2>,
    /// Slope of the energy along the direction.
    slope: f64,
    /// Products with the Hessian it took.
    products: usize,
}

impl<'a> Step<'a> {
    /// The Newton direction. Triangles that the full step would all but flatten are made stiffer, and the direction is brought to
    /// what that changes: their neighbours give way, and what is far from them moves as it would.
    fn new(
        level: &'a Level,
        places: &'a [DVec3],
        objective: &'a Objective,
        products: usize,
        settings: &'a Settings<'a>,
    ) -> Result<Self, Canceled> {
        /// Rounds of stiffening.
        const ROUNDS: usize = 2;
        /// How much stiffer, over the share of the step that the triangle could take.
        const STIFFER: f64 = 8.0;
        /// The largest such factor.
        const STIFFEST: f64 = 1000.0;
        let count = level.triangles.len();
        let frames: Vec<[DVec3; 2]> = level.map(level.len(), settings, |v| tangents(places[v]).into());
        let mut triangles = level.map(count, settings, |t| {
            Triangle::new(level.triangles[t].map(|v| v as usize), places, &frames, &level.shapes[t], objective)
        });
        let mut system = System::new(level, &triangles, settings);
        let (direction, used) = system.solve(level, products, None, settings)?;
        let before = level.map(count, settings, |t| determinant(level, places, t));
        let mut step =
            Self { level, places, objective, settings, frames, before, direction, slope: 0.0, products: used };
        for _ in 0..ROUNDS {
            let shares = level.map(count, settings, |t| step.share(t));
            let mut flat = shares.into_iter().enumerate().filter(|(_, share)| *share < 1.0).peekable();
            if flat.peek().is_none() {
                break;
            }
            flat.for_each(|(t, share)| triangles[t].stiffen((STIFFER / share).min(STIFFEST)));
            system = System::new(level, &triangles, settings);
            let start = std::mem::take(&mut step.direction);
            let (direction, used) = system.solve(level, products, Some(start), settings)?;
            step.direction = direction;
            step.products += used;
        }
        step.slope = level.sum(level.len(), settings, |v| system.gradients[v].dot(step.direction[v]));
        Ok(step)
    }

    /// Where a share of the step takes a vertex.
    fn place(&self, v: usize, share: f64) -> DVec3 {
        let ([e1, e2], along) = (self.frames[v], share * self.direction[v]);
        (self.places[v] + along.x * e1 + along.y * e2).normalize_or_zero()
    }

    /// The share of the step that a triangle can take, halved from the full one.
    fn share(&self, t: usize) -> f64 {
        /// The least that is told apart.
        const LEAST: f64 = 1e-4;
        let mut share = 1.0;
        while share > LEAST {
            let [a, b, c] = self.level.triangles[t].map(|v| self.place(v as usize, share));
            if a.dot(b.cross(c)) >= KEPT * self.before[t] {
                break;
            }
            share *= 0.5;
        }
        share
    }

    /// Where the step leads and the energy there, `energy` being that before: the full step, longer ones while they are better,
    /// or shorter ones. Before the energy of these is asked, vertices of triangles that they would all but flatten take half
    /// of them, again and again.
    fn search(&self, energy: f64) -> Option<(Vec<DVec3>, f64)> {
        /// Rounds of local halving.
        const ROUNDS: usize = 8;
        /// Steps at most, each half of the one before.
        const SHORTER: usize = 10;
        /// Steps at most, each twice the one before.
        const LONGER: usize = 4;
        let Self { level, objective, settings, .. } = *self;
        let mut shares = vec![1.0f64; level.len()];
        for trial in 0..SHORTER {
            let mut to = level.map(level.len(), settings, |v| self.place(v, shares[v]));
            let mut whole = trial == 0;
            for _ in 0..ROUNDS {
                let kept =
                    level.map(level.triangles.len(), settings, |t| determinant(level, &to, t) >= KEPT * self.before[t]);
                let flat = (0..kept.len()).filter(|&t| !kept[t]);
                let mut squeezed: Vec<u32> = flat.flat_map(|t| level.triangles[t]).collect();
                if squeezed.is_empty() {
                    break;
                }
                whole = false;
                squeezed.sort_unstable();
                squeezed.dedup();
                for v in squeezed {
                    shares[v as usize] *= 0.5;
                    to[v as usize] = self.place(v as usize, shares[v as usize]);
                }
            }
            let mut best = (level.energy(&to, objective, settings), to);
            if best.0 < energy {
                // the Hessian is made positive, which makes it stiffer than the energy is
                for doubled in 1..=if whole { LONGER } else { 0 } {
                    let to = level.map(level.len(), settings, |v| self.place(v, f64::from(1 << doubled)));
                    let after = level.energy(&to, objective, settings);
                    if after.is_nan() || after >= best.0 {
                        break;
                    }
                    best = (after, to);
                }
                return Some((best.1, best.0));
            }
            shares.iter_mut().for_each(|share| *share *= 0.5);
        }
        None
    }
}

fn determinant(level: &Level, places: &[DVec3], t: usize) -> f64 {
    let [a, b, c] = level.triangles[t].map(|v| places[v as usize]);
    a.dot(b.cross(c))
}

#[cfg(test)]
mod tests {
    use super::super::tests::{ISOMETRIC, bad, limb, map};
    use super::*;
    use crate::measure::fixtures::with_settings;

    #[test]
    fn triangles_that_a_step_would_turn_over_are_made_stiffer() {
        const PRODUCTS: usize = 200;
        let mesh = limb(40, 30, 8.0);
        with_settings(1, |settings| {
            let (level, _) = bad(&mesh, settings);
            // a good map, drawn together at the limb's tip
            let (good, _) = map(&mesh, ISOMETRIC, 1);
            let mut places: Vec<DVec3> = good.iter().map(|d| (*d + 0.95 * DVec3::Z).normalize()).collect();
            let (mut plain, mut stiffened) = (0, 0);
            for _ in 0..8 {
                let mut step = Step::new(&level, &places, &ISOMETRIC, PRODUCTS, settings).unwrap();
                let flat = |step: &Step<'_>| (0..level.triangles.len()).filter(|&t| step.share(t) < 1.0).count();
                stiffened += flat(&step);
                let (to, _) = step.search(level.energy(&places, &ISOMETRIC, settings)).expect("a better map");
                let triangle = |t: usize| {
                    let corners = level.triangles[t].map(|v| v as usize);
                    Triangle::new(corners, &places, &step.frames, &level.shapes[t], &ISOMETRIC)
                };
                let triangles: Vec<Triangle> = (0..level.triangles.len()).map(triangle).collect();
                let system = System::new(&level, &triangles, settings);
                step.direction = system.solve(&level, PRODUCTS, None, settings).unwrap().0;
                plain += flat(&step);
                places = to;
            }
            assert!(plain > 0 && 2 * stiffened < plain, "{stiffened} of {plain}");
        });
    }
}
