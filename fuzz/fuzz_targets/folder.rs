//! Folders of DeepSDF, as archives and as lists of their files: an answer or an error, never a panic.
#![no_main]

#[path = "common/archive.rs"]
mod archive;
#[path = "common/network.rs"]
mod network;

use libfuzzer_sys::fuzz_target;
use shrinkd::field::network::family::Hints;
use shrinkd::field::network::folder;

fuzz_target!(|data: &[u8]| {
    if let Ok((read, _)) = folder::read(&archive::archive(data), &Hints::default()) {
        network::can_be_evaluated(&read);
    }
});
