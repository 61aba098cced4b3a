//! Where a notice may be sent: the check of an address that somebody else chose.
//!
//! It is made when a job is accepted, for an early answer, and again at every delivery. Names are not resolved here: the
//! [courier](super::courier) does that when it connects, and connects to nothing but addresses that are [permitted](super::network).

use super::network;
use crate::config::WebhooksConfig;
use ipnet::IpNet;
use std::net::IpAddr;
use url::{Host, Url};

/// Characters of a target.
pub const MAX_URL: usize = 2048;

/// What targets may be.
#[derive(Clone, Debug, Default)]
pub struct Rules {
    /// Whether `http` will do.
    pub http: bool,
    /// The ports that may be asked; none means any.
    pub ports: Vec<u16>,
    /// Networks that are let through although they are no part of the public internet.
    pub networks: Vec<IpNet>,
}

/// Why a target is refused: a stable code and a sentence.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{detail}")]
pub struct Refused {
    /// What is wrong, as a name.
    pub code: &'static str,
    /// What is wrong, for a person.
    pub detail: String,
}

fn refused(code: &'static str, detail: impl Into<String>) -> Refused {
    Refused { code, detail: detail.into() }
}

impl From<&WebhooksConfig> for Rules {
    fn from(config: &WebhooksConfig) -> Self {
        Self { http: config.allow_http, ports: config.ports.clone(), networks: config.allow_private.clone() }
    }
}

impl Rules {
    /// Reads a target. Numbers in the place of a name (`0x7f.1`, `2130706433`, `0177.0.0.1`) are the addresses that they stand for.
    ///
    /// # Errors
    /// What about it is not let through.
    pub fn read(&self, text: &str) -> Result<Url, Refused> {
        if text.len() > MAX_URL {
            return Err(refused("too_long", format!("an address has at most {MAX_URL} characters")));
        }
        let url = Url::parse(text).map_err(|error| refused("malformed_url", format!("expected a URL: {error}")))?;
        match url.scheme() {
            "https" => {}
            "http" if self.http => {}
            "http" => return Err(refused("not_https", "expected https")),
            other => return Err(refused("not_https", format!("expected https, found {other:?}"))),
        }
        if !url.username().is_empty() || url.password().is_some() {
            return Err(refused(
                "user_info",
                "a name or password in the address is not sent; the signature says who asks",
            ));
        }
        if url.fragment().is_some() {
            return Err(refused("malformed_url", "a fragment is not sent"));
        }
        let port = url.port_or_known_default().unwrap_or_default();
        if !self.ports.is_empty() && !self.ports.contains(&port) {
            return Err(refused("port", format!("port {port} is not let through; known: {:?}", self.ports)));
        }
        match url.host() {
            Some(Host::Ipv4(address)) => self.permit(IpAddr::V4(address))?,
            Some(Host::Ipv6(address)) => self.permit(IpAddr::V6(address))?,
            // loopback by definition (RFC 6761), whatever a resolver says
            Some(Host::Domain(name)) if is_localhost(name) => self.permit(IpAddr::from([127, 0, 0, 1]))?,
            Some(Host::Domain(_)) => {}
            None => return Err(refused("malformed_url", "expected a host")),
        }
        Ok(url)
    }

    /// Lets an address through, or not.
    ///
    /// # Errors
    /// When it is no part of the public internet, and the operator did not name it.
    pub fn permit(&self, address: IpAddr) -> Result<(), Refused> {
        if network::is_permitted(address, &self.networks) {
            return Ok(());
        }
        // the address itself is not told: a name may have led to it, and what a name leads to inside is nobody's business
        Err(refused("private_address", "the host is no part of the public internet"))
    }
}

fn is_localhost(name: &str) -> bool {
    let name = name.trim_end_matches('.');
    name.eq_ignore_ascii_case("localhost") || name.to_ascii_lowercase().ends_with(".localhost")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn code(rules: &Rules, text: &str) -> Option<&'static str> {
        rules.read(text).err().map(|refused| refused.code)
    }

    #[test]
    fn a_public_https_address_is_let_through() {
        let rules = Rules { ports: vec![443], ..Rules::default() };
        for text in [
            "https://hooks.example.com/a?b=c",
            "https://1.1.1.1/",
            "https://[2606:4700::1111]/x",
            "https://example.com:443/",
        ] {
            assert_eq!(code(&rules, text), None, "{text}");
        }
    }

    #[test]
    fn every_spelling_of_a_local_address_is_refused() {
        let rules = Rules::default();
        let loopback =
            ["127.0.0.1", "127.1", "2130706433", "0x7f000001", "0177.0.0.1", "0x7f.1", "017700000001", "127.0.0.1."];
        let others = [
            "localhost",
            "LOCALHOST.",
            "a.localhost",
            "0",
            "0.0.0.0",
            "169.254.169.254",
            "0xa9fea9fe",
            "10.0.0.1",
            "[::1]",
        ];
        let v6 = [
            "[::ffff:127.0.0.1]",
            "[::ffff:7f00:1]",
            "[::127.0.0.1]",
            "[64:ff9b::7f00:1]",
            "[fe80::1]",
            "[fd00::1]",
            "[::]",
        ];
        // digits and dots of other scripts stand for the ASCII ones
        let scripts = ["\u{ff11}\u{ff12}\u{ff17}.0.0.1", "127\u{3002}0\u{3002}0\u{3002}1"];
        for host in loopback.iter().chain(&others).chain(&v6).chain(&scripts) {
            assert_eq!(code(&rules, &format!("https://{host}/")), Some("private_address"), "{host}");
        }
    }

    #[test]
    fn other_schemes_ports_and_user_info_are_refused() {
        let rules = Rules { ports: vec![443], ..Rules::default() };
        let cases = [
            ("http://example.com/", "not_https"),
            ("ftp://example.com/", "not_https"),
            ("file:///etc/passwd", "not_https"),
            ("https://user@example.com/", "user_info"),
            ("https://:secret@example.com/", "user_info"),
            ("https://example.com:8443/", "port"),
            ("https://example.com:22/", "port"),
            ("https://example.com/#a", "malformed_url"),
            ("https://", "malformed_url"),
            ("hooks.example.com/", "malformed_url"),
            ("https://256.1.1.1/", "malformed_url"),
        ];
        for (text, expected) in cases {
            assert_eq!(code(&rules, text), Some(expected), "{text}");
        }
        assert_eq!(code(&rules, &format!("https://example.com/{}", "x".repeat(MAX_URL))), Some("too_long"));
        let open = Rules { http: true, networks: vec!["127.0.0.0/8".parse().expect("network")], ..Rules::default() };
        assert_eq!(code(&open, "http://localhost:8123/hook"), None);
        assert_eq!(code(&open, "http://10.0.0.1/"), Some("private_address"));
    }
}
