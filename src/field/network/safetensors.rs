//! shrinkd's own weight files: safetensors with the architecture as JSON in the metadata.
//!
//! The metadata member `architecture` holds an [`Architecture`]; layer i has the tensors `layers.i.weight` of shape
//! `[outputs, inputs]` and `layers.i.bias` of shape `[outputs]`, with a layer norm `layers.i.norm.scale` and `layers.i.norm.shift` of that
//! shape, too, and `latent_codes` of shape `[n, latent_size]` may come along.
//! Numbers are F32 or F64. `docs/networks.md` describes the format for those who write it.

use super::tensors::{Tensor, Tensors, bfloat, half};
use super::{Activation, Encoding, Layer, LayerNorm, MAX_LAYERS, MAX_PARAMETERS, Network, Skip, layer_norm};
use crate::field::{Domain, FieldError, Metric};
use safetensors::tensor::{Metadata, TensorView};
use safetensors::{Dtype, SafeTensors};
use std::collections::HashSet;

const FORMAT: &str = "safetensors";
/// The version of the architecture's JSON that is read and written.
pub const VERSION: u32 = 1;
/// Longest header; a network of 64 layers needs about 10 KiB.
const MAX_HEADER: u64 = 1 << 20;

/// What the metadata member `architecture` says.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Architecture {
    /// 1.
    pub version: u32,
    /// The layers in order.
    pub layers: Vec<LayerSpec>,
    /// How a point becomes input; the coordinates as they are by default.
    #[serde(default)]
    pub encoding: Encoding,
    /// Entries of a latent code; 0 by default.
    #[serde(default)]
    pub latent_size: u32,
    /// The box that holds the zero level set; the cube of half extent 1 by default.
    #[serde(default)]
    pub domain: Domain,
    /// What the values mean; `bound` by default.
    #[serde(default = "bound")]
    pub metric: Metric,
    /// An upper bound of the gradient's length over the domain.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub lipschitz: Option<f32>,
}

fn bound() -> Metric {
    Metric::Bound
}

/// One layer of an [`Architecture`].
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LayerSpec {
    /// Number of outputs.
    pub outputs: u32,
    /// What is done to all outputs together before their activation.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub layer_norm: Option<LayerNormSpec>,
    /// What is done to the outputs; `identity` by default.
    #[serde(default)]
    pub activation: Activation,
    /// Whether the network's input is joined to the layer's.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub skip: Option<Skip>,
}

/// A layer norm of a [`LayerSpec`].
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LayerNormSpec {
    /// What is added to the variance; 1e-5 by default.
    #[serde(default = "epsilon")]
    pub epsilon: f32,
}

fn epsilon() -> f32 {
    layer_norm::EPSILON
}

fn fault(at: Option<u64>, detail: String) -> FieldError {
    FieldError::Malformed { format: FORMAT, at, detail }
}

/// Whether the bytes begin as safetensors do: a length, and a JSON object of that length.
pub(in crate::field) fn claims(bytes: &[u8]) -> bool {
    bytes.get(8) == Some(&b'{') && bytes.first_chunk::<8>().is_some_and(|n| u64::from_le_bytes(*n) < 1 << 32)
}

/// The tensors of a file that has no architecture, by name; `None` where it has one.
///
/// # Errors
/// As [`read`].
pub fn tensors(bytes: &[u8]) -> Result<Option<Tensors>, FieldError> {
    let (metadata, tensors) = open(bytes)?;
    if metadata.metadata().as_ref().is_some_and(|m| m.contains_key("architecture")) {
        return Ok(None);
    }
    let read = |(name, view): (String, TensorView<'_>)| {
        let values = numbers(&name, &view)?;
        Ok((name, Tensor { shape: view.shape().to_vec(), values }))
    };
    tensors.tensors().into_iter().map(read).collect::<Result<_, _>>().map(Some)
}

/// Reads a network.
///
/// # Errors
/// [`FieldError::Malformed`] that names the tensor or the byte, [`FieldError::Unsupported`] for safetensors without an
/// architecture or with another version of it, and [`FieldError::Limit`].
pub fn read(bytes: &[u8]) -> Result<Network, FieldError> {
    let (metadata, tensors) = open(bytes)?;
    read_own(&metadata, &tensors)
}

