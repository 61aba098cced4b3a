//! Neural signed distance fields: multilayer perceptrons from weight files, evaluated in batches with their gradients.
//!
//! A [`Network`] is what a file holds: dense layers with activations and skips, an encoding of the point, and perhaps a
//! table of latent codes. [`Network::field`] folds one latent code into the biases and gives a [`NetworkField`]. Some files say
//! what they are: shrinkd's own safetensors ([`safetensors`]), the npz of neural-implicit-queries ([`niq`]), ONNX graphs
//! ([`onnx`]). Others only hold named tensors ([`torch`], [`tensors`]), and [`family`] tells whose they are; [`folder`] is an
//! experiment of DeepSDF. `docs/networks.md` describes them all.
//!
//! What a network returns is neither promised to be a distance nor a bound of one: unless its file says more, the field
//! is [`Metric::Bound`] with an unknown Lipschitz bound.

mod activation;
pub mod adjoint;
mod evaluate;
pub mod family;
pub mod folder;
mod functions;
mod layer_norm;
pub mod niq;
pub mod onnx;
mod passes;
mod product;
pub mod safetensors;
pub mod tensors;
pub mod torch;
pub(in crate::field) mod zip;

pub use activation::Activation;
pub use evaluate::NetworkField;
pub use layer_norm::LayerNorm;

use super::{Domain, FieldError, Metric};

/// Most layers of a network.
pub const MAX_LAYERS: usize = 64;
/// Most outputs of a layer.
pub const MAX_WIDTH: usize = 8192;
/// Most outputs of all layers together: every thread keeps a value and a derivative of each for a block of points.
pub const MAX_UNITS: usize = 65_536;
/// Most weights and biases together, scales and shifts of norms included (256 MiB).
pub const MAX_PARAMETERS: usize = 1 << 26;
/// Most entries of a latent code.
pub const MAX_LATENT: usize = 4096;
/// Most octaves of a positional encoding.
pub const MAX_FREQUENCIES: u32 = 16;

/// How a point becomes the network's input.
#[derive(Clone, Copy, Debug, Default, PartialEq, serde::Serialize, serde::Deserialize, utoipa::ToSchema)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum Encoding {
    /// The three coordinates as they are.
    #[default]
    Identity,
    /// The coordinates, then for k = 0, 1, … the three sines and the three cosines of `base` 2^k times the coordinates.
    Positional {
        /// Number of octaves, from 1 to 16.
        frequencies: u32,
        /// Angular frequency of the first octave: 1 in IDR and NeuS, pi in NeRF.
        base: f64,
    },
}

impl Encoding {
    /// Numbers that a point becomes.
    pub fn size(self) -> usize {
        match self {
            Self::Identity => 3,
            Self::Positional { frequencies, .. } => 3 + 6 * frequencies as usize,
        }
    }
}

/// The network's input joined to what the layer before gives: `scale * [previous outputs, latent code, encoded point]`.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, serde::Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub struct Skip {
    /// Factor on the joined vector: 1 in DeepSDF, 1 / sqrt 2 in IDR and its descendants.
    #[serde(default = "one")]
    pub scale: f32,
}

fn one() -> f32 {
    1.0
}

/// One dense layer: `activation(weights * input + bias)`, or `activation(norm(weights * input + bias))`.
#[derive(Clone, Debug, PartialEq)]
pub struct Layer {
    /// Row-major, one row of `inputs` weights per output.
    pub weights: Vec<f32>,
    /// One number per output.
    pub bias: Vec<f32>,
    /// What is done to all outputs together before their activation; never on the last layer.
    pub norm: Option<LayerNorm>,
    /// What is done to the outputs.
    pub activation: Activation,
    /// Whether the network's input is joined to the layer's; never on the first layer.
    pub skip: Option<Skip>,
}

