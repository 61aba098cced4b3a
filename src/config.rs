//! Configuration of the service: defaults, then a TOML file, then `SHRINKD_*` variables, then the command line.
//!
//! In variables a level is two underscores: `SHRINKD_WORKER__SLOTS=4`. Unknown names are refused, in the file and in the
//! environment. The defaults need nothing: one folder, loopback only.

mod warnings;

use crate::engine::nats::{Address, InvalidAddress};
use crate::job::memory;
use crate::notify::signature::Secret;
use crate::quota::Quotas;
use crate::tenant::Tenant;
use figment::Figment;
use figment::providers::{Env, Format, Serialized, Toml};
use ipnet::IpNet;
use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};

/// Everything that can be set.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Config {
    /// Address to listen on (`SHRINKD_LISTEN`). Beyond loopback only with authentication, or where `auth.open_beyond_loopback` allows it.
    pub listen: SocketAddr,
    /// Address to serve `/metrics` at, and nothing else (`SHRINKD_METRICS_LISTEN`); empty serves it at `listen`. Nobody is asked for a
    /// key there.
    #[serde(with = "unless_empty")]
    pub metrics_listen: Option<SocketAddr>,
    /// Folder of the database and the blobs (`SHRINKD_DATA_DIR`), made when it is not there.
    pub data_dir: PathBuf,
    /// Where jobs are kept (`SHRINKD_ENGINE`): `sqlite`, in the folder and for one process; or the
    /// [address](crate::engine::nats::Address) of NATS servers, for any number of nodes. It may hold a password.
    pub engine: String,
    /// Origins whose pages may call the service (`SHRINKD_CORS_ORIGINS`, a list); none.
    pub cors_origins: Vec<String>,
    /// Where inputs and outputs lie (`SHRINKD_BLOBS`): `folder`, in the folder above; or `s3://BUCKET/PREFIX`, with what the `AWS_*`
    /// variables say (`AWS_ACCESS_KEY_ID`, `AWS_SECRET_ACCESS_KEY`, `AWS_REGION`, `AWS_ENDPOINT`, `AWS_ALLOW_HTTP`).
    pub blobs: String,
    /// Seconds for which a download is answered with a link into the bucket (`SHRINKD_DOWNLOAD_LINK_S`): 0 sends the bytes.
    pub download_link_s: u64,
    /// What this node does (`SHRINKD_ROLE`).
    pub role: Role,
    /// Seconds for which a node still answers after SIGTERM (`SHRINKD_DRAIN_S`): that it is not ready, and that it takes no more jobs.
    pub drain_s: u64,
    /// Who may ask.
    pub auth: AuthConfig,
    /// Sizes of requests, and what jobs may take.
    pub limits: Limits,
    /// What each tenant may have.
    pub quotas: Quotas,
    /// What is kept, and for how long.
    pub retention: Retention,
    /// The worker.
    pub worker: WorkerConfig,
    /// Notices of the ends of jobs.
    pub webhooks: WebhooksConfig,
    /// The log.
    pub log: LogConfig,
    /// Traces.
    pub traces: TracesConfig,
}

/// What a node does.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "lowercase")]
pub enum Role {
    /// Answers requests and runs jobs.
    All,
    /// Answers requests only.
    Api,
    /// Runs jobs only; answers nothing but whether it lives and is ready, and what it measures.
    Worker,
}

/// Who may ask.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct AuthConfig {
    /// Whether a request must say who asks (`SHRINKD_AUTH__MODE`).
    pub mode: AuthMode,
    /// Whether a service that asks nobody may listen beyond loopback (`SHRINKD_AUTH__OPEN_BEYOND_LOOPBACK`), where something else
    /// keeps strangers away.
    pub open_beyond_loopback: bool,
    /// The issuer whose tokens count beside API keys.
    pub oidc: OidcConfig,
}

/// Whether a request must say who asks.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum AuthMode {
    /// Nobody is asked; everything is the default tenant's.
    #[default]
    None,
    /// With an API key, or a token of the issuer.
    Required,
}

