//! What the numeric rooms are given instead of globals: a thread pool, a cancel token and a progress sink.
//!
//! Nothing in `field`, `shrink`, `surface` or `measure` reads a clock, an environment variable or a global pool, so the
//! same input gives the same bits for any number of threads.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

/// A flag that a caller raises to stop a computation; cloned handles share it.
#[derive(Clone, Debug, Default)]
pub struct CancelToken(Arc<AtomicBool>);

impl CancelToken {
    /// A token that is not raised.
    pub fn new() -> Self {
        Self::default()
    }
    /// Raises the flag. It cannot be lowered.
    pub fn cancel(&self) {
        self.0.store(true, Ordering::Relaxed);
    }
    /// Whether the flag is up.
    pub fn is_canceled(&self) -> bool {
        self.0.load(Ordering::Relaxed)
    }
    /// `Err(Canceled)` when the flag is up; called in every loop that can last longer than a few milliseconds.
    pub fn check(&self) -> Result<(), Canceled> {
        if self.is_canceled() { Err(Canceled) } else { Ok(()) }
    }
}

/// The computation was stopped by its [`CancelToken`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("canceled")]
pub struct Canceled;

/// The front while it shrinks, in scene units.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Front {
    /// Vertex positions in scene units.
    pub positions: Vec<[f32; 3]>,
    /// Counter-clockwise outward triangles, indices into `positions`.
    pub triangles: Vec<[u32; 3]>,
    /// Place of every vertex on the unit sphere; empty as long as the map onto it is not made.
    pub places: Vec<[f32; 3]>,
}

/// One report of how far a computation has come.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Progress {
    /// Name of the stage, one of the method's stage names (`contract`, `remesh`, `map`, `resample`, `untangle`, …).
    pub stage: &'static str,
    /// Number of the attempt at the surface, from 1; 0 where attempts are not told apart.
    pub attempt: u32,
    /// Iteration within the stage, from 0.
    pub iteration: u32,
    /// Iterations the stage will have, when it is known; otherwise 0.
    pub iterations: u32,
    /// Share of the whole computation done, from 0 to 1, never falling.
    pub fraction: f32,
    /// Energy per unit area of the stage's objective, where the stage has one.
    pub energy: Option<f64>,
    /// Largest distance from the front to the zero level set that is known, in scene units.
    pub max_distance: Option<f64>,
    /// Triangles now folded over.
    pub flips: Option<u64>,
    /// The front itself, sent a few times a second at most.
    pub front: Option<Front>,
}

/// What a computation runs with.
#[derive(Clone, Copy)]
pub struct Settings<'a> {
    /// The pool that parallel loops run on.
    pub pool: &'a rayon::ThreadPool,
    /// Raised when the result is no longer wanted.
    pub cancel: &'a CancelToken,
    /// Called with progress, from the thread that runs the computation.
    pub progress: &'a (dyn Fn(Progress) + Sync),
    /// Whether somebody looks at fronts, also at those that take time to make. It changes no result.
    pub watched: bool,
}
