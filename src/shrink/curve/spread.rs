//! Samples along a loop by arc length, corners among them.
//!
//! Between two points of the loop the curve is taken as the cubic through both with their tangents, as long as the circular arc
//! that turns as far; bends are looked at more closely first, so that both are good to a few parts in 10^5. One
//! evaluation per sample then tells its normal and whether it is on the zero set; the few that are not are moved.

use super::contour::Loop;
use super::corners::land;
use super::{Samples, ShrinkError};
use crate::field::Sampler;
use crate::settings::Canceled;
use glam::{DVec2, DVec3};

/// Normals of two successive points turn by no more than this (6 degrees) where the bend is resolved.
const BEND: f64 = 0.105;
/// Rounds of looking between points that turn by more; each halves the turn.
const BEND_ROUNDS: usize = 3;
/// A piece that turns by more than this is none that two tangents describe.
const STRAY: f64 = 1.2;
/// Samples this near to zero, in the frame, stay where they are: ten times what single precision makes of it.
const ON_ZERO: f64 = 1e-6;
/// Steps of the others; each leaves the square of the error, or bisects where values are no distances.
const STEPS: usize = 6;

/// The piece of the loop after point `k`: its turn, and its length as a circular arc.
struct Piece {
    turn: f64,
    length: f64,
}

fn piece(l: &Loop, k: usize) -> Piece {
    let j = (k + 1) % l.points.len();
    let (chord, turn) = (l.points[k].distance(l.points[j]), l.normals[k][1].angle_to(l.normals[j][0]));
    let half = 0.5 * turn.abs();
    let longer = if half > 1e-4 && turn.abs() < STRAY { half / half.sin() } else { 1.0 };
    Piece { turn, length: chord * longer }
}

/// The point at part `t` of a piece, in parts of its length.
fn within(l: &Loop, k: usize, t: f64) -> DVec2 {
    let j = (k + 1) % l.points.len();
    let (p, q) = (l.points[k], l.points[j]);
    let Piece { turn, length } = piece(l, k);
    let chord = q - p;
    let tangents = [l.normals[k][1].perp(), l.normals[j][0].perp()];
    if turn.abs() > STRAY || tangents.iter().any(|t| t.dot(chord) < 0.7 * chord.length()) {
        return p.lerp(q, t);
    }
    let (t2, t3) = (t * t, t * t * t);
    (2.0 * t3 - 3.0 * t2 + 1.0) * p
        + (t3 - 2.0 * t2 + t) * length * tangents[0]
        + (3.0 * t2 - 2.0 * t3) * q
        + (t3 - t2) * length * tangents[1]
}

/// Puts further points where the loop bends.
pub(super) fn resolve_bends(sampler: &Sampler<'_>, l: &mut Loop) -> Result<(), Canceled> {
    for _ in 0..BEND_ROUNDS {
        let n = l.points.len();
        let bent: Vec<usize> = (0..n).filter(|&k| piece(l, k).turn.abs() > BEND).collect();
        if bent.is_empty() {
            break;
        }
        let starts = bent.iter().map(|&k| within(l, k, 0.5)).collect();
        let reaches: Vec<f64> = bent.iter().map(|&k| 0.25 * piece(l, k).length).collect();
        let landed = land(sampler, starts, &reaches)?;
        let mut found = bent.iter().zip(landed).peekable();
        let mut finer = Loop::default();
        for k in 0..n {
            finer.points.push(l.points[k]);
            finer.normals.push(l.normals[k]);
            finer.corners.push(l.corners[k]);
            finer.sizes.push(l.sizes[k]);
            if let Some((_, middle)) = found.next_if(|(bent, _)| **bent == k) {
                let (p, q) = (l.points[k], l.points[(k + 1) % n]);
                // between both ends, or it is a point of something else
                if (middle.point - p).dot(q - p) > 0.0 && (q - middle.point).dot(q - p) > 0.0 {
                    finer.points.push(middle.point);
                    finer.normals.push([middle.normal; 2]);
                    finer.corners.push(false);
                    finer.sizes.push(l.sizes[k]);
                }
            }
        }
        *l = finer;
    }
    Ok(())
}

