//! The request: what a client asks for, checked member by member before anything is stored.
//!
//! The parser is written by hand over the JSON value, so that every fault is found in one go and each one names its place
//! with a JSON Pointer; unknown members are refused by name. The scene itself is checked by its own room.

use crate::blobs::BlobId;
use crate::extract::Budget;
use crate::field::input::FieldOptions;
use crate::field::{Fault, FieldError};
use crate::shrink::curve::{MAX_SAMPLES, MIN_SAMPLES};
use crate::shrink::lattice::LatticeSpec;
use crate::shrink::{Component, Density, Distortion, Effort, Method, OnTopology, ShrinkSpec};
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
/// Faults reported in one answer.
const MAX_FAULTS: usize = 32;

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
    /// What to do with the field: latent code, transform, domain, level, activation.
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

#[derive(Default)]
struct Faults(Vec<Fault>);

impl Faults {
    fn add(&mut self, pointer: impl Into<String>, code: &'static str, detail: impl Into<String>) {
        if self.0.len() < MAX_FAULTS {
            self.0.push(Fault { pointer: pointer.into(), code, detail: detail.into() });
        }
    }

    /// The members of an object; each one that is not `known` is a fault.
    fn object<'v>(&mut self, value: &'v Value, pointer: &str, known: &[&str]) -> Option<&'v Map<String, Value>> {
        let Some(object) = value.as_object() else {
            self.add(pointer, "wrong_type", format!("expected an object, found {}", type_name(value)));
            return None;
        };
        for name in object.keys().filter(|name| !known.contains(&name.as_str())) {
            let detail = format!("unknown member {name:?}; known here: {}", known.join(", "));
            self.add(format!("{pointer}/{}", escape(name)), "unknown_member", detail);
        }
        Some(object)
    }

    fn string<'v>(&mut self, value: &'v Value, pointer: &str) -> Option<&'v str> {
        let found = value.as_str();
        if found.is_none() {
            self.add(pointer, "wrong_type", format!("expected a string, found {}", type_name(value)));
        }
        found
    }

    fn boolean(&mut self, value: &Value, pointer: &str) -> Option<bool> {
        let found = value.as_bool();
        if found.is_none() {
            self.add(pointer, "wrong_type", format!("expected true or false, found {}", type_name(value)));
        }
        found
    }

    fn number(&mut self, value: &Value, pointer: &str) -> Option<f32> {
        let Some(number) = value.as_f64() else {
            self.add(pointer, "wrong_type", format!("expected a number, found {}", type_name(value)));
            return None;
        };
        let single = number as f32;
        if !single.is_finite() {
            self.add(pointer, "not_finite", format!("{number} is not finite in single precision"));
            return None;
        }
        Some(single)
    }

    fn count(&mut self, value: &Value, pointer: &str) -> Option<u32> {
        let count = value.as_u64().and_then(|n| u32::try_from(n).ok());
        if count.is_none() {
            let detail = match value {
                Value::Number(n) => format!("expected a whole number from 0 to {}, found {n}", u32::MAX),
                other => format!("expected a whole number, found {}", type_name(other)),
            };
            self.add(pointer, "wrong_type", detail);
        }
        count
    }
}

fn read_spec(value: &Value, faults: &mut Faults) -> JobSpec {
    let mut spec = JobSpec {
        kind: super::JobKind::Shrink,
        field: FieldSpec::default(),
        weight: None,
        shrink: ShrinkSpec::default(),
        budget: Budget::default(),
        outputs: vec![OutputName::Glb, OutputName::Preview, OutputName::Report],
        labels: BTreeMap::new(),
    };
    let known = ["kind", "field", "weight", "shrink", "budget", "outputs", "labels"];
    let Some(object) = faults.object(value, "", &known) else { return spec };
    if let Some(kind) = object.get("kind").and_then(|kind| faults.string(kind, "/kind"))
        && kind != "shrink"
    {
        faults.add("/kind", "unknown_value", format!("unknown kind {kind:?}; known: shrink"));
    }
    match object.get("field") {
        Some(field) => spec.field = read_field(field, "/field", faults),
        None => faults.add("/field", "missing_member", "a job needs a field"),
    }
    if let Some(shrink) = object.get("shrink") {
        spec.shrink = read_shrink(shrink, faults);
    }
    if let Some(weight) = object.get("weight") {
        spec.weight = Some(read_field(weight, "/weight", faults));
        if object.get("shrink").and_then(|shrink| shrink.get("density")).is_none() {
            spec.shrink.density = Density::Weight;
        }
    }
    match (&spec.weight, spec.shrink.density) {
        (None, Density::Weight) => faults.add("/weight", "missing_member", "density weight needs a weight, a field"),
        (Some(_), density) if density != Density::Weight => {
            faults.add("/shrink/density", "ambiguous", "a weight is given, so the density is weight");
        }
        _ => {}
    }
    if let Some(budget) = object.get("budget") {
        spec.budget = read_budget(budget, faults);
    }
    if let Some(outputs) = object.get("outputs") {
        spec.outputs = read_outputs(outputs, faults);
    }
    if let Some(labels) = object.get("labels") {
        spec.labels = read_labels(labels, faults);
    }
    spec
}

