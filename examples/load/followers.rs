//! Many open streams on few running jobs.

use crate::Load;
use crate::client::{cancel, client, follow, percentile, running, small, submit, training, upload};
use crate::service::Outcome;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::time::{Duration, Instant};

/// How long the streams are held once all are open.
const HELD: Duration = Duration::from_secs(10);
/// Submits that are timed meanwhile.
const SUBMITS: usize = 100;
/// Longer than it takes to open all streams, or to end them.
const PATIENCE: Duration = Duration::from_secs(300);

/// What the streams have seen.
#[derive(Default)]
struct Seen {
    /// Streams that got their first frame.
    open: AtomicUsize,
    frames: AtomicU64,
}

pub async fn measure(load: &Load) -> Outcome<()> {
    let folder = tempfile::tempdir()?;
    let node = load.node(folder.path(), &[("SHRINKD_WORKER__SLOTS", load.jobs.to_string())]).await?;
    let (url, http) = (node.url(), client()?);
    let (mesh, mut jobs) = (upload(&http, &url).await?, Vec::new());
    for _ in 0..load.jobs {
        jobs.push(submit(&http, &url, &training(&mesh)).await?.0);
    }
    for id in &jobs {
        running(&http, &url, id).await?;
    }
    // what the jobs themselves take grows until they have all their arrays
    tokio::time::sleep(HELD).await;
    let before = resident(node.id())?;
    let seen = Arc::new(Seen::default());
    let streams: Vec<_> = (0..load.followers)
        .map(|i| tokio::spawn(reader(url.clone(), jobs[i % jobs.len()].clone(), seen.clone())))
        .collect();
    let clock = Instant::now();
    while seen.open.load(Ordering::Relaxed) < load.followers {
        if clock.elapsed() > PATIENCE {
            return Err(format!("only {} streams were opened", seen.open.load(Ordering::Relaxed)).into());
        }
        tokio::time::sleep(Duration::from_millis(50)).await;
    }
    let opened = clock.elapsed();
    let (frames, held) = (seen.frames.load(Ordering::Relaxed), Instant::now());
    let mut accept = Vec::new();
    for _ in 0..SUBMITS {
        accept.push(submit(&http, &url, &small("followers")).await?.1);
        tokio::time::sleep(HELD / SUBMITS as u32).await;
    }
    let rate = (seen.frames.load(Ordering::Relaxed) - frames) as f64 / held.elapsed().as_secs_f64();
    let after = resident(node.id())?;
    for id in &jobs {
        cancel(&http, &url, id).await?;
    }
    let mut broken = 0;
    for stream in streams {
        let ended = tokio::time::timeout(PATIENCE, stream).await??;
        broken += usize::from(ended.is_err());
    }
    accept.sort_unstable();
    println!(
        "| engine | streams | jobs | opened in | frames/s | memory before | after | for each stream | accept p50 | p99 | broken off |"
    );
    println!("|---|---:|---:|---:|---:|---:|---:|---:|---:|---:|---:|");
    println!(
        "| {} | {} | {} | {:.1} s | {rate:.0} | {:.0} MiB | {:.0} MiB | {:.1} KiB | {:.1} ms | {:.1} ms | {broken} |\n",
        load.engine(),
        load.followers,
        jobs.len(),
        opened.as_secs_f64(),
        before / 1024.0,
        after / 1024.0,
        (after - before) / load.followers as f64,
        percentile(&accept, 0.5),
        percentile(&accept, 0.99),
    );
    if broken > 0 { Err("streams broke off".into()) } else { Ok(()) }
}

async fn reader(url: String, id: String, seen: Arc<Seen>) -> Outcome<()> {
    // a client each: so many connections
    let (http, mut first) = (client()?, true);
    follow(&http, &url, &id, || {
        if std::mem::take(&mut first) {
            seen.open.fetch_add(1, Ordering::Relaxed);
        }
        seen.frames.fetch_add(1, Ordering::Relaxed);
    })
    .await
}

/// The memory of a process that is in use, KiB.
fn resident(process: u32) -> Outcome<f64> {
    let status = std::fs::read_to_string(format!("/proc/{process}/status"))?;
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:")).ok_or("no VmRSS")?;
    Ok(line.trim().trim_end_matches(" kB").trim().parse()?)
}
