//! What a start is refused for, and what a node answers that does only a part of the work.

use crate::app::{App, BINARY, problem, small};
use crate::cluster::nats_server::NatsServer;
use reqwest::StatusCode;
use serde_json::Value;
use std::path::Path;
use std::process::{Command, Output, Stdio};

/// A start that is expected to end by itself.
fn refused(folder: &Path, arguments: &[&str]) -> Output {
    let mut command = Command::new(BINARY);
    command.args(["serve", "--listen", "127.0.0.1:0", "--data"]).arg(folder).args(arguments).stdin(Stdio::null());
    command.output().expect("runs")
}

#[test]
fn a_node_with_a_part_of_the_work_needs_an_engine_that_others_reach() {
    let folder = tempfile::tempdir().expect("folder");
    for role in ["api", "worker"] {
        for arguments in [&["--role", role][..], &["--role", role, "--engine", "sqlite"]] {
            let output = refused(folder.path(), arguments);
            let said = String::from_utf8_lossy(&output.stderr).into_owned();
            assert_eq!(output.status.code(), Some(2), "{arguments:?}: {said}");
            assert!(said.contains("role api or worker needs an engine") && said.contains("nats://"), "{said}");
        }
    }
    let left = std::fs::read_dir(folder.path()).expect("folder").count();
    assert_eq!(left, 0, "nothing was begun");
    let unknown = refused(folder.path(), &["--role", "manager"]);
    assert_eq!(unknown.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&unknown.stderr).contains("manager"), "{unknown:?}");
}

#[test]
fn a_folder_of_a_newer_program_is_refused_and_says_so() {
    let folder = tempfile::tempdir().expect("folder");
    let database = folder.path().join("shrinkd.sqlite3");
    let connection = rusqlite::Connection::open(&database).expect("opens");
    connection.pragma_update(None, "user_version", 999).expect("writes");
    drop(connection);
    let output = refused(folder.path(), &[]);
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(1), "{said}");
    assert!(said.contains("version 999") && said.contains("newer than this program"), "{said}");
    let connection = rusqlite::Connection::open(&database).expect("opens");
    let tables = "SELECT COUNT(*) FROM sqlite_schema";
    let tables: u32 = connection.query_row(tables, [], |row| row.get(0)).expect("reads");
    assert_eq!(tables, 0, "nothing was made in it");
}

#[tokio::test]
async fn a_node_that_only_runs_jobs_answers_whether_it_lives_and_what_it_measures() {
    let Some(server) = NatsServer::start() else { return };
    let folder = tempfile::tempdir().expect("folder");
    let engine = server.url();
    // it asks nobody, whatever the others do
    let variables = [("SHRINKD_ENGINE", &*engine), ("SHRINKD_ROLE", "worker"), ("SHRINKD_AUTH__MODE", "required")];
    let app = App::start_with(folder.path(), &variables);
    for path in ["/livez", "/readyz"] {
        let health: Value = app.get_json(path).await;
        assert_eq!(health["status"], "ok", "{path}");
    }
    let metrics = app.get("/metrics").await;
    assert_eq!(metrics.status(), StatusCode::OK);
    let slots = crate::monitoring::samples(&metrics.text().await.expect("text"))["shrinkd_worker_slots"];
    assert_eq!(slots, 2.0);
    for path in ["/v1/jobs", "/v1/jobs/01a204bd-6753-7535-9d12-52ce14175322", "/openapi.json", "/"] {
        problem(app.get(path).await, 404, "unknown_route").await;
    }
    problem(app.post("/v1/jobs", &small()).await, 404, "unknown_route").await;
    problem(app.post("/livez", &small()).await, 405, "method_not_allowed").await;
}
