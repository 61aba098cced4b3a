use super::*;
use crate::engine::conformance;
use crate::engine::sqlite::SqliteEngine;
use crate::engine::{Outcome, Terms};
use crate::notify::signature::Secret;
use crate::tenant::Tenant;
use std::collections::VecDeque;
use std::net::Ipv4Addr;
use std::sync::Mutex;
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::TcpListener;

/// Answers every look-up with the next of these, and counts them.
#[derive(Default)]
struct Scripted {
    answers: Mutex<VecDeque<Vec<IpAddr>>>,
    asked: Mutex<Vec<String>>,
}

impl Scripted {
    fn of(answers: &[&[&str]]) -> Arc<Self> {
        let read = |list: &&[&str]| list.iter().map(|text| text.parse().expect("an address")).collect();
        Arc::new(Self { answers: Mutex::new(answers.iter().map(read).collect()), asked: Mutex::default() })
    }
}

#[async_trait::async_trait]
impl Names for Scripted {
    async fn look_up(&self, name: &str) -> std::io::Result<Vec<IpAddr>> {
        self.asked.lock().expect("lock").push(name.to_owned());
        Ok(self.answers.lock().expect("lock").pop_front().expect("an answer"))
    }
}

/// A receiver that gives one answer to everybody; the requests that came.
struct Receiver {
    port: u16,
    came: Arc<Mutex<Vec<String>>>,
}

impl Receiver {
    async fn on(address: Ipv4Addr, port: u16, answer: &'static str) -> Self {
        let listener = TcpListener::bind((address, port)).await.expect("binds");
        let (port, came) = (listener.local_addr().expect("an address").port(), Arc::new(Mutex::new(Vec::new())));
        let requests = came.clone();
        tokio::spawn(async move {
            while let Ok((mut stream, _)) = listener.accept().await {
                let (mut request, mut buffer) = (Vec::new(), [0; 4096]);
                while !request.ends_with(b"}}") {
                    match stream.read(&mut buffer).await {
                        Ok(n) if n > 0 => request.extend_from_slice(&buffer[..n]),
                        _ => break,
                    }
                }
                requests.lock().expect("lock").push(String::from_utf8_lossy(&request).into_owned());
                // a sender that has gone away is none of its business
                let _ = stream.write_all(answer.as_bytes()).await;
            }
        });
        Self { port, came }
    }

    fn requests(&self) -> Vec<String> {
        self.came.lock().expect("lock").clone()
    }
}

const TAKEN: &str = "HTTP/1.1 204 No Content\r\nconnection: close\r\n\r\n";

/// What all tenants share, and what `acme` has for itself.
fn secrets() -> [Secret; 2] {
    ["whsec_MfKQ9r8GKYqrTwjUPD8ILPZIo2LaLaSw", "whsec_AAECAwQFBgcICQoLDA0ODxAREhMUFRYX"]
        .map(|text| Secret::try_from(text.to_owned()).expect("a secret"))
}

fn tenant(name: &str) -> Tenant {
    name.parse().expect("a name")
}

fn courier(names: Arc<dyn Names>, networks: &[&str]) -> Courier {
    let [common, own] = secrets();
    let config = WebhooksConfig {
        secrets: vec![common],
        tenants: [(tenant("acme"), vec![own]), (tenant("none"), Vec::new())].into(),
        allow_http: true,
        ports: Vec::new(),
        allow_private: networks.iter().map(|text| text.parse().expect("a network")).collect(),
        base_url: "https://shrinkd.example".to_owned(),
    };
    Courier::new(&config, names).expect("a courier")
}

async fn notice(url: String) -> DueNotice {
    let folder = tempfile::tempdir().expect("folder");
    let engine = SqliteEngine::open(folder.path(), Terms::default()).expect("opens");
    let job = conformance::new_job();
    let id = job.id;
    engine.submit(job).await.expect("submits");
    let claim = engine.claim("a", 1, Duration::ZERO).await.expect("claims").remove(0);
    engine.finish(&claim, Outcome::Canceled).await.expect("finishes");
    let job = engine.get(&Tenant::default(), id).await.expect("reads").expect("is there");
    DueNotice { tenant: Tenant::default(), job, url, attempts: 1 }
}

#[tokio::test]
async fn a_notice_is_sent_to_the_address_that_was_checked() {
    let receiver = Receiver::on(Ipv4Addr::LOCALHOST, 0, TAKEN).await;
    let names = Scripted::of(&[&["10.0.0.1", "127.0.0.1"]]);
    let courier = courier(names.clone(), &["127.0.0.1/32"]);
    let notice = notice(format!("http://hooks.test:{}/in?a=b", receiver.port)).await;
    assert_eq!(courier.attempt(&notice).await, Attempt::Taken);
    assert_eq!(*names.asked.lock().expect("lock"), ["hooks.test"], "looked up once");
    let requests = receiver.requests();
    assert!(requests[0].starts_with("POST /in?a=b HTTP/1.1\r\n"), "{requests:?}");
    assert!(requests[0].contains(&format!("webhook-id: job_{}\r\n", notice.job.id)), "{requests:?}");
    assert!(requests[0].contains("\"type\":\"job.canceled\""), "{requests:?}");
    assert!(requests[0].contains(&format!("https://shrinkd.example/v1/jobs/{}", notice.job.id)), "{requests:?}");
}

