//! A graded lattice: cubes that are halved where it is asked for, cut into tetrahedra that fit together everywhere.
//!
//! A cube is halved by bisection: its middle is put in, then the middles of its faces, then those of its edges, each of them
//! on the longest edge of the tetrahedra around it (Maubach 1995, "Local bisection refinement for n-simplicial grids generated
//! by reflection"). The middle of an edge is there only if the middles of the four faces around it are, that of a face only
//! if those of the two cubes beside it are, and that of a cube only if the cube itself is whole. So there are no hanging nodes,
//! neighbouring cells differ by one halving, and the cells stay of a few shapes.

use super::complex::Complex;
use crate::field::{Frame, Sampler};
use crate::settings::{Canceled, Settings};
use glam::{DVec3, IVec3};
use rayon::prelude::*;
use std::collections::HashMap;
use std::hash::{BuildHasherDefault, Hasher};

/// Coordinates are counted in units; a cube of the first lattice has this many along a side. It can be halved as often as
/// that has halves.
const ROOT: i32 = 1 << 9;
/// Bits of a coordinate in a key.
const BITS: u32 = 21;

/// A node's coordinates, in units.
pub type Place = [i32; 3];

/// Mixes the bits of the one number that a key is.
#[derive(Default)]
struct Mix(u64);

impl Hasher for Mix {
    fn finish(&self) -> u64 {
        self.0
    }
    fn write(&mut self, bytes: &[u8]) {
        for &b in bytes {
            self.write_u64(u64::from(b));
        }
    }
    fn write_u64(&mut self, key: u64) {
        // the multiplier is 2^64 over the golden ratio (Knuth's multiplicative hashing)
        let mixed = (self.0 ^ key).wrapping_mul(0x9e37_79b9_7f4a_7c15);
        self.0 = mixed ^ mixed >> 29;
    }
}

/// A cube: its lowest corner and its side, in units.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Cube {
    side: i32,
    low: Place,
}

/// Nodes with a value each. Where the zero level set cannot be, values are interpolated; `known` tells the evaluated ones.
#[derive(Clone, Debug)]
pub struct Graded {
    /// Position of the place (0, 0, 0), in frame units.
    pub origin: DVec3,
    /// Length of a unit.
    pub unit: f64,
    /// Largest place.
    extent: Place,
    /// Number of the node at every place that has one.
    index: HashMap<u64, u32, BuildHasherDefault<Mix>>,
    /// Where the nodes are.
    places: Vec<Place>,
    /// The field at the nodes.
    pub values: Vec<f32>,
    /// Whether it was evaluated there.
    pub known: Vec<bool>,
    /// The cubes that were halved as a whole last, or all of the first lattice.
    finest: Vec<Cube>,
    /// Side of the cubes that [`Graded::halve`] made last, in units.
    side: i32,
    /// What the field's values were divided by.
    divisor: f64,
}

fn key([x, y, z]: Place) -> u64 {
    (x as u64) << (2 * BITS) | (y as u64) << BITS | z as u64
}

/// The largest power of two, up to that of the first lattice's cubes and beyond, that divides all three coordinates.
fn step([x, y, z]: Place) -> i32 {
    1 << (x | y | z).trailing_zeros().min(30)
}

fn plus(a: Place, b: Place) -> Place {
    [a[0] + b[0], a[1] + b[1], a[2] + b[2]]
}

/// The eight corners of a cube: corner `k` is at the far side of axis `a` where bit `a` of `k` is set.
fn corner(cube: Cube, k: usize) -> Place {
    [0, 1, 2].map(|a| cube.low[a] + cube.side * (k >> a & 1) as i32)
}

