//! How a surface moves with its network, held against surfaces that were extracted again.

use crate::app::{App, BINARY, endless, problem, state};
use reqwest::{Method, Response, StatusCode};
use serde_json::{Value, json};
use shrinkd::field::network::safetensors as own;
use shrinkd::surface::sensitivity::Welded;
use std::path::Path;
use std::process::Command;

const NET: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/fixtures/networks/morph.safetensors");

fn run(arguments: &[&str]) {
    let said = Command::new(BINARY).args(arguments).output().expect("runs");
    assert!(said.status.success(), "{arguments:?}: {}", String::from_utf8_lossy(&said.stderr));
}

fn text(path: &Path) -> &str {
    path.to_str().expect("text")
}

/// The welded vertices and the triangles of a surface file.
fn surface(path: &Path) -> (Welded, Vec<[u32; 3]>) {
    let bytes = std::fs::read(path).expect("written");
    let tensors = safetensors::SafeTensors::deserialize(&bytes).expect("safetensors");
    let data = tensors.tensor("triangles").expect("there").data().to_vec();
    let corners: Vec<u32> = data.as_chunks().0.iter().map(|b| u32::from_le_bytes(*b)).collect();
    (Welded::read(&bytes).expect("a surface"), corners.as_chunks().0.to_vec())
}

