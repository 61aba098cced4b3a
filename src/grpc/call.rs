//! What every call gets: its deadline, and refusals as gRPC tells them.

use super::refusal;
use crate::http::Problem;
use crate::http::context::REQUEST_ID;
use axum::extract::Request;
use axum::http::{HeaderMap, Method, StatusCode, header};
use axum::middleware::Next;
use axum::response::{IntoResponse as _, Response};
use std::time::Duration;
use tokio::time::Instant;

/// The media type of a call.
const GRPC: &str = "application/grpc";
/// Longest time a client may ask for; more is as good as none.
const LONGEST: Duration = Duration::from_secs(365 * 24 * 3600);

/// When a call ends, whether it is done or not.
#[derive(Clone, Copy, Debug)]
pub struct Deadline(pub Instant);

/// Wraps every call: only what is one comes through, and no longer than its deadline.
pub async fn call(mut request: Request, next: Next) -> Response {
    if request.method() != Method::POST {
        let detail = format!("{} is not offered to gRPC", request.method());
        let title = "the method is not offered here";
        return Problem::new(StatusCode::METHOD_NOT_ALLOWED, "method_not_allowed", title, detail)
            .with_header(header::ALLOW, header::HeaderValue::from_static("POST"))
            .into_response();
    }
    if !is_call(request.headers()) {
        let detail = "expected application/grpc";
        let title = "the body has another media type";
        return Problem::new(StatusCode::UNSUPPORTED_MEDIA_TYPE, "unsupported_media_type", title, detail)
            .into_response();
    }
    let limit = match timeout(request.headers()) {
        Ok(limit) => limit,
        Err(problem) => return problem.into_response(),
    };
    let Some(limit) = limit else { return next.run(request).await };
    let deadline = Instant::now() + limit;
    request.extensions_mut().insert(Deadline(deadline));
    match tokio::time::timeout_at(deadline, next.run(request)).await {
        Ok(response) => response,
        Err(_) => exceeded().into_response(),
    }
}

/// The problem of a call that was not done in time.
pub fn exceeded() -> Problem {
    let detail = "the call's own deadline has passed; what it began may have been done";
    Problem::new(StatusCode::GATEWAY_TIMEOUT, "deadline_exceeded", "the deadline has passed", detail)
}

/// Tells the refusals of calls as gRPC does, whichever layer made them. Goes around everything else.
pub async fn speak(request: Request, next: Next) -> Response {
    if !is_call(request.headers()) {
        return next.run(request).await;
    }
    let response = next.run(request).await;
    if is_call(response.headers()) {
        return response;
    }
    let problem = response.extensions().get::<Problem>().cloned();
    let problem = problem.unwrap_or_else(|| match response.status() {
        // an answer of another route
        status if status.is_success() => Problem::from_status(StatusCode::NOT_FOUND),
        status => Problem::from_status(status),
    });
    let id = response.headers().get(REQUEST_ID).cloned();
    let text = id.as_ref().and_then(|id| id.to_str().ok()).unwrap_or_default();
    let mut response = refusal::status(&problem, text).into_http::<axum::body::Body>();
    if let Some(id) = id {
        response.headers_mut().insert(REQUEST_ID, id);
    }
    response
}

fn is_call(headers: &HeaderMap) -> bool {
    let media_type = headers.get(header::CONTENT_TYPE).and_then(|value| value.to_str().ok()).unwrap_or("");
    let essence = media_type.split(';').next().unwrap_or("").trim();
    essence == GRPC || essence.strip_prefix(GRPC).is_some_and(|rest| rest.starts_with('+'))
}

/// The time that a call may take: `grpc-timeout` is up to eight digits and a unit.
fn timeout(headers: &HeaderMap) -> Result<Option<Duration>, Problem> {
    let Some(given) = headers.get("grpc-timeout") else { return Ok(None) };
    let text = given.to_str().unwrap_or("?");
    let wrong =
        || Problem::header(format!("grpc-timeout: expected 1 to 8 digits and one of H M S m u n, found {text:?}"));
    let (digits, unit) = text.split_at_checked(text.len().saturating_sub(1)).ok_or_else(wrong)?;
    if digits.is_empty() || digits.len() > 8 || !digits.bytes().all(|b| b.is_ascii_digit()) {
        return Err(wrong());
    }
    let n: u64 = digits.parse().map_err(|_| wrong())?;
    let time = match unit {
        "H" => Duration::from_secs(n * 3600),
        "M" => Duration::from_secs(n * 60),
        "S" => Duration::from_secs(n),
        "m" => Duration::from_millis(n),
        "u" => Duration::from_micros(n),
        "n" => Duration::from_nanos(n),
        _ => return Err(wrong()),
    };
    Ok(Some(time.min(LONGEST)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use axum::http::HeaderValue;

    fn read(text: &'static str) -> Result<Option<Duration>, Problem> {
        timeout(&HeaderMap::from_iter([(
            header::HeaderName::from_static("grpc-timeout"),
            HeaderValue::from_static(text),
        )]))
    }

    #[test]
    fn timeouts_are_read_in_every_unit_and_refused_otherwise() {
        let known = [("2H", 7_200_000), ("3M", 180_000), ("4S", 4000), ("5m", 5), ("6000u", 6), ("7000000n", 7)];
        for (text, milliseconds) in known {
            assert_eq!(read(text).expect(text), Some(Duration::from_millis(milliseconds)), "{text}");
        }
        assert_eq!(read("99999999H").expect("long"), Some(LONGEST));
        for text in ["", "S", "1", "1s", "-1S", "123456789S", "1.5S"] {
            assert_eq!(read(text).expect_err(text).code(), "invalid_header");
        }
    }

    #[test]
    fn only_grpc_is_a_call() {
        let is = |text: &'static str| {
            is_call(&HeaderMap::from_iter([(header::CONTENT_TYPE, HeaderValue::from_static(text))]))
        };
        assert!(is("application/grpc") && is("application/grpc+proto") && is("application/grpc; charset=utf-8"));
        assert!(!is("application/grpc-web") && !is("application/json") && !is(""));
    }
}
