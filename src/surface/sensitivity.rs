//! How a surface moves with the network that it is the zero level set of.
//!
//! A vertex v on {f = 0} moves by dv = -n df / |grad f| with every change df of the network (the implicit function theorem; Remelli
//! et al. 2020, "MeshSDF"), n = grad f / |grad f|. So a loss with the derivatives dL/dv has the derivatives
//! -(dL/dv . n) / |grad f| df/dtheta by a weight or an entry of the latent code, summed over the vertices. Motion within the
//! surface is left out: it changes the vertices, not the surface.

use crate::field::input::Placed;
use crate::field::network::adjoint::{Prepared, Sums};
use crate::field::{Field, Gradients, Points};
use crate::settings::{Canceled, Settings};
use glam::DVec3;
use rayon::prelude::*;
use safetensors::SafeTensors;
use safetensors::tensor::{Dtype, TensorView};
use serde_json::json;
use std::collections::HashMap;

/// Vertices that one thread works on at a time.
const CHUNK: usize = 384;
/// Chunks whose sums are held at once; they are added up in order.
const TOGETHER: usize = 16;

/// Derivatives of a loss.
#[derive(Clone, Debug, PartialEq)]
pub struct Sensitivity {
    /// By the entries of the latent code.
    pub latent: Vec<f32>,
    /// By all weights and biases, in the order of [`Network::weights`](crate::field::network::Network::weights).
    pub weights: Vec<f32>,
}

/// Vertices in the frame of their network, one list per coordinate.
struct Vertices {
    places: [Vec<f32>; 3],
    /// The network's gradients there.
    gradients: [Vec<f32>; 3],
}

impl Vertices {
    fn of(placed: &Placed, vertices: &[[f32; 3]], settings: &Settings<'_>) -> Result<Self, Canceled> {
        let field = placed.field();
        let n = vertices.len();
        let places: Vec<DVec3> = vertices.iter().map(|v| placed.from_scene(DVec3::from(v.map(f64::from)))).collect();
        let places: [Vec<f32>; 3] = std::array::from_fn(|axis| places.iter().map(|p| p[axis] as f32).collect());
        let mut gradients: [Vec<f32>; 3] = std::array::from_fn(|_| vec![0.0; n]);
        let [gx, gy, gz] = &mut gradients;
        let chunks = gx.par_chunks_mut(CHUNK).zip(gy.par_chunks_mut(CHUNK)).zip(gz.par_chunks_mut(CHUNK)).enumerate();
        settings.pool.install(|| {
            chunks.try_for_each(|(i, ((x, y), z))| {
                settings.cancel.check()?;
                let mut values = [0.0; CHUNK];
                field.gradients(part(&places, i, n), &mut values[..x.len()], Gradients { x, y, z });
                Ok(())
            })
        })?;
        Ok(Self { places, gradients })
    }

    /// The gradient at a vertex, and its squared length; never 0, so that what has no direction does not move.
    fn gradient(&self, i: usize) -> (DVec3, f64) {
        let gradient = DVec3::from([0, 1, 2].map(|axis| f64::from(self.gradients[axis][i])));
        (gradient, gradient.length_squared().max(f64::MIN_POSITIVE))
    }
}

fn part(places: &[Vec<f32>; 3], chunk: usize, n: usize) -> Points<'_> {
    let these = chunk * CHUNK..((chunk + 1) * CHUNK).min(n);
    let [x, y, z] = places;
    Points { x: &x[these.clone()], y: &y[these.clone()], z: &z[these] }
}

