//! Uploads a field, submits a job, follows it and downloads its GLB, by the client in `shrinkd.rs`.
//!
//! ```text
//! cargo run --release --example client -- http://127.0.0.1:8080 examples/scenes/fork.json fork.glb
//! ```
//!
//! `SHRINKD_KEY` is the API key, where the service asks for one.

#[allow(dead_code, reason = "this example needs a part of it")]
mod shrinkd;

use futures::StreamExt;
use serde_json::json;
use shrinkd::Client;
use std::process::ExitCode;

#[tokio::main]
async fn main() -> ExitCode {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [url, field, output] = &arguments[..] else {
        eprintln!("usage: client URL FIELD OUT.glb");
        return ExitCode::from(2);
    };
    match wrap(url, field, output).await {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("client: {error}");
            ExitCode::FAILURE
        }
    }
}

async fn wrap(url: &str, field: &str, output: &str) -> Result<(), Box<dyn std::error::Error>> {
    let client = Client::new(url, std::env::var("SHRINKD_KEY").ok());
    let input = client.upload(std::fs::read(field)?).await?;
    println!("{field} is a {}", input["description"]["kind"].as_str().unwrap_or("field"));
    let id = input["id"].as_str().unwrap_or("");
    // whoever runs this twice gets the same job
    let job = client.submit(&json!({"field": {"input": id}}), &format!("client-example {id}")).await?;
    let id = job["id"].as_str().unwrap_or("").to_owned();
    let mut events = Box::pin(client.follow(&id, None));
    while let Some(event) = events.next().await {
        let event = event?;
        if event.kind == "progress" {
            let (stage, fraction) =
                (event.data["stage"].as_str().unwrap_or(""), event.data["fraction"].as_f64().unwrap_or(0.0));
            println!("{:>4} {:>3.0} % {stage}", event.seq, 100.0 * fraction);
        }
    }
    let job = client.succeeded(&id).await?;
    let glb = client.download(&job, "glb").await?;
    std::fs::write(output, &glb)?;
    println!(
        "{output}: {} bytes, {} vertices, {} flips",
        glb.len(),
        job["metrics"]["vertices"],
        job["metrics"]["flips"]["surface"]
    );
    Ok(())
}
