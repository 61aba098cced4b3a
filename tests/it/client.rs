//! The client in `examples/client`, through faults.

use crate::app::{App, endless, small};
use futures::StreamExt;
use serde_json::json;
use shrinkd::{Client, Error};

#[allow(dead_code, reason = "not every part of it is needed here")]
#[path = "../../examples/client/shrinkd.rs"]
mod shrinkd;

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_client_follows_a_job_over_the_death_of_the_service_and_downloads_it_whole() {
    let folder = tempfile::tempdir().expect("folder");
    let app = App::start(folder.path());
    let address = app.url.trim_start_matches("http://").to_owned();
    let client = Client::new(&app.url, None);
    let mut job = small();
    job["shrink"]["lattice"] = json!({"latlong": {"n_theta": 256, "n_phi": 128}});
    let accepted = client.submit(&job, "once").await.expect("is accepted");
    let id = accepted["id"].as_str().expect("a name").to_owned();
    assert_eq!(client.submit(&job, "once").await.expect("is answered")["id"], accepted["id"], "one key, one job");
    let mut events = Box::pin(client.follow(&id, None));
    let first = events.next().await.expect("an event").expect("is told");
    assert_eq!(first.kind, "snapshot");
    app.kill();
    let _app = App::start_at(folder.path(), &address, &[]);
    let (mut last, mut kinds) = (first.seq, Vec::new());
    while let Some(event) = events.next().await {
        let event = event.expect("is told");
        assert_eq!(event.seq, last + 1, "none is missed, and none comes twice");
        last = event.seq;
        kinds.push(event.kind);
    }
    assert_eq!(kinds.last().map(String::as_str), Some("done"));
    let mut rest = Box::pin(client.follow(&id, Some(last)));
    assert!(rest.next().await.is_none(), "who has seen everything is told nothing more");
    let job = client.succeeded(&id).await.expect("has succeeded");
    let glb = client.download(&job, "glb").await.expect("is there");
    assert_eq!(
        (&glb[..4], glb.len() as u64),
        (b"glTF".as_slice(), job["outputs"][0]["bytes"].as_u64().expect("a number"))
    );
}

#[tokio::test]
async fn the_client_says_what_the_service_says() {
    let folder = tempfile::tempdir().expect("folder");
    let app = App::start(folder.path());
    let client = Client::new(&app.url, None);
    let wrong =
        client.submit(&json!({"field": {"scene": {"sphere": {"radios": 1}}}}), "k").await.expect_err("is refused");
    assert!(matches!(&wrong, Error::Problem { status: 422, code, .. } if code == "invalid_request"), "{wrong:?}");
    assert!(wrong.to_string().contains("/field/scene/sphere/radios"), "{wrong}");
    let job = client.submit(&endless(), "endless").await.expect("is accepted");
    let id = job["id"].as_str().expect("a name");
    client.cancel(id).await.expect("is asked to stop");
    let ended = client.succeeded(id).await.expect_err("was canceled");
    assert!(ended.to_string().contains("canceled"), "{ended}");
    let torus = client.submit(&json!({"field": {"scene": {"torus": {"major": 0.5, "minor": 0.2}}}}), "torus").await;
    let failed = client.succeeded(torus.expect("is accepted")["id"].as_str().expect("a name")).await;
    assert!(failed.expect_err("is no sphere").to_string().contains("genus"));
}
