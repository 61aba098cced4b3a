//! The backup of docs/operations.md, carried out while the service works, and put back.

use crate::app::{App, endless, small, state};
use crate::tenants::{ask, keys};
use reqwest::Method;
use serde_json::Value;
use std::path::Path;
use std::process::Command;

fn run(program: &str, arguments: &[&str]) {
    let status = Command::new(program).args(arguments).status().unwrap_or_else(|e| panic!("{program}: {e}"));
    assert!(status.success(), "{program} {arguments:?}");
}

/// As docs/operations.md says: the databases by SQLite, then the blobs.
fn back_up(data: &Path, backup: &Path) {
    let (data, backup) = (data.display(), backup.display());
    for name in ["shrinkd", "keys"] {
        let copy = format!(
            "import sqlite3; sqlite3.connect(\"{data}/{name}.sqlite3\").backup(sqlite3.connect(\"{backup}/{name}.sqlite3\"))"
        );
        run("python3", &["-c", &copy]);
    }
    run("cp", &["-a", &format!("{data}/blobs"), &format!("{backup}/")]);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_was_backed_up_under_load_is_whole_when_it_is_put_back() {
    let (data, backup) = (tempfile::tempdir().expect("folder"), tempfile::tempdir().expect("folder"));
    let app = App::start_with(data.path(), &[("SHRINKD_WORKER__SLOTS", "1")]);
    let [key, revoked] = [(); 2].map(|()| keys(data.path(), &["create", "--tenant", "default"]));
    keys(data.path(), &["revoke", revoked.split('_').nth(1).expect("an id")]);
    let mut ended = Vec::new();
    for _ in 0..3 {
        let id = app.submit(&small()).await;
        app.ended(&id).await;
        ended.push(id);
    }
    let (running, queued) = (app.submit(&endless()).await, app.submit(&small()).await);
    app.running(&running).await;
    tokio::task::block_in_place(|| back_up(data.path(), backup.path()));
    // what comes after the copy is not in it, and what ends after it has not ended there
    let later = app.submit(&small()).await;
    let later_key = keys(data.path(), &["create", "--tenant", "default"]);
    let glb = async |app: &App, id: &str| {
        app.get(&format!("/v1/jobs/{id}/outputs/glb"))
            .await
            .error_for_status()
            .expect("is there")
            .bytes()
            .await
            .expect("whole")
    };
    let mut before = Vec::new();
    for id in &ended {
        before.push((app.get_json(&format!("/v1/jobs/{id}")).await, glb(&app, id).await));
    }
    app.kill();

    let app = App::start(backup.path());
    for (id, (job, bytes)) in ended.iter().zip(before) {
        assert_eq!(app.get_json(&format!("/v1/jobs/{id}")).await, job);
        assert_eq!(glb(&app, id).await, bytes, "the outputs are there, and the same");
    }
    assert_eq!(app.get(&format!("/v1/jobs/{later}")).await.status(), 404);
    assert_eq!(state(&app.ended(&queued).await), "succeeded", "what waited in the copy runs");
    let again: Value = app.running(&running).await;
    assert_eq!((state(&again), again["attempt"].as_u64()), ("running", Some(2)), "what ran in the copy runs again");
    app.kill();

    let app = App::start_with(backup.path(), &[("SHRINKD_AUTH__MODE", "required")]);
    let path = format!("/v1/jobs/{}", ended[0]);
    for (key, status) in [(&key, 200), (&revoked, 401), (&later_key, 401)] {
        assert_eq!(ask(&app, key, Method::GET, &path, b"").await.status(), status);
    }
}
