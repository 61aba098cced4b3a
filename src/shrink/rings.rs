//! Closed triangle meshes as ordered rings of neighbours, the one mesh structure of the shrinking room.
//!
//! `rings[v]` lists the neighbours of `v` counter-clockwise seen from outside; an empty ring is a vertex that was
//! collapsed. Split, collapse, flip and the reverse of a collapse touch only the rings around one edge.

use glam::DVec3;

/// Connectivity of a closed, oriented, manifold triangle mesh.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Rings {
    rings: Vec<Vec<u32>>,
}

impl Rings {
    /// From triangles of a closed manifold mesh over `vertices` vertices. `None` when a ring does not close, which is
    /// when the mesh is not a closed oriented manifold.
    pub fn new(vertices: usize, triangles: &[[u32; 3]]) -> Option<Self> {
        let mut wedges: Vec<Vec<(u32, u32)>> = vec![Vec::new(); vertices];
        for t in triangles {
            for c in 0..3 {
                wedges[t[c] as usize].push((t[(c + 1) % 3], t[(c + 2) % 3]));
            }
        }
        let mut rings = Vec::with_capacity(vertices);
        for wedge in &wedges {
            let mut ring = Vec::with_capacity(wedge.len());
            if let Some(&(first, _)) = wedge.first() {
                let mut current = first;
                loop {
                    ring.push(current);
                    current = wedge.iter().find(|w| w.0 == current)?.1;
                    if current == first {
                        break;
                    }
                    if ring.len() > wedge.len() {
                        return None;
                    }
                }
                if ring.len() != wedge.len() {
                    return None;
                }
            }
            rings.push(ring);
        }
        Some(Self { rings })
    }

    /// Number of vertices, collapsed ones included.
    pub fn len(&self) -> usize {
        self.rings.len()
    }
    /// Neighbours of `v`, counter-clockwise.
    pub fn ring(&self, v: u32) -> &[u32] {
        &self.rings[v as usize]
    }
    /// Whether `v` is part of the mesh.
    pub fn alive(&self, v: u32) -> bool {
        !self.rings[v as usize].is_empty()
    }
    /// Whether `v` and `w` are joined by an edge.
    pub fn joined(&self, v: u32, w: u32) -> bool {
        self.rings[v as usize].contains(&w)
    }
    /// Number of neighbours.
    pub fn valence(&self, v: u32) -> usize {
        self.rings[v as usize].len()
    }

    /// All triangles, each once, smallest vertex first.
    pub fn triangles(&self) -> Vec<[u32; 3]> {
        let mut triangles = Vec::with_capacity(2 * self.rings.len());
        for (v, ring) in self.rings.iter().enumerate() {
            let v = v as u32;
            for (i, &a) in ring.iter().enumerate() {
                let b = ring[(i + 1) % ring.len()];
                if v < a && v < b {
                    triangles.push([v, a, b]);
                }
            }
        }
        triangles
    }

    fn index(&self, v: u32, w: u32) -> usize {
        self.rings[v as usize].iter().position(|&x| x == w).expect("the vertices are joined")
    }
    /// The neighbour of `v` after `w`: the third corner of the triangle left of the edge from `v` to `w`.
    pub fn next(&self, v: u32, w: u32) -> u32 {
        let ring = &self.rings[v as usize];
        ring[(self.index(v, w) + 1) % ring.len()]
    }
    /// The neighbour of `v` before `w`: the third corner of the triangle right of the edge from `v` to `w`.
    pub fn previous(&self, v: u32, w: u32) -> u32 {
        let ring = &self.rings[v as usize];
        ring[(self.index(v, w) + ring.len() - 1) % ring.len()]
    }
    /// The ring of `v`, turned to start at `w`.
    fn turned(&self, v: u32, w: u32) -> Vec<u32> {
        let mut ring = self.rings[v as usize].clone();
        let start = self.index(v, w);
        ring.rotate_left(start);
        ring
    }

    /// Whether the edge `v w` can be collapsed and leave a closed manifold (link condition: exactly two common
    /// neighbours).
    pub fn collapsible(&self, v: u32, w: u32) -> bool {
        let (c, d) = (self.next(v, w), self.previous(v, w));
        if self.valence(c) <= 3 || self.valence(d) <= 3 {
            return false;
        }
        let common = self.ring(v).iter().filter(|u| self.joined(w, **u)).count();
        common == 2 && self.valence(v) + self.valence(w) >= 7
    }

