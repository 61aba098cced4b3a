//! Tokens of an OpenID Connect issuer: signed JSON web tokens (RFC 7519) that say whose the caller is and what it may.
//!
//! Guarantees: a token counts only when it is signed by a key that the issuer publishes, with one of the configured algorithms (never
//! `none`, and never one with a shared secret), by this issuer, for this audience, and now. The issuer's keys are kept at hand:
//! they are read again every `FRESH` and when a token names a key that is not among them, at most every `LEAST`, so that nobody can
//! make this service hammer the issuer. While the issuer is away the keys at hand serve on.
//! Not guaranteed: that a token stops working before it expires; and a key that the issuer withdraws works on here until the issuer was
//! read again.

use super::{Caller, Scope};
use crate::config::OidcConfig;
use futures::StreamExt;
use jsonwebtoken::jwk::{Jwk, JwkSet, PublicKeyUse};
use jsonwebtoken::{Algorithm, DecodingKey, Validation};
use serde::Deserialize;
use serde::de::DeserializeOwned;
use serde_json::Value;
use std::collections::BTreeSet;
use std::sync::{Arc, RwLock};
use std::time::Duration;
use tokio::sync::Mutex;
use tokio::time::Instant;

/// Age at which the keys are read again, while the old ones serve.
const FRESH: Duration = Duration::from_secs(10 * 60);
/// Least time between two readings of the issuer, whatever comes.
const LEAST: Duration = Duration::from_secs(5);
/// Time for one answer of the issuer.
const ANSWER: Duration = Duration::from_secs(5);
/// Bytes of an answer: a set of keys is a few kilobytes.
const LARGEST_ANSWER: usize = 256 << 10;
/// Keys of a set that are looked at.
const MOST_KEYS: usize = 64;
/// Bytes of a token; headers are not much larger anyway.
const LARGEST_TOKEN: usize = 16 << 10;

/// Algorithms that may be configured: those with a public key.
const ALGORITHMS: [(&str, Algorithm); 7] = [
    ("RS256", Algorithm::RS256),
    ("RS384", Algorithm::RS384),
    ("RS512", Algorithm::RS512),
    ("PS256", Algorithm::PS256),
    ("ES256", Algorithm::ES256),
    ("ES384", Algorithm::ES384),
    ("EdDSA", Algorithm::EdDSA),
];

/// What is wrong with the configuration.
#[derive(Debug, thiserror::Error)]
pub enum IssuerError {
    /// An address that tokens cannot be trusted by.
    #[error("auth.oidc: {0:?} is no https:// address (http:// only on this machine)")]
    Address(String),
    /// No audience.
    #[error("auth.oidc.audience is empty: tokens for other services would be taken")]
    Audience,
    /// An algorithm that is not offered.
    #[error("auth.oidc.algorithms: {0:?} is not among RS256, RS384, RS512, PS256, ES256, ES384 and EdDSA")]
    Algorithm(String),
    /// The client cannot be made.
    #[error("auth.oidc: {0}")]
    Client(#[from] reqwest::Error),
}

/// Why a token is refused.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Refused {
    /// It does not count; what may be told about why.
    Invalid(&'static str),
    /// The issuer's keys were never read.
    Unavailable,
}

/// An issuer whose tokens count.
pub struct Issuer {
    config: OidcConfig,
    algorithms: Vec<Algorithm>,
    client: reqwest::Client,
    keys: RwLock<Option<Arc<JwkSet>>>,
    read: Mutex<Readings>,
}

#[derive(Default)]
struct Readings {
    /// The last try.
    tried: Option<Instant>,
    /// The last success.
    succeeded: Option<Instant>,
    /// Where the keys are, once the issuer has said so.
    keys_at: Option<String>,
}

#[derive(Deserialize)]
struct Discovery {
    issuer: String,
    jwks_uri: String,
}

impl Issuer {
    /// An issuer, which is not asked yet.
    ///
    /// # Errors
    /// When the configuration cannot be trusted.
    pub fn new(config: &OidcConfig) -> Result<Self, IssuerError> {
        for address in [&config.issuer, &config.jwks_url].into_iter().filter(|address| !address.is_empty()) {
            check_address(address)?;
        }
        if config.audience.is_empty() {
            return Err(IssuerError::Audience);
        }
        let algorithm = |name: &String| {
            let known = ALGORITHMS.iter().find(|(known, _)| known == name);
            known.map(|(_, algorithm)| *algorithm).ok_or_else(|| IssuerError::Algorithm(name.clone()))
        };
        let algorithms = config.algorithms.iter().map(algorithm).collect::<Result<Vec<_>, _>>()?;
        // where the keys are is said by the issuer, and by nobody that its answer leads to
        let client = reqwest::Client::builder().timeout(ANSWER).redirect(reqwest::redirect::Policy::none()).build()?;
        Ok(Self { config: config.clone(), algorithms, client, keys: RwLock::default(), read: Mutex::default() })
    }

