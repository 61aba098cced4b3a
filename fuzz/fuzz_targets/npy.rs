//! Any bytes as a sampled grid: an answer or an error, never a panic.
#![no_main]

#[path = "common/field.rs"]
mod field;

use libfuzzer_sys::fuzz_target;
use shrinkd::field::Domain;
use shrinkd::field::grid::Grid;

fuzz_target!(|bytes: &[u8]| {
    if let Ok(grid) = Grid::read(bytes, Domain::default()) {
        field::keeps_its_promises(&grid);
    }
});
