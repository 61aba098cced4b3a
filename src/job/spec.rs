//! The request: what a client asks for, checked member by member before anything is stored.
//!
//! The parser is written by hand over the JSON value, so that every fault is found in one go and each one names its place
//! with a JSON Pointer; unknown members are refused by name. The scene itself is checked by its own room.

mod read;

use super::{JobId, JobKind};
use crate::blobs::BlobId;
use crate::extract::Budget;
use crate::field::Fault;
use crate::field::input::FieldOptions;
use crate::fit::FitSpec;
use crate::shrink::ShrinkSpec;
use crate::shrink::curve::{MAX_SAMPLES, MIN_SAMPLES};
use crate::shrink::lattice::LatticeSpec;
use crate::telemetry::traces::TRACEPARENT;
use read::{Faults, read_spec};
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};
use std::collections::BTreeMap;

/// Columns of a lat-long lattice: fewer than 8 are no sphere, more than 2,048 are no use in `f32`.
pub const N_THETA: std::ops::RangeInclusive<u32> = 8..=2048;
/// Rows of a lat-long lattice.
pub const N_PHI: std::ops::RangeInclusive<u32> = 4..=1024;
/// Subdivisions of an octahedron edge: up to a million vertices.
pub const OCTAHEDRAL_N: std::ops::RangeInclusive<u32> = 2..=500;
/// Samples of a curve.
pub const SAMPLES: std::ops::RangeInclusive<u32> = MIN_SAMPLES..=MAX_SAMPLES;
/// Labels a job may have.
pub const MAX_LABELS: usize = 16;
/// Characters of a label's name.
pub const MAX_LABEL_NAME: usize = 63;
/// Characters of a label's value.
pub const MAX_LABEL_VALUE: usize = 255;
/// Numbers in a latent code; the largest published auto-decoders use 512.
pub const MAX_LATENT: usize = 4096;

/// Something a job can make.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum OutputName {
    /// The surface as binary glTF, with the sphere's UVs.
    Glb,
    /// Positions, normals, UVs and fundamental forms as safetensors.
    Surface,
    /// The curve of a 2-D field as a drawing.
    Svg,
    /// The surface from four sides, or the curve, as PNG.
    Preview,
    /// The shrinking in six frames, as PNG.
    Filmstrip,
    /// The network that was fitted, as safetensors with its architecture.
    Network,
    /// Derivatives by a latent code and by weights, as safetensors.
    Sensitivity,
    /// Everything measured, as JSON.
    Report,
}

impl OutputName {
    /// All of them.
    pub const ALL: [OutputName; 8] = [
        OutputName::Glb,
        OutputName::Surface,
        OutputName::Svg,
        OutputName::Preview,
        OutputName::Filmstrip,
        OutputName::Network,
        OutputName::Sensitivity,
        OutputName::Report,
    ];

    /// Those that jobs of a kind can make.
    pub fn of(kind: JobKind) -> &'static [OutputName] {
        use OutputName::{Filmstrip, Glb, Network, Preview, Report, Sensitivity, Surface, Svg};
        match kind {
            JobKind::Shrink => &[Glb, Surface, Svg, Preview, Filmstrip, Report],
            JobKind::Fit => &[Network, Report],
            JobKind::Sensitivity => &[Sensitivity, Report],
        }
    }

    /// The name in JSON and in URLs.
    pub fn name(self) -> &'static str {
        match self {
            OutputName::Glb => "glb",
            OutputName::Surface => "surface",
            OutputName::Svg => "svg",
            OutputName::Preview => "preview",
            OutputName::Filmstrip => "filmstrip",
            OutputName::Network => "network",
            OutputName::Sensitivity => "sensitivity",
            OutputName::Report => "report",
        }
    }
    /// The output of that name.
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|o| o.name() == name)
    }
    /// The media type of its bytes.
    pub fn media_type(self) -> &'static str {
        match self {
            OutputName::Glb => "model/gltf-binary",
            // no registered type; the one the format's own tools use is octet-stream
            OutputName::Surface | OutputName::Network | OutputName::Sensitivity => "application/octet-stream",
            OutputName::Svg => "image/svg+xml",
            OutputName::Preview | OutputName::Filmstrip => "image/png",
            OutputName::Report => "application/json",
        }
    }
    /// The usual extension of a file of it.
    pub fn extension(self) -> &'static str {
        match self {
            OutputName::Glb => "glb",
            OutputName::Surface | OutputName::Network | OutputName::Sensitivity => "safetensors",
            OutputName::Svg => "svg",
            OutputName::Preview | OutputName::Filmstrip => "png",
            OutputName::Report => "json",
        }
    }
}

