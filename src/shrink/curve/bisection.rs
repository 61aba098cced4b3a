//! A triangulation of a square that is as fine as asked for wherever it is asked for, and conforming everywhere: right
//! isosceles triangles that are halved from the right angle to the middle of the longest side, neighbours first where
//! they are coarser (newest-vertex bisection, Mitchell 1989; as a set of vertices that holds the parents of each of its
//! members, Lindstrom et al. 1996).
//!
//! The whole state is the set of vertices with their values; triangles are walked, never stored.

use crate::field::Sampler;
use crate::settings::Canceled;
use glam::{DVec2, DVec3};
use std::collections::HashMap;
use std::hash::{BuildHasherDefault, Hasher};

/// Half extent of the square; beyond the domain, which ends at 1, so that its border is outside.
pub(super) const REACH: f64 = 1.03;
/// Finest steps along a side: 3e-5 of the frame each, some 200 times what single precision tells apart.
pub(super) const SIDE: u32 = 1 << 16;

/// A map by places on the finest steps. They are looked up at every step of every walk, so their hash is a short one; nobody
/// chooses them who could profit from collisions.
pub(super) type Map<K, V> = HashMap<K, V, BuildHasherDefault<Mix>>;

/// Multiplies by the golden ratio's fraction of 2^64 (Knuth), and folds the high half into the low one.
#[derive(Clone, Copy, Default)]
pub(super) struct Mix(u64);

impl Hasher for Mix {
    fn finish(&self) -> u64 {
        self.0 ^ (self.0 >> 32)
    }
    fn write(&mut self, bytes: &[u8]) {
        bytes.iter().for_each(|&b| self.write_u32(u32::from(b)));
    }
    fn write_u32(&mut self, x: u32) {
        self.0 = (self.0.rotate_left(29) ^ u64::from(x)).wrapping_mul(0x9e37_79b9_7f4a_7c15);
    }
}

/// A vertex by its place, in finest steps.
pub(super) type Vertex = (u32, u32);

/// Its place in the frame.
pub(super) fn place((x, y): Vertex) -> DVec2 {
    DVec2::splat(-REACH) + 2.0 * REACH / f64::from(SIDE) * DVec2::new(f64::from(x), f64::from(y))
}

/// A triangle: its right angle, then the ends of its longest side, counter-clockwise.
pub(super) type Triangle = [Vertex; 3];

/// Length of the longest side.
pub(super) fn size([_, a, b]: Triangle) -> f64 {
    place(a).distance(place(b))
}

fn middle([_, a, b]: Triangle) -> Vertex {
    (a.0.midpoint(b.0), a.1.midpoint(b.1))
}

/// Whether the triangle can be halved on the finest steps.
pub(super) fn divides([_, a, b]: Triangle) -> bool {
    a.0.abs_diff(b.0).max(a.1.abs_diff(b.1)) > 1
}

/// The right angles of the (at most two) triangles whose longest side `v` is the middle of.
fn parents((x, y): Vertex) -> impl Iterator<Item = Vertex> {
    let s = 1 << x.trailing_zeros().min(y.trailing_zeros());
    let (across, along) = (x & s != 0, y & s != 0);
    let corners = [(-1, -1), (1, -1), (1, 1), (-1, 1)];
    let sides = [(1, 0), (-1, 0), (0, 1), (0, -1)];
    let candidates = if across && along { corners } else { sides };
    let step = i64::from(s);
    candidates.into_iter().filter_map(move |(dx, dy)| {
        let (px, py) = (i64::from(x) + step * dx, i64::from(y) + step * dy);
        let (Ok(px), Ok(py)) = (u32::try_from(px), u32::try_from(py)) else { return None };
        let twice = s << 1;
        let is_parent = if across && along {
            // the middle of a square: the corners that are middles of the sides of the square twice as large
            (px & twice != 0) != (py & twice != 0)
        } else {
            // the middle of a side: the middles of the squares on either hand
            px & s != 0 && py & s != 0
        };
        (is_parent && px <= SIDE && py <= SIDE).then_some((px, py))
    })
}

/// Vertices with their values.
pub(super) struct Mesh {
    values: Map<Vertex, f64>,
}

impl Mesh {
    /// A mesh of squares, `cells` (a power of two) along a side.
    ///
    /// # Errors
    /// When the token is raised.
    pub fn new(sampler: &Sampler<'_>, cells: u32) -> Result<Self, Canceled> {
        let step = SIDE / cells;
        let vertices = (0..=cells).flat_map(|j| (0..=cells).map(move |i| (i * step, j * step))).collect();
        let mut mesh = Self { values: Map::default() };
        mesh.evaluate(sampler, vertices)?;
        Ok(mesh)
    }

    /// Vertices.
    pub fn len(&self) -> usize {
        self.values.len()
    }

    /// The value at a vertex of the mesh.
    pub fn value(&self, v: Vertex) -> f64 {
        self.values[&v]
    }

    /// Whether a vertex of the mesh is inside the solid.
    pub fn inside(&self, v: Vertex) -> bool {
        self.value(v) < 0.0
    }

    /// Smallest and largest value.
    pub fn range(&self) -> (f64, f64) {
        self.values.values().fold((f64::INFINITY, f64::NEG_INFINITY), |(lo, hi), &v| (lo.min(v), hi.max(v)))
    }

    /// Calls `f` with every triangle, in one fixed order.
    pub fn triangles(&self, mut f: impl FnMut(Triangle)) {
        let corners = [(0, 0), (SIDE, 0), (SIDE, SIDE), (0, SIDE)];
        let mut open = vec![[corners[1], corners[2], corners[0]], [corners[3], corners[0], corners[2]]];
        while let Some(triangle) = open.pop() {
            let m = middle(triangle);
            let [apex, a, b] = triangle;
            if divides(triangle) && self.values.contains_key(&m) {
                open.push([m, b, apex]);
                open.push([m, apex, a]);
            } else {
                f(triangle);
            }
        }
    }

    /// Halves triangles of the mesh (which must [divide](divides)), and what must be halved with them to stay conforming.
    ///
    /// # Errors
    /// When the token is raised.
    pub fn halve(&mut self, sampler: &Sampler<'_>, triangles: &[Triangle]) -> Result<(), Canceled> {
        let (mut wanted, mut new) = (Vec::new(), Map::default());
        for &triangle in triangles {
            wanted.push(middle(triangle));
            while let Some(v) = wanted.pop() {
                if !self.values.contains_key(&v) && new.insert(v, ()).is_none() {
                    wanted.extend(parents(v));
                }
            }
        }
        let mut vertices: Vec<Vertex> = new.into_keys().collect();
        vertices.sort_unstable();
        self.evaluate(sampler, vertices)
    }

    fn evaluate(&mut self, sampler: &Sampler<'_>, vertices: Vec<Vertex>) -> Result<(), Canceled> {
        let places: Vec<DVec3> = vertices.iter().map(|&v| place(v).extend(0.0)).collect();
        for (v, value) in vertices.into_iter().zip(sampler.values(&places)?) {
            // the border lies beyond the domain
            let border = [v.0, v.1].iter().any(|&c| c == 0 || c == SIDE);
            self.values.insert(v, if border { value.max(f64::MIN_POSITIVE) } else { value });
        }
        Ok(())
    }
}
