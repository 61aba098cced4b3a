//! What the process itself takes, by the names that clients of Prometheus share, read from `/proc` at a scrape.
//!
//! Where there is no `/proc` nothing of it is told.

use super::metrics::{Kind, Metric};
use std::fmt::Write as _;
use std::sync::OnceLock;
use std::time::{SystemTime, UNIX_EPOCH};

/// Metrics of the process, in the order in which they are [read](read).
pub const ALL: &[Metric] = &[
    Metric {
        name: "process_cpu_seconds_total",
        kind: Kind::Counter,
        help: "Time that the process has computed, for itself and in the system",
    },
    Metric { name: "process_resident_memory_bytes", kind: Kind::Gauge, help: "Memory of the process that is in use" },
    Metric { name: "process_threads", kind: Kind::Gauge, help: "Threads of the process" },
    Metric { name: "process_open_fds", kind: Kind::Gauge, help: "Files and connections that are open" },
    Metric { name: "process_max_fds", kind: Kind::Gauge, help: "Files and connections that may be open" },
    Metric {
        name: "process_start_time_seconds",
        kind: Kind::Gauge,
        help: "When the process began to count, in seconds since 1970",
    },
];

/// When this was first asked for, by the time of day: the start of the service.
pub fn start_time() -> f64 {
    static START: OnceLock<f64> = OnceLock::new();
    *START.get_or_init(|| SystemTime::now().duration_since(UNIX_EPOCH).map_or(0.0, |time| time.as_secs_f64()))
}

/// The metrics in the text format.
pub fn render() -> String {
    let mut text = String::new();
    for (metric, value) in ALL.iter().zip(read().unwrap_or_default()) {
        let kind = if metric.kind == Kind::Counter { "counter" } else { "gauge" };
        // writing to a string cannot fail
        let _ = writeln!(text, "# HELP {0} {1}\n# TYPE {0} {kind}\n{0} {value}\n", metric.name, metric.help);
    }
    text
}

fn read() -> Option<[f64; 6]> {
    let stat = std::fs::read_to_string("/proc/self/stat").ok()?;
    // the second field is the program's name in brackets, which may hold anything; the next is number 3 of proc(5)
    let fields: Vec<&str> = stat.rsplit_once(')')?.1.split_ascii_whitespace().collect();
    let field = |number: usize| fields.get(number - 3)?.parse::<f64>().ok();
    let cpu = (field(14)? + field(15)?) / rustix::param::clock_ticks_per_second() as f64;
    let memory = field(24)? * rustix::param::page_size() as f64;
    // one of them is the folder that is being read
    let open = std::fs::read_dir("/proc/self/fd").ok()?.count().saturating_sub(1);
    let most = rustix::process::getrlimit(rustix::process::Resource::Nofile).current;
    Some([cpu, memory, field(20)?, open as f64, most.map_or(f64::INFINITY, |most| most as f64), start_time()])
}

#[cfg(all(test, target_os = "linux"))]
mod tests {
    use super::*;
    use std::time::Instant;

    #[test]
    fn a_process_knows_what_it_takes() {
        let [_, memory, threads, open, most, start] = read().expect("reads");
        assert!(memory > 1e6 && threads >= 1.0 && open >= 3.0 && most >= open, "{memory} {threads} {open} {most}");
        assert!(start > 1.6e9);
        let clock = Instant::now();
        let before = read().expect("reads")[0];
        while clock.elapsed().as_millis() < 200 {}
        assert!(read().expect("reads")[0] > before, "computing takes time");
    }
}
