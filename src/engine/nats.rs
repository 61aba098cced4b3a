//! The cluster engine: NATS JetStream, for any number of nodes.
//!
//! Every node has one connection, one consumer that brings it every job's changes, and a `projection` of them that
//! it lists from. The truth is the `record` of a job in its stream, and every change of it is a compare-and-set
//! that says from which version it was made; so it does not matter which node, worker or sweeper is late, frozen or cut off.
//!
//! | promise | kept by |
//! |---|---|
//! | accepted jobs survive | the record is stored by a majority of the servers before `submit` returns; they must sync (`docker/nats.conf`) |
//! | jobs run in their turn | every node knows the queue (`projection`) and takes the job whose turn it is (`claims`) |
//! | one worker at a time | a claim is a compare-and-set from `queued` to `running` under the next attempt |
//! | only the newest attempt counts | renewing and finishing look at the attempt in the version that they replace |
//! | lost workers are found | every node watches heartbeats by its own clock (`leases`) |
//! | events have no gap | they are stored with the record, in one message (`record`) |
//! | one key, one job | a key names its job, and whoever finds it makes that job (`keys`) |
//! | an end is told | what is owed is stored with the end, in its record (`notices`) |
//!
//! Not guaranteed beyond what the [room](super) says: a list on one node shows what was submitted on another only once its
//! feed has brought it, usually within milliseconds.
//! Do not use it for a single machine: the embedded engine needs no servers and is faster.

mod address;
mod api_keys;
mod claims;
mod feed;
mod housekeeping;
mod keys;
mod layout;
mod leases;
mod ledger;
mod link;
mod notices;
mod projection;
mod record;
mod sweeper;
#[cfg(test)]
mod tests;

pub use address::{Address, InvalidAddress, SCHEMES};
pub use api_keys::NatsKeys;

use super::{
    Changes, Claim, Depth, DueNotice, Engine, EngineError, EventPage, Forgotten, IdempotencyKey, ListQuery, NewJob,
    Outcome, Page, Renewal, Submitted, Terms, Update,
};
use crate::job::{Job, JobId, JobSpec, State};
use crate::tenant::Tenant;
use bytes::Bytes;
use feed::Feed;
use jiff::Timestamp;
use layout::{Layout, Name};
use ledger::{Found, Ledger, Step, Version};
use link::{Expect, Link, failed, patiently};
use projection::Projection;
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;
use tokio::task::JoinHandle;

/// How long `health` waits for the servers.
const HEALTH: Duration = Duration::from_secs(2);
/// How often a running job looks at its claim by itself; news wake it at once.
const LOOK: Duration = Duration::from_secs(1);
/// How long forgetting waits for what other nodes stored before it; after that the blobs are kept.
const FORGET: Duration = Duration::from_secs(2);
/// Bytes of news that are stored together at most: well below the messages that servers take by default.
const NEWS_BYTES: usize = 256 << 10;

/// One node of the cluster.
pub struct NatsEngine {
    node: Arc<Node>,
    tasks: [JoinHandle<()>; 2],
}

/// What the engine's tasks share.
struct Node {
    ledger: Arc<Ledger>,
    feed: Feed,
    terms: Terms,
}

impl NatsEngine {
    /// Connects to the servers, makes the streams that are not there, and reads every record into a projection in `folder`
    /// (which nodes may share).
    ///
    /// # Errors
    /// When no server answers, it has no JetStream, or the folder cannot be written.
    pub async fn open(address: &Address, folder: &Path, terms: Terms) -> Result<Self, EngineError> {
        let link = Link::open(address, terms.request_bytes).await?;
        let layout = patiently(Layout::open(&link, address)).await?;
        let ledger = Arc::new(Ledger { link, layout, projection: Projection::open(folder)? });
        let feed = Feed::start(ledger.clone()).await?;
        let node = Arc::new(Node { ledger, feed, terms });
        let tasks = [
            tokio::spawn(sweeper::run(Arc::downgrade(&node))),
            tokio::spawn(housekeeping::run(Arc::downgrade(&node.ledger))),
        ];
        Ok(Self { node, tasks })
    }
}

