//! Two nodes of a cluster, and a bucket that answers with errors, breaks off, or is slow.

use super::cluster::{ended_once, node};
use crate::app::{App, problem, small, state};
use crate::cluster::nats_server::NatsServer;
use crate::s3::Bucket;
use crate::tenants::eventually;
use crate::walk::hex;
use reqwest::{Method, StatusCode};
use serde_json::{Value, json};
use std::path::Path;
use std::time::Duration;

/// Two nodes on one server and one bucket.
fn pair(folder: &Path, server: &NatsServer, bucket: &Bucket, lease_s: &str) -> [App; 2] {
    let variables = bucket.variables("pair");
    let mut all: Vec<(&str, &str)> = variables.iter().map(|(name, value)| (*name, value.as_str())).collect();
    all.extend([("SHRINKD_WORKER__LEASE_S", lease_s), ("SHRINKD_WORKER__MAX_LOSSES", "1000")]);
    [(); 2].map(|()| node(folder, &server.url(), &all))
}

/// A small job that makes no picture, which would take longer than the rest of it.
fn plain(radius: f64, outputs: &[&str]) -> Value {
    let mut body = small();
    body["field"]["scene"]["sphere"]["radius"] = json!(radius);
    body["outputs"] = json!(outputs);
    body
}

/// Downloads an output. `false` is an error that nobody can take for the output; whatever is not one is whole.
async fn download(app: &App, output: &Value) -> bool {
    let answer = app.get(output["href"].as_str().expect("a place")).await;
    if answer.status() != StatusCode::OK {
        problem(answer, 503, "blobs_unavailable").await;
        return false;
    }
    let Ok(bytes) = answer.bytes().await else { return false };
    assert_eq!(output["sha256"], hex(&bytes), "{} of {} bytes were told to be all", bytes.len(), output["bytes"]);
    true
}

/// Downloads every output of a job from every node, whole.
async fn all_whole(nodes: &[App], job: &Value) {
    for output in job["outputs"].as_array().expect("a list") {
        for node in nodes {
            assert!(download(node, output).await, "{output}");
        }
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_bucket_that_answers_with_errors_costs_no_job_and_shows_nothing_half() {
    let Some(server) = NatsServer::start() else { return };
    let Some(bucket) = Bucket::start().await else { return };
    let folder = tempfile::tempdir().expect("folder");
    let nodes = pair(folder.path(), &server, &bucket, "2");
    let before = nodes[0].submit(&plain(0.6, &["glb"])).await;
    let before = ended_once(&nodes[1], &before).await;
    all_whole(&nodes, &before).await;

    let send = async |node: &App| {
        let scene = r#"{"sphere": {"radius": 0.123}}"#;
        node.request(Method::POST, "/v1/inputs").body(scene).send().await.expect("an answer")
    };
    let upload = async |node: &App| {
        let answer = send(node).await;
        assert!(answer.headers().contains_key("retry-after"), "it says when to come again: {answer:?}");
        problem(answer, 503, "blobs_unavailable").await;
    };
    let look = async |node: &App| {
        problem(node.get("/readyz").await, 503, "blobs_unavailable").await;
    };
    bucket.refuse(500);
    // a scene needs no blob to be accepted, and cannot end without one
    let id = nodes[0].submit(&plain(0.4, &["glb", "report"])).await;
    let left = |line: &&str| line.contains("given back after a pause") && line.contains(&id);
    let failed = || nodes.iter().map(|node| node.log().lines().filter(left).count()).sum::<usize>();
    for status in [500, 503, 403] {
        bucket.refuse(status);
        let before_it = failed();
        let whole = tokio::join!(
            download(&nodes[0], &before["outputs"][0]),
            download(&nodes[1], &before["outputs"][0]),
            upload(&nodes[0]),
            upload(&nodes[1]),
            look(&nodes[0]),
            look(&nodes[1]),
        );
        assert!(!whole.0 && !whole.1, "the bucket has given nothing");
        eventually("an attempt fails", async || failed() > before_it).await;
        let waiting = nodes[1].get_json(&format!("/v1/jobs/{id}")).await;
        assert!(["running", "queued"].contains(&state(&waiting)), "{status}: {waiting}");
    }
    bucket.delay(Duration::ZERO);
    let job = ended_once(&nodes[1], &id).await;
    assert!(job["attempt"].as_u64() >= Some(4), "{job}");
    all_whole(&nodes, &job).await;
    for node in &nodes {
        assert!(node.get("/readyz").await.status().is_success());
        assert!(send(node).await.status().is_success());
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_download_that_the_bucket_breaks_off_is_an_error_or_whole() {
    let Some(server) = NatsServer::start() else { return };
    let Some(bucket) = Bucket::start().await else { return };
    let folder = tempfile::tempdir().expect("folder");
    let nodes = pair(folder.path(), &server, &bucket, "30");
    let id = nodes[0].submit(&plain(0.6, &["glb"])).await;
    let job = ended_once(&nodes[1], &id).await;
    let output = &job["outputs"][0];
    let size = output["bytes"].as_u64().expect("a number") as usize;
    // within the head of the bucket's answer, soon after it, in the middle of the output, and near its end
    for bytes in [100, 2000, size / 2, size] {
        let before = bucket.failures();
        bucket.cut_after(bytes);
        tokio::join!(download(&nodes[0], output), download(&nodes[1], output));
        assert!(bucket.failures() > before, "cut after {bytes} of {size} bytes");
        bucket.delay(Duration::ZERO);
        all_whole(&nodes, &job).await;
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_slow_bucket_costs_no_lease_on_a_cluster() {
    let Some(server) = NatsServer::start() else { return };
    let Some(bucket) = Bucket::start().await else { return };
    let folder = tempfile::tempdir().expect("folder");
    let nodes = pair(folder.path(), &server, &bucket, "3");
    // an output takes longer to be stored than the lease lasts
    bucket.delay(Duration::from_millis(3500));
    let id = nodes[0].submit(&plain(0.6, &["report"])).await;
    let job = ended_once(&nodes[1], &id).await;
    assert_eq!(job["attempt"], 1, "{job}");
    bucket.delay(Duration::from_millis(500));
    all_whole(&nodes, &job).await;
}
