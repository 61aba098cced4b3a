//! `shrinkd animate`: a path through the latent space of a network in, one GLB with a morph target for every frame out.

mod frame;
mod latents;

use super::options::MethodArg;
use super::progress_bar;
use super::{AnimateArgs, BAD_INPUT, BAD_USAGE, FAILED, NOT_WRAPPED, fail};
use crate::extract::path::{Path, PathError, Stop};
use crate::field::input::{self, FieldOptions};
use crate::job::pipeline;
use crate::job::spec::FieldSpec;
use crate::settings::{CancelToken, Progress, Settings};
use crate::shrink::ShrinkError;
use crate::surface::Surface;
use crate::surface::gltf::morph::{self, Shape};
use frame::{Frame, Later, Report};
use latents::Entry;
use serde_json::json;
use std::process::ExitCode;
use std::time::Instant;

/// Largest GLB: its lengths have 32 bits, and something is left for what is there once.
const MAX_BYTES: u64 = (1 << 32) - (1 << 28);

/// Animates one network.
pub fn run(args: &AnimateArgs) -> ExitCode {
    match animate(args) {
        Ok(()) => ExitCode::SUCCESS,
        Err((code, error)) => fail(code, &error),
    }
}

/// An exit code and what to say, where not every frame passed its checks.
fn animate(args: &AnimateArgs) -> Result<(), (u8, String)> {
    let clock = Instant::now();
    if args.shrink.method == MethodArg::Paper || args.shrink.relax_uv {
        return Err((BAD_USAGE, "an animation is made by the method adaptive, with the sphere's own UVs".to_owned()));
    }
    let in_net = |detail: &dyn std::fmt::Display| (BAD_INPUT, format!("{}: {detail}", args.net.display()));
    let in_latents = |detail: &dyn std::fmt::Display| (BAD_INPUT, format!("{}: {detail}", args.latents.display()));
    let bytes = super::read_field(&args.net).map_err(|e| in_net(&e))?;
    let given = args.field_options.as_deref().cloned().unwrap_or_default();
    let options = FieldOptions { domain: args.domain.or(given.domain), ..given };
    if options.latent.is_some() || options.latent_row.is_some() {
        return Err((BAD_USAGE, "the latent codes of an animation are those of --latents".to_owned()));
    }
    let with = |latent: Option<Vec<f32>>, latent_row| FieldOptions { latent, latent_row, ..options.clone() };
    let text = std::fs::read(&args.latents).map_err(|e| in_latents(&e))?;
    let look_up = |entry: &Entry| match entry {
        Entry::Row(row) => input::latent_code(&bytes, &with(None, Some(*row))),
        Entry::Code(code) => input::latent_code(&bytes, &with(Some(code.clone()), None)),
    };
    let codes = latents::read(&text, look_up).map_err(|e| in_latents(&e))?;
    let opened = |code: &[f32]| {
        let spec = FieldSpec { options: with(Some(code.to_vec()), None), ..FieldSpec::default() };
        pipeline::open(&spec, Some(&bytes), "")
    };
    let first = opened(&codes[0]).map_err(|failure| in_net(&failure.detail))?;
    let shrink = args.shrink.spec(args.lattice);
    let pool = rayon::ThreadPoolBuilder::new().num_threads(args.threads).build();
    let pool = pool.map_err(|e| (FAILED, e.to_string()))?;
    let (cancel, bar) = (CancelToken::new(), progress_bar());
    let total = bar.length().unwrap_or_default();
    let progress = |progress: Progress| {
        bar.set_position((f64::from(progress.fraction) * total as f64) as u64);
        bar.set_message(progress.stage.to_owned());
    };
    let settings = Settings { pool: &pool, cancel: &cancel, progress: &progress, watched: false };
    let open = |code: &[f32]| opened(code).map(|opened| opened.field);
    let path = Path { open: &open, spec: &shrink, budget: args.shrink.budget(), cold: args.cold, settings };
    let (mut frames, mut shapes, mut base) = (Vec::new(), Vec::new(), None::<Surface>);
    let mut arrive = |i: usize, stop: &Stop| {
        frames.push(Frame::new(i, &codes[i], stop));
        match &base {
            None => base = Some(stop.surface.clone()),
            Some(_) if args.output.is_some() => shapes.push(Shape::of(&stop.surface)),
            Some(_) => {}
        }
    };
    let followed = path.follow(&codes, &mut arrive);
    bar.finish_and_clear();
    followed.map_err(|(frame, error)| match error {
        PathError::Field(failure) => in_net(&format!("frame {frame}: {}", failure.detail)),
        PathError::Shrink(error @ ShrinkError::Canceled(_)) => (FAILED, error.to_string()),
        PathError::Shrink(error) => (NOT_WRAPPED, in_net(&format!("frame {frame}: {error} ({})", error.code())).1),
    })?;
    let report = Report {
        later: Later::of(&frames),
        passed: frames.iter().all(|frame| frame.passed),
        vertices: args.lattice.vertices(),
        options: shrink,
        network: first.detected,
        version: env!("CARGO_PKG_VERSION").to_owned(),
        frames,
    };
    let write = |path: &std::path::Path, bytes: &[u8]| {
        std::fs::write(path, bytes).map_err(|e| (FAILED, format!("{}: {e}", path.display())))
    };
    if let (Some(output), Some(base)) = (&args.output, &base) {
        if morph::bytes_of(base, shapes.len()) > MAX_BYTES {
            let detail = format!("{} frames of {} vertices are more than a GLB can hold", codes.len(), report.vertices);
            return Err((FAILED, detail));
        }
        let seconds = 1.0 / args.fps;
        write(output, &morph::to_glb(base, &shapes, seconds, &json!(report), &first.provenance))?;
    }
    if let Some(path) = &args.report {
        let mut text = serde_json::to_vec_pretty(&report).map_err(|e| (FAILED, e.to_string()))?;
        text.push(b'\n');
        write(path, &text)?;
    }
    println!("{}", summary(args, &report, clock.elapsed().as_secs_f64()));
    for frame in report.frames.iter().skip(1).filter(|frame| !frame.warm && !args.cold) {
        let detail = format!("frame {} could not be made from the one before: its UVs lie anew", frame.frame);
        eprintln!("shrinkd: {}", in_net(&detail).1);
    }
    let failed = report.frames.iter().filter(|frame| !frame.passed);
    let said = |frame: &Frame| {
        let faults: Vec<&str> = frame.faults.iter().map(|fault| fault.detail.as_str()).collect();
        format!("\n  frame {}: {}", frame.frame, faults.join("; "))
    };
    let failed: String = failed.map(said).collect();
    match failed.is_empty() {
        true => Ok(()),
        false => Err((FAILED, in_net(&format!("not every frame passed:{failed}")).1)),
    }
}

fn summary(args: &AnimateArgs, report: &Report, seconds: f64) -> String {
    let name = |path: &std::path::Path| path.file_name().unwrap_or(path.as_os_str()).to_string_lossy().into_owned();
    let output = args.output.as_deref().map_or("no file".to_owned(), name);
    let flips: u64 = report.frames.iter().map(|f| f.flips.surface + f.flips.sphere + f.flips.uv).sum();
    let Later { evaluations_per_vertex, distance, drift, .. } = report.later;
    format!(
        "{} -> {output}: {} frames of {} vertices, {:.1} evaluations per vertex for the first and {evaluations_per_vertex:.1} \
         for each other, {flips} flips, max distance {:.2} %, drift {:.3} %, {seconds:.2} s",
        name(&args.net),
        report.frames.len(),
        report.vertices,
        report.frames.first().map_or(0.0, |frame| frame.evaluations_per_vertex),
        100.0 * distance.max,
        100.0 * drift.mean,
    )
}
