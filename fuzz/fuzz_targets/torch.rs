#![no_main]
//! PyTorch checkpoints, both containers: `src/field/network/torch.rs`.
//!
//! Bytes that begin as neither container are taken for the pickle of the object in a stream, so that mutations reach the
//! pickle machine without keeping a magic number or the checksums of an archive whole.

use libfuzzer_sys::fuzz_target;
use shrinkd::field::network::torch;

/// A stream before the object's pickle: the magic number, the version and an empty description of the machine.
const HEAD: &[u8] = b"\x80\x02\x8a\x0al\xfc\x9cF\xf9 j\xa8P\x19.\x80\x02M\xe9\x03.\x80\x02}.";

fuzz_target!(|data: &[u8]| {
    let is_whole = data.starts_with(b"PK\x03\x04") || data.get(2..14) == HEAD.get(2..14);
    let read = if is_whole { torch::read(data) } else { torch::read(&[HEAD, data].concat()) };
    for (name, tensor) in read.into_iter().flatten() {
        assert_eq!(tensor.values.len(), tensor.shape.iter().product::<usize>(), "{name}");
    }
});
