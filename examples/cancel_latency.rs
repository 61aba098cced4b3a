//! How soon a cancel is seen: wraps a field again and again, raises the token at a different moment each time, and prints
//! how long the computation went on.
//!
//! ```text
//! cargo run --release --example cancel_latency -- FIELD...
//! ```

use shrinkd::field::input::{FieldOptions, open};
use shrinkd::field::sampler::{Sampler, Tally};
use shrinkd::settings::{CancelToken, Settings};
use shrinkd::shrink::{Effort, ShrinkSpec, shrink};
use std::time::{Duration, Instant};

/// Moments tried for each field.
const MOMENTS: u32 = 40;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let pool = rayon::ThreadPoolBuilder::new().build()?;
    for path in std::env::args().skip(1) {
        let field = open(&std::fs::read(&path)?, &FieldOptions::default())?.field;
        let run = |cancel: &CancelToken| {
            let settings = Settings { pool: &pool, cancel, progress: &|_| {}, watched: false };
            let tally = Tally::new();
            shrink(&Sampler::new(field.as_ref(), settings, &tally), &ShrinkSpec::default(), None, &Effort::default())
                .is_err()
        };
        let clock = Instant::now();
        run(&CancelToken::new());
        let whole = clock.elapsed();
        let mut latencies: Vec<Duration> = (0..MOMENTS)
            .map(|i| {
                let (cancel, moment) = (CancelToken::new(), whole * i / MOMENTS);
                std::thread::scope(|scope| {
                    let worker = scope.spawn(|| (run(&cancel), Instant::now()));
                    std::thread::sleep(moment);
                    cancel.cancel();
                    let raised = Instant::now();
                    let (_, ended) = worker.join().expect("the computation does not panic");
                    ended.saturating_duration_since(raised)
                })
            })
            .collect();
        latencies.sort();
        println!(
            "{path}: whole {whole:.2?}, canceled at {MOMENTS} moments: median {:.1?}, largest {:.1?}",
            latencies[latencies.len() / 2],
            latencies[latencies.len() - 1]
        );
    }
    Ok(())
}
