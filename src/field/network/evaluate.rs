//! Values and gradients of a network in blocks of points.
//!
//! Layer by layer, a block's outputs are the product of the weights with the block's inputs; derivatives of the activations
//! are kept on the way, and one pass back through the transposed weights gives the gradient of the value with respect to
//! the point (reverse mode: for one output it costs about one more forward pass, where three tangents would cost three).
//!
//! A block has [`BLOCK`] points whatever the batch; the last block of a batch is filled up with copies of its last point.
//! So every product has the same shape, and a point gets the same bits in every batch.

use super::{Activation, Encoding, Network};
use crate::field::{Domain, Field, Gradients, Metric, Points};
use gemm::Parallelism;
use std::cell::RefCell;

/// Points worked on together. No other size from 64 to 512 could be told to be faster in the noise of the machine it was
/// tried on, and a larger one would waste more on the last block of a batch.
const BLOCK: usize = 128;
/// A value that is not a number or too large stands for "far outside": finite, and not near any zero.
const FAR: f32 = 1e30;

thread_local! {
    static SCRATCH: RefCell<Vec<f32>> = const { RefCell::new(Vec::new()) };
}

/// A layer with the latent code folded into its bias.
struct Prepared {
    outputs: usize,
    /// Outputs of the layer before; 0 for the first layer.
    previous: usize,
    /// `outputs` rows of `previous` weights.
    from_previous: Vec<f32>,
    /// `outputs` rows of weights on the encoded point; empty when the layer does not see it.
    from_point: Vec<f32>,
    bias: Vec<f32>,
    activation: Activation,
}

/// A network with a latent code, as a [`Field`].
pub struct NetworkField {
    layers: Vec<Prepared>,
    encoding: Encoding,
    /// Outputs of all layers together.
    units: usize,
    /// Outputs of the widest layer.
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
                let sees_input = i == 0 || layer.skip.is_some();
                let scale = layer.skip.map_or(1.0, |s| s.scale);
                let mut prepared = Prepared {
                    outputs,
                    previous,
                    from_previous: Vec::with_capacity(outputs * previous),
                    from_point: Vec::with_capacity(if sees_input { outputs * point } else { 0 }),
                    bias: layer.bias.clone(),
                    activation: layer.activation,
                };
                for (row, bias) in layer.weights.chunks_exact(inputs).zip(&mut prepared.bias) {
                    let (from_previous, from_input) = row.split_at(previous);
                    prepared.from_previous.extend(from_previous.iter().map(|w| w * scale));
                    if sees_input {
                        let (from_latent, from_point) = from_input.split_at(latent.len());
                        let constant: f64 =
                            from_latent.iter().zip(latent).map(|(w, z)| f64::from(w * scale) * f64::from(*z)).sum();
                        *bias = (f64::from(*bias) + constant) as f32;
                        prepared.from_point.extend(from_point.iter().map(|w| w * scale));
                    }
                }
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

    /// Numbers of scratch for a block: the encoded points and their adjoint, all outputs and all derivatives, and two
    /// adjoints of the widest layer.
    fn scratch_size(&self) -> usize {
        BLOCK * (2 * self.encoding.size() + 2 * self.units + 2 * self.widest)
    }

    fn run(&self, points: Points<'_>, values: &mut [f32], mut gradients: Option<Gradients<'_>>) {
        SCRATCH.with_borrow_mut(|scratch| {
            let size = self.scratch_size();
            if scratch.len() < size {
                scratch.resize(size, 0.0);
            }
            let n = points.len();
            for start in (0..n).step_by(BLOCK) {
                let count = BLOCK.min(n - start);
                let (encoded, rest) = scratch.split_at_mut(BLOCK * self.encoding.size());
                let (outputs, rest) = rest.split_at_mut(BLOCK * self.units);
                let (derivatives, rest) = rest.split_at_mut(BLOCK * self.units);
                for (axis, from) in [points.x, points.y, points.z].into_iter().enumerate() {
                    let row = &mut encoded[axis * BLOCK..(axis + 1) * BLOCK];
                    row[..count].copy_from_slice(&from[start..start + count]);
                    row[count..].fill(from[start + count - 1]);
                }
                encode(self.encoding, encoded);
                self.forward(encoded, outputs, gradients.is_some().then_some(&mut *derivatives));
                let value = &outputs[BLOCK * (self.units - 1)..][..count];
                for (to, &from) in values[start..].iter_mut().zip(value) {
                    *to = if from.abs() <= FAR { from } else { FAR };
                }
                let Some(gradients) = gradients.as_mut() else { continue };
                let (adjoint, rest) = rest.split_at_mut(BLOCK * self.encoding.size());
                let (here, rest) = rest.split_at_mut(BLOCK * self.widest);
                self.backward(derivatives, adjoint, here, &mut rest[..BLOCK * self.widest]);
                decode(self.encoding, encoded, adjoint);
                let columns = [&mut *gradients.x, &mut *gradients.y, &mut *gradients.z];
                for (axis, to) in columns.into_iter().enumerate() {
                    for (to, &from) in to[start..start + count].iter_mut().zip(&adjoint[axis * BLOCK..]) {
                        *to = if from.abs() <= FAR { from } else { 0.0 };
                    }
                }
            }
        });
    }

