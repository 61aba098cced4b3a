//! Meshes to networks: training of small neural signed distance fields.
//!
//! [`fit`] makes of one mesh a SIREN (Sitzmann et al. 2020, "Implicit neural representations with periodic activation functions"), of
//! several an auto-decoder with a latent code each (Park et al. 2019, "DeepSDF"). It minimizes |f - d| over points of which most are
//! near the surface, d the exact signed distance, and on request (grad f - grad d)^2 and (|grad f| - 1)^2, by Adam with a
//! learning rate that falls along a cosine.
//!
//! All shapes are brought to the cube of half extent 1 about their common center by one scale, and what was learned is brought back
//! by the weights: the network answers in scene units. The same meshes and [`FitSpec`] give the same bits for any number of threads,
//! also where training went on from a [`Checkpoint`].

mod adam;
pub mod checkpoint;
pub mod report;
mod samples;
pub mod spec;

pub use checkpoint::Checkpoint;
pub use report::{FitReport, ShapeReport};
pub use spec::{FitSpec, Sampling};

use crate::field::mesh::MeshField;
use crate::field::network::adjoint::{Asked, Prepared, Sums};
use crate::field::network::{Activation, Layer, Network, Skip};
use crate::field::{Domain, Field, Points};
use crate::measure::sampling::Splitmix;
use crate::settings::{Canceled, Progress, Settings};
use adam::Adam;
use glam::DVec3;
use rayon::prelude::*;
use samples::Samples;

/// Points that are worked on by one thread at a time, all of one shape; sums over a batch are made in their order.
pub const CHUNK: usize = 384;
/// Share of the progress that is told while training; the rest is measuring.
const TRAINED_SHARE: f32 = 0.95;
/// Share of all steps over which the learning rate rises to what was asked for.
const WARM_UP: f64 = 0.02;
/// The latent penalty reaches its weight over this share of the epochs, as in DeepSDF's code.
const PENALTY_RISE: f64 = 0.1;

/// Why no network was made.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum FitError {
    /// The token was raised.
    #[error("canceled")]
    Canceled,
    /// The loss is not a number any more.
    #[error("training diverged in epoch {epoch}: the loss is not finite any more; a lower learning_rate may help")]
    Diverged {
        /// The epoch, from 1.
        epoch: u32,
    },
}

impl From<Canceled> for FitError {
    fn from(_: Canceled) -> Self {
        Self::Canceled
    }
}

/// A network that was trained.
#[derive(Clone, Debug)]
pub struct Fitted {
    /// The network, in scene units, with a latent code per mesh where there are several.
    pub network: Network,
    /// How well it does.
    pub report: FitReport,
}

/// What training is told beside its meshes.
pub struct Training<'a> {
    /// What is trained, and how.
    pub spec: &'a FitSpec,
    /// Where to go on, if it began before. Must have been made for the same meshes and the same `spec`.
    pub from: Option<Checkpoint>,
    /// Called after every epoch with its state.
    pub checkpoint: &'a dyn Fn(&Checkpoint),
}

/// Trains a network of the meshes' distances.
///
/// # Errors
/// When the token is raised, or when the loss is not finite any more.
///
/// # Panics
/// When there is no mesh.
pub fn fit(meshes: &[MeshField], training: Training<'_>, settings: &Settings<'_>) -> Result<Fitted, FitError> {
    assert!(!meshes.is_empty(), "there is a mesh to fit to");
    let spec = training.spec;
    let place = Place::of(meshes);
    let told = |progress: Progress| (settings.progress)(Progress { stage: "sample", ..progress });
    let quiet = Settings { progress: &told, ..*settings };
    told(Progress::default());
    let samples = meshes.iter().enumerate().map(|(i, mesh)| Samples::of(mesh, place, spec, i, &quiet));
    let samples: Vec<Samples> = samples.collect::<Result<_, _>>()?;
    let mut state = training.from.unwrap_or_else(|| Checkpoint::begin(spec, meshes.len()));
    let mut trainer = Trainer::new(spec, &samples, &state);
    while state.epoch < spec.epochs {
        let loss = trainer.epoch(&mut state, settings)?;
        if !loss.is_finite() {
            return Err(FitError::Diverged { epoch: state.epoch });
        }
        state.losses.push(loss as f32);
        (training.checkpoint)(&state);
    }
    let mut network = state.network(spec, meshes.len());
    place.bring_back(&mut network);
    network.domain = place.domain;
    let report = report::measure(&network, meshes, spec, &state.losses, settings)?;
    Ok(Fitted { network, report })
}

