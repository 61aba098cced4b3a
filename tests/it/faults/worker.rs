//! A worker of a cluster is killed in the middle of a job.

use super::cluster::{ended_once, node};
use super::{lengthy, states};
use crate::app::{App, state};
use crate::cluster::nats_server::NatsServer;
use crate::tenants::eventually;
use crate::walk::{follow, frames};
use reqwest::Method;
use serde_json::Value;

/// Which of the workers has taken a job up first.
async fn holder(workers: &[App], id: &str) -> usize {
    let has_it = |worker: &App| worker.log().lines().any(|line| line.contains("job started") && line.contains(id));
    eventually("a worker has it", async || workers.iter().any(has_it)).await;
    workers.iter().position(has_it).expect("one of them")
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_job_of_a_killed_worker_is_ended_by_another_and_its_reader_misses_nothing() {
    let Some(server) = NatsServer::start() else { return };
    let folder = tempfile::tempdir().expect("folder");
    let start = |role| node(folder.path(), &server.url(), &[("SHRINKD_WORKER__LEASE_S", "3"), ("SHRINKD_ROLE", role)]);
    let (api, mut workers) = (start("api"), vec![start("worker"), start("worker")]);
    // a job may come to its end in the moment between the look and the kill: then another one is killed
    for _ in 0..10 {
        let id = api.submit(&lengthy()).await;
        let events = api.request(Method::GET, &format!("/v1/jobs/{id}/events?after=0")).send().await;
        let reading = tokio::spawn(frames(events.expect("an answer")));
        let has_begun = |job: &Value| state(job) == "succeeded" || !job["progress"].is_null();
        api.wait_until(&id, has_begun).await;
        let holder = holder(&workers, &id).await;
        workers.remove(holder).kill();
        let job = ended_once(&api, &id).await;
        let seen = reading.await.expect("no panic");
        assert_eq!(follow(&api, &id, Some(0)).await, seen, "the reader was told what is told after the end");
        if job["attempt"] == 1 {
            workers.push(start("worker"));
            continue;
        }
        assert_eq!(job["attempt"], 2, "{job}");
        let expected = [("queued", 0), ("running", 1), ("queued", 1), ("running", 2), ("succeeded", 2)];
        assert_eq!(states(&seen), expected);
        let has_ended = |line: &str| line.contains("job ended") && line.contains(&id);
        eventually("the other says so", async || workers[0].log().lines().any(has_ended)).await;
        return;
    }
    panic!("ten jobs ended before their worker could be killed");
}