impl Layer {
    /// Number of outputs.
    pub fn outputs(&self) -> usize {
        self.bias.len()
    }
    /// Number of inputs, those of a skip included.
    pub fn inputs(&self) -> usize {
        self.weights.len() / self.bias.len().max(1)
    }
    /// Number of weights and biases, and of scales and shifts of a norm.
    pub fn parameters(&self) -> usize {
        self.lists().map(Vec::len).sum()
    }
    /// The weights row by row, the biases, and the scales and shifts of a norm.
    fn lists(&self) -> impl Iterator<Item = &Vec<f32>> {
        [&self.weights, &self.bias].into_iter().chain(self.norm.iter().flat_map(|norm| [&norm.scale, &norm.shift]))
    }
    fn lists_mut(&mut self) -> impl Iterator<Item = &mut Vec<f32>> {
        let norm = self.norm.iter_mut().flat_map(|norm| [&mut norm.scale, &mut norm.shift]);
        [&mut self.weights, &mut self.bias].into_iter().chain(norm)
    }
}

/// A network as its file holds it. The first layer takes `[latent code, encoded point]`; the last has one output.
#[derive(Clone, Debug, PartialEq)]
pub struct Network {
    /// The layers in order; at least one.
    pub layers: Vec<Layer>,
    /// How a point becomes input.
    pub encoding: Encoding,
    /// Entries of a latent code; 0 for a network of one shape.
    pub latent_size: usize,
    /// Latent codes that come with the network, row after row of `latent_size`.
    pub latent_codes: Vec<f32>,
    /// The box that holds the zero level set.
    pub domain: Domain,
    /// What the values mean.
    pub metric: Metric,
    /// An upper bound of the gradient's length over the domain, where one is known.
    pub lipschitz: Option<f32>,
}

impl Network {
    /// A network of one shape as most files mean it: of the coordinates themselves, over the cube of half extent 1, with
    /// values that bound a distance, by how much nobody says.
    pub fn of_layers(layers: Vec<Layer>) -> Self {
        Self {
            layers,
            encoding: Encoding::Identity,
            latent_size: 0,
            latent_codes: Vec::new(),
            domain: Domain::default(),
            metric: Metric::Bound,
            lipschitz: None,
        }
    }

    /// Number of weights and biases, and of scales and shifts of norms; latent codes are not counted.
    pub fn parameters(&self) -> usize {
        self.layers.iter().map(Layer::parameters).sum()
    }

    /// All weights and biases: layer by layer, the weights row by row, then the biases, then the scales and the shifts of its norm.
    pub fn weights(&self) -> Vec<f32> {
        self.layers.iter().flat_map(Layer::lists).flatten().copied().collect()
    }

    /// Replaces all weights and biases; the list is as [`Network::weights`] gives it.
    ///
    /// # Panics
    /// When the list has another length than [`Network::parameters`].
    pub fn set_weights(&mut self, list: &[f32]) {
        assert_eq!(list.len(), self.parameters());
        let mut rest = list;
        for part in self.layers.iter_mut().flat_map(Layer::lists_mut) {
            let (taken, after) = rest.split_at(part.len());
            part.copy_from_slice(taken);
            rest = after;
        }
    }

    /// Whether a layer is given the network's input: the first one, and those with a skip.
    fn sees_input(&self, layer: usize) -> bool {
        layer == 0 || self.layers[layer].skip.is_some()
    }

    /// Number of latent codes that come with the network.
    pub fn latent_rows(&self) -> usize {
        self.latent_codes.len().checked_div(self.latent_size).unwrap_or(0)
    }

    /// Latent code `row` of those that come with the network.
    pub fn latent_code(&self, row: usize) -> Option<&[f32]> {
        let start = row.checked_mul(self.latent_size)?;
        self.latent_codes.get(start..start + self.latent_size).filter(|code| !code.is_empty())
    }

    /// The field of this network for one latent code (empty for a network without), or `None` when the code is not
    /// `latent_size` finite numbers.
    pub fn field(&self, latent: &[f32]) -> Option<NetworkField> {
        let fits = latent.len() == self.latent_size && latent.iter().all(|v| v.is_finite());
        fits.then(|| NetworkField::new(self, latent))
    }

