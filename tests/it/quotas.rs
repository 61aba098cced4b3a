//! What one tenant may have of the service, and that another gets its turn.

use crate::app::{App, endless, problem, small, state};
use crate::tenants::{ask, eventually, keys};
use reqwest::{Method, Response, StatusCode};
use serde_json::{Value, json};

fn header<'a>(answer: &'a Response, name: &str) -> &'a str {
    answer.headers().get(name).unwrap_or_else(|| panic!("no {name}: {answer:?}")).to_str().expect("text")
}

/// Long enough for others to come meanwhile.
fn slow() -> Value {
    json!({
        "field": {"scene": {"ellipsoid": {"radii": [0.7, 0.5, 0.4]}}},
        "shrink": {"method": "paper", "lattice": {"latlong": {"n_theta": 400, "n_phi": 200}}},
        "outputs": ["report"],
    })
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_tenant_with_a_thousand_jobs_does_not_delay_anothers_one() {
    let folder = tempfile::tempdir().expect("folder");
    let app = App::start_with(folder.path(), &[("SHRINKD_AUTH__MODE", "required")]);
    let key = |tenant| keys(folder.path(), &["create", "--tenant", tenant, "--scope", "read", "--scope", "write"]);
    let (many, one) = (key("many"), key("one"));
    for key in [&many, &one] {
        eventually("the key works", async || ask(&app, key, Method::GET, "/v1/jobs", b"").await.status() == 200).await;
    }
    let submit = async |key: &str, body: &Value| -> String {
        let sent = app.request(Method::POST, "/v1/jobs").bearer_auth(key).json(body).send().await.expect("an answer");
        assert_eq!(sent.status(), StatusCode::ACCEPTED);
        sent.json::<Value>().await.expect("JSON")["id"].as_str().expect("a name").to_owned()
    };
    let mut first = String::new();
    for _ in 0..1000 {
        first = submit(&many, &slow()).await;
    }
    let id = submit(&one, &small()).await;
    let job = |key: String, id: String| {
        let app = &app;
        async move { ask(app, &key, Method::GET, &format!("/v1/jobs/{id}"), b"").await.json::<Value>().await.expect("JSON") }
    };
    eventually("the one ends", async || state(&job(one.clone(), id.clone()).await) == "succeeded").await;
    // the last of the many still waits, and so do most of them
    assert_eq!(state(&job(many.clone(), first.clone()).await), "queued");
    let waiting = ask(&app, &many, Method::GET, "/v1/jobs?state=queued&limit=100", b"").await;
    let waiting: Value = waiting.json().await.expect("JSON");
    assert_eq!(waiting["jobs"].as_array().map(Vec::len), Some(100), "{waiting}");
}

#[tokio::test]
async fn what_is_over_a_quota_is_refused_and_told() {
    let folder = tempfile::tempdir().expect("folder");
    let quotas = [
        ("SHRINKD_QUOTAS__DEFAULT__QUEUED", "1"),
        ("SHRINKD_QUOTAS__DEFAULT__UPLOAD_BYTES_PER_HOUR", "2000"),
        ("SHRINKD_QUOTAS__DEFAULT__VERTICES_PER_HOUR", "3000000"),
        ("SHRINKD_WORKER__SLOTS", "1"),
    ];
    let app = App::start_with(folder.path(), &quotas);
    let submit = async |key: &str, body: &Value| {
        let request = app.request(Method::POST, "/v1/jobs").header("Idempotency-Key", key).json(body);
        request.send().await.expect("an answer")
    };
    let vertices = async |body: &Value| {
        let estimate: Value = app.post("/v1/jobs?validate_only=true", body).await.json().await.expect("JSON");
        estimate["vertices"].as_u64().expect("an estimate")
    };
    let left = 3_000_000 - vertices(&endless()).await - vertices(&slow()).await;
    // one that runs, one that waits
    let running: Value = submit("a", &endless()).await.json().await.expect("JSON");
    app.running(running["id"].as_str().expect("a name")).await;
    assert_eq!(submit("b", &slow()).await.status(), StatusCode::ACCEPTED);
    let refused = submit("c", &small()).await;
    assert_eq!(header(&refused, "ratelimit-policy"), "\"queued\";q=1");
    assert!(header(&refused, "ratelimit").starts_with("\"queued\";r=0;t="), "{refused:?}");
    assert!(header(&refused, "retry-after").parse::<u32>().is_ok_and(|s| s >= 1));
    let told = problem(refused, 429, "quota_exceeded").await;
    assert!(told["detail"].as_str().is_some_and(|detail| detail.contains("queued")), "{told}");
    let again = submit("b", &slow()).await;
    assert_eq!(header(&again, "idempotent-replayed"), "true", "what was accepted is answered");
    // there is room again, and not for as many vertices
    let id = again.json::<Value>().await.expect("JSON")["id"].as_str().expect("a name").to_owned();
    app.post(&format!("/v1/jobs/{id}/cancel"), &json!({})).await;
    let refused = submit("d", &endless()).await;
    assert_eq!(header(&refused, "ratelimit-policy"), "\"vertices_per_hour\";q=3000000;w=3600");
    let told = header(&refused, "ratelimit");
    assert!(told.starts_with(&format!("\"vertices_per_hour\";r={left};t=")), "{told}");
    problem(refused, 429, "quota_exceeded").await;
    assert_eq!(submit("e", &small()).await.status(), StatusCode::ACCEPTED);

    let scene = |pad: usize| format!("{{\"sphere\": {{\"radius\": 0.5}}}}{}", " ".repeat(pad));
    let upload =
        async |body: String| app.request(Method::POST, "/v1/inputs").body(body).send().await.expect("an answer");
    assert_eq!(upload(scene(1200)).await.status(), StatusCode::CREATED);
    let refused = upload(scene(1201)).await;
    assert_eq!(header(&refused, "ratelimit-policy"), "\"upload_bytes_per_hour\";q=2000;w=3600");
    problem(refused, 429, "quota_exceeded").await;
    assert_eq!(upload(scene(10)).await.status(), StatusCode::CREATED);
}

#[tokio::test]
async fn whoever_asks_too_often_is_told_so_and_what_is_left_is_told_before() {
    let folder = tempfile::tempdir().expect("folder");
    let app = App::start_with(folder.path(), &[("SHRINKD_QUOTAS__DEFAULT__REQUESTS_PER_MINUTE", "3")]);
    for left in [2, 1, 0] {
        let answer = app.get("/v1/jobs").await;
        assert_eq!(answer.status(), StatusCode::OK);
        assert_eq!(header(&answer, "ratelimit-policy"), "\"requests_per_minute\";q=3;w=60");
        let told = header(&answer, "ratelimit");
        assert!(told.starts_with(&format!("\"requests_per_minute\";r={left};t=")), "{told}");
    }
    let refused = app.get("/v1/jobs").await;
    assert!(header(&refused, "retry-after").parse::<u32>().is_ok_and(|s| (1..=20).contains(&s)));
    problem(refused, 429, "quota_exceeded").await;
    assert_eq!(app.get("/livez").await.status(), StatusCode::OK, "whether it lives may be asked by anybody");
}

#[tokio::test]
async fn a_full_queue_takes_no_more_jobs() {
    let folder = tempfile::tempdir().expect("folder");
    let app = App::start_with(folder.path(), &[("SHRINKD_LIMITS__QUEUED_JOBS", "1"), ("SHRINKD_WORKER__SLOTS", "1")]);
    let running = app.submit(&endless()).await;
    app.running(&running).await;
    app.submit(&slow()).await;
    let refused = app.post("/v1/jobs", &small()).await;
    assert!(header(&refused, "retry-after").parse::<u32>().is_ok_and(|s| s >= 1));
    problem(refused, 503, "queue_full").await;
}

#[tokio::test]
async fn a_job_is_stopped_at_its_deadline() {
    let folder = tempfile::tempdir().expect("folder");
    let app = App::start_with(folder.path(), &[("SHRINKD_LIMITS__JOB_SECONDS", "100")]);
    let mut request = endless();
    request["deadline_s"] = json!(1);
    let id = app.submit(&request).await;
    let job = app.ended(&id).await;
    assert_eq!((state(&job), job["problem"]["code"].as_str()), ("failed", Some("deadline_exceeded")), "{job}");
    request["deadline_s"] = json!(101);
    let told = problem(app.post("/v1/jobs", &request).await, 422, "invalid_request").await;
    assert_eq!(told["errors"][0]["pointer"], "/deadline_s");
    request["deadline_s"] = json!(0);
    let told = problem(app.post("/v1/jobs", &request).await, 422, "invalid_request").await;
    assert_eq!(told["errors"][0]["pointer"], "/deadline_s");
}

#[tokio::test]
async fn a_job_that_needs_too_much_memory_is_refused_before_it_runs() {
    let folder = tempfile::tempdir().expect("folder");
    let app = App::start_with(folder.path(), &[("SHRINKD_WORKER__MEMORY_BYTES", "104857600")]);
    let estimate: Value = app.post("/v1/jobs?validate_only=true", &small()).await.json().await.expect("JSON");
    assert!(estimate["memory_bytes"].as_u64().is_some_and(|bytes| (1 << 20..100 << 20).contains(&bytes)), "{estimate}");
    for path in ["/v1/jobs?validate_only=true", "/v1/jobs"] {
        let told = problem(app.post(path, &slow()).await, 422, "memory_exceeded").await;
        assert!(told["detail"].as_str().is_some_and(|detail| detail.contains("100 MiB")), "{told}");
    }
    let id = app.submit(&small()).await;
    assert_eq!(state(&app.ended(&id).await), "succeeded");
}

#[tokio::test]
async fn streams_and_uploads_are_bounded_and_an_answer_tells_of_every_quota() {
    let folder = tempfile::tempdir().expect("folder");
    let limits = [
        ("SHRINKD_QUOTAS__DEFAULT__STREAMS", "1"),
        ("SHRINKD_QUOTAS__DEFAULT__REQUESTS_PER_MINUTE", "1000"),
        ("SHRINKD_LIMITS__UPLOAD_BYTES", "1000"),
    ];
    let app = App::start_with(folder.path(), &limits);
    let id = app.submit(&endless()).await;
    let path = format!("/v1/jobs/{id}/events");
    let open = app.get(&path).await;
    assert_eq!(open.status(), StatusCode::OK);
    let second = app.get(&path).await;
    let told: Vec<&str> = second.headers().get_all("ratelimit").iter().map(|v| v.to_str().expect("text")).collect();
    assert!(told.len() == 2 && told[0].contains("requests_per_minute") && told[1].contains("streams"), "{told:?}");
    problem(second, 429, "quota_exceeded").await;
    problem(app.get(&format!("/v1/jobs/{id}?wait=30")).await, 429, "quota_exceeded").await;
    drop(open);
    eventually("a stream that ended makes room", async || app.get(&path).await.status() == StatusCode::OK).await;
    // more than all uploads together may be
    let upload = app.request(Method::POST, "/v1/inputs").body(vec![b' '; 2000]).send().await.expect("an answer");
    problem(upload, 503, "uploads_full").await;
    let scene = json!({"sphere": {"radius": 0.5}}).to_string();
    let upload = app.request(Method::POST, "/v1/inputs").body(scene).send().await.expect("an answer");
    assert_eq!(upload.status(), StatusCode::CREATED, "what was refused holds nothing");
}
