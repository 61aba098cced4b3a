//! The base surface: the contracted front, remeshed to an even triangulation that lies on the zero level set and has no
//! fold.

use super::contract::Front;
use super::energy::Reference;
use super::remesh::remesh;
use super::rings::Mesh;
use super::unfold::{Corners, Problem, grow, relax, smooth};
use super::zero::step_to_zero;
use crate::field::Sampler;
use crate::settings::Canceled;
use glam::DVec3;

/// A triangle is folded where its unit normal times the field's unit gradient is at most this.
const FOLDED: f64 = 0.05;

/// Remeshes `front` to about `vertices` vertices on the zero level set. Returns the mesh and how many folded triangles
/// are left.
pub fn base(front: Front, vertices: usize, sampler: &Sampler<'_>) -> Result<(Mesh, usize), Canceled> {
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
    unfold(mesh, target, sampler)
}

fn onto_zero(mesh: &mut Mesh, sampler: &Sampler<'_>, reach: f64, turn: f64) -> Result<(), Canceled> {
    let (values, gradients) = sampler.gradients(&mesh.positions)?;
    let targets: Vec<DVec3> =
        (0..values.len()).map(|i| mesh.positions[i] + step_to_zero(values[i], gradients[i], reach)).collect();
    mesh.move_towards(&targets, turn);
    Ok(())
}

/// Relaxes the neighbourhoods of folded triangles, keeping the best mesh seen.
fn unfold(mut mesh: Mesh, target: f64, sampler: &Sampler<'_>) -> Result<(Mesh, usize), Canceled> {
    const ROUNDS: usize = 10;
    let mut best: Option<(usize, Mesh)> = None;
    for round in 0..ROUNDS {
        let triangles = mesh.rings.triangles();
        let centroids: Vec<DVec3> =
            triangles.iter().map(|t| t.iter().map(|&v| mesh.positions[v as usize]).sum::<DVec3>() / 3.0).collect();
        let (_, mut targets) = sampler.gradients(&centroids)?;
        let mut mask = vec![false; mesh.positions.len()];
        let mut folded = 0;
        for (t, target) in triangles.iter().zip(&mut targets) {
            *target = target.normalize_or_zero();
            let along = mesh.normal(*t).normalize_or_zero().dot(*target);
            folded += usize::from(along <= 0.0);
            if along <= FOLDED {
                for &v in t {
                    mask[v as usize] = true;
                }
            }
        }
        let worse = best.as_ref().is_some_and(|b| folded > 2 * b.0 + 50);
        if best.as_ref().is_none_or(|b| folded < b.0) {
            best = Some((folded, mesh.clone()));
        }
        if folded == 0 || worse || round + 1 == ROUNDS {
            break;
        }
        let before = mesh.positions.clone();
        let corners = Corners::new(mesh.positions.len(), &triangles);
        // every fourth round shakes the places loose that the energy cannot open
        let shake = round % 4 == 3;
        if shake {
            for _ in 0..4 {
                smooth(&mut mesh.positions, &triangles, &corners, &mask, 0.7);
            }
        } else {
            grow(&mut mask, &triangles, 2);
        }
        let active: Vec<u32> = (0..mask.len() as u32).filter(|&v| mask[v as usize]).collect();
        if !shake {
            let mut rim = mask.clone();
            grow(&mut rim, &triangles, 1);
            let around: Vec<u32> = (0..rim.len() as u32).filter(|&v| rim[v as usize]).collect();
            let points: Vec<DVec3> = around.iter().map(|&v| mesh.positions[v as usize]).collect();
            let (_, gradients) = sampler.gradients(&points)?;
            let mut normals = vec![DVec3::Z; mesh.positions.len()];
            for (&v, g) in around.iter().zip(gradients) {
                normals[v as usize] = g.normalize_or(DVec3::Z);
            }
            sampler.settings().cancel.check()?;
            mix_targets(&mut targets, &triangles, &mask, &normals);
            relax(
                &Problem {
                    triangles: &triangles,
                    corners: &corners,
                    reference: &|_, _| Reference::equilateral(target),
                    targets: &targets,
                    normals: &normals,
                    anchors: None,
                    epsilon: 0.1,
                },
                &mut mesh.positions,
                &active,
                4,
            );
        }
        let points: Vec<DVec3> = active.iter().map(|&v| mesh.positions[v as usize]).collect();
        let (values, gradients) = sampler.gradients(&points)?;
        for (k, &v) in active.iter().enumerate() {
            let moved = points[k] + step_to_zero(values[k], gradients[k], target);
            mesh.positions[v as usize] = before[v as usize] + (moved - before[v as usize]).clamp_length_max(target);
        }
        remesh(&mut mesh, target, 0.0, 0.2, sampler.settings().cancel)?;
        onto_zero(&mut mesh, sampler, target, -0.2)?;
    }
    Ok(best.map_or((mesh, 0), |(folded, mesh)| (mesh, folded)))
}

/// Adds the mean of the corners' normals to the targets of the triangles that `mask` touches.
pub fn mix_targets(targets: &mut [DVec3], triangles: &[[u32; 3]], mask: &[bool], normals: &[DVec3]) {
    for (t, target) in triangles.iter().zip(targets) {
        if t.iter().any(|&v| mask[v as usize]) {
            let mean = t.iter().map(|&v| normals[v as usize]).sum::<DVec3>().normalize_or_zero();
            *target = (*target + mean).normalize_or(mean);
        }
    }
}
