//! API keys: `shrinkd_ID_SECRET`, of which only a hash is kept.
//!
//! The secret is 256 random bits, so that one round of SHA-256 is enough: nobody can try them out, and there is nothing to slow down.
//! A key is shown once, when it is made.

use super::{Caller, Scope};
use crate::tenant::Tenant;
use aws_lc_rs::constant_time::verify_slices_are_equal;
use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use std::collections::BTreeSet;
use std::fmt::Write as _;

/// What every key begins with, so that programs which look for leaked secrets find it.
const PREFIX: &str = "shrinkd_";
/// Bytes of an id: enough for ids never to meet.
const ID_BYTES: usize = 8;
/// Bytes of a secret.
const SECRET_BYTES: usize = 32;

/// A key as its owner has it. It has no `Debug`, and is written only where it is handed over.
pub struct ApiKey<'k> {
    /// Which key it is.
    pub id: &'k str,
    secret: &'k str,
}

impl<'k> ApiKey<'k> {
    /// The key in a text; `None` when it is none.
    pub fn parse(text: &'k str) -> Option<Self> {
        let (id, secret) = text.strip_prefix(PREFIX)?.split_once('_')?;
        let hex = |text: &str, bytes: usize| {
            text.len() == 2 * bytes && text.bytes().all(|b| b.is_ascii_digit() || (b'a'..=b'f').contains(&b))
        };
        (hex(id, ID_BYTES) && hex(secret, SECRET_BYTES)).then_some(Self { id, secret })
    }

    /// Whether a text means to be a key.
    pub fn is_meant(text: &str) -> bool {
        text.starts_with(PREFIX)
    }
}

/// What is kept of a key.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct StoredKey {
    /// Which key it is.
    pub id: String,
    /// SHA-256 of the secret, hexadecimal.
    hash: String,
    /// Whose it is.
    pub tenant: Tenant,
    /// What it allows.
    pub scopes: BTreeSet<Scope>,
    /// What people call it; may be empty.
    pub name: String,
    /// When it was made.
    pub created_at: Timestamp,
    /// When it stops working; never when there is none.
    pub expires_at: Option<Timestamp>,
    /// When it was revoked.
    pub revoked_at: Option<Timestamp>,
}

/// What a new key is to be.
#[derive(Clone, Debug)]
pub struct NewKey {
    /// Whose it is.
    pub tenant: Tenant,
    /// What it allows.
    pub scopes: BTreeSet<Scope>,
    /// What people call it; may be empty.
    pub name: String,
    /// When it stops working.
    pub expires_at: Option<Timestamp>,
}

/// The system gives no random numbers.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("the system gives no random numbers")]
pub struct NoRandomness;

impl StoredKey {
    /// Makes a key: what is kept of it, and the key itself, which is to be shown once.
    ///
    /// # Errors
    /// [`NoRandomness`].
    pub fn make(new: NewKey) -> Result<(Self, String), NoRandomness> {
        let (id, secret) = (random_hex::<ID_BYTES>()?, random_hex::<SECRET_BYTES>()?);
        let key = format!("{PREFIX}{id}_{secret}");
        let NewKey { tenant, scopes, name, expires_at } = new;
        let hash = hash(&secret);
        let (created_at, revoked_at) = (Timestamp::now(), None);
        Ok((Self { id, hash, tenant, scopes, name, created_at, expires_at, revoked_at }, key))
    }

    /// Who asks with this key, if it is the one that is kept here and works at `now`.
    pub fn check(&self, key: &ApiKey<'_>, now: Timestamp) -> Option<Caller> {
        let is_same = verify_slices_are_equal(hash(key.secret).as_bytes(), self.hash.as_bytes()).is_ok();
        (is_same && self.id == key.id && self.works(now)).then(|| Caller::new(self.tenant.clone(), self.scopes.clone()))
    }

    /// Whether it is neither revoked nor expired.
    pub fn works(&self, now: Timestamp) -> bool {
        self.revoked_at.is_none() && self.expires_at.is_none_or(|end| now < end)
    }
}

fn hash(secret: &str) -> String {
    hex(&Sha256::digest(secret.as_bytes()))
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().fold(String::new(), |mut text, byte| {
        // writing to a string cannot fail
        let _ = write!(text, "{byte:02x}");
        text
    })
}

fn random_hex<const BYTES: usize>() -> Result<String, NoRandomness> {
    let mut bytes = [0u8; BYTES];
    aws_lc_rs::rand::fill(&mut bytes).map_err(|_| NoRandomness)?;
    Ok(hex(&bytes))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn made(expires_at: Option<Timestamp>) -> (StoredKey, String) {
        let tenant = "a".parse().expect("a name");
        StoredKey::make(NewKey { tenant, scopes: [Scope::Read].into(), name: String::new(), expires_at })
            .expect("makes")
    }

    #[test]
    fn only_the_key_itself_opens() {
        let now = Timestamp::now();
        let ((stored, key), (_, other)) = (made(None), made(None));
        let read = ApiKey::parse(&key).expect("is one");
        let caller = stored.check(&read, now).expect("opens");
        assert_eq!((caller.whose().name(), caller.may(Scope::Read).is_ok()), ("a", true));
        assert!(caller.may(Scope::Write).is_err());
        assert!(stored.check(&ApiKey::parse(&other).expect("is one"), now).is_none());
        let forged = format!("{PREFIX}{}_{}", stored.id, other.rsplit('_').next().expect("a secret"));
        assert!(stored.check(&ApiKey::parse(&forged).expect("is one"), now).is_none());
    }

    #[test]
    fn a_key_ends_when_it_is_revoked_or_expires() {
        let now = Timestamp::now();
        let (stored, key) = made(Some(now + jiff::SignedDuration::from_secs(60)));
        let key = ApiKey::parse(&key).expect("is one");
        assert!(stored.check(&key, now).is_some());
        assert!(stored.check(&key, now + jiff::SignedDuration::from_secs(60)).is_none());
        assert!(StoredKey { revoked_at: Some(now), ..stored }.check(&key, now).is_none());
    }

    #[test]
    fn nothing_that_is_kept_or_shown_holds_the_secret() {
        let (stored, key) = made(None);
        let secret = key.rsplit('_').next().expect("a secret");
        assert_eq!((key.len(), secret.len()), (PREFIX.len() + 2 * ID_BYTES + 1 + 64, 64));
        assert!(!format!("{stored:?}").contains(secret));
        assert!(!serde_json::to_string(&stored).expect("writes").contains(secret));
    }

    #[test]
    fn what_is_no_key_is_told_at_once() {
        let (_, key) = made(None);
        let upper = key.to_uppercase();
        for text in ["", "shrinkd_", "shrinkd_a_b", &key[1..], &key[..key.len() - 1], upper.as_str()] {
            assert!(ApiKey::parse(text).is_none(), "{text:?}");
        }
    }
}
