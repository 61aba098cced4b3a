//! Networks from the named tensors of other people's training code: which family a file is of is told by its names and
//! shapes, and what no file says is assumed and said.
//!
//! | family | names | hidden layers | skip | output |
//! |---|---|---|---|---|
//! | DeepSDF (Park et al. 2019) | `lin{l}`, weight norm or layer norms `bn{l}` | ReLU | `[x, input]` | tanh, twice with `use_tanh` |
//! | DeepSDFStruct | the same with parametrizations | ReLU | `[x, input]` | as it is, tanh with `use_tanh` |
//! | SIREN (Sitzmann et al. 2020) | `net.{i}.0` | sin(30 x), ReLU after its NeRF encoding | | as it is |
//! | SIREN of lucidrains | `layers.{i}`, `last_layer` | sin(30 x), then sin(x) | | as it is |
//! | IDR, VolSDF (Yariv et al. 2020, 2021) | `implicit_network.lin{l}` | softplus, beta 100 | `[x, input] / sqrt 2` | the first one |
//! | NeuS (Wang et al. 2021) | `sdf_network_fine.lin{l}` | as IDR | as IDR | the first one |
//! | IGR (Gropp et al. 2020) | `lin{l}` without a norm | softplus, beta 100 | as IDR | as it is |

mod norms;
mod stack;

use super::tensors::Tensors;
use super::{Activation, Encoding, Layer, MAX_FREQUENCIES, MAX_LATENT, Network, Skip};
use crate::field::FieldError;
use stack::{Dense, Scheme, Stack};

const FORMAT: &str = "network";

/// Whose training code a file is from.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize, utoipa::ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum Family {
    /// shrinkd's own safetensors.
    Shrinkd,
    /// neural-implicit-queries.
    NeuralImplicitQueries,
    /// An ONNX graph, which says everything itself.
    Onnx,
    /// DeepSDF.
    DeepSdf,
    /// DeepSDFStruct: DeepSDF without the last tanh.
    DeepSdfStruct,
    /// SIREN, in the layout of its authors.
    Siren,
    /// The ReLU network with a NeRF encoding of SIREN's authors (`mode="nerf"`).
    SirenNerf,
    /// SIREN, in the layout of lucidrains.
    SirenLucidrains,
    /// IDR.
    Idr,
    /// VolSDF.
    VolSdf,
    /// NeuS.
    Neus,
    /// IGR.
    Igr,
}

/// What a file was taken for.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize, utoipa::ToSchema)]
pub struct Detected {
    /// The family.
    pub family: Family,
    /// What in the file says so.
    pub because: String,
    /// What neither the file nor an option says and was taken as is usual in the family. What an option overrides ends with
    /// its name in parentheses.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub assumed: Vec<String>,
}

impl Detected {
    /// Forgets what was assumed in the place of an option that is given.
    pub(in crate::field) fn no_longer_assumes(&mut self, option: &str) {
        let ending = format!("(`{option}`)");
        self.assumed.retain(|assumption| !assumption.ends_with(&ending));
    }
}

/// What a `specs.json` of DeepSDF says about the network.
#[derive(Clone, Debug, Default, PartialEq, serde::Deserialize)]
pub struct Specs {
    /// Entries of a latent code.
    #[serde(rename = "CodeLength")]
    pub code_length: Option<usize>,
    /// The network's own part.
    #[serde(rename = "NetworkSpecs", default)]
    pub network: NetworkSpecs,
}

/// Arguments of DeepSDF's decoder, as far as the weights do not tell them.
#[derive(Clone, Debug, Default, PartialEq, serde::Deserialize)]
pub struct NetworkSpecs {
    /// Whether the last layer has a tanh of its own.
    #[serde(default)]
    pub use_tanh: bool,
    /// Whether layers with a norm have weight norm, or else a layer norm.
    pub weight_norm: Option<bool>,
    /// The layers with a norm.
    pub norm_layers: Option<Vec<usize>>,
    /// Coordinates of a point, which only DeepSDFStruct writes.
    pub geom_dimension: Option<usize>,
}

/// What a user says of a file.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Hints {
    /// The family, in place of the one that was detected.
    pub family: Option<Family>,
    /// How a point becomes input.
    pub encoding: Option<Encoding>,
}

fn fault(detail: String) -> FieldError {
    FieldError::Malformed { format: FORMAT, at: None, detail }
}

