//! An engine that is observed: every call that answers at once is timed, and a job that is submitted remembers the trace of its request. Calls that wait by design ([`Engine::claim`],
//! [`Engine::interrupted`]) are passed on as they are.

use super::{
    Changes, Claim, Depth, Engine, EngineError, EventPage, Forgotten, IdempotencyKey, ListQuery, NewJob, Outcome, Page,
    Renewal, Submitted, Update,
};
use crate::job::{Job, JobId, JobSpec};
use crate::telemetry::{metrics, traces};
use jiff::Timestamp;
use std::sync::Arc;
use std::time::{Duration, Instant};

/// Passes everything on to another engine.
pub struct Observed(pub Arc<dyn Engine>);

async fn timed<T>(call: &'static str, work: impl Future<Output = Result<T, EngineError>>) -> Result<T, EngineError> {
    let clock = Instant::now();
    let result = work.await;
    let outcome = match &result {
        Ok(_) => "ok",
        Err(EngineError::Fenced { .. }) => "fenced",
        Err(_) => "error",
    };
    metrics::engine_call(call, outcome, clock.elapsed());
    result
}

#[async_trait::async_trait]
impl Engine for Observed {
    async fn submit(&self, mut job: NewJob) -> Result<Submitted, EngineError> {
        job.spec.traceparent = traces::current();
        timed("submit", self.0.submit(job)).await
    }
    async fn recall(&self, key: IdempotencyKey) -> Result<Option<Submitted>, EngineError> {
        timed("recall", self.0.recall(key)).await
    }
    async fn get(&self, id: JobId) -> Result<Option<Job>, EngineError> {
        timed("get", self.0.get(id)).await
    }
    async fn spec(&self, id: JobId) -> Result<Option<JobSpec>, EngineError> {
        timed("spec", self.0.spec(id)).await
    }
    async fn list(&self, query: ListQuery) -> Result<Page, EngineError> {
        timed("list", self.0.list(query)).await
    }
    async fn request_cancel(&self, id: JobId) -> Result<Option<Job>, EngineError> {
        timed("request_cancel", self.0.request_cancel(id)).await
    }
    async fn forget(&self, id: JobId) -> Result<Forgotten, EngineError> {
        timed("forget", self.0.forget(id)).await
    }
    async fn unnamed(&self, blobs: Vec<String>, expired: Option<Timestamp>) -> Result<Vec<String>, EngineError> {
        timed("unnamed", self.0.unnamed(blobs, expired)).await
    }
    async fn claim(&self, worker: &str, slots: usize, wait: Duration) -> Result<Vec<Claim>, EngineError> {
        self.0.claim(worker, slots, wait).await
    }
    async fn renew(&self, claim: &Claim, news: Vec<Update>) -> Result<Renewal, EngineError> {
        timed("renew", self.0.renew(claim, news)).await
    }
    async fn interrupted(&self, claim: &Claim) -> Renewal {
        self.0.interrupted(claim).await
    }
    async fn finish(&self, claim: &Claim, outcome: Outcome) -> Result<(), EngineError> {
        timed("finish", self.0.finish(claim, outcome)).await
    }
    async fn events_after(&self, id: JobId, after: u64, limit: usize) -> Result<Option<EventPage>, EngineError> {
        timed("events_after", self.0.events_after(id, after, limit)).await
    }
    fn changes(&self, id: JobId) -> Changes {
        self.0.changes(id)
    }
    async fn depth(&self) -> Result<Depth, EngineError> {
        timed("depth", self.0.depth()).await
    }
    async fn health(&self) -> Result<(), EngineError> {
        timed("health", self.0.health()).await
    }
}
