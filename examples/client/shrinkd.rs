//! A client of the service: one file to copy. It needs `reqwest` (features `json` and `stream`), `eventsource-stream`, `futures`,
//! `serde_json`, `sha2`, `thiserror` and `tokio`.
//!
//! What can be repeated is repeated: a submit goes under a key, so that a second one after a lost answer is the same job; a stream that
//! was cut goes on after the last event that was seen; a download that was cut goes on where it stopped, and is checked against the hash
//! that the job's record promises.

use eventsource_stream::Eventsource;
use futures::{Stream, StreamExt, stream};
use reqwest::header::{HeaderMap, IF_RANGE, RANGE, RETRY_AFTER};
use reqwest::{Method, RequestBuilder, Response, StatusCode};
use serde_json::Value;
use sha2::{Digest, Sha256};
use std::collections::VecDeque;
use std::time::Duration;

/// How often a request is made that got no answer, or the answer that it should be made later.
const TRIES: u32 = 8;
/// Pause before it is made again where the service names none.
const PAUSE: Duration = Duration::from_secs(1);
/// Pauses at most, whatever the service names.
const LONGEST_PAUSE: Duration = Duration::from_secs(30);
/// Pause before a stream that was cut is opened again, until the stream names another.
const RETRY: Duration = Duration::from_secs(2);

/// Why there is no result.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The service refused: its problem document (RFC 9457).
    #[error("{code} ({status}): {detail}{places}", places = places(.document))]
    Problem {
        /// The HTTP status.
        status: u16,
        /// The stable name of the kind of problem.
        code: String,
        /// What is wrong this time.
        detail: String,
        /// The whole document.
        document: Value,
    },
    /// The job has ended without success.
    #[error("the job {id} has {state}: {detail}", id = .job["id"].as_str().unwrap_or("?"), state = .job["state"].as_str().unwrap_or("?"),
        detail = .job["problem"]["detail"].as_str().unwrap_or("it was asked to"))]
    NoSuccess {
        /// Its record.
        job: Box<Value>,
    },
    /// The service did not answer, or not as it should.
    #[error("{0}")]
    Answer(String),
    /// There is no connection.
    #[error(transparent)]
    Connection(#[from] reqwest::Error),
}

fn places(document: &Value) -> String {
    let faults = document["errors"].as_array().map(Vec::as_slice).unwrap_or_default();
    faults
        .iter()
        .map(|f| format!("\n  {}: {}", f["pointer"].as_str().unwrap_or(""), f["detail"].as_str().unwrap_or("")))
        .collect()
}

/// One event of a job.
#[derive(Clone, Debug)]
pub struct Event {
    /// The job's own number of it, from 1, the same at every node.
    pub seq: u64,
    /// `snapshot`, `state`, `progress`, `mesh` or `done`.
    pub kind: String,
    /// What it tells.
    pub data: Value,
}

/// A service, and who asks it.
#[derive(Clone)]
pub struct Client {
    http: reqwest::Client,
    url: String,
    key: Option<String>,
}

impl Client {
    /// A client of the service at an address such as `http://127.0.0.1:8080`; `key` is an API key or a token, where the service asks
    /// for one.
    pub fn new(url: &str, key: Option<String>) -> Self {
        Self { http: reqwest::Client::new(), url: url.trim_end_matches('/').to_owned(), key }
    }

    fn request(&self, method: Method, path: &str) -> RequestBuilder {
        let request = self.http.request(method, format!("{}{path}", self.url));
        match &self.key {
            Some(key) => request.bearer_auth(key),
            None => request,
        }
    }

    /// Uploads a field's file (scene, network, mesh, grid); returns its description, with its `id`.
    pub async fn upload(&self, bytes: Vec<u8>) -> Result<Value, Error> {
        Ok(patiently(|| self.request(Method::POST, "/v1/inputs").body(bytes.clone())).await?.json().await?)
    }

    /// Submits a job, such as `{"field": {"input": id}}`; the same `key` with the same body is the same job, for a day.
    pub async fn submit(&self, job: &Value, key: &str) -> Result<Value, Error> {
        let request = || self.request(Method::POST, "/v1/jobs").header("idempotency-key", key).json(job);
        Ok(patiently(request).await?.json().await?)
    }

    /// A job's record.
    pub async fn job(&self, id: &str) -> Result<Value, Error> {
        Ok(patiently(|| self.request(Method::GET, &format!("/v1/jobs/{id}"))).await?.json().await?)
    }

    /// Asks a job to stop.
    pub async fn cancel(&self, id: &str) -> Result<Value, Error> {
        Ok(patiently(|| self.request(Method::POST, &format!("/v1/jobs/{id}/cancel"))).await?.json().await?)
    }

    /// The events of a job as they happen, to its end; `after` a number only those that follow it.
    pub fn follow(&self, id: &str, after: Option<u64>) -> impl Stream<Item = Result<Event, Error>> + Send + use<> {
        let following = Following {
            client: self.clone(),
            id: id.to_owned(),
            after,
            retry: RETRY,
            here: VecDeque::new(),
            source: None,
            over: false,
        };
        stream::unfold(following, |mut following| async move {
            let event = following.next().await?;
            if event.is_err() {
                following.over = true;
            }
            Some((event, following))
        })
    }

    /// Waits for the end of a job; an end without success is an error.
    pub async fn succeeded(&self, id: &str) -> Result<Value, Error> {
        loop {
            let path = format!("/v1/jobs/{id}?wait=30");
            let job: Value = patiently(|| self.request(Method::GET, &path)).await?.json().await?;
            match job["state"].as_str() {
                Some("succeeded") => return Ok(job),
                Some("failed" | "canceled") => return Err(Error::NoSuccess { job: Box::new(job) }),
                _ => {}
            }
        }
    }

