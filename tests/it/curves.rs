//! Two-dimensional fields: over HTTP, on the command line, and as good as they were.

use crate::app::{App, BINARY, state};
use crate::losses::{Losses, count, number};
use reqwest::StatusCode;
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

fn scenes() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("examples/scenes/2d")
}

fn scene(name: &str) -> Value {
    let bytes = std::fs::read(scenes().join(format!("{name}.json"))).expect("reads");
    serde_json::from_slice(&bytes).expect("JSON")
}

fn names(job: &Value) -> Vec<&str> {
    job["outputs"].as_array().expect("a list").iter().map(|o| o["name"].as_str().expect("a name")).collect()
}

#[tokio::test]
async fn a_planar_scene_goes_in_and_a_curve_comes_out() {
    let folder = tempfile::tempdir().expect("folder");
    let app = App::start(folder.path());
    let outputs = ["glb", "surface", "svg", "preview", "report"];
    let request = json!({"field": {"scene": scene("gear")}, "shrink": {"samples": 600}, "outputs": outputs});
    let id = app.submit(&request).await;
    let job = app.ended(&id).await;
    assert_eq!(state(&job), "succeeded", "{job}");
    let metrics = &job["metrics"];
    assert_eq!((&metrics["dimension"], &metrics["vertices"]), (&json!(2), &json!(600)));
    assert_eq!(
        (&metrics["closed"], &metrics["simple"], &metrics["turning_number"]),
        (&json!(true), &json!(true), &json!(1))
    );
    assert_eq!((&metrics["self_intersections"], &metrics["corners"]), (&json!(0), &json!(48)));
    assert!(metrics["distance"]["max"].as_f64().expect("a number") < 1e-6, "{metrics}");
    assert!(metrics["arc_length"]["deviation_max"].as_f64().expect("a number") < 1e-3, "{metrics}");
    assert_eq!(names(&job), outputs);
    for (name, magic, media_type) in [
        ("glb", b"glTF".as_slice(), "model/gltf-binary"),
        ("surface", b"", "application/octet-stream"),
        ("svg", b"<svg", "image/svg+xml"),
        ("preview", b"\x89PNG", "image/png"),
        ("report", b"{", "application/json"),
    ] {
        let response = app.get(&format!("/v1/jobs/{id}/outputs/{name}")).await;
        assert_eq!(response.status(), StatusCode::OK);
        assert_eq!(response.headers()["content-type"], media_type);
        let bytes = response.bytes().await.expect("bytes");
        assert!(bytes.starts_with(magic), "{name}");
        if name == "report" {
            assert_eq!(&serde_json::from_slice::<Value>(&bytes).expect("JSON"), metrics);
        }
        if name == "surface" {
            let file = safetensors::SafeTensors::deserialize(&bytes).expect("safetensors");
            assert_eq!(file.tensor("positions").expect("is there").shape(), [600, 2]);
            assert_eq!(file.tensor("curvature").expect("is there").shape(), [600]);
        }
    }
}

#[tokio::test]
async fn a_planar_field_alone_is_a_good_job_from_a_scene_and_from_an_input() {
    let folder = tempfile::tempdir().expect("folder");
    let app = App::start(folder.path());
    let bytes = serde_json::to_vec(&scene("letter_s")).expect("JSON");
    let input: Value = app
        .request(reqwest::Method::POST, "/v1/inputs")
        .body(bytes)
        .send()
        .await
        .expect("an answer")
        .json()
        .await
        .expect("JSON");
    for field in [json!({"scene": scene("letter_s")}), json!({"input": input["id"]})] {
        let job = app.ended(&app.submit(&json!({ "field": field })).await).await;
        assert_eq!(state(&job), "succeeded", "{job}");
        assert_eq!(names(&job), ["glb", "svg", "preview", "report"]);
        assert_eq!(job["metrics"]["vertices"], 200, "as many as the default lattice has columns");
    }
    let estimate = app.post("/v1/jobs?validate_only=true", &json!({"field": {"input": input["id"]}})).await;
    assert_eq!(estimate.json::<Value>().await.expect("JSON")["vertices"], 200);
}

