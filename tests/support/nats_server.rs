//! A real NATS server under test: an own process, an own port, an own folder; killed when the test ends. It runs with the
//! configuration that is shipped.
//!
//! The program is `$SHRINKD_NATS_SERVER`, or `nats-server` on the path, or what `tests/support/cluster_tools.sh` installed. Where
//! there is none the test says so and is skipped; with `CI=true` it fails, so that the gate cannot pass without it.

use std::net::{TcpListener, TcpStream};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

/// Longer than a server takes to start on the slowest machine.
const START: Duration = Duration::from_secs(30);

/// The configuration for production, of which only the folder is changed.
const SHIPPED: &str = include_str!("../../docker/nats.conf");

/// A running server.
pub struct NatsServer {
    child: Child,
    program: PathBuf,
    arguments: Vec<String>,
    folder: tempfile::TempDir,
    port: u16,
}

impl NatsServer {
    /// Starts a server; `None` when there is no program and the test is to be skipped.
    ///
    /// # Panics
    /// When it does not start, or when there is none and `CI` is `true`.
    pub fn start() -> Option<Self> {
        let server = Self::begin(&program()?, Vec::new(), None);
        server.wait();
        Some(server)
    }

    /// Starts a server, as [`start`](Self::start) does, that stores so many bytes and no more.
    #[allow(dead_code, reason = "not every test that includes this file needs it")]
    pub fn start_with_room(bytes: u64) -> Option<Self> {
        let server = Self::begin(&program()?, Vec::new(), Some(bytes));
        server.wait();
        Some(server)
    }

    /// Starts three servers that are one cluster, as [`start`](Self::start) does one. The name of the i-th is `n{i}`.
    #[allow(dead_code, reason = "not every test that includes this file needs it")]
    pub fn start_three() -> Option<[Self; 3]> {
        let program = program()?;
        let addresses = [(); 3].map(|()| format!("nats://127.0.0.1:{}", free_port()));
        let servers = [0, 1, 2].map(|i: usize| {
            let cluster = ["--cluster_name", "test", "--cluster", &addresses[i], "--routes", &addresses.join(",")];
            let name = ["--name".to_owned(), format!("n{i}")];
            Self::begin(&program, cluster.map(str::to_owned).into_iter().chain(name).collect(), None)
        });
        servers.iter().for_each(Self::wait);
        Some(servers)
    }

    fn begin(program: &Path, mut arguments: Vec<String>, room: Option<u64>) -> Self {
        let (folder, port) = (tempfile::tempdir().expect("folder"), free_port());
        configure(folder.path(), room);
        let path = |name: &str| folder.path().join(name).display().to_string();
        let own = ["--config", &path("nats.conf"), "--addr", "127.0.0.1", "--port", &port.to_string()];
        arguments.extend(own.into_iter().chain(["--log", &path("log")]).map(str::to_owned));
        Self { child: spawn(program, &arguments), program: program.to_owned(), arguments, folder, port }
    }

    /// Where it listens.
    pub fn url(&self) -> String {
        format!("nats://127.0.0.1:{}", self.port)
    }

    /// Kills it without a warning.
    #[allow(dead_code, reason = "not every test that includes this file needs it")]
    pub fn kill(&mut self) {
        self.child.kill().expect("kills");
        self.child.wait().expect("ends");
    }

    /// Lets it store so many bytes from its next start on.
    #[allow(dead_code, reason = "not every test that includes this file needs it")]
    pub fn give_room(&self, bytes: u64) {
        configure(self.folder.path(), Some(bytes));
    }

    /// Starts it again on the same port with the same store.
    #[allow(dead_code, reason = "not every test that includes this file needs it")]
    pub fn restart(&mut self) {
        self.child = spawn(&self.program, &self.arguments);
        self.wait();
    }

    fn wait(&self) {
        let deadline = Instant::now() + START;
        while TcpStream::connect(("127.0.0.1", self.port)).is_err() {
            assert!(Instant::now() < deadline, "the server does not listen: {}", self.log());
            std::thread::sleep(Duration::from_millis(20));
        }
    }

    fn log(&self) -> String {
        std::fs::read_to_string(self.folder.path().join("log")).unwrap_or_default()
    }
}

impl Drop for NatsServer {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
        if std::thread::panicking() {
            eprintln!("the server's log:\n{}", self.log());
        }
    }
}

/// Writes the configuration that is shipped, with the store in a folder, and with a limit to it if there is to be one.
fn configure(folder: &Path, room: Option<u64>) {
    let mut config = SHIPPED.replace("/data/nats", &folder.join("store").display().to_string());
    assert_ne!(config, SHIPPED, "the store is not where it was");
    if let Some(bytes) = room {
        let limited = config.replacen("store_dir:", &format!("max_file_store: {bytes}\n  store_dir:"), 1);
        assert_ne!(limited, config, "the store is not told as it was");
        config = limited;
    }
    std::fs::write(folder.join("nats.conf"), config).expect("writes");
}

/// A port that is free now. It is given back at once, so that the server can have it, and have it again after a restart.
fn free_port() -> u16 {
    TcpListener::bind("127.0.0.1:0").and_then(|listener| listener.local_addr()).expect("a free port").port()
}

fn program() -> Option<PathBuf> {
    if let Some(program) = std::env::var_os("SHRINKD_NATS_SERVER") {
        return Some(program.into());
    }
    let on_path = std::env::var_os("PATH").unwrap_or_default();
    let installed = Path::new(env!("CARGO_MANIFEST_DIR")).join("target/cluster-tools/bin");
    let mut places = std::env::split_paths(&on_path).chain([installed]).map(|folder| folder.join("nats-server"));
    let found = places.find(|program| program.is_file());
    if found.is_none() {
        let hint = "no nats-server: run tests/support/cluster_tools.sh, or set SHRINKD_NATS_SERVER";
        assert!(std::env::var("CI").as_deref() != Ok("true"), "{hint}");
        eprintln!("skipped: {hint}");
    }
    found
}

fn spawn(program: &Path, arguments: &[String]) -> Child {
    let mut command = Command::new(program);
    command.args(arguments).stdout(Stdio::null()).stderr(Stdio::null());
    command.spawn().unwrap_or_else(|e| panic!("{} does not start: {e}", program.display()))
}
