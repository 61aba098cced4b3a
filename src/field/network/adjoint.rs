//! Derivatives by weights and latent codes: what training and sensitivities are made of.
//!
//! For every point somebody says what a loss changes by with the network's value there and, where asked for, with its gradient; the
//! [`Sums`] gather the loss's derivatives by all weights. Gradients take no second derivatives by the point: b . grad f is the
//! derivative of f along b, so one pass forward along b, and the pass back through it, are all there is to it. Layer norms have no
//! such pass: a loss of gradients is what training has, and no network that is trained here has a norm.

use super::Network;
use super::passes::{Adjoint, Biases, ForBack, Packed, TILES, decode, encode, encode_along, place};
use super::product::{Panels, Start, TILE, multiply, outer, outer_place, outer_scratch, outer_size, padded};
use crate::field::Points;
use std::ops::Range;

/// Points worked on together.
pub const BLOCK: usize = TILES * TILE;

/// What a block of points is asked: values and gradients of the network in, derivatives of the loss by them out.
pub struct Asked {
    /// The network's values.
    pub values: [f32; BLOCK],
    /// Its gradients, where they were asked for, one row per component.
    pub gradients: [[f32; BLOCK]; 3],
    /// Derivatives of the loss by the values.
    pub by_value: [f32; BLOCK],
    /// Derivatives of the loss by the gradients; read where gradients were asked for.
    pub by_gradient: [[f32; BLOCK]; 3],
}

/// A network ready for its derivatives.
pub struct Prepared<'n> {
    network: &'n Network,
    packed: Packed,
}

/// Derivatives by the weights of a network, summed over points, for one latent code; and the scratch that summing takes.
pub struct Sums {
    layers: Vec<LayerSums>,
    asked: Box<Asked>,
    scratch: Vec<f32>,
}

struct LayerSums {
    /// By the weights of the layer before and of the encoded point, as `outer` keeps them.
    previous: Vec<f32>,
    point: Vec<f32>,
    bias: Vec<f32>,
    /// By the scales and shifts of its norm, none where it has none.
    scale: Vec<f32>,
    shift: Vec<f32>,
}

impl LayerSums {
    fn lists(&self) -> [&Vec<f32>; 5] {
        [&self.previous, &self.point, &self.bias, &self.scale, &self.shift]
    }

    fn lists_mut(&mut self) -> [&mut Vec<f32>; 5] {
        [&mut self.previous, &mut self.point, &mut self.bias, &mut self.scale, &mut self.shift]
    }

    /// Adds the derivatives by scale and shift of a tile: `adjoint` are those by what the norm gave, `kept` what it kept.
    fn add_norm(&mut self, adjoint: &[f32], kept: &[f32]) {
        let sums = self.scale.iter_mut().zip(&mut self.shift);
        for ((scale, shift), (row, normed)) in sums.zip(adjoint.chunks_exact(TILE).zip(kept.chunks_exact(TILE))) {
            *scale += row.iter().zip(normed).map(|(g, n)| g * n).sum::<f32>();
            *shift += row.iter().sum::<f32>();
        }
    }
}

impl Sums {
    /// Room for the derivatives of a network of this shape, all zero.
    pub fn new(network: &Network) -> Self {
        let mut previous = 0;
        let layers = network.layers.iter().enumerate().map(|(i, layer)| {
            let point = if network.sees_input(i) { network.encoding.size() } else { 0 };
            let rows = layer.outputs();
            let normed = if layer.norm.is_some() { rows } else { 0 };
            let sums = LayerSums {
                previous: vec![0.0; outer_size(rows, previous)],
                point: vec![0.0; outer_size(rows, point)],
                bias: vec![0.0; padded(rows)],
                scale: vec![0.0; normed],
                shift: vec![0.0; normed],
            };
            previous = rows;
            sums
        });
        let asked = Asked {
            values: [0.0; BLOCK],
            gradients: [[0.0; BLOCK]; 3],
            by_value: [0.0; BLOCK],
            by_gradient: [[0.0; BLOCK]; 3],
        };
        Self { layers: layers.collect(), asked: Box::new(asked), scratch: Vec::new() }
    }

    /// Sets all sums to zero.
    pub fn clear(&mut self) {
        self.layers.iter_mut().flat_map(LayerSums::lists_mut).for_each(|list| list.fill(0.0));
    }

    /// Adds the sums of other points to these.
    pub fn merge(&mut self, other: &Self) {
        for (layer, from) in self.layers.iter_mut().zip(&other.layers) {
            for (to, from) in layer.lists_mut().into_iter().zip(from.lists()) {
                to.iter_mut().zip(from).for_each(|(to, from)| *to += from);
            }
        }
    }

