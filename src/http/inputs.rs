//! `/v1/inputs`: bytes that jobs name by their hash.

use super::rates::Rate;
use super::{App, Problem, body, query};
use crate::auth::{Caller, Scope};
use crate::blobs::BlobId;
use crate::field::FieldError;
use crate::field::input::{Description, FieldOptions};
use crate::field::network::family::Family;
use crate::job::{Failure, memory, pipeline, spec};
use crate::telemetry::metrics;
use crate::tenant::Tenant;
use axum::Json;
use axum::body::Body;
use axum::extract::{Path, RawQuery, State};
use axum::http::{HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Response};
use bytes::Bytes;
use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use serde_json::Value;

/// Parameters of an upload: the members of a job's field without which some networks cannot be read.
const READING: [&str; 5] = ["family", "encoding", "activation", "w0", "skip"];

/// An uploaded input.
#[derive(Serialize, Deserialize, utoipa::ToSchema)]
pub struct Input {
    /// Its name: `sha256:` and the hash of its bytes.
    #[schema(value_type = String)]
    pub(crate) id: BlobId,
    /// Its size.
    pub(crate) bytes: u64,
    /// When its tenant first uploaded it.
    #[schema(value_type = String, format = DateTime)]
    pub(crate) created_at: Timestamp,
    /// What the upload said of how to read it.
    #[serde(default, skip_serializing_if = "says_nothing")]
    #[schema(required = false)]
    options: FieldOptions,
    /// What it is: its kind, and what was found in it.
    pub(crate) description: Description,
}

impl Input {
    /// Whether it is a network that takes a latent code.
    pub(super) fn has_latent_code(&self) -> bool {
        matches!(self.description, Description::Network { latent_size, .. } if latent_size > 0)
    }

    /// Bytes of memory that it takes once it is a field.
    pub(super) fn memory(&self) -> u64 {
        memory::of_input(self.bytes, &self.description)
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

fn says_nothing(options: &FieldOptions) -> bool {
    *options == FieldOptions::default()
}

/// Uploads an input
///
/// Raw bytes of a scene, a network, a mesh or a sampled grid. What it is is told by its content; a file that cannot be
/// read is refused here. What a network's file does not say may be said in the query, as in the field of a job, which has to
/// say it again: an input is its bytes. Uploading the same bytes again answers 200, with what they are when they are read as
/// this upload says.
#[utoipa::path(
    post,
    path = "/v1/inputs",
    tag = "inputs",
    params(
        ("family" = Option<Family>, Query, description = "the family of a network's file, in place of the one that is detected"),
        ("encoding" = Option<String>, Query, description = "how a point becomes a network's input: a name, or JSON"),
        ("activation" = Option<String>, Query, description = "the activation of a network's hidden layers: a name, or JSON"),
        ("w0" = Option<String>, Query, description = "the frequency of a network's sines: a number, or two as JSON"),
        ("skip" = Option<String>, Query, description = "how a network's input is joined to the layers that take it: JSON"),
    ),
    request_body(content = Vec<u8>, content_type = "application/octet-stream", description = "the file"),
    responses(
        (status = 201, description = "stored", body = Input, headers(("Location", description = "where it is described"))),
        (status = 200, description = "it was there already", body = Input),
        (status = 400, description = "a query parameter is unknown or does not fit the file, or the body broke off"),
        (status = 413, description = "the file is too large"),
        (status = 422, description = "the file cannot be read as a field"),
        (status = 503, description = "the service is stopping, or as many bytes are being uploaded as may"),
    )
)]
pub async fn upload(
    State(app): State<App>,
    caller: Caller,
    RawQuery(raw): RawQuery,
    body: Body,
) -> Result<Response, Problem> {
    let tenant = caller.may(Scope::Write)?;
    let options = reading_options(raw.as_deref())?;
    let (bytes, _room) = body::read_upload(body, app.limits.input_bytes, &app.upload_room).await?;
    match store(&app, tenant, bytes, options).await? {
        Stored::Known(input) => Ok((StatusCode::OK, Json(input)).into_response()),
        Stored::New(input) => {
            let location =
                HeaderValue::from_str(&format!("/v1/inputs/{}", input.id)).map_err(|_| Problem::internal())?;
            Ok((StatusCode::CREATED, [(header::LOCATION, location)], Json(input)).into_response())
        }
    }
}

