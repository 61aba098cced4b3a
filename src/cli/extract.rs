//! `shrinkd extract`: one field in, files out, and one line that says how good they are.

use super::options::MethodArg;
use super::{BAD_INPUT, BAD_USAGE, ExtractArgs, FAILED, NOT_WRAPPED, STEPS, fail, progress_bar};
use crate::job::failure::{Ended, Failure};
use crate::job::pipeline::{self, Asked, CurveMade, Made, Opened};
use crate::job::spec::{FieldSpec, OutputName};
use crate::measure::report::WarmStart;
use crate::measure::verdict::Finding;
use crate::settings::{CancelToken, Progress, Settings};
use crate::shrink::{Density, ShrinkSpec};
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::Instant;

/// Places that are printed of each fault.
const PLACES: usize = 4;

/// Wraps one field.
pub fn run(args: &ExtractArgs) -> ExitCode {
    match extract(args) {
        Ok(()) => ExitCode::SUCCESS,
        Err((code, error)) => fail(code, &error),
    }
}

/// An exit code and what to say, where there is no result that passed its checks.
fn extract(args: &ExtractArgs) -> Result<(), (u8, String)> {
    let clock = Instant::now();
    let spec = FieldSpec { options: args.field_options.read()?, ..FieldSpec::default() };
    let in_field = |detail: &str| format!("{}: {detail}", args.field.display());
    let mut opened = open(&args.field, |bytes| pipeline::open(&spec, Some(bytes), ""))?;
    if args.latent_motion {
        opened = open(&args.field, |bytes| opened.with_latent_motion(bytes, &spec.options))?;
    }
    if let Some(path) = &args.weight {
        opened = open(path, |bytes| opened.with_weight(&FieldSpec::default(), Some(bytes), ""))?;
    }
    if let Some(path) = &args.warm_start {
        if args.shrink.method == MethodArg::Paper {
            return Err((BAD_USAGE, in_field("--warm-start is for the method adaptive")));
        }
        opened = open(path, |bytes| opened.with_warm_start(bytes, args.lattice))?;
    }
    let pool = rayon::ThreadPoolBuilder::new().num_threads(args.threads).build();
    let pool = pool.map_err(|e| (FAILED, e.to_string()))?;
    let (cancel, bar) = (CancelToken::new(), progress_bar());
    let progress = |progress: Progress| {
        bar.set_position((f64::from(progress.fraction) * STEPS as f64) as u64);
        bar.set_message(match progress.attempt {
            0 | 1 => progress.stage.to_owned(),
            n => format!("{} (attempt {n})", progress.stage),
        });
    };
    let settings = Settings { pool: &pool, cancel: &cancel, progress: &progress, watched: false };
    let mut shrink = ShrinkSpec { samples: args.samples, ..args.shrink.spec(args.lattice) };
    if args.weight.is_some() {
        shrink.density = Density::Weight;
    }
    let budget = args.shrink.budget();
    let load_seconds = clock.elapsed().as_secs_f64();
    let asked = |outputs| Asked { shrink: &shrink, budget, outputs, load_seconds };
    let ended = |ended: Ended| match ended {
        Ended::Failed(failure) if failure.is_bad_input() => (BAD_INPUT, in_field(&failure.detail)),
        Ended::Failed(failure) => {
            let Failure { detail, code, places, .. } = *failure;
            (NOT_WRAPPED, in_field(&finding("", &Finding { code, detail, places })))
        }
        Ended::Canceled => (FAILED, "canceled".to_owned()),
    };
    if opened.field.dimension() == 2 {
        if args.filmstrip.is_some() {
            return Err((BAD_USAGE, in_field("--filmstrip is for fields of dimension 3")));
        }
        let svg = args.svg.clone().unwrap_or_else(|| args.output.with_extension("svg"));
        let mut files = wanted(args);
        files.push((OutputName::Svg, svg.clone()));
        files.sort();
        let outputs: Vec<OutputName> = files.iter().map(|(output, _)| *output).collect();
        let made = pipeline::make_curve(&opened, &asked(&outputs), settings).map_err(ended)?;
        bar.finish_and_clear();
        for ((_, path), (_, bytes)) in files.iter().zip(&made.files) {
            write(path, bytes)?;
        }
        println!("{}", curve_summary(args, &svg, &made, clock.elapsed().as_secs_f64()));
        for warning in &made.report.verdict.warnings {
            eprintln!("shrinkd: {}", in_field(&finding("warning: ", warning)));
        }
        if made.is_sound() {
            return Ok(());
        }
        let faults = made.report.verdict.faults.iter().map(|fault| format!("\n{}", finding("  ", fault)));
        let faults: String = faults.collect();
        return Err((FAILED, in_field(&format!("the best curve was written, and it did not pass:{faults}"))));
    }
    if args.samples.is_some() || args.svg.is_some() {
        return Err((BAD_USAGE, in_field("--samples and --svg are for fields of dimension 2")));
    }
    let files = wanted(args);
    let outputs: Vec<OutputName> = files.iter().map(|(output, _)| *output).collect();
    let made = pipeline::make(&opened, &asked(&outputs), settings).map_err(ended)?;
    bar.finish_and_clear();
    for ((_, path), (_, bytes)) in files.iter().zip(&made.files) {
        write(path, bytes)?;
    }
    println!("{}", summary(args, &made, clock.elapsed().as_secs_f64()));
    let verdict = &made.report.verdict;
    if let Some(WarmStart { used: false, reason: Some(reason), .. }) = &made.report.warm_start {
        eprintln!("shrinkd: {}", in_field(&format!("the warm start did not pass, so its UVs were not kept: {reason}")));
    }
    for warning in &verdict.warnings {
        eprintln!("shrinkd: {}", in_field(&finding("warning: ", warning)));
    }
    if verdict.passed {
        return Ok(());
    }
    let faults: String = verdict.faults.iter().map(|fault| format!("\n{}", finding("  ", fault))).collect();
    let code = if made.refusal.is_some() { NOT_WRAPPED } else { FAILED };
    let attempts = match made.report.attempts {
        1 => "one attempt".to_owned(),
        n => format!("{n} attempts"),
    };
    Err((code, in_field(&format!("the best surface of {attempts} was written, and it did not pass:{faults}"))))
}

