//! What a client gets that waits: of a stream beside the events, of a long poll, and of `Prefer: wait`.

use crate::app::{App, PATIENCE, endless, problem, small, state};
use crate::monitoring::scrape;
use base64::Engine as _;
use base64::prelude::BASE64_STANDARD;
use reqwest::{Method, Response, StatusCode};
use serde_json::{Value, json};
use std::collections::BTreeSet;
use std::path::Path;
use std::time::{Duration, Instant};

/// A service whose only slot is taken, and the name of a job that waits behind it and is told nothing.
async fn held_up(folder: &Path) -> (App, String) {
    let app = App::start_with(folder, &[("SHRINKD_WORKER__SLOTS", "1"), ("SHRINKD_WORKER__THREADS", "1")]);
    let running = app.submit(&endless()).await;
    assert_eq!(state(&app.running(&running).await), "running");
    let queued = app.submit(&small()).await;
    (app, queued)
}

/// The lines of a stream until one is like this.
async fn lines_until(stream: &mut Response, wanted: impl Fn(&str) -> bool) -> Vec<String> {
    let mut text = Vec::new();
    loop {
        let read = String::from_utf8_lossy(&text).into_owned();
        // what comes after the last end of a line may not be whole
        let whole = read.rsplit_once('\n').map_or("", |(whole, _)| whole);
        if whole.lines().any(&wanted) {
            return whole.lines().map(str::to_owned).collect();
        }
        // the request's own patience ends this
        let chunk = stream.chunk().await.expect("the stream goes on").unwrap_or_else(|| panic!("it ended: {read}"));
        text.extend_from_slice(&chunk);
    }
}

#[tokio::test]
async fn a_stream_says_when_to_come_back_and_that_it_lives() {
    let folder = tempfile::tempdir().expect("folder");
    let (app, queued) = held_up(folder.path()).await;
    let mut stream = app.get(&format!("/v1/jobs/{queued}/events")).await;
    assert_eq!(stream.headers()["content-type"], "text/event-stream");
    assert_eq!(stream.headers()["cache-control"], "no-cache");
    assert_eq!(stream.headers()["x-accel-buffering"], "no");
    let lines = lines_until(&mut stream, |line| line.starts_with(':')).await;
    let of = |field: &str| -> Vec<&str> {
        let named = lines.iter().filter_map(|line| line.split_once(':').filter(|(name, _)| *name == field));
        named.map(|(_, value)| value.trim()).collect()
    };
    assert_eq!(of("retry"), ["2000"], "once, in the first frame: {lines:?}");
    assert_eq!(of("event"), ["snapshot"], "nothing happened before the comment: {lines:?}");
    assert_eq!(of(""), ["heartbeat"], "{lines:?}");
}

/// The numbers of a `mesh` event's positions and triangles, decoded as its description says.
fn decoded(mesh: &Value) -> (Vec<[f64; 3]>, Vec<[usize; 3]>) {
    let bytes = |member: &str| BASE64_STANDARD.decode(mesh[member].as_str().expect("text")).expect("base64");
    let number = |bytes: &[u8]| bytes.iter().rev().fold(0usize, |number, &byte| (number << 8) | usize::from(byte));
    let (positions, triangles) = (bytes("positions"), bytes("triangles"));
    let width = mesh["index_bytes"].as_u64().expect("a number") as usize;
    assert_eq!(positions.len() as u64, 3 * 2 * mesh["vertices"].as_u64().expect("a number"));
    assert_eq!((triangles.len() / width) as u64, 3 * mesh["faces"].as_u64().expect("a number"));
    let scale = |member: &str, axis: usize| mesh[member][axis].as_f64().expect("a number");
    let quantized: Vec<usize> = positions.chunks(2).map(number).collect();
    let positions = quantized
        .chunks(3)
        .map(|q| std::array::from_fn(|axis| scale("origin", axis) + q[axis] as f64 * scale("step", axis)));
    let corners: Vec<usize> = triangles.chunks(width).map(number).collect();
    (positions.collect(), corners.chunks(3).map(|t| [t[0], t[1], t[2]]).collect())
}