/// An OpenID Connect issuer.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct OidcConfig {
    /// Its address, as tokens have it in `iss` (`SHRINKD_AUTH__OIDC__ISSUER`); none when it is empty.
    pub issuer: String,
    /// What tokens for this service have in `aud` (`SHRINKD_AUTH__OIDC__AUDIENCE`).
    pub audience: String,
    /// Where its keys are (`SHRINKD_AUTH__OIDC__JWKS_URL`); when it is empty the issuer is asked.
    pub jwks_url: String,
    /// Algorithms of signatures that count (`SHRINKD_AUTH__OIDC__ALGORITHMS`).
    pub algorithms: Vec<String>,
    /// The claim that names the tenant (`SHRINKD_AUTH__OIDC__TENANT_CLAIM`).
    pub tenant_claim: String,
    /// The claim with the scopes (`SHRINKD_AUTH__OIDC__SCOPE_CLAIM`): words in one text, or a list.
    pub scope_claim: String,
    /// What this service's scopes begin with there (`SHRINKD_AUTH__OIDC__SCOPE_PREFIX`).
    pub scope_prefix: String,
    /// Seconds that clocks may differ (`SHRINKD_AUTH__OIDC__LEEWAY_S`).
    pub leeway_s: u64,
}

impl Default for OidcConfig {
    fn default() -> Self {
        Self {
            issuer: String::new(),
            audience: String::new(),
            jwks_url: String::new(),
            algorithms: ["RS256", "ES256", "EdDSA"].map(str::to_owned).to_vec(),
            tenant_claim: "tenant".to_owned(),
            scope_claim: "scope".to_owned(),
            scope_prefix: "shrinkd:".to_owned(),
            leeway_s: 30,
        }
    }
}

/// What is kept, and for how long.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Retention {
    /// Seconds that outputs and inputs of a job are kept after its end (`SHRINKD_RETENTION__OUTPUTS_S`): 0 keeps them as long
    /// as the job is remembered.
    pub outputs_s: u64,
    /// Seconds that an input is kept which no job names (`SHRINKD_RETENTION__INPUTS_S`), after it was last uploaded; at least an
    /// hour.
    pub inputs_s: u64,
    /// Seconds between two looks at what can go (`SHRINKD_RETENTION__EVERY_S`).
    pub every_s: u64,
}

impl Retention {
    /// The time before which a job must have ended for its outputs to have expired at `now`; `None` when they never do.
    pub fn expired(&self, now: Timestamp) -> Option<Timestamp> {
        let kept = i64::try_from(self.outputs_s).ok().filter(|&s| s > 0)?;
        now.checked_sub(jiff::SignedDuration::from_secs(kept)).ok()
    }
}

/// Sizes of requests, and what jobs may take.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Limits {
    /// Bytes of a JSON body (`SHRINKD_LIMITS__BODY_BYTES`): 1 MiB holds a scene of ten thousand nodes.
    pub body_bytes: u64,
    /// Bytes of an uploaded input (`SHRINKD_LIMITS__INPUT_BYTES`): 256 MiB, held in memory while it is checked.
    pub input_bytes: u64,
    /// Bytes of the uploads that a node reads at the same time (`SHRINKD_LIMITS__UPLOAD_BYTES`): 1 GiB.
    pub upload_bytes: u64,
    /// Jobs that may wait, over all tenants (`SHRINKD_LIMITS__QUEUED_JOBS`): 0 is no limit.
    pub queued_jobs: u64,
    /// Seconds that an attempt at a job may run (`SHRINKD_LIMITS__JOB_SECONDS`).
    pub job_seconds: u32,
    /// Bytes of memory that a job may be estimated to take (`SHRINKD_LIMITS__JOB_BYTES`): 0 is what this node's worker has.
    pub job_bytes: u64,
}

