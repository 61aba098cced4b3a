//! What every node does all the time: finds lost workers.
//!
//! All nodes do the same, at times of their own; what one has done the others find done. It costs a look into this node's
//! own memory.

use super::Node;
use super::leases;
use std::sync::Weak;
use std::time::Duration;
use uuid::Uuid;

/// Longest time between two looks for lost workers; a quarter of the lease when that is shorter.
const LOOK: Duration = Duration::from_secs(1);

/// Sweeps until the node is gone.
pub(super) async fn run(node: Weak<Node>) {
    let mut connections = None;
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
    }
}

/// Three to five quarters of a time, so that nodes that started together do not sweep together.
pub(super) fn jittered(time: Duration) -> Duration {
    let random = Uuid::now_v7().as_bytes()[15];
    time.mul_f64(0.75 + 0.5 * f64::from(random) / 255.0)
}
