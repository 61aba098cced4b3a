//! What is counted and measured while the service runs, in the text format of Prometheus.
//!
//! Every metric is in [`ALL`] and in `docs/monitoring.md`, and nowhere else is one named: whoever has something to tell calls a
//! function of this module. Before [`Exposition::start`] (on the command line, in tests) all of them do nothing. Labels have few
//! values: routes are templates, and neither ids nor names that a client chose become labels.
//!
//! The numeric rooms know nothing of this: what they spent is in their reports.

use super::process;
use crate::engine::{Depth, Engine};
use crate::job::{JobKind, State};
use metrics::{counter, gauge, histogram};
use metrics_exporter_prometheus::{Matcher, PrometheusBuilder, PrometheusHandle};
use std::sync::Arc;
use std::time::{Duration, Instant};
use tokio::sync::Mutex;

/// How a metric behaves.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Kind {
    /// Only grows, from 0 at the start of the process.
    Counter,
    /// Goes up and down.
    Gauge,
    /// Counts of what was at most so large, with sum and count.
    Histogram(&'static [f64]),
}

/// A metric.
pub struct Metric {
    /// Its name.
    pub name: &'static str,
    /// How it behaves.
    pub kind: Kind,
    /// What it says, in a sentence.
    pub help: &'static str,
}

/// Seconds of what a client waits for: the bar for accepting a job is 0.05.
const SHORT: Kind = Kind::Histogram(&[0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 10.0, 60.0]);
/// Seconds of what a job takes or waits.
const LONG: Kind = Kind::Histogram(&[0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0, 60.0, 300.0, 1800.0, 7200.0]);

const JOBS: &str = "shrinkd_jobs";
const OLDEST: &str = "shrinkd_oldest_queued_job_age_seconds";
const CONNECTED: &str = "shrinkd_engine_connected";
const LAG: &str = "shrinkd_engine_lag_entries";
const ACCEPT: &str = "shrinkd_job_accept_duration_seconds";
const WAIT: &str = "shrinkd_job_wait_duration_seconds";
const RUN: &str = "shrinkd_job_run_duration_seconds";
const LOST: &str = "shrinkd_attempts_lost_total";
const EVALUATIONS: &str = "shrinkd_field_evaluations_total";
const VERTICES: &str = "shrinkd_vertices_total";
const RUNNING: &str = "shrinkd_worker_running_jobs";
const SLOTS: &str = "shrinkd_worker_slots";
const THREADS: &str = "shrinkd_pool_threads";
const REQUESTS: &str = "shrinkd_http_requests_total";
const REQUEST_DURATION: &str = "shrinkd_http_request_duration_seconds";
const SSE_CLIENTS: &str = "shrinkd_sse_clients";
const SSE_EVENTS: &str = "shrinkd_sse_events_total";
const UPLOADED: &str = "shrinkd_upload_bytes_total";
const DOWNLOADED: &str = "shrinkd_download_bytes_total";
const BLOB_DURATION: &str = "shrinkd_blob_operation_duration_seconds";
const ENGINE_DURATION: &str = "shrinkd_engine_call_duration_seconds";
const COLLECTED: &str = "shrinkd_blobs_collected_total";
const BUILD: &str = "shrinkd_build_info";