/// The derivatives of a loss by the network's latent code and weights; `vertices` are in scene units on the zero level set, and
/// `by_vertex` are the loss's derivatives by them.
///
/// # Errors
/// When the token is raised.
///
/// # Panics
/// When the lists are not of one length.
pub fn sensitivity(
    placed: &Placed,
    vertices: &[[f32; 3]],
    by_vertex: &[[f64; 3]],
    settings: &Settings<'_>,
) -> Result<Sensitivity, Canceled> {
    assert_eq!(vertices.len(), by_vertex.len());
    let (network, code) = (&placed.network, placed.latent.as_slice());
    let at = Vertices::of(placed, vertices, settings)?;
    let by_value = |i: usize| {
        let (gradient, length2) = at.gradient(i);
        let pulled = placed.pulled_back(DVec3::from(by_vertex[i]));
        (-pulled.dot(gradient) / length2) as f32
    };
    let prepared = Prepared::new(network);
    let chunks = vertices.len().div_ceil(CHUNK);
    let mut slots: Vec<Sums> = (0..TOGETHER.min(chunks)).map(|_| Sums::new(network)).collect();
    let mut total = Sums::new(network);
    for group in (0..chunks).step_by(TOGETHER) {
        settings.cancel.check()?;
        let slots = &mut slots[..TOGETHER.min(chunks - group)];
        settings.pool.install(|| {
            slots.par_iter_mut().enumerate().for_each(|(k, sums)| {
                let first = (group + k) * CHUNK;
                sums.clear();
                let points = part(&at.places, group + k, vertices.len());
                prepared.sum(code, points, false, sums, |these, asked| {
                    for (to, i) in asked.by_value.iter_mut().zip(these) {
                        *to = by_value(first + i);
                    }
                });
            });
        });
        slots.iter().for_each(|sums| total.merge(sums));
    }
    let mut made = Sensitivity { latent: vec![0.0; code.len()], weights: vec![0.0; network.parameters()] };
    total.add_to(network, &mut made.weights);
    total.add_code_to(network, code, &mut made.weights, &mut made.latent);
    Ok(made)
}

/// How far every vertex moves along its normal, outward, per unit of each entry of the latent code: dv/dz = n times this. Row after
/// row of the latent code's size, in scene units.
///
/// # Errors
/// When the token is raised.
pub fn latent_motion(placed: &Placed, vertices: &[[f32; 3]], settings: &Settings<'_>) -> Result<Vec<f32>, Canceled> {
    let size = placed.latent.len();
    let at = Vertices::of(placed, vertices, settings)?;
    let prepared = Prepared::new(&placed.network);
    let mut motion = vec![0.0; vertices.len() * size];
    if size == 0 {
        return Ok(motion);
    }
    settings.pool.install(|| {
        motion.par_chunks_mut(CHUNK * size).enumerate().try_for_each(|(k, rows)| {
            settings.cancel.check()?;
            prepared.by_code(&placed.latent, part(&at.places, k, vertices.len()), rows);
            for (i, row) in rows.chunks_exact_mut(size).enumerate() {
                let (_, length2) = at.gradient(k * CHUNK + i);
                let factor = -placed.scale() / length2.sqrt();
                row.iter_mut().for_each(|z| *z = (f64::from(*z) * factor) as f32);
            }
            Ok(())
        })
    })?;
    Ok(motion)
}

/// The derivatives as a safetensors file: `latent` of the code's size, and for every layer `layers.i.weight` and `layers.i.bias`, with a
/// layer norm `layers.i.norm.scale` and `layers.i.norm.shift`, too, as in shrinkd's own files of networks (of a file with weight norm: by the
/// weights that it gives).
pub fn to_safetensors(placed: &Placed, made: &Sensitivity) -> Vec<u8> {
    let bytes = |list: &[f32]| list.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>();
    let mut tensors = vec![("latent".to_owned(), vec![made.latent.len()], bytes(&made.latent))];
    let mut rest = made.weights.as_slice();
    let mut put = |name: String, shape: &[usize]| {
        let (list, after) = rest.split_at(shape.iter().product());
        tensors.push((name, shape.to_vec(), bytes(list)));
        rest = after;
    };
    for (i, layer) in placed.network.layers.iter().enumerate() {
        put(format!("layers.{i}.weight"), &[layer.outputs(), layer.inputs()]);
        put(format!("layers.{i}.bias"), &[layer.outputs()]);
        if layer.norm.is_some() {
            put(format!("layers.{i}.norm.scale"), &[layer.outputs()]);
            put(format!("layers.{i}.norm.shift"), &[layer.outputs()]);
        }
    }
    let views = tensors.iter().map(|(name, shape, data)| {
        (name.as_str(), TensorView::new(Dtype::F32, shape.clone(), data).expect("as many bytes as the shape says"))
    });
    let about = json!({"format": 1, "version": env!("CARGO_PKG_VERSION")}).to_string();
    let metadata = HashMap::from([("shrinkd".to_owned(), about)]);
    safetensors::serialize(views, Some(metadata)).expect("a header far under the format's limit")
}

