//! Random faults against real processes for a given time, and what became of every accepted job.
//!
//! ```text
//! cargo build --release --bin shrinkd
//! cargo run --release --example campaign -- --engine sqlite --seconds 1200
//! cargo run --release --example campaign -- --engine nats --seconds 1200 --seed 7
//! cargo run --release --example campaign -- --engine nats --blobs bucket --seconds 1200
//! ```
//!
//! Clients submit small jobs under keys, repeat a submit until it is answered, and wait for an end before they submit far more than one
//! machine computes. Meanwhile nodes are killed and frozen, with `nats` the server, too, and now and then everything at once; with
//! `--blobs bucket` the blobs lie in a bucket whose connections are cut or slow for seconds at a time. At the end all is started again,
//! every accepted job must come to its end, and what it made is downloaded and compared with the hash that its record promises. Exits 1
//! when a job was lost, ended twice or left half an output. `--program` names the service ([`service::PROGRAM`] by default); the NATS
//! server and the bucket's are found as the tests find them.

#[path = "../tests/support/bucket.rs"]
mod bucket;
#[path = "../tests/support/nats_server.rs"]
mod nats_server;
#[path = "../tests/support/service.rs"]
mod service;

use bucket::Bucket;
use nats_server::NatsServer;
use reqwest::{Client, StatusCode};
use serde_json::{Value, json};
use service::{Node, Outcome, option};
use sha2::{Digest, Sha256};
use std::collections::BTreeMap;
use std::process::ExitCode;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

/// Nodes of the cluster; the embedded engine is for one.
const NODES: usize = 3;
const CLIENTS: usize = 6;
/// Short, so that many leases are lost.
const LEASE: Duration = Duration::from_secs(3);
/// Jobs of a client that have not ended yet, at most.
const OPEN: usize = 5;
/// Once the faults are over, time for another of the accepted jobs to come to its end after the one before.
const PATIENCE: Duration = Duration::from_secs(300);

/// Numbers that only depend on the seed (Steele et al. 2014, splitmix64).
struct Random(u64);

impl Random {
    fn below(&mut self, n: u64) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        (z ^ (z >> 31)) % n
    }

    fn millis(&mut self, from: u64, to: u64) -> Duration {
        Duration::from_millis(from + self.below(to - from))
    }
}

/// The accepted jobs by key, and what went against the promises already.
#[derive(Default)]
struct Ledger {
    accepted: BTreeMap<String, String>,
    broken: Vec<String>,
}

impl Ledger {
    fn accept(&mut self, key: &str, id: &str) {
        let known = self.accepted.entry(key.to_owned()).or_insert_with(|| id.to_owned());
        if known != id {
            self.broken.push(format!("key {key} made {known} and {id}"));
        }
    }
}

fn request(radius: f64) -> Value {
    json!({
        "field": {"scene": {"sphere": {"radius": radius}}},
        "shrink": {"method": "paper", "lattice": {"latlong": {"n_theta": 48, "n_phi": 24}}},
        "outputs": ["glb", "report"],
        "labels": {"project": "campaign"},
    })
}

/// Submits under one key until somebody answers, to any node each time. A quarter of all keys are used by two at once.
async fn client(number: usize, seed: u64, urls: Vec<String>, ledger: Arc<Mutex<Ledger>>, over: Arc<AtomicBool>) {
    let http = Client::builder().timeout(Duration::from_secs(10)).build().expect("a client");
    let (mut random, mut open) = (Random(seed), Vec::new());
    for i in 0.. {
        if over.load(Ordering::SeqCst) {
            return;
        }
        let (key, body) = (format!("{number}-{i}"), request(0.3 + 0.001 * (i % 400) as f64));
        let copies = if random.below(4) == 0 { 2 } else { 1 };
        let submits = (0..copies).map(|_| {
            let (mut random, urls, http) = (Random(random.below(u64::MAX)), &urls, &http);
            let (key, body, over, ledger) = (&key, &body, &over, &ledger);
            async move {
                while !over.load(Ordering::SeqCst) {
                    let url = &urls[random.below(urls.len() as u64) as usize];
                    let sent =
                        http.post(format!("{url}/v1/jobs")).header("idempotency-key", key).json(body).send().await;
                    match sent {
                        Ok(answer) if answer.status().is_success() => {
                            // an answer that breaks off is no answer
                            if let Ok(job) = answer.json::<Value>().await {
                                ledger.lock().expect("ledger").accept(key, job["id"].as_str().unwrap_or_default());
                                return;
                            }
                        }
                        Ok(answer) if answer.status().is_client_error() && answer.status() != StatusCode::CONFLICT => {
                            let problem = answer.text().await.unwrap_or_default();
                            ledger.lock().expect("ledger").broken.push(format!("key {key} was refused: {problem}"));
                            return;
                        }
                        _ => {}
                    }
                    tokio::time::sleep(random.millis(50, 400)).await;
                }
            }
        });
        futures::future::join_all(submits).await;
        let made = ledger.lock().expect("ledger").accepted.get(&key).cloned();
        open.extend(made);
        while open.len() >= OPEN && !over.load(Ordering::SeqCst) {
            let url = &urls[random.below(urls.len() as u64) as usize];
            let mut left = Vec::new();
            for id in open {
                // who does not answer is asked again
                let answer = http.get(format!("{url}/v1/jobs/{id}")).send().await;
                let job = match answer {
                    Ok(answer) if answer.status().is_success() => answer.json().await.unwrap_or_default(),
                    _ => Value::Null,
                };
                if !job["finished_at"].is_string() {
                    left.push(id);
                }
            }
            open = left;
            tokio::time::sleep(random.millis(100, 500)).await;
        }
        tokio::time::sleep(random.millis(50, 500)).await;
    }
}

