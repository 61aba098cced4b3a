//! Queue, leases, records and events behind one trait, so that one node and a cluster are the same service.
//!
//! Guarantees of every engine, checked by [`conformance`]: a submitted job is durable before [`Engine::submit`] returns; it
//! is held by one worker at a time, in attempts that are numbered from 1; only the newest attempt can change it, and it ends
//! once; its events are numbered from 1 without a gap, and are durable before anyone reads them.
//! Every job belongs to a [`Tenant`]. Whoever asks about a job says for whom, and another tenant's job is not there: it is looked
//! for where it is not, so that neither the answer nor its time differs from that of a job which never was.
//! Workers are given jobs in turn: of the tenants with jobs that wait, the one with the fewest that run, and of these the one that has
//! waited longest for its turn; and of its jobs the oldest. So a tenant's one job waits for a slot, and never behind another tenant's queue.
//! What a tenant may have is judged when it submits. Engines of several nodes judge by what the node has heard, so that submits at the same
//! moment on several nodes may exceed it by a few.
//! Not guaranteed: that a job runs only once (a worker that is lost in the middle is followed by another attempt), and that
//! old events are kept (a reader that comes too late gets a fresh snapshot). Whoever is to be told of an end is owed that from the
//! moment of the end, and until somebody settles it.

pub mod conformance;
pub mod nats;
mod observed;
pub mod sqlite;

pub use observed::Observed;

use crate::job::{Event, EventKind, Failure, Job, JobId, JobKind, JobSpec, Output, ProgressView, State};
use crate::quota::{Exceeded, Quotas};
use crate::tenant::Tenant;
use futures::stream::BoxStream;
use jiff::Timestamp;
use std::collections::VecDeque;
use std::sync::Arc;
use std::time::Duration;

/// How leases, attempts and tenants are judged.
#[derive(Clone, Debug)]
pub struct Terms {
    /// How long a claim lasts without a renewal.
    pub lease: Duration,
    /// Lost attempts after which a job is failed.
    pub max_losses: u32,
    /// Jobs that may wait, over all tenants; 0 is no limit.
    pub queue: u64,
    /// What each tenant may have.
    pub quotas: Arc<Quotas>,
    /// Bytes of the largest request that is accepted.
    pub request_bytes: u64,
}

impl Default for Terms {
    /// 30 s (three heartbeats of 10 s), and five losses: a job that kills its worker five times is poison. No quotas.
    fn default() -> Self {
        Self { lease: Duration::from_secs(30), max_losses: 5, queue: 0, quotas: Arc::default(), request_bytes: 1 << 20 }
    }
}

/// A key that makes a submit repeatable, and what it was used for. Every tenant has keys of its own.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct IdempotencyKey {
    /// The key, as the client chose it.
    pub key: String,
    /// Hash of the request that it stands for.
    pub fingerprint: String,
}

/// A job to accept.
#[derive(Clone, Debug)]
pub struct NewJob {
    /// Whose it is.
    pub tenant: Tenant,
    /// Its name.
    pub id: JobId,
    /// The checked request.
    pub spec: JobSpec,
    /// Vertices that it asks for, which its tenant's quota counts.
    pub vertices: u64,
    /// The key of the request, if it has one.
    pub key: Option<IdempotencyKey>,
}

/// What became of a submit.
#[derive(Clone, Debug, PartialEq)]
pub enum Submitted {
    /// The job was accepted.
    Created(Job),
    /// The key was used before for the same request: the job as it was accepted then.
    Replayed(Job),
    /// The key was used before for another request.
    KeyConflict,
    /// It was not accepted: as many jobs wait as may, over all tenants.
    QueueFull,
    /// It was not accepted: its tenant has what it may have.
    OverQuota(Exceeded),
}

/// What to list, newest first.
#[derive(Clone, Debug, Default)]
pub struct ListQuery {
    /// Only jobs older than this one.
    pub before: Option<JobId>,
    /// Only jobs in one of these states; empty means all.
    pub states: Vec<State>,
    /// Only jobs with all these labels.
    pub labels: Vec<(String, String)>,
    /// Only jobs accepted at this time or later.
    pub created_from: Option<Timestamp>,
    /// Only jobs accepted before this time.
    pub created_to: Option<Timestamp>,
    /// How many at most.
    pub limit: usize,
}

