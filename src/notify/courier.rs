//! Takes notices that are due from the engine, and sends them.

use super::payload::{Notice, message_id};
use super::signature::sign;
use super::target::Rules;
use super::{network, schedule};
use crate::config::WebhooksConfig;
use crate::engine::{DueNotice, Engine};
use ipnet::IpNet;
use jiff::{SignedDuration, Timestamp};
use reqwest::dns::{Addrs, Name, Resolve, Resolving};
use reqwest::header::{CONTENT_TYPE, RETRY_AFTER};
use reqwest::{Client, StatusCode, redirect};
use std::net::{IpAddr, SocketAddr};
use std::sync::Arc;
use std::time::Duration;
use tokio::task::JoinSet;
use tokio_util::sync::CancellationToken;

/// Notices on their way at once.
const AT_ONCE: usize = 32;
/// Time between two looks for notices.
const LOOK: Duration = Duration::from_secs(1);
/// Time that a receiver has to take a notice.
const TIMEOUT: Duration = Duration::from_secs(20);
/// Time that a connection may take.
const CONNECT: Duration = Duration::from_secs(10);
/// How long a notice that was taken is this node's: longer than an attempt can take. Then another node may send it.
const HOLD: Duration = Duration::from_secs(60);

/// Finds the addresses of a name.
#[async_trait::async_trait]
pub trait Names: Send + Sync {
    /// All of them.
    async fn look_up(&self, name: &str) -> std::io::Result<Vec<IpAddr>>;
}

/// The names that this machine knows.
pub struct SystemNames;

#[async_trait::async_trait]
impl Names for SystemNames {
    async fn look_up(&self, name: &str) -> std::io::Result<Vec<IpAddr>> {
        Ok(tokio::net::lookup_host((name, 0)).await?.map(|address| address.ip()).collect())
    }
}

/// Looks names up for connections, and lets only permitted addresses through. What it gives is what is connected to: there is no second
/// look-up between the check and the connection, in which a name could come to mean something else.
struct Guarded {
    names: Arc<dyn Names>,
    networks: Vec<IpNet>,
}

impl Resolve for Guarded {
    fn resolve(&self, name: Name) -> Resolving {
        let (names, networks) = (self.names.clone(), self.networks.clone());
        Box::pin(async move {
            let mut addresses = names.look_up(name.as_str()).await?;
            addresses.retain(|&address| network::is_permitted(address, &networks));
            if addresses.is_empty() {
                return Err("the name leads to no address that is let through".into());
            }
            let addresses: Addrs = Box::new(addresses.into_iter().map(|address| SocketAddr::new(address, 0)));
            Ok(addresses)
        })
    }
}

/// What an attempt came to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Attempt {
    /// The receiver has it.
    Taken,
    /// The receiver wants nothing more.
    Gone,
    /// Not now; the receiver may have said when.
    Failed(Option<Duration>),
}

/// Sends notices.
pub struct Courier {
    client: Client,
    rules: Rules,
    config: WebhooksConfig,
}

impl Courier {
    /// A courier that looks names up as `names` does.
    ///
    /// # Errors
    /// When this machine's certificates cannot be read.
    pub fn new(config: &WebhooksConfig, names: Arc<dyn Names>) -> reqwest::Result<Self> {
        let rules = Rules::from(config);
        let client = Client::builder()
            .dns_resolver(Arc::new(Guarded { names, networks: rules.networks.clone() }))
            .redirect(redirect::Policy::none())
            .no_proxy()
            .timeout(TIMEOUT)
            .connect_timeout(CONNECT)
            // every attempt looks its name up
            .pool_max_idle_per_host(0)
            .user_agent(concat!("shrinkd/", env!("CARGO_PKG_VERSION")))
            .build()?;
        Ok(Self { client, rules, config: config.clone() })
    }

