//! Tenants: apart, in turn, and within their quotas.

use super::super::{Claim, Engine, Forgotten, IdempotencyKey, ListQuery, NewJob, Outcome, Renewal, Submitted, follow};
use super::{PATIENCE, QUEUE, claim_one, labeled, new_job, progress, submit, success, tenant};
use crate::blobs::BlobId;
use crate::job::{JobId, JobSpec, State};
use crate::quota::{Exceeded, HOUR};
use serde_json::json;
use std::sync::Arc;
use std::time::Duration;

pub async fn another_tenants_job_is_not_there(engine: &Arc<dyn Engine>) {
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

pub async fn keys_and_labels_are_each_tenants_own(engine: &Arc<dyn Engine>) {
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

pub async fn tenants_take_turns(engine: &Arc<dyn Engine>) {
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

pub async fn what_a_tenant_has_at_once_is_limited(engine: &Arc<dyn Engine>) {
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

pub async fn what_a_tenants_jobs_cost_is_limited(engine: &Arc<dyn Engine>) {
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

pub async fn a_full_queue_takes_no_more(engine: &Arc<dyn Engine>) {
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