/// Every metric of the service.
pub const ALL: &[Metric] = &[
    Metric { name: JOBS, kind: Kind::Gauge, help: "Jobs that have not ended, in the whole service, by kind and state" },
    Metric {
        name: OLDEST,
        kind: Kind::Gauge,
        help: "Time since the oldest job that is queued was accepted; 0 when none is",
    },
    Metric {
        name: CONNECTED,
        kind: Kind::Gauge,
        help: "Whether the engine answered this node at the last look (1) or not (0)",
    },
    Metric {
        name: LAG,
        kind: Kind::Gauge,
        help: "Entries of the cluster that this node has not read yet; always 0 for sqlite",
    },
    Metric {
        name: ACCEPT,
        kind: SHORT,
        help: "Time from a request for a new job to the moment that the job is durable, by kind",
    },
    Metric { name: WAIT, kind: LONG, help: "Time from the acceptance of a job to its first start, by kind" },
    Metric { name: RUN, kind: LONG, help: "Time of an attempt from claim to end, by kind and outcome" },
    Metric { name: LOST, kind: Kind::Counter, help: "Attempts whose worker this node found lost" },
    Metric {
        name: EVALUATIONS,
        kind: Kind::Counter,
        help: "Evaluations of fields by jobs that ended here, by what was asked for",
    },
    Metric { name: VERTICES, kind: Kind::Counter, help: "Vertices of the surfaces and curves that were made here" },
    Metric { name: RUNNING, kind: Kind::Gauge, help: "Jobs that this node runs now" },
    Metric { name: SLOTS, kind: Kind::Gauge, help: "Jobs that this node runs at most" },
    Metric { name: THREADS, kind: Kind::Gauge, help: "Threads of the pool that this node's jobs share" },
    Metric { name: REQUESTS, kind: Kind::Counter, help: "Requests that were answered, by method, route and status" },
    Metric {
        name: REQUEST_DURATION,
        kind: SHORT,
        help: "Time to the head of the answer, by method and route; a wait that the client asked for is part of it",
    },
    Metric { name: SSE_CLIENTS, kind: Kind::Gauge, help: "Streams of events that are open now" },
    Metric { name: SSE_EVENTS, kind: Kind::Counter, help: "Events that were sent on streams, by type" },
    Metric { name: UPLOADED, kind: Kind::Counter, help: "Bytes of inputs that were uploaded" },
    Metric { name: DOWNLOADED, kind: Kind::Counter, help: "Bytes of outputs that were sent, by output" },
    Metric {
        name: BLOB_DURATION,
        kind: SHORT,
        help: "Time of an operation on the blob store, by operation and outcome",
    },
    Metric { name: ENGINE_DURATION, kind: SHORT, help: "Time of a call of the engine, by call and outcome" },
    Metric {
        name: COLLECTED,
        kind: Kind::Counter,
        help: "Blobs that this node removed because no job names them any more",
    },
    Metric { name: BUILD, kind: Kind::Gauge, help: "Always 1, with the version of the program" },
];

/// A share of a second that an answer to a scrape is used again for: scrapers that come together ask the engine once.
const FRESH: Duration = Duration::from_secs(1);
/// How long a scrape waits for the engine; the rest is told all the same.
const ENGINE_PATIENCE: Duration = Duration::from_secs(2);

/// What can be scraped; clones share it.
#[derive(Clone)]
pub struct Exposition {
    handle: PrometheusHandle,
    looked: Arc<Mutex<Option<Instant>>>,
}

impl Exposition {
    /// Starts counting. Once in a process.
    ///
    /// # Errors
    /// When something counts already.
    pub fn start() -> Result<Self, Box<dyn std::error::Error>> {
        let mut builder = PrometheusBuilder::new();
        for metric in ALL {
            if let Kind::Histogram(bounds) = metric.kind {
                builder = builder.set_buckets_for_metric(Matcher::Full(metric.name.to_owned()), bounds)?;
            }
        }
        let recorder = builder.build_recorder();
        let handle = recorder.handle();
        metrics::set_global_recorder(recorder)?;
        for metric in ALL {
            match metric.kind {
                Kind::Counter => metrics::describe_counter!(metric.name, metric.help),
                Kind::Gauge => metrics::describe_gauge!(metric.name, metric.help),
                Kind::Histogram(_) => metrics::describe_histogram!(metric.name, metric.help),
            }
        }
        process::start_time();
        gauge!(BUILD, "version" => env!("CARGO_PKG_VERSION")).set(1.0);
        // what may never happen is there from the start, so that its rate is known
        for kind in JobKind::ALL {
            let _ = histogram!(ACCEPT, "kind" => kind.name());
            let _ = histogram!(WAIT, "kind" => kind.name());
            for outcome in OUTCOMES {
                let _ = histogram!(RUN, "kind" => kind.name(), "outcome" => outcome);
            }
        }
        for asked in EVALUATED {
            let _ = counter!(EVALUATIONS, "of" => asked);
        }
        for name in [LOST, VERTICES, UPLOADED, COLLECTED] {
            let _ = counter!(name);
        }
        for name in [RUNNING, SLOTS, THREADS, SSE_CLIENTS] {
            gauge!(name).set(0.0);
        }
        Ok(Self { handle, looked: Arc::default() })
    }