#[tokio::test]
async fn the_front_of_a_running_job_is_told_and_can_be_decoded() {
    let folder = tempfile::tempdir().expect("folder");
    let app = App::start(folder.path());
    let id = app.submit(&small()).await;
    let events = crate::walk::follow(&app, &id, Some(0)).await;
    let at = |kind: &str, name: &str| events.iter().position(|(_, k, body)| k == kind && body["state"] == name);
    let (began, ended) = (at("state", "running").expect("begins"), at("state", "succeeded").expect("succeeds"));
    let meshes: Vec<usize> = (0..events.len()).filter(|&i| events[i].1 == "mesh").collect();
    assert!(!meshes.is_empty(), "{events:?}");
    for i in meshes {
        assert!(began < i && i < ended, "while it runs: {events:?}");
        let (positions, triangles) = decoded(&events[i].2);
        // the lattice is small enough to be sent as it is
        assert_eq!((positions.len(), triangles.len()), (32 * 15 + 2, 2 * 32 * 15));
        // the domain, and the ball around it
        assert!(positions.iter().flatten().all(|c| c.abs() < 2.0), "{positions:?}");
        assert!(positions.iter().any(|p| p.iter().any(|c| c.abs() > 0.5)), "no smaller than what it shrinks onto");
        let edges = triangles.iter().flat_map(|&[a, b, c]| [(a, b), (b, c), (c, a)]);
        let edges: BTreeSet<(usize, usize)> = edges.collect();
        assert_eq!(edges.len(), 3 * triangles.len(), "no edge is gone along twice in one direction");
        assert!(edges.iter().all(|&(a, b)| edges.contains(&(b, a))), "closed");
        assert!(edges.iter().all(|&(a, _)| a < positions.len()), "every corner is there");
    }
}

/// How often the engine was asked for a job.
async fn looks(app: &App) -> f64 {
    let told = scrape(app).await;
    told.get(r#"shrinkd_engine_call_duration_seconds_count{call="get",outcome="ok"}"#).copied().unwrap_or(0.0)
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn who_waits_with_a_tag_is_answered_when_something_has_changed() {
    let folder = tempfile::tempdir().expect("folder");
    let (app, queued) = held_up(folder.path()).await;
    let path = format!("/v1/jobs/{queued}");
    let tag = app.get(&path).await.headers()["etag"].to_str().expect("text").to_owned();
    let wait = |seconds: u32, tag: &str| {
        app.request(Method::GET, &format!("{path}?wait={seconds}")).header("if-none-match", tag).send()
    };
    let same = wait(1, &tag).await.expect("an answer");
    assert_eq!((same.status(), &same.headers()["etag"]), (StatusCode::NOT_MODIFIED, &tag.parse().expect("text")));
    assert!(same.bytes().await.expect("no body").is_empty());
    // what is news already is not waited for, though the job has not ended
    let other = wait(60, "W/\"0\"").await.expect("an answer");
    assert_eq!((other.status(), state(&other.json().await.expect("JSON"))), (StatusCode::OK, "queued"));

    let before = looks(&app).await;
    let waiting = tokio::spawn(wait(60, &tag));
    let clock = Instant::now();
    while looks(&app).await <= before {
        assert!(clock.elapsed() < PATIENCE, "the request never came\n{}", app.log());
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
    // it has looked, found what it knows, and waits
    let canceled = app.post(&format!("{path}/cancel"), &json!(null)).await;
    assert_eq!(canceled.status(), StatusCode::OK);
    let answer = waiting.await.expect("no panic").expect("an answer");
    assert_eq!(answer.status(), StatusCode::OK);
    assert_ne!(answer.headers()["etag"].to_str().expect("text"), tag);
    assert!(!answer.headers().contains_key("retry-after"), "nothing more will happen");
    assert_eq!(state(&answer.json().await.expect("JSON")), "canceled");
    for (query, header) in [("wait=soon", None), ("wait=-1", None), ("wait=1&wait=1", Some(&tag))] {
        let request = app.request(Method::GET, &format!("{path}?{query}"));
        let request = header.into_iter().fold(request, |request, tag| request.header("if-none-match", tag));
        problem(request.send().await.expect("an answer"), 400, "invalid_query").await;
    }
}

#[tokio::test]
async fn a_submit_that_prefers_to_wait_is_answered_in_time_all_the_same() {
    let folder = tempfile::tempdir().expect("folder");
    let app = App::start(folder.path());
    let submit = |prefer: &'static str| app.request(Method::POST, "/v1/jobs").header("prefer", prefer).json(&endless());
    let answer = submit("respond-async, wait=1").send().await.expect("an answer");
    assert_eq!(answer.status(), StatusCode::ACCEPTED);
    assert_eq!(answer.headers()["preference-applied"], "wait=1");
    assert!(answer.headers().contains_key("retry-after"));
    let location = answer.headers()["location"].to_str().expect("text").to_owned();
    let job: Value = answer.json().await.expect("JSON");
    assert_eq!(location, format!("/v1/jobs/{}", job["id"].as_str().expect("a name")));
    assert!(["queued", "running"].contains(&state(&job)), "{job}");
    // what is not understood is ignored, and not said to be applied
    let answer = submit("wait=soon").send().await.expect("an answer");
    assert_eq!(answer.status(), StatusCode::ACCEPTED);
    assert!(!answer.headers().contains_key("preference-applied"));
}
