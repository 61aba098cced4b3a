//! Values and gradients of a network in blocks of points.
//!
//! Layer by layer, a block's outputs are the product of the weights with the block's inputs; derivatives of the activations
//! are kept on the way, and one pass back through the transposed weights gives the gradient of the value with respect to
//! the point (reverse mode: for one output it costs about one more forward pass, where three tangents would cost three).
//! Activations are taken of every piece of a product as soon as it is there, while it is in the nearest cache; a norm waits for all
//! outputs of its layer.
//!
//! Points come in tiles of [`TILE`], the last of which is filled up with copies of the last point. No number of a point depends
//! on the others in its tile, so a point gets the same bits in every batch.

use super::Network;
use super::passes::{Biases, ForBack, Packed, TILES, decode, encode, place};
use super::product::{TILE, padded};
use crate::field::{Domain, Field, Gradients, Metric, Points};
use std::cell::RefCell;

/// A value that is not a number or too large stands for "far outside": finite, and not near any zero.
const FAR: f32 = 1e30;

thread_local! {
    static SCRATCH: RefCell<Vec<f32>> = const { RefCell::new(Vec::new()) };
}

/// A network with a latent code, as a [`Field`].
pub struct NetworkField {
    packed: Packed,
    biases: Biases,
    domain: Domain,
    metric: Metric,
    lipschitz: Option<f32>,
}

impl NetworkField {
    /// Folds `latent` (of the network's latent size) into the biases. The network was checked.
    pub(super) fn new(network: &Network, latent: &[f32]) -> Self {
        Self {
            packed: Packed::new(network),
            biases: Packed::fold(network, latent),
            domain: network.domain,
            metric: network.metric,
            lipschitz: network.lipschitz,
        }
    }

    /// Numbers of scratch for a tile: the encoded points and their adjoint, all outputs and all derivatives, what norms keep, and
    /// two adjoints of the widest layer.
    fn scratch_size(&self) -> usize {
        TILE * (2 * (self.packed.point() + self.packed.units() + self.packed.widest()) + self.packed.kept())
    }

    fn run(&self, points: Points<'_>, values: &mut [f32], mut gradients: Option<Gradients<'_>>) {
        let (packed, encoding) = (&self.packed, self.packed.encoding());
        let (point, units, widest) = (TILE * packed.point(), packed.units(), packed.widest());
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
                let (outputs, rest) = rest.split_at_mut(tiles * TILE * units);
                let (derivatives, rest) = rest.split_at_mut(tiles * TILE * units);
                let (kept, rest) = rest.split_at_mut(tiles * TILE * packed.kept());
                let places = |tile: usize| start + tile * TILE..(start + (tile + 1) * TILE).min(n);
                for (tile, encoded) in encoded.chunks_exact_mut(point).enumerate() {
                    place(points, places(tile), encoded);
                    encode(encoding, encoded);
                }
                let back = gradients.is_some().then_some(ForBack { slopes: &mut *derivatives, kept: &mut *kept });
                packed.forward(&self.biases, tiles, encoded, outputs, back);
                let last = &outputs[tiles * TILE * (units - padded(1))..];
                for (tile, value) in last.chunks_exact(TILE * padded(1)).enumerate() {
                    for (to, &from) in values[places(tile)].iter_mut().zip(value) {
                        *to = if from.abs() <= FAR { from } else { FAR };
                    }
                }
                let Some(gradients) = gradients.as_mut() else { continue };
                let (adjoint, rest) = rest.split_at_mut(tiles * point);
                let (here, rest) = rest.split_at_mut(tiles * TILE * widest);
                let before = &mut rest[..tiles * TILE * widest];
                adjoint.fill(0.0);
                let last = tiles * TILE * (units - padded(1));
                here[..derivatives.len() - last].copy_from_slice(&derivatives[last..]);
                let finish = |at: usize, piece: &mut [f32]| {
                    piece.iter_mut().zip(&derivatives[at..]).for_each(|(g, slope)| *g *= slope);
                };
                packed.backward(tiles, kept, Some(&mut *adjoint), [here, before], finish, |_, _| {});
                for (tile, adjoint) in adjoint.chunks_exact_mut(point).enumerate() {
                    decode(encoding, &encoded[tile * point..], adjoint);
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