/// The worker.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct WorkerConfig {
    /// Jobs at once (`SHRINKD_WORKER__SLOTS`): 2, so that one loads or writes while another computes.
    pub slots: usize,
    /// Bytes of memory that its jobs may be estimated to take together (`SHRINKD_WORKER__MEMORY_BYTES`): 0 is four fifths of what the
    /// machine, or the process's control group, has.
    pub memory_bytes: u64,
    /// Threads of the pool that all jobs share (`SHRINKD_WORKER__THREADS`): 0 is one per core.
    pub threads: usize,
    /// Seconds a job is held without a heartbeat (`SHRINKD_WORKER__LEASE_S`).
    pub lease_s: u64,
    /// Lost workers after which a job is failed (`SHRINKD_WORKER__MAX_LOSSES`).
    pub max_losses: u32,
}

/// Notices of the ends of jobs, which jobs ask for (`webhook`).
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct WebhooksConfig {
    /// What notices are signed with (`SHRINKD_WEBHOOKS__SECRETS`, a list): `whsec_` and 24 to 64 bytes in base64; several while one
    /// takes the place of another. None: no job may ask for a notice.
    pub secrets: Vec<Secret>,
    /// What those of some tenants are signed with, in place of that, by the tenant's name: a secret is known to every receiver that
    /// verifies by it.
    pub tenants: BTreeMap<Tenant, Vec<Secret>>,
    /// Whether notices may go over `http` (`SHRINKD_WEBHOOKS__ALLOW_HTTP`).
    pub allow_http: bool,
    /// The ports they may go to (`SHRINKD_WEBHOOKS__PORTS`, a list): 443. None means any.
    pub ports: Vec<u16>,
    /// Networks they may go to although they are no part of the public internet (`SHRINKD_WEBHOOKS__ALLOW_PRIVATE`, a list).
    pub allow_private: Vec<IpNet>,
    /// What their links to jobs begin with (`SHRINKD_WEBHOOKS__BASE_URL`): where clients reach this service.
    pub base_url: String,
}

/// The log, on standard error.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LogConfig {
    /// `pretty` or `json` (`SHRINKD_LOG__FORMAT`).
    pub format: LogFormat,
    /// What is logged (`SHRINKD_LOG__FILTER`), in the syntax of `tracing-subscriber`: `info`.
    pub filter: String,
}

/// Traces, sent by OTLP over HTTP.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TracesConfig {
    /// Address of the collector, such as `http://127.0.0.1:4318` (`SHRINKD_TRACES__ENDPOINT`); empty sends nothing.
    pub endpoint: String,
    /// Share of the traces that is sent, from 0 to 1, of those that no client decided about (`SHRINKD_TRACES__SAMPLE_RATIO`).
    pub sample_ratio: f64,
}

/// How a line of the log is written.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum LogFormat {
    /// For a person.
    Pretty,
    /// One JSON object per line.
    Json,
}

impl Default for Config {
    fn default() -> Self {
        Self {
            listen: SocketAddr::from(([127, 0, 0, 1], 8080)),
            metrics_listen: None,
            data_dir: PathBuf::from("./shrinkd-data"),
            engine: SQLITE.to_owned(),
            cors_origins: Vec::new(),
            blobs: FOLDER.to_owned(),
            download_link_s: 0,
            role: Role::All,
            drain_s: 1,
            auth: AuthConfig::default(),
            retention: Retention { outputs_s: 0, inputs_s: 7 * 24 * 3600, every_s: 3600 },
            limits: Limits {
                body_bytes: 1 << 20,
                input_bytes: 256 << 20,
                upload_bytes: 1 << 30,
                queued_jobs: 100_000,
                job_seconds: 3600,
                job_bytes: 0,
            },
            quotas: Quotas::default(),
            worker: WorkerConfig { slots: 2, memory_bytes: 0, threads: 0, lease_s: 30, max_losses: 5 },
            webhooks: WebhooksConfig { ports: vec![443], ..WebhooksConfig::default() },
            log: LogConfig { format: LogFormat::Pretty, filter: "info".to_owned() },
            traces: TracesConfig { endpoint: String::new(), sample_ratio: 1.0 },
        }
    }
}

/// The embedded engine's name.
pub const SQLITE: &str = "sqlite";
/// Blobs in the node's own folder.
pub const FOLDER: &str = "folder";

/// Variables of the project that are no settings of the service: test data, the renewal of stored metrics, and servers
/// that tests start.
const NOT_SETTINGS: [&str; 4] = ["DATA", "RENEW_METRICS", "NATS_SERVER", "MOTO_SERVER"];

