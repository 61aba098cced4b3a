//! Keys made and revoked by the command line while the service runs, and what a tenant sees of another: nothing.

use super::app::{App, BINARY, PATIENCE, problem, small};
use super::monitoring::samples;
use reqwest::{Method, Response};
use serde_json::Value;
use std::collections::BTreeMap;
use std::path::Path;
use std::process::Command;
use std::time::{Duration, Instant};

const AUTH: [(&str, &str); 1] = [("SHRINKD_AUTH__MODE", "required")];

pub fn keys(folder: &Path, arguments: &[&str]) -> String {
    let made = Command::new(BINARY).arg("keys").args(arguments).arg("--data").arg(folder).output().expect("runs");
    assert!(made.status.success(), "{arguments:?}: {}", String::from_utf8_lossy(&made.stderr));
    String::from_utf8(made.stdout).expect("text").trim().to_owned()
}

pub async fn ask(app: &App, key: &str, method: Method, path: &str, body: &'static [u8]) -> Response {
    let media_type = if path.starts_with("/v1/jobs") { "application/json" } else { "application/octet-stream" };
    let mut request = app.request(method, path).bearer_auth(key).header("content-type", media_type);
    if !body.is_empty() {
        request = request.body(body);
    }
    request.send().await.expect("an answer")
}

pub async fn eventually(what: &str, mut look: impl AsyncFnMut() -> bool) {
    let clock = Instant::now();
    while !look().await {
        assert!(clock.elapsed() < PATIENCE, "not in time: {what}");
        tokio::time::sleep(Duration::from_millis(100)).await;
    }
}

#[tokio::test]
async fn a_key_works_until_it_is_revoked_and_only_for_what_it_allows() {
    let folder = tempfile::tempdir().expect("folder");
    let app = App::start_with(folder.path(), &AUTH);
    for path in ["/livez", "/readyz", "/openapi.json"] {
        assert_eq!(app.get(path).await.status(), 200, "{path} needs no key");
    }
    let bare = app.get("/v1/jobs").await;
    assert_eq!(bare.headers()["www-authenticate"], "Bearer realm=\"shrinkd\"");
    problem(bare, 401, "unauthenticated").await;
    let reader = keys(folder.path(), &["create", "--tenant", "a", "--scope", "read", "--name", "of a test"]);
    let made_up = format!("{}{}", &reader[..reader.len() - 2], "00");
    eventually("the new key works", async || ask(&app, &reader, Method::GET, "/v1/jobs", b"").await.status() == 200)
        .await;
    let write = ask(&app, &reader, Method::POST, "/v1/jobs", b"{}").await;
    let challenge = write.headers()["www-authenticate"].to_str().expect("text").to_owned();
    assert!(challenge.contains("insufficient_scope") && challenge.contains("scope=\"write\""), "{challenge}");
    problem(write, 403, "insufficient_scope").await;
    for wrong in [made_up.as_str(), "shrinkd_", "x", "a.b.c"] {
        let refused = ask(&app, wrong, Method::GET, "/v1/jobs", b"").await;
        let challenge = refused.headers()["www-authenticate"].to_str().expect("text").to_owned();
        assert!(challenge.contains("error=\"invalid_token\""), "{challenge}");
        problem(refused, 401, "unauthenticated").await;
    }
    let in_query = app.get(&format!("/v1/jobs?access_token={reader}")).await;
    problem(in_query, 401, "unauthenticated").await;
    let listed = keys(folder.path(), &["list"]);
    let secret = reader.rsplit('_').next().expect("a secret");
    assert!(
        listed.contains("\ta\tread\tworks\t") && listed.contains("of a test") && !listed.contains(secret),
        "{listed}"
    );
    let id = reader.split('_').nth(1).expect("an id");
    keys(folder.path(), &["revoke", id]);
    eventually("the key is refused", async || ask(&app, &reader, Method::GET, "/v1/jobs", b"").await.status() == 401)
        .await;
    assert!(keys(folder.path(), &["list"]).contains("\trevoked\t"));
    assert!(!app.log().contains(secret), "no secret is logged");
    for file in std::fs::read_dir(folder.path()).expect("folder").map(|entry| entry.expect("entry").path()) {
        let bytes = std::fs::read(&file).unwrap_or_default();
        let holds = bytes.windows(secret.len()).any(|window| window == secret.as_bytes());
        assert!(!holds, "{} holds the secret", file.display());
    }
}

