//! Decimation to a tetrahedron with a log that can be taken back.

use super::super::energy::add_outer;
use super::super::rings::{Mesh, Rings};
use crate::settings::{CancelToken, Canceled};
use glam::{DMat3, DVec3};
use std::cmp::Ordering;
use std::collections::BinaryHeap;

/// A collapsed vertex and its ring, from the vertex it went into.
pub type Collapse = (u32, Vec<u32>);

#[derive(PartialEq)]
struct Candidate {
    cost: f64,
    vertex: u32,
    stamp: u32,
}
impl Eq for Candidate {}
impl PartialOrd for Candidate {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}
impl Ord for Candidate {
    fn cmp(&self, other: &Self) -> Ordering {
        // the heap's top is the cheapest; equal costs go by vertex number
        other.cost.total_cmp(&self.cost).then(other.vertex.cmp(&self.vertex))
    }
}

/// A symmetric 4 x 4 form: squared distance to planes (Garland and Heckbert 1997).
#[derive(Clone, Copy, Default)]
struct Quadric {
    quadratic: DMat3,
    linear: DVec3,
    constant: f64,
}
impl Quadric {
    fn add_plane(&mut self, normal: DVec3, point: DVec3, weight: f64) {
        let offset = -normal.dot(point);
        add_outer(&mut self.quadratic, normal, normal, weight);
        self.linear += weight * offset * normal;
        self.constant += weight * offset * offset;
    }
    fn add(&mut self, other: &Quadric) {
        self.quadratic += other.quadratic;
        self.linear += other.linear;
        self.constant += other.constant;
    }
    fn at(&self, p: DVec3) -> f64 {
        p.dot(self.quadratic * p) + 2.0 * self.linear.dot(p) + self.constant
    }
}

/// Collapses to four vertices, cheapest half-edge first (quadric plus squared length, worse for slivers, folds and high
/// valence). `None` when that is impossible.
pub fn decimate(mesh: &Mesh, rings: &mut Rings, cancel: &CancelToken) -> Result<Option<Vec<Collapse>>, Canceled> {
    let n = mesh.positions.len();
    let (mut quadrics, mut area) = (vec![Quadric::default(); n], 0.0);
    for t in mesh.rings.triangles() {
        let normal = mesh.normal(t);
        let a = 0.5 * normal.length();
        area += a;
        for v in t {
            quadrics[v as usize].add_plane(normal.normalize_or_zero(), mesh.positions[t[0] as usize], a);
        }
    }
    let length_weight = area / n as f64;
    let cost = |rings: &Rings, quadrics: &[Quadric], v: u32, w: u32| -> f64 {
        let to = mesh.positions[w as usize];
        let mut quadric = quadrics[v as usize];
        quadric.add(&quadrics[w as usize]);
        let ring = rings.ring(v);
        let (mut aspect, mut folds) = (1.0f64, 0);
        for (i, &a) in ring.iter().enumerate() {
            let b = ring[(i + 1) % ring.len()];
            if a == w || b == w {
                continue;
            }
            let (pa, pb) = (mesh.positions[a as usize], mesh.positions[b as usize]);
            let (after, before) = ((pa - to).cross(pb - to), mesh.normal([v, a, b]));
            let edges = pa.distance_squared(pb) + pa.distance_squared(to) + pb.distance_squared(to);
            // 1 for an equilateral triangle
            aspect = aspect.max(edges / (12f64.sqrt() * after.length()).max(1e-9 * edges));
            folds += i32::from(before.dot(after) < 0.2 * before.length() * after.length());
        }
        let squared = to.distance_squared(mesh.positions[v as usize]);
        let mut cost = (quadric.at(to).max(0.0) + length_weight * squared) * (1.0 + 0.1 * aspect.min(100.0));
        let merged = ring.len() + rings.valence(w) - 4;
        for valence in [merged, ring.len()] {
            if valence > 9 {
                cost *= 1.0 + ((valence - 9) as f64).powi(2);
            }
        }
        if folds > 0 {
            cost *= 50.0 * f64::from(1 + folds);
        }
        cost + 1e-30 * squared
    };
    let cheapest = |rings: &Rings, quadrics: &[Quadric], v: u32| -> Option<(f64, u32)> {
        let choices = rings.ring(v).iter().filter(|&&w| rings.collapsible(v, w));
        choices.map(|&w| (cost(rings, quadrics, v, w), w)).min_by(|a, b| a.0.total_cmp(&b.0))
    };
    let (mut stamps, mut targets) = (vec![0u32; n], vec![u32::MAX; n]);
    let mut heap = BinaryHeap::new();
    let mut log = Vec::with_capacity(n);
    let mut alive = (0..n as u32).filter(|&v| rings.alive(v)).count();
    let mut refilled_at = usize::MAX;
    while alive > 4 {
        let Some(Candidate { vertex: v, stamp, .. }) = heap.pop() else {
            // edges become collapsible again when links change farther away
            if refilled_at == alive {
                return Ok(None);
            }
            refilled_at = alive;
            for v in (0..n as u32).filter(|&v| rings.alive(v)) {
                if v.is_multiple_of(1024) {
                    cancel.check()?;
                }
                stamps[v as usize] += 1;
                if let Some((cost, w)) = cheapest(rings, &quadrics, v) {
                    targets[v as usize] = w;
                    heap.push(Candidate { cost, vertex: v, stamp: stamps[v as usize] });
                }
            }
            continue;
        };
        if !rings.alive(v) || stamp != stamps[v as usize] {
            continue;
        }
        let w = targets[v as usize];
        let mut touched = vec![v];
        if rings.joined(v, w) && rings.collapsible(v, w) {
            log.push((v, rings.collapse(v, w)));
            let gone = quadrics[v as usize];
            quadrics[w as usize].add(&gone);
            alive -= 1;
            if alive.is_multiple_of(256) {
                cancel.check()?;
            }
            touched = rings.ring(w).to_vec();
            touched.push(w);
        }
        for u in touched {
            stamps[u as usize] += 1;
            if let Some((cost, x)) = cheapest(rings, &quadrics, u) {
                targets[u as usize] = x;
                heap.push(Candidate { cost, vertex: u, stamp: stamps[u as usize] });
            }
        }
    }
    Ok(Some(log))
}
