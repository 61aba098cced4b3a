//! Warm starts: a job that begins from an earlier one's surface, and a path through a latent space as one GLB.

use crate::app::{App, BINARY, fixture, problem, small, state};
use reqwest::{Method, StatusCode};
use serde_json::{Value, json};
use shrinkd::field::mesh::ChartedMesh;
use shrinkd::field::network::safetensors;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

async fn network(app: &App) -> Value {
    let bytes = fixture("networks/morph.safetensors");
    let response = app.request(Method::POST, "/v1/inputs").body(bytes).send().await.expect("an answer");
    response.json::<Value>().await.expect("JSON")["id"].clone()
}

/// The code that is so much of the way from row 0 to row 1.
fn code(share: f32) -> Vec<f32> {
    let network = safetensors::read(&fixture("networks/morph.safetensors")).expect("a network");
    let (from, to) = (network.latent_code(0).expect("a code"), network.latent_code(1).expect("a code"));
    from.iter().zip(to).map(|(a, b)| a + share * (b - a)).collect()
}

/// A job of the network with the code at this share of the way.
fn request(input: &Value, share: f32) -> Value {
    json!({"field": {"input": input, "latent": code(share)}, "shrink": {"lattice": {"octahedral": {"n": 36}}},
           "outputs": ["glb", "surface", "report"]})
}

fn from(mut request: Value, job: &str) -> Value {
    request["warm_start"] = json!(job);
    request
}

async fn output(app: &App, job: &str, name: &str) -> Vec<u8> {
    app.get(&format!("/v1/jobs/{job}/outputs/{name}")).await.bytes().await.expect("bytes").to_vec()
}

#[tokio::test]
async fn a_code_nearby_begins_from_the_surface_before_and_keeps_its_charts() {
    let folder = tempfile::tempdir().expect("folder");
    let app = App::start(folder.path());
    let input = network(&app).await;
    let first = app.submit(&request(&input, 0.0)).await;
    let cold = app.ended(&first).await;
    assert_eq!(state(&cold), "succeeded", "{cold}");
    assert_eq!(cold["metrics"]["warm_start"], json!(null));
    let second = app.submit(&from(request(&input, 0.05), &first)).await;
    let warm = app.ended(&second).await;
    assert_eq!(state(&warm), "succeeded", "{warm}");
    let told = &warm["metrics"]["warm_start"];
    assert_eq!(told["used"], true, "{told}");
    let per_vertex = |job: &Value| job["metrics"]["evaluations"]["per_vertex"].as_f64().expect("a number");
    assert!(per_vertex(&warm) < 4.0 && per_vertex(&warm) < 0.6 * per_vertex(&cold), "{warm}");
    let mean = |what: &str| told[what]["mean"].as_f64().expect("a number");
    assert!(mean("moved") > 1e-3 && mean("drift") < 0.1 * mean("moved"), "{told}");
    // the same chart, other places
    let (a, b) = (output(&app, &first, "glb").await, output(&app, &second, "glb").await);
    let read = |glb: &[u8]| ChartedMesh::read(glb).expect("a GLB").expect("a chart");
    let (a, b) = (read(&a), read(&b));
    assert_eq!((&a.triangles, &a.uv), (&b.triangles, &b.uv));
    assert_ne!(a.vertices, b.vertices);
}

#[tokio::test]
async fn the_earlier_job_may_be_forgotten_while_the_later_one_waits() {
    let folder = tempfile::tempdir().expect("folder");
    let app = App::start_with(folder.path(), &[("SHRINKD_WORKER__SLOTS", "1")]);
    let input = network(&app).await;
    let first = app.submit(&request(&input, 0.0)).await;
    assert_eq!(state(&app.ended(&first).await), "succeeded");
    let blocking = app.submit(&crate::app::endless()).await;
    app.running(&blocking).await;
    let body = from(request(&input, 0.03), &first);
    let submit = || app.request(Method::POST, "/v1/jobs").header("Idempotency-Key", "again").json(&body).send();
    let accepted = submit().await.expect("an answer");
    assert_eq!(accepted.status(), StatusCode::ACCEPTED);
    let second = accepted.json::<Value>().await.expect("JSON")["id"].as_str().expect("a name").to_owned();
    let delete = |id: &str| app.request(Method::DELETE, &format!("/v1/jobs/{id}")).send();
    assert_eq!(delete(&first).await.expect("an answer").status(), StatusCode::NO_CONTENT);
    // the same request has the same answer, another one has nothing to begin from any more
    let again = submit().await.expect("an answer");
    assert_eq!(again.headers()["idempotent-replayed"], "true");
    assert_eq!(again.json::<Value>().await.expect("JSON")["id"], second.as_str());
    let refused = problem(app.post("/v1/jobs", &body).await, 422, "invalid_request").await;
    assert_eq!(refused["errors"][0]["code"], "unknown_job", "{refused}");
    app.post(&format!("/v1/jobs/{blocking}/cancel"), &json!(null)).await;
    let job = app.ended(&second).await;
    assert_eq!((state(&job), &job["metrics"]["warm_start"]["used"]), ("succeeded", &json!(true)), "{job}");
    // with the last job that names it the surface goes, too
    app.ended(&blocking).await;
    for id in [&second, &blocking] {
        assert_eq!(delete(id).await.expect("an answer").status(), StatusCode::NO_CONTENT);
    }
    let names = |dir: PathBuf| std::fs::read_dir(dir).into_iter().flatten().flatten().map(|entry| entry.path());
    let left: Vec<PathBuf> = names(folder.path().join("blobs/sha256")).flat_map(names).collect();
    assert_eq!(left.len(), 1, "the network alone is left: {left:?}");
}