/// Where the shapes lie: training takes place in the cube of half extent 1.
#[derive(Clone, Copy, Debug)]
struct Place {
    center: DVec3,
    scale: f64,
    domain: Domain,
}

impl Place {
    fn of(meshes: &[MeshField]) -> Self {
        let domains = meshes.iter().map(MeshField::domain);
        let (mut low, mut high) = (DVec3::INFINITY, DVec3::NEG_INFINITY);
        for domain in domains {
            (low, high) = (low.min(DVec3::from(domain.min)), high.max(DVec3::from(domain.max)));
        }
        let scale = 0.5 * (high - low).max_element();
        Self { center: 0.5 * (low + high), scale, domain: Domain { min: low.to_array(), max: high.to_array() } }
    }

    /// Makes a network that was trained in the cube answer in scene units: f(p) = scale g((p - center) / scale).
    fn bring_back(self, network: &mut Network) {
        let (latent, mut previous) = (network.latent_size, 0);
        for layer in &mut network.layers {
            let inputs = layer.inputs();
            if inputs == previous + latent + 3 {
                let scale = f64::from(layer.skip.map_or(1.0, |s| s.scale));
                for (row, bias) in layer.weights.chunks_exact_mut(inputs).zip(&mut layer.bias) {
                    let mut moved = f64::from(*bias);
                    for (w, c) in row[previous + latent..].iter_mut().zip(self.center.to_array()) {
                        let scaled = f64::from(*w) / self.scale;
                        *w = scaled as f32;
                        moved -= scale * scaled * c;
                    }
                    *bias = moved as f32;
                }
            }
            previous = layer.outputs();
        }
        if let Some(last) = network.layers.last_mut() {
            for number in last.weights.iter_mut().chain(&mut last.bias) {
                *number = (f64::from(*number) * self.scale) as f32;
            }
        }
    }
}

/// A network of the shape that is asked for, with random weights.
fn untrained(spec: &FitSpec, shapes: usize) -> Network {
    let mut random = Splitmix::new(spec.seed);
    let latent_size = spec.latent_size(shapes);
    let input = latent_size + 3;
    let skip_at = spec.skip_at(shapes);
    let activation = spec.activation(shapes);
    let mut layers = Vec::new();
    let mut previous = 0;
    for i in 0..=spec.layers as usize {
        let skip = (i > 0 && Some(i as u32) == skip_at).then_some(Skip { scale: 1.0 });
        let inputs = if i == 0 { input } else { previous + if skip.is_some() { input } else { 0 } };
        let outputs = if i == spec.layers as usize { 1 } else { spec.width as usize };
        let fan = inputs as f64;
        // SIREN's own section 3.2, and He et al. 2015 for what is zero on one side
        let reach = match activation {
            Activation::Sine { .. } if i == 0 => 1.0 / fan,
            Activation::Sine { w0 } => (6.0 / fan).sqrt() / f64::from(w0),
            _ => (6.0 / fan).sqrt(),
        };
        let mut number = |reach: f64| ((2.0 * random.unit() - 1.0) * reach) as f32;
        let weights = (0..inputs * outputs).map(|_| number(reach)).collect();
        let bias = (0..outputs).map(|_| number(1.0 / fan.sqrt())).collect();
        let last = i == spec.layers as usize;
        let activation = if last { Activation::Identity } else { activation };
        layers.push(Layer { weights, bias, norm: None, activation, skip });
        previous = outputs;
    }
    // codes begin near zero, of length about .1 (DeepSDF's code: 1 / sqrt(size), which is far from where they end)
    let rows = if latent_size == 0 { 0 } else { shapes };
    let reach = 0.1 / (latent_size.max(1) as f64).sqrt();
    let latent_codes =
        (0..rows * latent_size).map(|_| ((2.0 * random.unit() - 1.0) * 3f64.sqrt() * reach) as f32).collect();
    Network { latent_size, latent_codes, ..Network::of_layers(layers) }
}

