//! Keys, tags and ranges: what makes requests repeatable and downloads cheap.

use crate::app::{App, endless, problem, small, state};
use reqwest::{Method, Response, StatusCode};
use serde_json::{Value, json};

async fn keyed(app: &App, key: &str, body: &str) -> Response {
    let request = app.request(Method::POST, "/v1/jobs").header("idempotency-key", key);
    request.header("content-type", "application/json").body(body.to_owned()).send().await.expect("an answer")
}

#[tokio::test]
async fn a_key_makes_a_submit_repeatable() {
    let folder = tempfile::tempdir().expect("folder");
    let app = App::start(folder.path());
    let body = small().to_string();
    let first = keyed(&app, "k1", &body).await;
    assert_eq!(first.status(), StatusCode::ACCEPTED);
    assert!(!first.headers().contains_key("idempotent-replayed"));
    let first: Value = first.json().await.expect("JSON");
    app.ended(first["id"].as_str().expect("a name")).await;
    // other spaces are the same request
    let pretty = serde_json::to_string_pretty(&small()).expect("JSON");
    let again = keyed(&app, "k1", &pretty).await;
    assert_eq!(again.status(), StatusCode::ACCEPTED);
    assert_eq!(again.headers()["idempotent-replayed"], "true");
    assert_eq!(again.json::<Value>().await.expect("JSON"), first, "the same answer");
    problem(keyed(&app, "k1", &endless().to_string()).await, 422, "idempotency_key_reused").await;
    let other: Value = keyed(&app, "k2", &body).await.json().await.expect("JSON");
    assert_ne!(other["id"], first["id"]);
    problem(keyed(&app, &"k".repeat(300), &body).await, 400, "invalid_header").await;
    let jobs = app.get_json("/v1/jobs").await;
    assert_eq!(jobs["jobs"].as_array().map(Vec::len), Some(2));
}

#[tokio::test]
async fn a_key_is_known_after_a_restart() {
    let folder = tempfile::tempdir().expect("folder");
    let app = App::start(folder.path());
    let body = small().to_string();
    let first: Value = keyed(&app, "k", &body).await.json().await.expect("JSON");
    app.kill();
    let app = App::start(folder.path());
    assert_eq!(keyed(&app, "k", &body).await.json::<Value>().await.expect("JSON"), first);
}

#[tokio::test]
async fn an_unchanged_job_is_not_sent_again() {
    let folder = tempfile::tempdir().expect("folder");
    let app = App::start(folder.path());
    let id = app.submit(&small()).await;
    app.ended(&id).await;
    let path = format!("/v1/jobs/{id}");
    let tag = app.get(&path).await.headers()["etag"].clone();
    assert!(tag.to_str().expect("text").starts_with("W/\""));
    let conditional = |tag: &str| app.request(Method::GET, &path).header("if-none-match", tag).send();
    let same = conditional(tag.to_str().expect("text")).await.expect("an answer");
    assert_eq!((same.status(), &same.headers()["etag"]), (StatusCode::NOT_MODIFIED, &tag));
    assert_eq!(conditional("W/\"0\"").await.expect("an answer").status(), StatusCode::OK);
}

#[tokio::test]
async fn an_output_is_had_in_parts() {
    let folder = tempfile::tempdir().expect("folder");
    let app = App::start(folder.path());
    let id = app.submit(&small()).await;
    app.ended(&id).await;
    let path = format!("/v1/jobs/{id}/outputs/glb");
    let whole = app.get(&path).await;
    let tag = whole.headers()["etag"].to_str().expect("text").to_owned();
    assert!(whole.headers()["repr-digest"].to_str().expect("text").starts_with("sha-256=:"));
    let whole = whole.bytes().await.expect("bytes");
    let part = |range: &str, condition: Option<&str>| {
        let request = app.request(Method::GET, &path).header("range", range);
        condition.map(|tag| request.try_clone().expect("no body").header("if-range", tag)).unwrap_or(request).send()
    };
    let size = whole.len();
    for (range, expected) in [("bytes=0-3", 0..4), ("bytes=10-", 10..size), ("bytes=-7", size - 7..size)] {
        let response = part(range, Some(&tag)).await.expect("an answer");
        assert_eq!(response.status(), StatusCode::PARTIAL_CONTENT, "{range}");
        let said = format!("bytes {}-{}/{size}", expected.start, expected.end - 1);
        assert_eq!(response.headers()["content-range"].to_str().expect("text"), said);
        assert_eq!(response.headers()["etag"].to_str().expect("text"), tag);
        assert_eq!(response.bytes().await.expect("bytes"), whole[expected], "{range}");
    }
    let stale = part("bytes=0-3", Some("\"another\"")).await.expect("an answer");
    assert_eq!(stale.status(), StatusCode::OK, "a range of another version is the whole");
    let beyond = part(&format!("bytes={size}-"), None).await.expect("an answer");
    assert_eq!(beyond.headers()["content-range"].to_str().expect("text"), format!("bytes */{size}"));
    problem(beyond, 416, "range_not_satisfiable").await;
    let known = app.request(Method::GET, &path).header("if-none-match", &tag).send().await.expect("an answer");
    assert_eq!(known.status(), StatusCode::NOT_MODIFIED);
    let head = app.request(Method::HEAD, &path).send().await.expect("an answer");
    assert_eq!(head.headers()["content-length"].to_str().expect("text"), size.to_string());
    assert_eq!(head.headers()["etag"].to_str().expect("text"), tag);
    assert!(head.bytes().await.expect("no body").is_empty());
}

#[tokio::test]
async fn an_output_is_not_there_before_the_end_and_says_so() {
    let folder = tempfile::tempdir().expect("folder");
    let app = App::start(folder.path());
    let id = app.submit(&endless()).await;
    problem(app.get(&format!("/v1/jobs/{id}/outputs/glb")).await, 409, "job_not_ended").await;
    problem(app.get(&format!("/v1/jobs/{id}/outputs/stl")).await, 404, "unknown_output").await;
    app.post(&format!("/v1/jobs/{id}/cancel"), &json!(null)).await;
    let job = app.ended(&id).await;
    assert_eq!(state(&job), "canceled");
    problem(app.get(&format!("/v1/jobs/{id}/outputs/glb")).await, 404, "unknown_output").await;
}