impl Cube {
    fn middle(self) -> Place {
        self.low.map(|c| c + self.side / 2)
    }
    /// The half cube at a corner.
    fn half(self, k: usize) -> Self {
        let side = self.side / 2;
        Self { side, low: [0, 1, 2].map(|a| self.low[a] + side * (k >> a & 1) as i32) }
    }
    /// The corner from which the cube's diagonal goes to the opposite one: that on the cubes of twice the size.
    fn even(self) -> usize {
        (0..3).map(|a| usize::from(self.low[a] & self.side != 0) << a).sum()
    }
}

/// A tetrahedron, right-handed, and the side of the cube that it is cut from, in units.
struct Cell {
    nodes: [u32; 4],
    side: i32,
}

/// The orders in which the six tetrahedra of a cube go through the axes; every other one is left-handed.
const ORDERS: [[usize; 3]; 6] = [[0, 1, 2], [0, 2, 1], [1, 2, 0], [1, 0, 2], [2, 0, 1], [2, 1, 0]];

impl Graded {
    /// Evaluates every node of a lattice of spacing `h` over the box `lo..hi`, with one cell to spare on every side.
    pub fn new(sampler: &Sampler<'_>, lo: DVec3, hi: DVec3, h: f64) -> Result<Self, Canceled> {
        let cells = ((hi - lo) / h).ceil().max(DVec3::ONE) + 2.0;
        let count = cells.as_ivec3().to_array();
        let mut grid = Self {
            origin: 0.5 * (lo + hi) - 0.5 * h * cells,
            unit: h / f64::from(ROOT),
            extent: count.map(|c| c * ROOT),
            index: HashMap::default(),
            places: Vec::new(),
            values: Vec::new(),
            known: Vec::new(),
            finest: Vec::new(),
            side: ROOT,
            divisor: 1.0,
        };
        for x in 0..=count[0] {
            for y in 0..=count[1] {
                for z in 0..=count[2] {
                    let place = [x, y, z].map(|c| c * ROOT);
                    grid.add(place);
                    if x < count[0] && y < count[1] && z < count[2] {
                        grid.finest.push(Cube { side: ROOT, low: place });
                    }
                }
            }
        }
        let points: Vec<DVec3> = (0..grid.len()).map(|i| grid.position(i)).collect();
        grid.values = sampler.values(&points)?.into_iter().map(|v| v as f32).collect();
        grid.known.fill(true);
        Ok(grid)
    }

    /// Number of nodes.
    pub fn len(&self) -> usize {
        self.places.len()
    }
    /// Spacing of the cubes that [`Graded::halve`] made last.
    pub fn h(&self) -> f64 {
        self.unit * f64::from(self.side)
    }
    /// Position of a node.
    pub fn position(&self, i: usize) -> DVec3 {
        self.at(self.places[i])
    }
    fn at(&self, place: Place) -> DVec3 {
        self.origin + self.unit * DVec3::from(place.map(f64::from))
    }
    fn node(&self, place: Place) -> Option<u32> {
        self.index.get(&key(place)).copied()
    }
    fn has(&self, place: Place) -> bool {
        self.index.contains_key(&key(place))
    }
    fn within(&self, place: Place) -> bool {
        (0..3).all(|a| (0..=self.extent[a]).contains(&place[a]))
    }
    /// Whether the node lies on the box's boundary.
    pub fn on_border(&self, i: usize) -> bool {
        (0..3).any(|a| self.places[i][a] == 0 || self.places[i][a] == self.extent[a])
    }

    /// Goes over to a frame; its values are divided by `slope` too, also those that are still to come.
    pub fn enter(&mut self, frame: Frame, slope: f64) {
        self.origin = frame.from_scene(self.origin);
        self.unit /= frame.scale;
        self.divisor = slope;
        for v in &mut self.values {
            *v = (f64::from(*v) / (slope * frame.scale)) as f32;
        }
    }

    fn add(&mut self, place: Place) {
        self.index.insert(key(place), self.places.len() as u32);
        self.places.push(place);
        self.values.push(0.0);
        self.known.push(false);
    }

