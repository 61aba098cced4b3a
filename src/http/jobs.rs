//! `/v1/jobs`: submit, look, cancel, forget.

mod estimate;
pub mod request;
pub(super) mod sensitivity;
mod warm_start;

use super::{App, Problem, body, conditional, query};
use crate::auth::{Caller, Scope};
use crate::blobs::BlobId;
use crate::config::WebhooksConfig;
use crate::engine::{Forgotten, IdempotencyKey, NewJob, Submitted};
use crate::field::Fault;
use crate::job::spec::Work;
use crate::job::{Failure, Job, JobId, JobKind, JobSpec};
use crate::notify::target::Rules;
use crate::telemetry::metrics;
use crate::tenant::Tenant;
use axum::Json;
use axum::body::Body;
use axum::extract::{Path, RawQuery, State};
use axum::http::{HeaderMap, HeaderName, HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Response};
use serde::Serialize;
use serde_json::Value;
use std::time::{Duration, Instant};

pub(crate) use estimate::Estimate;
use estimate::{Fields, check_fields, estimate};
use request::JobRequest;

/// Characters of an idempotency key.
pub(crate) const MAX_KEY: usize = 255;
/// Longest hint to come back, seconds: an estimate far ahead is not worth more trust.
const MAX_RETRY_AFTER: f64 = 30.0;
/// Submits a job
///
/// The answer is sent once the job is durable. `Prefer: wait=N` waits up to N seconds (at most 60) for its end and then
/// answers 200.
#[utoipa::path(
    post,
    path = "/v1/jobs",
    tag = "jobs",
    params(
        ("validate_only" = Option<bool>, Query, description = "check the request and estimate its cost, without submitting it"),
        ("Idempotency-Key" = Option<String>, Header, min_length = 1, max_length = 255, pattern = "^[!-~]+$", description = "makes the submit repeatable for 24 hours"),
        ("Prefer" = Option<String>, Header, description = "`wait=N`: wait up to N seconds for the end"),
    ),
    request_body(content = JobRequest, content_type = "application/json"),
    responses(
        (status = 202, description = "accepted", body = Job, headers(
            ("Location", description = "where the job is"),
            ("Retry-After", description = "seconds after which to look"),
            ("Idempotent-Replayed", description = "`true` when this is the answer to an earlier request with the same key"))),
        (status = 200, description = "ended in time, or (with validate_only) the estimate", body = SubmitAnswer),
        (status = 400, description = "the body is not JSON, or a header or parameter is malformed"),
        (status = 413, description = "the body is too large"),
        (status = 415, description = "the body is not application/json"),
        (status = 422, description = "the request is wrong, or its key was used for another request"),
        (status = 429, description = "a quota is used up", headers(
            ("Retry-After", description = "seconds after which there may be more"),
            ("RateLimit", description = "the quota, and what is left of it"),
            ("RateLimit-Policy", description = "the quota, how much it is, and over how many seconds"))),
        (status = 503, description = "the queue is full, or the service is stopping"),
    )
)]
pub async fn submit(
    State(app): State<App>,
    caller: Caller,
    RawQuery(raw): RawQuery,
    headers: HeaderMap,
    body: Body,
) -> Result<Response, Problem> {
    let tenant = caller.may(Scope::Write)?;
    let parameters = query::parameters(raw.as_deref(), &["validate_only"], &[])?;
    let validate_only = query::flag(&parameters, "validate_only")?;
    let key = idempotency_key(&headers)?;
    let request = body::read_json(&headers, body, app.limits.body_bytes).await?;
    if validate_only {
        return Ok(Json(judge(&app, tenant, &request).await?).into_response());
    }
    let accepted = accept(&app, tenant, &request, key).await?;
    answer_submit(&app, tenant, &headers, accepted).await
}

/// A job that was accepted, now or by an earlier request with the same key.
pub(crate) struct Accepted {
    /// The job as it was accepted.
    pub job: Job,
    /// Whether an earlier request did.
    pub replayed: bool,
}

