//! Problem documents (RFC 9457): every answer that is not a success, and the one place that maps errors to them.
//!
//! Handlers return a [`Problem`]; the request's middleware writes it, because only that knows the request's id. Internal
//! detail goes to the log and never into a problem.

use super::rates;
use crate::blobs::BlobError;
use crate::engine::EngineError;
use crate::field::Fault;
use crate::job::Failure;
use crate::job::failure::{FaultView, TYPE_PREFIX};
use axum::Json;
use axum::body::Body;
use axum::http::{HeaderMap, HeaderName, HeaderValue, Method, StatusCode, Uri, header};
use axum::response::{IntoResponse, Response};
use serde::Serialize;

/// What went wrong with a request; small, because every handler may return it.
#[derive(Clone, Debug)]
pub struct Problem(Box<Parts>);

#[derive(Clone, Debug)]
struct Parts {
    status: StatusCode,
    code: String,
    title: String,
    detail: String,
    errors: Vec<FaultView>,
    headers: Vec<(HeaderName, HeaderValue)>,
}

/// A problem as it is written.
#[derive(Serialize, utoipa::ToSchema)]
#[schema(as = Problem)]
pub struct ProblemDocument {
    /// Stable name of the problem type: `urn:shrinkd:problem:` and the code.
    #[serde(rename = "type")]
    kind: String,
    /// What kind of problem it is, the same for every occurrence.
    title: String,
    /// The HTTP status.
    status: u16,
    /// The last part of the type.
    code: String,
    /// What is wrong this time.
    detail: String,
    /// The request's id, as in the log and in the header `x-request-id`.
    request_id: String,
    /// Faults by place, for a request that was understood and is wrong.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    errors: Vec<FaultView>,
}

impl Problem {
    /// A problem with a code (stable, part of its type) and a title.
    pub fn new(status: StatusCode, code: &str, title: &str, detail: impl Into<String>) -> Self {
        let (code, title, detail) = (code.to_owned(), title.to_owned(), detail.into());
        Self(Box::new(Parts { status, code, title, detail, errors: Vec::new(), headers: Vec::new() }))
    }

    /// The same problem with a header.
    pub fn with_header(mut self, name: HeaderName, value: impl Into<HeaderValue>) -> Self {
        self.0.headers.push((name, value.into()));
        self
    }

    fn with_errors(mut self, errors: Vec<FaultView>) -> Self {
        self.0.errors = errors;
        self
    }

    /// The same problem, with a hint when to try again.
    pub fn retry_after(self, seconds: u32) -> Self {
        self.with_header(header::RETRY_AFTER, seconds)
    }

    /// The stable code.
    pub fn code(&self) -> &str {
        &self.0.code
    }
    /// What is wrong this time.
    pub fn detail(&self) -> &str {
        &self.0.detail
    }
    /// The HTTP status.
    pub fn status(&self) -> StatusCode {
        self.0.status
    }
    /// Stable name of the problem type.
    pub fn kind(&self) -> String {
        format!("{TYPE_PREFIX}{}", self.0.code)
    }
    /// What kind of problem it is.
    pub fn title(&self) -> &str {
        &self.0.title
    }
    /// Faults by place.
    pub fn errors(&self) -> &[FaultView] {
        &self.0.errors
    }
    /// Seconds after which to try again, where that is known.
    pub fn retry_after_s(&self) -> Option<u64> {
        let header = self.0.headers.iter().find(|(name, _)| name == header::RETRY_AFTER);
        header.and_then(|(_, value)| value.to_str().ok()?.parse().ok())
    }

