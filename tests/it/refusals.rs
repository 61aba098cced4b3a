//! Bad input of every kind: refused with the right problem, at the right place, without harm.

use crate::app::{App, fixture, problem, small, state};
use reqwest::Method;
use serde_json::{Value, json};

async fn raw(app: &App, body: impl Into<reqwest::Body>) -> reqwest::Response {
    let request = app.request(Method::POST, "/v1/jobs").header("content-type", "application/json");
    request.body(body).send().await.expect("an answer")
}

#[tokio::test]
async fn what_is_not_json_is_refused_before_anything_else() {
    let folder = tempfile::tempdir().expect("folder");
    let app = App::start(folder.path());
    for body in ["", "{", "{\"field\": }", "{\"field\": NaN}", "{\"field\": {\"level\": 1e999}}", "{} {}", "\u{feff}{}"]
    {
        problem(raw(&app, body).await, 400, "malformed_json").await;
    }
    problem(raw(&app, b"{\"a\": \"\xff\"}".to_vec()).await, 400, "malformed_json").await;
    let deep = format!("{{\"field\": {{\"scene\": {}{}}}}}", "{\"round\": ".repeat(10_000), "}".repeat(10_000));
    problem(raw(&app, deep).await, 400, "too_deep").await;
    let lists = format!("{}{}", "[".repeat(10_000), "]".repeat(10_000));
    problem(raw(&app, lists).await, 400, "too_deep").await;
    let typed = |media_type: &'static str| {
        app.request(Method::POST, "/v1/jobs").header("content-type", media_type).body(small().to_string()).send()
    };
    problem(typed("text/plain").await.expect("an answer"), 415, "unsupported_media_type").await;
    problem(typed("application/x-www-form-urlencoded").await.expect("an answer"), 415, "unsupported_media_type").await;
    assert_eq!(app.get_json("/v1/jobs").await["jobs"], json!([]), "nothing was accepted");
}

#[tokio::test]
async fn every_fault_of_a_request_is_named_by_its_place() {
    let folder = tempfile::tempdir().expect("folder");
    let app = App::start(folder.path());
    let cases = [
        (json!({}), "/field", "missing_member"),
        (json!([]), "", "wrong_type"),
        (json!({"field": {"scene": {"sphere": {"radius": 0.5}}}, "colour": "red"}), "/colour", "unknown_member"),
        (json!({"field": {"scene": {"sphere": {"radius": 0.5}}, "levle": 0}}), "/field/levle", "unknown_member"),
        (json!({"field": {"input": "md5:00"}}), "/field/input", "invalid_id"),
        (json!({"field": {"input": format!("sha256:{}", "0".repeat(64))}}), "/field/input", "unknown_input"),
        (
            json!({"field": {"scene": {"sphere": {"radius": 0.5}}}, "shrink": {"lattice": {"octahedral": {"n": 501}}}}),
            "/shrink/lattice/octahedral/n",
            "out_of_range",
        ),
        (json!({"field": {"scene": {"sphere": {"radius": 0.5}}}, "outputs": ["stl"]}), "/outputs/0", "unknown_value"),
        (
            json!({"field": {"scene": {"sphere": {"radius": 0.5}}}, "weight": {"input": format!("sha256:{}", "0".repeat(64))}}),
            "/weight/input",
            "unknown_input",
        ),
        (
            json!({"field": {"scene": {"sphere": {"radius": 0.5}}}, "weight": {"scene": {"circle": {"radius": 0.5}}}}),
            "/weight",
            "dimension",
        ),
        (
            json!({"field": {"scene": {"circle": {"radius": 0.5}}}, "weight": {"scene": {"sphere": {"radius": 0.5}}}}),
            "/weight",
            "dimension",
        ),
    ];
    for (body, pointer, code) in cases {
        let document = problem(app.post("/v1/jobs", &body).await, 422, "invalid_request").await;
        assert_eq!(
            (&document["errors"][0]["pointer"], &document["errors"][0]["code"]),
            (&json!(pointer), &json!(code)),
            "{body}"
        );
    }
    let scene =
        json!({"field": {"scene": {"union": {"of": [{"sphere": {"radius": 0.5}}, {"blob": {}}, {"sphere": {}}]}}}});
    let document = problem(app.post("/v1/jobs", &scene).await, 422, "invalid_request").await;
    let pointers: Vec<&str> =
        document["errors"].as_array().expect("a list").iter().filter_map(|e| e["pointer"].as_str()).collect();
    assert!(pointers.len() >= 2, "both faults: {document}");
    assert!(pointers.iter().all(|p| p.starts_with("/field/scene/union/of/")), "{pointers:?}");
}

