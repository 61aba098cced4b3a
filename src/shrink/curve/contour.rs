//! The zero set of a two-dimensional field as closed loops: marching triangles on a lattice that is refined only near it.
//!
//! Every triangle of the lattice is crossed by at most one piece of the contour, so the loops are closed and simple, and
//! their number and orientation *is* the topology: counter-clockwise loops are components, clockwise ones are holes. Crossings are bracketed
//! roots on the edges of the lattice, corners are where the tangents at two neighbouring crossings meet (the
//! two-dimensional case of Ju et al. 2002, "Dual contouring of Hermite data"). What is smaller than a cell of the lattice
//! is not seen.

use super::ShrinkError;
use super::polyline::double_area;
use crate::field::{Frame, Sampler};
use crate::settings::Canceled;
use glam::{DVec2, DVec3};
use std::collections::HashMap;

/// Cells per side of the first lattice, on which every node is evaluated.
const COARSE: usize = 64;
/// How often the spacing is halved: 512 cells per side at last.
const LEVELS: usize = 3;
/// A cell may hold a piece of the zero set when a value at its corners is below this part of what the values vary by over
/// three cells: a distance varies by at least 3 cells there, and the zero set is at most 0.71 cells from a corner of its cell.
const NEAR: f64 = 0.5;
/// Half extent of the lattice; beyond the domain, which ends at 1, so that its border is outside.
const REACH: f64 = 1.03;
/// Normals at neighbouring crossings that differ by more than 8 degrees may have a corner between them.
const CORNER_COSINE: f64 = 0.99;
/// Normals that are nearly opposite do not tell where their tangents meet.
const LEAST_SINE: f64 = 0.1;
/// A corner is one when the field vanishes there to this part of a cell. On a smooth curve that turns by 8 degrees (0.14) in
/// a cell the tangents meet 0.14/8 of a cell off the curve, so what passes is no rounding.
const CORNER_MISS: f64 = 0.01;
/// Crossings closer than this part of a cell are one.
const MERGE: f64 = 0.02;
/// Rounds of root finding on the edges; a bracket shrinks at least eightfold in three of them.
const ROUNDS: usize = 24;

/// A closed loop with the solid on its left.
pub(super) struct Loop {
    pub points: Vec<DVec2>,
    /// Unit gradients; at a corner the mean of both sides.
    pub normals: Vec<DVec2>,
    pub corners: Vec<bool>,
}

/// All loops, and what the lattice saw.
pub(super) struct Contour {
    pub loops: Vec<Loop>,
    /// Of the finest lattice, in frame units.
    pub spacing: f64,
}

/// Values on a square lattice of `side` nodes per side.
struct Grid {
    side: usize,
    values: Vec<f64>,
}

impl Grid {
    fn spacing(&self) -> f64 {
        2.0 * REACH / (self.side - 1) as f64
    }
    fn place(&self, node: usize) -> DVec2 {
        DVec2::splat(-REACH) + self.spacing() * DVec2::new((node % self.side) as f64, (node / self.side) as f64)
    }
    fn inside(&self, node: usize) -> bool {
        self.values[node] < 0.0
    }
}

impl Contour {
    /// Contours the sampler's field in its frame.
    ///
    /// # Errors
    /// [`ShrinkError::Empty`] without a zero set, [`ShrinkError::Canceled`].
    pub fn new(sampler: &Sampler<'_>) -> Result<Self, ShrinkError> {
        let grid = refined(sampler)?;
        let (paths, brackets) = paths(&grid);
        if paths.is_empty() {
            let fold = |f: fn(f64, f64) -> f64| grid.values.iter().copied().reduce(f).unwrap_or(0.0);
            let scale = sampler.frame().scale;
            return Err(ShrinkError::Empty { min: scale * fold(f64::min), max: scale * fold(f64::max) });
        }
        let crossings = roots(sampler, &brackets)?;
        let lifted: Vec<DVec3> = crossings.iter().map(|p| p.extend(0.0)).collect();
        let (_, gradients) = sampler.gradients(&lifted)?;
        let mut loops = Vec::with_capacity(paths.len());
        for path in paths {
            let points: Vec<DVec2> = path.iter().map(|&k| crossings[k]).collect();
            let normals = path.iter().map(|&k| gradients[k].truncate().normalize_or(DVec2::X)).collect();
            let smooth = Loop { corners: vec![false; points.len()], points, normals };
            loops.push(with_corners(sampler, smooth, grid.spacing())?);
        }
        loops.sort_by(|a, b| double_area(&b.points).abs().total_cmp(&double_area(&a.points).abs()));
        Ok(Self { loops, spacing: grid.spacing() })
    }

