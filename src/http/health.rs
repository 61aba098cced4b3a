//! Whether the process lives, and whether it should be sent requests.

use super::{App, Problem};
use axum::Json;
use axum::extract::State;
use serde::Serialize;

/// How it is.
#[derive(Serialize, utoipa::ToSchema)]
pub struct Health {
    /// `ok`.
    status: &'static str,
    /// Version of the program.
    version: &'static str,
}

const OK: Health = Health { status: "ok", version: env!("CARGO_PKG_VERSION") };

/// Whether the process lives
#[utoipa::path(get, path = "/livez", tag = "operation", responses((status = 200, description = "it does", body = Health)))]
pub async fn livez() -> Json<Health> {
    Json(OK)
}

/// Whether requests can be served
#[utoipa::path(
    get,
    path = "/readyz",
    tag = "operation",
    responses(
        (status = 200, description = "they can", body = Health),
        (status = 503, description = "the service is stopping, or its engine or blob store is out of reach"),
    )
)]
pub async fn readyz(State(app): State<App>) -> Result<Json<Health>, Problem> {
    ready(&app).await?;
    Ok(Json(OK))
}

/// Whether requests can be served.
///
/// # Errors
/// 503 that says why they cannot.
pub async fn ready(app: &App) -> Result<(), Problem> {
    if app.stop.is_cancelled() {
        return Err(Problem::unavailable("stopping", "the service is stopping"));
    }
    if let Err(error) = app.engine.health().await {
        tracing::error!(%error, "the engine is out of reach");
        return Err(Problem::unavailable("engine_unavailable", "the queue is out of reach"));
    }
    if let Err(error) = app.blobs.health().await {
        tracing::error!(%error, "the blob store is out of reach");
        return Err(Problem::unavailable("blobs_unavailable", "the blob store is out of reach"));
    }
    Ok(())
}
