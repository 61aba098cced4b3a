//! What is trained, and how.

use crate::field::Fault;
use crate::field::network::{Activation, MAX_LATENT, MAX_LAYERS};
use serde::{Deserialize, Serialize};
use std::ops::RangeInclusive;

/// Meshes that one network is fitted to, at most.
pub const MAX_MESHES: usize = 1024;
/// Side of the grid of [`Sampling::Grid`]: the paper's.
pub const GRID: usize = 32;

/// Where a mesh's distance is learned from.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum Sampling {
    /// Points on the surface, near it, and all over the domain.
    #[default]
    Points,
    /// The nodes of a grid of 32 x 32 x 32 over the domain, as in the paper.
    Grid,
}

/// How a network is fitted to meshes.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(default, deny_unknown_fields)]
pub struct FitSpec {
    /// Hidden layers, from 1 to 16.
    pub layers: u32,
    /// Outputs of a hidden layer, from 8 to 1,024.
    pub width: u32,
    /// Activation of the hidden layers: `{"sine": {"w0": 30}}` for one mesh and `"relu"` for several when nothing is said.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub activation: Option<Activation>,
    /// Entries of the latent code that each of several meshes gets, from 1 to 4,096.
    pub latent_size: u32,
    /// Passes over the samples, from 1 to 100,000.
    pub epochs: u32,
    /// Samples of every mesh, from 1,024 to 4,194,304.
    pub samples: u32,
    /// Where the samples lie.
    pub sampling: Sampling,
    /// Whether every mesh is first brought to the cube of half extent 1 about its own center. The network then answers in that
    /// cube's units, and the report says how to come back.
    pub normalize: bool,
    /// Samples of a step, from 384 to 262,144; the next multiple of 384 is taken.
    pub batch: u32,
    /// Learning rate at its highest, up to 1.
    pub learning_rate: f64,
    /// Weight of (grad f - grad d)^2 beside the distance's error; 0 for none.
    pub normal: f64,
    /// Weight of (|grad f| - 1)^2; 0 for none.
    pub eikonal: f64,
    /// Weight of |z|^2, the squared length of the latent codes.
    pub latent_penalty: f64,
    /// Seed of all that is random.
    pub seed: u64,
}

impl Default for FitSpec {
    fn default() -> Self {
        Self {
            layers: 4,
            width: 128,
            activation: None,
            latent_size: 32,
            epochs: 25,
            samples: 200_000,
            sampling: Sampling::Points,
            normalize: false,
            batch: 6144,
            learning_rate: 1e-3,
            normal: 0.0,
            eikonal: 0.0,
            latent_penalty: 1e-4,
            seed: 0,
        }
    }
}

impl FitSpec {
    /// What is out of range, by member.
    pub fn faults(&self) -> Vec<Fault> {
        let mut faults = Vec::new();
        let mut fault = |member: &str, detail: String| {
            faults.push(Fault { pointer: format!("/{member}"), code: "out_of_range", detail });
        };
        let counts: [(&str, u32, RangeInclusive<u32>); 6] = [
            ("layers", self.layers, 1..=(MAX_LAYERS as u32 / 4)),
            ("width", self.width, 8..=1024),
            ("latent_size", self.latent_size, 1..=MAX_LATENT as u32),
            ("epochs", self.epochs, 1..=100_000),
            ("samples", self.samples, 1024..=1 << 22),
            ("batch", self.batch, super::CHUNK as u32..=1 << 18),
        ];
        for (member, number, range) in counts {
            if !range.contains(&number) {
                fault(member, format!("{number} is not in {} to {}", range.start(), range.end()));
            }
        }
        if !(self.learning_rate > 0.0 && self.learning_rate <= 1.0) {
            fault("learning_rate", format!("{} is not above 0 and at most 1", self.learning_rate));
        }
        let weights = [("normal", self.normal), ("eikonal", self.eikonal), ("latent_penalty", self.latent_penalty)];
        for (member, weight) in weights {
            if !(0.0..=1e3).contains(&weight) {
                fault(member, format!("{weight} is not in 0 to 1000"));
            }
        }
        if self.activation.is_some_and(|a| !a.is_valid()) {
            fault("activation", "the parameter of the activation is not above 0 and at most 10,000".to_owned());
        }
        faults
    }

    /// Activation of the hidden layers for so many meshes.
    pub fn activation(&self, meshes: usize) -> Activation {
        let usual = if meshes == 1 { Activation::Sine { w0: 30.0 } } else { Activation::Relu };
        self.activation.unwrap_or(usual)
    }

    /// Entries of a latent code for so many meshes; 0 for one.
    pub fn latent_size(&self, meshes: usize) -> usize {
        if meshes == 1 { 0 } else { self.latent_size as usize }
    }

    /// The layer that the network's input is joined to: the middle one, of networks with codes and some depth.
    pub fn skip_at(&self, meshes: usize) -> Option<u32> {
        (meshes > 1 && self.layers >= 4).then_some(self.layers / 2)
    }
}
