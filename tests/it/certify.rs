//! Certificates: a surface that passes says so wherever it goes, and one that does not is no success.

use crate::app::{App, BINARY, problem, small, state};
use crate::walk::follow;
use serde_json::{Value, json};
use std::path::{Path, PathBuf};
use std::process::Command;

/// A comb, whose eight long teeth the eighteen vertices of the coarsest octahedral lattice cannot follow.
fn hopeless() -> Value {
    let bar = |from: [f64; 2], to: [f64; 2]| json!({"capsule": {"from": [from[0], from[1], 0], "to": [to[0], to[1], 0], "radius": 0.05}});
    let teeth = (0..8).map(|k| 0.22 * f64::from(k) - 0.77).map(|y| bar([-0.8, y], [0.8, y]));
    let bars: Vec<Value> = teeth.chain([bar([-0.8, -0.77], [-0.8, 0.77])]).collect();
    json!({"union": {"of": bars}})
}

/// The root extras of a GLB.
fn extras(glb: &[u8]) -> Value {
    let length = u32::from_le_bytes(glb[12..16].try_into().expect("four bytes")) as usize;
    let document: Value = serde_json::from_slice(&glb[20..20 + length]).expect("JSON");
    document["extras"].clone()
}

async fn download(app: &App, job: &Value, name: &str) -> Vec<u8> {
    let output = job["outputs"].as_array().expect("a list").iter().find(|o| o["name"] == name).expect(name);
    let response = app.get(output["href"].as_str().expect("a path")).await;
    assert_eq!(response.status(), 200, "{name}");
    response.bytes().await.expect("bytes").to_vec()
}

fn certified(job: &Value) -> Vec<bool> {
    job["outputs"].as_array().expect("a list").iter().map(|o| o["certified"].as_bool().expect("told")).collect()
}

#[tokio::test]
async fn a_surface_that_passes_says_so_in_job_report_and_glb() {
    let folder = tempfile::tempdir().expect("folder");
    let app = App::start(folder.path());
    let request = json!({
        "field": {"scene": {"ellipsoid": {"radii": [0.6, 0.5, 0.4]}}},
        "shrink": {"lattice": {"octahedral": {"n": 24}}, "density": "area", "distortion": "angle"},
        "outputs": ["glb", "report"],
    });
    let id = app.submit(&request).await;
    let job = app.ended(&id).await;
    assert_eq!(state(&job), "succeeded", "{job}");
    let passed = json!({"passed": true, "faults": [], "warnings": []});
    assert_eq!((&job["metrics"]["verdict"], &job["metrics"]["attempts"]), (&passed, &json!(1)));
    assert_eq!(job["metrics"]["options"], job["shrink"]);
    assert_eq!((&job["shrink"]["density"], &job["shrink"]["distortion"]), (&json!("area"), &json!("angle")));
    assert_eq!(certified(&job), [true, true]);
    let report: Value = serde_json::from_slice(&download(&app, &job, "report").await).expect("JSON");
    assert_eq!(report["verdict"], passed);
    assert_eq!(extras(&download(&app, &job, "glb").await)["report"]["verdict"], passed);
}

#[tokio::test]
async fn a_surface_that_does_not_pass_fails_the_job_and_is_kept() {
    let folder = tempfile::tempdir().expect("folder");
    let app = App::start(folder.path());
    let request = json!({
        "field": {"scene": hopeless()},
        "shrink": {"lattice": {"octahedral": {"n": 2}}},
        "budget": {"attempts": 2},
        "outputs": ["glb", "preview", "report"],
    });
    let id = app.submit(&request).await;
    let job = app.ended(&id).await;
    assert_eq!((state(&job), &job["problem"]["code"]), ("failed", &json!("not_certified")), "{job}");
    let verdict = &job["metrics"]["verdict"];
    let faults = verdict["faults"].as_array().expect("a list");
    assert_eq!((&verdict["passed"], faults.is_empty()), (&json!(false), false));
    let detail = job["problem"]["detail"].as_str().expect("text");
    assert!(
        faults.iter().all(|f| detail.contains(f["detail"].as_str().expect("text"))),
        "the cause is named: {detail}"
    );
    assert!(!job["problem"]["places"].as_array().expect("a list").is_empty(), "and the place: {job}");
    assert_eq!(job["metrics"]["attempts"], 2);

    assert_eq!(certified(&job), [false; 3]);
    let glb = download(&app, &job, "glb").await;
    assert_eq!(&extras(&glb)["report"]["verdict"], verdict);
    assert!(download(&app, &job, "preview").await.starts_with(b"\x89PNG"));
    let response = app.get(&format!("/v1/jobs/{id}/outputs/surface")).await;
    problem(response, 404, "unknown_output").await;

    let events = follow(&app, &id, Some(0)).await;
    let progress: Vec<&Value> = events.iter().filter(|e| e.1 == "progress").map(|e| &e.2).collect();
    let fractions: Vec<f64> = progress.iter().filter_map(|p| p["fraction"].as_f64()).collect();
    assert!(fractions.is_sorted(), "{fractions:?}");
    let attempts: Vec<u64> = progress.iter().filter_map(|p| p["attempt"].as_u64()).collect();
    assert!(attempts.is_sorted() && attempts.last() == Some(&2), "a second attempt is told: {attempts:?}");
    assert_eq!(events.last().map(|e| (e.1.as_str(), state(&e.2))), Some(("done", "failed")));
}

