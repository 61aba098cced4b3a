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

/// Costs of collapsing a vertex into each of its neighbours, with what is needed to compute them.
struct Costs<'a> {
    mesh: &'a Mesh,
    quadrics: Vec<Quadric>,
    /// Weight of an edge's squared length.
    length_weight: f64,
    /// Area vectors, twice, of the triangles around the vertex; reused.
    normals: Vec<DVec3>,
    /// Cost and neighbour; reused.
    choices: Vec<(f64, u32)>,
}

impl<'a> Costs<'a> {
    fn new(mesh: &'a Mesh) -> Self {
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
        Self { mesh, quadrics, length_weight: area / n as f64, normals: Vec::new(), choices: Vec::new() }
    }

    /// The cheapest neighbour that `v` can be collapsed into.
    fn cheapest(&mut self, rings: &Rings, v: u32) -> Option<(f64, u32)> {
        let (ring, positions) = (rings.ring(v), &self.mesh.positions);
        let next = |i: usize| if i + 1 < ring.len() { ring[i + 1] } else { ring[0] };
        self.normals.clear();
        self.normals.extend((0..ring.len()).map(|i| self.mesh.normal([v, ring[i], next(i)])));
        self.choices.clear();
        for &w in ring {
            let cost = self.cost(rings, v, w, positions[w as usize]);
            self.choices.push((cost, w));
        }
        // few neighbours are not collapsible, and to know it takes longer than to know the cost
        while let Some(k) = (0..self.choices.len()).min_by(|&a, &b| self.choices[a].0.total_cmp(&self.choices[b].0)) {
            if rings.collapsible(v, self.choices[k].1) {
                return Some(self.choices[k]);
            }
            self.choices.swap_remove(k);
        }
        None
    }

    /// Quadric plus squared length, worse for slivers, folds and high valence.
    fn cost(&self, rings: &Rings, v: u32, w: u32, to: DVec3) -> f64 {
        /// A triangle that turns by more than the angle of this cosine is folded.
        const TURN: f64 = 0.2;
        let (ring, positions) = (rings.ring(v), &self.mesh.positions);
        // the largest squared ratio of edges to area, and 1 for an equilateral triangle
        let (mut aspect, mut folds) = (1.0f64, 0);
        for (i, &a) in ring.iter().enumerate() {
            let b = if i + 1 < ring.len() { ring[i + 1] } else { ring[0] };
            if a == w || b == w {
                continue;
            }
            let (pa, pb) = (positions[a as usize] - to, positions[b as usize] - to);
            let (after, before) = (pa.cross(pb), self.normals[i]);
            let edges = pa.distance_squared(pb) + pa.length_squared() + pb.length_squared();
            let (squared, edges) = (after.length_squared(), edges * edges);
            aspect = aspect.max(edges / (12.0 * squared).max(1e-18 * edges));
            let along = before.dot(after);
            folds += i32::from(along < 0.0 || along * along < TURN * TURN * before.length_squared() * squared);
        }
        let squared = to.distance_squared(positions[v as usize]);
        let quadric = self.quadrics[v as usize].at(to) + self.quadrics[w as usize].at(to);
        let mut cost = (quadric.max(0.0) + self.length_weight * squared) * (1.0 + 0.1 * aspect.sqrt().min(100.0));
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
    }
}

/// Target of a vertex that waits for its surroundings to change, because it cannot be collapsed as they are.
const NONE: u32 = u32::MAX;

/// The vertices in the order of their costs.
struct Queue {
    heap: BinaryHeap<Candidate>,
    /// A candidate whose stamp is not its vertex's own is out of date.
    stamps: Vec<u32>,
    targets: Vec<u32>,
    /// Whether a vertex's surroundings have changed since it was looked at.
    stale: Vec<bool>,
}

impl Queue {
    fn new(vertices: usize) -> Self {
        let heap = BinaryHeap::new();
        Self { heap, stamps: vec![0; vertices], targets: vec![NONE; vertices], stale: vec![false; vertices] }
    }
    fn push(&mut self, v: u32, target: u32, cost: f64) {
        self.targets[v as usize] = target;
        self.heap.push(Candidate { cost, vertex: v, stamp: self.stamps[v as usize] });
    }
    /// Gives a vertex the place that its cheapest collapse has now.
    fn look_at(&mut self, costs: &mut Costs<'_>, rings: &Rings, v: u32) {
        self.stamps[v as usize] += 1;
        self.stale[v as usize] = false;
        self.targets[v as usize] = NONE;
        if let Some((cost, target)) = costs.cheapest(rings, v) {
            self.push(v, target, cost);
        }
    }
    /// Notes that the surroundings of a vertex have changed. One that waited for that gets its turn, at `target` for a start.
    fn touch(&mut self, v: u32, target: u32) {
        self.stale[v as usize] = true;
        if self.targets[v as usize] == NONE {
            self.stamps[v as usize] += 1;
            self.push(v, target, 0.0);
        }
    }
}

/// Collapses to four vertices, about the cheapest half-edge first: a vertex whose surroundings have changed is looked at
/// again when its turn comes, for most changes make it dearer. `None` when that is impossible.
pub fn decimate(mesh: &Mesh, rings: &mut Rings, cancel: &CancelToken) -> Result<Option<Vec<Collapse>>, Canceled> {
    let n = mesh.positions.len();
    let (mut costs, mut queue) = (Costs::new(mesh), Queue::new(n));
    let mut log = Vec::with_capacity(n);
    let mut alive = (0..n as u32).filter(|&v| rings.alive(v)).count();
    let mut refilled_at = usize::MAX;
    while alive > 4 {
        let Some(Candidate { vertex: v, stamp, .. }) = queue.heap.pop() else {
            // edges become collapsible again when links change farther away
            if refilled_at == alive {
                return Ok(None);
            }
            refilled_at = alive;
            for v in (0..n as u32).filter(|&v| rings.alive(v)) {
                if v.is_multiple_of(1024) {
                    cancel.check()?;
                }
                queue.look_at(&mut costs, rings, v);
            }
            continue;
        };
        if !rings.alive(v) || stamp != queue.stamps[v as usize] {
            continue;
        }
        let w = queue.targets[v as usize];
        if queue.stale[v as usize] || !rings.joined(v, w) || !rings.collapsible(v, w) {
            queue.look_at(&mut costs, rings, v);
            continue;
        }
        log.push((v, rings.collapse(v, w)));
        let gone = costs.quadrics[v as usize];
        costs.quadrics[w as usize].add(&gone);
        alive -= 1;
        if alive.is_multiple_of(256) {
            cancel.check()?;
        }
        for &u in rings.ring(w).iter().chain([&w]) {
            queue.touch(u, w);
        }
    }
    Ok(Some(log))
}
