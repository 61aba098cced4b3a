//! Two processes of the service on one NATS server: one service.

use crate::app::App;
use reqwest::{Method, StatusCode};
use serde_json::{Value, json};

#[path = "../support/nats_server.rs"]
pub mod nats_server;

#[tokio::test]
async fn two_processes_are_one_service() {
    let Some(server) = nats_server::NatsServer::start() else { return };
    // blobs are shared, as they must be
    let folder = tempfile::tempdir().expect("folder");
    let engine = server.url();
    let start = || App::start_with(folder.path(), &[("SHRINKD_ENGINE", &engine)]);
    let (a, b) = (start(), start());
    let request = json!({
        "field": {"scene": {"sphere": {"radius": 0.5}}},
        "shrink": {"lattice": {"octahedral": {"n": 16}}},
    });
    let submit = async |app: &App, wait: &str| {
        let submit = app.request(Method::POST, "/v1/jobs").header("Idempotency-Key", "once").header("Prefer", wait);
        let answer = submit.json(&request).send().await.expect("an answer");
        assert!(answer.status().is_success(), "{}", answer.status());
        answer.json::<Value>().await.expect("JSON")
    };
    let accepted = submit(&a, "wait=0").await;
    let id = accepted["id"].as_str().expect("an id");
    let job = submit(&b, "wait=60").await;
    assert_eq!(job["id"], id, "a repetition on the other node finds the same job");
    assert_eq!(job["state"], "succeeded");
    assert_eq!(job["attempt"], 1);

    let path = format!("/v1/jobs/{id}");
    assert_eq!(a.get_json(&path).await, b.get_json(&path).await);
    let request_events = async |app: &App| {
        let events = app.request(Method::GET, &format!("{path}/events?limit=512")).header("Accept", "application/json");
        events.send().await.expect("an answer").json::<Value>().await.expect("JSON")
    };
    let events = request_events(&a).await;
    assert_eq!(events, request_events(&b).await);
    assert_eq!(events["events"][0]["seq"], 1);
    for app in [&a, &b] {
        assert_eq!(app.get(&format!("{path}/outputs/glb")).await.status(), StatusCode::OK);
        assert_eq!(app.get_json("/v1/jobs").await["jobs"][0]["id"], id);
    }
    let forgotten = b.request(Method::DELETE, &path).send().await.expect("an answer");
    assert_eq!(forgotten.status(), StatusCode::NO_CONTENT);
    assert_eq!(a.get(&path).await.status(), StatusCode::NOT_FOUND);
}
