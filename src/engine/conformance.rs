//! One suite for every engine: the promises of the [module above](super), as claims that panic when broken.
//!
//! ```no_run
//! # async fn example(engine: std::sync::Arc<dyn shrinkd::engine::Engine>) {
//! // the engine must have been opened with `conformance::terms()`
//! shrinkd::engine::conformance::run(engine).await;
//! # }
//! ```

use super::{
    Claim, Depth, DueNotice, Engine, EngineError, Forgotten, IdempotencyKey, ListQuery, NewJob, Outcome, Renewal,
    Submitted, Terms, Update, follow,
};
use crate::blobs::BlobId;
use crate::job::spec::{WarmStartSpec, Work};
use crate::job::{Event, EventKind, Failure, JobId, JobKind, JobSpec, Output, ProgressView, State};
use crate::quota::{Exceeded, Exception, HOUR, Quotas};
use crate::tenant::Tenant;
use futures::StreamExt;
use jiff::Timestamp;
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
    a_job_lives_from_submit_to_its_end(&engine).await;
    jobs_are_claimed_oldest_first_and_once(&engine).await;
    a_key_makes_a_submit_repeatable(&engine).await;
    a_queued_job_is_canceled_at_once(&engine).await;
    a_running_job_is_told_to_stop(&engine).await;
    a_worker_that_lost_its_lease_cannot_finish(&engine).await;
    a_renewed_lease_holds(&engine).await;
    a_job_that_is_given_back_runs_again(&engine).await;
    a_job_that_is_lost_too_often_fails(&engine).await;
    a_reader_that_comes_back_misses_nothing(&engine).await;
    a_reader_that_comes_too_late_goes_on_from_a_snapshot(&engine).await;
    a_waiting_worker_gets_a_job_as_it_comes(&engine).await;
    lists_are_newest_first_paged_and_filtered(&engine).await;
    only_an_ended_job_is_forgotten(&engine).await;
    a_surface_is_kept_for_the_jobs_that_begin_from_it(&engine).await;
    a_blob_is_named_while_a_job_remembers_it(&engine).await;
    another_tenants_job_is_not_there(&engine).await;
    keys_and_labels_are_each_tenants_own(&engine).await;
    what_there_is_to_do_is_counted(&engine).await;
    an_end_is_told_until_that_is_settled(&engine).await;
    tenants_take_turns(&engine).await;
    what_a_tenant_has_at_once_is_limited(&engine).await;
    what_a_tenants_jobs_cost_is_limited(&engine).await;
    a_full_queue_takes_no_more(&engine).await;
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

async fn a_job_lives_from_submit_to_its_end(engine: &Arc<dyn Engine>) {
    let id = submit(engine, new_job()).await;
    let queued = engine.get(&own(), id).await.expect("reads").expect("is there");
    assert_eq!((queued.state, queued.attempt, queued.started_at), (State::Queued, 0, None));
    let claim = claim_one(engine, "a").await;
    assert_eq!((claim.id, claim.attempt), (id, 1));
    let running = engine.get(&own(), id).await.expect("reads").expect("is there");
    assert_eq!(running.state, State::Running);
    assert!(running.revision > queued.revision && running.started_at.is_some());
    assert_eq!(engine.renew(&claim, vec![progress(0.5)]).await.expect("renews"), Renewal::Keep);
    let later = engine.get(&own(), id).await.expect("reads").expect("is there");
    assert!(later.revision > running.revision);
    assert_eq!(later.progress.map(|p| p.fraction), Some(0.5));
    engine.finish(&claim, success("aa")).await.expect("finishes");
    let ended = engine.get(&own(), id).await.expect("reads").expect("is there");
    assert_eq!(ended.state, State::Succeeded);
    assert_eq!((ended.outputs.len(), ended.problem), (1, None));
    assert!(ended.finished_at >= ended.started_at && ended.metrics.is_some());
    let again = engine.finish(&claim, success("bb")).await;
    assert!(matches!(again, Err(EngineError::Fenced { .. })), "a job ends once: {again:?}");
    assert_eq!(engine.renew(&claim, Vec::new()).await.expect("answers"), Renewal::Lost);
    assert_eq!(engine.get(&own(), JobId::new()).await.expect("reads"), None);
}

async fn jobs_are_claimed_oldest_first_and_once(engine: &Arc<dyn Engine>) {
    let mut ids = Vec::new();
    for _ in 0..6 {
        ids.push(submit(engine, new_job()).await);
    }
    let (a, b) = tokio::join!(engine.claim("a", 3, PATIENCE), engine.claim("b", 3, PATIENCE));
    let claims = [a.expect("claims"), b.expect("claims")].concat();
    let mut claimed: Vec<JobId> = claims.iter().map(|c| c.id).collect();
    claimed.sort_unstable();
    assert_eq!(claimed, ids, "each job is claimed, and once");
    assert!(engine.claim("c", 3, Duration::ZERO).await.expect("claims").is_empty());
    for claim in claims {
        engine.finish(&claim, Outcome::failed(Failure::internal())).await.expect("finishes");
        let job = engine.get(&own(), claim.id).await.expect("reads").expect("is there");
        assert_eq!(job.problem.map(|p| p.code).as_deref(), Some("internal"));
    }
}

