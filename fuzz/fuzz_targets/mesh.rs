//! Any bytes as a mesh (PLY, OBJ, STL, OFF, GLB): an answer or an error, never a panic; indices stay in range, and what bounds
//! a solid has a distance.
#![no_main]

#[path = "common/field.rs"]
mod field;

use libfuzzer_sys::fuzz_target;
use shrinkd::field::mesh::{ChartedMesh, MeshField, TriangleMesh};

fuzz_target!(|bytes: &[u8]| {
    if let Ok(Some(mesh)) = ChartedMesh::read(bytes) {
        assert_eq!(mesh.uv.len(), mesh.vertices.len());
        assert!(mesh.triangles.iter().flatten().all(|&v| (v as usize) < mesh.vertices.len()));
    }
    let Ok(mesh) = TriangleMesh::read(bytes) else { return };
    assert!(mesh.triangles.iter().flatten().all(|&v| (v as usize) < mesh.vertices.len()));
    if let Ok(distance) = MeshField::new(mesh) {
        field::keeps_its_promises(&distance);
    }
});
