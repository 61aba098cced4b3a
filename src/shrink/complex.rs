//! Tetrahedra that fit together, seen from their nodes: who is whose neighbour, and what a node's link looks like.

use super::unfold::Corners;
use glam::DVec3;

/// A complex of tetrahedra that fills a box.
pub struct Complex {
    /// Positions of the nodes, in frame units.
    pub positions: Vec<DVec3>,
    /// Nodes of every tetrahedron; right-handed.
    pub tets: Vec<[u32; 4]>,
    /// Side of the smallest cube around every node, in units.
    pub sides: Vec<i32>,
    /// Length of a unit.
    pub unit: f64,
    /// Whether a node is on the box's boundary.
    pub border: Vec<bool>,
    corners: Corners,
}

impl Complex {
    /// From positions, right-handed tetrahedra, the nodes' cubes and the length of a unit, and which nodes are on the border.
    pub(super) fn new(
        positions: Vec<DVec3>,
        tets: Vec<[u32; 4]>,
        sides: Vec<i32>,
        unit: f64,
        border: Vec<bool>,
    ) -> Self {
        let corners = Corners::new(positions.len(), &tets);
        Self { positions, tets, sides, unit, border, corners }
    }

    /// Number of nodes.
    pub fn len(&self) -> usize {
        self.positions.len()
    }
    /// Tetrahedra at a node.
    pub fn star(&self, v: usize) -> impl Iterator<Item = usize> {
        self.corners.at(v as u32).iter().map(|&k| k as usize / 4)
    }
    /// Spacing of the lattice at a node.
    pub fn spacing(&self, v: usize) -> f64 {
        self.unit * f64::from(self.sides[v])
    }

    /// Connected sets of nodes.
    pub fn clusters(&self, set: &[bool]) -> Vec<Vec<usize>> {
        let mut seen = vec![false; self.len()];
        let mut list = Vec::new();
        for start in 0..self.len() {
            if !set[start] || seen[start] {
                continue;
            }
            seen[start] = true;
            let mut cluster = vec![start];
            let mut next = 0;
            while next < cluster.len() {
                for t in self.star(cluster[next]) {
                    for j in self.tets[t].map(|j| j as usize) {
                        if set[j] && !seen[j] {
                            seen[j] = true;
                            cluster.push(j);
                        }
                    }
                }
                next += 1;
            }
            list.push(cluster);
        }
        list
    }

    /// Euler characteristic of the complex that a set of nodes spans.
    pub fn euler(&self, set: &[bool]) -> i64 {
        let mut rings = Rings::new(self);
        let mut chi = 0;
        for v in (0..self.len()).filter(|&v| set[v]) {
            let ring = rings.of(v);
            // cells are counted at their lowest node
            let counts = |u: u32| u as usize > v && set[u as usize];
            let own = (0..ring.nodes.len()).filter(|&k| counts(ring.nodes[k])).fold(0u64, |own, k| own | 1 << k);
            let joined: u32 = bits(own).map(|k| (ring.links[k] & own).count_ones()).sum();
            let whole = |t: &usize| self.tets[*t].iter().all(|&u| u as usize == v || counts(u));
            chi += 1 - i64::from(own.count_ones()) + i64::from(joined / 2);
            chi -= self.star(v).filter(whole).count() as i64;
        }
        chi
    }
}

fn bits(mut set: u64) -> impl Iterator<Item = usize> {
    std::iter::from_fn(move || {
        let k = (set != 0).then(|| set.trailing_zeros() as usize);
        set &= set.wrapping_sub(1);
        k
    })
}

/// A node's neighbours, and the edges of its link.
#[derive(Clone, Copy, Debug)]
pub struct Ring<'a> {
    /// The neighbours.
    pub nodes: &'a [u32],
    /// For every neighbour the set of the others (a bit each) that an edge of the link joins it to.
    pub links: &'a [u64],
}

