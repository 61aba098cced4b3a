//! The result: positions on a lattice, normals from the field, UVs from the sphere.

pub mod checkerboard;
pub mod curve;
pub mod forms;
pub mod gltf;
pub mod lettering;
pub mod preview;
pub mod raster;
pub mod sheet;
pub mod tensors;

use crate::shrink::Wrap;
use crate::shrink::lattice::SphereLattice;
use glam::DVec3;

/// A parameterized surface: one chart over a sphere lattice, in scene units and single precision, as it is written.
#[derive(Clone, Debug)]
pub struct Surface {
    /// The lattice: directions on the sphere, grid, chart.
    pub lattice: SphereLattice,
    /// Position of every welded vertex.
    pub positions: Vec<[f32; 3]>,
    /// Unit gradient of the field at every welded vertex.
    pub normals: Vec<[f32; 3]>,
    /// Length of the gradient at every welded vertex.
    pub gradient_norms: Vec<f32>,
    /// Value of the field at every welded vertex, scene units.
    pub values: Vec<f32>,
    /// Triangles of welded vertices, counter-clockwise outward.
    pub triangles: Vec<[u32; 3]>,
    /// The same triangles over chart vertices (`lattice.chart`, `lattice.uv`), in the same order.
    pub chart_triangles: Vec<[u32; 3]>,
}

impl Surface {
    /// Rounds the wrap to single precision. The field was evaluated at the rounded places already: a sampler rounds every
    /// point that it is asked about.
    pub fn new(wrap: Wrap) -> Self {
        Self {
            positions: wrap.positions.iter().map(|p| p.as_vec3().to_array()).collect(),
            normals: wrap.gradients.iter().map(|g| g.normalize_or(DVec3::Z).as_vec3().to_array()).collect(),
            gradient_norms: wrap.gradients.iter().map(|g| g.length() as f32).collect(),
            values: wrap.values.iter().map(|&v| v as f32).collect(),
            triangles: wrap.lattice.triangles(&wrap.diagonals),
            chart_triangles: wrap.lattice.chart_triangles(&wrap.diagonals),
            lattice: wrap.lattice,
        }
    }
}
