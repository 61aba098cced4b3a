//! Problems as gRPC tells them: a status code, and the problem's parts in `google.rpc` details.
//!
//! Details travel in a header, which clients bound to a few kilobytes: long texts are cut, and of many faults the first are told.

use crate::http::Problem;
use axum::http::StatusCode;
use std::collections::HashMap;
use std::time::Duration;
use tonic::{Code, Status};
use tonic_types::{ErrorDetails, FieldViolation, StatusExt as _};

/// What errors are told to be of.
pub const DOMAIN: &str = "shrinkd";
/// Bytes of the faults that one status tells.
const FAULTS: usize = 2048;
/// Bytes of one text.
const TEXT: usize = 512;

/// The status of a problem of the request with that id.
pub fn status(problem: &Problem, request_id: &str) -> Status {
    let parts = [("type", problem.kind()), ("title", problem.title().to_owned())];
    let parts: HashMap<String, String> = parts.map(|(name, value)| (name.to_owned(), value)).into();
    let mut details = ErrorDetails::with_error_info(problem.code(), DOMAIN, parts);
    details.set_request_info(request_id, "");
    let mut room = FAULTS;
    let faults = problem.errors().iter().map_while(|fault| {
        let description = format!("{}: {}", fault.code, cut(&fault.detail));
        room = room.checked_sub(fault.pointer.len() + description.len())?;
        Some(FieldViolation::new(&fault.pointer, description))
    });
    let faults: Vec<FieldViolation> = faults.collect();
    if !faults.is_empty() {
        details.set_bad_request(faults);
    }
    if let Some(seconds) = problem.retry_after_s() {
        details.set_retry_info(Some(Duration::from_secs(seconds)));
    }
    Status::with_error_details(code(problem), cut(problem.detail()), details)
}

/// The code that says the same as the problem's HTTP status.
fn code(problem: &Problem) -> Code {
    match (problem.code(), problem.status()) {
        ("unknown_route" | "not_found", _) => Code::Unimplemented,
        (_, StatusCode::BAD_REQUEST | StatusCode::UNPROCESSABLE_ENTITY) => Code::InvalidArgument,
        (_, StatusCode::UNAUTHORIZED) => Code::Unauthenticated,
        (_, StatusCode::FORBIDDEN) => Code::PermissionDenied,
        (_, StatusCode::NOT_FOUND | StatusCode::GONE) => Code::NotFound,
        (_, StatusCode::CONFLICT) => Code::FailedPrecondition,
        (_, StatusCode::PAYLOAD_TOO_LARGE | StatusCode::RANGE_NOT_SATISFIABLE) => Code::OutOfRange,
        (_, StatusCode::TOO_MANY_REQUESTS) => Code::ResourceExhausted,
        (_, StatusCode::METHOD_NOT_ALLOWED | StatusCode::NOT_IMPLEMENTED) => Code::Unimplemented,
        (_, StatusCode::REQUEST_TIMEOUT | StatusCode::GATEWAY_TIMEOUT) => Code::DeadlineExceeded,
        (_, StatusCode::SERVICE_UNAVAILABLE | StatusCode::BAD_GATEWAY) => Code::Unavailable,
        (_, status) if status.is_client_error() => Code::FailedPrecondition,
        _ => Code::Internal,
    }
}

/// A text that fits, cut between two characters.
fn cut(text: &str) -> String {
    if text.len() <= TEXT {
        return text.to_owned();
    }
    let end = (0..=TEXT).rev().find(|&i| text.is_char_boundary(i)).unwrap_or(0);
    format!("{}...", &text[..end])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::field::Fault;

    #[test]
    fn a_problem_keeps_its_code_its_place_and_its_request() {
        let fault = Fault { pointer: "/field".to_owned(), code: "missing_member", detail: "give a field".to_owned() };
        let status = status(&Problem::invalid_request("", &[fault]), "r-1");
        assert_eq!(status.code(), Code::InvalidArgument);
        let details = status.get_error_details();
        assert_eq!(details.error_info().map(|info| info.reason.as_str()), Some("invalid_request"));
        assert_eq!(details.request_info().map(|info| info.request_id.as_str()), Some("r-1"));
        let faults = &details.bad_request().expect("faults").field_violations;
        assert_eq!(
            (faults[0].field.as_str(), faults[0].description.as_str()),
            ("/field", "missing_member: give a field")
        );
    }

    #[test]
    fn a_problem_with_many_long_faults_fits_into_a_header() {
        let fault = |i| Fault { pointer: format!("/f/{i}"), code: "wrong_type", detail: "\u{e4}".repeat(2000) };
        let faults: Vec<Fault> = (0..32).map(fault).collect();
        let status = status(&Problem::invalid_request("", &faults), "r");
        // the default of widely used clients is 8 KiB for all headers together, and base64 takes a third more
        assert!(status.details().len() * 4 / 3 + status.message().len() < 6000, "{}", status.details().len());
        let told = status.get_error_details().bad_request().expect("faults").field_violations.len();
        assert!((1..32).contains(&told), "{told}");
    }

    #[test]
    fn a_hint_when_to_come_back_is_kept() {
        let status = status(&Problem::unavailable("stopping", "the service is stopping"), "r");
        assert_eq!(status.code(), Code::Unavailable);
        let retry = status.get_error_details();
        assert_eq!(retry.retry_info().and_then(|info| info.retry_delay), Some(Duration::from_secs(5)));
    }
}