    /// Adds what goes through the latent code `code`, which all points of the sums must have been seen with: to `weights` the
    /// derivatives by the weights that meet it, to `latent` those by the code itself. The order is that of [`Network::weights`].
    pub fn add_code_to(&self, network: &Network, code: &[f32], weights: &mut [f32], latent: &mut [f32]) {
        let (mut at, mut previous) = (0, 0);
        for (i, (layer, sums)) in network.layers.iter().zip(&self.layers).enumerate() {
            let scale = layer.skip.map_or(1.0, |s| s.scale);
            if network.sees_input(i) {
                let rows = layer.weights.chunks_exact(layer.inputs());
                for ((row, own), sum) in rows.enumerate().zip(&sums.bias) {
                    let first = at + row * layer.inputs() + previous;
                    let codes = weights[first..first + code.len()].iter_mut().zip(code);
                    codes.for_each(|(to, z)| *to += scale * sum * z);
                    latent.iter_mut().zip(&own[previous..]).for_each(|(to, w)| *to += scale * sum * w);
                }
            }
            at += layer.parameters();
            previous = layer.outputs();
        }
    }

    /// Adds the derivatives by all weights, biases, scales and shifts to `weights`, in the order of [`Network::weights`], but for those by the weights that meet a latent code.
    pub fn add_to(&self, network: &Network, weights: &mut [f32]) {
        let (mut rest, mut previous) = (weights, 0);
        for (i, (layer, sums)) in network.layers.iter().zip(&self.layers).enumerate() {
            let (rows, inputs) = (layer.outputs(), layer.inputs());
            let (matrix, after) = rest.split_at_mut(rows * inputs);
            let (bias, after) = after.split_at_mut(rows);
            let (norm_scale, after) = after.split_at_mut(sums.scale.len());
            let (norm_shift, after) = after.split_at_mut(sums.shift.len());
            let scale = layer.skip.map_or(1.0, |s| s.scale);
            let point = if network.sees_input(i) { previous + network.latent_size } else { inputs };
            for (row, to) in matrix.chunks_exact_mut(inputs).enumerate() {
                for (column, to) in to[..previous].iter_mut().enumerate() {
                    *to += scale * sums.previous[outer_place(rows, row, column)];
                }
                for (column, to) in to[point..].iter_mut().enumerate() {
                    *to += scale * sums.point[outer_place(rows, row, column)];
                }
            }
            for (to, sums) in [(bias, &sums.bias), (norm_scale, &sums.scale), (norm_shift, &sums.shift)] {
                to.iter_mut().zip(sums).for_each(|(to, sum)| *to += sum);
            }
            (rest, previous) = (after, rows);
        }
    }
}

impl<'n> Prepared<'n> {
    /// Packs the weights of a network that was checked.
    pub fn new(network: &'n Network) -> Self {
        Self { network, packed: Packed::new(network) }
    }

    /// Adds to `sums` the derivatives of a loss of `points`, all seen with the latent code `code`. `loss` is told the place of up
    /// to [`BLOCK`] points, and what the network says there; gradients only where `gradients` asks for them.
    ///
    /// # Panics
    /// When gradients are asked for of a network with layer norms.
    pub fn sum(
        &self,
        code: &[f32],
        points: Points<'_>,
        gradients: bool,
        sums: &mut Sums,
        mut loss: impl FnMut(Range<usize>, &mut Asked),
    ) {
        assert!(!gradients || self.packed.kept() == 0, "no gradients of gradients through layer norms");
        let biases = Packed::fold(self.network, code);
        let mut scratch = std::mem::take(&mut sums.scratch);
        for start in (0..points.len()).step_by(BLOCK) {
            let these = start..(start + BLOCK).min(points.len());
            self.block(&biases, points, these, gradients, sums, &mut scratch, &mut loss);
        }
        sums.scratch = scratch;
    }

