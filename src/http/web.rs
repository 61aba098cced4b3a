//! The page for a person, as `web/` builds it, and the interface's description as Swagger UI shows it: files inside the program,
//! which need no other host. They are the same for everybody; what is whose comes from the routes that the page asks.

use super::conditional::names_tag;
use super::{App, Problem};
use crate::blobs::BlobId;
use axum::body::Bytes;
use axum::extract::Path;
use axum::http::{HeaderMap, HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Redirect, Response};
use axum::routing::get;
use axum::{Router, body::Body};
use std::sync::{Arc, LazyLock};
use utoipa_swagger_ui::{Config, SwaggerFile};

/// `(path, bytes, the same compressed by gzip)`; empty where the page was not built.
type Files = &'static [(&'static str, &'static [u8], &'static [u8])];

static PAGE: Files = include!(concat!(env!("OUT_DIR"), "/page.rs"));

/// Entity tags of the files, in their order. They are weak: what is sent may be compressed.
static TAGS: LazyLock<Vec<String>> =
    LazyLock::new(|| PAGE.iter().map(|(_, plain, _)| format!("W/\"{}\"", BlobId::of(plain).hex())).collect());

/// Nothing runs that did not come with the page, and nothing comes from elsewhere.
const PAGE_POLICY: &str = "default-src 'self'; img-src 'self' data: blob:; connect-src 'self' blob: data:; worker-src 'self' blob:; \
                           base-uri 'none'; form-action 'none'; frame-ancestors 'none'";
/// Swagger UI sets styles in its markup.
const DOCS_POLICY: &str = "default-src 'self'; img-src 'self' data:; style-src 'self' 'unsafe-inline'; base-uri 'none'; \
                           form-action 'none'; frame-ancestors 'none'";
/// Names of assets carry a hash of their content.
const FOREVER: &str = "public, max-age=31536000, immutable";

/// Where the description is shown.
const DOCS: &str = "/docs";

/// What is served to everybody, whoever asks.
pub(super) fn is_open(path: &str) -> bool {
    match path {
        "/" => is_built(),
        DOCS => true,
        _ => path.starts_with("/assets/") || path.starts_with("/docs/"),
    }
}

/// Whether the page is in this program.
pub(super) fn is_built() -> bool {
    PAGE.iter().any(|(name, ..)| *name == "index.html")
}

/// The page, where it was built.
pub(super) fn index(headers: &HeaderMap) -> Option<Response> {
    file("index.html", headers, "no-cache")
}

/// The routes of files.
pub(super) fn routes() -> Router<App> {
    Router::new()
        .route("/assets/{*path}", get(asset))
        .route(DOCS, get(|| async { Redirect::permanent("/docs/") }))
        .route("/docs/", get(|| async { docs("index.html") }))
        .route("/docs/{*path}", get(|Path(path): Path<String>| async move { docs(&path) }))
}

async fn asset(Path(path): Path<String>, headers: HeaderMap) -> Result<Response, Problem> {
    file(&format!("assets/{path}"), &headers, FOREVER).ok_or_else(unknown_file)
}

fn unknown_file() -> Problem {
    Problem::not_found("unknown_route", "there is nothing at this path", "the page has no such file")
}

fn file(path: &str, headers: &HeaderMap, cache: &'static str) -> Option<Response> {
    let index = PAGE.iter().position(|(name, ..)| *name == path)?;
    let ((_, plain, packed), tag) = (PAGE[index], &TAGS[index]);
    let mut answer = HeaderMap::new();
    answer.insert(header::ETAG, HeaderValue::from_str(tag).ok()?);
    answer.insert(header::CACHE_CONTROL, HeaderValue::from_static(cache));
    answer.insert(header::VARY, HeaderValue::from_static("accept-encoding"));
    if names_tag(headers, header::IF_NONE_MATCH, tag) {
        return Some((StatusCode::NOT_MODIFIED, answer).into_response());
    }
    answer.insert(header::CONTENT_TYPE, HeaderValue::from_static(media_type(path)));
    answer.insert(header::CONTENT_SECURITY_POLICY, HeaderValue::from_static(PAGE_POLICY));
    answer.insert(header::X_CONTENT_TYPE_OPTIONS, HeaderValue::from_static("nosniff"));
    answer.insert(header::REFERRER_POLICY, HeaderValue::from_static("no-referrer"));
    let body = if takes_gzip(headers) {
        answer.insert(header::CONTENT_ENCODING, HeaderValue::from_static("gzip"));
        packed
    } else {
        plain
    };
    Some((answer, Body::from(Bytes::from_static(body))).into_response())
}

fn takes_gzip(headers: &HeaderMap) -> bool {
    let accepted = headers.get_all(header::ACCEPT_ENCODING).iter().filter_map(|value| value.to_str().ok());
    accepted.flat_map(|value| value.split(',')).any(|coding| {
        let (name, weight) = coding.split_once(';').unwrap_or((coding, ""));
        name.trim().eq_ignore_ascii_case("gzip") && !matches!(weight.trim(), "q=0" | "q=0.0" | "q=0.00" | "q=0.000")
    })
}

fn media_type(path: &str) -> &'static str {
    match path.rsplit_once('.').map_or("", |(_, extension)| extension) {
        "html" => "text/html; charset=utf-8",
        "js" => "text/javascript; charset=utf-8",
        "css" => "text/css; charset=utf-8",
        "svg" => "image/svg+xml",
        "png" => "image/png",
        "json" => "application/json",
        "wasm" => "application/wasm",
        "woff2" => "font/woff2",
        _ => "application/octet-stream",
    }
}

/// A file of Swagger UI, which shows `/openapi.json`.
fn docs(path: &str) -> Response {
    static CONFIG: LazyLock<Arc<Config<'static>>> =
        LazyLock::new(|| Arc::new(Config::from("/openapi.json").try_it_out_enabled(true)));
    match utoipa_swagger_ui::serve(path, CONFIG.clone()) {
        Ok(Some(SwaggerFile { bytes, content_type, .. })) => {
            let headers = [
                (header::CONTENT_TYPE, content_type.as_str()),
                (header::CONTENT_SECURITY_POLICY, DOCS_POLICY),
                (header::X_CONTENT_TYPE_OPTIONS, "nosniff"),
                (header::CACHE_CONTROL, "no-cache"),
            ];
            (headers, bytes.into_owned()).into_response()
        }
        Ok(None) => unknown_file().into_response(),
        Err(error) => {
            tracing::error!(%error, "Swagger UI could not be served");
            Problem::internal().into_response()
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gzip_is_sent_to_whom_takes_it() {
        let takes =
            |value: &str| takes_gzip(&HeaderMap::from_iter([(header::ACCEPT_ENCODING, value.parse().unwrap())]));
        assert!(takes("gzip") && takes("br, GZip;q=0.5") && takes("gzip, deflate, br"));
        assert!(!takes("gzip;q=0") && !takes("br") && !takes("x-gzip"));
    }

    #[test]
    fn what_is_open_is_the_same_for_everybody() {
        assert!(is_open("/docs") && is_open("/docs/index.html") && is_open("/assets/index-1.js"));
        assert!(!is_open("/v1/jobs") && !is_open("/plain") && !is_open("/docsx") && !is_open("/assets"));
        assert_eq!(is_open("/"), is_built(), "the page without scripts shows jobs of a tenant");
    }
}
