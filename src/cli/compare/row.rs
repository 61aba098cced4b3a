//! One result: a shape on a lattice, and what was measured.

use crate::measure::Report;
use crate::measure::baseline::Baseline;
use crate::shrink::lattice::LatticeSpec;
use serde::Serialize;
use serde_json::{Map, Value};
use std::fmt::Write as _;

/// What became of a shape on a lattice.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[serde(tag = "result", rename_all = "snake_case")]
pub enum Outcome {
    /// It succeeded, by every condition of `docs/metrics.md`.
    Passed,
    /// It did not.
    Failed {
        /// A stable short name: `not_certified` for a result that breaks a condition, `crashed`, `over_time`, or the
        /// failure's own code.
        code: String,
        /// One sentence for every reason.
        faults: Vec<String>,
    },
    /// Its zero level set is no sphere, and was refused.
    Refused {
        /// The failure's code, such as `genus`.
        code: String,
        /// What was found, with its number.
        detail: String,
        /// Scene positions that belong to it.
        places: Vec<[f64; 3]>,
        /// Whether a refusal was expected.
        expected: bool,
    },
}

impl Outcome {
    /// Whether this is what should have come: a success, or a refusal that was expected.
    pub fn is_as_expected(&self) -> bool {
        matches!(self, Outcome::Passed | Outcome::Refused { expected: true, .. })
    }
}

/// One row of the table.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Row {
    /// The shape's path from the folder.
    pub shape: String,
    /// The folder that it is in.
    pub folder: String,
    /// The lattice.
    pub lattice: LatticeSpec,
    /// What became of it.
    #[serde(flatten)]
    pub outcome: Outcome,
    /// Wall-clock seconds of opening, shrinking, measuring and writing together.
    pub seconds: f64,
    /// Wall-clock seconds of shrinking in which the field was being evaluated.
    pub field_seconds: f64,
    /// Attempts that were made, where the report says so.
    pub attempts: Option<u64>,
    /// The report of the result, where there is one.
    pub report: Option<Report>,
    /// Marching cubes of as many vertices on the same field.
    pub baseline: Option<Baseline>,
    /// The report of what the paper's method made of it, where it was asked for and made something.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub paper: Option<Report>,
}

impl Row {
    /// The lattice as it is written on the command line.
    pub fn lattice_name(&self) -> String {
        lattice_name(self.lattice)
    }

    /// Seconds of shrinking outside the field.
    pub fn other_seconds(&self) -> Option<f64> {
        self.report.as_ref().map(|report| (report.seconds.shrink - self.field_seconds).max(0.0))
    }

    /// One line of the table.
    pub fn to_markdown(&self) -> String {
        let (result, why) = match &self.outcome {
            Outcome::Passed => ("pass", String::new()),
            Outcome::Failed { code, faults } if self.report.is_none() => {
                ("**FAIL**", format!("{code}: {}", faults.join("; ")))
            }
            Outcome::Failed { faults, .. } => ("**FAIL**", faults.join("; ")),
            Outcome::Refused { detail, expected: true, .. } => ("refused", detail.clone()),
            Outcome::Refused { detail, .. } => ("**refused**", detail.clone()),
        };
        let mut line = format!("| {} | {} | {result} |", in_a_cell(&self.shape), self.lattice_name());
        match &self.report {
            None => line.push_str(&" |".repeat(COLUMNS - 4)),
            Some(report) => self.figures(report, &mut line),
        }
        let _ = writeln!(line, " {} |", in_a_cell(&why));
        line
    }

