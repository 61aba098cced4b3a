//! Closed polygons in the plane: length, area, what is inside, distances.

use glam::DVec2;
use std::collections::HashMap;

/// Length of the closed polygon.
pub(super) fn perimeter(polygon: &[DVec2]) -> f64 {
    let n = polygon.len();
    (0..n).map(|i| polygon[i].distance(polygon[(i + 1) % n])).sum()
}

/// Twice the signed area; positive counter-clockwise.
pub(super) fn double_area(polygon: &[DVec2]) -> f64 {
    let n = polygon.len();
    (0..n).map(|i| polygon[i].perp_dot(polygon[(i + 1) % n])).sum()
}

/// The polygon at `count` places with equal arc length between them, starting at its first point, each as (edge, parameter along the edge).
pub(super) fn even_places(polygon: &[DVec2], count: usize) -> Vec<(usize, f64)> {
    let n = polygon.len();
    let step = perimeter(polygon) / count as f64;
    let length = |i: usize| polygon[i].distance(polygon[(i + 1) % n]);
    let (mut edge, mut passed) = (0, 0.0);
    (0..count)
        .map(|k| {
            let s = step * k as f64;
            while edge + 1 < n && passed + length(edge) <= s {
                passed += length(edge);
                edge += 1;
            }
            let l = length(edge);
            (edge, if l > 0.0 { ((s - passed) / l).clamp(0.0, 1.0) } else { 0.0 })
        })
        .collect()
}

/// Whether `p` is inside the closed polygon, by the parity of crossings with the ray to the right.
pub(super) fn contains(polygon: &[DVec2], p: DVec2) -> bool {
    let n = polygon.len();
    let crosses = |&i: &usize| {
        let (a, b) = (polygon[i], polygon[(i + 1) % n]);
        (a.y > p.y) != (b.y > p.y) && p.x < a.x + (p.y - a.y) / (b.y - a.y) * (b.x - a.x)
    };
    (0..n).filter(crosses).count() % 2 == 1
}

/// Edges of closed polygons by the squares of a grid that they pass, for questions about what is near.
pub(super) struct Segments {
    squares: HashMap<(i32, i32), Vec<(DVec2, DVec2)>>,
    side: f64,
}

impl Segments {
    /// `side` is that of the squares: about the length of the longest edges.
    pub fn new(polygons: &[&[DVec2]], side: f64) -> Self {
        let mut squares: HashMap<(i32, i32), Vec<(DVec2, DVec2)>> = HashMap::new();
        for polygon in polygons {
            for (i, &a) in polygon.iter().enumerate() {
                let b = polygon[(i + 1) % polygon.len()];
                let (lo, hi) = ((a.min(b) / side).floor().as_ivec2(), (a.max(b) / side).floor().as_ivec2());
                for y in lo.y..=hi.y {
                    for x in lo.x..=hi.x {
                        squares.entry((x, y)).or_default().push((a, b));
                    }
                }
            }
        }
        Self { squares, side }
    }

    /// Whether an edge is no farther than `radius` from `p`.
    pub fn any_within(&self, p: DVec2, radius: f64) -> bool {
        let lo = ((p - radius) / self.side).floor().as_ivec2();
        let hi = ((p + radius) / self.side).floor().as_ivec2();
        let near = |(a, b): &(DVec2, DVec2)| to_segment(p, *a, *b) <= radius;
        (lo.y..=hi.y)
            .any(|y| (lo.x..=hi.x).any(|x| self.squares.get(&(x, y)).is_some_and(|edges| edges.iter().any(near))))
    }
}

fn to_segment(p: DVec2, a: DVec2, b: DVec2) -> f64 {
    let along = b - a;
    let squared = along.length_squared();
    let t = if squared > 0.0 { ((p - a).dot(along) / squared).clamp(0.0, 1.0) } else { 0.0 };
    p.distance(a + t * along)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn circle(n: usize) -> Vec<DVec2> {
        (0..n).map(|i| DVec2::from_angle(std::f64::consts::TAU * i as f64 / n as f64)).collect()
    }

    #[test]
    fn a_circle_holds_its_middle_and_nothing_beyond() {
        let round = circle(100);
        let tau = std::f64::consts::TAU;
        assert!((double_area(&round) - tau).abs() < 0.01 && (perimeter(&round) - tau).abs() < 0.01);
        assert!(contains(&round, DVec2::new(0.3, 0.2)) && contains(&round, DVec2::new(-0.99, 0.0)));
        assert!(!contains(&round, DVec2::new(1.01, 0.0)) && !contains(&round, DVec2::new(-5.0, 0.0)));
    }

    #[test]
    fn distances_to_a_circle_agree_with_its_radius() {
        let round = circle(2000);
        let segments = Segments::new(&[&round], 0.1);
        for (p, d) in [(DVec2::new(3.0, 0.0), 2.0), (DVec2::ZERO, 1.0), (DVec2::new(0.0, -1.5), 0.5)] {
            assert!(segments.any_within(p, d + 2e-6) && !segments.any_within(p, d - 2e-6));
        }
    }

    #[test]
    fn even_places_are_even() {
        let square = [DVec2::ZERO, DVec2::X, DVec2::ONE, DVec2::Y];
        assert_eq!(even_places(&square, 8).iter().map(|p| p.0).collect::<Vec<_>>(), [0, 0, 1, 1, 2, 2, 3, 3]);
        assert!(even_places(&square, 8).iter().enumerate().all(|(k, p)| (p.1 - 0.5 * (k % 2) as f64).abs() < 1e-12));
    }
}
