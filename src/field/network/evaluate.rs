//! Values and gradients of a network in blocks of points.
//!
//! Layer by layer, a block's outputs are the product of the weights with the block's inputs; derivatives of the activations
//! are kept on the way, and one pass back through the transposed weights gives the gradient of the value with respect to
//! the point (reverse mode: for one output it costs about one more forward pass, where three tangents would cost three).
//! Activations are taken of every piece of a product as soon as it is there, while it is in the nearest cache.
//!
//! Points come in tiles of [`TILE`], the last of which is filled up with copies of the last point. No number of a point depends
//! on the others in its tile, so a point gets the same bits in every batch.

use super::product::{Panels, Start, TILE, multiply, padded};
use super::{Activation, Encoding, Network};
use crate::field::{Domain, Field, Gradients, Metric, Points};
use std::cell::RefCell;

/// Tiles worked on together: a panel of weights is used for all of them while it is in the nearest cache.
const TILES: usize = 4;
/// A value that is not a number or too large stands for "far outside": finite, and not near any zero.
const FAR: f32 = 1e30;

thread_local! {
    static SCRATCH: RefCell<Vec<f32>> = const { RefCell::new(Vec::new()) };
}

/// A layer with the latent code folded into its bias.
struct Prepared {
    /// Outputs with their padding.
    outputs: usize,
    /// One row per output, one column per output of the layer before, ...
    from_previous: Panels,
    /// ... and one per number of the encoded point, none where the layer does not see it.
    from_point: Panels,
    /// The transposes of both.
    to_previous: Panels,
    to_point: Panels,
    bias: Vec<f32>,
    activation: Activation,
}

/// A network with a latent code, as a [`Field`].
pub struct NetworkField {
    layers: Vec<Prepared>,
    encoding: Encoding,
    /// Outputs of all layers together, and of the widest, with their padding.
    units: usize,
    widest: usize,
    domain: Domain,
    metric: Metric,
    lipschitz: Option<f32>,
}

impl NetworkField {
    /// Folds `latent` (of the network's latent size) into the biases. The network was checked.
    pub(super) fn new(network: &Network, latent: &[f32]) -> Self {
        let point = network.encoding.size();
        let mut previous = 0;
        let layers: Vec<Prepared> = network
            .layers
            .iter()
            .enumerate()
            .map(|(i, layer)| {
                let (inputs, outputs) = (layer.inputs(), layer.outputs());
                let seen = if i == 0 || layer.skip.is_some() { point } else { 0 };
                let scale = layer.skip.map_or(1.0, |s| s.scale);
                let mut bias = layer.bias.clone();
                if seen > 0 {
                    for (row, bias) in layer.weights.chunks_exact(inputs).zip(&mut bias) {
                        let weights = row[previous..].iter().zip(latent);
                        let constant: f64 = weights.map(|(w, z)| f64::from(w * scale) * f64::from(*z)).sum();
                        *bias = (f64::from(*bias) + constant) as f32;
                    }
                }
                bias.resize(padded(outputs), 0.0);
                let weight = |row: usize, column: usize| scale * layer.weights[row * inputs + column];
                let of_point = |row: usize, column: usize| weight(row, previous + latent.len() + column);
                let prepared = Prepared {
                    outputs: padded(outputs),
                    from_previous: Panels::new(outputs, previous, weight),
                    from_point: Panels::new(outputs, seen, of_point),
                    to_previous: Panels::new(previous, if i == 0 { 0 } else { outputs }, |i, j| weight(j, i)),
                    to_point: Panels::new(point, if seen > 0 { outputs } else { 0 }, |i, j| of_point(j, i)),
                    bias,
                    activation: layer.activation,
                };
                previous = outputs;
                prepared
            })
            .collect();
        Self {
            units: layers.iter().map(|l| l.outputs).sum(),
            widest: layers.iter().map(|l| l.outputs).max().unwrap_or(0),
            layers,
            encoding: network.encoding,
            domain: network.domain,
            metric: network.metric,
            lipschitz: network.lipschitz,
        }
    }

