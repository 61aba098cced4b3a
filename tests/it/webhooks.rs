//! Notices of the ends of jobs: from the real program to a real receiver, which verifies them by the specification's own words.

use crate::app::{App, PATIENCE, problem, small};
use axum::Router;
use axum::body::Bytes;
use axum::http::{HeaderMap, StatusCode};
use axum::routing::post;
use base64::Engine as _;
use base64::prelude::BASE64_STANDARD;
use serde_json::{Value, json};
use sha2::{Digest as _, Sha256};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

/// Two secrets, as while one takes the place of the other.
const SECRETS: [&str; 2] = [
    "whsec_bmV3IHNlY3JldCBvZiB0aGUgdGVzdHMgb2Ygc2hyaW5rZA==",
    "whsec_b2xkIHNlY3JldCBvZiB0aGUgdGVzdHMgb2Ygc2hyaW5rZA==",
];

/// A receiver that fails a number of times before it takes notices.
struct Receiver {
    url: String,
    came: Arc<Mutex<Vec<(HeaderMap, Bytes)>>>,
}

impl Receiver {
    async fn that_fails(times: usize) -> Self {
        let came = Arc::new(Mutex::new(Vec::new()));
        let kept = came.clone();
        let take = move |headers: HeaderMap, body: Bytes| async move {
            let mut came = kept.lock().expect("lock");
            came.push((headers, body));
            if came.len() <= times { StatusCode::SERVICE_UNAVAILABLE } else { StatusCode::NO_CONTENT }
        };
        let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.expect("binds");
        let url = format!("http://{}/in?for=test", listener.local_addr().expect("an address"));
        tokio::spawn(axum::serve(listener, Router::new().route("/in", post(take))).into_future());
        Self { url, came }
    }

