//! What a job may cost, judged before it runs, and what the fields that it names are.

use super::super::inputs::{self, Input};
use super::{App, Problem};
use crate::blobs::BlobId;
use crate::field::{Fault, FieldError};
use crate::job::spec::{FieldSpec, Fitting, Work};
use crate::job::{Failure, Job, JobSpec, OutputName, memory, pipeline};
use crate::shrink::Method;
use crate::tenant::Tenant;
use serde::Serialize;

/// Evaluations per vertex of the adaptive method, the median over the table of `benches/extract_table.py`.
const ADAPTIVE_EVALUATIONS: f64 = 9.1;
/// Evaluations per vertex of the paper's loop: a value with gradient in each of its 110 iterations and at the end.
const PAPER_EVALUATIONS: f64 = 111.0;
/// Evaluations that the contour of a planar shape takes, the median over `examples/scenes/2d`; a sample takes one more.
const CONTOUR_EVALUATIONS: u64 = 10_000;
/// Evaluations per sample of the paper's loop for curves: in each of its 100 iterations and at the end.
const CURVE_PAPER_EVALUATIONS: u64 = 101;

/// What a job may cost, judged before it runs.
#[derive(Serialize, utoipa::ToSchema)]
pub struct Estimate {
    /// Whether the request would be accepted; always true here, a faulty one is a 422.
    valid: bool,
    /// Vertices of the result.
    pub(crate) vertices: u64,
    /// Field evaluations, estimated.
    pub(crate) evaluations: u64,
    /// Bytes of memory, estimated from above.
    pub(crate) memory_bytes: u64,
}

/// What is known of a job's fields before it runs.
pub(super) struct Fields {
    /// Of the field: 3 for surfaces, 2 for curves.
    pub(super) dimension: u8,
    /// Bytes of memory that all of them take.
    pub(super) memory: u64,
}

/// Checks what the field and the weight name.
pub(super) async fn check_fields(app: &App, tenant: &Tenant, spec: &JobSpec) -> Result<Fields, Problem> {
    let work = match &spec.work {
        Work::Shrink(work) => work,
        Work::Fit(fitting) => {
            let memory = check_meshes(app, tenant, &fitting.meshes).await?;
            return Ok(Fields { dimension: 3, memory });
        }
        Work::Sensitivity(_) => return Ok(Fields { dimension: 3, memory: 0 }),
    };
    let mut fields = check_field(app, tenant, &work.field, "/field").await?;
    if work.latent_motion {
        let input = match work.field.input {
            Some(id) => Some(described(app, tenant, id, "/field/input").await?),
            None => None,
        };
        if !input.is_some_and(|input| input.has_latent_code()) {
            let detail = "only the surface of a network with a latent code moves with it".to_owned();
            let fault = Fault { pointer: "/latent_motion".to_owned(), code: "no_latent_code", detail };
            return Err(Problem::invalid_request("", &[fault]));
        }
    }
    if let Some(weight) = &work.weight {
        let weight = check_field(app, tenant, weight, "/weight").await?;
        if weight.dimension != 3 {
            let detail = "a weight is a field of dimension 3".to_owned();
            let fault = Fault { pointer: "/weight".to_owned(), code: "dimension", detail };
            return Err(Problem::invalid_request("", &[fault]));
        }
        fields.memory = fields.memory.saturating_add(weight.memory);
    }
    Ok(fields)
}

/// The blob of a job's output `surface`, if it made one.
pub(super) fn surface_blob(job: &Job) -> Option<BlobId> {
    let output = job.outputs.iter().find(|output| output.name == OutputName::Surface.name());
    output.and_then(|output| BlobId::from_hex(&output.sha256))
}

/// What an input holds that is about to be named at `pointer`.
async fn described(app: &App, tenant: &Tenant, id: BlobId, pointer: &str) -> Result<Input, Problem> {
    let note = if app.blobs.touch(tenant, id).await? { app.blobs.note(tenant, id).await? } else { None };
    let Some(note) = note else {
        let detail = format!("no input {id} is stored; upload it to /v1/inputs first");
        let fault = Fault { pointer: pointer.to_owned(), code: "unknown_input", detail };
        return Err(Problem::invalid_request("", &[fault]));
    };
    inputs::read_note(&note)
}

/// Checks that the inputs which a fit names are there, and meshes. Bytes of memory that all of them take.
async fn check_meshes(app: &App, tenant: &Tenant, meshes: &[BlobId]) -> Result<u64, Problem> {
    let mut memory = 0u64;
    for (i, &id) in meshes.iter().enumerate() {
        let pointer = format!("/meshes/{i}");
        let input = described(app, tenant, id, &pointer).await?;
        memory = memory.saturating_add(input.memory());
        if !input.is_mesh() {
            let detail = format!("{id} is no mesh, and a network is fitted to meshes");
            return Err(Problem::invalid_request("", &[Fault { pointer, code: "not_a_mesh", detail }]));
        }
    }
    Ok(memory)
}

/// Checks what a field names, at `pointer`: the scene in the request, or the input that must be there.
async fn check_field(app: &App, tenant: &Tenant, field: &FieldSpec, pointer: &'static str) -> Result<Fields, Problem> {
    if let Some(id) = field.input {
        let input = described(app, tenant, id, &format!("{pointer}/input")).await?;
        return Ok(Fields { dimension: input.dimension(), memory: input.memory() });
    }
    let Some(scene) = field.scene.clone() else { return Ok(Fields { dimension: 3, memory: 0 }) };
    // a scene may be large: checked off the runtime
    let checked = tokio::task::spawn_blocking(move || {
        let memory = memory::of_scene(scene.to_string().len() as u64);
        pipeline::check_scene(&scene).map(|dimension| Fields { dimension, memory })
    });
    let checked = checked.await.map_err(|error| {
        tracing::error!(%error, "a scene could not be checked");
        Problem::internal()
    })?;
    let pointer = format!("{pointer}/scene");
    checked.map_err(|error| match error {
        FieldError::Invalid { faults } => Problem::invalid_request(&pointer, &faults),
        error => Failure::from_field(&error, &pointer).into(),
    })
}

/// What a job of these fields may cost.
pub(super) fn estimate(spec: &JobSpec, fields: &Fields) -> Estimate {
    let (vertices, evaluations) = estimate_work(&spec.work, fields.dimension);
    let memory_bytes = memory::of_job(&spec.work, vertices, fields.memory);
    Estimate { valid: true, vertices, evaluations, memory_bytes }
}

/// Vertices and evaluations of a job.
fn estimate_work(work: &Work, dimension: u8) -> (u64, u64) {
    let shrink = match work {
        Work::Shrink(work) => &work.shrink,
        // of the meshes' distances; the network is evaluated as often in every epoch
        Work::Fit(Fitting { meshes, fit }) => return (0, meshes.len() as u64 * u64::from(fit.samples)),
        Work::Sensitivity(_) => return (0, 0),
    };
    if dimension == 2 {
        let vertices = u64::from(shrink.curve_samples());
        let evaluations = match shrink.method {
            Method::Adaptive => CONTOUR_EVALUATIONS + vertices,
            Method::Paper => CURVE_PAPER_EVALUATIONS * vertices,
        };
        return (vertices, evaluations);
    }
    let vertices = shrink.lattice.vertices();
    let per_vertex = match shrink.method {
        Method::Adaptive => ADAPTIVE_EVALUATIONS,
        Method::Paper => PAPER_EVALUATIONS,
    };
    (vertices, (vertices as f64 * per_vertex).round() as u64)
}
