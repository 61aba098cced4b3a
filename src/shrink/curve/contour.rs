//! The zero set of a two-dimensional field as closed loops: marching triangles on a mesh that is refined only near it.
//!
//! Every triangle is crossed by at most one piece of the contour and the mesh is conforming, so the loops are closed and
//! do not cross, and their number and orientation *is* the topology: counter-clockwise loops bound components, clockwise
//! ones are holes. Crossings are bracketed roots on the edges. The mesh is halved on wherever the loops do not account for
//! the values around them: beside a slot, a strut or a tip that slipped between the vertices the field is nearer to zero
//! than to any loop, and where a rounding is not resolved the normals of successive crossings are far apart.

use super::bisection::{Map, Mesh, Triangle, Vertex, divides, place, size};
use super::corners::{Corner, Step, with_corners};
use super::polyline::{Segments, double_area};
use super::{Detail, ShrinkError};
use crate::field::{Metric, Sampler};
use crate::settings::Canceled;
use glam::{DVec2, DVec3};

/// Cells per side of the first mesh where the field says how fast it can vary, and where it does not.
const COARSE: (u32, u32) = (32, 64);
/// Where no bound is known, the field is taken to vary at most this much faster than it does between vertices nearby.
const STEEPER: f64 = 2.0;
/// A value accounts for a loop this many times as far away as it says: bounds may fall short of the distance.
const SHORT: f64 = 2.0;
/// What loops and values may disagree by, in parts of a triangle's longest side.
const SLACK: f64 = 0.1;
/// Successive normals that turn by more than 20 degrees ask for a closer look, unless a corner is between them.
const TURN_COSINE: f64 = 0.94;
/// A loop whose successive normals turn by more than 90 degrees, with no corner between them, has turned back.
const BACK_COSINE: f64 = 0.0;
/// Vertices of a mesh at most.
const MOST: usize = 500_000;
/// Rounds of root finding on the edges; a bracket shrinks at least eightfold in three of them.
const ROUNDS: usize = 24;

/// A closed loop with the solid on its left.
#[derive(Clone, Default)]
pub(super) struct Loop {
    pub points: Vec<DVec2>,
    /// Unit gradients as they are before and after each point, which differ at corners.
    pub normals: Vec<[DVec2; 2]>,
    pub corners: Vec<bool>,
    /// Longest sides of the triangles there.
    pub sizes: Vec<f64>,
}

/// A crossing of the zero set and an edge of the mesh.
#[derive(Clone, Copy)]
pub(super) struct Crossing {
    pub point: DVec2,
    pub normal: DVec2,
}

/// Contours the sampler's field in its frame: all loops, largest area first.
///
/// # Errors
/// [`ShrinkError::Empty`] without a zero set, [`ShrinkError::Canceled`].
pub(super) fn contour(sampler: &Sampler<'_>, detail: Detail) -> Result<Vec<Loop>, ShrinkError> {
    let bound = sampler.field().lipschitz().map(f64::from);
    let exact = sampler.field().metric() == Metric::Exact;
    let coarse = if bound.is_some() { COARSE.0 } else { COARSE.1 };
    let mut mesh = Mesh::new(sampler, coarse)?;
    // everywhere near the zero set to the same size first
    while mesh.len() < MOST {
        let near = Near::new(&mesh, bound, exact);
        let mut wanted = Vec::new();
        mesh.triangles(|t| {
            if size(t) > detail.coarsest && near.may_hold(&mesh, t) {
                wanted.push(t);
            }
        });
        if wanted.is_empty() {
            break;
        }
        mesh.halve(sampler, &wanted)?;
    }
    let mut known = Known::default();
    loop {
        let loops = trace(sampler, &mesh, &mut known)?;
        let wanted = if mesh.len() < MOST { unaccounted(&mesh, &loops, bound, exact, detail) } else { Vec::new() };
        if !wanted.is_empty() {
            mesh.halve(sampler, &wanted)?;
            continue;
        }
        if loops.is_empty() {
            let (min, max) = mesh.range();
            let scale = sampler.frame().scale;
            return Err(ShrinkError::Empty { min: scale * min, max: scale * max });
        }
        let mut loops: Vec<Loop> = loops.into_iter().map(|(l, _)| l).collect();
        loops.sort_by(|a, b| double_area(&b.points).abs().total_cmp(&double_area(&a.points).abs()));
        return Ok(loops);
    }
}

/// What was found on edges, and between them, that are still there after the mesh was halved elsewhere.
#[derive(Default)]
pub(super) struct Known {
    crossings: Map<Edge, Crossing>,
    pub corners: Map<(Edge, Edge), Option<Corner>>,
}

/// How fast the field varies around every vertex, at most.
struct Near {
    slopes: Map<Vertex, f64>,
    bound: Option<f64>,
}

