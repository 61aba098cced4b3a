//! What every request gets: an id, a span, one line in the log, and a problem document when it fails.

use super::problem::{self, Problem};
use crate::telemetry::{metrics, traces};
use axum::extract::{MatchedPath, Request};
use axum::http::{HeaderName, HeaderValue};
use axum::middleware::Next;
use axum::response::Response;
use std::time::Instant;
use tracing::Instrument as _;
use tracing::field::Empty;

/// The header that carries a request's id, in both directions.
pub const REQUEST_ID: HeaderName = HeaderName::from_static("x-request-id");
/// Characters of an id that a client may choose; longer ones are replaced.
const MAX_REQUEST_ID: usize = 128;

/// Wraps every request.
pub async fn request(mut request: Request, next: Next) -> Response {
    let id = request_id(&request);
    let route = request.extensions().get::<MatchedPath>().map_or("", |path| path.as_str()).to_owned();
    let span = tracing::info_span!("request", request.id = %id, http.method = %request.method(), http.path = request.uri().path(), http.route = route, trace.id = Empty);
    traces::join(&span, request.headers().get(traces::TRACEPARENT).and_then(|value| value.to_str().ok()));
    let position = traces::position(&span);
    if let Some(position) = &position {
        span.record("trace.id", traces::trace_id(position));
    }
    let (clock, method) = (Instant::now(), request.method().clone());
    let id_header = HeaderValue::from_str(&id).unwrap_or_else(|_| HeaderValue::from_static("invalid"));
    request.headers_mut().insert(REQUEST_ID, id_header.clone());
    async move {
        let response = next.run(request).await;
        let status = response.status();
        let mut response = if status.is_client_error() || status.is_server_error() {
            // every failure leaves as a problem document, whoever made it
            let problem = response.extensions().get::<Problem>().cloned();
            let problem = problem.unwrap_or_else(|| Problem::from_status(status));
            tracing::debug!(problem.code = problem.code(), problem.detail = problem.detail(), "request refused");
            problem::render(&problem, &id, response)
        } else {
            response
        };
        response.headers_mut().insert(REQUEST_ID, id_header);
        if let Some(position) = position.and_then(|position| HeaderValue::from_str(&position).ok()) {
            response.headers_mut().insert(traces::TRACERESPONSE, position);
        }
        let elapsed = clock.elapsed();
        metrics::request_answered(&method, &route, status.as_u16(), elapsed);
        let elapsed_ms = (elapsed.as_secs_f64() * 1e6).round() / 1e3;
        tracing::info!(http.status = status.as_u16(), elapsed_ms, "request answered");
        response
    }
    .instrument(span)
    .await
}

/// The client's own id where it is a short printable one, else a new one.
fn request_id(request: &Request) -> String {
    let given = request.headers().get(REQUEST_ID).and_then(|id| id.to_str().ok());
    match given {
        Some(id) if !id.is_empty() && id.len() <= MAX_REQUEST_ID && id.bytes().all(|b| b.is_ascii_graphic()) => {
            id.to_owned()
        }
        _ => uuid::Uuid::now_v7().to_string(),
    }
}
