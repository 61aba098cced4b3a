//! What the rows say together, by folder and lattice.

use super::row::{Outcome, Row, lattice_name};
use crate::shrink::lattice::LatticeSpec;
use serde::Serialize;
use std::collections::BTreeSet;
use std::fmt::Write as _;

/// Bounds of the area ratio that a well-spread lattice keeps between its 1st and 99th percentile.
const AREA: std::ops::RangeInclusive<f64> = 0.3..=3.3;
/// How the summary names all folders together.
const ALL: &str = "all";

/// The rows of a folder on a lattice.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Group {
    /// The folder, or `all`.
    pub folder: String,
    /// The lattice, as it is written on the command line.
    pub lattice: String,
    /// Rows.
    pub shapes: usize,
    /// Those that succeeded.
    pub passed: usize,
    /// Those that did not.
    pub failed: usize,
    /// Those that were refused, expected or not.
    pub refused: usize,
    /// Those that were refused against expectation.
    pub refused_unexpectedly: usize,
    /// `passed` over the rows that were not refused as expected.
    pub share: Option<f64>,
    /// Rows with a baseline, ...
    pub beside_baseline: usize,
    /// ... those whose normal consistency is not below it, ...
    pub normals_as_good: usize,
    /// ... and those whose mean distance is not above it.
    pub mean_as_good: usize,
    /// Rows with a report, ...
    pub measured: usize,
    /// ... and those whose area ratio has its 1st and 99th percentile within 0.3 and 3.3.
    pub area_in_bounds: usize,
    /// Medians over the rows with a report.
    pub medians: Medians,
}

/// Medians; `None` without rows.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Medians {
    /// Field evaluations per vertex.
    pub evaluations_per_vertex: Option<f64>,
    /// Largest distance both ways, in parts of the diagonal.
    pub max_distance: Option<f64>,
    /// Mean distance.
    pub mean_distance: Option<f64>,
    /// Normal consistency.
    pub normal_consistency: Option<f64>,
    /// Normal consistency of marching cubes.
    pub baseline_normal_consistency: Option<f64>,
    /// Root mean square of the log of the area ratio, sphere to surface.
    pub log_area_rms: Option<f64>,
    /// Symmetric Dirichlet energy, sphere to surface.
    pub symmetric_dirichlet: Option<f64>,
    /// Seconds of shrinking.
    pub shrink_seconds: Option<f64>,
    /// Of those, seconds outside the field.
    pub other_seconds: Option<f64>,
}

/// Every folder on every lattice, and all folders together when there are several.
pub fn of(rows: &[Row], lattices: &[LatticeSpec]) -> Vec<Group> {
    let folders: BTreeSet<&str> = rows.iter().map(|row| row.folder.as_str()).collect();
    let mut groups = Vec::new();
    for &lattice in lattices {
        for folder in &folders {
            groups.extend(group(folder, lattice, rows.iter().filter(|row| row.folder == *folder)));
        }
        if folders.len() > 1 {
            groups.extend(group(ALL, lattice, rows.iter()));
        }
    }
    groups
}

fn group<'a>(folder: &str, lattice: LatticeSpec, rows: impl Iterator<Item = &'a Row>) -> Option<Group> {
    let rows: Vec<&Row> = rows.filter(|row| row.lattice == lattice).collect();
    if rows.is_empty() {
        return None;
    }
    let count = |wanted: &dyn Fn(&Row) -> bool| rows.iter().filter(|row| wanted(row)).count();
    let passed = count(&|row| row.outcome == Outcome::Passed);
    let refused = count(&|row| matches!(row.outcome, Outcome::Refused { .. }));
    let refused_unexpectedly = count(&|row| matches!(row.outcome, Outcome::Refused { expected: false, .. }));
    let counted = rows.len() - (refused - refused_unexpectedly);
    let both = |row: &Row| Some((row.report.clone()?, row.baseline?));
    let median = |figure: &dyn Fn(&Row) -> Option<f64>| median(rows.iter().filter_map(|row| figure(row)).collect());
    let reported = |figure: &dyn Fn(&crate::measure::Report) -> f64| median(&|row| row.report.as_ref().map(figure));
    Some(Group {
        folder: folder.to_owned(),
        lattice: lattice_name(lattice),
        shapes: rows.len(),
        passed,
        failed: rows.len() - passed - refused,
        refused,
        refused_unexpectedly,
        share: (counted > 0).then(|| passed as f64 / counted as f64),
        beside_baseline: count(&|row| both(row).is_some()),
        normals_as_good: count(&|row| {
            both(row).is_some_and(|(r, b)| r.closeness.normal_consistency >= b.closeness.normal_consistency)
        }),
        mean_as_good: count(&|row| {
            both(row).is_some_and(|(r, b)| r.closeness.distance.mean <= b.closeness.distance.mean)
        }),
        measured: count(&|row| row.report.is_some()),
        area_in_bounds: count(&|row| {
            let sphere = row.report.as_ref().map(|r| r.distortion.sphere);
            sphere.is_some_and(|d| AREA.contains(&d.area_p1) && AREA.contains(&d.area_p99))
        }),
        medians: Medians {
            evaluations_per_vertex: reported(&|r| r.evaluations.per_vertex),
            max_distance: reported(&|r| r.closeness.distance.max),
            mean_distance: reported(&|r| r.closeness.distance.mean),
            normal_consistency: reported(&|r| r.closeness.normal_consistency),
            baseline_normal_consistency: median(&|row| row.baseline.map(|b| b.closeness.normal_consistency)),
            log_area_rms: reported(&|r| r.distortion.sphere.log_area_rms),
            symmetric_dirichlet: reported(&|r| r.distortion.sphere.symmetric_dirichlet),
            shrink_seconds: reported(&|r| r.seconds.shrink),
            other_seconds: median(&Row::other_seconds),
        },
    })
}

