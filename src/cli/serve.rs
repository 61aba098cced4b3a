//! `shrinkd serve`: puts the rooms together and runs them until a signal comes.

use super::open_engine::{open_engine, open_keys};
use super::{BAD_USAGE, FAILED, NodeArgs, ServeArgs, fail, first_job};
use crate::auth::Authenticator;
use crate::auth::issuer::Issuer;
use crate::auth::keys::KeyRing;
use crate::blobs::Blobs;
use crate::config::{AuthMode, Config, FOLDER, Role};
use crate::grpc;
use crate::http::rates::Rates;
use crate::http::{self, App};
use crate::job::memory::Memory;
use crate::job::worker::Worker;
use crate::job::{collector, priority};
use crate::notify::courier::{Courier, SystemNames};
use crate::telemetry;
use crate::telemetry::metrics::{self, Exposition};
use crate::telemetry::traces::Traces;
use serde::Serialize;
use std::net::SocketAddr;
use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::Arc;
use std::time::Duration;
use tokio::net::TcpListener;
use tokio::signal::unix::{SignalKind, signal};
use tokio_util::sync::CancellationToken;

/// Time from the closing of the listeners to the end of the process at most; what has not ended by then is taken up after the next start.
const DRAIN: Duration = Duration::from_secs(4);

/// What the command line says; absent members leave the configuration as it is.
#[derive(Serialize)]
pub(super) struct Flags<'a> {
    #[serde(skip_serializing_if = "Option::is_none")]
    listen: Option<std::net::SocketAddr>,
    #[serde(skip_serializing_if = "Option::is_none")]
    data_dir: Option<&'a std::path::Path>,
    #[serde(skip_serializing_if = "Option::is_none")]
    engine: Option<&'a str>,
    #[serde(skip_serializing_if = "Option::is_none")]
    blobs: Option<&'a str>,
    #[serde(skip_serializing_if = "Option::is_none")]
    role: Option<Role>,
}

/// What the command line says of the configuration.
pub(super) fn flags(args: &NodeArgs) -> Flags<'_> {
    Flags {
        listen: args.listen,
        data_dir: args.data.as_deref(),
        engine: args.engine.as_deref(),
        blobs: args.blobs.as_deref(),
        role: args.role,
    }
}

/// Runs the service until SIGTERM or SIGINT.
pub fn run(args: &ServeArgs) -> ExitCode {
    let (node, first) = (&args.node, args.first.clone());
    let config = match Config::load(node.config.as_deref(), flags(node)) {
        Ok(config) => config,
        Err(error) => return fail(BAD_USAGE, &error),
    };
    if config.is_open_to_strangers() {
        let why = "listening beyond loopback needs auth.mode = \"required\", or auth.open_beyond_loopback = true where something else \
                   keeps strangers away";
        return fail(BAD_USAGE, &why);
    }
    let runtime = match tokio::runtime::Builder::new_multi_thread().enable_all().build() {
        Ok(runtime) => runtime,
        Err(error) => return fail(FAILED, &error),
    };
    let traces = match Traces::start(&config.traces, runtime.handle()) {
        Ok(traces) => traces,
        Err(error) => return fail(BAD_USAGE, &error),
    };
    if let Err(error) = telemetry::start(&config.log, traces.as_ref()) {
        return fail(BAD_USAGE, &error);
    }
    let result = runtime.block_on(serve(config, first));
    if let Some(traces) = traces {
        runtime.block_on(traces.stop());
    }
    // a computation that did not see its token in time must not hold up the end
    runtime.shutdown_background();
    match result {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => fail(FAILED, &error),
    }
}

/// Opens the blob store, and warns of what will not work with it.
async fn open_blobs(config: &Config) -> Result<Blobs, Box<dyn std::error::Error>> {
    if config.blobs == FOLDER {
        return Ok(Blobs::in_folder(&config.data_dir.join("blobs"))?);
    }
    let blobs = Blobs::in_bucket(&config.blobs)?;
    match blobs.probe().await {
        Ok(true) => {}
        Ok(false) => tracing::warn!(
            "the bucket has no conditional put: two nodes may write over each other what describes an input"
        ),
        // it may come up later; until then the service is not ready
        Err(error) => tracing::warn!(%error, "the bucket cannot be written to"),
    }
    Ok(blobs)
}

/// What tells who asks; `None` where nobody is asked.
async fn open_authenticator(
    config: &Config,
    stop: &CancellationToken,
) -> Result<Option<Arc<Authenticator>>, Box<dyn std::error::Error>> {
    if config.auth.mode == AuthMode::None || config.role == Role::Worker {
        return Ok(None);
    }
    let keys = Arc::new(KeyRing::open(open_keys(config).await?).await?);
    tokio::spawn(keys.clone().watch(stop.clone()));
    let oidc = &config.auth.oidc;
    let issuer = if oidc.issuer.is_empty() { None } else { Some(Issuer::new(oidc)?) };
    Ok(Some(Arc::new(Authenticator { keys, issuer })))
}

