//! One shape: opened once, wrapped on every lattice by the same call as `shrinkd extract`, measured beside marching cubes.

use super::clocked::{Clocked, Watch};
use super::fits;
use super::row::{Outcome, Row, lattice_name};
use super::shapes::Shape;
use super::sheet;
use crate::extract::Budget;
use crate::field::Sampler;
use crate::field::input::{Description, FieldOptions};
use crate::field::sampler::Tally;
use crate::job::failure::{self, Failure};
use crate::job::pipeline::{self, Asked, Made, Opened};
use crate::job::spec::{FieldSpec, OutputName};
use crate::measure::Report;
use crate::measure::baseline::{Baseline, baseline, cubes_at, side_for};
use crate::measure::report::passes;
use crate::measure::truth::Truth;
use crate::settings::{CancelToken, Canceled, Progress, Settings};
use crate::shrink::lattice::LatticeSpec;
use crate::shrink::{Method, ShrinkSpec};
use crate::surface::sheet::plain_picture;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

/// Failures that say that the zero level set is no sphere.
const REFUSALS: [&str; 3] = ["genus", "components", "empty_zero_set"];
/// How often the clock and the signal are looked at while a shape is at work.
const TICK: Duration = Duration::from_millis(20);

/// What is done with every shape.
pub struct Task<'a> {
    /// How it is wrapped, on whatever lattice.
    pub asked: ShrinkSpec,
    /// What may be spent on one lattice.
    pub budget: Budget,
    /// On which lattices.
    pub lattices: &'a [LatticeSpec],
    /// Whether marching cubes is run beside.
    pub baseline: bool,
    /// Time that one lattice may take.
    pub limit: Option<Duration>,
    /// Patterns of the shapes that should be refused.
    pub expected: &'a [String],
    /// Folder that the GLBs go to.
    pub keep: Option<&'a Path>,
    /// Whether pictures are drawn.
    pub draw: bool,
    /// Whether the paper's method is run, too, and drawn with marching cubes beside the result.
    pub side_by_side: bool,
    /// The pool.
    pub pool: &'a rayon::ThreadPool,
    /// Raised by the signal.
    pub stop: &'a CancelToken,
}

/// Why a shape gave no rows, or not all.
pub enum Ended {
    /// It cannot be read as a surface.
    Unread(String),
    /// The signal came.
    Stopped,
    /// A row or a file could not be written.
    Io(String),
}

/// Pictures of a row, each empty where there is none.
#[derive(Default)]
pub struct Pictures {
    /// The result.
    pub own: Vec<u8>,
    /// Marching cubes.
    pub cubes: Vec<u8>,
    /// What the paper's method made.
    pub paper: Vec<u8>,
}

/// Takes a row as it comes, with its pictures.
pub type Add<'a> = &'a mut dyn FnMut(Row, Pictures) -> Result<(), String>;

/// Wraps a shape on every lattice and hands over each row as it comes.
pub fn run(shape: &Shape, task: &Task<'_>, add: Add<'_>) -> Result<(), Ended> {
    let clock = Instant::now();
    let watch = Arc::new(Watch::default());
    let opened = open(shape, &watch).map_err(Ended::Unread)?;
    let load = clock.elapsed().as_secs_f64();
    let settings = Settings { pool: task.pool, cancel: task.stop, progress: &|_| {}, watched: false };
    let tally = Tally::new();
    let sampler = Sampler::new(opened.field.as_ref(), settings, &tally);
    let mut beside = Beside::new(&sampler);
    for &lattice in task.lattices {
        let (mut row, own) = wrapped(shape, task, &opened, &watch, lattice, load, &mut beside)?;
        let mut pictures = Pictures { own, ..Pictures::default() };
        if task.side_by_side {
            let vertices = row.report.as_ref().map_or(lattice.vertices(), |report| report.vertices);
            pictures.cubes = beside.picture(vertices).map_err(|Canceled| Ended::Stopped)?;
            (row.paper, pictures.paper) = by_the_paper(task, &opened, lattice)?;
        }
        add(row, pictures).map_err(Ended::Io)?;
    }
    Ok(())
}

fn open(shape: &Shape, watch: &Arc<Watch>) -> Result<Opened, String> {
    let bytes = std::fs::read(&shape.path).map_err(|e| e.to_string())?;
    // a network of many shapes stands for its first
    let latent_row = match pipeline::describe(&bytes, &FieldOptions::default()) {
        Ok(Description::Network { latent_rows: 1.., .. }) => Some(0),
        _ => None,
    };
    let spec = FieldSpec { options: FieldOptions { latent_row, ..FieldOptions::default() }, ..FieldSpec::default() };
    let mut opened = pipeline::open(&spec, Some(&bytes), "").map_err(|failure| failure.detail)?;
    if opened.field.dimension() != 3 {
        return Err("a curve, not a surface".to_owned());
    }
    opened.field = Box::new(Clocked::new(opened.field, watch.clone()));
    Ok(opened)
}

