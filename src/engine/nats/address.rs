//! Where the servers are, and what the cluster engine is told about them: one address.
//!
//! `nats://[user:password@]host:port[,host:port…][?replicas=3&prefix=NAME&credentials=FILE]`, or `tls://…`.

use std::fmt;
use std::path::PathBuf;

/// Schemes of an address, the second for a connection that must be encrypted.
pub const SCHEMES: [&str; 2] = ["nats://", "tls://"];

/// A cluster engine's address.
#[derive(Clone, PartialEq, Eq)]
pub struct Address {
    /// The servers, each as the client takes it; with credentials.
    pub servers: Vec<String>,
    /// Copies of every message (`replicas`): 1, or 3 where there are three servers. What is there already keeps its number.
    pub replicas: usize,
    /// What the names of streams and subjects begin with (`prefix`): `SHRINKD`. Services with different prefixes share
    /// servers and nothing else.
    pub prefix: String,
    /// A file with the client's credentials (`credentials`).
    pub credentials: Option<PathBuf>,
}

/// What is wrong with an address. Never tells the address itself, which may hold a password.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum InvalidAddress {
    /// It is no address of such a server.
    #[error("expected nats://host:port or tls://host:port")]
    Scheme,
    /// A server has no name.
    #[error("a server without a name")]
    Server,
    /// An option is not known.
    #[error("unknown option {0}: replicas, prefix and credentials are known")]
    Option(String),
    /// An option's value cannot be used.
    #[error("{0}: {1}")]
    Value(&'static str, &'static str),
}

impl std::str::FromStr for Address {
    type Err = InvalidAddress;

    fn from_str(text: &str) -> Result<Self, InvalidAddress> {
        let scheme = SCHEMES.into_iter().find(|scheme| text.starts_with(scheme)).ok_or(InvalidAddress::Scheme)?;
        let (servers, options) = text[scheme.len()..].split_once('?').unwrap_or((&text[scheme.len()..], ""));
        let servers: Vec<&str> = servers.trim_end_matches('/').split(',').map(str::trim).collect();
        if servers.iter().any(|server| server.rsplit('@').next().is_none_or(str::is_empty)) {
            return Err(InvalidAddress::Server);
        }
        // the first server's user is everyone's, so that a password is written once
        let user = servers[0].rsplit_once('@').map(|(user, _)| format!("{user}@")).unwrap_or_default();
        let server = |server: &&str| match server.contains('@') {
            true => format!("{scheme}{server}"),
            false => format!("{scheme}{user}{server}"),
        };
        let servers = servers.iter().map(server).collect();
        let mut address = Self { servers, replicas: 1, prefix: "SHRINKD".to_owned(), credentials: None };
        for option in options.split('&').filter(|option| !option.is_empty()) {
            let (name, value) = option.split_once('=').unwrap_or((option, ""));
            match name {
                "replicas" => match value {
                    "1" | "3" | "5" => address.replicas = usize::from(value.as_bytes()[0] - b'0'),
                    _ => return Err(InvalidAddress::Value("replicas", "expected 1, 3 or 5")),
                },
                "prefix" => {
                    let plain = |c: char| c.is_ascii_alphanumeric() || c == '_' || c == '-';
                    if value.is_empty() || !value.chars().all(plain) {
                        return Err(InvalidAddress::Value("prefix", "expected letters, digits, - and _"));
                    }
                    address.prefix = value.to_owned();
                }
                "credentials" if !value.is_empty() => address.credentials = Some(value.into()),
                _ => return Err(InvalidAddress::Option(name.to_owned())),
            }
        }
        Ok(address)
    }
}

impl fmt::Display for Address {
    /// The servers without their credentials.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (i, server) in self.servers.iter().enumerate() {
            let host = server.rsplit(['@', '/']).next().unwrap_or_default();
            write!(f, "{}{host}", if i > 0 { "," } else { "" })?;
        }
        Ok(())
    }
}

impl fmt::Debug for Address {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Address({self}, replicas {}, prefix {})", self.replicas, self.prefix)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_address_names_servers_and_options() {
        let address: Address = "nats://me:secret@a:4222,b:4222?replicas=3&prefix=TEST-1".parse().expect("reads");
        assert_eq!(address.servers, ["nats://me:secret@a:4222", "nats://me:secret@b:4222"]);
        assert_eq!((address.replicas, address.prefix.as_str()), (3, "TEST-1"));
        assert_eq!(address.to_string(), "a:4222,b:4222", "no password where it may be logged");
        assert!(!format!("{address:?}").contains("secret"));
        let plain: Address = "tls://a/".parse().expect("reads");
        assert_eq!((plain.servers, plain.replicas, plain.prefix.as_str()), (vec!["tls://a".to_owned()], 1, "SHRINKD"));
    }

    #[test]
    fn what_is_no_address_is_refused() {
        let refused = |text: &str| text.parse::<Address>().expect_err(text);
        assert_eq!(refused("http://a"), InvalidAddress::Scheme);
        assert_eq!(refused("nats://a,,b"), InvalidAddress::Server);
        assert_eq!(refused("nats://me@"), InvalidAddress::Server);
        assert_eq!(refused("nats://a?replica=3"), InvalidAddress::Option("replica".to_owned()));
        for text in ["nats://a?replicas=2", "nats://a?prefix=a.b", "nats://a?prefix="] {
            assert!(matches!(refused(text), InvalidAddress::Value(..)), "{text}");
        }
    }
}
