//! Any bytes as an ONNX model: an answer or an error, never a panic, in bounded time and memory.
#![no_main]

use libfuzzer_sys::fuzz_target;
use shrinkd::field::network::onnx;

fuzz_target!(|bytes: &[u8]| {
    if let Ok(network) = onnx::read(bytes) {
        assert!(network.field(&vec![0.0; network.latent_size]).is_some());
    }
});
