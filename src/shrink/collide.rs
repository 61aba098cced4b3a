//! Which triangles of a lattice surface meet where they should not: found in double precision over a bounding volume
//! hierarchy, for the optimiser's own use. The certificate decides the same question exactly with code of its own.

use crate::settings::{Canceled, Settings};
use glam::{DVec2, DVec3};
use rayon::prelude::*;

/// Nodes of the hierarchy per piece of a parallel search; fixed, so that the result does not depend on the number of threads.
const CHUNK: usize = 256;
/// Triangles in a leaf of the hierarchy.
const LEAF: usize = 4;
/// A determinant below this share of the sum of its terms' magnitudes counts as zero (a few roundings).
const ROUNDING: f64 = 4e-15;

/// An axis-aligned box.
#[derive(Clone, Copy, Debug)]
pub struct Bounds {
    lo: DVec3,
    hi: DVec3,
}

impl Bounds {
    /// Around some points.
    pub fn around(points: impl IntoIterator<Item = DVec3>) -> Self {
        let mut bounds = Self { lo: DVec3::INFINITY, hi: DVec3::NEG_INFINITY };
        for p in points {
            (bounds.lo, bounds.hi) = (bounds.lo.min(p), bounds.hi.max(p));
        }
        bounds
    }
    /// Around this and another.
    pub fn with(self, other: Self) -> Self {
        Self { lo: self.lo.min(other.lo), hi: self.hi.max(other.hi) }
    }
    /// Length of the diagonal.
    pub fn diagonal(&self) -> f64 {
        self.hi.distance(self.lo)
    }
    /// Whether two closed boxes have a point in common.
    pub fn meets(&self, other: &Self) -> bool {
        self.lo.cmple(other.hi).all() && other.lo.cmple(self.hi).all()
    }
}

struct Node {
    bounds: Bounds,
    /// Items of a leaf in `order`; empty for an inner node.
    items: (u32, u32),
    /// The node that follows when this one is passed over.
    skip: u32,
    parent: u32,
}

/// The triangles of a surface in a bounding volume hierarchy that follows them while vertices move. Its nodes are in the
/// order of a walk that never goes back.
pub struct Index {
    nodes: Vec<Node>,
    order: Vec<u32>,
    boxes: Vec<Bounds>,
    /// The leaf that a triangle is in.
    leaf: Vec<u32>,
}

impl Index {
    /// Over the triangles of a surface.
    pub fn new(positions: &[DVec3], triangles: &[[u32; 3]]) -> Self {
        let boxes: Vec<Bounds> = triangles.iter().map(|t| Bounds::around(t.map(|v| positions[v as usize]))).collect();
        let centers: Vec<DVec3> = boxes.iter().map(|b| b.lo + b.hi).collect();
        let mut order: Vec<u32> = (0..boxes.len() as u32).collect();
        let mut index = Self { nodes: Vec::with_capacity(boxes.len()), order: Vec::new(), boxes, leaf: Vec::new() };
        index.leaf = vec![0; order.len()];
        index.grow(&centers, &mut order, 0, 0);
        index.order = order;
        index
    }

    fn grow(&mut self, centers: &[DVec3], order: &mut [u32], first: usize, parent: u32) {
        let bounds = order.iter().fold(Bounds::around([]), |all, &i| all.with(self.boxes[i as usize]));
        let here = self.nodes.len();
        let leaf = order.len() <= LEAF;
        let items = if leaf { (first as u32, (first + order.len()) as u32) } else { (0, 0) };
        self.nodes.push(Node { bounds, items, skip: 0, parent });
        if leaf {
            for &i in order.iter() {
                self.leaf[i as usize] = here as u32;
            }
        } else {
            let size = bounds.hi - bounds.lo;
            let axis = if size.x >= size.y && size.x >= size.z { 0 } else { usize::from(size.z > size.y) + 1 };
            let middle = order.len() / 2;
            let key = |i: u32| centers[i as usize][axis];
            order.select_nth_unstable_by(middle, |&a, &b| key(a).total_cmp(&key(b)).then(a.cmp(&b)));
            let (left, right) = order.split_at_mut(middle);
            self.grow(centers, left, first, here as u32);
            self.grow(centers, right, first + middle, here as u32);
        }
        self.nodes[here].skip = self.nodes.len() as u32;
    }

