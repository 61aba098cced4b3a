//! The backup of a cluster, as docs/operations.md says, carried out while it works, and put back into servers that have nothing.
//!
//! `nats account backup` asks the servers for a snapshot of every stream, in the order of their names, and `nats account restore` gives
//! them back. The same requests are made here (JetStream's API: `STREAM.SNAPSHOT`, `STREAM.RESTORE`), because that program is no part
//! of the tests.

use crate::app::{App, endless, small, state};
use crate::cluster::nats_server::NatsServer;
use async_nats::Client;
use futures::StreamExt;
use serde_json::{Value, json};
use std::path::Path;

/// A stream as it was copied: what describes it, and its content in pieces.
struct Snapshot {
    name: String,
    description: Value,
    pieces: Vec<bytes::Bytes>,
}

async fn ask(client: &Client, subject: String, body: Value) -> Value {
    let answer = client.request(subject.clone(), body.to_string().into()).await.expect("an answer");
    let answer: Value = serde_json::from_slice(&answer.payload).expect("JSON");
    assert!(answer["error"].is_null(), "{subject}: {answer}");
    answer
}

async fn stream_names(client: &Client) -> Vec<String> {
    let list = ask(client, "$JS.API.STREAM.NAMES".to_owned(), json!({})).await;
    let mut names: Vec<String> = serde_json::from_value(list["streams"].clone()).unwrap_or_default();
    names.sort();
    names
}

async fn back_up(client: &Client) -> Vec<Snapshot> {
    let mut snapshots = Vec::new();
    for name in stream_names(client).await {
        let inbox = client.new_inbox();
        let mut arriving = client.subscribe(inbox.clone()).await.expect("subscribes");
        let asked = json!({"deliver_subject": inbox, "no_consumers": true, "chunk_size": 128 << 10});
        let answer = ask(client, format!("$JS.API.STREAM.SNAPSHOT.{name}"), asked).await;
        let mut pieces = Vec::new();
        while let Some(piece) = arriving.next().await {
            if piece.payload.is_empty() {
                break;
            }
            // the server sends more once this has arrived
            if let Some(reply) = piece.reply {
                client.publish(reply, "".into()).await.expect("acknowledges");
            }
            pieces.push(piece.payload);
        }
        let description = json!({"config": answer["config"], "state": answer["state"]});
        snapshots.push(Snapshot { name, description, pieces });
    }
    snapshots
}

async fn put_back(client: &Client, snapshots: Vec<Snapshot>) {
    for Snapshot { name, description, pieces } in snapshots {
        let answer = ask(client, format!("$JS.API.STREAM.RESTORE.{name}"), description).await;
        let to = answer["deliver_subject"].as_str().expect("a subject").to_owned();
        for piece in pieces {
            client.request(to.clone(), piece).await.expect("is taken");
        }
        // an empty piece is the end; the answer is that of making the stream
        let made = client.request(to, "".into()).await.expect("an answer");
        let made: Value = serde_json::from_slice(&made.payload).expect("JSON");
        assert!(made["error"].is_null() && made["config"]["name"] == name, "{made}");
    }
}

fn node(folder: &Path, server: &NatsServer) -> App {
    App::start_with(folder, &[("SHRINKD_ENGINE", server.url().as_str()), ("SHRINKD_WORKER__SLOTS", "1")])
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_cluster_that_was_backed_up_under_load_is_whole_when_it_is_put_back() {
    let Some(server) = NatsServer::start() else { return };
    let (data, restored) = (tempfile::tempdir().expect("folder"), tempfile::tempdir().expect("folder"));
    let app = node(data.path(), &server);
    let mut ended = Vec::new();
    for i in 0..3 {
        let answer = app.request(reqwest::Method::POST, "/v1/jobs").header("idempotency-key", format!("key-{i}"));
        let job: Value = answer.json(&small()).send().await.expect("an answer").json().await.expect("JSON");
        let id = job["id"].as_str().expect("a name").to_owned();
        app.ended(&id).await;
        ended.push(id);
    }
    let (running, queued) = (app.submit(&endless()).await, app.submit(&small()).await);
    app.running(&running).await;
    let client = async_nats::connect(server.url()).await.expect("connects");
    let snapshots = back_up(&client).await;
    let names: Vec<&str> = snapshots.iter().map(|snapshot| snapshot.name.as_str()).collect();
    assert!(
        names.contains(&"SHRINKD_JOBS") && names.contains(&"SHRINKD_KEYS") && names.contains(&"SHRINKD_SPECS"),
        "{names:?}"
    );
    // the bytes after the records, as docs/operations.md says
    let copied =
        std::process::Command::new("cp").arg("-a").arg(data.path().join("blobs")).arg(restored.path()).status();
    assert!(copied.expect("cp").success());
    let glb = async |app: &App, id: &str| {
        let answer = app.get(&format!("/v1/jobs/{id}/outputs/glb")).await.error_for_status().expect("is there");
        answer.bytes().await.expect("whole")
    };
    let mut before = Vec::new();
    for id in &ended {
        before.push((app.get_json(&format!("/v1/jobs/{id}")).await, glb(&app, id).await));
    }
    app.kill();
    drop(server);

    let empty = NatsServer::start().expect("the program was there");
    let client = async_nats::connect(empty.url()).await.expect("connects");
    assert_eq!(stream_names(&client).await, Vec::<String>::new(), "it has nothing yet");
    put_back(&client, snapshots).await;
    let app = node(restored.path(), &empty);
    for (i, (id, (job, bytes))) in ended.iter().zip(before).enumerate() {
        assert_eq!(app.get_json(&format!("/v1/jobs/{id}")).await, job);
        assert_eq!(glb(&app, id).await, bytes, "the outputs are there, and the same");
        let again = app.request(reqwest::Method::POST, "/v1/jobs").header("idempotency-key", format!("key-{i}"));
        let again: Value = again.json(&small()).send().await.expect("an answer").json().await.expect("JSON");
        assert_eq!(again["id"], **id, "its key is known still");
    }
    assert_eq!(app.get_json("/v1/jobs").await["jobs"].as_array().expect("a list").len(), 5);
    // whoever had the job before the copy is gone, which shows after a lease
    let again = app.wait_until(&running, |job| job["attempt"].as_u64() == Some(2)).await;
    assert_eq!(state(&again), "running");
    let canceled = app.post(&format!("/v1/jobs/{running}/cancel"), &json!({})).await;
    assert!(canceled.status().is_success());
    assert_eq!(state(&app.ended(&queued).await), "succeeded", "what waited in the copy runs");
}
