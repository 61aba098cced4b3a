//! The streams, their subjects, and what the servers are asked to promise about them.
//!
//! | stream | subjects | holds |
//! |---|---|---|
//! | `SHRINKD_JOBS` | `SHRINKD.job.{id}` | entries of a job: the newest is its record, the older ones its events |
//! | `SHRINKD_SPECS` | `SHRINKD.spec.{id}` | the request, once; apart, because it may be large and never changes |
//! | `SHRINKD_KEYS` | `SHRINKD.key.{hash}` | idempotency keys, for 24 hours |
//! | `SHRINKD_WORK` | `SHRINKD.work.{id}` | ids of jobs that wait for a worker; a work queue |

use super::address::Address;
use super::link::{Link, failed};
use crate::engine::EngineError;
use crate::job::JobId;
use async_nats::jetstream::consumer::{AckPolicy, PullConsumer, pull};
use async_nats::jetstream::stream::{Config, DiscardPolicy, RetentionPolicy, StorageType, Stream};
use sha2::{Digest, Sha256};
use std::time::Duration;
use tracing::warn;

/// Entries kept per job, heartbeats among them. A reader that falls further behind starts over from a snapshot.
const KEPT_ENTRIES: i64 = 512;
/// How long an idempotency key is kept.
pub(super) const KEY_LIFETIME: Duration = Duration::from_secs(24 * 60 * 60);
/// How long the servers remember the ids of messages, so that an id put into the queue twice is there once.
const REPETITIONS: Duration = Duration::from_secs(60);
/// How long a claimed id may wait for its record to be changed before another worker gets it. It is no lease: the id is gone
/// from the queue as soon as the record says who runs the job.
pub(super) const HANDOVER: Duration = Duration::from_secs(10);
/// Workers that wait for a job at once, over all nodes.
const WAITING: i64 = 8192;
/// The one consumer of the queue, which all workers share.
const WORKERS: &str = "workers";

/// Handles on the streams; reading their own description is not needed.
#[derive(Clone)]
pub(super) struct Layout {
    pub jobs: Stream<()>,
    pub specs: Stream<()>,
    pub keys: Stream<()>,
    pub work: Stream<()>,
    prefix: String,
}

impl Layout {
    /// Makes the streams that are not there. Those that are there stay as they are; what in them breaks a promise is warned
    /// about.
    pub(super) async fn open(link: &Link, address: &Address) -> Result<Self, EngineError> {
        let prefix = &address.prefix;
        let base = |name: &str, subject: &str| Config {
            name: format!("{prefix}_{name}"),
            subjects: vec![format!("{prefix}.{subject}.*")],
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
        let work = Config { retention: RetentionPolicy::WorkQueue, ..base("WORK", "work") };
        Ok(Self {
            jobs: open(link, jobs).await?,
            specs: open(link, base("SPECS", "spec")).await?,
            keys: open(link, keys).await?,
            work: open(link, work).await?,
            prefix: prefix.clone(),
        })
    }

    pub(super) fn job(&self, id: JobId) -> String {
        format!("{}.job.{id}", self.prefix)
    }

    pub(super) fn every_job(&self) -> String {
        format!("{}.job.*", self.prefix)
    }

    pub(super) fn spec(&self, id: JobId) -> String {
        format!("{}.spec.{id}", self.prefix)
    }

    pub(super) fn every_spec(&self) -> String {
        format!("{}.spec.*", self.prefix)
    }

    pub(super) fn work(&self, id: JobId) -> String {
        format!("{}.work.{id}", self.prefix)
    }

    pub(super) fn every_work(&self) -> String {
        format!("{}.work.*", self.prefix)
    }

    /// A client chooses its keys freely, and a subject cannot hold every text.
    pub(super) fn key(&self, key: &str) -> String {
        let hash: String = Sha256::digest(key.as_bytes()).iter().map(|byte| format!("{byte:02x}")).collect();
        format!("{}.key.{hash}", self.prefix)
    }

    /// The job that a subject belongs to.
    pub(super) fn id_of(subject: &str) -> Option<JobId> {
        subject.rsplit('.').next()?.parse().ok()
    }

    /// The queue's consumer, made when it is not there.
    pub(super) async fn workers(&self) -> Result<PullConsumer, EngineError> {
        let config = pull::Config {
            durable_name: Some(WORKERS.to_owned()),
            ack_policy: AckPolicy::Explicit,
            ack_wait: HANDOVER,
            // an id is handed over for as long as its job waits; what a job does to its workers is counted in its record
            max_deliver: -1,
            max_ack_pending: -1,
            max_waiting: WAITING,
            ..pull::Config::default()
        };
        self.work.get_or_create_consumer(WORKERS, config).await.map_err(|e| failed("the queue's consumer")(e.into()))
    }
}

async fn open(link: &Link, wanted: Config) -> Result<Stream<()>, EngineError> {
    let what = format!("stream {}", wanted.name);
    let stream = link.context.get_or_create_stream(wanted.clone()).await.map_err(|e| failed(&what)(e.into()))?;
    let found = &stream.cached_info().config;
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
