//! An evaluation as text: a Markdown table with a column per mesh, its cells padded so that it can be read as it stands.

use crate::measure::chamfer::Chamfer;
use crate::measure::evaluation::{Evaluation, Figures};
use crate::measure::report::Distortion;
use std::fmt::Write as _;
use std::path::Path;

/// Stands where there is no figure.
const NONE: &str = "–";

/// The whole text.
pub fn to_text(found: &Evaluation, mesh: &Path, truth: &Path, kind: &str) -> String {
    let name = |path: &Path| path.file_name().unwrap_or(path.as_os_str()).to_string_lossy().into_owned();
    let mut text = format!(
        "{} against {} ({kind}).\nDistances and the field's own absolute values in parts of the diagonal of the truth's \
         bounding box ({:.6} scene units).\n",
        name(mesh),
        name(truth),
        found.diagonal
    );
    if found.surface.chamfer.is_some() {
        let _ = writeln!(
            text,
            "CD, F1, ECD and EF1: 100,000 samples of each side, longest side of the truth at 0.9 (NDC: scene units x {:.6}); \
             the truth against itself is their floor.",
            found.ndc_scale
        );
    }
    text.push('\n');
    text.push_str(&laid_out(&figures(found)));
    if let Some(chart) = &found.parameterization {
        text.push_str("\nParameterization (areas matched globally; weighted by area on the surface):\n\n");
        let mut rows = vec![["".to_owned(), "sphere to surface".to_owned(), "chart to surface".to_owned()].to_vec()];
        let sphere_flips = chart.sphere_flips.map_or(NONE.to_owned(), |n| n.to_string());
        rows.push(vec!["flips".to_owned(), sphere_flips, chart.uv_flips.to_string()]);
        for (label, figure, digits) in DISTORTIONS {
            let cell = |d: &Distortion| format!("{:.digits$}", figure(d));
            rows.push(vec![label.to_owned(), chart.sphere.as_ref().map_or(NONE.to_owned(), cell), cell(&chart.uv)]);
        }
        text.push_str(&laid_out(&rows));
        let _ = writeln!(text, "\ncharts: {}", chart.charts);
    }
    let (distance, [there, back]) = (&found.surface.closeness.distance, found.surface.worst_places);
    let place = |[x, y, z]: [f64; 3]| format!("({x:.5}, {y:.5}, {z:.5})");
    let _ = writeln!(
        text,
        "\nfarthest from the truth: {:.3} % of the diagonal, at {}\nfarthest from the surface: {:.3} %, at {} on the truth",
        100.0 * distance.surface_to_truth.max,
        place(there),
        100.0 * distance.truth_to_surface.max,
        place(back)
    );
    match found.succeeds() {
        Ok(()) => text.push_str("succeeds: every condition holds\n"),
        Err(faults) => {
            let _ = writeln!(text, "does not succeed: {}", faults.join("; "));
        }
    }
    text
}