/// How often each fault was made.
#[derive(Default)]
struct Faults {
    kills: u32,
    freezes: u32,
    server: u32,
    bucket: u32,
    everything: u32,
}

async fn torment(
    nodes: &mut [Node],
    server: &mut Option<NatsServer>,
    bucket: Option<&Bucket>,
    until: Instant,
    random: &mut Random,
) -> Outcome<Faults> {
    let mut faults = Faults::default();
    while Instant::now() < until {
        tokio::time::sleep(random.millis(500, 4000)).await;
        for node in nodes.iter_mut() {
            node.revive()?;
        }
        if let Some(bucket) = bucket
            && random.below(3) == 0
        {
            faults.bucket += 1;
            match random.below(2) {
                0 => bucket.cut(),
                _ => bucket.delay(random.millis(500, 3000)),
            }
            tokio::time::sleep(random.millis(500, 5000)).await;
            bucket.delay(Duration::ZERO);
            continue;
        }
        let victim = random.below(nodes.len() as u64) as usize;
        match random.below(10) {
            0..=4 => {
                faults.kills += 1;
                nodes[victim].kill();
                tokio::time::sleep(random.millis(0, 3000)).await;
                nodes[victim].restart()?;
            }
            5..=7 => {
                faults.freezes += 1;
                nodes[victim].signal("-STOP");
                tokio::time::sleep(LEASE + random.millis(500, 3000)).await;
                nodes[victim].signal("-CONT");
            }
            8 if server.is_some() => {
                faults.server += 1;
                if let Some(server) = server.as_mut() {
                    server.kill();
                    tokio::time::sleep(random.millis(0, 3000)).await;
                    server.restart();
                }
            }
            _ => {
                faults.everything += 1;
                nodes.iter_mut().for_each(Node::kill);
                if let Some(server) = server.as_mut() {
                    server.kill();
                    server.restart();
                }
                for node in nodes.iter_mut() {
                    node.restart()?;
                }
            }
        }
    }
    for node in nodes.iter_mut() {
        node.revive()?;
    }
    Ok(faults)
}

/// What became of the accepted jobs.
#[derive(Default)]
struct Counts {
    once: usize,
    twice: usize,
    lost: usize,
    half_written: usize,
    attempts: u64,
}

/// The answer of a node that is there, as JSON; asked again until `deadline`.
async fn ask(http: &Client, url: &str, path: &str, deadline: Instant) -> Outcome<Option<Value>> {
    loop {
        let sent = http.get(format!("{url}{path}")).header("accept", "application/json").send().await;
        match sent {
            Ok(answer) if answer.status().is_success() => return Ok(Some(answer.json().await?)),
            Ok(answer) if answer.status() == StatusCode::NOT_FOUND => return Ok(None),
            _ if Instant::now() > deadline => return Err("nobody answers".into()),
            _ => tokio::time::sleep(Duration::from_millis(200)).await,
        }
    }
}