    /// Removes `v` into its neighbour `w`; returns the ring of `v` from `w` on, which [`Rings::uncollapse`] takes back.
    pub fn collapse(&mut self, v: u32, w: u32) -> Vec<u32> {
        let ring = self.turned(v, w);
        let last = ring.len() - 1;
        for &u in &ring[2..last] {
            let i = self.index(u, v);
            self.rings[u as usize][i] = w;
        }
        for u in [ring[1], ring[last]] {
            let i = self.index(u, v);
            self.rings[u as usize].remove(i);
        }
        let i = self.index(w, v);
        self.rings[w as usize].splice(i..=i, ring[2..last].iter().copied());
        self.rings[v as usize].clear();
        ring
    }

    /// Takes a collapse back. Collapses must be taken back in reverse order.
    pub fn uncollapse(&mut self, v: u32, ring: &[u32]) {
        let (w, c, d, last) = (ring[0], ring[1], ring[ring.len() - 1], ring.len() - 1);
        let around = self.turned(w, c);
        let mut mended = vec![c, v];
        mended.extend_from_slice(&around[last - 1..]);
        self.rings[w as usize] = mended;
        for &u in &ring[2..last] {
            let i = self.index(u, w);
            self.rings[u as usize][i] = v;
        }
        let i = self.index(c, w);
        self.rings[c as usize].insert(i, v);
        let i = self.index(d, w);
        self.rings[d as usize].insert(i + 1, v);
        self.rings[v as usize] = ring.to_vec();
    }

    /// Turns the edge `a b` into the other diagonal of its two triangles; `false` when that would break the manifold.
    pub fn flip(&mut self, a: u32, b: u32) -> bool {
        let (c, d) = (self.next(a, b), self.previous(a, b));
        if self.valence(a) <= 3 || self.valence(b) <= 3 || c == d || self.joined(c, d) {
            return false;
        }
        for (v, w) in [(a, b), (b, a)] {
            let i = self.index(v, w);
            self.rings[v as usize].remove(i);
        }
        let i = self.index(c, b);
        self.rings[c as usize].insert(i, d);
        let i = self.index(d, a);
        self.rings[d as usize].insert(i, c);
        true
    }

    /// Puts a new vertex on the edge `a b` and returns it.
    pub fn split(&mut self, a: u32, b: u32) -> u32 {
        let (c, d) = (self.next(a, b), self.previous(a, b));
        let m = self.rings.len() as u32;
        for (v, w) in [(a, b), (b, a)] {
            let i = self.index(v, w);
            self.rings[v as usize][i] = m;
        }
        let i = self.index(c, b);
        self.rings[c as usize].insert(i, m);
        let i = self.index(d, a);
        self.rings[d as usize].insert(i, m);
        self.rings.push(vec![b, c, a, d]);
        m
    }

    /// Drops collapsed vertices; returns for every kept vertex its old number.
    pub fn compact(&mut self) -> Vec<u32> {
        let kept: Vec<u32> = (0..self.rings.len() as u32).filter(|&v| self.alive(v)).collect();
        let mut number = vec![u32::MAX; self.rings.len()];
        for (i, &v) in kept.iter().enumerate() {
            number[v as usize] = i as u32;
        }
        self.rings =
            kept.iter().map(|&v| self.rings[v as usize].iter().map(|&w| number[w as usize]).collect()).collect();
        kept
    }
}

/// Unit normal of a triangle, zero for a degenerate one.
pub fn unit_normal([a, b, c]: [DVec3; 3]) -> DVec3 {
    (b - a).cross(c - a).normalize_or_zero()
}

/// A closed triangle mesh with positions.
#[derive(Clone, Debug)]
pub struct Mesh {
    /// Position of every vertex.
    pub positions: Vec<DVec3>,
    /// Connectivity.
    pub rings: Rings,
}

