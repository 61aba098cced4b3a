//! `shrinkd keys`: makes, lists and revokes API keys, while the service runs or before it does.

use super::open_engine::open_keys;
use super::{BAD_USAGE, FAILED, fail};
use crate::auth::Scope;
use crate::auth::key::{NewKey, StoredKey};
use crate::auth::keys::{KeyStore, revoke};
use crate::config::Config;
use crate::tenant::Tenant;
use clap::{Args, Subcommand};
use jiff::{Span, Timestamp, Zoned};
use serde::Serialize;
use std::path::PathBuf;
use std::process::ExitCode;

/// What `keys --help` ends with.
pub const EXAMPLES: &str = "\
Examples:
  shrinkd keys create --tenant team-a --name viewer --scope read --expires 90d
  shrinkd keys list --engine nats://host:4222
  shrinkd keys revoke 5f0c9a0e7d1b2c34

Keys are kept where the service keeps its jobs: give the same --data, --engine or --config. A running service takes a new key at once, and
refuses a revoked one within a few seconds, on every node.";

/// Arguments of `keys`.
#[derive(Debug, Args)]
pub struct KeysArgs {
    #[command(subcommand)]
    command: Command,
    /// Folder of the service [default: ./shrinkd-data]
    #[arg(long, value_name = "DIR", global = true)]
    data: Option<PathBuf>,
    /// Where the service keeps its jobs: sqlite, or nats://HOST:PORT for a cluster [default: sqlite]
    #[arg(long, value_name = "URL", global = true)]
    engine: Option<String>,
    /// Configuration file of the service (TOML)
    #[arg(long, value_name = "FILE", global = true)]
    config: Option<PathBuf>,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Make a key and print it, this once: only a hash of it is kept
    Create {
        /// Whose the key is
        #[arg(long)]
        tenant: Tenant,
        /// What it allows, separated by commas
        #[arg(long, value_enum, value_delimiter = ',', default_values = ["read", "write"])]
        scope: Vec<Scope>,
        /// When it stops working: a time (2027-01-31T00:00:00Z) or how long from now (90d)
        #[arg(long, value_name = "TIME", value_parser = parse_expiry)]
        expires: Option<Timestamp>,
        /// What people call it
        #[arg(long, default_value = "")]
        name: String,
    },
    /// List the keys, also those that do not work any more: id, tenant, scopes, state, times and name, separated by tabs
    List,
    /// Stop a key from working
    Revoke {
        /// Its id: the part between the first and the second underscore
        id: String,
    },
}

#[derive(Serialize)]
struct Flags<'a> {
    #[serde(skip_serializing_if = "Option::is_none")]
    data_dir: Option<&'a std::path::Path>,
    #[serde(skip_serializing_if = "Option::is_none")]
    engine: Option<&'a str>,
}

/// Does what is asked.
pub fn run(args: &KeysArgs) -> ExitCode {
    let flags = Flags { data_dir: args.data.as_deref(), engine: args.engine.as_deref() };
    let config = match Config::load(args.config.as_deref(), flags) {
        Ok(config) => config,
        Err(error) => return fail(BAD_USAGE, &error),
    };
    let runtime = match tokio::runtime::Builder::new_current_thread().enable_all().build() {
        Ok(runtime) => runtime,
        Err(error) => return fail(FAILED, &error),
    };
    let done = runtime.block_on(async {
        let store = open_keys(&config).await?;
        act(store.as_ref(), &args.command).await
    });
    match done {
        Ok(code) => code,
        Err(error) => fail(FAILED, &error),
    }
}

async fn act(store: &dyn KeyStore, command: &Command) -> Result<ExitCode, Box<dyn std::error::Error>> {
    match command {
        Command::Create { tenant, scope, expires, name } => {
            let new = NewKey {
                tenant: tenant.clone(),
                scopes: scope.iter().copied().collect(),
                name: name.clone(),
                expires_at: *expires,
            };
            let (stored, key) = StoredKey::make(new)?;
            let id = stored.id.clone();
            store.put(stored).await?;
            eprintln!("shrinkd: key {id} of tenant {tenant} is shown this once:");
            println!("{key}");
        }
        Command::List => {
            let mut keys = store.all().await?;
            keys.sort_by(|a, b| (&a.tenant, a.created_at).cmp(&(&b.tenant, b.created_at)));
            println!("id\ttenant\tscopes\tstate\tcreated\texpires\tname");
            for key in keys {
                println!("{}", row(&key, Timestamp::now()));
            }
        }
        Command::Revoke { id } => {
            // whoever pastes the whole key means its id
            let id = id.strip_prefix("shrinkd_").and_then(|key| key.split('_').next()).unwrap_or(id);
            if !revoke(store, id).await? {
                return Ok(fail(FAILED, &format!("there is no key {id}")));
            }
            eprintln!("shrinkd: key {id} is revoked");
        }
    }
    Ok(ExitCode::SUCCESS)
}

fn row(key: &StoredKey, now: Timestamp) -> String {
    let scopes: Vec<&str> = key.scopes.iter().map(|scope| scope.name()).collect();
    let state = match key.works(now) {
        true => "works",
        false if key.revoked_at.is_some() => "revoked",
        false => "expired",
    };
    let expires = key.expires_at.map_or("never".to_owned(), |at| at.to_string());
    let (created, name) = (key.created_at, key.name.replace(['\t', '\n'], " "));
    format!("{}\t{}\t{}\t{state}\t{created:.0}\t{expires}\t{name}", key.id, key.tenant, scopes.join(","))
}

/// A time, or how long from now; in the future.
fn parse_expiry(text: &str) -> Result<Timestamp, String> {
    let now = Zoned::now();
    let from_now = || now.checked_add(text.parse::<Span>().ok()?).ok().map(|then| then.timestamp());
    let then = text.parse().ok().or_else(from_now);
    let then = then.ok_or("expected a time such as 2027-01-31T00:00:00Z, or how long from now, such as 90d")?;
    if then > now.timestamp() { Ok(then) } else { Err("expected a time in the future".to_owned()) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_expiry_is_a_time_or_how_long_from_now() {
        let now = Timestamp::now();
        let days = parse_expiry("90d").expect("reads").duration_since(now).as_hours();
        assert!((90 * 24 - 2..=90 * 24 + 2).contains(&days), "{days} hours");
        assert_eq!(parse_expiry("2999-01-31T00:00:00Z").expect("reads").to_string(), "2999-01-31T00:00:00Z");
        for text in ["", "soon", "1970-01-01T00:00:00Z", "-1d"] {
            assert!(parse_expiry(text).is_err(), "{text}");
        }
    }
}