impl Ring<'_> {
    /// Whether the node can change sides without a change of topology: what is inside of its link and what is outside are
    /// both in one piece (Bertrand 1994; the link is a sphere, so one piece each makes both a disc).
    pub fn simple(&self, inside: &[bool]) -> bool {
        let all = u64::MAX >> (64 - self.nodes.len());
        let set = (0..self.nodes.len()).fold(0u64, |set, k| set | u64::from(inside[self.nodes[k] as usize]) << k);
        self.connected(set) && self.connected(all & !set)
    }

    fn connected(&self, set: u64) -> bool {
        let mut seen = set & set.wrapping_neg();
        let mut fresh = seen;
        while fresh != 0 {
            let grown = bits(fresh).fold(0, |grown, k| grown | self.links[k]);
            fresh = grown & set & !seen;
            seen |= fresh;
        }
        set != 0 && seen == set
    }
}

/// Makes the rings of nodes.
pub struct Rings<'a> {
    complex: &'a Complex,
    /// For every node its number in the ring that is being made; others have [`NONE`].
    numbers: Vec<u8>,
    /// What the last ring was made of.
    nodes: Vec<u32>,
    links: Vec<u64>,
}

const NONE: u8 = u8::MAX;

impl<'a> Rings<'a> {
    /// For the nodes of a complex.
    pub fn new(complex: &'a Complex) -> Self {
        Self { complex, numbers: vec![NONE; complex.len()], nodes: Vec::new(), links: Vec::new() }
    }

    /// The ring of a node.
    ///
    /// # Panics
    /// If it has more than 64 neighbours; on a graded lattice none has more than 26.
    pub fn of(&mut self, v: usize) -> Ring<'_> {
        let Self { nodes, links, .. } = self;
        nodes.clear();
        links.clear();
        for t in self.complex.star(v) {
            let mut all = 0u64;
            let mut local = [usize::MAX; 4];
            for (slot, u) in local.iter_mut().zip(self.complex.tets[t]) {
                if u as usize == v {
                    continue;
                }
                let number = &mut self.numbers[u as usize];
                if *number == NONE {
                    assert!(nodes.len() < 64, "a ring of at most 64 nodes");
                    *number = nodes.len() as u8;
                    nodes.push(u);
                    links.push(0);
                }
                *slot = usize::from(*number);
                all |= 1 << *number;
            }
            for k in local.into_iter().filter(|&k| k != usize::MAX) {
                links[k] |= all & !(1 << k);
            }
        }
        for &u in nodes.iter() {
            self.numbers[u as usize] = NONE;
        }
        Ring { nodes: &self.nodes, links: &self.links }
    }
}

/// Rings of nodes that are asked for again and again, each made once.
pub struct Kept<'a> {
    rings: Rings<'a>,
    /// Number of every node's ring here; others have `u32::MAX`.
    numbers: Vec<u32>,
    /// Where every ring starts; one longer than there are rings.
    first: Vec<u32>,
    nodes: Vec<u32>,
    links: Vec<u64>,
}

impl<'a> Kept<'a> {
    /// For the nodes of a complex.
    pub fn new(complex: &'a Complex) -> Self {
        let numbers = vec![u32::MAX; complex.len()];
        Self { rings: Rings::new(complex), numbers, first: vec![0], nodes: Vec::new(), links: Vec::new() }
    }

    /// The ring of a node.
    pub fn of(&mut self, v: usize) -> Ring<'_> {
        if self.numbers[v] == u32::MAX {
            let ring = self.rings.of(v);
            self.nodes.extend_from_slice(ring.nodes);
            self.links.extend_from_slice(ring.links);
            self.numbers[v] = self.first.len() as u32 - 1;
            self.first.push(self.nodes.len() as u32);
        }
        let number = self.numbers[v] as usize;
        let range = self.first[number] as usize..self.first[number + 1] as usize;
        Ring { nodes: &self.nodes[range.clone()], links: &self.links[range] }
    }
}

#[cfg(test)]
mod tests {
    use super::super::graded::Graded;
    use super::*;
    use crate::field::Sampler;
    use crate::field::sampler::Tally;
    use crate::field::scene::Scene;
    use crate::measure::fixtures::with_settings;
    use std::collections::BTreeMap;

