//! Simple polygons: what makes one valid, and the exact signed distance to one.
//!
//! The sign comes from the nearest feature: on which side of the nearest edge a point lies, or whether the nearest corner
//! is convex (the two-dimensional case of angle-weighted pseudo-normals, Bærentzen and Aanæs 2005). No ray is cast, so
//! there is no ray to go wrong, and the value next to an edge has no cancellation.

/// A simple polygon, counter-clockwise.
#[derive(Clone, Debug)]
pub(super) struct Polygon {
    /// Edges that count for the distance; a revolved polygon has none along its axis.
    pub edges: Vec<Edge>,
    pub min: [f64; 2],
    pub max: [f64; 2],
    pub convex: bool,
}

/// An edge and the kind of its two corners.
#[derive(Clone, Copy, Debug)]
pub(super) struct Edge {
    pub start: [f32; 2],
    pub along: [f32; 2],
    /// 1 over the squared length.
    pub inverse: f32,
    /// Unit, outward.
    pub normal: [f32; 2],
    /// Sign of the distance where the start, or the end, is the nearest point; 0 when the two edges there are in line.
    pub corners: [f32; 2],
}

/// Value and gradient in the plane.
pub(super) struct Planar {
    pub value: f32,
    pub gradient: [f32; 2],
}

/// Why a list of points is no simple polygon; indices into the list.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Defect {
    /// Two successive points are the same (the second one).
    Repeated(usize),
    /// Two edges (by their first points) cross, touch or lie on each other.
    Crossing(usize, usize),
}

fn cross(a: [f64; 2], b: [f64; 2]) -> f64 {
    a[0] * b[1] - a[1] * b[0]
}

fn minus(a: [f64; 2], b: [f64; 2]) -> [f64; 2] {
    [a[0] - b[0], a[1] - b[1]]
}

fn orientation(a: [f64; 2], b: [f64; 2], c: [f64; 2]) -> f64 {
    cross(minus(b, a), minus(c, a))
}

/// Whether `p`, known to be in line with `a` and `b`, lies between them.
fn between(a: [f64; 2], b: [f64; 2], p: [f64; 2]) -> bool {
    (0..2).all(|k| p[k] >= a[k].min(b[k]) && p[k] <= a[k].max(b[k]))
}

fn segments_meet(a: [f64; 2], b: [f64; 2], c: [f64; 2], d: [f64; 2]) -> bool {
    let apart = |k: usize| a[k].max(b[k]) < c[k].min(d[k]) || c[k].max(d[k]) < a[k].min(b[k]);
    if apart(0) || apart(1) {
        return false;
    }
    let (o1, o2, o3, o4) = (orientation(a, b, c), orientation(a, b, d), orientation(c, d, a), orientation(c, d, b));
    (o1 * o2 < 0.0 && o3 * o4 < 0.0)
        || (o1 == 0.0 && between(a, b, c))
        || (o2 == 0.0 && between(a, b, d))
        || (o3 == 0.0 && between(c, d, a))
        || (o4 == 0.0 && between(c, d, b))
}

/// The first thing that keeps `points` (at least three, closed implicitly) from being a simple polygon.
pub(super) fn defect(points: &[[f64; 2]]) -> Option<Defect> {
    let n = points.len();
    let at = |i: usize| points[i % n];
    if let Some(i) = (0..n).find(|&i| at(i) == at(i + 1)) {
        return Some(Defect::Repeated((i + 1) % n));
    }
    for i in 0..n {
        // the next edge shares a corner: it may not fold back onto this one
        let (u, v) = (minus(at(i + 1), at(i)), minus(at(i + 2), at(i + 1)));
        if cross(u, v) == 0.0 && u[0] * v[0] + u[1] * v[1] < 0.0 {
            return Some(Defect::Crossing(i, (i + 1) % n));
        }
        for j in i + 2..n {
            if (j + 1) % n != i && segments_meet(at(i), at(i + 1), at(j), at(j + 1)) {
                return Some(Defect::Crossing(i, j));
            }
        }
    }
    None
}

impl Polygon {
    /// From points without [`defect`], in either order.
    pub fn new(points: &[[f64; 2]]) -> Self {
        Self::build(points, false)
    }

    /// The profile of a solid of revolution: `points` have non-negative first coordinates, and what lies on the axis is
    /// no boundary.
    pub fn profile(points: &[[f64; 2]]) -> Self {
        Self::build(points, true)
    }

    fn build(points: &[[f64; 2]], about_axis: bool) -> Self {
        let n = points.len();
        let area: f64 = (0..n).map(|i| cross(points[i], points[(i + 1) % n])).sum();
        let mut ring = points.to_vec();
        if area < 0.0 {
            ring.reverse();
        }
        let at = |i: usize| ring[i % n];
        let on_axis = |i: usize| about_axis && at(i)[0] == 0.0;
        let axial = |i: usize| on_axis(i) && on_axis(i + 1);
        let direction = |i: usize| minus(at(i + 1), at(i));
        // at the axis the profile goes on into its mirror image
        let turn = |i: usize| {
            let (mut before, mut after) = (direction(i + n - 1), direction(i));
            if axial(i) {
                after = [before[0], -before[1]];
            } else if axial(i + n - 1) {
                before = [after[0], -after[1]];
            }
            let (sine, lengths) = (cross(before, after), before[0].hypot(before[1]) * after[0].hypot(after[1]));
            // an angle that single precision cannot tell from a straight line
            if sine.abs() < 1e-7 * lengths { 0.0 } else { sine.signum() as f32 }
        };
        let edges: Vec<Edge> = (0..n)
            .filter(|&i| !axial(i))
            .map(|i| {
                let (start, along) = (at(i), direction(i));
                let length = along[0].hypot(along[1]);
                Edge {
                    start: start.map(|c| c as f32),
                    along: along.map(|c| c as f32),
                    inverse: (1.0 / (length * length)) as f32,
                    normal: [(along[1] / length) as f32, (-along[0] / length) as f32],
                    corners: [turn(i), turn(i + 1)],
                }
            })
            .collect();
        let fold = |k: usize, f: fn(f64, f64) -> f64| ring.iter().map(|p| p[k]).reduce(f).unwrap_or(0.0);
        Self {
            min: [fold(0, f64::min), fold(1, f64::min)],
            max: [fold(0, f64::max), fold(1, f64::max)],
            // a profile is convex only together with its mirror image, which needs a common edge
            convex: (0..n).all(|i| turn(i) >= 0.0) && (!about_axis || edges.len() < n),
            edges,
        }
    }