    /// Numbers of scratch for a tile: the encoded points and their adjoint, all outputs and all derivatives, and two
    /// adjoints of the widest layer.
    fn scratch_size(&self) -> usize {
        TILE * (2 * padded(self.encoding.size()) + 2 * self.units + 2 * self.widest)
    }

    fn run(&self, points: Points<'_>, values: &mut [f32], mut gradients: Option<Gradients<'_>>) {
        let point = TILE * padded(self.encoding.size());
        SCRATCH.with_borrow_mut(|scratch| {
            let size = TILES * self.scratch_size();
            if scratch.len() < size {
                scratch.resize(size, 0.0);
            }
            let n = points.len();
            for start in (0..n).step_by(TILES * TILE) {
                let count = (TILES * TILE).min(n - start);
                let tiles = count.div_ceil(TILE);
                let (encoded, rest) = scratch.split_at_mut(tiles * point);
                let (outputs, rest) = rest.split_at_mut(tiles * TILE * self.units);
                let (derivatives, rest) = rest.split_at_mut(tiles * TILE * self.units);
                let places = |tile: usize| start + tile * TILE..(start + (tile + 1) * TILE).min(n);
                for (tile, encoded) in encoded.chunks_exact_mut(point).enumerate() {
                    for (from, row) in [points.x, points.y, points.z].into_iter().zip(encoded.chunks_exact_mut(TILE)) {
                        let from = &from[places(tile)];
                        row[..from.len()].copy_from_slice(from);
                        row[from.len()..].fill(from[from.len() - 1]);
                    }
                    encode(self.encoding, encoded);
                }
                self.forward(tiles, encoded, outputs, gradients.is_some().then_some(&mut *derivatives));
                let last = &outputs[tiles * TILE * (self.units - padded(1))..];
                for (tile, value) in last.chunks_exact(TILE * padded(1)).enumerate() {
                    for (to, &from) in values[places(tile)].iter_mut().zip(value) {
                        *to = if from.abs() <= FAR { from } else { FAR };
                    }
                }
                let Some(gradients) = gradients.as_mut() else { continue };
                let (adjoint, rest) = rest.split_at_mut(tiles * point);
                let (here, rest) = rest.split_at_mut(tiles * TILE * self.widest);
                self.backward(tiles, derivatives, adjoint, here, &mut rest[..tiles * TILE * self.widest]);
                for (tile, adjoint) in adjoint.chunks_exact_mut(point).enumerate() {
                    decode(self.encoding, &encoded[tile * point..], adjoint);
                    let columns = [&mut *gradients.x, &mut *gradients.y, &mut *gradients.z];
                    for (to, row) in columns.into_iter().zip(adjoint.chunks_exact(TILE)) {
                        for (to, &from) in to[places(tile)].iter_mut().zip(row) {
                            *to = if from.abs() <= FAR { from } else { 0.0 };
                        }
                    }
                }
            }
        });
    }

    /// Fills the outputs of every layer, and the derivatives of their activations where asked for.
    fn forward(&self, tiles: usize, encoded: &[f32], outputs: &mut [f32], mut derivatives: Option<&mut [f32]>) {
        let (mut at, mut previous) = (0, 0);
        for layer in &self.layers {
            let (before, rest) = outputs.split_at_mut(at);
            let size = tiles * TILE * layer.outputs;
            let mut slopes = derivatives.as_deref_mut().map(|all| &mut all[at..at + size]);
            let activate = |place: usize, piece: &mut [f32]| match slopes.as_deref_mut() {
                None => layer.activation.apply(piece),
                Some(slopes) => layer.activation.apply_with_derivative(piece, &mut slopes[place..place + piece.len()]),
            };
            let parts = [(&layer.from_previous, &before[at - previous..]), (&layer.from_point, encoded)];
            multiply(given(&parts), tiles, Start::Bias(&layer.bias), &mut rest[..size], activate);
            (at, previous) = (at + size, size);
        }
    }

