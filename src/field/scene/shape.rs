//! Signed distances of the elementary shapes, with gradients, one point at a time; written without branches where the
//! compiler can then turn a loop over them into vector code.
//!
//! Every gradient has unit length, also where the distance has a crease, on an axis and in a centre: there one of the
//! directions of steepest ascent on either side is taken. Differences that vanish on the surface are formed before they
//! are squared, so that normals on the surface keep their digits.

/// Lengths below this are zero: their squares leave the normal range of `f32` soon after.
pub(super) const TINY: f32 = 1e-18;

/// Value and gradient at a point.
#[derive(Clone, Copy)]
pub(super) struct Sample {
    pub value: f32,
    pub gradient: [f32; 3],
}

#[inline(always)]
fn dot(a: [f32; 3], b: [f32; 3]) -> f32 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

/// Length and direction of `v`, `otherwise` where it has none.
#[inline(always)]
fn direction(v: [f32; 3], otherwise: [f32; 3]) -> (f32, [f32; 3]) {
    let length = dot(v, v).sqrt();
    let known = length > TINY;
    let inverse = if known { 1.0 / length } else { 0.0 };
    (length, std::array::from_fn(|k| if known { v[k] * inverse } else { otherwise[k] }))
}

/// The convex corner where two perpendicular faces meet, at distances `a` and `b` beyond them: the distance, and how much
/// of each face's normal the gradient has.
#[inline(always)]
pub(super) fn corner(a: f32, b: f32) -> (f32, f32, f32) {
    let (oa, ob) = (a.max(0.0), b.max(0.0));
    let outside = (oa * oa + ob * ob).sqrt();
    let beyond = outside > TINY;
    let inverse = if beyond { 1.0 / outside } else { 0.0 };
    let first = if a >= b { 1.0 } else { 0.0 };
    let value = if beyond { outside } else { a.max(b) };
    (value, if beyond { oa * inverse } else { first }, if beyond { ob * inverse } else { 1.0 - first })
}

/// Distance from the z axis and the direction away from it.
#[inline(always)]
pub(super) fn radial(x: f32, y: f32) -> (f32, f32, f32) {
    let (r, d) = direction([x, y, 0.0], [1.0, 0.0, 0.0]);
    (r, d[0], d[1])
}

#[inline(always)]
pub(super) fn sphere(p: [f32; 3], radius: f32) -> Sample {
    let (length, gradient) = direction(p, [1.0, 0.0, 0.0]);
    Sample { value: length - radius, gradient }
}

#[inline(always)]
pub(super) fn boxed(p: [f32; 3], half: [f32; 3], radius: f32) -> Sample {
    let q: [f32; 3] = std::array::from_fn(|k| p[k].abs() - half[k]);
    let o = q.map(|c| c.max(0.0));
    let outside = dot(o, o).sqrt();
    let beyond = outside > TINY;
    let inverse = if beyond { 1.0 / outside } else { 0.0 };
    let most = q[0].max(q[1]).max(q[2]);
    let x = if q[0] >= most { 1.0 } else { 0.0 };
    let y = if q[1] >= most { 1.0 - x } else { 0.0 };
    let inner = [x, y, 1.0 - x - y];
    let gradient = std::array::from_fn(|k| (if beyond { o[k] * inverse } else { inner[k] }).copysign(p[k]));
    Sample { value: (if beyond { outside } else { most }) - radius, gradient }
}

#[inline(always)]
pub(super) fn rectangle(p: [f32; 3], half: [f32; 2]) -> Sample {
    let (value, a, b) = corner(p[0].abs() - half[0], p[1].abs() - half[1]);
    Sample { value, gradient: [a.copysign(p[0]), b.copysign(p[1]), 0.0] }
}

/// `aside` is a unit vector across the axis.
#[inline(always)]
pub(super) fn capsule(
    p: [f32; 3],
    from: [f32; 3],
    along: [f32; 3],
    inverse: f32,
    aside: [f32; 3],
    radius: f32,
) -> Sample {
    let w: [f32; 3] = std::array::from_fn(|k| p[k] - from[k]);
    #[allow(clippy::manual_clamp)] // `clamp` keeps a loop over this from becoming vector code
    let t = (dot(w, along) * inverse).max(0.0).min(1.0);
    let (length, gradient) = direction(std::array::from_fn(|k| w[k] - t * along[k]), aside);
    Sample { value: length - radius, gradient }
}

#[inline(always)]
pub(super) fn cylinder(p: [f32; 3], radius: f32, half_height: f32) -> Sample {
    let (r, dx, dy) = radial(p[0], p[1]);
    let (value, a, b) = corner(r - radius, p[2].abs() - half_height);
    Sample { value, gradient: [a * dx, a * dy, b.copysign(p[2])] }
}

