//! The part of a mesh that bounds its solid. Where a mesh meets itself, what lies inside the solid bounds nothing: the zero
//! level set does not go there, and no surface can be asked to.

use super::TriangleMesh;
use super::sides::{OFF, Sides};
use super::winding::Winding;
use glam::DVec3;

/// A triangle that meets others is cut into four this often at most; pieces are judged as a whole.
const CUTS: u32 = 3;

/// The triangles of `mesh` with the solid on one side and space on the other, cut where they go into the solid; `sides` tells
/// what is beside every triangle, and `winding` is about `center`.
pub(super) fn boundary(mesh: &TriangleMesh, sides: &[Sides], winding: &Winding, center: DVec3) -> TriangleMesh {
    let mut kept = TriangleMesh::default();
    let mut numbers = vec![u32::MAX; mesh.vertices.len()];
    let mut pieces = Vec::new();
    for (triangle, side) in mesh.triangles.iter().zip(sides) {
        let corners = triangle.map(|v| DVec3::from(mesh.vertices[v as usize]));
        let whole = match side {
            Sides::Plain | Sides::Swapped => true,
            Sides::Buried => continue,
            Sides::Unknown => cut(corners, &|t| is_boundary(t, winding, center), CUTS, &mut pieces),
        };
        if whole {
            kept.triangles.push(triangle.map(|v| {
                let number = &mut numbers[v as usize];
                if *number == u32::MAX {
                    *number = kept.vertices.len() as u32;
                    kept.vertices.push(mesh.vertices[v as usize]);
                }
                *number
            }));
        } else {
            for piece in pieces.drain(..) {
                let first = kept.vertices.len() as u32;
                kept.vertices.extend(piece.map(|p| p.to_array()));
                kept.triangles.push([first, first + 1, first + 2]);
            }
        }
        pieces.clear();
    }
    kept
}

/// Whether all of a triangle is boundary; where not, `pieces` gets what is.
fn cut(t: [DVec3; 3], is_boundary: &dyn Fn([DVec3; 3]) -> bool, cuts: u32, pieces: &mut Vec<[DVec3; 3]>) -> bool {
    if cuts == 0 {
        return is_boundary(t);
    }
    let [a, b, c] = t;
    let [ab, bc, ca] = [a.midpoint(b), b.midpoint(c), c.midpoint(a)];
    let before = pieces.len();
    let quarters = [[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]];
    let whole = quarters.map(|quarter| cut(quarter, is_boundary, cuts - 1, pieces));
    if whole.iter().all(|&w| w) {
        pieces.truncate(before);
        return true;
    }
    pieces.extend(quarters.into_iter().zip(whole).filter(|(_, whole)| *whole).map(|(quarter, _)| quarter));
    false
}

/// Whether the solid is on exactly one side of a triangle's middle.
fn is_boundary([a, b, c]: [DVec3; 3], winding: &Winding, center: DVec3) -> bool {
    let normal = (b - a).cross(c - a);
    let off = normal.normalize_or_zero() * (OFF * (0.5 * normal.length()).sqrt());
    let middle = (a + b + c) / 3.0 - center;
    let inside = |p: DVec3| winding.number(p).abs() > 0.5;
    inside(middle + off) != inside(middle - off)
}
