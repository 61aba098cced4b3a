//! `/metrics`: what it tells is what is documented, and counts what happens.

use crate::app::{App, PATIENCE, endless, fixture, small};
use reqwest::{Method, StatusCode};
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

/// The samples of a scrape, by name and labels as they are written.
pub async fn scrape(app: &App) -> BTreeMap<String, f64> {
    let response = app.get("/metrics").await;
    assert_eq!(response.status(), StatusCode::OK);
    assert!(response.headers()["content-type"].to_str().expect("text").starts_with("text/plain; version=0.0.4"));
    samples(&response.text().await.expect("text"))
}

pub fn samples(text: &str) -> BTreeMap<String, f64> {
    let lines = text.lines().filter(|line| !line.is_empty() && !line.starts_with('#'));
    lines
        .map(|line| {
            let (series, value) = line.rsplit_once(' ').expect("a sample");
            (series.to_owned(), value.parse().expect("a number"))
        })
        .collect()
}

/// The metrics and their kinds, as a scrape describes them.
fn described(text: &str) -> BTreeSet<(String, String)> {
    let types = text.lines().filter_map(|line| line.strip_prefix("# TYPE ")?.split_once(' '));
    types.map(|(name, kind)| (name.to_owned(), kind.to_owned())).collect()
}

fn documented() -> BTreeSet<(String, String)> {
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("docs/monitoring.md");
    let text = std::fs::read_to_string(file).expect("reads");
    let rows = text.lines().filter_map(|line| line.strip_prefix("| `")?.split_once("` | "));
    rows.map(|(name, rest)| (name.to_owned(), rest.split(" |").next().unwrap_or_default().to_owned())).collect()
}

