//! A service under test: an own process, an own port, an own folder; killed when the test ends.

use reqwest::{Client, Method, RequestBuilder, Response, StatusCode};
use serde_json::{Value, json};
use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

/// Longer than anything a test waits for, on the slowest machine.
pub const PATIENCE: Duration = Duration::from_secs(120);
/// The program under test.
pub const BINARY: &str = env!("CARGO_BIN_EXE_shrinkd");

/// A running service.
pub struct App {
    child: Child,
    /// Where it listens, without a slash at the end.
    pub url: String,
    /// A client without any memory.
    pub client: Client,
    log: Arc<Mutex<String>>,
}

impl App {
    /// Starts a service in a folder.
    pub fn start(folder: &Path) -> Self {
        Self::start_with(folder, &[])
    }

    /// Starts a service in a folder, with further variables.
    pub fn start_with(folder: &Path, variables: &[(&str, &str)]) -> Self {
        Self::start_at(folder, "127.0.0.1:0", variables)
    }

    /// Starts a service in a folder, at an address, with further variables.
    pub fn start_at(folder: &Path, listen: &str, variables: &[(&str, &str)]) -> Self {
        let mut command = Command::new(BINARY);
        command.args(["serve", "--listen", listen, "--data"]).arg(folder);
        // two threads, so that what takes long here takes long on a machine with many cores, too
        command.env("SHRINKD_LOG__FORMAT", "json").env("SHRINKD_WORKER__THREADS", "2").envs(variables.iter().copied());
        let mut child = command.stdout(Stdio::null()).stderr(Stdio::piped()).spawn().expect("the program starts");
        let mut lines = BufReader::new(child.stderr.take().expect("piped")).lines();
        let log = Arc::new(Mutex::new(String::new()));
        let address = loop {
            let line = lines.next().unwrap_or_else(|| panic!("ended before it listened: {}", log.lock().expect("log")));
            let line = line.expect("text");
            log.lock().expect("log").push_str(&format!("{line}\n"));
            let entry: Value = serde_json::from_str(&line).unwrap_or_default();
            if entry["message"] == "listening" {
                break entry["http.address"].as_str().expect("an address").to_owned();
            }
        };
        let kept = log.clone();
        std::thread::spawn(move || {
            for line in lines.map_while(Result::ok) {
                kept.lock().expect("log").push_str(&format!("{line}\n"));
            }
        });
        Self { child, url: format!("http://{address}"), client: Client::new(), log }
    }

    /// What it has logged so far.
    pub fn log(&self) -> String {
        self.log.lock().expect("log").clone()
    }

    /// The number of its process.
    pub fn process(&self) -> u32 {
        self.child.id()
    }

    /// A request to a path.
    pub fn request(&self, method: Method, path: &str) -> RequestBuilder {
        self.client.request(method, format!("{}{path}", self.url)).timeout(PATIENCE)
    }

    /// GET, whatever the answer.
    pub async fn get(&self, path: &str) -> Response {
        self.request(Method::GET, path).send().await.expect("an answer")
    }

    /// GET of JSON that must succeed.
    pub async fn get_json(&self, path: &str) -> Value {
        let response = self.get(path).await;
        assert!(response.status().is_success(), "{path}: {}", response.status());
        response.json().await.expect("JSON")
    }

    /// POST of JSON, whatever the answer.
    pub async fn post(&self, path: &str, body: &Value) -> Response {
        self.request(Method::POST, path).json(body).send().await.expect("an answer")
    }

    /// Submits a job that must be accepted, and returns its name.
    pub async fn submit(&self, body: &Value) -> String {
        let response = self.post("/v1/jobs", body).await;
        assert_eq!(response.status(), StatusCode::ACCEPTED);
        let job: Value = response.json().await.expect("JSON");
        job["id"].as_str().expect("a name").to_owned()
    }

    /// The job once `done` says so.
    pub async fn wait_until(&self, id: &str, done: impl Fn(&Value) -> bool) -> Value {
        let clock = Instant::now();
        loop {
            let job = self.get_json(&format!("/v1/jobs/{id}")).await;
            if done(&job) {
                return job;
            }
            assert!(clock.elapsed() < PATIENCE, "still {job}\n{}", self.log());
            tokio::time::sleep(Duration::from_millis(10)).await;
        }
    }

    /// The job once it has ended.
    pub async fn ended(&self, id: &str) -> Value {
        self.wait_until(id, |job| ["succeeded", "failed", "canceled"].contains(&state(job))).await
    }

    /// The job once a worker has it (or it has ended already).
    pub async fn running(&self, id: &str) -> Value {
        self.wait_until(id, |job| state(job) != "queued").await
    }

    /// Kills it at once, as `kill -9` does.
    pub fn kill(mut self) {
        self.child.kill().expect("kills");
        self.child.wait().expect("ends");
    }

    /// Asks it to stop.
    pub fn terminate(&self) {
        self.signal("-TERM");
    }

    /// Asks it to stop as Ctrl-C does.
    pub fn interrupt(&self) {
        self.signal("-INT");
    }

    fn signal(&self, signal: &str) {
        let id = self.process().to_string();
        assert!(Command::new("kill").args([signal, &id]).status().expect("kill").success());
    }

    /// How it ended, and how long that took.
    pub fn wait(&mut self) -> (ExitStatus, Duration) {
        let clock = Instant::now();
        loop {
            if let Some(status) = self.child.try_wait().expect("waits") {
                return (status, clock.elapsed());
            }
            assert!(clock.elapsed() < PATIENCE, "it does not end\n{}", self.log());
            std::thread::sleep(Duration::from_millis(10));
        }
    }
}

impl Drop for App {
    fn drop(&mut self) {
        // fails when it has ended already
        let _ = self.child.kill();
        let _ = self.child.wait();
        if std::thread::panicking() {
            eprintln!("--- log of the service ---\n{}", self.log());
        }
    }
}

/// A state's name.
pub fn state(job: &Value) -> &str {
    job["state"].as_str().expect("a state")
}

/// A job that is done in a moment: a ball on a small lattice, by the method that needs the least.
pub fn small() -> Value {
    json!({
        "field": {"scene": {"sphere": {"radius": 0.6}}},
        "shrink": {"method": "paper", "lattice": {"latlong": {"n_theta": 32, "n_phi": 16}}},
    })
}

/// A job that takes much longer than a test: the paper's loop on the finest lattice.
pub fn endless() -> Value {
    json!({
        "field": {"scene": {"ellipsoid": {"radii": [0.8, 0.6, 0.4]}}},
        "shrink": {"method": "paper", "lattice": {"latlong": {"n_theta": 2048, "n_phi": 1024}}},
    })
}

/// Checks that an answer is a problem document with this status and code, and returns it.
pub async fn problem(response: Response, status: u16, code: &str) -> Value {
    assert_eq!(response.headers()["content-type"], "application/problem+json");
    let (found, id) =
        (response.status().as_u16(), response.headers()["x-request-id"].to_str().expect("text").to_owned());
    let body: Value = response.json().await.expect("JSON");
    assert_eq!((found, body["code"].as_str()), (status, Some(code)), "{body}");
    assert_eq!(body["type"], format!("urn:shrinkd:problem:{code}"));
    assert_eq!(body["status"], status);
    assert_eq!(body["request_id"], id);
    assert!(body["title"].is_string() && body["detail"].is_string());
    body
}

/// A file among the fixtures.
pub fn fixture(name: &str) -> Vec<u8> {
    std::fs::read(Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures").join(name)).expect("reads")
}
