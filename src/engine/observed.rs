//! An engine that is observed: every call that answers at once is timed, and a job that is submitted remembers the trace of its request. Calls that wait by design ([`Engine::claim`],
//! [`Engine::interrupted`]) are passed on as they are.

use super::{
    Changes, Claim, Depth, DueNotice, Engine, EngineError, EventPage, Forgotten, IdempotencyKey, ListQuery, NewJob,
    Outcome, Page, Renewal, Submitted, Update,
};
use crate::job::{Job, JobId, JobSpec};
use crate::telemetry::{metrics, traces};
use crate::tenant::Tenant;
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
    async fn recall(&self, tenant: &Tenant, key: IdempotencyKey) -> Result<Option<Submitted>, EngineError> {
        timed("recall", self.0.recall(tenant, key)).await
    }
    async fn get(&self, tenant: &Tenant, id: JobId) -> Result<Option<Job>, EngineError> {
        timed("get", self.0.get(tenant, id)).await
    }
    async fn spec(&self, tenant: &Tenant, id: JobId) -> Result<Option<JobSpec>, EngineError> {
        timed("spec", self.0.spec(tenant, id)).await
    }
    async fn list(&self, tenant: &Tenant, query: ListQuery) -> Result<Page, EngineError> {
        timed("list", self.0.list(tenant, query)).await
    }
    async fn request_cancel(&self, tenant: &Tenant, id: JobId) -> Result<Option<Job>, EngineError> {
        timed("request_cancel", self.0.request_cancel(tenant, id)).await
    }
    async fn forget(&self, tenant: &Tenant, id: JobId) -> Result<Forgotten, EngineError> {
        timed("forget", self.0.forget(tenant, id)).await
    }
    async fn unnamed(
        &self,
        tenant: Option<&Tenant>,
        blobs: Vec<String>,
        expired: Option<Timestamp>,
    ) -> Result<Vec<String>, EngineError> {
        timed("unnamed", self.0.unnamed(tenant, blobs, expired)).await
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
    async fn events_after(
        &self,
        tenant: &Tenant,
        id: JobId,
        after: u64,
        limit: usize,
    ) -> Result<Option<EventPage>, EngineError> {
        timed("events_after", self.0.events_after(tenant, id, after, limit)).await
    }
    fn changes(&self, tenant: &Tenant, id: JobId) -> Changes {
        self.0.changes(tenant, id)
    }
    async fn take_notices(&self, limit: usize, hold: Duration) -> Result<Vec<DueNotice>, EngineError> {
        timed("take_notices", self.0.take_notices(limit, hold)).await
    }
    async fn settle_notice(
        &self,
        tenant: &Tenant,
        id: JobId,
        attempts: u32,
        next: Option<Timestamp>,
    ) -> Result<(), EngineError> {
        timed("settle_notice", self.0.settle_notice(tenant, id, attempts, next)).await
    }
    async fn depth(&self) -> Result<Depth, EngineError> {
        timed("depth", self.0.depth()).await
    }
    async fn health(&self) -> Result<(), EngineError> {
        timed("health", self.0.health()).await
    }
}
