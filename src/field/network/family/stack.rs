//! The dense layers of one network among the tensors of a file.

use super::{fault, norms};
use crate::field::FieldError;
use crate::field::network::tensors::{Tensor, Tensors};
use crate::field::network::{LayerNorm, MAX_LAYERS, MAX_PARAMETERS};
use std::collections::BTreeMap;

/// How layers are named.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Scheme {
    /// `lin0`, `lin1`, …
    Lin,
    /// `net.0.0`, `net.1.0`, …
    Net,
    /// `layers.0`, `layers.1`, …, `last_layer`.
    Layers,
}

/// One dense layer, its weight norm multiplied out.
pub struct Dense {
    pub name: String,
    pub outputs: usize,
    pub inputs: usize,
    pub weights: Vec<f32>,
    pub bias: Vec<f32>,
    pub norm: Option<LayerNorm>,
}

/// The layers that were found.
pub struct Stack {
    pub scheme: Scheme,
    /// What the names have in front.
    pub prefix: String,
    /// The name of the first layer, as an example.
    pub shown: String,
    pub layers: Vec<Dense>,
    /// Whether some weights are a direction and a length, and whether in the newer spelling of it.
    pub normed: bool,
    pub parametrized: bool,
}

/// The tensors of one layer.
#[derive(Default)]
struct Parts<'a> {
    weight: Option<&'a Tensor>,
    length: Option<&'a Tensor>,
    direction: Option<&'a Tensor>,
    bias: Option<&'a Tensor>,
    parametrized: bool,
    name: &'a str,
}

/// Endings of the names of a layer's tensors.
const ENDINGS: [&str; 6] = [
    ".weight",
    ".bias",
    ".weight_g",
    ".weight_v",
    ".parametrizations.weight.original0",
    ".parametrizations.weight.original1",
];
/// Networks for other things than the shape, by what their names contain.
const OTHERS: [&str; 7] = ["render", "color", "radiance", "nerf_outside", "homogen", "background", "bg_"];
/// Names shown of a file that is not understood.
const SHOWN: usize = 12;

/// A layer's name as its scheme, what is in front and its number; the last layer of [`Scheme::Layers`] has the largest.
fn split(name: &str) -> Option<(Scheme, &str, usize)> {
    let (front, last) = name.rsplit_once('.').unwrap_or(("", name));
    if let Some(number) = last.strip_prefix("lin").and_then(|n| n.parse().ok()) {
        return Some((Scheme::Lin, front, number));
    }
    if last == "last_layer" {
        return Some((Scheme::Layers, front, usize::MAX));
    }
    let (before, group) = front.rsplit_once('.').unwrap_or(("", front));
    if group == "layers" {
        return Some((Scheme::Layers, before, last.parse().ok()?));
    }
    if last == "0" {
        let number = group.parse().ok()?;
        let (before, net) = before.rsplit_once('.').unwrap_or(("", before));
        return (net == "net").then_some((Scheme::Net, before, number));
    }
    None
}

