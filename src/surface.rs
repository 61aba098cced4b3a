//! The result: positions on a lattice, normals from the field, UVs from the sphere.

pub mod checkerboard;
pub mod curve;
pub mod forms;
pub mod gltf;
pub mod lettering;
pub mod preview;
pub mod raster;
pub mod sensitivity;
pub mod sheet;
pub mod tensors;

use crate::settings::{Canceled, Settings};
use crate::shrink::chart::relax;
use crate::shrink::lattice::SphereLattice;
use crate::shrink::warm::Earlier;
use crate::shrink::{Distortion, Wrap};
use glam::{DVec3, Vec3};

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
    /// UV of every chart vertex where the chart was relaxed (see [`crate::shrink::chart`]); otherwise it is `lattice.uv`, the
    /// place on the sphere.
    pub relaxed_uv: Option<Vec<[f64; 2]>>,
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
            relaxed_uv: None,
        }
    }

    /// The surface as a warm start begins from it.
    ///
    /// # Panics
    /// When its triangles are not those of its lattice.
    pub fn earlier(&self) -> Earlier {
        let wide = |list: &[[f32; 3]]| -> Vec<DVec3> { list.iter().map(|&p| Vec3::from(p).as_dvec3()).collect() };
        Earlier {
            positions: wide(&self.positions),
            normals: wide(&self.normals),
            diagonals: self.lattice.diagonals_of(&self.triangles).expect("triangles of the lattice"),
            lattice: self.lattice.clone(),
        }
    }

    /// UV of every chart vertex.
    pub fn uv(&self) -> &[[f64; 2]] {
        self.relaxed_uv.as_ref().unwrap_or(&self.lattice.uv)
    }

    /// Relaxes the chart by what `distortion` keeps.
    ///
    /// # Errors
    /// When the token is raised.
    pub fn relax_uv(&mut self, distortion: Distortion, settings: &Settings<'_>) -> Result<(), Canceled> {
        let positions: Vec<DVec3> = self.positions.iter().map(|&p| Vec3::from(p).as_dvec3()).collect();
        self.relaxed_uv = Some(relax(&self.lattice, &self.chart_triangles, &positions, distortion, settings)?);
        Ok(())
    }
}
