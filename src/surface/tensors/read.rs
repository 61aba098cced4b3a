//! Reads a surface back from the safetensors it was written as: what a warm start needs of it.
//!
//! The bytes are not trusted: nothing is allocated from a number in them that was not compared with their length or with the
//! lattice that is asked for.

use super::FORMAT;
use crate::shrink::lattice::{LatticeSpec, SphereLattice};
use crate::shrink::warm::Earlier;
use glam::DVec3;
use safetensors::SafeTensors;
use safetensors::tensor::Dtype;
use serde_json::Value;

/// Longest header; one of all tensors has about 1 KiB.
const MAX_HEADER: u64 = 1 << 16;
/// Largest coordinate: beyond, little of a shape is left in single precision.
const MAX_SIZE: f32 = 1e6;

/// Why bytes are no surface to start from. Safe to show to a client.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{0}")]
pub struct Unreadable(String);

fn unreadable(detail: impl Into<String>) -> Unreadable {
    Unreadable(detail.into())
}

/// Reads a surface on this lattice.
///
/// # Errors
/// [`Unreadable`] when the bytes are no safetensors of [`to_safetensors`](super::to_safetensors), when the surface is on another
/// lattice, or when a number in it is not finite.
pub fn from_safetensors(bytes: &[u8], lattice: LatticeSpec) -> Result<Earlier, Unreadable> {
    let header = bytes.first_chunk::<8>().map(|n| u64::from_le_bytes(*n));
    if !header.is_some_and(|header| header <= MAX_HEADER && header <= bytes.len() as u64 - 8) {
        return Err(unreadable("the bytes are no safetensors of a surface"));
    }
    let broken = |e: safetensors::SafeTensorError| unreadable(format!("the bytes are no safetensors: {e}"));
    let (_, metadata) = SafeTensors::read_metadata(bytes).map_err(broken)?;
    let tensors = SafeTensors::deserialize(bytes).map_err(broken)?;
    let about = metadata.metadata().as_ref().and_then(|entries| entries.get("shrinkd"));
    let about: Value = about.and_then(|text| serde_json::from_str(text).ok()).unwrap_or_default();
    if about["format"] != FORMAT || about["lattice"].is_null() {
        return Err(unreadable("the metadata is not that of a surface on a lattice"));
    }
    if about["lattice"] != serde_json::json!(lattice) {
        let asked = serde_json::json!(lattice);
        return Err(unreadable(format!(
            "the surface is on the lattice {}, and {asked} is asked for",
            about["lattice"]
        )));
    }
    let lattice = SphereLattice::new(lattice);
    let (rows, columns) = (lattice.rows, lattice.columns);
    let words = |name: &str, dtype: Dtype, shape: &[usize]| -> Result<Vec<[u8; 4]>, Unreadable> {
        let tensor = tensors.tensor(name).map_err(|_| unreadable(format!("there is no tensor {name:?}")))?;
        if tensor.dtype() != dtype || tensor.shape() != shape {
            let found = (tensor.dtype(), tensor.shape());
            return Err(unreadable(format!("{name} is {found:?} and not {:?}", (dtype, shape))));
        }
        Ok(tensor.data().as_chunks::<4>().0.to_vec())
    };
    let welded: Vec<u32> = words("vertex", Dtype::U32, &[rows, columns])?.into_iter().map(u32::from_le_bytes).collect();
    if welded != lattice.grid {
        return Err(unreadable("vertex does not weld the grid as the lattice does"));
    }
    // every grid point of a vertex has the same position, and the last one is taken
    let per_vertex = |name: &str| -> Result<Vec<DVec3>, Unreadable> {
        let values: Vec<f32> =
            words(name, Dtype::F32, &[rows, columns, 3])?.into_iter().map(f32::from_le_bytes).collect();
        if let Some(i) = values.iter().position(|x| !x.is_finite() || x.abs() > MAX_SIZE) {
            return Err(unreadable(format!("number {i} of {name} is {}", values[i])));
        }
        let mut list = vec![DVec3::ZERO; lattice.directions.len()];
        for (&v, &[x, y, z]) in lattice.grid.iter().zip(values.as_chunks::<3>().0) {
            list[v as usize] = DVec3::new(x.into(), y.into(), z.into());
        }
        Ok(list)
    };
    let (positions, normals) = (per_vertex("positions")?, per_vertex("normals")?);
    let count = 2 * lattice.quads.len() + lattice.caps.len();
    let corners: Vec<u32> = words("triangles", Dtype::U32, &[count, 3])?.into_iter().map(u32::from_le_bytes).collect();
    let diagonals = lattice.diagonals_of(corners.as_chunks::<3>().0);
    let diagonals = diagonals.ok_or_else(|| unreadable("the triangles are not those of the lattice"))?;
    Ok(Earlier { lattice, positions, normals, diagonals })
}
