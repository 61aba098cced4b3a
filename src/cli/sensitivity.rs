//! `shrinkd sensitivity`: a network, a surface of it and a gradient of the surface's vertices in, the gradient of its latent code and
//! weights out.

use super::{BAD_INPUT, FAILED, FieldArgs, fail};
use crate::job::failure::Ended;
use crate::job::pipeline::sensitivity_of;
use crate::settings::{CancelToken, Settings};
use clap::Args;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

/// What the help ends with.
pub const EXAMPLES: &str = "\
Examples:
  shrinkd extract chairs.safetensors --latent-row 3 -o chair.glb --surface chair.safetensors
  shrinkd sensitivity chairs.safetensors --latent-row 3 --surface chair.safetensors --gradient dl_dv.safetensors -o dl_dz.safetensors

Exits 0 when the derivatives were written, 2 on bad usage, 3 when a file cannot be read or does not fit the others.";

/// Arguments of `sensitivity`.
#[derive(Debug, Args)]
pub struct SensitivityArgs {
    /// The network, as it was given to `extract`
    pub field: PathBuf,
    /// The surface that `extract --surface` wrote
    #[arg(long, value_name = "S.safetensors")]
    pub surface: PathBuf,
    /// The derivatives of a loss by the surface's vertices: safetensors with the tensor `gradient`, [vertices, 3] or [rows, columns, 3]
    #[arg(long, value_name = "G.safetensors")]
    pub gradient: PathBuf,
    /// Where the derivatives by the latent code and the weights go (safetensors)
    #[arg(short, long, value_name = "OUT.safetensors")]
    pub output: PathBuf,
    /// What the field leaves open, as it was given to `extract`.
    #[command(flatten)]
    pub field_options: FieldArgs,
    /// Threads; 0 is one per core. The result does not depend on it
    #[arg(long, default_value_t = 0)]
    pub threads: usize,
}

/// Carries one gradient back.
pub fn run(args: &SensitivityArgs) -> ExitCode {
    match carried(args) {
        Ok(()) => ExitCode::SUCCESS,
        Err((code, error)) => fail(code, &error),
    }
}

fn carried(args: &SensitivityArgs) -> Result<(), (u8, String)> {
    let options = args.field_options.read()?;
    let read = |path: &Path| std::fs::read(path).map_err(|e| (BAD_INPUT, format!("{}: {e}", path.display())));
    let field = super::read_field(&args.field).map_err(|e| (BAD_INPUT, format!("{}: {e}", args.field.display())))?;
    let (surface, gradient) = (read(&args.surface)?, read(&args.gradient)?);
    let pool = rayon::ThreadPoolBuilder::new().num_threads(args.threads).build();
    let pool = pool.map_err(|e| (FAILED, e.to_string()))?;
    let settings = Settings { pool: &pool, cancel: &CancelToken::new(), progress: &|_| {}, watched: false };
    let made = sensitivity_of(&field, &options, &surface, &gradient, &settings).map_err(|ended| {
        let Ended::Failed(failure) = ended else { return (FAILED, "canceled".to_owned()) };
        let path = match failure.code.as_str() {
            "malformed_surface" => &args.surface,
            "malformed_gradient" => &args.gradient,
            _ => &args.field,
        };
        (BAD_INPUT, format!("{}: {}", path.display(), failure.detail))
    })?;
    std::fs::write(&args.output, made.bytes).map_err(|e| (FAILED, format!("{}: {e}", args.output.display())))?;
    println!(
        "{}: |dL/dlatent| {:.6e}, |dL/dweights| {:.6e}, {} vertices",
        args.output.display(),
        made.report.latent_norm,
        made.report.weights_norm,
        made.report.vertices,
    );
    Ok(())
}