/// Reads a field, or a weight, at `pointer`.
fn read_field(value: &Value, pointer: &str, faults: &mut Faults) -> FieldSpec {
    let mut field = FieldSpec::default();
    let known = ["scene", "input", "latent", "latent_row", "transform", "domain", "level", "activation"];
    let Some(object) = faults.object(value, pointer, &known) else { return field };
    match (object.get("scene"), object.get("input")) {
        (Some(scene), None) => field.scene = Some(scene.clone()),
        (None, Some(input)) => {
            if let Some(name) = faults.string(input, &format!("{pointer}/input")) {
                field.input = name.parse().ok();
                if field.input.is_none() {
                    let detail = "expected sha256: and 64 lower-case hexadecimal digits";
                    faults.add(format!("{pointer}/input"), "invalid_id", detail);
                }
            }
        }
        (Some(_), Some(_)) => faults.add(pointer, "ambiguous", "give scene or input, not both"),
        (None, None) => faults.add(pointer, "missing_member", "give scene or input"),
    }
    field.options = FieldOptions {
        latent: object.get("latent").and_then(|latent| read_latent(latent, &format!("{pointer}/latent"), faults)),
        latent_row: object.get("latent_row").and_then(|row| faults.count(row, &format!("{pointer}/latent_row"))),
        transform: option(object, pointer, "transform", "scale, rotate {axis [3], angle}, translate [3]", faults),
        domain: option(object, pointer, "domain", "\"fit\" or {\"min\": [x, y, z], \"max\": [x, y, z]}", faults),
        level: object.get("level").and_then(|level| faults.number(level, &format!("{pointer}/level"))),
        activation: option(object, pointer, "activation", "the name of an activation", faults),
    };
    // what an option may be is known in the field's room
    if let Err(FieldError::Invalid { faults: wrong }) = field.options.check() {
        faults.0.extend(wrong.into_iter().map(|f| Fault { pointer: format!("{pointer}{}", f.pointer), ..f }));
    }
    field
}

/// A member that its own type reads.
fn option<T: serde::de::DeserializeOwned>(
    object: &Map<String, Value>,
    pointer: &str,
    name: &str,
    expected: &str,
    faults: &mut Faults,
) -> Option<T> {
    let value = object.get(name)?;
    match T::deserialize(value) {
        Ok(read) => Some(read),
        Err(error) => {
            faults.add(format!("{pointer}/{name}"), "invalid_value", format!("expected {expected}: {error}"));
            None
        }
    }
}

fn read_latent(value: &Value, pointer: &str, faults: &mut Faults) -> Option<Vec<f32>> {
    let Some(list) = value.as_array() else {
        faults.add(pointer, "wrong_type", format!("expected a list of numbers, found {}", type_name(value)));
        return None;
    };
    if list.len() > MAX_LATENT {
        faults.add(pointer, "too_many", format!("{} numbers, and at most {MAX_LATENT} are read", list.len()));
        return None;
    }
    let numbers = list.iter().enumerate().map(|(i, n)| faults.number(n, &format!("{pointer}/{i}")));
    // a plain collect would stop at the first fault
    let numbers: Vec<Option<f32>> = numbers.collect();
    numbers.into_iter().collect()
}

