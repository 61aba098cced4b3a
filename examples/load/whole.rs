//! Clients that submit, follow and download, one job after the other.

use crate::Load;
use crate::client::{client, download, follow, percentile, small, submit};
use crate::service::Outcome;
use std::time::{Duration, Instant};

/// How long accepting took, and how long everything.
type Times = Vec<(Duration, Duration)>;

pub async fn measure(load: &Load) -> Outcome<()> {
    let folder = tempfile::tempdir()?;
    let node = load.node(folder.path(), &[]).await?;
    let clock = Instant::now();
    let clients: Vec<_> = (0..load.clients).map(|_| tokio::spawn(one(node.url(), clock + load.time))).collect();
    let mut times = Times::new();
    for client in clients {
        times.extend(client.await??);
    }
    let seconds = clock.elapsed().as_secs_f64();
    let (mut accept, mut whole): (Vec<_>, Vec<_>) = times.iter().copied().unzip();
    accept.sort_unstable();
    whole.sort_unstable();
    println!("| engine | clients | seconds | jobs | jobs/s | accept p50 | accept p99 | end to end p50 | p99 |");
    println!("|---|---:|---:|---:|---:|---:|---:|---:|---:|");
    println!(
        "| {} | {} | {seconds:.0} | {} | {:.1} | {:.1} ms | {:.1} ms | {:.0} ms | {:.0} ms |\n",
        load.engine(),
        load.clients,
        times.len(),
        times.len() as f64 / seconds,
        percentile(&accept, 0.5),
        percentile(&accept, 0.99),
        percentile(&whole, 0.5),
        percentile(&whole, 0.99),
    );
    Ok(())
}

async fn one(url: String, until: Instant) -> Outcome<Times> {
    let (http, mut times) = (client()?, Times::new());
    while Instant::now() < until {
        let clock = Instant::now();
        let (id, accepted) = submit(&http, &url, &small("whole")).await?;
        follow(&http, &url, &id, || {}).await?;
        download(&http, &url, &id).await?;
        times.push((accepted, clock.elapsed()));
    }
    Ok(times)
}
