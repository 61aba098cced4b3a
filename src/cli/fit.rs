//! `shrinkd fit`: meshes in, a network's weights out, and one line per mesh that says how well it does.

use super::interrupt::raise_on_signal;
use super::{BAD_INPUT, BAD_USAGE, FAILED, fail, progress_bar};
use crate::blobs::BlobId;
use crate::field::mesh::MeshField;
use crate::field::network::{Activation, safetensors};
use crate::fit::spec::MAX_MESHES;
use crate::fit::{Checkpoint, FitSpec, Sampling, Training, fit};
use crate::job::pipeline::open_mesh;
use crate::settings::{CancelToken, Progress, Settings};
use clap::{Args, ValueEnum};
use std::cell::Cell;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::{Duration, Instant};

/// Least time between two checkpoints.
const CHECKPOINT_EVERY: Duration = Duration::from_secs(5);

/// What the help ends with.
pub const EXAMPLES: &str = "\
Examples:
  shrinkd fit spot.ply -o spot.safetensors
  shrinkd fit spot.ply -o spot.safetensors --checkpoint spot.checkpoint --report spot.json
  shrinkd fit chairs/*.ply -o chairs.safetensors --latent-size 64 --layers 8 --width 256 --normalize
  shrinkd extract chairs.safetensors --latent-row 3 -o chair.glb

Exits 0 when a network was written, 1 when training was interrupted or diverged, 2 on bad usage, 3 when a file is no mesh.";

/// Arguments of `fit`.
#[derive(Debug, Args)]
pub struct FitArgs {
    /// The meshes: one gives a SIREN, several an auto-decoder with a latent code each, in this order
    #[arg(required = true, value_name = "MESH")]
    pub meshes: Vec<PathBuf>,
    /// Where the network goes (safetensors, with its architecture)
    #[arg(short, long, value_name = "NET.safetensors")]
    pub output: PathBuf,
    /// Hidden layers
    #[arg(long, value_name = "N", default_value_t = FitSpec::default().layers)]
    pub layers: u32,
    /// Outputs of a hidden layer
    #[arg(long, value_name = "N", default_value_t = FitSpec::default().width)]
    pub width: u32,
    /// Activation of the hidden layers [default: sine for one mesh, relu for several]
    #[arg(long, value_enum, value_name = "NAME")]
    pub activation: Option<ActivationArg>,
    /// Frequency of the sine
    #[arg(long, default_value_t = 30.0)]
    pub w0: f32,
    /// Entries of the latent code that each of several meshes gets
    #[arg(long, value_name = "N", default_value_t = FitSpec::default().latent_size)]
    pub latent_size: u32,
    /// Passes over the samples
    #[arg(long, value_name = "N", default_value_t = FitSpec::default().epochs)]
    pub epochs: u32,
    /// Samples of every mesh
    #[arg(long, value_name = "N", default_value_t = FitSpec::default().samples)]
    pub samples: u32,
    /// Where the samples lie
    #[arg(long, value_enum, default_value_t = SamplingArg::Points)]
    pub sampling: SamplingArg,
    /// Bring every mesh to one cube first; the report says how to come back
    #[arg(long)]
    pub normalize: bool,
    /// Samples of a step
    #[arg(long, value_name = "N", default_value_t = FitSpec::default().batch)]
    pub batch: u32,
    /// Learning rate at its highest; it falls along a cosine
    #[arg(long, value_name = "RATE", default_value_t = FitSpec::default().learning_rate)]
    pub learning_rate: f64,
    /// Weight of (grad f - grad d)^2 beside |f - d|
    #[arg(long, value_name = "WEIGHT", default_value_t = FitSpec::default().normal)]
    pub normal: f64,
    /// Weight of (|grad f| - 1)^2 beside |f - d|
    #[arg(long, value_name = "WEIGHT", default_value_t = FitSpec::default().eikonal)]
    pub eikonal: f64,
    /// Weight of |z|^2, the squared length of the latent codes
    #[arg(long, value_name = "WEIGHT", default_value_t = FitSpec::default().latent_penalty)]
    pub latent_penalty: f64,
    /// Seed of all that is random
    #[arg(long, value_name = "N", default_value_t = FitSpec::default().seed)]
    pub seed: u64,
    /// Where the report goes (JSON)
    #[arg(long, value_name = "R.json")]
    pub report: Option<PathBuf>,
    /// Where the state is kept every few seconds; a run that finds the state of the same training there goes on from it
    #[arg(long, value_name = "FILE")]
    pub checkpoint: Option<PathBuf>,
    /// Threads; 0 is one per core. The result does not depend on it
    #[arg(long, default_value_t = 0)]
    pub threads: usize,
}

/// Activations that networks are trained with.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum ActivationArg {
    /// sin(w0 x)
    Sine,
    /// max(x, 0)
    Relu,
    /// ln(1 + e^(100 x)) / 100
    Softplus,
    /// x for positive x, e^x - 1 otherwise
    Elu,
    /// Hyperbolic tangent
    Tanh,
}

/// Where samples lie.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum SamplingArg {
    /// On the surface, near it, and all over the domain
    Points,
    /// The nodes of the paper's grid of 32 x 32 x 32
    Grid,
}

impl FitArgs {
    fn spec(&self) -> FitSpec {
        let activation = self.activation.map(|name| match name {
            ActivationArg::Sine => Activation::Sine { w0: self.w0 },
            ActivationArg::Relu => Activation::Relu,
            ActivationArg::Softplus => Activation::Softplus { beta: 100.0 },
            ActivationArg::Elu => Activation::Elu,
            ActivationArg::Tanh => Activation::Tanh,
        });
        let sine = || (self.meshes.len() == 1).then_some(Activation::Sine { w0: self.w0 });
        FitSpec {
            layers: self.layers,
            width: self.width,
            activation: activation.or_else(sine),
            latent_size: self.latent_size,
            epochs: self.epochs,
            samples: self.samples,
            sampling: match self.sampling {
                SamplingArg::Points => Sampling::Points,
                SamplingArg::Grid => Sampling::Grid,
            },
            normalize: self.normalize,
            batch: self.batch,
            learning_rate: self.learning_rate,
            normal: self.normal,
            eikonal: self.eikonal,
            latent_penalty: self.latent_penalty,
            seed: self.seed,
        }
    }
}

/// Fits one network.
pub fn run(args: &FitArgs) -> ExitCode {
    match fitted(args) {
        Ok(()) => ExitCode::SUCCESS,
        Err((code, error)) => fail(code, &error),
    }
}

fn fitted(args: &FitArgs) -> Result<(), (u8, String)> {
    let clock = Instant::now();
    let spec = args.spec();
    if let Some(fault) = spec.faults().first() {
        let flag = fault.pointer.trim_start_matches('/').replace('_', "-");
        return Err((BAD_USAGE, format!("--{flag}: {}", fault.detail)));
    }
    if args.meshes.len() > MAX_MESHES {
        return Err((BAD_USAGE, format!("{} meshes, and at most {MAX_MESHES} are fitted", args.meshes.len())));
    }
    let opened: Vec<(MeshField, String)> = args.meshes.iter().map(|path| open(path)).collect::<Result<_, _>>()?;
    let (meshes, hashes): (Vec<MeshField>, Vec<String>) = opened.into_iter().unzip();
    let fingerprint = hashes.join(" ");
    let from = args.checkpoint.as_deref().and_then(|path| std::fs::read(path).ok());
    let from = from.and_then(|bytes| Checkpoint::from_bytes(&bytes, &spec, meshes.len(), &fingerprint));
    if let Some(state) = &from {
        eprintln!("shrinkd: going on after epoch {} of {}", state.epoch, spec.epochs);
    }
    let pool = rayon::ThreadPoolBuilder::new().num_threads(args.threads).build();
    let pool = pool.map_err(|e| (FAILED, e.to_string()))?;
    let (cancel, bar) = (CancelToken::new(), progress_bar());
    raise_on_signal(&cancel).map_err(|e| (FAILED, e.to_string()))?;
    let progress = |progress: Progress| {
        bar.set_position((f64::from(progress.fraction) * super::STEPS as f64) as u64);
        let loss = progress.energy.map_or(String::new(), |loss| format!(" loss {loss:.5}"));
        bar.set_message(format!("{}{loss}", progress.stage));
    };
    let settings = Settings { pool: &pool, cancel: &cancel, progress: &progress, watched: false };
    let last = Cell::new(Instant::now());
    let checkpoint = |state: &Checkpoint| {
        let Some(path) = &args.checkpoint else { return };
        let due = state.epoch == spec.epochs || last.get().elapsed() >= CHECKPOINT_EVERY;
        if due && let Err(error) = write_whole(path, &state.to_bytes(&spec, &fingerprint)) {
            eprintln!("shrinkd: {}: {error}", path.display());
        }
        if due {
            last.set(Instant::now());
        }
    };
    let made = fit(&meshes, Training { spec: &spec, from, checkpoint: &checkpoint }, &settings);
    bar.finish_and_clear();
    let made = made.map_err(|e| (FAILED, e.to_string()))?;
    let write = |path: &Path, bytes: &[u8]| {
        std::fs::write(path, bytes).map_err(|e| (FAILED, format!("{}: {e}", path.display())))
    };
    write(&args.output, &safetensors::write(&made.network))?;
    if let Some(path) = &args.report {
        let mut text = serde_json::to_vec_pretty(&made.report).unwrap_or_default();
        text.push(b'\n');
        write(path, &text)?;
    }
    for (path, shape) in args.meshes.iter().zip(&made.report.shapes) {
        let zeros = shape.closeness.map_or("no zero level set".to_owned(), |closeness| {
            let distance = closeness.distance;
            let (mean, max) = (100.0 * distance.mean, 100.0 * distance.max);
            let parts = match shape.components {
                1 => String::new(),
                n => format!(" in {n} components"),
            };
            format!("zero level set{parts} mean {mean:.3} %, max {max:.2} %")
        });
        println!("{}: error {:.3} %, {zeros}", path.display(), 100.0 * shape.error);
    }
    println!(
        "{}: {} parameters, loss {:.5}, {:.1} s",
        args.output.display(),
        made.report.parameters,
        made.report.losses.last().copied().unwrap_or_default(),
        clock.elapsed().as_secs_f64(),
    );
    Ok(())
}

/// A mesh, and the hash of its file.
fn open(path: &Path) -> Result<(MeshField, String), (u8, String)> {
    let wrong = |e: &dyn std::fmt::Display| (BAD_INPUT, format!("{}: {e}", path.display()));
    let bytes = std::fs::read(path).map_err(|e| wrong(&e))?;
    let mesh = open_mesh(&bytes, "").map_err(|failure| wrong(&failure.detail))?;
    Ok((mesh, BlobId::of(&bytes).hex()))
}

/// Writes a file that is whole whenever it is read: beside it first, then in its place.
fn write_whole(path: &Path, bytes: &[u8]) -> std::io::Result<()> {
    let mut beside = path.as_os_str().to_owned();
    beside.push(".new");
    std::fs::write(&beside, bytes)?;
    std::fs::rename(&beside, path)
}
