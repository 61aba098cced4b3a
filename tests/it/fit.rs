//! Networks fitted to meshes, over HTTP and on the command line.

use crate::app::{App, BINARY, PATIENCE, state};
use crate::walk::follow;
use reqwest::{Method, StatusCode};
use serde_json::{Value, json};
use std::path::Path;
use std::process::Command;
use std::time::{Duration, Instant};

/// An octahedron as OFF, of half axes `x`, `y` and `z`.
fn octahedron([x, y, z]: [f64; 3]) -> Vec<u8> {
    let corners = format!("{x} 0 0\n-{x} 0 0\n0 {y} 0\n0 -{y} 0\n0 0 {z}\n0 0 -{z}\n");
    let faces = "3 0 2 4\n3 2 1 4\n3 1 3 4\n3 3 0 4\n3 2 0 5\n3 1 2 5\n3 3 1 5\n3 0 3 5\n";
    format!("OFF\n6 8 0\n{corners}{faces}").into_bytes()
}

async fn uploaded(app: &App, bytes: Vec<u8>) -> Value {
    let response = app.request(Method::POST, "/v1/inputs").body(bytes).send().await.expect("an answer");
    assert!(response.status().is_success(), "{}", response.status());
    response.json::<Value>().await.expect("JSON")["id"].clone()
}

async fn output(app: &App, job: &Value, name: &str) -> Vec<u8> {
    let outputs = job["outputs"].as_array().expect("a list");
    let href = outputs.iter().find(|o| o["name"] == name).expect("the output")["href"].as_str().expect("a place");
    app.get(href).await.bytes().await.expect("bytes").to_vec()
}

/// Trains as the jobs below do: two small layers, `epochs` times.
fn command(meshes: &[&Path], epochs: u32, out: &Path) -> Command {
    let mut command = Command::new(BINARY);
    command.arg("fit").args(meshes).arg("-o").arg(out).args(["--layers", "2", "--width", "24", "--samples", "6000"]);
    command.args(["--w0", "10", "--batch", "768", "--epochs", &epochs.to_string()]);
    command
}

fn job(meshes: &[&Value], epochs: u32) -> Value {
    let fit = json!({"layers": 2, "width": 24, "samples": 6000, "batch": 768, "epochs": epochs,
                     "activation": {"sine": {"w0": 10}}});
    json!({"kind": "fit", "meshes": meshes, "fit": fit})
}

#[tokio::test]
async fn a_mesh_becomes_a_network_and_the_network_a_surface() {
    let folder = tempfile::tempdir().expect("folder");
    let app = App::start(&folder.path().join("data"));
    let mesh = octahedron([3.0, 2.0, 2.5]);
    let id = app.submit(&job(&[&uploaded(&app, mesh.clone()).await], 60)).await;
    let ended = app.ended(&id).await;
    assert_eq!((state(&ended), &ended["kind"]), ("succeeded", &json!("fit")), "{ended}");
    assert_eq!((&ended["fit"]["width"], ended.get("shrink")), (&json!(24), None));
    let shape = &ended["metrics"]["shapes"][0];
    assert!(shape["closeness"]["distance"]["mean"].as_f64().expect("a number") < 0.02, "{shape}");
    let report: Value = serde_json::from_slice(&output(&app, &ended, "report").await).expect("JSON");
    assert_eq!(report, ended["metrics"]);
    let events = follow(&app, &id, Some(0)).await;
    assert!(events.iter().any(|event| event.2["stage"] == "train" && event.2["energy"].is_number()));
    let losses: Vec<f64> = report["losses"].as_array().expect("a list").iter().filter_map(Value::as_f64).collect();
    assert!(losses.len() == 60 && losses[59] < 0.5 * losses[0], "{losses:?}");

    // the command line makes the same bytes
    let network = output(&app, &ended, "network").await;
    let (path, made) = (folder.path().join("octahedron.off"), folder.path().join("net.safetensors"));
    std::fs::write(&path, &mesh).expect("writes");
    let said = command(&[&path], 60, &made).output().expect("runs");
    assert!(said.status.success(), "{}", String::from_utf8_lossy(&said.stderr));
    assert!(std::fs::read(&made).expect("written") == network);
    assert!(String::from_utf8_lossy(&said.stdout).contains("zero level set mean"));

    let input = uploaded(&app, network).await;
    let shrink = json!({"lattice": {"octahedral": {"n": 16}}});
    let id = app.submit(&json!({"field": {"input": input}, "shrink": shrink, "outputs": ["report"]})).await;
    let ended = app.ended(&id).await;
    assert_eq!(state(&ended), "succeeded", "{ended}");
}

