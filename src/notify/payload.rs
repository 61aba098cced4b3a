//! What is told: that a job has ended, how, and where it is.

use crate::job::{Job, JobId, JobKind, State};
use jiff::Timestamp;
use serde::Serialize;
use std::collections::BTreeMap;

/// A notice that a job has ended. It is thin: the job itself is read at `href`.
#[derive(Serialize, utoipa::ToSchema)]
pub struct Notice {
    /// `job.succeeded`, `job.failed` or `job.canceled`.
    #[serde(rename = "type")]
    kind: String,
    /// When the job ended.
    #[schema(value_type = String, format = DateTime)]
    timestamp: Timestamp,
    /// The job.
    data: NoticeOfJob,
}

/// The job of a [`Notice`].
#[derive(Serialize, utoipa::ToSchema)]
pub struct NoticeOfJob {
    /// Its name.
    id: JobId,
    /// What kind of work it is.
    kind: JobKind,
    /// How it ended.
    state: State,
    /// Names the client gave it.
    labels: BTreeMap<String, String>,
    /// Where it is, below `webhooks.base_url`.
    href: String,
}

impl Notice {
    /// Of a job that has ended.
    pub fn of(job: &Job, base_url: &str) -> Self {
        Self {
            kind: format!("job.{}", job.state.name()),
            timestamp: job.finished_at.unwrap_or(job.created_at),
            data: NoticeOfJob {
                id: job.id,
                kind: job.kind,
                state: job.state,
                labels: job.labels.clone(),
                href: format!("{}/v1/jobs/{}", base_url.trim_end_matches('/'), job.id),
            },
        }
    }
}

/// The header `webhook-id`: one job, one end, one id.
pub fn message_id(job: JobId) -> String {
    format!("job_{job}")
}
