//! How a worker comes to a job.
//!
//! An id is taken from the queue, the record is moved to `running` under the next attempt, and then the id is settled. Should
//! the node die before the record is moved, the id comes back to the queue; should it die after that, the job has a hold
//! whose lease runs out.

use super::Node;
use super::layout::{HANDOVER, Name};
use super::ledger::{Found, Step};
use super::link::patiently;
use super::queue::Ticket;
use crate::engine::{Claim, EngineError, Outcome};
use crate::job::{Failure, JobSpec, State};
use std::sync::Arc;
use std::time::Duration;
use tokio::sync::oneshot;
use tokio::time::Instant;
use tracing::{error, warn};

/// Takes up to `slots` jobs, waiting at most `wait` for the first. Whoever asked may go away: what was claimed for nobody is
/// given back, and no loss is counted.
pub(super) async fn take(
    node: &Arc<Node>,
    worker: &str,
    slots: usize,
    wait: Duration,
) -> Result<Vec<Claim>, EngineError> {
    let (mut answer, answered) = oneshot::channel();
    let (node, worker) = (node.clone(), worker.to_owned());
    tokio::spawn(async move {
        let taken = wait_for(&node, &worker, slots, wait, &mut answer).await;
        let Err(Ok(unwanted)) = answer.send(taken) else { return };
        for claim in unwanted {
            if let Err(error) = node.finish(&claim, Outcome::Released).await {
                warn!(job.id = %claim.id, %error, "a job that nobody waited for could not be given back");
            }
        }
    });
    answered.await.map_err(|_| EngineError::Stopped)?
}

async fn wait_for(
    node: &Node,
    worker: &str,
    slots: usize,
    wait: Duration,
    answer: &mut oneshot::Sender<Result<Vec<Claim>, EngineError>>,
) -> Result<Vec<Claim>, EngineError> {
    let deadline = Instant::now() + wait;
    let mut claims = Vec::new();
    while claims.len() < slots {
        let mut tickets = match patiently(node.queue.waiting(slots - claims.len())).await {
            Ok(tickets) => tickets,
            // what was claimed so far is claimed
            Err(_) if !claims.is_empty() => break,
            Err(error) => {
                patiently(node.queue.mend()).await?;
                return Err(error);
            }
        };
        if tickets.is_empty() {
            let left = deadline.saturating_duration_since(Instant::now());
            if !claims.is_empty() || left.is_zero() {
                break;
            }
            tickets = tokio::select! {
                () = answer.closed() => break,
                came = node.queue.next(left) => came?,
            };
        }
        let taken = futures::future::join_all(tickets.iter().map(|ticket| claim(node, ticket, worker))).await;
        for (ticket, taken) in tickets.iter().zip(taken) {
            match taken {
                Ok(claim) => claims.extend(claim),
                Err(error) => {
                    // the id comes back to the queue
                    warn!(job.id = %ticket.name.id, handover_s = HANDOVER.as_secs(), %error, "a job could not be claimed");
                }
            }
        }
    }
    Ok(claims)
}

async fn claim(node: &Node, ticket: &Ticket, worker: &str) -> Result<Option<Claim>, EngineError> {
    let claimed = patiently(take_up(node, &ticket.name, worker)).await?;
    ticket.settle().await;
    Ok(claimed)
}

/// Moves the record, if the job waits; `None` when it does not.
async fn take_up(node: &Node, name: &Name, worker: &str) -> Result<Option<Claim>, EngineError> {
    let waits = |state| state == State::Queued;
    // that a job waits is believed from an older record, because storing would fail; that it does not is not
    let version = match node.ledger.projection.seen(name.id).filter(|version| waits(version.record.job.state)) {
        Some(version) => version,
        None => match node.ledger.read(name).await? {
            Found::Job(version) if waits(version.record.job.state) => version,
            _ => return Ok(None),
        },
    };
    // before the record is moved, so that a stream that cannot be read costs no attempt
    let request = node.ledger.request(name).await?;
    let lease = node.terms.lease;
    let taken = node.ledger.change(name, Some(version), |draft| {
        if waits(draft.record.job.state) {
            draft.claim(worker, lease);
            Step::Write(true)
        } else {
            Step::Leave(false)
        }
    });
    let Some((true, record)) = taken.await? else { return Ok(None) };
    let (Name { tenant, id }, attempt) = (name.clone(), record.job.attempt);
    match request.map(JobSpec::from_stored) {
        Some(Ok(spec)) => Ok(Some(Claim { tenant, id, attempt, spec, worker: worker.to_owned(), lease })),
        unreadable => {
            // accepted by another version that knew more
            error!(job.id = %name.id, ?unreadable, "the stored request cannot be read");
            let failed = node.ledger.change(name, None, |draft| {
                if draft.record.job.attempt != attempt || draft.record.job.state.ended() {
                    return Step::Leave(());
                }
                draft.finish(Outcome::failed(Failure::internal()), crate::engine::Renewal::Keep);
                Step::Write(())
            });
            failed.await?;
            Ok(None)
        }
    }
}