fn cross(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

/// A loss of a surface, its enclosed volume weighted by `weight`: the sum of a . (b x c) / 6 (w_a + w_b + w_c) / 3; and its derivatives.
fn loss((welded, triangles): &(Welded, Vec<[u32; 3]>), weight: [f64; 3]) -> (f64, Vec<[f64; 3]>) {
    let p: Vec<[f64; 3]> = welded.positions.iter().map(|v| v.map(f64::from)).collect();
    let dot = |a: [f64; 3], b: [f64; 3]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
    let w = |v: [f64; 3]| 1.0 + dot(weight, v);
    let (mut sum, mut by_vertex) = (0.0, vec![[0.0; 3]; p.len()]);
    for triangle in triangles {
        let corners = triangle.map(|v| p[v as usize]);
        let volume = dot(corners[0], cross(corners[1], corners[2])) / 6.0;
        // of the linear weight over the tetrahedron with the origin: a quarter of the four corners' together
        let mean = (1.0 + corners.iter().map(|&c| w(c)).sum::<f64>()) / 4.0;
        sum += volume * mean;
        for i in 0..3 {
            let by = cross(corners[(i + 1) % 3], corners[(i + 2) % 3]);
            for axis in 0..3 {
                by_vertex[triangle[i] as usize][axis] += by[axis] / 6.0 * mean + volume * weight[axis] / 4.0;
            }
        }
    }
    (sum, by_vertex)
}

fn write_gradient(path: &Path, by_vertex: &[[f64; 3]]) {
    let bytes: Vec<u8> = by_vertex.iter().flatten().flat_map(|v| v.to_le_bytes()).collect();
    let view = safetensors::tensor::TensorView::new(safetensors::Dtype::F64, vec![by_vertex.len(), 3], &bytes);
    let file = safetensors::serialize([("gradient", view.expect("fits"))], None).expect("serializes");
    std::fs::write(path, file).expect("writes");
}

fn numbers(path: &Path, name: &str) -> Vec<f64> {
    let bytes = std::fs::read(path).expect("written");
    let tensors = safetensors::SafeTensors::deserialize(&bytes).expect("safetensors");
    let data = tensors.tensor(name).expect("there").data().to_vec();
    data.as_chunks().0.iter().map(|b| f32::from_le_bytes(*b).into()).collect()
}

/// The bar: relative error below 1e-2 against finite differences of surfaces that were extracted again.
#[test]
fn derivatives_are_those_of_surfaces_that_are_extracted_again() {
    let folder = tempfile::tempdir().expect("folder");
    let place = |name: &str| folder.path().join(name);
    let network = own::read(&std::fs::read(NET).expect("there")).expect("a network");
    let code = network.latent_code(0).expect("a code").to_vec();
    let extracted = |net: &Path, code: &[f32]| {
        let (latent, out) = (place("code.json"), place("s.safetensors"));
        std::fs::write(&latent, format!("{code:?}")).expect("writes");
        let (latent, out, glb) = (text(&latent), text(&out), place("s.glb"));
        let lattice = ["--lattice", "octahedral:64"];
        run(&[&["extract", text(net), "--latent", latent, "-o", text(&glb), "--surface", out][..], &lattice].concat());
        surface(Path::new(out))
    };
    let base = extracted(Path::new(NET), &code);
    std::fs::copy(place("s.safetensors"), place("base.safetensors")).expect("copies");
    let weight = [0.4, -0.3, 0.2];
    let (value, by_vertex) = loss(&base, weight);
    write_gradient(&place("gradient.safetensors"), &by_vertex);
    let latent = place("base.json");
    std::fs::write(&latent, format!("{code:?}")).expect("writes");
    run(&[
        "sensitivity",
        NET,
        "--latent",
        text(&latent),
        "--surface",
        text(&place("base.safetensors")),
        "--gradient",
        text(&place("gradient.safetensors")),
        "-o",
        text(&place("derivatives.safetensors")),
    ]);
    let derivatives = place("derivatives.safetensors");
    let by_code = numbers(&derivatives, "latent");
    let largest = by_code.iter().fold(0f64, |m, d| m.max(d.abs()));
    for at in 0..code.len() {
        // one that changes the loss by about a thousandth
        let step = (1e-3 * value / largest) as f32;
        let moved = |by: f32| {
            let mut code = code.clone();
            code[at] += by;
            loss(&extracted(Path::new(NET), &code), weight).0
        };
        let slope = (moved(step) - moved(-step)) / f64::from(2.0 * step);
        let error = (slope - by_code[at]).abs() / largest;
        println!("code {at}: {slope} {} {error:.1e}", by_code[at]);
        assert!(error < 1e-2, "entry {at} of the code: {slope} {}", by_code[at]);
    }

    // the weight of every layer that says most
    let (kept, mut first) = (network.weights(), 0);
    for (i, layer) in network.layers.iter().enumerate() {
        let by_weight = numbers(&derivatives, &format!("layers.{i}.weight"));
        assert_eq!(by_weight.len(), layer.weights.len());
        let at = (0..by_weight.len()).max_by(|&a, &b| by_weight[a].abs().total_cmp(&by_weight[b].abs())).expect("one");
        let step = (1e-3 * value / by_weight[at].abs()) as f32;
        let moved = |by: f32| {
            let mut list = kept.clone();
            list[first + at] += by;
            let mut other = network.clone();
            other.set_weights(&list);
            std::fs::write(place("other.safetensors"), own::write(&other)).expect("writes");
            loss(&extracted(&place("other.safetensors"), &code), weight).0
        };
        let slope = (moved(step) - moved(-step)) / f64::from(2.0 * step);
        let error = (slope / by_weight[at] - 1.0).abs();
        println!("layer {i} weight {at}: {slope} {} {error:.1e}", by_weight[at]);
        assert!(error < 1e-2, "weight {at} of layer {i}: {slope} {}", by_weight[at]);
        first += layer.weights.len() + layer.bias.len();
    }
}

#[test]
fn files_that_do_not_fit_are_refused_by_name() {
    let folder = tempfile::tempdir().expect("folder");
    let place = |name: &str| folder.path().join(name);
    run(&[
        "extract",
        NET,
        "--latent-row",
        "0",
        "-o",
        text(&place("s.glb")),
        "--surface",
        text(&place("s")),
        "--lattice",
        "octahedral:12",
    ]);
    let refused = |field: &str, surface: &Path, gradient: &Path| {
        let (surface, gradient, out) = (text(surface), text(gradient), place("out"));
        let arguments = ["sensitivity", field, "--latent-row", "0", "--surface", surface, "--gradient", gradient, "-o"];
        let said = Command::new(BINARY).args(arguments).arg(&out).output().expect("runs");
        assert_eq!(said.status.code(), Some(3));
        String::from_utf8_lossy(&said.stderr).into_owned()
    };
    write_gradient(&place("short"), &[[0.0; 3]; 2]);
    let said = refused(NET, &place("s"), &place("short"));
    assert!(
        said.contains("short: \"gradient\" has the shape [2, 3], and the surface takes [578, 3] or [25, 25, 3]"),
        "{said}"
    );
    let said = refused(NET, &place("short"), &place("short"));
    assert!(said.contains("short: the tensor \"positions\" is missing; there are [\"gradient\"]"), "{said}");
    let scene = concat!(env!("CARGO_MANIFEST_DIR"), "/examples/scenes/fork.json");
    let said = refused(scene, &place("s"), &place("short"));
    assert!(said.contains("only a network has weights and codes"), "{said}");
}

async fn input(app: &App, bytes: Vec<u8>) -> Value {
    let response = app.request(Method::POST, "/v1/inputs").body(bytes).send().await.expect("an answer");
    response.json::<Value>().await.expect("JSON")["id"].clone()
}

async fn asked(app: &App, job: &str, gradient: Vec<u8>, key: &str) -> Response {
    let request = app.request(Method::POST, &format!("/v1/jobs/{job}/sensitivity")).header("Idempotency-Key", key);
    request.body(gradient).send().await.expect("an answer")
}

#[tokio::test]
async fn a_job_is_differentiated_also_when_it_is_forgotten_before() {
    let folder = tempfile::tempdir().expect("folder");
    let place = |name: &str| folder.path().join(name);
    let app = App::start_with(&place("data"), &[("SHRINKD_WORKER__SLOTS", "1")]);
    let net = input(&app, std::fs::read(NET).expect("there")).await;
    let field = json!({"input": net, "latent_row": 0});
    let shrink = json!({"lattice": {"octahedral": {"n": 16}}});
    let id = app.submit(&json!({"field": field, "shrink": shrink, "outputs": ["surface"]})).await;
    let job = app.ended(&id).await;
    assert_eq!(state(&job), "succeeded", "{job}");
    let bytes = app.get(&format!("/v1/jobs/{id}/outputs/surface")).await.bytes().await.expect("bytes");
    std::fs::write(place("s"), &bytes).expect("writes");
    let made = surface(&place("s"));
    write_gradient(&place("g"), &loss(&made, [0.0; 3]).1);
    let gradient = std::fs::read(place("g")).expect("written");

    // one worker, and it is busy: the surface is gone from its job before it is needed
    let busy = app.submit(&endless()).await;
    app.running(&busy).await;
    let response = asked(&app, &id, gradient.clone(), "once").await;
    assert_eq!(response.status(), StatusCode::ACCEPTED);
    let accepted: Value = response.json().await.expect("JSON");
    assert_eq!((&accepted["kind"], &accepted["of"]), (&json!("sensitivity"), &json!(id)));
    let forgotten = app.request(Method::DELETE, &format!("/v1/jobs/{id}")).send().await.expect("an answer");
    assert_eq!(forgotten.status(), StatusCode::NO_CONTENT);
    let request = app.get(&format!("/v1/jobs/{}/request", accepted["id"].as_str().expect("a name"))).await;
    problem(request, 404, "no_request").await;
    let again = asked(&app, &id, gradient.clone(), "once").await;
    assert_eq!(again.headers()["idempotent-replayed"], "true");
    app.post(&format!("/v1/jobs/{busy}/cancel"), &json!({})).await;
    let ended = app.ended(accepted["id"].as_str().expect("a name")).await;
    assert_eq!(state(&ended), "succeeded", "{ended}");
    let href = ended["outputs"][0]["href"].as_str().expect("a place").to_owned();
    assert!(href.ends_with("/outputs/sensitivity"), "{ended}");
    let served = app.get(&href).await.bytes().await.expect("bytes");

    // the command line makes the same bytes
    let arguments =
        ["--latent-row", "0", "--surface", text(&place("s")), "--gradient", text(&place("g")), "-o", text(&place("d"))]
            .map(str::to_owned);
    run(&[&["sensitivity", NET][..], &arguments.iter().map(String::as_str).collect::<Vec<_>>()].concat());
    assert!(std::fs::read(place("d")).expect("written") == served);
}

#[tokio::test]
async fn what_cannot_be_differentiated_is_refused() {
    let folder = tempfile::tempdir().expect("folder");
    let place = |name: &str| folder.path().join(name);
    let app = App::start(&place("data"));
    write_gradient(&place("g"), &[[1.0; 3]; 4]);
    let gradient = std::fs::read(place("g")).expect("written");
    let refused = async |job: &str, gradient: Vec<u8>, key: &str, status: StatusCode| {
        let response = asked(&app, job, gradient, key).await;
        assert_eq!(response.status(), status);
        response.json::<Value>().await.expect("JSON")
    };
    let scene = json!({"field": {"scene": {"sphere": {"radius": 0.5}}}, "shrink": {"lattice": {"octahedral": {"n": 8}}},
                       "outputs": ["surface"]});
    let scene = app.submit(&scene).await;
    app.ended(&scene).await;
    let problem = refused(&scene, gradient.clone(), "a", StatusCode::CONFLICT).await;
    assert_eq!(problem["code"], "not_differentiable");
    assert!(problem["detail"].as_str().is_some_and(|detail| detail.ends_with("is of a scene, which has no weights")));
    let problem = refused(&scene, b"{}".to_vec(), "b", StatusCode::UNPROCESSABLE_ENTITY).await;
    assert_eq!(problem["code"], "malformed_gradient");
    let nobody = "01890000-0000-7000-8000-000000000000";
    refused(nobody, gradient.clone(), "c", StatusCode::NOT_FOUND).await;

    let net = input(&app, std::fs::read(NET).expect("there")).await;
    let field = json!({"input": net, "latent_row": 0});
    let shrink = json!({"lattice": {"octahedral": {"n": 8}}});
    let plain = app.submit(&json!({"field": field, "shrink": shrink, "outputs": ["report"]})).await;
    app.ended(&plain).await;
    let problem = refused(&plain, gradient.clone(), "d", StatusCode::CONFLICT).await;
    assert!(problem["detail"].as_str().is_some_and(|detail| detail.contains("output \"surface\"")), "{problem}");
    let full = app.submit(&json!({"field": field, "shrink": shrink, "outputs": ["surface"]})).await;
    app.ended(&full).await;
    // of the wrong shape, which only the worker knows
    let accepted: Value = asked(&app, &full, gradient, "e").await.json().await.expect("JSON");
    let ended = app.ended(accepted["id"].as_str().expect("a name")).await;
    assert_eq!((state(&ended), &ended["problem"]["code"]), ("failed", &json!("malformed_gradient")));

    let direct = app.post("/v1/jobs", &json!({"kind": "sensitivity"})).await;
    assert_eq!(direct.status(), StatusCode::UNPROCESSABLE_ENTITY);
}

/// The example in the repository; needs Python, whose absence is said.
#[tokio::test]
async fn a_latent_code_is_changed_until_the_surface_meets_a_target() {
    let folder = tempfile::tempdir().expect("folder");
    let app = App::start(folder.path());
    let example = concat!(env!("CARGO_MANIFEST_DIR"), "/examples/optimize_latent.py");
    let mut command = Command::new("python3");
    command.args([example, &app.url, NET, "--row", "3", "--volume", "0.4"]);
    let said = match tokio::task::spawn_blocking(move || command.output()).await.expect("ends") {
        Ok(said) => said,
        Err(error) => {
            eprintln!("skipped: python3 cannot be run: {error}");
            return;
        }
    };
    let out = String::from_utf8_lossy(&said.stdout).into_owned();
    assert!(said.status.success(), "{out}{}", String::from_utf8_lossy(&said.stderr));
    assert!(out.lines().count() > 1, "it began elsewhere: {out}");
}

/// The volume's slope by the code is the motion along the normals, summed over areas.
#[test]
fn the_surface_says_how_it_moves_with_its_code() {
    let folder = tempfile::tempdir().expect("folder");
    let place = |name: &str| folder.path().join(name);
    let (glb, out) = (place("s.glb"), place("s"));
    let extract =
        ["extract", NET, "--latent-row", "0", "--lattice", "octahedral:32", "-o", text(&glb), "--surface", text(&out)];
    run(&[&extract[..], &["--latent-motion"]].concat());
    let made = surface(&out);
    let (_, by_vertex) = loss(&made, [0.0; 3]);
    let (normals, motion) = (numbers(&out, "normals"), numbers(&out, "latent_motion"));
    let mut slope = [0.0; 2];
    let mut seen = vec![false; by_vertex.len()];
    for (point, &v) in made.0.vertex.iter().enumerate() {
        if !std::mem::replace(&mut seen[v as usize], true) {
            let outward: f64 = (0..3).map(|a| by_vertex[v as usize][a] * normals[3 * point + a]).sum();
            (0..2).for_each(|k| slope[k] += outward * motion[2 * point + k]);
        }
    }
    write_gradient(&place("g"), &by_vertex);
    let arguments = ["sensitivity", NET, "--latent-row", "0", "--surface", text(&out), "--gradient"];
    run(&[&arguments[..], &[text(&place("g")), "-o", text(&place("d"))]].concat());
    for (found, expected) in slope.into_iter().zip(numbers(&place("d"), "latent")) {
        assert!((found / expected - 1.0).abs() < 1e-4, "{found} {expected}");
    }
    let blob = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/fixtures/networks/blob.safetensors");
    let refused = ["extract", blob, "-o", text(&glb), "--surface", text(&out), "--latent-motion"];
    let said = Command::new(BINARY).args(refused).output().expect("runs");
    assert_eq!(said.status.code(), Some(3));
    assert!(String::from_utf8_lossy(&said.stderr).contains("takes no latent code"));
}