    /// 400: the request breaks a syntax.
    pub fn bad_request(code: &str, title: &str, detail: impl Into<String>) -> Self {
        Self::new(StatusCode::BAD_REQUEST, code, title, detail)
    }
    /// 400: a query parameter is wrong.
    pub fn query(detail: impl Into<String>) -> Self {
        Self::bad_request("invalid_query", "a query parameter is invalid", detail)
    }
    /// 400: query parameters are wrong; the faults' pointers begin with the parameter's name.
    pub fn parameters(faults: &[Fault]) -> Self {
        let said = faults.iter().map(|f| format!("{}: {}", f.pointer.trim_start_matches('/'), f.detail));
        Self::query(said.collect::<Vec<_>>().join("; "))
    }
    /// 400: a header is wrong.
    pub fn header(detail: impl Into<String>) -> Self {
        Self::bad_request("invalid_header", "a header is invalid", detail)
    }
    /// 404: there is no such thing.
    pub fn not_found(code: &str, title: &str, detail: impl Into<String>) -> Self {
        Self::new(StatusCode::NOT_FOUND, code, title, detail)
    }
    /// 404: there is no such job.
    pub fn unknown_job(id: &str) -> Self {
        Self::not_found("unknown_job", "there is no such job", format!("no job {id:?} is known"))
    }
    /// 409: not in this state.
    pub fn conflict(code: &str, title: &str, detail: impl Into<String>) -> Self {
        Self::new(StatusCode::CONFLICT, code, title, detail)
    }
    /// 413: too large.
    pub fn too_large(limit: u64) -> Self {
        let detail = format!("the body is larger than the {limit} bytes that are allowed here");
        Self::new(StatusCode::PAYLOAD_TOO_LARGE, "body_too_large", "the body is too large", detail)
    }
    /// 422: understood, and wrong; faults are pointed to below `prefix`.
    pub fn invalid_request(prefix: &str, faults: &[Fault]) -> Self {
        let detail = match faults {
            [one] => format!("{} at {:?}", one.detail, format!("{prefix}{}", one.pointer)),
            many => format!("{} members are wrong", many.len()),
        };
        let errors = faults.iter().map(|f| FaultView::below(prefix, f)).collect();
        Self::unprocessable("invalid_request", "the request is invalid", detail).with_errors(errors)
    }
    /// 422 with another code.
    pub fn unprocessable(code: &str, title: &str, detail: impl Into<String>) -> Self {
        Self::new(StatusCode::UNPROCESSABLE_ENTITY, code, title, detail)
    }
    /// 500: something inside failed; the log has the cause under the request's id.
    pub fn internal() -> Self {
        let detail = "the service failed; the log has the cause under the request's id";
        Self::new(StatusCode::INTERNAL_SERVER_ERROR, "internal", "internal error", detail)
    }
    /// 503: not now.
    pub fn unavailable(code: &str, detail: impl Into<String>) -> Self {
        Self::new(StatusCode::SERVICE_UNAVAILABLE, code, "the service is not available now", detail).retry_after(5)
    }

    /// The problem behind a bare status, such as a rejection by the framework.
    pub fn from_status(status: StatusCode) -> Self {
        match status {
            StatusCode::INTERNAL_SERVER_ERROR => Self::internal(),
            StatusCode::NOT_FOUND => Self::not_found("not_found", "there is nothing here", "the path leads nowhere"),
            _ => {
                let title = status.canonical_reason().unwrap_or("error").to_lowercase();
                let code = title.replace(|c: char| !c.is_ascii_alphanumeric(), "_");
                Self::new(status, &code, &title, "the request was refused")
            }
        }
    }
}

impl IntoResponse for Problem {
    fn into_response(self) -> Response {
        let mut response = self.0.status.into_response();
        response.extensions_mut().insert(self);
        response
    }
}

/// Writes the document, keeping the headers that the answer had (such as `Allow`).
pub(super) fn render(refused: &Problem, request_id: &str, response: Response) -> Response {
    let problem = refused.0.as_ref();
    let document = ProblemDocument {
        kind: refused.kind(),
        title: problem.title.clone(),
        status: problem.status.as_u16(),
        code: problem.code.clone(),
        detail: problem.detail.clone(),
        request_id: request_id.to_owned(),
        errors: problem.errors.clone(),
    };
    let (parts, _) = response.into_parts();
    let mut headers: HeaderMap = parts.headers;
    headers.remove(header::CONTENT_LENGTH);
    for (name, value) in &problem.headers {
        // an answer may tell of several quotas
        if rates::tells(name) {
            headers.append(name, value.clone())
        } else {
            headers.insert(name, value.clone()).is_some()
        };
    }
    headers.insert(header::CONTENT_TYPE, HeaderValue::from_static("application/problem+json"));
    headers.insert(header::CACHE_CONTROL, HeaderValue::from_static("no-store"));
    let body: Body = Json(document).into_response().into_body();
    let mut response = (problem.status, headers, body).into_response();
    // whoever speaks another language around this one tells it in that
    response.extensions_mut().insert(refused.clone());
    response
}

