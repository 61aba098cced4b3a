//! Nodes and servers that die at the wrong moment.

use super::link::{Expect, Store};
use super::record::now;
use super::*;
use std::time::Instant;

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_job_of_a_dead_node_is_taken_up_by_another() {
    let Some(cluster) = Cluster::start() else { return };
    let (a, b) = (cluster.node(quick()).await, cluster.node(quick()).await);
    let id = submit(&a).await;
    let first = claim(&a).await;
    drop(a);
    let second = claim(&b).await;
    assert_eq!((second.id, second.attempt), (id, 2));
    let back = cluster.node(quick()).await;
    assert_eq!(back.renew(&first, Vec::new()).await.expect("answers"), Renewal::Lost);
    assert_eq!(back.interrupted(&first).await, Renewal::Lost);
    let late = back.finish(&first, Outcome::Canceled).await;
    assert!(matches!(late, Err(EngineError::Fenced { .. })), "{late:?}");
    b.finish(&second, Outcome::Canceled).await.expect("finishes");
    assert_eq!(job(&back, id).await.state, State::Canceled);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_worker_that_lives_keeps_its_job_whoever_watches() {
    let Some(cluster) = Cluster::start() else { return };
    let (a, b) = (cluster.node(quick()).await, cluster.node(quick()).await);
    submit(&a).await;
    let claim = claim(&a).await;
    for _ in 0..9 {
        tokio::time::sleep(conformance::LEASE / 3).await;
        assert_eq!(a.renew(&claim, Vec::new()).await.expect("renews"), Renewal::Keep);
    }
    assert!(b.claim("b", 1, Duration::ZERO).await.expect("claims").is_empty());
    a.finish(&claim, Outcome::Canceled).await.expect("finishes");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_job_whose_node_died_as_it_was_stored_is_claimed_by_any_other() {
    let Some(cluster) = Cluster::start() else { return };
    let (a, b) = (cluster.node(calm()).await, cluster.node(calm()).await);
    let new = conformance::new_job();
    a.node.ledger.create(&new, now()).await.expect("stores").expect("is new");
    drop(a);
    assert_eq!(claim(&b).await.id, new.id);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_submit_that_died_after_its_key_is_finished_by_its_repetition() {
    let Some(cluster) = Cluster::start() else { return };
    let (a, b) = (cluster.node(calm()).await, cluster.node(calm()).await);
    let key = IdempotencyKey { key: "k".to_owned(), fingerprint: "one".to_owned() };
    let keyed = || NewJob { key: Some(key.clone()), ..conformance::new_job() };
    let new = keyed();
    let dead = record::Draft::accepted(&new, now()).record.job;
    assert!(keys::reserve(&a.node.ledger, &own(), &key, dead.clone()).await.expect("stores").is_none());
    assert_eq!(b.recall(&own(), key.clone()).await.expect("answers"), None, "nothing was accepted yet");
    assert_eq!(b.submit(keyed()).await.expect("submits"), Submitted::Created(dead.clone()));
    assert_eq!(a.submit(keyed()).await.expect("submits"), Submitted::Replayed(dead.clone()));
    // the first one was only slow, and comes now: the very same job is there
    assert!(a.node.ledger.create(&new, dead.created_at).await.expect("stores").is_none());
    assert_eq!(claim(&a).await.id, dead.id);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_job_whose_request_cannot_be_read_fails_and_holds_nobody_up() {
    let Some(cluster) = Cluster::start() else { return };
    let a = cluster.node(calm()).await;
    let new = conformance::new_job();
    let draft = record::Draft::accepted(&new, now());
    a.node.ledger.write(&Name::new(&own(), new.id), draft, Expect::Nothing).await.expect("stores").expect("is new");
    let next = submit(&a).await;
    assert_eq!(claim(&a).await.id, next);
    let failed = job(&a, new.id).await;
    assert_eq!((failed.state, failed.problem.map(|p| p.code).as_deref()), (State::Failed, Some("internal")));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_job_claimed_for_a_worker_that_went_away_is_given_back() {
    let Some(cluster) = Cluster::start() else { return };
    let a = cluster.node(calm()).await;
    let waiting = tokio::spawn({
        let a = a.clone();
        async move { a.claim("gone", 1, PATIENCE).await }
    });
    tokio::time::sleep(Duration::from_millis(200)).await;
    waiting.abort();
    let id = submit(&a).await;
    let claim = claim(&a).await;
    assert_eq!(claim.id, id);
    assert_eq!(a.node.ledger.version(&Name::new(&own(), id)).await.expect("reads").expect("is there").record.losses, 0);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_message_whose_first_try_was_stored_after_all_is_told_from_one_that_came_too_late() {
    let Some(cluster) = Cluster::start() else { return };
    let a = cluster.node(calm()).await;
    let Ledger { link, layout, .. } = &*a.node.ledger;
    let (subject, x) = (layout.job(&Name::new(&own(), JobId::new())), bytes::Bytes::from_static(b"x"));
    let store = async |expect, id, is_repetition| {
        link.store_once(&layout.jobs, &subject, &x, expect, id, is_repetition)
            .await
            .expect("answers")
            .expect("is known")
    };
    let Store::Done(first) = store(Expect::Nothing, "first", false).await else { panic!("is stored") };
    let Store::Done(second) = store(Expect::Newest(first), "second", false).await else { panic!("is stored") };
    assert!(second > first);
    // also when another message follows by now
    assert_eq!(store(Expect::Nothing, "first", true).await, Store::Done(first));
    assert_eq!(store(Expect::Newest(first), "second", true).await, Store::Done(second));
    assert_eq!(store(Expect::Newest(first), "third", true).await, Store::Conflict);
    assert_eq!(store(Expect::Nothing, "third", true).await, Store::Conflict);
    assert_eq!(store(Expect::Newest(first), "third", false).await, Store::Conflict);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_killed_server_loses_nothing_that_was_accepted() {
    let Some(mut cluster) = Cluster::start() else { return };
    // leases shorter than the interruption would be lost without anybody's fault
    let terms = Terms { lease: Duration::from_secs(6), ..quick() };
    let (a, b) = (cluster.node(terms.clone()).await, cluster.node(terms).await);
    let running = submit(&a).await;
    let held = claim(&a).await;
    let stop = tokio_util::sync::CancellationToken::new();
    let submitting = tokio::spawn({
        let (a, stop) = (a.clone(), stop.clone());
        async move {
            let mut accepted = Vec::new();
            while !stop.is_cancelled() {
                // an error is no promise, and may be one all the same
                if let Ok(Submitted::Created(job)) = a.submit(conformance::new_job()).await {
                    accepted.push(job.id);
                }
            }
            accepted
        }
    });
    tokio::time::sleep(Duration::from_millis(300)).await;
    for _ in 0..2 {
        cluster.server.kill();
        tokio::time::sleep(Duration::from_millis(500)).await;
        cluster.server.restart();
        assert_eq!(a.renew(&held, Vec::new()).await.expect("renews"), Renewal::Keep);
        tokio::time::sleep(Duration::from_millis(500)).await;
    }
    stop.cancel();
    let accepted = submitting.await.expect("no panic");
    assert!(accepted.len() > 10, "{} jobs were accepted", accepted.len());
    b.finish(&held, Outcome::Canceled).await.expect("the claim outlived it");
    assert_eq!(job(&b, running).await.state, State::Canceled);

    let mut run = Vec::new();
    while run.len() < accepted.len() {
        let claims = b.claim("b", 16, PATIENCE).await.expect("claims");
        assert!(!claims.is_empty(), "{} of {} jobs came", run.len(), accepted.len());
        for claim in claims {
            assert_eq!(claim.attempt, 1);
            b.finish(&claim, Outcome::Canceled).await.expect("finishes");
            if accepted.contains(&claim.id) {
                run.push(claim.id);
            }
        }
    }
    run.sort_unstable();
    assert_eq!(run, accepted, "each once");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn calls_end_in_time_while_the_server_is_away_and_work_when_it_is_back() {
    let Some(mut cluster) = Cluster::start() else { return };
    let a = cluster.node(calm()).await;
    let id = submit(&a).await;
    a.health().await.expect("healthy");
    cluster.server.kill();
    let began = Instant::now();
    eventually("it is noticed", async || a.health().await.err()).await;
    assert!(began.elapsed() < HEALTH * 2, "health took {:?}", began.elapsed());
    let began = Instant::now();
    let own = own();
    let (submitted, read, claimed) =
        tokio::join!(a.submit(conformance::new_job()), a.get(&own, id), a.claim("a", 1, Duration::ZERO));
    assert!(matches!(submitted, Err(EngineError::Store(_))), "{submitted:?}");
    assert!(matches!(read, Err(EngineError::Store(_))), "{read:?}");
    assert!(claimed.is_err() || claimed.is_ok_and(|claims| claims.is_empty()));
    assert!(began.elapsed() < link::CALL * 2 + Duration::from_secs(2), "the calls took {:?}", began.elapsed());
    assert_eq!(a.list(&own, ListQuery { limit: 5, ..ListQuery::default() }).await.expect("lists").jobs.len(), 1);
    cluster.server.restart();
    eventually("it is healthy again", async || a.health().await.ok()).await;
    assert_eq!(claim(&a).await.attempt, 1);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_cluster_of_three_keeps_every_promise_and_goes_on_without_one_of_them() {
    let Some(mut servers) = NatsServer::start_three() else { return };
    let folder = tempfile::tempdir().expect("folder");
    let hosts = servers.each_ref().map(|server| server.url().trim_start_matches("nats://").to_owned()).join(",");
    let address: Address = format!("nats://{hosts}?replicas=3").parse().expect("an address");
    let open = async |terms: Terms| {
        let open = async || NatsEngine::open(&address, folder.path(), terms.clone()).await.ok();
        eventually("the servers agree", open).await
    };
    let (a, b) = (Arc::new(open(quick()).await), open(quick()).await);
    conformance::run(a.clone()).await;
    let terms_outlive_an_election = open(Terms { lease: Duration::from_secs(20), ..quick() }).await;
    let id = submit(&a).await;
    let held = claim(&terms_outlive_an_election).await;
    let info = a.node.ledger.layout.jobs.get_info().await.expect("is there");
    let leader = info.cluster.and_then(|cluster| cluster.leader).expect("has a leader");
    let leader: usize = leader.trim_start_matches('n').parse().expect("is one of ours");
    servers[leader].kill();
    let mut others = Vec::new();
    for _ in 0..10 {
        // an error is no promise: a client would repeat it
        others.push(
            eventually("jobs are accepted", async || match a.submit(conformance::new_job()).await {
                Ok(Submitted::Created(job)) => Some(job.id),
                _ => None,
            })
            .await,
        );
    }
    let finished =
        eventually("it is finished", async || match terms_outlive_an_election.finish(&held, Outcome::Canceled).await {
            Ok(()) | Err(EngineError::Fenced { .. }) => Some(()),
            Err(_) => None,
        });
    finished.await;
    let ended = job(&b, id).await;
    assert_eq!((ended.state, ended.attempt), (State::Canceled, 1));
    let mut waiting = others.clone();
    while !waiting.is_empty() {
        for claim in b.claim("b", 4, PATIENCE).await.unwrap_or_default() {
            eventually("it is finished", async || match b.finish(&claim, Outcome::Canceled).await {
                Ok(()) | Err(EngineError::Fenced { .. }) => Some(()),
                Err(_) => None,
            })
            .await;
            waiting.retain(|id| *id != claim.id);
        }
    }
    servers[leader].restart();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_job_that_somebody_removed_from_the_stream_holds_nobody_up() {
    let Some(cluster) = Cluster::start() else { return };
    let a = cluster.node(calm()).await;
    let gone = submit(&a).await;
    let subject = a.node.ledger.layout.job(&Name::new(&own(), gone));
    a.node.ledger.layout.jobs.purge().filter(subject).await.expect("purges");
    let next = submit(&a).await;
    assert_eq!(claim(&a).await.id, next);
    assert_eq!(a.depth().await.expect("counts").oldest_queued, None);
}
