//! `shrinkd doctor`: looks at a set-up as `serve` would find it, and says of everything that is wrong what to do. It starts nothing, takes
//! nothing from a service that runs, and leaves nothing behind.

use super::{BAD_USAGE, FAILED, NodeArgs, fail, serve};
use crate::blobs::Blobs;
use crate::config::{Config, FOLDER, Role, SQLITE};
use crate::engine::nats::{Address, NatsEngine};
use crate::engine::sqlite;
use crate::extract::Budget;
use crate::http;
use crate::job::pipeline::{self, Asked};
use crate::job::spec::FieldSpec;
use crate::settings::{CancelToken, Settings};
use crate::shrink::ShrinkSpec;
use crate::shrink::lattice::LatticeSpec;
use crate::telemetry;
use rustix::process::{Resource, getrlimit};
use std::fmt::Display;
use std::net::TcpListener;
use std::path::Path;
use std::process::ExitCode;
use std::time::{Duration, Instant};

/// What `doctor --help` ends with.
pub const EXAMPLES: &str = "\
Examples:
  shrinkd doctor
  shrinkd doctor --config /etc/shrinkd.toml
  shrinkd doctor --engine nats://nats-1:4222 --blobs s3://surfaces/prod

Exits 0 when a service can be started so, 1 when it cannot, 2 on bad usage or a configuration that cannot be read.";

/// Time for servers to answer.
const PATIENCE: Duration = Duration::from_secs(10);
/// Fewer open files than this run out with a few hundred clients.
const FEW_FILES: u64 = 4096;
/// Less room on the disk than this is gone after a few thousand jobs.
const LITTLE_ROOM: u64 = 1 << 30;

/// What a look came to.
enum Found {
    Well(String),
    Doubtful(String),
    Wrong(String),
}

use Found::{Doubtful, Well, Wrong};

/// Looks at everything and prints a line for each.
pub fn run(args: &NodeArgs) -> ExitCode {
    let config = match Config::load(args.config.as_deref(), serve::flags(args)) {
        Ok(config) => config,
        Err(error) => return fail(BAD_USAGE, &error),
    };
    let runtime = match tokio::runtime::Builder::new_multi_thread().enable_all().build() {
        Ok(runtime) => runtime,
        Err(error) => return fail(FAILED, &error),
    };
    if let Err(error) = telemetry::start(&config.log, None) {
        return fail(BAD_USAGE, &error);
    }
    let mut wrong = 0;
    let mut say = |what: &str, found: Found| {
        let (mark, text) = match found {
            Well(text) => ("ok", text),
            Doubtful(text) => ("doubt", text),
            Wrong(text) => {
                wrong += 1;
                ("WRONG", text)
            }
        };
        println!("{mark:<6} {what:<13} {text}");
    };
    let file = args.config.as_deref().map_or("defaults and variables".to_owned(), |file| file.display().to_string());
    say("configuration", if config.is_open_to_strangers() { Wrong(strangers()) } else { Well(file) });
    for warning in config.warnings() {
        say("setting", Doubtful(warning));
    }
    say("folder", folder(&config.data_dir));
    say("address", address(&config));
    say("engine", runtime.block_on(engine(&config)));
    say("blobs", runtime.block_on(blobs(&config)));
    say("memory", memory(&config));
    say("files", files());
    if config.role != Role::Worker {
        say("page", page());
    }
    if config.role != Role::Api {
        say("extraction", extraction());
    }
    if wrong == 0 { ExitCode::SUCCESS } else { ExitCode::from(FAILED) }
}

fn strangers() -> String {
    "listen is beyond loopback and nobody is asked for a key: set auth.mode = \"required\" and make a key (shrinkd keys create)".to_owned()
}

/// Whether the folder, or what it will be made in, can be written to, and has room.
fn folder(wanted: &Path) -> Found {
    let absolute = std::path::absolute(wanted).unwrap_or_else(|_| wanted.to_owned());
    let Some(there) = absolute.ancestors().find(|path| path.exists()) else {
        return Wrong(format!("{}: no part of the path is there", absolute.display()));
    };
    let shown = absolute.display();
    if !there.is_dir() {
        return Wrong(format!("{shown}: {} is no folder", there.display()));
    }
    let probe = there.join(format!(".shrinkd-doctor-{}", std::process::id()));
    let written = std::fs::write(&probe, b"probe").and_then(|()| std::fs::remove_file(&probe));
    if let Err(error) = written {
        return Wrong(format!("{shown}: {} cannot be written to: {error}", there.display()));
    }
    let made = if there == absolute { "" } else { ", will be made" };
    match rustix::fs::statvfs(there).map(|of| of.f_bavail.saturating_mul(of.f_frsize)) {
        Ok(room) if room < LITTLE_ROOM => Doubtful(format!("{shown}: only {} are free on its disk", size(room))),
        Ok(room) => Well(format!("{shown}{made}, {} free", size(room))),
        Err(_) => Well(format!("{shown}{made}")),
    }
}

/// Whether the address can be listened at.
fn address(config: &Config) -> Found {
    let wanted = config.listen;
    match TcpListener::bind(wanted) {
        Ok(_) => Well(format!("{wanted} is free")),
        Err(error) if error.kind() == std::io::ErrorKind::AddrInUse => {
            let asked = super::healthcheck::ask(&format!("http://{wanted}"));
            let who = match asked {
                Ok(status) if status.contains(" 200") => {
                    "by a service that is ready: shrinkd runs there already, perhaps"
                }
                Ok(_) => "by a service that is not ready",
                Err(_) => "by another program",
            };
            Wrong(format!("{wanted} is taken {who}; choose another with --listen"))
        }
        Err(error) => Wrong(format!("{wanted}: {error}")),
    }
}

