//! Do two triangles meet? Decided by exact signs alone, so that neither a touching nor a near miss is ever mistaken.

use super::bvh::{Aabb, Bvh};
use super::predicates::{orient2d, orient3d};
use super::{corners, map_chunks};
use crate::settings::{Canceled, Settings};
use glam::{DVec2, DVec3};
use std::ops::ControlFlow;

/// Pairs that are counted of one triangle with those after it: a surface that is folded all over has hundreds of millions, which nobody wants to wait for.
const MOST: u32 = 1000;

/// Triangles of a mesh that meet others.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Crossing {
    /// Pairs, of one triangle with those after it at most 1,000.
    pub pairs: u64,
    /// The triangles that meet one that comes after them, in ascending order.
    pub triangles: Vec<u32>,
}

/// The pairs of triangles of a mesh that meet in more than the vertices or the edge they share:
///
/// - no vertex shared: the closed triangles have a point in common (touching counts);
/// - one vertex shared: they have another point in common;
/// - an edge shared: they lie in one plane on the same side of the edge (folded back onto each other);
/// - all three vertices shared: always.
///
/// Vertices are shared when their index is; two indices at one place touch. Signs are exact for coordinates that are
/// single-precision numbers.
///
/// # Errors
/// When the token is raised.
pub fn self_intersections(
    vertices: &[DVec3],
    triangles: &[[u32; 3]],
    settings: &Settings<'_>,
) -> Result<Crossing, Canceled> {
    let boxes: Vec<Aabb> = triangles.iter().map(|&t| Aabb::of(&corners(vertices, t))).collect();
    let tree = Bvh::new(&boxes);
    let found = map_chunks(triangles, settings, |i, &t| {
        let mut met = 0u32;
        tree.overlapping(&boxes[i], |j| {
            let later = j as usize > i;
            let meets =
                later && boxes[i].overlaps(&boxes[j as usize]) && pair_meets(vertices, t, triangles[j as usize]);
            met += u32::from(meets);
            if met < MOST { ControlFlow::Continue(()) } else { ControlFlow::Break(()) }
        });
        met
    })?;
    let triangles = (0u32..).zip(&found).filter(|(_, met)| **met > 0).map(|(i, _)| i).collect();
    Ok(Crossing { pairs: found.iter().copied().map(u64::from).sum(), triangles })
}

/// Whether two triangles of a mesh meet in more than what they share; see [`self_intersections`].
fn pair_meets(vertices: &[DVec3], s: [u32; 3], t: [u32; 3]) -> bool {
    // turn both so that what they share comes first
    let shared = s.iter().filter(|v| t.contains(v)).count();
    let (p, q) = (corners(vertices, s), corners(vertices, t));
    match shared {
        0 => triangles_meet(p, q),
        1 => {
            let i = s.iter().position(|v| t.contains(v)).unwrap_or(0);
            let j = t.iter().position(|&v| v == s[i]).unwrap_or(0);
            // two triangles with a common corner that have another point in common have one on the edge that is opposite
            // in one of them: follow the ray from the corner through the point until it leaves one
            segment_meets_triangle(p[(i + 1) % 3], p[(i + 2) % 3], q)
                || segment_meets_triangle(q[(j + 1) % 3], q[(j + 2) % 3], p)
        }
        2 => {
            let i = s.iter().position(|v| !t.contains(v)).unwrap_or(0);
            let j = t.iter().position(|v| !s.contains(v)).unwrap_or(0);
            let (a, b) = (p[(i + 1) % 3], p[(i + 2) % 3]);
            folded_back(a, b, p[i], q[j])
        }
        _ => true,
    }
}

/// Whether the triangles `a b c` and `a b d` lie in one plane with `c` and `d` on the same side of `a b`. Triangles without
/// area fold nothing.
fn folded_back(a: DVec3, b: DVec3, c: DVec3, d: DVec3) -> bool {
    orient3d(a, b, c, d) == 0
        && PLANES.into_iter().any(|axis| {
            let [a, b, c, d] = [a, b, c, d].map(|p| drop_axis(p, axis));
            orient2d(a, b, c) * orient2d(a, b, d) > 0
        })
}

/// The coordinate that a projection drops.
const PLANES: [usize; 3] = [0, 1, 2];

fn drop_axis(p: DVec3, axis: usize) -> DVec2 {
    DVec2::new(p[(axis + 1) % 3], p[(axis + 2) % 3])
}

/// A projection along an axis that keeps the triangle's area from vanishing; `None` when it has none.
fn open_projection(t: [DVec3; 3]) -> Option<usize> {
    PLANES.into_iter().find(|&axis| {
        let [a, b, c] = t.map(|p| drop_axis(p, axis));
        orient2d(a, b, c) != 0
    })
}

