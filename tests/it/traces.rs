//! Spans as a collector gets them, from one process and from two.

use crate::app::{App, PATIENCE, small};
use crate::cluster::nats_server;
use axum::Router;
use axum::body::Bytes;
use axum::routing::post;
use opentelemetry_proto::tonic::collector::trace::v1::ExportTraceServiceRequest;
use opentelemetry_proto::tonic::trace::v1::Span;
use prost::Message as _;
use reqwest::Method;
use serde_json::Value;
use std::net::SocketAddr;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

/// The standard's own example.
const TRACE: &str = "0af7651916cd43dd8448eb211c80319c";
const PARENT: &str = "b7ad6b7169203331";

/// A collector, and the spans it got.
struct Collector {
    address: SocketAddr,
    spans: Arc<Mutex<Vec<Span>>>,
}

impl Collector {
    async fn start() -> Self {
        let spans = Arc::new(Mutex::new(Vec::new()));
        let got = spans.clone();
        let take = move |body: Bytes| {
            let request = ExportTraceServiceRequest::decode(body).expect("a message");
            let scopes = request.resource_spans.into_iter().flat_map(|resource| resource.scope_spans);
            got.lock().expect("spans").extend(scopes.flat_map(|scope| scope.spans));
            std::future::ready("")
        };
        let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.expect("a port");
        let address = listener.local_addr().expect("an address");
        let router = Router::new().route("/v1/traces", post(take));
        tokio::spawn(async { axum::serve(listener, router).await.expect("serves") });
        Self { address, spans }
    }

    fn endpoint(&self) -> String {
        format!("http://{}", self.address)
    }

    fn of_trace(&self, name: &str) -> Vec<Span> {
        let spans = self.spans.lock().expect("spans");
        let ours = |span: &&Span| span.name == name && hex(&span.trace_id) == TRACE;
        spans.iter().filter(ours).cloned().collect()
    }

    /// The spans of that name in our trace, once there are any.
    async fn wait_for(&self, name: &str) -> Vec<Span> {
        let clock = Instant::now();
        loop {
            let found = self.of_trace(name);
            if !found.is_empty() {
                return found;
            }
            assert!(clock.elapsed() < PATIENCE, "no span {name} among {:?}", self.spans.lock().expect("spans"));
            tokio::time::sleep(Duration::from_millis(50)).await;
        }
    }
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

/// Submits a job in our trace; its id, and the span that the answer names.
async fn submit(app: &App, flags: &str) -> (String, String) {
    let traceparent = format!("00-{TRACE}-{PARENT}-{flags}");
    let submit = app.request(Method::POST, "/v1/jobs").header("traceparent", traceparent).json(&small());
    let answer = submit.send().await.expect("an answer");
    let response = answer.headers()["traceresponse"].to_str().expect("text").to_owned();
    let parts: Vec<&str> = response.split('-').collect();
    assert_eq!((parts[0], parts[1], parts[3]), ("00", TRACE, flags), "{response}");
    let job: Value = answer.json().await.expect("JSON");
    (job["id"].as_str().expect("an id").to_owned(), parts[2].to_owned())
}

/// The spans of the request and of the job, checked.
async fn check(collector: &Collector, span: &str) {
    let requests = collector.wait_for("request").await;
    let request = requests.iter().find(|request| hex(&request.span_id) == span).expect("the span of the answer");
    assert_eq!(hex(&request.parent_span_id), PARENT);
    let jobs = collector.wait_for("job").await;
    assert_eq!(jobs.len(), 1, "{jobs:?}");
    assert_eq!(hex(&jobs[0].parent_span_id), span, "the job follows from its request");
    assert!(jobs[0].attributes.iter().any(|attribute| attribute.key == "job.id"));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_job_continues_the_trace_of_its_request() {
    let (folder, collector) = (tempfile::tempdir().expect("folder"), Collector::start().await);
    let mut app = App::start_with(folder.path(), &[("SHRINKD_TRACES__ENDPOINT", &collector.endpoint())]);
    let (id, span) = submit(&app, "01").await;
    app.ended(&id).await;
    assert!(app.log().contains(TRACE), "lines of the log name the trace");
    // what was not sent yet is sent at the stop
    app.terminate();
    let (status, _) = tokio::task::block_in_place(|| app.wait());
    assert!(status.success(), "{status}");
    check(&collector, &span).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_trace_that_its_sender_does_not_sample_is_not_sent() {
    let (folder, collector) = (tempfile::tempdir().expect("folder"), Collector::start().await);
    let mut app = App::start_with(folder.path(), &[("SHRINKD_TRACES__ENDPOINT", &collector.endpoint())]);
    let (id, _) = submit(&app, "00").await;
    app.ended(&id).await;
    app.terminate();
    tokio::task::block_in_place(|| app.wait());
    assert_eq!(collector.of_trace("request").len() + collector.of_trace("job").len(), 0);
    assert!(!collector.spans.lock().expect("spans").is_empty(), "other requests are sent");
}

#[tokio::test]
async fn without_a_collector_nothing_is_told_of_a_trace() {
    let folder = tempfile::tempdir().expect("folder");
    let app = App::start(folder.path());
    let traceparent = format!("00-{TRACE}-{PARENT}-01");
    let answer = app.request(Method::GET, "/livez").header("traceparent", traceparent).send().await.expect("an answer");
    assert_eq!(answer.headers().get("traceresponse"), None);
    // and no client can say it in a request
    let mut request = small();
    request["traceparent"] = format!("00-{TRACE}-{PARENT}-01").into();
    crate::app::problem(app.post("/v1/jobs", &request).await, 422, "invalid_request").await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_worker_on_another_node_continues_the_trace() {
    let Some(server) = nats_server::NatsServer::start() else { return };
    let (folder, collector) = (tempfile::tempdir().expect("folder"), Collector::start().await);
    let (engine, endpoint) = (server.url(), collector.endpoint());
    let start = |role| {
        let variables =
            [("SHRINKD_ENGINE", engine.as_str()), ("SHRINKD_ROLE", role), ("SHRINKD_TRACES__ENDPOINT", &endpoint)];
        App::start_with(folder.path(), &variables)
    };
    let (api, worker) = (start("api"), start("worker"));
    let (id, span) = submit(&api, "01").await;
    api.ended(&id).await;
    for mut app in [worker, api] {
        app.terminate();
        tokio::task::block_in_place(|| app.wait());
    }
    check(&collector, &span).await;
}
