//! `GET /v1/jobs/{id}/events`: a job's events as they happen (server-sent events), or as JSON pages.

use super::jobs::job_id;
use super::{App, Problem, query};
use crate::auth::{Caller, Scope};
use crate::engine;
use crate::job::{Event, JobId};
use crate::telemetry::metrics::{self, Present};
use crate::tenant::Tenant;
use axum::Json;
use axum::extract::{Path, RawQuery, State};
use axum::http::{HeaderMap, HeaderName, StatusCode, header};
use axum::response::sse::{self, KeepAlive, Sse};
use axum::response::{IntoResponse, Response};
use futures::StreamExt;
use serde::Serialize;
use std::time::Duration;

/// How long a reader waits before it connects again.
const RETRY: Duration = Duration::from_millis(2000);
/// How often an idle stream says that it is alive.
const HEARTBEAT: Duration = Duration::from_secs(15);
/// Events of a JSON page when nothing is said.
const DEFAULT_LIMIT: u64 = 100;
/// Events of a JSON page at most.
const MAX_LIMIT: u64 = 512;

/// A page of events.
#[derive(Serialize, utoipa::ToSchema)]
pub struct EventsPage {
    /// The events, in order.
    events: Vec<Event>,
    /// The number to ask after for the next page.
    next_after: u64,
    /// The oldest number that is kept: events before it are gone, and what they told is in the job itself.
    oldest: u64,
    /// The newest number there is.
    newest: u64,
    /// Whether the job has ended, so that nothing comes after `newest`.
    ended: bool,
}

/// Follows a job
///
/// A stream of server-sent events, or a JSON page when `Accept` asks for `application/json`. The first frame of a stream
/// is a `snapshot` (the whole job), then `state`, `progress`, `mesh` as they happen, and `done` at the end. `id` is the job's
/// own sequence number. With `Last-Event-ID` or `after` the stream goes on after that number; when events in between are
/// no longer kept, with a fresh snapshot.
#[utoipa::path(
    get,
    path = "/v1/jobs/{id}/events",
    tag = "jobs",
    params(
        ("id" = String, Path, description = "the job"),
        ("after" = Option<u64>, Query, description = "only events after this number"),
        ("limit" = Option<u64>, Query, minimum = 1, maximum = 512, description = "events of a JSON page, 1 to 512"),
        ("Last-Event-ID" = Option<String>, Header, pattern = "^[0-9]{0,19}$", description = "the last number that was seen; goes before `after`"),
    ),
    responses(
        (status = 200, description = "the events", content((String = "text/event-stream"), (EventsPage = "application/json"))),
        (status = 204, description = "the job has ended and everything was seen: do not come back"),
        (status = 400, description = "a header or parameter is malformed"),
        (status = 404, description = "there is no such job"),
        (status = 406, description = "neither text/event-stream nor application/json is accepted"),
    )
)]
pub async fn events(
    State(app): State<App>,
    caller: Caller,
    Path(id): Path<String>,
    RawQuery(raw): RawQuery,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    let tenant = caller.may(Scope::Read)?;
    let parameters = query::parameters(raw.as_deref(), &["after", "limit"], &[])?;
    let limit = query::number(&parameters, "limit")?.unwrap_or(DEFAULT_LIMIT);
    if !(1..=MAX_LIMIT).contains(&limit) {
        return Err(Problem::query(format!("limit: expected 1 to {MAX_LIMIT}, found {limit}")));
    }
    let after = last_event_id(&headers)?.or(query::number(&parameters, "after")?);
    let id = job_id(&id)?;
    match wanted(&headers)? {
        Form::Stream => stream(app, tenant, id, after).await,
        Form::Page => page(&app, tenant, id, after.unwrap_or(0), limit as usize).await,
    }
}

async fn page(app: &App, tenant: &Tenant, id: JobId, after: u64, limit: usize) -> Result<Response, Problem> {
    let page = app.engine.events_after(tenant, id, after, limit).await?;
    let page = page.ok_or_else(|| Problem::unknown_job(&id.to_string()))?;
    let next_after = page.events.last().map_or(after, |event| event.seq);
    let ended = page.job.state.ended();
    let body = EventsPage { events: page.events, next_after, oldest: page.oldest, newest: page.newest, ended };
    Ok(([(header::CACHE_CONTROL, "no-cache")], Json(body)).into_response())
}

async fn stream(app: App, tenant: &Tenant, id: JobId, after: Option<u64>) -> Result<Response, Problem> {
    let open = app.rates.open_stream(tenant)?;
    let unknown = || Problem::unknown_job(&id.to_string());
    if let Some(after) = after {
        let seen = app.engine.events_after(tenant, id, after, 1).await?.ok_or_else(unknown)?;
        if seen.job.state.ended() && after == seen.newest {
            return Ok(StatusCode::NO_CONTENT.into_response());
        }
    }
    let events = engine::follow(app.engine, tenant, id, after).await?.ok_or_else(unknown)?;
    let client = Present::sse_client();
    let frames = events.enumerate().map(move |(i, event)| {
        let _here = (&client, &open);
        let event = event.inspect_err(|error| tracing::error!(job.id = %id, %error, "a stream broke off"))?;
        metrics::event_sent(event.kind.name());
        let frame =
            sse::Event::default().id(event.seq.to_string()).event(event.kind.name()).data(event.data.to_string());
        Ok::<_, engine::EngineError>(if i == 0 { frame.retry(RETRY) } else { frame })
    });
    // an open stream must not hold up a stop; its reader comes back with the last number it saw
    let frames = frames.take_until(app.stop.cancelled_owned());
    let heartbeat = KeepAlive::new().interval(HEARTBEAT).text("heartbeat");
    // proxies that buffer would make a stream look dead
    let unbuffered = [(HeaderName::from_static("x-accel-buffering"), "no")];
    Ok((unbuffered, Sse::new(frames).keep_alive(heartbeat)).into_response())
}

enum Form {
    Stream,
    Page,
}

/// What `Accept` asks for; a stream when it takes either.
fn wanted(headers: &HeaderMap) -> Result<Form, Problem> {
    let accept: Vec<String> = headers
        .get_all(header::ACCEPT)
        .iter()
        .filter_map(|v| v.to_str().ok())
        .flat_map(|v| v.split(','))
        .map(|range| range.split(';').next().unwrap_or("").trim().to_ascii_lowercase())
        .collect();
    let takes = |types: [&str; 2]| accept.iter().any(|range| types.contains(&range.as_str()));
    if takes(["text/event-stream", "text/*"]) {
        Ok(Form::Stream)
    } else if takes(["application/json", "application/*"]) {
        Ok(Form::Page)
    } else if accept.is_empty() || takes(["*/*", "*"]) {
        Ok(Form::Stream)
    } else {
        let detail = "events are text/event-stream or application/json";
        Err(Problem::new(StatusCode::NOT_ACCEPTABLE, "not_acceptable", "no accepted media type is offered", detail))
    }
}

fn last_event_id(headers: &HeaderMap) -> Result<Option<u64>, Problem> {
    let Some(id) = headers.get("last-event-id") else { return Ok(None) };
    // an empty id is what a reader sends that has seen none
    let text = id.to_str().unwrap_or("?").trim();
    if text.is_empty() {
        return Ok(None);
    }
    let number =
        text.parse().map_err(|_| Problem::header(format!("Last-Event-ID: expected a number, found {text:?}")))?;
    Ok(Some(number))
}
