//! What networks cost: microseconds per point for value and gradient, and how near that is to the peak of the `gemm` crate on a product of
//! 2048-cubes, in one run and turn by turn. Where `python3` (or what `PYTHON` names) has JAX or ONNX Runtime, theirs are printed beside.
//!
//! ```sh
//! cargo bench --bench kernels
//! ```

use rayon::prelude::*;
use shrinkd::field::network::{Activation, Layer, Network};
use shrinkd::field::{Field, Gradients, Points};
use std::time::Instant;

const POINTS: usize = 20_000;
/// Points of a batch, as the sampler makes them.
const BATCH: usize = 512;
const ROUNDS: usize = 7;
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
            activation: if i < widths.len() { activation } else { Activation::Identity },
            skip: None,
        };
        previous = outputs;
        layer
    };
    Network::of_layers((0..=widths.len()).map(layer).collect())
}

/// Seconds of one product of cubes on one thread.
fn product(a: &[f32], b: &[f32], to: &mut [f32]) -> f64 {
    let (n, step, start) = (CUBE, CUBE as isize, Instant::now());
    assert!([a.len(), b.len(), to.len()].iter().all(|&length| length == n * n));
    // SAFETY: the three slices are CUBE x CUBE matrices at these strides, and `to` overlaps none of the others.
    unsafe {
        let (a, b, to, one) = (a.as_ptr(), b.as_ptr(), to.as_mut_ptr(), gemm::Parallelism::None);
        gemm::gemm(n, n, n, to, 1, step, false, a, 1, step, b, 1, step, 0.0, 1.0, false, false, false, one);
    }
    start.elapsed().as_secs_f64()
}

fn main() {
    let threads = std::thread::available_parallelism().map_or(1, |n| n.get());
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("threads");
    let axis = |k: usize| (0..POINTS).map(|i| ((i * k) % 1009) as f32 / 504.5 - 1.0).collect::<Vec<f32>>();
    let (x, y, z) = (axis(7919), axis(104_729), axis(1_299_709));
    let [mut values, mut gx, mut gy, mut gz] = [0; 4].map(|_| vec![0.0f32; POINTS]);
    let (a, b) = (vec![0.5f32; CUBE * CUBE], vec![0.25f32; CUBE * CUBE]);
    let mut to = vec![0.0f32; CUBE * CUBE];
    let nets = [
        ("SIREN 4x256", vec![256; 4], Activation::Sine { w0: 30.0 }),
        ("DeepSDF 8x512", vec![512; 8], Activation::Relu),
        ("ELU 8x64", vec![64; 8], Activation::Elu),
        ("IDR 8x256", vec![256; 8], Activation::Softplus { beta: 100.0 }),
    ];
    println!("value and gradient, the best of {ROUNDS} rounds over {POINTS} points");
    println!(
        "| network | us/point, one thread | GFLOP/s | of gemm's peak | us/point, {threads} threads | value only, {threads} threads |"
    );
    println!("|---|---:|---:|---:|---:|---:|");
    for (name, widths, activation) in nets {
        let network = network(&widths, activation);
        let field = network.field(&[]).expect("no latent code");
        // two operations per weight forward and two back
        let operations: f64 = network.layers.iter().map(|l| 4.0 * l.weights.len() as f64).sum();
        let (mut cube, mut one, mut all, mut alone) = (f64::INFINITY, f64::INFINITY, f64::INFINITY, f64::INFINITY);
        for _ in 0..ROUNDS {
            cube = cube.min(product(&a, &b, &mut to));
            let start = Instant::now();
            for s in (0..POINTS).step_by(BATCH) {
                let r = s..(s + BATCH).min(POINTS);
                let points = Points { x: &x[r.clone()], y: &y[r.clone()], z: &z[r.clone()] };
                let into = Gradients { x: &mut gx[r.clone()], y: &mut gy[r.clone()], z: &mut gz[r.clone()] };
                field.gradients(points, &mut values[r], into);
            }
            one = one.min(start.elapsed().as_secs_f64());
            let places = x.par_chunks(BATCH).zip(y.par_chunks(BATCH)).zip(z.par_chunks(BATCH));
            let start = Instant::now();
            pool.install(|| {
                let slopes = gx.par_chunks_mut(BATCH).zip(gy.par_chunks_mut(BATCH)).zip(gz.par_chunks_mut(BATCH));
                places.clone().zip(values.par_chunks_mut(BATCH)).zip(slopes).for_each(
                    |((((x, y), z), v), ((gx, gy), gz))| {
                        field.gradients(Points { x, y, z }, v, Gradients { x: gx, y: gy, z: gz });
                    },
                );
            });
            all = all.min(start.elapsed().as_secs_f64());
            let start = Instant::now();
            pool.install(|| {
                places
                    .zip(values.par_chunks_mut(BATCH))
                    .for_each(|(((x, y), z), v)| field.values(Points { x, y, z }, v));
            });
            alone = alone.min(start.elapsed().as_secs_f64());
        }
        let micros = |seconds: f64| seconds * 1e6 / POINTS as f64;
        let (speed, peak) = (operations * POINTS as f64 / one, 2.0 * (CUBE as f64).powi(3) / cube);
        println!(
            "| {name} | {:.2} | {:.0} | {:.0} % of {:.0} | {:.2} | {:.2} |",
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
