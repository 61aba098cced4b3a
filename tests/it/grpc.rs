//! The service over gRPC, by a client that is generated from its contract.

use crate::app::{App, PATIENCE, endless, fixture, small};
use crate::cluster::nats_server;
use crate::tenants;
use client::shrinkd_client::ShrinkdClient;
use client::{
    CancelRequest, Chunk, DownloadRequest, EstimateRequest, Event, ForgetRequest, GetRequest, Job, ListRequest, State,
    SubmitRequest, WatchRequest,
};
use futures::{StreamExt as _, stream};
use prost_types::value::Kind;
use prost_types::{ListValue, Struct};
use reqwest::{Method, StatusCode};
use serde_json::{Value, json};
use std::time::Duration;
use tonic::transport::Channel;
use tonic::{Code, Request, Status};
use tonic_health::pb::health_check_response::ServingStatus;
use tonic_health::pb::health_client::HealthClient;
use tonic_health::pb::{HealthCheckRequest, HealthCheckResponse};
use tonic_types::{ErrorDetails, StatusExt as _};

mod client {
    #![allow(clippy::all, clippy::pedantic, unused)]
    include!(concat!(env!("OUT_DIR"), "/client/shrinkd.v1.rs"));
}

async fn channel(app: &App) -> Channel {
    Channel::from_shared(app.url.clone()).expect("an address").connect().await.expect("connects")
}

async fn connect(app: &App) -> ShrinkdClient<Channel> {
    ShrinkdClient::new(channel(app).await)
}

/// A JSON value as a message.
fn message(value: &Value) -> prost_types::Value {
    let kind = match value {
        Value::Null => Kind::NullValue(0),
        Value::Bool(b) => Kind::BoolValue(*b),
        Value::Number(n) => Kind::NumberValue(n.as_f64().expect("a double")),
        Value::String(s) => Kind::StringValue(s.clone()),
        Value::Array(list) => Kind::ListValue(ListValue { values: list.iter().map(message).collect() }),
        Value::Object(_) => Kind::StructValue(object(value)),
    };
    prost_types::Value { kind: Some(kind) }
}

fn object(value: &Value) -> Struct {
    let members = value.as_object().expect("an object").iter();
    Struct { fields: members.map(|(name, value)| (name.clone(), message(value))).collect() }
}

fn text(message: &Struct, member: &str) -> String {
    match message.fields.get(member).and_then(|value| value.kind.clone()) {
        Some(Kind::StringValue(text)) => text,
        other => panic!("{member} is no text: {other:?}"),
    }
}

fn submission(spec: &Value) -> SubmitRequest {
    SubmitRequest { spec: Some(object(spec)), ..SubmitRequest::default() }
}

async fn submit(client: &mut ShrinkdClient<Channel>, spec: &Value) -> Job {
    let answer = client.submit(submission(spec)).await.expect("accepted").into_inner();
    assert!(!answer.replayed);
    answer.job.expect("a job")
}

/// All events of a job after a number, or with a snapshot.
async fn watch(client: &mut ShrinkdClient<Channel>, id: &str, after: Option<u64>) -> Vec<Event> {
    let events = client.watch(WatchRequest { id: id.to_owned(), after }).await.expect("a stream").into_inner();
    let events = tokio::time::timeout(PATIENCE, events.collect::<Vec<_>>()).await.expect("ends with the job");
    events.into_iter().map(|event| event.expect("an event")).collect()
}

async fn download(client: &mut ShrinkdClient<Channel>, id: &str, name: &str, offset: u64) -> Result<Vec<u8>, Status> {
    let request = DownloadRequest { id: id.to_owned(), name: name.to_owned(), offset };
    let mut chunks = client.download(request).await?.into_inner();
    let mut bytes = Vec::new();
    while let Some(chunk) = chunks.message().await? {
        bytes.extend_from_slice(&chunk.data);
    }
    Ok(bytes)
}

/// Checks a refusal's code and reason, and returns its details.
fn refused<T: std::fmt::Debug>(answer: Result<T, Status>, code: Code, reason: &str) -> ErrorDetails {
    let status = answer.expect_err(reason);
    let details = status.get_error_details();
    assert_eq!(status.code(), code, "{status:?}");
    assert_eq!(details.error_info().map(|info| info.reason.as_str()), Some(reason), "{status:?}");
    let id = details.request_info().map(|info| info.request_id.clone()).unwrap_or_default();
    assert!(!id.is_empty(), "{status:?}");
    details
}

