//! The whole way: submit, follow, download.

use crate::app::{App, PATIENCE, endless, fixture, small, state};
use eventsource_stream::Eventsource;
use futures::StreamExt;
use reqwest::{Method, StatusCode};
use serde_json::{Value, json};
use sha2::{Digest, Sha256};

/// The events of a job until its stream ends: number, kind, body.
pub async fn follow(app: &App, id: &str, last_seen: Option<u64>) -> Vec<(u64, String, Value)> {
    let mut request = app.request(Method::GET, &format!("/v1/jobs/{id}/events"));
    if let Some(last) = last_seen {
        request = request.header("last-event-id", last.to_string());
    }
    frames(request.send().await.expect("an answer")).await
}

/// The events of a stream until it ends: number, kind, body.
pub async fn frames(response: reqwest::Response) -> Vec<(u64, String, Value)> {
    assert_eq!(response.status(), StatusCode::OK);
    assert_eq!(response.headers()["content-type"], "text/event-stream");
    let mut stream = response.bytes_stream().eventsource();
    let mut events = Vec::new();
    // a stream that breaks off ends the list
    while let Some(Ok(event)) = stream.next().await {
        let body = serde_json::from_str(&event.data).expect("JSON");
        events.push((event.id.parse().expect("a number"), event.event, body));
    }
    events
}

/// The SHA-256 of bytes, as outputs and inputs are named by it.
pub fn hex(bytes: &[u8]) -> String {
    Sha256::digest(bytes).iter().map(|b| format!("{b:02x}")).collect()
}

#[tokio::test]
async fn a_scene_goes_in_and_a_parameterized_surface_comes_out() {
    let folder = tempfile::tempdir().expect("folder");
    let app = App::start(folder.path());
    let mut request = small();
    request["outputs"] = json!(["glb", "surface", "preview", "report"]);
    request["labels"] = json!({"project": "demo"});
    let response = app.post("/v1/jobs", &request).await;
    assert_eq!(response.status(), StatusCode::ACCEPTED);
    assert!(response.headers().contains_key("retry-after"));
    let location = response.headers()["location"].to_str().expect("text").to_owned();
    let accepted: Value = response.json().await.expect("JSON");
    let id = accepted["id"].as_str().expect("a name");
    assert_eq!(location, format!("/v1/jobs/{id}"));
    assert_eq!((state(&accepted), &accepted["attempt"]), ("queued", &json!(0)));

    let job = app.ended(id).await;
    assert_eq!(state(&job), "succeeded", "{job}");
    assert_eq!(job["attempt"], 1);
    assert_eq!(job["labels"], json!({"project": "demo"}));
    assert_eq!(job["metrics"]["vertices"], 32 * 15 + 2);
    assert_eq!(job["metrics"]["euler"], 2);
    for (name, magic, media_type) in [
        ("glb", b"glTF".as_slice(), "model/gltf-binary"),
        ("surface", b"", "application/octet-stream"),
        ("preview", b"\x89PNG", "image/png"),
        ("report", b"{", "application/json"),
    ] {
        let output = job["outputs"].as_array().expect("a list").iter().find(|o| o["name"] == name).expect(name);
        let response = app.get(output["href"].as_str().expect("a path")).await;
        assert_eq!(response.status(), StatusCode::OK);
        assert_eq!(response.headers()["content-type"], media_type);
        assert_eq!(
            response.headers()["etag"].to_str().expect("text"),
            format!("\"{}\"", output["sha256"].as_str().expect("hash"))
        );
        let bytes = response.bytes().await.expect("bytes");
        assert!(bytes.starts_with(magic), "{name}");
        assert_eq!(output["bytes"], bytes.len());
        assert_eq!(output["sha256"], hex(&bytes), "{name}");
        if name == "report" {
            assert_eq!(serde_json::from_slice::<Value>(&bytes).expect("JSON"), job["metrics"]);
        }
    }
    let log = app.log();
    let submitted = log.lines().find(|line| line.contains("job submitted")).expect("logged");
    assert!(submitted.contains(id) && submitted.contains("request.id"), "{submitted}");
}