    /// Everything as it is now.
    pub async fn render(&self, engine: &dyn Engine) -> String {
        let mut looked = self.looked.lock().await;
        if looked.is_none_or(|then| then.elapsed() > FRESH) {
            look(engine).await;
            *looked = Some(Instant::now());
        }
        self.handle.run_upkeep();
        self.handle.render() + &process::render()
    }
}

/// Asks the engine how much there is to do.
async fn look(engine: &dyn Engine) {
    let depth = tokio::time::timeout(ENGINE_PATIENCE, engine.depth()).await;
    let Ok(Ok(depth)) = depth else {
        gauge!(CONNECTED).set(0.0);
        return;
    };
    gauge!(CONNECTED).set(if depth.connected { 1.0 } else { 0.0 });
    gauge!(LAG).set(depth.lag as f64);
    let now = jiff::Timestamp::now();
    let age = depth.oldest_queued.map_or(0.0, |then| now.duration_since(then).as_secs_f64().max(0.0));
    gauge!(OLDEST).set(age);
    for kind in JobKind::ALL {
        for state in [State::Queued, State::Running, State::Canceling] {
            gauge!(JOBS, "kind" => kind.name(), "state" => state.name()).set(count(&depth, kind, state) as f64);
        }
    }
}

fn count(depth: &Depth, kind: JobKind, state: State) -> u64 {
    depth.open.iter().find(|open| (open.0, open.1) == (kind, state)).map_or(0, |open| open.2)
}

/// Ends of an attempt: the job's own, or `released` to the queue when the node stops, `lost` to another attempt, `unfinished` when
/// inputs or outputs were out of reach.
const OUTCOMES: [&str; 6] = ["succeeded", "failed", "canceled", "released", "lost", "unfinished"];
/// What an evaluation was asked for.
const EVALUATED: [&str; 2] = ["value", "gradient"];

/// A job was accepted, so long after its request began.
pub fn job_accepted(kind: JobKind, took: Duration) {
    histogram!(ACCEPT, "kind" => kind.name()).record(took);
}

/// A job that was accepted so long ago was taken up for the first time.
pub fn job_began(kind: JobKind, waited: Duration) {
    histogram!(WAIT, "kind" => kind.name()).record(waited);
}

/// An attempt came to its end.
pub fn attempt_ended(kind: JobKind, outcome: &'static str, took: Duration) {
    debug_assert!(OUTCOMES.contains(&outcome), "{outcome}");
    histogram!(RUN, "kind" => kind.name(), "outcome" => outcome).record(took);
}

/// What a job spent and made, as its report says.
pub fn job_reported(report: &serde_json::Value) {
    for asked in EVALUATED {
        let spent = report["evaluations"][asked].as_u64().unwrap_or_default();
        counter!(EVALUATIONS, "of" => asked).increment(spent);
    }
    counter!(VERTICES).increment(report["vertices"].as_u64().unwrap_or_default());
}

/// Attempts whose workers were found lost.
pub fn attempts_lost(count: u64) {
    counter!(LOST).increment(count);
}

/// What a worker has.
pub fn worker_started(slots: usize, threads: usize) {
    gauge!(SLOTS).set(slots as f64);
    gauge!(THREADS).set(threads as f64);
}

