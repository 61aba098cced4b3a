//! Removes blobs that no job names any more: expired outputs, and inputs that nobody came to use.
//!
//! An input goes tenant by tenant: first what describes it to a tenant whose jobs do not name it, however young another tenant
//! keeps the bytes, and the bytes with the last of them.
//!
//! Guarantees: a blob that a remembered job names, and that has not expired, stays; so does one that was put or touched within
//! [`Blobs::GRACE`], for its record may be on its way. Not guaranteed: that a blob goes at once; any number of nodes may collect at the same
//! time.

use crate::blobs::{BlobError, BlobId, Blobs};
use crate::config::Retention;
use crate::engine::{Engine, EngineError};
use crate::telemetry::metrics;
use futures::TryStreamExt;
use jiff::Timestamp;
use std::sync::Arc;
use std::time::Duration;
use tokio_util::sync::CancellationToken;

/// Blobs that the engine is asked about at once.
const BATCH: usize = 256;

/// Why collecting broke off. What is left is collected the next time.
#[derive(Debug, thiserror::Error)]
pub enum CollectError {
    /// The store failed.
    #[error(transparent)]
    Blobs(#[from] BlobError),
    /// The engine failed.
    #[error(transparent)]
    Engine(#[from] EngineError),
}

/// Collects every [`Retention::every_s`], until `stop` is raised.
pub async fn run(engine: Arc<dyn Engine>, blobs: Blobs, retention: Retention, stop: CancellationToken) {
    let mut ticks = tokio::time::interval(Duration::from_secs(retention.every_s.max(1)));
    loop {
        tokio::select! {
            () = stop.cancelled() => return,
            _ = ticks.tick() => {}
        }
        let collected = tokio::select! {
            () = stop.cancelled() => return,
            collected = collect(engine.as_ref(), &blobs, &retention) => collected,
        };
        match collected {
            Ok(0) => {}
            Ok(blobs) => {
                metrics::blobs_collected(blobs as u64);
                tracing::info!(blobs, "what no job names any more was removed");
            }
            Err(error) => tracing::warn!(%error, "what no job names any more could not be removed"),
        }
    }
}

/// Removes what is to go now, and tells how many blobs that were.
///
/// # Errors
/// When the store or the engine fails.
pub async fn collect(engine: &dyn Engine, blobs: &Blobs, retention: &Retention) -> Result<usize, CollectError> {
    let mut removed = 0;
    let unused = Duration::from_secs(retention.inputs_s);
    let mut notes = blobs.notes_older_than(unused);
    while let Some((tenant, id)) = notes.try_next().await? {
        let expired = retention.expired(Timestamp::now());
        if engine.unnamed(Some(&tenant), vec![id.hex()], expired).await?.is_empty() {
            continue;
        }
        // no job of this node comes to name it between the question and its end
        let _sweep = blobs.sweep().await;
        if !engine.unnamed(Some(&tenant), vec![id.hex()], expired).await?.is_empty() {
            blobs.remove_older_note(&tenant, id, unused).await?;
        }
    }
    let mut batches = blobs.older_than(Blobs::GRACE).try_chunks(BATCH);
    while let Some(batch) = batches.try_next().await.map_err(|e| e.1)? {
        let hashes = batch.iter().map(BlobId::hex).collect();
        for hash in engine.unnamed(None, hashes, retention.expired(Timestamp::now())).await? {
            if let Some(id) = BlobId::from_hex(&hash)
                && remove(engine, blobs, retention, id).await?
            {
                removed += 1;
            }
        }
    }
    let mut checkpoints = blobs.checkpoints_older_than(Blobs::GRACE);
    while let Some((tenant, name)) = checkpoints.try_next().await? {
        let job = match name.parse() {
            Ok(id) => engine.get(&tenant, id).await?,
            Err(_) => None,
        };
        if job.is_none_or(|job| job.state.ended()) {
            blobs.remove_checkpoint(&tenant, &name).await?;
        }
    }
    Ok(removed)
}

/// Removes a blob that was not named a moment ago.
async fn remove(engine: &dyn Engine, blobs: &Blobs, retention: &Retention, id: BlobId) -> Result<bool, CollectError> {
    // no job of this node comes to name it between the question and its end
    let _sweep = blobs.sweep().await;
    let unnamed = engine.unnamed(None, vec![id.hex()], retention.expired(Timestamp::now())).await?;
    Ok(!unnamed.is_empty() && !blobs.is_input(id).await? && blobs.remove_older(id, Blobs::GRACE).await?)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::sqlite::SqliteEngine;
    use crate::engine::{NewJob, Outcome, Terms};
    use crate::job::{JobId, JobSpec, Output};
    use crate::tenant::Tenant;
    use bytes::Bytes;
    use serde_json::json;
    use std::path::Path;
    use std::time::SystemTime;

    /// Makes every file of a folder look as if it was written so long ago.
    fn age(folder: &Path, by: Duration) {
        for entry in std::fs::read_dir(folder).expect("folder").map(|entry| entry.expect("entry").path()) {
            if entry.is_dir() {
                age(&entry, by);
            } else {
                let file = std::fs::File::options().write(true).open(&entry).expect("opens");
                file.set_modified(SystemTime::now() - by).expect("sets the time");
            }
        }
    }

    #[tokio::test]
    async fn what_is_named_or_young_stays_and_the_rest_goes() {
        let own = Tenant::default();
        let folder = tempfile::tempdir().expect("folder");
        let engine = SqliteEngine::open(&folder.path().join("engine"), Terms::default()).expect("engine");
        let store = folder.path().join("blobs");
        let blobs = Blobs::in_folder(&store).expect("blobs");
        let retention = Retention { outputs_s: 0, inputs_s: 4 * 3600, every_s: 60 };
        let put = async |text: &'static str| blobs.put(Bytes::from_static(text.as_bytes())).await.expect("puts");
        let [named, stray, unused, output] =
            [put("named").await, put("stray").await, put("unused").await, put("output").await];
        for input in [named, unused] {
            blobs.put_note(&own, input, Bytes::from_static(b"{}")).await.expect("notes");
        }
        let spec = JobSpec::from_value(&json!({"field": {"input": named.to_string()}})).expect("a request");
        engine
            .submit(NewJob { tenant: own.clone(), id: JobId::new(), spec, vertices: 0, key: None })
            .await
            .expect("submits");
        let claim = engine.claim("a", 1, Duration::ZERO).await.expect("claims").remove(0);
        let made = Output {
            name: "glb".to_owned(),
            href: String::new(),
            media_type: String::new(),
            bytes: 6,
            sha256: output.hex(),
            certified: true,
        };
        let outcome = Outcome::Succeeded { outputs: vec![made], metrics: json!({}) };
        engine.finish(&claim, outcome).await.expect("finishes");
        blobs.put_checkpoint(&own, &claim.id.to_string(), Bytes::from_static(b"c")).await.expect("puts");

        let left = async || {
            let mut there = Vec::new();
            for id in [named, stray, unused, output] {
                there.push(blobs.get(id).await.is_ok());
            }
            there
        };
        assert_eq!(collect(&engine, &blobs, &retention).await.expect("collects"), 0, "all are young");
        age(&store, 2 * Blobs::GRACE);
        assert_eq!(collect(&engine, &blobs, &retention).await.expect("collects"), 1);
        assert_eq!(left().await, [true, false, true, true], "an input may wait longer for a job");
        assert_eq!(blobs.checkpoint(&own, &claim.id.to_string()).await.expect("answers"), None);
        age(&store, 5 * Blobs::GRACE);
        assert!(blobs.touch(&own, unused).await.expect("touches"));
        assert_eq!(collect(&engine, &blobs, &retention).await.expect("collects"), 0, "it was touched");
        age(&store, 5 * Blobs::GRACE);
        assert_eq!(collect(&engine, &blobs, &retention).await.expect("collects"), 1);
        assert_eq!(left().await, [true, false, false, true]);
        assert_eq!(blobs.note(&own, unused).await.expect("answers"), None);
        // outputs that are kept for a second after the job's end, and a second
        tokio::time::sleep(Duration::from_millis(1100)).await;
        let short = Retention { outputs_s: 1, ..retention };
        assert_eq!(collect(&engine, &blobs, &short).await.expect("collects"), 2);
        assert_eq!(left().await, [false; 4]);
    }
}