#[tokio::test]
async fn a_stream_begins_with_a_snapshot_and_ends_with_done() {
    let folder = tempfile::tempdir().expect("folder");
    let app = App::start(folder.path());
    let id = app.submit(&small()).await;
    let events = follow(&app, &id, None).await;
    let kinds: Vec<&str> = events.iter().map(|(_, kind, _)| kind.as_str()).collect();
    assert_eq!((kinds[0], kinds[kinds.len() - 1]), ("snapshot", "done"), "{kinds:?}");
    assert!(events.windows(2).all(|w| w[1].0 == w[0].0 + 1), "without a gap: {events:?}");
    assert_eq!(state(&events[events.len() - 1].2), "succeeded");

    let all = follow(&app, &id, Some(0)).await;
    assert_eq!(all.iter().map(|e| e.0).collect::<Vec<_>>(), (1..=all.len() as u64).collect::<Vec<_>>());
    let states: Vec<&str> = all.iter().filter(|e| e.1 == "state").map(|e| state(&e.2)).collect();
    assert_eq!(states, ["queued", "running", "succeeded"]);
    assert!(all.iter().any(|e| e.1 == "progress" && e.2["fraction"].is_number()), "progress is told");
    let middle = all.len() as u64 / 2;
    assert_eq!(follow(&app, &id, Some(middle)).await, all[middle as usize..]);

    let last = all.len() as u64;
    let again = app.request(Method::GET, &format!("/v1/jobs/{id}/events")).header("last-event-id", last.to_string());
    assert_eq!(again.send().await.expect("an answer").status(), StatusCode::NO_CONTENT, "nothing will come any more");
    assert_eq!(app.get(&format!("/v1/jobs/{id}/events?after={last}")).await.status(), StatusCode::NO_CONTENT);
}

#[tokio::test]
async fn events_are_also_had_as_pages() {
    let folder = tempfile::tempdir().expect("folder");
    let app = App::start(folder.path());
    let id = app.submit(&small()).await;
    app.ended(&id).await;
    let all = follow(&app, &id, Some(0)).await;
    let (mut after, mut paged) = (0, Vec::new());
    loop {
        let path = format!("/v1/jobs/{id}/events?after={after}&limit=2");
        let response = app.request(Method::GET, &path).header("accept", "application/json").send().await;
        let page: Value = response.expect("an answer").json().await.expect("JSON");
        assert_eq!(page["ended"], true);
        for event in page["events"].as_array().expect("a list") {
            paged.push((
                event["seq"].as_u64().expect("number"),
                event["type"].as_str().expect("kind").to_owned(),
                event["data"].clone(),
            ));
        }
        after = page["next_after"].as_u64().expect("a number");
        if after == page["newest"] {
            break;
        }
    }
    assert_eq!(paged, all);
}

#[tokio::test]
async fn an_uploaded_scene_is_described_and_used_by_its_hash() {
    let folder = tempfile::tempdir().expect("folder");
    let app = App::start(folder.path());
    let scene = r#"{"ellipsoid": {"radii": [0.6, 0.5, 0.4]}}"#;
    let upload = || async { app.request(Method::POST, "/v1/inputs").body(scene).send().await.expect("an answer") };
    let first = upload().await;
    assert_eq!(first.status(), StatusCode::CREATED);
    let location = first.headers()["location"].to_str().expect("text").to_owned();
    let input: Value = first.json().await.expect("JSON");
    assert_eq!(input["id"], format!("sha256:{}", hex(scene.as_bytes())));
    assert_eq!((&input["bytes"], &input["description"]["kind"]), (&json!(scene.len()), &json!("scene")));
    let second = upload().await;
    assert_eq!(second.status(), StatusCode::OK);
    assert_eq!(second.json::<Value>().await.expect("JSON"), input);
    assert_eq!(app.get_json(&location).await, input);

    let mut request = small();
    request["field"] = json!({"input": input["id"]});
    let id = app.submit(&request).await;
    assert_eq!(state(&app.ended(&id).await), "succeeded");
}

/// Uploads a network, wraps it with these members of its field, and returns its description and the job.
async fn wrapped(app: &App, file: &str, members: Value) -> (Value, Value) {
    let upload = app.request(Method::POST, "/v1/inputs").body(fixture(&format!("networks/{file}"))).send();
    let input: Value = upload.await.expect("an answer").json().await.expect("JSON");
    let mut request = small();
    request["field"] = members;
    request["field"]["input"] = input["id"].clone();
    let id = app.submit(&request).await;
    (input["description"].clone(), app.ended(&id).await)
}

#[tokio::test]
async fn a_network_gives_the_same_surface_from_pytorch_as_from_our_own_format_once_it_is_said_what_no_file_says() {
    let folder = tempfile::tempdir().expect("folder");
    let app = App::start(folder.path());
    for (own, theirs, family, members, mut said) in [
        ("blob.safetensors", "families/blob_siren.pth", "siren", json!({}), json!({"w0": 12.0})),
        (
            "morph.safetensors",
            "families/morph_deep_sdf.pth",
            "deep_sdf_struct",
            json!({"latent_row": 2}),
            json!({"latent_row": 2, "activation": {"softplus": {"beta": 100.0}}}),
        ),
    ] {
        let (description, ours) = wrapped(&app, own, members).await;
        said["domain"] = description["domain"].clone();
        let (description, job) = wrapped(&app, theirs, said).await;
        assert_eq!((&description["format"], &description["family"]), (&json!("torch"), &json!(family)));
        assert!(description["assumed"].as_array().is_some_and(|list| !list.is_empty()), "{description}");
        assert_eq!(state(&job), "succeeded", "{job}");
        let metrics = |job: &Value, name: &str| job["metrics"][name].clone();
        assert_eq!(metrics(&job, "network")["family"], json!(family), "the report says what was detected: {job}");
        for name in ["vertices", "evaluations", "normal_consistency", "distance"] {
            assert_ne!(metrics(&job, name), Value::Null, "{name}");
            assert_eq!(metrics(&job, name), metrics(&ours, name), "{theirs}: {name}");
        }
    }
}

