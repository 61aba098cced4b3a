//! The npz files of neural-implicit-queries (N. Sharp and A. Jacobson, Spelunking the Deep, 2022).
//!
//! An archive of arrays named `NNNN.operation.parameter`, operations applied in the order of NNNN: `dense` with `A` of
//! shape `[inputs, outputs]` and `b` of shape `[outputs]`, activations (`relu`, `elu`, `tanh`, `sigmoid`, `sin`) and at last
//! `squeeze_last` with a parameter `_` that means nothing. The shape lies in the cube of half extent 1.

use super::{Activation, Layer, MAX_LAYERS, MAX_PARAMETERS, Network, zip};
use crate::field::FieldError;
use crate::field::grid::npy;
use std::collections::BTreeMap;

const FORMAT: &str = "npz";

fn fault(detail: String) -> FieldError {
    FieldError::Malformed { format: FORMAT, at: None, detail }
}

/// The entries of one operation.
struct Operation<'a> {
    name: &'a str,
    parameters: BTreeMap<&'a str, &'a zip::Entry>,
}

/// Whether an archive has entries named as those of this family.
pub(in crate::field) fn claims(entries: &[zip::Entry]) -> bool {
    entries.iter().any(|e| split(&e.name).is_some_and(|(_, operation, _)| operation == "dense"))
}

/// `0002.dense.A.npy` as (2, "dense", "A").
fn split(name: &str) -> Option<(u32, &str, &str)> {
    let mut parts = name.strip_suffix(".npy")?.splitn(3, '.');
    let (index, operation, parameter) = (parts.next()?, parts.next()?, parts.next()?);
    let digits = index.len() == 4 && index.bytes().all(|b| b.is_ascii_digit());
    digits.then(|| index.parse().ok()).flatten().map(|index| (index, operation, parameter))
}

/// Reads a network.
///
/// # Errors
/// [`FieldError::Malformed`] that names the entry, [`FieldError::Unsupported`] for an operation that is not known, and
/// [`FieldError::Limit`].
pub fn read(bytes: &[u8]) -> Result<Network, FieldError> {
    let entries = zip::entries(bytes)?;
    let mut operations: BTreeMap<u32, Operation<'_>> = BTreeMap::new();
    for entry in &entries {
        let Some((index, name, parameter)) = split(&entry.name) else {
            return Err(fault(format!("entry {:?} is not named as an operation's parameter", entry.name)));
        };
        let operation = operations.entry(index).or_insert_with(|| Operation { name, parameters: BTreeMap::new() });
        if operation.name != name {
            return Err(fault(format!("operation {index} is both {} and {name}", operation.name)));
        }
        if operation.parameters.insert(parameter, entry).is_some() {
            return Err(fault(format!("entry {:?} is there twice", entry.name)));
        }
    }
    let mut layers: Vec<Layer> = Vec::new();
    let mut parameters_left = MAX_PARAMETERS;
    let mut activated = true;
    for (index, operation) in &operations {
        let activation = match operation.name {
            "dense" => {
                if layers.len() == MAX_LAYERS {
                    let (found, limit) = (MAX_LAYERS as u64 + 1, MAX_LAYERS as u64);
                    return Err(FieldError::Limit { what: "layers of a network", found, limit });
                }
                let layer = dense(bytes, *index, operation, &mut parameters_left)?;
                layers.push(layer);
                activated = false;
                continue;
            }
            "squeeze_last" => continue,
            "relu" => Activation::Relu,
            "elu" => Activation::Elu,
            "tanh" => Activation::Tanh,
            "sigmoid" => Activation::Sigmoid,
            "sin" => Activation::Sine { w0: 1.0 },
            other => {
                return Err(FieldError::Unsupported {
                    detail: format!("the operation {other} of the npz at {index:04}"),
                });
            }
        };
        match layers.last_mut() {
            Some(layer) if !activated => layer.activation = activation,
            _ => return Err(fault(format!("the activation at {index:04} does not follow a dense layer"))),
        }
        activated = true;
    }
    let network = Network::of_layers(layers);
    network.check(FORMAT)?;
    Ok(network)
}

fn dense(bytes: &[u8], index: u32, operation: &Operation<'_>, left: &mut usize) -> Result<Layer, FieldError> {
    let mut array = |parameter: &str, axes: usize| -> Result<(Vec<usize>, Vec<f64>, bool), FieldError> {
        let entry = operation
            .parameters
            .get(parameter)
            .ok_or_else(|| fault(format!("entry \"{index:04}.dense.{parameter}.npy\" is missing")))?;
        let named = |error: FieldError| match error {
            FieldError::Malformed { at, detail, .. } => {
                FieldError::Malformed { format: FORMAT, at, detail: format!("entry {:?}: {detail}", entry.name) }
            }
            other => other,
        };
        // a number takes four bytes or more, so the entry's size bounds what is unpacked
        if entry.size / 4 > *left + 4096 {
            let (found, limit) = ((entry.size / 4) as u64, MAX_PARAMETERS as u64);
            return Err(FieldError::Limit { what: "parameters of a network", found, limit });
        }
        let unpacked = entry.unpack(bytes)?;
        let header = npy::header(&unpacked, *left).map_err(named)?;
        if header.shape.len() != axes {
            return Err(fault(format!("entry {:?} has {} axes instead of {axes}", entry.name, header.shape.len())));
        }
        *left -= header.count();
        let numbers: Vec<f64> = (0..header.count()).map(|i| header.number(&unpacked, i)).collect();
        if let Some(at) = numbers.iter().position(|v| !v.is_finite()) {
            return Err(fault(format!("number {at} of entry {:?} is not finite", entry.name)));
        }
        Ok((header.shape, numbers, header.fortran))
    };
    let (shape, matrix, fortran) = array("A", 2)?;
    let (bias_shape, bias, _) = array("b", 1)?;
    let (inputs, outputs) = (shape[0], shape[1]);
    if bias_shape[0] != outputs || outputs == 0 || inputs == 0 {
        let found = bias_shape[0];
        return Err(fault(format!("operation {index:04}: A has the shape [{inputs}, {outputs}] and b has {found}")));
    }
    let mut weights = Vec::with_capacity(matrix.len());
    for output in 0..outputs {
        for input in 0..inputs {
            let at = if fortran { output * inputs + input } else { input * outputs + output };
            weights.push(matrix[at] as f32);
        }
    }
    let bias = bias.into_iter().map(|b| b as f32).collect();
    Ok(Layer { weights, bias, norm: None, activation: Activation::Identity, skip: None })
}