/// One page of a list.
#[derive(Clone, Debug, PartialEq)]
pub struct Page {
    /// The jobs, newest first.
    pub jobs: Vec<Job>,
    /// Whether there are more.
    pub more: bool,
}

/// What became of a wish to forget a job.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Forgotten {
    /// It is gone; these hashes (hexadecimal SHA-256) of its outputs, and of the surface that it began from, are named by no
    /// job any more.
    Gone(Vec<String>),
    /// It has not ended.
    Running,
    /// There is no such job.
    Unknown,
}

/// A worker's hold on a job for one attempt.
#[derive(Clone, Debug, PartialEq)]
pub struct Claim {
    /// Whose job it is.
    pub tenant: Tenant,
    /// The job.
    pub id: JobId,
    /// The attempt, from 1.
    pub attempt: u32,
    /// The request.
    pub spec: JobSpec,
    /// Who holds it.
    pub worker: String,
    /// How long the hold lasts without a renewal.
    pub lease: Duration,
}

/// News from a worker about its claim.
#[derive(Clone, Debug)]
pub struct Update {
    /// `Progress` or `Mesh`.
    pub kind: EventKind,
    /// The body of the event.
    pub data: serde_json::Value,
    /// The record's new progress, where there is one.
    pub progress: Option<ProgressView>,
}

/// The end of a job that somebody is to be told.
#[derive(Clone, Debug, PartialEq)]
pub struct DueNotice {
    /// Whose job it is.
    pub tenant: Tenant,
    /// The job, which has ended.
    pub job: Job,
    /// Who is to be told.
    pub url: String,
    /// Attempts to tell it, this one included.
    pub attempts: u32,
}

/// What a renewal found.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Renewal {
    /// The claim holds.
    Keep,
    /// The claim holds, and the job is to be stopped.
    CancelRequested,
    /// Another attempt has begun, or the job has ended: stop, nothing of this attempt counts.
    Lost,
}

/// How an attempt ended.
#[derive(Clone, Debug, PartialEq)]
pub enum Outcome {
    /// With outputs, which are durable already, and the report.
    Succeeded {
        /// The outputs.
        outputs: Vec<Output>,
        /// The report.
        metrics: serde_json::Value,
    },
    /// With a problem, and with what was made all the same.
    Failed {
        /// The problem.
        problem: Failure,
        /// Outputs that did not pass, which are durable already.
        outputs: Vec<Output>,
        /// Their report.
        metrics: Option<serde_json::Value>,
    },
    /// It was stopped because it was asked to.
    Canceled,
    /// It was given back unfinished, because its worker is stopping; another worker will take it up.
    Released,
}

impl Outcome {
    /// With a problem and nothing else.
    pub fn failed(problem: Failure) -> Self {
        Self::Failed { problem, outputs: Vec::new(), metrics: None }
    }
}

/// Numbers of jobs by kind and state.
pub type Counts = Vec<(JobKind, State, u64)>;

/// How much there is to do.
#[derive(Clone, Debug, PartialEq)]
pub struct Depth {
    /// How many jobs there are of a kind in a state; only of those that have not ended, and only where there are any.
    pub open: Counts,
    /// When the oldest job that is queued was accepted.
    pub oldest_queued: Option<Timestamp>,
    /// Whether the engine is connected to where the jobs are kept.
    pub connected: bool,
    /// Changes of other nodes that this one has not read yet.
    pub lag: u64,
}

/// What an engine can fail with. The text is for the log, not for clients.
#[derive(Debug, thiserror::Error)]
pub enum EngineError {
    /// The claim was lost: another attempt has begun, or the job has ended.
    #[error("attempt {attempt} of job {id} is fenced off")]
    Fenced {
        /// The job.
        id: JobId,
        /// The attempt that came too late.
        attempt: u32,
    },
    /// The store behind failed.
    #[error("engine: {0}")]
    Store(String),
    /// The engine was shut down.
    #[error("the engine has stopped")]
    Stopped,
}