async fn listen(address: SocketAddr) -> Result<TcpListener, String> {
    TcpListener::bind(address).await.map_err(|e| format!("{address} cannot be listened at: {e}"))
}

async fn serve(config: Config, first: Option<PathBuf>) -> Result<(), Box<dyn std::error::Error>> {
    for warning in config.warnings() {
        tracing::warn!("{warning}");
    }
    let exposition = Exposition::start()?;
    let engine = open_engine(&config).await?;
    let blobs = open_blobs(&config).await?;
    let pool = rayon::ThreadPoolBuilder::new()
        .num_threads(config.worker.threads)
        .thread_name(|i| format!("pool-{i}"))
        .start_handler(|_| priority::give_way())
        .build()?;
    let (stop, close) = (CancellationToken::new(), CancellationToken::new());
    let authenticator = open_authenticator(&config, &stop).await?;
    let (mut terminate, mut interrupt) = (signal(SignalKind::terminate())?, signal(SignalKind::interrupt())?);

    let listener = listen(config.listen).await?;
    let address = listener.local_addr()?;
    if config.role != Role::Api {
        metrics::worker_started(config.worker.slots, pool.current_num_threads());
    }
    let (engine_of_worker, blobs_of_worker) = (engine.clone(), blobs.clone());
    let memory = config.worker_memory().map(|bytes| Arc::new(Memory::new(bytes)));
    let worker = move || Worker {
        engine: engine_of_worker,
        blobs: blobs_of_worker,
        pool: Arc::new(pool),
        slots: config.worker.slots,
        job_seconds: config.limits.job_seconds,
        memory,
        name: format!("worker-{}", uuid::Uuid::now_v7()),
    };
    let worker = (config.role != Role::Api).then(|| tokio::spawn(worker().run(stop.clone())));
    tokio::spawn(collector::run(engine.clone(), blobs.clone(), config.retention, stop.clone()));
    let courier = if config.role == Role::Worker || !config.webhooks.is_in_use() {
        None
    } else {
        let courier = Courier::new(&config.webhooks, Arc::new(SystemNames))?;
        Some(tokio::spawn(courier.run(engine.clone(), stop.clone())))
    };
    let app = App {
        engine,
        blobs,
        limits: config.limits.clone(),
        job_memory: config.job_memory(),
        retention: config.retention,
        download_link: Duration::from_secs(config.download_link_s),
        metrics: exposition,
        metrics_apart: config.metrics_listen.is_some(),
        webhooks: Arc::new(config.webhooks.clone()),
        rates: Arc::new(Rates::new(config.quotas.clone())),
        upload_room: http::body::Room::new(config.limits.upload_bytes),
        stop: stop.clone(),
    };
    if let Some(address) = config.metrics_listen {
        let (listener, router) = (listen(address).await?, http::metrics::router(app.clone()));
        tracing::info!(http.address = %listener.local_addr()?, "serving metrics");
        tokio::spawn(http::server::serve(listener, router, close.clone()));
    }
    let router = match config.role {
        Role::Worker => http::health_router(app.clone(), grpc::health_routes(app)),
        Role::All | Role::Api => http::router(app.clone(), authenticator, &config.cors_origins, grpc::routes(app)),
    };
    let router = router.layer(axum::middleware::from_fn(grpc::speak));
    let routes = router.clone();
    let server = tokio::spawn(http::server::serve(listener, router, close.clone()));
    // the program that started this one may wait for this line
    tracing::info!(http.address = %address, data.dir = %config.data_dir.display(), "listening");
    if let Some(field) = first {
        tokio::spawn(first_job::run(routes, address, field));
    }

    let drain = tokio::select! {
        _ = terminate.recv() => {
            tracing::info!(signal = "SIGTERM", "stopping");
            Duration::from_secs(config.drain_s)
        }
        // a person does not wait for a balancer
        _ = interrupt.recv() => {
            tracing::info!(signal = "SIGINT", "stopping");
            Duration::ZERO
        }
    };
    stop.cancel();
    tokio::select! {
        () = tokio::time::sleep(drain) => {}
        _ = interrupt.recv() => {}
    }
    close.cancel();
    let drained = async {
        if let Some(worker) = worker {
            worker.await?;
        }
        if let Some(courier) = courier {
            courier.await?;
        }
        server.await?;
        Ok::<_, Box<dyn std::error::Error>>(())
    };
    match tokio::time::timeout(DRAIN, drained).await {
        Ok(result) => result?,
        Err(_) => tracing::warn!("stopped before everything had ended"),
    }
    tracing::info!("stopped");
    Ok(())
}
