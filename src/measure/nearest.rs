//! Exact closest points on a triangle mesh, in double precision.

use super::bvh::{Aabb, Bvh};
use super::{corners, map_chunks};
use crate::settings::{Canceled, Settings};
use glam::DVec3;
use std::ops::ControlFlow;

/// Answers closest-point queries on a set of triangles.
#[derive(Clone, Debug)]
pub struct Nearest {
    triangles: Vec<[DVec3; 3]>,
    tree: Bvh,
}

/// The closest point of a mesh.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Closest {
    /// The point itself.
    pub point: DVec3,
    /// Squared distance to it.
    pub distance_squared: f64,
    /// The triangle it lies on; of several, the one that the traversal met first.
    pub triangle: u32,
}

impl Closest {
    /// Distance to the point.
    pub fn distance(&self) -> f64 {
        self.distance_squared.sqrt()
    }
}

impl Nearest {
    /// Builds the hierarchy over the triangles. `vertices` must be finite.
    ///
    /// # Panics
    /// When a triangle names a vertex that does not exist.
    pub fn new(vertices: &[DVec3], triangles: &[[u32; 3]]) -> Self {
        Self::from_corners(triangles.iter().map(|&t| corners(vertices, t)).collect())
    }

    /// Builds the hierarchy over points, each a triangle that is one point: nearest neighbours.
    pub fn of_points(points: &[DVec3]) -> Self {
        Self::from_corners(points.iter().map(|&p| [p; 3]).collect())
    }

    fn from_corners(triangles: Vec<[DVec3; 3]>) -> Self {
        let boxes: Vec<Aabb> = triangles.iter().map(|t| Aabb::of(t)).collect();
        Self { tree: Bvh::new(&boxes), triangles }
    }

    /// Number of triangles.
    pub fn len(&self) -> usize {
        self.triangles.len()
    }
    /// Whether there is no triangle.
    pub fn is_empty(&self) -> bool {
        self.triangles.is_empty()
    }

    /// The closest point to `p`; `None` when there is no triangle.
    pub fn closest(&self, p: DVec3) -> Option<Closest> {
        self.closest_within(p, f64::INFINITY)
    }

    /// The closest point to `p` nearer than `radius`, if there is one.
    pub fn closest_within(&self, p: DVec3, radius: f64) -> Option<Closest> {
        let mut point = p;
        let mut best = radius * radius;
        let (triangle, distance_squared) = self.tree.nearest(p, best, |i| {
            let q = closest_on_triangle(p, self.triangles[i as usize]);
            let d = p.distance_squared(q);
            if d < best {
                (best, point) = (d, q);
            }
            d
        })?;
        Some(Closest { point, distance_squared, triangle })
    }

    /// Whether some triangle within `radius` of `p` satisfies `wanted`.
    pub(crate) fn any_within(&self, p: DVec3, radius: f64, mut wanted: impl FnMut(u32) -> bool) -> bool {
        let mut found = false;
        let reach = Aabb { min: p - radius, max: p + radius };
        self.tree.overlapping(&reach, |i| {
            let within = p.distance_squared(closest_on_triangle(p, self.triangles[i as usize])) <= radius * radius;
            found = within && wanted(i);
            if found { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
        });
        found
    }

    /// The closest point to every point, in order, on the settings' pool.
    ///
    /// # Errors
    /// When the token is raised.
    ///
    /// # Panics
    /// When there is no triangle.
    pub fn closest_all(&self, points: &[DVec3], settings: &Settings<'_>) -> Result<Vec<Closest>, Canceled> {
        map_chunks(points, settings, |_, &p| self.closest(p).expect("a mesh with at least one triangle"))
    }
}

/// The point of a closed triangle that is closest to `p` (Ericson 2005, *Real-Time Collision Detection*, section 5.1.5).
/// A triangle without area is the union of its edges.
pub fn closest_on_triangle(p: DVec3, [a, b, c]: [DVec3; 3]) -> DVec3 {
    let (ab, ac, ap) = (b - a, c - a, p - a);
    let (d1, d2) = (ab.dot(ap), ac.dot(ap));
    if d1 <= 0.0 && d2 <= 0.0 {
        return a;
    }
    let bp = p - b;
    let (d3, d4) = (ab.dot(bp), ac.dot(bp));
    if d3 >= 0.0 && d4 <= d3 {
        return b;
    }
    let cp = p - c;
    let (d5, d6) = (ab.dot(cp), ac.dot(cp));
    if d6 >= 0.0 && d5 <= d6 {
        return c;
    }
    let vc = d1 * d4 - d3 * d2;
    let vb = d5 * d2 - d1 * d6;
    let va = d3 * d6 - d5 * d4;
    // the differences above cancel on slivers; there, and outside the triangle, the answer lies on an edge
    let doubled = ab.cross(ac).length_squared();
    let thin = doubled <= 1e-20 * ab.length_squared().max(ac.length_squared()).powi(2);
    if va > 0.0 && vb > 0.0 && vc > 0.0 && !thin {
        let scale = 1.0 / (va + vb + vc);
        return a + ab * (vb * scale) + ac * (vc * scale);
    }
    [(a, b), (b, c), (c, a)]
        .into_iter()
        .map(|(s, e)| closest_on_segment(p, s, e))
        .min_by(|x, y| p.distance_squared(*x).total_cmp(&p.distance_squared(*y)))
        .unwrap_or(a)
}

fn closest_on_segment(p: DVec3, a: DVec3, b: DVec3) -> DVec3 {
    let ab = b - a;
    let length_squared = ab.length_squared();
    if length_squared == 0.0 {
        return a;
    }
    let t = (p - a).dot(ab) / length_squared;
    if t >= 1.0 { b } else { a + ab * t.max(0.0) }
}

#[cfg(test)]
mod tests {
    use super::super::fixtures::*;
    use super::*;

