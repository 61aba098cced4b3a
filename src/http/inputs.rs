//! `/v1/inputs`: bytes that jobs name by their hash.

use super::{App, Problem, body, query};
use crate::blobs::BlobId;
use crate::field::input::Description;
use crate::job::{Failure, pipeline};
use axum::Json;
use axum::body::Body;
use axum::extract::{Path, RawQuery, State};
use axum::http::{HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Response};
use jiff::Timestamp;
use serde::{Deserialize, Serialize};

/// An uploaded input.
#[derive(Serialize, Deserialize, utoipa::ToSchema)]
pub struct Input {
    /// Its name: `sha256:` and the hash of its bytes.
    #[schema(value_type = String)]
    id: BlobId,
    /// Its size.
    bytes: u64,
    /// When it was first uploaded.
    #[schema(value_type = String, format = DateTime)]
    created_at: Timestamp,
    /// What it is: its kind, and what was found in it.
    description: Description,
}

impl Input {
    /// Whether it is a network that takes a latent code.
    pub(super) fn has_latent_code(&self) -> bool {
        matches!(self.description, Description::Network { latent_size, .. } if latent_size > 0)
    }

    /// Whether it is a mesh.
    pub(super) fn is_mesh(&self) -> bool {
        matches!(self.description, Description::Mesh { .. })
    }

    /// Whether it is a network.
    pub(super) fn is_network(&self) -> bool {
        matches!(self.description, Description::Network { .. })
    }

    /// 3 for surfaces, 2 for curves.
    pub(super) fn dimension(&self) -> u8 {
        match self.description {
            Description::Scene { dimension, .. } => dimension,
            _ => 3,
        }
    }
}

/// Uploads an input
///
/// Raw bytes of a scene, a network, a mesh or a sampled grid. What it is is told by its content; a file that cannot be
/// read is refused here. Uploading the same bytes again answers 200.
#[utoipa::path(
    post,
    path = "/v1/inputs",
    tag = "inputs",
    request_body(content = Vec<u8>, content_type = "application/octet-stream", description = "the file"),
    responses(
        (status = 201, description = "stored", body = Input, headers(("Location", description = "where it is described"))),
        (status = 200, description = "it was there already", body = Input),
        (status = 400, description = "a query parameter is unknown, or the body broke off"),
        (status = 413, description = "the file is too large"),
        (status = 422, description = "the file cannot be read as a field"),
        (status = 503, description = "the service is stopping"),
    )
)]
pub async fn upload(State(app): State<App>, RawQuery(raw): RawQuery, body: Body) -> Result<Response, Problem> {
    query::parameters(raw.as_deref(), &[], &[])?;
    let bytes = body::read(body, app.limits.input_bytes).await?;
    let hashed = bytes.clone();
    let id = tokio::task::spawn_blocking(move || BlobId::of(&hashed)).await.map_err(joined)?;
    if let Some(known) = app.blobs.note(id).await? {
        return Ok((StatusCode::OK, Json(read_note(&known)?)).into_response());
    }
    let described = bytes.clone();
    let description = tokio::task::spawn_blocking(move || pipeline::describe(&described)).await.map_err(joined)?;
    let description = description.map_err(|error| Failure::from_field(&error, ""))?;
    let input = Input { id, bytes: bytes.len() as u64, created_at: Timestamp::now(), description };
    app.blobs.put(bytes).await?;
    // the note comes last: an input that is known is complete
    let note = serde_json::to_vec(&input).map_err(|_| Problem::internal())?;
    app.blobs.put_note(id, note.into()).await?;
    let location = HeaderValue::from_str(&format!("/v1/inputs/{id}")).map_err(|_| Problem::internal())?;
    Ok((StatusCode::CREATED, [(header::LOCATION, location)], Json(input)).into_response())
}

/// Describes an input
#[utoipa::path(
    get,
    path = "/v1/inputs/{id}",
    tag = "inputs",
    params(("id" = String, Path, description = "`sha256:` and 64 hexadecimal digits")),
    responses(
        (status = 200, description = "what it is", body = Input),
        (status = 400, description = "a query parameter is unknown"),
        (status = 404, description = "there is no such input"),
    )
)]
pub async fn describe(
    State(app): State<App>,
    Path(id): Path<String>,
    RawQuery(raw): RawQuery,
) -> Result<Json<Input>, Problem> {
    query::parameters(raw.as_deref(), &[], &[])?;
    let unknown =
        || Problem::not_found("unknown_input", "there is no such input", format!("no input {id:?} is stored"));
    let note = app.blobs.note(id.parse().map_err(|_| unknown())?).await?.ok_or_else(unknown)?;
    Ok(Json(read_note(&note)?))
}

pub(super) fn read_note(note: &[u8]) -> Result<Input, Problem> {
    serde_json::from_slice(note).map_err(|error| {
        tracing::error!(%error, "an input's note cannot be read");
        Problem::internal()
    })
}

fn joined(error: tokio::task::JoinError) -> Problem {
    tracing::error!(%error, "a file could not be looked at");
    Problem::internal()
}
