//! What can be said of a closed polygon by itself: whether it is simple, by exact signs, and how often it turns around.

use super::super::bvh::{Aabb, Bvh};
use super::super::map_chunks;
use super::super::predicates::orient2d;
use crate::settings::{Canceled, Settings};
use glam::DVec2;
use std::ops::ControlFlow;

/// How many times the direction of travel turns around, counter-clockwise positive: 1 for a simple polygon with the
/// inside on its left. Edges without length are passed over.
pub(super) fn turning_number(polygon: &[DVec2]) -> i64 {
    let n = polygon.len();
    let edges: Vec<DVec2> = (0..n).map(|i| polygon[(i + 1) % n] - polygon[i]).filter(|e| *e != DVec2::ZERO).collect();
    let turns = edges.iter().zip(edges.iter().cycle().skip(1)).map(|(a, b)| a.angle_to(*b));
    (turns.sum::<f64>() / std::f64::consts::TAU).round() as i64
}

/// Every pair `(i, j)`, `i < j`, of edges of a closed polygon that meet in more than the vertex they share, in ascending
/// order: closed edges that share no vertex and have a point in common (touching counts), and successive ones that are
/// folded onto each other. Edge `i` runs from vertex `i` to the next. Signs are exact for single-precision numbers.
///
/// # Errors
/// When the token is raised.
pub(super) fn crossings(polygon: &[DVec2], settings: &Settings<'_>) -> Result<Vec<(u32, u32)>, Canceled> {
    let n = polygon.len();
    let ends = |i: usize| [polygon[i], polygon[(i + 1) % n]];
    let boxes: Vec<Aabb> = (0..n).map(|i| Aabb::of(&ends(i).map(|p| p.extend(0.0)))).collect();
    let tree = Bvh::new(&boxes);
    let found = map_chunks(&boxes, settings, |i, bounds| {
        let mut hits: Vec<(u32, u32)> = Vec::new();
        tree.overlapping(bounds, |j| {
            let k = j as usize;
            if k <= i || !bounds.overlaps(&boxes[k]) {
                return ControlFlow::Continue(());
            }
            let ([a, b], [c, d]) = (ends(i), ends(k));
            let meet = if i + 1 == k {
                folded(a, b, d)
            } else if (k + 1) % n == i {
                folded(c, d, b)
            } else {
                segments_meet(a, b, c, d)
            };
            if meet {
                hits.push((i as u32, j));
            }
            ControlFlow::Continue(())
        });
        hits.sort_unstable();
        hits
    })?;
    Ok(found.into_iter().flatten().collect())
}

/// Whether the edges `a b` and `b c` lie on each other.
fn folded(a: DVec2, b: DVec2, c: DVec2) -> bool {
    orient2d(a, b, c) == 0 && (a - b).dot(c - b) > 0.0
}

/// Whether the closed segments `a b` and `c d` have a point in common.
fn segments_meet(a: DVec2, b: DVec2, c: DVec2, d: DVec2) -> bool {
    // of three points in line, whether the last is between the others
    let between = |a: DVec2, b: DVec2, p: DVec2| a.min(b).cmple(p).all() && p.cmple(a.max(b)).all();
    let [c_of, d_of] = [orient2d(a, b, c), orient2d(a, b, d)];
    let [a_of, b_of] = [orient2d(c, d, a), orient2d(c, d, b)];
    (c_of * d_of < 0 && a_of * b_of < 0)
        || (c_of == 0 && between(a, b, c))
        || (d_of == 0 && between(a, b, d))
        || (a_of == 0 && between(c, d, a))
        || (b_of == 0 && between(c, d, b))
}

#[cfg(test)]
mod tests {
    use super::super::super::fixtures::with_settings;
    use super::*;
    use std::f64::consts::TAU;

    fn found(polygon: &[DVec2]) -> Vec<(u32, u32)> {
        with_settings(2, |s| crossings(polygon, s).unwrap())
    }

    #[test]
    fn a_circle_turns_once_and_an_eight_crosses_itself() {
        let round: Vec<DVec2> = (0..1000).map(|i| DVec2::from_angle(TAU * f64::from(i) / 1000.0)).collect();
        assert_eq!((turning_number(&round), found(&round).len()), (1, 0));
        let back: Vec<DVec2> = round.iter().rev().copied().collect();
        assert_eq!(turning_number(&back), -1);
        let eight: Vec<DVec2> = (0..100)
            .map(|i| TAU * (f64::from(i) + 0.3) / 100.0)
            .map(|t| DVec2::new(t.sin(), (2.0 * t).sin()))
            .collect();
        assert_eq!((turning_number(&eight), found(&eight).len()), (0, 1));
    }

    #[test]
    fn touching_and_folding_are_meeting() {
        let p = |x: f64, y: f64| DVec2::new(x, y);
        // a vertex on another edge, exactly
        let touching = [p(0.0, 0.0), p(2.0, 0.0), p(2.0, 1.0), p(1.0, 0.0), p(0.0, 1.0)];
        assert_eq!(found(&touching), [(0, 2), (0, 3)]);
        // the same, a hair above
        let free = [p(0.0, 0.0), p(2.0, 0.0), p(2.0, 1.0), p(1.0, f64::from(f32::EPSILON)), p(0.0, 1.0)];
        assert_eq!(found(&free), []);
        let spike = [p(0.0, 0.0), p(2.0, 0.0), p(1.0, 0.0), p(1.0, 1.0)];
        assert!(found(&spike).contains(&(0, 1)));
        let straight = [p(0.0, 0.0), p(1.0, 0.0), p(2.0, 0.0), p(1.0, 1.0)];
        assert_eq!(found(&straight), []);
    }
}
