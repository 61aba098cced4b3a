//! From bytes to outputs: the one place where the job room meets the numeric rooms.

mod plane;

pub use plane::{CurveMade, make_curve};

use super::failure::{Ended, Failure};
use super::spec::{FieldSpec, OutputName};
use crate::blobs::BlobId;
use crate::field::input::{self, Description};
use crate::field::sampler::Tally;
use crate::field::scene::Scene;
use crate::field::{Field, FieldError, Sampler};
use crate::measure::{self, Report};
use crate::settings::{Progress, Settings};
use crate::shrink::{Effort, ShrinkSpec, shrink};
use crate::surface::{self, Surface};
use serde::Serialize;
use serde_json::{Value, json};
use std::time::Instant;

/// Share of a job's time that shrinking takes; measuring and writing take the rest.
const SHRINK_SHARE: f32 = 0.75;
/// Share of a job's time that is over when the outputs are written.
const MEASURED_SHARE: f32 = 0.95;

/// Sides of the preview, pixels.
const PREVIEW_WIDTH: u32 = 1024;

/// A field, and where it came from.
pub struct Opened {
    /// The field.
    pub field: Box<dyn Field>,
    /// The hash and the size of its bytes, and the options; written into the GLB.
    pub provenance: Value,
}

/// What a job made.
pub struct Made {
    /// The report, with the seconds that each part took.
    pub report: Report,
    /// The outputs that were asked for, in the order of [`OutputName`].
    pub files: Vec<(OutputName, Vec<u8>)>,
}

impl Made {
    /// Whether the result passed its own checks: closed, Euler characteristic 2, no flips of any kind.
    pub fn is_sound(&self) -> bool {
        let flips = self.report.flips;
        self.report.closed && self.report.euler == 2 && flips.surface + flips.sphere + flips.uv == 0
    }
}

/// What a field made, of either dimension.
pub struct Finished {
    /// The report.
    pub metrics: Value,
    /// The outputs that were asked for, in the order of [`OutputName`].
    pub files: Vec<(OutputName, Vec<u8>)>,
    /// Why this is no success, if it is none.
    pub problem: Option<Failure>,
}

/// Makes what a job asks for: a surface of a field of dimension 3, a curve of one of dimension 2.
pub fn run(
    opened: &Opened,
    spec: &ShrinkSpec,
    outputs: &[OutputName],
    load_seconds: f64,
    settings: Settings<'_>,
) -> Result<Finished, Ended> {
    if opened.field.dimension() == 2 {
        let made = make_curve(opened, spec, outputs, load_seconds, settings)?;
        return Ok(Finished { metrics: json!(made.report), problem: made.problem(), files: made.files });
    }
    let made = make(opened, spec, outputs, load_seconds, settings)?;
    Ok(Finished { metrics: json!(made.report), files: made.files, problem: None })
}

/// Checks a scene that is written out in a request, and tells its dimension. Pointers are relative to the scene.
pub fn check_scene(scene: &Value) -> Result<u8, FieldError> {
    Scene::from_value(scene).map(|scene| scene.dimension())
}

/// Tells what bytes are, without running them.
pub fn describe(bytes: &[u8]) -> Result<Description, FieldError> {
    input::describe(bytes)
}

/// Opens the field of a request; `bytes` are those of the input that it names, if it names one. Faults are pointed to
/// below `at`, the place of the field in the request.
pub fn open(spec: &FieldSpec, bytes: Option<&[u8]>, at: &str) -> Result<Opened, Box<Failure>> {
    let scene = match &spec.scene {
        None => None,
        Some(scene) => {
            // read first by itself, so that a later fault is one of the options
            check_scene(scene).map_err(|e| Failure::from_field(&e, &format!("{at}/scene")))?;
            Some(scene.to_string().into_bytes())
        }
    };
    let bytes = scene.as_deref().or(bytes).ok_or_else(|| Box::new(Failure::internal()))?;
    let field = input::open(bytes, &spec.options).map_err(|e| Failure::from_field(&e, at))?;
    // the bytes of a scene in a request are its JSON without spaces, members in alphabetical order
    let provenance = json!({"sha256": BlobId::of(bytes).hex(), "bytes": bytes.len(), "options": spec.options});
    Ok(Opened { field, provenance })
}

/// Shrinks, measures and writes. `load_seconds` is what opening the field took.
///
/// Every output but the report is the same for the same request, whatever the clock and the number of threads say.
pub fn make(
    opened: &Opened,
    spec: &ShrinkSpec,
    outputs: &[OutputName],
    load_seconds: f64,
    settings: Settings<'_>,
) -> Result<Made, Ended> {
    let told = |progress: Progress| {
        (settings.progress)(Progress { fraction: SHRINK_SHARE * progress.fraction, ..progress });
    };
    let stage = |stage: &'static str, fraction: f32| {
        (settings.progress)(Progress { stage, fraction, ..Progress::default() });
    };
    let tally = Tally::new();
    let sampler = Sampler::new(opened.field.as_ref(), Settings { progress: &told, ..settings }, &tally);
    let clock = Instant::now();
    let wrap = shrink(&sampler, spec, &Effort::default())?;
    let spent = tally.by_stage();
    let shrink_seconds = clock.elapsed().as_secs_f64();

    stage("measure", SHRINK_SHARE);
    let clock = Instant::now();
    let surface = Surface::new(wrap);
    let mut report = measure::report::measure(&surface, &sampler, &spent, spec)?;
    report.seconds.load = load_seconds;
    report.seconds.shrink = shrink_seconds;
    report.seconds.finish = clock.elapsed().as_secs_f64();

    stage("write", MEASURED_SHARE);
    let clock = Instant::now();
    let lasting = lasting(&report);
    let mut files = Vec::new();
    for &output in outputs {
        settings.cancel.check()?;
        let bytes = match output {
            OutputName::Glb => surface::gltf::to_glb(&surface, &lasting, &opened.provenance),
            OutputName::Surface => surface::tensors::to_safetensors(&surface),
            OutputName::Svg => {
                let detail = "svg is made of fields of dimension 2, and this one has dimension 3";
                return Err(Failure::new("dimension", "the field has the wrong dimension for this", detail).into());
            }
            OutputName::Preview => surface::preview::to_png(&surface, PREVIEW_WIDTH, &settings)?,
            OutputName::Report => {
                report.seconds.write = clock.elapsed().as_secs_f64();
                pretty(&report)
            }
        };
        files.push((output, bytes));
    }
    Ok(Made { report, files })
}

/// The report without what another run would say differently.
fn lasting(report: &impl Serialize) -> Value {
    let mut value = json!(report);
    if let Some(members) = value.as_object_mut() {
        members.remove("seconds");
        members.remove("threads");
    }
    value
}

fn pretty(report: &impl Serialize) -> Vec<u8> {
    let mut text = serde_json::to_vec_pretty(report).unwrap_or_default();
    text.push(b'\n');
    text
}