/// A balancer that has not looked for so long is not looking.
const MAX_DRAIN_S: u64 = 300;
/// The longest that S3 signs a link for: a week.
const MAX_LINK_S: u64 = 7 * 24 * 3600;

/// Whether it is what browsers send in `Origin`: scheme, host and port, and nothing after them.
fn is_origin(text: &str) -> bool {
    url::Url::parse(text).is_ok_and(|url| url.origin().is_tuple() && url.origin().ascii_serialization() == text)
}

impl Config {
    /// Reads the configuration; `flags` are what the command line says.
    ///
    /// # Errors
    /// When the file cannot be read, a name is unknown, or a value is of the wrong kind or impossible.
    pub fn load(file: Option<&Path>, flags: impl Serialize) -> Result<Self, ConfigError> {
        let mut figment = Figment::from(Serialized::defaults(Config::default()));
        if let Some(file) = file {
            figment = figment.merge(Toml::file_exact(file));
        }
        let environment = Env::prefixed("SHRINKD_").ignore(&NOT_SETTINGS).split("__");
        let config: Config =
            figment.merge(environment).merge(Serialized::defaults(flags)).extract().map_err(Box::new)?;
        let wrong = [
            (config.worker.slots == 0, "worker.slots must be at least 1"),
            (config.worker.lease_s == 0, "worker.lease_s must be at least 1"),
            (config.worker.max_losses == 0, "worker.max_losses must be at least 1"),
            (!(0.0..=1.0).contains(&config.traces.sample_ratio), "traces.sample_ratio must be from 0 to 1"),
            (config.retention.every_s == 0, "retention.every_s must be at least 1"),
            (config.retention.inputs_s < 3600, "retention.inputs_s must be at least 3600"),
            (
                config.role != Role::All && config.engine == SQLITE,
                "role api or worker needs an engine that other nodes reach: engine = \"nats://...\"",
            ),
            (config.limits.body_bytes == 0 || config.limits.input_bytes == 0, "limits of bytes must be at least 1"),
            (config.limits.job_seconds == 0, "limits.job_seconds must be at least 1"),
            (config.drain_s > MAX_DRAIN_S, "drain_s must be at most 300"),
            (config.download_link_s > MAX_LINK_S, "download_link_s must be at most 604800: no store signs for longer"),
            (
                !config.auth.oidc.issuer.is_empty() && config.auth.oidc.algorithms.is_empty(),
                "auth.oidc.algorithms must name an algorithm",
            ),
            (
                !config.cors_origins.iter().all(|origin| is_origin(origin)),
                "cors_origins are like https://pages.example or http://127.0.0.1:3000, without a path",
            ),
        ];
        if let Some((_, why)) = wrong.iter().find(|(is_wrong, _)| *is_wrong) {
            return Err(ConfigError::Impossible(why));
        }
        if !config.auth.oidc.issuer.is_empty() && config.auth.mode == AuthMode::None {
            return Err(ConfigError::Impossible("auth.oidc does nothing unless auth.mode is \"required\""));
        }
        if config.engine != SQLITE {
            config.engine.parse::<Address>()?;
        }
        Ok(config)
    }
}

impl WebhooksConfig {
    /// What notices of a tenant's jobs are signed with; where there is nothing, its jobs may not ask for any.
    pub fn secrets_of(&self, tenant: &Tenant) -> &[Secret] {
        self.tenants.get(tenant).unwrap_or(&self.secrets)
    }

    /// Whether any job may ask for a notice.
    pub fn is_in_use(&self) -> bool {
        !self.secrets.is_empty() || self.tenants.values().any(|secrets| !secrets.is_empty())
    }
}

impl Config {
    /// Bytes of memory that the jobs of this node's worker may take together; `None` where nobody can tell what there is.
    pub fn worker_memory(&self) -> Option<u64> {
        match self.worker.memory_bytes {
            0 => memory::of_machine().map(|bytes| bytes / 5 * 4),
            bytes => Some(bytes),
        }
    }

