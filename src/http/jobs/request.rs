//! The request of a job: how it may be sent, and what was understood of one that was.

use super::{App, Problem, job_id, query};
use crate::auth::{Caller, Scope};
use crate::job::spec::{FieldSpec, WebhookSpec};
use crate::job::{JobId, JobSpec};
use axum::Json;
use axum::extract::{Path, RawQuery, State};
use serde::Serialize;

/// Reads a job's request
///
/// What was asked for, with every default written out: sent to `/v1/jobs` again it makes the same job anew.
#[utoipa::path(
    get,
    path = "/v1/jobs/{id}/request",
    operation_id = "request",
    tag = "jobs",
    params(("id" = String, Path, description = "the job")),
    responses(
        (status = 200, description = "the request", body = JobRequest),
        (status = 400, description = "a query parameter is unknown"),
        (status = 404, description = "there is no such job, or it was not asked for at `/v1/jobs`: a sensitivity is not"),
    )
)]
pub async fn show(
    State(app): State<App>,
    caller: Caller,
    Path(id): Path<String>,
    RawQuery(raw): RawQuery,
) -> Result<Json<JobSpec>, Problem> {
    let tenant = caller.may(Scope::Read)?;
    query::parameters(raw.as_deref(), &[], &[])?;
    let id = job_id(&id)?;
    let spec = app.engine.spec(tenant, id).await?.ok_or_else(|| Problem::unknown_job(&id.to_string()))?;
    spec.as_asked().map(Json).ok_or_else(|| {
        let detail = format!("job {id} is a sensitivity: its gradient was posted to the job that made the surface");
        Problem::not_found("no_request", "the job was not asked for at /v1/jobs", detail)
    })
}

/// A request for a job, as it may be sent.
#[derive(Serialize, utoipa::ToSchema)]
#[serde(untagged)]
pub enum JobRequest {
    /// For a surface.
    Shrink(Box<ShrinkRequest>),
    /// For a network.
    Fit(FitRequest),
}

/// The kind of a [`ShrinkRequest`].
#[derive(Serialize, utoipa::ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum ShrinkKind {
    /// Shrink a sphere onto a field.
    Shrink,
}

/// The kind of a [`FitRequest`].
#[derive(Serialize, utoipa::ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum FitKind {
    /// Fit a network to meshes.
    Fit,
}

/// A request for a network: only the kind and the meshes are required.
#[derive(Serialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub struct FitRequest {
    /// What kind of work it is.
    kind: FitKind,
    /// The names of uploaded meshes: one gives a SIREN, several (at most 1,024) an auto-decoder with a latent code each, in this order.
    meshes: Vec<String>,
    /// How it is fitted.
    #[schema(required = false)]
    fit: crate::fit::FitSpec,
    /// What is made; `network` and `report` when nothing is said.
    #[schema(required = false)]
    outputs: Vec<crate::job::OutputName>,
    /// Names to find the job by: at most 16.
    #[schema(required = false)]
    labels: std::collections::BTreeMap<String, String>,
    /// Who is told of the end.
    #[schema(required = false)]
    webhook: Option<WebhookSpec>,
    /// Seconds that an attempt may run, from its start: then it is stopped, and the job has failed. The service's own limit when nothing is
    /// said; no more than that.
    #[schema(required = false, minimum = 1)]
    deadline_s: Option<u32>,
}

/// A request for a surface: only the field is required. [`JobSpec`] is the same with every default filled in.
#[derive(Serialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub struct ShrinkRequest {
    /// What kind of work it is.
    #[schema(required = false)]
    kind: ShrinkKind,
    /// The field.
    field: FieldSpec,
    /// What samples are spread by, where the density is `weight`: its values, which need not be distances.
    #[schema(required = false)]
    weight: Option<FieldSpec>,
    /// Whether the output `surface` says how the surface moves with the latent code (its tensor `latent_motion`).
    #[schema(required = false)]
    latent_motion: bool,
    /// The job whose output `surface` it begins from, and keeps the UVs of: one that succeeded by the method `adaptive` on the
    /// same lattice, of a field nearby.
    #[schema(required = false)]
    warm_start: Option<JobId>,
    /// How it is shrunk.
    #[schema(required = false)]
    shrink: crate::shrink::ShrinkSpec,
    /// What may be spent on it.
    #[schema(required = false)]
    budget: crate::extract::Budget,
    /// What is made; `glb`, `preview` and `report` when nothing is said, and `svg` of a 2-D field.
    #[schema(required = false)]
    outputs: Vec<crate::job::OutputName>,
    /// Names to find the job by: at most 16.
    #[schema(required = false)]
    labels: std::collections::BTreeMap<String, String>,
    /// Who is told of the end.
    #[schema(required = false)]
    webhook: Option<WebhookSpec>,
    /// Seconds that an attempt may run, from its start: then it is stopped, and the job has failed. The service's own limit when nothing is
    /// said; no more than that.
    #[schema(required = false, minimum = 1)]
    deadline_s: Option<u32>,
}
