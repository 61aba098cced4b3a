//! Keys in the folder of the embedded engine: a database of their own, which several processes may have open.

use super::{KeyStore, KeyStoreError};
use crate::auth::key::StoredKey;
use rusqlite::{Connection, params};
use std::path::Path;
use std::sync::{Arc, Mutex};
use std::time::Duration;

/// How long one process waits for another that is writing.
const BUSY: Duration = Duration::from_secs(5);

const TABLE: &str = "
    CREATE TABLE IF NOT EXISTS keys (
        id  TEXT PRIMARY KEY,
        key TEXT NOT NULL
    ) STRICT, WITHOUT ROWID;
";

/// The file `keys.sqlite3`.
pub struct KeyFile(Arc<Mutex<Connection>>);

impl KeyFile {
    /// Opens the file in a folder, making what is not there.
    ///
    /// # Errors
    /// When the folder or the file cannot be written.
    pub fn open(folder: &Path) -> Result<Self, KeyStoreError> {
        std::fs::create_dir_all(folder).map_err(|e| KeyStoreError(format!("{}: {e}", folder.display())))?;
        let path = folder.join("keys.sqlite3");
        let open = || -> rusqlite::Result<Connection> {
            let connection = Connection::open(&path)?;
            connection.busy_timeout(BUSY)?;
            connection.pragma_update(None, "journal_mode", "WAL")?;
            connection.pragma_update(None, "synchronous", "FULL")?;
            connection.execute_batch(TABLE)?;
            Ok(connection)
        };
        let connection = open().map_err(|e| KeyStoreError(format!("{}: {e}", path.display())))?;
        Ok(Self(Arc::new(Mutex::new(connection))))
    }

    async fn run<T: Send + 'static>(
        &self,
        work: impl FnOnce(&Connection) -> rusqlite::Result<T> + Send + 'static,
    ) -> Result<T, KeyStoreError> {
        let connection = self.0.clone();
        let done = tokio::task::spawn_blocking(move || work(&connection.lock().unwrap_or_else(|e| e.into_inner())));
        done.await.map_err(|e| KeyStoreError(e.to_string()))?.map_err(|e| KeyStoreError(e.to_string()))
    }
}

#[async_trait::async_trait]
impl KeyStore for KeyFile {
    /// Counts the changes that other processes made.
    async fn version(&self) -> Result<u64, KeyStoreError> {
        self.run(|c| c.query_row("PRAGMA data_version", [], |row| row.get(0))).await
    }

    async fn all(&self) -> Result<Vec<StoredKey>, KeyStoreError> {
        let texts = self.run(|c| {
            let mut statement = c.prepare_cached("SELECT key FROM keys ORDER BY id")?;
            statement.query_map([], |row| row.get::<_, String>(0))?.collect::<rusqlite::Result<Vec<_>>>()
        });
        let read = |text: String| serde_json::from_str(&text).map_err(|e| KeyStoreError(e.to_string()));
        texts.await?.into_iter().map(read).collect()
    }

    async fn put(&self, key: StoredKey) -> Result<(), KeyStoreError> {
        let text = serde_json::to_string(&key).map_err(|e| KeyStoreError(e.to_string()))?;
        let put = "INSERT INTO keys (id, key) VALUES (?1, ?2) ON CONFLICT (id) DO UPDATE SET key = ?2";
        self.run(move |c| c.execute(put, params![key.id, text])).await.map(|_| ())
    }
}
