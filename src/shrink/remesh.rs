//! Isotropic remeshing of the front: edges are split, collapsed and flipped towards one length, vertices slide in the
//! tangent plane (Botsch and Kobbelt 2004, "A remeshing approach to multiresolution modeling"), and no operation may turn
//! a triangle over.

use super::energy::add_outer;
use super::rings::Mesh;
use crate::settings::{CancelToken, Canceled};
use glam::{DMat3, DVec3};

/// Edges longer than this many target lengths are split.
const LONG: f64 = 4.0 / 3.0;
/// Edges shorter than this many target lengths are collapsed.
const SHORT: f64 = 0.8;

/// One round of split, collapse, flip and, where `smooth` > 0, tangential smoothing with that step. `turn` is the cosine
/// of the largest angle that a triangle may turn by; a collapse may move the surface by `loss` target lengths.
pub fn remesh(
    mesh: &mut Mesh,
    target: f64,
    smooth: f64,
    turn: f64,
    loss: f64,
    cancel: &CancelToken,
) -> Result<(), Canceled> {
    split(mesh, target);
    cancel.check()?;
    collapse(mesh, target, turn, loss, cancel)?;
    cancel.check()?;
    flip(mesh, target);
    cancel.check()?;
    let kept = mesh.rings.compact();
    mesh.positions = kept.iter().map(|&v| mesh.positions[v as usize]).collect();
    if smooth > 0.0 {
        slide(mesh, smooth, turn);
    }
    cancel.check()
}

/// Edges for which `wanted` holds, with their lengths, in order of vertex numbers.
fn edges(mesh: &Mesh, wanted: impl Fn(f64) -> bool) -> Vec<(f64, u32, u32)> {
    let mut list = Vec::new();
    for v in 0..mesh.rings.len() as u32 {
        for &w in mesh.rings.ring(v) {
            if v < w {
                let length = mesh.length(v, w);
                if wanted(length) {
                    list.push((length, v, w));
                }
            }
        }
    }
    list
}

fn split(mesh: &mut Mesh, target: f64) {
    let mut long = edges(mesh, |length| length > LONG * target);
    long.sort_by(|a, b| b.0.total_cmp(&a.0).then((a.1, a.2).cmp(&(b.1, b.2))));
    for (_, a, b) in long {
        // splits never remove an edge other than the one they split
        let middle = 0.5 * (mesh.positions[a as usize] + mesh.positions[b as usize]);
        mesh.rings.split(a, b);
        mesh.positions.push(middle);
    }
}

fn collapse(mesh: &mut Mesh, target: f64, turn: f64, loss: f64, cancel: &CancelToken) -> Result<(), Canceled> {
    /// A closed mesh keeps at least this many vertices.
    const FEWEST: usize = 8;
    let mut short = edges(mesh, |length| length < SHORT * target);
    short.sort_by(|a, b| a.0.total_cmp(&b.0).then((a.1, a.2).cmp(&(b.1, b.2))));
    let mut alive = (0..mesh.rings.len() as u32).filter(|&v| mesh.rings.alive(v)).count();
    for (i, (_, a, b)) in short.into_iter().enumerate() {
        if alive <= FEWEST {
            break;
        }
        if i.is_multiple_of(1024) {
            cancel.check()?;
        }
        let gone = !mesh.rings.alive(a) || !mesh.rings.alive(b) || !mesh.rings.joined(a, b);
        if gone || mesh.length(a, b) > SHORT * target || !mesh.rings.collapsible(a, b) {
            continue;
        }
        let (pa, pb) = (mesh.positions[a as usize], mesh.positions[b as usize]);
        for (to, v, w) in [(0.5 * (pa + pb), a, b), (pb, a, b), (pa, b, a)] {
            if off_planes(mesh, v, w, to).max(off_planes(mesh, w, v, to)) > loss * target {
                continue;
            }
            if !mesh.may_move(v, to, Some(w), turn) || !mesh.may_move(w, to, Some(v), turn) {
                continue;
            }
            let mut around = mesh.rings.ring(v).iter().chain(mesh.rings.ring(w));
            if around.any(|&u| mesh.positions[u as usize].distance(to) > LONG * target) {
                continue;
            }
            mesh.positions[w as usize] = to;
            mesh.rings.collapse(v, w);
            alive -= 1;
            break;
        }
    }
    Ok(())
}