impl Near {
    fn new(mesh: &Mesh, bound: Option<f64>, exact: bool) -> Self {
        let mut slopes = Map::default();
        // a distance needs no estimate
        if !exact {
            mesh.triangles(|t| {
                let slope = (0..3).map(|k| slope(mesh, t[k], t[(k + 1) % 3])).fold(0.0, f64::max);
                for v in t {
                    let known: &mut f64 = slopes.entry(v).or_default();
                    *known = known.max(slope);
                }
            });
        }
        Self { slopes, bound }
    }

    /// How fast the field may vary around `v`: a bound that is near to what it does is taken for sure.
    fn slope(&self, v: Vertex) -> f64 {
        let steepest = STEEPER * self.slopes.get(&v).copied().unwrap_or(f64::INFINITY);
        self.bound.map_or(steepest, |bound| bound.min(steepest.max(1.0)))
    }

    /// How fast the field does vary around `v`.
    fn typical(&self, v: Vertex) -> f64 {
        self.slopes.get(&v).copied().unwrap_or(1.0).max(f64::MIN_POSITIVE)
    }

    /// Whether the zero set may pass through a triangle, no point of which is farther from its nearest corner than half its
    /// longest side.
    fn may_hold(&self, mesh: &Mesh, t: Triangle) -> bool {
        let crossed = t.iter().any(|&v| mesh.inside(v) != mesh.inside(t[0]));
        crossed || t.iter().any(|&v| mesh.value(v).abs() <= 0.5 * size(t) * self.slope(v))
    }
}

fn slope(mesh: &Mesh, a: Vertex, b: Vertex) -> f64 {
    (mesh.value(a) - mesh.value(b)).abs() / place(a).distance(place(b))
}

/// The triangles to look into, because the values at their corners or the normals along the loops say that something is there
/// which the loops do not show.
fn unaccounted(
    mesh: &Mesh,
    loops: &[(Loop, Vec<Triangle>)],
    bound: Option<f64>,
    exact: bool,
    detail: Detail,
) -> Vec<Triangle> {
    let near = Near::new(mesh, bound, exact);
    let polygons: Vec<&[DVec2]> = loops.iter().map(|(l, _)| l.points.as_slice()).collect();
    let segments = Segments::new(&polygons, detail.coarsest);
    let fine = |t: Triangle| size(t) > detail.finest && divides(t);
    let mut wanted: Vec<Triangle> = Vec::new();
    mesh.triangles(|t| {
        if !fine(t) || !near.may_hold(mesh, t) {
            return;
        }
        let odd = t.iter().any(|&v| {
            let (value, reach) = (mesh.value(v).abs(), 0.5 * size(t));
            let says = if exact { value } else { SHORT * value / near.typical(v) };
            value <= reach * near.slope(v) && !segments.any_within(place(v), says + SLACK * size(t))
        });
        if odd {
            wanted.push(t);
        }
    });
    // a loop that turns back at once ends where its triangles do, or a real tip
    let mut ends = Ends { cells: Map::default(), reach: detail.coarsest };
    for (l, triangles) in loops {
        let n = l.points.len();
        for (k, &triangle) in triangles.iter().enumerate() {
            let turn = l.normals[k][1].dot(l.normals[(k + 1) % n][0]);
            if turn < TURN_COSINE && fine(triangle) {
                wanted.push(triangle);
            }
            if turn < BACK_COSINE {
                ends.add(l.points[k], size(triangle));
            }
        }
    }
    if !ends.cells.is_empty() {
        mesh.triangles(|t| {
            if fine(t) && near.may_hold(mesh, t) && ends.is_coarse(t) {
                wanted.push(t);
            }
        });
    }
    wanted.sort_unstable();
    wanted.dedup();
    wanted
}

/// Where loops turn back, and how fine the mesh is there. Around them it has to be about as fine: what goes on from there goes on
/// through triangles whose corners the two ends account for.
struct Ends {
    cells: Map<(u32, u32), Vec<(DVec2, f64)>>,
    reach: f64,
}

impl Ends {
    fn cell(&self, p: DVec2) -> (u32, u32) {
        let c = ((p + 2.0) / self.reach).floor().as_uvec2();
        (c.x, c.y)
    }
    fn add(&mut self, p: DVec2, size: f64) {
        self.cells.entry(self.cell(p)).or_default().push((p, size));
    }
    fn is_coarse(&self, t: Triangle) -> bool {
        let (p, size) = (place(t[0]), size(t));
        let (x, y) = self.cell(p);
        let of = |c: (u32, u32)| self.cells.get(&c).map(Vec::as_slice).unwrap_or_default();
        let near = |&(q, fine): &(DVec2, f64)| size > 2.5 * fine && p.distance(q) <= self.reach;
        (x - 1..=x + 1).any(|x| (y - 1..=y + 1).any(|y| of((x, y)).iter().any(near)))
    }
}

/// An edge by its ends, the smaller first.
pub(super) type Edge = (Vertex, Vertex);

