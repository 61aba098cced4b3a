//! `shrinkd serve --try FIELD`: a first job through the service's own routes, so that a new set-up shows a result.

use crate::auth::Caller;
use axum::Router;
use axum::body::Body;
use axum::http::{Method, Request, header};
use futures::TryStreamExt;
use serde_json::{Value, json};
use std::net::SocketAddr;
use std::path::PathBuf;
use tower::ServiceExt;

/// Uploads the file, submits a job, waits for its end and logs where its outputs are. Whatever goes wrong is logged; the
/// service runs on.
pub async fn run(router: Router, address: SocketAddr, field: PathBuf) {
    match submit(&router, &field).await {
        Ok(job) if job["state"] == "succeeded" => {
            let id = job["id"].as_str().unwrap_or("");
            let at = |name: &str| format!("http://{address}/v1/jobs/{id}/outputs/{name}");
            tracing::info!(
                field = %field.display(), glb = at("glb"), preview = at("preview"), report = at("report"),
                "the first job succeeded; open http://{address}/#/jobs/{id} to see it"
            );
        }
        Ok(job) => tracing::error!(field = %field.display(), answer = %job, "the first job did not succeed"),
        Err(error) => tracing::error!(field = %field.display(), %error, "the first job could not be submitted"),
    }
}

async fn submit(router: &Router, field: &PathBuf) -> Result<Value, Box<dyn std::error::Error + Send + Sync>> {
    let bytes = tokio::fs::read(field).await?;
    let input = ask(router, Method::POST, "/v1/inputs", "application/octet-stream", bytes.into()).await?;
    if input["id"].is_null() {
        return Ok(input);
    }
    let body = json!({"field": {"input": input["id"]}}).to_string();
    let job = ask(router, Method::POST, "/v1/jobs", "application/json", body.into()).await?;
    let Some(id) = job["id"].as_str() else { return Ok(job) };
    tracing::info!(field = %field.display(), job.id = id, "the first job is being made");
    // its events end when it has ended, or the service stops
    let events = request(Method::GET, &format!("/v1/jobs/{id}/events"), "", Body::empty())?;
    let mut events = router.clone().oneshot(events).await?.into_body().into_data_stream();
    while events.try_next().await?.is_some() {}
    ask(router, Method::GET, &format!("/v1/jobs/{id}"), "", Body::empty()).await
}

/// A request from within, where nobody has to say who asks.
fn request(method: Method, path: &str, media_type: &str, body: Body) -> Result<Request<Body>, axum::http::Error> {
    let mut request = Request::builder().method(method).uri(path);
    if !media_type.is_empty() {
        request = request.header(header::CONTENT_TYPE, media_type);
    }
    let mut request = request.body(body)?;
    request.extensions_mut().insert(Caller::anybody());
    Ok(request)
}

async fn ask(
    router: &Router,
    method: Method,
    path: &str,
    media_type: &str,
    body: Body,
) -> Result<Value, Box<dyn std::error::Error + Send + Sync>> {
    let answer = router.clone().oneshot(request(method, path, media_type, body)?).await?;
    /// A job document with its report is a few kilobytes.
    const LARGEST: usize = 1 << 20;
    Ok(serde_json::from_slice(&axum::body::to_bytes(answer.into_body(), LARGEST).await?)?)
}
