//! ONNX models of multilayer perceptrons, as exporters write them.
//!
//! The file is a protocol buffer (`wire` and `model` read the few messages that matter). Its graph is worked through
//! symbolically: a value is either a constant, which is computed, or a tensor of affine forms in the network's inputs and in
//! the outputs of activations (`value`, `forms`). Every activation closes a stage (`stages`); at the end the stages
//! become the layers of a [`Network`]. So it does not matter how an exporter spells a dense layer, a skip, a sharpness or a
//! weight norm, as long as the spelling is affine.
//!
//! The model has one input of three or more columns, `[latent code, x, y, z]`, or two inputs of which the one of three columns
//! is the point, and one output that is a number for every point. Axes before the columns count points and may have any
//! length. Refused by name: operators that are no part of such a network, a connection past a layer other than one from the
//! input (residual connections), tensors outside the file, and functions of the model's own.
//!
//! Time and memory are in proportion to the file: what is computed from constants, and what forms are multiplied out, is
//! counted against a budget of so much for every byte.

mod arithmetic;
mod axes;
mod budget;
mod forms;
mod graph;
mod model;
mod operators;
mod shapes;
mod stages;
mod structure;
mod tensor;
mod value;
mod wire;

use super::Network;
use crate::field::FieldError;

const FORMAT: &str = "ONNX";

/// Whether the bytes begin as the protocol buffer of an ONNX model: a small version of the format, then a field of a model.
pub(in crate::field) fn claims(bytes: &[u8]) -> bool {
    const FIELDS_OF_A_MODEL: [u8; 7] = [0x12, 0x1a, 0x22, 0x28, 0x32, 0x3a, 0x42];
    matches!(bytes, [0x08, 1..=32, tag, ..] if FIELDS_OF_A_MODEL.contains(tag))
}

/// Reads a network. There is no latent code in the file, and nothing about the domain: it is the default one.
///
/// # Errors
/// [`FieldError::Malformed`] with the byte or the node at fault, [`FieldError::Unsupported`] with the name of an operator or of
/// what else is not read, and [`FieldError::Limit`].
pub fn read(bytes: &[u8]) -> Result<Network, FieldError> {
    let model = model::Model::parse(bytes)?;
    let network = graph::network(&model, bytes.len())?;
    network.check(FORMAT)?;
    Ok(network)
}

/// A broken file. Messages quote names with [`quoted`].
fn fault(at: Option<u64>, detail: String) -> FieldError {
    FieldError::Malformed { format: FORMAT, at, detail }
}

/// A name from the file for a message: escaped, and cut where it is too long to be read.
fn quoted(name: &str) -> String {
    const LONGEST: usize = 80;
    match name.char_indices().nth(LONGEST) {
        Some((end, _)) => format!("{:?}…", &name[..end]),
        None => format!("{name:?}"),
    }
}

#[cfg(test)]
mod tests;