/// The header and the tensors, checked against the length of the file.
fn open(bytes: &[u8]) -> Result<(Metadata, SafeTensors<'_>), FieldError> {
    let header = bytes.first_chunk::<8>().map(|n| u64::from_le_bytes(*n));
    let header = header.ok_or_else(|| fault(Some(0), "the file ends inside its header".to_owned()))?;
    if header > MAX_HEADER {
        return Err(FieldError::Limit { what: "bytes of a safetensors header", found: header, limit: MAX_HEADER });
    }
    if header > bytes.len() as u64 - 8 {
        return Err(fault(Some(bytes.len() as u64), "the file ends inside its header".to_owned()));
    }
    let (_, metadata) = SafeTensors::read_metadata(bytes).map_err(|e| fault(None, e.to_string()))?;
    let tensors = SafeTensors::deserialize(bytes).map_err(|e| fault(None, e.to_string()))?;
    Ok((metadata, tensors))
}

fn read_own(metadata: &Metadata, tensors: &SafeTensors<'_>) -> Result<Network, FieldError> {
    let text = metadata.metadata().as_ref().and_then(|m| m.get("architecture"));
    let text = text.ok_or_else(|| FieldError::Unsupported {
        detail: "safetensors without an architecture in the metadata".to_owned(),
    })?;
    let document: serde_json::Value =
        serde_json::from_str(text).map_err(|e| fault(None, format!("the architecture is not JSON: {e}")))?;
    let version = document.get("version").and_then(serde_json::Value::as_u64);
    if version != Some(u64::from(VERSION)) {
        let found = version.map_or("none".to_owned(), |v| v.to_string());
        return Err(FieldError::Unsupported { detail: format!("version {found} of the architecture, not {VERSION}") });
    }
    let architecture: Architecture =
        serde_json::from_value(document).map_err(|e| fault(None, format!("the architecture: {e}")))?;
    if architecture.layers.len() > MAX_LAYERS {
        let (found, limit) = (architecture.layers.len() as u64, MAX_LAYERS as u64);
        return Err(FieldError::Limit { what: "layers of a network", found, limit });
    }

    let mut expected = HashSet::new();
    let mut take = |name: String, axes: usize| -> Result<(Vec<usize>, Vec<f32>), FieldError> {
        let view = tensors.tensor(&name).map_err(|_| fault(None, format!("tensor {name:?} is missing")))?;
        if view.shape().len() != axes {
            return Err(fault(None, format!("tensor {name:?} has {} axes instead of {axes}", view.shape().len())));
        }
        let taken = (view.shape().to_vec(), numbers(&name, &view)?);
        expected.insert(name);
        Ok(taken)
    };
    let mut layers = Vec::with_capacity(architecture.layers.len());
    for (i, spec) in architecture.layers.iter().enumerate() {
        let (shape, weights) = take(format!("layers.{i}.weight"), 2)?;
        let (bias_shape, bias) = take(format!("layers.{i}.bias"), 1)?;
        let outputs = spec.outputs as usize;
        if shape[0] != outputs || bias_shape[0] != outputs || outputs == 0 {
            let (rows, biases) = (shape[0], bias_shape[0]);
            return Err(fault(
                None,
                format!("layer {i} has {outputs} outputs, its weight {rows} rows and its bias {biases} entries"),
            ));
        }
        let norm = match spec.layer_norm {
            None => None,
            Some(LayerNormSpec { epsilon }) => {
                let (_, scale) = take(format!("layers.{i}.norm.scale"), 1)?;
                let (_, shift) = take(format!("layers.{i}.norm.shift"), 1)?;
                Some(LayerNorm { scale, shift, epsilon })
            }
        };
        layers.push(Layer { weights, bias, norm, activation: spec.activation, skip: spec.skip });
    }
    let latent_size = architecture.latent_size as usize;
    let latent_codes = if tensors.names().contains(&"latent_codes") {
        let (shape, codes) = take("latent_codes".to_owned(), 2)?;
        if shape[1] != latent_size {
            return Err(fault(
                None,
                format!("tensor \"latent_codes\" has rows of {} instead of {latent_size}", shape[1]),
            ));
        }
        codes
    } else {
        Vec::new()
    };
    if let Some(name) = tensors.names().into_iter().filter(|n| !expected.contains(*n)).min() {
        return Err(fault(None, format!("tensor {name:?} belongs to no layer")));
    }
    let network = Network {
        layers,
        encoding: architecture.encoding,
        latent_size,
        latent_codes,
        domain: architecture.domain,
        metric: architecture.metric,
        lipschitz: architecture.lipschitz,
    };
    network.check(FORMAT)?;
    Ok(network)
}