    /// Halves the finest cubes that the zero level set may go through, where values change by at most `slope` per length.
    /// New nodes are evaluated where the edge that they halve may be crossed, with `margin` times its length to either side.
    pub fn halve(&mut self, sampler: &Sampler<'_>, slope: f64, margin: f64) -> Result<(), Canceled> {
        let near = (0.5 * 3f64.sqrt() * margin * self.h() * slope) as f32;
        let crossed = |cube: &Cube| {
            let values =
                [0, 1, 2, 3, 4, 5, 6, 7].map(|k| self.values[self.node(corner(*cube, k)).expect("whole") as usize]);
            let inside = values.iter().filter(|v| **v <= 0.0).count();
            (inside > 0 && inside < 8) || (values.iter().sum::<f32>() / 8.0).abs() <= near
        };
        let cubes: Vec<Cube> = self.finest.iter().copied().filter(crossed).collect();
        self.finest = cubes.iter().flat_map(|&cube| (0..8).map(move |k| cube.half(k))).collect();
        self.side /= 2;
        self.split(sampler, cubes, slope, margin)
    }

    /// Halves the cubes around nodes, each of the node's own `side` (see [`Complex::sides`]); those that cannot be halved any
    /// more stay as they are. Returns whether anything changed.
    pub fn halve_around(
        &mut self,
        sampler: &Sampler<'_>,
        nodes: impl IntoIterator<Item = (usize, i32)>,
        slope: f64,
        margin: f64,
    ) -> Result<bool, Canceled> {
        let mut cubes = Vec::new();
        for (i, side) in nodes {
            for k in 0..8 {
                let low = [0, 1, 2].map(|a| self.places[i][a] - side * (k >> a & 1));
                if side >= 2 && self.within(low) && self.within(low.map(|c| c + side)) {
                    cubes.push(Cube { side, low });
                }
            }
        }
        cubes.sort_unstable();
        cubes.dedup();
        let before = self.len();
        self.split(sampler, cubes, slope, margin)?;
        Ok(self.len() > before)
    }

    /// Puts the middles of cubes, of their faces and edges in, and what these rely on.
    fn split(&mut self, sampler: &Sampler<'_>, cubes: Vec<Cube>, slope: f64, margin: f64) -> Result<(), Canceled> {
        let first = self.len();
        for (n, cube) in cubes.into_iter().enumerate() {
            if n.is_multiple_of(1 << 12) {
                sampler.settings().cancel.check()?;
            }
            let s = cube.side / 2;
            for x in 0..3 {
                for y in 0..3 {
                    for z in 0..3 {
                        self.ensure(plus(cube.low, [x * s, y * s, z * s]));
                    }
                }
            }
        }
        // a node halves an edge between nodes of larger cubes
        let mut fresh: Vec<usize> = (first..self.len()).collect();
        fresh.sort_by_key(|&i| std::cmp::Reverse(step(self.places[i])));
        for batch in fresh.chunk_by(|&i, &j| step(self.places[i]) == step(self.places[j])) {
            let (mut wanted, mut points) = (Vec::new(), Vec::new());
            for &i in batch {
                let [a, b] = ends(self.places[i]);
                let half = 0.5 * self.at(a).distance(self.at(b));
                let [a, b] = [a, b].map(|end| self.values[self.node(end).expect("the ends of an edge") as usize]);
                self.values[i] = 0.5 * (a + b);
                let crossed = (a <= 0.0) != (b <= 0.0);
                if crossed || f64::from(self.values[i].abs()) <= margin * slope * half {
                    wanted.push(i);
                    points.push(self.position(i));
                }
            }
            for (&i, v) in wanted.iter().zip(sampler.values(&points)?) {
                self.values[i] = (v / self.divisor) as f32;
                self.known[i] = true;
            }
        }
        Ok(())
    }

