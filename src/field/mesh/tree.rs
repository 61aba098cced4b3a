//! A bounding-volume tree for nearest-point queries on many small triangles.
//!
//! Nodes have four children whose boxes are `f32`, rounded outward: one node is two cache lines and one pass of vector
//! instructions. Boxes only exclude; every distance that is compared is computed by the caller in `f64`.

use glam::DVec3;

/// Triangles in a leaf.
const LEAF: usize = 4;
/// Bins per axis of the surface area heuristic (I. Wald, On fast construction of SAH-based bounding volume hierarchies,
/// 2007).
const BINS: usize = 12;
/// Below this depth splits are at the median, so that no arrangement of triangles makes a deep tree.
const MAX_UNEVEN_DEPTH: usize = 40;
/// Room for the children that wait: three for each level, and a median split halves what is left at every second step.
const STACK: usize = 256;
/// Boxes grow by this share of the largest coordinate, which covers the rounding of boxes and points to `f32`.
const GROWN: f64 = 4e-7;
/// Squared distances to boxes are taken this much smaller, which covers their own rounding.
const SHORTENED: f32 = 1.0 - 4e-6;
/// Marks a child that is a leaf: the bits below are its first triangle, and its number of triangles less one.
const IS_LEAF: u32 = 1 << 31;
/// Marks a child that is not there.
const ABSENT: u32 = u32::MAX;

#[derive(Clone, Copy)]
#[repr(align(64))]
struct Node {
    low: [[f32; 4]; 3],
    high: [[f32; 4]; 3],
    children: [u32; 4],
}

/// The tree. Leaves name places in an order of the triangles that [`Tree::build`] returns.
pub(super) struct Tree {
    nodes: Vec<Node>,
}

#[derive(Clone, Copy)]
struct Hull {
    low: DVec3,
    high: DVec3,
}

impl Hull {
    const EMPTY: Hull = Hull { low: DVec3::INFINITY, high: DVec3::NEG_INFINITY };
    fn join(self, other: Hull) -> Hull {
        Hull { low: self.low.min(other.low), high: self.high.max(other.high) }
    }
    fn half_area(self) -> f64 {
        let d = (self.high - self.low).max(DVec3::ZERO);
        d.x * d.y + d.y * d.z + d.z * d.x
    }
}

struct Item {
    hull: Hull,
    middle: DVec3,
    triangle: u32,
}

impl Tree {
    /// A tree over triangles given by their corners, and the order of the triangles that its leaves speak of.
    pub fn build(triangles: impl Iterator<Item = [DVec3; 3]>) -> (Self, Vec<u32>) {
        let mut items: Vec<Item> = (0u32..)
            .zip(triangles)
            .map(|(triangle, [a, b, c])| {
                let hull = Hull { low: a.min(b).min(c), high: a.max(b).max(c) };
                Item { hull, middle: 0.5 * (hull.low + hull.high), triangle }
            })
            .collect();
        let whole = items.iter().fold(Hull::EMPTY, |h, item| h.join(item.hull));
        let margin = GROWN * whole.low.abs().max(whole.high.abs()).max_element();
        let mut tree = Self { nodes: Vec::with_capacity(items.len() / 4 + 1) };
        let count = items.len();
        tree.node(&mut items, 0..count, 0, margin);
        (tree, items.iter().map(|item| item.triangle).collect())
    }

    /// Adds the node over a range and all below it; returns its index.
    fn node(&mut self, items: &mut [Item], range: std::ops::Range<usize>, depth: usize, margin: f64) -> u32 {
        let mut parts = vec![range];
        while parts.len() < 4 {
            // the part with the most triangles is split next
            let Some(largest) = (0..parts.len()).filter(|&i| parts[i].len() > LEAF).max_by_key(|&i| parts[i].len())
            else {
                break;
            };
            let part = parts[largest].clone();
            let middle = part.start + split(&mut items[part.clone()], depth >= MAX_UNEVEN_DEPTH);
            parts[largest] = part.start..middle;
            parts.insert(largest + 1, middle..part.end);
        }
        let index = self.nodes.len();
        let empty = Node { low: [[f32::INFINITY; 4]; 3], high: [[f32::INFINITY; 4]; 3], children: [ABSENT; 4] };
        self.nodes.push(empty);
        for (slot, part) in parts.into_iter().enumerate() {
            let hull = items[part.clone()].iter().fold(Hull::EMPTY, |h, item| h.join(item.hull));
            for axis in 0..3 {
                self.nodes[index].low[axis][slot] = (hull.low[axis] - margin) as f32;
                self.nodes[index].high[axis][slot] = (hull.high[axis] + margin) as f32;
            }
            self.nodes[index].children[slot] = if part.len() <= LEAF {
                IS_LEAF | (part.start as u32) << 2 | (part.len() as u32 - 1)
            } else {
                self.node(items, part, depth + 1, margin)
            };
        }
        index as u32
    }

