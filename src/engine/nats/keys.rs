//! Idempotency keys: one key, one job, whoever submits it how often and on which node.
//!
//! The key's message is stored first and only if there is none; it names the job. Whoever finds it makes that very job, if it
//! is not made yet, and of those who try one succeeds. So a submit that died in the middle is finished by its repetition, and
//! nobody has to wait, to guess whether the other one is dead, or to free a key.

use super::layout::Name;
use super::ledger::{Found, Ledger};
use super::link::{Expect, Store, failed};
use super::record::{Draft, now};
use crate::engine::{EngineError, IdempotencyKey, NewJob, Submitted};
use crate::job::Job;
use crate::tenant::Tenant;
use bytes::Bytes;
use serde::{Deserialize, Serialize};

/// What a key was used for.
#[derive(Serialize, Deserialize)]
pub(super) struct Used {
    fingerprint: String,
    /// The job as it is accepted, which is the answer to every repetition.
    job: Job,
}

/// Makes the job of a submit, or finds the one that its key stands for.
pub(super) async fn submit(ledger: &Ledger, mut new: NewJob) -> Result<Submitted, EngineError> {
    let mut created_at = now();
    if let Some(key) = new.key.clone() {
        match reserve(ledger, &new.tenant, &key, Draft::accepted(&new, created_at).record.job).await? {
            None => {}
            Some(used) if used.fingerprint != key.fingerprint => return Ok(Submitted::KeyConflict),
            Some(used) if was_made(ledger, &new.tenant, &used.job).await? => return Ok(Submitted::Replayed(used.job)),
            Some(used) => (new.id, created_at) = (used.job.id, used.job.created_at),
        }
    }
    match ledger.create(&new, created_at).await? {
        Some(record) => Ok(Submitted::Created(record.job.clone())),
        // somebody with the same key was faster
        None if new.key.is_some() => Ok(Submitted::Replayed(Draft::accepted(&new, created_at).record.job)),
        None => Err(EngineError::Store(format!("there is a job {} already", new.id))),
    }
}

/// Takes a key for a job; what it was used for, where it was.
pub(super) async fn reserve(
    ledger: &Ledger,
    tenant: &Tenant,
    key: &IdempotencyKey,
    job: Job,
) -> Result<Option<Used>, EngineError> {
    let used = Used { fingerprint: key.fingerprint.clone(), job };
    let payload = Bytes::from(serde_json::to_vec(&used).map_err(|e| failed("a key")(e.into()))?);
    loop {
        let subject = ledger.layout.key(tenant, &key.key);
        if ledger.link.store(&ledger.layout.keys, subject, payload.clone(), Expect::Nothing).await? != Store::Conflict {
            return Ok(None);
        }
        // one that ran out in this moment is taken after all
        if let Some(used) = find(ledger, tenant, key).await? {
            return Ok(Some(used));
        }
    }
}

/// What a submit with this key would find. A key whose job is not made yet is as good as new: a submit would make the job.
pub(super) async fn recall(
    ledger: &Ledger,
    tenant: &Tenant,
    key: &IdempotencyKey,
) -> Result<Option<Submitted>, EngineError> {
    let Some(used) = find(ledger, tenant, key).await? else { return Ok(None) };
    if used.fingerprint != key.fingerprint {
        return Ok(Some(Submitted::KeyConflict));
    }
    Ok(was_made(ledger, tenant, &used.job).await?.then_some(Submitted::Replayed(used.job)))
}

async fn find(ledger: &Ledger, tenant: &Tenant, key: &IdempotencyKey) -> Result<Option<Used>, EngineError> {
    let Some(stored) = ledger.link.newest(&ledger.layout.keys, &ledger.layout.key(tenant, &key.key)).await? else {
        return Ok(None);
    };
    serde_json::from_slice(&stored.payload).map(Some).map_err(|e| failed("a key")(e.into()))
}

async fn was_made(ledger: &Ledger, tenant: &Tenant, job: &Job) -> Result<bool, EngineError> {
    Ok(!matches!(ledger.read(&Name::new(tenant, job.id)).await?, Found::Nothing))
}