/// The queue and the records. See the module for the guarantees.
#[async_trait::async_trait]
pub trait Engine: Send + Sync {
    /// Accepts a job, unless its tenant or the queue has no room for it. A submit that repeats an earlier one is answered in any case.
    async fn submit(&self, job: NewJob) -> Result<Submitted, EngineError>;
    /// What a submit with this key would be answered without accepting anything; `None` when the key is new.
    async fn recall(&self, tenant: &Tenant, key: IdempotencyKey) -> Result<Option<Submitted>, EngineError>;
    /// The record of a job.
    async fn get(&self, tenant: &Tenant, id: JobId) -> Result<Option<Job>, EngineError>;
    /// The request of a job.
    async fn spec(&self, tenant: &Tenant, id: JobId) -> Result<Option<JobSpec>, EngineError>;
    /// A page of records.
    async fn list(&self, tenant: &Tenant, query: ListQuery) -> Result<Page, EngineError>;
    /// Asks for a job to be stopped: a queued one ends at once, a running one is told. The record afterwards.
    async fn request_cancel(&self, tenant: &Tenant, id: JobId) -> Result<Option<Job>, EngineError>;
    /// Forgets an ended job.
    async fn forget(&self, tenant: &Tenant, id: JobId) -> Result<Forgotten, EngineError>;

    /// Those of these blobs (hexadecimal SHA-256) that no job names: neither as an input nor as an output. Only the jobs of `whose`
    /// count, where it is given; and jobs that ended before `expired` do not, where that is given. When in doubt a blob counts as
    /// named.
    async fn unnamed(
        &self,
        whose: Option<&Tenant>,
        blobs: Vec<String>,
        expired: Option<Timestamp>,
    ) -> Result<Vec<String>, EngineError>;

    /// Takes up to `slots` jobs, each in its tenant's turn, waiting at most `wait` for the first.
    async fn claim(&self, worker: &str, slots: usize, wait: Duration) -> Result<Vec<Claim>, EngineError>;
    /// Extends a claim and tells its news.
    async fn renew(&self, claim: &Claim, news: Vec<Update>) -> Result<Renewal, EngineError>;
    /// Returns when a claimed job is to be stopped or the claim was lost, as soon as the engine learns of it.
    async fn interrupted(&self, claim: &Claim) -> Renewal;
    /// Ends an attempt.
    ///
    /// # Errors
    /// [`EngineError::Fenced`] when the claim was lost.
    async fn finish(&self, claim: &Claim, outcome: Outcome) -> Result<(), EngineError>;

    /// The stored events of a job after a sequence number, at most `limit`; `None` when there is no such job.
    async fn events_after(
        &self,
        tenant: &Tenant,
        id: JobId,
        after: u64,
        limit: usize,
    ) -> Result<Option<EventPage>, EngineError>;
    /// The job's events from now on. Every change of a record is told by an event.
    fn changes(&self, tenant: &Tenant, id: JobId) -> Changes;
    /// How much there is to do, as this node sees it.
    async fn depth(&self) -> Result<Depth, EngineError>;
    /// Takes up to `limit` ends of jobs that somebody is to be told, of the tenants in turn and of each the one that waits longest first. Each is whose took it for
    /// the time of `hold`, and then due again unless it was settled. It became due in the same step in which its job ended.
    async fn take_notices(&self, limit: usize, hold: Duration) -> Result<Vec<DueNotice>, EngineError>;
    /// Notes what became of an attempt: the end is told again at `next`, or not any more. Nothing is noted of an attempt that was
    /// followed by another.
    async fn settle_notice(
        &self,
        tenant: &Tenant,
        id: JobId,
        attempts: u32,
        next: Option<Timestamp>,
    ) -> Result<(), EngineError>;
    /// Whether the engine can do its work.
    async fn health(&self) -> Result<(), EngineError>;
}

/// A stretch of a job's events, and where it stands in the whole.
#[derive(Clone, Debug, PartialEq)]
pub struct EventPage {
    /// The events, in order.
    pub events: Vec<Event>,
    /// The oldest sequence number that is still kept (0 when none is).
    pub oldest: u64,
    /// The newest sequence number.
    pub newest: u64,
    /// The record at the same moment.
    pub job: Job,
}

