//! The passes through a network that evaluation and training are made of: forward, forward along a direction, and back.
//!
//! A block of points is a few tiles ([`TILE`]); the numbers of a layer for a block lie together, and those of all layers follow one
//! another in the order of the layers. Offsets into such a run of numbers tell a layer's.

use super::product::{Panels, Start, TILE, multiply, padded};
use super::{Activation, Encoding, LayerNorm, Network};
use crate::field::Points;
use std::ops::Range;

/// Tiles worked on together: a panel of weights is used for all of them while it is in the nearest cache.
pub(super) const TILES: usize = 4;

/// A layer's weights, packed, with the scale of a skip in them.
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
    norm: Option<LayerNorm>,
    activation: Activation,
}

/// A network's weights without any latent code.
pub(super) struct Packed {
    layers: Vec<Prepared>,
    encoding: Encoding,
    /// Outputs of all layers together, and of the widest, with their padding.
    units: usize,
    widest: usize,
    /// Numbers per point that norms keep for the way back.
    kept: usize,
}

/// What the way back needs of a pass forward.
pub(super) struct ForBack<'a> {
    /// Derivatives of the activations; they lie as the outputs do.
    pub slopes: &'a mut [f32],
    /// What norms keep ([`LayerNorm::forward`]), layer by layer and tile after tile: [`Packed::kept`] numbers per point.
    pub kept: &'a mut [f32],
}

/// What a pass back comes by, for one layer of a block.
pub(super) enum Adjoint<'a> {
    /// Where the layer has a norm: derivatives by what the norm gave, and what it kept.
    Normed(&'a [f32], &'a [f32]),
    /// Derivatives by the sums of weights times inputs, and bias.
    Sums(&'a [f32]),
}

/// One bias per layer, with its padding and with a latent code folded in.
pub(super) type Biases = Vec<Vec<f32>>;

impl Packed {
    /// Packs the weights of a network that was checked.
    pub fn new(network: &Network) -> Self {
        let point = network.encoding.size();
        let (mut previous, mut zeros) = (0, false);
        let layers: Vec<Prepared> = network
            .layers
            .iter()
            .enumerate()
            .map(|(i, layer)| {
                let (inputs, outputs) = (layer.inputs(), layer.outputs());
                let seen = if network.sees_input(i) { point } else { 0 };
                let scale = layer.skip.map_or(1.0, |s| s.scale);
                let weight = |row: usize, column: usize| scale * layer.weights[row * inputs + column];
                let of_point = |row: usize, column: usize| weight(row, previous + network.latent_size + column);
                // behind a norm, where an activation has no slope there still is one by its sums
                let no_slopes = layer.activation.has_zeros() && layer.norm.is_none();
                let prepared = Prepared {
                    outputs: padded(outputs),
                    from_previous: Panels::new(outputs, previous, weight).of_zeros(zeros),
                    from_point: Panels::new(outputs, seen, of_point),
                    to_previous: Panels::new(previous, if i == 0 { 0 } else { outputs }, |i, j| weight(j, i))
                        .of_zeros(no_slopes),
                    to_point: Panels::new(point, if seen > 0 { outputs } else { 0 }, |i, j| of_point(j, i))
                        .of_zeros(no_slopes),
                    norm: layer.norm.clone(),
                    activation: layer.activation,
                };
                (previous, zeros) = (outputs, layer.activation.has_zeros());
                prepared
            })
            .collect();
        Self {
            units: layers.iter().map(|l| l.outputs).sum(),
            widest: layers.iter().map(|l| l.outputs).max().unwrap_or(0),
            kept: layers.iter().filter_map(|l| Some(l.norm.as_ref()?.kept())).sum(),
            layers,
            encoding: network.encoding,
        }
    }

