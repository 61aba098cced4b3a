//! What a client of the service does, timed.

use crate::service::Outcome;
use futures::StreamExt;
use reqwest::{Client, StatusCode};
use serde_json::{Value, json};
use std::time::{Duration, Instant};

/// Longer than anything here takes.
const PATIENCE: Duration = Duration::from_secs(300);

/// A small scene: two balls that flow into each other, on a lattice of 1,026 vertices.
pub fn small(label: &str) -> Value {
    json!({
        "field": {"scene": {"smooth_union": {"k": 0.1, "of": [
            {"sphere": {"radius": 0.4}},
            {"translate": {"by": [0.35, 0.0, 0.2], "of": {"sphere": {"radius": 0.25}}}}]}}},
        "shrink": {"lattice": {"octahedral": {"n": 16}}},
        "outputs": ["glb"],
        "labels": {"load": label},
    })
}

/// A job that takes longer than any measurement: the paper's loop on the finest lattice.
pub fn endless(label: &str) -> Value {
    json!({
        "field": {"scene": {"ellipsoid": {"radii": [0.8, 0.6, 0.4]}}},
        "shrink": {"method": "paper", "lattice": {"latlong": {"n_theta": 2048, "n_phi": 1024}}},
        "labels": {"load": label},
    })
}

/// A training that takes longer than any measurement and keeps the memory that it has from its beginning.
pub fn training(mesh: &str) -> Value {
    json!({
        "kind": "fit",
        "meshes": [mesh],
        "fit": {"epochs": 10_000, "samples": 20_000},
        "labels": {"load": "followers"},
    })
}

/// Uploads a mesh, a tetrahedron; its name.
pub async fn upload(http: &Client, url: &str) -> Outcome<String> {
    const TETRAHEDRON: &str = "OFF\n4 4 6\n1 1 1\n1 -1 -1\n-1 1 -1\n-1 -1 1\n3 0 1 2\n3 0 3 1\n3 0 2 3\n3 1 3 2\n";
    let input: Value = http.post(format!("{url}/v1/inputs")).body(TETRAHEDRON).send().await?.json().await?;
    input["id"].as_str().map(str::to_owned).ok_or_else(|| format!("the mesh was not taken: {input}").into())
}

/// A client that keeps its connection.
pub fn client() -> Outcome<Client> {
    Ok(Client::builder().timeout(PATIENCE).build()?)
}

/// Waits until the service is ready.
pub async fn ready(url: &str) -> Outcome<()> {
    let (http, deadline) = (client()?, Instant::now() + Duration::from_secs(60));
    loop {
        if http.get(format!("{url}/readyz")).send().await.is_ok_and(|answer| answer.status().is_success()) {
            return Ok(());
        }
        if Instant::now() > deadline {
            return Err(format!("{url} does not become ready").into());
        }
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
}

/// Submits a job that must be accepted. Its id, and how long the answer took.
pub async fn submit(http: &Client, url: &str, request: &Value) -> Outcome<(String, Duration)> {
    let clock = Instant::now();
    let answer = http.post(format!("{url}/v1/jobs")).json(request).send().await?;
    let status = answer.status();
    let job: Value = answer.json().await?;
    if status != StatusCode::ACCEPTED {
        return Err(format!("a job was not accepted: {job}").into());
    }
    Ok((job["id"].as_str().unwrap_or_default().to_owned(), clock.elapsed()))
}

/// Follows a job's stream to its end, calling `frame` for every frame. Fails when the stream breaks off.
pub async fn follow(http: &Client, url: &str, id: &str, mut frame: impl FnMut()) -> Outcome<()> {
    let answer = http.get(format!("{url}/v1/jobs/{id}/events")).header("accept", "text/event-stream").send().await?;
    let mut stream = answer.error_for_status()?.bytes_stream();
    // a frame ends with an empty line, which may be cut in two
    let mut ended_line = false;
    while let Some(chunk) = stream.next().await {
        for byte in chunk? {
            if byte == b'\n' && ended_line {
                frame();
            }
            ended_line = byte == b'\n';
        }
    }
    Ok(())
}

/// The job as it is now.
pub async fn job(http: &Client, url: &str, id: &str) -> Outcome<Value> {
    Ok(http.get(format!("{url}/v1/jobs/{id}")).send().await?.error_for_status()?.json().await?)
}

/// Waits until a worker has the job.
pub async fn running(http: &Client, url: &str, id: &str) -> Outcome<()> {
    let deadline = Instant::now() + PATIENCE;
    while job(http, url, id).await?["state"] == "queued" {
        if Instant::now() > deadline {
            return Err(format!("no worker took job {id} up").into());
        }
        tokio::time::sleep(Duration::from_millis(50)).await;
    }
    Ok(())
}

/// Cancels a job.
pub async fn cancel(http: &Client, url: &str, id: &str) -> Outcome<()> {
    http.post(format!("{url}/v1/jobs/{id}/cancel")).send().await?.error_for_status()?;
    Ok(())
}

/// Downloads the GLB of a job that must have succeeded; its size.
pub async fn download(http: &Client, url: &str, id: &str) -> Outcome<usize> {
    let answer = http.get(format!("{url}/v1/jobs/{id}/outputs/glb")).send().await?;
    if !answer.status().is_success() {
        return Err(format!("no GLB of job {id}: {}", answer.text().await?).into());
    }
    Ok(answer.bytes().await?.len())
}

/// The value below which this share of the sorted times is, in milliseconds.
pub fn percentile(sorted: &[Duration], share: f64) -> f64 {
    let last = sorted.len().saturating_sub(1);
    let rank = (share * sorted.len() as f64).ceil() as usize;
    sorted.get(rank.saturating_sub(1).min(last)).map_or(f64::NAN, |time| time.as_secs_f64() * 1e3)
}
