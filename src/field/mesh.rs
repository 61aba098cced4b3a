//! Triangle meshes: reading them, and their exact signed distance.
//!
//! [`TriangleMesh::read`] takes PLY, OBJ, STL, OFF and GLB, told apart by their content, merges vertices at the same
//! place and cuts polygons into triangles. [`MeshField`] is the signed distance to such a mesh. Nothing is allocated
//! from a count in a file before the file was seen to be long enough for it.

mod boundary;
mod closest;
mod distance;
mod glb;
mod intersect;
mod obj;
mod off;
mod ply;
mod sheet;
mod sides;
mod stl;
mod text;
mod topology;
mod tree;
mod winding;

pub use distance::MeshField;
pub use sheet::Sheet;
pub use topology::Soundness;

use super::FieldError;
use glam::DVec3;
use std::collections::HashMap;

/// Most triangles that are read: at about 400 bytes per triangle of search structure this is 1.6 GiB.
pub const MAX_TRIANGLES: usize = 4_000_000;
/// Most vertices that are read, before those at the same place are merged (an STL has three per triangle).
pub const MAX_VERTICES: usize = 3 * MAX_TRIANGLES;
/// Most corners of one polygon.
const MAX_CORNERS: usize = 65_536;
/// Coordinates beyond this are refused: their cubes must stay far inside the range of the arithmetic.
const MAX_COORDINATE: f64 = 1e30;

/// A closed triangle mesh in scene units, vertices shared between triangles, counter-clockwise outward.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct TriangleMesh {
    /// Vertex positions.
    pub vertices: Vec<[f64; 3]>,
    /// Triangles, indices into `vertices`.
    pub triangles: Vec<[u32; 3]>,
}

/// A mesh as it stands in a file, with a place in the chart for every vertex: vertices on a seam are there once per side.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ChartedMesh {
    /// Vertex positions.
    pub vertices: Vec<[f64; 3]>,
    /// Texture coordinates of every vertex, v downwards.
    pub uv: Vec<[f32; 2]>,
    /// The second ones, where they are there.
    pub second_uv: Option<Vec<[f32; 2]>>,
    /// Triangles, indices into both.
    pub triangles: Vec<[u32; 3]>,
    /// The `extras` of the document; null when there are none.
    pub extras: serde_json::Value,
}

/// The point of a triangle nearest to `p`.
pub(crate) fn closest_on_triangle(p: DVec3, [a, b, c]: [DVec3; 3]) -> DVec3 {
    closest::closest(p, a, b - a, c - a).0
}

impl ChartedMesh {
    /// Reads the mesh of a GLB with its texture coordinates. `None` when the bytes are of another format, when a
    /// primitive has no first texture coordinates, or one of them is not finite.
    ///
    /// # Errors
    /// As [`TriangleMesh::read`].
    pub fn read(bytes: &[u8]) -> Result<Option<Self>, FieldError> {
        if MeshFormat::detect(bytes) != Some(MeshFormat::Glb) {
            return Ok(None);
        }
        let (soup, extras) = glb::read_charted(bytes)?;
        let finite = |places: &Vec<[f32; 2]>| places.iter().flatten().all(|c| c.is_finite());
        let [uv, second_uv] = soup.places.map(|places| places.filter(finite));
        Ok(uv.map(|uv| Self { vertices: soup.vertices, uv, second_uv, triangles: soup.triangles, extras }))
    }
}

/// The mesh formats that are read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum MeshFormat {
    /// Stanford PLY, text or binary of either byte order.
    Ply,
    /// Wavefront OBJ.
    Obj,
    /// STL, text or binary.
    Stl,
    /// Object File Format, text.
    Off,
    /// glTF 2.0 in its binary container.
    Glb,
}

impl MeshFormat {
    /// The format's short lower-case name, as in an input's description.
    pub fn name(self) -> &'static str {
        match self {
            Self::Ply => "ply",
            Self::Obj => "obj",
            Self::Stl => "stl",
            Self::Off => "off",
            Self::Glb => "glb",
        }
    }

    /// The format that `bytes` claim to be of by their beginning, or by their length for a binary STL.
    pub fn detect(bytes: &[u8]) -> Option<Self> {
        if bytes.starts_with(b"glTF") {
            Some(Self::Glb)
        } else if bytes.starts_with(b"ply\n") || bytes.starts_with(b"ply\r") {
            Some(Self::Ply)
        } else if off::claims(bytes) {
            Some(Self::Off)
        } else if stl::claims(bytes) {
            Some(Self::Stl)
        } else if obj::claims(bytes) {
            Some(Self::Obj)
        } else {
            None
        }
    }
}