async fn engine(config: &Config) -> Found {
    if config.engine == SQLITE {
        let path = config.data_dir.clone();
        return match tokio::task::spawn_blocking(move || sqlite::look(&path)).await {
            Ok(Ok(look)) => Well(format!("sqlite, {look}")),
            Ok(Err(error)) => Wrong(error.to_string()),
            Err(error) => Wrong(error.to_string()),
        };
    }
    let address = match config.engine.parse::<Address>() {
        Ok(address) => address,
        Err(error) => return Wrong(error.to_string()),
    };
    match within(NatsEngine::probe(&address, config.limits.body_bytes)).await {
        Ok(servers) => Well(format!("{address}, {servers}")),
        Err(error) => Wrong(format!("{error}; are the servers up, and started with docker/nats.conf or alike?")),
    }
}

async fn blobs(config: &Config) -> Found {
    if config.blobs == FOLDER {
        return Well("in the folder".to_owned());
    }
    let blobs = match Blobs::in_bucket(&config.blobs) {
        Ok(blobs) => blobs,
        Err(error) => return Wrong(error.to_string()),
    };
    match within(blobs.probe()).await {
        Ok(true) => Well(format!("{}, with conditional put", config.blobs)),
        Ok(false) => Doubtful(format!(
            "{} has no conditional put: nodes may write over each other what describes an input",
            config.blobs
        )),
        Err(error) => Wrong(format!("{}: {error}; look at AWS_ENDPOINT, AWS_REGION and the keys", config.blobs)),
    }
}

async fn within<T, E: Display>(look: impl Future<Output = Result<T, E>>) -> Result<T, String> {
    match tokio::time::timeout(PATIENCE, look).await {
        Ok(found) => found.map_err(|error| error.to_string()),
        Err(_) => Err(format!("no answer within {} s", PATIENCE.as_secs())),
    }
}

fn memory(config: &Config) -> Found {
    match config.worker_memory() {
        Some(bytes) => Well(format!("{} for jobs that run together", size(bytes))),
        None => {
            Doubtful("nobody can tell how much there is: set worker.memory_bytes, or jobs are not bounded".to_owned())
        }
    }
}

fn files() -> Found {
    match getrlimit(Resource::Nofile).current {
        Some(limit) if limit < FEW_FILES => Doubtful(format!(
            "{limit} may be open; every client takes one: raise `ulimit -n` (LimitNOFILE= of systemd)"
        )),
        Some(limit) => Well(format!("{limit} may be open")),
        None => Well("any number may be open".to_owned()),
    }
}

fn page() -> Found {
    if http::has_page() {
        Well("is in the program".to_owned())
    } else {
        Doubtful(
            "is not in the program, so / shows a plain list: `npm ci && npm run build` in web/, then build the program"
                .to_owned(),
        )
    }
}

/// Wraps a ball.
fn extraction() -> Found {
    let clock = Instant::now();
    let made = || -> Result<bool, String> {
        let spec = FieldSpec { scene: Some(serde_json::json!({"sphere": {"radius": 0.5}})), ..FieldSpec::default() };
        let opened = pipeline::open(&spec, None, "").map_err(|failure| failure.detail)?;
        let pool = rayon::ThreadPoolBuilder::new().build().map_err(|e| e.to_string())?;
        let cancel = CancelToken::new();
        let settings = Settings { pool: &pool, cancel: &cancel, progress: &|_| {}, watched: false };
        let shrink = ShrinkSpec { lattice: LatticeSpec::Octahedral { n: 16 }, ..ShrinkSpec::default() };
        let asked = Asked { shrink: &shrink, budget: Budget::default(), outputs: &[], load_seconds: 0.0 };
        let made = pipeline::make(&opened, &asked, settings).map_err(|ended| format!("{ended:?}"))?;
        Ok(made.is_sound())
    };
    match made() {
        Ok(true) => Well(format!("a ball in {:.2} s, and it passed every check", clock.elapsed().as_secs_f64())),
        Ok(false) => Wrong("a ball did not pass its checks".to_owned()),
        Err(error) => Wrong(error),
    }
}

/// A number of bytes for a person.
fn size(bytes: u64) -> String {
    const GIB: f64 = (1u64 << 30) as f64;
    format!("{:.1} GiB", bytes as f64 / GIB)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_folder_that_cannot_be_is_wrong_and_one_that_will_be_is_not_made() {
        let root = tempfile::tempdir().expect("folder");
        let wanted = root.path().join("a/b");
        assert!(matches!(folder(&wanted), Well(text) if text.contains("will be made")));
        assert!(!root.path().join("a").exists());
        std::fs::write(root.path().join("a"), b"a file").expect("writes");
        assert!(matches!(folder(&wanted), Wrong(text) if text.contains("no folder")));
    }

    #[test]
    fn a_port_that_is_taken_is_wrong() {
        let taken = TcpListener::bind("127.0.0.1:0").expect("a port");
        let config = Config { listen: taken.local_addr().expect("an address"), ..Config::default() };
        assert!(matches!(address(&config), Wrong(text) if text.contains("another program")));
    }
}
