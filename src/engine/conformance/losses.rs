//! Leases that are held, lost and given back.

use super::super::{Engine, EngineError, Outcome, Renewal};
use super::{LEASE, claim_one, new_job, own, progress, state, submit, success};
use crate::job::State;
use std::sync::Arc;
use std::time::Duration;

pub async fn a_worker_that_lost_its_lease_cannot_finish(engine: &Arc<dyn Engine>) {
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

pub async fn a_renewed_lease_holds(engine: &Arc<dyn Engine>) {
    submit(engine, new_job()).await;
    let claim = claim_one(engine, "a").await;
    for _ in 0..4 {
        tokio::time::sleep(LEASE / 3).await;
        assert_eq!(engine.renew(&claim, Vec::new()).await.expect("renews"), Renewal::Keep);
    }
    assert!(engine.claim("b", 1, Duration::ZERO).await.expect("claims").is_empty());
    engine.finish(&claim, Outcome::Canceled).await.expect("finishes");
}

pub async fn a_job_that_is_given_back_runs_again(engine: &Arc<dyn Engine>) {
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

pub async fn a_job_that_is_lost_too_often_fails(engine: &Arc<dyn Engine>) {
    let id = submit(engine, new_job()).await;
    for attempt in 1..=2 {
        assert_eq!(claim_one(engine, "doomed").await.attempt, attempt);
    }
    assert!(engine.claim("b", 1, LEASE * 2).await.expect("claims").is_empty());
    let job = engine.get(&own(), id).await.expect("reads").expect("is there");
    assert_eq!(job.state, State::Failed);
    assert_eq!(job.problem.map(|p| p.code).as_deref(), Some("attempts_exhausted"));
}
