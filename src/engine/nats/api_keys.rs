//! API keys in the cluster, where every node sees them: a stream with a subject for each.
//!
//! | stream | subjects | holds |
//! |---|---|---|
//! | `SHRINKD_APIKEYS` | `SHRINKD.apikey.{id}` | what is kept of a key: the newest message counts |

use super::address::Address;
use super::feed::passing;
use super::layout;
use super::link::{Expect, Link, failed, patiently};
use crate::auth::key::StoredKey;
use crate::auth::keys::{KeyStore, KeyStoreError};
use crate::engine::EngineError;
use async_nats::jetstream::consumer::DeliverPolicy;
use async_nats::jetstream::consumer::pull;
use async_nats::jetstream::stream::{Config, StorageType, Stream};
use futures::StreamExt;

/// The cluster's keys.
pub struct NatsKeys {
    link: Link,
    stream: Stream<()>,
    prefix: String,
}

impl NatsKeys {
    /// Connects to the servers, and makes the stream when it is not there.
    ///
    /// # Errors
    /// When no server answers, or it has no JetStream.
    pub async fn open(address: &Address) -> Result<Self, EngineError> {
        let (link, prefix) = (Link::open(address, 0).await?, address.prefix.clone());
        let wanted = Config {
            name: format!("{prefix}_APIKEYS"),
            subjects: vec![format!("{prefix}.apikey.*")],
            storage: StorageType::File,
            num_replicas: address.replicas,
            max_messages_per_subject: 1,
            allow_direct: false,
            ..Config::default()
        };
        let stream = patiently(layout::open(&link, wanted)).await?;
        Ok(Self { link, stream, prefix })
    }

    async fn newest_of_each(&self) -> Result<Vec<StoredKey>, EngineError> {
        let what = "the keys";
        let every = passing(format!("{}.apikey.*", self.prefix));
        let config = pull::Config { deliver_policy: DeliverPolicy::LastPerSubject, ..every };
        let consumer = self.stream.create_consumer(config).await.map_err(|e| failed(what)(e.into()))?;
        let info = consumer.cached_info();
        let (name, stored) = (info.name.clone(), info.num_pending as usize);
        let mut keys = Vec::with_capacity(stored);
        if stored > 0 {
            let batch = consumer.fetch().max_messages(stored).messages().await;
            let mut batch = batch.map_err(|e| failed(what)(e.into()))?;
            while let Some(message) = batch.next().await {
                let message = message.map_err(failed(what))?;
                keys.push(serde_json::from_slice(&message.payload).map_err(|e| failed(what)(e.into()))?);
            }
        }
        if let Err(error) = self.stream.delete_consumer(&name).await {
            // the server drops it by itself after a while
            tracing::warn!(%error, "a consumer could not be deleted");
        }
        if keys.len() < stored {
            return Err(EngineError::Store("some keys did not come".to_owned()));
        }
        Ok(keys)
    }
}

impl From<EngineError> for KeyStoreError {
    fn from(error: EngineError) -> Self {
        Self(error.to_string())
    }
}

#[async_trait::async_trait]
impl KeyStore for NatsKeys {
    async fn version(&self) -> Result<u64, KeyStoreError> {
        let info = patiently(async { self.stream.get_info().await.map_err(|e| failed("the keys")(e.into())) });
        Ok(info.await?.state.last_sequence)
    }

    async fn all(&self) -> Result<Vec<StoredKey>, KeyStoreError> {
        Ok(patiently(self.newest_of_each()).await?)
    }

    async fn put(&self, key: StoredKey) -> Result<(), KeyStoreError> {
        let payload = serde_json::to_vec(&key).map_err(|e| KeyStoreError(e.to_string()))?;
        let subject = format!("{}.apikey.{}", self.prefix, key.id);
        patiently(self.link.store(&self.stream, subject, payload.into(), Expect::Any)).await?;
        Ok(())
    }
}