impl NatsEngine {
    /// What answers at an address, in a few words, for a person. Nothing is made there.
    ///
    /// # Errors
    /// When no server answers, or it has no JetStream.
    pub async fn probe(address: &Address, request_bytes: u64) -> Result<String, EngineError> {
        let link = Link::open(address, request_bytes).await?;
        Ok(format!("nats-server {} with JetStream", link.client.server_info().version))
    }
}

impl Drop for NatsEngine {
    fn drop(&mut self) {
        self.tasks.iter().for_each(JoinHandle::abort);
    }
}

impl Node {
    /// The version of a claimed job that this node saw last, if that is not older than the claim.
    fn seen(&self, claim: &Claim) -> Option<Version> {
        self.ledger.projection.seen(claim.id).filter(|version| version.record.job.attempt >= claim.attempt)
    }

    async fn submit(&self, new: NewJob) -> Result<Submitted, EngineError> {
        if let Some(refused) = self.ledger.projection.refuse(new.clone(), &self.terms).await? {
            // what was accepted before is answered in any case
            let known = match &new.key {
                Some(key) => keys::recall(&self.ledger, &new.tenant, key).await?,
                None => None,
            };
            return Ok(known.unwrap_or(refused));
        }
        keys::submit(&self.ledger, new).await
    }

    async fn request_cancel(&self, name: &Name) -> Result<Option<Job>, EngineError> {
        let changed = self.ledger.change(name, None, |draft| {
            match draft.record.job.state {
                State::Queued => draft.go(State::Canceled),
                State::Running => draft.go(State::Canceling),
                _ => return Step::Leave(()),
            }
            Step::Write(())
        });
        Ok(changed.await?.map(|((), record)| record.job.clone()))
    }

    /// Forgets a job, and decides which blobs nobody names any more.
    ///
    /// Jobs that end and jobs that are forgotten are stored in one stream, so there is an order between them. An entry that
    /// names a blob and comes before the tombstone is seen here, because the projection is waited for; for one that comes
    /// after it, the job is open now, and as long as any job is open no blob is given up. Nor is one when this node does not
    /// hear of the others. What is kept so is left to the garbage collection. Left open: a job that is submitted, run and
    /// ended with the same output within the moment from here to the removal of the blob.
    async fn forget(&self, name: &Name) -> Result<Forgotten, EngineError> {
        let (tombstone, record) = loop {
            let Some(version) = self.ledger.version(name).await? else { return Ok(Forgotten::Unknown) };
            if !version.record.job.state.ended() {
                return Ok(Forgotten::Running);
            }
            if let Some(seq) = self.ledger.forget(name, &version).await? {
                break (seq, version.record);
            }
        };
        let hears = self.feed.reaches(tombstone, FORGET).await;
        if !hears || !self.ledger.projection.open_jobs(|_| true).is_empty() {
            return Ok(Forgotten::Gone(Vec::new()));
        }
        self.ledger.projection.unnamed(None, record.named_blobs(), None).await.map(Forgotten::Gone)
    }

    /// Those of the blobs that no job names. Only asked once everything that was stored so far is here: a node that does not hear of
    /// the others gives up nothing. What is stored after that is about blobs that were put or touched a moment before.
    async fn unnamed(
        &self,
        whose: Option<&Tenant>,
        blobs: Vec<String>,
        expired: Option<Timestamp>,
    ) -> Result<Vec<String>, EngineError> {
        let info = self.ledger.layout.jobs.get_info().await.map_err(|e| failed("the jobs")(e.into()))?;
        if !self.feed.reaches(info.state.last_sequence, FORGET).await {
            return Ok(Vec::new());
        }
        self.ledger.projection.unnamed(whose, blobs, expired).await
    }

    async fn renew(&self, claim: &Claim, news: Vec<Update>) -> Result<Renewal, EngineError> {
        let (mut renewal, name) = (Renewal::Lost, name(claim));
        for news in together(news) {
            let renewed = self.ledger.change(&name, self.seen(claim), |draft| {
                let standing = draft.record.standing(claim);
                if standing == Renewal::Lost {
                    return Step::Leave(standing);
                }
                // also without news: the entry is the sign of life
                news.iter().for_each(|update| draft.tell(update.clone()));
                Step::Write(standing)
            });
            renewal = renewed.await?.map_or(Renewal::Lost, |(standing, _)| standing);
            if renewal == Renewal::Lost {
                break;
            }
        }
        Ok(renewal)
    }

