//! Marching cubes, the baseline that every figure is compared with (Lorensen and Cline 1987).
//!
//! The table is made by code: in each of the 256 sign patterns the crossings are joined face by face, and on a face whose
//! diagonals differ each inside corner is cut off by itself, on both sides of the face alike, so that neighbouring cubes always
//! agree and the surface is closed wherever it does not leave the grid (the defect of the original table is described by
//! Dürst 1988). Not promised: the topology of the trilinear interpolant inside ambiguous cubes.

use crate::field::Sampler;
use crate::settings::Canceled;
use glam::DVec3;
use std::collections::HashMap;

/// A mesh of marching cubes.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Cubes {
    /// Vertices, one per grid edge that the zero level set crosses, in the sampler's frame.
    pub vertices: Vec<DVec3>,
    /// Triangles, counter-clockwise outward.
    pub triangles: Vec<[u32; 3]>,
    /// Nodes of the grid: the field values that marching over all of it takes. Where the field has a Lipschitz bound,
    /// those that it proves to lie away from the zero level set are left out, which changes no vertex.
    pub values: u64,
}

/// Corner `i` of a cube is at (i & 1, i >> 1 & 1, i >> 2 & 1).
const CORNERS: usize = 8;
/// Edges as pairs of corners, the lower first: four along x, four along y, four along z.
const EDGES: [[usize; 2]; 12] =
    [[0, 1], [2, 3], [4, 5], [6, 7], [0, 2], [1, 3], [4, 6], [5, 7], [0, 4], [1, 5], [2, 6], [3, 7]];
/// Faces as corners, counter-clockwise seen from outside the cube.
const FACES: [[usize; 4]; 6] = [[0, 4, 6, 2], [1, 3, 7, 5], [0, 1, 5, 4], [2, 6, 7, 3], [0, 2, 3, 1], [4, 5, 7, 6]];

fn edge_between(a: usize, b: usize) -> usize {
    EDGES.iter().position(|e| *e == [a.min(b), a.max(b)]).unwrap_or(0)
}

/// Triangles, as triples of edges, of every sign pattern (bit `i` is set when corner `i` is inside).
fn table() -> Vec<Vec<[usize; 3]>> {
    (0..1 << CORNERS).map(|inside: usize| loops(inside).iter().flat_map(|l| triangulate(l)).collect()).collect()
}

/// The closed loops of edges that part inside from outside, each counter-clockwise seen from outside the solid.
fn loops(inside: usize) -> Vec<Vec<usize>> {
    let is_inside = |corner: usize| inside >> corner & 1 == 1;
    // on every face, walking round it counter-clockwise, the surface's trace goes from the edge where the walk enters the
    // inside to the edge where it leaves; with two inside runs each is cut off by itself, which keeps the other corners joined
    let mut next = [usize::MAX; EDGES.len()];
    for face in FACES {
        for k in 0..4 {
            if !is_inside(face[k]) && is_inside(face[(k + 1) % 4]) {
                let enters = edge_between(face[k], face[(k + 1) % 4]);
                let leaving = (1..4).find(|j| !is_inside(face[(k + j + 1) % 4])).unwrap_or(3);
                let leaves = edge_between(face[(k + leaving) % 4], face[(k + leaving + 1) % 4]);
                next[enters] = leaves;
            }
        }
    }
    let mut found = Vec::new();
    for start in 0..EDGES.len() {
        let (mut round, mut at) = (Vec::new(), start);
        while next[at] != usize::MAX {
            round.push(at);
            at = std::mem::replace(&mut next[at], usize::MAX);
        }
        if !round.is_empty() {
            found.push(round);
        }
    }
    found
}

/// Cuts a loop into triangles so that no diagonal lies on a face of the cube, where it could coincide with an edge of the
/// neighbouring cube and give it four triangles.
fn triangulate(polygon: &[usize]) -> Vec<[usize; 3]> {
    fn cut(polygon: &[usize]) -> Option<Vec<[usize; 3]>> {
        if polygon.len() == 3 {
            return Some(vec![[polygon[0], polygon[1], polygon[2]]]);
        }
        (0..polygon.len()).find_map(|ear| {
            let n = polygon.len();
            let (before, after) = (polygon[(ear + n - 1) % n], polygon[(ear + 1) % n]);
            if share_a_face(before, after) {
                return None;
            }
            let rest: Vec<usize> = (0..n).filter(|&i| i != ear).map(|i| polygon[i]).collect();
            let mut triangles = cut(&rest)?;
            triangles.push([before, polygon[ear], after]);
            Some(triangles)
        })
    }
    cut(polygon).unwrap_or_else(|| (2..polygon.len()).map(|i| [polygon[0], polygon[i - 1], polygon[i]]).collect())
}

fn share_a_face(a: usize, b: usize) -> bool {
    FACES.iter().any(|face| [a, b].iter().all(|&e| EDGES[e].iter().all(|c| face.contains(c))))
}

