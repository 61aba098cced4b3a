//! Networks from any of their files, with what the options say of them.

use super::options::fault;
use super::{FieldOptions, Format};
use crate::field::network::family::{self, Detected, Family, Hints};
use crate::field::network::{Activation, Network, folder, niq, onnx, safetensors, torch};
use crate::field::{Fault, FieldError};

/// Reads a network, puts what the options say in the place of what was read or assumed, and says what it was taken for.
/// An option for which the network has no place is a fault.
pub(super) fn read(
    bytes: &[u8],
    format: Format,
    options: &FieldOptions,
    faults: &mut Vec<Fault>,
) -> Result<(Network, Detected), FieldError> {
    let (mut network, mut detected) = from_file(bytes, format, options)?;
    overridden(&mut network, options, faults);
    for (name, is_said) in [
        ("activation", options.activation.is_some()),
        // an activation that is said comes with its frequency
        ("w0", options.w0.is_some() || options.activation.is_some()),
        ("skip", options.skip.is_some()),
        ("domain", options.domain.is_some()),
    ] {
        if is_said {
            detected.no_longer_assumes(name);
        }
    }
    Ok((network, detected))
}

/// The network as its file and its family have it.
fn from_file(bytes: &[u8], format: Format, options: &FieldOptions) -> Result<(Network, Detected), FieldError> {
    let hints = Hints { family: options.family, encoding: options.encoding };
    let itself = |family, because: &str| Detected { family, because: because.to_owned(), assumed: Vec::new() };
    let told = |network: Network, family, because: &str| match not_offered(&hints) {
        None => Ok((network, itself(family, because))),
        Some(fault) => Err(FieldError::Invalid { faults: vec![fault] }),
    };
    match format {
        Format::Npz => told(niq::read(bytes)?, Family::NeuralImplicitQueries, "its arrays are numbered operations"),
        Format::Onnx => told(onnx::read(bytes)?, Family::Onnx, "the graph says everything"),
        Format::Torch => family::read(&torch::read(bytes)?, None, None, &hints),
        Format::Folder => folder::read(bytes, &hints),
        _ => match safetensors::tensors(bytes)? {
            None => told(safetensors::read(bytes)?, Family::Shrinkd, "there is an architecture in its metadata"),
            Some(tensors) => family::read(&tensors, None, None, &hints),
        },
    }
}

/// A file that says what it is takes no other word for it.
fn not_offered(hints: &Hints) -> Option<Fault> {
    let members = [("/family", hints.family.is_some()), ("/encoding", hints.encoding.is_some())];
    let (pointer, _) = members.into_iter().find(|member| member.1)?;
    Some(fault(pointer, "not_offered", format!("the file itself says its {}", &pointer[1..])))
}

/// Puts what the options say in the place of what was read or assumed.
fn overridden(network: &mut Network, options: &FieldOptions, faults: &mut Vec<Fault>) {
    let Some((_, hidden)) = network.layers.split_last_mut() else { return };
    if let Some(activation) = options.activation {
        hidden.iter_mut().for_each(|layer| layer.activation = activation);
    }
    if let Some(w0) = options.w0 {
        let mut sines = 0;
        for layer in &mut *hidden {
            if let Activation::Sine { w0: own } = &mut layer.activation {
                *own = if sines == 0 { w0.first() } else { w0.others() };
                sines += 1;
            }
        }
        if sines == 0 {
            faults.push(fault("/w0", "not_offered", "no layer of the network has a sine"));
        }
    }
    if let Some(skip) = options.skip {
        let mut joined = network.layers.iter_mut().filter_map(|layer| layer.skip.as_mut()).peekable();
        if joined.peek().is_none() {
            faults.push(fault("/skip", "not_offered", "no layer of the network has its input joined to it"));
        }
        joined.for_each(|own| *own = skip);
    }
}
