//! `GET|HEAD /v1/jobs/{id}/outputs/{name}`: what a job made, with strong tags and ranges.

use super::conditional::{self, Part};
use super::jobs::job_id;
use super::{App, Problem, query};
use crate::auth::{Caller, Scope};
use crate::blobs::{BlobError, BlobId};
use crate::job::{Output, OutputName};
use crate::telemetry::metrics;
use crate::tenant::Tenant;
use axum::body::Body;
use axum::extract::{Path, RawQuery, State};
use axum::http::{HeaderMap, HeaderName, HeaderValue, Method, StatusCode, header};
use axum::response::{IntoResponse, Response};
use base64::Engine as _;
use base64::prelude::BASE64_STANDARD;
use bytes::Bytes;
use futures::TryStreamExt;
use futures::stream::BoxStream;
use jiff::Timestamp;
use std::ops::Range;

/// What a job made never changes, and may be forgotten: a day in a private cache.
const CACHE: &str = "private, max-age=86400, immutable";

/// Downloads an output
#[utoipa::path(
    method(get, head),
    path = "/v1/jobs/{id}/outputs/{name}",
    tag = "jobs",
    params(
        ("id" = String, Path, description = "the job"),
        ("name" = String, Path, description = "`glb`, `surface`, `svg` (of a 2-D field), `preview` or `report`"),
        ("Range" = Option<String>, Header, description = "one range of bytes"),
        ("If-None-Match" = Option<String>, Header, description = "versions that are there already"),
        ("If-Range" = Option<String>, Header, description = "the range is of this version"),
    ),
    responses(
        (status = 200, description = "the output", headers(
            ("ETag", description = "strong: the SHA-256 of the bytes"),
            ("Repr-Digest", description = "the same as a digest (RFC 9530)"),
            ("Accept-Ranges", description = "`bytes`")),
            content((Vec<u8> = "model/gltf-binary"), (Vec<u8> = "application/octet-stream"), (Vec<u8> = "image/png"),
                (String = "image/svg+xml"), (crate::measure::AnyReport = "application/json"))),
        (status = 206, description = "the range of it", headers(("Content-Range", description = "which bytes"))),
        (status = 304, description = "it is there already"),
        (status = 307, description = "it is at the address in `Location` for a while, where the service is told to say so", headers(
            ("Location", description = "a link into the bucket that needs no credentials"))),
        (status = 400, description = "a query parameter is unknown"),
        (status = 404, description = "there is no such job, or it has no such output"),
        (status = 409, description = "the job has not ended"),
        (status = 410, description = "the output is no longer kept"),
        (status = 416, description = "the output has no such bytes", headers(("Content-Range", description = "its size"))),
    )
)]
pub async fn download(
    State(app): State<App>,
    caller: Caller,
    Path((id, name)): Path<(String, String)>,
    RawQuery(raw): RawQuery,
    method: Method,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    let tenant = caller.may(Scope::Read)?;
    query::parameters(raw.as_deref(), &[], &[])?;
    let Made { output, kind, blob } = find(&app, tenant, &id, &name).await?;
    let tag = format!("\"{}\"", output.sha256);
    let digest = format!("sha-256=:{}:", BASE64_STANDARD.encode(blob.bytes()));

    let mut answer = HeaderMap::new();
    let mut set = |name: HeaderName, value: &str| -> Result<(), Problem> {
        answer.insert(name, HeaderValue::from_str(value).map_err(|_| Problem::internal())?);
        Ok(())
    };
    set(header::ETAG, &tag)?;
    set(HeaderName::from_static("repr-digest"), &digest)?;
    set(header::ACCEPT_RANGES, "bytes")?;
    set(header::CACHE_CONTROL, CACHE)?;
    if conditional::names_tag(&headers, header::IF_NONE_MATCH, &tag) {
        return Ok((StatusCode::NOT_MODIFIED, answer).into_response());
    }
    set(header::CONTENT_TYPE, &output.media_type)?;
    set(header::CONTENT_DISPOSITION, &format!("inline; filename=\"{id}.{}\"", kind.extension()))?;
    // a browser must not guess that an output is a page
    set(header::X_CONTENT_TYPE_OPTIONS, "nosniff")?;
    // a link is signed for GET, and the page of this service may not read from elsewhere
    let from_page = headers.get("sec-fetch-site").is_some_and(|site| site == "same-origin");
    if !app.download_link.is_zero()
        && method == Method::GET
        && !from_page
        && let Some(link) = app.blobs.signed_link(blob, app.download_link).await?
    {
        // the link dies before its answer may be reused
        let answer = [(header::LOCATION, link), (header::CACHE_CONTROL, "no-store".to_owned())];
        return Ok((StatusCode::TEMPORARY_REDIRECT, answer).into_response());
    }
    let (status, range) = match conditional::part(&headers, &tag, output.bytes) {
        Part::Whole => (StatusCode::OK, None),
        Part::Bytes(range) => {
            set(header::CONTENT_RANGE, &format!("bytes {}-{}/{}", range.start, range.end - 1, output.bytes))?;
            (StatusCode::PARTIAL_CONTENT, Some(range))
        }
        Part::Unsatisfiable => {
            let detail = format!("the output has {} bytes", output.bytes);
            let title = "the output has no such bytes";
            let size = HeaderValue::from_str(&format!("bytes */{}", output.bytes)).map_err(|_| Problem::internal())?;
            let problem = Problem::new(StatusCode::RANGE_NOT_SATISFIABLE, "range_not_satisfiable", title, detail);
            return Err(problem.with_header(header::CONTENT_RANGE, size));
        }
    };
    let length = range.as_ref().map_or(output.bytes, |r| r.end - r.start);
    set(header::CONTENT_LENGTH, &length.to_string())?;
    let bytes = read(&app, blob, range).await?;
    let name = kind.name();
    let counted = bytes.inspect_ok(move |bytes| metrics::downloaded(name, bytes.len() as u64));
    let body = if method == Method::HEAD { Body::empty() } else { Body::from_stream(counted) };
    Ok((status, answer, body).into_response())
}

