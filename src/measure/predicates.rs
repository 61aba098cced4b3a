//! Exact signs of orientation determinants.
//!
//! A floating-point filter answers almost always; the rest is settled by exact expansion arithmetic (Shewchuk 1997, "Adaptive
//! precision floating-point arithmetic and fast robust geometric predicates"). The signs are exact for coordinates that
//! are single-precision numbers stored in `f64` (no product then over- or underflows), and for any others as long as no
//! product does.

use glam::{DVec2, DVec3};

/// Half the distance from 1 to the next larger double.
const EPSILON: f64 = f64::EPSILON * 0.5;
/// Shewchuk's bound for the first stage of `orient2d`.
const BOUND_2D: f64 = (3.0 + 16.0 * EPSILON) * EPSILON;
/// Shewchuk's bound for the first stage of `orient3d`.
const BOUND_3D: f64 = (7.0 + 56.0 * EPSILON) * EPSILON;

/// Sign of the doubled area of `a b c`: 1 when counter-clockwise, -1 when clockwise, 0 exactly when collinear.
pub fn orient2d(a: DVec2, b: DVec2, c: DVec2) -> i8 {
    let left = (a.x - c.x) * (b.y - c.y);
    let right = (a.y - c.y) * (b.x - c.x);
    let determinant = left - right;
    if determinant.abs() > BOUND_2D * (left.abs() + right.abs()) {
        return sign(determinant);
    }
    let minor = cross(difference(a.x, c.x), difference(b.y, c.y), difference(a.y, c.y), difference(b.x, c.x));
    minor.sign()
}

/// Sign of the sixfold volume of the tetrahedron `a b c d`: 1 when `d` lies on the side of the plane from which `a b c`
/// is seen clockwise (against the normal `(b - a) x (c - a)`), -1 on the other, 0 exactly on the plane.
pub fn orient3d(a: DVec3, b: DVec3, c: DVec3, d: DVec3) -> i8 {
    let (ad, bd, cd) = (a - d, b - d, c - d);
    let (bc, cb) = (bd.x * cd.y, cd.x * bd.y);
    let (ca, ac) = (cd.x * ad.y, ad.x * cd.y);
    let (ab, ba) = (ad.x * bd.y, bd.x * ad.y);
    let determinant = ad.z * (bc - cb) + bd.z * (ca - ac) + cd.z * (ab - ba);
    let permanent =
        (bc.abs() + cb.abs()) * ad.z.abs() + (ca.abs() + ac.abs()) * bd.z.abs() + (ab.abs() + ba.abs()) * cd.z.abs();
    if determinant.abs() > BOUND_3D * permanent {
        return sign(determinant);
    }
    orient3d_exact(a, b, c, d)
}

#[cold]
fn orient3d_exact(a: DVec3, b: DVec3, c: DVec3, d: DVec3) -> i8 {
    let [ax, ay, az] = [difference(a.x, d.x), difference(a.y, d.y), difference(a.z, d.z)];
    let [bx, by, bz] = [difference(b.x, d.x), difference(b.y, d.y), difference(b.z, d.z)];
    let [cx, cy, cz] = [difference(c.x, d.x), difference(c.y, d.y), difference(c.z, d.z)];
    let mut total = Expansion::<192>::default();
    for (z, minor) in [(az, cross(bx, cy, by, cx)), (bz, cross(cx, ay, cy, ax)), (cz, cross(ax, by, ay, bx))] {
        for factor in z.terms() {
            total.add(minor.scaled(*factor).terms());
        }
    }
    total.sign()
}

fn sign(x: f64) -> i8 {
    i8::from(x > 0.0) - i8::from(x < 0.0)
}

/// A number as an unevaluated sum of doubles: nonoverlapping, of increasing magnitude, without zeros.
#[derive(Clone, Copy)]
struct Expansion<const N: usize> {
    terms: [f64; N],
    length: usize,
}

impl<const N: usize> Default for Expansion<N> {
    fn default() -> Self {
        Self { terms: [0.0; N], length: 0 }
    }
}

impl<const N: usize> Expansion<N> {
    fn terms(&self) -> &[f64] {
        &self.terms[..self.length]
    }
    fn push(&mut self, term: f64) {
        if term != 0.0 {
            self.terms[self.length] = term;
            self.length += 1;
        }
    }
    /// The term of largest magnitude has the sign of the whole.
    fn sign(&self) -> i8 {
        self.terms().last().map_or(0, |&t| sign(t))
    }
    /// Adds an expansion, term by term (Shewchuk's Expansion-Sum with zero elimination: every addition of one term leaves a
    /// nonoverlapping expansion that is at most one longer).
    fn add(&mut self, terms: &[f64]) {
        for &term in terms {
            let mut carry = term;
            let mut length = 0;
            for i in 0..self.length {
                let (sum, error) = two_sum(carry, self.terms[i]);
                if error != 0.0 {
                    self.terms[length] = error;
                    length += 1;
                }
                carry = sum;
            }
            self.length = length;
            self.push(carry);
        }
    }
}

impl Expansion<16> {
    /// The product with one double, exactly (Shewchuk's Scale-Expansion).
    fn scaled(&self, factor: f64) -> Expansion<32> {
        let mut product = Expansion::default();
        let mut carry = 0.0;
        for &term in self.terms() {
            let (high, low) = two_product(term, factor);
            let (sum, error) = two_sum(carry, low);
            product.push(error);
            let (sum, error) = fast_two_sum(high, sum);
            product.push(error);
            carry = sum;
        }
        product.push(carry);
        product
    }
}

