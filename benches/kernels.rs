//! What networks cost: microseconds per point for value and gradient, and how near that is to the peak of the `gemm` crate on a product of
//! 2048-cubes, in one run. Where `python3` (or what `PYTHON` names) has JAX or ONNX Runtime, theirs are printed beside.
//!
//! ```sh
//! cargo bench --bench kernels
//! NETWORKS=one.safetensors:folder_of_deep_sdf cargo bench --bench kernels -- one
//! ```
//!
//! Networks of random weights are evaluated at random points. A network from a file is evaluated at the vertices of its own surface, in their
//! order, which is what an extraction does. Criterion prints what it always prints; the table below it has the least times of all its samples.

use criterion::{BenchmarkId, Criterion, Throughput};
use rayon::prelude::*;
use shrinkd::field::input::{self, FieldOptions};
use shrinkd::field::network::{Activation, Layer, Network, NetworkField, folder};
use shrinkd::field::sampler::Tally;
use shrinkd::field::{Field, Gradients, Points, Sampler};
use shrinkd::settings::{CancelToken, Settings};
use shrinkd::shrink::lattice::LatticeSpec;
use shrinkd::shrink::{Effort, ShrinkSpec, shrink};
use std::cell::RefCell;
use std::collections::BTreeMap;
use std::time::{Duration, Instant};

const POINTS: usize = 20_000;
/// Points of a batch, as the sampler makes them.
const BATCH: usize = 512;
const CUBE: usize = 2048;

/// A network of these widths with weights that keep the signal's size.
fn network(widths: &[usize], activation: Activation) -> Network {
    let mut state = 1u64;
    let mut random = || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 40) as f32 / (1u64 << 23) as f32 - 1.0
    };
    let mut previous = 3;
    let layer = |i: usize| {
        let outputs = widths.get(i).copied().unwrap_or(1);
        let gain = if let Activation::Sine { w0 } = activation { 2.4 / w0 } else { 1.8 } / (previous as f32).sqrt();
        let layer = Layer {
            weights: (0..outputs * previous).map(|_| random() * gain).collect(),
            bias: (0..outputs).map(|_| random() * 0.1).collect(),
            norm: None,
            activation: if i < widths.len() { activation } else { Activation::Identity },
            skip: None,
        };
        previous = outputs;
        layer
    };
    Network::of_layers((0..=widths.len()).map(layer).collect())
}

/// What is evaluated, and where.
struct Case {
    name: String,
    field: NetworkField,
    weights: usize,
    places: [Vec<f32>; 3],
}

impl Case {
    fn random(name: &str, widths: &[usize], activation: Activation) -> Self {
        let axis = |k: usize| (0..POINTS).map(|i| ((i * k) % 1009) as f32 / 504.5 - 1.0).collect();
        let network = network(widths, activation);
        let field = network.field(&[]).expect("a network without a code");
        Self::new(name.to_owned(), &network, field, [7919, 104_729, 1_299_709].map(axis))
    }

    fn new(name: String, network: &Network, field: NetworkField, places: [Vec<f32>; 3]) -> Self {
        Self { name, field, weights: network.layers.iter().map(|l| l.weights.len()).sum(), places }
    }

    /// A network of any file, or of a folder of DeepSDF, at the vertices of its (first) surface.
    fn of_file(path: &str, pool: &rayon::ThreadPool) -> Result<Self, String> {
        let said = |e: &dyn std::fmt::Display| format!("{path}: {e}");
        let at = std::path::Path::new(path);
        let bytes = if at.is_dir() { folder::pack(at) } else { std::fs::read(at) }.map_err(|e| said(&e))?;
        let first_row = FieldOptions { latent_row: Some(0), ..FieldOptions::default() };
        let (placed, _) = input::open_network(&bytes, &first_row)
            .or_else(|_| input::open_network(&bytes, &FieldOptions::default()))
            .map_err(|e| said(&e))?;
        let (cancel, tally, field) = (CancelToken::new(), Tally::new(), placed.field());
        let sampler =
            Sampler::new(&field, Settings { pool, cancel: &cancel, progress: &|_| {}, watched: false }, &tally);
        let spec = ShrinkSpec { lattice: LatticeSpec::Octahedral { n: 72 }, ..ShrinkSpec::default() };
        let surface = shrink(&sampler, &spec, None, &Effort::default()).map_err(|e| said(&e))?;
        let places = [0, 1, 2].map(|axis| surface.positions.iter().map(|p| p[axis] as f32).collect());
        let name = at.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        Ok(Self::new(name, &placed.network, placed.field(), places))
    }

    fn points(&self) -> usize {
        self.places[0].len()
    }

    /// Evaluates all points on the pool, with gradients where there is room for them.
    fn evaluate(&self, pool: &rayon::ThreadPool, values: &mut [f32], gradients: Option<&mut [Vec<f32>; 3]>) {
        let [x, y, z] = &self.places;
        let places = x.par_chunks(BATCH).zip(y.par_chunks(BATCH)).zip(z.par_chunks(BATCH));
        let work = places.zip(values[..self.points()].par_chunks_mut(BATCH));
        pool.install(|| match gradients {
            None => work.for_each(|(((x, y), z), v)| self.field.values(Points { x, y, z }, v)),
            Some([x, y, z]) => {
                let slopes = x.par_chunks_mut(BATCH).zip(y.par_chunks_mut(BATCH)).zip(z.par_chunks_mut(BATCH));
                work.zip(slopes).for_each(|((((x, y), z), v), ((gx, gy), gz))| {
                    self.field.gradients(Points { x, y, z }, v, Gradients { x: gx, y: gy, z: gz });
                });
            }
        });
    }
}

