//! Cancel, forget, list, validate.

use crate::app::{App, PATIENCE, endless, problem, small, state};
use reqwest::{Method, StatusCode};
use serde_json::{Value, json};
use std::time::Instant;

#[tokio::test]
async fn a_running_job_stops_soon_after_it_is_canceled() {
    let folder = tempfile::tempdir().expect("folder");
    let app = App::start(folder.path());
    let id = app.submit(&endless()).await;
    assert_eq!(state(&app.running(&id).await), "running");
    let clock = Instant::now();
    let response = app.post(&format!("/v1/jobs/{id}/cancel"), &json!(null)).await;
    assert_eq!(response.status(), StatusCode::ACCEPTED);
    assert_eq!(state(&response.json().await.expect("JSON")), "canceling");
    let job = app.ended(&id).await;
    println!("canceled within {:?}", clock.elapsed());
    assert_eq!((state(&job), &job["problem"], &job["outputs"]), ("canceled", &json!(null), &json!([])));
    assert!(clock.elapsed() < PATIENCE / 10, "the job itself would take much longer");
    let again = app.post(&format!("/v1/jobs/{id}/cancel"), &json!(null)).await;
    assert_eq!(again.status(), StatusCode::OK);
    assert_eq!(again.json::<Value>().await.expect("JSON"), job, "cancelling what has ended changes nothing");
}

#[tokio::test]
async fn a_queued_job_is_canceled_at_once() {
    let folder = tempfile::tempdir().expect("folder");
    let app = App::start_with(folder.path(), &[("SHRINKD_WORKER__SLOTS", "1")]);
    let first = app.submit(&endless()).await;
    app.running(&first).await;
    let second = app.submit(&small()).await;
    let response = app.post(&format!("/v1/jobs/{second}/cancel"), &json!(null)).await;
    assert_eq!(response.status(), StatusCode::OK);
    assert_eq!(state(&response.json().await.expect("JSON")), "canceled");
}

#[tokio::test]
async fn an_ended_job_can_be_forgotten_and_a_shared_output_stays() {
    let folder = tempfile::tempdir().expect("folder");
    let app = App::start(folder.path());
    let (first, second) = (app.submit(&small()).await, app.submit(&small()).await);
    app.ended(&first).await;
    app.ended(&second).await;
    let delete = |id: &str| app.request(Method::DELETE, &format!("/v1/jobs/{id}")).send();
    assert_eq!(delete(&first).await.expect("an answer").status(), StatusCode::NO_CONTENT);
    problem(app.get(&format!("/v1/jobs/{first}")).await, 404, "unknown_job").await;
    problem(delete(&first).await.expect("an answer"), 404, "unknown_job").await;
    // both jobs made the same bytes, which are stored once
    let glb = app.get(&format!("/v1/jobs/{second}/outputs/glb")).await;
    assert_eq!(glb.status(), StatusCode::OK);
    assert!(glb.bytes().await.expect("bytes").starts_with(b"glTF"));
    assert_eq!(delete(&second).await.expect("an answer").status(), StatusCode::NO_CONTENT);
    let blobs = std::fs::read_dir(folder.path().join("blobs/sha256")).expect("folder").flatten();
    let left: usize = blobs.map(|d| std::fs::read_dir(d.path()).expect("folder").count()).sum();
    assert_eq!(left, 0, "bytes that no job names are gone");

    let running = app.submit(&endless()).await;
    problem(delete(&running).await.expect("an answer"), 409, "job_not_ended").await;
}

#[tokio::test]
async fn jobs_are_listed_newest_first_page_by_page() {
    let folder = tempfile::tempdir().expect("folder");
    let app = App::start(folder.path());
    let mut ids = Vec::new();
    for i in 0..5 {
        let mut request = small();
        request["labels"] = json!({"parity": if i % 2 == 0 { "even" } else { "odd" }});
        ids.insert(0, app.submit(&request).await);
    }
    for id in &ids {
        app.ended(id).await;
    }
    let names = |page: &Value| -> Vec<String> {
        page["jobs"].as_array().expect("a list").iter().map(|j| j["id"].as_str().expect("a name").to_owned()).collect()
    };
    let (mut listed, mut next) = (Vec::new(), Some("/v1/jobs?limit=2&state=succeeded".to_owned()));
    while let Some(path) = next {
        let response = app.get(&path).await;
        let link = response.headers().get("link").map(|l| l.to_str().expect("text").to_owned());
        next = link.map(|l| l.strip_prefix('<').and_then(|l| l.split_once('>')).expect("a link").0.to_owned());
        listed.extend(names(&response.json().await.expect("JSON")));
    }
    assert_eq!(listed, ids);
    assert_eq!(names(&app.get_json("/v1/jobs?label=parity:odd").await), [ids[1].clone(), ids[3].clone()]);
    assert_eq!(names(&app.get_json("/v1/jobs?state=failed&state=running").await), Vec::<String>::new());
    let third = app.get_json(&format!("/v1/jobs/{}", ids[2])).await;
    let from = third["created_at"].as_str().expect("a time");
    assert!(names(&app.get_json(&format!("/v1/jobs?created_from={from}")).await).contains(&ids[2]));
    assert!(!names(&app.get_json(&format!("/v1/jobs?created_to={from}")).await).contains(&ids[2]));
    let page = app.get("/plain").await.text().await.expect("text");
    assert!(ids.iter().all(|id| page.contains(id.as_str())), "the page shows them all");
}

#[tokio::test]
async fn a_node_that_drains_says_so_to_whoever_asks_and_then_ends() {
    let folder = tempfile::tempdir().expect("folder");
    let mut app = App::start_with(folder.path(), &[("SHRINKD_DRAIN_S", "300")]);
    assert!(app.get("/readyz").await.status().is_success());
    app.terminate();
    let clock = std::time::Instant::now();
    while app.get("/readyz").await.status().is_success() {
        assert!(clock.elapsed() < crate::app::PATIENCE, "it is still ready\n{}", app.log());
    }
    // over a connection of its own: the port is still open
    let client = reqwest::Client::new();
    problem(client.get(format!("{}/readyz", app.url)).send().await.expect("an answer"), 503, "stopping").await;
    let submit = client.post(format!("{}/v1/jobs", app.url)).json(&small()).send().await.expect("an answer");
    assert!(submit.headers().contains_key("retry-after"));
    problem(submit, 503, "stopping").await;
    assert_eq!(app.get_json("/v1/jobs").await["jobs"], json!([]));
    // who interrupts it does not want to wait
    app.interrupt();
    let (status, _) = app.wait();
    assert!(status.success(), "{status}");
}

#[tokio::test]
async fn a_request_can_be_checked_without_being_submitted() {
    let folder = tempfile::tempdir().expect("folder");
    let app = App::start(folder.path());
    let response = app.post("/v1/jobs?validate_only=true", &small()).await;
    assert_eq!(response.status(), StatusCode::OK);
    let estimate: Value = response.json().await.expect("JSON");
    assert_eq!((&estimate["valid"], &estimate["vertices"]), (&json!(true), &json!(32 * 15 + 2)));
    assert!(estimate["evaluations"].as_u64() > estimate["vertices"].as_u64());
    let wrong = json!({"field": {"scene": {"sphere": {"radius": -1}}}});
    problem(app.post("/v1/jobs?validate_only=true", &wrong).await, 422, "invalid_request").await;
    assert_eq!(app.get_json("/v1/jobs").await["jobs"], json!([]));
}