    /// Checks that the layers fit each other, that all numbers are finite and that no limit is passed.
    fn check(&self, format: &'static str) -> Result<(), FieldError> {
        let fault = |detail: String| Err(FieldError::Malformed { format, at: None, detail });
        let over = |what, found: usize, limit: usize| {
            Err(FieldError::Limit { what, found: found as u64, limit: limit as u64 })
        };
        if self.layers.is_empty() {
            return fault("the network has no layer".to_owned());
        }
        if self.layers.len() > MAX_LAYERS {
            return over("layers of a network", self.layers.len(), MAX_LAYERS);
        }
        if self.latent_size > MAX_LATENT {
            return over("entries of a latent code", self.latent_size, MAX_LATENT);
        }
        if let Encoding::Positional { frequencies, base } = self.encoding {
            if frequencies > MAX_FREQUENCIES {
                return over("frequencies of an encoding", frequencies as usize, MAX_FREQUENCIES as usize);
            }
            if frequencies == 0 || !(base > 0.0 && base <= 1e4) {
                return fault("a positional encoding needs a frequency and a base from 0 to 10,000".to_owned());
            }
        }
        let input = self.latent_size + self.encoding.size();
        let mut previous = 0;
        for (i, layer) in self.layers.iter().enumerate() {
            if layer.outputs() == 0 || layer.outputs() > MAX_WIDTH {
                return over("outputs of a layer", layer.outputs(), MAX_WIDTH);
            }
            let expected = match layer.skip {
                None if i == 0 => input,
                None => previous,
                Some(_) if i == 0 => return fault("the first layer cannot have a skip".to_owned()),
                Some(_) => previous + input,
            };
            if layer.weights.len() != expected * layer.outputs() {
                let found = layer.inputs();
                return fault(format!("layer {i} takes {found} inputs where {expected} arrive"));
            }
            if !layer.activation.is_valid() || layer.skip.is_some_and(|s| !s.scale.is_finite()) {
                return fault(format!("layer {i} has a parameter of its activation or skip that is out of range"));
            }
            let finite = |list: &[f32], name: &str| match list.iter().position(|w| !w.is_finite()) {
                Some(at) => fault(format!("entry {at} of the {name} of layer {i} is not finite")),
                None => Ok(()),
            };
            finite(&layer.weights, "weights")?;
            finite(&layer.bias, "bias")?;
            if let Some(norm) = &layer.norm {
                let (scales, shifts, outputs) = (norm.scale.len(), norm.shift.len(), layer.outputs());
                if i + 1 == self.layers.len() {
                    return fault(format!("layer {i} has a layer norm, and the last layer cannot have one"));
                }
                if scales != outputs || shifts != outputs {
                    return fault(format!(
                        "the layer norm of layer {i} has {scales} scales and {shifts} shifts for {outputs} outputs"
                    ));
                }
                if !(norm.epsilon > 0.0 && norm.epsilon.is_finite()) {
                    return fault(format!("the epsilon of the layer norm of layer {i} is not a positive number"));
                }
                finite(&norm.scale, "scale of the layer norm")?;
                finite(&norm.shift, "shift of the layer norm")?;
            }
            previous = layer.outputs();
        }
        if previous != 1 {
            return fault(format!("the last layer has {previous} outputs instead of one"));
        }
        let units = self.layers.iter().map(Layer::outputs).sum();
        if units > MAX_UNITS {
            return over("outputs of all layers", units, MAX_UNITS);
        }
        if self.parameters() > MAX_PARAMETERS {
            return over("parameters of a network", self.parameters(), MAX_PARAMETERS);
        }
        if !self.latent_codes.is_empty()
            && (self.latent_size == 0 || !self.latent_codes.len().is_multiple_of(self.latent_size))
        {
            return fault(format!("the latent codes are not rows of {} numbers", self.latent_size));
        }
        if let Some(at) = self.latent_codes.iter().position(|v| !v.is_finite()) {
            return fault(format!("entry {at} of the latent codes is not finite"));
        }
        let box_is_sound = (0..3).all(|a| {
            let (low, high) = (self.domain.min[a], self.domain.max[a]);
            low < high && low.abs() <= 1e6 && high.abs() <= 1e6
        });
        if !box_is_sound {
            return fault("the domain is not a box within a million units of the origin".to_owned());
        }
        if self.lipschitz.is_some_and(|l| !(l > 0.0 && l.is_finite())) {
            return fault("the Lipschitz bound is not a positive number".to_owned());
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests;