#[tokio::test]
async fn a_deep_sdf_with_layer_norms_is_told_and_wrapped() {
    let folder = tempfile::tempdir().expect("folder");
    let app = App::start(folder.path());
    let (description, job) = wrapped(&app, "families/two_lobes.pth", json!({"latent_row": 1})).await;
    assert_eq!((&description["family"], &description["latent_rows"]), (&json!("deep_sdf"), &json!(2)), "{description}");
    assert!(description["because"].as_str().is_some_and(|b| b.contains("layer norms")), "{description}");
    assert!(description["assumed"].to_string().contains("1e-5"), "{description}");
    assert_eq!(state(&job), "succeeded", "{job}");
    assert_eq!(job["metrics"]["verdict"]["passed"], true, "{job}");
}

#[tokio::test]
async fn an_uploaded_network_is_described_and_wrapped_for_a_latent_code() {
    let folder = tempfile::tempdir().expect("folder");
    let app = App::start(folder.path());
    let upload = app.request(Method::POST, "/v1/inputs").body(fixture("networks/morph.safetensors")).send();
    let input: Value = upload.await.expect("an answer").json().await.expect("JSON");
    let description = &input["description"];
    assert_eq!((&description["kind"], &description["format"]), (&json!("network"), &json!("safetensors")), "{input}");
    assert!(description["latent_rows"].as_u64() > Some(0) && description["parameters"].as_u64() > Some(0));
    let mut request = small();
    request["field"] = json!({"input": input["id"], "latent_row": 1});
    let id = app.submit(&request).await;
    let job = app.ended(&id).await;
    assert_eq!(state(&job), "succeeded", "{job}");

    request["field"] = json!({"input": input["id"], "latent_row": 1000});
    let id = app.submit(&request).await;
    let job = app.ended(&id).await;
    assert_eq!(
        (state(&job), &job["problem"]["errors"][0]["pointer"]),
        ("failed", &json!("/field/latent_row")),
        "{job}"
    );
}

#[tokio::test]
async fn a_client_may_wait_for_the_end() {
    let folder = tempfile::tempdir().expect("folder");
    let app = App::start(folder.path());
    let submit = app.request(Method::POST, "/v1/jobs").header("prefer", "wait=60").json(&small());
    let response = submit.send().await.expect("an answer");
    assert_eq!(response.status(), StatusCode::OK);
    assert_eq!(response.headers()["preference-applied"], "wait=60");
    assert_eq!(state(&response.json().await.expect("JSON")), "succeeded");

    let id = app.submit(&small()).await;
    assert_eq!(state(&app.get_json(&format!("/v1/jobs/{id}?wait=60")).await), "succeeded");

    let id = app.submit(&endless()).await;
    let soon = tokio::time::timeout(PATIENCE, app.get(&format!("/v1/jobs/{id}?wait=1"))).await.expect("in time");
    assert!(soon.headers().contains_key("retry-after"), "it has not ended, and says when to look again");
    app.post(&format!("/v1/jobs/{id}/cancel"), &json!(null)).await;
}

#[tokio::test]
async fn the_result_does_not_depend_on_the_number_of_threads() {
    let mut hashes = Vec::new();
    for threads in ["1", "16"] {
        let folder = tempfile::tempdir().expect("folder");
        let app = App::start_with(folder.path(), &[("SHRINKD_WORKER__THREADS", threads)]);
        let request = json!({
            "field": {"scene": {"smooth_union": {"k": 0.1, "of": [
                {"sphere": {"radius": 0.4}},
                {"translate": {"by": [0.3, 0.1, 0.2], "of": {"sphere": {"radius": 0.3}}}},
            ]}}},
            "shrink": {"lattice": {"octahedral": {"n": 16}}},
            "outputs": ["glb", "surface", "preview"],
        });
        let id = app.submit(&request).await;
        let job = app.ended(&id).await;
        assert_eq!(state(&job), "succeeded", "{job}");
        let outputs = job["outputs"].as_array().expect("a list").iter();
        hashes.push(outputs.map(|o| (o["name"].clone(), o["sha256"].clone())).collect::<Vec<_>>());
    }
    assert_eq!(hashes[0], hashes[1]);
}