/// What became of an upload.
pub(crate) enum Stored {
    /// It was there already.
    Known(Input),
    /// It is there now.
    New(Input),
}

/// Checks a file and stores it, with what it is when it is read as `options` say.
pub(crate) async fn store(app: &App, tenant: &Tenant, bytes: Bytes, options: FieldOptions) -> Result<Stored, Problem> {
    app.rates.take(tenant, Rate::UploadedBytes, bytes.len() as u64)?;
    metrics::uploaded(bytes.len() as u64);
    let hashed = bytes.clone();
    let id = tokio::task::spawn_blocking(move || BlobId::of(&hashed)).await.map_err(joined)?;
    if let Some(mut known) = known(app, tenant, id).await? {
        // the note keeps what the first upload said: an answer depends on its own request alone
        if known.options != options {
            known = Input { description: described(bytes, options.clone()).await?, options, ..known };
        }
        return Ok(Stored::Known(known));
    }
    let description = described(bytes.clone(), options.clone()).await?;
    let input = Input { id, bytes: bytes.len() as u64, created_at: Timestamp::now(), options, description };
    let _promise = app.blobs.promise().await;
    app.blobs.put_unseen(bytes).await?;
    // the note comes last: an input that is known is complete
    let note = serde_json::to_vec(&input).map_err(|_| Problem::internal())?;
    app.blobs.put_note(tenant, id, note.into()).await?;
    Ok(Stored::New(input))
}

/// The input, if it is there already; from now on it is kept as one that was just uploaded.
async fn known(app: &App, tenant: &Tenant, id: BlobId) -> Result<Option<Input>, Problem> {
    let _promise = app.blobs.promise().await;
    if !app.blobs.touch(tenant, id).await? {
        return Ok(None);
    }
    app.blobs.note(tenant, id).await?.map(|note| read_note(&note)).transpose()
}

/// What the query says of how to read the file. A value that is no JSON is a name.
fn reading_options(query: Option<&str>) -> Result<FieldOptions, Problem> {
    let pairs = query::parameters(query, &READING, &[])?;
    let member = |(name, text): (String, String)| {
        let value = serde_json::from_str(&text).unwrap_or(Value::String(text));
        (name, value)
    };
    let members = pairs.into_iter().map(member).collect();
    spec::field_options(&members).map_err(|faults| Problem::parameters(&faults))
}

/// What the bytes are, found off the runtime.
async fn described(bytes: Bytes, options: FieldOptions) -> Result<Description, Problem> {
    let said = !says_nothing(&options);
    let description =
        tokio::task::spawn_blocking(move || pipeline::describe(&bytes, &options)).await.map_err(joined)?;
    description.map_err(|error| match error {
        // where something is said, faults are those of what is said: a scene takes none of it, and only scenes have others
        FieldError::Invalid { faults } if said => Problem::parameters(&faults),
        error => Failure::from_field(&error, "").into(),
    })
}

/// Describes an input
///
/// As the parameters of its first upload said to read it.
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
    caller: Caller,
    Path(id): Path<String>,
    RawQuery(raw): RawQuery,
) -> Result<Json<Input>, Problem> {
    let tenant = caller.may(Scope::Read)?;
    query::parameters(raw.as_deref(), &[], &[])?;
    let unknown =
        || Problem::not_found("unknown_input", "there is no such input", format!("no input {id:?} is stored"));
    let parsed = id.parse().map_err(|_| unknown())?;
    let note = app.blobs.note(tenant, parsed).await?.ok_or_else(unknown)?;
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