/// Whether two closed triangles have a point in common. Triangles without area are the segments they span.
pub fn triangles_meet(p: [DVec3; 3], q: [DVec3; 3]) -> bool {
    // the intersection of two triangles, if there is one, has an extreme point on an edge of one of them
    let sides = |t: [DVec3; 3], other: [DVec3; 3]| other.map(|x| orient3d(t[0], t[1], t[2], x));
    let apart = |s: [i8; 3]| s == [1; 3] || s == [-1; 3];
    if apart(sides(p, q)) || apart(sides(q, p)) {
        return false;
    }
    let edges = |t: [DVec3; 3]| [(t[0], t[1]), (t[1], t[2]), (t[2], t[0])];
    edges(p).into_iter().any(|(a, b)| segment_meets_triangle(a, b, q))
        || edges(q).into_iter().any(|(a, b)| segment_meets_triangle(a, b, p))
}

/// Whether a closed segment and a closed triangle have a point in common.
pub fn segment_meets_triangle(p: DVec3, q: DVec3, t: [DVec3; 3]) -> bool {
    let [a, b, c] = t;
    let (above, below) = (orient3d(a, b, c, p), orient3d(a, b, c, q));
    if above * below > 0 {
        return false;
    }
    if (above, below) != (0, 0) {
        // the segment's line crosses the plane in one point, which is in the triangle when it passes all edges on one side
        let turns = [orient3d(p, q, a, b), orient3d(p, q, b, c), orient3d(p, q, c, a)];
        return turns.iter().all(|&s| s >= 0) || turns.iter().all(|&s| s <= 0);
    }
    match open_projection(t) {
        Some(axis) => {
            let [p, q, a, b, c] = [p, q, a, b, c].map(|x| drop_axis(x, axis));
            inside(p, [a, b, c])
                || inside(q, [a, b, c])
                || [(a, b), (b, c), (c, a)].into_iter().any(|(x, y)| segments_cross(p, q, x, y))
        }
        None => [(a, b), (b, c), (c, a)].into_iter().any(|(x, y)| segments_meet(p, q, x, y)),
    }
}

fn inside(p: DVec2, [a, b, c]: [DVec2; 3]) -> bool {
    let turns = [orient2d(a, b, p), orient2d(b, c, p), orient2d(c, a, p)];
    turns.iter().all(|&s| s >= 0) || turns.iter().all(|&s| s <= 0)
}

/// Closed segments in the plane.
fn segments_cross(p: DVec2, q: DVec2, a: DVec2, b: DVec2) -> bool {
    let (pa, qa) = (orient2d(a, b, p), orient2d(a, b, q));
    let (ap, bp) = (orient2d(p, q, a), orient2d(p, q, b));
    if pa == 0 && qa == 0 && ap == 0 && bp == 0 {
        let overlap =
            |lo: (f64, f64), hi: (f64, f64)| lo.0.min(lo.1) <= hi.0.max(hi.1) && hi.0.min(hi.1) <= lo.0.max(lo.1);
        return overlap((p.x, q.x), (a.x, b.x)) && overlap((p.y, q.y), (a.y, b.y));
    }
    pa * qa <= 0 && ap * bp <= 0
}

/// Closed segments in space: in one plane, and crossing in every projection (one of which keeps that plane open).
fn segments_meet(p: DVec3, q: DVec3, a: DVec3, b: DVec3) -> bool {
    orient3d(p, q, a, b) == 0
        && PLANES.into_iter().all(|axis| {
            let [p, q, a, b] = [p, q, a, b].map(|x| drop_axis(x, axis));
            segments_cross(p, q, a, b)
        })
}

#[cfg(test)]
mod tests {
    use super::super::fixtures::*;
    use super::*;

    fn v(x: f64, y: f64, z: f64) -> DVec3 {
        DVec3::new(x, y, z)
    }
    const UNIT: [DVec3; 3] = [DVec3::ZERO, DVec3::X, DVec3::Y];

    #[test]
    fn pairs_are_told_apart_down_to_one_ulp() {
        let lowest = |z: f64| [v(0.2, 0.2, z), v(0.3, 0.2, 1.0), v(0.2, 0.3, 1.0)];
        assert!(triangles_meet(UNIT, lowest(0.0)), "touching counts");
        assert!(triangles_meet(UNIT, lowest(-f64::MIN_POSITIVE)));
        assert!(!triangles_meet(UNIT, lowest(f64::MIN_POSITIVE)));
        let corner = |x: f64| [v(x, 0.5, -1.0), v(x, 0.5, 1.0), v(2.0, 2.0, 0.0)];
        assert!(triangles_meet(UNIT, corner(0.5)));
        assert!(!triangles_meet(UNIT, corner(0.5f64.next_up())));
    }

    #[test]
    fn coplanar_triangles_meet_when_they_overlap_touch_or_contain() {
        let inner = [v(0.1, 0.1, 0.0), v(0.2, 0.1, 0.0), v(0.1, 0.2, 0.0)];
        let beside = [v(1.0, 1.0, 0.0), v(2.0, 1.0, 0.0), v(1.0, 2.0, 0.0)];
        let touching = [v(1.0, 0.0, 0.0), v(2.0, 0.0, 0.0), v(2.0, 1.0, 0.0)];
        assert!(triangles_meet(UNIT, inner) && triangles_meet(inner, UNIT));
        assert!(!triangles_meet(UNIT, beside));
        assert!(triangles_meet(UNIT, touching));
        // in a plane that two of the three projections close
        let turn = |t: [DVec3; 3]| t.map(|p| v(0.5, p.x, p.y));
        assert!(triangles_meet(turn(UNIT), turn(inner)));
        assert!(!triangles_meet(turn(UNIT), turn(beside)));
    }