fn read_shrink(value: &Value, faults: &mut Faults) -> ShrinkSpec {
    let mut shrink = ShrinkSpec::default();
    let known = ["method", "lattice", "density", "distortion", "relax_uv", "on_topology", "component", "samples"];
    let Some(object) = faults.object(value, "/shrink", &known) else { return shrink };
    use {Density as D, Distortion as K, Method as M, OnTopology as T};
    let methods = [("adaptive", M::Adaptive), ("paper", M::Paper)];
    let densities = [("area", D::Area), ("curvature", D::Curvature), ("reach", D::Reach), ("weight", D::Weight)];
    let distortions = [("area", K::Area), ("angle", K::Angle), ("isometric", K::Isometric)];
    let topologies = [("refuse", T::Refuse), ("wrap", T::Wrap)];
    choose(object, "method", &methods, &mut shrink.method, faults);
    choose(object, "density", &densities, &mut shrink.density, faults);
    choose(object, "distortion", &distortions, &mut shrink.distortion, faults);
    choose(object, "on_topology", &topologies, &mut shrink.on_topology, faults);
    if let Some(relax) = object.get("relax_uv") {
        shrink.relax_uv = faults.boolean(relax, "/shrink/relax_uv").unwrap_or_default();
    }
    shrink.component = object.get("component").and_then(|component| read_component(component, faults));
    if let Some(lattice) = object.get("lattice").and_then(|lattice| read_lattice(lattice, faults)) {
        faults.0.extend(check_lattice(lattice, "/shrink/lattice"));
        shrink.lattice = lattice;
    }
    if let Some(samples) = object.get("samples") {
        shrink.samples = faults.count(samples, "/shrink/samples");
        if let Some(n) = shrink.samples.filter(|n| !SAMPLES.contains(n)) {
            let detail = format!("{n} is not in {} to {}", SAMPLES.start(), SAMPLES.end());
            faults.add("/shrink/samples", "out_of_range", detail);
        }
    }
    shrink
}

/// A member of `shrink` that is one of a few names.
fn choose<T: Copy>(
    object: &Map<String, Value>,
    member: &str,
    known: &[(&str, T)],
    chosen: &mut T,
    faults: &mut Faults,
) {
    let pointer = format!("/shrink/{member}");
    let Some(name) = object.get(member).and_then(|value| faults.string(value, &pointer)) else { return };
    match known.iter().find(|(known, _)| *known == name) {
        Some((_, value)) => *chosen = *value,
        None => {
            let names: Vec<&str> = known.iter().map(|(name, _)| *name).collect();
            let detail = format!("unknown {member} {name:?}; known: {}", names.join(", "));
            faults.add(pointer, "unknown_value", detail);
        }
    }
}

fn read_component(value: &Value, faults: &mut Faults) -> Option<Component> {
    const POINTER: &str = "/shrink/component";
    match value {
        Value::String(name) if name == "largest" => Some(Component::Largest),
        Value::String(name) => {
            let detail = format!("unknown component {name:?}; give \"largest\" or an index from 0");
            faults.add(POINTER, "unknown_value", detail);
            None
        }
        Value::Number(_) => faults.count(value, POINTER).map(Component::Index),
        other => {
            let detail = format!("expected \"largest\" or an index, found {}", type_name(other));
            faults.add(POINTER, "wrong_type", detail);
            None
        }
    }
}

fn read_budget(value: &Value, faults: &mut Faults) -> Budget {
    let mut budget = Budget::default();
    let Some(object) = faults.object(value, "/budget", &["attempts", "evaluations"]) else { return budget };
    if let Some(attempts) = object.get("attempts").and_then(|n| faults.count(n, "/budget/attempts")) {
        if (1..=Effort::ATTEMPTS).contains(&attempts) {
            budget.attempts = Some(attempts);
        } else {
            let detail = format!("{attempts} is not in 1 to {}", Effort::ATTEMPTS);
            faults.add("/budget/attempts", "out_of_range", detail);
        }
    }
    match object.get("evaluations").map(|n| (n, n.as_u64())) {
        None => {}
        Some((_, Some(0))) => faults.add("/budget/evaluations", "out_of_range", "0 evaluations make no surface"),
        Some((_, Some(evaluations))) => budget.evaluations = Some(evaluations),
        Some((n, None)) => {
            let found = if n.is_number() { n.to_string() } else { type_name(n).to_owned() };
            faults.add("/budget/evaluations", "wrong_type", format!("expected a whole number, found {found}"));
        }
    }
    budget
}