    /// The loop, when there is only one; places are in scene units.
    ///
    /// # Errors
    /// [`ShrinkError::Components`], or [`ShrinkError::Genus`] with the number of holes.
    pub fn only_loop(&self, frame: Frame) -> Result<&Loop, ShrinkError> {
        let (outer, holes): (Vec<&Loop>, Vec<&Loop>) = self.loops.iter().partition(|l| double_area(&l.points) > 0.0);
        let places = |loops: &[&Loop]| -> Vec<[f64; 3]> {
            loops.iter().take(16).map(|l| frame.to_scene(within(l, self.spacing).extend(0.0)).to_array()).collect()
        };
        match (&outer[..], &holes[..]) {
            ([only], []) => Ok(only),
            ([_], holes) => Err(ShrinkError::Genus { genus: holes.len(), places: places(holes) }),
            (outer, _) => Err(ShrinkError::Components { count: outer.len(), places: places(outer) }),
        }
    }
}

/// A point just left of the loop's rightmost point (inside a component; for a hole, next to it).
fn within(l: &Loop, spacing: f64) -> DVec2 {
    let rightmost = (0..l.points.len()).max_by(|&a, &b| l.points[a].x.total_cmp(&l.points[b].x)).unwrap_or(0);
    l.points[rightmost] - 0.25 * spacing * l.normals[rightmost]
}

/// The lattice at its finest: new nodes are evaluated in cells near which the sign changes or could, judged by how much
/// the values around vary, which needs no distances; elsewhere they are interpolated and their sign is certain.
fn refined(sampler: &Sampler<'_>) -> Result<Grid, Canceled> {
    let side = COARSE + 1;
    let mut grid = Grid { side, values: vec![0.0; side * side] };
    let nodes: Vec<DVec3> = (0..side * side).map(|k| grid.place(k).extend(0.0)).collect();
    grid.values = sampler.values(&nodes)?;
    for _ in 0..LEVELS {
        grid = halved(sampler, &grid)?;
    }
    // the border lies beyond the domain
    let side = grid.side;
    for k in 0..side {
        for node in [k, (side - 1) * side + k, k * side, k * side + side - 1] {
            grid.values[node] = grid.values[node].max(f64::MIN_POSITIVE);
        }
    }
    Ok(grid)
}

fn halved(sampler: &Sampler<'_>, coarse: &Grid) -> Result<Grid, Canceled> {
    let (cells, side) = (coarse.side - 1, 2 * coarse.side - 1);
    let mut grid = Grid { side, values: vec![0.0; side * side] };
    let mut wanted = vec![false; side * side];
    for cell in 0..cells * cells {
        let (i, j) = (cell % cells, cell / cells);
        // how much the values vary over the cell and its neighbours
        let (mut least, mut most) = (f64::INFINITY, f64::NEG_INFINITY);
        for b in j.saturating_sub(1)..=(j + 2).min(cells) {
            for a in i.saturating_sub(1)..=(i + 2).min(cells) {
                let v = coarse.values[b * coarse.side + a];
                (least, most) = (least.min(v), most.max(v));
            }
        }
        let v = |a: usize, b: usize| coarse.values[(j + b) * coarse.side + i + a];
        let corners = [v(0, 0), v(1, 0), v(0, 1), v(1, 1)];
        let nearest = corners.into_iter().map(f64::abs).fold(f64::INFINITY, f64::min);
        let crossed = corners.iter().any(|c| (*c < 0.0) != (corners[0] < 0.0));
        let near = crossed || nearest <= NEAR * (most - least);
        for (a, b) in [(0, 0), (1, 0), (2, 0), (0, 1), (1, 1), (2, 1), (0, 2), (1, 2), (2, 2)] {
            let node = (2 * j + b) * side + 2 * i + a;
            let (x, y) = (0.5 * a as f64, 0.5 * b as f64);
            grid.values[node] =
                (1.0 - y) * ((1.0 - x) * v(0, 0) + x * v(1, 0)) + y * ((1.0 - x) * v(0, 1) + x * v(1, 1));
            wanted[node] |= near && (a == 1 || b == 1);
        }
    }
    let nodes: Vec<usize> = (0..side * side).filter(|&k| wanted[k]).collect();
    let places: Vec<DVec3> = nodes.iter().map(|&k| grid.place(k).extend(0.0)).collect();
    for (&node, value) in nodes.iter().zip(sampler.values(&places)?) {
        grid.values[node] = value;
    }
    Ok(grid)
}

