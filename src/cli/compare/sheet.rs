//! The pictures of the contact sheet, and what stands under them.

use super::row::{Outcome, Row};
use crate::field::mesh::ChartedMesh;
use crate::job::pipeline::Made;
use crate::job::spec::OutputName;
use crate::settings::{Canceled, Settings};
use crate::shrink::lattice::LatticeSpec;
use crate::surface::checkerboard::Tiles;
use crate::surface::sheet::{self, Mark, Tile};

/// The picture of what was made, from its GLB as it is written; empty when there is none.
pub fn picture(made: &Made, lattice: LatticeSpec, settings: &Settings<'_>) -> Result<Vec<u8>, Canceled> {
    let glb = made.files.iter().find(|(output, _)| *output == OutputName::Glb);
    match glb.and_then(|(_, bytes)| ChartedMesh::read(bytes).ok().flatten()) {
        Some(mesh) => sheet::picture(&mesh, Tiles::of(lattice), settings),
        None => Ok(Vec::new()),
    }
}

/// The tile of a row.
pub fn tile(row: &Row, pixels: Vec<u8>) -> Tile {
    let mark = match &row.outcome {
        Outcome::Passed => Mark::Good,
        Outcome::Refused { expected: true, .. } => Mark::Aside,
        Outcome::Failed { .. } | Outcome::Refused { .. } => Mark::Bad,
    };
    let figures = row.report.as_ref().map(|report| {
        format!(
            "max {:.2}% mean {:.2}e-4 NC {:.4} area {:.2}-{:.2}",
            100.0 * report.closeness.distance.max,
            1e4 * report.closeness.distance.mean,
            report.closeness.normal_consistency,
            report.distortion.sphere.area_p1,
            report.distortion.sphere.area_p99
        )
    });
    let told = match &row.outcome {
        Outcome::Passed => figures.unwrap_or_default(),
        // the figures are in the table; here the reason counts
        Outcome::Failed { code, faults } => format!("{code}: {}", faults.join("; ")),
        Outcome::Refused { detail, .. } => format!("refused: {detail}"),
    };
    Tile { caption: [row.shape.clone(), told], mark, pixels }
}