    /// Who asks with this token.
    ///
    /// # Errors
    /// When it does not count.
    pub async fn identify(&self, token: &str) -> Result<Caller, Refused> {
        let invalid = Refused::Invalid("the token is malformed");
        if token.len() > LARGEST_TOKEN {
            return Err(Refused::Invalid("the token is too long"));
        }
        let header = jsonwebtoken::decode_header(token).map_err(|_| invalid)?;
        if !self.algorithms.contains(&header.alg) {
            return Err(Refused::Invalid("the token's algorithm is not allowed here"));
        }
        if header.crit.is_some() {
            return Err(Refused::Invalid("the token has extensions that are not understood here"));
        }
        let (kid, algorithm) = (header.kid.as_deref(), header.alg);
        let mut keys = self.keys(None).await;
        if keys.as_deref().is_none_or(|keys| candidates(keys, kid, algorithm).next().is_none()) {
            keys = self.keys(Some(LEAST)).await;
        }
        let keys = keys.ok_or(Refused::Unavailable)?;
        let mut refused = Refused::Invalid("the token is signed with a key that the issuer does not have");
        for key in candidates(&keys, kid, algorithm) {
            let Ok(key) = DecodingKey::from_jwk(key) else { continue };
            match jsonwebtoken::decode::<Value>(token, &key, &self.validation(algorithm)) {
                Ok(token) => return self.caller(&token.claims),
                Err(error) => refused = Refused::Invalid(reason(error.kind())),
            }
        }
        Err(refused)
    }

    fn validation(&self, algorithm: Algorithm) -> Validation {
        let mut validation = Validation::new(algorithm);
        validation.set_required_spec_claims(&["exp", "iss", "aud"]);
        validation.set_issuer(&[&self.config.issuer]);
        validation.set_audience(&[&self.config.audience]);
        validation.leeway = self.config.leeway_s;
        validation.validate_nbf = true;
        validation
    }

    /// What the claims of a token that counts say.
    fn caller(&self, claims: &Value) -> Result<Caller, Refused> {
        // an issuer is one text; a list of several would let each of them speak for the others
        if claims.get("iss").and_then(Value::as_str) != Some(&self.config.issuer) {
            return Err(Refused::Invalid("the token is of another issuer"));
        }
        let tenant = claims.get(&self.config.tenant_claim).and_then(Value::as_str);
        let tenant = tenant.and_then(|tenant| tenant.parse().ok());
        let tenant = tenant.ok_or(Refused::Invalid("the token names no tenant"))?;
        let given: Vec<&str> = match claims.get(&self.config.scope_claim) {
            Some(Value::String(text)) => text.split(' ').collect(),
            Some(Value::Array(list)) => list.iter().filter_map(Value::as_str).collect(),
            _ => Vec::new(),
        };
        let own = given.iter().filter_map(|scope| scope.strip_prefix(self.config.scope_prefix.as_str()));
        let scopes: BTreeSet<Scope> = own.filter_map(Scope::from_name).collect();
        Ok(Caller::new(tenant, scopes))
    }

