//! The front while it shrinks, small enough to be streamed: positions quantized to 16 bits per coordinate.

use crate::settings::Front;
use base64::Engine as _;
use base64::prelude::BASE64_STANDARD;
use glam::Vec3;
use serde::{Deserialize, Serialize};
use std::collections::HashMap;

/// Vertices of a preview at most: some 40 kB as it is sent.
const MAX_VERTICES: usize = 2048;
/// Cells along an edge of the grid that a larger front is merged on, to begin with.
const FINEST_CELLS: u32 = 32;

/// Body of a `mesh` event.
///
/// `positions` is base64 of `vertices` x 3 unsigned 16-bit little-endian integers q; the coordinate along an axis is
/// `origin + q * step`. `triangles` is base64 of `faces` x 3 unsigned little-endian integers of `index_bytes` bytes each. `places` is
/// base64 of `vertices` x 3 signed 16-bit little-endian integers: a triple over 32767 is the vertex's place on the unit sphere.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct MeshPreview {
    /// Number of vertices.
    pub vertices: u32,
    /// Number of triangles.
    pub faces: u32,
    /// Position of the smallest quantized value, scene units.
    pub origin: [f32; 3],
    /// Scene units per quantization step, by axis.
    pub step: [f32; 3],
    /// Base64 of the quantized positions.
    pub positions: String,
    /// Base64 of the triangles.
    pub triangles: String,
    /// Bytes of one index: 2 for at most 65,536 vertices, else 4.
    pub index_bytes: u8,
    /// Base64 of the vertices' places on the sphere, once the map onto it is made.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub places: Option<String>,
}

impl MeshPreview {
    /// Quantizes a front over its bounding box. Nothing to show (no vertex, or a coordinate that is not finite) is `None`.
    pub fn new(front: &Front) -> Option<Self> {
        if front.positions.is_empty() || !front.positions.iter().flatten().all(|c| c.is_finite()) {
            return None;
        }
        let coarse = coarsened(front);
        let front = coarse.as_ref().unwrap_or(front);
        let (mut low, mut high) = ([f32::INFINITY; 3], [f32::NEG_INFINITY; 3]);
        for p in &front.positions {
            for axis in 0..3 {
                low[axis] = low[axis].min(p[axis]);
                high[axis] = high[axis].max(p[axis]);
            }
        }
        let step: [f32; 3] = std::array::from_fn(|axis| (high[axis] - low[axis]) / f32::from(u16::MAX));
        let quantize = |c: f32, axis: usize| -> u16 {
            if step[axis] > 0.0 {
                ((c - low[axis]) / step[axis]).round().clamp(0.0, f32::from(u16::MAX)) as u16
            } else {
                0
            }
        };
        let mut positions = Vec::with_capacity(6 * front.positions.len());
        for p in &front.positions {
            for (axis, &c) in p.iter().enumerate() {
                positions.extend_from_slice(&quantize(c, axis).to_le_bytes());
            }
        }
        let index_bytes: u8 = if front.positions.len() <= 1 << 16 { 2 } else { 4 };
        let mut triangles = Vec::with_capacity(3 * usize::from(index_bytes) * front.triangles.len());
        for corner in front.triangles.iter().flatten() {
            triangles.extend_from_slice(&corner.to_le_bytes()[..usize::from(index_bytes)]);
        }
        Some(Self {
            vertices: front.positions.len() as u32,
            faces: front.triangles.len() as u32,
            origin: low,
            step,
            positions: BASE64_STANDARD.encode(positions),
            triangles: BASE64_STANDARD.encode(triangles),
            index_bytes,
            places: (!front.places.is_empty()).then(|| BASE64_STANDARD.encode(quantized_places(&front.places))),
        })
    }
}

fn quantized_places(places: &[[f32; 3]]) -> Vec<u8> {
    let quantize = |c: &f32| ((c * f32::from(i16::MAX)).round() as i16).to_le_bytes();
    places.iter().flatten().flat_map(quantize).collect()
}