    fn figures(&self, report: &Report, line: &mut String) {
        let (flips, sphere, d) = (report.flips, &report.distortion.sphere, &report.closeness.distance);
        let base = self.baseline.as_ref();
        let or_none = |text: Option<String>| text.unwrap_or_else(|| "–".to_owned());
        let cells = [
            report.vertices.to_string(),
            format!("{:.1}", report.evaluations.per_vertex),
            or_none(self.attempts.map(|n| n.to_string())),
            (flips.surface + flips.sphere + flips.uv).to_string(),
            report.self_intersections.to_string(),
            format!("{:.3}", 100.0 * d.surface_to_truth.max),
            format!("{:.3}", 100.0 * d.truth_to_surface.max),
            format!("{:.2}", 1e4 * d.mean),
            or_none(base.map(|b| format!("{:.2}", 1e4 * b.closeness.distance.mean))),
            format!("{:.4}", report.closeness.normal_consistency),
            or_none(base.map(|b| format!("{:.4}", b.closeness.normal_consistency))),
            format!("{:.2}", sphere.area_p1),
            format!("{:.2}", sphere.area_p99),
            format!("{:.2}", sphere.log_area_rms),
            format!("{:.1}", sphere.symmetric_dirichlet),
            format!("{:.2}", report.seconds.shrink),
            format!("{:.2}", self.field_seconds),
        ];
        for cell in cells {
            let _ = write!(line, " {cell} |");
        }
    }
}

/// Columns of the table.
const COLUMNS: usize = HEAD.len();
/// Their names.
const HEAD: [&str; 21] = [
    "shape",
    "lattice",
    "result",
    "vertices",
    "eval/vertex",
    "attempts",
    "flips",
    "self-int.",
    "max to truth %",
    "max from truth %",
    "mean e-4",
    "MC mean e-4",
    "NC",
    "MC NC",
    "area p1",
    "area p99",
    "log-area RMS",
    "sym. Dirichlet",
    "shrink s",
    "field s",
    "why",
];

/// What stands before the rows; `options` are those of wrapping.
pub fn head(options: &Map<String, Value>) -> String {
    let options: Vec<String> = options.iter().map(|(name, value)| format!("{name} {value}").replace('"', "")).collect();
    let mut text = format!("Options: {}.\n\n", options.join(", "));
    text.push_str(
        "Distances in parts of the diagonal of the truth's bounding box. MC: marching cubes of as many vertices on the same \
         field. Area ratio (percentiles over triangles), log-area and symmetric Dirichlet: sphere to surface, areas matched \
         globally. Field: seconds of shrinking in which the field was being evaluated.\n\n|",
    );
    for name in HEAD {
        let _ = write!(text, " {name} |");
    }
    text.push_str("\n|---|---|---|");
    text.push_str(&"---:|".repeat(COLUMNS - 4));
    text.push_str("---|\n");
    text
}

/// The lattice as it is written on the command line.
pub fn lattice_name(lattice: LatticeSpec) -> String {
    match lattice {
        LatticeSpec::Latlong { n_theta, n_phi } => format!("latlong:{n_theta}x{n_phi}"),
        LatticeSpec::Octahedral { n } => format!("octahedral:{n}"),
    }
}

/// Text that cannot end a cell or a line of a Markdown table.
pub fn in_a_cell(text: &str) -> String {
    text.replace('|', "\\|").replace(['\n', '\r'], " ")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_row_has_as_many_cells_as_the_head_whatever_became_of_it() {
        let row = |outcome: Outcome| Row {
            shape: "a|b.ply".to_owned(),
            folder: ".".to_owned(),
            lattice: LatticeSpec::Octahedral { n: 8 },
            outcome,
            seconds: 1.0,
            field_seconds: 0.5,
            attempts: None,
            report: None,
            baseline: None,
            paper: None,
        };
        let cells = |line: &str| line.replace("\\|", "").matches('|').count() - 1;
        for line in head(&Map::new()).lines().filter(|l| l.starts_with('|')) {
            assert_eq!(cells(line), COLUMNS, "{line}");
        }
        let failed = Outcome::Failed { code: "crashed".to_owned(), faults: vec!["two\nlines".to_owned()] };
        let refused =
            Outcome::Refused { code: "genus".to_owned(), detail: "1 | 2".to_owned(), places: vec![], expected: false };
        for outcome in [Outcome::Passed, failed, refused] {
            let line = row(outcome).to_markdown();
            assert_eq!(line.lines().count(), 1);
            assert_eq!(cells(&line), COLUMNS, "{line}");
        }
    }
}
