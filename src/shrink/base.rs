//! The base surface: the contracted front, remeshed to an even triangulation on the zero level set. Every vertex stays on
//! its own sheet, so thin walls and narrow gaps keep their two sides.

use super::contract::Front;
use super::remesh::remesh;
use super::rings::Mesh;
use super::zero::own_sheet;
use crate::field::Sampler;
use crate::settings::Canceled;
use glam::DVec3;

/// Remeshes `front` to about `vertices` vertices on the zero level set.
pub fn base(front: Front, vertices: usize, sampler: &Sampler<'_>) -> Result<Mesh, Canceled> {
    let mut mesh = front.mesh;
    // the front's staircase makes its area about 5 % too large
    let area = 0.95 * mesh.area();
    let target = (area * 2.0 / (3f64.sqrt() * vertices as f64)).sqrt();
    for round in 0..3 {
        // the front's own staircase may turn freely, later rounds may not
        let (turn, guard) = if round == 0 { (-0.2, -0.5) } else { (0.3, 0.0) };
        remesh(&mut mesh, target, 0.6, turn, sampler.settings().cancel)?;
        if round == 0 {
            remesh(&mut mesh, target, 0.6, turn, sampler.settings().cancel)?;
        }
        onto_zero(&mut mesh, sampler, target, guard)?;
    }
    Ok(mesh)
}

/// Moves every vertex onto its own sheet of the zero level set.
fn onto_zero(mesh: &mut Mesh, sampler: &Sampler<'_>, reach: f64, turn: f64) -> Result<(), Canceled> {
    let normals: Vec<DVec3> = (0..mesh.positions.len() as u32).map(|v| mesh.vertex_normal(v)).collect();
    let targets = own_sheet(sampler, &mesh.positions, &normals, reach)?;
    for (v, target) in targets.into_iter().enumerate() {
        mesh.move_vertex(v as u32, target, turn);
    }
    Ok(())
}