/// The front with at most [`MAX_VERTICES`], by merging the vertices in each cell of a cubic grid at their mean; `None` when
/// it is small enough as it is. Triangles that lose a corner are left out (Rossignac and Borrel 1993).
fn coarsened(front: &Front) -> Option<Front> {
    if front.positions.len() <= MAX_VERTICES {
        return None;
    }
    let points: Vec<Vec3> = front.positions.iter().map(|&p| Vec3::from(p)).collect();
    let low = points.iter().copied().reduce(Vec3::min)?;
    let extent = (points.iter().copied().reduce(Vec3::max)? - low).max_element().max(f32::MIN_POSITIVE);
    let mut cells = FINEST_CELLS;
    loop {
        let mut vertex_of_cell = HashMap::new();
        let mut sums: Vec<(Vec3, u32)> = Vec::new();
        let mut places: Vec<Vec3> = Vec::new();
        let merged: Vec<u32> = points
            .iter()
            .enumerate()
            .map(|(i, &p)| {
                let cell = ((p - low) * (cells as f32 / extent)).as_uvec3();
                let vertex = *vertex_of_cell.entry(cell).or_insert(sums.len() as u32);
                if vertex as usize == sums.len() {
                    sums.push((Vec3::ZERO, 0));
                    places.push(Vec3::ZERO);
                }
                if let Some(&place) = front.places.get(i) {
                    places[vertex as usize] += Vec3::from(place);
                }
                let (sum, count) = &mut sums[vertex as usize];
                *sum += p;
                *count += 1;
                vertex
            })
            .collect();
        if sums.len() > MAX_VERTICES {
            // a surface fills about the square of the number of cells along an edge
            cells = (cells * 4 / 5).max(1);
            continue;
        }
        let corners = front.triangles.iter().map(|t| t.map(|v| merged[v as usize]));
        let mut triangles: Vec<[u32; 3]> = corners.filter(|[a, b, c]| a != b && b != c && c != a).collect();
        // what has lost all its triangles is left out, too
        let mut left = vec![u32::MAX; sums.len()];
        let mut coarse = Front::default();
        for corner in triangles.iter_mut().flatten() {
            let vertex = *corner as usize;
            if left[vertex] == u32::MAX {
                left[vertex] = coarse.positions.len() as u32;
                let (sum, count) = sums[vertex];
                coarse.positions.push((sum / count as f32).to_array());
                if !front.places.is_empty() {
                    coarse.places.push(places[vertex].normalize_or(Vec3::Z).to_array());
                }
            }
            *corner = left[vertex];
        }
        return Some(Front { triangles, ..coarse });
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_decoded_preview_is_within_half_a_step_of_the_front() {
        let front = Front {
            positions: vec![[0.0, -1.0, 5.0], [0.25, 2.0, 5.0], [1.0, 0.3333, 5.0]],
            triangles: vec![[0, 1, 2]],
            places: vec![[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.6, 0.0, 0.8]],
        };
        let preview = MeshPreview::new(&front).expect("finite");
        let places = BASE64_STANDARD.decode(preview.places.as_deref().expect("are there")).expect("base64");
        let places: Vec<i16> = places.chunks_exact(2).map(|b| i16::from_le_bytes([b[0], b[1]])).collect();
        assert_eq!(places, [32767, 0, 0, 0, -32767, 0, 19660, 0, 26214]);
        let bytes = BASE64_STANDARD.decode(&preview.positions).expect("base64");
        for (v, p) in front.positions.iter().enumerate() {
            for (axis, original) in p.iter().enumerate() {
                let k = 2 * (3 * v + axis);
                let q = u16::from_le_bytes([bytes[k], bytes[k + 1]]);
                let c = preview.origin[axis] + f32::from(q) * preview.step[axis];
                assert!((c - original).abs() <= 0.51 * preview.step[axis] + 1e-6, "{c} for {original}");
            }
        }
        assert_eq!(BASE64_STANDARD.decode(&preview.triangles).expect("base64"), [0, 0, 1, 0, 2, 0]);
    }

    #[test]
    fn a_fine_front_is_sent_coarse_and_whole() {
        use crate::shrink::lattice::{LatticeSpec, SphereLattice};
        let lattice = SphereLattice::new(LatticeSpec::Octahedral { n: 72 });
        let front = Front {
            positions: lattice.directions.iter().map(|d| d.as_vec3().to_array()).collect(),
            triangles: lattice.triangles(&vec![false; lattice.quads.len()]),
            places: lattice.directions.iter().map(|d| d.as_vec3().to_array()).collect(),
        };
        let coarse = coarsened(&front).expect("20,738 vertices are too many");
        assert!((MAX_VERTICES / 4..=MAX_VERTICES).contains(&coarse.positions.len()), "{}", coarse.positions.len());
        assert!(coarse.positions.iter().all(|&p| (Vec3::from(p).length() - 1.0).abs() < 0.02), "on the sphere still");
        let beside = |(p, d): (&[f32; 3], &[f32; 3])| Vec3::from(*p).dot(Vec3::from(*d)) > 0.99;
        assert!(
            coarse.places.len() == coarse.positions.len() && coarse.positions.iter().zip(&coarse.places).all(beside)
        );
        let used: std::collections::BTreeSet<u32> = coarse.triangles.iter().flatten().copied().collect();
        assert!(used.iter().copied().eq(0..coarse.positions.len() as u32), "every vertex has a triangle");
        let volume: f32 = coarse
            .triangles
            .iter()
            .map(|t| {
                let [a, b, c] = t.map(|v| Vec3::from(coarse.positions[v as usize]));
                a.dot(b.cross(c)) / 6.0
            })
            .sum();
        assert!((volume - 4.19).abs() < 0.15, "closed, with the ball's volume: {volume}");
        let preview = MeshPreview::new(&front).expect("finite");
        assert!(preview.positions.len() + preview.triangles.len() < 50_000);
    }

    #[test]
    fn a_front_that_blew_up_is_not_shown() {
        assert_eq!(
            MeshPreview::new(&Front { positions: vec![[f32::NAN; 3]], triangles: vec![], places: vec![] }),
            None
        );
    }
}