    /// The requests, once there are so many.
    async fn requests(&self, count: usize) -> Vec<(HeaderMap, Bytes)> {
        let clock = Instant::now();
        loop {
            let came = self.came.lock().expect("lock").clone();
            if came.len() >= count {
                return came;
            }
            assert!(clock.elapsed() < PATIENCE, "{} of {count} notices came", came.len());
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    }
}

fn settings() -> Vec<(&'static str, String)> {
    vec![
        ("SHRINKD_WEBHOOKS__SECRETS", format!("{SECRETS:?}")),
        ("SHRINKD_WEBHOOKS__ALLOW_HTTP", "true".to_owned()),
        ("SHRINKD_WEBHOOKS__PORTS", "[]".to_owned()),
        ("SHRINKD_WEBHOOKS__ALLOW_PRIVATE", "[\"127.0.0.1/32\"]".to_owned()),
    ]
}

fn start(folder: &std::path::Path) -> App {
    let settings = settings();
    let settings: Vec<(&str, &str)> = settings.iter().map(|(name, value)| (*name, value.as_str())).collect();
    App::start_with(folder, &settings)
}

/// HMAC-SHA256 as RFC 2104 writes it.
fn hmac(key: &[u8], message: &[u8]) -> Vec<u8> {
    assert!(key.len() <= 64);
    let padded = |pad: u8| (0..64).map(|i| key.get(i).copied().unwrap_or(0) ^ pad).collect::<Vec<u8>>();
    let inner = Sha256::digest([padded(0x36), message.to_vec()].concat());
    Sha256::digest([padded(0x5c), inner.to_vec()].concat()).to_vec()
}

/// Verifies a notice with each of the secrets, and returns its id and its body.
fn verified((headers, body): &(HeaderMap, Bytes)) -> (String, Value) {
    let text = |name: &str| headers[name].to_str().expect("text").to_owned();
    let (id, timestamp) = (text("webhook-id"), text("webhook-timestamp"));
    assert!(!id.contains('.'), "{id}");
    let now = SystemTime::now().duration_since(UNIX_EPOCH).expect("after 1970").as_secs();
    assert!(timestamp.parse::<u64>().expect("seconds").abs_diff(now) < 300);
    let content = [format!("{id}.{timestamp}.").as_bytes(), body].concat();
    let expected = SECRETS.map(|secret| {
        let key = BASE64_STANDARD.decode(secret.strip_prefix("whsec_").expect("prefix")).expect("base64");
        format!("v1,{}", BASE64_STANDARD.encode(hmac(&key, &content)))
    });
    assert_eq!(text("webhook-signature").split(' ').collect::<Vec<_>>(), expected);
    (id, serde_json::from_slice(body).expect("JSON"))
}

#[tokio::test]
async fn a_notice_survives_a_kill_and_is_sent_until_it_is_taken() {
    let folder = tempfile::tempdir().expect("folder");
    let receiver = Receiver::that_fails(1).await;
    let app = start(folder.path());
    let mut spec = small();
    spec["webhook"] = json!({"url": receiver.url});
    spec["labels"] = json!({"for": "notice"});
    let id = app.submit(&spec).await;
    let refused = receiver.requests(1).await;
    // also where the kill is faster than the note of the failure: then the notice comes when its hold is over
    app.kill();
    let app = start(folder.path());
    let taken = receiver.requests(2).await;
    let ((first, _), (second, notice)) = (verified(&refused[0]), verified(&taken[1]));
    assert_eq!(first, second, "every attempt has the same id");
    assert_eq!(refused[0].1, taken[1].1);
    let job = app.ended(&id).await;
    assert_eq!(notice["type"], "job.succeeded");
    assert_eq!(notice["timestamp"], job["finished_at"]);
    let data = json!({"id": id, "kind": "shrink", "state": "succeeded", "labels": {"for": "notice"}, "href": format!("/v1/jobs/{id}")});
    assert_eq!(notice["data"], data);
    assert!(!app.log().contains("for=test"), "addresses stay out of the log");
    assert!(!SECRETS.iter().any(|secret| app.log().contains(secret)));
}

#[tokio::test]
async fn a_tenant_without_secrets_may_not_ask_for_notices() {
    let folder = tempfile::tempdir().expect("folder");
    let variables = [
        ("SHRINKD_WEBHOOKS__SECRETS", format!("{SECRETS:?}")),
        ("SHRINKD_WEBHOOKS__TENANTS", "{default=[]}".to_owned()),
    ];
    let app = App::start_with(folder.path(), &variables.each_ref().map(|(name, value)| (*name, value.as_str())));
    let mut spec = small();
    spec["webhook"] = json!({"url": "https://example.com/"});
    let body = problem(app.post("/v1/jobs", &spec).await, 422, "invalid_request").await;
    assert_eq!(
        (&body["errors"][0]["pointer"], &body["errors"][0]["code"]),
        (&json!("/webhook"), &json!("not_offered"))
    );
}

#[tokio::test]
async fn a_target_inside_the_network_is_refused_at_its_place() {
    let folder = tempfile::tempdir().expect("folder");
    let app = App::start_with(folder.path(), &[("SHRINKD_WEBHOOKS__SECRETS", &format!("{SECRETS:?}"))]);
    let cases = [
        ("http://example.com/", "not_https"),
        ("https://127.0.0.1/", "private_address"),
        ("https://10.1.2.3/", "private_address"),
        ("https://169.254.169.254/latest/meta-data", "private_address"),
        ("https://[::ffff:127.0.0.1]/", "private_address"),
        ("https://2130706433/", "private_address"),
        ("https://localhost/", "private_address"),
        ("https://example.com:8443/", "port"),
        ("https://me:secret@example.com/", "user_info"),
        ("example.com", "malformed_url"),
    ];
    for (url, code) in cases {
        let mut spec = small();
        spec["webhook"] = json!({"url": url});
        let body = problem(app.post("/v1/jobs", &spec).await, 422, "invalid_request").await;
        assert_eq!(
            (&body["errors"][0]["pointer"], &body["errors"][0]["code"]),
            (&json!("/webhook/url"), &json!(code)),
            "{url}"
        );
    }
    for (webhook, pointer) in [
        (json!({}), "/webhook/url"),
        (json!({"url": 1}), "/webhook/url"),
        (json!({"uri": "x", "url": "x"}), "/webhook/uri"),
        (json!("x"), "/webhook"),
    ] {
        let mut spec = small();
        spec["webhook"] = webhook;
        let body = problem(app.post("/v1/jobs", &spec).await, 422, "invalid_request").await;
        assert_eq!(body["errors"][0]["pointer"], pointer, "{body}");
    }
    let mut spec = small();
    spec["webhook"] = json!({"url": "https://hooks.example.com/"});
    assert_eq!(app.post("/v1/jobs?validate_only=true", &spec).await.status(), 200);

    let folder = tempfile::tempdir().expect("folder");
    let app = App::start(folder.path());
    let body = problem(app.post("/v1/jobs", &spec).await, 422, "invalid_request").await;
    assert_eq!(
        (&body["errors"][0]["pointer"], &body["errors"][0]["code"]),
        (&json!("/webhook"), &json!("not_offered"))
    );
}
