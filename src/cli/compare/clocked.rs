//! A field with a stop watch: how long anything was being evaluated, by the clock on the wall.

use crate::field::mesh::TriangleMesh;
use crate::field::{Domain, Field, Gradients, Metric, Points};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

/// The watch. It runs while at least one thread is in the field and nobody has paused it.
#[derive(Debug, Default)]
pub struct Watch(Mutex<State>);

#[derive(Debug, Default)]
struct State {
    paused: bool,
    inside: u32,
    since: Option<Instant>,
    total: Duration,
}

impl Watch {
    fn with<R>(&self, change: impl FnOnce(&mut State) -> R) -> R {
        change(&mut self.0.lock().unwrap_or_else(|e| e.into_inner()))
    }
    fn enter(&self) {
        self.with(|state| {
            if state.inside == 0 && !state.paused {
                state.since = Some(Instant::now());
            }
            state.inside += 1;
        });
    }
    fn leave(&self) {
        self.with(|state| {
            state.inside -= 1;
            if state.inside == 0
                && let Some(since) = state.since.take()
            {
                state.total += since.elapsed();
            }
        });
    }
    /// Whether what comes is counted; to be called while nothing is being evaluated.
    pub fn pause(&self, paused: bool) {
        self.with(|state| state.paused = paused);
    }
    /// Starts anew from 0.
    pub fn reset(&self) {
        self.with(|state| state.total = Duration::ZERO);
    }
    /// Seconds so far.
    pub fn seconds(&self) -> f64 {
        self.with(|state| state.total.as_secs_f64())
    }
}

/// A field whose evaluations a [`Watch`] sees.
pub struct Clocked {
    field: Box<dyn Field>,
    watch: Arc<Watch>,
}

impl Clocked {
    /// Puts the watch on a field.
    pub fn new(field: Box<dyn Field>, watch: Arc<Watch>) -> Self {
        Self { field, watch }
    }
}

impl Field for Clocked {
    fn domain(&self) -> Domain {
        self.field.domain()
    }
    fn metric(&self) -> Metric {
        self.field.metric()
    }
    fn lipschitz(&self) -> Option<f32> {
        self.field.lipschitz()
    }
    fn dimension(&self) -> u8 {
        self.field.dimension()
    }
    fn values(&self, points: Points<'_>, values: &mut [f32]) {
        self.watch.enter();
        self.field.values(points, values);
        self.watch.leave();
    }
    fn gradients(&self, points: Points<'_>, values: &mut [f32], gradients: Gradients<'_>) {
        self.watch.enter();
        self.field.gradients(points, values, gradients);
        self.watch.leave();
    }
    fn truth(&self) -> Option<&TriangleMesh> {
        self.field.truth()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn two_threads_in_the_field_at_once_count_once_and_a_pause_counts_nothing() {
        let watch = Watch::default();
        let nap = Duration::from_millis(20);
        watch.enter();
        watch.enter();
        std::thread::sleep(nap);
        watch.leave();
        assert_eq!(watch.seconds(), 0.0, "still one inside");
        watch.leave();
        let one = watch.seconds();
        assert!(one >= nap.as_secs_f64());
        watch.pause(true);
        watch.enter();
        std::thread::sleep(nap);
        watch.leave();
        assert_eq!(watch.seconds(), one);
        watch.reset();
        assert_eq!(watch.seconds(), 0.0);
    }
}