#[tokio::test]
async fn several_meshes_get_a_latent_code_each() {
    let folder = tempfile::tempdir().expect("folder");
    let app = App::start(folder.path());
    let meshes = [uploaded(&app, octahedron([1.0; 3])).await, uploaded(&app, octahedron([1.0, 0.5, 0.7])).await];
    let id = app.submit(&job(&[&meshes[0], &meshes[1]], 3)).await;
    let ended = app.ended(&id).await;
    assert_eq!(state(&ended), "succeeded", "{ended}");
    let network = uploaded(&app, output(&app, &ended, "network").await).await;
    let described = app.get_json(&format!("/v1/inputs/{}", network.as_str().expect("a name"))).await;
    assert_eq!(
        (&described["description"]["latent_rows"], &described["description"]["latent_size"]),
        (&json!(2), &json!(32))
    );
}

#[tokio::test]
async fn a_mesh_is_brought_to_the_cube_and_the_report_says_how_to_bring_it_back() {
    let folder = tempfile::tempdir().expect("folder");
    let app = App::start(folder.path());
    let scale = 0.01;
    let mesh = uploaded(&app, octahedron([scale, 0.8 * scale, 0.9 * scale])).await;
    let mut request = job(&[&mesh], 60);
    request["fit"]["normalize"] = json!(true);
    let ended = app.ended(&app.submit(&request).await).await;
    assert_eq!((state(&ended), &ended["fit"]["normalize"]), ("succeeded", &json!(true)), "{ended}");
    let shape = &ended["metrics"]["shapes"][0];
    assert!(shape["closeness"]["distance"]["mean"].as_f64().expect("a number") < 0.02, "{shape}");

    // wrapped where its mesh was, in a box of its mesh's size
    let network = uploaded(&app, output(&app, &ended, "network").await).await;
    let reach = vec![1.3 * scale; 3];
    let domain = json!({"min": reach.iter().map(|c| -c).collect::<Vec<_>>(), "max": reach});
    let field = json!({"input": network, "transform": shape["transform"], "domain": domain});
    let shrink = json!({"lattice": {"octahedral": {"n": 16}}});
    let wrapped = app.ended(&app.submit(&json!({"field": field, "shrink": shrink, "outputs": ["glb"]})).await).await;
    assert_eq!(state(&wrapped), "succeeded", "{wrapped}");
    let glb = output(&app, &wrapped, "glb").await;
    let (document, buffers, _) = gltf::import_slice(&glb).expect("a GLB");
    let primitive = document.meshes().next().expect("a mesh").primitives().next().expect("a primitive");
    let reader = primitive.reader(|buffer| Some(&buffers[buffer.index()]));
    let farthest = reader.read_positions().expect("positions").map(|p| p[0].abs()).fold(0.0, f32::max);
    // so small a network rounds the corners
    assert!((0.8..1.05).contains(&(f64::from(farthest) / scale)), "reaches {farthest} of {scale}");
}

