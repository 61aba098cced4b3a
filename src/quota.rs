//! How much of the service one tenant may have, so that it is there for the others.
//!
//! What a tenant has at once (jobs that wait, jobs that run) and what its jobs cost within an hour (vertices asked for, seconds
//! computed) is judged by the [engine](crate::engine), which knows the jobs of every node. How often a tenant asks, how many bytes
//! it uploads and how many streams it has open is judged where the requests arrive, by each node for itself.

use crate::tenant::Tenant;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::time::Duration;

/// The time over which vertices, seconds and uploaded bytes are counted; it ends now.
pub const HOUR: Duration = Duration::from_secs(3600);
/// The time over which requests are counted.
pub const MINUTE: Duration = Duration::from_secs(60);

/// What one tenant may have; 0 is no limit.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Quota {
    /// Jobs that wait.
    pub queued: u64,
    /// Jobs that run at once, over all nodes. More of them wait.
    pub running: u64,
    /// Vertices of the surfaces that are asked for within an hour.
    pub vertices_per_hour: u64,
    /// Seconds for which the jobs that stopped within an hour have run. What runs now counts when it stops.
    pub seconds_per_hour: u64,
    /// Bytes of the inputs that are uploaded to a node within an hour.
    pub upload_bytes_per_hour: u64,
    /// Requests to a node within a minute.
    pub requests_per_minute: u64,
    /// Streams of events, long polls and downloads over gRPC that are open at a node.
    pub streams: u64,
}

/// What a tenant may have that is not what every tenant may.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Exception {
    /// As [`Quota::queued`].
    pub queued: Option<u64>,
    /// As [`Quota::running`].
    pub running: Option<u64>,
    /// As [`Quota::vertices_per_hour`].
    pub vertices_per_hour: Option<u64>,
    /// As [`Quota::seconds_per_hour`].
    pub seconds_per_hour: Option<u64>,
    /// As [`Quota::upload_bytes_per_hour`].
    pub upload_bytes_per_hour: Option<u64>,
    /// As [`Quota::requests_per_minute`].
    pub requests_per_minute: Option<u64>,
    /// As [`Quota::streams`].
    pub streams: Option<u64>,
}

/// What every tenant may have.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Quotas {
    /// Those that are not named.
    pub default: Quota,
    /// Those that are, in what is said of them.
    pub tenants: BTreeMap<Tenant, Exception>,
}

impl Quotas {
    /// What a tenant may have.
    pub fn of(&self, tenant: &Tenant) -> Quota {
        let (every, own) = (self.default, self.tenants.get(tenant).copied().unwrap_or_default());
        Quota {
            queued: own.queued.unwrap_or(every.queued),
            running: own.running.unwrap_or(every.running),
            vertices_per_hour: own.vertices_per_hour.unwrap_or(every.vertices_per_hour),
            seconds_per_hour: own.seconds_per_hour.unwrap_or(every.seconds_per_hour),
            upload_bytes_per_hour: own.upload_bytes_per_hour.unwrap_or(every.upload_bytes_per_hour),
            requests_per_minute: own.requests_per_minute.unwrap_or(every.requests_per_minute),
            streams: own.streams.unwrap_or(every.streams),
        }
    }
}

/// A quota that does not let something through.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Exceeded {
    /// Its name, as in the configuration.
    pub quota: &'static str,
    /// How much of it there is.
    pub limit: u64,
    /// The time over which it is counted; none for what is had at once.
    pub window: Option<Duration>,
    /// How much is left.
    pub left: u64,
    /// When there may be more.
    pub retry_after: Duration,
}

#[cfg(test)]
mod tests {
    use super::*;
    use figment::providers::{Format, Toml};

    #[test]
    fn an_exception_is_one_in_what_it_says_and_for_whom_it_names() {
        let text = "[default]\nqueued = 10\nrunning = 2\n[tenants.\"a.b\"]\nqueued = 100\nrequests_per_minute = 0";
        let quotas: Quotas = figment::Figment::from(Toml::string(text)).extract().expect("reads");
        let (named, other) = (quotas.of(&"a.b".parse().expect("a name")), quotas.of(&Tenant::default()));
        assert_eq!((named.queued, named.running, named.requests_per_minute), (100, 2, 0));
        assert_eq!((other.queued, other.running), (10, 2));
    }
}