    /// Fills the outputs of every layer, and the derivatives of their activations where asked for.
    fn forward(&self, encoded: &[f32], outputs: &mut [f32], mut derivatives: Option<&mut [f32]>) {
        let mut at = 0;
        for layer in &self.layers {
            let (before, rest) = outputs.split_at_mut(at);
            let here = &mut rest[..BLOCK * layer.outputs];
            for (row, &bias) in here.chunks_exact_mut(BLOCK).zip(&layer.bias) {
                row.fill(bias);
            }
            if layer.previous > 0 {
                let input = &before[at - BLOCK * layer.previous..];
                multiply_add(&layer.from_previous, Shape::Straight, layer.outputs, layer.previous, input, here);
            }
            if !layer.from_point.is_empty() {
                let size = self.encoding.size();
                multiply_add(&layer.from_point, Shape::Straight, layer.outputs, size, encoded, here);
            }
            match derivatives.as_deref_mut() {
                None => layer.activation.apply(here),
                Some(all) => layer.activation.apply_with_derivative(here, &mut all[at..at + here.len()]),
            }
            at += BLOCK * layer.outputs;
        }
    }

    /// Carries the derivative of the value back to the encoded point, into `adjoint`.
    fn backward<'s>(
        &self,
        derivatives: &[f32],
        adjoint: &mut [f32],
        mut here: &'s mut [f32],
        mut before: &'s mut [f32],
    ) {
        adjoint.fill(0.0);
        let mut end = BLOCK * self.units;
        here[..BLOCK].fill(1.0);
        for layer in self.layers.iter().rev() {
            let size = BLOCK * layer.outputs;
            let slopes = &derivatives[end - size..end];
            for (g, slope) in here[..size].iter_mut().zip(slopes) {
                *g *= slope;
            }
            if !layer.from_point.is_empty() {
                let point = self.encoding.size();
                multiply_add(&layer.from_point, Shape::Transposed, point, layer.outputs, &here[..size], adjoint);
            }
            if layer.previous > 0 {
                let to = &mut before[..BLOCK * layer.previous];
                to.fill(0.0);
                multiply_add(&layer.from_previous, Shape::Transposed, layer.previous, layer.outputs, &here[..size], to);
            }
            std::mem::swap(&mut here, &mut before);
            end -= size;
        }
    }
}

/// Whether a product takes the weights as they stand or their transpose.
#[derive(Clone, Copy, PartialEq)]
enum Shape {
    Straight,
    Transposed,
}

/// `to += weights * from` (or its transpose), with `from` of `inner` rows and `to` of `rows` rows of [`BLOCK`] points.
fn multiply_add(weights: &[f32], shape: Shape, rows: usize, inner: usize, from: &[f32], to: &mut [f32]) {
    assert_eq!(weights.len(), rows * inner);
    assert_eq!(from.len(), inner * BLOCK);
    assert_eq!(to.len(), rows * BLOCK);
    let (column_step, row_step) = match shape {
        Shape::Straight => (1, inner as isize),
        Shape::Transposed => (rows as isize, 1),
    };
    let block = BLOCK as isize;
    // SAFETY: `gemm` reads `rows` x `inner` weights, `inner` x BLOCK of `from`, and reads and writes `rows` x BLOCK of
    // `to`, at the strides given; the assertions above make each slice exactly as long as its matrix, every element is
    // initialized, and `to` is borrowed mutably, so it overlaps none of the others.
    unsafe {
        gemm::gemm(
            rows,
            BLOCK,
            inner,
            to.as_mut_ptr(),
            1,
            block,
            true,
            weights.as_ptr(),
            column_step,
            row_step,
            from.as_ptr(),
            1,
            block,
            1.0,
            1.0,
            false,
            false,
            false,
            Parallelism::None,
        );
    }
}

/// Fills the rows behind the three coordinates of a block.
fn encode(encoding: Encoding, encoded: &mut [f32]) {
    let Encoding::Positional { frequencies, base } = encoding else { return };
    let (coordinates, rest) = encoded.split_at_mut(3 * BLOCK);
    let mut w = base;
    for octave in rest.chunks_exact_mut(6 * BLOCK).take(frequencies as usize) {
        let (sines, cosines) = octave.split_at_mut(3 * BLOCK);
        for ((s, c), &x) in sines.iter_mut().zip(cosines).zip(&*coordinates) {
            let (sine, cosine) = f64::from(w * x).sin_cos();
            (*s, *c) = (sine as f32, cosine as f32);
        }
        w *= 2.0;
    }
}

/// Adds the adjoints of the encoding's rows to those of the three coordinates.
fn decode(encoding: Encoding, encoded: &[f32], adjoint: &mut [f32]) {
    let Encoding::Positional { frequencies, base } = encoding else { return };
    let (coordinates, rest) = adjoint.split_at_mut(3 * BLOCK);
    let mut w = base;
    let octaves = encoded[3 * BLOCK..].chunks_exact(6 * BLOCK).zip(rest.chunks_exact(6 * BLOCK));
    for (values, adjoints) in octaves.take(frequencies as usize) {
        for (i, to) in coordinates.iter_mut().enumerate() {
            let (sine, cosine) = (values[i], values[3 * BLOCK + i]);
            *to += w * (cosine * adjoints[i] - sine * adjoints[3 * BLOCK + i]);
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