/// What must be the same for another tenant's thing and for one that never was: the status, and the body apart from names.
async fn answer(response: Response, names: [&str; 2]) -> (u16, String) {
    let status = response.status().as_u16();
    let mut body: Value = serde_json::from_slice(&response.bytes().await.expect("a body")).unwrap_or_default();
    if let Some(body) = body.as_object_mut() {
        body.remove("request_id");
    }
    (status, names.iter().fold(body.to_string(), |text, name| text.replace(name, "NAME")))
}

#[tokio::test]
async fn another_tenants_things_answer_on_every_route_as_if_they_had_never_been() {
    let folder = tempfile::tempdir().expect("folder");
    let [a, b] = ["a", "b"].map(|tenant| keys(folder.path(), &["create", "--tenant", tenant]));
    let app = App::start_with(folder.path(), &AUTH);
    const SCENE: &[u8] = b"{\"sphere\": {\"radius\": 0.5}}";
    let uploaded = ask(&app, &a, Method::POST, "/v1/inputs", SCENE).await;
    assert_eq!(uploaded.status(), 201);
    let input = uploaded.json::<Value>().await.expect("JSON")["id"].as_str().expect("a name").to_owned();
    let submitted =
        app.request(Method::POST, "/v1/jobs").bearer_auth(&a).json(&small()).send().await.expect("an answer");
    let job = submitted.json::<Value>().await.expect("JSON")["id"].as_str().expect("a name").to_owned();
    eventually("the job has ended", async || {
        let seen = ask(&app, &a, Method::GET, &format!("/v1/jobs/{job}"), b"").await.json::<Value>().await;
        seen.expect("JSON")["state"] == "succeeded"
    })
    .await;
    let (no_job, no_input) = ("01900000-0000-7000-8000-000000000000", format!("sha256:{}", "0".repeat(64)));
    let document = app.get_json("/openapi.json").await;
    let mut walked = 0;
    for (path, item) in document["paths"].as_object().expect("paths") {
        if !path.contains('{') {
            continue;
        }
        for method in item.as_object().expect("operations").keys().filter(|key| *key != "parameters") {
            let method = Method::from_bytes(method.to_uppercase().as_bytes()).expect("a method");
            let (theirs, never) = if path.starts_with("/v1/inputs") { (&*input, &*no_input) } else { (&*job, no_job) };
            let mut answers = Vec::new();
            for name in [theirs, never] {
                let path = path.replace("{id}", name).replace("{name}", "report");
                let response = ask(&app, &b, method.clone(), &path, b"").await;
                answers.push(answer(response, [theirs, never]).await);
            }
            assert_eq!(answers[0], answers[1], "{method} {path}");
            assert!(answers[0].0 == 404 || answers[0].0 == 422, "{method} {path}: {answers:?}");
            walked += 1;
        }
    }
    assert!(walked >= 7, "{walked} operations");
    for (theirs, never, request) in [
        (&*input, &*no_input, r#"{"field": {"input": "NAME"}}"#),
        (&*job, no_job, r#"{"field": {"scene": {"sphere": {"radius": 0.5}}}, "warm_start": "NAME"}"#),
    ] {
        let mut answers = Vec::new();
        for name in [theirs, never] {
            let body = request.replace("NAME", name);
            let request =
                app.request(Method::POST, "/v1/jobs").bearer_auth(&b).header("content-type", "application/json");
            answers.push(answer(request.body(body).send().await.expect("an answer"), [theirs, never]).await);
        }
        assert_eq!((answers[0].0, &answers[0]), (422, &answers[1]));
    }
    let listed = ask(&app, &b, Method::GET, "/v1/jobs", b"").await.json::<Value>().await.expect("JSON");
    assert_eq!(listed["jobs"], serde_json::json!([]));
    assert_eq!(ask(&app, &b, Method::POST, "/v1/inputs", SCENE).await.status(), 201, "the same bytes are new to b");
    assert_eq!(ask(&app, &b, Method::POST, "/v1/inputs", SCENE).await.status(), 200);
    let still = ask(&app, &a, Method::GET, &format!("/v1/jobs/{job}"), b"").await;
    assert_eq!(still.status(), 200, "nothing that b did has touched it");
}

/// What requests have made the engine and the blob store do, by call and outcome.
async fn done(app: &App, operator: &str) -> BTreeMap<String, f64> {
    let told = ask(app, operator, Method::GET, "/metrics", b"").await;
    assert_eq!(told.status(), 200);
    let mut told = samples(&told.text().await.expect("text"));
    // a scrape itself asks how much there is to do
    told.retain(|series, _| {
        ["shrinkd_engine_call_duration_seconds_count{", "shrinkd_blob_operation_duration_seconds_count{"]
            .iter()
            .any(|name| series.starts_with(name))
            && !series.contains("call=\"depth\"")
    });
    told
}

/// What was done between two looks.
fn since(before: &BTreeMap<String, f64>, after: BTreeMap<String, f64>) -> BTreeMap<String, f64> {
    let more = after.into_iter().map(|(series, count)| {
        let more = count - before.get(&series).copied().unwrap_or(0.0);
        (series, more)
    });
    more.filter(|(_, more)| *more != 0.0).collect()
}

/// A gradient that is one, so that it is not what a request is refused for.
fn gradient() -> Vec<u8> {
    let header = br#"{"gradient":{"dtype":"F32","shape":[1,3],"data_offsets":[0,12]}}"#;
    [&(header.len() as u64).to_le_bytes()[..], header, &[0; 12]].concat()
}

#[tokio::test]
async fn what_another_tenant_has_is_looked_for_no_longer_than_what_never_was() {
    let folder = tempfile::tempdir().expect("folder");
    let [a, b] = ["a", "b"].map(|tenant| keys(folder.path(), &["create", "--tenant", tenant]));
    let operator = keys(folder.path(), &["create", "--tenant", "c", "--scope", "operate"]);
    let app = App::start_with(folder.path(), &AUTH);
    let uploaded = ask(&app, &a, Method::POST, "/v1/inputs", b"{\"sphere\": {\"radius\": 0.5}}").await;
    let input = uploaded.json::<Value>().await.expect("JSON")["id"].as_str().expect("a name").to_owned();
    let submitted =
        app.request(Method::POST, "/v1/jobs").bearer_auth(&a).json(&small()).send().await.expect("an answer");
    let job = submitted.json::<Value>().await.expect("JSON")["id"].as_str().expect("a name").to_owned();
    eventually("the job has ended", async || {
        let seen = ask(&app, &a, Method::GET, &format!("/v1/jobs/{job}"), b"").await.json::<Value>().await;
        seen.expect("JSON")["state"] == "succeeded"
    })
    .await;
    // the collector looks through the store once at the start, at descriptions, blobs and checkpoints, and then not for an hour
    eventually("the collector is done", async || {
        let listed = done(&app, &operator).await;
        let listed = listed.iter().filter(|(series, _)| series.contains("operation=\"list\"")).map(|(_, count)| count);
        listed.sum::<f64>() >= 3.0
    })
    .await;
    let (no_job, no_input) = ("01900000-0000-7000-8000-000000000000", format!("sha256:{}", "0".repeat(64)));
    let of_input = r#"{"field": {"input": "NAME"}}"#;
    let of_weight = r#"{"field": {"scene": {"sphere": {"radius": 0.5}}}, "weight": {"input": "NAME"}}"#;
    let of_meshes = r#"{"kind": "fit", "meshes": ["NAME"]}"#;
    let warm = r#"{"field": {"scene": {"sphere": {"radius": 0.5}}}, "warm_start": "NAME"}"#;
    // a method, a path, a body, and whether it names an input
    let mut requests: Vec<(Method, String, Vec<u8>, bool)> = Vec::new();
    for (body, of_an_input) in [(of_input, true), (of_weight, true), (of_meshes, true), (warm, false)] {
        for path in ["/v1/jobs", "/v1/jobs?validate_only=true"] {
            requests.push((Method::POST, path.to_owned(), body.as_bytes().to_vec(), of_an_input));
        }
    }
    for query in ["?wait=1", "/events?after=3", "/outputs/glb"] {
        requests.push((Method::GET, format!("/v1/jobs/NAME{query}"), Vec::new(), false));
    }
    let document = app.get_json("/openapi.json").await;
    for (path, item) in document["paths"].as_object().expect("paths").iter().filter(|(path, _)| path.contains("{id}")) {
        for method in item.as_object().expect("operations").keys().filter(|key| *key != "parameters") {
            let method = Method::from_bytes(method.to_uppercase().as_bytes()).expect("a method");
            let body = if path.ends_with("/sensitivity") { gradient() } else { Vec::new() };
            let of_an_input = path.starts_with("/v1/inputs");
            requests.push((method, path.replace("{id}", "NAME").replace("{name}", "report"), body, of_an_input));
        }
    }
    assert!(requests.len() >= 18, "{requests:?}");
    for (method, path, body, of_an_input) in requests {
        let (theirs, never) = if of_an_input { (&*input, &*no_input) } else { (&*job, no_job) };
        let mut all = Vec::new();
        for name in [theirs, never] {
            let before = done(&app, &operator).await;
            let media_type = if body.starts_with(b"{") { "application/json" } else { "application/octet-stream" };
            let named = String::from_utf8(body.clone()).map(|body| body.replace("NAME", name).into_bytes());
            let request = app.request(method.clone(), &path.replace("NAME", name)).bearer_auth(&b);
            let request = request.header("content-type", media_type).body(named.unwrap_or_else(|_| body.clone()));
            let answered = answer(request.send().await.expect("an answer"), [theirs, never]).await;
            all.push((answered, since(&before, done(&app, &operator).await)));
        }
        assert_eq!(all[0], all[1], "{method} {path}");
        assert!(!all[0].1.is_empty(), "{method} {path} was not looked for: {all:?}");
        assert!([404, 422].contains(&all[0].0.0), "{method} {path}: {all:?}");
    }
}

#[tokio::test]
async fn figures_over_all_tenants_are_for_whoever_operates_the_service() {
    let folder = tempfile::tempdir().expect("folder");
    let key = |scope: &str| keys(folder.path(), &["create", "--tenant", "a", "--scope", scope]);
    let (client, operator) = (key("read,write"), key("operate"));
    let app = App::start_with(folder.path(), &AUTH);
    problem(app.get("/metrics").await, 401, "unauthenticated").await;
    let refused = ask(&app, &client, Method::GET, "/metrics", b"").await;
    let challenge = refused.headers()["www-authenticate"].to_str().expect("text").to_owned();
    assert!(challenge.contains("scope=\"operate\""), "{challenge}");
    problem(refused, 403, "insufficient_scope").await;
    let told = ask(&app, &operator, Method::GET, "/metrics", b"").await;
    assert_eq!(told.status(), 200);
    assert!(told.text().await.expect("text").contains("shrinkd_build_info"));
    // and who operates it has no part in what tenants do with it
    problem(ask(&app, &operator, Method::GET, "/v1/jobs", b"").await, 403, "insufficient_scope").await;
    problem(ask(&app, &operator, Method::POST, "/v1/jobs", b"{}").await, 403, "insufficient_scope").await;
    assert_eq!(ask(&app, &client, Method::GET, "/v1/jobs", b"").await.status(), 200);
}

#[test]
fn strangers_are_not_let_in_unless_it_is_said() {
    let folder = tempfile::tempdir().expect("folder");
    let refused = Command::new(BINARY).args(["serve", "--listen", "0.0.0.0:0", "--data"]).arg(folder.path()).output();
    let refused = refused.expect("runs");
    assert_eq!(refused.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&refused.stderr).contains("auth.mode"), "{refused:?}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_key_of_a_cluster_works_on_every_node_until_it_is_revoked() {
    let Some(server) = crate::cluster::nats_server::NatsServer::start() else { return };
    let folder = tempfile::tempdir().expect("folder");
    let (engine, url) = (("SHRINKD_ENGINE", server.url()), server.url());
    let nodes = [0, 1].map(|_| App::start_with(folder.path(), &[AUTH[0], (engine.0, &engine.1)]));
    let key = keys(folder.path(), &["create", "--tenant", "a", "--scope", "read", "--engine", &url]);
    let all_answer = async |status: u16| {
        for node in &nodes {
            eventually("every node knows", async || {
                ask(node, &key, Method::GET, "/v1/jobs", b"").await.status() == status
            })
            .await;
        }
    };
    all_answer(200).await;
    assert!(keys(folder.path(), &["list", "--engine", &url]).contains("\ta\tread\tworks\t"));
    keys(folder.path(), &["revoke", key.split('_').nth(1).expect("an id"), "--engine", &url]);
    all_answer(401).await;
}