    /// Offers the places of all leaves that may hold something nearer than `bound` (a squared distance) to `p`. The
    /// caller's answer to each place becomes the bound if it is smaller. Leaves come near ones first, and in an order
    /// that depends on `p` alone.
    #[inline]
    pub fn nearest(&self, p: DVec3, mut bound: f64, mut offer: impl FnMut(u32, f64) -> f64) {
        let q = p.as_vec3().to_array();
        let mut stack = [(0.0f32, 0u32); STACK];
        let mut height = 1;
        while height > 0 {
            height -= 1;
            let (score, child) = stack[height];
            if f64::from(score) > bound {
                continue;
            }
            if child & IS_LEAF != 0 {
                let first = (child & !IS_LEAF) >> 2;
                for place in first..=first + (child & 3) {
                    bound = bound.min(offer(place, bound));
                }
                continue;
            }
            let node = &self.nodes[child as usize];
            let mut scores = [0.0f32; 4];
            for (&q, (low, high)) in q.iter().zip(node.low.iter().zip(&node.high)) {
                for (score, (low, high)) in scores.iter_mut().zip(low.iter().zip(high)) {
                    let (below, above) = (low - q, q - high);
                    let outside = if below > above { below } else { above };
                    let outside = if outside > 0.0 { outside } else { 0.0 };
                    *score += outside * outside;
                }
            }
            let waiting = height;
            for (score, &child) in scores.iter().zip(&node.children) {
                let score = score * SHORTENED;
                if child == ABSENT || f64::from(score) > bound {
                    continue;
                }
                // nearest on top
                let mut at = height;
                while at > waiting && stack[at - 1].0 < score {
                    stack[at] = stack[at - 1];
                    at -= 1;
                }
                stack[at] = (score, child);
                height += 1;
            }
        }
    }
}

/// Orders the items so that those of the first part come first; returns how many they are, neither none nor all.
fn split(items: &mut [Item], at_median: bool) -> usize {
    let (mut low, mut high) = (DVec3::INFINITY, DVec3::NEG_INFINITY);
    for item in items.iter() {
        (low, high) = (low.min(item.middle), high.max(item.middle));
    }
    let extent = high - low;
    let best =
        (0..3).filter(|&a| !at_median && extent[a] > 0.0).filter_map(|axis| best_plane(items, axis, low, extent));
    if let Some((_, axis, bin)) = best.min_by(|a, b| a.0.total_cmp(&b.0)) {
        let mut first = 0;
        for i in 0..items.len() {
            if bin_of(items[i].middle[axis], low[axis], extent[axis]) <= bin {
                items.swap(first, i);
                first += 1;
            }
        }
        return first;
    }
    let axis = extent.max_position();
    let middle = items.len() / 2;
    items.select_nth_unstable_by(middle, |a, b| {
        a.middle[axis].total_cmp(&b.middle[axis]).then(a.triangle.cmp(&b.triangle))
    });
    middle
}

fn bin_of(coordinate: f64, low: f64, extent: f64) -> usize {
    (((coordinate - low) / extent * BINS as f64) as usize).min(BINS - 1)
}

/// Cost, axis and last bin of the first part for the cheapest plane across an axis.
fn best_plane(items: &[Item], axis: usize, low: DVec3, extent: DVec3) -> Option<(f64, usize, usize)> {
    let mut bins = [(Hull::EMPTY, 0usize); BINS];
    for item in items {
        let bin = &mut bins[bin_of(item.middle[axis], low[axis], extent[axis])];
        *bin = (bin.0.join(item.hull), bin.1 + 1);
    }
    let mut behind = [(Hull::EMPTY, 0usize); BINS + 1];
    for i in (0..BINS).rev() {
        behind[i] = (behind[i + 1].0.join(bins[i].0), behind[i + 1].1 + bins[i].1);
    }
    let mut before = (Hull::EMPTY, 0);
    let mut best: Option<(f64, usize, usize)> = None;
    for i in 0..BINS - 1 {
        before = (before.0.join(bins[i].0), before.1 + bins[i].1);
        let after = behind[i + 1];
        if before.1 == 0 || after.1 == 0 {
            continue;
        }
        let cost = before.0.half_area() * before.1 as f64 + after.0.half_area() * after.1 as f64;
        if best.is_none_or(|(least, ..)| cost < least) {
            best = Some((cost, axis, i));
        }
    }
    best
}
