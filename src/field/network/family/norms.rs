//! The layer norms of DeepSDF, which it has between a layer and its ReLU where weight norm is off: `bn{l}.weight` and `bn{l}.bias`.

use super::stack::Dense;
use super::{NetworkSpecs, fault};
use crate::field::FieldError;
use crate::field::network::tensors::Tensors;
use crate::field::network::{LayerNorm, layer_norm};
use std::collections::HashSet;

/// Gives the layers their norms, which have the layers' prefix in front.
///
/// # Errors
/// [`FieldError::Malformed`] with the name of a norm that belongs to no layer, does not fit it or lacks a tensor, and
/// [`FieldError::Unsupported`] with that of a tensor that no layer norm has.
pub fn give(tensors: &Tensors, prefix: &str, layers: &mut [Dense]) -> Result<(), FieldError> {
    let front = if prefix.is_empty() { String::new() } else { format!("{prefix}.") };
    let mut known = HashSet::new();
    for (l, layer) in layers.iter_mut().enumerate() {
        let mut part = |kind: &str| -> Result<Option<Vec<f32>>, FieldError> {
            let name = format!("{front}bn{l}.{kind}");
            let Some(tensor) = tensors.get(&name) else { return Ok(None) };
            if tensor.shape != [layer.outputs] {
                let (found, of, outputs) = (&tensor.shape, &layer.name, layer.outputs);
                return Err(fault(format!("{name:?} has the shape {found:?}, and {of:?} has {outputs} outputs")));
            }
            known.insert(name);
            Ok(Some(tensor.values.clone()))
        };
        let missing = |kind: &str| Err(fault(format!("the layer norm {:?} has no {kind}", format!("{front}bn{l}"))));
        layer.norm = match (part("weight")?, part("bias")?) {
            (None, None) => None,
            (Some(scale), Some(shift)) => Some(LayerNorm { scale, shift, epsilon: layer_norm::EPSILON }),
            (None, _) => return missing("weight"),
            (_, None) => return missing("bias"),
        };
    }
    let is_norm = |own: &str| own.strip_prefix("bn").is_some_and(|l| l.starts_with(|c: char| c.is_ascii_digit()));
    let mut others = tensors.keys().filter(|name| name.strip_prefix(&front).is_some_and(is_norm));
    match others.find(|name| !known.contains(*name)) {
        None => Ok(()),
        Some(name) if name.ends_with(".weight") || name.ends_with(".bias") => {
            Err(fault(format!("{name:?} belongs to no layer")))
        }
        Some(name) => Err(FieldError::Unsupported { detail: format!("a norm that is no layer norm ({name:?})") }),
    }
}

/// Checks that the layers have the norms that a `specs.json` says they have.
///
/// # Errors
/// [`FieldError::Malformed`] with the norm.
pub fn check(specs: &NetworkSpecs, layers: &[Dense], weight_norm: bool) -> Result<(), FieldError> {
    for (l, layer) in layers.iter().enumerate() {
        let listed = specs.norm_layers.as_ref().map(|list| list.contains(&l));
        match (layer.norm.is_some(), specs.weight_norm, listed) {
            (true, Some(true), _) => {
                return Err(fault(format!("specs.json has weight_norm, and there is a layer norm \"bn{l}\"")));
            }
            (true, _, Some(false)) => {
                return Err(fault(format!(
                    "there is a layer norm \"bn{l}\", and no {l} among norm_layers in specs.json"
                )));
            }
            (false, Some(false), Some(true)) if !weight_norm => {
                return Err(fault(format!(
                    "specs.json has {l} among norm_layers, and there is no layer norm \"bn{l}\""
                )));
            }
            _ => {}
        }
    }
    Ok(())
}
