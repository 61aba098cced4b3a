//! The request: what a client asks for, checked member by member before anything is stored.
//!
//! The parser is written by hand over the JSON value, so that every fault is found in one go and each one names its place
//! with a JSON Pointer; unknown members are refused by name. The scene itself is checked by its own room.

mod read;

use crate::blobs::BlobId;
use crate::extract::Budget;
use crate::field::Fault;
use crate::field::input::FieldOptions;
use crate::shrink::ShrinkSpec;
use crate::shrink::curve::{MAX_SAMPLES, MIN_SAMPLES};
use crate::shrink::lattice::LatticeSpec;
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
    /// Everything measured, as JSON.
    Report,
}

impl OutputName {
    /// All of them.
    pub const ALL: [OutputName; 5] =
        [OutputName::Glb, OutputName::Surface, OutputName::Svg, OutputName::Preview, OutputName::Report];

    /// The name in JSON and in URLs.
    pub fn name(self) -> &'static str {
        match self {
            OutputName::Glb => "glb",
            OutputName::Surface => "surface",
            OutputName::Svg => "svg",
            OutputName::Preview => "preview",
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
            OutputName::Surface => "application/octet-stream",
            OutputName::Svg => "image/svg+xml",
            OutputName::Preview => "image/png",
            OutputName::Report => "application/json",
        }
    }
    /// The usual extension of a file of it.
    pub fn extension(self) -> &'static str {
        match self {
            OutputName::Glb => "glb",
            OutputName::Surface => "safetensors",
            OutputName::Svg => "svg",
            OutputName::Preview => "png",
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

/// A checked request for a job.
#[derive(Clone, Debug, PartialEq, Serialize, utoipa::ToSchema)]
pub struct JobSpec {
    /// What kind of work it is.
    pub kind: super::JobKind,
    /// The field.
    pub field: FieldSpec,
    /// What samples are spread by, where the density is `weight`: its values, which need not be distances.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(required = false)]
    pub weight: Option<FieldSpec>,
    /// How it is shrunk.
    pub shrink: ShrinkSpec,
    /// What may be spent on it.
    pub budget: Budget,
    /// What is made; `glb`, `preview` and `report` when nothing is said, and `svg` of a 2-D field.
    pub outputs: Vec<OutputName>,
    /// Names the client gives the job; jobs can be listed by them.
    pub labels: BTreeMap<String, String>,
}

impl JobSpec {
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
        if dimension == 2 {
            if self.weight.is_some() {
                let detail = "samples of a curve are spread by arc length, not by a weight";
                return Err(vec![Fault {
                    pointer: "/weight".to_owned(),
                    code: "dimension",
                    detail: detail.to_owned(),
                }]);
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
        if self.shrink.samples.is_some() {
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
