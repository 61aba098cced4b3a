//! Networks of neural-implicit-queries, as archives and as lists of their entries: an answer or an error, never a panic.
#![no_main]

#[path = "common/archive.rs"]
mod archive;
#[path = "common/network.rs"]
mod network;

use libfuzzer_sys::fuzz_target;
use shrinkd::field::network::niq;

fuzz_target!(|data: &[u8]| {
    if let Ok(read) = niq::read(&archive::archive(data)) {
        network::can_be_evaluated(&read);
    }
});
