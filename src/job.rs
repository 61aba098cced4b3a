//! What is asked of the service and what becomes of it: the request ([`JobSpec`]), the record ([`Job`]), its [`State`]s and
//! [`Event`]s, and the worker that runs it on the rayon pool.
//!
//! Guarantees: a request that was accepted can be read back and run by any later process; a record's `revision` grows with
//! every change. This room may read the clock; the numeric rooms below it may not.

pub mod collector;
pub mod event;
pub mod failure;
pub mod memory;
pub mod pipeline;
pub mod preview;
pub mod priority;
pub mod spec;
pub mod worker;

pub use event::{Event, EventKind};
pub use failure::Failure;
pub use spec::{JobSpec, OutputName};

use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use uuid::Uuid;

/// Name of a job: a UUID of version 7, so that names sort by the time of creation.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(transparent)]
#[schema(value_type = Uuid)]
pub struct JobId(pub Uuid);

impl JobId {
    /// A new name, larger than every name this process has made before.
    pub fn new() -> Self {
        Self(Uuid::now_v7())
    }
}

impl Default for JobId {
    fn default() -> Self {
        Self::new()
    }
}

impl std::fmt::Display for JobId {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        self.0.fmt(f)
    }
}

impl std::str::FromStr for JobId {
    type Err = uuid::Error;
    fn from_str(s: &str) -> Result<Self, uuid::Error> {
        s.parse().map(Self)
    }
}

/// What kind of work a job is.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum JobKind {
    /// Shrink a sphere onto a field.
    #[default]
    Shrink,
    /// Fit a network to meshes.
    Fit,
    /// Carry a gradient of a surface's vertices back to its network.
    Sensitivity,
}

impl JobKind {
    /// All of them.
    pub const ALL: [JobKind; 3] = [JobKind::Shrink, JobKind::Fit, JobKind::Sensitivity];

    /// The name in JSON and in the database.
    pub fn name(self) -> &'static str {
        match self {
            JobKind::Shrink => "shrink",
            JobKind::Fit => "fit",
            JobKind::Sensitivity => "sensitivity",
        }
    }
    /// The kind of that name.
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|kind| kind.name() == name)
    }
}

/// Where a job is in its life: `queued -> running -> (canceling) -> succeeded | failed | canceled`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum State {
    /// Accepted, waiting for a worker; also after its worker was lost.
    Queued,
    /// A worker has it.
    Running,
    /// A worker has it and was asked to stop.
    Canceling,
    /// Ended with its outputs.
    Succeeded,
    /// Ended with a problem.
    Failed,
    /// Ended because it was asked to.
    Canceled,
}

impl State {
    /// All of them, in the order of a life.
    pub const ALL: [State; 6] =
        [State::Queued, State::Running, State::Canceling, State::Succeeded, State::Failed, State::Canceled];

    /// Whether nothing more will happen.
    pub fn ended(self) -> bool {
        matches!(self, State::Succeeded | State::Failed | State::Canceled)
    }
    /// The name in JSON and in the database.
    pub fn name(self) -> &'static str {
        match self {
            State::Queued => "queued",
            State::Running => "running",
            State::Canceling => "canceling",
            State::Succeeded => "succeeded",
            State::Failed => "failed",
            State::Canceled => "canceled",
        }
    }
    /// The state of that name.
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|s| s.name() == name)
    }
}

/// How far a running job has come.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(default)]
pub struct ProgressView {
    /// Name of the stage: `topology`, then in every attempt `contract`, `remesh`, `map`, `resample`, `untangle`, `slide`, `sharpen`,
    /// `separate` and `measure`, then `relax` (with `relax_uv`) and `write`; the method `paper` has `shrink` before `measure`, and a
    /// warm start has `warm` in place of the stages up to `resample`. A fit has `sample`, `train` and `measure`.
    pub stage: String,
    /// Number of the attempt at the surface, from 1 (not of the worker's, which the job counts); 0 before the first.
    pub attempt: u32,
    /// Iteration within the stage, from 0.
    pub iteration: u32,
    /// Iterations of the stage; 0 when it is not known.
    pub iterations: u32,
    /// Share of the job done, from 0 to 1.
    pub fraction: f32,
    /// Energy per unit area of the stage's objective; of a fit the mean of the loss in this epoch.
    pub energy: Option<f64>,
    /// Largest known distance from the front to the zero level set, scene units.
    pub max_distance: Option<f64>,
    /// Triangles now folded over.
    pub flips: Option<u64>,
    /// Seconds the rest may take, judged from the time so far.
    pub eta_s: Option<f64>,
}

/// One finished output of a job.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct Output {
    /// Its name: `glb`, `surface`, `svg`, `preview`, `network`, `sensitivity` or `report`.
    pub name: String,
    /// Where it is downloaded.
    pub href: String,
    /// Its media type.
    pub media_type: String,
    /// Its size in bytes.
    pub bytes: u64,
    /// SHA-256 of its bytes, lower-case hexadecimal; also its strong `ETag`.
    pub sha256: String,
    /// Whether the surface in it passed every check of its verdict (in the report). One that did not is kept for looking at. Of
    /// a fit: whether every mesh has a zero level set in the network.
    #[serde(default)]
    pub certified: bool,
}

/// What is measured about a job's result, by its kind.
#[derive(Serialize, utoipa::ToSchema)]
#[serde(untagged)]
pub enum Metrics {
    /// Of a surface or a curve.
    Shrink(crate::measure::AnyReport),
    /// Of a network.
    Fit(crate::fit::FitReport),
    /// Of derivatives.
    Sensitivity(pipeline::SensitivityReport),
}

/// A job's record: what clients see.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct Job {
    /// Its name.
    pub id: JobId,
    /// What kind of work it is.
    pub kind: JobKind,
    /// Where it is in its life.
    pub state: State,
    /// How often a worker has taken it up; 0 before the first.
    pub attempt: u32,
    /// Grows with every change of the record.
    pub revision: u64,
    /// When it was accepted.
    #[schema(value_type = String, format = DateTime)]
    pub created_at: Timestamp,
    /// When a worker first took it up.
    #[schema(value_type = Option<String>, format = DateTime)]
    pub started_at: Option<Timestamp>,
    /// When it ended.
    #[schema(value_type = Option<String>, format = DateTime)]
    pub finished_at: Option<Timestamp>,
    /// Names the client gave it.
    pub labels: BTreeMap<String, String>,
    /// How it is shrunk, where the kind is `shrink`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub shrink: Option<crate::shrink::ShrinkSpec>,
    /// How it is fitted, where the kind is `fit`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub fit: Option<crate::fit::FitSpec>,
    /// The job whose surface is differentiated, where the kind is `sensitivity`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub of: Option<JobId>,
    /// How far it has come, once it runs.
    pub progress: Option<ProgressView>,
    /// Seconds the rest may take.
    pub eta_s: Option<f64>,
    /// What was measured about the result: the same object as the output `report`. A job that failed with `not_certified`
    /// has it too, about the best surface that was made. A fit and a sensitivity have reports of their own.
    // kept as a value, so that records of another version can still be shown
    #[schema(value_type = Option<Metrics>)]
    pub metrics: Option<serde_json::Value>,
    /// What it made. A job that failed because no surface passed keeps the best one, marked as not certified.
    pub outputs: Vec<Output>,
    /// Why it failed.
    pub problem: Option<Failure>,
}
