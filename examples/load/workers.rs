//! The same heap of jobs for one, two and three worker processes on one cluster.

use crate::Load;
use crate::client::{client, follow, small, submit};
use crate::service::Outcome;
use std::time::Instant;

/// Jobs of the heap.
const HEAP: usize = 120;
/// Worker processes at most.
const MOST: usize = 3;

pub async fn measure(load: &Load) -> Outcome<()> {
    println!("| worker processes of one thread | jobs | seconds | jobs/s | speed-up |");
    println!("|---:|---:|---:|---:|---:|");
    let mut alone = None;
    for count in 1..=MOST {
        let folder = tempfile::tempdir()?;
        let variables = |role: &str| {
            [
                ("SHRINKD_ROLE", role.to_owned()),
                ("SHRINKD_WORKER__SLOTS", "1".to_owned()),
                ("SHRINKD_WORKER__THREADS", "1".to_owned()),
            ]
        };
        let api = load.node(folder.path(), &variables("api")).await?;
        let (http, url) = (client()?, api.url());
        let mut heap = Vec::new();
        for _ in 0..HEAP {
            heap.push(submit(&http, &url, &small("workers")).await?.0);
        }
        let clock = Instant::now();
        let mut workers = Vec::new();
        for _ in 0..count {
            workers.push(load.node(folder.path(), &variables("worker")).await?);
        }
        for id in &heap {
            follow(&http, &url, id, || {}).await?;
        }
        let seconds = clock.elapsed().as_secs_f64();
        for id in &heap {
            let job = crate::client::job(&http, &url, id).await?;
            if job["state"] != "succeeded" {
                return Err(format!("a job did not succeed: {job}").into());
            }
        }
        let speed_up = *alone.get_or_insert(seconds) / seconds;
        println!("| {count} | {HEAP} | {seconds:.1} | {:.1} | {speed_up:.2} |", HEAP as f64 / seconds);
    }
    println!();
    Ok(())
}
