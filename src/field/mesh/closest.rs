//! The point of a triangle nearest to a point, and the feature it lies on.

use glam::DVec3;

/// The part of a triangle that a nearest point lies on. Edge `k` joins corners `k` and `k + 1`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Feature {
    Face,
    Edge(u8),
    Corner(u8),
}

/// The nearest point of the triangle (a, a + ab, a + ac) to `p`, by the Voronoi regions of its features
/// (C. Ericson, Real-Time Collision Detection, 2005, section 5.1.5).
#[inline]
pub(super) fn closest(p: DVec3, a: DVec3, ab: DVec3, ac: DVec3) -> (DVec3, Feature) {
    let ap = p - a;
    let (d1, d2) = (ab.dot(ap), ac.dot(ap));
    if d1 <= 0.0 && d2 <= 0.0 {
        return (a, Feature::Corner(0));
    }
    let bp = ap - ab;
    let (d3, d4) = (ab.dot(bp), ac.dot(bp));
    if d3 >= 0.0 && d4 <= d3 {
        return (a + ab, Feature::Corner(1));
    }
    let vc = d1 * d4 - d3 * d2;
    if vc <= 0.0 && d1 >= 0.0 && d3 <= 0.0 {
        // an edge whose square is nothing divides nothing by nothing
        return if d1 > d3 { (a + ab * (d1 / (d1 - d3)), Feature::Edge(0)) } else { nearest_edge(p, a, ab, ac) };
    }
    let cp = ap - ac;
    let (d5, d6) = (ab.dot(cp), ac.dot(cp));
    if d6 >= 0.0 && d5 <= d6 {
        return (a + ac, Feature::Corner(2));
    }
    let vb = d5 * d2 - d1 * d6;
    if vb <= 0.0 && d2 >= 0.0 && d6 <= 0.0 {
        return if d2 > d6 { (a + ac * (d2 / (d2 - d6)), Feature::Edge(2)) } else { nearest_edge(p, a, ab, ac) };
    }
    let va = d3 * d6 - d5 * d4;
    let (along, back) = (d4 - d3, d5 - d6);
    if va <= 0.0 && along >= 0.0 && back >= 0.0 {
        let total = along + back;
        return if total > 0.0 {
            (a + ab + (ac - ab) * (along / total), Feature::Edge(1))
        } else {
            nearest_edge(p, a, ab, ac)
        };
    }
    let total = va + vb + vc;
    if total <= 0.0 {
        // a triangle without area: rounding alone decided the regions above, so its edges are asked one by one
        return nearest_edge(p, a, ab, ac);
    }
    (a + ab * (vb / total) + ac * (vc / total), Feature::Face)
}

#[cold]
fn nearest_edge(p: DVec3, a: DVec3, ab: DVec3, ac: DVec3) -> (DVec3, Feature) {
    let on_segment = |start: DVec3, along: DVec3| {
        let length = along.length_squared();
        let t = if length > 0.0 { ((p - start).dot(along) / length).clamp(0.0, 1.0) } else { 0.0 };
        start + along * t
    };
    [
        (on_segment(a, ab), Feature::Edge(0)),
        (on_segment(a + ab, ac - ab), Feature::Edge(1)),
        (on_segment(a, ac), Feature::Edge(2)),
    ]
    .into_iter()
    .min_by(|x, y| x.0.distance_squared(p).total_cmp(&y.0.distance_squared(p)))
    .unwrap_or((a, Feature::Corner(0)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_edge_whose_square_is_nothing_has_a_nearest_point() {
        let short = DVec3::X * 1e-170;
        let corners = [DVec3::ZERO, short, DVec3::Y];
        for turn in 0..3 {
            let [a, b, c] = [0, 1, 2].map(|k| corners[(turn + k) % 3]);
            for (p, nearest) in [(DVec3::new(0.0, 0.5, 0.25), 0.5), (DVec3::new(0.0, 2.0, 0.0), 1.0), (DVec3::Z, 0.0)] {
                let (found, _) = closest(p, a, b - a, c - a);
                assert!(found.distance(DVec3::Y * nearest) < 1e-12, "{p} is nearest to {found}");
            }
        }
    }
}
