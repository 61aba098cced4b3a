//! Events, and readers who come back for them.

use super::super::{Engine, Renewal, follow};
use super::{MANY_EVENTS, PATIENCE, claim_one, new_job, own, progress, submit, success};
use crate::job::{Event, EventKind, JobId};
use futures::StreamExt;
use std::sync::Arc;

async fn collect(engine: &Arc<dyn Engine>, id: JobId, after: Option<u64>) -> Vec<Event> {
    let stream = follow(engine.clone(), &own(), id, after).await.expect("follows").expect("is there");
    let all = stream.map(|event| Event::clone(&event.expect("reads"))).collect::<Vec<_>>();
    tokio::time::timeout(PATIENCE, all).await.expect("the stream ends with the job")
}

pub async fn a_reader_that_comes_back_misses_nothing(engine: &Arc<dyn Engine>) {
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

pub async fn a_reader_that_comes_too_late_goes_on_from_a_snapshot(engine: &Arc<dyn Engine>) {
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
