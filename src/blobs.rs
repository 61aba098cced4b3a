//! Inputs and outputs by the hash of their content, on `object_store`: in a folder, or in a bucket that speaks S3.
//!
//! Guarantees: what [`Blobs::put`] returned is in the store (in a folder: file and folder synced) under its SHA-256 and never
//! changes; a half-written blob is never visible; a blob that was put or touched is kept for [`Blobs::GRACE`] at least, whether or not
//! anything names it. Not guaranteed: that a blob is still what it was after the store was edited by hand; [`Blobs::get`] checks
//! the hash, ranges do not.

mod id;
mod measured;
mod place;

pub use id::{BlobId, InvalidBlobId};
pub use place::PlaceError;

use crate::tenant::Tenant;
use bytes::Bytes;
use futures::stream::BoxStream;
use futures::{StreamExt, TryStreamExt};
use jiff::Timestamp;
use object_store::path::Path;
use object_store::{GetOptions, GetRange, ObjectMeta, ObjectStore, ObjectStoreExt, PutMode, PutOptions};
use place::Place;
use std::ops::Range;
use std::sync::Arc;
use std::time::Duration;
use tokio::sync::{OwnedRwLockReadGuard, OwnedRwLockWriteGuard, RwLock};

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
    place: Place,
    /// Equal outputs of two jobs are one blob: on one node nothing may be removed between the moment that a job's output was found
    /// to be there already and the moment that the job's record names it. Between nodes [`Blobs::GRACE`] does the same.
    promises: Arc<RwLock<()>>,
}

impl Blobs {
    /// How long a blob is kept after it was put or touched, for a record to come to name it.
    pub const GRACE: Duration = Duration::from_secs(60 * 60);
    /// Age at which a blob that is put again, or named by a new job, is made young again: long before it may be removed.
    const AGED: Duration = Duration::from_secs(20 * 60);

    /// Blobs in a folder, which is made when it is not there. Every write is synced to the disk.
    ///
    /// # Errors
    /// When the folder cannot be made.
    pub fn in_folder(folder: &std::path::Path) -> Result<Self, PlaceError> {
        Ok(Self { place: Place::folder(folder)?, promises: Arc::default() })
    }

    /// Blobs in the bucket of `s3://BUCKET/PREFIX`; the rest is what the `AWS_*` variables of the environment say.
    ///
    /// # Errors
    /// When the address or a variable is wrong. The bucket is not looked at: [`Blobs::probe`] does that.
    pub fn in_bucket(url: &str) -> Result<Self, PlaceError> {
        Ok(Self { place: Place::bucket(url)?, promises: Arc::default() })
    }

    /// Whether every node that is given this store's address sees the same blobs.
    pub fn are_shared(&self) -> bool {
        self.place.is_shared()
    }

    /// Writes something twice, and tells whether the store refused the second time, as it must for two nodes not to write over each
    /// other.
    ///
    /// # Errors
    /// When the store cannot be written to.
    pub async fn probe(&self) -> Result<bool, BlobError> {
        let path = Path::from_iter(["probes".to_owned(), uuid::Uuid::now_v7().to_string()]);
        let (first, second) =
            (self.create(&path, Bytes::from_static(b"1")).await?, self.create(&path, Bytes::from_static(b"2")).await);
        self.delete(&path).await?;
        Ok(first && matches!(second, Ok(false)))
    }

    /// An address at which a client can read a blob for so long without asking this service; `None` where the store has no such
    /// thing.
    pub async fn signed_link(&self, id: BlobId, valid: Duration) -> Result<Option<String>, BlobError> {
        Ok(self.place.signed_link(&blob_path(id), valid).await?)
    }

    /// While this guard lives no blob is removed. Held from before a blob is put until a record names it.
    pub async fn promise(&self) -> OwnedRwLockReadGuard<()> {
        self.promises.clone().read_owned().await
    }
    /// While this guard lives no blob is promised. Held from before a record is forgotten until its blobs are removed.
    pub async fn sweep(&self) -> OwnedRwLockWriteGuard<()> {
        self.promises.clone().write_owned().await
    }

    /// Stores bytes that a client sent under their hash, and writes them whether or not they are there: the time that it takes tells
    /// nobody whether somebody else has sent the same.
    pub async fn put_unseen(&self, bytes: Bytes) -> Result<BlobId, BlobError> {
        let (id, bytes) = tokio::task::spawn_blocking(move || (BlobId::of(&bytes), bytes)).await.map_err(joined)?;
        self.store().put(&blob_path(id), bytes.into()).await?;
        Ok(id)
    }