    async fn finish(&self, claim: &Claim, outcome: Outcome) -> Result<(), EngineError> {
        let name = name(claim);
        let ended = self.ledger.change(&name, self.seen(claim), |draft| {
            let standing = draft.record.standing(claim);
            if standing == Renewal::Lost {
                return Step::Leave(false);
            }
            draft.finish(outcome.clone(), standing);
            Step::Write(true)
        });
        match ended.await? {
            Some((true, _)) => Ok(()),
            _ => Err(EngineError::Fenced { id: claim.id, attempt: claim.attempt }),
        }
    }

    async fn standing(&self, claim: &Claim) -> Result<Renewal, EngineError> {
        let version = match self.seen(claim) {
            Some(version) => Some(version),
            None => self.ledger.version(&name(claim)).await?,
        };
        Ok(version.map_or(Renewal::Lost, |version| version.record.standing(claim)))
    }

    async fn events_after(&self, name: &Name, after: u64, limit: usize) -> Result<Option<EventPage>, EngineError> {
        let projection = &self.ledger.projection;
        let mut found = projection.events_after(name, after, limit).await?;
        // another node may have told more than has come here
        if found.as_ref().is_none_or(|(page, _)| after > page.newest) {
            if self.ledger.version(name).await?.is_none() {
                return Ok(None);
            }
            found = projection.events_after(name, after, limit).await?;
        }
        let Some((page, whole)) = found else { return Ok(None) };
        let is_here = after >= page.newest || (page.oldest > 0 && after + 1 >= page.oldest);
        if whole || is_here {
            return Ok(Some(page));
        }
        let (events, seq) = feed::history(&self.ledger, name).await?;
        projection.complete(name.id, events, seq).await?;
        Ok(projection.events_after(name, after, limit).await?.map(|(page, _)| page))
    }

    /// The servers are asked for the number of the newest entry only; the counts are this node's own.
    async fn depth(&self) -> Result<Depth, EngineError> {
        let newest = tokio::time::timeout(HEALTH, self.ledger.layout.jobs.get_info()).await.ok().and_then(Result::ok);
        let (open, oldest_queued) = self.ledger.projection.depth().await?;
        let lag = newest.as_ref().map_or(0, |info| info.state.last_sequence.saturating_sub(self.feed.position()));
        Ok(Depth { open, oldest_queued, connected: newest.is_some(), lag })
    }

    async fn health(&self) -> Result<(), EngineError> {
        if !self.ledger.link.is_up() {
            return Err(EngineError::Store("there is no connection to the cluster".to_owned()));
        }
        let info = self.ledger.layout.jobs.get_info().await.map_err(|e| failed("the stream of jobs")(e.into()))?;
        if info.cluster.is_some_and(|cluster| cluster.leader.is_none_or(|leader| leader.is_empty())) {
            return Err(EngineError::Store("the stream of jobs has no leader".to_owned()));
        }
        // servers without room can still be read
        let (layout, id) = (&self.ledger.layout, uuid::Uuid::now_v7().to_string());
        let probe = layout.probe();
        match self.ledger.link.store_once(&layout.keys, &probe, &Bytes::new(), Expect::Any, &id, false).await? {
            Some(_) => Ok(()),
            None => Err(EngineError::Store("nothing can be stored".to_owned())),
        }
    }
}

/// The job that a claim holds.
fn name(claim: &Claim) -> Name {
    Name::new(&claim.tenant, claim.id)
}

/// News in portions that fit into one message each; one portion when there are none.
fn together(news: Vec<Update>) -> Vec<Vec<Update>> {
    let (mut portions, mut bytes) = (vec![Vec::new()], 0);
    for update in news {
        let size = update.data.to_string().len();
        if bytes > 0 && bytes + size > NEWS_BYTES {
            portions.push(Vec::new());
            bytes = 0;
        }
        bytes += size;
        if let Some(portion) = portions.last_mut() {
            portion.push(update);
        }
    }
    portions
}

#[async_trait::async_trait]
impl Engine for NatsEngine {
    async fn submit(&self, job: NewJob) -> Result<Submitted, EngineError> {
        patiently(self.node.submit(job)).await
    }

