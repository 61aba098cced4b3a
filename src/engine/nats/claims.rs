//! How a worker comes to a job.
//!
//! There is no queue but the records: every node knows which jobs wait, takes the one whose turn it is, and moves its record to
//! `running` under the next attempt. That is a compare-and-set, so of several nodes that try one succeeds, and the others find
//! that out and take the next. (The plan had a work queue of its own beside the records; a queue that hands out ids in the order
//! in which they came cannot give tenants their turns.)

use super::Node;
use super::layout::Name;
use super::ledger::{Found, Step};
use super::link::{failed, patiently};
use super::sweeper::jittered;
use crate::engine::{Claim, EngineError, Outcome};
use crate::job::{Failure, JobSpec, State};
use std::sync::Arc;
use std::time::Duration;
use tokio::sync::oneshot;
use tokio::time::Instant;
use tracing::{error, warn};

/// Pause after other nodes were faster with everything whose turn it was.
const PAUSE: Duration = Duration::from_millis(10);
/// How often the queue is looked at without news: somebody's limit of jobs at once may have been freed.
const LOOK: Duration = Duration::from_secs(1);

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
        // listened to before looking, so that nothing falls between
        let queued = node.ledger.projection.queued.notified();
        let turns = node.ledger.projection.next(slots - claims.len(), &node.terms).await?;
        if turns.is_empty() {
            let now = Instant::now();
            if !claims.is_empty() || now >= deadline {
                break;
            }
            tokio::select! {
                () = answer.closed() => break,
                () = queued => {}
                () = tokio::time::sleep_until(deadline.min(now + LOOK)) => {}
            }
            continue;
        }
        let taken = futures::future::join_all(turns.iter().map(|name| patiently(take_up(node, name, worker)))).await;
        let (before, mut failed) = (claims.len(), None);
        for (name, taken) in turns.iter().zip(taken) {
            match taken {
                Ok(claim) => claims.extend(claim),
                Err(error) => {
                    warn!(job.id = %name.id, %error, "a job could not be claimed");
                    failed = Some(error);
                }
            }
        }
        match failed {
            // what was claimed so far is claimed
            Some(_) if !claims.is_empty() => break,
            Some(error) => return Err(error),
            None if claims.len() == before => tokio::time::sleep(jittered(PAUSE)).await,
            None => {}
        }
    }
    Ok(claims)
}

/// Moves the record, if the job waits; `None` when it does not.
async fn take_up(node: &Node, name: &Name, worker: &str) -> Result<Option<Claim>, EngineError> {
    let waits = |state| state == State::Queued;
    // that a job waits is believed from an older record, because storing would fail; that it does not is not
    let version = match node.ledger.projection.seen(name.id).filter(|version| waits(version.record.job.state)) {
        Some(version) => version,
        None => match node.ledger.read(name).await? {
            Found::Job(version) if waits(version.record.job.state) => version,
            Found::Nothing => return drop_removed(node, name).await.map(|()| None),
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
    let record = match taken.await? {
        Some((true, record)) => record,
        Some((false, _)) => return Ok(None),
        None => return drop_removed(node, name).await.map(|()| None),
    };
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

/// Forgets a job whose messages somebody has removed from the stream, so that it holds nobody up. A leader that has not come to them yet
/// does not count.
async fn drop_removed(node: &Node, name: &Name) -> Result<(), EngineError> {
    let info = node.ledger.layout.jobs.get_info().await.map_err(|e| failed("the jobs")(e.into()))?;
    match node.ledger.projection.seen(name.id) {
        Some(version) if version.seq > info.state.last_sequence => {
            Err(EngineError::Store("the stream's leader is behind".to_owned()))
        }
        _ => {
            warn!(job.id = %name.id, "somebody has removed the record of a job that waits");
            node.ledger.projection.drop_removed(name.id).await
        }
    }
}