    /// Sends what is due until the service stops. What is on its way then is due again after a while.
    pub async fn run(self, engine: Arc<dyn Engine>, stop: CancellationToken) {
        let courier = Arc::new(self);
        let mut on_their_way = JoinSet::new();
        loop {
            tokio::select! {
                () = stop.cancelled() => break,
                () = tokio::time::sleep(LOOK) => {}
            }
            while on_their_way.try_join_next().is_some() {}
            let free = AT_ONCE.saturating_sub(on_their_way.len());
            match engine.take_notices(free, HOLD).await {
                Ok(due) => {
                    for notice in due {
                        on_their_way.spawn(deliver(courier.clone(), engine.clone(), notice));
                    }
                }
                Err(error) => tracing::warn!(%error, "the notices could not be looked at"),
            }
        }
        // what was taken by a receiver must be noted, if that is possible in time
        while on_their_way.join_next().await.is_some() {}
    }

    /// Sends a notice once.
    pub async fn attempt(&self, notice: &DueNotice) -> Attempt {
        let id = message_id(notice.job.id);
        let url = match self.rules.read(&notice.url) {
            Ok(url) => url,
            Err(refused) => {
                tracing::warn!(job.id = %notice.job.id, problem.code = refused.code, "the target of a webhook is not let through");
                return Attempt::Failed(None);
            }
        };
        let secrets = self.config.secrets_of(&notice.tenant);
        if secrets.is_empty() {
            tracing::warn!(job.id = %notice.job.id, "there is no secret any more to sign a webhook with");
            return Attempt::Failed(None);
        }
        let Ok(payload) = serde_json::to_vec(&Notice::of(&notice.job, &self.config.base_url)) else {
            return Attempt::Gone;
        };
        let now = Timestamp::now();
        let request = self
            .client
            .post(url)
            .header(CONTENT_TYPE, "application/json")
            .header("webhook-id", &id)
            .header("webhook-timestamp", now.as_second())
            .header("webhook-signature", sign(secrets, &id, now.as_second(), &payload))
            .body(payload);
        match request.send().await {
            Ok(answer) => {
                let status = answer.status();
                tracing::info!(job.id = %notice.job.id, http.status = status.as_u16(), attempt = notice.attempts, "a webhook was answered");
                match status {
                    status if status.is_success() => Attempt::Taken,
                    StatusCode::GONE => Attempt::Gone,
                    _ => {
                        let asked = answer.headers().get(RETRY_AFTER).and_then(|value| value.to_str().ok());
                        Attempt::Failed(asked.and_then(|text| schedule::retry_after(text, Timestamp::now())))
                    }
                }
            }
            Err(error) => {
                // the address may hold what only its owner should know
                let error = error.without_url();
                tracing::warn!(job.id = %notice.job.id, attempt = notice.attempts, %error, cause = causes(&error), "a webhook could not be sent");
                Attempt::Failed(None)
            }
        }
    }
}

fn causes(error: &dyn std::error::Error) -> String {
    let causes = std::iter::successors(error.source(), |cause| cause.source());
    causes.map(ToString::to_string).collect::<Vec<_>>().join(": ")
}

async fn deliver(courier: Arc<Courier>, engine: Arc<dyn Engine>, notice: DueNotice) {
    let next = match courier.attempt(&notice).await {
        Attempt::Taken | Attempt::Gone => None,
        Attempt::Failed(asked) => schedule::pause(notice.attempts, asked),
    };
    let next = next.map(|pause| {
        let pause = SignedDuration::try_from(pause).unwrap_or(SignedDuration::from_hours(24));
        Timestamp::now().saturating_add(pause).unwrap_or(Timestamp::MAX)
    });
    if next.is_none() {
        tracing::info!(job.id = %notice.job.id, attempts = notice.attempts, "a webhook is over");
    }
    // should that fail it is sent once more
    if let Err(error) = engine.settle_notice(&notice.tenant, notice.job.id, notice.attempts, next).await {
        tracing::warn!(job.id = %notice.job.id, %error, "the outcome of a webhook could not be noted");
    }
}

#[cfg(test)]
mod tests;