/// The network in some tensors, and what it was taken for. Latent codes are looked for in `codes` and in the tensors.
///
/// # Errors
/// [`FieldError::Unsupported`] with the names that are there and what was missing, [`FieldError::Malformed`] where
/// shapes do not fit each other, [`FieldError::Limit`].
pub fn read(
    tensors: &Tensors,
    codes: Option<&Tensors>,
    specs: Option<&Specs>,
    hints: &Hints,
) -> Result<(Network, Detected), FieldError> {
    let stack = Stack::find(tensors)?;
    let mut detected = detect(tensors, &stack, specs);
    if let Some(family) = hints.family {
        detected.family = family;
        "it was asked for".clone_into(&mut detected.because);
    }
    let family = detected.family;
    let mut assumed = Vec::new();
    let inputs = stack.layers[0].inputs;
    let nerf = family == Family::SirenNerf;
    check_norms(family, &stack, specs)?;
    let (encoding, latent_size) = input_of(family, inputs, specs, hints.encoding, &mut assumed)?;
    let activations = activations(family, &stack, specs, &mut assumed);
    let skip = skip_of(family);
    let mut layers = Vec::with_capacity(stack.layers.len() + 1);
    let mut previous = 0;
    let count = stack.layers.len();
    let mut norms = false;
    for (i, (dense, activation)) in stack.layers.into_iter().zip(activations).enumerate() {
        let mut dense = if i + 1 == count { first_output(family, dense)? } else { dense };
        if i + 1 == count && dense.norm.take().is_some() {
            // norm_layers may list the last layer, which then has a norm that the code of DeepSDF passes over
            assumed.push("the layer norm of the last layer is not used".to_owned());
        }
        norms |= dense.norm.is_some();
        let outputs = dense.outputs;
        let layer = if i == 0 {
            let weights = if nerf { from_interleaved(&dense, encoding) } else { dense.weights };
            Layer { weights, bias: dense.bias, norm: dense.norm, activation, skip: None }
        } else {
            joined(dense, previous, (inputs, latent_size), activation, skip)?
        };
        layers.push(layer);
        previous = outputs;
    }
    if norms {
        assumed.push("layer norms add 1e-5 to the variance".to_owned());
    }
    if layers.iter().any(|layer| layer.skip.is_some()) && skip.scale != 1.0 {
        assumed.push("the input joined to a layer is divided by sqrt 2 (`skip`)".to_owned());
    }
    if family == Family::DeepSdf && specs.is_some_and(|s| s.network.use_tanh) {
        // tanh of a tanh, as a layer that only has the second one
        let activation = Activation::Tanh;
        layers.push(Layer { weights: vec![1.0], bias: vec![0.0], norm: None, activation, skip: None });
    }
    let latent_codes = match latent_size {
        0 => Vec::new(),
        size => codes.and_then(|c| latent_codes(c, size)).or_else(|| latent_codes(tensors, size)).unwrap_or_default(),
    };
    assumed.push("the shape lies in the cube of half extent 1 (`domain`)".to_owned());
    detected.assumed = assumed;
    let network = Network { encoding, latent_size, latent_codes, ..Network::of_layers(layers) };
    network.check(FORMAT)?;
    Ok((network, detected))
}

/// The family by names alone.
fn detect(tensors: &Tensors, stack: &Stack, specs: Option<&Specs>) -> Detected {
    let has = |part: &str| tensors.keys().any(|name| name.contains(part));
    let of = |family, because: String| Detected { family, because, assumed: Vec::new() };
    let shown = &stack.shown;
    match stack.scheme {
        Scheme::Net if stack.layers[0].inputs > 3 => {
            let inputs = stack.layers[0].inputs;
            of(Family::SirenNerf, format!("its layers are named like {shown:?}, and the first takes {inputs} numbers"))
        }
        Scheme::Net => of(Family::Siren, format!("its layers are named like {shown:?}")),
        Scheme::Layers => {
            of(Family::SirenLucidrains, format!("its layers are named like {shown:?}, with a last_layer"))
        }
        Scheme::Lin if stack.prefix.contains("sdf_network") => {
            of(Family::Neus, format!("its layers are named like {shown:?}"))
        }
        Scheme::Lin if stack.prefix.contains("implicit_network") && has("density.beta") => {
            of(Family::VolSdf, format!("its layers are named like {shown:?}, and there is a density.beta"))
        }
        Scheme::Lin if stack.prefix.contains("implicit_network") => {
            of(Family::Idr, format!("its layers are named like {shown:?}"))
        }
        Scheme::Lin if specs.is_some_and(|s| s.network.geom_dimension.is_some()) => {
            of(Family::DeepSdfStruct, "its specs.json has a geom_dimension".to_owned())
        }
        Scheme::Lin if has("homogen_network") => {
            of(Family::DeepSdfStruct, "there is a homogen_network beside its layers".to_owned())
        }
        Scheme::Lin if specs.is_some() => of(Family::DeepSdf, "there is a specs.json".to_owned()),
        Scheme::Lin if stack.parametrized => of(
            Family::DeepSdfStruct,
            format!("its layers are named like {shown:?}, with weight norm as a parametrization"),
        ),
        Scheme::Lin if stack.normed => {
            of(Family::DeepSdf, format!("its layers are named like {shown:?}, with weight norm"))
        }
        Scheme::Lin if stack.layers.iter().any(|layer| layer.norm.is_some()) => {
            of(Family::DeepSdf, format!("its layers are named like {shown:?}, with layer norms"))
        }
        Scheme::Lin => of(Family::Igr, format!("its layers are named like {shown:?}, without weight norm")),
    }
}