    /// Tells where a triangle is now.
    pub fn update(&mut self, triangle: u32, corners: [DVec3; 3]) {
        let bounds = Bounds::around(corners);
        self.boxes[triangle as usize] = bounds;
        let mut i = self.leaf[triangle as usize] as usize;
        loop {
            let node = &mut self.nodes[i];
            node.bounds = node.bounds.with(bounds);
            if i == 0 {
                break;
            }
            i = node.parent as usize;
        }
    }

    /// The box of a triangle.
    pub fn bounds(&self, triangle: u32) -> &Bounds {
        &self.boxes[triangle as usize]
    }

    /// Calls `found` with every triangle whose box meets `bounds`.
    pub fn near(&self, bounds: &Bounds, mut found: impl FnMut(u32)) {
        let mut i = 0;
        while let Some(node) = self.nodes.get(i) {
            if node.bounds.meets(bounds) {
                for &t in &self.order[node.items.0 as usize..node.items.1 as usize] {
                    if self.boxes[t as usize].meets(bounds) {
                        found(t);
                    }
                }
                i += 1;
            } else {
                i = node.skip as usize;
            }
        }
    }
}

/// Every pair `(i, j)`, `i < j`, of triangles that meet in more than the vertices they share and of which at least one is
/// in `asked` (ascending, each once), in ascending order.
pub fn crossings(
    index: &Index,
    positions: &[DVec3],
    triangles: &[[u32; 3]],
    asked: &[u32],
    settings: &Settings<'_>,
) -> Result<Vec<(u32, u32)>, Canceled> {
    let mut among = vec![false; triangles.len()];
    for &t in asked {
        among[t as usize] = true;
    }
    let search = |piece: &[Node]| {
        settings.cancel.check()?;
        let (mut near, mut hits) = (Vec::new(), Vec::new());
        for leaf in piece {
            let items = &index.order[leaf.items.0 as usize..leaf.items.1 as usize];
            if items.iter().all(|&i| !among[i as usize]) {
                continue;
            }
            // one walk for all of a leaf
            near.clear();
            index.near(&leaf.bounds, |j| near.push(j));
            for &i in items.iter().filter(|&&i| among[i as usize]) {
                let t = triangles[i as usize];
                for &j in &near {
                    // of two that are both asked about the first one finds the pair
                    let mine = j > i || (j < i && !among[j as usize]);
                    let close = mine && index.boxes[j as usize].meets(&index.boxes[i as usize]);
                    if close && meet(positions, t, triangles[j as usize]) {
                        hits.push((i.min(j), i.max(j)));
                    }
                }
            }
        }
        Ok(hits)
    };
    let pieces: Result<Vec<Vec<(u32, u32)>>, Canceled> =
        settings.pool.install(|| index.nodes.par_chunks(CHUNK).map(search).collect());
    let mut pairs = pieces?.concat();
    pairs.sort_unstable();
    Ok(pairs)
}

/// Whether two triangles meet in more than what they share by index.
pub fn meet(positions: &[DVec3], s: [u32; 3], t: [u32; 3]) -> bool {
    let mut shared = [(0, 0); 3];
    let mut count = 0;
    for (i, v) in s.iter().enumerate() {
        for (j, w) in t.iter().enumerate() {
            if v == w {
                shared[count] = (i, j);
                count += 1;
            }
        }
    }
    let (p, q) = (s.map(|v| positions[v as usize]), t.map(|v| positions[v as usize]));
    match count {
        0 => triangles_meet(p, q),
        1 => {
            let (i, j) = shared[0];
            wedges_meet([p[i], p[(i + 1) % 3], p[(i + 2) % 3]], [q[j], q[(j + 1) % 3], q[(j + 2) % 3]])
        }
        2 => {
            let (i, j) = (3 - shared[0].0 - shared[1].0, 3 - shared[0].1 - shared[1].1);
            folded_back(p[(i + 1) % 3], p[(i + 2) % 3], p[i], q[j])
        }
        _ => true,
    }
}