/// Estimates what a request would cost, checking it as if it were submitted.
pub(crate) async fn judge(app: &App, tenant: &Tenant, request: &Value) -> Result<Estimate, Problem> {
    let spec = read(app, tenant, request)?;
    let _promise = app.blobs.promise().await;
    let (spec, fields) = look_up(app, tenant, spec, request).await?;
    let estimate = estimate(&spec, &fields);
    check_memory(app, estimate.memory_bytes)?;
    Ok(estimate)
}

/// Accepts a request for a job, whatever way it came: the job is durable before this returns.
pub(crate) async fn accept(
    app: &App,
    tenant: &Tenant,
    request: &Value,
    key: Option<String>,
) -> Result<Accepted, Problem> {
    let clock = Instant::now();
    let spec = read(app, tenant, request)?;
    // the keys of a JSON value are sorted, so that spaces and order do not make another request
    let fingerprint = BlobId::of(request.to_string().as_bytes()).hex();
    let key = key.map(|key| IdempotencyKey { key, fingerprint });
    // a repeated request has its answer, also when what it named is gone by now
    if let Some(key) = &key
        && let Some(answer) = app.engine.recall(tenant, key.clone()).await?
    {
        return accepted(answer);
    }
    // no blob goes from the moment that it is looked up until the new job's record names it
    let promise = app.blobs.promise().await;
    let (mut spec, fields) = look_up(app, tenant, spec, request).await?;
    let Estimate { vertices, memory_bytes, .. } = estimate(&spec, &fields);
    check_memory(app, memory_bytes)?;
    spec.memory_bytes = Some(memory_bytes);
    if app.stop.is_cancelled() {
        return Err(Problem::unavailable("stopping", "the service is stopping"));
    }
    let new = NewJob { tenant: tenant.clone(), id: JobId::new(), spec, vertices, key };
    let submitted = app.engine.submit(new).await?;
    drop(promise);
    tell_accepted(&submitted, clock);
    accepted(submitted)
}

/// Counts a job that is new.
fn tell_accepted(submitted: &Submitted, since: Instant) {
    if let Submitted::Created(job) = submitted {
        metrics::job_accepted(job.kind, since.elapsed());
    }
}

/// Reads a request for a job; what it names is not looked up yet.
fn read(app: &App, tenant: &Tenant, request: &Value) -> Result<JobSpec, Problem> {
    let mut spec = JobSpec::from_value(request).map_err(|faults| Problem::invalid_request("", &faults))?;
    if spec.work.kind() == JobKind::Sensitivity {
        let detail = "a sensitivity is asked for by POST /v1/jobs/{id}/sensitivity".to_owned();
        let fault = Fault { pointer: "/kind".to_owned(), code: "not_offered", detail };
        return Err(Problem::invalid_request("", &[fault]));
    }
    if let Some(webhook) = &spec.webhook {
        check_webhook(&app.webhooks, tenant, &webhook.url)?;
    }
    let longest = app.limits.job_seconds;
    if spec.deadline_s.is_some_and(|seconds| seconds > longest) {
        let detail = format!("a job runs for {longest} s at most here");
        let fault = Fault { pointer: "/deadline_s".to_owned(), code: "out_of_range", detail };
        return Err(Problem::invalid_request("", &[fault]));
    }
    spec.deadline_s.get_or_insert(longest);
    Ok(spec)
}

/// Checks who is to be told of the end. What a name leads to is looked at when the notice is sent.
fn check_webhook(webhooks: &WebhooksConfig, tenant: &Tenant, url: &str) -> Result<(), Problem> {
    if webhooks.secrets_of(tenant).is_empty() {
        let detail = "this service sends no notices: it has no secret to sign them with".to_owned();
        let fault = Fault { pointer: "/webhook".to_owned(), code: "not_offered", detail };
        return Err(Problem::invalid_request("", &[fault]));
    }
    Rules::from(webhooks).read(url).map(|_| ()).map_err(|refused| {
        let fault = Fault { pointer: "/webhook/url".to_owned(), code: refused.code, detail: refused.detail };
        Problem::invalid_request("", &[fault])
    })
}