/// Marching cubes on the field of a shape, by its number of samples per side: two lattices may ask for the same.
struct Beside<'s, 'a> {
    sampler: &'s Sampler<'a>,
    truth: Option<Truth<'s, 'a>>,
    known: Vec<(usize, Option<Baseline>)>,
}

impl<'s, 'a> Beside<'s, 'a> {
    fn new(sampler: &'s Sampler<'a>) -> Self {
        Self { sampler, truth: None, known: Vec::new() }
    }

    /// Marching cubes with about as many vertices.
    fn get(&mut self, vertices: u64) -> Result<Option<Baseline>, Canceled> {
        let truth = match &mut self.truth {
            Some(truth) => truth,
            none => none.insert(Truth::of(self.sampler)?),
        };
        let Some(side) = side_for(truth, vertices) else { return Ok(None) };
        if let Some((_, known)) = self.known.iter().find(|(s, _)| *s == side) {
            return Ok(*known);
        }
        let found = baseline(truth, side)?;
        self.known.push((side, found));
        Ok(found)
    }

    /// Its picture; empty where there is nothing.
    fn picture(&mut self, vertices: u64) -> Result<Vec<u8>, Canceled> {
        self.get(vertices)?;
        let Some(truth) = &self.truth else { return Ok(Vec::new()) };
        let Some(side) = side_for(truth, vertices) else { return Ok(Vec::new()) };
        match cubes_at(truth, side)? {
            Some(cubes) => plain_picture(&cubes.vertices, &cubes.triangles, self.sampler.settings()),
            None => Ok(Vec::new()),
        }
    }
}

/// What the paper's method makes of the same field on the same lattice, and its picture.
fn by_the_paper(task: &Task<'_>, opened: &Opened, lattice: LatticeSpec) -> Result<(Option<Report>, Vec<u8>), Ended> {
    let spec = ShrinkSpec { lattice, method: Method::Paper, ..ShrinkSpec::default() };
    let asked = Asked { shrink: &spec, budget: task.budget, outputs: &[OutputName::Glb], load_seconds: 0.0 };
    let made = guarded(task, &|cancel| {
        let settings = Settings { pool: task.pool, cancel, progress: &|_| {}, watched: false };
        pipeline::make(opened, &asked, settings)
    });
    let settings = Settings { pool: task.pool, cancel: task.stop, progress: &|_| {}, watched: false };
    match made {
        Guarded::Done(Ok(made)) => {
            let picture = sheet::picture(&made, lattice, &settings).map_err(|Canceled| Ended::Stopped)?;
            Ok((Some(made.report), picture))
        }
        Guarded::Done(Err(failure::Ended::Canceled)) if task.stop.is_canceled() => Err(Ended::Stopped),
        // a shape that it makes nothing of
        _ => Ok((None, Vec::new())),
    }
}

fn wrapped(
    shape: &Shape,
    task: &Task<'_>,
    opened: &Opened,
    watch: &Watch,
    lattice: LatticeSpec,
    load: f64,
    beside: &mut Beside<'_, '_>,
) -> Result<(Row, Vec<u8>), Ended> {
    let clock = Instant::now();
    let spec = ShrinkSpec { lattice, ..task.asked.clone() };
    let outputs: &[OutputName] = if task.draw || task.keep.is_some() { &[OutputName::Glb] } else { &[] };
    // what is measured after shrinking is not part of its time in the field
    let progress = |progress: Progress| watch.pause(matches!(progress.stage, "measure" | "write"));
    watch.reset();
    watch.pause(false);
    let asked = Asked { shrink: &spec, budget: task.budget, outputs, load_seconds: load };
    let made = guarded(task, &|cancel| {
        let settings = Settings { pool: task.pool, cancel, progress: &progress, watched: false };
        pipeline::make(opened, &asked, settings)
    });
    watch.pause(true);
    let seconds = load + clock.elapsed().as_secs_f64();
    let mut row = Row {
        shape: shape.name.clone(),
        folder: shape.folder.clone(),
        lattice,
        outcome: Outcome::Passed,
        seconds,
        field_seconds: watch.seconds(),
        attempts: None,
        report: None,
        baseline: None,
        paper: None,
    };
    let mut picture = Vec::new();
    let expected = task.expected.iter().any(|pattern| fits(pattern, &shape.name));
    match made {
        Guarded::Done(Ok(made)) => {
            row.attempts = Some(u64::from(made.report.attempts));
            row.outcome = match made.problem() {
                Some(problem) if made.refusal.is_some() => failed(problem, expected),
                _ => judged(&made, expected),
            };
            if let Some(folder) = task.keep {
                keep(folder, shape, lattice, &made).map_err(Ended::Io)?;
            }
            if task.draw {
                picture =
                    sheet::picture(&made, lattice, beside.sampler.settings()).map_err(|Canceled| Ended::Stopped)?;
            }
            if task.baseline {
                row.baseline = beside.get(made.report.vertices).map_err(|Canceled| Ended::Stopped)?;
            }
            row.report = Some(made.report);
        }
        Guarded::Done(Err(failure::Ended::Failed(failure))) => row.outcome = failed(*failure, expected),
        Guarded::Done(Err(failure::Ended::Canceled)) if task.stop.is_canceled() => return Err(Ended::Stopped),
        Guarded::Done(Err(failure::Ended::Canceled)) => {
            let limit = task.limit.unwrap_or_default().as_secs();
            row.outcome = fault("over_time", format!("took longer than {limit} s"));
        }
        Guarded::Crashed(message) => row.outcome = fault("crashed", message),
    }
    Ok((row, picture))
}