/// Reads a file and opens it; what is wrong is said with the file's name.
fn open(path: &Path, with: impl FnOnce(&[u8]) -> Result<Opened, Box<Failure>>) -> Result<Opened, (u8, String)> {
    let bytes = super::read_field(path).map_err(|e| (BAD_INPUT, format!("{}: {e}", path.display())))?;
    with(&bytes).map_err(|failure| (BAD_INPUT, format!("{}: {}", path.display(), super::faults(&failure))))
}

/// A finding in one line: its sentence, its code, and where.
fn finding(before: &str, finding: &Finding) -> String {
    let places = finding.places.iter().take(PLACES).map(|[x, y, z]| format!("({x:.4}, {y:.4}, {z:.4})"));
    let places: Vec<String> = places.collect();
    let at = if places.is_empty() { String::new() } else { format!(" at {}", places.join(", ")) };
    let more = if finding.places.len() > PLACES { " and more" } else { "" };
    format!("{before}{} ({}){at}{more}", finding.detail, finding.code)
}

/// Which outputs go where, in the order of [`OutputName`].
fn wanted(args: &ExtractArgs) -> Vec<(OutputName, PathBuf)> {
    let files = [
        (OutputName::Glb, Some(&args.output)),
        (OutputName::Surface, args.surface.as_ref()),
        (OutputName::Preview, args.preview.as_ref()),
        (OutputName::Filmstrip, args.filmstrip.as_ref()),
        (OutputName::Report, args.report.as_ref()),
    ];
    files.into_iter().filter_map(|(output, path)| Some((output, path?.clone()))).collect()
}

fn write(path: &Path, bytes: &[u8]) -> Result<(), (u8, String)> {
    std::fs::write(path, bytes).map_err(|e| (FAILED, format!("{}: {e}", path.display())))
}

fn name(path: &Path) -> std::borrow::Cow<'_, str> {
    path.file_name().unwrap_or(path.as_os_str()).to_string_lossy()
}

fn summary(args: &ExtractArgs, made: &Made, seconds: f64) -> String {
    let report = &made.report;
    let flips = report.flips.surface + report.flips.sphere + report.flips.uv;
    let passed = if report.verdict.passed { "; passed every check" } else { "" };
    format!(
        "{} -> {}: {} vertices, {:.1} evaluations per vertex, {flips} flips, NC {:.4}, max distance {:.2} %, {seconds:.2} s{passed}",
        name(&args.field),
        name(&args.output),
        report.vertices,
        report.evaluations.per_vertex,
        report.closeness.normal_consistency,
        100.0 * report.closeness.distance.max,
    )
}

fn curve_summary(args: &ExtractArgs, svg: &Path, made: &CurveMade, seconds: f64) -> String {
    let report = &made.report;
    let passed = if made.is_sound() { "; passed every check" } else { "" };
    format!(
        "{} -> {}, {}: {} samples, {:.1} evaluations per sample, {} self-intersections, max distance {:.2} %, {seconds:.2} s{passed}",
        name(&args.field),
        name(&args.output),
        name(svg),
        report.vertices,
        report.evaluations.per_vertex,
        report.self_intersections,
        100.0 * report.closeness.distance.max,
    )
}