#[tokio::test]
async fn a_job_is_submitted_watched_and_downloaded_as_over_http() {
    let folder = tempfile::tempdir().expect("folder");
    let app = App::start(folder.path());
    let mut client = connect(&app).await;
    let mut spec = small();
    spec["labels"] = json!({"project": "call"});
    let accepted = submit(&mut client, &spec).await;
    assert_eq!((accepted.state(), accepted.kind.as_str()), (State::Queued, "shrink"));

    let events = watch(&mut client, &accepted.id, Some(0)).await;
    assert_eq!(events.iter().map(|e| e.id).collect::<Vec<_>>(), (1..=events.len() as u64).collect::<Vec<_>>());
    assert_eq!(events.last().map(|e| e.kind.as_str()), Some("done"));
    let path = format!("/v1/jobs/{}", accepted.id);
    let page = app.request(Method::GET, &format!("{path}/events?limit=512")).header("Accept", "application/json");
    let page: Value = page.send().await.expect("an answer").json().await.expect("JSON");
    let told: Vec<(u64, String)> = events.iter().map(|e| (e.id, e.kind.clone())).collect();
    let same = page["events"].as_array().expect("a list").iter();
    let same: Vec<(u64, String)> =
        same.map(|e| (e["seq"].as_u64().expect("a number"), e["type"].as_str().expect("a kind").to_owned())).collect();
    assert_eq!(told, same, "the numbers of both interfaces are the same");
    let resumed = watch(&mut client, &accepted.id, Some(2)).await;
    assert_eq!(resumed, events[2..]);
    assert_eq!(watch(&mut client, &accepted.id, Some(events.len() as u64)).await, []);
    let kinds: Vec<String> = watch(&mut client, &accepted.id, None).await.into_iter().map(|e| e.kind).collect();
    assert_eq!(kinds, ["snapshot", "done"]);

    let job = client.get(GetRequest { id: accepted.id.clone() }).await.expect("there").into_inner();
    let http = app.get_json(&path).await;
    assert_eq!(job.state(), State::Succeeded);
    assert_eq!(job.labels["project"], "call");
    assert_eq!(job.revision, http["revision"].as_u64().expect("a number"));
    assert_eq!(job.metrics, Some(object(&http["metrics"])));
    assert_eq!(job.shrink, Some(object(&http["shrink"])));
    assert_eq!(job.created_at.expect("a time").to_string(), http["created_at"]);
    for output in &job.outputs {
        let over_http = app.get(&output.href).await.bytes().await.expect("bytes");
        assert_eq!(over_http.len() as u64, output.bytes);
        let bytes = download(&mut client, &job.id, &output.name, 0).await.expect("whole");
        assert!(bytes == over_http, "{} differs", output.name);
        let rest = download(&mut client, &job.id, &output.name, output.bytes / 2).await.expect("the rest");
        assert!(rest == over_http[output.bytes as usize / 2..]);
        assert!(download(&mut client, &job.id, &output.name, output.bytes).await.expect("nothing").is_empty());
    }
    assert!(!job.outputs.is_empty());
}

#[tokio::test]
async fn a_key_gives_the_same_answer_on_both_interfaces() {
    let folder = tempfile::tempdir().expect("folder");
    let app = App::start(folder.path());
    let mut client = connect(&app).await;
    let keyed = |spec: &Value| SubmitRequest { idempotency_key: "once".to_owned(), ..submission(spec) };
    let first = client.submit(keyed(&small())).await.expect("accepted").into_inner();
    let again = client.submit(keyed(&small())).await.expect("accepted").into_inner();
    assert_eq!((first.replayed, again.replayed), (false, true));
    assert_eq!(first.job, again.job);
    let http = app.request(Method::POST, "/v1/jobs").header("Idempotency-Key", "once").json(&small());
    let http = http.send().await.expect("an answer");
    assert_eq!(http.headers()["idempotent-replayed"], "true");
    assert_eq!(http.json::<Value>().await.expect("JSON")["id"], first.job.expect("a job").id);
    refused(client.submit(keyed(&endless())).await, Code::InvalidArgument, "idempotency_key_reused");
    let long = SubmitRequest { idempotency_key: "x".repeat(256), ..submission(&small()) };
    refused(client.submit(long).await, Code::InvalidArgument, "invalid_header");
}

