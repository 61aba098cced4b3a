//! A full disk: nothing that was accepted is lost, nothing is half-written, and it is over when there is space again.

use crate::app::{App, problem, small, state};
use reqwest::StatusCode;
use serde_json::Value;
use sha2::{Digest, Sha256};
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Duration;

/// Builds what makes the disk full; it is preloaded into the service.
fn full_disk(folder: &Path) -> PathBuf {
    let source = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/support/full_disk.c");
    let library = folder.join("full_disk.so");
    let mut compiler = Command::new("cc");
    compiler.args(["-shared", "-fPIC", "-O1", "-o"]).arg(&library).arg(source).arg("-ldl");
    let built = compiler.output().expect("there is a C compiler, which the service is built with");
    assert!(built.status.success(), "{}", String::from_utf8_lossy(&built.stderr));
    library
}

/// Downloads everything that a job promises, and checks that it is whole.
async fn is_whole(app: &App, job: &Value) {
    for output in job["outputs"].as_array().expect("a list") {
        let answer = app.get(output["href"].as_str().expect("a place")).await;
        assert_eq!(answer.status(), StatusCode::OK, "{output}");
        let bytes = answer.bytes().await.expect("bytes");
        let hash: String = Sha256::digest(&bytes).iter().map(|b| format!("{b:02x}")).collect();
        assert_eq!(output["sha256"], *hash);
    }
}

#[tokio::test]
async fn a_full_disk_loses_nothing() {
    let folder = tempfile::tempdir().expect("folder");
    let (library, flag) = (full_disk(folder.path()), folder.path().join("full"));
    let preloaded = [
        ("LD_PRELOAD", library.to_str().expect("text")),
        ("FULL_DISK_WHILE", flag.to_str().expect("text")),
        ("SHRINKD_WORKER__LEASE_S", "2"),
        ("SHRINKD_WORKER__MAX_LOSSES", "1000"),
    ];
    let data = folder.path().join("data");
    let app = App::start_with(&data, &preloaded);
    let before = app.submit(&small()).await;
    let before = app.ended(&before).await;
    assert_eq!(state(&before), "succeeded", "{before}");

    // long enough to be in the middle when the disk fills up
    let mut lengthy = small();
    lengthy["shrink"]["lattice"]["latlong"] = serde_json::json!({"n_theta": 120, "n_phi": 60});
    let running = app.submit(&lengthy).await;
    app.running(&running).await;
    let mut waiting = Vec::new();
    for _ in 0..3 {
        waiting.push(app.submit(&lengthy).await);
    }
    std::fs::write(&flag, "").expect("writes");
    problem(app.post("/v1/jobs", &small()).await, 503, "engine_unavailable").await;
    let upload = app.request(reqwest::Method::POST, "/v1/inputs").body(r#"{"sphere": {"radius": 0.123}}"#).send().await;
    problem(upload.expect("an answer"), 503, "blobs_unavailable").await;
    let ready = app.get("/readyz").await;
    assert_eq!(ready.status(), StatusCode::SERVICE_UNAVAILABLE);
    assert!(app.get("/livez").await.status().is_success());
    is_whole(&app, &before).await;
    // leases run out and computations come to their end meanwhile
    tokio::time::sleep(Duration::from_secs(5)).await;
    for id in waiting.iter().chain([&running]) {
        let job = app.get_json(&format!("/v1/jobs/{id}")).await;
        is_whole(&app, &job).await;
    }
    std::fs::remove_file(&flag).expect("removes");

    for id in waiting.iter().chain([&running]) {
        let job = app.ended(id).await;
        assert_eq!(state(&job), "succeeded", "{job}");
        is_whole(&app, &job).await;
    }
    assert!(app.get("/readyz").await.status().is_success());
    let listed = app.get_json("/v1/jobs").await["jobs"].as_array().expect("a list").len();
    assert_eq!(listed, 5, "what was refused is not there");
    let after = app.submit(&small()).await;
    is_whole(&app, &app.ended(&after).await).await;

    // and killed in the middle of it
    let last = app.submit(&lengthy).await;
    app.running(&last).await;
    std::fs::write(&flag, "").expect("writes");
    tokio::time::sleep(Duration::from_secs(1)).await;
    app.kill();
    std::fs::remove_file(&flag).expect("removes");
    let app = App::start_with(&data, &preloaded);
    let job = app.ended(&last).await;
    assert_eq!(state(&job), "succeeded", "{job}");
    is_whole(&app, &job).await;
}