/// Looks up everything that a request names, and completes it.
async fn look_up(app: &App, tenant: &Tenant, spec: JobSpec, request: &Value) -> Result<(JobSpec, Fields), Problem> {
    let fields = check_fields(app, tenant, &spec).await?;
    let mut spec =
        spec.for_dimension(fields.dimension, request).map_err(|faults| Problem::invalid_request("", &faults))?;
    if matches!(&spec.work, Work::Shrink(work) if work.warm_start.is_some()) {
        warm_start::resolve(app, tenant, &mut spec).await?;
    }
    Ok((spec, fields))
}

/// Refuses what needs more memory than a job may.
fn check_memory(app: &App, needed: u64) -> Result<(), Problem> {
    match app.job_memory {
        Some(limit) if needed > limit => Err(Failure::memory_exceeded(needed, limit).into()),
        _ => Ok(()),
    }
}

/// What the engine made of a submit.
fn accepted(submitted: Submitted) -> Result<Accepted, Problem> {
    let (job, replayed) = match submitted {
        Submitted::Created(job) => (job, false),
        Submitted::Replayed(job) => (job, true),
        Submitted::KeyConflict => {
            let detail = "the key was used for another request within the last 24 hours";
            return Err(Problem::unprocessable(
                "idempotency_key_reused",
                "the key was used for another request",
                detail,
            ));
        }
        Submitted::OverQuota(over) => return Err(Problem::over_quota(over)),
        Submitted::QueueFull => {
            return Err(Problem::unavailable("queue_full", "as many jobs wait as may, of all tenants together"));
        }
    };
    tracing::info!(job.id = %job.id, replayed, "job submitted");
    Ok(Accepted { job, replayed })
}

/// The answer to a submit, after the wait that `Prefer` asks for.
async fn answer_submit(
    app: &App,
    tenant: &Tenant,
    headers: &HeaderMap,
    accepted: Accepted,
) -> Result<Response, Problem> {
    let Accepted { mut job, replayed } = accepted;
    let mut answer = HeaderMap::new();
    let location = HeaderValue::from_str(&format!("/v1/jobs/{}", job.id)).map_err(|_| Problem::internal())?;
    answer.insert(header::LOCATION, location);
    if replayed {
        answer.insert(HeaderName::from_static("idempotent-replayed"), HeaderValue::from_static("true"));
    }
    if let Some(wait) = query::prefer_wait(headers) {
        job = wait_until(app, tenant, job.id, wait, |job| job.state.ended()).await?.unwrap_or(job);
        let applied = HeaderValue::from_str(&format!("wait={}", wait.as_secs())).map_err(|_| Problem::internal())?;
        answer.insert(HeaderName::from_static("preference-applied"), applied);
    }
    let status = if job.state.ended() { StatusCode::OK } else { StatusCode::ACCEPTED };
    Ok((status, answer, job_answer(job)).into_response())
}

/// Reads a job
///
/// With `wait`, the answer comes when the job has changed from the version in `If-None-Match`, or, without that header,
/// when it has ended; and in any case after `wait` seconds.
#[utoipa::path(
    get,
    path = "/v1/jobs/{id}",
    tag = "jobs",
    params(
        ("id" = String, Path, description = "the job"),
        ("wait" = Option<u64>, Query, description = "seconds to wait for news, at most 60"),
        ("If-None-Match" = Option<String>, Header, description = "versions that are known already"),
    ),
    responses(
        (status = 200, description = "the job; a failed one has its problem inside", body = Job, headers(
            ("ETag", description = "weak, changes with every revision"),
            ("Retry-After", description = "seconds after which to look again, while it has not ended"))),
        (status = 304, description = "it has not changed"),
        (status = 400, description = "a parameter is malformed"),
        (status = 404, description = "there is no such job"),
    )
)]
pub async fn get(
    State(app): State<App>,
    caller: Caller,
    Path(id): Path<String>,
    RawQuery(raw): RawQuery,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    let tenant = caller.may(Scope::Read)?;
    let parameters = query::parameters(raw.as_deref(), &["wait"], &[])?;
    let wait = query::wait(&parameters)?.unwrap_or_default();
    let id = job_id(&id)?;
    let known = |job: &Job| conditional::names_tag(&headers, header::IF_NONE_MATCH, &tag(job));
    let conditional = headers.contains_key(header::IF_NONE_MATCH);
    let news = |job: &Job| if conditional { !known(job) } else { job.state.ended() };
    let job = wait_until(&app, tenant, id, wait, news).await?;
    let job = job.ok_or_else(|| Problem::unknown_job(&id.to_string()))?;
    if known(&job) {
        let answer = [(header::ETAG, tag(&job)), (header::CACHE_CONTROL, "no-cache".to_owned())];
        return Ok((StatusCode::NOT_MODIFIED, answer).into_response());
    }
    Ok(job_answer(job).into_response())
}