#[tokio::test]
async fn a_shape_that_cannot_be_wrapped_fails_with_its_cause() {
    let folder = tempfile::tempdir().expect("folder");
    let app = App::start(folder.path());
    let at = |x: f64, radius: f64| json!({"translate": {"by": [x, 0, 0], "of": {"sphere": {"radius": radius}}}});
    let cases = [
        (json!({"intersection": {"of": [at(-0.5, 0.2), at(0.5, 0.2)]}}), "empty_zero_set"),
        // outside the domain, which is the cube of half extent 1
        (at(5.0, 0.5), "empty_zero_set"),
        (json!({"union": {"of": [at(-0.5, 0.3), at(0.5, 0.3)]}}), "components"),
        (json!({"torus": {"major": 0.5, "minor": 0.2}}), "genus"),
    ];
    for (scene, code) in cases {
        let id = app.submit(&json!({"field": {"scene": scene}})).await;
        let job = app.ended(&id).await;
        assert_eq!((state(&job), &job["problem"]["code"]), ("failed", &json!(code)), "{job}");
        assert_eq!(job["problem"]["type"], format!("urn:shrinkd:problem:{code}"));
        assert_eq!((&job["outputs"], &job["metrics"]), (&json!([]), &json!(null)));
    }
}

#[tokio::test]
async fn a_file_that_is_no_field_is_refused_when_it_arrives() {
    let folder = tempfile::tempdir().expect("folder");
    let app = App::start(folder.path());
    let upload = |body: Vec<u8>| app.request(Method::POST, "/v1/inputs").body(body).send();
    let half = |name: &str| {
        let whole = fixture(name);
        whole[..whole.len() / 2].to_vec()
    };
    let deep = [b"{\"round\": ".repeat(10_000), b"}".repeat(10_000)].concat();
    let files: [(&str, Vec<u8>); 10] = [
        ("nothing", Vec::new()),
        ("noise", (0..4096u32).map(|i| (i.wrapping_mul(2_654_435_761) >> 13) as u8).collect()),
        ("a broken scene", b"{\"sphere\": {\"radius\": ".to_vec()),
        ("a scene with a fault", b"{\"sphere\": {\"radius\": -1}}".to_vec()),
        ("a scene nested 10,000 deep", deep),
        ("a truncated npz", half("networks/blob.npz")),
        ("a truncated safetensors", half("networks/blob.safetensors")),
        ("a truncated checkpoint", half("networks/families/blob_siren.pth")),
        ("a truncated graph", half("networks/onnx/siren.onnx")),
        ("a pickled module, which would have to be run", fixture("networks/torch/whole_module.pth")),
    ];
    for (what, bytes) in files {
        let response = upload(bytes).await.expect("an answer");
        assert_eq!(response.status(), 422, "{what}");
        assert_eq!(response.headers()["content-type"], "application/problem+json");
        let document: Value = response.json().await.expect("JSON");
        let code = document["code"].as_str().expect("a code");
        let known = ["unrecognized_input", "malformed_input", "invalid_scene", "over_limit", "unsupported_input"];
        assert!(known.contains(&code), "{what}: {document}");
    }
    problem(app.get("/v1/inputs/sha256:00").await, 404, "unknown_input").await;
    problem(app.get("/v1/inputs/%2e%2e%2fetc").await, 404, "unknown_input").await;
}