/// 404 for a path that is not served.
pub(super) async fn unknown_route(uri: Uri) -> Problem {
    Problem::not_found("unknown_route", "there is nothing at this path", format!("no route for {:?}", uri.path()))
}

/// 405; the framework adds `Allow`.
pub(super) async fn wrong_method(method: Method, uri: Uri) -> Problem {
    let detail = format!("{method} is not offered at {:?}", uri.path());
    Problem::new(StatusCode::METHOD_NOT_ALLOWED, "method_not_allowed", "the method is not offered here", detail)
}

/// 500 for a handler that panicked.
pub(super) fn panicked(panic: Box<dyn std::any::Any + Send>) -> Response {
    let message = panic.downcast_ref::<&str>().map(|s| (*s).to_owned());
    let message = message.or_else(|| panic.downcast_ref::<String>().cloned()).unwrap_or_default();
    tracing::error!(panic = message, "a handler panicked");
    Problem::internal().into_response()
}

impl From<EngineError> for Problem {
    fn from(error: EngineError) -> Self {
        tracing::error!(%error, "the engine failed");
        match error {
            EngineError::Stopped => Self::unavailable("stopping", "the service is stopping"),
            EngineError::Store(_) => Self::unavailable("engine_unavailable", "the queue is out of reach"),
            EngineError::Fenced { .. } => Self::internal(),
        }
    }
}

impl From<BlobError> for Problem {
    fn from(error: BlobError) -> Self {
        tracing::error!(%error, "the blob store failed");
        match error {
            BlobError::Store(_) => Self::unavailable("blobs_unavailable", "the blob store is out of reach"),
            BlobError::Missing | BlobError::Damaged(_) => Self::internal(),
        }
    }
}

impl From<Failure> for Problem {
    fn from(failure: Failure) -> Self {
        Self::unprocessable(&failure.code, &failure.title, failure.detail).with_errors(failure.errors)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::BTreeSet;
    use std::path::Path;

    type Codes = BTreeSet<String>;

    /// A file of the repository; of a source what comes before its tests.
    fn file(path: impl AsRef<Path>) -> String {
        let text = std::fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join(path)).expect("reads");
        text.split("#[cfg(test)]").next().unwrap_or_default().to_owned()
    }

    fn is_code(text: &str) -> bool {
        !text.is_empty() && text.bytes().all(|b| b.is_ascii_lowercase() || b == b'_')
    }

    /// The first words in quotes after every use of a constructor, in all files of a folder.
    fn codes(folder: &str) -> Codes {
        const CONSTRUCTORS: [&str; 8] = [
            "bad_request(",
            "not_found(",
            "conflict(",
            "unprocessable(",
            "unavailable(",
            "Problem::new(",
            "Failure::new(",
            "Self::new(",
        ];
        let mut found = Codes::new();
        let entries = std::fs::read_dir(Path::new(env!("CARGO_MANIFEST_DIR")).join(folder)).expect("reads");
        for entry in entries.map(|entry| entry.expect("entry")) {
            let path = format!("{folder}/{}", entry.file_name().to_str().expect("text"));
            if entry.path().is_dir() {
                found.extend(codes(&path));
                continue;
            }
            let code = file(path);
            for call in CONSTRUCTORS.iter().flat_map(|constructor| code.split(constructor).skip(1)) {
                let first = call.split('"').nth(1).unwrap_or_default();
                let close = call.find(['"', ')', ';']);
                if is_code(first) && close.is_some_and(|at| call.as_bytes()[at] == b'"') {
                    found.insert(first.to_owned());
                }
            }
        }
        found
    }

    /// Codes of faults, which come first in their calls or right after a pointer.
    fn faults(path: &str, calls: &[&str]) -> Codes {
        let code = file(path);
        let calls = calls.iter().flat_map(|call| code.split(call).skip(1));
        let texts = calls.filter_map(|call| {
            let quoted = call.split(';').next().unwrap_or_default().split('"').skip(1).step_by(2);
            quoted.take(2).find(|text| is_code(text)).map(str::to_owned)
        });
        texts.collect()
    }

