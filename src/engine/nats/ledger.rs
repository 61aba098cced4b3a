//! Records and requests in the streams: the truth that every node agrees on.
//!
//! A record is changed by storing its next entry on the condition that the entry it was made from is still the newest
//! (compare-and-set by the last sequence of the subject). JetStream has no fencing; this is the fence.

use super::layout::{Layout, Name};
use super::link::{Expect, Link, Store, failed};
use super::projection::Projection;
use super::record::{Draft, Entry, Record, now};
use crate::engine::{EngineError, NewJob};
use jiff::Timestamp;
use std::sync::Arc;

/// A record and the number of its entry.
#[derive(Clone, Debug)]
pub(super) struct Version {
    pub seq: u64,
    pub record: Arc<Record>,
}

/// What a job's subject holds.
#[derive(Clone, Debug)]
pub(super) enum Found {
    Job(Version),
    Forgotten,
    Nothing,
}

/// Whether a change is to be made.
pub(super) enum Step<T> {
    /// The draft is to be stored.
    Write(T),
    /// Everything stays as it is.
    Leave(T),
}

/// The streams, and the projection that hears at once of what this node stored.
pub(super) struct Ledger {
    pub link: Link,
    pub layout: Layout,
    pub projection: Projection,
}

impl Ledger {
    /// A job's record as the stream's leader has it.
    pub(super) async fn read(&self, name: &Name) -> Result<Found, EngineError> {
        let Some(stored) = self.link.newest(&self.layout.jobs, &self.layout.job(name)).await? else {
            return Ok(Found::Nothing);
        };
        let entry =
            Entry::read(&stored.payload).map_err(|e| failed(&format!("the record of job {}", name.id))(e.into()))?;
        let found = match &entry {
            Entry::Changed { record, .. } => {
                Found::Job(Version { seq: stored.seq, record: Arc::new(Record::clone(record)) })
            }
            Entry::Forgotten { .. } => Found::Forgotten,
        };
        self.project(stored.seq, name, entry).await;
        Ok(found)
    }

    /// Tells this node's projection what was read or stored. Where that fails the feed tries it again, and what is stored
    /// stands.
    async fn project(&self, seq: u64, name: &Name, entry: Entry) {
        if let Err(error) = self.projection.apply(vec![(seq, name.clone(), entry)]).await {
            tracing::error!(job.id = %name.id, %error, "the node's own view of the jobs cannot be written");
        }
    }

    /// The version of a job that is there.
    pub(super) async fn version(&self, name: &Name) -> Result<Option<Version>, EngineError> {
        Ok(match self.read(name).await? {
            Found::Job(version) => Some(version),
            Found::Forgotten | Found::Nothing => None,
        })
    }

    /// Changes a job as `decide` says, which is asked again when another change came between. `known` is a version to begin
    /// from, which need not be the newest as long as whatever `decide` leaves as it is would stay so. Returns what was decided
    /// and the record afterwards; `None` when there is no such job.
    pub(super) async fn change<T>(
        &self,
        name: &Name,
        known: Option<Version>,
        mut decide: impl FnMut(&mut Draft) -> Step<T>,
    ) -> Result<Option<(T, Arc<Record>)>, EngineError> {
        let mut version = known;
        loop {
            let from = match version.take() {
                Some(version) => version,
                None => match self.version(name).await? {
                    Some(version) => version,
                    None => return Ok(None),
                },
            };
            let mut draft = Draft::of(Record::clone(&from.record));
            match decide(&mut draft) {
                Step::Leave(decided) => return Ok(Some((decided, from.record))),
                Step::Write(decided) => {
                    if let Some(record) = self.write(name, draft, Expect::Newest(from.seq)).await? {
                        return Ok(Some((decided, record)));
                    }
                }
            }
        }
    }

    /// Stores a draft as the next entry; `None` when somebody else was faster.
    pub(super) async fn write(
        &self,
        name: &Name,
        draft: Draft,
        expect: Expect,
    ) -> Result<Option<Arc<Record>>, EngineError> {
        let record = Arc::new(draft.record.clone());
        let entry = draft.entry();
        let payload = entry.write().map_err(|e| failed("a record")(e.into()))?;
        match self.link.store(&self.layout.jobs, self.layout.job(name), payload, expect).await? {
            Store::Conflict => Ok(None),
            Store::Done(seq) => {
                self.project(seq, name, entry).await;
                Ok(Some(record))
            }
        }
    }

    /// Makes the record of a new job, after its request. `None` when there is, or was, a job of that name.
    pub(super) async fn create(&self, new: &NewJob, created_at: Timestamp) -> Result<Option<Arc<Record>>, EngineError> {
        let name = Name::new(&new.tenant, new.id);
        let spec = serde_json::to_vec(&new.spec).map_err(|e| failed("a request")(e.into()))?;
        // one that is there already is the same: its name is given once
        self.link.store(&self.layout.specs, self.layout.spec(&name), spec.into(), Expect::Nothing).await?;
        self.write(&name, Draft::accepted(new, created_at), Expect::Nothing).await
    }

    /// The request of a job, as it was stored.
    pub(super) async fn request(&self, name: &Name) -> Result<Option<serde_json::Value>, EngineError> {
        let Some(stored) = self.link.newest(&self.layout.specs, &self.layout.spec(name)).await? else {
            return Ok(None);
        };
        serde_json::from_slice(&stored.payload).map(Some).map_err(|e| failed("a stored request")(e.into()))
    }

    /// Puts a tombstone in the place of an ended job's entries, if `from` is still its newest. The number of the tombstone.
    pub(super) async fn forget(&self, name: &Name, from: &Version) -> Result<Option<u64>, EngineError> {
        let entry =
            Entry::Forgotten { at: now(), accepted_at: Some(from.record.job.created_at), cost: from.record.cost };
        let payload = entry.write().map_err(|e| failed("a record")(e.into()))?;
        let Store::Done(seq) =
            self.link.store(&self.layout.jobs, self.layout.job(name), payload, Expect::Replace(from.seq)).await?
        else {
            return Ok(None);
        };
        self.project(seq, name, entry).await;
        if let Err(error) = self.layout.specs.purge().filter(self.layout.spec(name)).await {
            // the housekeeping will find it
            tracing::warn!(job.id = %name.id, %error, "the request of a forgotten job is still there");
        }
        Ok(Some(seq))
    }
}
