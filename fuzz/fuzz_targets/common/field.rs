//! What every field promises of its values.

use shrinkd::field::{Field, Gradients, Points};

/// Places in the default cube, one of them a corner and one the middle.
const PLACES: [[f32; 4]; 3] = [[0.0, 0.3, -0.7, 1.0], [0.0, -0.2, 0.9, 1.0], [0.0, 0.5, 0.1, 1.0]];

/// Values and gradients are finite in the default cube.
pub fn keeps_its_promises(field: &dyn Field) {
    let [x, y, z] = &PLACES;
    let points = || Points { x, y, z };
    let (mut values, mut alone, mut gradients) = ([0.0; 4], [0.0; 4], [[0.0; 4]; 3]);
    let [gx, gy, gz] = &mut gradients;
    field.gradients(points(), &mut values, Gradients { x: gx, y: gy, z: gz });
    field.values(points(), &mut alone);
    let mut all = values.iter().chain(&alone).chain(gradients.iter().flatten());
    assert!(all.all(|v| v.is_finite()), "{values:?} {alone:?} {gradients:?}");
}