    /// The issuer's keys: those at hand, unless they are old (then they are read again behind the scenes of this one question), or
    /// `wanted` says that a key is missing among them. `None` when they were never read.
    async fn keys(&self, wanted: Option<Duration>) -> Option<Arc<JwkSet>> {
        let at_hand = self.at_hand();
        // one reads, and only those wait for it who have nothing that they could use
        let mut readings = match (&at_hand, wanted) {
            (Some(_), None) => match self.read.try_lock() {
                Ok(readings) => readings,
                Err(_) => return at_hand,
            },
            _ => self.read.lock().await,
        };
        let older = |moment: Option<Instant>, age| moment.is_none_or(|moment| moment.elapsed() >= age);
        let due = match (wanted, &at_hand) {
            (None, Some(_)) => older(readings.succeeded, FRESH),
            _ => true,
        };
        if !due || !older(readings.tried, LEAST) {
            return self.at_hand();
        }
        readings.tried = Some(Instant::now());
        match self.fetch(&mut readings).await {
            Ok(keys) => {
                readings.succeeded = Some(Instant::now());
                tracing::info!(
                    oidc.issuer = self.config.issuer,
                    oidc.keys = keys.keys.len(),
                    "the issuer's keys were read"
                );
                *self.keys.write().unwrap_or_else(|e| e.into_inner()) = Some(Arc::new(keys));
            }
            Err(error) => {
                tracing::warn!(oidc.issuer = self.config.issuer, error, "the issuer's keys cannot be read");
            }
        }
        self.at_hand()
    }

    fn at_hand(&self) -> Option<Arc<JwkSet>> {
        self.keys.read().unwrap_or_else(|e| e.into_inner()).clone()
    }

    async fn fetch(&self, readings: &mut Readings) -> Result<JwkSet, String> {
        let keys_at = match &readings.keys_at {
            Some(keys_at) => keys_at.clone(),
            None => self.discover().await?,
        };
        let mut keys: LenientSet = self.get(&keys_at).await?;
        readings.keys_at = Some(keys_at);
        keys.keys.truncate(MOST_KEYS);
        // a key of a kind that is not known here is no reason to do without the others
        Ok(JwkSet { keys: keys.keys.into_iter().filter_map(|key| serde_json::from_value(key).ok()).collect() })
    }

    /// Where the keys are (OpenID Connect Discovery 1.0, section 4).
    async fn discover(&self) -> Result<String, String> {
        if !self.config.jwks_url.is_empty() {
            return Ok(self.config.jwks_url.clone());
        }
        let issuer = self.config.issuer.trim_end_matches('/');
        let found: Discovery = self.get(&format!("{issuer}/.well-known/openid-configuration")).await?;
        if found.issuer != self.config.issuer {
            return Err(format!("it says that it is {:?}", found.issuer));
        }
        check_address(&found.jwks_uri).map_err(|e| e.to_string())?;
        Ok(found.jwks_uri)
    }

    async fn get<T: DeserializeOwned>(&self, url: &str) -> Result<T, String> {
        let answer = self.client.get(url).send().await.map_err(|e| format!("{url}: {e}"))?;
        if !answer.status().is_success() {
            return Err(format!("{url}: {}", answer.status()));
        }
        let (mut stream, mut bytes) = (answer.bytes_stream(), Vec::new());
        while let Some(chunk) = stream.next().await {
            let chunk = chunk.map_err(|e| format!("{url}: {e}"))?;
            if bytes.len() + chunk.len() > LARGEST_ANSWER {
                return Err(format!("{url}: the answer has more than {LARGEST_ANSWER} bytes"));
            }
            bytes.extend_from_slice(&chunk);
        }
        serde_json::from_slice(&bytes).map_err(|e| format!("{url}: {e}"))
    }
}

/// A set whose keys are read one by one.
#[derive(Deserialize)]
struct LenientSet {
    keys: Vec<Value>,
}

/// The keys that may have signed a token: that of its name, or those without a name when it names none; for signatures, and of the
/// algorithm's family.
fn candidates<'k>(
    keys: &'k JwkSet,
    kid: Option<&'k str>,
    algorithm: Algorithm,
) -> impl Iterator<Item = &'k Jwk> + use<'k> {
    keys.keys.iter().filter(move |key| {
        let common = &key.common;
        let named = kid.is_none() || common.key_id.as_deref() == kid;
        let signs = common.public_key_use.as_ref().is_none_or(|usage| *usage == PublicKeyUse::Signature);
        let said = common.key_algorithm.is_none_or(|said| said.to_string() == format!("{algorithm:?}"));
        let fits = DecodingKey::from_jwk(key).is_ok_and(|key| key.family() == algorithm.family());
        named && signs && said && fits
    })
}