/// Sign of the volume of `a b c d`, 0 when rounding could have made it.
fn side(a: DVec3, b: DVec3, c: DVec3, d: DVec3) -> i8 {
    let (u, v, w) = (b - a, c - a, d - a);
    let (x, y, z) = ((u.y * v.z, u.z * v.y), (u.z * v.x, u.x * v.z), (u.x * v.y, u.y * v.x));
    let volume = w.x * (x.0 - x.1) + w.y * (y.0 - y.1) + w.z * (z.0 - z.1);
    let scale =
        w.x.abs() * (x.0.abs() + x.1.abs()) + w.y.abs() * (y.0.abs() + y.1.abs()) + w.z.abs() * (z.0.abs() + z.1.abs());
    if volume.abs() <= ROUNDING * scale { 0 } else { i8::from(volume > 0.0) - i8::from(volume < 0.0) }
}

/// Sign of the area of `a b c` in the plane, 0 when rounding could have made it.
fn turn(a: DVec2, b: DVec2, c: DVec2) -> i8 {
    let (l, r) = ((b.x - a.x) * (c.y - a.y), (b.y - a.y) * (c.x - a.x));
    if (l - r).abs() <= ROUNDING * (l.abs() + r.abs()) { 0 } else { i8::from(l > r) - i8::from(l < r) }
}

/// Whether two closed triangles have a point in common.
fn triangles_meet(p: [DVec3; 3], q: [DVec3; 3]) -> bool {
    let sides = |t: [DVec3; 3], o: [DVec3; 3]| o.map(|x| side(t[0], t[1], t[2], x));
    let apart = |s: [i8; 3]| s == [1; 3] || s == [-1; 3];
    if apart(sides(p, q)) || apart(sides(q, p)) {
        return false;
    }
    // what they have in common ends at an edge of one of them
    let edges = |t: [DVec3; 3]| [(t[0], t[1]), (t[1], t[2]), (t[2], t[0])];
    edges(p).into_iter().any(|(a, b)| pierces(a, b, q)) || edges(q).into_iter().any(|(a, b)| pierces(a, b, p))
}

/// Whether triangles with the first corner in common have another point in common: one's opposite edge then goes through
/// the other.
fn wedges_meet(p: [DVec3; 3], q: [DVec3; 3]) -> bool {
    let (b, c) = (side(p[0], p[1], p[2], q[1]), side(p[0], p[1], p[2], q[2]));
    if b * c > 0 {
        return false;
    }
    let (b, c) = (side(q[0], q[1], q[2], p[1]), side(q[0], q[1], q[2], p[2]));
    b * c <= 0 && (pierces(p[1], p[2], q) || pierces(q[1], q[2], p))
}

/// Whether `a b c` and `a b d` lie in one plane on one side of `a b`.
fn folded_back(a: DVec3, b: DVec3, c: DVec3, d: DVec3) -> bool {
    if side(a, b, c, d) != 0 {
        return false;
    }
    let along = b - a;
    let (n, m) = (along.cross(c - a), along.cross(d - a));
    n.dot(m) > 0.0
}

