//! Which triangles of a mesh meet others where they share no corner.
//!
//! The answer only chooses how the sign of the distance is found, and the slower way is right for both answers; so
//! touching counts as meeting, and no exact arithmetic is spent on it.

use glam::{DVec2, DVec3};
use parry3d_f64::bounding_volume::Aabb;
use parry3d_f64::partitioning::{Bvh, BvhBuildStrategy};

/// Which triangles meet another one outside the corners they share.
pub(super) fn find(vertices: &[DVec3], triangles: &[[u32; 3]]) -> Vec<bool> {
    let places = |t: &[u32; 3]| t.map(|i| vertices[i as usize]);
    let hulls = triangles.iter().map(|triangle| {
        let [a, b, c] = places(triangle);
        Aabb::new(a.min(b).min(c), a.max(b).max(c))
    });
    let bvh = Bvh::from_iter(BvhBuildStrategy::Binned, hulls.enumerate());
    let mut meets = vec![false; triangles.len()];
    for (index, triangle) in triangles.iter().enumerate() {
        let [a, b, c] = places(triangle);
        let hull = Aabb::new(a.min(b).min(c), a.max(b).max(c));
        for other in bvh.intersect_aabb(&hull) {
            let other = other as usize;
            if other > index && meet(triangle, [a, b, c], &triangles[other], places(&triangles[other])) {
                meets[index] = true;
                meets[other] = true;
            }
        }
    }
    meets
}

/// Whether two triangles meet outside the corners they share.
fn meet(s: &[u32; 3], sp: [DVec3; 3], t: &[u32; 3], tp: [DVec3; 3]) -> bool {
    let shared = |i: &u32, list: &[u32; 3]| list.contains(i);
    match s.iter().filter(|i| shared(i, t)).count() {
        0 => (0..3).any(|k| crosses(sp[k], sp[(k + 1) % 3], tp)) || (0..3).any(|k| crosses(tp[k], tp[(k + 1) % 3], sp)),
        1 => {
            // only the edge opposite the shared corner can reach the other triangle away from that corner
            let opposite = |c: &[u32; 3], other: &[u32; 3]| c.iter().position(|i| shared(i, other)).unwrap_or(0);
            let (k, l) = (opposite(s, t), opposite(t, s));
            crosses(sp[(k + 1) % 3], sp[(k + 2) % 3], tp) || crosses(tp[(l + 1) % 3], tp[(l + 2) % 3], sp)
        }
        2 => folded(s, sp, t, tp),
        _ => true,
    }
}

/// Whether two triangles over one edge lie on each other: the same plane, and both on the same side of the edge.
fn folded(s: &[u32; 3], sp: [DVec3; 3], t: &[u32; 3], tp: [DVec3; 3]) -> bool {
    let alone = |c: &[u32; 3], other: &[u32; 3]| c.iter().position(|i| !other.contains(i)).unwrap_or(0);
    let k = alone(s, t);
    let (a, b) = (sp[(k + 1) % 3], sp[(k + 2) % 3]);
    let (u, v) = (sp[k] - a, tp[alone(t, s)] - a);
    let edge = b - a;
    let (m, n) = (edge.cross(u), edge.cross(v));
    // planes within a millionth of a radian of each other, where the input's own rounding decides
    m.dot(n) > 0.0 && m.cross(n).length_squared() <= 1e-12 * m.length_squared() * n.length_squared()
}

/// Whether the segment from `p` to `q` meets the triangle.
fn crosses(p: DVec3, q: DVec3, [a, b, c]: [DVec3; 3]) -> bool {
    let normal = (b - a).cross(c - a);
    let (hp, hq) = (normal.dot(p - a), normal.dot(q - a));
    // below this a height is rounding of the products that made it
    let noise = 1e-14 * normal.length() * (p - a).length().max((q - a).length());
    let (flat_p, flat_q) = (hp.abs() <= noise, hq.abs() <= noise);
    if flat_p && flat_q {
        return crosses_in_plane(p, q, [a, b, c], normal);
    }
    if hp * hq > 0.0 && !flat_p && !flat_q {
        return false;
    }
    let x = p + (q - p) * (hp / (hp - hq));
    let inside = |s: DVec3, e: DVec3| normal.dot((e - s).cross(x - s));
    inside(a, b) >= 0.0 && inside(b, c) >= 0.0 && inside(c, a) >= 0.0
}

/// The same for a segment in the triangle's plane: it meets the triangle's inside.
fn crosses_in_plane(p: DVec3, q: DVec3, corners: [DVec3; 3], normal: DVec3) -> bool {
    let drop = normal.abs().max_position();
    let flat = |v: DVec3| match drop {
        0 => DVec2::new(v.y, v.z),
        1 => DVec2::new(v.z, v.x),
        _ => DVec2::new(v.x, v.y),
    };
    let turn = normal[drop].signum();
    let (mut enter, mut leave) = (0.0f64, 1.0f64);
    let (start, along) = (flat(p), flat(q) - flat(p));
    for k in 0..3 {
        let (s, e) = (flat(corners[k]), flat(corners[(k + 1) % 3]));
        let height = |v: DVec2| turn * (e - s).perp_dot(v);
        let (at, slope) = (height(start - s), height(along));
        if slope == 0.0 {
            if at <= 0.0 {
                return false;
            }
        } else if slope > 0.0 {
            enter = enter.max(-at / slope);
        } else {
            leave = leave.min(-at / slope);
        }
    }
    // a piece of the segment, not just a point of it, lies inside
    leave - enter > 1e-9
}
