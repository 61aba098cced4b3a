//! From bytes to outputs: the one place where the job room meets the numeric rooms.

mod filmstrip;
mod fitting;
mod plane;
mod sensing;

use filmstrip::Film;
pub use fitting::{Kept, StateBytes, open_mesh, run_fit};
pub use plane::{CurveMade, make_curve};
pub use sensing::{Carried, SensitivityReport, run_sensitivity, sensitivity_of};

use super::failure::{Ended, Failure};
use super::spec::{FieldSpec, OutputName};
use crate::blobs::BlobId;
use crate::extract::{Budget, Extracted, Part, extract};
use crate::field::input::{self, Description, FieldOptions, Placed};
use crate::field::network::family::Detected;
use crate::field::sampler::Tally;
use crate::field::scene::Scene;
use crate::field::{Field, FieldError, Sampler};
use crate::measure::Report;
use crate::settings::{Progress, Settings};
use crate::shrink::lattice::LatticeSpec;
use crate::shrink::warm::Earlier;
use crate::shrink::{Method, ShrinkError, ShrinkSpec};
use crate::surface;
use crate::surface::sensitivity::latent_motion;
use serde::Serialize;
use serde_json::{Value, json};
use std::cell::Cell;
use std::time::Instant;

/// Share of a job's time that is over when the outputs are written.
const MEASURED_SHARE: f32 = 0.95;

/// Sides of the preview, pixels.
const PREVIEW_WIDTH: u32 = 1024;

/// A field, and where it came from.
pub struct Opened {
    /// The field.
    pub field: Box<dyn Field>,
    /// What `density: weight` goes by, if it was given.
    pub weight: Option<Box<dyn Field>>,
    /// The surface that a warm start begins from, if there is one.
    pub earlier: Option<Earlier>,
    /// The hash and the size of the field's bytes, and the options; written into the GLB.
    pub provenance: Value,
    /// What a network's file was taken for.
    pub detected: Option<Detected>,
    /// The network, where the surface is to say how it moves with its latent code.
    pub moved_by: Option<Placed>,
}

/// What a job made.
pub struct Made {
    /// The report, with the seconds that each part took.
    pub report: Report,
    /// The outputs that were asked for, in the order of [`OutputName`].
    pub files: Vec<(OutputName, Vec<u8>)>,
    /// What the shape turned out to be after a surface was made, where that is none that a sphere can wrap.
    pub refusal: Option<ShrinkError>,
}

impl Made {
    /// Whether the result passed every check of its verdict.
    pub fn is_sound(&self) -> bool {
        self.report.verdict.passed
    }

    /// Why this is no success, if it is none. The paper's loop is a baseline: what it makes is what was asked for, folds
    /// and all, and only its verdict tells.
    pub fn problem(&self) -> Option<Failure> {
        match &self.refusal {
            Some(error) => Some(Failure::from_shrink(error)),
            None if self.is_sound() || self.report.method == Method::Paper => None,
            None => Some(Failure::not_certified(&self.report.verdict)),
        }
    }
}

/// What a job made, of any kind.
pub struct Finished {
    /// The report.
    pub metrics: Value,
    /// Whether it passed every check of its verdict.
    pub certified: bool,
    /// The outputs that were asked for, in the order of [`OutputName`].
    pub files: Vec<(OutputName, Vec<u8>)>,
    /// Why this is no success, if it is none.
    pub problem: Option<Failure>,
}

/// What is asked of a field.
#[derive(Clone, Copy, Debug)]
pub struct Asked<'a> {
    /// How it is shrunk.
    pub shrink: &'a ShrinkSpec,
    /// What may be spent on it.
    pub budget: Budget,
    /// What is made.
    pub outputs: &'a [OutputName],
    /// Seconds that opening the field took, for the report.
    pub load_seconds: f64,
}

impl Asked<'_> {
    /// Writes every output by `bytes`, in order, until the token is raised.
    fn written(
        &self,
        settings: &Settings<'_>,
        mut bytes: impl FnMut(OutputName) -> Result<Vec<u8>, Ended>,
    ) -> Result<Vec<(OutputName, Vec<u8>)>, Ended> {
        let write = |&output: &OutputName| {
            settings.cancel.check()?;
            Ok((output, bytes(output)?))
        };
        self.outputs.iter().map(write).collect()
    }
}

/// Makes what a job asks for: a surface of a field of dimension 3, a curve of one of dimension 2.
pub fn run(opened: &Opened, asked: &Asked<'_>, settings: Settings<'_>) -> Result<Finished, Ended> {
    if opened.field.dimension() == 2 {
        let made = make_curve(opened, asked, settings)?;
        let (certified, problem) = (made.is_sound(), made.problem());
        return Ok(Finished { metrics: json!(made.report), certified, problem, files: made.files });
    }
    let made = make(opened, asked, settings)?;
    let (certified, problem) = (made.is_sound(), made.problem());
    Ok(Finished { metrics: json!(made.report), certified, problem, files: made.files })
}

/// Checks a scene that is written out in a request, and tells its dimension. Pointers are relative to the scene.
pub fn check_scene(scene: &Value) -> Result<u8, FieldError> {
    Scene::from_value(scene).map(|scene| scene.dimension())
}

/// Tells what bytes are, read as the options say, without running them.
pub fn describe(bytes: &[u8], options: &FieldOptions) -> Result<Description, FieldError> {
    input::describe(bytes, options)
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
    let input::Opened { field, detected } =
        input::open(bytes, &spec.options).map_err(|e| Failure::from_field(&e, at))?;
    // the bytes of a scene in a request are its JSON without spaces, members in alphabetical order
    let provenance = json!({"sha256": BlobId::of(bytes).hex(), "bytes": bytes.len(), "options": spec.options});
    Ok(Opened { field, weight: None, earlier: None, provenance, detected, moved_by: None })
}

