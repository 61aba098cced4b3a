//! Any bytes as a sampled grid and as a list of latent codes: an answer or an error, never a panic.
#![no_main]

#[path = "common/field.rs"]
mod field;

use libfuzzer_sys::fuzz_target;
use shrinkd::field::Domain;
use shrinkd::field::grid::{Grid, npy};

/// Numbers of a list of codes.
const MAX_NUMBERS: usize = 4096;

fuzz_target!(|bytes: &[u8]| {
    if let Ok(grid) = Grid::read(bytes, Domain::default()) {
        field::keeps_its_promises(&grid);
    }
    if let Some(Ok(rows)) = npy::rows(bytes, MAX_NUMBERS) {
        let columns = rows.first().map_or(0, Vec::len);
        assert!(rows.iter().all(|row| row.len() == columns) && rows.len() * columns <= MAX_NUMBERS);
    }
});
