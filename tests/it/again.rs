//! The request of a job, read back and sent again.

use crate::app::{App, fixture, problem, small, state};
use reqwest::{Method, StatusCode};
use serde_json::{Value, json};

const TETRAHEDRON: &[u8] = b"OFF\n4 4 0\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n3 0 2 1\n3 0 1 3\n3 0 3 2\n3 1 2 3\n";

async fn asked(app: &App, id: &str) -> Value {
    let answer = app.get(&format!("/v1/jobs/{id}/request")).await;
    assert_eq!(answer.status(), StatusCode::OK);
    answer.json().await.expect("JSON")
}

async fn upload(app: &App, bytes: Vec<u8>) -> Value {
    let answer = app.request(Method::POST, "/v1/inputs").body(bytes).send().await.expect("an answer");
    answer.json::<Value>().await.expect("JSON")["id"].clone()
}

#[tokio::test]
async fn a_request_that_is_read_back_makes_the_same_job_anew() {
    let folder = tempfile::tempdir().expect("folder");
    let app = App::start(folder.path());
    let morph = upload(&app, fixture("networks/morph.safetensors")).await;
    let mesh = upload(&app, TETRAHEDRON.into()).await;
    let lattice = json!({"octahedral": {"n": 12}});
    let first = json!({"field": {"input": morph, "latent_row": 1}, "shrink": {"lattice": lattice}, "outputs": ["glb", "surface", "report"]});
    let first = app.submit(&first).await;
    assert_eq!(state(&app.ended(&first).await), "succeeded");
    let mut labelled = small();
    labelled["labels"] = json!({"name": "egg"});
    labelled["deadline_s"] = json!(77);
    let requests = [
        labelled,
        json!({"field": {"scene": {"circle": {"radius": 0.5}}}, "shrink": {"samples": 60}}),
        json!({"field": {"input": morph, "latent_row": 1}, "shrink": {"lattice": lattice}, "warm_start": first, "latent_motion": true,
               "outputs": ["surface"]}),
        json!({"field": {"scene": {"sphere": {"radius": 0.5}}}, "weight": {"scene": {"sphere": {"radius": 2}}},
               "shrink": {"lattice": lattice, "density": "weight"}}),
        json!({"kind": "fit", "meshes": [mesh], "fit": {"layers": 2, "width": 24, "samples": 6000, "batch": 768, "epochs": 2}}),
    ];
    for request in requests {
        let id = app.submit(&request).await;
        let read = asked(&app, &id).await;
        for (member, value) in request.as_object().expect("an object") {
            // a part of the request is a part of what is read back, whose defaults are written out
            let holds = match (value, &read[member]) {
                (Value::Object(part), whole) => part.iter().all(|(name, value)| &whole[name] == value),
                (value, read) => value == read,
            };
            assert!(holds, "{member} of {read}");
        }
        let again = app.submit(&read).await;
        assert_ne!(again, id);
        assert_eq!(asked(&app, &again).await, read, "and so is its own");
        for job in [id, again] {
            app.post(&format!("/v1/jobs/{job}/cancel"), &json!({})).await;
        }
    }
    problem(app.get("/v1/jobs/01a204e3-7cfe-7621-aecf-7e493a0df60a/request").await, 404, "unknown_job").await;
    problem(app.get(&format!("/v1/jobs/{first}/request?whole=true")).await, 400, "invalid_query").await;
}
