//! Whose something is.
//!
//! Jobs, idempotency keys and descriptions of inputs belong to one tenant each. Every question about them names the tenant
//! that asks, and is answered as if nothing but that tenant's existed: what belongs to another is looked up under a name that
//! is not there, on the same way as what never was, so that neither the answer nor its time tells them apart.

use serde::{Deserialize, Serialize};
use std::fmt;
use std::sync::Arc;

/// Characters of a name at most.
const MAX_LENGTH: usize = 64;

/// The name of a tenant: 1 to 64 of `a-z`, `0-9`, `.`, `_` and `-`, the first a letter or a digit.
#[derive(Clone, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct Tenant(Arc<str>);

/// What is no name of a tenant.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("expected a tenant's name: 1 to {MAX_LENGTH} of a-z, 0-9, '.', '_' and '-', the first a letter or a digit")]
pub struct InvalidTenant;

impl Tenant {
    /// Whose everything is where nobody says who asks, and was before there were tenants.
    pub const DEFAULT: &'static str = "default";

    /// The name.
    pub fn name(&self) -> &str {
        &self.0
    }

    /// Whether it is the default tenant, whose things have the names that they had before there were tenants.
    pub fn is_default(&self) -> bool {
        &*self.0 == Self::DEFAULT
    }
}

impl Default for Tenant {
    fn default() -> Self {
        Self(Self::DEFAULT.into())
    }
}

impl std::str::FromStr for Tenant {
    type Err = InvalidTenant;

    fn from_str(name: &str) -> Result<Self, InvalidTenant> {
        let plain = |b: u8| b.is_ascii_lowercase() || b.is_ascii_digit();
        let fits = name.len() <= MAX_LENGTH
            && name.bytes().next().is_some_and(plain)
            && name.bytes().all(|b| plain(b) || matches!(b, b'.' | b'_' | b'-'));
        if fits { Ok(Self(name.into())) } else { Err(InvalidTenant) }
    }
}

impl TryFrom<String> for Tenant {
    type Error = InvalidTenant;

    fn try_from(name: String) -> Result<Self, InvalidTenant> {
        name.parse()
    }
}

impl From<Tenant> for String {
    fn from(tenant: Tenant) -> Self {
        tenant.0.as_ref().to_owned()
    }
}

impl fmt::Display for Tenant {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

impl fmt::Debug for Tenant {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Tenant({})", self.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_name_is_short_and_plain() {
        for name in ["default", "a", "0", "team-7", "a.b_c", &"x".repeat(MAX_LENGTH)] {
            assert_eq!(name.parse::<Tenant>().expect(name).name(), name);
        }
        let long = "x".repeat(MAX_LENGTH + 1);
        for name in ["", ".", "..", "-a", "A", "a b", "a/b", "a*", "ä", "a\n", long.as_str()] {
            assert_eq!(name.parse::<Tenant>(), Err(InvalidTenant), "{name:?}");
            assert!(serde_json::from_value::<Tenant>(name.into()).is_err(), "{name:?}");
        }
        assert!(Tenant::default().is_default());
        assert_eq!(serde_json::to_value(Tenant::default()).expect("writes"), "default");
    }
}
