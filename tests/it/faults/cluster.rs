//! Nodes and servers of a cluster that die or freeze, as processes.

use super::lengthy;
use crate::app::{App, PATIENCE, small, state};
use crate::cluster::nats_server::NatsServer;
use crate::walk::{follow, frames};
use eventsource_stream::Eventsource;
use futures::StreamExt;
use reqwest::{Method, StatusCode};
use serde_json::Value;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

/// Longer than an election takes on a slow machine.
const LEASE: (&str, &str) = ("SHRINKD_WORKER__LEASE_S", "10");

/// A node of the cluster whose servers are at an address.
pub(super) fn node(folder: &Path, engine: &str, more: &[(&str, &str)]) -> App {
    App::start_with(folder, &[&[("SHRINKD_ENGINE", engine)], more].concat())
}

/// The address of three servers that keep three copies.
fn of_three(servers: &[NatsServer; 3]) -> String {
    let hosts = servers.each_ref().map(|server| server.url().trim_start_matches("nats://").to_owned()).join(",");
    format!("nats://{hosts}?replicas=3")
}

/// Submits until it is answered, on one node after the other, as a client with a key does.
async fn submit_under(nodes: &[(String, reqwest::Client)], key: &str) -> String {
    let clock = Instant::now();
    for turn in 0.. {
        let (url, client) = &nodes[turn % nodes.len()];
        let request = client.post(format!("{url}/v1/jobs")).header("Idempotency-Key", key).json(&small());
        if let Ok(answer) = request.timeout(Duration::from_secs(20)).send().await
            && answer.status().is_success()
        {
            let job: Value = answer.json().await.expect("JSON");
            return job["id"].as_str().expect("a name").to_owned();
        }
        assert!(clock.elapsed() < PATIENCE, "no node accepts {key}");
        tokio::time::sleep(Duration::from_millis(50)).await;
    }
    unreachable!("the turns do not end")
}

/// GET that asks again, as clients do, when it is told that the servers have not agreed on a leader yet.
async fn get_under(app: &App, path: &str) -> reqwest::Response {
    let clock = Instant::now();
    loop {
        let answer = app.request(Method::GET, path).header("Last-Event-ID", "0").send().await.expect("an answer");
        if answer.status() != StatusCode::SERVICE_UNAVAILABLE {
            assert_eq!(answer.status(), StatusCode::OK, "{path}");
            return answer;
        }
        assert!(answer.headers().contains_key("retry-after"), "it says when to ask again");
        assert!(clock.elapsed() < PATIENCE, "no answer to {path}\n{}", app.log());
        tokio::time::sleep(Duration::from_millis(200)).await;
    }
}

/// Checks that a job ended well and once: its events are numbered from 1 without a gap, and only the last one is its end.
pub(super) async fn ended_once(app: &App, id: &str) -> Value {
    let clock = Instant::now();
    let job = loop {
        let job: Value = get_under(app, &format!("/v1/jobs/{id}")).await.json().await.expect("JSON");
        if state(&job) != "queued" && state(&job) != "running" {
            break job;
        }
        assert!(clock.elapsed() < PATIENCE, "still {job}\n{}", app.log());
        tokio::time::sleep(Duration::from_millis(20)).await;
    };
    assert_eq!(state(&job), "succeeded", "{job}");
    let events = frames(get_under(app, &format!("/v1/jobs/{id}/events")).await).await;
    let ends = events.iter().filter(|event| event.1 == "done").count();
    assert_eq!((ends, events.last().map(|event| event.1.as_str())), (1, Some("done")), "{events:?}");
    assert_eq!(events.iter().map(|e| e.0).collect::<Vec<_>>(), (1..=events.len() as u64).collect::<Vec<_>>());
    job
}

