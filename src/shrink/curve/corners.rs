//! Corners of a loop: where the tangents at two successive crossings meet (the two-dimensional case of Ju et al. 2002,
//! "Dual contouring of Hermite data"), looked at from ever nearer until the place is sure, or until it proves a rounding.

use super::bisection::{Triangle, size};
use super::contour::{Crossing, Edge, Known, Loop};
use crate::field::Sampler;
use crate::settings::Canceled;
use glam::{DVec2, DVec3};

/// Normals at neighbouring crossings that differ by more than 8 degrees may have a corner between them.
const CORNER_COSINE: f64 = 0.99;
/// Normals that are nearly opposite do not tell where their tangents meet: tips below one degree are not found.
const LEAST_SINE: f64 = 0.02;
/// Farthest that a tip of one degree can be from the last crossings before it, in sizes of a triangle.
const FARTHEST: f64 = 60.0;
/// Crossings closer than this part of a triangle's size are one.
const MERGE: f64 = 0.02;
/// A crossing this near to a corner says nothing that the corner does not, in the same parts.
const BESIDE: f64 = 0.1;
/// How much nearer the sides are looked at in every round, and the rounds.
const NEARER: f64 = 0.1;
const ROUNDS: usize = 4;
/// The sides are not looked at from nearer than this part of a triangle's size, ...
const NEAREST: f64 = 0.005;
/// ... nor than this in the frame, where single precision blurs their directions.
const SHARPEST: f64 = 1e-5;
/// The place is sure when a nearer look moves it by less than this part of the distance it was looked at from.
const STILL: f64 = 1e-3;
/// The field must vanish there to this part of that distance: a rounding of a twentieth of it does not.
const VANISHES: f64 = 0.02;
/// What single precision makes of zero in the frame.
const NOISE: f64 = 3e-7;
/// A nearer look at a corner finds the turn again, of which a rounding keeps only a part.
const KEPT: f64 = 0.6;

/// A corner: its place, and the unit normals before and after it.
#[derive(Clone, Copy)]
pub(super) struct Corner {
    pub point: DVec2,
    pub normals: [DVec2; 2],
}

/// A step of a loop: the crossed edge, the crossing, and the triangle entered there.
pub(super) type Step = (Edge, Crossing, Triangle);

/// Merges crossings that are one, and puts a point on every corner. Also says for every point the triangle after it.
pub(super) fn with_corners(
    sampler: &Sampler<'_>,
    paths: Vec<Vec<Step>>,
    known: &mut Known,
) -> Result<Vec<(Loop, Vec<Triangle>)>, Canceled> {
    let paths: Vec<Vec<Step>> = paths.into_iter().map(merged).collect();
    // of every loop, pairs of steps that may have a corner between them, by the first; a crossing on top of a corner has
    // a normal from anywhere between its sides', and then those on either side decide
    let mut pairs: Vec<Vec<(usize, [usize; 2])>> = Vec::with_capacity(paths.len());
    let mut open: Vec<Candidate> = Vec::new();
    for path in &paths {
        let n = path.len();
        let meets = |k: usize, l: usize| Candidate::new(&path[k % n], &path[l % n]);
        let mut list = Vec::new();
        for (k, step) in path.iter().enumerate() {
            let around = || {
                let hidden = meets(k + n - 1, k).is_none();
                let candidate = hidden.then(|| meets(k + n - 1, k + 1)).flatten()?;
                let on_top = candidate.place.distance(step.1.point) < BESIDE * size(step.2);
                on_top.then_some((candidate, [(k + n - 1) % n, (k + 1) % n]))
            };
            let direct = meets(k, k + 1).map(|c| (c, [k, (k + 1) % n]));
            if let Some((candidate, [a, b])) = direct.or_else(around) {
                if !known.corners.contains_key(&candidate.key) {
                    open.push(candidate);
                }
                list.push((k, [a, b]));
            }
        }
        pairs.push(list);
    }
    settle(sampler, open, known)?;
    let build = |(path, list): (&Vec<Step>, &Vec<(usize, [usize; 2])>)| {
        let mut corners = vec![None; path.len()];
        for &(k, [a, b]) in list {
            corners[k] = known.corners.get(&(path[a].0, path[b].0)).copied().flatten();
        }
        joined(path, &corners)
    };
    Ok(paths.iter().zip(&pairs).map(build).collect())
}

