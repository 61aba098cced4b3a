//! What stands in the way: components and handles of the solid, counted on the lattice after a contraction got stuck.

use super::ShrinkError;
use super::grid3::{Grid3, NEIGHBOURS};
use crate::field::Frame;
use glam::{DVec3, IVec3};

/// Places named in an error, at most.
pub(super) const PLACES: usize = 16;

/// Names why nodes farther outside than `limit` had to stay inside: more than one component (or a void), or handles.
/// `Ok` when neither is found.
pub fn explain(grid: &Grid3, values: &[f32], inside: &[bool], limit: f32, frame: Frame) -> Result<(), ShrinkError> {
    let solid: Vec<bool> = (0..grid.len()).map(|i| inside[i] && values[i] <= limit).collect();
    let stuck: Vec<bool> = (0..grid.len()).map(|i| inside[i] && values[i] > limit).collect();
    let outside: Vec<bool> = solid.iter().map(|s| !s).collect();
    let mut bodies = clusters(grid, &solid);
    // the outside that touches the border is one cluster; every other one is a void
    let voids: Vec<Vec<usize>> =
        clusters(grid, &outside).into_iter().filter(|c| !c.iter().any(|&i| grid.on_border(i))).collect();
    bodies.sort_by_key(|c| std::cmp::Reverse(c.len()));
    let place = |cluster: &Vec<usize>| middle(grid, cluster, frame);
    if bodies.len() + voids.len() > 1 {
        let places = bodies.iter().chain(&voids).take(PLACES).map(place).collect();
        return Err(ShrinkError::Components { count: bodies.len() + voids.len(), places });
    }
    let genus = 1 - euler(grid, &solid);
    if genus > 0 {
        let places = clusters(grid, &stuck).iter().take(PLACES).map(place).collect();
        return Err(ShrinkError::Genus { genus: genus as usize, places });
    }
    Ok(())
}

/// The node of a cluster that is nearest to its center, in scene units.
pub(super) fn middle(grid: &Grid3, cluster: &[usize], frame: Frame) -> [f64; 3] {
    let center = cluster.iter().map(|&i| grid.position(i)).sum::<DVec3>() / cluster.len().max(1) as f64;
    let nearest = cluster
        .iter()
        .map(|&i| grid.position(i))
        .min_by(|a, b| a.distance_squared(center).total_cmp(&b.distance_squared(center)))
        .unwrap_or(center);
    frame.to_scene(nearest).to_array()
}

/// Connected sets of nodes in the Freudenthal lattice.
pub(super) fn clusters(grid: &Grid3, set: &[bool]) -> Vec<Vec<usize>> {
    let mut seen = vec![false; grid.len()];
    let mut list = Vec::new();
    for start in 0..grid.len() {
        if !set[start] || seen[start] {
            continue;
        }
        seen[start] = true;
        let mut cluster = vec![start];
        let mut next = 0;
        while next < cluster.len() {
            let here = grid.place(cluster[next]);
            next += 1;
            for offset in NEIGHBOURS {
                if let Some(j) = neighbour(grid, here, offset)
                    && set[j]
                    && !seen[j]
                {
                    seen[j] = true;
                    cluster.push(j);
                }
            }
        }
        list.push(cluster);
    }
    list
}

pub(super) fn neighbour(grid: &Grid3, here: [usize; 3], offset: IVec3) -> Option<usize> {
    let mut to = [0usize; 3];
    for k in 0..3 {
        to[k] = here[k].checked_add_signed(offset[k] as isize).filter(|&c| c < grid.nodes[k])?;
    }
    Some(grid.index(to[0], to[1], to[2]))
}

/// Euler characteristic of the Freudenthal complex that a set of nodes spans.
pub(super) fn euler(grid: &Grid3, set: &[bool]) -> i64 {
    // chains of the seven positive steps: an edge is one step, a triangle two nested ones, a tetrahedron three
    let steps = &NEIGHBOURS[..7];
    let nested = |a: IVec3, b: IVec3| a != b && (b - a).min_element() >= 0;
    let mut chi = 0;
    for i in (0..grid.len()).filter(|&i| set[i]) {
        let here = grid.place(i);
        chi += 1;
        let present: Vec<IVec3> =
            steps.iter().copied().filter(|&o| neighbour(grid, here, o).is_some_and(|j| set[j])).collect();
        chi -= present.len() as i64;
        for &a in &present {
            for &b in present.iter().filter(|&&b| nested(a, b)) {
                chi += 1;
                chi -= present.iter().filter(|&&c| nested(b, c)).count() as i64;
            }
        }
    }
    chi
}