#[tokio::test]
async fn a_request_may_be_text_and_is_judged_without_being_submitted() {
    let folder = tempfile::tempdir().expect("folder");
    let app = App::start(folder.path());
    let mut client = connect(&app).await;
    // deeper than messages go
    let mut scene = json!({"sphere": {"radius": 0.3}});
    for _ in 0..35 {
        scene = json!({"translate": {"by": [0.001, 0, 0], "of": scene}});
    }
    let deep = json!({"field": {"scene": scene}}).to_string();
    let estimate = client.estimate(EstimateRequest { spec: None, json: deep }).await.expect("valid").into_inner();
    assert!(estimate.vertices > 1000 && estimate.evaluations > estimate.vertices);
    let http = app.post("/v1/jobs?validate_only=true", &small()).await.json::<Value>().await.expect("JSON");
    let same = client.estimate(EstimateRequest { spec: Some(object(&small())), json: String::new() }).await;
    assert_eq!(http["evaluations"], same.expect("valid").into_inner().evaluations);
    let list = client.list(ListRequest::default()).await.expect("a page").into_inner();
    assert_eq!(list.jobs, [], "nothing was submitted");
}

#[tokio::test]
async fn what_is_refused_says_why_and_where() {
    let folder = tempfile::tempdir().expect("folder");
    let app = App::start_with(
        folder.path(),
        &[("SHRINKD_LIMITS__BODY_BYTES", "10000"), ("SHRINKD_LIMITS__INPUT_BYTES", "1000")],
    );
    let mut client = connect(&app).await;
    let wrong = json!({"field": {"scene": {"sphere": {"radius": -1}}}, "shrink": {"method": "guess"}, "colour": 1});
    let details = refused(client.submit(submission(&wrong)).await, Code::InvalidArgument, "invalid_request");
    let faults = &details.bad_request().expect("faults").field_violations;
    let places: Vec<&str> = faults.iter().map(|fault| fault.field.as_str()).collect();
    assert!(places.contains(&"/colour") && places.contains(&"/shrink/method"), "{places:?}");
    let scene = json!({"field": {"scene": {"sphere": {"radius": -1}}}});
    let details = refused(client.submit(submission(&scene)).await, Code::InvalidArgument, "invalid_request");
    assert_eq!(details.bad_request().expect("faults").field_violations[0].field, "/field/scene/sphere/radius");
    refused(client.submit(SubmitRequest::default()).await, Code::InvalidArgument, "invalid_request");
    let broken = SubmitRequest { json: "{".to_owned(), ..SubmitRequest::default() };
    refused(client.submit(broken).await, Code::InvalidArgument, "malformed_json");
    let large =
        SubmitRequest { json: format!("{{\"field\": \"{}\"}}", "x".repeat(20_000)), ..SubmitRequest::default() };
    assert_eq!(client.submit(large).await.expect_err("too large").code(), Code::OutOfRange);

    let nobody = || "018f0000-0000-7000-8000-000000000000".to_owned();
    for id in [nobody(), "nonsense".to_owned(), String::new()] {
        refused(client.get(GetRequest { id: id.clone() }).await, Code::NotFound, "unknown_job");
        refused(client.cancel(CancelRequest { id: id.clone() }).await, Code::NotFound, "unknown_job");
        refused(client.forget(ForgetRequest { id: id.clone() }).await, Code::NotFound, "unknown_job");
        refused(client.watch(WatchRequest { id: id.clone(), after: None }).await, Code::NotFound, "unknown_job");
        refused(download(&mut client, &id, "glb", 0).await, Code::NotFound, "unknown_job");
    }
    let job = submit(&mut client, &small()).await;
    watch(&mut client, &job.id, None).await;
    refused(download(&mut client, &job.id, "film", 0).await, Code::NotFound, "unknown_output");
    refused(download(&mut client, &job.id, "surface", 0).await, Code::NotFound, "unknown_output");
    refused(download(&mut client, &job.id, "glb", u64::MAX).await, Code::OutOfRange, "range_not_satisfiable");
    let list = |request| {
        let mut client = client.clone();
        async move { client.list(request).await }
    };
    refused(list(ListRequest { limit: 201, ..ListRequest::default() }).await, Code::InvalidArgument, "invalid_query");
    refused(
        list(ListRequest { states: vec![77], ..ListRequest::default() }).await,
        Code::InvalidArgument,
        "invalid_query",
    );
    let cursor = ListRequest { cursor: "?".to_owned(), ..ListRequest::default() };
    refused(list(cursor).await, Code::InvalidArgument, "invalid_query");

    let file = stream::iter(vec![Chunk { data: vec![b'x'; 600].into() }; 2]);
    refused(client.upload(file).await, Code::OutOfRange, "body_too_large");
    let file = stream::iter([Chunk { data: b"no field at all".to_vec().into() }]);
    refused(client.upload(file).await, Code::InvalidArgument, "unrecognized_input");

    let mut odd = Request::new(GetRequest { id: nobody() });
    odd.metadata_mut().insert("grpc-timeout", "soon".parse().expect("text"));
    refused(client.get(odd).await, Code::InvalidArgument, "invalid_header");
}