impl Mesh {
    /// Twice the area vector of a triangle.
    pub fn normal(&self, t: [u32; 3]) -> DVec3 {
        let [a, b, c] = t.map(|v| self.positions[v as usize]);
        (b - a).cross(c - a)
    }
    /// Sum of triangle areas.
    pub fn area(&self) -> f64 {
        self.rings.triangles().into_iter().map(|t| 0.5 * self.normal(t).length()).sum()
    }
    /// Area-weighted unit normal at a vertex.
    pub fn vertex_normal(&self, v: u32) -> DVec3 {
        let ring = self.rings.ring(v);
        let sum: DVec3 = (0..ring.len()).map(|i| self.normal([v, ring[i], ring[(i + 1) % ring.len()]])).sum();
        sum.normalize_or_zero()
    }
    /// Length of an edge.
    pub fn length(&self, a: u32, b: u32) -> f64 {
        self.positions[a as usize].distance(self.positions[b as usize])
    }

    /// Whether `v` may go to `to` without turning any of its triangles by more than acos(`turn`); triangles at `except`
    /// are not looked at. A sliver may move as long as it does not get thinner.
    pub fn may_move(&self, v: u32, to: DVec3, except: Option<u32>, turn: f64) -> bool {
        /// Below this ratio of twice the area to the longest edge squared a triangle is a sliver without a direction.
        const SLIVER: f64 = 0.02;
        let ring = self.rings.ring(v);
        for (i, &a) in ring.iter().enumerate() {
            let b = ring[(i + 1) % ring.len()];
            if Some(a) == except || Some(b) == except {
                continue;
            }
            let (pa, pb) = (self.positions[a as usize], self.positions[b as usize]);
            let (before, after) = (self.normal([v, a, b]), (pa - to).cross(pb - to));
            let (l0, l1) = (before.length(), after.length());
            let longest = pa.distance_squared(pb).max(pa.distance_squared(to)).max(pb.distance_squared(to));
            if l1 < SLIVER * longest {
                if l0 > l1 {
                    return false;
                }
            } else if before.dot(after) < turn * l0 * l1 {
                return false;
            }
        }
        true
    }

    /// Moves `v` towards `target`, the step shortened until no triangle turns by more than acos(`turn`).
    pub fn move_vertex(&mut self, v: u32, target: DVec3, turn: f64) {
        let from = self.positions[v as usize];
        let mut step = 1.0;
        for _ in 0..4 {
            let to = from + step * (target - from);
            if self.may_move(v, to, None, turn) {
                self.positions[v as usize] = to;
                break;
            }
            step *= 0.4;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn octahedron() -> Rings {
        let t = [[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 1], [5, 2, 1], [5, 3, 2], [5, 4, 3], [5, 1, 4]];
        Rings::new(6, &t).unwrap()
    }

    fn manifold(rings: &Rings) {
        let rebuilt = Rings::new(rings.len(), &rings.triangles()).expect("a closed manifold");
        for v in 0..rings.len() as u32 {
            let mut ring = rebuilt.ring(v).to_vec();
            if let Some(i) = ring.iter().position(|&w| Some(&w) == rings.ring(v).first()) {
                ring.rotate_left(i);
            }
            assert_eq!(ring, rings.ring(v));
        }
    }

    #[test]
    fn splits_flips_and_collapses_keep_a_closed_manifold_and_collapses_can_be_taken_back() {
        let mut rings = octahedron();
        let mut seed = 7u64;
        let mut random = move |n: usize| {
            seed = seed.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
            (seed >> 33) as usize % n
        };
        for _ in 0..300 {
            let v = random(rings.len()) as u32;
            let w = rings.ring(v)[random(rings.valence(v))];
            if random(2) == 0 {
                rings.split(v, w);
            } else {
                rings.flip(v, w);
            }
        }
        manifold(&rings);
        let before = rings.clone();
        let mut log = Vec::new();
        for _ in 0..2000 {
            let v = random(rings.len()) as u32;
            if rings.alive(v) {
                let w = rings.ring(v)[random(rings.valence(v))];
                if rings.collapsible(v, w) {
                    log.push((v, rings.collapse(v, w)));
                }
            }
        }
        manifold(&rings);
        assert!(2 * log.len() > before.len(), "most vertices can be collapsed");
        while let Some((v, ring)) = log.pop() {
            rings.uncollapse(v, &ring);
        }
        manifold(&rings);
        assert_eq!(rings.triangles().len(), before.triangles().len());
    }
}
