//! A weight: a field whose values say how closely samples are spaced where.

use crate::app::{App, BINARY, state};
use reqwest::Method;
use serde_json::{Value, json};
use shrinkd::field::mesh::ChartedMesh;
use std::process::Command;

/// A grid over the cube of half extent 1 whose samples are `below` for z < 0, `above` for z > 0, as `.npy`.
fn grid(below: f32, above: f32) -> Vec<u8> {
    const LAYERS: usize = 10;
    let header = format!("{{'descr': '<f4', 'fortran_order': False, 'shape': (2, 2, {LAYERS}), }}");
    let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
    bytes.extend((117 + 1u16).to_le_bytes());
    bytes.extend(format!("{header:<117}\n").into_bytes());
    let samples = (0..4 * LAYERS).map(|i| if i % LAYERS < LAYERS / 2 { below } else { above });
    bytes.extend(samples.flat_map(f32::to_le_bytes));
    bytes
}

/// Share of a GLB's vertices that are above z = 0.
fn share_above(glb: &[u8]) -> f64 {
    let mesh = ChartedMesh::read(glb).expect("a GLB").expect("a chart");
    mesh.vertices.iter().filter(|p| p[2] > 0.0).count() as f64 / mesh.vertices.len() as f64
}

async fn uploaded(app: &App, bytes: Vec<u8>) -> Value {
    let response = app.request(Method::POST, "/v1/inputs").body(bytes).send().await.expect("an answer");
    response.json::<Value>().await.expect("JSON")["id"].clone()
}

fn weighted(weight: &Value) -> Value {
    json!({"field": {"scene": {"sphere": {"radius": 0.6}}}, "weight": {"input": weight},
           "shrink": {"lattice": {"octahedral": {"n": 24}}}, "outputs": ["glb"]})
}

#[tokio::test]
async fn samples_are_where_the_weight_says() {
    let folder = tempfile::tempdir().expect("folder");
    let app = App::start(folder.path());
    let weight = uploaded(&app, grid(1.0, 3.0)).await;
    let id = app.submit(&weighted(&weight)).await;
    let job = app.ended(&id).await;
    assert_eq!(state(&job), "succeeded", "{job}");
    assert_eq!(job["shrink"]["density"], "weight");
    let glb = app.get(&format!("/v1/jobs/{id}/outputs/glb")).await.bytes().await.expect("bytes");
    // three to one is three quarters; the map gives some of it up for shape
    let share = share_above(&glb);
    assert!((0.68..0.77).contains(&share), "{share}");
}

#[tokio::test]
async fn a_weight_that_says_nothing_is_refused_by_name() {
    let folder = tempfile::tempdir().expect("folder");
    let app = App::start(folder.path());
    let weight = uploaded(&app, grid(-1.0, -0.5)).await;
    let id = app.submit(&weighted(&weight)).await;
    let job = app.ended(&id).await;
    assert_eq!((state(&job), &job["problem"]["code"]), ("failed", &json!("no_weight")), "{job}");
}

#[test]
fn the_command_line_takes_a_weight() {
    let folder = tempfile::tempdir().expect("folder");
    let path = |name: &str| folder.path().join(name).to_string_lossy().into_owned();
    std::fs::write(path("ball.json"), r#"{"sphere": {"radius": 0.6}}"#).expect("writes");
    std::fs::write(path("weight.npy"), grid(3.0, 1.0)).expect("writes");
    std::fs::write(path("none.npy"), grid(0.0, 0.0)).expect("writes");
    std::fs::write(path("disc.json"), r#"{"circle": {"radius": 0.6}}"#).expect("writes");
    let wrap = |field: &str, further: &[&str]| {
        let (field, out) = (path(field), path("out.glb"));
        let arguments = ["extract", &field, "-o", &out, "--lattice", "octahedral:24"];
        Command::new(BINARY).args(arguments).args(further).output().expect("runs")
    };
    let run = |further: &[&str]| wrap("ball.json", further);
    let output = run(&["--weight", &path("weight.npy")]);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let share = share_above(&std::fs::read(path("out.glb")).expect("reads"));
    assert!((0.23..0.32).contains(&share), "{share}");
    for (further, code, said) in [
        (vec!["--weight".to_owned(), path("none.npy")], 3, "the weight is positive nowhere on the surface"),
        (vec!["--weight".to_owned(), path("missing.npy")], 3, "missing.npy"),
        (vec!["--weight".to_owned(), path("weight.npy"), "--density".to_owned(), "area".to_owned()], 2, "--density"),
    ] {
        let further: Vec<&str> = further.iter().map(String::as_str).collect();
        let output = run(&further);
        let told = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(output.status.code() == Some(code) && told.contains(said), "{further:?}: {told}");
    }
    for (field, weight) in [("disc.json", "weight.npy"), ("ball.json", "disc.json")] {
        let output = wrap(field, &["--weight", &path(weight)]);
        let told = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(output.status.code() == Some(3) && told.contains("one here has 2"), "{field} {weight}: {told}");
    }
}
