//! What stands in the way: components and handles of the solid, counted on the lattice after a contraction got stuck.

use super::ShrinkError;
use super::complex::Complex;
use crate::field::Frame;
use glam::DVec3;

/// Places named in an error, at most.
pub(super) const PLACES: usize = 16;

/// Names why the nodes that are `far` outside had to stay inside: more than one component (or a void), or handles.
/// `Ok` when neither is found.
pub fn explain(complex: &Complex, far: &[bool], inside: &[bool], frame: Frame) -> Result<(), ShrinkError> {
    let solid: Vec<bool> = inside.iter().zip(far).map(|(inside, far)| *inside && !far).collect();
    let outside: Vec<bool> = solid.iter().map(|s| !s).collect();
    let mut bodies = complex.clusters(&solid);
    // the outside that touches the border is one cluster; every other one is a void
    let voids: Vec<Vec<usize>> =
        complex.clusters(&outside).into_iter().filter(|c| !c.iter().any(|&i| complex.border[i])).collect();
    bodies.sort_by_key(|c| std::cmp::Reverse(c.len()));
    let place = |cluster: &Vec<usize>| middle(complex, cluster, frame);
    if bodies.len() + voids.len() > 1 {
        let places = bodies.iter().chain(&voids).take(PLACES).map(place).collect();
        return Err(ShrinkError::Components { solids: bodies.len(), voids: voids.len(), places });
    }
    let genus = 1 - complex.euler(&solid);
    if genus > 0 {
        let places = complex.clusters(far).iter().take(PLACES).map(place).collect();
        return Err(ShrinkError::Genus { genus: genus as usize, places });
    }
    Ok(())
}

/// The node of a cluster that is nearest to its center, in scene units.
pub(super) fn middle(complex: &Complex, cluster: &[usize], frame: Frame) -> [f64; 3] {
    let center = cluster.iter().map(|&i| complex.positions[i]).sum::<DVec3>() / cluster.len().max(1) as f64;
    let nearest = cluster
        .iter()
        .map(|&i| complex.positions[i])
        .min_by(|a, b| a.distance_squared(center).total_cmp(&b.distance_squared(center)))
        .unwrap_or(center);
    frame.to_scene(nearest).to_array()
}