/// The live events of one job.
pub struct Changes(pub tokio::sync::broadcast::Receiver<Arc<Event>>);

impl Changes {
    /// The next event since the last call (or since subscribing); `None` when some were dropped because the reader was
    /// slow, so that the engine must be asked.
    pub async fn next(&mut self) -> Option<Arc<Event>> {
        use tokio::sync::broadcast::error::RecvError;
        match self.0.recv().await {
            Ok(event) => Some(event),
            Err(RecvError::Lagged(_)) => None,
            // the engine is gone: nothing will change any more
            Err(RecvError::Closed) => std::future::pending().await,
        }
    }
}

/// Events read at once from the engine by a follower.
const PAGE: usize = 64;
/// How long a follower believes that a silent job has nothing to tell before it asks the engine.
const QUIET: Duration = Duration::from_secs(15);

/// The events of a job as they happen: from `after` on when that is still kept, else from a fresh snapshot. Ends after the
/// `done` event. `None` when there is no such job.
pub async fn follow(
    engine: Arc<dyn Engine>,
    tenant: &Tenant,
    id: JobId,
    after: Option<u64>,
) -> Result<Option<BoxStream<'static, Result<Arc<Event>, EngineError>>>, EngineError> {
    // subscribed before reading, so that nothing falls between
    let changes = engine.changes(tenant, id);
    let Some(page) = engine.events_after(tenant, id, after.unwrap_or(u64::MAX), PAGE).await? else { return Ok(None) };
    let tenant = tenant.clone();
    let pending = VecDeque::new();
    let mut follower = Follower { engine, tenant, id, changes, pending, position: 0, caught_up: false, over: false };
    match after {
        Some(after) if after <= page.newest && after.saturating_add(1) >= page.oldest => {
            follower.position = after;
            follower.pending.extend(page.events.into_iter().map(Arc::new));
        }
        _ => follower.start_over(&page),
    }
    let stream = futures::stream::unfold(follower, |mut follower| async move {
        follower.next().await.transpose().map(|event| (event, follower))
    });
    Ok(Some(Box::pin(stream)))
}

struct Follower {
    engine: Arc<dyn Engine>,
    tenant: Tenant,
    id: JobId,
    changes: Changes,
    pending: VecDeque<Arc<Event>>,
    /// Sequence number of the last event that was given out.
    position: u64,
    /// Whether there was nothing after it in the engine, since it listens to changes.
    caught_up: bool,
    over: bool,
}

impl Follower {
    /// Goes on from a snapshot. The last event of an ended job comes after it, so that every stream ends with `done`.
    fn start_over(&mut self, page: &EventPage) {
        let seq = if page.job.state.ended() { page.newest.saturating_sub(1) } else { page.newest };
        let data = serde_json::to_value(&page.job).unwrap_or_default();
        self.pending = VecDeque::from([Arc::new(Event { seq, kind: EventKind::Snapshot, at: Timestamp::now(), data })]);
    }

    async fn next(&mut self) -> Result<Option<Arc<Event>>, EngineError> {
        while !self.over {
            if let Some(event) = self.pending.pop_front() {
                self.position = event.seq;
                self.over = event.kind == EventKind::Done;
                return Ok(Some(event));
            }
            if self.caught_up {
                // whatever was stored since comes by itself, and the engine is asked nothing for it
                match tokio::time::timeout(QUIET, self.changes.next()).await {
                    Ok(Some(event)) if event.seq == self.position + 1 => self.pending.push_back(event),
                    Ok(Some(event)) if event.seq <= self.position => {}
                    _ => self.caught_up = false,
                }
                continue;
            }
            let page = self.engine.events_after(&self.tenant, self.id, self.position, PAGE).await;
            match page.inspect_err(|_| self.over = true)? {
                None => self.over = true,
                Some(page) if page.events.is_empty() => {
                    self.over = page.job.state.ended() && self.position >= page.newest;
                    self.caught_up = true;
                }
                // the reader was slower than the trimming of old events
                Some(page) if page.oldest > self.position + 1 => self.start_over(&page),
                Some(page) => self.pending.extend(page.events.into_iter().map(Arc::new)),
            }
        }
        Ok(None)
    }
}
