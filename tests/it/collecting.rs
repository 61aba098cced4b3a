//! What a running service removes by itself, and what it keeps.

use crate::app::{App, endless, problem, small, state};
use crate::monitoring::scrape;
use crate::tenants::eventually;
use reqwest::{Method, StatusCode};
use serde_json::{Value, json};
use std::path::Path;
use std::time::{Duration, SystemTime};

/// Longer than anything is kept that no job names.
const OLD: Duration = Duration::from_secs(3 * 60 * 60);

/// Makes every file of a folder look as if it was written so long ago.
fn age(folder: &Path, by: Duration) {
    for entry in std::fs::read_dir(folder).expect("folder").map(|entry| entry.expect("entry").path()) {
        if entry.is_dir() {
            age(&entry, by);
        } else {
            let file = std::fs::File::options().write(true).open(&entry).expect("opens");
            file.set_modified(SystemTime::now() - by).expect("sets the time");
        }
    }
}

/// Files in a folder, at any depth; none where there is no folder.
fn files(folder: &Path) -> usize {
    let Ok(entries) = std::fs::read_dir(folder) else { return 0 };
    entries.map(|entry| entry.expect("entry").path()).map(|path| if path.is_dir() { files(&path) } else { 1 }).sum()
}

async fn upload(app: &App, scene: &Value) -> String {
    let response = app.request(Method::POST, "/v1/inputs").body(scene.to_string()).send().await.expect("an answer");
    assert_eq!(response.status(), StatusCode::CREATED);
    response.json::<Value>().await.expect("JSON")["id"].as_str().expect("a name").to_owned()
}

#[tokio::test]
async fn a_running_service_removes_what_has_expired_and_what_nobody_came_to_use() {
    let folder = tempfile::tempdir().expect("folder");
    let retention = [
        ("SHRINKD_RETENTION__OUTPUTS_S", "1"),
        ("SHRINKD_RETENTION__INPUTS_S", "3600"),
        ("SHRINKD_RETENTION__EVERY_S", "1"),
        ("SHRINKD_WORKER__THREADS", "1"),
    ];
    let app = App::start_with(folder.path(), &retention);
    let unused = upload(&app, &json!({"sphere": {"radius": 0.25}})).await;
    let used = upload(&app, &json!({"ellipsoid": {"radii": [0.8, 0.6, 0.4]}})).await;
    let ended = app.submit(&small()).await;
    assert_eq!(state(&app.ended(&ended).await), "succeeded");
    let mut request = endless();
    request["field"] = json!({"input": used});
    let running = app.submit(&request).await;
    assert_eq!(state(&app.running(&running).await), "running");

    let blobs = folder.path().join("blobs");
    let stored = files(&blobs.join("sha256"));
    assert_eq!(stored, 5, "two inputs, and three outputs");
    let collected = async || scrape(&app).await["shrinkd_blobs_collected_total"];
    assert_eq!(collected().await, 0.0, "all of them are young");
    age(&blobs, OLD);
    eventually("the counter has gone up", async || collected().await >= 4.0).await;
    assert_eq!(files(&blobs.join("sha256")), 1, "only the input of the job that runs is left");
    assert!(app.log().contains("what no job names any more was removed"), "{}", app.log());
    problem(app.get(&format!("/v1/inputs/{unused}")).await, 404, "unknown_input").await;
    problem(app.get(&format!("/v1/jobs/{ended}/outputs/glb")).await, 410, "output_expired").await;
    assert_eq!(state(&app.get_json(&format!("/v1/jobs/{ended}")).await), "succeeded", "the job is remembered");
    assert_eq!(app.get(&format!("/v1/inputs/{used}")).await.status(), StatusCode::OK);
    assert_eq!(collected().await, 4.0, "each was counted once");
}