    /// Puts a node in, and before it those that it relies on.
    fn ensure(&mut self, place: Place) {
        if !self.within(place) || self.has(place) {
            return;
        }
        let step = step(place);
        let odd = place.map(|c| c & step != 0);
        let shifted = |axis: usize, by: i32| {
            let mut to = place;
            to[axis] += by;
            to
        };
        match odd.iter().filter(|&&o| o).count() {
            3 => {
                // a cube's middle: the cube is whole when the edges that its own corners halve are halved
                let cube = Cube { side: 2 * step, low: place.map(|c| c - step) };
                if cube.side < ROOT {
                    let even = cube.even();
                    for a in 0..3 {
                        self.ensure(corner(cube, even ^ 1 << a));
                    }
                }
            }
            2 => {
                let axis = odd.iter().position(|o| !o).expect("one is even");
                self.ensure(shifted(axis, -step));
                self.ensure(shifted(axis, step));
            }
            _ => {
                for axis in (0..3).filter(|&a| !odd[a]) {
                    self.ensure(shifted(axis, -step));
                    self.ensure(shifted(axis, step));
                }
            }
        }
        self.add(place);
    }

    /// The tetrahedra, and how they hang together.
    pub fn complex(&self, settings: &Settings<'_>) -> Result<Complex, Canceled> {
        /// Nodes per piece of parallel work.
        const CHUNK: usize = 4096;
        let mut cells = self.uncut();
        let pieces: Vec<Result<Vec<Cell>, Canceled>> = settings.pool.install(|| {
            (0..self.len().div_ceil(CHUNK))
                .into_par_iter()
                .map(|piece| {
                    settings.cancel.check()?;
                    let mut cells = Vec::new();
                    for i in piece * CHUNK..self.len().min((piece + 1) * CHUNK) {
                        self.cut(i as u32, &mut cells);
                    }
                    Ok(cells)
                })
                .collect()
        });
        for piece in pieces {
            cells.extend(piece?);
        }
        settings.cancel.check()?;
        let mut sides = vec![ROOT; self.len()];
        for cell in &cells {
            for v in cell.nodes {
                sides[v as usize] = sides[v as usize].min(cell.side);
            }
        }
        let tets = cells.into_iter().map(|cell| cell.nodes).collect();
        let positions = (0..self.len()).map(|i| self.position(i)).collect();
        let border = (0..self.len()).map(|i| self.on_border(i)).collect();
        settings.cancel.check()?;
        Ok(Complex::new(positions, tets, sides, self.unit, border))
    }

    /// The tetrahedra of the first lattice's cubes that are still whole.
    fn uncut(&self) -> Vec<Cell> {
        let mut cells = Vec::new();
        let [_, y, z] = self.extent.map(|e| e / ROOT);
        let count = self.extent.map(|e| e / ROOT).iter().product::<i32>();
        for n in 0..count {
            let cube = Cube { side: ROOT, low: [n / (y * z), n / z % y, n % z].map(|c| c * ROOT) };
            if self.has(cube.middle()) {
                continue;
            }
            let even = cube.even();
            let corners = self.corners(cube);
            for (n, order) in ORDERS.into_iter().enumerate() {
                let path = [0, 1 << order[0], 1 << order[0] | 1 << order[1], 7];
                let mut nodes = path.map(|k| corners[even ^ k]);
                // every other order is left-handed, and so is what is mirrored
                if (n % 2 == 1) != (even.count_ones() % 2 == 1) {
                    nodes.swap(2, 3);
                }
                cells.push(Cell { nodes, side: ROOT });
            }
        }
        cells
    }

    fn corners(&self, cube: Cube) -> [u32; 8] {
        [0, 1, 2, 3, 4, 5, 6, 7].map(|k| self.node(corner(cube, k)).expect("a whole cube"))
    }