    /// Bytes of memory that a job may take that this node accepts: what is said, or what its own worker has.
    pub fn job_memory(&self) -> Option<u64> {
        match (self.limits.job_bytes, self.role) {
            (0, Role::All) => self.worker_memory(),
            (0, _) => None,
            (bytes, _) => Some(bytes),
        }
    }

    /// Whether it would let strangers in: beyond loopback, without asking who they are, and without having been told to.
    pub fn is_open_to_strangers(&self) -> bool {
        self.role != Role::Worker
            && self.auth.mode == AuthMode::None
            && !self.auth.open_beyond_loopback
            && !self.listen.ip().is_loopback()
    }
}

/// A value that may be left out: TOML and the environment say so with an empty text.
mod unless_empty {
    use serde::{Deserialize, Deserializer, Serializer, de::Error};
    use std::fmt::Display;
    use std::str::FromStr;

    pub fn serialize<T: Display, S: Serializer>(value: &Option<T>, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_str(&value.as_ref().map(ToString::to_string).unwrap_or_default())
    }

    pub fn deserialize<'de, T, D>(deserializer: D) -> Result<Option<T>, D::Error>
    where
        T: FromStr<Err: Display>,
        D: Deserializer<'de>,
    {
        let text = String::deserialize(deserializer)?;
        let parsed = (!text.is_empty()).then(|| text.parse()).transpose();
        parsed.map_err(|error| D::Error::custom(format!("{text:?}: {error}")))
    }
}

/// Why a configuration was refused.
#[derive(Debug, thiserror::Error)]
pub enum ConfigError {
    /// It cannot be read.
    #[error("configuration: {0}")]
    Unreadable(#[from] Box<figment::Error>),
    /// It asks for what cannot work.
    #[error("configuration: {0}")]
    Impossible(&'static str),
    /// The engine is neither `sqlite` nor an address.
    #[error("configuration: engine: {0}, or sqlite")]
    Engine(#[from] InvalidAddress),
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn flags_go_before_the_file_and_the_file_before_the_defaults() {
        let folder = tempfile::tempdir().expect("folder");
        let file = folder.path().join("shrinkd.toml");
        std::fs::write(&file, "listen = \"127.0.0.1:1\"\n[worker]\nslots = 7\n").expect("writes");
        let flags = figment::util::map!["listen" => "127.0.0.1:2"];
        let config = Config::load(Some(&file), flags).expect("loads");
        assert_eq!((config.listen.port(), config.worker.slots, config.worker.lease_s), (2, 7, 30));
    }

    #[test]
    fn the_documented_defaults_are_the_defaults() {
        let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("docs/shrinkd.toml");
        let documented: Config = Figment::from(Toml::file_exact(file)).extract().expect("names every setting");
        assert_eq!(documented, Config::default());
    }

    #[test]
    fn strangers_are_let_in_only_where_it_is_said() {
        let beyond = Config { listen: "0.0.0.0:80".parse().expect("an address"), ..Config::default() };
        assert!(beyond.is_open_to_strangers() && !Config::default().is_open_to_strangers());
        for auth in [
            AuthConfig { mode: AuthMode::Required, ..AuthConfig::default() },
            AuthConfig { open_beyond_loopback: true, ..AuthConfig::default() },
        ] {
            assert!(!Config { auth, ..beyond.clone() }.is_open_to_strangers());
        }
    }

    #[test]
    fn unknown_names_and_impossible_values_are_refused() {
        let folder = tempfile::tempdir().expect("folder");
        let file = folder.path().join("shrinkd.toml");
        for (text, named) in [
            ("lisen = \"x\"", "lisen"),
            ("[worker]\nslots = 0", "slots"),
            ("[log]\nformat = \"xml\"", "xml"),
            ("engine = \"http://a\"", "engine"),
        ] {
            std::fs::write(&file, text).expect("writes");
            let error =
                Config::load(Some(&file), figment::util::map!["log" => figment::util::map!["filter" => "info"]]);
            assert!(error.as_ref().is_err_and(|e| e.to_string().contains(named)), "{text}: {error:?}");
        }
    }
}
