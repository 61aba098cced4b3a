//! A curve as safetensors, for numeric use: one row per sample, in the order of the parameter.
//!
//! | tensor | shape | type |
//! |---|---|---|
//! | `positions` | [n, 2] | f32, scene units |
//! | `normals` | [n, 2] | f32, unit gradients; at a corner the mean of both sides' |
//! | `u` | [n] | f32: arc length from the first sample in parts of the whole |
//! | `curvature` | [n] | f32, 1 / scene units, positive where the solid is convex |
//! | `corner` | [n] | u8: 1 where the sample is a corner of the zero set |
//! | `gradient_norm`, `value` | [n] | f32 |
//!
//! The metadata has one entry, `shrinkd`: JSON with `format`, `version`, `dimension`, `vertices` and `length` (of the
//! polygon, scene units). The same curve gives the same bytes.

use crate::shrink::curve::Curve;
use crate::surface::tensors::{Tensor, file};
use safetensors::tensor::Dtype;
use serde_json::json;

/// Version of the layout above.
const FORMAT: u32 = 1;

fn step(curve: &Curve, i: usize) -> f64 {
    let n = curve.positions.len();
    let (a, b) = (curve.positions[i % n], curve.positions[(i + 1) % n]);
    (a[0] - b[0]).hypot(a[1] - b[1])
}

/// Curvature at every sample, in 1 / scene units: the turn of the normals over the way, from the sample before to the one
/// after, never across a corner. At a corner, where there is none, the mean of what it is on either side.
pub fn curvatures(curve: &Curve) -> Vec<f64> {
    let n = curve.positions.len();
    let normal = |i: usize| glam::DVec2::from(curve.normals[i % n]);
    let corner = |i: usize| curve.corners[i % n];
    // of the sample's own side: its steps back and ahead that end at no corner
    let smooth = |i: usize| {
        let (back, ahead) = (i + n - 1, i + 1);
        let (from, to) = (if corner(back) { i } else { back }, if corner(ahead) { i } else { ahead });
        let way = if from == back { step(curve, back) } else { 0.0 } + if to == ahead { step(curve, i) } else { 0.0 };
        if way > 0.0 { normal(from).angle_to(normal(to)) / way } else { 0.0 }
    };
    let mut curvatures: Vec<f64> = (0..n).map(|i| if corner(i) { 0.0 } else { smooth(i) }).collect();
    for i in (0..n).filter(|&i| corner(i)) {
        curvatures[i] = 0.5 * (curvatures[(i + n - 1) % n] + curvatures[(i + 1) % n]);
    }
    curvatures
}

/// The curve as a safetensors file.
pub fn to_safetensors(curve: &Curve) -> Vec<u8> {
    let n = curve.positions.len();
    let flat = |values: &[f64]| -> Vec<u8> { values.iter().flat_map(|&x| (x as f32).to_le_bytes()).collect() };
    let tensors: Vec<Tensor> = vec![
        ("positions", Dtype::F32, vec![n, 2], flat(curve.positions.as_flattened())),
        ("normals", Dtype::F32, vec![n, 2], flat(curve.normals.as_flattened())),
        ("u", Dtype::F32, vec![n], flat(&curve.parameters)),
        ("curvature", Dtype::F32, vec![n], flat(&curvatures(curve))),
        ("corner", Dtype::U8, vec![n], curve.corners.iter().map(|&c| u8::from(c)).collect()),
        ("gradient_norm", Dtype::F32, vec![n], flat(&curve.gradient_norms)),
        ("value", Dtype::F32, vec![n], flat(&curve.values)),
    ];
    let about = json!({
        "format": FORMAT,
        "version": env!("CARGO_PKG_VERSION"),
        "dimension": 2,
        "vertices": n,
        "length": (0..n).map(|i| step(curve, i)).sum::<f64>(),
    });
    file(&tensors, &about)
}

#[cfg(test)]
mod tests {
    use super::super::tests::diamond;
    use super::*;
    use safetensors::SafeTensors;
    use std::f64::consts::TAU;

    #[test]
    fn the_curvature_of_a_circle_is_one_over_its_radius() {
        let angle = |i: usize| TAU * i as f64 / 60.0;
        let mut circle = Curve {
            positions: (0..60).map(|i| [0.5 * angle(i).cos(), 0.5 * angle(i).sin()]).collect(),
            normals: (0..60).map(|i| [angle(i).cos(), angle(i).sin()]).collect(),
            parameters: (0..60).map(|i| i as f64 / 60.0).collect(),
            corners: vec![false; 60],
            values: vec![0.0; 60],
            gradient_norms: vec![1.0; 60],
            ..diamond()
        };
        // a chord is shorter than its arc by a part of (tau/60)^2 / 24
        assert!(curvatures(&circle).iter().all(|k| (k - 2.0).abs() < 2e-3));
        // a corner, whose normal is that of neither side, spoils nothing
        (circle.corners[7], circle.normals[7]) = (true, [0.0, 1.0]);
        assert!(curvatures(&circle).iter().all(|k| (k - 2.0).abs() < 2e-3), "{:?}", curvatures(&circle));
    }

    #[test]
    fn every_tensor_is_there_in_its_shape_and_the_bytes_do_not_change() {
        let bytes = to_safetensors(&diamond());
        assert_eq!(bytes, to_safetensors(&diamond()));
        let file = SafeTensors::deserialize(&bytes).unwrap();
        for (name, shape) in [
            ("positions", vec![4, 2]),
            ("normals", vec![4, 2]),
            ("u", vec![4]),
            ("curvature", vec![4]),
            ("corner", vec![4]),
            ("gradient_norm", vec![4]),
            ("value", vec![4]),
        ] {
            assert_eq!(file.tensor(name).unwrap().shape(), shape, "{name}");
        }
    }
}
