//! The unsigned distance to loose triangles: no sides, no closedness.

use super::closest::closest;
use super::tree::Tree;
use glam::DVec3;

/// Triangles that can be asked for the point nearest to a place. A triangle may be a segment or a point.
#[derive(Default)]
pub struct Sheet {
    tree: Option<Tree>,
    /// First corner and the two edges from it, in the order of the tree's places.
    triangles: Vec<[DVec3; 3]>,
}

impl Sheet {
    /// A sheet of triangles given by their corners.
    pub fn new(corners: &[[DVec3; 3]]) -> Self {
        if corners.is_empty() {
            return Self::default();
        }
        let (tree, order) = Tree::build(corners.iter().copied());
        let triangles = order.into_iter().map(|t| {
            let [a, b, c] = corners[t as usize];
            [a, b - a, c - a]
        });
        Self { triangles: triangles.collect(), tree: Some(tree) }
    }

    /// The nearest point of the sheet, where it is nearer than `within`. Of equally near ones the first by coordinates.
    pub fn nearest(&self, p: DVec3, within: f64) -> Option<DVec3> {
        if within <= 0.0 {
            return None;
        }
        let mut best: Option<(f64, DVec3)> = None;
        self.tree.as_ref()?.nearest(p, within * within, |place, bound| {
            let [a, ab, ac] = self.triangles[place as usize];
            let (foot, _) = closest(p, a, ab, ac);
            let distance2 = foot.distance_squared(p);
            let nearer = best.is_none_or(|(least, held)| {
                distance2 < least || (distance2 == least && foot.to_array() < held.to_array())
            });
            if nearer {
                best = Some((distance2, foot));
            }
            bound.min(distance2)
        });
        best.filter(|&(distance2, _)| distance2 < within * within).map(|(_, foot)| foot)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_nearest_point_is_the_nearest_of_all_triangles() {
        // a fan of triangles, a segment and a point
        let at = |k: usize| DVec3::new((k as f64).cos(), (k as f64).sin(), 0.1 * k as f64);
        let mut corners: Vec<[DVec3; 3]> = (0..40).map(|k| [DVec3::ZERO, at(k), at(k + 1)]).collect();
        corners.push([DVec3::Z * 3.0, DVec3::Z * 4.0, DVec3::Z * 4.0]);
        corners.push([DVec3::X * 5.0; 3]);
        let sheet = Sheet::new(&corners);
        for k in 0..200 {
            let t = f64::from(k);
            let p = DVec3::new(3.0 * (0.7 * t).sin(), 4.0 * (1.3 * t).cos(), 2.0 + 3.0 * (0.37 * t).sin());
            let brute = corners.iter().map(|&[a, b, c]| closest(p, a, b - a, c - a).0.distance(p));
            let least = brute.fold(f64::INFINITY, f64::min);
            let found = sheet.nearest(p, f64::INFINITY).expect("there are triangles").distance(p);
            assert!((found - least).abs() < 1e-12, "{found} {least}");
            assert_eq!(sheet.nearest(p, 0.99 * least), None);
        }
        assert_eq!(Sheet::new(&[]).nearest(DVec3::ZERO, f64::INFINITY), None);
    }
}