    /// Stores bytes under their hash. Storing the same bytes again changes nothing.
    pub async fn put(&self, bytes: Bytes) -> Result<BlobId, BlobError> {
        let (id, bytes) = tokio::task::spawn_blocking(move || (BlobId::of(&bytes), bytes)).await.map_err(joined)?;
        if !self.create(&blob_path(id), bytes.clone()).await? {
            self.make_young(&blob_path(id), bytes).await?;
        }
        Ok(id)
    }

    /// Makes a tenant's input that is about to be named young again, should it have come into years. `false` when the tenant has no
    /// such input; whether another has is not looked at.
    pub async fn touch(&self, tenant: &Tenant, id: BlobId) -> Result<bool, BlobError> {
        for path in [note_path(tenant, id), blob_path(id)] {
            let meta = match self.store().head(&path).await {
                Ok(meta) => meta,
                Err(object_store::Error::NotFound { .. }) => return Ok(false),
                Err(error) => return Err(error.into()),
            };
            if is_older(&meta, Self::AGED) {
                let bytes = self.store().get(&path).await?.bytes().await?;
                self.store().put(&path, bytes.into()).await?;
            }
        }
        Ok(true)
    }

    /// Blobs that were neither put nor touched for so long, at least [`Blobs::GRACE`].
    pub fn older_than(&self, age: Duration) -> BoxStream<'static, Result<BlobId, BlobError>> {
        let age = age.max(Self::GRACE);
        let all = self.store().list(Some(&Path::from(BLOBS)));
        let old = all.try_filter_map(move |meta| {
            let id = is_older(&meta, age).then(|| blob_of(&meta.location)).flatten();
            std::future::ready(Ok(id))
        });
        old.map_err(BlobError::from).boxed()
    }

    /// Removes a blob that is no tenant's input, unless it was made young since it was listed. Tells whether it did.
    pub async fn remove_older(&self, id: BlobId, age: Duration) -> Result<bool, BlobError> {
        self.remove_if_older(&blob_path(id), age).await
    }

    /// The inputs that their tenants neither uploaded nor named for so long, at least [`Blobs::GRACE`].
    pub fn notes_older_than(&self, age: Duration) -> BoxStream<'static, Result<(Tenant, BlobId), BlobError>> {
        let age = age.max(Self::GRACE);
        let all = self.store().list(Some(&Path::from(NOTES)));
        let old = all.try_filter_map(move |meta| {
            std::future::ready(Ok(is_older(&meta, age).then(|| noted_at(&meta.location)).flatten()))
        });
        old.map_err(BlobError::from).boxed()
    }

    /// Removes what describes a tenant's input, unless it was made young since it was listed. Tells whether it did.
    pub async fn remove_older_note(&self, tenant: &Tenant, id: BlobId, age: Duration) -> Result<bool, BlobError> {
        self.remove_if_older(&note_path(tenant, id), age).await
    }

    /// Whether a blob is an input of any tenant.
    pub async fn is_input(&self, id: BlobId) -> Result<bool, BlobError> {
        match self.store().head(&note_path(&Tenant::default(), id)).await {
            Ok(_) => return Ok(true),
            Err(object_store::Error::NotFound { .. }) => {}
            Err(error) => return Err(error.into()),
        }
        let others = Path::from_iter(note_folder(id));
        Ok(self.store().list(Some(&others)).try_next().await?.is_some())
    }

    async fn remove_if_older(&self, path: &Path, age: Duration) -> Result<bool, BlobError> {
        match self.store().head(path).await {
            Ok(meta) if is_older(&meta, age.max(Self::GRACE)) => {}
            Ok(_) | Err(object_store::Error::NotFound { .. }) => return Ok(false),
            Err(error) => return Err(error.into()),
        }
        self.delete(path).await?;
        Ok(true)
    }

    /// The jobs whose checkpoints were not written for so long, by tenant and name.
    pub fn checkpoints_older_than(&self, age: Duration) -> BoxStream<'static, Result<(Tenant, String), BlobError>> {
        let all = self.store().list(Some(&Path::from(CHECKPOINTS)));
        let old = all.try_filter_map(move |meta| {
            std::future::ready(Ok(is_older(&meta, age).then(|| checkpoint_at(&meta.location)).flatten()))
        });
        old.map_err(BlobError::from).boxed()
    }

    /// The whole blob, its hash checked.
    pub async fn get(&self, id: BlobId) -> Result<Bytes, BlobError> {
        let bytes = self.store().get(&blob_path(id)).await?.bytes().await?;
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
        let result = self.store().get_opts(&blob_path(id), options).await?;
        Ok(result.into_stream().map_err(BlobError::from).boxed())
    }

    /// Writes the note that describes a tenant's input, and makes the blob known to that tenant. The first one stays.
    pub async fn put_note(&self, tenant: &Tenant, id: BlobId, note: Bytes) -> Result<(), BlobError> {
        self.create(&note_path(tenant, id), note).await.map(|_| ())
    }

    /// The note that describes a tenant's input; `None` when the tenant has no such input.
    pub async fn note(&self, tenant: &Tenant, id: BlobId) -> Result<Option<Bytes>, BlobError> {
        match self.store().get(&note_path(tenant, id)).await {
            Ok(found) => Ok(Some(found.bytes().await?)),
            Err(object_store::Error::NotFound { .. }) => Ok(None),
            Err(error) => Err(error.into()),
        }
    }

    /// Removes a blob; one that is not there is no error. Where other nodes may be about to name it, nothing happens: what is named by
    /// nobody is removed when it is old.
    pub async fn remove(&self, id: BlobId) -> Result<(), BlobError> {
        if self.are_shared() {
            return Ok(());
        }
        self.delete(&blob_path(id)).await
    }

    /// Writes the checkpoint of a job over the one before. Whoever writes it, it is the state of the same computation.
    pub async fn put_checkpoint(&self, tenant: &Tenant, job: &str, bytes: Bytes) -> Result<(), BlobError> {
        self.store().put(&checkpoint_path(tenant, job), bytes.into()).await?;
        Ok(())
    }

    /// The checkpoint of a job, if it has one.
    pub async fn checkpoint(&self, tenant: &Tenant, job: &str) -> Result<Option<Bytes>, BlobError> {
        match self.store().get(&checkpoint_path(tenant, job)).await {
            Ok(found) => Ok(Some(found.bytes().await?)),
            Err(object_store::Error::NotFound { .. }) => Ok(None),
            Err(error) => Err(error.into()),
        }
    }

    /// Removes the checkpoint of a job; one that is not there is no error.
    pub async fn remove_checkpoint(&self, tenant: &Tenant, job: &str) -> Result<(), BlobError> {
        self.delete(&checkpoint_path(tenant, job)).await
    }

    /// Whether the store answers.
    pub async fn health(&self) -> Result<(), BlobError> {
        self.store().list_with_delimiter(None).await?;
        Ok(())
    }

    fn store(&self) -> &Arc<dyn ObjectStore> {
        self.place.store()
    }

    async fn delete(&self, path: &Path) -> Result<(), BlobError> {
        match self.store().delete(path).await {
            Ok(()) | Err(object_store::Error::NotFound { .. }) => Ok(()),
            Err(error) => Err(error.into()),
        }
    }

    /// Writes what is there already once more, if it is aged or has gone meanwhile.
    async fn make_young(&self, path: &Path, bytes: Bytes) -> Result<(), BlobError> {
        match self.store().head(path).await {
            Ok(meta) if !is_older(&meta, Self::AGED) => return Ok(()),
            Ok(_) | Err(object_store::Error::NotFound { .. }) => {}
            Err(error) => return Err(error.into()),
        }
        self.store().put(path, bytes.into()).await?;
        Ok(())
    }

    async fn create(&self, path: &Path, bytes: Bytes) -> Result<bool, BlobError> {
        let options = PutOptions { mode: PutMode::Create, ..PutOptions::default() };
        match self.store().put_opts(path, bytes.into(), options).await {
            Ok(_) => Ok(true),
            Err(object_store::Error::AlreadyExists { .. }) => Ok(false),
            Err(error) => Err(error.into()),
        }
    }
}