#[tokio::test]
async fn what_no_route_knows_is_told_in_the_language_of_the_call() {
    let folder = tempfile::tempdir().expect("folder");
    let app = App::start(folder.path());
    // HTTP/2 without an upgrade, as every client of gRPC speaks it
    let http2 = reqwest::Client::builder().http2_prior_knowledge().build().expect("a client");
    let call = |path: &str| http2.post(format!("{}{path}", app.url)).header("content-type", "application/grpc");
    let answer = call("/shrinkd.v2.Shrinkd/Get").send().await.expect("an answer");
    assert_eq!((answer.status(), &answer.headers()["grpc-status"]), (StatusCode::OK, &"12".parse().expect("text")));
    assert!(answer.headers().contains_key("x-request-id"));
    let answer = call("/v1/inputs").header("x-request-id", "mine").body("x").send().await.expect("an answer");
    assert_eq!(&answer.headers()["x-request-id"], "mine");
    assert_ne!(answer.headers()["grpc-status"], "0");
    let answer = call("/shrinkd.v1.Shrinkd/Guess").send().await.expect("an answer");
    assert_eq!(answer.headers()["grpc-status"], "12");
    // and what is no call is told as HTTP does
    let answer = app.post("/shrinkd.v1.Shrinkd/Get", &json!({})).await;
    crate::app::problem(answer, 415, "unsupported_media_type").await;
    crate::app::problem(app.get("/shrinkd.v1.Shrinkd/Get").await, 405, "method_not_allowed").await;
    let answer = http2.get(format!("{}/livez", app.url)).send().await.expect("an answer");
    assert_eq!((answer.status(), answer.version()), (StatusCode::OK, reqwest::Version::HTTP_2));
}

#[tokio::test]
async fn a_running_job_is_canceled_and_its_watcher_hears_of_it() {
    let folder = tempfile::tempdir().expect("folder");
    let app = App::start(folder.path());
    let mut client = connect(&app).await;
    let job = submit(&mut client, &endless()).await;
    app.running(&job.id).await;
    refused(download(&mut client, &job.id, "glb", 0).await, Code::FailedPrecondition, "job_not_ended");
    refused(client.forget(ForgetRequest { id: job.id.clone() }).await, Code::FailedPrecondition, "job_not_ended");
    let watcher = tokio::spawn({
        let (mut client, id) = (client.clone(), job.id.clone());
        async move { watch(&mut client, &id, None).await }
    });
    let stopping = client.cancel(CancelRequest { id: job.id.clone() }).await.expect("there").into_inner();
    assert!([State::Canceling, State::Canceled].contains(&stopping.state()));
    let events = watcher.await.expect("no panic");
    let last = events.last().expect("an event");
    assert_eq!((last.kind.as_str(), text(last.data.as_ref().expect("a job"), "state").as_str()), ("done", "canceled"));
    let again = client.cancel(CancelRequest { id: job.id.clone() }).await.expect("there").into_inner();
    assert_eq!(again.state(), State::Canceled);
    client.forget(ForgetRequest { id: job.id.clone() }).await.expect("forgotten");
    refused(client.get(GetRequest { id: job.id }).await, Code::NotFound, "unknown_job");
}

