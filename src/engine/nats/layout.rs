//! The streams, their subjects, and what the servers are asked to promise about them.
//!
//! | stream | subjects | holds |
//! |---|---|---|
//! | `SHRINKD_JOBS` | `SHRINKD.job.{tenant}.{id}` | entries of a job: the newest is its record, the older ones its events |
//! | `SHRINKD_SPECS` | `SHRINKD.spec.{tenant}.{id}` | the request, once; apart, because it may be large and never changes |
//! | `SHRINKD_KEYS` | `SHRINKD.key.{tenant}.{hash}` | idempotency keys, for 24 hours |
//!
//! The tenant is part of the subject, so that what another tenant has is asked for where nothing is. The default tenant's subjects
//! leave it out, as all did before there were tenants.

use super::address::Address;
use super::link::{Link, failed};
use crate::engine::EngineError;
use crate::job::JobId;
use crate::tenant::Tenant;
use async_nats::jetstream::stream::{Config, DiscardPolicy, StorageType, Stream};
use sha2::{Digest, Sha256};
use std::time::Duration;
use tracing::warn;

/// Entries kept per job, heartbeats among them. A reader that falls further behind starts over from a snapshot.
const KEPT_ENTRIES: i64 = 512;
/// How long an idempotency key is kept.
pub(super) const KEY_LIFETIME: Duration = Duration::from_secs(24 * 60 * 60);
/// How long the servers remember the ids of messages.
const REPETITIONS: Duration = Duration::from_secs(60);

/// What stands for a dot of a tenant's name in a subject, where dots separate. No name holds it.
const DOT: &str = "=";

/// A job's name in the streams: whose it is, and its id.
#[derive(Clone, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub(super) struct Name {
    pub tenant: Tenant,
    pub id: JobId,
}

impl Name {
    pub(super) fn new(tenant: &Tenant, id: JobId) -> Self {
        Self { tenant: tenant.clone(), id }
    }
}

/// Handles on the streams; reading their own description is not needed.
#[derive(Clone)]
pub(super) struct Layout {
    pub jobs: Stream<()>,
    pub specs: Stream<()>,
    pub keys: Stream<()>,
    prefix: String,
}

impl Layout {
    /// Makes the streams that are not there. Those that are there stay as they are; what in them breaks a promise is warned
    /// about.
    pub(super) async fn open(link: &Link, address: &Address) -> Result<Self, EngineError> {
        let prefix = &address.prefix;
        let base = |name: &str, subject: &str| Config {
            name: format!("{prefix}_{name}"),
            subjects: vec![format!("{prefix}.{subject}.>")],
            storage: StorageType::File,
            num_replicas: address.replicas,
            discard: DiscardPolicy::Old,
            max_messages_per_subject: 1,
            duplicate_window: REPETITIONS,
            // readers must see what was stored, and followers may lag
            allow_direct: false,
            ..Config::default()
        };
        let jobs = Config { max_messages_per_subject: KEPT_ENTRIES, allow_rollup: true, ..base("JOBS", "job") };
        let keys = Config { max_age: KEY_LIFETIME, ..base("KEYS", "key") };
        Ok(Self {
            jobs: open(link, jobs).await?,
            specs: open(link, base("SPECS", "spec")).await?,
            keys: open(link, keys).await?,
            prefix: prefix.clone(),
        })
    }

    fn subject(&self, kind: &str, tenant: &Tenant, last: impl std::fmt::Display) -> String {
        subject_of(&self.prefix, kind, tenant, last)
    }

    pub(super) fn job(&self, name: &Name) -> String {
        self.subject("job", &name.tenant, name.id)
    }

    pub(super) fn every_job(&self) -> String {
        format!("{}.job.>", self.prefix)
    }

    pub(super) fn spec(&self, name: &Name) -> String {
        self.subject("spec", &name.tenant, name.id)
    }

    pub(super) fn every_spec(&self) -> String {
        format!("{}.spec.>", self.prefix)
    }

    /// A client chooses its keys freely, and a subject cannot hold every text.
    pub(super) fn key(&self, tenant: &Tenant, key: &str) -> String {
        let hash: String = Sha256::digest(key.as_bytes()).iter().map(|byte| format!("{byte:02x}")).collect();
        self.subject("key", tenant, hash)
    }

    /// What is stored to see whether something can be; no key has its name.
    pub(super) fn probe(&self) -> String {
        self.subject("key", &Tenant::default(), "probe")
    }

    /// The job that a subject belongs to.
    pub(super) fn name_of(subject: &str) -> Option<Name> {
        let tokens: Vec<&str> = subject.split('.').collect();
        let (tenant, id) = match tokens[..] {
            [_, _, id] => (Tenant::default(), id),
            [_, _, tenant, id] => (tenant.replace(DOT, ".").parse().ok()?, id),
            _ => return None,
        };
        Some(Name { tenant, id: id.parse().ok()? })
    }
}

/// The subject of something that a tenant has.
fn subject_of(prefix: &str, kind: &str, tenant: &Tenant, last: impl std::fmt::Display) -> String {
    if tenant.is_default() {
        return format!("{prefix}.{kind}.{last}");
    }
    format!("{prefix}.{kind}.{}.{last}", tenant.name().replace('.', DOT))
}

pub(super) async fn open(link: &Link, wanted: Config) -> Result<Stream<()>, EngineError> {
    let what = format!("stream {}", wanted.name);
    let stream = link.context.get_or_create_stream(wanted.clone()).await.map_err(|e| failed(&what)(e.into()))?;
    let found = match &stream.cached_info().config {
        // made before subjects named tenants
        found if found.subjects == wanted.subjects.iter().map(|s| s.replace('>', "*")).collect::<Vec<_>>() => {
            let wider = Config { subjects: wanted.subjects.clone(), ..found.clone() };
            &link.context.update_stream(wider).await.map_err(|e| failed(&what)(e.into()))?.config
        }
        found => found,
    };
    if found.storage != StorageType::File {
        warn!(nats.stream = found.name, "the stream is kept in memory: a restart of the servers loses every job in it");
    }
    if found.num_replicas < wanted.num_replicas {
        warn!(
            nats.stream = found.name,
            nats.replicas = found.num_replicas,
            nats.wanted_replicas = wanted.num_replicas,
            "the stream has fewer replicas than asked for: change it with `nats stream edit`"
        );
    }
    if found.retention != wanted.retention || found.subjects != wanted.subjects {
        return Err(EngineError::Store(format!("{what} is there, and is not one of this service's")));
    }
    if found.max_messages_per_subject != wanted.max_messages_per_subject || found.max_age != wanted.max_age {
        warn!(nats.stream = found.name, "the stream has other limits than this version of the service gives it");
    }
    link.context.get_stream_no_info(&wanted.name).await.map_err(|e| failed(&what)(e.into()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_subject_names_the_tenant_and_the_default_tenants_are_as_they_were() {
        for (tenant, subject) in [("default", "P.job."), ("a", "P.job.a."), ("a.b-c", "P.job.a=b-c.")] {
            let name = Name { tenant: tenant.parse().expect("a name"), id: JobId::new() };
            let whole = format!("{subject}{}", name.id);
            assert_eq!(subject_of("P", "job", &name.tenant, name.id), whole);
            assert_eq!(Layout::name_of(&whole), Some(name));
        }
        assert_eq!(Layout::name_of("P.job.a.b.c"), None);
        assert_eq!(Layout::name_of("P.job.no-id"), None);
    }
}
