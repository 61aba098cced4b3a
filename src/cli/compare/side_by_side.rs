//! Marching cubes, the paper's method and the result beside each other: pictures with their figures, and a table.

use super::one::Pictures;
use super::row::{Row, in_a_cell};
use super::sheet;
use crate::measure::Report;
use crate::measure::report::Closeness;
use crate::surface::sheet::{Mark, Tile};
use std::fmt::Write as _;

/// Tiles of a row.
pub const COLUMNS: usize = 3;

/// The tiles of a row: marching cubes, the paper's method, the result.
pub fn tiles(row: &Row, pictures: Pictures) -> [Tile; COLUMNS] {
    let beside = |name: &str, figures: Option<String>, pixels: Vec<u8>, mark: Mark| Tile {
        caption: [format!("{} {name}", row.shape), figures.unwrap_or_else(|| "nothing".to_owned())],
        mark,
        pixels,
    };
    let cubes = row.baseline.as_ref().map(|b| format!("{} vertices, no UVs, {}", b.vertices, close(&b.closeness)));
    let paper = row.paper.as_ref().map(|report| format!("{}, {}", faults(report), close(&report.closeness)));
    let sound = row.paper.as_ref().is_some_and(|report| report.verdict.passed);
    [
        beside("marching cubes", cubes, pictures.cubes, Mark::Aside),
        beside("paper", paper, pictures.paper, if sound { Mark::Good } else { Mark::Bad }),
        sheet::tile(row, pictures.own),
    ]
}

fn faults(report: &Report) -> String {
    let flips = report.flips.surface + report.flips.sphere + report.flips.uv;
    format!("{flips} flips {} crossings", report.self_intersections)
}

fn close(closeness: &Closeness) -> String {
    format!("max {:.2}% NC {:.4}", 100.0 * closeness.distance.max, closeness.normal_consistency)
}

/// The table of all rows.
pub fn to_markdown(rows: &[Row]) -> String {
    let mut text = String::from(
        "\n## Side by side\n\nLargest distance in % of the diagonal, both ways; flips of every kind; pairs of triangles that cross. Marching cubes has as many \
         vertices and no UVs.\n\n| shape | lattice | MC max | MC NC | paper flips | crossings | max | NC | ours flips | crossings | max | NC |\n\
         |---|---|---:|---:|---:|---:|---:|---:|---:|---:|---:|---:|\n",
    );
    let none = || "–".to_owned();
    for row in rows {
        let cubes = row.baseline.as_ref().map_or([none(), none()], |b| cells(&b.closeness));
        let of = |report: &Option<Report>| match report {
            None => [none(), none(), none(), none()],
            Some(report) => {
                let flips = report.flips.surface + report.flips.sphere + report.flips.uv;
                let [max, nc] = cells(&report.closeness);
                [flips.to_string(), report.self_intersections.to_string(), max, nc]
            }
        };
        let cells = [cubes.to_vec(), of(&row.paper).to_vec(), of(&row.report).to_vec()].concat().join(" | ");
        let _ = writeln!(text, "| {} | {} | {cells} |", in_a_cell(&row.shape), row.lattice_name());
    }
    text
}

fn cells(closeness: &Closeness) -> [String; 2] {
    [format!("{:.2}", 100.0 * closeness.distance.max), format!("{:.4}", closeness.normal_consistency)]
}
