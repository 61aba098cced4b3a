//! Load on real processes of the service, and what they make of it, as tables.
//!
//! ```text
//! cargo build --release --bin shrinkd
//! cargo run --release --example load                         # all of it, on the embedded engine
//! eval "$(tests/support/cluster_tools.sh)"
//! cargo run --release --example load -- --engine nats        # and one to three workers on NATS
//! cargo run --release --example load -- --only accept --seconds 20
//! ```
//!
//! - `whole`: clients that submit a small scene, follow it to its end and download what it made, one after the other.
//! - `accept`: submits at a steady rate while long jobs keep the pool busy. Accepting must not wait for computing.
//! - `followers`: many open streams on few running jobs, and what one of them costs in memory.
//! - `workers` (with `--engine nats`): the same heap of jobs for one, two and three worker processes of one thread each.
//!
//! `--program` names the service, `--only` one of the four, `--seconds` how long the first two take, `--clients`, `--followers`
//! and `--jobs` how many there are. Exits 1 when something is not as it must be: a job that fails, a stream that breaks off.

mod accept;
mod client;
mod followers;
mod whole;
mod workers;

#[path = "../../tests/support/nats_server.rs"]
mod nats_server;
#[path = "../../tests/support/service.rs"]
mod service;

use nats_server::NatsServer;
use service::{Node, Outcome, option};
use std::path::Path;
use std::time::Duration;

/// What is asked for.
struct Load {
    program: std::path::PathBuf,
    /// The NATS server, where the jobs are kept in one.
    server: Option<NatsServer>,
    /// How long a measurement over time takes.
    time: Duration,
    clients: usize,
    followers: usize,
    jobs: usize,
}

impl Load {
    fn read() -> Outcome<Self> {
        let number = |name: &str, default: usize| option(name).map_or(Ok(default), |text| text.parse());
        let server = match option("--engine").as_deref() {
            Some("nats") => Some(NatsServer::start().ok_or("there is no nats-server")?),
            None | Some("sqlite") => None,
            Some(other) => return Err(format!("--engine is sqlite or nats, and not {other}").into()),
        };
        Ok(Self {
            program: service::program(),
            server,
            time: Duration::from_secs(number("--seconds", 30)? as u64),
            clients: number("--clients", 8)?,
            followers: number("--followers", 2000)?,
            jobs: number("--jobs", 20)?,
        })
    }

    /// The engine's name in a table.
    fn engine(&self) -> &'static str {
        if self.server.is_some() { "nats" } else { "sqlite" }
    }

    /// Starts a process that is ready to be asked. Nodes of one folder share their jobs, and nobody else's.
    async fn node(&self, folder: &Path, variables: &[(&'static str, String)]) -> Outcome<Node> {
        let name = folder.file_name().unwrap_or_default().to_string_lossy();
        let prefix: String = name.chars().filter(char::is_ascii_alphanumeric).collect();
        let engine = self.server.as_ref().map(|server| format!("{}?prefix={prefix}", server.url()));
        let engine = engine.unwrap_or_else(|| "sqlite".to_owned());
        let mut all = vec![("SHRINKD_ENGINE", engine)];
        all.extend_from_slice(variables);
        let node = Node::start(&self.program, folder, &all)?;
        client::ready(&node.url()).await?;
        Ok(node)
    }
}

#[tokio::main]
async fn main() -> Outcome<()> {
    let load = Load::read()?;
    let only = option("--only");
    let wanted = |name: &str| only.as_deref().is_none_or(|only| only == name);
    if wanted("whole") {
        whole::measure(&load).await?;
    }
    if wanted("accept") {
        accept::measure(&load).await?;
    }
    if wanted("followers") {
        followers::measure(&load).await?;
    }
    if wanted("workers") && load.server.is_some() {
        workers::measure(&load).await?;
    }
    Ok(())
}
