//! The claims of the room's suite on real servers, and those that only several nodes can break.

mod faults;
mod nodes;

use super::*;
use crate::engine::conformance;

#[path = "../../../tests/support/nats_server.rs"]
mod nats_server;
use nats_server::NatsServer;

/// Longer than any step may take.
const PATIENCE: Duration = Duration::from_secs(30);
/// What the suite asks for.
fn quick() -> Terms {
    conformance::terms()
}

/// Terms under which nobody is lost while a test runs.
fn calm() -> Terms {
    Terms { lease: Duration::from_secs(300), ..Terms::default() }
}

/// A server, and a folder for the nodes that a test opens on it.
struct Cluster {
    server: NatsServer,
    folder: tempfile::TempDir,
}

impl Cluster {
    /// `None` where there is no server to test with.
    fn start() -> Option<Self> {
        Some(Self { server: NatsServer::start()?, folder: tempfile::tempdir().expect("folder") })
    }

    async fn node(&self, terms: Terms) -> Arc<NatsEngine> {
        let address = self.server.url().parse().expect("an address");
        Arc::new(NatsEngine::open(&address, self.folder.path(), terms).await.expect("opens"))
    }
}

fn own() -> Tenant {
    Tenant::default()
}

async fn submit(engine: &NatsEngine) -> JobId {
    match engine.submit(conformance::new_job()).await.expect("submits") {
        Submitted::Created(job) => job.id,
        other => panic!("expected a new job, found {other:?}"),
    }
}

async fn claim(engine: &NatsEngine) -> Claim {
    let mut claims = engine.claim("worker", 1, PATIENCE).await.expect("claims");
    assert_eq!(claims.len(), 1, "one slot, one claim");
    claims.remove(0)
}

async fn job(engine: &NatsEngine, id: JobId) -> Job {
    engine.get(&own(), id).await.expect("reads").expect("is there")
}

/// Waits until it is so.
async fn eventually<T>(what: &str, mut look: impl AsyncFnMut() -> Option<T>) -> T {
    let deadline = tokio::time::Instant::now() + PATIENCE;
    loop {
        if let Some(found) = look().await {
            return found;
        }
        assert!(tokio::time::Instant::now() < deadline, "not in time: {what}");
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn keeps_every_promise_of_an_engine() {
    let Some(cluster) = Cluster::start() else { return };
    conformance::run(cluster.node(quick()).await).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_servers_keep_a_key_for_a_day() {
    let Some(cluster) = Cluster::start() else { return };
    let node = cluster.node(calm()).await;
    let layout = &node.node.ledger.layout;
    let kept = async |stream: &async_nats::jetstream::stream::Stream<()>| {
        stream.get_info().await.expect("a description").config.max_age
    };
    assert_eq!(kept(&layout.keys).await, Duration::from_secs(24 * 60 * 60));
    // and nothing else goes by its age
    for stream in [&layout.jobs, &layout.specs] {
        assert_eq!(kept(stream).await, Duration::ZERO);
    }
}
