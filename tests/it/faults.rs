//! What survives a kill, and what a stop does to those who are connected.

mod bucket;
mod cluster;
mod crowd;
mod disk;
mod repetition;
mod room;
mod worker;

use crate::app::{App, PATIENCE, endless, small, state};
use crate::walk::follow;
use eventsource_stream::Eventsource;
use futures::StreamExt;
use reqwest::Method;
use serde_json::{Value, json};
use std::time::{Duration, Instant};

/// Long enough to be killed in the middle, short enough to be waited for.
fn lengthy() -> Value {
    json!({
        "field": {"scene": {"ellipsoid": {"radii": [0.7, 0.5, 0.4]}}},
        "shrink": {"method": "paper", "lattice": {"latlong": {"n_theta": 200, "n_phi": 100}}},
    })
}

/// Submits under a key as a client does, which repeats what it is told to repeat and nothing else: the job's name, and whether the
/// answer says that it repeats an earlier one.
async fn submit_keyed(app: &App, key: &str, body: &Value) -> (String, bool) {
    let clock = Instant::now();
    loop {
        let request = app.request(Method::POST, "/v1/jobs").header("Idempotency-Key", key).json(body);
        let answer = request.send().await.expect("an answer");
        let (status, headers) = (answer.status().as_u16(), answer.headers().clone());
        let told: Value = answer.json().await.expect("JSON");
        if matches!(status, 200 | 202) {
            let is_repetition = headers.get("idempotent-replayed").is_some_and(|value| value == "true");
            return (told["id"].as_str().expect("a name").to_owned(), is_repetition);
        }
        let code = told["code"].as_str().unwrap_or_default();
        let known = [(503, "engine_unavailable")];
        assert!(known.contains(&(status, code)), "{status}: {told}");
        assert!(headers.contains_key("retry-after"), "it says when to ask again: {told}");
        assert!(clock.elapsed() < PATIENCE, "still {told}\n{}", app.log());
        tokio::time::sleep(Duration::from_millis(200)).await;
    }
}

/// A small job that is found by its label. It makes no picture, which would take longer than the rest of it.
fn labeled(round: &str) -> Value {
    let mut body = small();
    body["outputs"] = json!(["report"]);
    body["labels"] = json!({ "round": round });
    body
}

/// The names of the jobs with a label.
async fn jobs_labeled(app: &App, round: &str) -> Vec<String> {
    let listed = app.get_json(&format!("/v1/jobs?label=round:{round}")).await;
    let jobs = listed["jobs"].as_array().expect("a list").iter();
    jobs.map(|job| job["id"].as_str().expect("a name").to_owned()).collect()
}

/// The states that events tell of, with their attempts.
fn states(events: &[(u64, String, Value)]) -> Vec<(&str, u64)> {
    let told = events.iter().filter(|event| event.1 == "state");
    told.map(|event| (state(&event.2), event.2["attempt"].as_u64().expect("a number"))).collect()
}

/// The numbers and kinds of a job's events, until one is of this kind.
async fn read_until(app: &App, id: &str, wanted: impl Fn(&str, &Value) -> bool) -> Vec<(u64, String, Value)> {
    let response = app.request(Method::GET, &format!("/v1/jobs/{id}/events?after=0")).send().await.expect("an answer");
    let mut stream = response.bytes_stream().eventsource();
    let mut events = Vec::new();
    while let Some(Ok(event)) = stream.next().await {
        let body: Value = serde_json::from_str(&event.data).expect("JSON");
        let found = wanted(&event.event, &body);
        events.push((event.id.parse().expect("a number"), event.event, body));
        if found {
            break;
        }
    }
    events
}