#[tokio::test]
async fn what_only_curves_have_is_refused_of_a_surface_by_its_place() {
    let folder = tempfile::tempdir().expect("folder");
    let app = App::start(folder.path());
    let ball = json!({"scene": {"sphere": {"radius": 0.5}}});
    let request = json!({"field": ball, "shrink": {"samples": 100}, "outputs": ["glb", "svg"]});
    let response = app.post("/v1/jobs", &request).await;
    assert_eq!(response.status(), StatusCode::UNPROCESSABLE_ENTITY);
    let problem: Value = response.json().await.expect("JSON");
    let places: Vec<&str> =
        problem["errors"].as_array().expect("a list").iter().map(|e| e["pointer"].as_str().expect("text")).collect();
    assert_eq!(places, ["/outputs/1", "/shrink/samples"], "{problem}");
}

#[tokio::test]
async fn planar_shapes_that_are_no_loop_fail_with_number_and_places() {
    let folder = tempfile::tempdir().expect("folder");
    let app = App::start(folder.path());
    let disc = |x: f64| json!({"translate": {"by": [x, 0.0], "of": {"circle": {"radius": 0.3}}}});
    let two = json!({"union": {"of": [disc(-0.5), disc(0.5)]}});
    let ring = json!({"shell": {"thickness": 0.1, "of": {"circle": {"radius": 0.5}}}});
    for (scene, code, places) in [(two, "components", 2), (ring, "genus", 1)] {
        let job = app.ended(&app.submit(&json!({"field": {"scene": scene}})).await).await;
        assert_eq!((state(&job), &job["problem"]["code"]), ("failed", &json!(code)), "{job}");
        assert_eq!(job["problem"]["places"].as_array().map(Vec::len), Some(places), "{job}");
    }
    // eight samples cannot follow a letter
    let job = json!({"field": {"scene": scene("letter_s")}, "shrink": {"samples": 8}});
    let job = app.ended(&app.submit(&job).await).await;
    assert_eq!((state(&job), &job["problem"]["code"]), ("failed", &json!("not_certified")), "{job}");
    assert!(!job["problem"]["places"].as_array().expect("places").is_empty(), "{job}");
}

fn extract(folder: &Path, field: &Path, further: &[&str]) -> Output {
    Command::new(BINARY)
        .arg("extract")
        .arg(field)
        .arg("-o")
        .arg(folder.join("out.glb"))
        .args(further)
        .output()
        .expect("runs")
}

#[test]
fn extract_of_a_planar_scene_writes_every_file_it_was_asked_for() {
    let folder = tempfile::tempdir().expect("folder");
    let path = |name: &str| -> String { folder.path().join(name).to_string_lossy().into_owned() };
    let (report, preview, surface, svg) = (path("r.json"), path("p.png"), path("s.safetensors"), path("c.svg"));
    let files = ["--report", &report, "--preview", &preview, "--surface", &surface, "--svg", &svg, "--samples", "500"];
    let output = extract(folder.path(), &scenes().join("letter_g.json"), &files);
    assert_eq!(output.status.code(), Some(0), "{}", String::from_utf8_lossy(&output.stderr));
    assert!(String::from_utf8_lossy(&output.stdout).contains("500 samples"));
    assert!(std::fs::read(path("out.glb")).expect("reads").starts_with(b"glTF"));
    assert!(std::fs::read(&preview).expect("reads").starts_with(b"\x89PNG"));
    assert!(std::fs::read_to_string(&svg).expect("reads").starts_with("<svg"));
    assert!(std::fs::metadata(&surface).expect("is there").len() > 500 * 8);
    let report: Value = serde_json::from_slice(&std::fs::read(&report).expect("reads")).expect("JSON");
    assert_eq!(report["vertices"], 500);

    let ball = folder.path().join("ball.json");
    std::fs::write(&ball, r#"{"sphere": {"radius": 0.5}}"#).expect("writes");
    assert_eq!(extract(folder.path(), &ball, &["--samples", "500"]).status.code(), Some(2));
}

/// What is stored of a curve.
#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Metrics {
    vertices: u64,
    corners: u64,
    distance_mean: f64,
    distance_max: f64,
    normal_consistency: f64,
    arc_length_deviation: f64,
    evaluations_per_vertex: f64,
}

