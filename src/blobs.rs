//! Inputs and outputs by the hash of their content, on `object_store`.
//!
//! Guarantees: what [`Blobs::put`] returned is on the disk (file and folder synced) under its SHA-256 and never changes; a
//! half-written blob is never visible. Not guaranteed: that a blob is still what it was after the folder was edited by hand;
//! [`Blobs::get`] checks the hash, ranges do not.

use bytes::Bytes;
use futures::stream::BoxStream;
use futures::{StreamExt, TryStreamExt};
use object_store::local::LocalFileSystem;
use object_store::path::Path;
use object_store::{GetOptions, GetRange, ObjectStore, ObjectStoreExt, PutMode, PutOptions};
use sha2::{Digest, Sha256};
use std::ops::Range;
use std::sync::Arc;
use tokio::sync::{OwnedRwLockReadGuard, OwnedRwLockWriteGuard, RwLock};

/// Name of a blob: the SHA-256 of its bytes, written `sha256:` and 64 lower-case hexadecimal digits.
#[derive(Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct BlobId([u8; 32]);

impl BlobId {
    /// The name of these bytes.
    pub fn of(bytes: &[u8]) -> Self {
        Self(Sha256::digest(bytes).into())
    }
    /// The name with these 64 hexadecimal digits.
    pub fn from_hex(hex: &str) -> Option<Self> {
        let digits = hex.as_bytes();
        if digits.len() != 64 || digits.iter().any(|d| !matches!(d, b'0'..=b'9' | b'a'..=b'f')) {
            return None;
        }
        let mut id = [0u8; 32];
        for (byte, pair) in id.iter_mut().zip(digits.chunks_exact(2)) {
            *byte = u8::from_str_radix(std::str::from_utf8(pair).ok()?, 16).ok()?;
        }
        Some(Self(id))
    }
    /// The 64 hexadecimal digits.
    pub fn hex(&self) -> String {
        self.0.iter().map(|b| format!("{b:02x}")).collect()
    }
    /// The 32 bytes of the hash.
    pub fn bytes(&self) -> &[u8; 32] {
        &self.0
    }
}

impl std::fmt::Display for BlobId {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "sha256:{}", self.hex())
    }
}

impl std::fmt::Debug for BlobId {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        std::fmt::Display::fmt(self, f)
    }
}

impl std::str::FromStr for BlobId {
    type Err = InvalidBlobId;
    fn from_str(s: &str) -> Result<Self, InvalidBlobId> {
        s.strip_prefix("sha256:").and_then(Self::from_hex).ok_or(InvalidBlobId)
    }
}

impl serde::Serialize for BlobId {
    fn serialize<S: serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_str(self)
    }
}

impl<'de> serde::Deserialize<'de> for BlobId {
    fn deserialize<D: serde::Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let text = String::deserialize(deserializer)?;
        text.parse().map_err(serde::de::Error::custom)
    }
}

/// The text is not `sha256:` and 64 lower-case hexadecimal digits.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("expected sha256: and 64 lower-case hexadecimal digits")]
pub struct InvalidBlobId;

/// Why the store did not do what was asked. The cause is for the log, not for clients.
#[derive(Debug, thiserror::Error)]
pub enum BlobError {
    /// There is no blob of that name.
    #[error("no such blob")]
    Missing,
    /// The bytes under that name have another hash.
    #[error("{0} is damaged: its bytes have another hash")]
    Damaged(BlobId),
    /// The store failed.
    #[error("blob store: {0}")]
    Store(object_store::Error),
}

impl From<object_store::Error> for BlobError {
    fn from(error: object_store::Error) -> Self {
        match error {
            object_store::Error::NotFound { .. } => BlobError::Missing,
            other => BlobError::Store(other),
        }
    }
}

/// A store of blobs; clones share it.
#[derive(Clone, Debug)]
pub struct Blobs {
    store: Arc<dyn ObjectStore>,
    /// Equal outputs of two jobs are one blob: nothing may be removed between the moment that a job's output was found to
    /// be there already and the moment that the job's record names it.
    promises: Arc<RwLock<()>>,
}

impl Blobs {
    /// Blobs in a folder, which is made when it is not there. Every write is synced to the disk.
    pub fn in_folder(folder: &std::path::Path) -> Result<Self, BlobError> {
        std::fs::create_dir_all(folder).map_err(|source| {
            BlobError::Store(object_store::Error::Generic { store: "LocalFileSystem", source: source.into() })
        })?;
        let store = Arc::new(LocalFileSystem::new_with_prefix(folder)?.with_fsync(true));
        Ok(Self { store, promises: Arc::default() })
    }

    /// While this guard lives no blob is removed. Held from before a blob is put until a record names it.
    pub async fn promise(&self) -> OwnedRwLockReadGuard<()> {
        self.promises.clone().read_owned().await
    }
    /// While this guard lives no blob is promised. Held from before a record is forgotten until its blobs are removed.
    pub async fn sweep(&self) -> OwnedRwLockWriteGuard<()> {
        self.promises.clone().write_owned().await
    }

    /// Stores bytes under their hash. Storing the same bytes again changes nothing.
    pub async fn put(&self, bytes: Bytes) -> Result<BlobId, BlobError> {
        let (id, bytes) = tokio::task::spawn_blocking(move || (BlobId::of(&bytes), bytes)).await.map_err(joined)?;
        self.create(&blob_path(id), bytes).await?;
        Ok(id)
    }

    /// The whole blob, its hash checked.
    pub async fn get(&self, id: BlobId) -> Result<Bytes, BlobError> {
        let bytes = self.store.get(&blob_path(id)).await?.bytes().await?;
        let (found, bytes) = tokio::task::spawn_blocking(move || (BlobId::of(&bytes), bytes)).await.map_err(joined)?;
        if found == id { Ok(bytes) } else { Err(BlobError::Damaged(id)) }
    }

