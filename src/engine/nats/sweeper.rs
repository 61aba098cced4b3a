//! What every node does all the time: finds lost workers, and ids that are missing in the queue.
//!
//! All nodes do the same, at times of their own; what one has done the others find done. It costs a look into this node's
//! own memory, and while jobs wait for long a question to the servers every few seconds.

use super::Node;
use super::layout::{Layout, Name};
use super::leases;
use crate::engine::EngineError;
use crate::engine::nats::link::{failed, patiently};
use crate::job::State;
use futures::TryStreamExt;
use std::collections::HashSet;
use std::sync::Weak;
use std::time::Duration;
use tokio::time::Instant;
use tracing::warn;
use uuid::Uuid;

/// Longest time between two looks for lost workers; a quarter of the lease when that is shorter.
const LOOK: Duration = Duration::from_secs(1);
/// Time after which a queued job's id must be in the queue: a submit has long put it there, or died.
const SETTLED: Duration = Duration::from_secs(3);
/// Time between two looks into the queue.
const QUEUE_LOOK: Duration = Duration::from_secs(5);
/// Looks that trust the number of ids before one looks at the ids themselves: ids of canceled jobs stay in the queue until
/// their turn comes, and hide ones that are missing.
const TRUSTING_LOOKS: u32 = 11;

/// Sweeps until the node is gone.
pub(super) async fn run(node: Weak<Node>) {
    let mut next_queue_look = Instant::now() + jittered(SETTLED);
    let (mut trusting, mut connections) = (0, None);
    loop {
        let Some(lease) = node.upgrade().map(|node| node.terms.lease) else { return };
        tokio::time::sleep(jittered(LOOK.min(lease / 4))).await;
        let Some(node) = node.upgrade() else { return };
        if !node.ledger.link.is_up() {
            continue;
        }
        // after an interruption everybody gets a fresh lease: their heartbeats could not be stored either
        let connection = Some(*node.ledger.link.connections.borrow());
        if connections != connection {
            connections = connection;
            node.ledger.projection.forgive();
        }
        leases::take_from_the_lost(&node).await;
        if Instant::now() >= next_queue_look {
            next_queue_look = Instant::now() + jittered(QUEUE_LOOK);
            trusting = if trusting == 0 { TRUSTING_LOOKS } else { trusting - 1 };
            if let Err(error) = patiently(put_back_missing(&node, trusting > 0)).await {
                warn!(%error, "the queue could not be looked at");
            }
        }
    }
}

/// Puts the ids of jobs that wait for long into the queue where they are missing, because a node died between the record and
/// the queue.
async fn put_back_missing(node: &Node, trusting: bool) -> Result<(), EngineError> {
    let waiting = node
        .ledger
        .projection
        .open_jobs(|seen| seen.version.record.job.state == State::Queued && seen.at.elapsed() > SETTLED);
    if waiting.is_empty() {
        return Ok(());
    }
    let work = &node.ledger.layout.work;
    if trusting {
        let info = work.get_info().await.map_err(|e| failed("the queue")(e.into()))?;
        if info.state.messages >= waiting.len() as u64 {
            return Ok(());
        }
    }
    let subjects = work.info_builder().subjects(node.ledger.layout.every_work()).fetch().await;
    let subjects: Vec<(String, usize)> = subjects
        .map_err(|e| failed("the queue")(e.into()))?
        .try_collect()
        .await
        .map_err(|e| failed("the queue")(e.into()))?;
    let queued: HashSet<Name> = subjects.iter().filter_map(|(subject, _)| Layout::name_of(subject)).collect();
    let mut missing: Vec<Name> =
        waiting.iter().map(|seen| seen.version.record.name()).filter(|name| !queued.contains(name)).collect();
    missing.sort_unstable_by_key(|name| name.id);
    for name in missing {
        // it may have been taken up meanwhile: then a worker passes it over
        warn!(job.id = %name.id, "a job that waits was not in the queue");
        node.queue.push(&name).await?;
    }
    Ok(())
}

/// Three to five quarters of a time, so that nodes that started together do not sweep together.
pub(super) fn jittered(time: Duration) -> Duration {
    let random = Uuid::now_v7().as_bytes()[15];
    time.mul_f64(0.75 + 0.5 * f64::from(random) / 255.0)
}
