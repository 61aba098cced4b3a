//! Submits at a steady rate while the pool is saturated.

use crate::Load;
use crate::client::{cancel, client, endless, percentile, running, small, submit};
use crate::service::Outcome;
use std::time::{Duration, Instant};

/// Submits in a second, whether or not earlier ones were answered.
const RATE: u32 = 50;

pub async fn measure(load: &Load) -> Outcome<()> {
    let folder = tempfile::tempdir()?;
    let node = load.node(folder.path(), &[]).await?;
    let (url, http) = (node.url(), client()?);
    // as many as there are slots, so that nothing else is ever computed
    let mut busy = Vec::new();
    for _ in 0..2 {
        let (id, _) = submit(&http, &url, &endless("accept")).await?;
        running(&http, &url, &id).await?;
        busy.push(id);
    }
    let (clock, mut submits) = (Instant::now(), Vec::new());
    let mut ticks = tokio::time::interval(Duration::from_secs(1) / RATE);
    ticks.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Burst);
    while clock.elapsed() < load.time {
        ticks.tick().await;
        let (http, url) = (http.clone(), url.clone());
        submits.push(tokio::spawn(async move { submit(&http, &url, &small("accept")).await }));
    }
    let mut times = Vec::new();
    for submitted in submits {
        times.push(submitted.await??.1);
    }
    times.sort_unstable();
    println!("| engine | long jobs | submits/s | submits | accept p50 | p90 | p99 | longest |");
    println!("|---|---:|---:|---:|---:|---:|---:|---:|");
    println!(
        "| {} | {} | {RATE} | {} | {:.1} ms | {:.1} ms | {:.1} ms | {:.1} ms |\n",
        load.engine(),
        busy.len(),
        times.len(),
        percentile(&times, 0.5),
        percentile(&times, 0.9),
        percentile(&times, 0.99),
        percentile(&times, 1.0),
    );
    for id in busy {
        cancel(&http, &url, &id).await?;
    }
    Ok(())
}