    /// Writes the derivatives of the value at every point by the entries of the latent code `code`, row after row of its size.
    pub fn by_code(&self, code: &[f32], points: Points<'_>, rows: &mut [f32]) {
        let (packed, encoding) = (&self.packed, self.packed.encoding());
        let biases = Packed::fold(self.network, code);
        let mut previous = 0;
        let to_code = self.network.layers.iter().enumerate().map(|(i, layer)| {
            let (first, inputs) = (previous, layer.inputs());
            let scale = layer.skip.map_or(1.0, |s| s.scale);
            previous = layer.outputs();
            let columns = if self.network.sees_input(i) { layer.outputs() } else { 0 };
            Panels::new(code.len(), columns, |z, row| scale * layer.weights[row * inputs + first + z])
        });
        let to_code: Vec<Panels> = to_code.collect();
        let of_code = TILE * padded(code.len());
        let per_point = packed.point() + 2 * packed.units() + packed.kept() + 2 * packed.widest();
        let mut scratch = vec![0.0; TILE * per_point + of_code];
        let (encoded, rest) = scratch.split_at_mut(TILE * packed.point());
        let (outputs, rest) = rest.split_at_mut(TILE * packed.units());
        let (slopes, rest) = rest.split_at_mut(TILE * packed.units());
        let (kept, rest) = rest.split_at_mut(TILE * packed.kept());
        let (here, rest) = rest.split_at_mut(TILE * packed.widest());
        let (before, by_code) = rest.split_at_mut(TILE * packed.widest());
        for start in (0..points.len()).step_by(TILE) {
            let these = start..(start + TILE).min(points.len());
            place(points, these.clone(), encoded);
            encode(encoding, encoded);
            packed.forward(&biases, 1, encoded, outputs, Some(ForBack { slopes: &mut *slopes, kept: &mut *kept }));
            let last = TILE * padded(1);
            here[..last].copy_from_slice(&slopes[slopes.len() - last..]);
            by_code.fill(0.0);
            let finish = |at: usize, piece: &mut [f32]| {
                piece.iter_mut().zip(&slopes[at..]).for_each(|(g, slope)| *g *= slope);
            };
            packed.backward(1, kept, None, [here, before], finish, |i, adjoint| {
                if let Adjoint::Sums(adjoint) = adjoint
                    && !to_code[i].is_empty()
                {
                    multiply(&[(&to_code[i], adjoint)], 1, Start::There, by_code, |_, _| {});
                }
            });
            let rows = &mut rows[these.start * code.len()..these.end * code.len()];
            for (lane, row) in rows.chunks_exact_mut(code.len()).enumerate() {
                row.iter_mut().zip(by_code.chunks_exact(TILE)).for_each(|(to, from)| *to = from[lane]);
            }
        }
    }

