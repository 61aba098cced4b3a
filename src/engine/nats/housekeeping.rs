//! What nobody will ask for any more is removed from the streams: tombstones that no idempotency key remembers, the events of
//! jobs that ended long ago, and requests whose job was never made. Every node does it, once an hour, at a time of its own.

use super::layout::{KEY_LIFETIME, Layout, Name};
use super::ledger::{Found, Ledger};
use super::link::failed;
use super::sweeper::jittered;
use crate::engine::EngineError;
use crate::job::JobId;
use async_nats::jetstream::stream::Stream;
use futures::TryStreamExt;
use jiff::{SignedDuration, Timestamp};
use std::collections::HashSet;
use std::sync::Weak;
use std::time::Duration;

/// Tombstones outlive the keys that may name their job, and clocks that differ by a day.
const TOMBSTONES: Duration = KEY_LIFETIME.saturating_mul(2);
/// How long the events of an ended job are kept; its last entry, with its end, stays.
const EVENTS: Duration = Duration::from_secs(24 * 60 * 60);
/// How long a node keeps the events of an ended job at hand.
const EVENTS_AT_HAND: Duration = Duration::from_secs(60 * 60);
/// A request without a record is one of a submit that is under way, or of one that died; by now it is the latter.
const UNDER_WAY: Duration = Duration::from_secs(24 * 60 * 60);

/// Time between two times.
const EVERY: Duration = Duration::from_secs(60 * 60);

/// Keeps house until the node is gone.
pub(super) async fn run(ledger: Weak<Ledger>) {
    loop {
        tokio::time::sleep(jittered(EVERY)).await;
        let Some(ledger) = ledger.upgrade() else { return };
        if let Err(error) = tidy(&ledger, Timestamp::now()).await {
            tracing::warn!(%error, "the housekeeping was not finished");
        }
    }
}

/// Tidies up. What another node removes meanwhile is no error.
pub(super) async fn tidy(ledger: &Ledger, now: Timestamp) -> Result<(), EngineError> {
    ledger.projection.drop_events_before(before(now, EVENTS_AT_HAND)).await?;
    remove_tombstones(ledger, before(now, TOMBSTONES)).await?;
    thin_ended_jobs(ledger, before(now, EVENTS)).await?;
    remove_orphaned_requests(ledger, before(now, UNDER_WAY)).await
}

async fn remove_tombstones(ledger: &Ledger, then: Timestamp) -> Result<(), EngineError> {
    let forgotten = ledger.projection.forgotten_before(then).await?;
    for name in &forgotten {
        purge(&ledger.layout.jobs, ledger.layout.job(name), 0).await?;
    }
    ledger.projection.drop_forgotten(forgotten.into_iter().map(|name| name.id).collect()).await
}

async fn thin_ended_jobs(ledger: &Ledger, then: Timestamp) -> Result<(), EngineError> {
    let ended: HashSet<Name> = ledger.projection.ended_before(then).await?.into_iter().collect();
    if ended.is_empty() {
        return Ok(());
    }
    for (subject, entries) in subjects(&ledger.layout.jobs, ledger.layout.every_job()).await? {
        if entries > 1 && Layout::name_of(&subject).is_some_and(|name| ended.contains(&name)) {
            purge(&ledger.layout.jobs, subject, 1).await?;
        }
    }
    Ok(())
}

async fn remove_orphaned_requests(ledger: &Ledger, then: Timestamp) -> Result<(), EngineError> {
    for (subject, _) in subjects(&ledger.layout.specs, ledger.layout.every_spec()).await? {
        let Some(name) = Layout::name_of(&subject) else { continue };
        let is_old = made_at(name.id).is_some_and(|made| made < then);
        if !is_old || ledger.projection.knows(name.id).await? {
            continue;
        }
        if matches!(ledger.read(&name).await?, Found::Nothing | Found::Forgotten) {
            purge(&ledger.layout.specs, subject, 0).await?;
        }
    }
    Ok(())
}

/// A job's name tells when it was made.
fn made_at(id: JobId) -> Option<Timestamp> {
    let (seconds, nanoseconds) = id.0.get_timestamp()?.to_unix();
    Timestamp::new(seconds as i64, nanoseconds as i32).ok()
}

fn before(now: Timestamp, time: Duration) -> Timestamp {
    now.checked_sub(SignedDuration::try_from(time).unwrap_or(SignedDuration::ZERO)).unwrap_or(now)
}

async fn subjects(stream: &Stream<()>, filter: String) -> Result<Vec<(String, usize)>, EngineError> {
    let subjects = stream.info_builder().subjects(filter).fetch().await.map_err(|e| failed("a stream")(e.into()))?;
    subjects.try_collect().await.map_err(|e| failed("a stream")(e.into()))
}

/// Removes the messages of a subject but the newest `keep`.
async fn purge(stream: &Stream<()>, subject: String, keep: u64) -> Result<(), EngineError> {
    let purge = stream.purge().filter(subject);
    let purged = if keep > 0 { purge.keep(keep).await } else { purge.await };
    purged.map(|_| ()).map_err(|e| failed("a purge")(e.into()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_job_is_as_old_as_its_name_says() {
        let (earliest, made) = (super::super::record::now(), made_at(JobId::new()).expect("a time"));
        assert!(made >= earliest && made <= Timestamp::now());
    }
}