impl TriangleMesh {
    /// Reads a mesh of any known format.
    ///
    /// # Errors
    /// [`FieldError::Unrecognized`] when the bytes are of no mesh format, [`FieldError::Malformed`] with the byte where
    /// they break theirs, [`FieldError::Limit`] and [`FieldError::Unsupported`] by name.
    pub fn read(bytes: &[u8]) -> Result<Self, FieldError> {
        let format = MeshFormat::detect(bytes)
            .ok_or_else(|| FieldError::Unrecognized { detail: "not a mesh in PLY, OBJ, STL, OFF or GLB".to_owned() })?;
        let soup = match format {
            MeshFormat::Ply => ply::read(bytes)?,
            MeshFormat::Obj => obj::read(bytes)?,
            MeshFormat::Stl => stl::read(bytes)?,
            MeshFormat::Off => off::read(bytes)?,
            MeshFormat::Glb => glb::read(bytes)?,
        };
        let mesh = soup.weld();
        if mesh.triangles.is_empty() {
            return Err(malformed(format.name(), None, "the mesh has no triangle with three different corners"));
        }
        Ok(mesh)
    }

    /// Smallest and largest coordinates of the vertices.
    pub fn bounds(&self) -> ([f64; 3], [f64; 3]) {
        let mut bounds = ([f64::INFINITY; 3], [f64::NEG_INFINITY; 3]);
        for vertex in &self.vertices {
            for (axis, &c) in vertex.iter().enumerate() {
                bounds.0[axis] = bounds.0[axis].min(c);
                bounds.1[axis] = bounds.1[axis].max(c);
            }
        }
        bounds
    }
}

/// What a reader collects: vertices as they stand in the file, and triangles over them.
#[derive(Default)]
struct Soup {
    format: &'static str,
    vertices: Vec<[f64; 3]>,
    triangles: Vec<[u32; 3]>,
    /// First and second texture coordinates by vertex, for a reader that was asked for them.
    places: [Option<Vec<[f32; 2]>>; 2],
}

impl Soup {
    fn new(format: &'static str) -> Self {
        Self { format, ..Self::default() }
    }

    fn vertex(&mut self, position: [f64; 3], at: usize) -> Result<(), FieldError> {
        if self.vertices.len() == MAX_VERTICES {
            return Err(limit("vertices of a mesh", self.vertices.len() + 1, MAX_VERTICES));
        }
        if !position.iter().all(|c| c.abs() <= MAX_COORDINATE) {
            let detail = format!("vertex {} is not finite or beyond 1e30", self.vertices.len());
            return Err(malformed(self.format, Some(at), detail));
        }
        // adding zero turns -0 into +0, so that both are one place
        self.vertices.push(position.map(|c| c + 0.0));
        Ok(())
    }

    /// Adds a polygon as a fan about its first corner. `corners` are indices into the vertices, already checked.
    fn polygon(&mut self, corners: &[u32]) -> Result<(), FieldError> {
        if self.triangles.len() + corners.len().saturating_sub(2) > MAX_TRIANGLES {
            return Err(limit("triangles of a mesh", self.triangles.len() + corners.len() - 2, MAX_TRIANGLES));
        }
        for pair in corners.get(1..).unwrap_or_default().windows(2) {
            self.triangles.push([corners[0], pair[0], pair[1]]);
        }
        Ok(())
    }

    /// Merges vertices at exactly the same place, drops triangles that thereby lost a corner, and vertices that no
    /// triangle uses. Order is kept.
    fn weld(self) -> TriangleMesh {
        let mut place: HashMap<[u64; 3], u32> = HashMap::with_capacity(self.vertices.len());
        let merged: Vec<u32> = (0u32..)
            .zip(&self.vertices)
            .map(|(index, vertex)| *place.entry(vertex.map(f64::to_bits)).or_insert(index))
            .collect();
        const UNUSED: u32 = u32::MAX;
        let mut renamed = vec![UNUSED; self.vertices.len()];
        let mut mesh = TriangleMesh::default();
        for triangle in &self.triangles {
            let [a, b, c] = triangle.map(|corner| merged[corner as usize]);
            if a == b || b == c || c == a {
                continue;
            }
            let corners = [a, b, c].map(|corner| {
                let name = &mut renamed[corner as usize];
                if *name == UNUSED {
                    *name = mesh.vertices.len() as u32;
                    mesh.vertices.push(self.vertices[corner as usize]);
                }
                *name
            });
            mesh.triangles.push(corners);
        }
        mesh
    }
}

fn malformed(format: &'static str, at: Option<usize>, detail: impl Into<String>) -> FieldError {
    FieldError::Malformed { format, at: at.map(|byte| byte as u64), detail: detail.into() }
}

fn limit(what: &'static str, found: usize, limit: usize) -> FieldError {
    FieldError::Limit { what, found: found as u64, limit: limit as u64 }
}

#[cfg(test)]
mod readers_tests;
#[cfg(test)]
pub(in crate::field) mod tests;