/// Cancels a job
///
/// A queued job ends at once; a running one is told to stop. Cancelling what has ended changes nothing.
#[utoipa::path(
    post,
    path = "/v1/jobs/{id}/cancel",
    tag = "jobs",
    params(("id" = String, Path, description = "the job")),
    responses(
        (status = 202, description = "it is stopping", body = Job),
        (status = 200, description = "it has ended", body = Job),
        (status = 400, description = "a query parameter is unknown"),
        (status = 404, description = "there is no such job"),
    )
)]
pub async fn cancel(
    State(app): State<App>,
    caller: Caller,
    Path(id): Path<String>,
    RawQuery(raw): RawQuery,
) -> Result<Response, Problem> {
    let tenant = caller.may(Scope::Write)?;
    query::parameters(raw.as_deref(), &[], &[])?;
    let job = request_cancel(&app, tenant, &id).await?;
    let status = if job.state.ended() { StatusCode::OK } else { StatusCode::ACCEPTED };
    Ok((status, job_answer(job)).into_response())
}

/// Asks for a job to be stopped. The record afterwards.
pub(crate) async fn request_cancel(app: &App, tenant: &Tenant, id: &str) -> Result<Job, Problem> {
    let id = job_id(id)?;
    let job = app.engine.request_cancel(tenant, id).await?;
    let job = job.ok_or_else(|| Problem::unknown_job(&id.to_string()))?;
    tracing::info!(job.id = %id, job.state = job.state.name(), "cancel requested");
    Ok(job)
}

/// Forgets a job and its outputs
#[utoipa::path(
    delete,
    path = "/v1/jobs/{id}",
    tag = "jobs",
    params(("id" = String, Path, description = "the job")),
    responses(
        (status = 204, description = "it is gone"),
        (status = 400, description = "a query parameter is unknown"),
        (status = 404, description = "there is no such job"),
        (status = 409, description = "it has not ended"),
    )
)]
pub async fn forget(
    State(app): State<App>,
    caller: Caller,
    Path(id): Path<String>,
    RawQuery(raw): RawQuery,
) -> Result<StatusCode, Problem> {
    let tenant = caller.may(Scope::Write)?;
    query::parameters(raw.as_deref(), &[], &[])?;
    remove(&app, tenant, &id).await?;
    Ok(StatusCode::NO_CONTENT)
}

/// Forgets an ended job, and the blobs that no other job names.
pub(crate) async fn remove(app: &App, tenant: &Tenant, id: &str) -> Result<(), Problem> {
    let id = job_id(id)?;
    // no job may come to name a blob between the two steps
    let _sweep = app.blobs.sweep().await;
    match app.engine.forget(tenant, id).await? {
        Forgotten::Gone(unused) => {
            for blob in unused.iter().filter_map(|hex| BlobId::from_hex(hex)) {
                app.blobs.remove(blob).await?;
            }
            app.blobs.remove_checkpoint(tenant, &id.to_string()).await?;
            tracing::info!(job.id = %id, "job forgotten");
            Ok(())
        }
        Forgotten::Running => {
            let detail = "cancel the job first, or wait for its end";
            Err(Problem::conflict("job_not_ended", "the job has not ended", detail))
        }
        Forgotten::Unknown => Err(Problem::unknown_job(&id.to_string())),
    }
}

/// The job of that name; what is no name is a job that is not there.
pub(crate) fn job_id(text: &str) -> Result<JobId, Problem> {
    text.parse().map_err(|_| Problem::unknown_job(text))
}