    /// The tetrahedra around the middle of a cube, if that is what node `i` is.
    fn cut(&self, i: u32, cells: &mut Vec<Cell>) {
        let place = self.places[i as usize];
        let s = step(place);
        if s >= ROOT || place.iter().any(|c| c & s == 0) {
            return;
        }
        let cube = Cube { side: 2 * s, low: place.map(|c| c - s) };
        let (corners, even) = (self.corners(cube), cube.even());
        let halved = [0, 1, 2, 3, 4, 5, 6, 7].map(|k| s > 1 && self.has(cube.half(k).middle()));
        // the middles of the edges along an axis, at the corner of the other two
        let mut edges = [[None; 8]; 3];
        for (axis, edges) in edges.iter_mut().enumerate() {
            for k in (0..8).filter(|k| k >> axis & 1 == 0) {
                let mut middle = corner(cube, k);
                middle[axis] += s;
                edges[k] = self.node(middle);
                edges[k | 1 << axis] = edges[k];
            }
        }
        for axis in 0..3 {
            let [p, q] = [(axis + 1) % 3, (axis + 2) % 3];
            for side in 0..2usize {
                // the face's corners in turn, beginning on its diagonal
                let base = side << axis | (even & !(1 << axis));
                let ring = [base, base ^ 1 << p, base ^ 1 << p ^ 1 << q, base ^ 1 << q];
                // seen from the middle of the cube they go round to the left or to the right
                let left = (side == 1) != ((base >> p & 1) != (base >> q & 1));
                let mut add = |a: u32, b: u32, c: u32, side: i32| {
                    let nodes = if left { [i, a, b, c] } else { [i, a, c, b] };
                    cells.push(Cell { nodes, side });
                };
                let mut middle = place;
                middle[axis] += if side == 1 { s } else { -s };
                let Some(face) = self.node(middle) else {
                    add(corners[ring[0]], corners[ring[1]], corners[ring[2]], cube.side);
                    add(corners[ring[0]], corners[ring[2]], corners[ring[3]], cube.side);
                    continue;
                };
                for k in 0..4 {
                    let (a, b) = (ring[k], ring[(k + 1) % 4]);
                    match edges[if k % 2 == 0 { p } else { q }][a] {
                        None => add(face, corners[a], corners[b], cube.side),
                        Some(edge) => {
                            if !halved[a] {
                                add(face, corners[a], edge, s);
                            }
                            if !halved[b] {
                                add(face, edge, corners[b], s);
                            }
                        }
                    }
                }
            }
        }
    }

    /// The smallest whole cube around a place (in units, within the box) and the nodes at its corners.
    fn cell(&self, q: DVec3) -> (Cube, [u32; 8]) {
        let top = self.extent.map(|e| e - 1);
        let at = q.floor().as_ivec3().to_array();
        let at = [0, 1, 2].map(|a| at[a].clamp(0, top[a]));
        let around = |side: i32| Cube { side, low: at.map(|c| c - c % side) };
        let nodes = |cube: Cube| {
            let mut list = [0; 8];
            for (k, slot) in list.iter_mut().enumerate() {
                *slot = self.node(corner(cube, k))?;
            }
            Some(list)
        };
        let mut cube = around(ROOT);
        let mut corners = nodes(cube).expect("the first lattice is whole");
        while cube.side > 1 && self.has(cube.middle()) {
            let half = around(cube.side / 2);
            let Some(list) = nodes(half) else { break };
            (cube, corners) = (half, list);
        }
        (cube, corners)
    }

    /// Trilinear interpolation in the smallest whole cube around a place; `None` outside.
    pub fn interpolate(&self, p: DVec3) -> Option<f64> {
        let q = (p - self.origin) / self.unit;
        if (0..3).any(|a| !(q[a] >= 0.0 && q[a] < f64::from(self.extent[a]))) {
            return None;
        }
        let (cube, corners) = self.cell(q);
        let t = (q - DVec3::from(cube.low.map(f64::from))) / f64::from(cube.side);
        let weight = |k: usize, a: usize| if k >> a & 1 == 1 { t[a] } else { 1.0 - t[a] };
        let term = |k: usize| weight(k, 0) * weight(k, 1) * weight(k, 2) * f64::from(self.values[corners[k] as usize]);
        Some((0..8).map(term).sum())
    }