/// Marches over `side` samples per side of the box from `min` to `max` (a cube usually), in the sampler's frame; values are
/// taken layer by layer, `side^3` in all. A corner counts as inside when its value is negative; vertices are placed by
/// linear interpolation.
///
/// # Errors
/// When the token is raised.
///
/// # Panics
/// When `side` is less than 2.
pub fn marching_cubes(sampler: &Sampler<'_>, min: DVec3, max: DVec3, side: usize) -> Result<Cubes, Canceled> {
    assert!(side >= 2, "a grid needs two samples per side");
    let table = table();
    let step = (max - min) / (side - 1) as f64;
    let place = |x: usize, y: usize, z: usize| min + step * DVec3::new(x as f64, y as f64, z as f64);
    let blocks = Blocks::new(sampler, min, step, side)?;
    let layer = |z: usize| -> Result<Vec<f64>, Canceled> {
        let far: Vec<Option<f64>> = (0..side * side).map(|i| blocks.far([i % side, i / side, z])).collect();
        let near = (0..side * side).filter(|&i| far[i].is_none());
        let points: Vec<DVec3> = near.map(|i| place(i % side, i / side, z)).collect();
        let mut values = sampler.values(&points)?.into_iter();
        Ok(far.into_iter().map(|known| known.or_else(|| values.next()).unwrap_or(0.0)).collect())
    };
    let mut out = Cubes { values: (side * side * side) as u64, ..Cubes::default() };
    // vertex of a grid edge, by its lower node within the layers at hand and its axis
    let mut known: HashMap<(usize, usize, usize, usize), u32> = HashMap::new();
    let mut below = layer(0)?;
    for z in 0..side - 1 {
        let above = layer(z + 1)?;
        for y in 0..side - 1 {
            for x in 0..side - 1 {
                let corner = |i: usize| (x + (i & 1), y + (i >> 1 & 1), z + (i >> 2));
                let value = |i: usize| {
                    let (cx, cy, cz) = corner(i);
                    if cz == z { below[cy * side + cx] } else { above[cy * side + cx] }
                };
                let inside = (0..CORNERS).fold(0, |bits, i| bits | usize::from(value(i) < 0.0) << i);
                for triangle in &table[inside] {
                    out.triangles.push(triangle.map(|e| {
                        let [a, b] = EDGES[e];
                        let (ax, ay, az) = corner(a);
                        *known.entry((ax, ay, az, e / 4)).or_insert_with(|| {
                            let (bx, by, bz) = corner(b);
                            let t = value(a) / (value(a) - value(b));
                            out.vertices.push(place(ax, ay, az).lerp(place(bx, by, bz), t));
                            out.vertices.len() as u32 - 1
                        })
                    }));
                }
            }
        }
        known.retain(|key, _| key.2 > z);
        below = above;
    }
    Ok(out)
}

/// Cells per side of a block that is looked at as a whole.
const BLOCK: usize = 4;
/// A Lipschitz bound is taken this much larger: values and places are rounded to single precision.
const ROUNDING: f64 = 1.001;

/// Which blocks of cells a Lipschitz bound proves to hold no zero: |s| at the middle is more than the bound times the way to
/// a corner.
struct Blocks {
    per_side: usize,
    /// The value at the middle of a block without a zero; it has the sign of the whole block.
    far: Vec<Option<f64>>,
}

impl Blocks {
    fn new(sampler: &Sampler<'_>, min: DVec3, step: DVec3, side: usize) -> Result<Self, Canceled> {
        let per_side = (side - 1).div_ceil(BLOCK);
        let Some(bound) = sampler.field().lipschitz() else {
            return Ok(Self { per_side: 0, far: Vec::new() });
        };
        // outside the domain the distance to it is added, at right angles to what the field does along its faces
        let bound = ROUNDING * f64::from(bound).hypot(1.0);
        let size = step * BLOCK as f64;
        let middle = |i: usize| {
            let place = [i % per_side, i / per_side % per_side, i / (per_side * per_side)];
            min + size * (DVec3::from(place.map(|k| k as f64)) + 0.5)
        };
        let middles: Vec<DVec3> = (0..per_side.pow(3)).map(middle).collect();
        let reach = bound * 0.5 * size.length();
        let far = sampler.values(&middles)?.into_iter().map(|s| (s.abs() > reach).then_some(s)).collect();
        Ok(Self { per_side, far })
    }

    /// A value of the right sign for a node whose blocks all are far; `None` where the field must be asked.
    fn far(&self, node: [usize; 3]) -> Option<f64> {
        if self.per_side == 0 {
            return None;
        }
        // a node on a border belongs to the blocks of both sides
        let last = self.per_side - 1;
        let range = node.map(|k| (k.saturating_sub(1) / BLOCK).min(last)..=(k / BLOCK).min(last));
        let [xs, ys, zs] = range;
        let mut value = None;
        for z in zs {
            for y in ys.clone() {
                for x in xs.clone() {
                    value = Some(self.far[(z * self.per_side + y) * self.per_side + x]?);
                }
            }
        }
        value
    }
}

