//! What lies on the two sides of each part of a surface that meets itself.
//!
//! Where triangles meet nothing, the two winding numbers beside the surface do not change along it. So one winding number
//! per patch of such triangles says what the nearest feature's pseudo-normal means there, and only points whose nearest
//! feature touches a place where the surface meets itself need a winding number of their own.

use super::topology::NONE;
use super::winding::Winding;
use glam::DVec3;

/// What the side that a pseudo-normal points to, and the other side, are.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Sides {
    /// Outside and inside: a proper boundary.
    Plain,
    /// Inside and outside: the patch is wrapped the other way round.
    Swapped,
    /// Both inside: the patch is buried in the solid.
    Buried,
    /// Not the same everywhere about this feature.
    Unknown,
}

/// A point beside a triangle is off it by this share of the square root of its area.
pub(super) const OFF: f64 = 1e-5;
/// Triangles of a patch that are tried for a clear answer, the largest first.
const TRIES: usize = 8;
/// How far from whole numbers one apart the two winding numbers may be.
const CLEAR: f64 = 0.1;

/// Sides of every triangle and of every vertex. `meets` tells the triangles that meet others.
pub(super) fn classify(
    vertices: &[DVec3],
    triangles: &[[u32; 3]],
    neighbours: &[[u32; 3]],
    meets: &[bool],
    winding: &Winding,
) -> (Vec<Sides>, Vec<Sides>) {
    let mut of_triangles = vec![Sides::Unknown; triangles.len()];
    let mut reached = meets.to_vec();
    let mut patch = Vec::new();
    for seed in 0..triangles.len() {
        if std::mem::replace(&mut reached[seed], true) {
            continue;
        }
        patch.clear();
        patch.push(seed);
        let mut next = 0;
        while let Some(&here) = patch.get(next) {
            next += 1;
            for &there in neighbours[here].iter().filter(|&&t| t != NONE) {
                if !std::mem::replace(&mut reached[there as usize], true) {
                    patch.push(there as usize);
                }
            }
        }
        let sides = beside(vertices, triangles, &patch, winding);
        patch.iter().for_each(|&triangle| of_triangles[triangle] = sides);
    }
    let mut of_vertices: Vec<Option<Sides>> = vec![None; vertices.len()];
    for (corners, &sides) in triangles.iter().zip(&of_triangles) {
        for &corner in corners {
            let known = &mut of_vertices[corner as usize];
            *known = Some(if known.is_none_or(|k| k == sides) { sides } else { Sides::Unknown });
        }
    }
    (of_triangles, of_vertices.into_iter().map(|s| s.unwrap_or(Sides::Unknown)).collect())
}

/// The sides of a patch, from the winding numbers just off its largest triangles.
fn beside(vertices: &[DVec3], triangles: &[[u32; 3]], patch: &[usize], winding: &Winding) -> Sides {
    let places = |triangle: usize| triangles[triangle].map(|i| vertices[i as usize]);
    let doubled = |triangle: usize| {
        let [a, b, c] = places(triangle);
        (b - a).cross(c - a)
    };
    let mut largest: Vec<(f64, usize)> = patch.iter().map(|&t| (doubled(t).length_squared(), t)).collect();
    largest.sort_unstable_by(|s, t| t.0.total_cmp(&s.0).then(s.1.cmp(&t.1)));
    for &(_, triangle) in largest.iter().take(TRIES) {
        let [a, b, c] = places(triangle);
        let doubled = doubled(triangle);
        let off = doubled.normalize_or_zero() * (OFF * doubled.length().sqrt());
        let middle = (a + b + c) / 3.0;
        let (before, behind) = (winding.number(middle + off), winding.number(middle - off));
        let whole = before.round();
        if (before - whole).abs() < CLEAR && (behind - whole - 1.0).abs() < CLEAR {
            return match whole as i64 {
                0 => Sides::Plain,
                -1 => Sides::Swapped,
                _ => Sides::Buried,
            };
        }
    }
    Sides::Unknown
}