/// An output that is kept.
pub(crate) struct Made {
    /// What the job says of it.
    pub output: Output,
    /// Which one it is.
    pub kind: OutputName,
    /// Its bytes.
    pub blob: BlobId,
}

/// An output of a job that has ended.
pub(crate) async fn find(app: &App, tenant: &Tenant, id: &str, name: &str) -> Result<Made, Problem> {
    let id = job_id(id)?;
    let job = app.engine.get(tenant, id).await?.ok_or_else(|| Problem::unknown_job(&id.to_string()))?;
    let unknown = || {
        let detail = format!("the job has no output {name:?}");
        Problem::not_found("unknown_output", "there is no such output", detail)
    };
    let kind = OutputName::from_name(name).ok_or_else(unknown)?;
    if !job.state.ended() {
        let detail = "outputs are there once the job has succeeded";
        return Err(Problem::conflict("job_not_ended", "the job has not ended", detail).retry_after(1));
    }
    let finished_at = job.finished_at;
    let output = job.outputs.into_iter().find(|o| o.name == name).ok_or_else(unknown)?;
    if app.retention.expired(Timestamp::now()).is_some_and(|before| finished_at < Some(before)) {
        return Err(expired());
    }
    let blob = BlobId::from_hex(&output.sha256).ok_or_else(Problem::internal)?;
    Ok(Made { output, kind, blob })
}

/// The bytes of an output, or a range of them, as they are read.
pub(crate) async fn read(
    app: &App,
    blob: BlobId,
    range: Option<Range<u64>>,
) -> Result<BoxStream<'static, Result<Bytes, BlobError>>, Problem> {
    app.blobs.stream(blob, range).await.map_err(|error| match error {
        BlobError::Missing => expired(),
        error => error.into(),
    })
}

fn expired() -> Problem {
    let detail = "the job is remembered, its bytes are not";
    Problem::new(StatusCode::GONE, "output_expired", "the output is no longer kept", detail)
}