    /// Carries the derivative of the value back to the encoded point, into `adjoint`.
    fn backward<'s>(
        &self,
        tiles: usize,
        derivatives: &[f32],
        adjoint: &mut [f32],
        mut here: &'s mut [f32],
        mut before: &'s mut [f32],
    ) {
        adjoint.fill(0.0);
        let mut end = tiles * TILE * self.units;
        let last = tiles * TILE * padded(1);
        here[..last].copy_from_slice(&derivatives[end - last..]);
        for (i, layer) in self.layers.iter().enumerate().rev() {
            let size = tiles * TILE * layer.outputs;
            end -= size;
            if !layer.to_point.is_empty() {
                multiply(&[(&layer.to_point, &here[..size])], tiles, Start::There, adjoint, |_, _| {});
            }
            if i > 0 {
                let size_before = tiles * TILE * self.layers[i - 1].outputs;
                let slopes = &derivatives[end - size_before..end];
                let to = &mut before[..size_before];
                multiply(&[(&layer.to_previous, &here[..size])], tiles, Start::Zero, to, |place, piece| {
                    piece.iter_mut().zip(&slopes[place..]).for_each(|(g, slope)| *g *= slope);
                });
            }
            std::mem::swap(&mut here, &mut before);
        }
    }
}

/// The parts of a product that there are: the first layer has no layer before it, and few see the point.
fn given<'p, 'a>(parts: &'p [(&'a Panels, &'a [f32]); 2]) -> &'p [(&'a Panels, &'a [f32])] {
    match (parts[0].0.is_empty(), parts[1].0.is_empty()) {
        (true, _) => &parts[1..],
        (_, true) => &parts[..1],
        _ => parts,
    }
}

/// Fills the rows behind the three coordinates of a tile.
fn encode(encoding: Encoding, encoded: &mut [f32]) {
    let Encoding::Positional { frequencies, base } = encoding else { return };
    let (coordinates, rest) = encoded.split_at_mut(3 * TILE);
    let mut w = base;
    for octave in rest.chunks_exact_mut(6 * TILE).take(frequencies as usize) {
        let (sines, cosines) = octave.split_at_mut(3 * TILE);
        for ((s, c), &x) in sines.iter_mut().zip(cosines).zip(&*coordinates) {
            let (sine, cosine) = (w * f64::from(x)).sin_cos();
            (*s, *c) = (sine as f32, cosine as f32);
        }
        w *= 2.0;
    }
}

/// Adds the adjoints of the encoding's rows to those of the three coordinates.
fn decode(encoding: Encoding, encoded: &[f32], adjoint: &mut [f32]) {
    let Encoding::Positional { frequencies, base } = encoding else { return };
    let (coordinates, rest) = adjoint.split_at_mut(3 * TILE);
    let mut w = base;
    let octaves = encoded[3 * TILE..].chunks_exact(6 * TILE).zip(rest.chunks_exact(6 * TILE));
    for (values, adjoints) in octaves.take(frequencies as usize) {
        for (i, to) in coordinates.iter_mut().enumerate() {
            let (sine, cosine) = (values[i], values[3 * TILE + i]);
            *to += w as f32 * (cosine * adjoints[i] - sine * adjoints[3 * TILE + i]);
        }
        w *= 2.0;
    }
}

impl Field for NetworkField {
    fn domain(&self) -> Domain {
        self.domain
    }
    fn metric(&self) -> Metric {
        self.metric
    }
    fn lipschitz(&self) -> Option<f32> {
        self.lipschitz
    }
    fn values(&self, points: Points<'_>, values: &mut [f32]) {
        self.run(points, values, None);
    }
    fn gradients(&self, points: Points<'_>, values: &mut [f32], gradients: Gradients<'_>) {
        self.run(points, values, Some(gradients));
    }
}