/// Which field: a scene written out, or an uploaded input with its options.
#[derive(Clone, Debug, Default, PartialEq, Serialize, utoipa::ToSchema)]
pub struct FieldSpec {
    /// A scene in the request itself. Exactly one of `scene` and `input` is given.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(value_type = Option<Object>)]
    pub scene: Option<Value>,
    /// The name of an uploaded input, `sha256:` and 64 hexadecimal digits.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(value_type = Option<String>)]
    pub input: Option<BlobId>,
    /// What to do with the field, and what its file does not say.
    #[serde(flatten)]
    pub options: FieldOptions,
}

/// Which surface a warm start begins from.
///
/// A client names the job that made it, as text. When the job is accepted the surface's blob is looked up and stored with
/// it, as an object, because the earlier job may be forgotten before this one runs.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
#[serde(into = "SpelledWarmStart")]
pub struct WarmStartSpec {
    /// The job that made it.
    pub job: JobId,
    /// Its output `surface`, once it was looked up.
    pub surface: Option<BlobId>,
}

/// A [`WarmStartSpec`] as it is written.
#[derive(Serialize)]
#[serde(untagged)]
enum SpelledWarmStart {
    /// By a client.
    Job(JobId),
    /// In the engine.
    Surface {
        /// The job that made it.
        job: JobId,
        /// Its output `surface`.
        surface: BlobId,
    },
}

impl From<WarmStartSpec> for SpelledWarmStart {
    fn from(WarmStartSpec { job, surface }: WarmStartSpec) -> Self {
        match surface {
            None => Self::Job(job),
            Some(surface) => Self::Surface { job, surface },
        }
    }
}

/// A checked request for a job.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct JobSpec {
    /// What is to be done.
    #[serde(flatten)]
    pub work: Work,
    /// What is made: `glb`, `preview` and `report` of a surface, `svg` too of a 2-D field, `network` and `report` of a fit when nothing
    /// is said.
    pub outputs: Vec<OutputName>,
    /// Names the client gives the job; jobs can be listed by them.
    pub labels: BTreeMap<String, String>,
    /// Where the request was in its trace, so that the worker continues it: known to the engine only, no client can say it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub traceparent: Option<String>,
    /// Who is told of the end.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub webhook: Option<WebhookSpec>,
    /// Seconds that an attempt may run before it is stopped and the job has failed; the service's limit when nothing is said.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub deadline_s: Option<u32>,
    /// Bytes of memory that it is estimated to take: known to the engine only, no client can say it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub memory_bytes: Option<u64>,
}

/// Where an engine's stored request has what no client can say, besides the trace.
const MEMORY: &str = "memory_bytes";

/// Who is told of the end of a job.
#[derive(Clone, Debug, PartialEq, Serialize, utoipa::ToSchema)]
pub struct WebhookSpec {
    /// Where the notice is posted: an `https` address of the public internet, unless the service lets others through.
    pub url: String,
}

/// What a job does, by its kind.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[serde(tag = "kind", rename_all = "snake_case")]
pub enum Work {
    /// Shrinks a sphere onto a field.
    Shrink(Box<Shrinking>),
    /// Fits a network to meshes.
    Fit(Fitting),
    /// Carries a gradient of a surface's vertices back to its network.
    Sensitivity(Box<Sensing>),
}

/// What the names of inputs begin with among those of a job's blobs.
pub const INPUT: &str = "input:";