/// The welded vertices of a surface that [`tensors`](super::tensors) wrote, and for every point of its grid the vertex there.
#[derive(Clone, Debug, PartialEq)]
pub struct Welded {
    /// Positions in scene units.
    pub positions: Vec<[f32; 3]>,
    /// Shape of the grid.
    pub grid: [usize; 2],
    /// The vertex of each grid point, row by row.
    pub vertex: Vec<u32>,
}

impl Welded {
    /// Reads them back; the error is a sentence.
    pub fn read(bytes: &[u8]) -> Result<Self, String> {
        let tensors = SafeTensors::deserialize(bytes).map_err(|e| e.to_string())?;
        let (shape, positions) = floats(&tensors, "positions")?;
        let vertex = tensors.tensor("vertex").map_err(|_| "the tensor \"vertex\" is missing".to_owned())?;
        let [rows, columns, 3] = shape[..] else { return Err(format!("\"positions\" has the shape {shape:?}")) };
        if vertex.dtype() != Dtype::U32 || vertex.shape() != [rows, columns] {
            return Err("\"vertex\" is not a grid of whole numbers like that of \"positions\"".to_owned());
        }
        let vertex: Vec<u32> = vertex.data().as_chunks().0.iter().map(|b| u32::from_le_bytes(*b)).collect();
        let count = vertex.iter().max().map_or(0, |&v| v as usize + 1);
        if count > vertex.len() {
            return Err(format!("\"vertex\" names vertex {} of a grid of {}", count - 1, vertex.len()));
        }
        let mut welded = vec![[0.0; 3]; count];
        for (&v, place) in vertex.iter().zip(positions.as_chunks().0) {
            welded[v as usize] = place.map(|c: f64| c as f32);
        }
        Ok(Self { positions: welded, grid: [rows, columns], vertex })
    }

    /// Reads the derivatives of a loss by the vertices: the tensor `gradient` of the shape [vertices, 3], or [rows, columns, 3] for the
    /// points of the grid. The error is a sentence.
    pub fn gradient(&self, bytes: &[u8]) -> Result<Vec<[f64; 3]>, String> {
        let tensors = SafeTensors::deserialize(bytes).map_err(|e| e.to_string())?;
        let (shape, numbers) = floats(&tensors, "gradient")?;
        let rows = numbers.as_chunks::<3>().0;
        if shape == [self.positions.len(), 3] {
            return Ok(rows.to_vec());
        }
        if shape == [self.grid[0], self.grid[1], 3] {
            // points of the grid that are one vertex move together
            let mut sums = vec![[0.0; 3]; self.positions.len()];
            for (&v, row) in self.vertex.iter().zip(rows) {
                sums[v as usize].iter_mut().zip(row).for_each(|(sum, g)| *sum += g);
            }
            return Ok(sums);
        }
        let ([r, c], n) = (self.grid, self.positions.len());
        Err(format!("\"gradient\" has the shape {shape:?}, and the surface takes [{n}, 3] or [{r}, {c}, 3]"))
    }
}

/// Whether a file holds a gradient at all: the tensor `gradient` with rows of three finite numbers. The error is a sentence.
pub fn check_gradient(bytes: &[u8]) -> Result<(), String> {
    let tensors = SafeTensors::deserialize(bytes).map_err(|e| e.to_string())?;
    match floats(&tensors, "gradient")?.0.last() {
        Some(3) => Ok(()),
        _ => Err("\"gradient\" has no rows of three numbers".to_owned()),
    }
}

/// The shape and the numbers of a tensor, all of them finite.
fn floats(tensors: &SafeTensors<'_>, name: &str) -> Result<(Vec<usize>, Vec<f64>), String> {
    let tensor = tensors.tensor(name).map_err(|_| {
        let mut names = tensors.names();
        names.sort_unstable();
        format!("the tensor {name:?} is missing; there are {names:?}")
    })?;
    let data = tensor.data();
    let numbers: Vec<f64> = match tensor.dtype() {
        Dtype::F32 => data.as_chunks().0.iter().map(|b| f32::from_le_bytes(*b).into()).collect(),
        Dtype::F64 => data.as_chunks().0.iter().map(|b| f64::from_le_bytes(*b)).collect(),
        other => return Err(format!("{name:?} has the type {other:?}, not F32 or F64")),
    };
    match numbers.iter().position(|v| !v.is_finite()) {
        Some(at) => Err(format!("number {at} of {name:?} is not finite")),
        None => Ok((tensor.shape().to_vec(), numbers)),
    }
}

#[cfg(test)]
mod tests;
