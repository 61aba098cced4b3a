//! A bounding volume hierarchy over axis-aligned boxes, as one flat array.
//!
//! Built top-down with the surface area heuristic over bins (Wald 2007, "On fast construction of SAH-based bounding volume
//! hierarchies"), falling back to the median where the heuristic sees no gain or the tree gets deep. The build is serial
//! and depends on nothing but the boxes.

use glam::DVec3;
use std::ops::ControlFlow;

/// An axis-aligned box.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Aabb {
    /// Smallest coordinates.
    pub min: DVec3,
    /// Largest coordinates.
    pub max: DVec3,
}

impl Aabb {
    /// The box that holds nothing.
    pub const EMPTY: Aabb = Aabb { min: DVec3::INFINITY, max: DVec3::NEG_INFINITY };

    /// The smallest box around some points.
    pub fn of(points: &[DVec3]) -> Self {
        points.iter().fold(Self::EMPTY, |b, &p| Aabb { min: b.min.min(p), max: b.max.max(p) })
    }
    /// The smallest box around both.
    pub fn union(self, other: Self) -> Self {
        Aabb { min: self.min.min(other.min), max: self.max.max(other.max) }
    }
    /// Whether the closed boxes share a point.
    pub fn overlaps(&self, other: &Self) -> bool {
        self.min.cmple(other.max).all() && other.min.cmple(self.max).all()
    }
    /// Squared distance from `p`, 0 inside.
    pub fn distance_squared(&self, p: DVec3) -> f64 {
        p.distance_squared(p.clamp(self.min, self.max))
    }
    fn half_area(&self) -> f64 {
        let d = (self.max - self.min).max(DVec3::ZERO);
        d.x * d.y + d.y * d.z + d.z * d.x
    }
}

/// A node: a leaf over `order[first..first + count]` when `count > 0`; otherwise the left child is the next node and
/// `first` is the right one.
#[derive(Clone, Copy, Debug)]
struct Node {
    bounds: Aabb,
    first: u32,
    count: u32,
}

/// A hierarchy over boxes numbered by their place in the slice it was built from.
#[derive(Clone, Debug)]
pub struct Bvh {
    nodes: Vec<Node>,
    order: Vec<u32>,
}

/// Boxes in a leaf at most, unless they cannot be told apart.
const LEAF: usize = 4;
/// Bins of the heuristic.
const BINS: usize = 16;
/// Below this depth the median is taken, so that the depth stays under `STACK` for any 2^32 boxes.
const DEEP: usize = 32;
/// Entries of a traversal stack: `DEEP` levels of the heuristic, then at most 32 halvings, and one spare per level.
const STACK: usize = 72;

impl Bvh {
    /// Builds the hierarchy. Boxes must be finite and fewer than 2^32.
    pub fn new(boxes: &[Aabb]) -> Self {
        let mut order: Vec<u32> = (0..boxes.len() as u32).collect();
        let mut nodes = Vec::with_capacity(boxes.len().max(1));
        if !boxes.is_empty() {
            let centers: Vec<DVec3> = boxes.iter().map(|b| 0.5 * (b.min + b.max)).collect();
            build(boxes, &centers, &mut order, 0, 0, &mut nodes);
        }
        Self { nodes, order }
    }

    /// Calls `visit` with every box index whose leaf overlaps `query` (a superset of the boxes that overlap it), until it breaks off.
    pub fn overlapping(&self, query: &Aabb, mut visit: impl FnMut(u32) -> ControlFlow<()>) {
        let (mut stack, mut top) = ([0u32; STACK], 0);
        let mut at = 0u32;
        if self.nodes.is_empty() {
            return;
        }
        loop {
            let node = &self.nodes[at as usize];
            if node.bounds.overlaps(query) {
                if node.count == 0 {
                    stack[top] = node.first;
                    top += 1;
                    at += 1;
                    continue;
                }
                for &i in &self.order[node.first as usize..(node.first + node.count) as usize] {
                    if visit(i).is_break() {
                        return;
                    }
                }
            }
            if top == 0 {
                return;
            }
            top -= 1;
            at = stack[top];
        }
    }

