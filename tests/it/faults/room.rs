//! The servers of a cluster have no room left to store anything.

use super::cluster::{ended_once, node};
use super::{jobs_labeled, labeled, submit_keyed};
use crate::app::{endless, problem, state};
use crate::cluster::nats_server::NatsServer;
use crate::tenants::eventually;
use crate::walk::follow;
use async_nats::jetstream::context::PublishErrorKind;
use async_nats::jetstream::{self, stream};
use reqwest::Method;
use serde_json::{Value, json};

/// Bytes that the server stores at first: the events of a job that runs meanwhile are far fewer.
const LITTLE: u64 = 32 << 20;
/// Bytes that are enough for anything.
const PLENTY: u64 = 1 << 30;

/// Stores messages of its own until there is no room for the smallest.
async fn fill(server: &NatsServer) {
    let context = jetstream::new(async_nats::connect(server.url()).await.expect("connects"));
    let filler =
        stream::Config { name: "FILLER".to_owned(), subjects: vec!["filler".to_owned()], ..Default::default() };
    context.create_stream(filler).await.expect("is made");
    for size in [1 << 20, 1 << 10, 1] {
        loop {
            let sent = context.publish("filler", vec![0u8; size].into()).await.expect("is sent");
            match sent.await {
                Ok(_) => {}
                // the disk is slow
                Err(error) if error.kind() == PublishErrorKind::TimedOut => {}
                Err(_) => break,
            }
        }
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn servers_without_room_refuse_jobs_and_lose_none() {
    let Some(mut server) = NatsServer::start_with_room(LITTLE) else { return };
    let folder = tempfile::tempdir().expect("folder");
    let engine = server.url();
    let start = |role| {
        let more = [
            ("SHRINKD_ROLE", role),
            ("SHRINKD_WORKER__SLOTS", "1"),
            ("SHRINKD_WORKER__LEASE_S", "2"),
            ("SHRINKD_WORKER__MAX_LOSSES", "1000"),
        ];
        node(folder.path(), &engine, &more)
    };
    let (api, _worker) = (start("api"), start("worker"));
    let running = api.submit(&endless()).await;
    api.running(&running).await;
    let mut accepted = Vec::new();
    for i in 0..3 {
        accepted.push(submit_keyed(&api, &format!("before-{i}"), &labeled("before")).await.0);
    }
    fill(&server).await;

    let submit = async |round: &str, key: Option<&str>| {
        let request = api.request(Method::POST, "/v1/jobs").json(&labeled(round));
        let request = if let Some(key) = key { request.header("Idempotency-Key", key) } else { request };
        let answer = request.send().await.expect("an answer");
        let after = answer.headers().get("retry-after").and_then(|value| value.to_str().ok()?.parse::<u32>().ok());
        problem(answer, 503, "engine_unavailable").await;
        assert!(after >= Some(1), "it says when to come again");
    };
    tokio::join!(submit("meanwhile", Some("meanwhile")), submit("nobody", None));
    for id in &accepted {
        let job = api.get_json(&format!("/v1/jobs/{id}")).await;
        assert_eq!((state(&job), &job["attempt"]), ("queued", &json!(0)), "it waits as before: {job}");
    }
    assert!(["queued", "running"].contains(&state(&api.get_json(&format!("/v1/jobs/{running}")).await)));
    assert!(api.get("/livez").await.status().is_success());
    problem(api.get("/readyz").await, 503, "engine_unavailable").await;

    server.kill();
    server.give_room(PLENTY);
    tokio::task::block_in_place(|| server.restart());
    let (id, _) = submit_keyed(&api, "meanwhile", &labeled("meanwhile")).await;
    accepted.push(id.clone());
    eventually("the one that runs is canceled", async || {
        let cancel = api.post(&format!("/v1/jobs/{running}/cancel"), &Value::Null).await;
        cancel.status().is_success()
    })
    .await;
    assert_eq!(state(&api.ended(&running).await), "canceled");
    let events = follow(&api, &running, Some(0)).await;
    assert_eq!(events.iter().filter(|event| event.1 == "done").count(), 1, "{events:?}");
    for id in &accepted {
        ended_once(&api, id).await;
    }
    // a node that comes late knows everything that was stored before it
    let late = start("api");
    assert_eq!(jobs_labeled(&late, "meanwhile").await, [id], "the key made one job");
    assert_eq!(jobs_labeled(&late, "before").await.len(), 3);
    assert!(jobs_labeled(&late, "nobody").await.is_empty(), "what was refused is not there");
}
