//! What a configuration asks for that will not work, or not as it seems. Nothing here keeps the service from starting: what could only be
//! a mistake is refused when the configuration is read.

use super::{AuthMode, Config, FOLDER, Role, SQLITE};
use crate::job::memory;
use crate::shrink::lattice::LatticeSpec;

/// A heartbeat comes every third of a lease, and the engine may take so long to store it. A lease must not end over one that is late.
const LEAST_LEASE_S: u64 = 9;

impl Config {
    /// One sentence for everything that will not work, beginning with the name of the setting.
    pub fn warnings(&self) -> Vec<String> {
        let cluster = self.engine != SQLITE;
        let job_memory = self.limits.job_bytes;
        let worker_memory = (self.role != Role::Api).then(|| self.worker_memory()).flatten();
        let least_job = memory::of_least_job();
        let default_job = LatticeSpec::default().vertices();
        let quotas = &self.quotas.default;
        let oidc = &self.auth.oidc;
        let said = |wrong: bool, what: String| wrong.then_some(what);
        let list = [
            said(
                !self.listen.ip().is_loopback() && self.auth.mode == AuthMode::None && self.role != Role::Worker,
                "listen: beyond loopback without authentication, so whoever reaches this address can use it".to_owned(),
            ),
            said(
                cluster && self.blobs == FOLDER,
                "blobs: they are in this node's folder, and other nodes of the cluster do not see them unless they share it".to_owned(),
            ),
            said(
                self.blobs == FOLDER && self.download_link_s > 0,
                "download_link_s: does nothing, because blobs in a folder have no links".to_owned(),
            ),
            said(
                self.worker.lease_s < LEAST_LEASE_S,
                format!(
                    "worker.lease_s: {} s are shorter than a heartbeat may take, so jobs will be run again without need; at least \
                     {LEAST_LEASE_S}",
                    self.worker.lease_s
                ),
            ),
            said(
                worker_memory.is_some_and(|bytes| bytes < least_job),
                format!("worker.memory_bytes: every job is taken to need at least {least_job} bytes, so this worker runs none"),
            ),
            said(
                worker_memory.is_some_and(|bytes| job_memory > bytes),
                "limits.job_bytes: more than worker.memory_bytes, so jobs are accepted that this worker fails".to_owned(),
            ),
            said(
                job_memory > 0 && job_memory < least_job,
                format!("limits.job_bytes: every job is taken to need at least {least_job} bytes, so none is accepted"),
            ),
            said(
                (1..default_job).contains(&quotas.vertices_per_hour),
                format!("quotas.default.vertices_per_hour: a job has {default_job} vertices unless it says otherwise, so none is accepted"),
            ),
            said(
                quotas.upload_bytes_per_hour > 0 && quotas.upload_bytes_per_hour < self.limits.input_bytes,
                "quotas.default.upload_bytes_per_hour: less than limits.input_bytes, so the largest inputs are never accepted".to_owned(),
            ),
            said(
                self.limits.upload_bytes < self.limits.input_bytes,
                "limits.upload_bytes: less than limits.input_bytes, so the largest inputs are never accepted".to_owned(),
            ),
            said(
                oidc.issuer.is_empty() && !(oidc.audience.is_empty() && oidc.jwks_url.is_empty()),
                "auth.oidc.audience, auth.oidc.jwks_url: do nothing without auth.oidc.issuer".to_owned(),
            ),
            said(
                self.webhooks.is_in_use() && self.webhooks.base_url.is_empty(),
                "webhooks.base_url: empty, so the links in notices are paths without a host".to_owned(),
            ),
        ];
        list.into_iter().flatten().collect()
    }
}

#[cfg(test)]
mod tests {
    use super::super::*;
    use crate::quota::{Quota, Quotas};

    #[test]
    fn the_defaults_warn_of_nothing() {
        assert_eq!(Config::default().warnings(), Vec::<String>::new());
    }

    #[test]
    fn every_setting_that_cannot_work_is_named() {
        let usual = Config::default;
        let worker = |worker: WorkerConfig| Config { worker, ..usual() };
        let quota = |default: Quota| Config { quotas: Quotas { default, ..Quotas::default() }, ..usual() };
        let secret = Secret::try_from("whsec_MfKQ9r8GKYqrTwjUPD8ILPZIo2LaLaSw".to_owned()).expect("a secret");
        let cases = [
            ("listen", Config { listen: "0.0.0.0:80".parse().expect("an address"), ..usual() }),
            ("blobs", Config { engine: "nats://127.0.0.1:4222".to_owned(), ..usual() }),
            ("download_link_s", Config { download_link_s: 60, ..usual() }),
            ("worker.lease_s", worker(WorkerConfig { lease_s: 2, ..usual().worker })),
            ("worker.memory_bytes", worker(WorkerConfig { memory_bytes: 1 << 20, ..usual().worker })),
            (
                "limits.job_bytes",
                Config {
                    limits: Limits { job_bytes: 2 << 30, ..usual().limits },
                    ..worker(WorkerConfig { memory_bytes: 1 << 30, ..usual().worker })
                },
            ),
            ("limits.job_bytes", Config { limits: Limits { job_bytes: 1, ..usual().limits }, ..usual() }),
            ("quotas.default.vertices_per_hour", quota(Quota { vertices_per_hour: 100, ..Quota::default() })),
            ("quotas.default.upload_bytes_per_hour", quota(Quota { upload_bytes_per_hour: 1000, ..Quota::default() })),
            ("limits.upload_bytes", Config { limits: Limits { upload_bytes: 1000, ..usual().limits }, ..usual() }),
            (
                "auth.oidc.audience",
                Config {
                    auth: AuthConfig {
                        oidc: OidcConfig { audience: "a".to_owned(), ..OidcConfig::default() },
                        ..AuthConfig::default()
                    },
                    ..usual()
                },
            ),
            (
                "webhooks.base_url",
                Config { webhooks: WebhooksConfig { secrets: vec![secret], ..usual().webhooks }, ..usual() },
            ),
        ];
        for (setting, config) in cases {
            let warnings = config.warnings();
            assert!(matches!(&warnings[..], [one] if one.starts_with(setting)), "{setting}: {warnings:?}");
        }
    }
}