#[tokio::test]
async fn a_job_that_cannot_be_begun_from_is_refused_by_what_is_wrong_with_it() {
    let folder = tempfile::tempdir().expect("folder");
    let app = App::start(folder.path());
    let ball = |n: u32, outputs: &[&str]| {
        json!({"field": {"scene": {"sphere": {"radius": 0.6}}}, "shrink": {"lattice": {"octahedral": {"n": n}}},
               "outputs": outputs})
    };
    let paper = json!({"field": {"scene": {"sphere": {"radius": 0.6}}}, "outputs": ["surface"],
                       "shrink": {"method": "paper", "lattice": {"octahedral": {"n": 12}}}});
    let disc = json!({"field": {"scene": {"circle": {"radius": 0.6}}}, "outputs": ["surface"],
                      "shrink": {"lattice": {"octahedral": {"n": 12}}}});
    let empty = json!({"field": {"scene": {"translate": {"by": [9, 0, 0], "of": {"sphere": {"radius": 0.1}}}}}});
    let mut ids = Vec::new();
    for body in [ball(12, &["surface"]), ball(12, &["glb"]), ball(16, &["surface"]), paper, disc, empty] {
        ids.push(app.submit(&body).await);
    }
    for id in &ids {
        app.ended(id).await;
    }
    let running = app.submit(&crate::app::endless()).await;
    let asked = || ball(12, &["glb"]);
    let nobody = "0197a9c0-0000-7000-8000-000000000000".to_owned();
    for (job, code, said) in [
        (&nobody, "unknown_job", "there is no job"),
        (&running, "not_succeeded", "has not succeeded"),
        (&ids[5], "not_succeeded", "it is failed"),
        (&ids[1], "no_surface", "no output"),
        (&ids[2], "other_lattice", "is on the lattice"),
        (&ids[3], "wrong_method", "paper"),
        (&ids[4], "dimension", "a curve"),
    ] {
        let answer = app.post("/v1/jobs", &from(asked(), job)).await;
        let refused = problem(answer, 422, "invalid_request").await;
        let fault = &refused["errors"][0];
        assert_eq!((&fault["pointer"], &fault["code"]), (&json!("/warm_start"), &json!(code)), "{refused}");
        assert!(fault["detail"].as_str().expect("text").contains(said), "{refused}");
    }
    let mut small = from(small(), &ids[0]);
    small["shrink"]["lattice"] = json!({"octahedral": {"n": 12}});
    let mut curve = from(asked(), &ids[0]);
    curve["field"] = json!({"scene": {"circle": {"radius": 0.6}}});
    let mut stored = asked();
    stored["warm_start"] = json!({"job": ids[0], "surface": format!("sha256:{}", "0".repeat(64))});
    let mut named = asked();
    named["warm_start"] = json!("yesterday's");
    let mut number = asked();
    number["warm_start"] = json!(7);
    for (body, code) in [
        (small, "not_offered"),
        (curve, "dimension"),
        (stored, "wrong_type"),
        (named, "invalid_id"),
        (number, "wrong_type"),
    ] {
        let refused = problem(app.post("/v1/jobs", &body).await, 422, "invalid_request").await;
        let fault = &refused["errors"][0];
        assert_eq!((&fault["pointer"], &fault["code"]), (&json!("/warm_start"), &json!(code)), "{refused}");
    }
    let fine = app.post("/v1/jobs?validate_only=true", &from(asked(), &ids[0])).await;
    assert_eq!(fine.status(), StatusCode::OK);
}

fn networks() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/networks")
}

fn run(arguments: &[&str]) -> Output {
    Command::new(BINARY).args(arguments).output().expect("runs")
}