/// Largest distance of `to` from the planes of the triangles at `v` that are not at `except`.
fn off_planes(mesh: &Mesh, v: u32, except: u32, to: DVec3) -> f64 {
    let ring = mesh.rings.ring(v);
    let away = to - mesh.positions[v as usize];
    (0..ring.len())
        .map(|i| [v, ring[i], ring[(i + 1) % ring.len()]])
        .filter(|t| !t.contains(&except))
        .map(|t| mesh.normal(t).normalize_or_zero().dot(away).abs())
        .fold(0.0, f64::max)
}

fn cosine(a: DVec3, b: DVec3) -> f64 {
    a.dot(b) / (a.length() * b.length()).max(1e-300)
}

fn flip(mesh: &mut Mesh, target: f64) {
    for v in 0..mesh.rings.len() as u32 {
        for w in mesh.rings.ring(v).to_vec() {
            if v < w && mesh.rings.joined(v, w) && better_flipped(mesh, target, v, w) {
                mesh.rings.flip(v, w);
            }
        }
    }
}

/// Whether the other diagonal is better: nearer to valence six, nearer to Delaunay, or much flatter, and never folded.
fn better_flipped(mesh: &Mesh, target: f64, v: u32, w: u32) -> bool {
    let (c, d) = (mesh.rings.next(v, w), mesh.rings.previous(v, w));
    let valence = |x: u32| mesh.rings.valence(x) as i64;
    let excess = |change: i64| {
        (valence(v) - change - 6).pow(2)
            + (valence(w) - change - 6).pow(2)
            + (valence(c) + change - 6).pow(2)
            + (valence(d) + change - 6).pow(2)
    };
    let (n0, n1) = (mesh.normal([v, w, c]), mesh.normal([w, v, d]));
    let (m0, m1) = (mesh.normal([v, d, c]), mesh.normal([w, c, d]));
    let both = n0 + n1;
    if m0.dot(both) <= 0.0 || m1.dot(both) <= 0.0 {
        return false;
    }
    let opposite = |x: u32| {
        let p = mesh.positions[x as usize];
        cosine(mesh.positions[v as usize] - p, mesh.positions[w as usize] - p).clamp(-1.0, 1.0).acos()
    };
    // positive where the edge is not Delaunay
    let crowded = opposite(c) + opposite(d) - std::f64::consts::PI;
    let (flat, flat_before) = (cosine(m0, m1), cosine(n0, n1));
    let not_sharper = flat > flat_before - 0.1;
    let wanted = (excess(1) < excess(0) && crowded > -0.6 && not_sharper)
        || (crowded > 0.3 && not_sharper)
        || (flat > flat_before + 0.5 && crowded > -0.6);
    let smallest = m0.length().min(m1.length()) > 0.3 * n0.length().min(n1.length());
    let short = mesh.length(c, d) < 1.6 * mesh.length(v, w).max(1.2 * target);
    wanted && smallest && short && flat > flat_before.min(0.2)
}

/// Slides every vertex towards the middle of its star, but not off the planes around it: at a rim or a tip the planes fix
/// it, on a crease it moves along, and only where the surface is flat it is free.
fn slide(mesh: &mut Mesh, smooth: f64, turn: f64) {
    /// Weight of the planes against the way to the middle. A surface that turns by 0.3 rad over an edge slides at half speed.
    const STIFFNESS: f64 = 20.0;
    for v in 0..mesh.rings.len() as u32 {
        let here = mesh.positions[v as usize];
        let ring = mesh.rings.ring(v);
        let (mut center, mut weight, mut planes) = (DVec3::ZERO, 0.0, DMat3::ZERO);
        for (i, &a) in ring.iter().enumerate() {
            let b = ring[(i + 1) % ring.len()];
            let normal = mesh.normal([v, a, b]);
            let area = normal.length().max(1e-30);
            center += area * (mesh.positions[a as usize] + mesh.positions[b as usize] + here) / 3.0;
            weight += area;
            let unit = normal / area;
            add_outer(&mut planes, unit, unit, STIFFNESS / ring.len() as f64);
        }
        // least |step - towards|^2 + sum of squared distances to the planes
        let along = (DMat3::IDENTITY + planes).inverse() * (center / weight - here);
        let mut step = smooth;
        for _ in 0..3 {
            let to = here + step * along;
            if mesh.may_move(v, to, None, turn) {
                mesh.positions[v as usize] = to;
                break;
            }
            step *= 0.4;
        }
    }
}
