//! The engine that the configuration names.

use crate::config::{Config, SQLITE};
use crate::engine::nats::{Address, NatsEngine};
use crate::engine::sqlite::SqliteEngine;
use crate::engine::{Engine, Observed, Terms};
use std::sync::Arc;
use std::time::Duration;

/// Opens the engine. What a cluster's node keeps for itself goes to the data folder.
pub async fn open_engine(config: &Config) -> Result<Arc<dyn Engine>, Box<dyn std::error::Error>> {
    let terms = Terms { lease: Duration::from_secs(config.worker.lease_s), max_losses: config.worker.max_losses };
    if config.engine == SQLITE {
        return Ok(Arc::new(Observed(Arc::new(SqliteEngine::open(&config.data_dir, terms)?))));
    }
    let address: Address = config.engine.parse()?;
    let engine = NatsEngine::open(&address, &config.data_dir.join("projection"), terms).await?;
    tracing::info!(nats.servers = %address, "joined the cluster");
    Ok(Arc::new(Observed(Arc::new(engine))))
}