/// The loops with their corners, and for every point the triangle that lies between it and the next.
fn trace(sampler: &Sampler<'_>, mesh: &Mesh, known: &mut Known) -> Result<Vec<(Loop, Vec<Triangle>)>, Canceled> {
    let paths = paths(mesh);
    let mut new: Vec<Edge> = Vec::new();
    for &(edge, _) in paths.iter().flatten() {
        if !known.crossings.contains_key(&edge) {
            new.push(edge);
        }
    }
    let points = roots(sampler, mesh, &new)?;
    let lifted: Vec<DVec3> = points.iter().map(|p| p.extend(0.0)).collect();
    let (_, gradients) = sampler.gradients(&lifted)?;
    for ((edge, point), gradient) in new.into_iter().zip(points).zip(gradients) {
        known.crossings.insert(edge, Crossing { point, normal: gradient.truncate().normalize_or(DVec2::X) });
    }
    let step = |(edge, t): &(Edge, Triangle)| -> Step { (*edge, known.crossings[edge], *t) };
    let steps = paths.iter().map(|path| path.iter().map(step).collect()).collect();
    with_corners(sampler, steps, known)
}

/// Loops of crossed edges, each with the triangle that the contour enters there.
fn paths(mesh: &Mesh) -> Vec<Vec<(Edge, Triangle)>> {
    let edge = |a: Vertex, b: Vertex| (a.min(b), a.max(b));
    let mut next: Map<Edge, (Edge, Triangle)> = Map::default();
    let mut starts: Vec<Edge> = Vec::new();
    mesh.triangles(|t| {
        // entering where the boundary of the triangle goes from inside to outside keeps the solid on the left
        let sides = [0, 1, 2].map(|c| (t[c], t[(c + 1) % 3]));
        let from = sides.iter().find(|(a, b)| mesh.inside(*a) && !mesh.inside(*b));
        let to = sides.iter().find(|(a, b)| !mesh.inside(*a) && mesh.inside(*b));
        if let (Some(&(a, b)), Some(&(c, d))) = (from, to) {
            next.insert(edge(a, b), (edge(c, d), t));
            starts.push(edge(a, b));
        }
    });
    let mut paths = Vec::new();
    for start in starts {
        let (mut path, mut at) = (Vec::new(), start);
        while let Some((to, triangle)) = next.remove(&at) {
            path.push((at, triangle));
            at = to;
        }
        if !path.is_empty() {
            paths.push(path);
        }
    }
    paths
}

/// The zero on every edge: false position with the Illinois rule (Dowell and Jarratt 1971), every third round a bisection.
fn roots(sampler: &Sampler<'_>, mesh: &Mesh, edges: &[Edge]) -> Result<Vec<DVec2>, Canceled> {
    struct State {
        places: [DVec2; 2],
        ends: [f64; 2],
        values: [f64; 2],
        last: usize,
    }
    // single precision knows no finer places than this, in parts of the frame
    const DONE: f64 = 2e-7;
    let mut states: Vec<State> = edges
        .iter()
        .map(|&(a, b)| {
            let (inside, outside) = if mesh.inside(a) { (a, b) } else { (b, a) };
            State {
                places: [place(inside), place(outside)],
                ends: [0.0, 1.0],
                values: [mesh.value(inside), mesh.value(outside)],
                last: 2,
            }
        })
        .collect();
    let mut roots = vec![0.0; edges.len()];
    let mut open: Vec<usize> = (0..edges.len()).collect();
    let at = |s: &State, t: f64| s.places[0].lerp(s.places[1], t);
    for round in 0..ROUNDS {
        if open.is_empty() {
            break;
        }
        for &k in &open {
            let State { ends: [a, b], values: [va, vb], .. } = states[k];
            let falling = a + (b - a) * va / (va - vb);
            roots[k] = if round % 3 == 2 || !falling.is_finite() { 0.5 * (a + b) } else { falling };
        }
        let places: Vec<DVec3> = open.iter().map(|&k| at(&states[k], roots[k]).extend(0.0)).collect();
        let values = sampler.values(&places)?;
        let mut still = Vec::with_capacity(open.len());
        for (&k, v) in open.iter().zip(values) {
            let length = states[k].places[0].distance(states[k].places[1]);
            let state = &mut states[k];
            let slope = (state.values[1] - state.values[0]) / (length * (state.ends[1] - state.ends[0]));
            let end = usize::from(v >= 0.0);
            state.ends[end] = roots[k];
            state.values[end] = v;
            if state.last == end {
                state.values[1 - end] *= 0.5;
            }
            state.last = end;
            if v.abs() > DONE * slope && length * (state.ends[1] - state.ends[0]) > DONE {
                still.push(k);
            }
        }
        open = still;
    }
    Ok(states.iter().zip(&roots).map(|(s, &t)| at(s, t)).collect())
}