    /// The index with the smallest `distance_squared(index)`, among those below `bound`; nearer subtrees first. Ties go to
    /// the one met first, which depends on nothing but the tree and `p`.
    pub fn nearest(&self, p: DVec3, bound: f64, mut distance_squared: impl FnMut(u32) -> f64) -> Option<(u32, f64)> {
        let (mut stack, mut top) = ([(0u32, 0.0f64); STACK], 0);
        let (mut best, mut found) = (bound, None);
        if self.nodes.is_empty() {
            return None;
        }
        let mut at = 0u32;
        let mut gap = self.nodes[0].bounds.distance_squared(p);
        loop {
            if gap < best {
                let node = &self.nodes[at as usize];
                if node.count == 0 {
                    let (left, right) = (at + 1, node.first);
                    let dl = self.nodes[left as usize].bounds.distance_squared(p);
                    let dr = self.nodes[right as usize].bounds.distance_squared(p);
                    let (near, near_gap, far, far_gap) =
                        if dl <= dr { (left, dl, right, dr) } else { (right, dr, left, dl) };
                    stack[top] = (far, far_gap);
                    top += 1;
                    (at, gap) = (near, near_gap);
                    continue;
                }
                for &i in &self.order[node.first as usize..(node.first + node.count) as usize] {
                    let d = distance_squared(i);
                    if d < best {
                        (best, found) = (d, Some(i));
                    }
                }
            }
            if top == 0 {
                return found.map(|i| (i, best));
            }
            top -= 1;
            (at, gap) = stack[top];
        }
    }
}

fn build(boxes: &[Aabb], centers: &[DVec3], order: &mut [u32], offset: usize, depth: usize, nodes: &mut Vec<Node>) {
    let bounds = order.iter().fold(Aabb::EMPTY, |b, &i| b.union(boxes[i as usize]));
    let index = nodes.len();
    nodes.push(Node { bounds, first: offset as u32, count: order.len() as u32 });
    if order.len() <= LEAF {
        return;
    }
    let middle = if depth < DEEP { split_by_area(boxes, centers, order) } else { None };
    let middle = middle.unwrap_or_else(|| split_by_median(centers, order));
    let (left, right) = order.split_at_mut(middle);
    build(boxes, centers, left, offset, depth + 1, nodes);
    let second = nodes.len();
    build(boxes, centers, right, offset + middle, depth + 1, nodes);
    nodes[index].first = second as u32;
    nodes[index].count = 0;
}

fn center_bounds(centers: &[DVec3], order: &[u32]) -> Aabb {
    order.iter().fold(Aabb::EMPTY, |b, &i| {
        let c = centers[i as usize];
        Aabb { min: b.min.min(c), max: b.max.max(c) }
    })
}

/// Halves the boxes along the widest axis of their centres.
fn split_by_median(centers: &[DVec3], order: &mut [u32]) -> usize {
    let extent = center_bounds(centers, order);
    let axis = (extent.max - extent.min).max_position();
    let middle = order.len() / 2;
    order.select_nth_unstable_by(middle, |&i, &j| {
        centers[i as usize][axis].total_cmp(&centers[j as usize][axis]).then(i.cmp(&j))
    });
    middle
}

/// Parts the boxes at the bin border of least expected cost; `None` when all centres coincide.
fn split_by_area(boxes: &[Aabb], centers: &[DVec3], order: &mut [u32]) -> Option<usize> {
    let extent = center_bounds(centers, order);
    let size = extent.max - extent.min;
    let bin =
        |c: DVec3, axis: usize| (((c[axis] - extent.min[axis]) / size[axis] * BINS as f64) as usize).min(BINS - 1);
    let mut best: Option<(f64, usize, usize)> = None;
    for axis in 0..3 {
        if size[axis] <= 0.0 || !size[axis].is_finite() {
            continue;
        }
        let mut bins = [(Aabb::EMPTY, 0usize); BINS];
        for &i in order.iter() {
            let slot = &mut bins[bin(centers[i as usize], axis)];
            slot.0 = slot.0.union(boxes[i as usize]);
            slot.1 += 1;
        }
        let mut below = [0.0; BINS];
        let (mut sweep, mut count) = (Aabb::EMPTY, 0);
        for k in 0..BINS - 1 {
            sweep = sweep.union(bins[k].0);
            count += bins[k].1;
            below[k] = if count == 0 { 0.0 } else { sweep.half_area() * count as f64 };
        }
        let (mut sweep, mut above) = (Aabb::EMPTY, 0);
        for k in (1..BINS).rev() {
            sweep = sweep.union(bins[k].0);
            above += bins[k].1;
            if above == 0 || above == order.len() {
                continue;
            }
            let cost = below[k - 1] + sweep.half_area() * above as f64;
            if best.is_none_or(|b| cost < b.0) {
                best = Some((cost, axis, k));
            }
        }
    }
    let (_, axis, border) = best?;
    // a stable partition, so that the order depends on the boxes alone
    let (mut left, mut right) = (Vec::with_capacity(order.len()), Vec::new());
    for &i in order.iter() {
        if bin(centers[i as usize], axis) < border { left.push(i) } else { right.push(i) }
    }
    let middle = left.len();
    order[..middle].copy_from_slice(&left);
    order[middle..].copy_from_slice(&right);
    Some(middle)
}