/// An edge of the lattice that the zero set crosses.
struct Bracket {
    inside: DVec2,
    outside: DVec2,
    values: [f64; 2],
}

/// Loops of crossed edges, as indices into the list of brackets.
fn paths(grid: &Grid) -> (Vec<Vec<usize>>, Vec<Bracket>) {
    let side = grid.side;
    let mut brackets = Vec::new();
    let mut numbers: HashMap<(usize, usize), usize> = HashMap::new();
    let mut number = |a: usize, b: usize| -> usize {
        *numbers.entry((a.min(b), a.max(b))).or_insert_with(|| {
            let (i, o) = if grid.inside(a) { (a, b) } else { (b, a) };
            let values = [grid.values[i], grid.values[o]];
            brackets.push(Bracket { inside: grid.place(i), outside: grid.place(o), values });
            brackets.len() - 1
        })
    };
    let mut next: Vec<usize> = Vec::new();
    for j in 0..side - 1 {
        for i in 0..side - 1 {
            let k = j * side + i;
            // both triangles counter-clockwise
            for t in [[k, k + 1, k + side + 1], [k, k + side + 1, k + side]] {
                // entering where the boundary of the triangle goes from outside to inside keeps the solid on the left
                let edges = [0, 1, 2].map(|c| (t[c], t[(c + 1) % 3]));
                let leaving = edges.iter().find(|(a, b)| grid.inside(*a) && !grid.inside(*b));
                let entering = edges.iter().find(|(a, b)| !grid.inside(*a) && grid.inside(*b));
                if let (Some(&(a, b)), Some(&(c, d))) = (entering, leaving) {
                    let (from, to) = (number(c, d), number(a, b));
                    if next.len() <= from.max(to) {
                        next.resize(from.max(to) + 1, usize::MAX);
                    }
                    next[from] = to;
                }
            }
        }
    }
    let mut seen = vec![false; next.len()];
    let mut paths = Vec::new();
    for start in 0..next.len() {
        let (mut path, mut k) = (Vec::new(), start);
        while !seen[k] {
            seen[k] = true;
            path.push(k);
            k = next[k];
        }
        if !path.is_empty() {
            paths.push(path);
        }
    }
    (paths, brackets)
}

/// The zero of every bracket: false position with the Illinois rule (Dowell and Jarratt 1971), every third round a bisection.
fn roots(sampler: &Sampler<'_>, brackets: &[Bracket]) -> Result<Vec<DVec2>, Canceled> {
    struct State {
        ends: [f64; 2],
        values: [f64; 2],
        last: usize,
    }
    // single precision knows no finer places than this part of an edge
    const DONE: f64 = 1e-6;
    let mut states: Vec<State> =
        brackets.iter().map(|b| State { ends: [0.0, 1.0], values: b.values, last: 2 }).collect();
    let mut roots = vec![0.0; brackets.len()];
    let mut open: Vec<usize> = (0..brackets.len()).collect();
    let at = |k: usize, t: f64| brackets[k].inside.lerp(brackets[k].outside, t);
    for round in 0..ROUNDS {
        if open.is_empty() {
            break;
        }
        for &k in &open {
            let State { ends: [a, b], values: [va, vb], .. } = states[k];
            let falling = a + (b - a) * va / (va - vb);
            roots[k] = if round % 3 == 2 || !falling.is_finite() { 0.5 * (a + b) } else { falling };
        }
        let places: Vec<DVec3> = open.iter().map(|&k| at(k, roots[k]).extend(0.0)).collect();
        let values = sampler.values(&places)?;
        let mut still = Vec::with_capacity(open.len());
        for (&k, v) in open.iter().zip(values) {
            let state = &mut states[k];
            let size = brackets[k].values[1] - brackets[k].values[0];
            let end = usize::from(v >= 0.0);
            state.ends[end] = roots[k];
            state.values[end] = v;
            if state.last == end {
                state.values[1 - end] *= 0.5;
            }
            state.last = end;
            if v.abs() > DONE * size && state.ends[1] - state.ends[0] > DONE {
                still.push(k);
            }
        }
        open = still;
    }
    Ok((0..brackets.len()).map(|k| at(k, roots[k])).collect())
}