#[tokio::test]
async fn training_that_was_killed_goes_on_where_it_was() {
    let folder = tempfile::tempdir().expect("folder");
    let (data, epochs) = (folder.path().join("data"), 300);
    let app = App::start(&data);
    let mesh = octahedron([1.0, 0.8, 0.9]);
    let id = app.submit(&job(&[&uploaded(&app, mesh.clone()).await], epochs)).await;
    let kept = data.join("blobs/checkpoints").join(&id);
    let clock = Instant::now();
    while !kept.exists() {
        assert!(clock.elapsed() < PATIENCE, "no checkpoint\n{}", app.log());
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
    app.kill();
    let app = App::start(&data);
    let ended = app.ended(&id).await;
    assert_eq!((state(&ended), &ended["attempt"]), ("succeeded", &json!(2)), "{ended}");
    let events = follow(&app, &id, Some(0)).await;
    let second = events.iter().rposition(|e| e.1 == "state" && e.2["state"] == "running").expect("the second attempt");
    let trained = events[second..].iter().find(|e| e.1 == "progress" && e.2["stage"] == "train").expect("training");
    assert!(trained.2["iteration"].as_u64() > Some(0), "it went on: {}", trained.2);
    assert!(!kept.exists(), "an ended job needs no checkpoint");

    let (path, made) = (folder.path().join("octahedron.off"), folder.path().join("net.safetensors"));
    std::fs::write(&path, &mesh).expect("writes");
    assert!(command(&[&path], epochs, &made).status().expect("runs").success());
    let network = output(&app, &ended, "network").await;
    assert!(std::fs::read(&made).expect("written") == network, "as if it had never been killed");
}

#[tokio::test]
async fn training_is_canceled_and_what_is_no_mesh_is_refused() {
    let folder = tempfile::tempdir().expect("folder");
    let app = App::start(folder.path());
    let mesh = uploaded(&app, octahedron([1.0; 3])).await;
    let id = app.submit(&job(&[&mesh], 100_000)).await;
    app.wait_until(&id, |job| job["progress"]["stage"] == "train").await;
    app.post(&format!("/v1/jobs/{id}/cancel"), &json!({})).await;
    let ended = app.ended(&id).await;
    assert_eq!((state(&ended), &ended["outputs"]), ("canceled", &json!([])));

    let scene = uploaded(&app, br#"{"sphere": {"radius": 0.5}}"#.to_vec()).await;
    let response = app.post("/v1/jobs", &job(&[&mesh, &scene], 1)).await;
    assert_eq!(response.status(), StatusCode::UNPROCESSABLE_ENTITY);
    let problem: Value = response.json().await.expect("JSON");
    assert_eq!(
        (&problem["errors"][0]["pointer"], &problem["errors"][0]["code"]),
        (&json!("/meshes/1"), &json!("not_a_mesh"))
    );
    let absent = json!(format!("sha256:{}", "ab".repeat(32)));
    let problem: Value = app.post("/v1/jobs", &job(&[&absent], 1)).await.json().await.expect("JSON");
    assert_eq!(problem["errors"][0]["code"], "unknown_input");
}

#[test]
fn the_command_line_goes_on_from_its_checkpoint_and_says_what_is_wrong() {
    let folder = tempfile::tempdir().expect("folder");
    let place = |name: &str| folder.path().join(name);
    std::fs::write(place("mesh.off"), octahedron([1.0, 0.9, 0.8])).expect("writes");
    let run = |epochs: u32, out: &str| {
        let mut command = command(&[&place("mesh.off")], epochs, &place(out));
        command.arg("--checkpoint").arg(place("state"));
        command.output().expect("runs")
    };
    assert!(run(3, "a").status.success());
    let again = run(3, "b");
    assert!(again.status.success());
    assert!(String::from_utf8_lossy(&again.stderr).contains("going on after epoch 3 of 3"));
    assert_eq!(std::fs::read(place("a")).expect("written"), std::fs::read(place("b")).expect("written"));

    std::fs::write(place("scene.json"), r#"{"sphere": {"radius": 0.5}}"#).expect("writes");
    let refused = command(&[&place("scene.json")], 1, &place("c")).output().expect("runs");
    assert_eq!(refused.status.code(), Some(3));
    assert!(String::from_utf8_lossy(&refused.stderr).contains("fitted to meshes"));
    let usage = command(&[&place("mesh.off")], 0, &place("c")).output().expect("runs");
    assert_eq!(usage.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&usage.stderr).contains("--epochs: 0 is not in 1 to 100000"));
}
