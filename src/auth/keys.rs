//! Where keys are kept, and the ring that a service has of them.
//!
//! Keys lie beside the jobs but not among them, so that the command line can make and revoke them while the service runs: in a database
//! of their own in the folder ([`KeyFile`]), or in a stream of the cluster ([`NatsKeys`](crate::engine::nats::NatsKeys)).
//!
//! A service keeps all of them at hand and looks every [`EVERY`] whether there is something new. So a key that is revoked stops working on
//! every node within a little more than that; a node that cannot reach the store goes on with what it knows, says so in the log, and
//! hears of it later. A key that is not known is looked for at once, at most every [`ON_DEMAND`], so that nobody can wear out the store
//! with made-up keys.

mod file;

pub use file::KeyFile;

use super::Caller;
use super::key::{ApiKey, StoredKey};
use jiff::Timestamp;
use std::collections::HashMap;
use std::sync::{Arc, RwLock};
use std::time::Duration;
use tokio::sync::Mutex;
use tokio::time::Instant;
use tokio_util::sync::CancellationToken;

/// Time between two looks for changes.
pub const EVERY: Duration = Duration::from_secs(1);
/// Least time between two looks for keys that are not known.
pub const ON_DEMAND: Duration = Duration::from_millis(200);

/// The store of keys failed. The text is for the log.
#[derive(Debug, thiserror::Error)]
#[error("keys: {0}")]
pub struct KeyStoreError(pub String);

/// Where keys are kept.
#[async_trait::async_trait]
pub trait KeyStore: Send + Sync {
    /// A number that is another one after every change.
    async fn version(&self) -> Result<u64, KeyStoreError>;
    /// Every key, also those that do not work any more.
    async fn all(&self) -> Result<Vec<StoredKey>, KeyStoreError>;
    /// Keeps a key or what has become of it; durable when it returns.
    async fn put(&self, key: StoredKey) -> Result<(), KeyStoreError>;
}

/// Revokes a key. `false` when there is no such key; one that was revoked before stays as it is.
///
/// # Errors
/// When the store fails.
pub async fn revoke(store: &dyn KeyStore, id: &str) -> Result<bool, KeyStoreError> {
    let Some(mut key) = store.all().await?.into_iter().find(|key| key.id == id) else { return Ok(false) };
    if key.revoked_at.is_none() {
        key.revoked_at = Some(Timestamp::now());
        store.put(key).await?;
    }
    Ok(true)
}

/// The keys that a service has at hand.
pub struct KeyRing {
    store: Arc<dyn KeyStore>,
    known: RwLock<Arc<HashMap<String, StoredKey>>>,
    look: Mutex<Look>,
}

/// The last look into the store.
struct Look {
    at: Instant,
    version: Option<u64>,
    failed: bool,
}

impl KeyRing {
    /// Reads every key.
    ///
    /// # Errors
    /// When the store fails.
    pub async fn open(store: Arc<dyn KeyStore>) -> Result<Self, KeyStoreError> {
        let look = Mutex::new(Look { at: Instant::now(), version: None, failed: false });
        let ring = Self { store, known: RwLock::default(), look };
        ring.refresh(&mut *ring.look.lock().await).await?;
        Ok(ring)
    }

    /// Who asks with this key; `None` when it does not work.
    pub async fn find(&self, key: &ApiKey<'_>) -> Option<Caller> {
        let now = Timestamp::now();
        if let Some(stored) = self.known().get(key.id) {
            return stored.check(key, now);
        }
        self.look_after(ON_DEMAND).await;
        self.known().get(key.id).and_then(|stored| stored.check(key, now))
    }

    /// Looks for changes until `stop` is raised.
    pub async fn watch(self: Arc<Self>, stop: CancellationToken) {
        while stop.run_until_cancelled(tokio::time::sleep(EVERY)).await.is_some() {
            self.look_after(EVERY / 2).await;
        }
    }

    /// Looks into the store, unless somebody did within `least`.
    async fn look_after(&self, least: Duration) {
        let mut look = self.look.lock().await;
        if look.at.elapsed() < least {
            return;
        }
        look.at = Instant::now();
        let had_failed = look.failed;
        let result = self.refresh(&mut look).await;
        look.failed = result.is_err();
        match result {
            Err(error) if !had_failed => {
                tracing::error!(%error, "the store of keys is out of reach: what is revoked now works on until it is back");
            }
            Ok(()) if had_failed => tracing::info!("the store of keys is back"),
            _ => {}
        }
    }

    async fn refresh(&self, look: &mut Look) -> Result<(), KeyStoreError> {
        // asked first: what changes while the keys are read is read the next time
        let version = Some(self.store.version().await?);
        if look.version != version {
            let keys = self.store.all().await?.into_iter().map(|key| (key.id.clone(), key)).collect();
            *self.known.write().unwrap_or_else(|e| e.into_inner()) = Arc::new(keys);
            look.version = version;
        }
        Ok(())
    }

    fn known(&self) -> Arc<HashMap<String, StoredKey>> {
        self.known.read().unwrap_or_else(|e| e.into_inner()).clone()
    }
}

#[cfg(test)]
mod tests {
    use super::super::Scope;
    use super::super::key::NewKey;
    use super::*;

    #[tokio::test]
    async fn a_key_works_from_when_it_is_made_until_it_is_revoked_by_somebody_else() {
        let folder = tempfile::tempdir().expect("folder");
        let [service, command_line] = [(); 2].map(|()| Arc::new(KeyFile::open(folder.path()).expect("opens")));
        let ring = Arc::new(KeyRing::open(service).await.expect("opens"));
        let stop = CancellationToken::new();
        tokio::spawn(ring.clone().watch(stop.clone()));
        let new = NewKey {
            tenant: "a".parse().expect("a name"),
            scopes: [Scope::Write].into(),
            name: "of a test".to_owned(),
            expires_at: None,
        };
        let (stored, text) = StoredKey::make(new).expect("makes");
        let key = ApiKey::parse(&text).expect("is one");
        assert!(ring.find(&key).await.is_none());
        command_line.put(stored.clone()).await.expect("keeps");
        let deadline = Instant::now() + Duration::from_secs(30);
        while ring.find(&key).await.is_none() {
            assert!(Instant::now() < deadline, "not in time");
            tokio::time::sleep(ON_DEMAND).await;
        }
        assert!(!revoke(&*command_line, "0").await.expect("answers"));
        assert!(revoke(&*command_line, &stored.id).await.expect("revokes"));
        while ring.find(&key).await.is_some() {
            assert!(Instant::now() < deadline, "not in time");
            tokio::time::sleep(ON_DEMAND).await;
        }
        let kept = command_line.all().await.expect("reads");
        let revoked_at = kept[0].revoked_at;
        let mut expected = stored.clone();
        expected.revoked_at = revoked_at;
        assert!(revoked_at.is_some());
        assert_eq!(kept, [expected]);
        assert!(revoke(&*command_line, &stored.id).await.expect("answers"));
        assert_eq!(command_line.all().await.expect("reads")[0].revoked_at, revoked_at, "the first time counts");
        stop.cancel();
    }
}