/// Merges crossings that are one, and puts a point on every corner.
fn with_corners(sampler: &Sampler<'_>, raw: Loop, spacing: f64) -> Result<Loop, Canceled> {
    let mut keep: Vec<usize> = Vec::with_capacity(raw.points.len());
    for i in 0..raw.points.len() {
        if keep.last().is_none_or(|&k| raw.points[k].distance(raw.points[i]) > MERGE * spacing) {
            keep.push(i);
        }
    }
    while keep.len() > 3 && raw.points[keep[0]].distance(raw.points[keep[keep.len() - 1]]) <= MERGE * spacing {
        keep.pop();
    }
    let n = keep.len();
    // where the tangents at two crossings meet, when they turn enough for a corner between them
    let meeting = |k: usize, l: usize| -> Option<(DVec2, DVec2)> {
        let (i, j) = (keep[k % n], keep[l % n]);
        let (p, q, u, v) = (raw.points[i], raw.points[j], raw.normals[i], raw.normals[j]);
        let sine = u.perp_dot(v);
        if u.dot(v) > CORNER_COSINE || sine.abs() < LEAST_SINE {
            return None;
        }
        let (a, b) = (u.dot(p), v.dot(q));
        let meet = DVec2::new(a * v.y - b * u.y, b * u.x - a * v.x) / sine;
        (meet.distance(p).max(meet.distance(q)) < 2.0 * spacing).then_some((meet, (u + v).normalize_or(u)))
    };
    let beside = 5.0 * MERGE * spacing;
    let direct: Vec<Option<(DVec2, DVec2)>> = (0..n).map(|k| meeting(k, k + 1)).collect();
    let mut candidates: Vec<(usize, DVec2, DVec2)> = Vec::new();
    for k in 0..n {
        // a crossing on top of a corner has a normal from anywhere between its sides': then those on either side decide
        let hidden = direct[k].is_none() && direct[(k + n - 1) % n].is_none();
        let around = hidden.then(|| meeting(k + n - 1, k + 1)).flatten();
        let around = around.filter(|(meet, _)| meet.distance(raw.points[keep[k]]) < beside);
        if let Some((meet, normal)) = direct[k].or(around) {
            candidates.push((k, meet, normal));
        }
    }
    let places: Vec<DVec3> = candidates.iter().map(|c| c.1.extend(0.0)).collect();
    let (values, gradients) = sampler.gradients(&places)?;
    let mut found = candidates
        .into_iter()
        .zip(values.into_iter().zip(gradients))
        .filter(|(_, (s, g))| s.abs() <= CORNER_MISS * spacing * g.length().max(f64::MIN_POSITIVE))
        .map(|(c, _)| c)
        .peekable();
    let mut out = Loop { points: vec![], normals: vec![], corners: vec![] };
    for (k, &i) in keep.iter().enumerate() {
        out.points.push(raw.points[i]);
        out.normals.push(raw.normals[i]);
        out.corners.push(false);
        if let Some((_, place, normal)) = found.next_if(|c| c.0 == k) {
            out.points.push(place);
            out.normals.push(normal);
            out.corners.push(true);
        }
    }
    // crossings on top of a corner would make needless short edges of uncertain direction
    let m = out.points.len();
    let drop = |i: usize| {
        let covered = |j: usize| out.corners[j] && out.points[j].distance(out.points[i]) < beside;
        !out.corners[i] && (covered((i + 1) % m) || covered((i + m - 1) % m))
    };
    let kept: Vec<usize> = (0..m).filter(|&i| !drop(i)).collect();
    Ok(Loop {
        points: kept.iter().map(|&i| out.points[i]).collect(),
        normals: kept.iter().map(|&i| out.normals[i]).collect(),
        corners: kept.iter().map(|&i| out.corners[i]).collect(),
    })
}