/// How much worse a figure may get, relative; the count of evaluations follows decisions that rounding may turn.
const WORSE: f64 = 0.05;
/// Distances and deviations below this are what single precision makes of none.
const NOISE: f64 = 1e-6;

impl Metrics {
    fn of(report: &Value) -> Self {
        Self {
            vertices: count(report, "/vertices"),
            corners: count(report, "/corners"),
            distance_mean: number(report, "/distance/mean"),
            distance_max: number(report, "/distance/max"),
            normal_consistency: number(report, "/normal_consistency"),
            arc_length_deviation: number(report, "/arc_length/deviation_max"),
            evaluations_per_vertex: number(report, "/evaluations/per_vertex"),
        }
    }

    /// What got worse.
    fn losses(&self, stored: &Metrics) -> Vec<String> {
        let mut losses = Losses::default();
        let limit = |stored: f64| stored * (1.0 + WORSE) + NOISE;
        losses.at_most("mean distance", self.distance_mean, limit(stored.distance_mean));
        losses.at_most("largest distance", self.distance_max, limit(stored.distance_max));
        losses.at_most("1 - NC", 1.0 - self.normal_consistency, limit(1.0 - stored.normal_consistency));
        losses.at_most("arc length deviation", self.arc_length_deviation, limit(stored.arc_length_deviation) + 1e-5);
        losses.at_most("evaluations", self.evaluations_per_vertex, limit(stored.evaluations_per_vertex));
        if (self.vertices, self.corners) != (stored.vertices, stored.corners) {
            losses.0.push(format!("{} vertices and {} corners", self.vertices, self.corners));
        }
        losses.0
    }
}

/// Renewed, like the others, by `SHRINKD_RENEW_METRICS=1 cargo test --release --test it curves`.
#[test]
fn curves_are_as_good_as_the_stored_metrics() {
    let renew = std::env::var_os("SHRINKD_RENEW_METRICS").is_some();
    let stored_in = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/metrics/2d");
    let mut fields: Vec<PathBuf> =
        std::fs::read_dir(scenes()).expect("scenes").map(|entry| entry.expect("reads").path()).collect();
    fields.sort();
    assert!(fields.len() >= 6, "the example scenes are there");
    let mut losses = Vec::new();
    for field in fields {
        let folder = tempfile::tempdir().expect("folder");
        let report = folder.path().join("report.json");
        let files = ["--report", &report.to_string_lossy(), "--samples", "400", "--threads", "1"];
        let output = extract(folder.path(), &field, &files);
        println!("{}", String::from_utf8_lossy(&output.stdout).trim_end());
        let name = field.file_name().expect("a name").to_string_lossy().into_owned();
        if !output.status.success() {
            losses.push(format!("{name}: {}", String::from_utf8_lossy(&output.stderr)));
            continue;
        }
        let report: Value = serde_json::from_slice(&std::fs::read(&report).expect("reads")).expect("JSON");
        let (found, path) = (Metrics::of(&report), stored_in.join(&name));
        if renew {
            std::fs::create_dir_all(&stored_in).expect("a folder");
            std::fs::write(&path, serde_json::to_string_pretty(&found).expect("JSON") + "\n").expect("writes");
        } else {
            let stored = serde_json::from_slice(&std::fs::read(&path).expect("stored metrics")).expect("JSON");
            losses.extend(found.losses(&stored).into_iter().map(|loss| format!("{name}: {loss}")));
        }
    }
    assert!(losses.is_empty(), "{}", losses.join("\n"));
}