/// Whether a closed segment meets a closed triangle.
fn pierces(p: DVec3, q: DVec3, t: [DVec3; 3]) -> bool {
    let [a, b, c] = t;
    let (above, below) = (side(a, b, c, p), side(a, b, c, q));
    if above * below > 0 {
        return false;
    }
    if (above, below) != (0, 0) {
        let turns = [side(p, q, a, b), side(p, q, b, c), side(p, q, c, a)];
        return turns.iter().all(|&s| s >= 0) || turns.iter().all(|&s| s <= 0);
    }
    // all in one plane: seen along the axis that is nearest to its normal
    let normal = (b - a).cross(c - a).abs();
    let axis = if normal.x >= normal.y && normal.x >= normal.z { 0 } else { usize::from(normal.z > normal.y) + 1 };
    let [p, q, a, b, c] = [p, q, a, b, c].map(|x| DVec2::new(x[(axis + 1) % 3], x[(axis + 2) % 3]));
    let inside = |x: DVec2| {
        let s = [turn(a, b, x), turn(b, c, x), turn(c, a, x)];
        s.iter().all(|&s| s >= 0) || s.iter().all(|&s| s <= 0)
    };
    let cross = |x: DVec2, y: DVec2| turn(p, q, x) * turn(p, q, y) <= 0 && turn(x, y, p) * turn(x, y, q) <= 0;
    let bounds = |x: DVec2, y: DVec2| (x.min(y), x.max(y));
    let near = |x: DVec2, y: DVec2| {
        let ((l, h), (m, k)) = (bounds(p, q), bounds(x, y));
        l.cmple(k).all() && m.cmple(h).all()
    };
    inside(p) || inside(q) || [(a, b), (b, c), (c, a)].into_iter().any(|(x, y)| near(x, y) && cross(x, y))
}