/// One product of cubes on one thread.
fn product(a: &[f32], b: &[f32], to: &mut [f32]) {
    let (n, step) = (CUBE, CUBE as isize);
    assert!([a.len(), b.len(), to.len()].iter().all(|&length| length == n * n));
    // SAFETY: the three slices are CUBE x CUBE matrices at these strides, and `to` overlaps none of the others.
    unsafe {
        let (a, b, to, one) = (a.as_ptr(), b.as_ptr(), to.as_mut_ptr(), gemm::Parallelism::None);
        gemm::gemm(n, n, n, to, 1, step, false, a, 1, step, b, 1, step, 0.0, 1.0, false, false, false, one);
    }
}

/// The least seconds of every benchmark that ran.
#[derive(Default)]
struct Least(RefCell<BTreeMap<(String, &'static str), f64>>);

impl Least {
    /// Times `work` so many times, as criterion wants it, and keeps the least.
    fn time(&self, name: &str, mode: &'static str, rounds: u64, mut work: impl FnMut()) -> Duration {
        let mut all = Duration::ZERO;
        for _ in 0..rounds {
            let start = Instant::now();
            work();
            let taken = start.elapsed();
            all += taken;
            let mut least = self.0.borrow_mut();
            let kept = least.entry((name.to_owned(), mode)).or_insert(f64::INFINITY);
            *kept = kept.min(taken.as_secs_f64());
        }
        all
    }

    fn seconds(&self, name: &str, mode: &'static str) -> Option<f64> {
        self.0.borrow().get(&(name.to_owned(), mode)).copied()
    }
}

const ONE: &str = "value and gradient, one thread";
const ALL: &str = "value and gradient, all threads";
const ALONE: &str = "value, all threads";

fn main() {
    let mut criterion = Criterion::default().sample_size(10).configure_from_args();
    let threads = std::thread::available_parallelism().map_or(1, |n| n.get());
    let [one, all] = [1, threads].map(|n| rayon::ThreadPoolBuilder::new().num_threads(n).build().expect("threads"));
    let mut cases = vec![
        Case::random("SIREN 4x256", &[256; 4], Activation::Sine { w0: 30.0 }),
        Case::random("DeepSDF 8x512", &[512; 8], Activation::Relu),
        Case::random("ELU 8x64", &[64; 8], Activation::Elu),
        Case::random("IDR 8x256", &[256; 8], Activation::Softplus { beta: 100.0 }),
    ];
    for path in std::env::var("NETWORKS").iter().flat_map(|list| list.split(':')).filter(|path| !path.is_empty()) {
        match Case::of_file(path, &all) {
            Ok(case) => cases.push(case),
            Err(fault) => println!("left out: {fault}"),
        }
    }
    let least = Least::default();
    let (a, b, mut to) = (vec![0.5; CUBE * CUBE], vec![0.25; CUBE * CUBE], vec![0.0; CUBE * CUBE]);
    let largest = cases.iter().map(Case::points).max().unwrap_or(0);
    let (mut values, mut gradients) = (vec![0.0; largest], [0; 3].map(|_| vec![0.0; largest]));
    for case in &cases {
        let mut group = criterion.benchmark_group(&case.name);
        // beside every network, so that both see the same machine
        group.bench_function(BenchmarkId::new("gemm", CUBE), |bencher| {
            bencher.iter_custom(|rounds| least.time(&case.name, "gemm", rounds, || product(&a, &b, &mut to)));
        });
        group.throughput(Throughput::Elements(case.points() as u64));
        for (mode, pool, slopes) in [(ONE, &one, true), (ALL, &all, true), (ALONE, &all, false)] {
            group.bench_function(mode, |bencher| {
                bencher.iter_custom(|rounds| {
                    let work = || case.evaluate(pool, &mut values, slopes.then_some(&mut gradients));
                    least.time(&case.name, mode, rounds, work)
                });
            });
        }
    }
    criterion.final_summary();

    println!(
        "| network | points | us/point, one thread | GFLOP/s | of gemm's peak | us/point, {threads} threads | value only |"
    );
    println!("|---|---:|---:|---:|---:|---:|---:|");
    for case in &cases {
        let seconds = ["gemm", ONE, ALL, ALONE].map(|mode| least.seconds(&case.name, mode));
        let [Some(cube), Some(one), Some(all), Some(alone)] = seconds else { continue };
        let micros = |seconds: f64| seconds * 1e6 / case.points() as f64;
        // two operations per weight forward and two back
        let speed = (4 * case.weights * case.points()) as f64 / one;
        let peak = 2.0 * (CUBE as f64).powi(3) / cube;
        println!(
            "| {} | {} | {:.2} | {:.0} | {:.0} % of {:.0} | {:.2} | {:.2} |",
            case.name,
            case.points(),
            micros(one),
            speed / 1e9,
            100.0 * speed / peak,
            peak / 1e9,
            micros(all),
            micros(alone),
        );
    }
    let python = std::env::var("PYTHON").unwrap_or_else(|_| "python3".to_owned());
    let script = concat!(env!("CARGO_MANIFEST_DIR"), "/benches/kernel_peers.py");
    match std::process::Command::new(&python).arg(script).status() {
        Ok(status) if status.success() => {}
        other => println!("{python} {script}: {other:?}"),
    }
}