fn is_softplus(family: Family) -> bool {
    matches!(family, Family::Idr | Family::VolSdf | Family::Neus | Family::Igr)
}

/// Refuses layer norms where nothing says what they do, or where something else is said of them.
fn check_norms(family: Family, stack: &Stack, specs: Option<&Specs>) -> Result<(), FieldError> {
    let is_deep_sdf = matches!(family, Family::DeepSdf | Family::DeepSdfStruct);
    if let Some(l) = stack.layers.iter().position(|layer| layer.norm.is_some()) {
        if !is_deep_sdf {
            let shown = &stack.shown;
            let detail = format!("a layer norm \"bn{l}\" beside layers named like {shown:?}: only DeepSDF's are known");
            return Err(FieldError::Unsupported { detail });
        }
        if stack.normed {
            return Err(fault(format!(
                "there is a layer norm \"bn{l}\" beside weight norm, and DeepSDF has one of them"
            )));
        }
    }
    match specs {
        Some(specs) if is_deep_sdf => norms::check(&specs.network, &stack.layers, stack.normed),
        _ => Ok(()),
    }
}

/// The encoding and the size of the latent code that make so many inputs.
fn input_of(
    family: Family,
    inputs: usize,
    specs: Option<&Specs>,
    hint: Option<Encoding>,
    assumed: &mut Vec<String>,
) -> Result<(Encoding, usize), FieldError> {
    if let Some(dimension) = specs.and_then(|s| s.network.geom_dimension).filter(|&d| d != 3) {
        return Err(FieldError::Unsupported { detail: format!("a network of points with {dimension} coordinates") });
    }
    let octaves = |inputs: usize| (inputs > 3 && (inputs - 3).is_multiple_of(6)).then(|| (inputs as u32 - 3) / 6);
    let encoding = match (hint, octaves(inputs)) {
        (Some(encoding), _) => encoding,
        (None, Some(frequencies)) if family == Family::SirenNerf && frequencies <= MAX_FREQUENCIES => {
            Encoding::Positional { frequencies, base: std::f64::consts::PI }
        }
        (None, Some(frequencies)) if is_softplus(family) && family != Family::Igr && frequencies <= MAX_FREQUENCIES => {
            assumed.push(format!("a point is encoded by {frequencies} octaves from 1 on (`encoding`)"));
            Encoding::Positional { frequencies, base: 1.0 }
        }
        (None, _) => Encoding::Identity,
    };
    let Some(latent) = inputs.checked_sub(encoding.size()) else {
        let size = encoding.size();
        return Err(fault(format!("the first layer takes {inputs} numbers, and a point alone is {size} of them")));
    };
    if let Some(length) = specs.and_then(|s| s.code_length).filter(|&length| length != latent) {
        return Err(fault(format!(
            "specs.json has a CodeLength of {length}, and the first layer has room for {latent}"
        )));
    }
    if latent > 0 && matches!(family, Family::Siren | Family::SirenNerf | Family::SirenLucidrains) {
        let detail = format!("the first layer takes {inputs} numbers, which is no point and no encoding of it");
        return Err(FieldError::Unsupported { detail });
    }
    if latent > MAX_LATENT {
        let (found, limit) = (latent as u64, MAX_LATENT as u64);
        return Err(FieldError::Limit { what: "entries of a latent code", found, limit });
    }
    Ok((encoding, latent))
}

