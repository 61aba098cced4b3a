//! `GET /v1/jobs`: newest first, page by page.

use super::{App, Problem, query};
use crate::auth::{Caller, Scope};
use crate::engine::ListQuery;
use crate::job::{Job, JobId, State};
use crate::tenant::Tenant;
use axum::Json;
use axum::extract::{RawQuery, State as Shared};
use axum::http::{HeaderMap, HeaderValue, header};
use base64::Engine as _;
use base64::prelude::BASE64_URL_SAFE_NO_PAD;
use jiff::Timestamp;
use serde::Serialize;

/// Jobs of a page when nothing is said.
pub(crate) const DEFAULT_LIMIT: u64 = 50;
/// Jobs of a page at most.
const MAX_LIMIT: u64 = 200;
/// Filters by label at most.
const MAX_LABELS: usize = 16;

/// A label that jobs must have: `name:value`.
#[derive(utoipa::ToSchema)]
#[schema(value_type = String, pattern = "^[^:]*:")]
#[allow(dead_code, reason = "only described")]
pub struct LabelFilter(String);

/// A page of jobs.
#[derive(Serialize, utoipa::ToSchema)]
pub struct JobPage {
    /// The jobs, newest first.
    pub(crate) jobs: Vec<Job>,
    /// The cursor of the next page; null on the last one.
    pub(crate) next_cursor: Option<String>,
}

/// Lists jobs, newest first
#[utoipa::path(
    get,
    path = "/v1/jobs",
    tag = "jobs",
    params(
        ("state" = Option<Vec<State>>, Query, description = "only jobs in these states; may be repeated"),
        ("label" = Option<Vec<LabelFilter>>, Query, max_items = 16, description = "only jobs with this label, `name:value`; may be repeated"),
        ("created_from" = Option<String>, Query, format = DateTime, description = "only jobs accepted at this time (RFC 3339) or later"),
        ("created_to" = Option<String>, Query, format = DateTime, description = "only jobs accepted before this time (RFC 3339)"),
        ("limit" = Option<u64>, Query, minimum = 1, maximum = 200, description = "jobs of a page, 1 to 200, 50 when nothing is said"),
        ("cursor" = Option<String>, Query, pattern = "^[A-Za-z0-9_-]{21}[AQgw]$", description = "from the page before, as it is"),
    ),
    responses(
        (status = 200, description = "a page", body = JobPage, headers(("Link", description = "`rel=\"next\"`: the next page"))),
        (status = 400, description = "a parameter is malformed"),
    )
)]
pub async fn list(
    Shared(app): Shared<App>,
    caller: Caller,
    RawQuery(raw): RawQuery,
) -> Result<(HeaderMap, Json<JobPage>), Problem> {
    let tenant = caller.may(Scope::Read)?;
    let known = ["state", "label", "created_from", "created_to", "limit", "cursor"];
    let parameters = query::parameters(raw.as_deref(), &known, &["state", "label"])?;
    let limit = query::number(&parameters, "limit")?.unwrap_or(DEFAULT_LIMIT);
    let mut wanted = ListQuery {
        before: query::value(&parameters, "cursor").map(read_cursor).transpose()?,
        created_from: time(&parameters, "created_from")?,
        created_to: time(&parameters, "created_to")?,
        limit: limit as usize,
        ..ListQuery::default()
    };
    for (name, value) in &parameters {
        match name.as_str() {
            "state" => wanted.states.push(State::from_name(value).ok_or_else(|| {
                let known = State::ALL.map(State::name).join(", ");
                Problem::query(format!("state: unknown state {value:?}; known: {known}"))
            })?),
            "label" => {
                let (name, value) = value
                    .split_once(':')
                    .ok_or_else(|| Problem::query(format!("label: expected name:value, found {value:?}")))?;
                wanted.labels.push((name.to_owned(), value.to_owned()));
            }
            _ => {}
        }
    }
    let page = page(&app, tenant, wanted).await?;
    let mut headers = HeaderMap::from_iter([(header::CACHE_CONTROL, HeaderValue::from_static("no-cache"))]);
    if let Some(cursor) = &page.next_cursor {
        let link = next_link(raw.as_deref().unwrap_or(""), cursor);
        headers.insert(header::LINK, HeaderValue::from_str(&link).map_err(|_| Problem::internal())?);
    }
    Ok((headers, Json(page)))
}

/// A page of jobs, whatever way it was asked for.
pub(crate) async fn page(app: &App, tenant: &Tenant, wanted: ListQuery) -> Result<JobPage, Problem> {
    if !(1..=MAX_LIMIT).contains(&(wanted.limit as u64)) {
        return Err(Problem::query(format!("limit: expected 1 to {MAX_LIMIT}, found {}", wanted.limit)));
    }
    if wanted.labels.len() > MAX_LABELS {
        return Err(Problem::query(format!("label: at most {MAX_LABELS}")));
    }
    let page = app.engine.list(tenant, wanted).await?;
    let next_cursor = page.jobs.last().filter(|_| page.more).map(|job| BASE64_URL_SAFE_NO_PAD.encode(job.id.0));
    Ok(JobPage { jobs: page.jobs, next_cursor })
}

/// The same query with another cursor.
fn next_link(query: &str, cursor: &str) -> String {
    let others = query.split('&').filter(|p| !p.is_empty() && !p.starts_with("cursor="));
    let parameters: Vec<String> = others.map(str::to_owned).chain([format!("cursor={cursor}")]).collect();
    format!("</v1/jobs?{}>; rel=\"next\"", parameters.join("&"))
}

pub(crate) fn read_cursor(text: &str) -> Result<JobId, Problem> {
    let bytes = BASE64_URL_SAFE_NO_PAD.decode(text).ok();
    let id = bytes.and_then(|b| uuid::Uuid::from_slice(&b).ok());
    id.map(JobId).ok_or_else(|| Problem::query("cursor: not a cursor that was given out"))
}

fn time(parameters: &[(String, String)], name: &str) -> Result<Option<Timestamp>, Problem> {
    let text = query::value(parameters, name);
    // a plus that was not escaped has become a space
    let parse = |text: &str| text.replace(' ', "+").parse();
    text.map(|text| {
        parse(text).map_err(|_| Problem::query(format!("{name}: expected an RFC 3339 time, found {text:?}")))
    })
    .transpose()
}
