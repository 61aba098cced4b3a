//! One suite for every engine: the promises of the [module above](super), as claims that panic when broken.
//!
//! ```no_run
//! # async fn example(engine: std::sync::Arc<dyn shrinkd::engine::Engine>) {
//! // the engine must have been opened with `conformance::terms()`
//! shrinkd::engine::conformance::run(engine).await;
//! # }
//! ```

mod kept;
mod life;
mod losses;
mod notices;
mod readers;
mod tenants;

use super::{Claim, Engine, NewJob, Outcome, Submitted, Terms, Update};
use crate::job::{EventKind, JobId, JobSpec, Output, ProgressView, State};
use crate::quota::Exception;
use crate::quota::Quotas;
use crate::tenant::Tenant;
use serde_json::json;
use std::sync::Arc;
use std::time::Duration;

/// The lease that an engine under test is opened with: long enough for a slow machine to renew, short enough to wait for.
pub const LEASE: Duration = Duration::from_millis(1500);
/// Jobs that may wait in an engine under test.
const QUEUE: u64 = 60;
/// Longer than any step of the suite may take.
const PATIENCE: Duration = Duration::from_secs(20);
/// More events than any engine keeps of a job.
const MANY_EVENTS: u64 = 700;

/// What an engine under test is opened with.
pub fn terms() -> Terms {
    let none = Exception::default();
    let bounded = [
        (tenant("jobs"), Exception { queued: Some(2), running: Some(1), ..none }),
        (tenant("vertices"), Exception { vertices_per_hour: Some(100), ..none }),
        (tenant("seconds"), Exception { seconds_per_hour: Some(1), ..none }),
    ];
    let quotas = Quotas { tenants: bounded.into(), ..Quotas::default() };
    Terms { lease: LEASE, max_losses: 2, queue: QUEUE, quotas: Arc::new(quotas), ..Terms::default() }
}

fn tenant(name: &str) -> Tenant {
    name.parse().unwrap_or_else(|e| panic!("{name}: {e}"))
}

/// Whose the suite's jobs are, where it is not about tenants.
fn own() -> Tenant {
    Tenant::default()
}

/// A small valid job, not submitted yet.
pub fn new_job() -> NewJob {
    labeled("suite", "conformance")
}

fn labeled(name: &str, value: &str) -> NewJob {
    let request = json!({"field": {"scene": {"sphere": {"radius": 0.5}}}, "labels": {name: value}});
    let spec =
        JobSpec::from_value(&request).unwrap_or_else(|faults| panic!("the suite's own job is refused: {faults:?}"));
    NewJob { tenant: own(), id: JobId::new(), spec, vertices: 0, key: None }
}

/// Runs every claim, one after the other, on an engine that holds no job.
///
/// # Panics
/// When the engine breaks a promise.
pub async fn run(engine: Arc<dyn Engine>) {
    life::a_job_lives_from_submit_to_its_end(&engine).await;
    life::jobs_are_claimed_oldest_first_and_once(&engine).await;
    life::a_key_makes_a_submit_repeatable(&engine).await;
    life::a_queued_job_is_canceled_at_once(&engine).await;
    life::a_running_job_is_told_to_stop(&engine).await;
    losses::a_worker_that_lost_its_lease_cannot_finish(&engine).await;
    losses::a_renewed_lease_holds(&engine).await;
    losses::a_job_that_is_given_back_runs_again(&engine).await;
    losses::a_job_that_is_lost_too_often_fails(&engine).await;
    readers::a_reader_that_comes_back_misses_nothing(&engine).await;
    readers::a_reader_that_comes_too_late_goes_on_from_a_snapshot(&engine).await;
    life::a_waiting_worker_gets_a_job_as_it_comes(&engine).await;
    life::lists_are_newest_first_paged_and_filtered(&engine).await;
    kept::only_an_ended_job_is_forgotten(&engine).await;
    kept::a_surface_is_kept_for_the_jobs_that_begin_from_it(&engine).await;
    kept::a_blob_is_named_while_a_job_remembers_it(&engine).await;
    tenants::another_tenants_job_is_not_there(&engine).await;
    tenants::keys_and_labels_are_each_tenants_own(&engine).await;
    life::what_there_is_to_do_is_counted(&engine).await;
    notices::an_end_is_told_until_that_is_settled(&engine).await;
    tenants::tenants_take_turns(&engine).await;
    tenants::what_a_tenant_has_at_once_is_limited(&engine).await;
    tenants::what_a_tenants_jobs_cost_is_limited(&engine).await;
    tenants::a_full_queue_takes_no_more(&engine).await;
    engine.health().await.expect("healthy");
}

async fn submit(engine: &Arc<dyn Engine>, job: NewJob) -> JobId {
    match engine.submit(job).await.expect("submits") {
        Submitted::Created(job) => job.id,
        other => panic!("expected a new job, found {other:?}"),
    }
}

async fn claim_one(engine: &Arc<dyn Engine>, worker: &str) -> Claim {
    let mut claims = engine.claim(worker, 1, PATIENCE).await.expect("claims");
    assert_eq!(claims.len(), 1, "one slot, one claim");
    claims.remove(0)
}

async fn state(engine: &Arc<dyn Engine>, id: JobId) -> State {
    engine.get(&own(), id).await.expect("reads").expect("is there").state
}

fn success(sha256: &str) -> Outcome {
    let output = Output {
        name: "glb".to_owned(),
        href: String::new(),
        media_type: "model/gltf-binary".to_owned(),
        bytes: 1,
        sha256: sha256.to_owned(),
        certified: true,
    };
    Outcome::Succeeded { outputs: vec![output], metrics: json!({"vertices": 1}) }
}

fn progress(fraction: f32) -> Update {
    let progress = ProgressView { stage: "contract".to_owned(), fraction, ..ProgressView::default() };
    Update { kind: EventKind::Progress, data: json!({"fraction": fraction}), progress: Some(progress) }
}