impl Work {
    /// The blobs that it works on: of a surface those of its field, its weight and its warm start, where it has them; the meshes
    /// of a fit; the network, the surface and the gradient of a sensitivity.
    pub fn blobs(&self) -> Vec<BlobId> {
        match self {
            Self::Shrink(work) => {
                let weight = work.weight.as_ref().and_then(|weight| weight.input);
                let surface = work.warm_start.and_then(|warm_start| warm_start.surface);
                work.field.input.into_iter().chain(weight).chain(surface).collect()
            }
            Self::Fit(fitting) => fitting.meshes.clone(),
            Self::Sensitivity(work) => work.field.input.into_iter().chain([work.surface, work.gradient]).collect(),
        }
    }

    /// All of its blobs, by names that no output has and that begin with [`INPUT`]: they are kept while the job is remembered.
    pub fn inputs(&self) -> Vec<(String, BlobId)> {
        self.blobs().into_iter().enumerate().map(|(i, blob)| (format!("{INPUT}{i}"), blob)).collect()
    }

    /// Those of its blobs that are no inputs, and must be kept for it as its outputs are; by names that no output has.
    pub fn held(&self) -> Vec<(&'static str, BlobId)> {
        match self {
            Self::Shrink(work) => {
                let surface = work.warm_start.and_then(|warm_start| warm_start.surface);
                surface.map(|id| ("warm_start", id)).into_iter().collect()
            }
            Self::Fit(_) => Vec::new(),
            Self::Sensitivity(work) => vec![("of", work.surface), ("gradient", work.gradient)],
        }
    }

    /// What kind of work it is.
    pub fn kind(&self) -> JobKind {
        match self {
            Self::Shrink(_) => JobKind::Shrink,
            Self::Fit(_) => JobKind::Fit,
            Self::Sensitivity(_) => JobKind::Sensitivity,
        }
    }
}

/// Meshes, and how a network is fitted to them.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Fitting {
    /// The names of uploaded meshes: one gives a SIREN, several an auto-decoder with a latent code each, in this order.
    pub meshes: Vec<BlobId>,
    /// How it is fitted.
    pub fit: FitSpec,
}

/// A gradient of the vertices of a job's surface. Everything is looked up when the request is accepted, because the job that made the
/// surface may be forgotten before this one runs.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Sensing {
    /// The job that made the surface.
    pub of: JobId,
    /// Its field, a network.
    pub field: FieldSpec,
    /// Its output `surface`.
    pub surface: BlobId,
    /// The derivatives of a loss by the vertices.
    pub gradient: BlobId,
}

/// A field, and how a sphere is shrunk onto it.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Shrinking {
    /// The field.
    pub field: FieldSpec,
    /// What samples are spread by, where the density is `weight`: its values, which need not be distances.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub weight: Option<FieldSpec>,
    /// The surface that it begins from.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub warm_start: Option<WarmStartSpec>,
    /// Whether the output `surface` says how the surface moves with the latent code.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub latent_motion: bool,
    /// How it is shrunk.
    pub shrink: ShrinkSpec,
    /// What may be spent on it.
    pub budget: Budget,
}

impl JobSpec {
    /// Reads what an engine stored.
    ///
    /// # Errors
    /// As [`from_value`](Self::from_value): it was stored by a version that knew more.
    pub fn from_stored(mut value: Value) -> Result<Self, Vec<Fault>> {
        let mut own = |name| value.as_object_mut().and_then(|members| members.remove(name));
        let (traceparent, memory) = (own(TRACEPARENT), own(MEMORY));
        let spec = Self::from_value(&value)?;
        let traceparent = traceparent.and_then(|text| text.as_str().map(str::to_owned));
        Ok(Self { traceparent, memory_bytes: memory.and_then(|bytes| bytes.as_u64()), ..spec })
    }

    /// The request that a client could send to have the same job again: what only the engine knows is left away. `None` of a
    /// sensitivity, which is not asked for by a request in JSON.
    pub fn as_asked(mut self) -> Option<Self> {
        self.traceparent = None;
        self.memory_bytes = None;
        match &mut self.work {
            Work::Shrink(work) => {
                if let Some(warm_start) = &mut work.warm_start {
                    warm_start.surface = None;
                }
            }
            Work::Fit(_) => {}
            Work::Sensitivity(_) => return None,
        }
        Some(self)
    }

