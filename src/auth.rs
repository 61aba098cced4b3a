//! Who asks, and what they may: by an API key of the service's own ([`key`], [`keys`]), or by a token of an OpenID Connect issuer
//! ([`issuer`]).
//!
//! Guarantees: nothing that is logged, shown or kept holds a secret; a key that is revoked stops working on every node within seconds.

pub mod issuer;
pub mod key;
pub mod keys;

pub use issuer::Refused;

use issuer::Issuer;
use key::ApiKey;
use keys::KeyRing;
use std::sync::Arc;

use crate::tenant::Tenant;
use serde::{Deserialize, Serialize};
use std::collections::BTreeSet;

/// What a caller may do.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "snake_case")]
pub enum Scope {
    /// Look at jobs, their events and outputs, and at inputs.
    Read,
    /// Upload inputs; submit, cancel and forget jobs.
    Write,
    /// See figures about the whole service, over all tenants.
    Operate,
}

impl Scope {
    /// All of them.
    pub const ALL: [Scope; 3] = [Scope::Read, Scope::Write, Scope::Operate];

    /// The name in keys, in tokens and in answers.
    pub fn name(self) -> &'static str {
        match self {
            Scope::Read => "read",
            Scope::Write => "write",
            Scope::Operate => "operate",
        }
    }

    /// The scope of that name.
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|scope| scope.name() == name)
    }
}

/// Who asks, for which tenant, and what they may.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Caller {
    tenant: Tenant,
    scopes: BTreeSet<Scope>,
}

impl Caller {
    /// Somebody of a tenant.
    pub fn new(tenant: Tenant, scopes: impl IntoIterator<Item = Scope>) -> Self {
        Self { tenant, scopes: scopes.into_iter().collect() }
    }

    /// Whoever asks where nobody says who asks: may do everything, and everything is the default tenant's.
    pub fn anybody() -> Self {
        Self::new(Tenant::default(), Scope::ALL)
    }

    /// Whose things it asks for, if it may do this with them: the only way to the tenant, so that what is to be done is said wherever
    /// anything is done.
    ///
    /// # Errors
    /// [`NotAllowed`] when its key or token has no such scope.
    pub fn may(&self, scope: Scope) -> Result<&Tenant, NotAllowed> {
        if self.scopes.contains(&scope) { Ok(&self.tenant) } else { Err(NotAllowed(scope)) }
    }

    /// Who it is, for the log and for limits.
    pub fn whose(&self) -> &Tenant {
        &self.tenant
    }
}

/// Tells who asks.
pub struct Authenticator {
    /// The service's own keys.
    pub keys: Arc<KeyRing>,
    /// An issuer whose tokens count beside them.
    pub issuer: Option<Issuer>,
}

impl Authenticator {
    /// Who asks with this key or token.
    ///
    /// # Errors
    /// When it does not count, or cannot be checked now.
    pub async fn identify(&self, bearer: &str) -> Result<Caller, Refused> {
        if ApiKey::is_meant(bearer) {
            let caller = match ApiKey::parse(bearer) {
                Some(key) => self.keys.find(&key).await,
                None => None,
            };
            // which of these it is is nobody's business but the owner's
            return caller.ok_or(Refused::Invalid("the key is unknown, revoked or expired"));
        }
        match &self.issuer {
            Some(issuer) => issuer.identify(bearer).await,
            None => Err(Refused::Invalid("this is no API key, and tokens of an issuer are not taken here")),
        }
    }
}

/// A scope that is missing.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("the scope {:?} is missing", .0.name())]
pub struct NotAllowed(pub Scope);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_caller_may_do_what_its_scopes_say() {
        let caller = Caller::new(Tenant::default(), [Scope::Read]);
        assert_eq!(caller.may(Scope::Read), Ok(&Tenant::default()));
        assert_eq!(caller.may(Scope::Write), Err(NotAllowed(Scope::Write)));
        for scope in Scope::ALL {
            assert!(Caller::anybody().may(scope).is_ok());
            assert_eq!(Scope::from_name(scope.name()), Some(scope));
        }
    }
}