#[tokio::test]
async fn a_tenants_notices_are_signed_with_its_own_secret_and_with_no_other() {
    let receiver = Receiver::on(Ipv4Addr::LOCALHOST, 0, TAKEN).await;
    let courier = courier(Arc::new(SystemNames), &["127.0.0.1/32"]);
    let [common, own] = secrets();
    for (name, secret) in [("default", common), ("acme", own)] {
        let of = DueNotice { tenant: tenant(name), ..notice(format!("http://127.0.0.1:{}/", receiver.port)).await };
        assert_eq!(courier.attempt(&of).await, Attempt::Taken);
        let request = receiver.requests().pop().expect("a request");
        let (head, body) = request.split_once("\r\n\r\n").expect("a body");
        let header = |name: &str| {
            let line = head.lines().find_map(|line| line.strip_prefix(name)).expect("the header");
            line.trim_start_matches(": ").to_owned()
        };
        let timestamp = header("webhook-timestamp").parse().expect("seconds");
        let signed = sign(&[secret], &header("webhook-id"), timestamp, body.as_bytes());
        assert_eq!(header("webhook-signature"), signed, "{name}");
    }
    let of = DueNotice { tenant: tenant("none"), ..notice(format!("http://127.0.0.1:{}/", receiver.port)).await };
    assert_eq!(courier.attempt(&of).await, Attempt::Failed(None));
    assert_eq!(receiver.requests().len(), 2, "nothing goes unsigned");
}

#[tokio::test]
async fn a_name_that_comes_to_mean_something_else_is_not_followed_there() {
    // both listen on one port, so that only the address tells them apart
    let public = Receiver::on(Ipv4Addr::new(127, 0, 0, 2), 0, TAKEN).await;
    let inside = Receiver::on(Ipv4Addr::LOCALHOST, public.port, TAKEN).await;
    let answers: [&[&str]; 3] = [&["127.0.0.2"], &["127.0.0.1"], &["::ffff:127.0.0.1", "127.0.0.1", "10.0.0.1", "::1"]];
    let names = Scripted::of(&answers);
    let courier = courier(names.clone(), &["127.0.0.2/32"]);
    let notice = notice(format!("http://rebinding.test:{}/", public.port)).await;
    assert_eq!(courier.attempt(&notice).await, Attempt::Taken);
    assert_eq!(courier.attempt(&notice).await, Attempt::Failed(None));
    assert_eq!(courier.attempt(&notice).await, Attempt::Failed(None));
    assert_eq!(names.asked.lock().expect("lock").len(), 3, "every attempt looks the name up once");
    assert_eq!((public.requests().len(), inside.requests().len()), (1, 0));
}

#[tokio::test]
async fn a_local_address_gets_nothing_however_it_is_written() {
    let inside = Receiver::on(Ipv4Addr::LOCALHOST, 0, TAKEN).await;
    let courier = courier(Arc::new(SystemNames), &[]);
    for host in
        ["127.0.0.1", "localhost", "2130706433", "0x7f.1", "0177.0.0.1", "[::ffff:127.0.0.1]", "0.0.0.0", "[::]"]
    {
        let notice = notice(format!("http://{host}:{}/", inside.port)).await;
        assert_eq!(courier.attempt(&notice).await, Attempt::Failed(None), "{host}");
    }
    assert!(inside.requests().is_empty());
}

#[tokio::test]
async fn a_redirect_is_a_failure_and_is_not_followed() {
    let inside = Receiver::on(Ipv4Addr::LOCALHOST, 0, TAKEN).await;
    let answer = format!(
        "HTTP/1.1 307 Temporary Redirect\r\nlocation: http://127.0.0.1:{}/\r\nconnection: close\r\n\r\n",
        inside.port
    );
    let outside = Receiver::on(Ipv4Addr::new(127, 0, 0, 2), 0, answer.leak()).await;
    // also where the target of the redirect would be let through
    let courier = courier(Arc::new(SystemNames), &["127.0.0.0/8"]);
    let notice = notice(format!("http://127.0.0.2:{}/", outside.port)).await;
    assert_eq!(courier.attempt(&notice).await, Attempt::Failed(None));
    assert_eq!((outside.requests().len(), inside.requests().len()), (1, 0));
}

#[tokio::test]
async fn what_a_receiver_answers_is_heeded() {
    let cases = [
        ("HTTP/1.1 200 OK\r\ncontent-length: 0\r\n\r\n", Attempt::Taken),
        ("HTTP/1.1 410 Gone\r\nconnection: close\r\n\r\n", Attempt::Gone),
        ("HTTP/1.1 404 Not Found\r\nconnection: close\r\n\r\n", Attempt::Failed(None)),
        (
            "HTTP/1.1 429 Slow Down\r\nretry-after: 77\r\nconnection: close\r\n\r\n",
            Attempt::Failed(Some(Duration::from_secs(77))),
        ),
        ("HTTP/1.1 503 No\r\nretry-after: soon\r\nconnection: close\r\n\r\n", Attempt::Failed(None)),
        ("not HTTP at all\r\n\r\n", Attempt::Failed(None)),
    ];
    let courier = courier(Arc::new(SystemNames), &["127.0.0.0/8"]);
    for (answer, expected) in cases {
        let receiver = Receiver::on(Ipv4Addr::LOCALHOST, 0, answer).await;
        let notice = notice(format!("http://127.0.0.1:{}/", receiver.port)).await;
        assert_eq!(courier.attempt(&notice).await, expected, "{answer}");
        assert_eq!(receiver.requests().len(), 1, "{answer}");
    }
}