#[tokio::test]
async fn what_is_not_there_or_not_offered_is_a_problem_too() {
    let folder = tempfile::tempdir().expect("folder");
    let app = App::start(folder.path());
    problem(app.get("/v2/jobs").await, 404, "unknown_route").await;
    problem(app.get("/v1/jobs/x").await, 404, "unknown_job").await;
    problem(app.get("/v1/jobs/%ff").await, 400, "bad_request").await;
    problem(app.get("/v1/jobs/01a204bd-6753-7535-9d12-52ce14175322/events").await, 404, "unknown_job").await;
    problem(app.get("/v1/jobs/01a204bd-6753-7535-9d12-52ce14175322/outputs/glb").await, 404, "unknown_job").await;
    let put = app.request(Method::PUT, "/v1/jobs").send().await.expect("an answer");
    let allow = put.headers()["allow"].to_str().expect("text").to_owned();
    assert!(allow.contains("GET") && allow.contains("POST"), "{allow}");
    problem(put, 405, "method_not_allowed").await;
    for query in [
        "limit=0",
        "limit=x",
        "limit=201",
        "cursor=!",
        "state=done",
        "label=x",
        "created_from=today",
        "colour=red",
        "limit=1&limit=2",
    ] {
        problem(app.get(&format!("/v1/jobs?{query}")).await, 400, "invalid_query").await;
    }
    let id = app.submit(&small()).await;
    let events = app.request(Method::GET, &format!("/v1/jobs/{id}/events"));
    let odd = events.try_clone().expect("no body").header("last-event-id", "x").send().await.expect("an answer");
    problem(odd, 400, "invalid_header").await;
    problem(events.header("accept", "image/png").send().await.expect("an answer"), 406, "not_acceptable").await;
}

#[tokio::test]
async fn a_body_that_is_too_large_is_refused_and_the_answer_arrives() {
    let folder = tempfile::tempdir().expect("folder");
    let limits = [("SHRINKD_LIMITS__BODY_BYTES", "1000"), ("SHRINKD_LIMITS__INPUT_BYTES", "2000")];
    let app = App::start_with(folder.path(), &limits);
    let padded = |size: usize| format!("{}{}", small(), " ".repeat(size - small().to_string().len()));
    assert_eq!(raw(&app, padded(1000)).await.status(), 202);
    problem(raw(&app, padded(1001)).await, 413, "body_too_large").await;
    // larger than what lies in any buffer between the two
    problem(raw(&app, padded(8 << 20)).await, 413, "body_too_large").await;
    let upload = app.request(Method::POST, "/v1/inputs").body(vec![0u8; 2001]).send().await.expect("an answer");
    problem(upload, 413, "body_too_large").await;
}

#[tokio::test]
async fn a_request_keeps_the_id_that_its_client_gave_it() {
    let folder = tempfile::tempdir().expect("folder");
    let app = App::start(folder.path());
    let named = |id: &'static str| app.request(Method::GET, "/nowhere").header("x-request-id", id).send();
    let response = named("abc-123").await.expect("an answer");
    assert_eq!(response.headers()["x-request-id"], "abc-123");
    assert_eq!(problem(response, 404, "unknown_route").await["request_id"], "abc-123");
    let odd = named("a b").await.expect("an answer");
    assert_ne!(odd.headers()["x-request-id"], "a b", "an id that could break a log line is replaced");
}

#[tokio::test]
async fn another_origin_is_not_let_in() {
    let folder = tempfile::tempdir().expect("folder");
    let app = App::start(folder.path());
    let response =
        app.request(Method::GET, "/livez").header("origin", "http://elsewhere.test").send().await.expect("an answer");
    assert!(!response.headers().contains_key("access-control-allow-origin"));
}