fn signal(app: &App, name: &str) {
    let sent = std::process::Command::new("kill").args([name, &app.process().to_string()]).status();
    assert!(sent.expect("kill").success());
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn each_of_three_servers_and_then_everything_is_killed_and_no_accepted_job_is_lost() {
    let Some(mut servers) = NatsServer::start_three() else { return };
    let folder = tempfile::tempdir().expect("folder");
    let engine = of_three(&servers);
    let nodes = [node(folder.path(), &engine, &[LEASE]), node(folder.path(), &engine, &[LEASE])];
    let places: Vec<_> = nodes.iter().map(|node| (node.url.clone(), node.client.clone())).collect();
    let over = Arc::new(AtomicBool::new(false));
    let submitting = tokio::spawn({
        let over = over.clone();
        async move {
            let mut accepted = Vec::new();
            while !over.load(Ordering::SeqCst) {
                let key = format!("key {}", accepted.len());
                accepted.push((key.clone(), submit_under(&places, &key).await));
            }
            accepted
        }
    });
    for server in &mut servers {
        tokio::time::sleep(Duration::from_secs(1)).await;
        server.kill();
        tokio::time::sleep(Duration::from_secs(3)).await;
        tokio::task::block_in_place(|| server.restart());
    }
    tokio::time::sleep(Duration::from_secs(1)).await;
    over.store(true, Ordering::SeqCst);
    let accepted = submitting.await.expect("no panic");
    assert!(accepted.len() > 3, "{} jobs were accepted", accepted.len());

    nodes.into_iter().for_each(App::kill);
    servers.iter_mut().for_each(NatsServer::kill);
    // they have to find each other before any of them answers
    tokio::task::block_in_place(|| {
        std::thread::scope(|scope| servers.iter_mut().for_each(|server| drop(scope.spawn(|| server.restart()))));
    });
    let nodes = [node(folder.path(), &engine, &[LEASE]), node(folder.path(), &engine, &[LEASE])];
    for (i, (_, id)) in accepted.iter().enumerate() {
        ended_once(&nodes[i % 2], id).await;
    }
    let (key, id) = &accepted[0];
    let places: Vec<_> = nodes.iter().map(|node| (node.url.clone(), node.client.clone())).collect();
    assert_eq!(&submit_under(&places, key).await, id, "the key is remembered, too");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_worker_that_was_frozen_wakes_after_its_lease_and_changes_nothing() {
    let Some(server) = NatsServer::start() else { return };
    let folder = tempfile::tempdir().expect("folder");
    let quick = ("SHRINKD_WORKER__LEASE_S", "2");
    let api = node(folder.path(), &server.url(), &[quick, ("SHRINKD_ROLE", "api")]);
    let frozen = node(folder.path(), &server.url(), &[quick, ("SHRINKD_ROLE", "worker")]);
    // a job may come to its end in the moment between the look and the signal: then another one is held up
    for _ in 0..10 {
        let id = api.submit(&lengthy()).await;
        api.wait_until(&id, |job| state(job) != "queued" && !job["progress"].is_null()).await;
        signal(&frozen, "-STOP");
        let held = api.get_json(&format!("/v1/jobs/{id}")).await;
        if state(&held) != "running" {
            signal(&frozen, "-CONT");
            continue;
        }
        let other = node(folder.path(), &server.url(), &[quick, ("SHRINKD_ROLE", "worker")]);
        let job = ended_once(&api, &id).await;
        assert_eq!(job["attempt"], 2, "{job}");
        signal(&frozen, "-CONT");
        let clock = Instant::now();
        while !frozen.log().contains("the claim was lost") {
            assert!(clock.elapsed() < PATIENCE, "it does not notice\n{}", frozen.log());
            tokio::time::sleep(Duration::from_millis(50)).await;
        }
        assert_eq!(api.get_json(&format!("/v1/jobs/{id}")).await, job, "nothing of the first attempt counts");
        drop(other);
        return;
    }
    panic!("ten jobs ended before their worker could be frozen");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_client_that_hops_between_nodes_misses_nothing() {
    let Some(server) = NatsServer::start() else { return };
    let folder = tempfile::tempdir().expect("folder");
    let nodes = [0, 1, 2].map(|_| node(folder.path(), &server.url(), &[]));
    let id = nodes[0].submit(&lengthy()).await;
    let (mut seen, mut last) = (Vec::new(), 0u64);
    let mut hops = 0;
    'job: for turn in 1.. {
        let node = &nodes[turn % 3];
        let events = node.request(Method::GET, &format!("/v1/jobs/{id}/events"));
        let answer = events.header("Last-Event-ID", last.to_string()).send().await.expect("an answer");
        assert_eq!(answer.status(), StatusCode::OK);
        let mut stream = answer.bytes_stream().eventsource();
        // a few of them on every node, and then away without a word
        for _ in 0..4 {
            let event = tokio::time::timeout(PATIENCE, stream.next()).await.expect("in time");
            let event = event.expect("a frame").expect("whole");
            last = event.id.parse().expect("a number");
            let body: Value = serde_json::from_str(&event.data).expect("JSON");
            seen.push((last, event.event.clone(), body));
            if event.event == "done" {
                break 'job;
            }
        }
        hops = turn;
    }
    assert!(hops >= 2, "the client has been on every node");
    for node in &nodes {
        assert_eq!(follow(node, &id, Some(0)).await, seen, "the same events with the same numbers");
        let events = node.request(Method::GET, &format!("/v1/jobs/{id}/events"));
        let answer = events.header("Last-Event-ID", last.to_string()).send().await.expect("an answer");
        assert_eq!(answer.status(), StatusCode::NO_CONTENT, "there is nothing more on any node");
    }
}