async fn judge(http: &Client, url: &str, id: &str, deadline: Instant, counts: &mut Counts) -> Outcome<()> {
    let path = format!("/v1/jobs/{id}");
    let job = loop {
        match ask(http, url, &path, deadline).await? {
            Some(job) if job["finished_at"].is_string() => break job,
            Some(_) if Instant::now() < deadline => tokio::time::sleep(Duration::from_millis(200)).await,
            other => {
                println!("lost: {id}: {}", other.unwrap_or_default());
                counts.lost += 1;
                return Ok(());
            }
        }
    };
    counts.attempts += job["attempt"].as_u64().unwrap_or_default();
    if job["state"] != "succeeded" {
        println!("lost: {job}");
        counts.lost += 1;
        return Ok(());
    }
    let page = ask(http, url, &format!("{path}/events?after=0&limit=512"), deadline).await?.unwrap_or_default();
    let events = page["events"].as_array().cloned().unwrap_or_default();
    let ends = events.iter().filter(|event| event["type"] == "done").count();
    let numbers: Vec<u64> = events.iter().filter_map(|event| event["seq"].as_u64()).collect();
    if ends != 1 || numbers.windows(2).any(|pair| pair[1] != pair[0] + 1) {
        println!("{ends} ends among the events {numbers:?} of {id}");
        counts.twice += 1;
    } else {
        counts.once += 1;
    }
    for output in job["outputs"].as_array().into_iter().flatten() {
        let href = output["href"].as_str().unwrap_or_default();
        let bytes = http.get(format!("{url}{href}")).send().await?.error_for_status()?.bytes().await?;
        let hash: String = Sha256::digest(&bytes).iter().map(|byte| format!("{byte:02x}")).collect();
        if output["sha256"] != hash || output["bytes"] != bytes.len() {
            println!("half an output: {output}");
            counts.half_written += 1;
        }
    }
    Ok(())
}

#[tokio::main]
async fn main() -> Outcome<ExitCode> {
    let program = service::program();
    let seconds: u64 = option("--seconds").unwrap_or_else(|| "60".to_owned()).parse()?;
    let mut random = Random(option("--seed").unwrap_or_else(|| "1".to_owned()).parse()?);
    let folder = tempfile::tempdir()?;
    let (mut server, engine, count) = match option("--engine").as_deref() {
        Some("nats") => {
            let server = NatsServer::start().ok_or("there is no nats-server")?;
            let engine = server.url();
            (Some(server), engine, NODES)
        }
        None | Some("sqlite") => (None, "sqlite".to_owned(), 1),
        Some(other) => return Err(format!("--engine is sqlite or nats, and not {other}").into()),
    };
    let bucket = match option("--blobs").as_deref() {
        Some("bucket") => Some(Bucket::start().await.ok_or("there is no moto_server")?),
        None | Some("folder") => None,
        Some(other) => return Err(format!("--blobs is folder or bucket, and not {other}").into()),
    };
    let mut variables = vec![
        ("SHRINKD_ENGINE", engine),
        ("SHRINKD_WORKER__LEASE_S", LEASE.as_secs().to_string()),
        // a job that is lost again and again is what this is about
        ("SHRINKD_WORKER__MAX_LOSSES", "1000000".to_owned()),
    ];
    variables.extend(bucket.iter().flat_map(|bucket| bucket.variables("campaign")));
    let nodes = (0..count).map(|_| Node::start(&program, folder.path(), &variables));
    let mut nodes = nodes.collect::<Outcome<Vec<_>>>()?;
    let urls: Vec<String> = nodes.iter().map(Node::url).collect();
    let (ledger, over) = (Arc::new(Mutex::new(Ledger::default())), Arc::new(AtomicBool::new(false)));
    let clients: Vec<_> = (0..CLIENTS)
        .map(|i| tokio::spawn(client(i, random.below(u64::MAX), urls.clone(), ledger.clone(), over.clone())))
        .collect();
    let until = Instant::now() + Duration::from_secs(seconds);
    let faults = torment(&mut nodes, &mut server, bucket.as_ref(), until, &mut random).await?;
    over.store(true, Ordering::SeqCst);
    for client in clients {
        client.await?;
    }
    let http = Client::builder().timeout(Duration::from_secs(20)).build()?;
    let (accepted, broken) = {
        let ledger = ledger.lock().expect("ledger");
        (ledger.accepted.clone(), ledger.broken.clone())
    };
    let mut counts = Counts::default();
    for (i, id) in accepted.values().enumerate() {
        nodes.iter_mut().try_for_each(Node::revive)?;
        judge(&http, &urls[i % urls.len()], id, Instant::now() + PATIENCE, &mut counts).await?;
    }
    broken.iter().for_each(|what| println!("{what}"));
    println!(
        "| engine | blobs | nodes | seconds | node kills | freezes | server kills | bucket faults | everything killed | accepted | attempts | ended once | ended twice | lost | half-written |"
    );
    println!("|---|---|---:|---:|---:|---:|---:|---:|---:|---:|---:|---:|---:|---:|---:|");
    println!(
        "| {} | {} | {count} | {seconds} | {} | {} | {} | {} | {} | {} | {} | {} | {} | {} | {} |",
        if server.is_some() { "nats" } else { "sqlite" },
        if bucket.is_some() { "bucket" } else { "folder" },
        faults.kills,
        faults.freezes,
        faults.server,
        faults.bucket,
        faults.everything,
        accepted.len(),
        counts.attempts,
        counts.once,
        counts.twice + broken.len(),
        counts.lost,
        counts.half_written,
    );
    let sound = counts.twice + counts.lost + counts.half_written + broken.len() == 0;
    Ok(if sound { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}