fn read_lattice(value: &Value, faults: &mut Faults) -> Option<LatticeSpec> {
    let object = faults.object(value, "/shrink/lattice", &["latlong", "octahedral"])?;
    let mut sizes = |kind: &str, names: &[&str]| -> Option<Vec<u32>> {
        let pointer = format!("/shrink/lattice/{kind}");
        let members = faults.object(&object[kind], &pointer, names)?;
        let read = names.iter().map(|name| {
            let pointer = format!("{pointer}/{name}");
            match members.get(*name) {
                Some(size) => faults.count(size, &pointer),
                None => {
                    faults.add(pointer, "missing_member", format!("a lattice {kind} needs {name}"));
                    None
                }
            }
        });
        let read: Vec<Option<u32>> = read.collect();
        read.into_iter().collect()
    };
    match (object.contains_key("latlong"), object.contains_key("octahedral")) {
        (true, false) => {
            let sizes = sizes("latlong", &["n_theta", "n_phi"])?;
            Some(LatticeSpec::Latlong { n_theta: sizes[0], n_phi: sizes[1] })
        }
        (false, true) => Some(LatticeSpec::Octahedral { n: sizes("octahedral", &["n"])?[0] }),
        _ => {
            faults.add("/shrink/lattice", "ambiguous", "give exactly one of latlong and octahedral");
            None
        }
    }
}

fn read_outputs(value: &Value, faults: &mut Faults) -> Vec<OutputName> {
    let Some(list) = value.as_array() else {
        faults.add("/outputs", "wrong_type", format!("expected a list of names, found {}", type_name(value)));
        return Vec::new();
    };
    if list.is_empty() {
        faults.add("/outputs", "too_few", "a job makes at least one output");
    }
    let mut outputs = Vec::new();
    for (i, item) in list.iter().enumerate() {
        let pointer = format!("/outputs/{i}");
        let Some(name) = faults.string(item, &pointer) else { continue };
        match OutputName::from_name(name) {
            Some(output) if outputs.contains(&output) => {
                faults.add(pointer, "duplicate", format!("{name:?} is named twice"));
            }
            Some(output) => outputs.push(output),
            None => {
                let known = OutputName::ALL.map(OutputName::name).join(", ");
                faults.add(pointer, "unknown_value", format!("unknown output {name:?}; known: {known}"));
            }
        }
    }
    outputs.sort_unstable();
    outputs
}

fn read_labels(value: &Value, faults: &mut Faults) -> BTreeMap<String, String> {
    let mut labels = BTreeMap::new();
    let Some(object) = value.as_object() else {
        faults.add("/labels", "wrong_type", format!("expected an object, found {}", type_name(value)));
        return labels;
    };
    if object.len() > MAX_LABELS {
        faults.add("/labels", "too_many", format!("{} labels, and at most {MAX_LABELS} are kept", object.len()));
        return labels;
    }
    for (name, value) in object {
        let pointer = format!("/labels/{}", escape(name));
        let letters = |c: char| c.is_ascii_alphanumeric() || "._-/".contains(c);
        if name.is_empty() || name.chars().count() > MAX_LABEL_NAME || !name.chars().all(letters) {
            let detail = format!("a label's name is 1 to {MAX_LABEL_NAME} of the characters a-z A-Z 0-9 . _ - /");
            faults.add(pointer, "invalid_label", detail);
            continue;
        }
        let Some(text) = faults.string(value, &pointer) else { continue };
        if text.chars().count() > MAX_LABEL_VALUE || text.chars().any(char::is_control) {
            let detail = format!("a label's value is at most {MAX_LABEL_VALUE} characters, none of them control");
            faults.add(pointer, "invalid_label", detail);
            continue;
        }
        labels.insert(name.clone(), text.to_owned());
    }
    labels
}

/// A member's name as a token of a JSON Pointer (RFC 6901).
fn escape(name: &str) -> String {
    name.replace('~', "~0").replace('/', "~1")
}