/// Folders of the store.
const BLOBS: &str = "sha256";
const CHECKPOINTS: &str = "checkpoints";

const NOTES: &str = "inputs";

/// `checkpoints/JOB` of the default tenant, as before there were tenants, and `checkpoints/TENANT/JOB` of the others.
fn checkpoint_path(tenant: &Tenant, job: &str) -> Path {
    match tenant.is_default() {
        true => Path::from_iter([CHECKPOINTS, job]),
        false => Path::from_iter([CHECKPOINTS, tenant.name(), job]),
    }
}

/// Whose checkpoint lies at a path, and of which job.
fn checkpoint_at(path: &Path) -> Option<(Tenant, String)> {
    let parts: Vec<_> = path.parts().collect();
    match &parts[..] {
        [_, job] => Some((Tenant::default(), job.as_ref().to_owned())),
        [_, tenant, job] => Some((tenant.as_ref().parse().ok()?, job.as_ref().to_owned())),
        _ => None,
    }
}

fn blob_path(id: BlobId) -> Path {
    let hex = id.hex();
    Path::from_iter([BLOBS, &hex[..2], &hex[2..]])
}

/// The blob that lies at a path.
fn blob_of(path: &Path) -> Option<BlobId> {
    let digits: Vec<_> = path.parts().skip(1).collect();
    BlobId::from_hex(&digits.iter().map(AsRef::as_ref).collect::<String>())
}