#[inline(always)]
pub(super) fn torus(p: [f32; 3], major: f32, minor: f32) -> Sample {
    let (r, dx, dy) = radial(p[0], p[1]);
    let (length, [a, b, _]) = direction([r - major, p[2], 0.0], [1.0, 0.0, 0.0]);
    Sample { value: length - minor, gradient: [a * dx, a * dy, b] }
}

#[inline(always)]
pub(super) fn half_space(p: [f32; 3], normal: [f32; 3], offset: f32) -> Sample {
    Sample { value: dot(p, normal) - offset, gradient: normal }
}

/// In the positive octant the face is the simplex x + y + z = `size`, and the nearest point of a simplex is
/// max(p - tau, 0) with tau the largest of (sum of the k largest coordinates - size)/k (Duchi et al. 2008, "Efficient
/// projections onto the l1-ball", section 3); so the vector to it is min(p, tau).
#[inline(always)]
pub(super) fn octahedron(p: [f32; 3], size: f32) -> Sample {
    const THIRD: f32 = 0.577_350_3;
    let a = p.map(f32::abs);
    let sum = a[0] + a[1] + a[2];
    let (least, most) = (a[0].min(a[1]).min(a[2]), a[0].max(a[1]).max(a[2]));
    let tau = ((sum - size) / 3.0).max((sum - least - size) * 0.5).max(most - size);
    let v = a.map(|c| c.min(tau));
    let outside = dot(v, v).sqrt();
    let beyond = tau > TINY;
    let inverse = if beyond { 1.0 / outside } else { 0.0 };
    let gradient = std::array::from_fn(|k| (if beyond { v[k] * inverse } else { THIRD }).copysign(p[k]));
    Sample { value: if beyond { outside } else { (sum - size) * THIRD }, gradient }
}

/// Distance to an ellipsoid with half axes `radii` (Eberly 2013, "Distance from a point to an ellipse, an ellipsoid, or a
/// hyperellipsoid"): the nearest point is a_i^2 p_i / (t + a_i^2) with t the largest root of sum (a_i p_i / (t + a_i^2))^2 = 1.
///
/// The left side falls and is convex right of its last pole, so Newton's iteration from any start left of the root climbs
/// to it without overshooting; the start makes the largest single term 1, which leaves it at most a factor sqrt 3 away. The unknown
/// is the distance from the last pole, so that nothing cancels there. The gradient is the ellipsoid's normal at the
/// nearest point, and the value its length times t: both keep their digits next to the surface.
pub(super) fn ellipsoid(p: [f32; 3], radii: [f64; 3]) -> Sample {
    let least = radii[0].min(radii[1]).min(radii[2]);
    let y = p.map(|c| f64::from(c.abs()));
    let a2 = radii.map(|a| a * a);
    // denominators are tau + gap
    let gap: [f64; 3] = std::array::from_fn(|k| (radii[k] - least) * (radii[k] + least));
    let ay: [f64; 3] = std::array::from_fn(|k| radii[k] * y[k]);
    let mut tau = (ay[0] - gap[0]).max(ay[1] - gap[1]).max(ay[2] - gap[2]);
    let mut normal = [0.0; 3];
    // at the pole itself: the nearest point has left the plane of symmetry that the point lies in
    let reach = |tau: f64| -> f64 { (0..3).filter(|&k| y[k] > 0.0).map(|k| (ay[k] / (tau + gap[k])).powi(2)).sum() };
    if tau <= 0.0 && reach(0.0) <= 1.0 {
        tau = 0.0;
        let mut rest = 1.0;
        for k in 0..3 {
            if gap[k] > 0.0 {
                normal[k] = y[k] / gap[k];
                rest -= (ay[k] / gap[k]).powi(2);
            }
        }
        // of several shortest axes the last takes the whole of what is missing
        let k = (0..3).rev().find(|&k| gap[k] == 0.0).unwrap_or(2);
        normal[k] = rest.max(0.0).sqrt() / least;
    } else {
        tau = tau.max(0.0);
        // quadratic convergence from within a factor of sqrt 3: 6 steps are typical, 12 were never needed
        for _ in 0..32 {
            let (mut f, mut slope) = (-1.0, 0.0);
            for k in 0..3 {
                if y[k] > 0.0 {
                    let inverse = 1.0 / (tau + gap[k]);
                    let term = ay[k] * inverse;
                    f += term * term;
                    slope += term * term * inverse;
                }
            }
            let step = f / (2.0 * slope);
            // only rounding makes the step negative; NaN cannot be: some y is positive where tau is
            if step <= tau * 1e-15 {
                break;
            }
            tau += step;
        }
        for k in 0..3 {
            normal[k] = if y[k] > 0.0 { y[k] / (tau + gap[k]) } else { 0.0 };
        }
    }
    let length = (normal[0] * normal[0] + normal[1] * normal[1] + normal[2] * normal[2]).sqrt();
    let t = tau - a2[0].min(a2[1]).min(a2[2]);
    let gradient = std::array::from_fn(|k| ((normal[k] / length) as f32).copysign(p[k]));
    Sample { value: (t * length) as f32, gradient }
}