/// `count` samples of a loop. Between two corners they are evenly spaced, as many as the length there asks for; with `bias`
/// above 0 they are the closer the more the loop bends, which changes where they are and not what their parameters mean.
pub(super) fn spread(sampler: &Sampler<'_>, l: &Loop, count: usize, bias: f64) -> Result<Samples, ShrinkError> {
    let n = l.points.len();
    let start_of = |anchors: &[usize]| {
        (0..anchors.len()).max_by(|&a, &b| {
            let (a, b) = (anchors[a], anchors[b]);
            l.points[a].x.total_cmp(&l.points[b].x).then(b.cmp(&a))
        })
    };
    let mut anchors = anchors(l, count, bias);
    // the parameter starts at the rightmost anchor
    if let Some(first) = start_of(&anchors) {
        anchors.rotate_left(first);
    }
    let start = anchors[0];
    let at = |k: usize| (start + k) % n;
    let (mut arc, mut weight) = (vec![0.0; n + 1], vec![0.0; n + 1]);
    let pieces: Vec<Piece> = (0..n).map(|k| piece(l, at(k))).collect();
    let total: f64 = pieces.iter().map(|p| p.length).sum();
    for (k, p) in pieces.iter().enumerate() {
        // chords leave an arc by kappa l^2 / 8: equal errors ask for a density of sqrt(kappa)
        let bend = (p.turn.abs() * p.length * total / std::f64::consts::TAU).sqrt();
        arc[k + 1] = arc[k] + p.length;
        weight[k + 1] = weight[k] + p.length + bias * bend;
    }
    let mut stops: Vec<usize> = anchors.iter().map(|&a| (a + n - start) % n).collect();
    stops.push(n);
    let shares: Vec<f64> = stops.windows(2).map(|w| weight[w[1]] - weight[w[0]]).collect();
    let counts = apportion(&shares, count);

    let mut out = Samples::with_capacity(count);
    for (w, &parts) in stops.windows(2).zip(&counts) {
        let mut k = w[0];
        for part in 0..parts {
            let target = weight[w[0]] + (weight[w[1]] - weight[w[0]]) * part as f64 / parts as f64;
            while k + 1 < w[1] && weight[k + 1] <= target {
                k += 1;
            }
            let t = ((target - weight[k]) / (weight[k + 1] - weight[k]).max(f64::MIN_POSITIVE)).clamp(0.0, 1.0);
            let [a, b] = [l.normals[at(k)], l.normals[at(k + 1)]];
            let corner = part == 0 && l.corners[at(k)];
            out.positions.push(if part == 0 { l.points[at(k)] } else { within(l, at(k), t) });
            out.normals.push(if corner {
                (a[0] + a[1]).normalize_or(a[0])
            } else {
                a[1].lerp(b[0], t).normalize_or(a[1])
            });
            out.parameters.push((arc[k] + t * (arc[k + 1] - arc[k])) / total);
            out.corners.push(corner);
            out.reaches.push(0.25 * l.sizes[at(k)]);
        }
    }
    settle(sampler, &mut out)?;
    Ok(out)
}

/// The points of the loop that are samples whatever the spacing: its corners, the sharpest where there are too many.
fn anchors(l: &Loop, count: usize, bias: f64) -> Vec<usize> {
    let n = l.points.len();
    let mut anchors: Vec<usize> = (0..n).filter(|&i| l.corners[i]).collect();
    // some samples stay free to be even, fewer when they are wanted where they are most needed
    let most = if bias > 0.0 { count - count / 8 } else { count - count / 4 };
    if anchors.len() > most {
        let sharpness = |&i: &usize| l.normals[i][0].dot(l.normals[i][1]);
        anchors.sort_by(|a, b| sharpness(a).total_cmp(&sharpness(b)).then(a.cmp(b)));
        anchors.truncate(most);
        anchors.sort_unstable();
    }
    if anchors.is_empty() {
        anchors.extend((0..n).max_by(|&a, &b| l.points[a].x.total_cmp(&l.points[b].x).then(b.cmp(&a))));
    }
    anchors
}

/// Splits `count` into whole parts as even in share per part as can be, each at least 1 (`count` >= the number of shares).
fn apportion(shares: &[f64], count: usize) -> Vec<usize> {
    /// Halvings of the interval in which the step is looked for: to the last digit.
    const HALVINGS: usize = 60;
    let total: f64 = shares.iter().sum();
    // the longest step at which the parts are no more than wanted
    let wanted = |step: f64, share: f64| (share / step).max(1.0);
    let (mut low, mut high) = (0.0, total.max(f64::MIN_POSITIVE));
    for _ in 0..HALVINGS {
        let step = 0.5 * (low + high);
        if shares.iter().map(|&s| wanted(step, s)).sum::<f64>() > count as f64 { low = step } else { high = step }
    }
    let wanted: Vec<f64> = shares.iter().map(|&s| wanted(high, s)).collect();
    let mut parts: Vec<usize> = wanted.iter().map(|w| *w as usize).collect();
    let mut order: Vec<usize> = (0..shares.len()).collect();
    order.sort_by(|&a, &b| wanted[b].fract().total_cmp(&wanted[a].fract()).then(a.cmp(&b)));
    let left = count.saturating_sub(parts.iter().sum());
    for &i in order.iter().cycle().take(left) {
        parts[i] += 1;
    }
    parts
}

/// Takes values and normals at the samples, and moves those that are off the zero set onto it: by Newton steps, halved until
/// the value falls.
fn settle(sampler: &Sampler<'_>, samples: &mut Samples) -> Result<(), ShrinkError> {
    let lifted = |q: &[DVec2]| -> Vec<DVec3> { q.iter().map(|p| p.extend(0.0)).collect() };
    let (mut s, mut g) = sampler.gradients(&lifted(&samples.positions))?;
    let newton = |s: f64, g: DVec3, reach: f64| {
        (-s * g.truncate() / g.length_squared().max(f64::MIN_POSITIVE)).clamp_length_max(reach)
    };
    let mut factors = vec![1.0; s.len()];
    for _ in 0..STEPS {
        let off = |i: &usize| !samples.corners[*i] && s[*i].abs() > ON_ZERO * g[*i].length();
        let open: Vec<usize> = (0..s.len()).filter(off).collect();
        if open.is_empty() {
            break;
        }
        let step = |i: usize| samples.positions[i] + factors[i] * newton(s[i], g[i], samples.reaches[i]);
        let moved: Vec<DVec2> = open.iter().map(|&i| step(i)).collect();
        let (after, slopes) = sampler.gradients(&lifted(&moved))?;
        for (k, &i) in open.iter().enumerate() {
            if after[k].abs() < s[i].abs() {
                (samples.positions[i], s[i], g[i]) = (moved[k], after[k], slopes[k]);
            } else {
                factors[i] *= 0.5;
            }
        }
    }
    for ((normal, gradient), corner) in samples.normals.iter_mut().zip(&g).zip(&samples.corners) {
        if !corner {
            *normal = gradient.truncate().normalize_or(*normal);
        }
    }
    samples.slopes = g.iter().map(|g| g.length()).collect();
    samples.values = s;
    Ok(())
}
