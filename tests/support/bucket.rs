//! An S3 endpoint under test (moto's server, from PyPI) behind a proxy that can be told to fail; both end with the test.
//!
//! The program is `$SHRINKD_MOTO_SERVER`, or `moto_server` on the path, or what `tests/support/cluster_tools.sh` installed. Where there
//! is none the test says so and is skipped; with `CI=true` it fails, so that the gate cannot pass without it.

use std::net::{SocketAddr, TcpListener, TcpStream};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};
use tokio::io::{AsyncRead, AsyncReadExt, AsyncWrite, AsyncWriteExt};

/// Longer than the server takes to start on the slowest machine.
const START: Duration = Duration::from_secs(60);

/// What the proxy does with what comes.
#[derive(Clone, Copy)]
enum Manner {
    /// Passes it on, this much later.
    PassOn(Duration),
    /// Cuts every connection.
    Cut,
    /// Passes on so many bytes of what the server says on a connection, and then cuts it.
    CutAfter(usize),
    /// Answers every request itself, with this status.
    Refuse(u16),
}

/// A bucket named `shrinkd`.
pub struct Bucket {
    child: Child,
    /// Where clients go: the proxy.
    address: SocketAddr,
    proxy: Arc<Proxy>,
}

/// What stands between the clients and the server.
struct Proxy {
    server: SocketAddr,
    manner: Mutex<Manner>,
    /// Requests that were refused and connections that were cut.
    failures: AtomicUsize,
}

impl Bucket {
    /// Starts a server with an empty bucket; `None` when there is no program and the test is to be skipped.
    ///
    /// # Panics
    /// When it does not start, or when there is none and `CI` is `true`.
    pub async fn start() -> Option<Self> {
        let program = program()?;
        let port = TcpListener::bind("127.0.0.1:0").and_then(|listener| listener.local_addr()).expect("a port").port();
        let mut command = Command::new(&program);
        command.args(["-H", "127.0.0.1", "-p", &port.to_string()]).stdout(Stdio::null()).stderr(Stdio::null());
        let child = command.spawn().unwrap_or_else(|e| panic!("{} does not start: {e}", program.display()));
        let server = SocketAddr::from(([127, 0, 0, 1], port));
        let deadline = Instant::now() + START;
        while TcpStream::connect(server).is_err() {
            assert!(Instant::now() < deadline, "{} does not listen", program.display());
            tokio::time::sleep(Duration::from_millis(50)).await;
        }
        let listener = TcpListener::bind("127.0.0.1:0").expect("a port");
        let address = listener.local_addr().expect("an address");
        let manner = Mutex::new(Manner::PassOn(Duration::ZERO));
        let proxy = Arc::new(Proxy { server, manner, failures: AtomicUsize::new(0) });
        listener.set_nonblocking(true).expect("a socket");
        // a thread of its own: tests wait for their services without giving way to other tasks
        std::thread::spawn({
            let proxy = proxy.clone();
            move || {
                let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().expect("a runtime");
                runtime.block_on(async {
                    stand_between(tokio::net::TcpListener::from_std(listener).expect("a socket"), proxy).await;
                });
            }
        });
        let bucket = Self { child, address, proxy };
        let made =
            reqwest::Client::new().put(format!("{}/shrinkd", bucket.endpoint())).send().await.expect("an answer");
        assert!(made.status().is_success(), "{made:?}");
        Some(bucket)
    }

    /// Where the server is.
    pub fn endpoint(&self) -> String {
        format!("http://{}", self.address)
    }

    /// The variables that make a service use the bucket, under a prefix.
    pub fn variables(&self, prefix: &str) -> Vec<(&'static str, String)> {
        vec![
            ("SHRINKD_BLOBS", format!("s3://shrinkd/{prefix}")),
            ("AWS_ENDPOINT", self.endpoint()),
            ("AWS_ALLOW_HTTP", "true".to_owned()),
            ("AWS_ACCESS_KEY_ID", "test".to_owned()),
            ("AWS_SECRET_ACCESS_KEY", "test".to_owned()),
            ("AWS_REGION", "us-east-1".to_owned()),
        ]
    }

    /// Cuts every connection from now on.
    pub fn cut(&self) {
        self.proxy.behave(Manner::Cut);
    }

    /// Passes everything on, this much later.
    pub fn delay(&self, by: Duration) {
        self.proxy.behave(Manner::PassOn(by));
    }

    /// Passes on so many bytes of the server's answers on each connection from now on, and then cuts it.
    #[allow(dead_code, reason = "not every program that includes this file needs it")]
    pub fn cut_after(&self, bytes: usize) {
        self.proxy.behave(Manner::CutAfter(bytes));
    }

