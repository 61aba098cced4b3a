//! Submits a job, waits for its end and saves what it made. Needs: cargo add serde_json; cargo add reqwest --features blocking,json

use reqwest::blocking::{Client, RequestBuilder, Response};
use serde_json::{Value, json};
use std::error::Error;

fn answer(request: RequestBuilder) -> Result<Response, Box<dyn Error>> {
    let answer = request.bearer_auth(std::env::var("SHRINKD_KEY")?).send()?;
    if answer.status().is_success() { Ok(answer) } else { Err(answer.text()?.into()) }
}

fn main() -> Result<(), Box<dyn Error>> {
    let base = "http://127.0.0.1:8080";
    let client = Client::new();
    let file = std::fs::read("blob.safetensors")?;
    let described: Value = answer(client.post(format!("{base}/v1/inputs")).body(file))?.json()?;
    let input = described["id"].as_str().ok_or("no id")?;
    let request = json!({
        "field": {
            "input": input,
            "latent_row": 1
        },
        "shrink": {
            "lattice": {
                "octahedral": {
                    "n": 24
                }
            },
            "relax_uv": true
        },
        "labels": {
            "name": "blob"
        }
    });
    let mut job: Value = answer(client.post(format!("{base}/v1/jobs")).json(&request))?.json()?;
    let id = job["id"].as_str().ok_or("no id")?.to_owned();
    while !["succeeded", "failed", "canceled"].contains(&job["state"].as_str().unwrap_or_default()) {
        job = answer(client.get(format!("{base}/v1/jobs/{id}?wait=20")))?.json()?;
    }
    if job["state"] != "succeeded" {
        return Err(format!("{}: {}", job["state"], job["problem"]).into());
    }
    let glb = answer(client.get(format!("{base}/v1/jobs/{id}/outputs/glb")))?.bytes()?;
    std::fs::write("blob.glb", glb)?;
    Ok(())
}
