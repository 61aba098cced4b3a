//! What an operator sees of a running service. Here the log: structured lines on standard error, with the request's and the job's
//! id on each; beside it the [metrics] and the [traces].

pub mod metrics;
mod process;
pub mod traces;

use crate::config::{LogConfig, LogFormat};
use std::io::IsTerminal;
use traces::Traces;
use tracing_subscriber::layer::SubscriberExt as _;
use tracing_subscriber::util::SubscriberInitExt as _;
use tracing_subscriber::{EnvFilter, Layer as _};

/// Starts the log, and with it what is sent to a collector. A second call changes nothing.
///
/// # Errors
/// When the filter cannot be read.
pub fn start(config: &LogConfig, traces: Option<&Traces>) -> Result<(), tracing_subscriber::filter::ParseError> {
    let filter = EnvFilter::try_new(&config.filter)?;
    let log = tracing_subscriber::fmt::layer().with_writer(std::io::stderr);
    // https://no-color.org
    let colours = std::io::stderr().is_terminal() && std::env::var_os("NO_COLOR").is_none_or(|value| value.is_empty());
    let log = match config.format {
        LogFormat::Json => log.json().flatten_event(true).with_filter(filter).boxed(),
        LogFormat::Pretty => log.with_ansi(colours).with_filter(filter).boxed(),
    };
    // fails only when a log was started before, which then stays
    let _ = tracing_subscriber::registry().with(log).with(traces.map(Traces::layer)).try_init();
    Ok(())
}