    /// Answers every request with this status from now on; what is under way is cut.
    #[allow(dead_code, reason = "not every program that includes this file needs it")]
    pub fn refuse(&self, status: u16) {
        self.proxy.behave(Manner::Refuse(status));
    }

    /// How many requests were refused and connections cut so far.
    #[allow(dead_code, reason = "not every program that includes this file needs it")]
    pub fn failures(&self) -> usize {
        self.proxy.failures.load(Ordering::SeqCst)
    }
}

impl Drop for Bucket {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

async fn stand_between(listener: tokio::net::TcpListener, proxy: Arc<Proxy>) {
    while let Ok((client, _)) = listener.accept().await {
        let proxy = proxy.clone();
        tokio::spawn(async move {
            if let Manner::Refuse(status) = proxy.manner() {
                proxy.refuse(client, status).await;
                return;
            }
            let Ok(server) = tokio::net::TcpStream::connect(proxy.server).await else { return };
            let ((from_client, to_client), (from_server, to_server)) = (client.into_split(), server.into_split());
            tokio::select! {
                () = proxy.copy(from_client, to_server, false) => {}
                () = proxy.copy(from_server, to_client, true) => {}
            }
        });
    }
}

impl Proxy {
    fn manner(&self) -> Manner {
        *self.manner.lock().expect("no panic")
    }

    fn behave(&self, manner: Manner) {
        *self.manner.lock().expect("no panic") = manner;
    }

    fn fail(&self) {
        self.failures.fetch_add(1, Ordering::SeqCst);
    }

    /// Copies until either side ends or the connection is to be cut.
    async fn copy(&self, mut from: impl AsyncRead + Unpin, mut to: impl AsyncWrite + Unpin, is_answer: bool) {
        let (mut buffer, mut passed) = (vec![0; 1 << 16], 0);
        while let Ok(read @ 1..) = from.read(&mut buffer).await {
            let kept = match self.manner() {
                Manner::PassOn(wait) => {
                    tokio::time::sleep(wait).await;
                    read
                }
                Manner::CutAfter(bytes) if is_answer => read.min(bytes.saturating_sub(passed)),
                Manner::CutAfter(_) => read,
                // whoever is in the middle of a request cannot be answered, and comes again
                Manner::Cut | Manner::Refuse(_) => 0,
            };
            passed += kept;
            let written = to.write_all(&buffer[..kept]).await;
            if kept < read {
                self.fail();
                return;
            }
            if written.is_err() {
                return;
            }
        }
    }

    /// Reads one request and answers it with an error, as a bucket says it.
    async fn refuse(&self, mut client: tokio::net::TcpStream, status: u16) {
        let (mut buffer, mut request) = (vec![0; 1 << 16], Vec::new());
        while !is_whole(&request) {
            let Ok(read @ 1..) = client.read(&mut buffer).await else { return };
            request.extend_from_slice(&buffer[..read]);
        }
        self.fail();
        let code = match status {
            403 => "AccessDenied",
            503 => "SlowDown",
            _ => "InternalError",
        };
        let error = format!("<Error><Code>{code}</Code><Message>by the test</Message></Error>");
        let head = format!(
            "HTTP/1.1 {status} {code}\r\ncontent-type: application/xml\r\ncontent-length: {}\r\nconnection: close\r\n\r\n",
            error.len(),
        );
        let body = if request.starts_with(b"HEAD ") { "" } else { &error };
        // a client that has gone away misses nothing
        let _ = client.write_all(format!("{head}{body}").as_bytes()).await;
        let _ = client.shutdown().await;
    }
}

/// Whether a request has come to its end; clients of buckets say how long it is.
fn is_whole(request: &[u8]) -> bool {
    let Some(head) = request.windows(4).position(|bytes| bytes == b"\r\n\r\n") else { return false };
    let text = String::from_utf8_lossy(&request[..head]).to_ascii_lowercase();
    let length = text.lines().find_map(|line| line.strip_prefix("content-length:")?.trim().parse().ok());
    request.len() >= head + 4 + length.unwrap_or(0)
}

fn program() -> Option<PathBuf> {
    if let Some(program) = std::env::var_os("SHRINKD_MOTO_SERVER") {
        return Some(program.into());
    }
    let on_path = std::env::var_os("PATH").unwrap_or_default();
    let installed = Path::new(env!("CARGO_MANIFEST_DIR")).join("target/cluster-tools/bin");
    let mut places = std::env::split_paths(&on_path).chain([installed]).map(|folder| folder.join("moto_server"));
    let found = places.find(|program| program.is_file());
    if found.is_none() {
        let hint = "no moto_server: run tests/support/cluster_tools.sh, or set SHRINKD_MOTO_SERVER";
        assert!(std::env::var("CI").as_deref() != Ok("true"), "{hint}");
        eprintln!("skipped: {hint}");
    }
    found
}
