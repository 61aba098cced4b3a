//! Triangle meshes: reading them, and their exact signed distance.

/// A closed triangle mesh in scene units, vertices shared between triangles, counter-clockwise outward.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct TriangleMesh {
    /// Vertex positions.
    pub vertices: Vec<[f64; 3]>,
    /// Triangles, indices into `vertices`.
    pub triangles: Vec<[u32; 3]>,
}