    /// Samples the triangle densely: slow, and obviously right.
    fn brute(p: DVec3, [a, b, c]: [DVec3; 3]) -> f64 {
        let n = 60;
        let mut best = f64::INFINITY;
        for i in 0..=n {
            for j in 0..=n - i {
                let (u, v) = (f64::from(i) / f64::from(n), f64::from(j) / f64::from(n));
                best = best.min(p.distance(a + u * (b - a) + v * (c - a)));
            }
        }
        best
    }

    #[test]
    fn the_closest_point_is_never_farther_than_a_dense_search_finds() {
        let mut random = Splitmix::new(1);
        for _ in 0..300 {
            let t = [random.point(), random.point(), random.point()];
            let p = 2.0 * random.point();
            let exact = p.distance(closest_on_triangle(p, t));
            let searched = brute(p, t);
            assert!(exact <= searched + 1e-12, "{exact} {searched}");
            assert!(searched - exact < 0.06, "{exact} {searched}");
        }
    }

    #[test]
    fn slivers_and_points_answer_like_segments() {
        let (a, b) = (DVec3::ZERO, DVec3::X);
        for c in [a, b, 0.5 * b, DVec3::new(0.5, 1e-17, 0.0)] {
            let q = closest_on_triangle(DVec3::new(0.3, 2.0, 0.0), [a, b, c]);
            assert!((q - DVec3::new(0.3, 0.0, 0.0)).length() < 1e-12, "{c} {q}");
        }
        assert_eq!(closest_on_triangle(DVec3::ONE, [a; 3]), a);
    }

    #[test]
    fn the_tree_finds_what_a_search_over_all_triangles_finds() {
        let (vertices, triangles) = sphere_mesh(24, 12, 1.0, DVec3::ZERO);
        let nearest = Nearest::new(&vertices, &triangles);
        let mut random = Splitmix::new(7);
        for _ in 0..500 {
            let p = 1.5 * random.point();
            let all = triangles
                .iter()
                .map(|&t| p.distance(closest_on_triangle(p, corners(&vertices, t))))
                .fold(f64::INFINITY, f64::min);
            let found = nearest.closest(p).unwrap();
            assert_eq!(found.distance(), p.distance(found.point));
            assert!((found.distance() - all).abs() < 1e-15, "{} {all}", found.distance());
        }
    }

    #[test]
    fn answers_do_not_depend_on_the_number_of_threads() {
        let (vertices, triangles) = sphere_mesh(40, 20, 1.0, DVec3::ZERO);
        let nearest = Nearest::new(&vertices, &triangles);
        let mut random = Splitmix::new(3);
        let points: Vec<DVec3> = (0..3000).map(|_| random.point()).collect();
        let one = with_settings(1, |s| nearest.closest_all(&points, s).unwrap());
        let three = with_settings(3, |s| nearest.closest_all(&points, s).unwrap());
        assert_eq!(one, three);
    }

    #[test]
    fn an_empty_mesh_has_no_closest_point() {
        assert!(Nearest::new(&[], &[]).closest(DVec3::ZERO).is_none());
    }
}
