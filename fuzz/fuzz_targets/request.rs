//! Any bytes as a request for a job: a request or faults that are told, never a panic; and what was read is read again as it was stored.
#![no_main]

use libfuzzer_sys::fuzz_target;
use shrinkd::job::JobSpec;

fuzz_target!(|bytes: &[u8]| {
    let Ok(value) = serde_json::from_slice(bytes) else { return };
    match JobSpec::from_value(&value) {
        Ok(spec) => {
            let stored = serde_json::to_value(&spec).expect("is JSON");
            assert_eq!(JobSpec::from_stored(stored).expect("is read again"), spec);
        }
        Err(faults) => assert!(!faults.is_empty() && faults.len() <= 32),
    }
});
