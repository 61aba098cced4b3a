//! Ends that somebody is to be told.

use super::super::{DueNotice, Engine, ListQuery, NewJob};
use super::{PATIENCE, claim_one, new_job, own, submit, success, tenant};
use crate::job::{JobSpec, State};
use jiff::Timestamp;
use serde_json::json;
use std::sync::Arc;
use std::time::Duration;

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

pub async fn an_end_is_told_until_that_is_settled(engine: &Arc<dyn Engine>) {
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