impl Opened {
    /// The same with a weight, opened like a field and pointed to below `at`.
    pub fn with_weight(mut self, spec: &FieldSpec, bytes: Option<&[u8]>, at: &str) -> Result<Self, Box<Failure>> {
        let opened = open(spec, bytes, at)?;
        for found in [opened.field.dimension(), self.field.dimension()] {
            if found != 3 {
                let detail =
                    format!("a weight is a field of dimension 3, for one of dimension 3, and one here has {found}");
                return Err(Box::new(Failure::new("dimension", "the field has the wrong dimension for this", detail)));
            }
        }
        self.weight = Some(opened.field);
        self.provenance["weight"] = opened.provenance;
        Ok(self)
    }

    /// The same with the network in `bytes`, so that the output `surface` says how it moves with its latent code.
    pub fn with_latent_motion(mut self, bytes: &[u8], options: &FieldOptions) -> Result<Self, Box<Failure>> {
        let (placed, _) = input::open_network(bytes, options).map_err(|e| Failure::from_field(&e, "/field"))?;
        if placed.latent.is_empty() {
            let detail = "the network takes no latent code, so nothing moves with it".to_owned();
            return Err(Box::new(Failure::from_field(&FieldError::Unsupported { detail }, "/field")));
        }
        self.moved_by = Some(placed);
        Ok(self)
    }

    /// The same with the surface that a warm start begins from: the output `surface` of an earlier job, on this lattice.
    pub fn with_warm_start(mut self, bytes: &[u8], lattice: LatticeSpec) -> Result<Self, Box<Failure>> {
        let wrong = |detail: String| Box::new(Failure::new("warm_start", "the surface is none to start from", detail));
        if self.field.dimension() != 3 {
            return Err(wrong("a curve has no warm start: the field has dimension 2".to_owned()));
        }
        let earlier = surface::tensors::from_safetensors(bytes, lattice).map_err(|e| wrong(e.to_string()))?;
        self.provenance["warm_start"] = json!({"sha256": BlobId::of(bytes).hex(), "bytes": bytes.len()});
        self.earlier = Some(earlier);
        Ok(self)
    }
}

/// Seconds that the parts of an extraction took.
#[derive(Default)]
struct Clock {
    shrink: Cell<f64>,
    measure: Cell<f64>,
    /// The part that runs, and since when.
    running: Cell<Option<(Part, Instant)>>,
}

impl Clock {
    fn begin(&self, next: Option<Part>) {
        if let Some((part, since)) = self.running.take() {
            let sum = match part {
                Part::Shrink => &self.shrink,
                Part::Measure => &self.measure,
            };
            sum.set(sum.get() + since.elapsed().as_secs_f64());
        }
        self.running.set(next.map(|part| (part, Instant::now())));
    }
}

/// Makes a certified surface of the field, or the best there is, and writes it.
///
/// Every output but the report is the same for the same request, whatever the clock and the number of threads say.
pub fn make(opened: &Opened, asked: &Asked<'_>, settings: Settings<'_>) -> Result<Made, Ended> {
    let film = asked.outputs.contains(&OutputName::Filmstrip).then(Film::default);
    let told = |progress: Progress| {
        if let Some(film) = &film {
            film.see(&progress);
        }
        (settings.progress)(Progress { fraction: MEASURED_SHARE * progress.fraction, ..progress });
    };
    let tally = Tally::new();
    let sampler = Sampler::new(
        opened.field.as_ref(),
        Settings { progress: &told, watched: settings.watched || film.is_some(), ..settings },
        &tally,
    );
    let clock = Clock::default();
    let begins = |part| clock.begin(Some(part));
    let (weight, earlier) = (opened.weight.as_deref(), opened.earlier.as_ref());
    let made = extract(&sampler, asked.shrink, weight, asked.budget, earlier, &begins);
    clock.begin(None);
    let Extracted { surface, mut report, refusal } = made?;
    report.network = opened.detected.clone();
    report.seconds.load = asked.load_seconds;
    report.seconds.shrink = clock.shrink.get();
    report.seconds.finish = clock.measure.get();

    let write = Progress { stage: "write", attempt: report.attempts, ..Progress::default() };
    (settings.progress)(Progress { fraction: MEASURED_SHARE, ..write });
    let clock = Instant::now();
    let lasting = lasting(&report);
    let files = asked.written(&settings, |output| {
        Ok(match output {
            OutputName::Glb => surface::gltf::to_glb(&surface, &lasting, &opened.provenance),
            OutputName::Surface => {
                let motion = opened.moved_by.as_ref().map(|net| latent_motion(net, &surface.positions, &settings));
                surface::tensors::to_safetensors(&surface, &report.by_triangle, motion.transpose()?.as_deref())
            }
            OutputName::Svg | OutputName::Network | OutputName::Sensitivity => {
                let detail = format!("{} is not made of a field of dimension 3", output.name());
                return Err(Failure::new("dimension", "the field has the wrong dimension for this", detail).into());
            }
            OutputName::Preview => surface::preview::to_png(&surface, PREVIEW_WIDTH, &settings)?,
            OutputName::Filmstrip => film.as_ref().map_or(Ok(Vec::new()), |film| film.to_png(&surface, &settings))?,
            OutputName::Report => {
                report.seconds.write = clock.elapsed().as_secs_f64();
                pretty(&report)
            }
        })
    })?;
    Ok(Made { report, files, refusal })
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