impl Stack {
    /// Finds the network of the shape.
    ///
    /// # Errors
    /// [`FieldError::Unsupported`] where no layers are named in a way that is known, [`FieldError::Malformed`] where a
    /// layer is missing or its tensors do not fit.
    pub fn find(tensors: &Tensors) -> Result<Self, FieldError> {
        let mut found: BTreeMap<(Scheme, &str), BTreeMap<usize, Parts<'_>>> = BTreeMap::new();
        for (name, tensor) in tensors {
            let Some(ending) = ENDINGS.iter().find(|e| name.ends_with(*e)) else { continue };
            let layer = &name[..name.len() - ending.len()];
            let Some((scheme, prefix, number)) = split(layer) else { continue };
            if OTHERS.iter().any(|other| prefix.contains(other)) {
                continue;
            }
            let parts = found.entry((scheme, prefix)).or_default().entry(number).or_default();
            parts.name = layer;
            match *ending {
                ".weight" => parts.weight = Some(tensor),
                ".bias" => parts.bias = Some(tensor),
                ".weight_g" => parts.length = Some(tensor),
                ".weight_v" => parts.direction = Some(tensor),
                _ if ending.ends_with('0') => (parts.length, parts.parametrized) = (Some(tensor), true),
                _ => (parts.direction, parts.parametrized) = (Some(tensor), true),
            }
        }
        // of several the network of distances, then the one with the shortest names
        let rank = |prefix: &str| (!prefix.contains("sdf_network"), !prefix.contains("implicit_network"), prefix.len());
        let best = found.into_iter().min_by_key(|((scheme, prefix), _)| (rank(prefix), *scheme));
        let ((scheme, prefix), layers) = best.ok_or_else(|| unknown(tensors))?;
        if layers.len() > MAX_LAYERS {
            let (found, limit) = (layers.len() as u64, MAX_LAYERS as u64);
            return Err(FieldError::Limit { what: "layers of a network", found, limit });
        }
        for (expected, (&number, parts)) in layers.iter().enumerate() {
            let last = scheme == Scheme::Layers && expected + 1 == layers.len();
            if number != expected && !(last && number == usize::MAX) {
                return Err(fault(format!("layer {expected} is missing before {:?}", parts.name)));
            }
        }
        if scheme == Scheme::Layers && layers.keys().next_back() != Some(&usize::MAX) {
            return Err(unknown(tensors));
        }
        let (normed, parametrized) =
            (layers.values().any(|p| p.direction.is_some()), layers.values().any(|p| p.parametrized));
        let shown = layers.values().next().map_or("", |p| p.name).to_owned();
        let mut left = MAX_PARAMETERS;
        let mut layers = layers.into_values().map(|parts| dense(&parts, &mut left)).collect::<Result<Vec<_>, _>>()?;
        norms::give(tensors, prefix, &mut layers)?;
        Ok(Self { scheme, prefix: prefix.to_owned(), shown, layers, normed, parametrized })
    }
}

/// What to say of a file in which no network was found.
fn unknown(tensors: &Tensors) -> FieldError {
    let names: Vec<String> = tensors.iter().take(SHOWN).map(|(n, t)| format!("{n:?} {:?}", t.shape)).collect();
    let more = if tensors.len() > SHOWN { format!(" and {} more", tensors.len() - SHOWN) } else { String::new() };
    let there = if names.is_empty() { "no tensor".to_owned() } else { format!("{}{more}", names.join(", ")) };
    let detail = format!(
        "no network of a known family: there is {there}, and none of lin0.weight (DeepSDF, IDR, NeuS, IGR), net.0.0.weight \
         (SIREN), layers.0.weight with last_layer.weight (SIREN of lucidrains); export it to ONNX, or to safetensors with an \
         architecture"
    );
    FieldError::Unsupported { detail }
}

fn dense(parts: &Parts<'_>, left: &mut usize) -> Result<Dense, FieldError> {
    let name = parts.name;
    let matrix = parts.direction.or(parts.weight).ok_or_else(|| fault(format!("{name:?} has no weight")))?;
    let &[outputs, inputs] = &matrix.shape[..] else {
        return Err(fault(format!("the weight of {name:?} has {} axes instead of 2", matrix.shape.len())));
    };
    if outputs == 0 || inputs == 0 {
        return Err(fault(format!("the weight of {name:?} is empty")));
    }
    *left = left.checked_sub(outputs.saturating_mul(inputs + 1)).ok_or(FieldError::Limit {
        what: "parameters of a network",
        found: (outputs as u64).saturating_mul(inputs as u64),
        limit: MAX_PARAMETERS as u64,
    })?;
    let mut weights = matrix.values.clone();
    if let Some(direction) = parts.direction {
        let length =
            parts.length.ok_or_else(|| fault(format!("{name:?} has a direction and no length of its weight")))?;
        if length.values.len() != outputs {
            let found = length.values.len();
            return Err(fault(format!("{name:?} has {outputs} rows and {found} lengths of them")));
        }
        let rows = weights.chunks_exact_mut(inputs).zip(direction.values.chunks_exact(inputs));
        for ((to, row), &length) in rows.zip(&length.values) {
            let norm = row.iter().map(|v| f64::from(*v).powi(2)).sum::<f64>().sqrt();
            to.iter_mut().zip(row).for_each(|(to, v)| *to = (f64::from(length) * f64::from(*v) / norm) as f32);
        }
    }
    let bias = parts.bias.ok_or_else(|| fault(format!("{name:?} has no bias")))?;
    if bias.values.len() != outputs {
        return Err(fault(format!("{name:?} has {outputs} rows and {} biases", bias.values.len())));
    }
    Ok(Dense { name: name.to_owned(), outputs, inputs, weights, bias: bias.values.clone(), norm: None })
}