/// `x - y` exactly.
fn difference(x: f64, y: f64) -> Expansion<2> {
    let (high, low) = two_sum(x, -y);
    let mut e = Expansion::default();
    e.push(low);
    e.push(high);
    e
}

/// `p q - r s` exactly.
fn cross(p: Expansion<2>, q: Expansion<2>, r: Expansion<2>, s: Expansion<2>) -> Expansion<16> {
    let mut total = Expansion::<16>::default();
    for (left, right, factor) in [(p, q, 1.0), (r, s, -1.0)] {
        for &x in left.terms() {
            for &y in right.terms() {
                let (high, low) = two_product(x, factor * y);
                total.add(&[low, high]);
            }
        }
    }
    total
}

/// Sum and rounding error (Knuth).
fn two_sum(a: f64, b: f64) -> (f64, f64) {
    let sum = a + b;
    let b_part = sum - a;
    let a_part = sum - b_part;
    (sum, (a - a_part) + (b - b_part))
}

/// Sum and rounding error, for `|a| >= |b|` (Dekker).
fn fast_two_sum(a: f64, b: f64) -> (f64, f64) {
    let sum = a + b;
    (sum, b - (sum - a))
}

/// Product and rounding error. A fused multiply-add rounds once, so the error is exact.
fn two_product(a: f64, b: f64) -> (f64, f64) {
    let product = a * b;
    (product, a.mul_add(b, -product))
}

#[cfg(test)]
mod tests {
    use super::super::fixtures::Splitmix;
    use super::*;

    /// The determinant in integers: coordinates are multiples of 2^-20 below 2^3.
    fn integer_orient3d(points: [DVec3; 4]) -> i8 {
        let p = points.map(|p| p.to_array().map(|x| (x * 1_048_576.0) as i128));
        let r = [0, 1, 2].map(|i| [0, 1, 2].map(|k| p[i][k] - p[3][k]));
        let det = r[0][2] * (r[1][0] * r[2][1] - r[1][1] * r[2][0])
            + r[1][2] * (r[2][0] * r[0][1] - r[2][1] * r[0][0])
            + r[2][2] * (r[0][0] * r[1][1] - r[0][1] * r[1][0]);
        det.signum() as i8
    }

    fn snapped(random: &mut Splitmix) -> DVec3 {
        (random.point() * 1_048_576.0).round() / 1_048_576.0
    }

    #[test]
    fn signs_agree_with_integer_arithmetic_on_random_and_flat_tetrahedra() {
        let mut random = Splitmix::new(11);
        let mut flat = 0;
        for i in 0..20_000 {
            let (a, u, v) = (snapped(&mut random), snapped(&mut random), snapped(&mut random));
            let (b, c) = (a + u, a + v);
            // integer combinations stay on the grid, and in the plane
            let mut d = a + 2.0 * u - v;
            if i % 2 == 0 {
                d[i % 3] += [0.0, 1.0, -1.0][(random.bits() % 3) as usize] / 1_048_576.0;
            }
            let expected = integer_orient3d([a, b, c, d]);
            flat += usize::from(expected == 0);
            assert_eq!(orient3d(a, b, c, d), expected, "{a} {b} {c} {d}");
            assert_eq!(orient3d(b, a, c, d), -expected);
            assert_eq!(orient3d_exact(a, b, c, d), expected);
        }
        assert!(flat > 1000 && flat < 19_000, "{flat}");
    }

    #[test]
    fn a_point_one_ulp_off_a_plane_is_off_the_plane() {
        let far = DVec3::splat(f64::from(1e7f32));
        let (a, b, c) = (far + DVec3::X, far + DVec3::Y, far + DVec3::Z);
        let on = far + DVec3::new(3.0, -1.0, -1.0);
        assert_eq!(orient3d(a, b, c, on), 0);
        for axis in 0..3 {
            let (mut above, mut below) = (on, on);
            above[axis] = on[axis].next_up();
            below[axis] = on[axis].next_down();
            assert_eq!(orient3d(a, b, c, above), -1);
            assert_eq!(orient3d(a, b, c, below), 1);
        }
    }

    #[test]
    fn the_plane_of_a_needle_is_found_where_rounding_loses_it() {
        // Kettner et al. 2008, "Classroom examples of robustness problems": nearly collinear points
        let (b, c) = (DVec2::splat(12.0), DVec2::splat(24.0));
        for i in 0..64i32 {
            for j in 0..64i32 {
                let a = DVec2::new(0.5 + f64::from(i) * EPSILON, 0.5 + f64::from(j) * EPSILON);
                let expected = (j - i).signum() as i8;
                assert_eq!(orient2d(a, b, c), -orient2d(b, a, c));
                // a is left of the line from b to c, which is y = x, exactly when j > i
                assert_eq!(orient2d(b, c, a), expected, "{i} {j}");
            }
        }
    }

    #[test]
    fn tiny_coordinates_keep_their_sign() {
        let tiny = f64::from(f32::from_bits(1));
        let d = DVec3::new(0.0, 0.0, tiny);
        assert_eq!(orient3d(DVec3::ZERO, DVec3::X * tiny, DVec3::Y * tiny, d), -1);
        assert_eq!(orient3d(DVec3::ZERO, DVec3::X * tiny, DVec3::Y * tiny, -d), 1);
    }
}