fn told(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

#[test]
fn the_command_line_begins_from_a_surface_that_it_wrote() {
    let folder = tempfile::tempdir().expect("folder");
    let path = |name: &str| folder.path().join(name).to_string_lossy().into_owned();
    let net = networks().join("morph.safetensors").to_string_lossy().into_owned();
    std::fs::write(path("near.json"), format!("{:?}", code(0.03))).expect("writes");
    let (out, surface, report) = (path("out.glb"), path("s.safetensors"), path("r.json"));
    let extract =
        |further: &[&str]| run(&[&["extract", &net, "-o", &out, "--lattice", "octahedral:36"], further].concat());
    let first = extract(&["--latent-row", "0", "--surface", &surface]);
    assert!(first.status.success(), "{}", told(&first));
    let second = extract(&["--latent", &path("near.json"), "--warm-start", &surface, "--report", &report]);
    assert!(second.status.success(), "{}", told(&second));
    let report: Value = serde_json::from_slice(&std::fs::read(&report).expect("reads")).expect("JSON");
    assert_eq!((&report["warm_start"]["used"], &report["attempts"]), (&json!(true), &json!(1)), "{report}");
    for (further, code, said) in [
        (vec!["--warm-start", &surface, "--lattice", "octahedral:30"], 3, "is on the lattice"),
        (vec!["--warm-start", &out], 3, "no safetensors"),
        (vec!["--warm-start", &net], 3, "not that of a surface"),
        (vec!["--warm-start", &surface, "--method", "paper"], 2, "adaptive"),
    ] {
        let arguments = [&["extract", &net, "-o", &out, "--latent-row", "1"], further.as_slice()].concat();
        let output = run(&arguments);
        assert!(output.status.code() == Some(code) && told(&output).contains(said), "{further:?}: {}", told(&output));
    }
}

#[test]
fn a_way_through_latent_space_is_one_glb() {
    let folder = tempfile::tempdir().expect("folder");
    let path = |name: &str| folder.path().join(name).to_string_lossy().into_owned();
    let net = networks().join("morph.safetensors").to_string_lossy().into_owned();
    let end = code(0.2);
    std::fs::write(path("way.json"), format!(r#"{{"from": 0, "to": {end:?}, "frames": 4}}"#)).expect("writes");
    let (latents, out, report) = (path("way.json"), path("way.glb"), path("way.report.json"));
    let animate = |threads: &str| {
        let arguments = ["animate", &net, "--latents", &latents, "-o", &out, "--report", &report, "--fps", "4"];
        let output = run(&[&arguments, ["--lattice", "octahedral:36", "--threads", threads].as_slice()].concat());
        assert!(output.status.success(), "{}", told(&output));
        std::fs::read(&out).expect("reads")
    };
    let glb = animate("1");
    assert_eq!(glb, animate("3"), "the same bytes for any number of threads");
    let (document, buffers, _) = gltf::import_slice(&glb).expect("a GLB");
    assert_eq!((document.meshes().count(), document.animations().count()), (1, 1));
    let primitive = document.meshes().next().expect("a mesh").primitives().next().expect("a primitive");
    let targets = primitive.reader(|b| Some(buffers[b.index()].0.as_slice())).read_morph_targets().count();
    assert_eq!(targets, 3);
    let report: Value = serde_json::from_slice(&std::fs::read(&report).expect("reads")).expect("JSON");
    let frames = report["frames"].as_array().expect("a list");
    assert_eq!((frames.len(), &report["passed"]), (4, &json!(true)));
    let number = |value: &Value| value.as_f64().expect("a number");
    assert_eq!(number(&frames[3]["latent"][1]) as f32, end[1]);
    for frame in &frames[1..] {
        assert_eq!((&frame["warm"], &frame["passed"], &frame["between"]), (&json!(true), &json!(true), &json!(0)));
        let (cost, first) = (number(&frame["evaluations_per_vertex"]), number(&frames[0]["evaluations_per_vertex"]));
        assert!(cost < 4.0 && cost < 0.6 * first, "{frame}");
        assert!(number(&frame["drift"]["mean"]) < 0.1 * number(&frame["moved"]["mean"]), "{frame}");
    }
}

#[test]
fn an_animation_that_makes_no_sense_is_refused() {
    let folder = tempfile::tempdir().expect("folder");
    let path = |name: &str| folder.path().join(name).to_string_lossy().into_owned();
    let net = |name: &str| networks().join(name).to_string_lossy().into_owned();
    let (morph, blob, out) = (net("morph.safetensors"), net("blob.safetensors"), path("out.glb"));
    for (file, text) in [("rows.json", "[0, 1]"), ("far.json", "[0, 77]"), ("long.json", "[[0, 0], [1, 2, 3]]")] {
        std::fs::write(path(file), text).expect("writes");
    }
    let (rows, far, long) = (path("rows.json"), path("far.json"), path("long.json"));
    for (arguments, code, said) in [
        (vec![morph.as_str(), "--latents", &far, "-o", &out], 3, "frame 1: the network comes with 5 latent codes"),
        (vec![&morph, "--latents", &long, "-o", &out], 3, "frame 1: the latent code has 3 entries"),
        (vec![&blob, "--latents", &rows, "-o", &out], 3, "no latent code"),
        (vec![&morph, "--latents", &morph, "-o", &out], 3, "expected a .npy array"),
        (vec![&morph, "--latents", &rows], 2, "--output"),
        (vec![&morph, "--latents", &rows, "-o", &out, "--relax-uv"], 2, "the sphere's own UVs"),
        (vec![&morph, "--latents", &rows, "-o", &out, "--fps", "0"], 2, "--fps"),
        (vec![&morph, "--latents", &rows, "-o", &out, "--field-options", r#"{"latent_row": 1}"#], 2, "--latents"),
    ] {
        let output = run(&[&["animate"], arguments.as_slice()].concat());
        assert!(output.status.code() == Some(code) && told(&output).contains(said), "{arguments:?}: {}", told(&output));
    }
    assert!(!Path::new(&out).exists());
}