    /// The codes in a column of the tables below a heading of docs/problems.md.
    fn documented(heading: &str, column: usize) -> Codes {
        let text = file("docs/problems.md");
        let below = text.split(&format!("\n## {heading}\n")).nth(1).unwrap_or_else(|| panic!("no heading {heading:?}"));
        let section = below.split("\n## ").next().unwrap_or_default();
        let cells = section.lines().filter_map(|line| line.strip_prefix("| ")?.split(" | ").nth(column));
        cells.flat_map(|cell| cell.split('`').skip(1).step_by(2).map(str::to_owned)).collect()
    }

    fn missing<'a>(found: &'a Codes, documented: &'a Codes) -> Vec<&'a String> {
        found.difference(documented).collect()
    }

    #[test]
    fn every_code_of_a_refusal_is_documented() {
        let mut found = codes("src/http");
        found.extend(codes("src/grpc"));
        // what layers around the handlers refuse: a path that is no text, and what no route knows
        for status in [StatusCode::BAD_REQUEST, StatusCode::NOT_FOUND, StatusCode::INTERNAL_SERVER_ERROR] {
            found.insert(Problem::from_status(status).code().to_owned());
        }
        found.insert(Problem::from(Failure::memory_exceeded(2, 1)).code().to_owned());
        assert!(found.len() > 30 && found.contains("insufficient_scope"), "{found:?}");
        assert_eq!(missing(&found, &documented("Of requests", 1)), Vec::<&String>::new());
    }

    #[test]
    fn every_code_of_a_job_that_failed_is_documented() {
        let mut found = codes("src/job");
        let shrink = file("src/shrink.rs");
        let of_shapes = shrink.split("pub fn code(&self)").nth(1).and_then(|rest| rest.split("\n    }\n").next());
        let of_shapes = of_shapes.expect("is there").split('"').skip(1).step_by(2);
        // a job that was canceled has not failed
        found.extend(of_shapes.filter(|code| *code != "canceled").map(str::to_owned));
        found.extend(["surface", "gradient"].map(|what| format!("malformed_{what}")));
        assert!(file("src/job/pipeline/sensing.rs").contains("malformed_{what}"));
        for code in ["genus", "diverged", "attempts_exhausted", "unknown_input", "malformed_input"] {
            assert!(found.contains(code), "{code} is not among {found:?}");
        }
        assert_eq!(missing(&found, &documented("Of jobs", 0)), Vec::<&String>::new());
    }

    #[test]
    fn the_codes_of_faults_are_those_that_are_documented() {
        let mut found = Codes::new();
        for path in [
            "src/field/input.rs",
            "src/field/input/network.rs",
            "src/field/input/options.rs",
            "src/field/scene/parse.rs",
            "src/grpc/message.rs",
            "src/http/jobs.rs",
            "src/http/jobs/estimate.rs",
            "src/http/jobs/warm_start.rs",
            "src/job/spec.rs",
            "src/job/spec/read.rs",
            "src/notify/target.rs",
        ] {
            found.extend(faults(path, &["fault(", "faults.add(", "refused(", "Err((", "code: "]));
        }
        // where faults are told by their member
        found.extend(faults("src/fit/spec.rs", &["code: "]));
        let documented = documented("Faults", 0);
        assert_eq!(missing(&found, &documented), Vec::<&String>::new(), "not documented");
        assert_eq!(missing(&documented, &found), Vec::<&String>::new(), "documented, and never told");
    }

    #[test]
    fn what_is_out_of_reach_is_no_fault_of_the_service() {
        let away = || "the cluster".to_owned();
        for (problem, code) in [
            (Problem::from(EngineError::Store(away())), "engine_unavailable"),
            (Problem::from(EngineError::Stopped), "stopping"),
        ] {
            assert_eq!((problem.status(), problem.code()), (StatusCode::SERVICE_UNAVAILABLE, code));
            assert!(problem.retry_after_s().is_some());
            assert!(!problem.detail().contains("cluster"), "the cause is for the log");
        }
    }
}