    /// Downloads an output (`glb`, `surface`, `preview`, `report`, …) of a job's record, whole and as the record promises it.
    pub async fn download(&self, job: &Value, name: &str) -> Result<Vec<u8>, Error> {
        let outputs = job["outputs"].as_array().map(Vec::as_slice).unwrap_or_default();
        let output = outputs.iter().find(|output| output["name"] == name);
        let output = output.ok_or_else(|| Error::Answer(format!("the job has no output {name:?}")))?;
        let (href, sha256) = (output["href"].as_str().unwrap_or(""), output["sha256"].as_str().unwrap_or(""));
        let (length, tag) = (output["bytes"].as_u64().unwrap_or(0), format!("\"{sha256}\""));
        let mut bytes = Vec::new();
        for _ in 0..TRIES {
            let from = bytes.len();
            let answer = patiently(|| {
                let request = self.request(Method::GET, href);
                if from == 0 { request } else { request.header(RANGE, format!("bytes={from}-")).header(IF_RANGE, &tag) }
            });
            let answer = answer.await?;
            if answer.status() != StatusCode::PARTIAL_CONTENT {
                bytes.clear();
            }
            let mut pieces = answer.bytes_stream();
            // a cut connection is an error in the middle of the pieces
            while let Some(Ok(piece)) = pieces.next().await {
                bytes.extend_from_slice(&piece);
            }
            if bytes.len() as u64 >= length {
                break;
            }
        }
        let hash: String = Sha256::digest(&bytes).iter().map(|byte| format!("{byte:02x}")).collect();
        if hash != sha256 {
            return Err(Error::Answer(format!(
                "{href}: {} bytes came of {length}, or others than the record promises",
                bytes.len()
            )));
        }
        Ok(bytes)
    }
}

/// A stream of events, and where it is.
struct Following {
    client: Client,
    id: String,
    after: Option<u64>,
    retry: Duration,
    here: VecDeque<Event>,
    source: Option<stream::BoxStream<'static, Option<eventsource_stream::Event>>>,
    over: bool,
}

impl Following {
    async fn next(&mut self) -> Option<Result<Event, Error>> {
        loop {
            if let Some(event) = self.here.pop_front() {
                self.over = event.kind == "done";
                return Some(Ok(event));
            }
            if self.over {
                return None;
            }
            match &mut self.source {
                None => match open(&self.client, &self.id, self.after).await {
                    // everything was seen before
                    Ok(None) => return None,
                    Ok(Some(answer)) => {
                        let events = answer.bytes_stream().eventsource().map(Result::ok);
                        self.source = Some(events.boxed());
                    }
                    Err(error) => return Some(Err(error)),
                },
                Some(source) => match source.next().await {
                    Some(Some(frame)) => {
                        self.retry = frame.retry.unwrap_or(self.retry);
                        let seq = frame.id.parse().ok().or(self.after).unwrap_or(0);
                        self.after = Some(seq);
                        let data = serde_json::from_str(&frame.data).unwrap_or(Value::Null);
                        self.here.push_back(Event { seq, kind: frame.event, data });
                    }
                    // cut, or the service stops
                    Some(None) | None => {
                        self.source = None;
                        tokio::time::sleep(self.retry).await;
                    }
                },
            }
        }
    }
}

/// Opens the stream of a job's events after a number; `None` when all were seen.
async fn open(client: &Client, id: &str, after: Option<u64>) -> Result<Option<Response>, Error> {
    let path = format!("/v1/jobs/{id}/events");
    let request = || {
        let request = client.request(Method::GET, &path).header("accept", "text/event-stream");
        match after {
            Some(after) => request.header("last-event-id", after),
            None => request,
        }
    };
    let answer = patiently(request).await?;
    Ok((answer.status() != StatusCode::NO_CONTENT).then_some(answer))
}

/// Makes a request until there is an answer that will not be another one later.
async fn patiently(request: impl Fn() -> RequestBuilder) -> Result<Response, Error> {
    for tries in 1.. {
        let pause = match request().send().await {
            Ok(answer) if answer.status().is_success() => return Ok(answer),
            Ok(answer) => {
                let later = matches!(answer.status(), StatusCode::TOO_MANY_REQUESTS | StatusCode::SERVICE_UNAVAILABLE);
                let pause = retry_after(answer.headers());
                if !later || tries == TRIES {
                    return Err(refused(answer).await);
                }
                pause
            }
            Err(error) if tries == TRIES => return Err(error.into()),
            Err(_) => PAUSE,
        };
        tokio::time::sleep(pause.min(LONGEST_PAUSE)).await;
    }
    unreachable!("the last try returns")
}

fn retry_after(headers: &HeaderMap) -> Duration {
    let seconds = headers.get(RETRY_AFTER).and_then(|value| value.to_str().ok()?.parse().ok());
    seconds.map_or(PAUSE, Duration::from_secs)
}

async fn refused(answer: Response) -> Error {
    let status = answer.status();
    match answer.json::<Value>().await {
        Ok(document) if document["code"].is_string() => Error::Problem {
            status: status.as_u16(),
            code: document["code"].as_str().unwrap_or("").to_owned(),
            detail: document["detail"].as_str().unwrap_or("").to_owned(),
            document,
        },
        _ => Error::Answer(format!("an answer {status} without a problem document")),
    }
}