fn merged(path: Vec<Step>) -> Vec<Step> {
    let near = |a: &Step, b: &Step| a.1.point.distance(b.1.point) <= MERGE * size(a.2);
    let mut kept: Vec<Step> = Vec::with_capacity(path.len());
    for step in path {
        if kept.last().is_none_or(|last| !near(last, &step)) {
            kept.push(step);
        }
    }
    while kept.len() > 3 && near(&kept[kept.len() - 1], &kept[0]) {
        kept.pop();
    }
    kept
}

/// Two crossings and the place where their tangents meet.
struct Candidate {
    key: (Edge, Edge),
    sides: [Crossing; 2],
    place: DVec2,
    /// Angle between the normals at first.
    turn: f64,
    /// Size of the triangles there, and how far from the place the sides were looked at last.
    size: f64,
    from: f64,
    sure: bool,
}

impl Candidate {
    fn new((edge_p, p, triangle): &Step, (edge_q, q, next): &Step) -> Option<Self> {
        let place = meeting(*p, *q)?;
        let size = size(*triangle).max(size(*next));
        let (before, after) = (place - p.point, q.point - place);
        let slack = BESIDE * size;
        let between = before.dot(along(p.normal)) > -slack && after.dot(along(q.normal)) > -slack;
        let from = before.length().max(after.length());
        (between && from < FARTHEST * size).then(|| Self {
            key: (*edge_p, *edge_q),
            sides: [*p, *q],
            place,
            turn: p.normal.angle_to(q.normal).abs(),
            size,
            from,
            sure: false,
        })
    }
}

/// Direction of travel, with the solid on the left.
fn along(normal: DVec2) -> DVec2 {
    normal.perp()
}

fn meeting(p: Crossing, q: Crossing) -> Option<DVec2> {
    let (u, v) = (p.normal, q.normal);
    let sine = u.perp_dot(v);
    if u.dot(v) > CORNER_COSINE || sine.abs() < LEAST_SINE {
        return None;
    }
    let (a, b) = (u.dot(p.point), v.dot(q.point));
    Some(DVec2::new(a * v.y - b * u.y, b * u.x - a * v.x) / sine)
}

/// Looks at every candidate from nearer and nearer, and notes what became of it.
fn settle(sampler: &Sampler<'_>, mut open: Vec<Candidate>, known: &mut Known) -> Result<(), Canceled> {
    for candidate in &open {
        known.corners.insert(candidate.key, None);
    }
    for _ in 0..ROUNDS {
        if open.is_empty() {
            return Ok(());
        }
        for c in &mut open {
            c.from = (NEARER * c.from).max(NEAREST * c.size).max(SHARPEST);
        }
        let reaches: Vec<f64> = open.iter().flat_map(|c| [c.from; 2]).collect();
        let starts: Vec<DVec2> = open
            .iter()
            .flat_map(|c| [c.place - c.from * along(c.sides[0].normal), c.place + c.from * along(c.sides[1].normal)])
            .collect();
        let landed = land(sampler, starts, &reaches)?;
        let mut next = Vec::with_capacity(open.len());
        for (mut c, sides) in open.into_iter().zip(landed.chunks_exact(2)) {
            let sides = [sides[0], sides[1]];
            let turned = sides[0].normal.angle_to(sides[1].normal).abs() >= KEPT * c.turn;
            let Some(place) = meeting(sides[0], sides[1]).filter(|_| turned) else { continue };
            let moved = place.distance(c.place);
            if moved > 10.0 * c.from {
                continue;
            }
            c.sure = moved <= STILL * c.from + NOISE;
            (c.place, c.sides) = (place, sides);
            next.push(c);
        }
        let (done, rest): (Vec<Candidate>, Vec<Candidate>) = next.into_iter().partition(|c| c.sure);
        let places: Vec<DVec3> = done.iter().map(|c| c.place.extend(0.0)).collect();
        let (values, gradients) = sampler.gradients(&places)?;
        for (c, (s, g)) in done.iter().zip(values.into_iter().zip(gradients)) {
            if s.abs() <= (VANISHES * c.from + NOISE) * g.length().max(f64::MIN_POSITIVE) {
                let corner = Corner { point: c.place, normals: c.sides.map(|s| s.normal) };
                known.corners.insert(c.key, Some(corner));
            }
        }
        open = rest;
    }
    Ok(())
}

