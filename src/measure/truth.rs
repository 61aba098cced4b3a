//! What surfaces are measured against, prepared once for several of them: the field's own mesh, or points on its zero level
//! set.

use super::bvh::Aabb;
use super::distance::{Comparison, FIELD_SAMPLES, Mesh, SAMPLES, between, mesh_vertices, to_zero_set};
use super::zero_set::{self, ZeroSet};
use super::{corners, diagonal, doubled_normal};
use crate::field::Sampler;
use crate::settings::Canceled;
use glam::DVec3;

/// The truth behind a field.
pub struct Truth<'s, 'a> {
    sampler: &'s Sampler<'a>,
    shape: Shape<'a>,
}

enum Shape<'a> {
    Mesh { vertices: Vec<DVec3>, triangles: &'a [[u32; 3]] },
    ZeroSet(ZeroSet),
}

impl<'s, 'a> Truth<'s, 'a> {
    /// The field's own mesh where it has one, otherwise points all over its zero level set ([`zero_set::find`]).
    ///
    /// # Errors
    /// When the token is raised.
    pub fn of(sampler: &'s Sampler<'a>) -> Result<Self, Canceled> {
        let shape = match sampler.field().truth() {
            Some(mesh) => Shape::Mesh { vertices: mesh_vertices(mesh), triangles: &mesh.triangles },
            None => Shape::ZeroSet(zero_set::find(sampler)?),
        };
        Ok(Self { sampler, shape })
    }

    /// The field that this is the truth of.
    pub fn sampler(&self) -> &'s Sampler<'a> {
        self.sampler
    }

    /// The truth as a mesh, where it is one.
    pub fn mesh(&self) -> Option<Mesh<'_>> {
        match &self.shape {
            Shape::Mesh { vertices, triangles } => Some(Mesh { vertices, triangles }),
            Shape::ZeroSet(_) => None,
        }
    }

    fn points(&self) -> &[DVec3] {
        match &self.shape {
            Shape::Mesh { vertices, .. } => vertices,
            Shape::ZeroSet(zeros) => &zeros.points,
        }
    }

    /// Bounding box, scene units; `None` when there is nothing.
    pub fn bounds(&self) -> Option<Aabb> {
        (!self.points().is_empty()).then(|| Aabb::of(self.points()))
    }

    /// Diagonal of the bounding box, scene units.
    pub fn diagonal(&self) -> f64 {
        diagonal(self.points())
    }

    /// Integral of |nx| + |ny| + |nz| over the surface: a grid of spacing h has about this over h^2 edges that cross it
    /// (Cauchy-Crofton), and marching cubes as many vertices.
    pub fn crossings(&self) -> f64 {
        match &self.shape {
            Shape::Mesh { vertices, triangles } => {
                triangles.iter().map(|&t| 0.5 * doubled_normal(corners(vertices, t)).abs().element_sum()).sum()
            }
            Shape::ZeroSet(zeros) => {
                zeros.weights.iter().zip(&zeros.normals).map(|(w, n)| w * n.abs().element_sum()).sum()
            }
        }
    }

    /// Compares a surface with it; see [`between`] and [`to_zero_set`]. `None` when either side has no area.
    ///
    /// # Errors
    /// When the token is raised.
    pub fn compare(&self, surface: Mesh<'_>) -> Result<Option<Comparison>, Canceled> {
        match &self.shape {
            Shape::Mesh { vertices, triangles } => {
                between(surface, Mesh { vertices, triangles }, SAMPLES, self.sampler.settings())
            }
            Shape::ZeroSet(zeros) => to_zero_set(surface, FIELD_SAMPLES, zeros, self.sampler),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::fixtures::*;
    use super::*;
    use crate::field::sampler::Tally;
    use std::f64::consts::PI;

    #[test]
    fn a_sphere_is_crossed_by_one_and_a_half_edges_per_face_of_the_grid() {
        with_settings(1, |settings| {
            let (field, tally) = (Balls::one(0.5), Tally::new());
            let sampler = Sampler::new(&field, *settings, &tally);
            let truth = Truth::of(&sampler).unwrap();
            assert!(truth.mesh().is_none());
            // the mean of |nx| + |ny| + |nz| over the sphere is 3/2
            assert!((truth.crossings() / (1.5 * PI) - 1.0).abs() < 0.01, "{}", truth.crossings());
            assert!((truth.diagonal() - 3f64.sqrt()).abs() < 0.01);
        });
    }
}