/// Figures of a parameterization, with the digits that are shown.
type Shown = (&'static str, fn(&Distortion) -> f64, usize);
const DISTORTIONS: [Shown; 8] = [
    ("QC (ideal 1)", |d| d.qc, 3),
    ("log-area RMS (0)", |d| d.log_area_rms, 3),
    ("area ratio min", |d| d.area_min, 4),
    ("area ratio p1", |d| d.area_p1, 3),
    ("area ratio p99", |d| d.area_p99, 3),
    ("area ratio max", |d| d.area_max, 3),
    ("symmetric Dirichlet (4)", |d| d.symmetric_dirichlet, 3),
    ("L2 stretch (1)", |d| d.l2_stretch, 3),
];

/// One row per figure, one column per mesh.
fn figures(found: &Evaluation) -> Vec<Vec<String>> {
    let mut columns: Vec<(String, &Figures)> = vec![("surface".to_owned(), &found.surface)];
    for cubes in &found.marching_cubes {
        columns.push((cubes.side.map_or("MC".to_owned(), |side| format!("MC {side}^3")), cubes));
    }
    columns.extend(found.truth.as_ref().map(|truth| ("truth itself".to_owned(), truth)));
    let mut rows: Vec<Vec<String>> = Vec::new();
    rows.push(std::iter::once(String::new()).chain(columns.iter().map(|c| c.0.clone())).collect());
    let mut row = |label: &str, cell: &dyn Fn(&Figures) -> String| {
        rows.push(std::iter::once(label.to_owned()).chain(columns.iter().map(|c| cell(c.1))).collect());
    };
    row("vertices", &|f| f.vertices.to_string());
    row("triangles", &|f| f.triangles.to_string());
    row("field values", &|f| f.field_values.map_or(NONE.to_owned(), |n| n.to_string()));
    row("closed", &|f| if f.closed { "yes" } else { "no" }.to_owned());
    row("Euler number", &|f| f.euler.to_string());
    row("components", &|f| f.components.to_string());
    row("flips on the surface", &|f| f.flips.to_string());
    row("triangles without area", &|f| f.degenerate.to_string());
    row("self-intersections", &|f| f.self_intersections.to_string());
    row("to truth: mean", &|f| small(f.closeness.distance.surface_to_truth.mean));
    row("to truth: RMS", &|f| small(f.closeness.distance.surface_to_truth.rms));
    row("to truth: max", &|f| small(f.closeness.distance.surface_to_truth.max));
    row("from truth: mean", &|f| small(f.closeness.distance.truth_to_surface.mean));
    row("from truth: RMS", &|f| small(f.closeness.distance.truth_to_surface.rms));
    row("from truth: max", &|f| small(f.closeness.distance.truth_to_surface.max));
    row("both: mean", &|f| small(f.closeness.distance.mean));
    row("both: max", &|f| small(f.closeness.distance.max));
    row("field: mean", &|f| small(f.values.mean));
    row("field: RMS", &|f| small(f.values.rms));
    row("field: max", &|f| small(f.values.max));
    row("NC", &|f| format!("{:.4}", f.closeness.normal_consistency));
    row("NC, signed", &|f| format!("{:.4}", f.closeness.normal_consistency_signed));
    let sampled = |figure: fn(&Chamfer) -> Option<f64>, factor: f64, digits: usize| {
        move |f: &Figures| {
            f.chamfer.as_ref().and_then(figure).map_or(NONE.to_owned(), |v| format!("{:.digits$}", factor * v))
        }
    };
    if found.surface.chamfer.is_some() {
        row("CD1", &sampled(|c| Some(c.cd1), 1.0, 5));
        row("CD2 x 1e5", &sampled(|c| Some(c.cd2), 1e5, 3));
        row("F1 at .003", &sampled(|c| Some(c.f1[1]), 1.0, 4));
        row("F1 at .001", &sampled(|c| Some(c.f1[0]), 1.0, 4));
        row("NC of samples", &sampled(|c| Some(c.normal_consistency), 1.0, 4));
        row("edge samples", &|f| f.chamfer.map_or(NONE.to_owned(), |c| c.edge_samples[0].to_string()));
        row("ECD2 x 100", &sampled(|c| c.edge_cd2, 100.0, 4));
        row("EF1 at .005", &sampled(|c| c.edge_f1, 1.0, 4));
    }
    rows
}

fn small(value: f64) -> String {
    if value == 0.0 { "0".to_owned() } else { format!("{value:.3e}") }
}

/// A Markdown table, the first row its head, the first column to the left.
fn laid_out(rows: &[Vec<String>]) -> String {
    let columns = rows.iter().map(Vec::len).max().unwrap_or(0);
    let width = |k: usize| rows.iter().filter_map(|row| row.get(k)).map(|cell| cell.chars().count()).max().unwrap_or(0);
    let widths: Vec<usize> = (0..columns).map(|k| width(k).max(2)).collect();
    let mut text = String::new();
    for (i, row) in rows.iter().enumerate() {
        for (k, (cell, &width)) in row.iter().zip(&widths).enumerate() {
            let _ = if k == 0 { write!(text, "| {cell:<width$} ") } else { write!(text, "| {cell:>width$} ") };
        }
        text.push_str("|\n");
        if i == 0 {
            for (k, &width) in widths.iter().enumerate() {
                let line = "-".repeat(width);
                let _ = if k == 0 { write!(text, "|-{line}-") } else { write!(text, "|-{line}:") };
            }
            text.push_str("|\n");
        }
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_table_has_lines_of_one_length() {
        let cells = |row: [&str; 3]| row.map(str::to_owned).to_vec();
        let text = laid_out(&[cells(["", "a", "long head"]), cells(["label", "–", "1"]), cells(["x", "12.5", "2"])]);
        let lengths: Vec<usize> = text.lines().map(|l| l.chars().count()).collect();
        assert_eq!(lengths.len(), 4);
        assert!(lengths.iter().all(|&n| n == lengths[0]), "{text}");
    }
}