/// Newton steps from every start to the zero set, the first no longer than its reach; what is left after them is taken linearly.
pub(super) fn land(sampler: &Sampler<'_>, starts: Vec<DVec2>, reaches: &[f64]) -> Result<Vec<Crossing>, Canceled> {
    let step = |s: f64, g: DVec3, reach: f64| {
        (-s * g.truncate() / g.length_squared().max(f64::MIN_POSITIVE)).clamp_length_max(reach)
    };
    let lifted = |points: &[DVec2]| -> Vec<DVec3> { points.iter().map(|p| p.extend(0.0)).collect() };
    let (s, g) = sampler.gradients(&lifted(&starts))?;
    let mut out: Vec<Crossing> = Vec::with_capacity(starts.len());
    let mut again = Vec::new();
    for i in 0..starts.len() {
        let moved = step(s[i], g[i], reaches[i]);
        out.push(Crossing { point: starts[i] + moved, normal: g[i].truncate().normalize_or(DVec2::X) });
        if moved.length() > STILL * reaches[i] + NOISE {
            again.push(i);
        }
    }
    let moved: Vec<DVec2> = again.iter().map(|&i| out[i].point).collect();
    let (s, g) = sampler.gradients(&lifted(&moved))?;
    for (k, &i) in again.iter().enumerate() {
        out[i].point += step(s[k], g[k], reaches[i]);
        out[i].normal = g[k].truncate().normalize_or(out[i].normal);
    }
    Ok(out)
}

/// The loop through the crossings and the corners, `corners[k]` after crossing `k`.
fn joined(path: &[Step], corners: &[Option<Corner>]) -> (Loop, Vec<Triangle>) {
    let mut all: Vec<(DVec2, [DVec2; 2], bool, Triangle)> = Vec::with_capacity(path.len() + 8);
    for ((_, crossing, triangle), corner) in path.iter().zip(corners) {
        all.push((crossing.point, [crossing.normal; 2], false, *triangle));
        if let Some(corner) = corner {
            let twice = |other: &(DVec2, [DVec2; 2], bool, Triangle)| {
                other.2 && other.0.distance(corner.point) < BESIDE * size(*triangle)
            };
            // found from both sides of a crossing on top of it, it is the last corner but one point ago
            if !all.iter().rev().take(3).any(twice) && !all.first().is_some_and(twice) {
                all.push((corner.point, corner.normals, true, *triangle));
            }
        }
    }
    let n = all.len();
    let covered = |i: usize| {
        let near = |j: usize| all[j].2 && all[j].0.distance(all[i].0) < BESIDE * size(all[i].3);
        !all[i].2 && (near((i + 1) % n) || near((i + n - 1) % n))
    };
    let (mut out, mut triangles) = (Loop::default(), Vec::with_capacity(n));
    for i in (0..n).filter(|&i| !covered(i)) {
        let (point, normals, corner, triangle) = all[i];
        out.points.push(point);
        out.normals.push(normals);
        out.corners.push(corner);
        out.sizes.push(size(triangle));
        triangles.push(triangle);
    }
    (out, triangles)
}
