//! Any bytes as a scene: an answer or an error, never a panic; what is read has finite values and gradients.
#![no_main]

#[path = "common/field.rs"]
mod field;

use libfuzzer_sys::fuzz_target;
use shrinkd::field::scene::Scene;

fuzz_target!(|bytes: &[u8]| {
    if let Ok(scene) = Scene::from_slice(bytes) {
        field::keeps_its_promises(&scene);
        scene.fit_domain();
    }
});