    /// The blob, or a range of it, as it is read.
    pub async fn stream(
        &self,
        id: BlobId,
        range: Option<Range<u64>>,
    ) -> Result<BoxStream<'static, Result<Bytes, BlobError>>, BlobError> {
        let options = GetOptions { range: range.map(GetRange::Bounded), ..GetOptions::default() };
        let result = self.store.get_opts(&blob_path(id), options).await?;
        Ok(result.into_stream().map_err(BlobError::from).boxed())
    }

    /// Writes the note that describes an input. The first one stays.
    pub async fn put_note(&self, id: BlobId, note: Bytes) -> Result<(), BlobError> {
        self.create(&note_path(id), note).await.map(|_| ())
    }

    /// The note that describes an input; `None` when there is no such input.
    pub async fn note(&self, id: BlobId) -> Result<Option<Bytes>, BlobError> {
        match self.store.get(&note_path(id)).await {
            Ok(found) => Ok(Some(found.bytes().await?)),
            Err(object_store::Error::NotFound { .. }) => Ok(None),
            Err(error) => Err(error.into()),
        }
    }

    /// Removes a blob; one that is not there is no error.
    pub async fn remove(&self, id: BlobId) -> Result<(), BlobError> {
        match self.store.delete(&blob_path(id)).await {
            Ok(()) | Err(object_store::Error::NotFound { .. }) => Ok(()),
            Err(error) => Err(error.into()),
        }
    }

    /// Writes the checkpoint of a job over the one before. Whoever writes it, it is the state of the same computation.
    pub async fn put_checkpoint(&self, job: &str, bytes: Bytes) -> Result<(), BlobError> {
        self.store.put(&checkpoint_path(job), bytes.into()).await?;
        Ok(())
    }

    /// The checkpoint of a job, if it has one.
    pub async fn checkpoint(&self, job: &str) -> Result<Option<Bytes>, BlobError> {
        match self.store.get(&checkpoint_path(job)).await {
            Ok(found) => Ok(Some(found.bytes().await?)),
            Err(object_store::Error::NotFound { .. }) => Ok(None),
            Err(error) => Err(error.into()),
        }
    }

    /// Removes the checkpoint of a job; one that is not there is no error.
    pub async fn remove_checkpoint(&self, job: &str) -> Result<(), BlobError> {
        match self.store.delete(&checkpoint_path(job)).await {
            Ok(()) | Err(object_store::Error::NotFound { .. }) => Ok(()),
            Err(error) => Err(error.into()),
        }
    }

    /// Whether the store answers.
    pub async fn health(&self) -> Result<(), BlobError> {
        self.store.list_with_delimiter(None).await?;
        Ok(())
    }

    async fn create(&self, path: &Path, bytes: Bytes) -> Result<bool, BlobError> {
        let options = PutOptions { mode: PutMode::Create, ..PutOptions::default() };
        match self.store.put_opts(path, bytes.into(), options).await {
            Ok(_) => Ok(true),
            Err(object_store::Error::AlreadyExists { .. }) => Ok(false),
            Err(error) => Err(error.into()),
        }
    }
}

fn checkpoint_path(job: &str) -> Path {
    Path::from_iter(["checkpoints", job])
}

fn blob_path(id: BlobId) -> Path {
    let hex = id.hex();
    Path::from_iter(["sha256", &hex[..2], &hex[2..]])
}

fn note_path(id: BlobId) -> Path {
    let hex = id.hex();
    Path::from_iter(["inputs".to_owned(), hex[..2].to_owned(), format!("{}.json", &hex[2..])])
}

fn joined(error: tokio::task::JoinError) -> BlobError {
    BlobError::Store(object_store::Error::JoinError { source: error })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn a_blob_is_read_back_whole_and_in_ranges_and_is_stored_once() {
        let folder = tempfile::tempdir().expect("folder");
        let blobs = Blobs::in_folder(&folder.path().join("blobs")).expect("store");
        let id = blobs.put(Bytes::from_static(b"hello world")).await.expect("put");
        assert_eq!(blobs.put(Bytes::from_static(b"hello world")).await.expect("again"), id);
        assert_eq!(blobs.get(id).await.expect("get"), "hello world");
        let part: Vec<Bytes> = blobs.stream(id, Some(6..9)).await.expect("range").try_collect().await.expect("read");
        assert_eq!(part.concat(), b"wor");
        assert_eq!(id.to_string().parse(), Ok(id));
    }

    #[tokio::test]
    async fn what_is_not_there_is_missing_and_what_was_edited_is_damaged() {
        let folder = tempfile::tempdir().expect("folder");
        let blobs = Blobs::in_folder(folder.path()).expect("store");
        let id = BlobId::of(b"x");
        assert!(matches!(blobs.get(id).await, Err(BlobError::Missing)));
        assert!(matches!(blobs.note(id).await, Ok(None)));
        blobs.put(Bytes::from_static(b"x")).await.expect("put");
        std::fs::write(folder.path().join(blob_path(id).as_ref()), "y").expect("edit");
        assert!(matches!(blobs.get(id).await, Err(BlobError::Damaged(_))));
    }

    #[test]
    fn names_that_are_no_hash_are_refused() {
        for name in
            ["sha256:ab", "md5:00", &format!("sha256:{}", "AB".repeat(32)), &format!("sha256:{}", "é".repeat(32))]
        {
            assert_eq!(name.parse::<BlobId>(), Err(InvalidBlobId), "{name}");
        }
    }
}