    /// Writes the index of the nearest edge of every point (x, y) to `nearest`; `best` is scratch.
    pub fn nearest(&self, x: &[f32], y: &[f32], best: &mut [f32], nearest: &mut [f32]) {
        best.fill(f32::INFINITY);
        nearest.fill(0.0);
        for (k, edge) in self.edges.iter().enumerate() {
            edge.closer(k as f32, x, y, best, nearest);
        }
    }
}

impl Edge {
    fn closer(&self, index: f32, x: &[f32], y: &[f32], best: &mut [f32], nearest: &mut [f32]) {
        let n = best.len();
        let (x, y, nearest) = (&x[..n], &y[..n], &mut nearest[..n]);
        let Edge { start: [ax, ay], along: [ex, ey], inverse, .. } = *self;
        for i in 0..n {
            let (wx, wy) = (x[i] - ax, y[i] - ay);
            #[allow(clippy::manual_clamp)] // `clamp` keeps the loop from becoming vector code
            let t = ((wx * ex + wy * ey) * inverse).max(0.0).min(1.0);
            let (dx, dy) = (wx - t * ex, wy - t * ey);
            let d = dx * dx + dy * dy;
            let closer = d < best[i];
            nearest[i] = if closer { index } else { nearest[i] };
            best[i] = if closer { d } else { best[i] };
        }
    }

    /// Signed distance and unit gradient at a point that has this edge as its nearest.
    pub fn distance(&self, x: f32, y: f32) -> Planar {
        let (wx, wy) = (x - self.start[0], y - self.start[1]);
        let t = (wx * self.along[0] + wy * self.along[1]) * self.inverse;
        let facing = wx * self.normal[0] + wy * self.normal[1];
        if t > 0.0 && t < 1.0 {
            return Planar { value: facing, gradient: self.normal };
        }
        let (corner, dx, dy) = if t <= 0.0 {
            (self.corners[0], wx, wy)
        } else {
            (self.corners[1], wx - self.along[0], wy - self.along[1])
        };
        let d = (dx * dx + dy * dy).sqrt();
        let sign = if corner == 0.0 { facing.signum() } else { corner };
        if d < super::shape::TINY {
            return Planar { value: 0.0, gradient: self.normal };
        }
        Planar { value: sign * d, gradient: [sign * dx / d, sign * dy / d] }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_square_is_simple_and_a_bow_tie_is_not() {
        let square = [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]];
        assert_eq!(defect(&square), None);
        assert_eq!(defect(&[square[0], square[2], square[1], square[3]]), Some(Defect::Crossing(0, 2)));
        assert_eq!(defect(&[square[0], square[1], square[1], square[3]]), Some(Defect::Repeated(2)));
        assert_eq!(defect(&[square[0], square[1], [0.5, 0.0], [0.5, 1.0]]), Some(Defect::Crossing(0, 1)));
        let touching = [[0.0, 0.0], [2.0, 0.0], [2.0, 1.0], [1.0, 0.0], [0.0, 1.0]];
        assert!(matches!(defect(&touching), Some(Defect::Crossing(..))));
    }

    fn distance(polygon: &Polygon, p: [f32; 2]) -> Planar {
        let (mut best, mut nearest) = ([0.0], [0.0]);
        polygon.nearest(&[p[0]], &[p[1]], &mut best, &mut nearest);
        polygon.edges[nearest[0] as usize].distance(p[0], p[1])
    }

    #[test]
    fn the_sign_agrees_with_the_winding_number_in_either_order_of_the_points() {
        let points = [[0.0, 0.0], [2.0, 0.2], [1.0, 0.5], [2.0, 1.0], [1.0, 2.0], [1.1, 0.9], [0.2, 1.5]];
        let mut reversed = points;
        reversed.reverse();
        for ring in [points, reversed] {
            let polygon = Polygon::new(&ring);
            for k in 0..1600 {
                let p = [-0.53 + 0.077 * (k % 40) as f64, -0.51 + 0.079 * (k / 40) as f64];
                let winding: f64 = (0..ring.len())
                    .map(|i| {
                        let (a, b) = (minus(ring[i], p), minus(ring[(i + 1) % ring.len()], p));
                        cross(a, b).atan2(a[0] * b[0] + a[1] * b[1])
                    })
                    .sum();
                let d = distance(&polygon, p.map(|c| c as f32));
                assert_eq!(d.value < 0.0, winding.abs() > 1.0, "{p:?} {}", d.value);
            }
        }
    }

    #[test]
    fn a_profile_has_no_boundary_on_its_axis() {
        let profile = Polygon::profile(&[[0.0, -1.0], [1.0, -1.0], [1.0, 1.0], [0.0, 1.0]]);
        assert_eq!(profile.edges.len(), 3);
        assert!((distance(&profile, [0.0, 0.0]).value + 1.0).abs() < 1e-6);
        assert!((distance(&profile, [0.0, 1.5]).value - 0.5).abs() < 1e-6);
    }
}
