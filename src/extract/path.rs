//! Along a path of fields, such as that of one network through its latent codes: a surface for every stop, each made from the one
//! before, all with the same triangles and texture coordinates.
//!
//! Where a warm start does not pass its certificate the way is halved, and the field in the middle of it is wrapped first, up to
//! [`HALVINGS`] times. Where that does not help the surface is made from nothing; its lattice then lies anew, which the report
//! of that stop says, and the path goes on from there.

use super::{Budget, Extracted, Told, extract, relaid, warmed};
use crate::field::sampler::Tally;
use crate::field::{Field, Sampler};
use crate::measure::moved::moved;
use crate::measure::report::{Evaluations, Report, WarmStart};
use crate::settings::{Progress, Settings};
use crate::shrink::warm::Earlier;
use crate::shrink::{ShrinkError, ShrinkSpec};
use crate::surface::Surface;
use std::cell::Cell;
use std::sync::atomic::AtomicU32;

/// How often the way from one stop to the next is halved at most.
pub const HALVINGS: u32 = 4;

/// Surfaces that are made between two stops at most by warm starts: what takes more costs more than beginning anew.
const MOST: u32 = 12;

/// Opens the field of a code.
pub type Open<'p, E> = dyn Fn(&[f32]) -> Result<Box<dyn Field>, E> + 'p;

/// What a path is followed with.
pub struct Path<'p, E> {
    /// Opens the field of a code.
    pub open: &'p Open<'p, E>,
    /// How every surface is made; without a weight, and without relaxed charts.
    pub spec: &'p ShrinkSpec,
    /// What may be spent on a surface that is made from nothing.
    pub budget: Budget,
    /// Whether every surface is made from nothing, with triangles of its own, to see what the others gain.
    pub cold: bool,
    /// What it runs with.
    pub settings: Settings<'p>,
}

/// A stop on a path.
pub struct Stop {
    /// Its surface.
    pub surface: Surface,
    /// Its report. The evaluations are all that were made on the way from the stop before, and `attempts` counts all surfaces
    /// on it; `warm_start` tells how far vertices are from that stop, and on the first one there is none.
    pub report: Report,
    /// Fields between the stop before and this one whose surfaces were made on the way.
    pub between: u32,
}

/// Why a path ends early.
#[derive(Debug)]
pub enum PathError<E> {
    /// The field of a code could not be opened.
    Field(E),
    /// There is no surface.
    Shrink(ShrinkError),
}

impl<E, S: Into<ShrinkError>> From<S> for PathError<E> {
    fn from(error: S) -> Self {
        Self::Shrink(error.into())
    }
}

/// A way that was gone by warm starts.
struct Way {
    surface: Surface,
    report: Report,
    between: u32,
}

/// What is spent between two stops.
struct Leg<'s> {
    settings: Settings<'s>,
    tally: Tally,
    /// Surfaces that were made, whether they passed or not.
    made: Cell<u32>,
}

impl Leg<'_> {
    fn count(&self, surfaces: u32) {
        self.made.set(self.made.get() + surfaces);
    }
}

