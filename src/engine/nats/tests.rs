//! The claims of the room's suite on real servers, and those that only several nodes can break.

use super::*;
use crate::engine::conformance;
use std::sync::atomic::{AtomicU32, Ordering};

#[path = "../../../tests/support/nats_server.rs"]
mod nats_server;
use nats_server::NatsServer;

/// Longer than any step may take.
const PATIENCE: Duration = Duration::from_secs(30);

/// A server, and folders for the nodes that a test opens on it.
struct Cluster {
    server: NatsServer,
    folder: tempfile::TempDir,
}

impl Cluster {
    /// `None` where there is no server to test with.
    fn start() -> Option<Self> {
        Some(Self { server: NatsServer::start()?, folder: tempfile::tempdir().expect("folder") })
    }

    fn address(&self) -> Address {
        self.server.url().parse().expect("an address")
    }

    async fn node(&self, terms: Terms) -> Arc<NatsEngine> {
        Arc::new(NatsEngine::open(&self.address(), self.folder.path(), terms).await.expect("opens"))
    }
}

const QUICK: Terms = Terms { lease: conformance::LEASE, max_losses: 2 };

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn keeps_every_promise_of_an_engine() {
    let Some(cluster) = Cluster::start() else { return };
    conformance::run(cluster.node(QUICK).await).await;
}
