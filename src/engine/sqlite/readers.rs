//! Connections that only read, so that nobody who reads waits for the writer.

use crate::engine::EngineError;
use rusqlite::Connection;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};
use tokio::sync::Semaphore;

/// Connections that read at once: more than the disk answers at once, few enough for their page caches.
const READERS: usize = 8;

/// Connections to one file, opened as they are needed.
pub(in crate::engine) struct Readers {
    idle: Arc<Mutex<Vec<Connection>>>,
    turns: Arc<Semaphore>,
    path: PathBuf,
    connect: fn(&Path) -> Result<Connection, EngineError>,
}

impl Readers {
    pub(in crate::engine) fn new(path: PathBuf, connect: fn(&Path) -> Result<Connection, EngineError>) -> Self {
        Self { idle: Arc::default(), turns: Arc::new(Semaphore::new(READERS)), path, connect }
    }

    /// Runs `work` in a transaction on a blocking thread.
    pub(in crate::engine) async fn run<T: Send + 'static>(
        &self,
        work: impl FnOnce(&Connection) -> rusqlite::Result<T> + Send + 'static,
    ) -> Result<T, EngineError> {
        let (idle, path, connect) = (self.idle.clone(), self.path.clone(), self.connect);
        let turn = self.turns.clone().acquire_owned().await.map_err(|_| EngineError::Stopped)?;
        let read = tokio::task::spawn_blocking(move || {
            let _turn = turn;
            let pooled = idle.lock().unwrap_or_else(|e| e.into_inner()).pop();
            let mut connection = match pooled {
                Some(connection) => connection,
                None => connect(&path)?,
            };
            // one transaction, so that everything read belongs together; it ends when it is dropped
            let result = connection.transaction().and_then(|tx| work(&tx))?;
            idle.lock().unwrap_or_else(|e| e.into_inner()).push(connection);
            Ok(result)
        });
        read.await.map_err(|e| EngineError::Store(e.to_string()))?
    }
}