/// What one thread works with: points of one shape, and the sums over them.
struct Slot {
    sums: Sums,
    points: [Vec<f32>; 3],
    normals: [Vec<f32>; 3],
    distances: Vec<f32>,
    shape: usize,
    loss: f64,
}

struct Trainer<'a> {
    spec: &'a FitSpec,
    samples: &'a [Samples],
    network: Network,
    slots: Vec<Slot>,
    weights: Vec<f32>,
    codes: Vec<f32>,
}

impl<'a> Trainer<'a> {
    fn new(spec: &'a FitSpec, samples: &'a [Samples], state: &Checkpoint) -> Self {
        let network = state.network(spec, samples.len());
        let slots = (spec.batch as usize).div_ceil(CHUNK);
        let lists = || std::array::from_fn(|_| vec![0.0; CHUNK]);
        let slot = |_| Slot {
            sums: Sums::new(&network),
            points: lists(),
            normals: lists(),
            distances: vec![0.0; CHUNK],
            shape: 0,
            loss: 0.0,
        };
        let slots = (0..slots).map(slot).collect();
        let (weights, codes) = (vec![0.0; network.parameters()], vec![0.0; network.latent_codes.len()]);
        Self { spec, samples, network, slots, weights, codes }
    }

    /// One pass over all samples; gives the mean of the loss.
    fn epoch(&mut self, state: &mut Checkpoint, settings: &Settings<'_>) -> Result<f64, Canceled> {
        let spec = self.spec;
        // a generator of its own for every epoch: a state holds nothing of it
        let mut random = Splitmix::new(spec.seed ^ (u64::from(state.epoch) + 1).wrapping_mul(0x9e37_79b9_7f4a_7c15));
        let mut orders: Vec<Vec<u32>> = self.samples.iter().map(|s| (0..s.len() as u32).collect()).collect();
        orders.iter_mut().for_each(|order| shuffle(order, &mut random));
        // what is left over of a shape when its samples are cut into chunks sits this epoch out
        let chunks = orders.iter().enumerate().flat_map(|(shape, o)| (0..o.len() / CHUNK).map(move |k| (shape, k)));
        let mut chunks: Vec<(usize, usize)> = chunks.collect();
        shuffle(&mut chunks, &mut random);
        let batches = chunks.len().div_ceil(self.slots.len());
        let (mut loss, epochs) = (0.0, f64::from(spec.epochs));
        for (i, batch) in chunks.chunks(self.slots.len()).enumerate() {
            settings.cancel.check()?;
            let done = (f64::from(state.epoch) + i as f64 / batches as f64) / epochs;
            for (slot, &(shape, k)) in self.slots.iter_mut().zip(batch) {
                slot.shape = shape;
                slot.take(&self.samples[shape], &orders[shape][k * CHUNK..][..CHUNK]);
            }
            loss += self.step(batch.len(), done, state, settings) * batch.len() as f64 / chunks.len() as f64;
            (settings.progress)(Progress {
                stage: "train",
                iteration: state.epoch,
                iterations: spec.epochs,
                fraction: TRAINED_SHARE * done as f32,
                energy: Some(loss * chunks.len() as f64 / ((i + 1) * self.slots.len()).min(chunks.len()) as f64),
                ..Progress::default()
            });
        }
        state.epoch += 1;
        Ok(loss)
    }