async fn a_key_makes_a_submit_repeatable(engine: &Arc<dyn Engine>) {
    let keyed = |fingerprint: &str| NewJob {
        key: Some(IdempotencyKey { key: "k".to_owned(), fingerprint: fingerprint.to_owned() }),
        ..new_job()
    };
    let mut racing = Vec::new();
    for _ in 0..8 {
        let (engine, job) = (engine.clone(), keyed("one"));
        racing.push(tokio::spawn(async move { engine.submit(job).await.expect("submits") }));
    }
    let (mut created, mut answers) = (0, Vec::new());
    for submit in racing {
        match submit.await.expect("no panic") {
            Submitted::Created(job) => {
                created += 1;
                answers.push(job);
            }
            Submitted::Replayed(job) => answers.push(job),
            other => panic!("the same request is answered with its job, not with {other:?}"),
        }
    }
    assert_eq!(created, 1, "one key, one job");
    assert!(answers.windows(2).all(|w| w[0] == w[1]), "every answer is the same");
    assert_eq!(engine.submit(keyed("two")).await.expect("answers"), Submitted::KeyConflict);
    let recall = async |fingerprint: &str, key: &str| {
        let key = IdempotencyKey { key: key.to_owned(), fingerprint: fingerprint.to_owned() };
        engine.recall(&own(), key).await.expect("answers")
    };
    assert_eq!(recall("one", "k").await, Some(Submitted::Replayed(answers[0].clone())));
    assert_eq!(recall("two", "k").await, Some(Submitted::KeyConflict));
    assert_eq!(recall("one", "new").await, None);
    let claim = claim_one(engine, "a").await;
    engine.finish(&claim, Outcome::Canceled).await.expect("finishes");
    let replayed = engine.submit(keyed("one")).await.expect("answers");
    assert_eq!(replayed, Submitted::Replayed(answers.remove(0)), "the same answer after the end, too");
}

async fn a_queued_job_is_canceled_at_once(engine: &Arc<dyn Engine>) {
    let id = submit(engine, new_job()).await;
    let job = engine.request_cancel(&own(), id).await.expect("cancels").expect("is there");
    assert_eq!(job.state, State::Canceled);
    assert!(engine.claim("a", 1, Duration::ZERO).await.expect("claims").is_empty());
    let again = engine.request_cancel(&own(), id).await.expect("answers").expect("is there");
    assert_eq!(again, job, "cancelling what has ended changes nothing");
    assert_eq!(engine.request_cancel(&own(), JobId::new()).await.expect("answers"), None);
}

async fn a_running_job_is_told_to_stop(engine: &Arc<dyn Engine>) {
    submit(engine, new_job()).await;
    let claim = claim_one(engine, "a").await;
    let waiting = tokio::spawn({
        let (engine, claim) = (engine.clone(), claim.clone());
        async move { engine.interrupted(&claim).await }
    });
    let job = engine.request_cancel(&own(), claim.id).await.expect("cancels").expect("is there");
    assert_eq!(job.state, State::Canceling);
    let told = tokio::time::timeout(PATIENCE, waiting).await.expect("in time").expect("no panic");
    assert_eq!(told, Renewal::CancelRequested);
    assert_eq!(engine.renew(&claim, Vec::new()).await.expect("answers"), Renewal::CancelRequested);
    engine.finish(&claim, Outcome::Canceled).await.expect("finishes");
    assert_eq!(state(engine, claim.id).await, State::Canceled);
}

async fn a_worker_that_lost_its_lease_cannot_finish(engine: &Arc<dyn Engine>) {
    let id = submit(engine, new_job()).await;
    let first = claim_one(engine, "frozen").await;
    let second = claim_one(engine, "b").await;
    assert_eq!((second.id, second.attempt), (id, 2));
    assert_eq!(engine.renew(&first, vec![progress(0.9)]).await.expect("answers"), Renewal::Lost);
    assert_eq!(engine.interrupted(&first).await, Renewal::Lost);
    assert!(matches!(engine.finish(&first, success("aa")).await, Err(EngineError::Fenced { .. })));
    let job = engine.get(&own(), id).await.expect("reads").expect("is there");
    assert_eq!((job.state, job.progress), (State::Running, None), "the lost attempt left no trace");
    engine.finish(&second, success("bb")).await.expect("finishes");
    assert_eq!(engine.get(&own(), id).await.expect("reads").expect("is there").outputs[0].sha256, "bb");
}

async fn a_renewed_lease_holds(engine: &Arc<dyn Engine>) {
    submit(engine, new_job()).await;
    let claim = claim_one(engine, "a").await;
    for _ in 0..4 {
        tokio::time::sleep(LEASE / 3).await;
        assert_eq!(engine.renew(&claim, Vec::new()).await.expect("renews"), Renewal::Keep);
    }
    assert!(engine.claim("b", 1, Duration::ZERO).await.expect("claims").is_empty());
    engine.finish(&claim, Outcome::Canceled).await.expect("finishes");
}