#[tokio::test]
async fn lists_come_in_pages_newest_first() {
    let folder = tempfile::tempdir().expect("folder");
    let app = App::start(folder.path());
    let mut client = connect(&app).await;
    let mut ids = Vec::new();
    for i in 0..5 {
        let mut spec = small();
        spec["labels"] = json!({"parity": if i % 2 == 0 { "even" } else { "odd" }});
        ids.insert(0, submit(&mut client, &spec).await.id);
    }
    let (mut found, mut cursor, mut sizes) = (Vec::new(), String::new(), Vec::new());
    loop {
        let page =
            client.list(ListRequest { limit: 2, cursor, ..ListRequest::default() }).await.expect("a page").into_inner();
        sizes.push(page.jobs.len());
        found.extend(page.jobs.into_iter().map(|job| job.id));
        cursor = page.next_cursor;
        if cursor.is_empty() {
            break;
        }
    }
    assert_eq!((found, sizes), (ids, vec![2, 2, 1]));
    let odd = ListRequest { labels: [("parity".to_owned(), "odd".to_owned())].into(), ..ListRequest::default() };
    assert_eq!(client.list(odd).await.expect("a page").into_inner().jobs.len(), 2);
    let canceled = ListRequest { states: vec![State::Canceled.into()], ..ListRequest::default() };
    assert_eq!(client.list(canceled).await.expect("a page").into_inner().jobs.len(), 0);
}

