//! Several nodes on one server.

use super::*;
use crate::engine::follow;
use crate::job::{Event, EventKind, Failure, Output};
use futures::StreamExt;
use serde_json::json;

fn news(i: u32) -> Vec<Update> {
    vec![Update { kind: EventKind::Progress, data: json!({ "iteration": i }), progress: None }]
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
    Outcome::Succeeded { outputs: vec![output], metrics: json!({}) }
}

async fn all_events(engine: &Arc<NatsEngine>, id: JobId) -> Vec<Event> {
    let stream = follow(engine.clone(), &own(), id, Some(0)).await.expect("follows").expect("is there");
    let all = stream.map(|event| Event::clone(&event.expect("reads"))).collect::<Vec<_>>();
    tokio::time::timeout(PATIENCE, all).await.expect("the stream ends with the job")
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn events_are_the_same_on_every_node_also_on_one_that_joins_late() {
    let Some(cluster) = Cluster::start() else { return };
    let (a, b) = (cluster.node(calm()).await, cluster.node(calm()).await);
    let id = submit(&a).await;
    let live_on_b = tokio::spawn({
        let b = b.clone();
        async move { all_events(&b, id).await }
    });
    let claim = claim(&a).await;
    for i in 0..40 {
        a.renew(&claim, news(i)).await.expect("renews");
    }
    let in_the_middle = cluster.node(calm()).await;
    let live_on_late = tokio::spawn({
        let late = in_the_middle.clone();
        async move { all_events(&late, id).await }
    });
    for i in 40..80 {
        a.renew(&claim, [news(i), news(i)].concat()).await.expect("renews");
    }
    a.finish(&claim, success("aa")).await.expect("finishes");
    let on_a = all_events(&a, id).await;
    let numbers: Vec<u64> = on_a.iter().map(|e| e.seq).collect();
    assert_eq!(numbers, (1..=124).collect::<Vec<_>>(), "numbered from 1 without a gap");
    assert_eq!(live_on_b.await.expect("no panic"), on_a);
    assert_eq!(live_on_late.await.expect("no panic"), on_a);
    let at_the_end = cluster.node(calm()).await;
    assert_eq!(all_events(&at_the_end, id).await, on_a);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_job_is_seen_on_every_node_as_soon_as_it_is_accepted() {
    let Some(cluster) = Cluster::start() else { return };
    let (a, b) = (cluster.node(calm()).await, cluster.node(calm()).await);
    for _ in 0..20 {
        let id = submit(&a).await;
        assert_eq!(job(&b, id).await.state, State::Queued);
        let page = b.events_after(&own(), id, 0, 10).await.expect("reads").expect("is there");
        assert_eq!(page.newest, 1);
        let newest = ListQuery { limit: 1, ..ListQuery::default() };
        let listed = a.list(&own(), newest.clone()).await.expect("lists");
        assert_eq!(listed.jobs[0].id, id, "the node that accepted it lists it at once");
        eventually("the other node lists it, too", async || {
            let listed = b.list(&own(), newest.clone()).await.expect("lists");
            (listed.jobs.first().map(|job| job.id) == Some(id)).then_some(())
        })
        .await;
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_cancel_on_one_node_stops_a_worker_on_another() {
    let Some(cluster) = Cluster::start() else { return };
    let (a, b) = (cluster.node(calm()).await, cluster.node(calm()).await);
    let id = submit(&b).await;
    let claim = claim(&a).await;
    let told = tokio::spawn({
        let (a, claim) = (a.clone(), claim.clone());
        async move { a.interrupted(&claim).await }
    });
    let canceling = b.request_cancel(&own(), id).await.expect("cancels").expect("is there");
    assert_eq!(canceling.state, State::Canceling);
    let told = tokio::time::timeout(PATIENCE, told).await.expect("in time").expect("no panic");
    assert_eq!(told, Renewal::CancelRequested);
    a.finish(&claim, Outcome::Canceled).await.expect("finishes");
    assert_eq!(job(&b, id).await.state, State::Canceled);
    assert_eq!(all_events(&b, id).await, all_events(&a, id).await);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn fifty_clients_with_one_key_on_three_nodes_make_one_job() {
    let Some(cluster) = Cluster::start() else { return };
    let nodes = [cluster.node(calm()).await, cluster.node(calm()).await, cluster.node(calm()).await];
    let clients = (0..50).map(|i| {
        let node = nodes[i % 3].clone();
        let key = Some(IdempotencyKey { key: "the same".to_owned(), fingerprint: "one".to_owned() });
        tokio::spawn(async move { node.submit(NewJob { key, ..conformance::new_job() }).await.expect("submits") })
    });
    let (mut created, mut answers) = (0, Vec::new());
    for client in clients.collect::<Vec<_>>() {
        match client.await.expect("no panic") {
            Submitted::Created(job) => {
                created += 1;
                answers.push(job);
            }
            Submitted::Replayed(job) => answers.push(job),
            other => panic!("a repetition is answered with the job, found {other:?}"),
        }
    }
    assert_eq!(created, 1, "one key, one job");
    assert!(answers.windows(2).all(|w| w[0] == w[1]), "every answer is the same");
    let claims = nodes[1].claim("worker", 2, PATIENCE).await.expect("claims");
    assert_eq!(claims.iter().map(|c| c.id).collect::<Vec<_>>(), [answers[0].id]);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn nodes_share_the_jobs_and_none_is_run_twice() {
    let Some(cluster) = Cluster::start() else { return };
    let nodes = [cluster.node(calm()).await, cluster.node(calm()).await, cluster.node(calm()).await];
    let mut ids = Vec::new();
    for i in 0..30 {
        ids.push(submit(&nodes[i % 3]).await);
    }
    let workers = nodes.map(|node| {
        tokio::spawn(async move {
            let mut run = Vec::new();
            loop {
                let claims = node.claim("worker", 2, Duration::from_millis(500)).await.expect("claims");
                if claims.is_empty() {
                    return run;
                }
                for claim in claims {
                    assert_eq!(claim.attempt, 1);
                    node.finish(&claim, Outcome::failed(Failure::internal())).await.expect("finishes");
                    run.push(claim.id);
                }
            }
        })
    });
    let mut run = Vec::new();
    for worker in workers {
        run.extend(worker.await.expect("no panic"));
    }
    run.sort_unstable();
    assert_eq!(run, ids);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_blob_is_given_up_only_when_no_node_can_come_to_name_it() {
    let Some(cluster) = Cluster::start() else { return };
    let (a, b) = (cluster.node(calm()).await, cluster.node(calm()).await);
    let mut ended = Vec::new();
    for node in [&a, &b, &a] {
        ended.push(submit(node).await);
        let claim = claim(node).await;
        node.finish(&claim, success("shared")).await.expect("finishes");
    }
    assert_eq!(
        a.forget(&own(), ended[0]).await.expect("forgets"),
        Forgotten::Gone(vec![]),
        "jobs of both nodes name it"
    );
    let running = submit(&b).await;
    let claim = claim(&b).await;
    assert_eq!(b.forget(&own(), ended[1]).await.expect("forgets"), Forgotten::Gone(vec![]), "another job names it");
    assert_eq!(
        a.forget(&own(), ended[2]).await.expect("forgets"),
        Forgotten::Gone(vec![]),
        "a running job may make it"
    );
    b.finish(&claim, success("shared")).await.expect("finishes");
    assert_eq!(a.forget(&own(), running).await.expect("forgets"), Forgotten::Gone(vec!["shared".to_owned()]));
    for id in ended.into_iter().chain([running]) {
        assert_eq!(b.get(&own(), id).await.expect("reads"), None);
        assert_eq!(b.events_after(&own(), id, 0, 1).await.expect("reads"), None);
    }
    eventually("the other node lists nothing, too", async || {
        let listed = b.list(&own(), ListQuery { limit: 9, ..ListQuery::default() }).await.expect("lists");
        listed.jobs.is_empty().then_some(())
    })
    .await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_key_outlives_its_job() {
    let Some(cluster) = Cluster::start() else { return };
    let (a, b) = (cluster.node(calm()).await, cluster.node(calm()).await);
    let key = IdempotencyKey { key: "k".to_owned(), fingerprint: "one".to_owned() };
    let keyed = || NewJob { key: Some(key.clone()), ..conformance::new_job() };
    let Submitted::Created(job) = a.submit(keyed()).await.expect("submits") else { panic!("a new job") };
    a.request_cancel(&own(), job.id).await.expect("cancels");
    assert!(matches!(a.forget(&own(), job.id).await.expect("forgets"), Forgotten::Gone(_)));
    assert_eq!(b.submit(keyed()).await.expect("answers"), Submitted::Replayed(job.clone()));
    assert_eq!(b.recall(&own(), key).await.expect("answers"), Some(Submitted::Replayed(job)));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn services_with_different_prefixes_do_not_meet() {
    let Some(cluster) = Cluster::start() else { return };
    let a = cluster.node(calm()).await;
    let address = format!("{}?prefix=OTHER", cluster.server.url()).parse().expect("an address");
    let other = NatsEngine::open(&address, cluster.folder.path(), calm()).await.expect("opens");
    let id = submit(&a).await;
    assert_eq!(other.get(&own(), id).await.expect("reads"), None);
    assert!(other.claim("b", 1, Duration::from_millis(200)).await.expect("claims").is_empty());
    assert!(other.list(&own(), ListQuery { limit: 1, ..ListQuery::default() }).await.expect("lists").jobs.is_empty());
    assert_eq!(claim(&a).await.id, id);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_nobody_asks_for_any_more_is_tidied_up_and_nothing_else() {
    let Some(cluster) = Cluster::start() else { return };
    let a = cluster.node(calm()).await;
    let ledger = &a.node.ledger;
    let (open, ended, forgotten) = (submit(&a).await, submit(&a).await, submit(&a).await);
    let orphan = Name::new(&own(), JobId::new());
    ledger
        .link
        .store(&ledger.layout.specs, ledger.layout.spec(&orphan), "{}".into(), link::Expect::Any)
        .await
        .expect("stores");
    for id in [ended, forgotten] {
        a.request_cancel(&own(), id).await.expect("cancels");
    }
    a.forget(&own(), forgotten).await.expect("forgets");
    let before = all_events(&a, ended).await;
    assert_eq!(before.len(), 3, "queued, canceled, done");

    let later = |days: i64| jiff::Timestamp::now() + jiff::SignedDuration::from_hours(24 * days + 1);
    let entries = async |id| {
        let mut info = ledger
            .layout
            .jobs
            .info_builder()
            .subjects(ledger.layout.job(&Name::new(&own(), id)))
            .fetch()
            .await
            .expect("is there");
        info.next().await.map_or(0, |found| found.expect("reads").1)
    };
    housekeeping::tidy(ledger, later(0)).await.expect("tidies");
    assert_eq!((entries(open).await, entries(ended).await, entries(forgotten).await), (1, 2, 1), "it is too early");
    housekeeping::tidy(ledger, later(1)).await.expect("tidies");
    assert_eq!((entries(open).await, entries(ended).await, entries(forgotten).await), (1, 1, 1));
    housekeeping::tidy(ledger, later(2)).await.expect("tidies");
    assert_eq!((entries(open).await, entries(ended).await, entries(forgotten).await), (1, 1, 0));
    assert_eq!(ledger.request(&orphan).await.expect("reads"), None);
    assert!(
        a.spec(&own(), open).await.expect("reads").is_some() && a.spec(&own(), ended).await.expect("reads").is_some()
    );
    let after = all_events(&a, ended).await;
    assert_eq!(after.iter().map(|e| e.kind).collect::<Vec<_>>(), [EventKind::Snapshot, EventKind::Done]);
    assert_eq!(after.last(), before.last());
}
