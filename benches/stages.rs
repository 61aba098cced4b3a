//! Where one attempt at a surface spends its time, stage by stage, outside the field.
//!
//!     cargo bench --bench stages -- FIELD... [--threads N] [--runs N] [--octahedral N | --latlong N]
//!
//! (a lat-long lattice of N rows has 2 N columns) prints for every field the least seconds over the runs: by the clock on the wall while no thread is in the field, and of
//! processor time of all threads together less what the field used (Linux only). On a machine that others use too only
//! the second can be compared.

use shrinkd::field::sampler::Tally;
use shrinkd::field::{Domain, Field, Gradients, Metric, Points, Sampler};
use shrinkd::job::pipeline;
use shrinkd::job::spec::FieldSpec;
use shrinkd::settings::{CancelToken, Progress, Settings};
use shrinkd::shrink::lattice::LatticeSpec;
use shrinkd::shrink::{Effort, ShrinkSpec, shrink};
use std::sync::Mutex;
use std::time::{Duration, Instant};

/// Seconds of processor time that a file of the kernel's gives in nanoseconds.
fn scheduled(path: &std::path::Path) -> f64 {
    let text = std::fs::read_to_string(path).unwrap_or_default();
    text.split_whitespace().next().and_then(|n| n.parse::<f64>().ok()).map_or(0.0, |n| n * 1e-9)
}

/// Of this thread.
fn thread_seconds() -> f64 {
    scheduled("/proc/thread-self/schedstat".as_ref())
}

/// Of all threads of the process.
fn process_seconds() -> f64 {
    let Ok(tasks) = std::fs::read_dir("/proc/self/task") else { return 0.0 };
    tasks.flatten().map(|task| scheduled(&task.path().join("schedstat"))).sum()
}

/// What a field has used so far.
#[derive(Default)]
struct Used {
    inside: u32,
    since: Option<Instant>,
    wall: Duration,
    processor: f64,
}

/// A field with two clocks.
struct Clocked {
    field: Box<dyn Field>,
    used: Mutex<Used>,
}

impl Clocked {
    fn around<R>(&self, work: impl FnOnce(&dyn Field) -> R) -> R {
        let before = thread_seconds();
        {
            let mut used = self.used.lock().unwrap();
            used.inside += 1;
            used.since.get_or_insert_with(Instant::now);
        }
        let result = work(self.field.as_ref());
        let mut used = self.used.lock().unwrap();
        used.inside -= 1;
        if used.inside == 0 {
            let since = used.since.take();
            used.wall += since.map_or(Duration::ZERO, |since| since.elapsed());
        }
        used.processor += thread_seconds() - before;
        result
    }
}

impl Field for Clocked {
    fn domain(&self) -> Domain {
        self.field.domain()
    }
    fn metric(&self) -> Metric {
        self.field.metric()
    }
    fn lipschitz(&self) -> Option<f32> {
        self.field.lipschitz()
    }
    fn dimension(&self) -> u8 {
        self.field.dimension()
    }
    fn values(&self, points: Points<'_>, values: &mut [f32]) {
        self.around(|field| field.values(points, values));
    }
    fn gradients(&self, points: Points<'_>, values: &mut [f32], gradients: Gradients<'_>) {
        self.around(|field| field.gradients(points, values, gradients));
    }
}

/// Seconds outside the field.
#[derive(Clone, Copy)]
struct Seconds {
    wall: f64,
    processor: f64,
}

impl Seconds {
    fn map(self, other: Self, with: impl Fn(f64, f64) -> f64) -> Self {
        Self { wall: with(self.wall, other.wall), processor: with(self.processor, other.processor) }
    }
}

/// Name and cost of every stage of one attempt, in order.
fn attempt(
    field: &Clocked,
    spec: &ShrinkSpec,
    pool: &rayon::ThreadPool,
) -> Result<Vec<(&'static str, Seconds)>, String> {
    let begin = Instant::now();
    let now = || {
        let used = field.used.lock().unwrap();
        Seconds { wall: (begin.elapsed() - used.wall).as_secs_f64(), processor: process_seconds() - used.processor }
    };
    *field.used.lock().unwrap() = Used::default();
    let marks = Mutex::new(Vec::new());
    let progress = |progress: Progress| marks.lock().unwrap().push((progress.stage, now()));
    let cancel = CancelToken::new();
    let settings = Settings { pool, cancel: &cancel, progress: &progress, watched: false };
    let tally = Tally::new();
    shrink(&Sampler::new(field, settings, &tally), spec, None, &Effort::default()).map_err(|e| e.to_string())?;
    let mut marks = marks.into_inner().unwrap();
    marks.push(("", now()));
    Ok(marks.windows(2).map(|m| (m[0].0, m[1].1.map(m[0].1, |end, start| end - start))).collect())
}

fn main() -> Result<(), String> {
    let mut arguments = std::env::args().skip(1);
    let (mut files, mut threads, mut runs) = (Vec::new(), 2, 5);
    let (mut lattice, mut asked) = (LatticeSpec::default(), false);
    let told = |of: &str| format!("{of} wants a number (see the top of benches/stages.rs)");
    while let Some(argument) = arguments.next() {
        let mut number = || arguments.next().and_then(|n| n.parse().ok()).ok_or_else(|| told(&argument));
        match argument.as_str() {
            // cargo says so when it is asked for benches; under `cargo test --all-targets` there is nothing to do
            "--bench" => asked = true,
            "--threads" => threads = number()?,
            "--runs" => runs = number()?.max(1),
            "--octahedral" => lattice = LatticeSpec::Octahedral { n: number()? as u32 },
            "--latlong" => {
                let n_phi = number()? as u32;
                lattice = LatticeSpec::Latlong { n_theta: 2 * n_phi, n_phi };
            }
            _ => files.push(argument),
        }
    }
    if !asked {
        return Ok(());
    }
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().map_err(|e| e.to_string())?;
    let spec = ShrinkSpec { lattice, ..ShrinkSpec::default() };
    for file in &files {
        let bytes = std::fs::read(file).map_err(|e| format!("{file}: {e}"))?;
        let opened = pipeline::open(&FieldSpec::default(), Some(&bytes), "").map_err(|e| format!("{file}: {e:?}"))?;
        let field = Clocked { field: opened.field, used: Mutex::default() };
        let mut least: Vec<(&str, Seconds)> = Vec::new();
        for _ in 0..runs {
            let stages = attempt(&field, &spec, &pool)?;
            if least.is_empty() {
                least = stages;
            } else {
                for (kept, new) in least.iter_mut().zip(stages) {
                    kept.1 = kept.1.map(new.1, f64::min);
                }
            }
        }
        let all = least.iter().fold(Seconds { wall: 0.0, processor: 0.0 }, |a, b| a.map(b.1, |x, y| x + y));
        println!("{file}: {threads} threads, least of {runs} runs");
        for (name, seconds) in least.iter().chain([&("all", all)]) {
            println!("  {name:10} {:7.3} s on the wall, {:7.3} s of processors", seconds.wall, seconds.processor);
        }
    }
    Ok(())
}
