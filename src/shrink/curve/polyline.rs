//! Closed polygons in the plane: length, turning, self-intersections, distances.

use glam::DVec2;

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

/// How many times the direction of travel turns around: 1 for a simple counter-clockwise polygon.
pub(super) fn turning(polygon: &[DVec2]) -> f64 {
    let n = polygon.len();
    let edge = |i: usize| polygon[(i + 1) % n] - polygon[i % n];
    (0..n).map(|i| edge(i).angle_to(edge(i + 1))).sum::<f64>() / std::f64::consts::TAU
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

fn orientation(a: DVec2, b: DVec2, c: DVec2) -> f64 {
    (b - a).perp_dot(c - a)
}

/// Pairs of edges that meet and are not neighbours.
pub(super) fn self_intersections(polygon: &[DVec2]) -> u64 {
    let n = polygon.len();
    let ends = |i: usize| (polygon[i], polygon[(i + 1) % n]);
    let mut order: Vec<usize> = (0..n).collect();
    let left = |i: usize| ends(i).0.x.min(ends(i).1.x);
    order.sort_by(|&a, &b| left(a).total_cmp(&left(b)).then(a.cmp(&b)));
    let mut count = 0;
    for (k, &i) in order.iter().enumerate() {
        let (a, b) = ends(i);
        let right = a.x.max(b.x);
        for &j in order[k + 1..].iter().take_while(|&&j| left(j) <= right) {
            if (i + 1) % n == j || (j + 1) % n == i {
                continue;
            }
            let (c, d) = ends(j);
            if a.y.max(b.y) < c.y.min(d.y) || c.y.max(d.y) < a.y.min(b.y) {
                continue;
            }
            // touching counts
            let (o1, o2) = (orientation(a, b, c), orientation(a, b, d));
            let (o3, o4) = (orientation(c, d, a), orientation(c, d, b));
            if o1.signum() * o2.signum() <= 0.0 && o3.signum() * o4.signum() <= 0.0 {
                count += 1;
            }
        }
    }
    count
}

/// Edges of closed polygons in order of their left ends, for distances.
pub(super) struct Segments {
    edges: Vec<(DVec2, DVec2)>,
    longest: f64,
}

impl Segments {
    pub fn new(polygons: &[impl AsRef<[DVec2]>]) -> Self {
        let mut edges: Vec<(DVec2, DVec2)> = polygons
            .iter()
            .map(AsRef::as_ref)
            .flat_map(|p| (0..p.len()).map(move |i| (p[i], p[(i + 1) % p.len()])))
            .collect();
        edges.sort_by(|a, b| a.0.x.total_cmp(&b.0.x));
        let longest = edges.iter().map(|(a, b)| a.distance(*b)).fold(0.0, f64::max);
        Self { edges, longest }
    }

    /// Distance from `p` to the nearest edge: a walk to both sides, ended where no edge can be nearer.
    pub fn distance(&self, p: DVec2) -> f64 {
        let middle = self.edges.partition_point(|(a, _)| a.x < p.x);
        let mut best = f64::INFINITY;
        let too_far = |a: DVec2, best: f64| (a.x - p.x).abs() - self.longest > best;
        for (a, b) in &self.edges[middle..] {
            if too_far(*a, best) {
                break;
            }
            best = best.min(to_segment(p, *a, *b));
        }
        for (a, b) in self.edges[..middle].iter().rev() {
            if too_far(*a, best) {
                break;
            }
            best = best.min(to_segment(p, *a, *b));
        }
        best
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
    fn a_circle_turns_once_and_an_eight_does_not() {
        let round = circle(100);
        assert!((turning(&round) - 1.0).abs() < 1e-12 && double_area(&round) > 0.0);
        assert_eq!(self_intersections(&round), 0);
        let eight: Vec<DVec2> = (0..100)
            .map(|i| std::f64::consts::TAU * (i as f64 + 0.3) / 100.0)
            .map(|t| DVec2::new(t.sin(), (2.0 * t).sin()))
            .collect();
        assert!(turning(&eight).abs() < 1e-12);
        assert_eq!(self_intersections(&eight), 1);
    }

    #[test]
    fn distances_to_a_circle_agree_with_its_radius() {
        let segments = Segments::new(&[circle(2000)]);
        for (p, d) in [(DVec2::new(3.0, 0.0), 2.0), (DVec2::ZERO, 1.0), (DVec2::new(0.0, -1.5), 0.5)] {
            assert!((segments.distance(p) - d).abs() < 2e-6);
        }
    }

    #[test]
    fn even_places_are_even() {
        let square = [DVec2::ZERO, DVec2::X, DVec2::ONE, DVec2::Y];
        assert_eq!(even_places(&square, 8).iter().map(|p| p.0).collect::<Vec<_>>(), [0, 0, 1, 1, 2, 2, 3, 3]);
        assert!(even_places(&square, 8).iter().enumerate().all(|(k, p)| (p.1 - 0.5 * (k % 2) as f64).abs() < 1e-12));
    }
}