/// A request was answered.
pub fn request_answered(method: &http::Method, route: &str, status: u16, took: Duration) {
    let (method, route) = (method_label(method), if route.is_empty() { "none" } else { route });
    counter!(REQUESTS, "method" => method, "route" => route.to_owned(), "status" => status.to_string()).increment(1);
    histogram!(REQUEST_DURATION, "method" => method, "route" => route.to_owned()).record(took);
}

/// A client may send any word as a method.
fn method_label(method: &http::Method) -> &'static str {
    const KNOWN: [&str; 7] = ["GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS"];
    KNOWN.into_iter().find(|known| *known == method.as_str()).unwrap_or("other")
}

/// An event was sent on a stream.
pub fn event_sent(kind: &'static str) {
    counter!(SSE_EVENTS, "type" => kind).increment(1);
}

/// Bytes of an input came in.
pub fn uploaded(bytes: u64) {
    counter!(UPLOADED).increment(bytes);
}

/// Bytes of an output went out.
pub fn downloaded(output: &'static str, bytes: u64) {
    counter!(DOWNLOADED, "output" => output).increment(bytes);
}

/// The blob store did something.
pub fn blob_operation(operation: &'static str, outcome: &'static str, took: Duration) {
    histogram!(BLOB_DURATION, "operation" => operation, "outcome" => outcome).record(took);
}

/// The engine answered a call.
pub fn engine_call(call: &'static str, outcome: &'static str, took: Duration) {
    histogram!(ENGINE_DURATION, "call" => call, "outcome" => outcome).record(took);
}

/// Blobs were removed because nobody names them.
pub fn blobs_collected(count: u64) {
    counter!(COLLECTED).increment(count);
}

/// Counts something that is there for as long as this lives.
pub struct Present(metrics::Gauge);

impl Present {
    /// A stream of events.
    pub fn sse_client() -> Self {
        Self::of(gauge!(SSE_CLIENTS))
    }

    /// A running job.
    pub fn running_job() -> Self {
        Self::of(gauge!(RUNNING))
    }

    fn of(gauge: metrics::Gauge) -> Self {
        gauge.increment(1.0);
        Self(gauge)
    }
}

impl Drop for Present {
    fn drop(&mut self) {
        self.0.decrement(1.0);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_metric_is_documented_and_every_documented_metric_exists() {
        let file = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("docs/monitoring.md");
        let text = std::fs::read_to_string(file).expect("reads");
        let documented: Vec<(&str, &str)> = text
            .lines()
            .filter_map(|line| line.strip_prefix("| `")?.split_once("` | "))
            .filter(|(name, _)| name.starts_with("shrinkd_") || name.starts_with("process_"))
            .map(|(name, rest)| (name, rest.split(" |").next().unwrap_or_default()))
            .collect();
        let kind = |metric: &Metric| match metric.kind {
            Kind::Counter => "counter",
            Kind::Gauge => "gauge",
            Kind::Histogram(_) => "histogram",
        };
        let there: Vec<(&str, &str)> = ALL.iter().chain(process::ALL).map(|m| (m.name, kind(m))).collect();
        assert_eq!(documented, there);
    }

    #[test]
    fn names_follow_the_conventions_of_prometheus() {
        for metric in ALL {
            let name = metric.name;
            assert!(
                name.starts_with("shrinkd_") && name.bytes().all(|b| b.is_ascii_lowercase() || b == b'_'),
                "{name}"
            );
            assert_eq!(metric.kind == Kind::Counter, name.ends_with("_total"), "{name}");
            assert!(!matches!(metric.kind, Kind::Histogram(_)) || name.ends_with("_seconds"), "{name}");
        }
    }

    #[test]
    fn a_method_that_a_client_made_up_is_no_label_of_its_own() {
        let made_up = http::Method::from_bytes(b"SMURF").expect("a token");
        assert_eq!((method_label(&made_up), method_label(&http::Method::GET)), ("other", "GET"));
    }
}