impl<E> Path<'_, E> {
    /// Goes to every code in order, and hands over each stop as it comes: to `arrive`, with its index.
    ///
    /// # Errors
    /// The index of the stop that could not be made, and why. A surface that did not pass its certificate is a stop all the same.
    pub fn follow(
        &self,
        codes: &[Vec<f32>],
        arrive: &mut dyn FnMut(usize, &Stop),
    ) -> Result<(), (usize, PathError<E>)> {
        let told = Told { settings: self.settings, fraction: AtomicU32::new(0) };
        let share = |i: usize| i as f32 / codes.len() as f32;
        let mut before: Option<Earlier> = None;
        for (i, code) in codes.iter().enumerate() {
            let progress = |progress: Progress| told.tell(0, share(i), share(i + 1), progress);
            let settings = Settings { progress: &progress, ..self.settings };
            let leg = Leg { settings, tally: Tally::new(), made: Cell::new(0) };
            let from = i.checked_sub(1).map(|i| codes[i].as_slice()).zip(before.as_ref());
            let stop = self.stop(from, code, &leg).map_err(|error| (i, error))?;
            arrive(i, &stop);
            before = Some(stop.surface.earlier());
        }
        Ok(())
    }

    /// The stop at a code, from the code and the surface before it, if there is one.
    fn stop(&self, from: Option<(&[f32], &Earlier)>, to: &[f32], leg: &Leg<'_>) -> Result<Stop, PathError<E>> {
        let warm = match from.filter(|_| !self.cold) {
            Some((code, earlier)) => self.go(code, to, earlier, HALVINGS, leg)?,
            None => None,
        };
        let used = warm.is_some();
        let earlier = from.map(|(_, earlier)| earlier);
        let Way { surface, mut report, between } = match warm {
            Some(way) => way,
            None => self.begin_anew(earlier, to, leg)?,
        };
        report.evaluations = Evaluations::new(&leg.tally.by_stage(), report.vertices);
        report.attempts = leg.made.get();
        report.warm_start = match earlier {
            None => None,
            Some(earlier) => {
                let moved = moved(&earlier.positions, &surface, &leg.settings)?;
                Some(WarmStart { used, reason: None, moved })
            }
        };
        Ok(Stop { surface, report, between })
    }

    /// Goes from one code to another by warm starts, through the middle where it must. `None` when that did not pass.
    fn go(
        &self,
        from: &[f32],
        to: &[f32],
        earlier: &Earlier,
        halvings: u32,
        leg: &Leg<'_>,
    ) -> Result<Option<Way>, PathError<E>> {
        let field = (self.open)(to).map_err(PathError::Field)?;
        let sampler = Sampler::new(field.as_ref(), leg.settings, &leg.tally);
        let passed = warmed(&sampler, self.spec, earlier)?;
        leg.count(1);
        if let Ok((surface, report)) = passed {
            return Ok(Some(Way { surface, report, between: 0 }));
        }
        if halvings == 0 || leg.made.get() >= MOST {
            return Ok(None);
        }
        let middle: Vec<f32> = from.iter().zip(to).map(|(a, b)| 0.5 * (a + b)).collect();
        let Some(half) = self.go(from, &middle, earlier, halvings - 1, leg)? else { return Ok(None) };
        let rest = self.go(&middle, to, &half.surface.earlier(), halvings - 1, leg)?;
        Ok(rest.map(|rest| Way { between: half.between + 1 + rest.between, ..rest }))
    }

    /// Makes the surface of a code from nothing, with the triangles of the `earlier` one.
    fn begin_anew(&self, earlier: Option<&Earlier>, to: &[f32], leg: &Leg<'_>) -> Result<Way, PathError<E>> {
        let field = (self.open)(to).map_err(PathError::Field)?;
        let sampler = Sampler::new(field.as_ref(), leg.settings, &leg.tally);
        let Extracted { surface, report, .. } = extract(&sampler, self.spec, None, self.budget, None, &|_| {})?;
        leg.count(report.attempts);
        if let Some(earlier) = earlier.filter(|_| !self.cold) {
            let (surface, report) = relaid(&sampler, self.spec, &surface, &earlier.diagonals)?;
            return Ok(Way { surface, report, between: 0 });
        }
        Ok(Way { surface, report, between: 0 })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::field::scene::Scene;
    use crate::measure::fixtures::with_settings;
    use crate::shrink::lattice::LatticeSpec;
    use serde_json::json;

    /// An ellipsoid by its radii and its place along x.
    fn open(code: &[f32]) -> Result<Box<dyn Field>, String> {
        let [a, b, c, x] = code[..] else { return Err(format!("{} numbers", code.len())) };
        let scene = json!({"translate": {"by": [x, 0, 0], "of": {"ellipsoid": {"radii": [a, b, c]}}}});
        Scene::from_value(&scene).map(|scene| Box::new(scene) as Box<dyn Field>).map_err(|e| e.to_string())
    }

    fn follow(codes: &[[f32; 4]], cold: bool) -> Result<Vec<Stop>, (usize, PathError<String>)> {
        with_settings(2, |settings| {
            let spec = ShrinkSpec { lattice: LatticeSpec::Octahedral { n: 24 }, ..ShrinkSpec::default() };
            let path = Path { open: &open, spec: &spec, budget: Budget::default(), cold, settings: *settings };
            let codes: Vec<Vec<f32>> = codes.iter().map(|code| code.to_vec()).collect();
            let mut stops = Vec::new();
            let mut arrive = |i: usize, stop: &Stop| {
                assert_eq!(i, stops.len());
                stops.push(Stop { surface: stop.surface.clone(), report: stop.report.clone(), between: stop.between });
            };
            path.follow(&codes, &mut arrive)?;
            Ok(stops)
        })
    }

    fn used(stop: &Stop) -> Option<bool> {
        stop.report.warm_start.as_ref().map(|warm_start| warm_start.used)
    }

    #[test]
    fn stops_share_their_triangles_and_cost_less_than_the_first() {
        let stops = follow(&[[0.6, 0.5, 0.4, 0.0], [0.62, 0.48, 0.4, 0.02], [0.64, 0.46, 0.41, 0.04]], false);
        let stops = stops.unwrap_or_else(|(i, e)| panic!("stop {i}: {e:?}"));
        assert_eq!(stops.iter().map(used).collect::<Vec<_>>(), [None, Some(true), Some(true)]);
        for stop in &stops {
            assert!(stop.report.verdict.passed && stop.surface.triangles == stops[0].surface.triangles);
        }
        let cost = |stop: &Stop| stop.report.evaluations.per_vertex;
        assert!(stops[1..].iter().all(|stop| cost(stop) < 0.5 * cost(&stops[0])));
    }

    #[test]
    fn a_way_too_far_for_one_step_is_gone_through_its_middle() {
        // ever farther, until one step is too far
        let far = |x: f32| follow(&[[0.2, 0.2, 0.2, -0.7], [0.2, 0.2, 0.2, x]], false);
        let halved = [-0.5, -0.3, 0.0, 0.4, 0.7].into_iter().find_map(|x| {
            let stops = far(x).unwrap_or_else(|(i, e)| panic!("stop {i}: {e:?}"));
            (stops[1].between > 0).then_some(stops)
        });
        let stops = halved.expect("a step of seven radii is too far");
        assert_eq!(used(&stops[1]), Some(true));
        assert!(stops[1].report.verdict.passed && stops[1].report.attempts > stops[1].between);
    }

    #[test]
    fn every_stop_is_made_from_nothing_where_that_is_asked_for() {
        let codes = [[0.6, 0.5, 0.4, 0.0], [0.62, 0.48, 0.4, 0.02]];
        let stops = follow(&codes, true).unwrap_or_else(|(i, e)| panic!("stop {i}: {e:?}"));
        assert_eq!(stops.iter().map(used).collect::<Vec<_>>(), [None, Some(false)]);
        assert!(stops[1].report.evaluations.by_stage.contains_key("contract"));
    }

    #[test]
    fn a_code_without_a_field_or_a_surface_ends_the_path_by_its_index() {
        let Err((1, PathError::Field(_))) = follow(&[[0.6, 0.5, 0.4, 0.0], [-0.6, 0.5, 0.4, 0.0]], false) else {
            panic!("a negative radius")
        };
        let Err((1, PathError::Shrink(ShrinkError::Empty { .. }))) =
            follow(&[[0.2, 0.2, 0.2, 0.0], [0.2, 0.2, 0.2, 9.0]], false)
        else {
            panic!("a ball outside the domain")
        };
    }
}