/// How far two triangles reach into each other: the length that their planes' common line runs inside both.
pub fn overlap(p: [DVec3; 3], q: [DVec3; 3]) -> f64 {
    let normal = |t: [DVec3; 3]| (t[1] - t[0]).cross(t[2] - t[0]);
    let (n, m) = (normal(p), normal(q));
    let line = n.cross(m).normalize_or_zero();
    // where the line enters and leaves a triangle
    let span = |t: [DVec3; 3], normal: DVec3, origin: DVec3| {
        let height = t.map(|x| normal.dot(x - origin));
        let (mut lo, mut hi) = (f64::INFINITY, f64::NEG_INFINITY);
        for i in 0..3 {
            let (a, b) = (height[i], height[(i + 1) % 3]);
            if (a <= 0.0) != (b <= 0.0) {
                let at = line.dot(t[i].lerp(t[(i + 1) % 3], a / (a - b)));
                (lo, hi) = (lo.min(at), hi.max(at));
            }
        }
        (lo, hi)
    };
    let (a, b) = (span(p, m, q[0]), span(q, n, p[0]));
    (a.1.min(b.1) - a.0.max(b.0)).max(0.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::settings::CancelToken;
    use crate::shrink::lattice::{LatticeSpec, SphereLattice};

    fn count(positions: &[DVec3], triangles: &[[u32; 3]]) -> usize {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(2).build().unwrap();
        let cancel = CancelToken::new();
        let settings = Settings { pool: &pool, cancel: &cancel, progress: &|_| {}, watched: false };
        let all: Vec<u32> = (0..triangles.len() as u32).collect();
        crossings(&Index::new(positions, triangles), positions, triangles, &all, &settings).unwrap().len()
    }

    const FLAT: [DVec3; 3] = [DVec3::ZERO, DVec3::X, DVec3::Y];

    fn pair(other: [DVec3; 3]) -> bool {
        let positions: Vec<DVec3> = FLAT.into_iter().chain(other).collect();
        meet(&positions, [0, 1, 2], [3, 4, 5])
    }

    #[test]
    fn a_sphere_crosses_nowhere_until_a_vertex_is_pulled_across_it() {
        for spec in [LatticeSpec::Latlong { n_theta: 40, n_phi: 20 }, LatticeSpec::Octahedral { n: 12 }] {
            let lattice = SphereLattice::new(spec);
            let triangles = lattice.triangles(&vec![false; lattice.quads.len()]);
            let mut positions = lattice.directions.clone();
            assert_eq!(count(&positions, &triangles), 0, "{spec:?}");
            positions[100] *= -1.5;
            assert!(count(&positions, &triangles) > 4, "{spec:?}");
        }
    }

    #[test]
    fn asking_about_some_triangles_finds_every_pair_they_are_in() {
        let lattice = SphereLattice::new(LatticeSpec::Octahedral { n: 8 });
        let triangles = lattice.triangles(&vec![false; lattice.quads.len()]);
        let mut positions = lattice.directions.clone();
        positions[40] *= -1.2;
        let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
        let cancel = CancelToken::new();
        let settings = Settings { pool: &pool, cancel: &cancel, progress: &|_| {}, watched: false };
        let index = Index::new(&positions, &triangles);
        let ask = |list: &[u32]| crossings(&index, &positions, &triangles, list, &settings).unwrap();
        let all = ask(&(0..triangles.len() as u32).collect::<Vec<_>>());
        let odd: Vec<u32> = (0..triangles.len() as u32).filter(|t| t % 2 == 1).collect();
        let expected: Vec<(u32, u32)> = all.iter().copied().filter(|p| p.0 % 2 == 1 || p.1 % 2 == 1).collect();
        assert!(expected.len() < all.len());
        assert_eq!(ask(&odd), expected);
    }

    #[test]
    fn closed_triangles_meet_when_they_touch_and_not_when_they_nearly_do() {
        let up = |z: f64| [DVec3::new(0.2, 0.2, z), DVec3::new(0.4, 0.2, z + 1.0), DVec3::new(0.2, 0.4, z + 1.0)];
        assert!(pair(up(-0.5)) && pair(up(0.0)));
        assert!(!pair(up(1e-9)));
        let beside = |x: f64| FLAT.map(|p| p + x * DVec3::X);
        assert!(pair(beside(0.5)) && pair(beside(1.0)) && !pair(beside(1.0 + 1e-9)));
    }

    #[test]
    fn a_shared_corner_is_no_crossing_and_what_is_beyond_it_is() {
        let fan = |c: DVec3, d: DVec3| meet(&[FLAT[0], FLAT[1], FLAT[2], c, d], [0, 1, 2], [0, 3, 4]);
        assert!(!fan(DVec3::NEG_X, DVec3::NEG_Y));
        assert!(!fan(DVec3::new(-1.0, 0.1, 0.0), DVec3::NEG_Y), "in one plane, beside each other");
        assert!(fan(DVec3::new(1.0, 1.0, 0.0), DVec3::NEG_X), "in one plane, on top of each other");
        assert!(fan(DVec3::new(1.0, 1.0, 1.0), DVec3::new(1.0, 1.0, -1.0)), "through it");
        assert!(!fan(DVec3::new(1.0, 1.0, 1.0), DVec3::new(1.0, 1.0, 0.1)), "above it");
    }

    #[test]
    fn a_shared_edge_crosses_only_folded_back_onto_itself() {
        let hinge = |d: DVec3| meet(&[FLAT[0], FLAT[1], FLAT[2], d], [0, 1, 2], [1, 0, 3]);
        assert!(!hinge(DVec3::new(0.3, -1.0, 0.0)) && !hinge(DVec3::new(0.3, 0.5, 1e-9)));
        assert!(hinge(DVec3::new(0.3, 0.5, 0.0)));
    }

    #[test]
    fn the_index_finds_a_triangle_that_was_moved() {
        let lattice = SphereLattice::new(LatticeSpec::Octahedral { n: 6 });
        let triangles = lattice.triangles(&vec![false; lattice.quads.len()]);
        let mut index = Index::new(&lattice.directions, &triangles);
        let place = DVec3::splat(3.0);
        let at = |index: &Index| {
            let mut found = Vec::new();
            index.near(&Bounds::around([place]), |t| found.push(t));
            found
        };
        assert!(at(&index).is_empty());
        index.update(17, [place - 0.1, place, place + 0.1]);
        assert_eq!(at(&index), [17]);
    }

    #[test]
    fn the_overlap_is_the_length_of_the_common_line() {
        let wall = [DVec3::new(0.2, 0.2, -1.0), DVec3::new(0.2, 0.5, -1.0), DVec3::new(0.2, 0.2, 1.0)];
        assert!((overlap(FLAT, wall) - 0.15).abs() < 1e-12);
        assert_eq!(overlap(FLAT, wall.map(|p| p + 2.0 * DVec3::X)), 0.0);
    }
}
