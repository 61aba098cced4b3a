//! Many clients submit under one key at the same time.

use super::cluster::{ended_once, node};
use super::{jobs_labeled, labeled, submit_keyed};
use crate::app::App;
use crate::cluster::nats_server::NatsServer;

/// Clients at once.
const CLIENTS: usize = 50;

/// Submits the same request from all clients at once, which take turns with the nodes; returns the name of the job.
async fn submit_at_once(nodes: &[App]) -> String {
    let body = labeled("crowd");
    let clients = (0..CLIENTS).map(|i| submit_keyed(&nodes[i % nodes.len()], "crowd", &body));
    let answers = futures::future::join_all(clients).await;
    let id = answers[0].0.clone();
    assert!(answers.iter().all(|answer| answer.0 == id), "every answer names the same job: {answers:?}");
    // none where the one that made it was told to repeat it
    let new = answers.iter().filter(|answer| !answer.1).count();
    assert!(new <= 1, "one of them was the first: {answers:?}");
    id
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn fifty_clients_with_one_key_make_one_job() {
    let folder = tempfile::tempdir().expect("folder");
    let nodes = [App::start(folder.path())];
    let id = submit_at_once(&nodes).await;
    assert_eq!(ended_once(&nodes[0], &id).await["attempt"], 1);
    assert_eq!(jobs_labeled(&nodes[0], "crowd").await, [id]);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn fifty_clients_with_one_key_on_three_processes_make_one_job() {
    let Some(server) = NatsServer::start() else { return };
    let folder = tempfile::tempdir().expect("folder");
    let start = || node(folder.path(), &server.url(), &[]);
    let nodes = [start(), start(), start()];
    let id = submit_at_once(&nodes).await;
    for node in &nodes {
        assert_eq!(ended_once(node, &id).await["attempt"], 1);
    }
    // a node that comes late knows everything that was stored before it
    let late = start();
    assert_eq!(jobs_labeled(&late, "crowd").await, [id.as_str()]);
    let listed = late.get_json("/v1/jobs").await;
    assert_eq!(listed["jobs"].as_array().map(Vec::len), Some(1), "{listed}");
}