async fn a_job_that_is_given_back_runs_again(engine: &Arc<dyn Engine>) {
    let id = submit(engine, new_job()).await;
    // more often than a job may be lost: giving back is no loss
    for attempt in 1..=4 {
        let claim = claim_one(engine, "stopping").await;
        assert_eq!((claim.id, claim.attempt), (id, attempt));
        engine.finish(&claim, Outcome::Released).await.expect("gives back");
        assert_eq!(state(engine, id).await, State::Queued);
    }
    engine.request_cancel(&own(), id).await.expect("cancels");
}

async fn a_job_that_is_lost_too_often_fails(engine: &Arc<dyn Engine>) {
    let id = submit(engine, new_job()).await;
    for attempt in 1..=2 {
        assert_eq!(claim_one(engine, "doomed").await.attempt, attempt);
    }
    assert!(engine.claim("b", 1, LEASE * 2).await.expect("claims").is_empty());
    let job = engine.get(&own(), id).await.expect("reads").expect("is there");
    assert_eq!(job.state, State::Failed);
    assert_eq!(job.problem.map(|p| p.code).as_deref(), Some("attempts_exhausted"));
}

async fn a_blob_is_named_while_a_job_remembers_it(engine: &Arc<dyn Engine>) {
    let (input, output, stray) =
        (BlobId::of(b"an input"), BlobId::of(b"an output").hex(), BlobId::of(b"a stray").hex());
    let request = json!({"field": {"input": input.to_string()}});
    let spec =
        JobSpec::from_value(&request).unwrap_or_else(|faults| panic!("the suite's own job is refused: {faults:?}"));
    let id = submit(engine, NewJob { tenant: own(), id: JobId::new(), spec, vertices: 0, key: None }).await;
    let unnamed = async |expired: Option<Timestamp>| {
        let blobs = vec![input.hex(), output.clone(), stray.clone()];
        engine.unnamed(None, blobs, expired).await.expect("answers")
    };
    assert_eq!(unnamed(None).await, [output.clone(), stray.clone()]);
    let claim = claim_one(engine, "a").await;
    engine.finish(&claim, success(&output)).await.expect("finishes");
    let ended = engine.get(&own(), id).await.expect("reads").expect("is there").finished_at.expect("has ended");
    assert_eq!(unnamed(None).await, std::slice::from_ref(&stray));
    assert_eq!(unnamed(Some(ended)).await, std::slice::from_ref(&stray), "it ended then, and not before");
    let later = ended.checked_add(jiff::SignedDuration::from_secs(1)).expect("a time");
    assert_eq!(unnamed(Some(later)).await, [input.hex(), output.clone(), stray.clone()]);
    assert_eq!(engine.forget(&own(), id).await.expect("answers"), Forgotten::Gone(vec![output.clone()]), "inputs stay");
    assert_eq!(unnamed(None).await, [input.hex(), output.clone(), stray.clone()]);
}