/// Whether something was last written so long ago, by this node's clock and the store's.
fn is_older(meta: &ObjectMeta, age: Duration) -> bool {
    let written = meta.last_modified.timestamp_millis();
    Timestamp::now().as_millisecond().saturating_sub(written) > age.as_millis() as i64
}

fn note_folder(id: BlobId) -> [String; 3] {
    let hex = id.hex();
    [NOTES.to_owned(), hex[..2].to_owned(), hex[2..].to_owned()]
}

/// `inputs/HA/SH.json` of the default tenant, as before there were tenants, and `inputs/HA/SH/TENANT.json` of the others.
fn note_path(tenant: &Tenant, id: BlobId) -> Path {
    let [notes, first, rest] = note_folder(id);
    match tenant.is_default() {
        true => Path::from_iter([notes, first, format!("{rest}.json")]),
        false => Path::from_iter([notes, first, rest, format!("{tenant}.json")]),
    }
}

/// Whose note lies at a path, and of which blob.
fn noted_at(path: &Path) -> Option<(Tenant, BlobId)> {
    let parts: Vec<_> = path.parts().collect();
    let name = parts.last()?.as_ref().strip_suffix(".json")?;
    match &parts[..] {
        [_, first, _] => Some((Tenant::default(), BlobId::from_hex(&format!("{}{name}", first.as_ref()))?)),
        [_, first, rest, _] => {
            let id = BlobId::from_hex(&format!("{}{}", first.as_ref(), rest.as_ref()))?;
            Some((name.parse().ok()?, id))
        }
        _ => None,
    }
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
    async fn what_describes_an_input_is_each_tenants_own() {
        let folder = tempfile::tempdir().expect("folder");
        let blobs = Blobs::in_folder(folder.path()).expect("store");
        let [own, other] = ["default", "a.b"].map(|name| name.parse::<Tenant>().expect("a name"));
        let id = blobs.put_unseen(Bytes::from_static(b"x")).await.expect("puts");
        assert_eq!(blobs.put_unseen(Bytes::from_static(b"x")).await.expect("again"), id);
        assert!(!blobs.is_input(id).await.expect("answers"));
        for (tenant, stranger) in [(&own, &other), (&other, &own)] {
            blobs.put_note(tenant, id, Bytes::from_static(b"note")).await.expect("notes");
            assert!(blobs.touch(tenant, id).await.expect("touches") && blobs.is_input(id).await.expect("answers"));
            assert!(!blobs.touch(stranger, id).await.expect("answers"));
            assert_eq!(blobs.note(stranger, id).await.expect("answers"), None);
            assert_eq!(noted_at(&note_path(tenant, id)), Some((tenant.clone(), id)));
            assert_eq!(checkpoint_at(&checkpoint_path(tenant, "job")), Some((tenant.clone(), "job".to_owned())));
            blobs.delete(&note_path(tenant, id)).await.expect("deletes");
        }
    }

    #[tokio::test]
    async fn what_is_not_there_is_missing_and_what_was_edited_is_damaged() {
        let folder = tempfile::tempdir().expect("folder");
        let blobs = Blobs::in_folder(folder.path()).expect("store");
        let id = BlobId::of(b"x");
        assert!(matches!(blobs.get(id).await, Err(BlobError::Missing)));
        assert!(matches!(blobs.note(&Tenant::default(), id).await, Ok(None)));
        blobs.put(Bytes::from_static(b"x")).await.expect("put");
        std::fs::write(folder.path().join(blob_path(id).as_ref()), "y").expect("edit");
        assert!(matches!(blobs.get(id).await, Err(BlobError::Damaged(_))));
    }
}