#[tokio::test]
async fn a_file_is_uploaded_in_pieces_and_named_as_over_http() {
    let folder = tempfile::tempdir().expect("folder");
    let app = App::start(folder.path());
    let mut client = connect(&app).await;
    let file = fixture("networks/blob.safetensors");
    let pieces: Vec<Chunk> = file.chunks(1000).map(|piece| Chunk { data: piece.to_vec().into() }).collect();
    let input = client.upload(stream::iter(pieces)).await.expect("stored").into_inner();
    assert_eq!(input.bytes, file.len() as u64);
    let over_http = app.request(Method::POST, "/v1/inputs").body(file).send().await.expect("an answer");
    assert_eq!(over_http.status(), StatusCode::OK, "it is there already");
    let over_http: Value = over_http.json().await.expect("JSON");
    assert_eq!(over_http["id"], input.id);
    assert_eq!(Some(object(&over_http["description"])), input.description);
    let job = submit(&mut client, &json!({"field": {"input": input.id}})).await;
    client.cancel(CancelRequest { id: job.id }).await.expect("there");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_watcher_may_go_away_and_one_that_stays_is_told_when_the_service_stops() {
    let folder = tempfile::tempdir().expect("folder");
    let mut app = App::start(folder.path());
    let mut client = connect(&app).await;
    let job = submit(&mut client, &endless()).await;
    app.running(&job.id).await;
    for _ in 0..20 {
        let mut leaving = connect(&app).await;
        let mut events =
            leaving.watch(WatchRequest { id: job.id.clone(), after: None }).await.expect("a stream").into_inner();
        assert_eq!(events.message().await.expect("an event").expect("an event").kind, "snapshot");
    }
    let mut late = Request::new(WatchRequest { id: job.id.clone(), after: None });
    late.set_timeout(Duration::from_millis(300));
    let mut events = client.watch(late).await.expect("a stream").into_inner();
    let end = loop {
        match events.message().await {
            Ok(Some(_)) => {}
            Ok(None) => panic!("the job has not ended"),
            Err(status) => break status,
        }
    };
    // the client looks at its own clock, too
    assert!([Code::DeadlineExceeded, Code::Cancelled].contains(&end.code()), "{end:?}");

    let mut events =
        client.watch(WatchRequest { id: job.id.clone(), after: None }).await.expect("a stream").into_inner();
    assert_eq!(events.message().await.expect("an event").expect("an event").kind, "snapshot");
    let rest = tokio::spawn(async move {
        loop {
            match events.message().await {
                Ok(Some(_)) => {}
                Ok(None) => return None,
                Err(status) => return Some(status),
            }
        }
    });
    app.terminate();
    let (status, _) = tokio::task::block_in_place(|| app.wait());
    assert!(status.success(), "{status}\n{}", app.log());
    let end = tokio::time::timeout(PATIENCE, rest).await.expect("ends").expect("no panic").expect("with an error");
    assert_eq!(end.code(), Code::Unavailable);
    assert_eq!(end.get_error_details().error_info().map(|info| info.reason.clone()).as_deref(), Some("stopping"));
}

#[tokio::test]
async fn what_is_over_a_quota_is_told_in_the_language_of_the_call() {
    let folder = tempfile::tempdir().expect("folder");
    let app = App::start_with(folder.path(), &[("SHRINKD_QUOTAS__DEFAULT__REQUESTS_PER_MINUTE", "1")]);
    let mut client = connect(&app).await;
    let answer = client.estimate(EstimateRequest { spec: Some(object(&small())), json: String::new() }).await;
    let answer = answer.expect("is let through");
    let policy = answer.metadata().get("ratelimit-policy").expect("is told").to_str().expect("text");
    assert_eq!(policy, "\"requests_per_minute\";q=1;w=60");
    assert!(answer.into_inner().memory_bytes > 1 << 20);
    let details = refused(client.submit(submission(&small())).await, Code::ResourceExhausted, "quota_exceeded");
    assert!(details.retry_info().and_then(|info| info.retry_delay).is_some_and(|delay| delay.as_secs() >= 1));
}

/// A message with a key, where there is one.
fn asked<T>(message: T, key: Option<&str>) -> Request<T> {
    let mut request = Request::new(message);
    if let Some(key) = key {
        request.metadata_mut().insert("authorization", format!("Bearer {key}").parse().expect("text"));
    }
    request
}

/// How every method answers about a job and an input, in the order of the contract.
async fn every_method(
    client: &mut ShrinkdClient<Channel>,
    key: Option<&str>,
    (job, input): (&str, &str),
) -> Vec<(&'static str, Result<(), Status>)> {
    let id = || job.to_owned();
    let spec = json!({"field": {"input": input}});
    let estimate = EstimateRequest { spec: Some(object(&spec)), json: String::new() };
    let chunk = Chunk { data: br#"{"sphere": {"radius": 0.125}}"#.to_vec().into() };
    let download = DownloadRequest { id: id(), name: "glb".to_owned(), offset: 0 };
    vec![
        ("Submit", client.submit(asked(submission(&spec), key)).await.map(drop)),
        ("Estimate", client.estimate(asked(estimate, key)).await.map(drop)),
        ("Get", client.get(asked(GetRequest { id: id() }, key)).await.map(drop)),
        ("List", client.list(asked(ListRequest::default(), key)).await.map(drop)),
        ("Cancel", client.cancel(asked(CancelRequest { id: id() }, key)).await.map(drop)),
        ("Forget", client.forget(asked(ForgetRequest { id: id() }, key)).await.map(drop)),
        ("Watch", client.watch(asked(WatchRequest { id: id(), after: None }, key)).await.map(drop)),
        ("Download", client.download(asked(download, key)).await.map(drop)),
        ("Upload", client.upload(asked(stream::iter([chunk]), key)).await.map(drop)),
    ]
}

/// A service that asks who calls, with an input and an ended job of the tenant `a`.
struct Guarded {
    app: App,
    client: ShrinkdClient<Channel>,
    folder: tempfile::TempDir,
    job: String,
    input: String,
}

impl Guarded {
    async fn start() -> Self {
        let folder = tempfile::tempdir().expect("folder");
        let app = App::start_with(folder.path(), &[("SHRINKD_AUTH__MODE", "required")]);
        let mut client = connect(&app).await;
        let mut new = Self { app, client: client.clone(), folder, job: String::new(), input: String::new() };
        let key = new.key("a", "read,write").await;
        let chunk = Chunk { data: br#"{"sphere": {"radius": 0.6}}"#.to_vec().into() };
        let stored = client.upload(asked(stream::iter([chunk]), Some(&key))).await.expect("stored").into_inner();
        let mut spec = small();
        spec["field"] = json!({"input": stored.id});
        let job = client.submit(asked(submission(&spec), Some(&key))).await.expect("accepted").into_inner();
        (new.input, new.job) = (stored.id, job.job.expect("a job").id);
        let events = WatchRequest { id: new.job.clone(), after: None };
        let events = client.watch(asked(events, Some(&key))).await.expect("a stream").into_inner();
        let mut events = tokio::time::timeout(PATIENCE, events.collect::<Vec<_>>()).await.expect("ends with the job");
        let last = events.pop().expect("an event").expect("an event");
        assert_eq!(text(last.data.as_ref().expect("a job"), "state"), "succeeded");
        new
    }

    /// A key that works.
    async fn key(&self, tenant: &str, scopes: &str) -> String {
        let key = tenants::keys(self.folder.path(), &["create", "--tenant", tenant, "--scope", scopes]);
        tenants::eventually("the new key works", async || {
            tenants::ask(&self.app, &key, Method::GET, "/v1/jobs", b"").await.status() != 401
        })
        .await;
        key
    }
}

#[tokio::test]
async fn every_method_asks_for_a_key_and_for_what_it_allows() {
    let guarded = Guarded::start().await;
    let (mut client, names) = (guarded.client.clone(), (guarded.job.as_str(), guarded.input.as_str()));
    let answers = every_method(&mut client, None, names).await;
    let contract = include_str!("../../proto/shrinkd/v1/shrinkd.proto");
    let methods = contract.lines().filter_map(|line| line.trim().strip_prefix("rpc ")?.split('(').next());
    assert_eq!(answers.iter().map(|(method, _)| *method).collect::<Vec<_>>(), methods.collect::<Vec<_>>());
    for (method, answer) in answers {
        assert!(answer.is_err(), "{method} needs no key");
        refused(answer, Code::Unauthenticated, "unauthenticated");
    }
    let made_up = format!("shrinkd_{}_{}", "0".repeat(16), "0".repeat(64));
    for (_, answer) in every_method(&mut client, Some(&made_up), names).await {
        refused(answer, Code::Unauthenticated, "unauthenticated");
    }
    let reader = guarded.key("a", "read").await;
    for (method, answer) in every_method(&mut client, Some(&reader), names).await {
        if ["Get", "List", "Watch", "Download"].contains(&method) {
            assert!(answer.is_ok(), "{method}: {answer:?}");
        } else {
            refused(answer, Code::PermissionDenied, "insufficient_scope");
        }
    }
    let operator = guarded.key("a", "operate").await;
    for (_, answer) in every_method(&mut client, Some(&operator), names).await {
        refused(answer, Code::PermissionDenied, "insufficient_scope");
    }
    // whether the node is well is told to everybody
    let mut health = HealthClient::new(channel(&guarded.app).await);
    assert!(serving(health.check(HealthCheckRequest::default()).await.expect("an answer").get_ref()));
}

#[tokio::test]
async fn another_tenants_things_answer_on_every_method_as_if_they_had_never_been() {
    let guarded = Guarded::start().await;
    let mut client = guarded.client.clone();
    let stranger = guarded.key("b", "read,write").await;
    let theirs = (guarded.job.as_str(), guarded.input.as_str());
    let no_input = format!("sha256:{}", "0".repeat(64));
    let never = ("01900000-0000-7000-8000-000000000000", no_input.as_str());
    let mut told = Vec::new();
    for names in [theirs, never] {
        let answers = every_method(&mut client, Some(&stranger), names).await;
        // the same apart from names, and from the id of each request
        let answers = answers.into_iter().map(|(method, answer)| {
            let said = answer.map_err(|status| {
                let details = status.get_error_details();
                let faults = details.bad_request().map(|faults| format!("{:?}", faults.field_violations));
                let reason = details.error_info().map(|info| info.reason.clone()).unwrap_or_default();
                let text = format!("{} {}", status.message(), faults.unwrap_or_default());
                (status.code(), reason, text.replace(names.0, "JOB").replace(names.1, "INPUT"))
            });
            (method, said)
        });
        told.push(answers.collect::<Vec<_>>());
    }
    assert_eq!(told[0], told[1]);
    for (method, answer) in &told[0] {
        let found = answer.as_ref().map_err(|(code, reason, _)| (*code, reason.as_str()));
        let expected = match *method {
            "Submit" | "Estimate" => Err((Code::InvalidArgument, "invalid_request")),
            "Get" | "Cancel" | "Forget" | "Watch" | "Download" => Err((Code::NotFound, "unknown_job")),
            // its own, of which there are none yet, and a file that is new to it
            "List" | "Upload" => Ok(&()),
            other => panic!("{other} is new: what does it tell a stranger?"),
        };
        assert_eq!(found, expected, "{method}");
    }
    for names in [theirs, never] {
        let warm = json!({"field": {"scene": {"sphere": {"radius": 0.5}}}, "warm_start": names.0});
        let answer = client.submit(asked(submission(&warm), Some(&stranger))).await;
        let details = refused(answer, Code::InvalidArgument, "invalid_request");
        let faults = &details.bad_request().expect("faults").field_violations;
        assert!(faults[0].description.starts_with("unknown_job: "), "{faults:?}");
    }
    let listed = client.list(asked(ListRequest::default(), Some(&stranger))).await.expect("a page").into_inner();
    assert_eq!(listed.jobs, []);
    let owner = guarded.key("a", "read").await;
    let still = client.get(asked(GetRequest { id: guarded.job.clone() }, Some(&owner))).await.expect("there");
    assert_eq!(still.into_inner().state(), State::Succeeded, "nothing that the stranger did has touched it");
}

fn serving(answer: &HealthCheckResponse) -> bool {
    answer.status() == ServingStatus::Serving
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn health_is_told_and_watched() {
    let folder = tempfile::tempdir().expect("folder");
    let mut app = App::start(folder.path());
    let mut health = HealthClient::new(channel(&app).await);
    let of = |service: &str| HealthCheckRequest { service: service.to_owned() };
    for service in ["", "shrinkd.v1.Shrinkd"] {
        assert!(serving(health.check(of(service)).await.expect("an answer").get_ref()));
    }
    assert_eq!(health.check(of("other")).await.expect_err("unknown").code(), Code::NotFound);
    let mut unknown = health.watch(of("other")).await.expect("a stream").into_inner();
    assert_eq!(unknown.message().await.expect("told").expect("told").status(), ServingStatus::ServiceUnknown);
    let mut watch = health.watch(of("")).await.expect("a stream").into_inner();
    assert!(serving(&watch.message().await.expect("told").expect("told")));
    app.terminate();
    let stopping = watch.message().await.expect("told").expect("told");
    assert_eq!(stopping.status(), ServingStatus::NotServing);
    assert!(tokio::task::block_in_place(|| app.wait()).0.success());
}

#[tokio::test]
async fn reflection_lists_the_service_and_tells_its_contract() {
    use tonic_reflection::pb::v1::ServerReflectionRequest;
    use tonic_reflection::pb::v1::server_reflection_client::ServerReflectionClient;
    use tonic_reflection::pb::v1::server_reflection_request::MessageRequest;
    use tonic_reflection::pb::v1::server_reflection_response::MessageResponse;
    let folder = tempfile::tempdir().expect("folder");
    let app = App::start(folder.path());
    let mut reflection = ServerReflectionClient::new(channel(&app).await);
    let ask = |message| stream::iter([ServerReflectionRequest { host: String::new(), message_request: Some(message) }]);
    let answer = reflection.server_reflection_info(ask(MessageRequest::ListServices(String::new()))).await;
    let answer = answer.expect("a stream").into_inner().message().await.expect("told").expect("told");
    let Some(MessageResponse::ListServicesResponse(list)) = answer.message_response else { panic!("{answer:?}") };
    let names: Vec<&str> = list.service.iter().map(|service| service.name.as_str()).collect();
    assert!(names.contains(&"shrinkd.v1.Shrinkd") && names.contains(&"grpc.health.v1.Health"), "{names:?}");
    let symbol = MessageRequest::FileContainingSymbol("shrinkd.v1.Shrinkd".to_owned());
    let answer = reflection.server_reflection_info(ask(symbol)).await;
    let answer = answer.expect("a stream").into_inner().message().await.expect("told").expect("told");
    let Some(MessageResponse::FileDescriptorResponse(files)) = answer.message_response else { panic!("{answer:?}") };
    assert!(!files.file_descriptor_proto.is_empty());
}

#[tokio::test]
async fn a_node_that_only_runs_jobs_tells_its_health_and_nothing_else() {
    let Some(server) = nats_server::NatsServer::start() else { return };
    let folder = tempfile::tempdir().expect("folder");
    let app = App::start_with(folder.path(), &[("SHRINKD_ENGINE", &server.url()), ("SHRINKD_ROLE", "worker")]);
    let mut health = HealthClient::new(channel(&app).await);
    assert!(serving(health.check(HealthCheckRequest::default()).await.expect("an answer").get_ref()));
    let mut client = connect(&app).await;
    refused(client.submit(submission(&small())).await, Code::Unimplemented, "unknown_route");
}
