//! Any text as what strangers send beside bodies: an API key, the target of a notice, a tenant's name, the address of NATS servers.
#![no_main]

use libfuzzer_sys::fuzz_target;
use shrinkd::auth::key::ApiKey;
use shrinkd::engine::nats::Address;
use shrinkd::notify::signature::Secret;
use shrinkd::notify::target::Rules;
use shrinkd::tenant::Tenant;

fuzz_target!(|text: &str| {
    if let Some(key) = ApiKey::parse(text) {
        assert!(!key.id.is_empty() && text.contains(key.id));
    }
    for http in [false, true] {
        let rules = Rules { http, ports: Vec::new(), networks: Vec::new() };
        if let Ok(url) = rules.read(text) {
            assert!(url.scheme() == "https" || http && url.scheme() == "http");
            assert!(url.has_host() && url.username().is_empty() && url.password().is_none());
        }
    }
    if let Ok(tenant) = text.parse::<Tenant>() {
        assert_eq!(tenant.name(), text);
    }
    let _ = (text.parse::<Address>(), Secret::try_from(text.to_owned()));
});
