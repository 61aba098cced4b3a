//! Any bytes as safetensors, shrinkd's own and those without an architecture: an answer or an error, never a panic, in
//! bounded time and memory; what is read can be written and evaluated.
#![no_main]

#[path = "common/network.rs"]
mod network;

use libfuzzer_sys::fuzz_target;
use shrinkd::field::network::family::{self, Hints};
use shrinkd::field::network::safetensors;

fuzz_target!(|bytes: &[u8]| {
    let read = match safetensors::tensors(bytes) {
        Ok(Some(tensors)) => family::read(&tensors, None, None, &Hints::default()).ok().map(|(network, _)| network),
        Ok(None) => safetensors::read(bytes).ok(),
        Err(_) => None,
    };
    if let Some(read) = read {
        let again = safetensors::read(&safetensors::write(&read)).expect("what was written");
        assert_eq!((again.weights(), again.layers.len()), (read.weights(), read.layers.len()));
        network::can_be_evaluated(&read);
    }
});
