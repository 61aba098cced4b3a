//! `/v1/jobs/{id}/sensitivity`: how a loss of a job's surface changes with the network that it came from.

use super::super::rates::Rate;
use super::estimate::surface_blob;
use super::{App, Problem, accepted, answer_submit, body, check_memory, idempotency_key, job_id, query, tell_accepted};
use crate::auth::{Caller, Scope};
use crate::blobs::BlobId;
use crate::engine::{IdempotencyKey, NewJob};
use crate::job::spec::{Sensing, Work};
use crate::job::{Job, JobId, JobKind, JobSpec, OutputName, State as JobState, memory};
use crate::surface::sensitivity::check_gradient;
use crate::tenant::Tenant;
use axum::body::Body;
use axum::extract::{Path, RawQuery, State};
use axum::http::HeaderMap;
use axum::response::Response;
use std::collections::BTreeMap;
use std::time::Instant;

/// Differentiates a job's surface
///
/// The body is a safetensors file with the tensor `gradient`: the derivatives of a loss by the vertices of the job's output `surface`,
/// `[vertices, 3]` for its welded vertices or `[rows, columns, 3]` for the points of its grid, F32 or F64. The answer is a job of the kind
/// `sensitivity`, whose output `sensitivity` holds the derivatives by the latent code (`latent`) and by the weights
/// (`layers.i.weight`, `layers.i.bias`, with a layer norm `layers.i.norm.scale` and `layers.i.norm.shift`).
#[utoipa::path(
    post,
    path = "/v1/jobs/{id}/sensitivity",
    tag = "jobs",
    params(
        ("id" = String, Path, description = "a job of the kind `shrink` that succeeded, of a network, with the output `surface`"),
        ("Idempotency-Key" = Option<String>, Header, min_length = 1, max_length = 255, pattern = "^[!-~]+$", description = "makes the request repeatable for 24 hours"),
        ("Prefer" = Option<String>, Header, description = "`wait=N`: wait up to N seconds for the end"),
    ),
    request_body(content = Vec<u8>, content_type = "application/octet-stream", description = "the gradient"),
    responses(
        (status = 202, description = "accepted", body = Job, headers(
            ("Location", description = "where the job is"),
            ("Retry-After", description = "seconds after which to look"),
            ("Idempotent-Replayed", description = "`true` when this is the answer to an earlier request with the same key"))),
        (status = 200, description = "ended in time", body = Job),
        (status = 400, description = "the body broke off, or a header or parameter is malformed"),
        (status = 404, description = "there is no such job"),
        (status = 409, description = "the job has no surface of a network, or a request with this key is not finished yet"),
        (status = 413, description = "the body is too large"),
        (status = 422, description = "the body holds no gradient, or its key was used for another request"),
        (status = 503, description = "the service is stopping"),
    )
)]
pub async fn differentiate(
    State(app): State<App>,
    caller: Caller,
    Path(id): Path<String>,
    RawQuery(raw): RawQuery,
    headers: HeaderMap,
    body: Body,
) -> Result<Response, Problem> {
    let tenant = caller.may(Scope::Write)?;
    let clock = Instant::now();
    query::parameters(raw.as_deref(), &[], &[])?;
    let key = idempotency_key(&headers)?;
    let id = job_id(&id)?;
    let (bytes, _room) = body::read_upload(body, app.limits.input_bytes, &app.upload_room).await?;
    app.rates.take(tenant, Rate::UploadedBytes, bytes.len() as u64)?;
    let checked = bytes.clone();
    let checked = tokio::task::spawn_blocking(move || check_gradient(&checked).map(|()| BlobId::of(&checked)));
    let hash = checked.await.map_err(|error| {
        tracing::error!(%error, "a gradient could not be looked at");
        Problem::internal()
    })?;
    let title = "the gradient cannot be used";
    let hash = hash.map_err(|detail| Problem::unprocessable("malformed_gradient", title, detail))?;
    let key = key.map(|key| IdempotencyKey { key, fingerprint: format!("{id} sensitivity {hash}") });
    // a repeated request has its answer, also when the job is forgotten by now
    if let Some(key) = &key
        && let Some(answer) = app.engine.recall(tenant, key.clone()).await?
    {
        return answer_submit(&app, tenant, &headers, accepted(answer)?).await;
    }
    if app.stop.is_cancelled() {
        return Err(Problem::unavailable("stopping", "the service is stopping"));
    }
    // no blob goes from the moment that it is looked up until the new job's record names it
    let promise = app.blobs.promise().await;
    let job = app.engine.get(tenant, id).await?.ok_or_else(|| Problem::unknown_job(&id.to_string()))?;
    let (mut sensing, network) = sensing(&app, tenant, &job).await?;
    let memory = network.saturating_add(memory::of_gradient(bytes.len() as u64));
    sensing.gradient = app.blobs.put_unseen(bytes).await?;
    let outputs = OutputName::of(JobKind::Sensitivity).to_vec();
    let work = Work::Sensitivity(Box::new(sensing));
    let memory = memory::of_job(&work, 0, memory);
    check_memory(&app, memory)?;
    let spec = JobSpec {
        work,
        outputs,
        labels: BTreeMap::new(),
        traceparent: None,
        webhook: None,
        deadline_s: Some(app.limits.job_seconds),
        memory_bytes: Some(memory),
    };
    let new = NewJob { tenant: tenant.clone(), id: JobId::new(), spec, vertices: 0, key };
    let submitted = app.engine.submit(new).await?;
    drop(promise);
    tell_accepted(&submitted, clock);
    answer_submit(&app, tenant, &headers, accepted(submitted)?).await
}

/// What is differentiated of a job, with its surface in the place of the gradient; and bytes of memory that its network takes.
async fn sensing(app: &App, tenant: &Tenant, job: &Job) -> Result<(Sensing, u64), Problem> {
    let no = |detail: &str| {
        let detail = format!("job {} {detail}", job.id);
        Problem::conflict("not_differentiable", "the job has no surface of a network", detail)
    };
    if job.state != JobState::Succeeded {
        return Err(no(&format!("has not succeeded: it is {}", job.state.name())));
    }
    let Some(Work::Shrink(work)) = app.engine.spec(tenant, job.id).await?.map(|spec| spec.work) else {
        return Err(no(&format!("is of the kind {}", job.kind.name())));
    };
    let Some(input) = work.field.input else { return Err(no("is of a scene, which has no weights")) };
    let note = app.blobs.note(tenant, input).await?.ok_or_else(|| no("is of an input that is gone"))?;
    let described = super::super::inputs::read_note(&note)?;
    if !described.is_network() {
        return Err(no("is of a field that is no network"));
    }
    let surface = surface_blob(job).ok_or_else(|| no("did not make the output \"surface\""))?;
    Ok((Sensing { of: job.id, field: work.field, surface, gradient: surface }, described.memory()))
}