    /// The biases of `network`, whose weights these are, with `latent` (of its latent size) folded in.
    pub fn fold(network: &Network, latent: &[f32]) -> Biases {
        let mut previous = 0;
        let folded = network.layers.iter().enumerate().map(|(i, layer)| {
            let scale = layer.skip.map_or(1.0, |s| s.scale);
            let mut bias = layer.bias.clone();
            if network.sees_input(i) {
                for (row, bias) in layer.weights.chunks_exact(layer.inputs()).zip(&mut bias) {
                    let weights = row[previous..].iter().zip(latent);
                    let constant: f64 = weights.map(|(w, z)| f64::from(w * scale) * f64::from(*z)).sum();
                    *bias = (f64::from(*bias) + constant) as f32;
                }
            }
            previous = layer.outputs();
            bias.resize(padded(previous), 0.0);
            bias
        });
        folded.collect()
    }

    /// How a point becomes input.
    pub fn encoding(&self) -> Encoding {
        self.encoding
    }

    /// Outputs of all layers together, with their padding.
    pub fn units(&self) -> usize {
        self.units
    }

    /// Outputs of the widest layer, with its padding.
    pub fn widest(&self) -> usize {
        self.widest
    }

    /// Numbers per point that norms keep for the way back: none where no layer has one.
    pub fn kept(&self) -> usize {
        self.kept
    }

    /// Numbers of the encoded point, with their padding.
    pub fn point(&self) -> usize {
        padded(self.encoding.size())
    }

    /// Every layer's activation and outputs (with their padding), in order.
    pub fn layers(&self) -> impl Iterator<Item = (Activation, usize)> {
        self.layers.iter().map(|layer| (layer.activation, layer.outputs))
    }

    /// Fills the outputs of every layer, and what the way back needs where it is asked for.
    pub fn forward(
        &self,
        biases: &Biases,
        tiles: usize,
        encoded: &[f32],
        outputs: &mut [f32],
        mut back: Option<ForBack<'_>>,
    ) {
        let (mut at, mut previous, mut kept_at) = (0, 0, 0);
        for (layer, bias) in self.layers.iter().zip(biases) {
            let (before, rest) = outputs.split_at_mut(at);
            let size = tiles * TILE * layer.outputs;
            let here = &mut rest[..size];
            let (mut slopes, kept) = match &mut back {
                Some(back) => (Some(&mut back.slopes[at..at + size]), Some(&mut back.kept[kept_at..])),
                None => (None, None),
            };
            let mut activate = |place: usize, piece: &mut [f32]| match slopes.as_deref_mut() {
                None => layer.activation.apply(piece),
                Some(slopes) => layer.activation.apply_with_derivative(piece, &mut slopes[place..place + piece.len()]),
            };
            let parts = [(&layer.from_previous, &before[at - previous..]), (&layer.from_point, encoded)];
            match &layer.norm {
                None => multiply(given(&parts), tiles, Start::Bias(bias), here, activate),
                Some(norm) => {
                    multiply(given(&parts), tiles, Start::Bias(bias), here, |_, _| {});
                    let mut kept = kept.map(|kept| kept.chunks_exact_mut(TILE * norm.kept()));
                    for (i, tile) in here.chunks_exact_mut(TILE * layer.outputs).enumerate() {
                        norm.forward(tile, kept.as_mut().and_then(Iterator::next));
                        activate(i * TILE * layer.outputs, tile);
                    }
                    kept_at += tiles * TILE * norm.kept();
                }
            }
            (at, previous) = (at + size, size);
        }
    }

    /// Carries a direction forward: `tangents` are the derivatives of all layers' outputs along it, `inner` those of what their
    /// activations were taken of, where `encoded` has that of the encoded points, and `derivatives` those of the activations.
    /// Of networks without norms only.
    pub fn along(&self, tiles: usize, encoded: &[f32], derivatives: &[f32], inner: &mut [f32], tangents: &mut [f32]) {
        let (mut at, mut previous) = (0, 0);
        for layer in &self.layers {
            let (before, rest) = tangents.split_at_mut(at);
            let size = tiles * TILE * layer.outputs;
            let (here, slopes, inner) = (&mut rest[..size], &derivatives[at..at + size], &mut inner[at..at + size]);
            let parts = [(&layer.from_previous, &before[at - previous..]), (&layer.from_point, encoded)];
            multiply(given(&parts), tiles, Start::Zero, here, |place, piece| {
                inner[place..place + piece.len()].copy_from_slice(piece);
                piece.iter_mut().zip(&slopes[place..]).for_each(|(t, slope)| *t *= slope);
            });
            (at, previous) = (at + size, size);
        }
    }