#[cfg(test)]
mod tests {
    use super::super::certificate::{Topology, topology};
    use super::super::fixtures::*;
    use super::*;
    use crate::field::sampler::Tally;
    use crate::field::{Domain, Field, Gradients, Metric, Points};

    #[test]
    fn no_triangulation_has_a_diagonal_on_a_face() {
        for (pattern, triangles) in table().iter().enumerate() {
            let mut edges: Vec<[usize; 2]> =
                triangles.iter().flat_map(|t| [[t[0], t[1]], [t[1], t[2]], [t[2], t[0]]]).collect();
            let all = edges.clone();
            edges.retain(|&[a, b]| all.contains(&[b, a]));
            assert!(edges.iter().all(|&[a, b]| !share_a_face(a, b)), "{pattern:#b} {triangles:?}");
        }
    }

    #[test]
    fn a_sphere_comes_out_closed_outward_and_near() {
        with_settings(2, |settings| {
            let (field, tally) = (Balls::one(0.6), Tally::new());
            let sampler = Sampler::new(&field, *settings, &tally);
            let cubes = marching_cubes(&sampler, DVec3::NEG_ONE, DVec3::ONE, 27).unwrap();
            let found = topology(cubes.vertices.len(), &cubes.triangles);
            assert_eq!(found, Topology { closed: true, euler: 2, components: 1 });
            assert_eq!(cubes.values, 27 * 27 * 27);
            assert!(cubes.vertices.iter().all(|p| (p.length() - 0.6).abs() < 3e-3));
            for t in &cubes.triangles {
                let [a, b, c] = t.map(|v| cubes.vertices[v as usize]);
                assert!((b - a).cross(c - a).dot(a + b + c) >= 0.0);
            }
        });
    }

    #[test]
    fn what_a_bound_leaves_out_changes_nothing() {
        let bounded = Balls { balls: vec![(glam::Vec3::X * 0.3, 0.5), (glam::Vec3::X * -0.5, 0.2)], ..Balls::one(0.5) };
        let unbounded = Balls { metric: Metric::Bound, balls: bounded.balls.clone(), ..bounded };
        assert!(bounded.lipschitz().is_some() && unbounded.lipschitz().is_none());
        // a box that reaches beyond the domain
        let march = |field: &Balls| {
            with_settings(2, |settings| {
                let tally = Tally::new();
                let sampler = Sampler::new(field, *settings, &tally);
                let cubes = marching_cubes(&sampler, DVec3::splat(-1.2), DVec3::splat(1.1), 43).unwrap();
                (cubes, tally.total().value)
            })
        };
        let ((fewer, few), (all, many)) = (march(&bounded), march(&unbounded));
        assert_eq!(fewer, all);
        assert!(many == 43 * 43 * 43 && few < many / 2, "{few} of {many}");
    }

    /// Pseudo-random signs at the nodes of a grid: every ambiguous pattern, beside every other.
    struct Noise;
    impl Field for Noise {
        fn domain(&self) -> Domain {
            Domain { min: [-10.0; 3], max: [10.0; 3] }
        }
        fn metric(&self) -> Metric {
            Metric::Sign
        }
        fn lipschitz(&self) -> Option<f32> {
            None
        }
        fn values(&self, points: Points<'_>, values: &mut [f32]) {
            for (i, v) in values.iter_mut().enumerate() {
                let (x, y, z) = (points.x[i].round(), points.y[i].round(), points.z[i].round());
                let border = x.abs().max(y.abs()).max(z.abs()) >= 8.0;
                let seed = (x as i64 + 50) as u64 * 10_007 + (y as i64 + 50) as u64 * 101 + (z as i64 + 50) as u64;
                let noise = Splitmix::new(seed).unit() as f32 - 0.5;
                *v = if border { 1.0 } else { noise };
            }
        }
        fn gradients(&self, points: Points<'_>, values: &mut [f32], gradients: Gradients<'_>) {
            self.values(points, values);
            gradients.x.fill(1.0);
            gradients.y.fill(0.0);
            gradients.z.fill(0.0);
        }
    }

    #[test]
    fn noise_of_every_pattern_comes_out_closed() {
        with_settings(1, |settings| {
            let tally = Tally::new();
            let sampler = Sampler::new(&Noise, *settings, &tally);
            let cubes = marching_cubes(&sampler, DVec3::splat(-9.0), DVec3::splat(9.0), 19).unwrap();
            assert!(cubes.triangles.len() > 5000);
            assert!(topology(cubes.vertices.len(), &cubes.triangles).closed);
        });
    }
}