fn type_name(value: &Value) -> &'static str {
    match value {
        Value::Null => "null",
        Value::Bool(_) => "a boolean",
        Value::Number(_) => "a number",
        Value::String(_) => "a string",
        Value::Array(_) => "a list",
        Value::Object(_) => "an object",
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    fn faults(value: Value) -> Vec<(String, &'static str)> {
        JobSpec::from_value(&value).expect_err("faulty").into_iter().map(|f| (f.pointer, f.code)).collect()
    }

    #[test]
    fn a_field_alone_is_a_good_job() {
        let spec = JobSpec::from_value(&json!({"field": {"scene": {"sphere": {"radius": 0.5}}}})).expect("good");
        assert_eq!(spec.shrink, ShrinkSpec::default());
        assert_eq!(spec.outputs, [OutputName::Glb, OutputName::Preview, OutputName::Report]);
    }

    #[test]
    fn a_stored_request_is_read_back_as_it_was() {
        let value = json!({
            "field": {"input": format!("sha256:{}", "ab".repeat(32)), "latent": [0.5, -1.0], "level": 0.25,
                      "domain": {"min": [-1, -1, -1], "max": [1, 1, 2]}},
            "shrink": {"method": "paper", "lattice": {"octahedral": {"n": 9}}, "density": "reach", "distortion": "angle",
                       "relax_uv": true, "on_topology": "wrap", "component": 2},
            "budget": {"attempts": 2, "evaluations": 5_000_000_000u64},
            "outputs": ["report", "glb"], "labels": {"project": "demo"},
        });
        let spec = JobSpec::from_value(&value).expect("good");
        let stored = serde_json::to_value(&spec).expect("serializes");
        assert_eq!(stored["shrink"]["component"], 2);
        assert_eq!(JobSpec::from_value(&stored), Ok(spec));
        let largest = json!({"field": {"scene": {}}, "shrink": {"component": "largest"}});
        let spec = JobSpec::from_value(&largest).expect("good");
        let stored = serde_json::to_value(&spec).expect("serializes");
        assert_eq!(stored["shrink"]["component"], "largest");
        let shrink = serde_json::from_value(stored["shrink"].clone()).expect("reads");
        assert_eq!((spec.shrink, spec.budget), (shrink, Budget::default()), "the record's own reader agrees");
    }

    #[test]
    fn options_and_budget_are_checked_member_by_member() {
        let found = faults(json!({
            "field": {"scene": {}},
            "shrink": {"density": "even", "distortion": 3, "relax_uv": "yes", "on_topology": "ignore",
                       "component": -1, "smooth": true},
            "budget": {"attempts": 4, "evaluations": 0, "seconds": 3},
        }));
        let expected = [
            ("/shrink/smooth", "unknown_member"),
            ("/shrink/density", "unknown_value"),
            ("/shrink/distortion", "wrong_type"),
            ("/shrink/on_topology", "unknown_value"),
            ("/shrink/relax_uv", "wrong_type"),
            ("/shrink/component", "wrong_type"),
            ("/budget/seconds", "unknown_member"),
            ("/budget/attempts", "out_of_range"),
            ("/budget/evaluations", "out_of_range"),
        ];
        assert_eq!(found, expected.map(|(p, c)| (p.to_owned(), c)));
        let odd = |component: Value| faults(json!({"field": {"scene": {}}, "shrink": {"component": component}}));
        assert_eq!(odd(json!("smallest")), [("/shrink/component".to_owned(), "unknown_value")]);
        assert_eq!(odd(json!([0])), [("/shrink/component".to_owned(), "wrong_type")]);
        let odd = |budget: Value| faults(json!({"field": {"scene": {}}, "budget": budget}));
        assert_eq!(odd(json!({"evaluations": 1.5})), [("/budget/evaluations".to_owned(), "wrong_type")]);
        assert_eq!(odd(json!({"attempts": 0})), [("/budget/attempts".to_owned(), "out_of_range")]);
        assert_eq!(odd(json!(3)), [("/budget".to_owned(), "wrong_type")]);
    }

    #[test]
    fn every_fault_is_found_at_once_and_named_by_its_place() {
        let found = faults(json!({
            "feild": 1,
            "field": {"scene": {}, "levle": 1, "latent": [1, "x", 1e300]},
            "shrink": {"method": "magic", "lattice": {"latlong": {"n_theta": 4, "n_phi": 5000}}},
            "outputs": ["glb", "stl", "glb"],
            "labels": {"a b": "c", "x": 3},
        }));
        let expected = [
            ("/feild", "unknown_member"),
            ("/field/levle", "unknown_member"),
            ("/field/latent/1", "wrong_type"),
            ("/field/latent/2", "not_finite"),
            ("/shrink/method", "unknown_value"),
            ("/shrink/lattice/latlong/n_theta", "out_of_range"),
            ("/shrink/lattice/latlong/n_phi", "out_of_range"),
            ("/outputs/1", "unknown_value"),
            ("/outputs/2", "duplicate"),
            ("/labels/a b", "invalid_label"),
            ("/labels/x", "wrong_type"),
        ];
        assert_eq!(found, expected.map(|(p, c)| (p.to_owned(), c)));
    }

    #[test]
    fn a_weight_is_read_like_a_field_and_makes_the_density() {
        let weight = json!({"input": format!("sha256:{}", "ab".repeat(32)), "level": 0.5});
        let spec = JobSpec::from_value(&json!({"field": {"scene": {}}, "weight": weight})).expect("good");
        assert_eq!(spec.shrink.density, Density::Weight);
        let stored = serde_json::to_value(&spec).expect("serializes");
        assert_eq!((&stored["weight"]["level"], JobSpec::from_value(&stored)), (&json!(0.5), Ok(spec)));
        let other = json!({"field": {"scene": {}}, "weight": weight, "shrink": {"density": "area"}});
        assert_eq!(faults(other), [("/shrink/density".to_owned(), "ambiguous")]);
        let none = json!({"field": {"scene": {}}, "shrink": {"density": "weight"}});
        assert_eq!(faults(none), [("/weight".to_owned(), "missing_member")]);
        let odd =
            json!({"field": {"scene": {}}, "weight": {"scene": {}, "levle": 1, "latent": [1, "x"], "domain": "large"}});
        let places = ["/weight/levle", "/weight/latent/1", "/weight/domain"];
        assert_eq!(faults(odd).into_iter().map(|f| f.0).collect::<Vec<_>>(), places);
    }

    #[test]
    fn what_is_not_an_object_or_has_no_field_is_refused() {
        assert_eq!(faults(json!([1])), [(String::new(), "wrong_type")]);
        assert_eq!(faults(json!({})), [("/field".to_owned(), "missing_member")]);
        assert_eq!(faults(json!({"field": {}})), [("/field".to_owned(), "missing_member")]);
        assert_eq!(faults(json!({"field": {"scene": {}, "input": "x"}})), [("/field".to_owned(), "ambiguous")]);
        let empty = json!({"field": {"scene": {}, "domain": {"min": [0, 0, 0], "max": [1, 0, 1]}}});
        assert_eq!(faults(empty), [("/field/domain/max/1".to_owned(), "empty")]);
        let odd = json!({"field": {"scene": {}, "domain": "large", "activation": "magic", "transform": {"scael": 2}}});
        let places = ["/field/transform", "/field/domain", "/field/activation"];
        assert_eq!(faults(odd), places.map(|p| (p.to_owned(), "invalid_value")));
    }

    #[test]
    fn what_only_curves_have_is_refused_for_surfaces_by_its_place() {
        let request = json!({"field": {"scene": {}}, "shrink": {"samples": 500}, "outputs": ["report", "svg"]});
        let spec = JobSpec::from_value(&request).expect("good for a curve");
        assert_eq!(spec.clone().for_dimension(2, &request), Ok(spec.clone()));
        let found = spec.for_dimension(3, &request).expect_err("no curve");
        let places: Vec<&str> = found.iter().map(|f| f.pointer.as_str()).collect();
        assert_eq!(places, ["/outputs/1", "/shrink/samples"]);
        let silent = json!({"field": {"scene": {}}});
        let spec = JobSpec::from_value(&silent).expect("good").for_dimension(2, &silent).expect("good");
        assert_eq!(spec.outputs, [OutputName::Glb, OutputName::Svg, OutputName::Preview, OutputName::Report]);
        for samples in [7, 100_001] {
            let value = json!({"field": {"scene": {}}, "shrink": {"samples": samples}});
            assert_eq!(faults(value), [("/shrink/samples".to_owned(), "out_of_range")]);
        }
    }

    #[test]
    fn a_number_too_large_for_an_index_is_refused_and_not_wrapped() {
        let value = json!({"field": {"scene": {}}, "shrink": {"lattice": {"octahedral": {"n": 4_294_967_298u64}}}});
        assert_eq!(faults(value), [("/shrink/lattice/octahedral/n".to_owned(), "wrong_type")]);
    }
}
