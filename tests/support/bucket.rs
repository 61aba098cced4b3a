//! An S3 endpoint under test (moto's server, from PyPI) behind a proxy that can be told to fail; both end with the test.
//!
//! The program is `$SHRINKD_MOTO_SERVER`, or `moto_server` on the path, or what `tests/support/cluster_tools.sh` installed. Where there
//! is none the test says so and is skipped; with `CI=true` it fails, so that the gate cannot pass without it.

use std::net::{SocketAddr, TcpListener, TcpStream};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

/// Longer than the server takes to start on the slowest machine.
const START: Duration = Duration::from_secs(60);
/// The delay that stands for "every connection is cut".
const CUT: u64 = u64::MAX;

/// A bucket named `shrinkd`.
pub struct Bucket {
    child: Child,
    /// Where clients go: the proxy.
    address: SocketAddr,
    /// Milliseconds that the proxy waits before it passes anything on, or [`CUT`].
    delay: Arc<AtomicU64>,
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
        let (address, delay) = (listener.local_addr().expect("an address"), Arc::new(AtomicU64::new(0)));
        listener.set_nonblocking(true).expect("a socket");
        // a thread of its own: tests wait for their services without giving way to other tasks
        std::thread::spawn({
            let delay = delay.clone();
            move || {
                let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().expect("a runtime");
                runtime.block_on(async {
                    pass_on(tokio::net::TcpListener::from_std(listener).expect("a socket"), server, delay).await;
                });
            }
        });
        let bucket = Self { child, address, delay };
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
        self.delay.store(CUT, Ordering::SeqCst);
    }

    /// Passes everything on, this much later.
    pub fn delay(&self, by: Duration) {
        self.delay.store(by.as_millis() as u64, Ordering::SeqCst);
    }
}

impl Drop for Bucket {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

async fn pass_on(listener: tokio::net::TcpListener, server: SocketAddr, delay: Arc<AtomicU64>) {
    while let Ok((client, _)) = listener.accept().await {
        let delay = delay.clone();
        tokio::spawn(async move {
            let Ok(server) = tokio::net::TcpStream::connect(server).await else { return };
            let ((from_client, to_client), (from_server, to_server)) = (client.into_split(), server.into_split());
            tokio::select! {
                () = copy(from_client, to_server, &delay) => {}
                () = copy(from_server, to_client, &delay) => {}
            }
        });
    }
}

async fn copy(from: tokio::net::tcp::OwnedReadHalf, to: tokio::net::tcp::OwnedWriteHalf, delay: &AtomicU64) {
    let mut buffer = vec![0; 1 << 16];
    while from.readable().await.is_ok() {
        let read = match from.try_read(&mut buffer) {
            Ok(0) => return,
            Ok(read) => read,
            Err(error) if error.kind() == std::io::ErrorKind::WouldBlock => continue,
            Err(_) => return,
        };
        match delay.load(Ordering::SeqCst) {
            CUT => return,
            wait => tokio::time::sleep(Duration::from_millis(wait)).await,
        }
        let mut rest = &buffer[..read];
        while !rest.is_empty() && to.writable().await.is_ok() {
            match to.try_write(rest) {
                Ok(written) => rest = &rest[written..],
                Err(error) if error.kind() == std::io::ErrorKind::WouldBlock => {}
                Err(_) => return,
            }
        }
    }
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