    /// Reads a request.
    ///
    /// # Errors
    /// Every fault that was found (at most 32), with pointers from the root of the request.
    pub fn from_value(value: &Value) -> Result<Self, Vec<Fault>> {
        let mut faults = Faults::default();
        let spec = read_spec(value, &mut faults);
        if faults.0.is_empty() { Ok(spec) } else { Err(faults.0) }
    }
}

impl JobSpec {
    /// Fits a request to the dimension of its field: what only curves have is refused for surfaces, and what a request that
    /// says nothing gets is completed. `request` is what the spec was read from.
    pub fn for_dimension(mut self, dimension: u8, request: &Value) -> Result<Self, Vec<Fault>> {
        let Work::Shrink(shrinking) = &self.work else { return Ok(self) };
        if dimension == 2 {
            if shrinking.warm_start.is_some() {
                let detail = "a curve has no warm start, and this field has dimension 2".to_owned();
                return Err(vec![Fault { pointer: "/warm_start".to_owned(), code: "dimension", detail }]);
            }
            if shrinking.weight.is_some() {
                let detail = "samples of a curve are spread by arc length, not by a weight";
                return Err(vec![Fault {
                    pointer: "/weight".to_owned(),
                    code: "dimension",
                    detail: detail.to_owned(),
                }]);
            }
            let listed = request.get("outputs").and_then(Value::as_array).map(Vec::as_slice).unwrap_or_default();
            if let Some(i) = listed.iter().position(|name| name == OutputName::Filmstrip.name()) {
                let detail = "a filmstrip is made of fields of dimension 3, and this one has dimension 2".to_owned();
                return Err(vec![Fault { pointer: format!("/outputs/{i}"), code: "dimension", detail }]);
            }
            if request.get("outputs").is_none() {
                self.outputs.push(OutputName::Svg);
                self.outputs.sort_unstable();
            }
            return Ok(self);
        }
        let mut faults = Faults::default();
        let listed = request.get("outputs").and_then(Value::as_array).map(Vec::as_slice).unwrap_or_default();
        if let Some(i) = listed.iter().position(|name| name == OutputName::Svg.name()) {
            let detail = "svg is made of fields of dimension 2, and this one has dimension 3";
            faults.add(format!("/outputs/{i}"), "dimension", detail);
        }
        if shrinking.shrink.samples.is_some() {
            let detail = "samples are those of a curve, and this field has dimension 3: it takes a lattice";
            faults.add("/shrink/samples", "dimension", detail);
        }
        if faults.0.is_empty() { Ok(self) } else { Err(faults.0) }
    }
}

/// Reads options of a field; members that are none are passed over.
///
/// # Errors
/// Every fault that was found, with pointers from the root of `members`.
pub fn field_options(members: &Map<String, Value>) -> Result<FieldOptions, Vec<Fault>> {
    let mut faults = Faults::default();
    let options = read::read_options(members, "", &mut faults);
    if faults.0.is_empty() { Ok(options) } else { Err(faults.0) }
}

/// Checks the limits of a lattice; faults are pointed to below `pointer`.
pub fn check_lattice(lattice: LatticeSpec, pointer: &str) -> Vec<Fault> {
    let mut faults = Faults::default();
    let sizes: &[(&str, u32, &std::ops::RangeInclusive<u32>)] = match lattice {
        LatticeSpec::Latlong { n_theta, n_phi } => {
            &[("latlong/n_theta", n_theta, &N_THETA), ("latlong/n_phi", n_phi, &N_PHI)]
        }
        LatticeSpec::Octahedral { n } => &[("octahedral/n", n, &OCTAHEDRAL_N)],
    };
    for (member, size, range) in sizes {
        if !range.contains(size) {
            let detail = format!("{size} is not in {} to {}", range.start(), range.end());
            faults.add(format!("{pointer}/{member}"), "out_of_range", detail);
        }
    }
    faults.0
}

#[cfg(test)]
mod tests;
