//! Reads a request, member by member, and collects its faults.

use super::{
    FieldSpec, Fitting, JobSpec, MAX_LABEL_NAME, MAX_LABEL_VALUE, MAX_LABELS, MAX_LATENT, OutputName, SAMPLES, Sensing,
    Shrinking, WarmStartSpec, WebhookSpec, Work, check_lattice,
};
use crate::blobs::BlobId;
use crate::extract::Budget;
use crate::field::input::FieldOptions;
use crate::field::{Fault, FieldError, type_name};
use crate::fit::FitSpec;
use crate::fit::spec::MAX_MESHES;
use crate::job::JobKind;
use crate::shrink::lattice::LatticeSpec;
use crate::shrink::{Component, Density, Distortion, Effort, Method, OnTopology, ShrinkSpec};
use serde::Deserialize as _;
use serde_json::{Map, Value};
use std::collections::BTreeMap;

/// What an activation may be.
const ACTIVATION: &str = "\"identity\", \"relu\", \"elu\", \"tanh\", \"sigmoid\", {\"sine\": {\"w0\": number}} or \
                          {\"softplus\": {\"beta\": number}}";
/// Faults reported in one answer.
const MAX_FAULTS: usize = 32;

/// What is wrong with a request.
#[derive(Default)]
pub struct Faults(pub Vec<Fault>);

