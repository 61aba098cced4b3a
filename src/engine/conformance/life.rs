//! Jobs that are submitted, claimed, listed, counted and ended.

use super::super::{Depth, Engine, EngineError, IdempotencyKey, ListQuery, NewJob, Outcome, Renewal, Submitted};
use super::{PATIENCE, claim_one, labeled, new_job, own, progress, state, submit, success};
use crate::job::{Failure, JobId, JobKind, State};
use crate::tenant::Tenant;
use std::sync::Arc;
use std::time::Duration;

pub async fn a_job_lives_from_submit_to_its_end(engine: &Arc<dyn Engine>) {
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

pub async fn jobs_are_claimed_oldest_first_and_once(engine: &Arc<dyn Engine>) {
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

pub async fn a_key_makes_a_submit_repeatable(engine: &Arc<dyn Engine>) {
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

pub async fn a_queued_job_is_canceled_at_once(engine: &Arc<dyn Engine>) {
    let id = submit(engine, new_job()).await;
    let job = engine.request_cancel(&own(), id).await.expect("cancels").expect("is there");
    assert_eq!(job.state, State::Canceled);
    assert!(engine.claim("a", 1, Duration::ZERO).await.expect("claims").is_empty());
    let again = engine.request_cancel(&own(), id).await.expect("answers").expect("is there");
    assert_eq!(again, job, "cancelling what has ended changes nothing");
    assert_eq!(engine.request_cancel(&own(), JobId::new()).await.expect("answers"), None);
}

pub async fn a_running_job_is_told_to_stop(engine: &Arc<dyn Engine>) {
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

pub async fn a_waiting_worker_gets_a_job_as_it_comes(engine: &Arc<dyn Engine>) {
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

pub async fn lists_are_newest_first_paged_and_filtered(engine: &Arc<dyn Engine>) {
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

/// Other claims may have left jobs behind: what counts is the difference.
pub async fn what_there_is_to_do_is_counted(engine: &Arc<dyn Engine>) {
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