    /// Carries derivatives back. `here` begins with those by what the last layer's activation was taken of, and `before` is as long; `finish`
    /// is shown every piece of the derivatives by a layer's outputs, with its offset among all layers' numbers, and makes of it those by
    /// what its activation was taken of; `each` is shown the latter, layer by layer, and before them those by what a norm gave. `kept` is
    /// what norms kept on the way forward. Derivatives by the encoded points are added to `adjoint`.
    pub fn backward(
        &self,
        tiles: usize,
        kept: &[f32],
        mut adjoint: Option<&mut [f32]>,
        [mut here, mut before]: [&mut [f32]; 2],
        mut finish: impl FnMut(usize, &mut [f32]),
        mut each: impl FnMut(usize, Adjoint<'_>),
    ) {
        let (mut end, mut kept_end) = (tiles * TILE * self.units, tiles * TILE * self.kept);
        for (i, layer) in self.layers.iter().enumerate().rev() {
            let size = tiles * TILE * layer.outputs;
            end -= size;
            if let Some(norm) = &layer.norm {
                let rows = TILE * norm.kept();
                let kept = &kept[kept_end - tiles * rows..kept_end];
                kept_end -= tiles * rows;
                each(i, Adjoint::Normed(&here[..size], kept));
                for (tile, kept) in here[..size].chunks_exact_mut(TILE * layer.outputs).zip(kept.chunks_exact(rows)) {
                    norm.backward(tile, kept);
                }
            }
            each(i, Adjoint::Sums(&here[..size]));
            if let Some(adjoint) = adjoint.as_deref_mut()
                && !layer.to_point.is_empty()
            {
                multiply(&[(&layer.to_point, &here[..size])], tiles, Start::There, adjoint, |_, _| {});
            }
            if i > 0 {
                let size_before = tiles * TILE * self.layers[i - 1].outputs;
                let start = end - size_before;
                let to = &mut before[..size_before];
                multiply(&[(&layer.to_previous, &here[..size])], tiles, Start::Zero, to, |place, piece| {
                    finish(start + place, piece);
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

/// Puts the coordinates of these points into a tile, and copies of the last one into what is left of it.
pub(super) fn place(points: Points<'_>, these: Range<usize>, encoded: &mut [f32]) {
    for (from, row) in [points.x, points.y, points.z].into_iter().zip(encoded.chunks_exact_mut(TILE)) {
        let from = &from[these.clone()];
        row[..from.len()].copy_from_slice(from);
        row[from.len()..].fill(from[from.len() - 1]);
    }
}

/// Fills the rows behind the three coordinates of a tile.
pub(super) fn encode(encoding: Encoding, encoded: &mut [f32]) {
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
pub(super) fn decode(encoding: Encoding, encoded: &[f32], adjoint: &mut [f32]) {
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

/// Fills the rows behind the three components of directions, with the encoding's derivatives along them.
pub(super) fn encode_along(encoding: Encoding, encoded: &[f32], along: &mut [f32]) {
    let Encoding::Positional { frequencies, base } = encoding else { return };
    let (directions, rest) = along.split_at_mut(3 * TILE);
    let mut w = base;
    let octaves = encoded[3 * TILE..].chunks_exact(6 * TILE).zip(rest.chunks_exact_mut(6 * TILE));
    for (values, along) in octaves.take(frequencies as usize) {
        for (i, direction) in directions.iter().enumerate() {
            along[i] = w as f32 * values[3 * TILE + i] * direction;
            along[3 * TILE + i] = -(w as f32) * values[i] * direction;
        }
        w *= 2.0;
    }
}