fn fault(code: &str, detail: String) -> Outcome {
    Outcome::Failed { code: code.to_owned(), faults: vec![detail] }
}

fn judged(made: &Made, expected_refusal: bool) -> Outcome {
    let mut faults = passes(&made.report).err().unwrap_or_default();
    if expected_refusal {
        faults.insert(0, "a refusal was expected".to_owned());
    }
    if faults.is_empty() { Outcome::Passed } else { Outcome::Failed { code: "not_certified".to_owned(), faults } }
}

fn failed(failure: Failure, expected: bool) -> Outcome {
    if REFUSALS.contains(&failure.code.as_str()) {
        Outcome::Refused { code: failure.code, detail: failure.detail, places: failure.places, expected }
    } else {
        fault(&failure.code, failure.detail)
    }
}

fn keep(folder: &Path, shape: &Shape, lattice: LatticeSpec, made: &Made) -> Result<(), String> {
    let path = folder.join("glb").join(format!("{}.{}.glb", shape.name, lattice_name(lattice).replace(':', "-")));
    let told = |e: std::io::Error| format!("{}: {e}", path.display());
    if let Some((_, bytes)) = made.files.iter().find(|(output, _)| *output == OutputName::Glb) {
        std::fs::create_dir_all(path.parent().unwrap_or(folder)).map_err(told)?;
        std::fs::write(&path, bytes).map_err(told)?;
    }
    Ok(())
}

enum Guarded<T> {
    Done(T),
    Crashed(String),
}

/// Runs `work` with a token of its own, which is raised when the signal comes or the time is over, and catches a panic.
fn guarded<T>(task: &Task<'_>, work: &dyn Fn(&CancelToken) -> T) -> Guarded<T> {
    let (cancel, done, start) = (CancelToken::new(), AtomicBool::new(false), Instant::now());
    std::thread::scope(|scope| {
        scope.spawn(|| {
            while !done.load(Ordering::Relaxed) {
                if task.stop.is_canceled() || task.limit.is_some_and(|limit| start.elapsed() > limit) {
                    cancel.cancel();
                    return;
                }
                std::thread::sleep(TICK);
            }
        });
        let result = catch_unwind(AssertUnwindSafe(|| work(&cancel)));
        done.store(true, Ordering::Relaxed);
        match result {
            Ok(result) => Guarded::Done(result),
            Err(payload) => {
                let text = payload.downcast_ref::<String>().map(String::as_str);
                let text = text.or_else(|| payload.downcast_ref::<&str>().copied());
                Guarded::Crashed(text.unwrap_or("a panic without a message").to_owned())
            }
        }
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn with_task<R>(limit: Option<Duration>, f: impl FnOnce(&Task<'_>) -> R) -> R {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
        let stop = CancelToken::new();
        let task = Task {
            asked: ShrinkSpec::default(),
            budget: Budget::default(),
            lattices: &[],
            baseline: false,
            limit,
            expected: &[],
            keep: None,
            draw: false,
            side_by_side: false,
            pool: &pool,
            stop: &stop,
        };
        f(&task)
    }

    #[test]
    fn a_panic_is_caught_with_its_message() {
        with_task(None, |task| {
            let message = match guarded::<()>(task, &|_| panic!("at {}", 7)) {
                Guarded::Crashed(message) => message,
                Guarded::Done(()) => String::new(),
            };
            assert_eq!(message, "at 7");
        });
    }

    #[test]
    fn the_token_is_raised_when_the_time_is_over() {
        with_task(Some(Duration::from_millis(30)), |task| {
            let raised = guarded(task, &|cancel| {
                let start = Instant::now();
                while !cancel.is_canceled() && start.elapsed() < Duration::from_secs(20) {
                    std::thread::sleep(Duration::from_millis(1));
                }
                cancel.is_canceled()
            });
            assert!(matches!(raised, Guarded::Done(true)));
        });
    }

    #[test]
    fn only_what_is_no_sphere_is_refused() {
        let genus = Failure::new("genus", "t", "genus 3");
        assert!(failed(genus.clone(), true).is_as_expected());
        assert!(!failed(genus, false).is_as_expected());
        assert!(matches!(failed(Failure::new("unmapped", "t", "d"), true), Outcome::Failed { .. }));
    }
}