/// A job with its version and, while it has not ended, a hint when to look again.
pub(super) fn job_answer(job: Job) -> impl IntoResponse {
    let mut headers = HeaderMap::new();
    headers.insert(header::CACHE_CONTROL, HeaderValue::from_static("no-cache"));
    if let Ok(tag) = HeaderValue::from_str(&tag(&job)) {
        headers.insert(header::ETAG, tag);
    }
    if !job.state.ended() {
        let seconds = job.eta_s.unwrap_or(1.0).ceil().clamp(1.0, MAX_RETRY_AFTER);
        headers.insert(header::RETRY_AFTER, HeaderValue::from(seconds as u32));
    }
    (headers, Json(job))
}

fn tag(job: &Job) -> String {
    format!("W/\"{}\"", job.revision)
}

/// The job once `done` says so, and at the latest after `wait` or when the service stops. `None` when there is no such job.
async fn wait_until(
    app: &App,
    tenant: &Tenant,
    id: JobId,
    wait: Duration,
    done: impl Fn(&Job) -> bool,
) -> Result<Option<Job>, Problem> {
    let deadline = tokio::time::Instant::now() + wait;
    let _open = if wait.is_zero() { None } else { Some(app.rates.open_stream(tenant)?) };
    let mut changes = (!wait.is_zero()).then(|| app.engine.changes(tenant, id));
    loop {
        let Some(job) = app.engine.get(tenant, id).await? else { return Ok(None) };
        let Some(changes) = changes.as_mut().filter(|_| !done(&job)) else { return Ok(Some(job)) };
        tokio::select! {
            _ = changes.next() => {}
            () = tokio::time::sleep_until(deadline) => return Ok(Some(job)),
            () = app.stop.cancelled() => return Ok(Some(job)),
        }
    }
}

fn idempotency_key(headers: &HeaderMap) -> Result<Option<String>, Problem> {
    let mut keys = headers.get_all("idempotency-key").iter();
    let Some(key) = keys.next() else { return Ok(None) };
    match (key.to_str().ok().and_then(read_key), keys.next()) {
        (Some(key), None) => Ok(Some(key)),
        _ => Err(Problem::header(format!("Idempotency-Key: expected one key of 1 to {MAX_KEY} visible characters"))),
    }
}

/// A key as it is kept; `None` for what is none.
pub(crate) fn read_key(text: &str) -> Option<String> {
    let visible = |b: u8| b == b'\t' || (b' '..=b'~').contains(&b);
    let is_key = !text.trim().is_empty() && text.len() <= MAX_KEY && text.bytes().all(visible);
    is_key.then(|| text.trim().to_owned())
}

/// What `POST /v1/jobs` answers with 200.
#[derive(Serialize, utoipa::ToSchema)]
#[serde(untagged)]
pub enum SubmitAnswer {
    /// The ended job.
    Job(Box<Job>),
    /// The estimate.
    Estimate(Estimate),
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    fn job(state: &str, eta_s: Option<f64>) -> Job {
        let job = json!({
            "id": JobId::new(), "kind": "shrink", "state": state, "attempt": 1, "revision": 7, "created_at": "2026-01-01T00:00:00Z",
            "labels": {}, "eta_s": eta_s, "outputs": [],
        });
        serde_json::from_value(job).expect("a job")
    }

    #[test]
    fn a_client_is_told_to_look_again_when_the_job_may_have_ended() {
        let told = |state: &str, eta_s: Option<f64>| {
            let answer = job_answer(job(state, eta_s)).into_response();
            answer.headers().get(header::RETRY_AFTER).map(|value| value.to_str().expect("text").to_owned())
        };
        for (eta_s, seconds) in [
            (None, "1"),
            (Some(0.0), "1"),
            (Some(0.4), "1"),
            (Some(7.0), "7"),
            (Some(7.2), "8"),
            (Some(29.5), "30"),
            (Some(1e9), "30"),
        ] {
            for state in ["queued", "running", "canceling"] {
                assert_eq!(told(state, eta_s).as_deref(), Some(seconds), "{state}, {eta_s:?}");
            }
        }
        for state in ["succeeded", "failed", "canceled"] {
            assert_eq!(told(state, None), None, "{state}");
        }
        let answer = job_answer(job("running", None)).into_response();
        assert_eq!(answer.headers()[header::ETAG], "W/\"7\"");
    }
}