    /// One step of Adam over the first slots, `done` of the way; gives the mean of the loss.
    fn step(&mut self, slots: usize, done: f64, state: &mut Checkpoint, settings: &Settings<'_>) -> f64 {
        let (spec, network, slots) = (self.spec, &self.network, &mut self.slots[..slots]);
        let prepared = Prepared::new(network);
        let count = slots.len() * CHUNK;
        let codes = network.latent_codes.chunks_exact(network.latent_size.max(1));
        let codes: Vec<&[f32]> = codes.collect();
        let code_of = |shape: usize| codes.get(shape).copied().unwrap_or_default();
        settings.pool.install(|| {
            slots.par_iter_mut().for_each(|slot| slot.sum(&prepared, code_of(slot.shape), spec, count));
        });
        self.weights.fill(0.0);
        self.codes.fill(0.0);
        let penalty = spec.latent_penalty * (done / PENALTY_RISE).min(1.0);
        let mut loss = 0.0;
        for slot in &*slots {
            loss += slot.loss;
            if network.latent_size > 0 {
                let code = code_of(slot.shape);
                let to = &mut self.codes[slot.shape * code.len()..][..code.len()];
                slot.sums.add_code_to(network, code, &mut self.weights, to);
                let share = penalty / slots.len() as f64;
                to.iter_mut().zip(code).for_each(|(to, z)| *to += (2.0 * share) as f32 * z);
                loss += share * code.iter().map(|&z| f64::from(z) * f64::from(z)).sum::<f64>();
            }
        }
        if let Some((first, others)) = slots.split_first_mut() {
            others.iter().for_each(|slot| first.sums.merge(&slot.sums));
            first.sums.add_to(network, &mut self.weights);
        }
        let rise = (done / WARM_UP).min(1.0);
        let rate = spec.learning_rate * rise * 0.5 * (1.0 + (std::f64::consts::PI * done).cos());
        state.steps += 1;
        let adam = Adam::new(rate, state.steps);
        adam.step(&mut state.weights, &self.weights);
        adam.step(&mut state.codes, &self.codes);
        self.network.set_weights(&state.weights.values);
        self.network.latent_codes.copy_from_slice(&state.codes.values);
        loss
    }
}

impl Slot {
    /// Takes these samples up.
    fn take(&mut self, samples: &Samples, these: &[u32]) {
        for (to, &i) in these.iter().enumerate() {
            let i = i as usize;
            self.distances[to] = samples.distances[i];
            for axis in 0..3 {
                self.points[axis][to] = samples.points[axis][i];
                self.normals[axis][to] = samples.gradients[axis][i];
            }
        }
    }

    /// Sums the loss's derivatives, each point's share of `count`.
    fn sum(&mut self, prepared: &Prepared<'_>, code: &[f32], spec: &FitSpec, count: usize) {
        let Self { sums, points: [x, y, z], normals, distances, loss, .. } = self;
        sums.clear();
        *loss = 0.0;
        let share = 1.0 / count as f32;
        let (normal, eikonal) = (spec.normal as f32, spec.eikonal as f32);
        let gradients = normal > 0.0 || eikonal > 0.0;
        prepared.sum(code, Points { x, y, z }, gradients, sums, |these, asked: &mut Asked| {
            let mut sum = 0.0f64;
            for (k, i) in these.enumerate() {
                let off = asked.values[k] - distances[i];
                sum += f64::from(off.abs());
                asked.by_value[k] = if off == 0.0 { 0.0 } else { share.copysign(off) };
                if gradients {
                    let g: [f32; 3] = std::array::from_fn(|a| asked.gradients[a][k]);
                    let length = (g[0] * g[0] + g[1] * g[1] + g[2] * g[2]).sqrt().max(1e-6);
                    let (turned, stretched) = (2.0 * normal * share, 2.0 * eikonal * share * (1.0 - 1.0 / length));
                    for a in 0..3 {
                        let miss = g[a] - normals[a][i];
                        sum += f64::from(normal * miss * miss);
                        asked.by_gradient[a][k] = turned * miss + stretched * g[a];
                    }
                    sum += f64::from(eikonal * (length - 1.0) * (length - 1.0));
                }
            }
            *loss += sum * f64::from(share);
        });
    }
}

/// Fisher and Yates' shuffle.
fn shuffle<T>(list: &mut [T], random: &mut Splitmix) {
    for i in (1..list.len()).rev() {
        list.swap(i, (random.unit() * (i + 1) as f64) as usize);
    }
}

#[cfg(test)]
mod tests;