/// The activation of every layer.
fn activations(family: Family, stack: &Stack, specs: Option<&Specs>, assumed: &mut Vec<String>) -> Vec<Activation> {
    const W0: f32 = 30.0;
    const BETA: f32 = 100.0;
    let hidden = match family {
        Family::Siren => {
            assumed.push("w0 is 30 in every layer (`w0`)".to_owned());
            Activation::Sine { w0: W0 }
        }
        Family::SirenLucidrains => {
            assumed.push("w0 is 30 in the first layer and 1 in the others (`w0`)".to_owned());
            Activation::Sine { w0: 1.0 }
        }
        family if is_softplus(family) => {
            assumed.push("hidden layers have a softplus of beta 100 (`activation`)".to_owned());
            Activation::Softplus { beta: BETA }
        }
        _ => {
            assumed.push("hidden layers have a ReLU (`activation`)".to_owned());
            Activation::Relu
        }
    };
    let own_tanh = family == Family::DeepSdfStruct && specs.is_some_and(|s| s.network.use_tanh);
    let last = if family == Family::DeepSdf || own_tanh { Activation::Tanh } else { Activation::Identity };
    if family == Family::DeepSdf {
        assumed.push("the output goes through a tanh".to_owned());
    }
    let count = stack.layers.len();
    let mut list = vec![hidden; count];
    if family == Family::SirenLucidrains {
        list[0] = Activation::Sine { w0: W0 };
    }
    list[count - 1] = last;
    list
}

fn skip_of(family: Family) -> Skip {
    Skip { scale: if is_softplus(family) { std::f32::consts::FRAC_1_SQRT_2 } else { 1.0 } }
}

/// The last layer with its first output only, where the others are features of the surface.
fn first_output(family: Family, mut dense: Dense) -> Result<Dense, FieldError> {
    if dense.outputs > 1 && !is_softplus(family) {
        let detail = format!("the last layer has {} outputs, and a distance is one", dense.outputs);
        return Err(FieldError::Unsupported { detail });
    }
    dense.weights.truncate(dense.inputs);
    dense.bias.truncate(1);
    dense.outputs = 1;
    Ok(dense)
}

/// A layer behind the first: what it takes tells whether the network's input, or the point alone, is joined to it.
fn joined(
    dense: Dense,
    previous: usize,
    (inputs, latent): (usize, usize),
    activation: Activation,
    skip: Skip,
) -> Result<Layer, FieldError> {
    let Dense { name, outputs, inputs: taken, weights, bias, norm } = dense;
    let (weights, skip) = match taken.checked_sub(previous) {
        Some(0) => (weights, None),
        Some(extra) if extra == inputs => (weights, Some(skip)),
        // DeepSDF's xyz_in_all: the point without the code
        Some(extra) if extra == 3 && inputs == latent + 3 => {
            let mut wide = Vec::with_capacity(outputs * (previous + inputs));
            for row in weights.chunks_exact(taken) {
                wide.extend_from_slice(&row[..previous]);
                wide.resize(wide.len() + latent, 0.0);
                wide.extend_from_slice(&row[previous..]);
            }
            (wide, Some(skip))
        }
        _ => {
            return Err(fault(format!(
                "{name:?} takes {taken} inputs, where {previous} arrive, or {} with the network's {inputs} joined to them",
                previous + inputs
            )));
        }
    };
    Ok(Layer { weights, bias, norm, activation, skip })
}

/// Columns of SIREN's NeRF encoding, sine beside cosine for every coordinate, in the order of [`Encoding::Positional`].
fn from_interleaved(dense: &Dense, encoding: Encoding) -> Vec<f32> {
    let column = |k: usize| {
        if k < 3 || encoding == Encoding::Identity {
            return k;
        }
        let (octave, within) = ((k - 3) / 6, (k - 3) % 6);
        3 + 6 * octave + 2 * (within % 3) + within / 3
    };
    dense.weights.chunks_exact(dense.inputs).flat_map(|row| (0..dense.inputs).map(|k| row[column(k)])).collect()
}

/// The table of latent codes of this size, if there is one.
fn latent_codes(tensors: &Tensors, size: usize) -> Option<Vec<f32>> {
    let named = |name: &str| {
        let last = name.strip_suffix(".weight").unwrap_or(name);
        last.is_empty() || ["latent_codes", "lat_vecs", "latent_vecs"].iter().any(|known| last.ends_with(known))
    };
    let fits = |shape: &[usize]| {
        shape.last() == Some(&size) && shape.iter().rev().skip(2).all(|&n| n == 1 || shape[shape.len() - 2] == 1)
    };
    let table = |(name, tensor): (&String, &super::tensors::Tensor)| {
        (named(name) && fits(&tensor.shape) && !tensor.values.is_empty()).then(|| tensor.values.clone())
    };
    tensors.iter().find_map(table)
}

#[cfg(test)]
mod tests;