    async fn recall(&self, tenant: &Tenant, key: IdempotencyKey) -> Result<Option<Submitted>, EngineError> {
        patiently(keys::recall(&self.node.ledger, tenant, &key)).await
    }

    async fn get(&self, tenant: &Tenant, id: JobId) -> Result<Option<Job>, EngineError> {
        let found = patiently(self.node.ledger.read(&Name::new(tenant, id))).await?;
        Ok(match found {
            Found::Job(version) => Some(version.record.job.clone()),
            Found::Forgotten | Found::Nothing => None,
        })
    }

    async fn spec(&self, tenant: &Tenant, id: JobId) -> Result<Option<JobSpec>, EngineError> {
        let stored = patiently(self.node.ledger.request(&Name::new(tenant, id))).await?;
        let read = |value| JobSpec::from_stored(value).map_err(|faults| EngineError::Store(format!("{faults:?}")));
        stored.map(read).transpose()
    }

    async fn list(&self, tenant: &Tenant, query: ListQuery) -> Result<Page, EngineError> {
        self.node.ledger.projection.list(tenant, query).await
    }

    async fn request_cancel(&self, tenant: &Tenant, id: JobId) -> Result<Option<Job>, EngineError> {
        patiently(self.node.request_cancel(&Name::new(tenant, id))).await
    }

    async fn forget(&self, tenant: &Tenant, id: JobId) -> Result<Forgotten, EngineError> {
        patiently(self.node.forget(&Name::new(tenant, id))).await
    }

    async fn unnamed(
        &self,
        whose: Option<&Tenant>,
        blobs: Vec<String>,
        expired: Option<Timestamp>,
    ) -> Result<Vec<String>, EngineError> {
        patiently(self.node.unnamed(whose, blobs, expired)).await
    }

    async fn claim(&self, worker: &str, slots: usize, wait: Duration) -> Result<Vec<Claim>, EngineError> {
        claims::take(&self.node, worker, slots, wait).await
    }

    async fn renew(&self, claim: &Claim, news: Vec<Update>) -> Result<Renewal, EngineError> {
        patiently(self.node.renew(claim, news)).await
    }

    async fn interrupted(&self, claim: &Claim) -> Renewal {
        let mut changes = self.changes(&claim.tenant, claim.id);
        loop {
            match patiently(self.node.standing(claim)).await {
                Ok(Renewal::Keep) => {}
                Ok(interruption) => return interruption,
                // the next heartbeat will tell whether the cluster is really gone
                Err(error) => tracing::warn!(job.id = %claim.id, %error, "the claim could not be looked at"),
            }
            let _ = tokio::time::timeout(LOOK, changes.next()).await;
        }
    }

    async fn finish(&self, claim: &Claim, outcome: Outcome) -> Result<(), EngineError> {
        patiently(self.node.finish(claim, outcome)).await
    }

    async fn events_after(
        &self,
        tenant: &Tenant,
        id: JobId,
        after: u64,
        limit: usize,
    ) -> Result<Option<EventPage>, EngineError> {
        patiently(self.node.events_after(&Name::new(tenant, id), after, limit)).await
    }

    async fn take_notices(&self, limit: usize, hold: Duration) -> Result<Vec<DueNotice>, EngineError> {
        if limit == 0 {
            return Ok(Vec::new());
        }
        patiently(notices::take(&self.node.ledger, limit, hold)).await
    }

    async fn settle_notice(
        &self,
        tenant: &Tenant,
        id: JobId,
        attempts: u32,
        next: Option<Timestamp>,
    ) -> Result<(), EngineError> {
        patiently(notices::settle(&self.node.ledger, &Name::new(tenant, id), attempts, next)).await
    }

    fn changes(&self, tenant: &Tenant, id: JobId) -> Changes {
        Changes(self.node.ledger.projection.subscribe(tenant, id))
    }

    async fn depth(&self) -> Result<Depth, EngineError> {
        patiently(self.node.depth()).await
    }

    async fn health(&self) -> Result<(), EngineError> {
        tokio::time::timeout(HEALTH, self.node.health())
            .await
            .unwrap_or_else(|_| Err(EngineError::Store("no answer from the cluster".to_owned())))
    }
}
