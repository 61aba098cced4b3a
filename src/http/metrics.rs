//! `/metrics`: what is counted and measured, for Prometheus.

use super::{App, Problem, problem};
use crate::auth::{Caller, Scope};
use axum::Router;
use axum::extract::State;
use axum::http::{Uri, header};
use axum::response::IntoResponse;
use axum::routing::get;

/// The text format's own media type.
const TEXT: &str = "text/plain; version=0.0.4; charset=utf-8";

/// What is counted and measured
///
/// In the text format of Prometheus. Where `metrics_listen` is set it is served at that address and not here.
#[utoipa::path(
    get,
    path = "/metrics",
    tag = "operation",
    responses(
        (status = 200, description = "the metrics", content_type = "text/plain", body = String),
        (status = 404, description = "they are served at another address"),
    )
)]
pub async fn metrics(State(app): State<App>, caller: Caller, uri: Uri) -> Result<impl IntoResponse, Problem> {
    caller.may(Scope::Operate)?;
    if app.metrics_apart {
        return Err(problem::unknown_route(uri).await);
    }
    Ok(answer(&app).await)
}

/// What is served at an address of its own: the metrics and nothing else.
pub fn router(app: App) -> Router {
    Router::new().route("/metrics", get(async |State(app): State<App>| answer(&app).await)).with_state(app)
}

async fn answer(app: &App) -> impl IntoResponse + use<> {
    let text = app.metrics.render(app.engine.as_ref()).await;
    ([(header::CONTENT_TYPE, TEXT), (header::CACHE_CONTROL, "no-store")], text)
}
