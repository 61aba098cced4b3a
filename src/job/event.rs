//! What happened to a job, in order: the events that clients follow.
//!
//! Every event has the job's own sequence number, from 1, the same on every node and after every restart. A `snapshot` is
//! not stored: it is made from the record when a reader starts (or comes back too late), and its number is that of the
//! newest event it includes.

use jiff::Timestamp;
use serde::{Deserialize, Serialize};

/// What an event tells.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum EventKind {
    /// The whole job as it is.
    Snapshot,
    /// The state changed: `{state, attempt}`.
    State,
    /// The computation came further: a progress object.
    Progress,
    /// The front as it is now, coarse and quantized: a [`MeshPreview`](super::preview::MeshPreview).
    Mesh,
    /// The job ended: the whole job. Always the last event.
    Done,
}

impl EventKind {
    /// The name in JSON, in the database and in the stream's `event:` field.
    pub fn name(self) -> &'static str {
        match self {
            EventKind::Snapshot => "snapshot",
            EventKind::State => "state",
            EventKind::Progress => "progress",
            EventKind::Mesh => "mesh",
            EventKind::Done => "done",
        }
    }
    /// The kind of that name.
    pub fn from_name(name: &str) -> Option<Self> {
        [Self::Snapshot, Self::State, Self::Progress, Self::Mesh, Self::Done].into_iter().find(|k| k.name() == name)
    }
}

/// One event of a job.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct Event {
    /// The job's own sequence number, from 1.
    pub seq: u64,
    /// What it tells.
    #[serde(rename = "type")]
    pub kind: EventKind,
    /// When it happened.
    #[schema(value_type = String, format = DateTime)]
    pub at: Timestamp,
    /// The body; its shape follows from the kind.
    pub data: serde_json::Value,
}