    #[expect(clippy::too_many_arguments, reason = "the inner half of `sum`")]
    fn block(
        &self,
        biases: &Biases,
        points: Points<'_>,
        these: Range<usize>,
        gradients: bool,
        sums: &mut Sums,
        scratch: &mut Vec<f32>,
        loss: &mut impl FnMut(Range<usize>, &mut Asked),
    ) {
        let (packed, encoding) = (&self.packed, self.packed.encoding());
        let tiles = these.len().div_ceil(TILE);
        let all = tiles * TILE * packed.units();
        let (point, widest) = (tiles * TILE * packed.point(), tiles * TILE * packed.widest());
        let widest_input = packed.widest().max(packed.point());
        let turning = outer_scratch(widest_input, tiles);
        let kept = tiles * TILE * packed.kept();
        scratch.resize(5 * all + kept + 2 * point + 2 * widest + turning, 0.0);
        let mut rest = &mut scratch[..];
        let mut take = |size: usize| {
            let (taken, after) = std::mem::take(&mut rest).split_at_mut(size);
            rest = after;
            taken
        };
        let (outputs, slopes, back, bend, tangents) = (take(all), take(all), take(all), take(all), take(all));
        let (kept, encoded, along) = (take(kept), take(point), take(point));
        let (here, before, turning) = (take(widest), take(widest), take(turning));
        let tile_of = |tile: usize| these.start + tile * TILE..(these.start + (tile + 1) * TILE).min(these.end);
        let size = TILE * packed.point();
        for (tile, encoded) in encoded.chunks_exact_mut(size).enumerate() {
            place(points, tile_of(tile), encoded);
            encode(encoding, encoded);
        }
        packed.forward(biases, tiles, encoded, outputs, Some(ForBack { slopes: &mut *slopes, kept: &mut *kept }));

        let end = all - tiles * TILE * padded(1);
        let asked = sums.asked.as_mut();
        gather(&outputs[end..], padded(1), &mut asked.values);
        if gradients {
            along.fill(0.0);
            here[..all - end].copy_from_slice(&slopes[end..]);
            back[end..].fill(1.0);
            let finish = |at: usize, piece: &mut [f32]| {
                back[at..at + piece.len()].copy_from_slice(piece);
                piece.iter_mut().zip(&slopes[at..]).for_each(|(g, slope)| *g *= slope);
            };
            packed.backward(tiles, kept, Some(&mut *along), [&mut *here, &mut *before], finish, |_, _| {});
            for (tile, along) in along.chunks_exact_mut(size).enumerate() {
                decode(encoding, &encoded[tile * size..], along);
            }
            for (axis, row) in asked.gradients.iter_mut().enumerate() {
                gather(&along[axis * TILE..], packed.point(), row);
            }
        }
        loss(these.clone(), asked);
        // the last tile was filled up with points that nobody asked about
        for list in asked.by_gradient.iter_mut().chain([&mut asked.by_value]) {
            list[these.len()..].fill(0.0);
        }

        if gradients {
            along.fill(0.0);
            for (tile, along) in along.chunks_exact_mut(size).enumerate() {
                for (axis, row) in along.chunks_exact_mut(TILE).take(3).enumerate() {
                    row.copy_from_slice(&asked.by_gradient[axis][tile * TILE..][..TILE]);
                }
                encode_along(encoding, &encoded[tile * size..], along);
            }
            packed.along(tiles, along, slopes, bend, tangents);
            let mut at = 0;
            for (activation, outputs_of) in packed.layers() {
                let these = at..at + tiles * TILE * outputs_of;
                activation.multiply_by_curvature(
                    &mut bend[these.clone()],
                    &outputs[these.clone()],
                    &slopes[these.clone()],
                );
                at = these.end;
            }
            for ((bend, back), slope) in bend.iter_mut().zip(&mut *back).zip(&*slopes) {
                *bend *= *back;
                *back *= slope;
            }
        }
        // the seed: by the value, and through the last activation's curvature
        here[..all - end].fill(0.0);
        for (tile, here) in here[..all - end].chunks_exact_mut(TILE * padded(1)).enumerate() {
            let at = end + tile * TILE * padded(1);
            for (lane, here) in here[..TILE].iter_mut().enumerate() {
                let bent = if gradients { bend[at + lane] } else { 0.0 };
                *here = asked.by_value[tile * TILE + lane] * slopes[at + lane] + bent;
            }
        }
        let finish = |at: usize, piece: &mut [f32]| {
            let slopes = &slopes[at..at + piece.len()];
            match gradients {
                false => piece.iter_mut().zip(slopes).for_each(|(g, slope)| *g *= slope),
                true => {
                    piece.iter_mut().zip(slopes).zip(&bend[at..]).for_each(|((g, slope), bend)| *g = *g * slope + bend)
                }
            }
        };
        let mut offset = all;
        let layers = &mut sums.layers;
        packed.backward(tiles, kept, None, [here, before], finish, |i, adjoint| {
            let rows = self.network.layers[i].outputs();
            let sums = &mut layers[i];
            let adjoint = match adjoint {
                Adjoint::Normed(adjoint, kept) => {
                    // one row more: what is behind the normalised outputs does not matter here
                    let tiles = adjoint.chunks_exact(TILE * padded(rows)).zip(kept.chunks_exact(TILE * (rows + 1)));
                    tiles.for_each(|(adjoint, kept)| sums.add_norm(adjoint, kept));
                    return;
                }
                Adjoint::Sums(adjoint) => adjoint,
            };
            offset -= adjoint.len();
            for adjoint in adjoint.chunks_exact(TILE * padded(rows)) {
                for (sum, row) in sums.bias.iter_mut().zip(adjoint.chunks_exact(TILE)) {
                    *sum += row.iter().sum::<f32>();
                }
            }
            let back = &back[offset..offset + adjoint.len()];
            if i > 0 {
                let columns = self.network.layers[i - 1].outputs();
                let start = offset - tiles * TILE * padded(columns);
                outer((adjoint, rows), (&outputs[start..offset], columns), tiles, turning, &mut sums.previous);
                if gradients {
                    outer((back, rows), (&tangents[start..offset], columns), tiles, turning, &mut sums.previous);
                }
            }
            if !sums.point.is_empty() {
                let columns = encoding.size();
                outer((adjoint, rows), (encoded, columns), tiles, turning, &mut sums.point);
                if gradients {
                    outer((back, rows), (along, columns), tiles, turning, &mut sums.point);
                }
            }
        });
    }
}

/// Takes a row of every tile together; tiles have so many rows, and the first row of the first begins `from`.
fn gather(from: &[f32], rows: usize, to: &mut [f32; BLOCK]) {
    for (tile, to) in from.chunks(TILE * rows).zip(to.chunks_exact_mut(TILE)) {
        to.copy_from_slice(&tile[..TILE]);
    }
}

#[cfg(test)]
mod tests;