    /// A node near a place: the nearest one on the finest lattice that has one there; beyond the box, near the nearest place
    /// in it.
    pub fn nearest(&self, p: DVec3) -> usize {
        let q = (p - self.origin) / self.unit;
        let mut side = self.side;
        loop {
            let on = (q / f64::from(side)).round();
            let place = [0, 1, 2].map(|a| (on[a] as i32).clamp(0, self.extent[a] / side) * side);
            match self.node(place) {
                Some(i) => return i as usize,
                // the first lattice is whole
                None => side *= 2,
            }
        }
    }

    /// The nodes within a box of half side `reach` around a place, as far as they are on the lattice of the spacing
    /// [`Graded::h`].
    pub fn near(&self, p: DVec3, reach: f64) -> impl Iterator<Item = usize> {
        let center = ((p - self.origin) / self.h()).round().as_ivec3();
        let steps = (reach / self.h()).ceil() as i32;
        let range = move || -steps..=steps;
        range()
            .flat_map(move |x| {
                range().flat_map(move |y| range().map(move |z| (center + IVec3::new(x, y, z)) * self.side))
            })
            .filter(|c| self.within(c.to_array()))
            .filter_map(|c| Some(self.node(c.to_array())? as usize))
    }

    /// Box of the nodes that the solid may reach: those not farther outside than half a cell's diagonal, where values change
    /// by `slope` per length; grown by one spacing. `None` when no node is inside.
    pub fn solid_box(&self, slope: f64) -> Option<(DVec3, DVec3)> {
        let near = 0.5 * 3f64.sqrt() * self.h() * slope;
        let mut bounds: Option<(DVec3, DVec3)> = None;
        for i in (0..self.len()).filter(|&i| f64::from(self.values[i]) <= near) {
            let p = self.position(i);
            bounds = Some(bounds.map_or((p, p), |(lo, hi)| (lo.min(p), hi.max(p))));
        }
        let any = self.values.iter().any(|&v| v <= 0.0);
        bounds.filter(|_| any).map(|(lo, hi)| (lo - self.h(), hi + self.h()))
    }

    /// Change of value per length that 95 % of the lattice edges through the zero level set stay below; of all edges
    /// when there are too few of those. 1 for an exact distance.
    pub fn slope(&self) -> f64 {
        /// Fewer edges than this say too little.
        const ENOUGH: usize = 24;
        let (mut crossing, mut all) = (Vec::new(), Vec::new());
        for (i, &place) in self.places.iter().enumerate() {
            for axis in 0..3 {
                let mut beyond = place;
                beyond[axis] += self.side;
                let Some(j) = self.node(beyond).map(|j| j as usize).filter(|&j| self.known[i] && self.known[j]) else {
                    continue;
                };
                let (a, b) = (self.values[i], self.values[j]);
                let slope = f64::from((a - b).abs()) / self.h();
                all.push(slope);
                if (a <= 0.0) != (b <= 0.0) {
                    crossing.push(slope);
                }
            }
        }
        let mut list = if crossing.len() >= ENOUGH { crossing } else { all };
        list.sort_by(f64::total_cmp);
        list.get(list.len() * 95 / 100).copied().unwrap_or(1.0)
    }
}

/// The ends of the edge that a node halves.
fn ends(place: Place) -> [Place; 2] {
    let step = step(place);
    let mut ends = [place; 2];
    for a in 0..3 {
        if place[a] & step != 0 {
            // the diagonal goes from the even corner to the odd one
            let sign = if (place[a] - step) & (2 * step) == 0 { step } else { -step };
            ends[0][a] -= sign;
            ends[1][a] += sign;
        }
    }
    ends
}