#[tokio::test]
async fn a_running_service_tells_what_is_documented_and_nothing_else() {
    let folder = tempfile::tempdir().expect("folder");
    let app = App::start(folder.path());
    // everything that is counted happens once
    let upload = app.request(Method::POST, "/v1/inputs").body(fixture("networks/blob.safetensors"));
    assert_eq!(upload.send().await.expect("an answer").status(), StatusCode::CREATED);
    let id = app.submit(&small()).await;
    crate::walk::follow(&app, &id, Some(0)).await;
    let glb = app.get(&format!("/v1/jobs/{id}/outputs/glb")).await.bytes().await.expect("bytes");
    assert_eq!(app.get("/v1/nothing").await.status(), StatusCode::NOT_FOUND);

    // the worker counts an attempt once its end is stored, which is when readers hear of it
    let ran = r#"shrinkd_job_run_duration_seconds_count{kind="shrink",outcome="succeeded"}"#;
    crate::tenants::eventually("the attempt is counted", async || {
        samples(&app.get("/metrics").await.text().await.expect("text")).get(ran) == Some(&1.0)
    })
    .await;
    let text = app.get("/metrics").await.text().await.expect("text");
    assert_eq!(described(&text), documented());
    let told = samples(&text);
    let at = |series: &str| *told.get(series).unwrap_or_else(|| panic!("no {series} in\n{text}"));
    assert_eq!(at(r#"shrinkd_jobs{kind="shrink",state="queued"}"#), 0.0);
    assert_eq!(at("shrinkd_oldest_queued_job_age_seconds"), 0.0);
    assert_eq!(at("shrinkd_engine_connected"), 1.0);
    assert_eq!(at(r#"shrinkd_job_accept_duration_seconds_count{kind="shrink"}"#), 1.0);
    assert_eq!(at(r#"shrinkd_job_wait_duration_seconds_count{kind="shrink"}"#), 1.0);
    assert_eq!(at(r#"shrinkd_job_run_duration_seconds_count{kind="shrink",outcome="succeeded"}"#), 1.0);
    let report = &app.get_json(&format!("/v1/jobs/{id}")).await["metrics"];
    for asked in ["value", "gradient"] {
        let spent = report["evaluations"][asked].as_f64().expect("a number");
        assert_eq!(at(&format!("shrinkd_field_evaluations_total{{of=\"{asked}\"}}")), spent);
    }
    assert_eq!(at("shrinkd_vertices_total"), report["vertices"].as_f64().expect("a number"));
    assert_eq!(at("shrinkd_worker_slots"), 2.0);
    assert_eq!(at("shrinkd_pool_threads"), 2.0);
    assert_eq!(at(r#"shrinkd_http_requests_total{method="POST",route="/v1/jobs",status="202"}"#), 1.0);
    assert_eq!(at(r#"shrinkd_http_requests_total{method="GET",route="none",status="404"}"#), 1.0);
    assert_eq!(at(r#"shrinkd_sse_events_total{type="done"}"#), 1.0);
    assert_eq!(at(r#"shrinkd_download_bytes_total{output="glb"}"#), glb.len() as f64);
    assert_eq!(at("shrinkd_upload_bytes_total"), fixture("networks/blob.safetensors").len() as f64);
    assert!(at(r#"shrinkd_blob_operation_duration_seconds_count{operation="put",outcome="ok"}"#) >= 4.0);
    assert!(at(r#"shrinkd_engine_call_duration_seconds_count{call="submit",outcome="ok"}"#) >= 1.0);
    assert!(at("process_resident_memory_bytes") > 1e6 && at("process_cpu_seconds_total") > 0.0);
    let ids = told.keys().find(|series| series.contains(&id));
    assert_eq!(ids, None, "no id is a label");
}

#[tokio::test]
async fn what_is_there_now_is_counted_while_it_is_there() {
    let folder = tempfile::tempdir().expect("folder");
    let app = App::start_with(folder.path(), &[("SHRINKD_WORKER__SLOTS", "1")]);
    let running = app.submit(&endless()).await;
    app.running(&running).await;
    let queued = app.submit(&endless()).await;
    let mut stream = app.get(&format!("/v1/jobs/{queued}/events")).await;
    assert!(stream.chunk().await.expect("a frame").is_some());
    let told = scrape(&app).await;
    for (series, value) in [
        (r#"shrinkd_jobs{kind="shrink",state="queued"}"#, 1.0),
        (r#"shrinkd_jobs{kind="shrink",state="running"}"#, 1.0),
        ("shrinkd_worker_running_jobs", 1.0),
        ("shrinkd_sse_clients", 1.0),
    ] {
        assert_eq!(told.get(series), Some(&value), "{series}");
    }
    drop(stream);
    for id in [queued, running] {
        app.post(&format!("/v1/jobs/{id}/cancel"), &serde_json::json!({})).await;
        app.ended(&id).await;
    }
    // the server learns of a client that is gone when it sends, and looks at the engine once in a second
    let clock = std::time::Instant::now();
    loop {
        let told = scrape(&app).await;
        let left: f64 = told.iter().filter(|(series, _)| series.starts_with("shrinkd_jobs{")).map(|(_, v)| v).sum();
        let gone = [told["shrinkd_worker_running_jobs"], told["shrinkd_sse_clients"], left] == [0.0; 3];
        if gone {
            break;
        }
        assert!(clock.elapsed() < PATIENCE, "{told:?}");
        tokio::time::sleep(std::time::Duration::from_millis(100)).await;
    }
}

#[tokio::test]
async fn metrics_may_be_served_apart() {
    let folder = tempfile::tempdir().expect("folder");
    let app = App::start_with(folder.path(), &[("SHRINKD_METRICS_LISTEN", "127.0.0.1:0")]);
    let log = app.log();
    let line = log.lines().find(|line| line.contains("serving metrics")).expect("a line");
    let line: serde_json::Value = serde_json::from_str(line).expect("JSON");
    let apart = format!("http://{}", line["http.address"].as_str().expect("an address"));
    let text = app.client.get(format!("{apart}/metrics")).send().await.expect("an answer").text().await.expect("text");
    assert!(text.contains("shrinkd_build_info"), "{text}");
    assert_eq!(app.client.get(format!("{apart}/v1/jobs")).send().await.expect("an answer").status(), 404);
    crate::app::problem(app.get("/metrics").await, 404, "unknown_route").await;
}

/// A file of the repository.
fn file(path: &str) -> String {
    std::fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join(path)).expect("reads")
}

/// The metrics that a text names.
fn named(text: &str) -> BTreeSet<String> {
    let words = text.split(|c: char| !c.is_ascii_alphanumeric() && c != '_');
    words.filter(|word| word.starts_with("shrinkd_") || word.starts_with("process_")).map(str::to_owned).collect()
}

#[test]
fn the_dashboard_and_the_alarms_know_only_metrics_that_there_are() {
    let mut known = BTreeSet::new();
    for (name, kind) in documented() {
        match kind.as_str() {
            "histogram" => known.extend(["_bucket", "_sum", "_count"].map(|series| format!("{name}{series}"))),
            _ => drop(known.insert(name)),
        }
    }
    let dashboard: serde_json::Value = serde_json::from_str(&file("docker/grafana/shrinkd.json")).expect("JSON");
    let mut shown = BTreeSet::new();
    let panels = dashboard["panels"].as_array().expect("panels");
    let targets = panels.iter().filter(|panel| panel["type"] != "row");
    for target in targets.flat_map(|panel| panel["targets"].as_array().expect("targets")) {
        let metrics = named(target["expr"].as_str().expect("an expression"));
        assert!(!metrics.is_empty(), "{target}");
        shown.extend(metrics);
    }
    assert_eq!(shown.difference(&known).collect::<Vec<_>>(), Vec::<&String>::new(), "on the dashboard");
    // every one of them is worth a look
    let unseen: Vec<_> = documented()
        .into_iter()
        .filter(|(name, _)| !shown.iter().any(|series| series.strip_prefix(name.as_str()).is_some_and(is_series)))
        .collect();
    assert_eq!(unseen, [], "not on the dashboard");
    let alarms = file("docker/prometheus/alerts.yml");
    assert_eq!(named(&alarms).difference(&known).collect::<Vec<_>>(), Vec::<&String>::new(), "in the alarms");
}

fn is_series(suffix: &str) -> bool {
    ["", "_bucket", "_sum", "_count"].contains(&suffix)
}

#[test]
fn every_alarm_and_every_warning_at_the_start_says_what_to_do() {
    let documented = file("docs/operations.md");
    let alarms = file("docker/prometheus/alerts.yml");
    let names: Vec<&str> = alarms.lines().filter_map(|line| line.trim().strip_prefix("- alert: ")).collect();
    assert!(names.len() > 10, "{names:?}");
    // promtool, which the gate runs, sees each of them ring and not ring: an alarm that it was not told of would go unseen
    let tests = file("docker/prometheus/alerts_test.yml");
    for name in &names {
        assert!(tests.contains(&format!("- alertname: {name}\n")), "{name} is never seen to ring");
        assert!(tests.contains(&format!("- {{alertname: {name}, ")), "{name} is never seen not to ring");
    }
    for name in names {
        assert!(documented.contains(&format!("\n| `{name}` | ")), "{name} is not in docs/operations.md");
    }
    let mut warnings = 0;
    for path in ["src/cli/serve.rs", "src/engine/nats.rs", "src/engine/nats/link.rs", "src/engine/nats/layout.rs"] {
        for call in file(path).split("warn!(").skip(1) {
            // fields come first, and none of them holds a text
            let message = call.split('"').nth(1).expect("a message");
            // that of a stop, or about a single job
            // (those of settings are looked at below)
            if ["stopped before", "could not", "a job that waits", "{warning}"]
                .iter()
                .any(|other| message.contains(other))
            {
                continue;
            }
            warnings += 1;
            let plain = |text: &str| text.replace('`', "").replace("|  ", "| ").replace("  |", " |");
            let row = plain(&format!("\n| {message} | "));
            assert!(plain(&documented).contains(&row), "{path}: {message:?} is not explained");
        }
    }
    for warning in
        file("src/config/warnings.rs").split("#[cfg(test)]").next().expect("the code").split('"').skip(1).step_by(2)
    {
        let Some((settings, _)) = warning.split_once(": ") else { continue };
        warnings += 1;
        let row = format!("\n| `{settings}: …` | ");
        assert!(documented.contains(&row), "{row:?} is not in docs/operations.md");
    }
    assert!(warnings >= 20, "{warnings}");
}