    /// A complex that is fine near a ball, and in some places finer.
    fn made() -> Complex {
        let scene = Scene::from_value(&serde_json::json!({"sphere": {"radius": 0.6}})).unwrap();
        with_settings(2, |settings| {
            let tally = Tally::new();
            let sampler = Sampler::new(&scene, *settings, &tally);
            let mut grid = Graded::new(&sampler, DVec3::splat(-1.0), DVec3::splat(1.0), 0.25).unwrap();
            grid.halve(&sampler, 1.0, 1.0).unwrap();
            for stride in [7, 41, 97] {
                let complex = grid.complex(settings).unwrap();
                let nodes: Vec<(usize, i32)> =
                    (0..complex.len()).step_by(stride).map(|i| (i, complex.sides[i])).collect();
                assert!(grid.halve_around(&sampler, nodes, 1.0, 1.0).unwrap());
            }
            grid.complex(settings).unwrap()
        })
    }

    #[test]
    fn cells_of_all_sizes_fit_together() {
        let complex = made();
        let sides: std::collections::BTreeSet<i32> = complex.sides.iter().copied().collect();
        assert!(sides.len() >= 4, "{sides:?}");
        let volume = |t: &[u32; 4]| {
            let [a, b, c, d] = t.map(|v| complex.positions[v as usize]);
            (b - a).cross(c - a).dot(d - a) / 6.0
        };
        assert!(complex.tets.iter().all(|t| volume(t) > 0.0), "all are right-handed");
        // a box of eight cells and one to spare on every side
        let all: f64 = complex.tets.iter().map(volume).sum();
        assert!((all - 2.5f64.powi(3)).abs() < 1e-9, "{all}");
        let mut faces = BTreeMap::<[u32; 3], u32>::new();
        for tet in &complex.tets {
            for k in 0..4 {
                let mut face = [tet[(k + 1) % 4], tet[(k + 2) % 4], tet[(k + 3) % 4]];
                face.sort_unstable();
                *faces.entry(face).or_default() += 1;
            }
        }
        for (face, count) in faces {
            let outer = face.iter().all(|&v| complex.border[v as usize]);
            assert!(count == 2 || (count == 1 && outer), "{face:?} is a face of {count} cells");
        }
    }

    #[test]
    fn rings_are_spheres_and_the_whole_is_a_ball() {
        let complex = made();
        assert_eq!(complex.euler(&vec![true; complex.len()]), 1);
        assert_eq!(complex.clusters(&vec![true; complex.len()]).len(), 1);
        let mut rings = Rings::new(&complex);
        for v in (0..complex.len()).filter(|&v| !complex.border[v]) {
            let ring = rings.of(v);
            assert!(ring.nodes.len() <= 26, "{}", ring.nodes.len());
            let edges: u32 = ring.links.iter().map(|links| links.count_ones()).sum::<u32>() / 2;
            // V - E + F = 2, and every triangle of the link belongs to one cell
            assert_eq!(ring.nodes.len() as i64 - i64::from(edges) + complex.star(v).count() as i64, 2);
        }
    }

    #[test]
    fn a_node_is_simple_if_both_sides_of_its_link_are_in_one_piece() {
        // an octahedron's six corners around a node, opposite ones 0 and 1, 2 and 3, 4 and 5
        let (nodes, links) = ([0, 1, 2, 3, 4, 5], [0u64, 1, 2, 3, 4, 5].map(|k| 0b11_1111 & !(0b11 << (k & !1))));
        let ring = Ring { nodes: &nodes, links: &links };
        let simple = |set: [usize; 6]| ring.simple(&set.map(|s| s == 1));
        assert!(simple([1, 0, 0, 0, 0, 0]) && simple([1, 0, 1, 0, 1, 0]) && simple([1, 1, 1, 0, 1, 1]));
        assert!(!simple([1; 6]) && !simple([0; 6]));
        assert!(!simple([1, 1, 0, 0, 0, 0]), "two pieces inside");
        assert!(!simple([0, 0, 1, 1, 1, 1]), "two pieces outside");
    }
}