/// Takes notices until there are some.
async fn notices(engine: &Arc<dyn Engine>, hold: Duration) -> Vec<DueNotice> {
    let deadline = tokio::time::Instant::now() + PATIENCE;
    loop {
        let taken = engine.take_notices(8, hold).await.expect("takes");
        if !taken.is_empty() {
            return taken;
        }
        assert!(tokio::time::Instant::now() < deadline, "nothing is due");
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
}

async fn an_end_is_told_until_that_is_settled(engine: &Arc<dyn Engine>) {
    const LONG: Duration = Duration::from_secs(3600);
    let url = "https://example.com/in";
    let webhook = json!({"field": {"scene": {"sphere": {"radius": 0.5}}}, "webhook": {"url": url}});
    let told = || {
        let spec =
            JobSpec::from_value(&webhook).unwrap_or_else(|faults| panic!("the suite's own job is refused: {faults:?}"));
        NewJob { spec, ..new_job() }
    };
    let none = async || engine.take_notices(8, LONG).await.expect("takes").is_empty();
    let id = submit(engine, told()).await;
    assert!(none().await, "nothing is told before the end");
    let claim = claim_one(engine, "a").await;
    engine.finish(&claim, success("aa")).await.expect("finishes");
    let ended = engine.get(&own(), id).await.expect("reads").expect("is there");
    let first = notices(engine, Duration::from_millis(100)).await;
    assert_eq!(first, [DueNotice { tenant: own(), job: ended.clone(), url: url.to_owned(), attempts: 1 }]);
    // whoever took it is gone: it is due again, and what the first one says later counts no more
    let second = notices(engine, LONG).await;
    assert_eq!((second.len(), second[0].attempts), (1, 2));
    engine.settle_notice(&own(), id, 1, None).await.expect("settles");
    assert!(none().await, "it is held");
    let soon = Timestamp::now().checked_add(jiff::SignedDuration::from_millis(50)).expect("a time");
    engine.settle_notice(&own(), id, 2, Some(soon)).await.expect("settles");
    let third = notices(engine, LONG).await;
    assert_eq!((third.len(), third[0].attempts), (1, 3));
    engine.settle_notice(&own(), id, 3, None).await.expect("settles");
    engine.settle_notice(&own(), id, 3, Some(soon)).await.expect("settles");
    tokio::time::sleep(Duration::from_millis(100)).await;
    assert!(none().await, "it is over");
    assert_eq!(
        engine.get(&own(), id).await.expect("reads"),
        Some(ended),
        "telling an end changes nothing about the job"
    );

    // one that is canceled while it waits is told, too, and whoever asks at once does not get it twice
    let canceled = submit(engine, told()).await;
    engine.request_cancel(&own(), canceled).await.expect("cancels");
    let mut asking = Vec::new();
    for _ in 0..8 {
        let engine = engine.clone();
        asking.push(tokio::spawn(async move { engine.take_notices(8, LONG).await.expect("takes") }));
    }
    let mut got = Vec::new();
    for asked in asking {
        got.extend(asked.await.expect("no panic"));
    }
    if got.is_empty() {
        got = notices(engine, LONG).await;
    }
    assert_eq!(
        got.iter().map(|notice| (notice.job.id, notice.job.state)).collect::<Vec<_>>(),
        [(canceled, State::Canceled)]
    );
    engine.settle_notice(&own(), canceled, 1, Some(Timestamp::now())).await.expect("settles");
    engine.forget(&own(), canceled).await.expect("forgets");
    assert!(none().await, "nobody is told of a job that was forgotten");

    // who has many ends to tell does not hold up who has one
    let mut ids = Vec::new();
    for name in ["many", "many", "many", "one"] {
        let id = submit(engine, NewJob { tenant: tenant(name), ..told() }).await;
        engine.request_cancel(&tenant(name), id).await.expect("cancels");
        ids.push((tenant(name), id));
    }
    for (tenant, id) in &ids {
        let canceled =
            async || engine.list(tenant, ListQuery { limit: 8, ..ListQuery::default() }).await.expect("lists");
        let deadline = tokio::time::Instant::now() + PATIENCE;
        while !canceled().await.jobs.iter().any(|job| job.id == *id && job.state == State::Canceled) {
            assert!(tokio::time::Instant::now() < deadline, "the list is late");
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    }
    let taken = engine.take_notices(2, LONG).await.expect("takes");
    let whose: Vec<&str> = taken.iter().map(|notice| notice.tenant.name()).collect();
    assert_eq!(whose, ["many", "one"]);
    engine.take_notices(8, LONG).await.expect("takes");
    for (tenant, id) in &ids {
        engine.settle_notice(tenant, *id, 1, None).await.expect("settles");
    }
}

async fn collect(engine: &Arc<dyn Engine>, id: JobId, after: Option<u64>) -> Vec<Event> {
    let stream = follow(engine.clone(), &own(), id, after).await.expect("follows").expect("is there");
    let all = stream.map(|event| Event::clone(&event.expect("reads"))).collect::<Vec<_>>();
    tokio::time::timeout(PATIENCE, all).await.expect("the stream ends with the job")
}

async fn a_reader_that_comes_back_misses_nothing(engine: &Arc<dyn Engine>) {
    let id = submit(engine, new_job()).await;
    let live = tokio::spawn({
        let engine = engine.clone();
        async move { collect(&engine, id, Some(0)).await }
    });
    let claim = claim_one(engine, "a").await;
    for i in 0..100 {
        engine.renew(&claim, vec![progress(i as f32 / 100.0)]).await.expect("renews");
    }
    engine.finish(&claim, success("aa")).await.expect("finishes");

    let live = live.await.expect("no panic");
    let numbers: Vec<u64> = live.iter().map(|e| e.seq).collect();
    assert_eq!(numbers, (1..=numbers.len() as u64).collect::<Vec<_>>(), "numbered from 1 without a gap");
    assert_eq!(live.len(), 104, "queued, running, 100 times progress, succeeded, done");
    assert_eq!(live.last().map(|e| e.kind), Some(EventKind::Done));
    for after in [0, 1, 50, 103] {
        let rest = collect(engine, id, Some(after)).await;
        assert_eq!(rest, live[after as usize..], "after {after}");
    }
    assert_eq!(collect(engine, id, Some(104)).await, [], "nothing comes after the end");
    let fresh = collect(engine, id, None).await;
    assert_eq!(fresh.iter().map(|e| e.kind).collect::<Vec<_>>(), [EventKind::Snapshot, EventKind::Done]);
    assert_eq!(fresh[0].data["state"], "succeeded");
    let ahead = collect(engine, id, Some(9999)).await;
    assert_eq!(ahead[0].kind, EventKind::Snapshot, "a number that was never given out starts over");
    assert!(follow(engine.clone(), &own(), JobId::new(), None).await.expect("answers").is_none());
}

async fn a_reader_that_comes_too_late_goes_on_from_a_snapshot(engine: &Arc<dyn Engine>) {
    const AT_ONCE: u64 = 50;
    let id = submit(engine, new_job()).await;
    let claim = claim_one(engine, "a").await;
    let tell = async |events: u64| {
        let news = (0..events).map(|i| progress(i as f32 / events as f32)).collect();
        assert_eq!(engine.renew(&claim, news).await.expect("renews"), Renewal::Keep);
    };
    for _ in 0..MANY_EVENTS / AT_ONCE {
        tell(AT_ONCE).await;
    }
    let page = engine.events_after(&own(), id, 1, 1).await.expect("reads").expect("is there");
    let (oldest, newest) = (page.oldest, page.newest);
    assert_eq!(newest, 2 + MANY_EVENTS, "queued, running, and the progress");
    assert!(oldest > 2, "{oldest}: old events are let go");
    let mut readers = Vec::new();
    for after in [1, oldest - 2, oldest - 1] {
        let events = follow(engine.clone(), &own(), id, Some(after)).await.expect("follows").expect("is there");
        let mut events = events.map(|event| Event::clone(&event.expect("reads")));
        let first = tokio::time::timeout(PATIENCE, events.next()).await.expect("in time").expect("an event");
        if after < oldest - 1 {
            assert_eq!((first.kind, first.seq), (EventKind::Snapshot, newest), "after {after}");
            assert_eq!(first.data["state"], "running");
        } else {
            assert_eq!((first.kind, first.seq), (EventKind::Progress, oldest), "what is kept is told as it was");
        }
        readers.push((first.seq, events));
    }
    tell(3).await;
    engine.finish(&claim, success("aa")).await.expect("finishes");
    let done = newest + 5;
    for (first, events) in readers {
        let rest = tokio::time::timeout(PATIENCE, events.collect::<Vec<_>>()).await.expect("ends with the job");
        let numbers: Vec<u64> = rest.iter().map(|event| event.seq).collect();
        assert_eq!(numbers, (first + 1..=done).collect::<Vec<_>>(), "without a gap");
        assert_eq!(rest.last().map(|event| event.kind), Some(EventKind::Done));
    }
    let after_the_end = collect(engine, id, Some(1)).await;
    let told: Vec<_> = after_the_end.iter().map(|event| (event.kind, event.seq)).collect();
    assert_eq!(told, [(EventKind::Snapshot, done - 1), (EventKind::Done, done)]);
}

async fn a_waiting_worker_gets_a_job_as_it_comes(engine: &Arc<dyn Engine>) {
    let waiting = tokio::spawn({
        let engine = engine.clone();
        async move { claim_one(&engine, "a").await }
    });
    tokio::task::yield_now().await;
    let id = submit(engine, new_job()).await;
    let claim = tokio::time::timeout(PATIENCE, waiting).await.expect("in time").expect("no panic");
    assert_eq!(claim.id, id);
    engine.finish(&claim, Outcome::Canceled).await.expect("finishes");
}

async fn lists_are_newest_first_paged_and_filtered(engine: &Arc<dyn Engine>) {
    let mut ids = Vec::new();
    for i in 0..5 {
        ids.push(submit(engine, labeled("list", if i % 2 == 0 { "even" } else { "odd" })).await);
    }
    ids.reverse();
    engine.request_cancel(&own(), ids[0]).await.expect("cancels");
    let list = async |query: ListQuery| {
        let page = engine.list(&own(), query).await.expect("lists");
        (page.jobs.iter().map(|j| j.id).collect::<Vec<_>>(), page.more)
    };
    let query = ListQuery { limit: 3, ..ListQuery::default() };
    assert_eq!(list(query.clone()).await, (ids[..3].to_vec(), true));
    let next = ListQuery { before: Some(ids[2]), limit: 2, ..ListQuery::default() };
    assert_eq!(list(next).await, (ids[3..].to_vec(), true), "older jobs of the suite follow");
    let odd = ListQuery { labels: vec![("list".to_owned(), "odd".to_owned())], ..query.clone() };
    assert_eq!(list(odd).await, (vec![ids[1], ids[3]], false));
    let queued = ListQuery {
        labels: vec![("list".to_owned(), "even".to_owned())],
        states: vec![State::Queued, State::Running],
        ..query.clone()
    };
    assert_eq!(list(queued).await, (vec![ids[2], ids[4]], false));
    let job = engine.get(&own(), ids[0]).await.expect("reads").expect("is there");
    let older = ListQuery { created_to: Some(job.created_at), created_from: Some(job.created_at), ..query };
    assert_eq!(list(older).await, (Vec::new(), false), "from is included, to is not");
    for id in &ids[1..] {
        engine.request_cancel(&own(), *id).await.expect("cancels");
    }
}

async fn only_an_ended_job_is_forgotten(engine: &Arc<dyn Engine>) {
    let mut ids = Vec::new();
    for _ in 0..2 {
        ids.push(submit(engine, new_job()).await);
        let claim = claim_one(engine, "a").await;
        assert_eq!(engine.forget(&own(), claim.id).await.expect("answers"), Forgotten::Running);
        engine.finish(&claim, success("shared")).await.expect("finishes");
    }
    assert_eq!(
        engine.forget(&own(), ids[0]).await.expect("forgets"),
        Forgotten::Gone(Vec::new()),
        "the other job names it too"
    );
    assert_eq!(engine.forget(&own(), ids[1]).await.expect("forgets"), Forgotten::Gone(vec!["shared".to_owned()]));
    assert_eq!(engine.forget(&own(), ids[1]).await.expect("answers"), Forgotten::Unknown);
    assert_eq!(engine.get(&own(), ids[1]).await.expect("reads"), None);
}

async fn a_surface_is_kept_for_the_jobs_that_begin_from_it(engine: &Arc<dyn Engine>) {
    let surface = BlobId::of(b"surface");
    let earlier = submit(engine, new_job()).await;
    let claim = claim_one(engine, "a").await;
    engine.finish(&claim, success(&surface.hex())).await.expect("finishes");
    let mut job = new_job();
    let Work::Shrink(work) = &mut job.spec.work else { panic!("{:?}", job.spec) };
    work.warm_start = Some(WarmStartSpec { job: earlier, surface: Some(surface) });
    let later = submit(engine, job.clone()).await;
    assert_eq!(engine.spec(&own(), later).await.expect("reads"), Some(job.spec.clone()));
    let gone = engine.forget(&own(), earlier).await.expect("forgets");
    assert_eq!(gone, Forgotten::Gone(Vec::new()), "a job that waits begins from it");
    let claim = claim_one(engine, "a").await;
    assert_eq!(claim.spec, job.spec, "the worker is told which blob");
    engine.finish(&claim, success("other")).await.expect("finishes");
    assert_eq!(
        engine.get(&own(), later).await.expect("reads").expect("is there").outputs.len(),
        1,
        "it is no output of its own"
    );
    let gone = engine.forget(&own(), later).await.expect("forgets");
    assert_eq!(gone, Forgotten::Gone(vec!["other".to_owned(), surface.hex()]));
}

async fn another_tenants_job_is_not_there(engine: &Arc<dyn Engine>) {
    // one name that only a dot tells from the other, and one that is the beginning of another
    for (owner, stranger) in [("team.a", "team-a"), ("team", "team.b"), ("default", "other"), ("other", "default")] {
        let (owner, stranger) = (tenant(owner), tenant(stranger));
        let input = BlobId::of(owner.name().as_bytes());
        let request = json!({"field": {"input": input.to_string()}, "labels": {"whose": owner.name()}});
        let spec = JobSpec::from_value(&request).unwrap_or_else(|faults| panic!("refused: {faults:?}"));
        let id = submit(engine, NewJob { tenant: owner.clone(), id: JobId::new(), spec, vertices: 0, key: None }).await;
        let (mut heard, mut not_heard) = (engine.changes(&owner, id), engine.changes(&stranger, id));
        let unseen = async || {
            assert_eq!(engine.get(&stranger, id).await.expect("answers"), None);
            assert_eq!(engine.spec(&stranger, id).await.expect("answers"), None);
            assert_eq!(engine.events_after(&stranger, id, 0, 10).await.expect("answers"), None);
            assert!(follow(engine.clone(), &stranger, id, Some(0)).await.expect("answers").is_none());
            assert_eq!(engine.request_cancel(&stranger, id).await.expect("answers"), None);
            assert_eq!(engine.forget(&stranger, id).await.expect("answers"), Forgotten::Unknown);
            for query in [
                ListQuery { limit: 100, ..ListQuery::default() },
                ListQuery {
                    labels: vec![("whose".to_owned(), owner.name().to_owned())],
                    limit: 9,
                    ..ListQuery::default()
                },
            ] {
                let page = engine.list(&stranger, query).await.expect("lists");
                assert!(page.jobs.iter().all(|job| job.id != id), "{stranger} lists a job of {owner}");
            }
            let blobs = vec![input.hex()];
            let unnamed = engine.unnamed(Some(&stranger), blobs.clone(), None).await.expect("answers");
            assert_eq!(unnamed, blobs, "{stranger} names nothing");
            assert!(engine.unnamed(Some(&owner), blobs, None).await.expect("answers").is_empty());
        };
        unseen().await;
        let claim = claim_one(engine, "a").await;
        assert_eq!((&claim.tenant, claim.id), (&owner, id), "the worker is told whose it is");
        unseen().await;
        assert_eq!(engine.renew(&claim, vec![progress(0.5)]).await.expect("renews"), Renewal::Keep);
        engine.finish(&claim, success(owner.name())).await.expect("finishes");
        unseen().await;
        let told = tokio::time::timeout(PATIENCE, heard.next()).await.expect("the owner hears");
        assert!(told.is_some());
        assert!(not_heard.0.try_recv().is_err(), "nobody else does");
        assert_eq!(engine.get(&owner, id).await.expect("reads").expect("is there").state, State::Succeeded);
        assert_eq!(engine.spec(&owner, id).await.expect("reads").expect("is there").labels["whose"], owner.name());
        assert_eq!(engine.forget(&owner, id).await.expect("forgets"), Forgotten::Gone(vec![owner.name().to_owned()]));
    }
}

async fn keys_and_labels_are_each_tenants_own(engine: &Arc<dyn Engine>) {
    let key = |fingerprint: &str| IdempotencyKey { key: "shared".to_owned(), fingerprint: fingerprint.to_owned() };
    let tenants = [tenant("default"), tenant("key-a"), tenant("key-b")];
    let mut jobs = Vec::new();
    for (i, owner) in tenants.iter().enumerate() {
        let fingerprint = format!("{i}");
        assert_eq!(engine.recall(owner, key(&fingerprint)).await.expect("answers"), None);
        let new = NewJob { tenant: owner.clone(), key: Some(key(&fingerprint)), ..labeled("shared", "label") };
        let Submitted::Created(job) = engine.submit(new.clone()).await.expect("submits") else {
            panic!("the key is new to {owner}")
        };
        assert_eq!(
            engine.submit(NewJob { id: JobId::new(), ..new }).await.expect("answers"),
            Submitted::Replayed(job.clone())
        );
        jobs.push(job);
    }
    for (i, owner) in tenants.iter().enumerate() {
        let replayed = engine.recall(owner, key(&format!("{i}"))).await.expect("answers");
        assert_eq!(replayed, Some(Submitted::Replayed(jobs[i].clone())));
        assert_eq!(engine.recall(owner, key("x")).await.expect("answers"), Some(Submitted::KeyConflict));
        let labels = vec![("shared".to_owned(), "label".to_owned())];
        let page = engine.list(owner, ListQuery { labels, limit: 5, ..ListQuery::default() }).await.expect("lists");
        assert_eq!(page.jobs.iter().map(|job| job.id).collect::<Vec<_>>(), [jobs[i].id]);
        engine.request_cancel(owner, jobs[i].id).await.expect("cancels");
    }
}

/// Other claims may have left jobs behind: what counts is the difference.
async fn what_there_is_to_do_is_counted(engine: &Arc<dyn Engine>) {
    let count = |depth: &Depth, state| {
        depth.open.iter().filter(|open| (open.0, open.1) == (JobKind::Shrink, state)).map(|open| open.2).sum::<u64>()
    };
    // whatever waits is taken away, so that the claim below is of this job
    for claim in engine.claim("a", 100, Duration::ZERO).await.expect("claims") {
        engine.finish(&claim, Outcome::Canceled).await.expect("finishes");
    }
    let before = engine.depth().await.expect("counts");
    assert_eq!((count(&before, State::Queued), before.oldest_queued), (0, None));
    let (first, second) = (submit(engine, new_job()).await, submit(engine, new_job()).await);
    let accepted = engine.get(&Tenant::default(), first).await.expect("reads").expect("is there").created_at;
    let queued = engine.depth().await.expect("counts");
    assert_eq!((count(&queued, State::Queued), queued.oldest_queued), (2, Some(accepted)));
    let claim = claim_one(engine, "a").await;
    assert_eq!(claim.id, first);
    let running = engine.depth().await.expect("counts");
    assert_eq!(count(&running, State::Queued), 1);
    assert_eq!(count(&running, State::Running), count(&before, State::Running) + 1);
    engine.finish(&claim, Outcome::Canceled).await.expect("finishes");
    engine.request_cancel(&Tenant::default(), second).await.expect("cancels");
    let after = engine.depth().await.expect("counts");
    assert_eq!((&after.open, after.oldest_queued, after.connected), (&before.open, None, true));
}

/// The suite's job of another tenant.
fn of(name: &str) -> NewJob {
    NewJob { tenant: tenant(name), ..new_job() }
}

async fn claim_tenants(engine: &Arc<dyn Engine>, slots: usize) -> Vec<Claim> {
    engine.claim("a", slots, Duration::ZERO).await.expect("claims")
}

async fn cancel_all(engine: &Arc<dyn Engine>, claims: impl IntoIterator<Item = Claim>) {
    for claim in claims {
        engine.finish(&claim, Outcome::Canceled).await.expect("finishes");
    }
}

async fn tenants_take_turns(engine: &Arc<dyn Engine>) {
    let mut ids = Vec::new();
    for _ in 0..8 {
        ids.push(submit(engine, of("many")).await);
    }
    let running = claim_one(engine, "a").await;
    assert_eq!(running.id, ids[0]);
    let (one, other) = (submit(engine, of("one")).await, submit(engine, of("other")).await);
    let names = |claims: &[Claim]| claims.iter().map(|claim| claim.tenant.name().to_owned()).collect::<Vec<_>>();
    // neither waits behind the many, of which one runs already
    let next = claim_tenants(engine, 2).await;
    assert_eq!(next.iter().map(|claim| claim.id).collect::<Vec<_>>(), [one, other], "{:?}", names(&next));
    // what comes back was first before
    engine.finish(&running, Outcome::Released).await.expect("gives back");
    cancel_all(engine, next).await;
    // one slot: one after the other, whoever has more
    for _ in 0..3 {
        submit(engine, of("one")).await;
    }
    let mut order = Vec::new();
    for _ in 0..6 {
        let claims = claim_tenants(engine, 1).await;
        order.extend(names(&claims));
        cancel_all(engine, claims).await;
    }
    assert!(order.windows(2).all(|pair| pair[0] != pair[1]), "{order:?}");
    // several slots at once are shared
    for _ in 0..3 {
        submit(engine, of("one")).await;
    }
    let claims = claim_tenants(engine, 4).await;
    assert_eq!(claims.iter().filter(|claim| claim.tenant == tenant("one")).count(), 2, "{:?}", names(&claims));
    cancel_all(engine, claims).await;
    cancel_all(engine, claim_tenants(engine, 100).await).await;
}

async fn what_a_tenant_has_at_once_is_limited(engine: &Arc<dyn Engine>) {
    let key = IdempotencyKey { key: "limited".to_owned(), fingerprint: "f".to_owned() };
    let keyed = || NewJob { key: Some(key.clone()), ..of("jobs") };
    submit(engine, keyed()).await;
    submit(engine, of("jobs")).await;
    let refused = engine.submit(of("jobs")).await.expect("answers");
    let Submitted::OverQuota(over) = refused else { panic!("expected to be over a quota, found {refused:?}") };
    assert_eq!((over.quota, over.limit, over.left, over.window), ("queued", 2, 0, None));
    let again = engine.submit(keyed()).await.expect("answers");
    assert!(matches!(again, Submitted::Replayed(_)), "what was accepted is answered: {again:?}");
    submit(engine, of("free")).await;
    let claims = claim_tenants(engine, 10).await;
    let of_jobs = |claims: &[Claim]| claims.iter().filter(|claim| claim.tenant == tenant("jobs")).count();
    assert_eq!((claims.len(), of_jobs(&claims)), (2, 1), "one at once, and others are not held up");
    assert!(claim_tenants(engine, 10).await.is_empty());
    submit(engine, of("jobs")).await;
    cancel_all(engine, claims).await;
    for _ in 0..2 {
        let claims = claim_tenants(engine, 10).await;
        assert_eq!(of_jobs(&claims), 1);
        cancel_all(engine, claims).await;
    }
}

async fn what_a_tenants_jobs_cost_is_limited(engine: &Arc<dyn Engine>) {
    let over = async |new: NewJob| match engine.submit(new).await.expect("answers") {
        Submitted::OverQuota(over) => over,
        other => panic!("expected to be over a quota, found {other:?}"),
    };
    let expect = |over: Exceeded, quota, limit, left| {
        assert_eq!((over.quota, over.limit, over.left, over.window), (quota, limit, left, Some(HOUR)));
        assert!(over.retry_after > HOUR - 2 * PATIENCE && over.retry_after <= HOUR, "{over:?}");
    };
    let asking = |vertices| NewJob { vertices, ..of("vertices") };
    let id = submit(engine, asking(60)).await;
    expect(over(asking(41)).await, "vertices_per_hour", 100, 40);
    submit(engine, asking(40)).await;
    // what was asked for counts, also when it is forgotten
    engine.request_cancel(&tenant("vertices"), id).await.expect("cancels");
    assert_eq!(engine.forget(&tenant("vertices"), id).await.expect("forgets"), Forgotten::Gone(Vec::new()));
    expect(over(asking(1)).await, "vertices_per_hour", 100, 0);
    submit(engine, asking(0)).await;
    cancel_all(engine, claim_tenants(engine, 10).await).await;

    let id = submit(engine, of("seconds")).await;
    let claim = claim_one(engine, "a").await;
    assert_eq!(claim.id, id);
    tokio::time::sleep(Duration::from_millis(20)).await;
    // what runs counts once it stops
    submit(engine, of("seconds")).await;
    engine.finish(&claim, success("aa")).await.expect("finishes");
    expect(over(of("seconds")).await, "seconds_per_hour", 1, 0);
    cancel_all(engine, claim_tenants(engine, 10).await).await;
}

async fn a_full_queue_takes_no_more(engine: &Arc<dyn Engine>) {
    let mut ids = Vec::new();
    for i in 0..QUEUE {
        ids.push((i, submit(engine, of(if i % 2 == 0 { "even" } else { "odd" })).await));
    }
    assert_eq!(engine.submit(of("even")).await.expect("answers"), Submitted::QueueFull);
    assert_eq!(engine.submit(of("another")).await.expect("answers"), Submitted::QueueFull);
    cancel_all(engine, claim_tenants(engine, 1).await).await;
    submit(engine, of("another")).await;
    cancel_all(engine, claim_tenants(engine, 100).await).await;
}
