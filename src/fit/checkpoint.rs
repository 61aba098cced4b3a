//! The state of a training between two epochs: enough to go on and end with the same bits.

use super::adam::Trained;
use super::{FitSpec, untrained};
use crate::field::network::Network;
use safetensors::tensor::TensorView;
use safetensors::{Dtype, SafeTensors};
use std::collections::HashMap;

/// The version of the bytes.
const VERSION: u32 = 1;
/// The tensors: the numbers that are trained with their moments, those of the weights first, and the losses.
const TENSORS: [&str; 7] =
    ["weights", "weight_means", "weight_squares", "codes", "code_means", "code_squares", "losses"];

/// Where a training is.
#[derive(Clone, Debug, PartialEq)]
pub struct Checkpoint {
    /// Epochs that are over.
    pub epoch: u32,
    /// Steps that were made.
    pub(super) steps: u64,
    pub(super) weights: Trained,
    pub(super) codes: Trained,
    /// Mean of the loss in every epoch.
    pub(super) losses: Vec<f32>,
}

/// What the metadata of the bytes say.
#[derive(serde::Serialize, serde::Deserialize)]
struct About {
    version: u32,
    /// What the training is of; see [`Checkpoint::to_bytes`].
    fingerprint: String,
    spec: FitSpec,
    epoch: u32,
    steps: u64,
}

impl Checkpoint {
    /// Before the first epoch, for so many meshes.
    pub(super) fn begin(spec: &FitSpec, meshes: usize) -> Self {
        let network = untrained(spec, meshes);
        Self {
            epoch: 0,
            steps: 0,
            weights: Trained::new(network.weights()),
            codes: Trained::new(network.latent_codes),
            losses: Vec::new(),
        }
    }

    /// The network as it is, in the cube that training takes place in.
    pub(super) fn network(&self, spec: &FitSpec, meshes: usize) -> Network {
        let mut network = untrained(spec, meshes);
        network.set_weights(&self.weights.values);
        network.latent_codes.copy_from_slice(&self.codes.values);
        network
    }

    fn lists(&self) -> [&Vec<f32>; 7] {
        let (w, c) = (&self.weights, &self.codes);
        [&w.values, &w.means, &w.squares, &c.values, &c.means, &c.squares, &self.losses]
    }

    /// The state as safetensors. `fingerprint` tells what the training is of, the hashes of its meshes in order.
    pub fn to_bytes(&self, spec: &FitSpec, fingerprint: &str) -> Vec<u8> {
        let about = About {
            version: VERSION,
            fingerprint: fingerprint.to_owned(),
            spec: *spec,
            epoch: self.epoch,
            steps: self.steps,
        };
        let about = serde_json::to_string(&about).expect("plain members");
        let data = self.lists().map(|list| list.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>());
        let views = TENSORS.iter().zip(&data).map(|(name, data)| {
            (*name, TensorView::new(Dtype::F32, vec![data.len() / 4], data).expect("four bytes per number"))
        });
        let metadata = HashMap::from([("checkpoint".to_owned(), about)]);
        safetensors::serialize(views, Some(metadata)).expect("a header far under the format's limit")
    }

    /// Reads a state back, if it is one of this training: the same `spec`, as many meshes, and the same `fingerprint`.
    pub fn from_bytes(bytes: &[u8], spec: &FitSpec, meshes: usize, fingerprint: &str) -> Option<Self> {
        let (_, header) = SafeTensors::read_metadata(bytes).ok()?;
        let about: About = serde_json::from_str(header.metadata().as_ref()?.get("checkpoint")?).ok()?;
        if (about.version, about.fingerprint.as_str(), about.spec) != (VERSION, fingerprint, *spec) {
            return None;
        }
        let tensors = SafeTensors::deserialize(bytes).ok()?;
        let list = |name: &str| -> Option<Vec<f32>> {
            let tensor = tensors.tensor(name).ok()?;
            let numbers = || tensor.data().as_chunks().0.iter().map(|b| f32::from_le_bytes(*b));
            (tensor.dtype() == Dtype::F32 && numbers().all(f32::is_finite)).then(|| numbers().collect())
        };
        let trained = |names: &[&str]| -> Option<Trained> {
            Some(Trained { values: list(names[0])?, means: list(names[1])?, squares: list(names[2])? })
        };
        let (weights, codes) = (trained(&TENSORS[..3])?, trained(&TENSORS[3..6])?);
        let losses = list(TENSORS[6])?;
        let read = Self { epoch: about.epoch, steps: about.steps, weights, codes, losses };
        let fresh = Self::begin(spec, meshes);
        let fits = read.lists()[..6].iter().zip(&fresh.lists()[..6]).all(|(a, b)| a.len() == b.len());
        (fits && read.epoch <= spec.epochs && read.losses.len() == read.epoch as usize).then_some(read)
    }
}