#[tokio::test]
async fn a_job_that_was_killed_in_the_middle_runs_again_and_its_reader_misses_nothing() {
    let folder = tempfile::tempdir().expect("folder");
    let mut app = App::start(folder.path());
    // a job may come to its end in the moment between the event and the kill: then another one is killed
    for _ in 0..10 {
        let id = app.submit(&lengthy()).await;
        let before = read_until(&app, &id, |kind, body| kind == "state" && body["state"] == "running").await;
        app.kill();
        app = App::start(folder.path());
        let job = app.ended(&id).await;
        assert_eq!(state(&job), "succeeded", "{job}");
        if job["attempt"] == 1 {
            continue;
        }
        assert_eq!(job["attempt"], 2);
        let last = before.last().expect("an event").0;
        let after = follow(&app, &id, Some(last)).await;
        let all = [before, after].concat();
        assert_eq!(all.iter().map(|e| e.0).collect::<Vec<_>>(), (1..=all.len() as u64).collect::<Vec<_>>());
        assert_eq!(states(&all), [("queued", 0), ("running", 1), ("queued", 1), ("running", 2), ("succeeded", 2)]);
        assert_eq!(all.last().map(|e| e.1.as_str()), Some("done"));
        assert_eq!(follow(&app, &id, Some(0)).await, all, "what was told before the kill is told the same after it");
        return;
    }
    panic!("ten jobs ended before they could be killed");
}

#[tokio::test]
async fn accepted_jobs_survive_a_kill() {
    let folder = tempfile::tempdir().expect("folder");
    let app = App::start_with(folder.path(), &[("SHRINKD_WORKER__SLOTS", "1")]);
    let first = app.submit(&endless()).await;
    app.running(&first).await;
    let mut waiting = Vec::new();
    for _ in 0..3 {
        waiting.push(app.submit(&small()).await);
    }
    app.kill();
    let app = App::start(folder.path());
    for id in &waiting {
        let job = app.ended(id).await;
        assert_eq!((state(&job), &job["attempt"]), ("succeeded", &json!(1)));
    }
    assert_eq!(app.running(&first).await["attempt"], 2);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_stop_ends_open_streams_and_waits_and_is_over_in_time() {
    let folder = tempfile::tempdir().expect("folder");
    let mut app = App::start(folder.path());
    let id = app.submit(&endless()).await;
    app.running(&id).await;
    let mut streams = Vec::new();
    for _ in 0..3 {
        let response = app.request(Method::GET, &format!("/v1/jobs/{id}/events")).send().await.expect("an answer");
        let mut stream = response.bytes_stream().eventsource();
        assert_eq!(stream.next().await.expect("a frame").expect("whole").event, "snapshot");
        streams.push(stream);
    }
    let poll = tokio::spawn(app.request(Method::GET, &format!("/v1/jobs/{id}?wait=60")).send());
    tokio::time::sleep(Duration::from_millis(100)).await;
    app.terminate();
    let (status, took) = tokio::task::block_in_place(|| app.wait());
    assert!(status.success(), "{status}\n{}", app.log());
    // it is bounded by 4 s in the program, and by 5 s in the contract
    assert!(took < Duration::from_secs(5), "{took:?}");
    for stream in streams {
        let rest = tokio::time::timeout(PATIENCE, stream.collect::<Vec<_>>()).await.expect("the stream ends");
        assert!(rest.iter().all(Result::is_ok), "and ends whole: {rest:?}");
    }
    let answer = poll.await.expect("no panic").expect("the long poll is answered");
    assert_eq!(answer.status(), 200);

    let app = App::start(folder.path());
    let job = app.running(&id).await;
    assert_eq!((state(&job), &job["attempt"]), ("running", &json!(2)), "given back, and taken up again");
}

#[test]
fn a_second_service_on_the_same_folder_is_refused() {
    let folder = tempfile::tempdir().expect("folder");
    let _app = App::start(folder.path());
    let second = std::process::Command::new(crate::app::BINARY)
        .args(["serve", "--listen", "127.0.0.1:0", "--data"])
        .arg(folder.path())
        .output()
        .expect("runs");
    assert_eq!(second.status.code(), Some(1));
    assert!(String::from_utf8_lossy(&second.stderr).contains("another process"));
}