fn numbers(name: &str, view: &TensorView<'_>) -> Result<Vec<f32>, FieldError> {
    let data = view.data();
    let list: Vec<f32> = match view.dtype() {
        Dtype::F32 => data.as_chunks().0.iter().map(|b| f32::from_le_bytes(*b)).collect(),
        Dtype::F16 => data.as_chunks().0.iter().map(|b| half(u16::from_le_bytes(*b))).collect(),
        Dtype::BF16 => data.as_chunks().0.iter().map(|b| bfloat(u16::from_le_bytes(*b))).collect(),
        Dtype::F64 => data.as_chunks().0.iter().map(|b| f64::from_le_bytes(*b) as f32).collect(),
        other => return Err(FieldError::Unsupported { detail: format!("tensor {name:?} of type {other:?}") }),
    };
    if list.len() > MAX_PARAMETERS {
        let (found, limit) = (list.len() as u64, MAX_PARAMETERS as u64);
        return Err(FieldError::Limit { what: "parameters of a network", found, limit });
    }
    if let Some(at) = list.iter().position(|v| !v.is_finite()) {
        return Err(fault(None, format!("number {at} of tensor {name:?} is not finite")));
    }
    Ok(list)
}

/// Writes a network so that [`read`] gives it back. The same network gives the same bytes.
pub fn write(network: &Network) -> Vec<u8> {
    let spec = |layer: &Layer| LayerSpec {
        outputs: layer.outputs() as u32,
        layer_norm: layer.norm.as_ref().map(|norm| LayerNormSpec { epsilon: norm.epsilon }),
        activation: layer.activation,
        skip: layer.skip,
    };
    let architecture = Architecture {
        version: VERSION,
        layers: network.layers.iter().map(spec).collect(),
        encoding: network.encoding,
        latent_size: network.latent_size as u32,
        domain: network.domain,
        metric: network.metric,
        lipschitz: network.lipschitz,
    };
    // the header is written by hand: with one metadata member and tensors in order there is little to it, and nothing fails
    let mut header = serde_json::Map::new();
    header.insert(
        "__metadata__".into(),
        serde_json::json!({ "architecture": serde_json::json!(architecture).to_string() }),
    );
    let mut data: Vec<u8> = Vec::new();
    let mut put = |name: String, shape: &[usize], list: &[f32]| {
        let start = data.len();
        data.extend(list.iter().flat_map(|v| v.to_le_bytes()));
        let tensor = serde_json::json!({ "dtype": "F32", "shape": shape, "data_offsets": [start, data.len()] });
        header.insert(name, tensor);
    };
    for (i, layer) in network.layers.iter().enumerate() {
        put(format!("layers.{i}.weight"), &[layer.outputs(), layer.inputs()], &layer.weights);
        put(format!("layers.{i}.bias"), &[layer.outputs()], &layer.bias);
        if let Some(norm) = &layer.norm {
            put(format!("layers.{i}.norm.scale"), &[norm.scale.len()], &norm.scale);
            put(format!("layers.{i}.norm.shift"), &[norm.shift.len()], &norm.shift);
        }
    }
    if network.latent_rows() > 0 {
        put("latent_codes".to_owned(), &[network.latent_rows(), network.latent_size], &network.latent_codes);
    }
    let mut text = serde_json::Value::Object(header).to_string().into_bytes();
    text.resize(text.len().next_multiple_of(8), b' ');
    let mut bytes = (text.len() as u64).to_le_bytes().to_vec();
    bytes.append(&mut text);
    bytes.append(&mut data);
    bytes
}
