//! What results and stored results have in common: figures of a report, and a list of those that got worse.

use serde_json::Value;

/// A number of a report.
pub fn number(report: &Value, pointer: &str) -> f64 {
    report.pointer(pointer).and_then(Value::as_f64).unwrap_or_else(|| panic!("no {pointer}"))
}

/// A count of a report.
pub fn count(report: &Value, pointer: &str) -> u64 {
    report.pointer(pointer).and_then(Value::as_u64).unwrap_or_else(|| panic!("no {pointer}"))
}

/// Figures that are over their limits.
#[derive(Default)]
pub struct Losses(pub Vec<String>);

impl Losses {
    /// Notes a figure that is over its limit, or no number at all.
    pub fn at_most(&mut self, what: &str, found: f64, limit: f64) {
        if found > limit || found.is_nan() || limit.is_nan() {
            self.0.push(format!("{what} is {found}, over {limit}"));
        }
    }
}