/// What may be told of why a token does not count.
fn reason(kind: &jsonwebtoken::errors::ErrorKind) -> &'static str {
    use jsonwebtoken::errors::ErrorKind;
    match kind {
        ErrorKind::ExpiredSignature => "the token has expired",
        ErrorKind::ImmatureSignature => "the token does not count yet",
        ErrorKind::InvalidIssuer => "the token is of another issuer",
        ErrorKind::InvalidAudience => "the token is for another audience",
        ErrorKind::MissingRequiredClaim(_) => "the token lacks one of exp, iss and aud",
        ErrorKind::InvalidSignature => "the token's signature is wrong",
        _ => "the token is malformed",
    }
}

/// `https://`, or `http://` on this machine.
fn check_address(address: &str) -> Result<(), IssuerError> {
    let wrong = || IssuerError::Address(address.to_owned());
    let url = reqwest::Url::parse(address).map_err(|_| wrong())?;
    let is_local = match url.host_str() {
        Some("localhost") => true,
        Some(host) => host.trim_matches(['[', ']']).parse::<std::net::IpAddr>().is_ok_and(|ip| ip.is_loopback()),
        None => return Err(wrong()),
    };
    match url.scheme() {
        "https" => Ok(()),
        "http" if is_local => Ok(()),
        _ => Err(wrong()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn config() -> OidcConfig {
        OidcConfig { issuer: "https://a.example".to_owned(), audience: "shrinkd".to_owned(), ..OidcConfig::default() }
    }

    #[test]
    fn what_tokens_cannot_be_trusted_by_is_refused_at_the_start() {
        assert!(Issuer::new(&config()).is_ok());
        for issuer in ["http://a.example", "ftp://a.example", "a.example", "http://127.0.0.1.example"] {
            let wrong = OidcConfig { issuer: issuer.to_owned(), ..config() };
            assert!(matches!(Issuer::new(&wrong), Err(IssuerError::Address(_))), "{issuer}");
        }
        for algorithm in ["none", "HS256", "RS1", ""] {
            let wrong = OidcConfig { algorithms: vec![algorithm.to_owned()], ..config() };
            assert!(matches!(Issuer::new(&wrong), Err(IssuerError::Algorithm(_))), "{algorithm}");
        }
        let wrong = OidcConfig { audience: String::new(), ..config() };
        assert!(matches!(Issuer::new(&wrong), Err(IssuerError::Audience)));
        assert!(Issuer::new(&OidcConfig { issuer: "http://127.0.0.1:9".to_owned(), ..config() }).is_ok());
    }

    #[test]
    fn claims_say_whose_the_caller_is_and_what_it_may() {
        let issuer = Issuer::new(&config()).expect("an issuer");
        let base =
            serde_json::json!({"iss": "https://a.example", "tenant": "team", "scope": "openid shrinkd:read write"});
        let caller = issuer.caller(&base).expect("counts");
        assert_eq!(caller, Caller::new("team".parse().expect("a name"), [Scope::Read]));
        let mut list = base.clone();
        list["scope"] = serde_json::json!(["shrinkd:read", "shrinkd:write", 7]);
        assert_eq!(issuer.caller(&list).expect("counts").may(Scope::Write).map(|t| t.name()), Ok("team"));
        let bare = Issuer::new(&OidcConfig { scope_prefix: String::new(), ..config() }).expect("an issuer");
        let caller = bare.caller(&base).expect("counts");
        assert_eq!(caller, Caller::new("team".parse().expect("a name"), [Scope::Write]), "scopes may have no prefix");
        for (member, value) in [
            ("tenant", serde_json::json!("No Name")),
            ("tenant", Value::Null),
            ("tenant", serde_json::json!(["team"])),
            ("iss", serde_json::json!(["https://a.example", "https://b.example"])),
        ] {
            let mut wrong = base.clone();
            wrong[member] = value;
            assert!(issuer.caller(&wrong).is_err(), "{wrong}");
        }
    }
}