impl Faults {
    pub fn add(&mut self, pointer: impl Into<String>, code: &'static str, detail: impl Into<String>) {
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

/// Reads a whole request; it means nothing when faults were found.
pub fn read_spec(value: &Value, faults: &mut Faults) -> JobSpec {
    let mut kind = JobKind::default();
    if let Some(name) = value.get("kind").and_then(|kind| faults.string(kind, "/kind")) {
        match JobKind::from_name(name) {
            Some(named) => kind = named,
            None => {
                let known = JobKind::ALL.map(JobKind::name).join(", ");
                faults.add("/kind", "unknown_value", format!("unknown kind {name:?}; known: {known}"));
            }
        }
    }
    let (work, outputs) = match kind {
        JobKind::Shrink => (
            Work::Shrink(Box::new(read_shrinking(value, faults))),
            vec![OutputName::Glb, OutputName::Preview, OutputName::Report],
        ),
        JobKind::Fit => (Work::Fit(read_fitting(value, faults)), vec![OutputName::Network, OutputName::Report]),
        JobKind::Sensitivity => match read_sensing(value, faults) {
            Some(work) => (Work::Sensitivity(Box::new(work)), OutputName::of(kind).to_vec()),
            // with a fault, so that nothing comes of it
            None => (Work::Fit(Fitting { meshes: Vec::new(), fit: FitSpec::default() }), Vec::new()),
        },
    };
    let mut spec = JobSpec {
        work,
        outputs,
        labels: BTreeMap::new(),
        traceparent: None,
        webhook: None,
        deadline_s: None,
        memory_bytes: None,
    };
    if let Some(outputs) = value.get("outputs") {
        spec.outputs = read_outputs(outputs, kind, faults);
    }
    if let Some(labels) = value.get("labels") {
        spec.labels = read_labels(labels, faults);
    }
    if let Some(seconds) = value.get("deadline_s") {
        spec.deadline_s = faults.count(seconds, "/deadline_s");
        if spec.deadline_s == Some(0) {
            faults.add("/deadline_s", "out_of_range", "a deadline is at least 1 second after the start");
        }
    }
    spec.webhook = value.get("webhook").and_then(|webhook| read_webhook(webhook, faults));
    spec
}

/// Reads who is told of the end; which addresses are let through is known to the service.
fn read_webhook(value: &Value, faults: &mut Faults) -> Option<WebhookSpec> {
    let object = faults.object(value, "/webhook", &["url"])?;
    let Some(url) = object.get("url") else {
        faults.add("/webhook/url", "missing_member", "a webhook needs a url");
        return None;
    };
    faults.string(url, "/webhook/url").map(|url| WebhookSpec { url: url.to_owned() })
}

/// Reads what the engine stored of a sensitivity.
fn read_sensing(value: &Value, faults: &mut Faults) -> Option<Sensing> {
    let object =
        faults.object(value, "", &["kind", "of", "field", "surface", "gradient", "outputs", "labels", "deadline_s"])?;
    let field = object.get("field").map(|field| read_field(field, "/field", faults));
    let mut blob = |name: &str| object.get(name).and_then(|id| read_input(id, &format!("/{name}"), faults));
    let (surface, gradient) = (blob("surface"), blob("gradient"));
    let of = object.get("of").and_then(Value::as_str).and_then(|id| id.parse().ok());
    let sensing = (|| Some(Sensing { of: of?, field: field?, surface: surface?, gradient: gradient? }))();
    if sensing.is_none() {
        faults.add("/kind", "not_offered", "a sensitivity is asked for by POST /v1/jobs/{id}/sensitivity");
    }
    sensing
}

/// Reads what a fit is of.
fn read_fitting(value: &Value, faults: &mut Faults) -> Fitting {
    let mut fitting = Fitting { meshes: Vec::new(), fit: FitSpec::default() };
    let known = ["kind", "meshes", "fit", "outputs", "labels", "webhook", "deadline_s"];
    let Some(object) = faults.object(value, "", &known) else { return fitting };
    match object.get("meshes") {
        None => faults.add("/meshes", "missing_member", "a fit needs meshes, the names of uploaded inputs"),
        Some(Value::Array(list)) if list.is_empty() => faults.add("/meshes", "too_few", "a fit needs a mesh"),
        Some(Value::Array(list)) if list.len() > MAX_MESHES => {
            faults.add("/meshes", "too_many", format!("{} meshes, and at most {MAX_MESHES} are fitted", list.len()));
        }
        Some(Value::Array(list)) => {
            for (i, name) in list.iter().enumerate() {
                fitting.meshes.extend(read_input(name, &format!("/meshes/{i}"), faults));
            }
        }
        Some(other) => {
            faults.add("/meshes", "wrong_type", format!("expected a list of inputs, found {}", type_name(other)));
        }
    }
    let Some(given) = object.get("fit").and_then(|fit| faults.object(fit, "/fit", &FIT_MEMBERS)) else {
        return fitting;
    };
    // read one by one, so that each fault has its place
    let mut sound = Map::new();
    for (name, value) in given.iter().filter(|(name, _)| FIT_MEMBERS.contains(&name.as_str())) {
        let alone = Value::Object(Map::from_iter([(name.clone(), value.clone())]));
        match FitSpec::deserialize(&alone) {
            Ok(_) => drop(sound.insert(name.clone(), value.clone())),
            Err(error) => faults.add(format!("/fit/{name}"), "invalid_value", error.to_string()),
        }
    }
    fitting.fit = FitSpec::deserialize(&Value::Object(sound)).unwrap_or_default();
    let wrong = fitting.fit.faults().into_iter();
    faults.0.extend(wrong.map(|fault| Fault { pointer: format!("/fit{}", fault.pointer), ..fault }));
    fitting
}

/// Members of `fit`.
const FIT_MEMBERS: [&str; 14] = [
    "layers",
    "width",
    "activation",
    "latent_size",
    "epochs",
    "samples",
    "sampling",
    "normalize",
    "batch",
    "learning_rate",
    "normal",
    "eikonal",
    "latent_penalty",
    "seed",
];

/// The name of an input.
fn read_input(value: &Value, pointer: &str, faults: &mut Faults) -> Option<BlobId> {
    let id = faults.string(value, pointer)?.parse().ok();
    if id.is_none() {
        faults.add(pointer, "invalid_id", "expected sha256: and 64 lower-case hexadecimal digits");
    }
    id
}

/// Reads what is shrunk, and how.
fn read_shrinking(value: &Value, faults: &mut Faults) -> Shrinking {
    let mut spec = Shrinking {
        field: FieldSpec::default(),
        weight: None,
        warm_start: None,
        latent_motion: false,
        shrink: ShrinkSpec::default(),
        budget: Budget::default(),
    };
    let known = [
        "kind",
        "field",
        "weight",
        "warm_start",
        "latent_motion",
        "shrink",
        "budget",
        "outputs",
        "labels",
        "webhook",
        "deadline_s",
    ];
    let Some(object) = faults.object(value, "", &known) else { return spec };
    match object.get("field") {
        Some(field) => spec.field = read_field(field, "/field", faults),
        None => faults.add("/field", "missing_member", "a job needs a field"),
    }
    if let Some(shrink) = object.get("shrink") {
        spec.shrink = read_shrink(shrink, faults);
    }
    if let Some(wanted) = object.get("latent_motion") {
        spec.latent_motion = faults.boolean(wanted, "/latent_motion").unwrap_or_default();
        let outputs = object.get("outputs").and_then(Value::as_array);
        let surface = outputs.is_some_and(|list| list.iter().any(|name| name == OutputName::Surface.name()));
        if spec.latent_motion && !surface {
            faults.add("/latent_motion", "no_surface", "it is written into the output surface, which is not asked for");
        }
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
    if let Some(warm_start) = object.get("warm_start") {
        spec.warm_start = read_warm_start(warm_start, faults);
        if spec.shrink.method != Method::Adaptive {
            faults.add("/warm_start", "not_offered", "a warm start is made by the method adaptive");
        }
    }
    if let Some(budget) = object.get("budget") {
        spec.budget = read_budget(budget, faults);
    }
    spec
}

/// Reads a warm start: a job's name from a client, or what the engine stored of it.
fn read_warm_start(value: &Value, faults: &mut Faults) -> Option<WarmStartSpec> {
    const POINTER: &str = "/warm_start";
    let (job, surface) = match value {
        Value::Object(_) => {
            let object = faults.object(value, POINTER, &["job", "surface"])?;
            let surface = option(object, POINTER, "surface", "the name of a blob", faults)?;
            (object.get("job").unwrap_or(&Value::Null), Some(surface))
        }
        name => (name, None),
    };
    let job = faults.string(job, POINTER)?;
    let parsed = job.parse().ok();
    if parsed.is_none() {
        faults.add(POINTER, "invalid_id", "expected the id of a job");
    }
    Some(WarmStartSpec { job: parsed?, surface })
}

/// Reads a field, or a weight, at `pointer`.
fn read_field(value: &Value, pointer: &str, faults: &mut Faults) -> FieldSpec {
    let mut field = FieldSpec::default();
    let known = [
        "scene",
        "input",
        "latent",
        "latent_row",
        "transform",
        "domain",
        "level",
        "activation",
        "family",
        "w0",
        "skip",
        "encoding",
        "sign",
        "scale",
    ];
    let Some(object) = faults.object(value, pointer, &known) else { return field };
    match (object.get("scene"), object.get("input")) {
        (Some(scene), None) => field.scene = Some(scene.clone()),
        (None, Some(input)) => field.input = read_input(input, &format!("{pointer}/input"), faults),
        (Some(_), Some(_)) => faults.add(pointer, "ambiguous", "give scene or input, not both"),
        (None, None) => faults.add(pointer, "missing_member", "give scene or input"),
    }
    field.options = read_options(object, pointer, faults);
    field
}

/// Reads the options among the members of a field at `pointer`.
pub fn read_options(object: &Map<String, Value>, pointer: &str, faults: &mut Faults) -> FieldOptions {
    let options = FieldOptions {
        latent: object.get("latent").and_then(|latent| read_latent(latent, &format!("{pointer}/latent"), faults)),
        latent_row: object.get("latent_row").and_then(|row| faults.count(row, &format!("{pointer}/latent_row"))),
        transform: option(object, pointer, "transform", "scale, rotate {axis [3], angle}, translate [3]", faults),
        domain: option(object, pointer, "domain", "\"fit\" or {\"min\": [x, y, z], \"max\": [x, y, z]}", faults),
        level: object.get("level").and_then(|level| faults.number(level, &format!("{pointer}/level"))),
        activation: option(object, pointer, "activation", ACTIVATION, faults),
        family: option(object, pointer, "family", "the name of a family of networks", faults),
        w0: option(object, pointer, "w0", "a frequency, or the first layer's and the others'", faults),
        skip: option(object, pointer, "skip", "{\"scale\": number}", faults),
        encoding: option(object, pointer, "encoding", "\"identity\" or {\"positional\": {frequencies, base}}", faults),
        sign: option(object, pointer, "sign", "\"positive_outside\" or \"positive_inside\"", faults),
        scale: object.get("scale").and_then(|scale| faults.number(scale, &format!("{pointer}/scale"))),
    };
    // what an option may be is known in the field's room
    if let Err(FieldError::Invalid { faults: wrong }) = options.check() {
        faults.0.extend(wrong.into_iter().map(|f| Fault { pointer: format!("{pointer}{}", f.pointer), ..f }));
    }
    options
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

fn read_outputs(value: &Value, kind: JobKind, faults: &mut Faults) -> Vec<OutputName> {
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
            Some(output) if OutputName::of(kind).contains(&output) => outputs.push(output),
            _ => {
                let known: Vec<&str> = OutputName::of(kind).iter().map(|output| output.name()).collect();
                let (kind, known) = (kind.name(), known.join(", "));
                let detail = format!("a job of the kind {kind} makes no output {name:?}; it makes: {known}");
                faults.add(pointer, "unknown_value", detail);
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