/// The middle value, or the mean of the two in the middle.
fn median(mut values: Vec<f64>) -> Option<f64> {
    values.sort_unstable_by(f64::total_cmp);
    let n = values.len();
    (n > 0).then(|| 0.5 * (values[(n - 1) / 2] + values[n / 2]))
}

/// The summary as a table.
pub fn to_markdown(rows: &[Row], lattices: &[LatticeSpec]) -> String {
    let mut text = String::from(
        "\nSummary: *share* is of the shapes that were not refused as expected; *NC* and *mean* count the shapes that are not \
         worse than marching cubes; *area* those whose p1 and p99 lie within 0.3 and 3.3; medians are over all measured.\n\n\
         | folder | lattice | shapes | pass | fail | refused (unexpected) | share | NC | mean | area | eval/vertex | max % \
         | mean e-4 | NC median | MC NC | log-area RMS | sym. Dirichlet | shrink s | outside field s |\n",
    );
    text.push_str("|---|---|");
    text.push_str(&"---:|".repeat(17));
    text.push('\n');
    for group in of(rows, lattices) {
        let m = &group.medians;
        let number = |value: Option<f64>, factor: f64, digits: usize| {
            value.map_or("–".to_owned(), |v| format!("{:.digits$}", factor * v))
        };
        let _ = writeln!(
            text,
            "| {} | {} | {} | {} | {} | {} ({}) | {} | {}/{} | {}/{} | {}/{} | {} | {} | {} | {} | {} | {} | {} | {} | {} |",
            group.folder,
            group.lattice,
            group.shapes,
            group.passed,
            group.failed,
            group.refused,
            group.refused_unexpectedly,
            group.share.map_or("–".to_owned(), |share| format!("{:.1} %", 100.0 * share)),
            group.normals_as_good,
            group.beside_baseline,
            group.mean_as_good,
            group.beside_baseline,
            group.area_in_bounds,
            group.measured,
            number(m.evaluations_per_vertex, 1.0, 1),
            number(m.max_distance, 100.0, 3),
            number(m.mean_distance, 1e4, 2),
            number(m.normal_consistency, 1.0, 4),
            number(m.baseline_normal_consistency, 1.0, 4),
            number(m.log_area_rms, 1.0, 2),
            number(m.symmetric_dirichlet, 1.0, 1),
            number(m.shrink_seconds, 1.0, 2),
            number(m.other_seconds, 1.0, 2),
        );
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    const LATTICE: LatticeSpec = LatticeSpec::Octahedral { n: 8 };

    fn row(folder: &str, outcome: Outcome) -> Row {
        Row {
            shape: format!("{folder}/x"),
            folder: folder.to_owned(),
            lattice: LATTICE,
            outcome,
            seconds: 1.0,
            field_seconds: 0.1,
            attempts: None,
            report: None,
            baseline: None,
            paper: None,
        }
    }

    #[test]
    fn an_expected_refusal_does_not_count_against_the_share_and_another_does() {
        let refused =
            |expected| Outcome::Refused { code: String::new(), detail: String::new(), places: vec![], expected };
        let failed = Outcome::Failed { code: String::new(), faults: vec![] };
        let rows = [
            row("a", Outcome::Passed),
            row("a", failed),
            row("a", refused(false)),
            row("b", refused(true)),
            row("b", Outcome::Passed),
        ];
        let groups = of(&rows, &[LATTICE, LatticeSpec::Octahedral { n: 9 }]);
        let found: Vec<(&str, usize, usize, usize, Option<f64>)> =
            groups.iter().map(|g| (g.folder.as_str(), g.passed, g.failed, g.refused, g.share)).collect();
        assert_eq!(found, [("a", 1, 1, 1, Some(1.0 / 3.0)), ("b", 1, 0, 1, Some(1.0)), (ALL, 2, 1, 2, Some(0.5))]);
        let table = to_markdown(&rows, &[LATTICE]);
        let widths: BTreeSet<usize> =
            table.lines().filter(|l| l.starts_with('|')).map(|l| l.matches('|').count()).collect();
        assert_eq!(widths.len(), 1, "{table}");
    }

    #[test]
    fn the_median_of_an_even_number_is_the_mean_of_two() {
        assert_eq!(median(vec![4.0, 1.0, 3.0, 2.0]), Some(2.5));
        assert_eq!(median(vec![5.0, 1.0, 3.0]), Some(3.0));
        assert_eq!(median(vec![]), None);
    }
}