#[tokio::test]
async fn the_baseline_is_a_success_whose_verdict_tells() {
    let folder = tempfile::tempdir().expect("folder");
    let app = App::start(folder.path());
    let mut request = small();
    request["field"]["scene"] = hopeless();
    let id = app.submit(&request).await;
    let job = app.ended(&id).await;
    assert_eq!((state(&job), &job["metrics"]["verdict"]["passed"]), ("succeeded", &json!(false)), "{job}");
    assert_eq!(job["metrics"]["attempts"], 1);
    assert!(certified(&job).iter().all(|c| !c));
}

#[tokio::test]
async fn a_shape_that_is_no_sphere_is_wrapped_when_that_is_asked_for() {
    let folder = tempfile::tempdir().expect("folder");
    let app = App::start(folder.path());
    let ball = |x: f64, r: f64| json!({"translate": {"by": [x, 0, 0], "of": {"sphere": {"radius": r}}}});
    let two = json!({"union": {"of": [ball(-0.45, 0.3), ball(0.5, 0.25)]}});
    let shell = json!({"difference": {"of": [ball(0.0, 0.6), ball(0.0, 0.4)]}});
    let torus = json!({"torus": {"major": 0.55, "minor": 0.25}});
    // scene, options, components, voids, handles, the area that may be invented
    let cases = [
        (&torus, json!({"on_topology": "wrap"}), [1, 0, 1], 0.01..0.2),
        (&two, json!({"on_topology": "wrap"}), [2, 0, 0], 0.01..0.3),
        (&two, json!({"component": "largest"}), [2, 0, 0], 0.0..1e-9),
        (&two, json!({"component": 1}), [2, 0, 0], 0.0..1e-9),
        (&shell, json!({"on_topology": "wrap"}), [1, 1, 0], 0.0..1e-9),
    ];
    for (scene, mut shrink, counts, invented) in cases {
        shrink["lattice"] = json!({"octahedral": {"n": 40}});
        let asked = shrink.clone();
        let id = app.submit(&json!({"field": {"scene": scene}, "shrink": shrink, "outputs": ["report"]})).await;
        let job = app.ended(&id).await;
        assert_eq!(state(&job), "succeeded", "{asked} {job}");
        let found = &job["metrics"]["topology"];
        assert_eq!(["components", "voids", "handles"].map(|m| found[m].clone()), counts.map(|n| json!(n)), "{found}");
        let area = found["invented_area"].as_f64().expect("a share");
        assert!(invented.contains(&area), "{asked} invents {area}");
    }
    let id = app.submit(&json!({"field": {"scene": two}, "shrink": {"component": 2}})).await;
    let job = app.ended(&id).await;
    assert_eq!((state(&job), &job["problem"]["code"]), ("failed", &json!("no_such_component")));
    assert_eq!(job["problem"]["places"].as_array().map(Vec::len), Some(2));
}

#[test]
fn extract_writes_what_did_not_pass_and_says_what_and_where() {
    let folder = tempfile::tempdir().expect("folder");
    let (field, glb) = (folder.path().join("field.json"), folder.path().join("out.glb"));
    std::fs::write(&field, hopeless().to_string()).expect("writes");
    let run = |further: &[&str]| {
        let mut command = Command::new(BINARY);
        command.arg("extract").arg(&field).arg("-o").arg(&glb).args(["--lattice", "octahedral:2"]).args(further);
        command.output().expect("runs")
    };
    let output = run(&["--attempts", "1"]);
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(1), "{said}");
    assert!(said.contains("one attempt") && said.contains("(distance) at ("), "{said}");
    assert_eq!(extras(&std::fs::read(&glb).expect("reads"))["report"]["verdict"]["passed"], false);
    for wrong in [["--attempts", "4"], ["--density", "even"], ["--component", "-1"], ["--max-evaluations", "0"]] {
        assert_eq!(run(&wrong).status.code(), Some(2), "{wrong:?}");
    }
}

/// The shared meshes of higher genus, with their genus; none where the data is not there.
fn shapes_with_handles() -> Vec<(PathBuf, u64)> {
    let data = std::env::var_os("SHRINKD_DATA").map(PathBuf::from);
    let data = data.unwrap_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data"));
    let shapes = [("torus", 1), ("rocker_arm", 1), ("three_holes", 3), ("fertility", 4)];
    let shapes = shapes.map(|(name, genus)| (data.join(format!("meshes/genus/{name}.ply")), genus));
    shapes.into_iter().filter(|(path, _)| path.exists()).collect()
}

#[test]
fn meshes_with_handles_are_refused_with_their_genus_and_wrapped_when_asked() {
    let shapes = shapes_with_handles();
    if shapes.is_empty() {
        println!("skipped: no shared meshes");
    }
    let folder = tempfile::tempdir().expect("folder");
    let (glb, report) = (folder.path().join("out.glb"), folder.path().join("report.json"));
    for (mesh, genus) in shapes {
        let run = |further: &[&str]| {
            let mut command = Command::new(BINARY);
            command.arg("extract").arg(&mesh).arg("-o").arg(&glb).args(["--lattice", "octahedral:40"]).args(further);
            let output = command.output().expect("runs");
            (output.status.code(), String::from_utf8_lossy(&output.stderr).into_owned())
        };
        let (code, said) = run(&[]);
        assert_eq!(code, Some(4), "{} {said}", mesh.display());
        assert!(said.contains(&format!("genus {genus} ")), "{said}");
        let (code, said) = run(&["--on-topology", "wrap", "--report", report.to_str().expect("text")]);
        assert_eq!(code, Some(0), "{} {said}", mesh.display());
        let report: Value = serde_json::from_slice(&std::fs::read(&report).expect("reads")).expect("JSON");
        assert_eq!(report["topology"]["handles"], genus, "{}", mesh.display());
        let area = report["topology"]["invented_area"].as_f64().expect("a share");
        assert!(area > 0.0 && area < 0.5, "{} invents {area}", mesh.display());
    }
}
