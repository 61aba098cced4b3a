//! The service with its blobs in a bucket: what it does when all is well, and when the bucket is slow or away.

use crate::app::{App, fixture, problem, small, state};
use crate::s3::Bucket;
use reqwest::{Method, StatusCode, header, redirect};
use serde_json::{Value, json};
use std::path::Path;
use std::time::Duration;

fn start(folder: &Path, bucket: &Bucket, more: &[(&str, &str)]) -> App {
    let variables = bucket.variables("some/where");
    let mut all: Vec<(&str, &str)> = variables.iter().map(|(name, value)| (*name, value.as_str())).collect();
    all.extend(more);
    App::start_with(folder, &all)
}

/// A job of the small network among the fixtures.
async fn of_network(app: &App) -> Value {
    let response = app.request(Method::POST, "/v1/inputs").body(fixture("networks/blob.safetensors")).send().await;
    let response = response.expect("an answer");
    assert_eq!(response.status(), StatusCode::CREATED);
    let input: Value = response.json().await.expect("JSON");
    let mut job = small();
    job["field"] = json!({"input": input["id"]});
    job
}

#[tokio::test]
async fn blobs_in_a_bucket_are_served_whole_in_ranges_and_by_links() {
    let Some(bucket) = Bucket::start().await else { return };
    let folder = tempfile::tempdir().expect("folder");
    let app = start(folder.path(), &bucket, &[]);
    let id = app.submit(&of_network(&app).await).await;
    let job = app.ended(&id).await;
    assert_eq!(state(&job), "succeeded", "{job}");
    let path = format!("/v1/jobs/{id}/outputs/glb");
    let whole = app.get(&path).await.bytes().await.expect("bytes");
    let length = job["outputs"][0]["bytes"].as_u64().expect("a number");
    assert_eq!(whole.len() as u64, length);
    let part = app.request(Method::GET, &path).header(header::RANGE, "bytes=8-99").send().await.expect("an answer");
    assert_eq!(part.status(), StatusCode::PARTIAL_CONTENT);
    assert_eq!(part.bytes().await.expect("bytes"), whole[8..100]);
    assert!(!folder.path().join("blobs").exists(), "nothing lies in the folder");
    assert!(!app.log().contains("conditional put"), "{}", app.log());
    app.kill();

    let app = start(folder.path(), &bucket, &[("SHRINKD_DOWNLOAD_LINK_S", "60")]);
    let strict = reqwest::Client::builder().redirect(redirect::Policy::none()).build().expect("a client");
    let answer = strict.get(format!("{}{path}", app.url)).send().await.expect("an answer");
    assert_eq!(answer.status(), StatusCode::TEMPORARY_REDIRECT);
    let link = answer.headers()["location"].to_str().expect("text").to_owned();
    assert!(link.starts_with(&bucket.endpoint()) && link.contains("X-Amz-Signature"), "{link}");
    assert_eq!(answer.headers()["cache-control"], "no-store");
    let linked = reqwest::get(&link).await.expect("an answer").bytes().await.expect("bytes");
    assert_eq!(linked, whole);
    // the page may not read from elsewhere
    let page = strict.get(format!("{}{path}", app.url)).header("sec-fetch-site", "same-origin").send().await;
    assert_eq!(page.expect("an answer").status(), StatusCode::OK);
    // a link is good for GET alone
    let head = strict.head(format!("{}{path}", app.url)).send().await.expect("an answer");
    assert_eq!(
        (head.status(), head.headers()["content-length"].to_str().ok()),
        (StatusCode::OK, Some(&*length.to_string()))
    );
}

#[tokio::test]
async fn a_bucket_that_is_away_loses_no_job() {
    let Some(bucket) = Bucket::start().await else { return };
    let folder = tempfile::tempdir().expect("folder");
    // one loss would fail a job: an outage is none
    let app = start(folder.path(), &bucket, &[("SHRINKD_WORKER__MAX_LOSSES", "1")]);
    let job = of_network(&app).await;
    bucket.cut();
    problem(app.get("/readyz").await, 503, "blobs_unavailable").await;
    assert!(app.get("/livez").await.status().is_success());
    let upload = app.request(Method::POST, "/v1/inputs").body(fixture("networks/morph.safetensors")).send().await;
    problem(upload.expect("an answer"), 503, "blobs_unavailable").await;
    problem(app.post("/v1/jobs", &job).await, 503, "blobs_unavailable").await;
    // a scene needs no blob to be accepted, and cannot end without one
    let id = app.submit(&small()).await;
    app.wait_until(&id, |_| app.log().contains("given back after a pause")).await;
    let waiting = app.get_json(&format!("/v1/jobs/{id}")).await;
    assert!(["running", "queued"].contains(&state(&waiting)), "{waiting}");
    bucket.delay(Duration::ZERO);
    let ended = app.ended(&id).await;
    assert_eq!(state(&ended), "succeeded", "{ended}");
    assert!(ended["attempt"].as_u64() >= Some(2), "{ended}");
    assert!(app.get("/readyz").await.status().is_success());
    let id = app.submit(&job).await;
    assert_eq!(state(&app.ended(&id).await), "succeeded");
}

#[tokio::test]
async fn a_slow_bucket_costs_no_lease() {
    let Some(bucket) = Bucket::start().await else { return };
    let folder = tempfile::tempdir().expect("folder");
    let app = start(folder.path(), &bucket, &[("SHRINKD_WORKER__LEASE_S", "1")]);
    // an output takes longer to be stored than the lease lasts
    bucket.delay(Duration::from_millis(1500));
    let id = app.submit(&small()).await;
    let job = app.ended(&id).await;
    assert_eq!((state(&job), &job["attempt"]), ("succeeded", &json!(1)), "{job}");
}

#[tokio::test]
async fn outputs_expire_when_they_are_told_to() {
    let folder = tempfile::tempdir().expect("folder");
    let app = App::start_with(folder.path(), &[("SHRINKD_RETENTION__OUTPUTS_S", "2")]);
    let id = app.submit(&small()).await;
    assert_eq!(state(&app.ended(&id).await), "succeeded");
    let path = format!("/v1/jobs/{id}/outputs/glb");
    assert!(app.get(&path).await.status().is_success());
    tokio::time::sleep(Duration::from_millis(2100)).await;
    problem(app.get(&path).await, 410, "output_expired").await;
    assert_eq!(state(&app.get_json(&format!("/v1/jobs/{id}")).await), "succeeded", "the job is remembered");
}
