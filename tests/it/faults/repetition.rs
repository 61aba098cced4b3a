//! The process that answers is killed between accepting a job and saying so, and the client says it again under the same key.

use super::cluster::{ended_once, node};
use super::{jobs_labeled, labeled, submit_keyed};
use crate::app::{App, PATIENCE};
use crate::cluster::nats_server::NatsServer;
use crate::tenants::eventually;
use async_nats::{Message, Subscriber};
use futures::StreamExt;
use serde_json::{Value, json};
use std::io::{Read, Write};
use std::net::TcpStream;
use std::time::Duration;

/// When the process is killed.
#[derive(Clone, Copy, Debug)]
enum Moment {
    /// So many milliseconds after the request was sent. Accepting takes some two to four (docs/operations.md).
    After(u64),
    /// Once the job is stored; nobody has listened to the answer.
    Stored,
    /// As it sends the servers of the cluster a message of this kind.
    Sends(&'static str),
}

impl Moment {
    /// Those that come with any engine, each with a word that a label and a key can have.
    fn of_any_engine() -> Vec<(Self, String)> {
        let spread = [0, 1, 2, 3, 4, 5, 7, 10].into_iter().map(|ms| (Self::After(ms), format!("{ms}-ms")));
        spread.chain([(Self::Stored, "stored".to_owned())]).collect()
    }

    /// The steps of a submit on a cluster (`src/engine/nats/layout.rs`): the key names the job, then comes the request, then the record.
    fn of_a_cluster() -> Vec<(Self, String)> {
        ["key", "spec", "job"].map(|kind| (Self::Sends(kind), format!("as-it-sends-the-{kind}"))).to_vec()
    }

    /// Waits for it. `sent` are the messages of the cluster, where there is one.
    async fn comes(self, app: &App, round: &str, sent: Option<&mut Subscriber>) {
        match self {
            // the runtime's own clock has no finer steps than these
            Self::After(ms) => std::thread::sleep(Duration::from_millis(ms)),
            Self::Stored => eventually("it is stored", async || jobs_labeled(app, round).await.len() == 1).await,
            Self::Sends(kind) => {
                let sent = sent.expect("a cluster");
                let is_it = |message: &Message| {
                    let has_label = message.payload.windows(round.len()).any(|bytes| bytes == round.as_bytes());
                    message.subject.starts_with(&format!("SHRINKD.{kind}.")) && has_label
                };
                let found =
                    tokio::time::timeout(PATIENCE, async { while !is_it(&sent.next().await.expect("a message")) {} });
                found.await.expect("in time");
            }
        }
    }
}

/// Sends the request of a round and does not wait for an answer.
fn send(app: &App, round: &str) -> TcpStream {
    let (address, body) = (app.url.trim_start_matches("http://"), labeled(round).to_string());
    let head = format!(
        "POST /v1/jobs HTTP/1.1\r\nhost: {address}\r\ncontent-type: application/json\r\nidempotency-key: {round}\r\n\
         content-length: {}\r\n\r\n",
        body.len(),
    );
    let mut connection = TcpStream::connect(address).expect("connects");
    connection.write_all(format!("{head}{body}").as_bytes()).expect("sends");
    connection
}

/// The job that the process has told of before it died, if the answer is whole.
fn told(mut connection: TcpStream) -> Option<Value> {
    connection.set_read_timeout(Some(PATIENCE)).expect("a socket");
    let mut answer = Vec::new();
    // whether the connection ended or was reset, this is all that came
    let _ = connection.read_to_end(&mut answer);
    let answer = String::from_utf8(answer).ok()?;
    let (head, body) = answer.split_once("\r\n\r\n")?;
    assert!(head.starts_with("HTTP/1.1 202 "), "{answer}");
    serde_json::from_str(body).ok()
}

/// Repeats the request of a round after its process was killed; returns the job's name.
async fn repeat(app: &App, (moment, round): &(Moment, String), connection: TcpStream) -> String {
    let (id, is_repetition) = submit_keyed(app, round, &labeled(round)).await;
    if let Some(told) = told(connection) {
        assert_eq!(told["id"], *id, "the dead process has told of the same job");
        assert!(is_repetition, "what was answered is accepted: {round}");
    }
    assert!(is_repetition || !matches!(moment, Moment::Stored), "what is stored is accepted");
    id
}

/// Checks that every round has made one job, and that it came to its end.
async fn one_each(app: &App, made: &[(String, String)]) {
    assert!(!made.is_empty());
    for (round, id) in made {
        ended_once(app, id).await;
        assert_eq!(jobs_labeled(app, round).await, [id.as_str()], "one key, one job: {round}");
    }
}

#[tokio::test]
async fn a_submit_that_is_repeated_after_a_kill_makes_one_job() {
    let folder = tempfile::tempdir().expect("folder");
    let start = || App::start(folder.path());
    let (mut app, mut made) = (start(), Vec::new());
    for round in Moment::of_any_engine() {
        let connection = send(&app, &round.1);
        round.0.comes(&app, &round.1, None).await;
        app.kill();
        app = start();
        let id = repeat(&app, &round, connection).await;
        // before the next kill, which would take it with it
        app.ended(&id).await;
        made.push((round.1, id));
    }
    one_each(&app, &made).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_submit_that_is_repeated_on_another_node_after_a_kill_makes_one_job() {
    let Some(server) = NatsServer::start() else { return };
    let folder = tempfile::tempdir().expect("folder");
    let api = || node(folder.path(), &server.url(), &[("SHRINKD_ROLE", "api")]);
    let other = node(folder.path(), &server.url(), &[]);
    let client = async_nats::connect(server.url()).await.expect("connects");
    let mut made = Vec::new();
    for round in Moment::of_any_engine().into_iter().chain(Moment::of_a_cluster()) {
        let dying = api();
        let mut sent = client.subscribe("SHRINKD.>").await.expect("subscribes");
        client.flush().await.expect("is heard");
        let connection = send(&dying, &round.1);
        round.0.comes(&dying, &round.1, Some(&mut sent)).await;
        dying.kill();
        let id = repeat(&other, &round, connection).await;
        made.push((round.1, id));
    }
    // a node that comes late knows everything that was stored before it
    let late = api();
    one_each(&late, &made).await;
    for (_, id) in &made {
        assert_eq!(late.get_json(&format!("/v1/jobs/{id}")).await["attempt"], json!(1), "its worker was never killed");
    }
}
