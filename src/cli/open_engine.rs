//! The engine that the configuration names, and the keys beside it.

use crate::auth::keys::{KeyFile, KeyStore};
use crate::config::{Config, SQLITE};
use crate::engine::nats::{Address, NatsEngine, NatsKeys};
use crate::engine::sqlite::SqliteEngine;
use crate::engine::{Engine, Observed, Terms};
use std::sync::Arc;
use std::time::Duration;
use tokio::time::Instant;

/// How long a cluster may take to be ready: its servers may have been started together with this node, and have to find each other
/// and to choose a leader first.
const READY: Duration = Duration::from_secs(60);
/// Pause between two tries.
const PAUSE: Duration = Duration::from_millis(500);

/// Opens the engine. What a cluster's node keeps for itself goes to the data folder.
pub async fn open_engine(config: &Config) -> Result<Arc<dyn Engine>, Box<dyn std::error::Error>> {
    let terms = Terms {
        lease: Duration::from_secs(config.worker.lease_s),
        max_losses: config.worker.max_losses,
        queue: config.limits.queued_jobs,
        quotas: Arc::new(config.quotas.clone()),
        request_bytes: config.limits.body_bytes,
    };
    if config.engine == SQLITE {
        return Ok(Arc::new(Observed(Arc::new(SqliteEngine::open(&config.data_dir, terms)?))));
    }
    let address: Address = config.engine.parse()?;
    let (folder, patience) = (config.data_dir.join("projection"), Instant::now() + READY);
    loop {
        match NatsEngine::open(&address, &folder, terms.clone()).await {
            Ok(engine) => {
                tracing::info!(nats.servers = %address, "joined the cluster");
                return Ok(Arc::new(Observed(Arc::new(engine))));
            }
            Err(error) if Instant::now() >= patience => return Err(error.into()),
            Err(error) => tracing::warn!(%error, "the cluster is not ready yet"),
        }
        tokio::time::sleep(PAUSE).await;
    }
}

/// Opens the store of API keys, which is there also while a service has the engine.
pub async fn open_keys(config: &Config) -> Result<Arc<dyn KeyStore>, Box<dyn std::error::Error>> {
    if config.engine == SQLITE {
        return Ok(Arc::new(KeyFile::open(&config.data_dir)?));
    }
    let address: Address = config.engine.parse()?;
    Ok(Arc::new(NatsKeys::open(&address).await?))
}
