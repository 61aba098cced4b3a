//! The service over HTTP: translates requests into the rooms below, and never computes.
//!
//! Guarantees: every answer that is not a success is a problem document (RFC 9457); nothing is promised in an answer before
//! it is durable; no handler keeps state that another node would miss. Every stream and every long poll ends when the
//! service stops.

pub mod body;
pub mod caller;
pub mod conditional;
pub mod context;
pub mod events;
pub mod health;
pub mod inputs;
pub mod jobs;
pub mod list;
pub mod metrics;
pub mod openapi;
pub mod outputs;
pub mod page;
pub mod problem;
pub mod query;
pub mod rates;
pub mod server;
mod web;

pub use problem::Problem;

use crate::auth::Authenticator;
use crate::blobs::Blobs;
use crate::config::{Limits, Retention, WebhooksConfig};
use crate::engine::Engine;
use crate::telemetry::metrics::Exposition;
use axum::http::HeaderValue;
use axum::middleware;
use caller::Door;
use rates::Rates;
use std::sync::Arc;
use std::time::Duration;
use tokio_util::sync::CancellationToken;
use tower_http::catch_panic::CatchPanicLayer;
use tower_http::cors::CorsLayer;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

/// Whether the page for a person was built into this program.
pub fn has_page() -> bool {
    web::is_built()
}

/// What handlers work with.
#[derive(Clone)]
pub struct App {
    /// Queue and records.
    pub engine: Arc<dyn Engine>,
    /// Bytes.
    pub blobs: Blobs,
    /// Sizes that requests may have.
    pub limits: Limits,
    /// Bytes of memory that a job may be estimated to take, where that is limited.
    pub job_memory: Option<u64>,
    /// How long outputs are kept.
    pub retention: Retention,
    /// How long a link into the bucket is good for that a download is answered with; zero sends the bytes.
    pub download_link: Duration,
    /// What is counted and measured.
    pub metrics: Exposition,
    /// Whether that is served at an address of its own.
    pub metrics_apart: bool,
    /// Who may be told of the ends of jobs.
    pub webhooks: Arc<WebhooksConfig>,
    /// How often tenants may ask this node.
    pub rates: Arc<Rates>,
    /// Room for uploads.
    pub upload_room: body::Room,
    /// Raised when the service stops.
    pub stop: CancellationToken,
}

/// Every route, with its description.
fn api() -> OpenApiRouter<App> {
    OpenApiRouter::with_openapi(openapi::base())
        // uploaded once, used by many jobs
        .routes(routes!(inputs::upload))
        .routes(routes!(inputs::describe))
        // the life of a job
        .routes(routes!(jobs::submit, list::list))
        .routes(routes!(jobs::get, jobs::forget))
        .routes(routes!(jobs::cancel))
        .routes(routes!(jobs::request::show))
        .routes(routes!(jobs::sensitivity::differentiate))
        .routes(routes!(events::events))
        .routes(routes!(outputs::download))
        // for whoever operates it
        .routes(routes!(health::livez))
        .routes(routes!(health::readyz))
        .routes(routes!(openapi::openapi_json))
        .routes(routes!(metrics::metrics))
        // for a person
        .routes(routes!(page::page))
        .routes(routes!(page::plain))
}

/// The description of the service, as it is pinned in `openapi.yaml`.
pub fn document() -> utoipa::openapi::OpenApi {
    openapi::complete(api().into_openapi())
}

/// What a node that only runs jobs answers: whether it lives and is ready, and what is measured. `others` are routes that get the same around them.
pub fn health_router(app: App, others: axum::Router) -> axum::Router {
    let (router, _) = OpenApiRouter::<App>::default()
        .routes(routes!(health::livez))
        .routes(routes!(health::readyz))
        .routes(routes!(metrics::metrics))
        .split_for_parts();
    let router = router.fallback(problem::unknown_route).method_not_allowed_fallback(problem::wrong_method);
    // it has nothing of any tenant
    let door = Door { authenticator: None, rates: Arc::default() };
    wrapped(router.with_state(app).merge(others), door, &[])
}

/// The service, for those whom the authenticator knows, or for everybody where there is none. Browsers of other origins are let in only when `cors_origins` names them. `others` are routes that get the same around them.
pub fn router(
    app: App,
    authenticator: Option<Arc<Authenticator>>,
    cors_origins: &[String],
    others: axum::Router,
) -> axum::Router {
    let (router, _) = api().split_for_parts();
    let door = Door { authenticator, rates: app.rates.clone() };
    let router = router.merge(web::routes());
    let router = router.fallback(problem::unknown_route).method_not_allowed_fallback(problem::wrong_method);
    wrapped(router.with_state(app).merge(others), door, cors_origins)
}

/// What every route has around it, from the inside out: an answer where a handler panics, who asks, what browsers are told about
/// other origins, and the id, the line in the log and the problem document of [`context`].
fn wrapped(router: axum::Router, door: Door, cors_origins: &[String]) -> axum::Router {
    let mut router = router
        .layer(CatchPanicLayer::custom(problem::panicked))
        .layer(middleware::from_fn_with_state(door, caller::identify));
    if !cors_origins.is_empty() {
        let origins: Vec<HeaderValue> = cors_origins.iter().filter_map(|o| o.parse().ok()).collect();
        let cors = CorsLayer::new().allow_origin(origins).allow_methods(tower_http::cors::Any);
        // a wildcard would not include Authorization
        router = router.layer(
            cors.allow_headers(tower_http::cors::AllowHeaders::mirror_request()).expose_headers(tower_http::cors::Any),
        );
    }
    router.layer(middleware::from_fn(context::request))
}

#[cfg(test)]
mod tests {
    use super::*;
    use axum::body::Body;
    use axum::http::{Request, StatusCode};
    use axum::routing::get;
    use tower::ServiceExt;

    async fn panics() -> &'static str {
        panic!("a secret of the inside")
    }

    #[tokio::test]
    async fn a_handler_that_panics_is_answered_with_a_problem_that_names_the_request() {
        let door = Door { authenticator: None, rates: Arc::default() };
        let routes = axum::Router::new().route("/panics", get(panics)).route("/works", get(async || "works"));
        let router = wrapped(routes, door, &["https://viewer.example".to_owned()]);
        let ask = async |path: &str| {
            let request =
                Request::builder().uri(path).header("x-request-id", "r-1").header("origin", "https://viewer.example");
            let request = request.body(Body::empty()).expect("a request");
            router.clone().oneshot(request).await.expect("an answer")
        };
        let answer = ask("/panics").await;
        assert_eq!(answer.status(), StatusCode::INTERNAL_SERVER_ERROR);
        assert_eq!(answer.headers()["content-type"], "application/problem+json");
        assert_eq!(answer.headers()["x-request-id"], "r-1");
        assert_eq!(answer.headers()["access-control-allow-origin"], "https://viewer.example", "a page can read it");
        let body = axum::body::to_bytes(answer.into_body(), 1 << 16).await.expect("a body");
        let body: serde_json::Value = serde_json::from_slice(&body).expect("JSON");
        assert_eq!((&body["code"], &body["status"]), (&"internal".into(), &500.into()));
        assert_eq!(body["request_id"], "r-1");
        assert!(!body.to_string().contains("secret"), "what was said inside stays there: {body}");
        assert_eq!(ask("/works").await.status(), StatusCode::OK, "the others go on");
    }
}
