//! The generalized winding number of a triangle mesh, approximated over a hierarchy: how often the surface wraps around
//! a point, 1 inside a closed surface and 0 outside, and something in between near a hole.
//!
//! G. Barill, N. Dickson, R. Schmidt, D. I. W. Levin, A. Jacobson, Fast winding numbers for soups and clouds, 2018. A node
//! far away counts as its dipole; near nodes are opened, and triangles at the leaves count with their exact solid angle (A. Van Oosterom and J. Strackee, 1983).

use glam::DVec3;
use std::f64::consts::PI;

/// A node is opened when the point is nearer to it than this many of its radii: dipoles alone are then right to about
/// 0.02, far below the 0.5 that separates inside from outside.
const FAR: f64 = 3.0;
/// Triangles in a leaf: solid angles of so few cost about as much as opening one level more.
const LEAF: usize = 8;

struct Node {
    /// Area-weighted mean of the triangles' centroids.
    center: DVec3,
    /// Largest distance from the center to a corner.
    radius: f64,
    /// Sum of area times normal.
    dipole: DVec3,
    /// First triangle in `order`, and one past the last.
    from: u32,
    to: u32,
    /// The node behind the first child's subtree: the second child. The first child is the next node. 0 for a leaf.
    second: u32,
}

/// The hierarchy over a mesh.
pub(super) struct Winding {
    nodes: Vec<Node>,
    corners: Vec<[DVec3; 3]>,
}

impl Winding {
    pub fn new(vertices: &[DVec3], triangles: &[[u32; 3]]) -> Self {
        let mut corners: Vec<[DVec3; 3]> = triangles.iter().map(|t| t.map(|i| vertices[i as usize])).collect();
        let mut nodes = Vec::with_capacity(2 * corners.len() / LEAF + 1);
        let count = corners.len();
        build(&mut nodes, &mut corners, 0, count);
        Self { nodes, corners }
    }

    /// How often the surface wraps around `p`.
    pub fn number(&self, p: DVec3) -> f64 {
        let mut stack = [0u32; 64];
        let mut depth = 1;
        let mut sum = 0.0;
        while depth > 0 {
            depth -= 1;
            let index = stack[depth] as usize;
            let node = &self.nodes[index];
            let r = node.center - p;
            let distance2 = r.length_squared();
            let far = FAR * node.radius;
            if distance2 > far * far {
                let inverse = 1.0 / distance2.sqrt();
                sum += node.dipole.dot(r) * (inverse * inverse * inverse);
            } else if node.second == 0 {
                for &[a, b, c] in &self.corners[node.from as usize..node.to as usize] {
                    sum += solid_angle(a - p, b - p, c - p);
                }
            } else {
                // the halves of the triangles shrink with every level, so 64 levels hold any mesh
                stack[depth] = node.second;
                stack[depth + 1] = index as u32 + 1;
                depth += 2;
            }
        }
        sum / (4.0 * PI)
    }
}

/// Builds the subtree over `corners[from..to]`, split at the median of the longest axis.
fn build(nodes: &mut Vec<Node>, corners: &mut [[DVec3; 3]], from: usize, to: usize) {
    let members = &mut corners[from..to];
    let centroid = |t: &[DVec3; 3]| (t[0] + t[1] + t[2]) / 3.0;
    let vector_area = |t: &[DVec3; 3]| 0.5 * (t[1] - t[0]).cross(t[2] - t[0]);
    let (mut weighted, mut area, mut plain, mut dipole) = (DVec3::ZERO, 0.0, DVec3::ZERO, DVec3::ZERO);
    let (mut low, mut high) = (DVec3::INFINITY, DVec3::NEG_INFINITY);
    for t in members.iter() {
        let (middle, vector) = (centroid(t), vector_area(t));
        weighted += middle * vector.length();
        area += vector.length();
        plain += middle;
        dipole += vector;
        (low, high) = (low.min(middle), high.max(middle));
    }
    let center = if area > 0.0 { weighted / area } else { plain / members.len() as f64 };
    let radius2 = members.iter().flatten().fold(0.0f64, |r, corner| r.max(corner.distance_squared(center)));
    let index = nodes.len();
    let (from32, to32) = (from as u32, to as u32);
    nodes.push(Node { center, radius: radius2.sqrt(), dipole, from: from32, to: to32, second: 0 });
    if members.len() > LEAF {
        let axis = (high - low).max_position();
        let middle = members.len() / 2;
        members.select_nth_unstable_by(middle, |s, t| centroid(s)[axis].total_cmp(&centroid(t)[axis]));
        build(nodes, corners, from, from + middle);
        nodes[index].second = nodes.len() as u32;
        build(nodes, corners, from + middle, to);
    }
}

/// Signed solid angle of a triangle seen from the origin, positive when it is seen from behind (from inside).
fn solid_angle(a: DVec3, b: DVec3, c: DVec3) -> f64 {
    let (la, lb, lc) = (a.length(), b.length(), c.length());
    let above = a.dot(b.cross(c));
    let below = la * lb * lc + a.dot(b) * lc + b.dot(c) * la + c.dot(a) * lb;
    2.0 * above.atan2(below)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The approximation of a far node against the sum over its triangles.
    #[test]
    fn a_far_node_counts_nearly_as_its_triangles_do() {
        let mesh = super::super::tests::icosphere(DVec3::ZERO, 1.0, 4);
        let vertices: Vec<DVec3> = mesh.vertices.iter().map(|&v| DVec3::from(v)).collect();
        let winding = Winding::new(&vertices, &mesh.triangles);
        let mut worst = 0.0f64;
        for i in 0..200 {
            let p = super::super::tests::point(i) * 2.0;
            let exact: f64 = winding.corners.iter().map(|&[a, b, c]| solid_angle(a - p, b - p, c - p)).sum();
            let difference = (winding.number(p) - exact / (4.0 * PI)).abs();
            worst = worst.max(difference);
        }
        // far below the 0.5 that separates inside from outside
        assert!(worst < 0.02, "{worst}");
    }
}
