//! Where blobs lie: a folder of this machine, or a bucket that every node reaches.

use super::measured::Measured;
use object_store::aws::{AmazonS3, AmazonS3Builder};
use object_store::local::LocalFileSystem;
use object_store::path::Path;
use object_store::prefix::PrefixStore;
use object_store::signer::Signer;
use object_store::{ClientOptions, ObjectStore, RetryConfig};
use std::sync::Arc;
use std::time::Duration;

/// Time for one request to the bucket; an object of a few hundred megabytes takes less over any network that a worker should have.
const REQUEST: Duration = Duration::from_secs(60);
/// Time and tries for a request that fails: short enough for a client that waits for its upload.
const RETRY_FOR: Duration = Duration::from_secs(20);
const RETRIES: usize = 4;

/// Why there is no store at an address.
#[derive(Debug, thiserror::Error)]
pub enum PlaceError {
    /// The folder cannot be made.
    #[error("{path}: {source}")]
    Folder {
        /// The folder.
        path: std::path::PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// The address is none of a bucket.
    #[error("{0:?} is no address of a bucket: expected s3://BUCKET or s3://BUCKET/PREFIX")]
    Address(String),
    /// The store cannot be opened.
    #[error("blob store: {0}")]
    Store(#[from] object_store::Error),
}

/// A store, and what only some stores can.
#[derive(Clone, Debug)]
pub struct Place {
    store: Arc<dyn ObjectStore>,
    /// The bucket, and the path in front of all others.
    bucket: Option<(Arc<AmazonS3>, Path)>,
}

impl Place {
    /// A folder, which is made when it is not there.
    pub fn folder(folder: &std::path::Path) -> Result<Self, PlaceError> {
        std::fs::create_dir_all(folder).map_err(|source| PlaceError::Folder { path: folder.to_owned(), source })?;
        let store = LocalFileSystem::new_with_prefix(folder)?.with_fsync(true);
        Ok(Self { store: Arc::new(Measured(Arc::new(store))), bucket: None })
    }

    /// `s3://BUCKET/PREFIX`.
    pub fn bucket(url: &str) -> Result<Self, PlaceError> {
        let wrong = || PlaceError::Address(url.to_owned());
        let (bucket, prefix) = url.strip_prefix("s3://").ok_or_else(wrong)?.split_once('/').unwrap_or((&url[5..], ""));
        if bucket.is_empty() || bucket.contains(['?', '#', '@', ' ']) {
            return Err(wrong());
        }
        let retry = RetryConfig { max_retries: RETRIES, retry_timeout: RETRY_FOR, ..RetryConfig::default() };
        let s3 = AmazonS3Builder::from_env()
            .with_bucket_name(bucket)
            .with_client_options(client_options().with_timeout(REQUEST))
            .with_retry(retry)
            .build()?;
        let (s3, prefix) = (Arc::new(s3), Path::from(prefix));
        let store = PrefixStore::new(s3.clone(), prefix.clone());
        Ok(Self { store: Arc::new(Measured(Arc::new(store))), bucket: Some((s3, prefix)) })
    }

    /// The store.
    pub fn store(&self) -> &Arc<dyn ObjectStore> {
        &self.store
    }

    /// Whether other nodes have the same store.
    pub fn is_shared(&self) -> bool {
        self.bucket.is_some()
    }

    /// An address that needs no credentials for so long.
    pub async fn signed_link(&self, path: &Path, valid: Duration) -> Result<Option<String>, object_store::Error> {
        let Some((s3, prefix)) = &self.bucket else { return Ok(None) };
        let whole = Path::from_iter(prefix.parts().chain(path.parts()));
        let url = s3.signed_url(http::Method::GET, &whole, valid).await?;
        Ok(Some(url.to_string()))
    }
}

/// Options of the client, with those of the environment that its builder would have taken.
fn client_options() -> ClientOptions {
    let allow_http = std::env::var("AWS_ALLOW_HTTP").is_ok_and(|value| value.eq_ignore_ascii_case("true"));
    ClientOptions::new().with_allow_http(allow_http)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_address_that_is_none_of_a_bucket_is_refused() {
        for url in ["", "s3://", "s3:///x", "http://bucket", "s3://user@bucket/x", "bucket"] {
            assert!(matches!(Place::bucket(url), Err(PlaceError::Address(_))), "{url}");
        }
    }
}