    #[test]
    fn triangles_without_area_are_segments() {
        let needle = [v(0.2, 0.2, -1.0), v(0.2, 0.2, 1.0), v(0.2, 0.2, 0.5)];
        assert!(triangles_meet(UNIT, needle));
        assert!(!triangles_meet(UNIT, needle.map(|p| p + DVec3::X)));
        let other = [v(-1.0, 0.2, 0.3), v(1.0, 0.2, 0.3), v(0.0, 0.2, 0.3)];
        assert!(triangles_meet(needle, other));
        assert!(!triangles_meet(needle, other.map(|p| p + 0.001 * DVec3::Y)));
    }

    #[test]
    fn neighbours_meet_only_when_they_overlap() {
        let at = |d: DVec3| {
            let vertices = [DVec3::ZERO, DVec3::X, DVec3::Y, d, v(-1.0, 0.0, 1.0)];
            pair_meets(&vertices, [0, 1, 2], [1, 0, 3])
        };
        assert!(!at(v(0.3, -1.0, 0.0)), "flat, on the other side");
        assert!(!at(v(0.3, 0.5, f64::MIN_POSITIVE)), "a sharp crease is no fold");
        assert!(at(v(0.3, 0.5, 0.0)), "folded back");
        let fan = |b: DVec3, c: DVec3| pair_meets(&[DVec3::ZERO, DVec3::X, DVec3::Y, b, c], [0, 1, 2], [0, 3, 4]);
        assert!(!fan(v(-1.0, 0.0, 0.0), v(0.0, -1.0, 0.0)));
        assert!(fan(v(0.2, 0.2, 0.0), v(-1.0, 1.0, 0.0)), "overlapping in the plane");
        assert!(fan(v(0.3, 0.3, -0.1), v(0.3, 0.3, 0.1)), "through the middle");
        assert!(fan(v(0.5, 0.0, 0.0), v(0.0, 0.0, 1.0)), "along an edge");
        assert!(!fan(v(0.3, 0.3, 0.1), v(0.3, 0.3, 0.2)));
    }

    #[test]
    fn a_sphere_is_clean_and_two_that_interpenetrate_are_not() {
        with_settings(2, |settings| {
            let (mut vertices, mut triangles) = sphere_mesh(32, 16, 1.0, DVec3::ZERO);
            let single: Vec<DVec3> = vertices.iter().map(|p| p.as_vec3().as_dvec3()).collect();
            assert_eq!(self_intersections(&single, &triangles, settings).unwrap(), Crossing::default());
            let (more, faces) = sphere_mesh(32, 16, 1.0, v(0.7, 0.0, 0.0));
            let offset = vertices.len() as u32;
            vertices.extend(more);
            triangles.extend(faces.iter().map(|t| t.map(|v| v + offset)));
            let found = self_intersections(&vertices, &triangles, settings).unwrap();
            assert!(found.pairs > 30, "{found:?}");
            // the search over all pairs finds the same
            let mut all: Vec<(usize, usize)> =
                (0..triangles.len()).flat_map(|i| (i + 1..triangles.len()).map(move |j| (i, j))).collect();
            all.retain(|&(i, j)| pair_meets(&vertices, triangles[i], triangles[j]));
            let split = triangles.len() / 2;
            assert!(all.iter().all(|&(i, j)| i < split && j >= split));
            let mut first: Vec<u32> = all.iter().map(|&(i, _)| i as u32).collect();
            first.dedup();
            assert_eq!(found, Crossing { pairs: all.len() as u64, triangles: first });
        });
    }

    #[test]
    fn of_a_surface_that_is_folded_all_over_each_triangle_counts_a_thousand() {
        // all of them through the origin
        let turned = |k: u32| {
            let (sin, cos) = (0.002 * f64::from(k)).sin_cos();
            [v(1.0, cos, sin), v(1.0, -cos, -sin), v(-1.0, 0.0, 0.0)].map(|p| p.as_vec3().as_dvec3())
        };
        let count = MOST + 500;
        let vertices: Vec<DVec3> = (0..count).flat_map(turned).collect();
        let triangles: Vec<[u32; 3]> = (0..count).map(|t| [3 * t, 3 * t + 1, 3 * t + 2]).collect();
        let expected: u64 = (0..count).map(|t| u64::from((count - 1 - t).min(MOST))).sum();
        for threads in [1, 3] {
            with_settings(threads, |settings| {
                let found = self_intersections(&vertices, &triangles, settings).unwrap();
                assert_eq!((found.pairs, found.triangles.len()), (expected, count as usize - 1));
            });
        }
    }
}
