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
