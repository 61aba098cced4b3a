//! Named tensors, as the weight files of training frameworks hold them before anyone knows what network they are.

use std::collections::BTreeMap;

/// A tensor in row-major order, whatever its strides and its type were in the file.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Tensor {
    /// Length of every axis; empty for a single number.
    pub shape: Vec<usize>,
    /// The numbers, as many as the product of the shape.
    pub values: Vec<f32>,
}

/// Tensors by name. Dictionaries in dictionaries become names joined by dots; a tensor that is a file of its own has the
/// empty name.
pub type Tensors = BTreeMap<String, Tensor>;

/// The value of a half-precision number (IEEE 754 binary16), which every `f32` can hold.
pub(super) fn half(bits: u16) -> f32 {
    let sign = u32::from(bits & 0x8000) << 16;
    let (exponent, fraction) = (u32::from(bits >> 10) & 0x1f, u32::from(bits) & 0x3ff);
    match exponent {
        // without a leading one: the fraction counts steps of 2^-24
        0 => f32::from_bits(sign | (fraction as f32 / 16_777_216.0).to_bits()),
        0x1f => f32::from_bits(sign | 0x7f80_0000 | fraction << 13),
        _ => f32::from_bits(sign | (exponent + 127 - 15) << 23 | fraction << 13),
    }
}

/// The value of a number in the upper half of single precision (bfloat16).
pub(super) fn bfloat(bits: u16) -> f32 {
    f32::from_bits(u32::from(bits) << 16)
}
