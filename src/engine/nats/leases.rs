//! When a worker counts as lost.
//!
//! Every heartbeat is an entry of the job's record, and every node sees every entry. A node that has seen none of a running
//! job for the time of its lease takes the job from its worker, on the condition that the entry it saw last is still the
//! newest. So no two clocks are compared, and there is no time of day in a record: all that is assumed is that clocks run
//! about equally fast. A node that hears late judges late; and one that has missed a heartbeat fails the condition.
//!
//! A lease begins when an entry is seen, so after a start or an interruption a lost worker is found at most one lease later
//! than it could be.

use super::Node;
use super::link::{Expect, patiently};
use super::projection::Seen;
use super::record::{Draft, Record};
use crate::engine::EngineError;
use crate::telemetry::metrics;

/// Takes the jobs from workers that were not heard of for the time of their lease.
pub(super) async fn take_from_the_lost(node: &Node) {
    for seen in node.ledger.projection.open_jobs(is_lost) {
        let name = seen.version.record.name();
        if let Err(error) = patiently(take(node, &seen)).await {
            tracing::warn!(job.id = %name.id, %error, "a lost job could not be queued again");
        }
    }
}

fn is_lost(seen: &Seen) -> bool {
    seen.version.record.lease().is_some_and(|lease| seen.at.elapsed() > lease)
}

async fn take(node: &Node, seen: &Seen) -> Result<(), EngineError> {
    let name = seen.version.record.name();
    let mut draft = Draft::of(Record::clone(&seen.version.record));
    draft.lose(node.terms.max_losses);
    let Some(record) = node.ledger.write(&name, draft, Expect::Newest(seen.version.seq)).await? else {
        // the worker lives, or another node was faster: reading it shows the entry that was missed
        return node.ledger.read(&name).await.map(|_| ());
    };
    metrics::attempts_lost(1);
    tracing::warn!(job.id = %name.id, losses = record.losses, "a worker was lost");
    Ok(())
}
