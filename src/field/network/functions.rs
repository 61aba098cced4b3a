//! The transcendental functions of activations, written so that a loop over them becomes vector instructions.
//!
//! No branch, no table, no fused multiply-add: a loop gives the same bits whatever width it is compiled for. The bounds
//! stated here are held by the tests, which compare with `f64` over the whole range of arguments that a network meets.

/// Adding and taking away this rounds an `f32` of magnitude below 2^22 to the nearest whole number.
const ROUND: f32 = 12_582_912.0;

/// e^x. Relative error below 2e-7 for -87 <= x <= 88; arguments beyond are moved to the nearer end.
#[inline(always)]
pub(super) fn exp(x: f32) -> f32 {
    let x = if x > 88.0 { 88.0 } else { x };
    let x = if x < -87.0 { -87.0 } else { x };
    let shifted = x * std::f32::consts::LOG2_E + ROUND;
    let n = shifted - ROUND;
    // ln 2 in two parts, the first with so few bits that its product with n is exact
    let r = (x - n * 0.693_359_4) - n * -2.121_944_4e-4;
    // the minimax polynomial of Cephes' expf (S. L. Moshier)
    let mut p = 1.987_569_1e-4;
    p = p * r + 1.398_2e-3;
    p = p * r + 8.333_452e-3;
    p = p * r + 4.166_579_6e-2;
    p = p * r + 1.666_666_5e-1;
    p = p * r + 0.5;
    let e = p * (r * r) + r + 1.0;
    // shifted holds n in its low bits; moved into the exponent it is a factor of 2^n
    f32::from_bits(e.to_bits().wrapping_add(shifted.to_bits() << 23))
}

/// Largest argument for which [`sin_cos`] keeps its bound.
pub(super) const SIN_COS_RANGE: f32 = 8192.0;

/// Sine and cosine. Absolute error below 1.5e-7 for |x| <= [`SIN_COS_RANGE`].
#[inline(always)]
pub(super) fn sin_cos(x: f32) -> (f32, f32) {
    let shifted = x * std::f32::consts::FRAC_2_PI + ROUND;
    let n = shifted - ROUND;
    // pi / 2 in three parts, the first two with few bits (Cody and Waite; the parts are Cephes' for pi / 4, doubled)
    let r = ((x - n * 1.570_312_5) - n * 4.837_513e-4) - n * 7.549_79e-8;
    let r2 = r * r;
    // the minimax polynomials of Cephes' sinf and cosf on [-pi/4, pi/4]
    let sine = ((-1.951_529_6e-4 * r2 + 8.332_161e-3) * r2 - 1.666_665_5e-1) * r2 * r + r;
    let cosine = ((2.443_315_7e-5 * r2 - 1.388_731_6e-3) * r2 + 4.166_664_6e-2) * (r2 * r2) - 0.5 * r2 + 1.0;
    // the low bits of shifted are n: odd quarters swap the two, the second and third negate
    let quarter = shifted.to_bits();
    let odd = quarter & 1 != 0;
    let (s, c) = if odd { (cosine, sine) } else { (sine, cosine) };
    let sign_s = (quarter & 2) << 30;
    let sign_c = (quarter.wrapping_add(1) & 2) << 30;
    (f32::from_bits(s.to_bits() ^ sign_s), f32::from_bits(c.to_bits() ^ sign_c))
}

/// Hyperbolic tangent. Absolute error below 2e-7, relative below 4e-7.
#[inline(always)]
pub(super) fn tanh(x: f32) -> f32 {
    let x2 = x * x;
    // the minimax polynomial of Cephes' tanhf for |x| < 0.625
    let mut p = -5.704_988_7e-3;
    p = p * x2 + 2.063_909e-2;
    p = p * x2 - 5.373_971_6e-2;
    p = p * x2 + 1.333_144_2e-1;
    p = p * x2 - 3.333_328e-1;
    let small = p * x2 * x + x;
    let large = (1.0 - 2.0 / (exp(2.0 * x.abs()) + 1.0)).copysign(x);
    if x.abs() < 0.625 { small } else { large }
}

/// 1 / (1 + e^-x). Relative error below 4e-7 for x >= -87.
#[inline(always)]
pub(super) fn sigmoid(x: f32) -> f32 {
    1.0 / (1.0 + exp(-x))
}

/// ln(1 + u) for 0 <= u <= 1. Relative error below 3e-7.
#[inline(always)]
pub(super) fn ln_1p(u: f32) -> f32 {
    // ln(1 + u) = 2 artanh(s) with s = u / (2 + u) <= 1/3, whose series ends below 1e-8 after s^13
    let s = u / (2.0 + u);
    let s2 = s * s;
    let mut p = 1.0 / 13.0;
    for term in [11.0, 9.0, 7.0, 5.0, 3.0] {
        p = p * s2 + 1.0 / term;
    }
    2.0 * s * (p * s2 + 1.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Arguments from `-to` to `to`, dense near zero as well as far from it.
    fn arguments(to: f64) -> impl Iterator<Item = f32> {
        let even = (-200_000..=200_000).map(move |i| (f64::from(i) / 200_000.0 * to) as f32);
        let tiny = (0..4000).flat_map(move |i| {
            let x = (to * (-f64::from(i) / 100.0).exp()) as f32;
            [x, -x]
        });
        even.chain(tiny)
    }

    fn worst(to: f64, error: impl Fn(f32) -> f64) -> f64 {
        arguments(to).map(error).fold(0.0, f64::max)
    }

    #[test]
    fn exp_keeps_its_bound() {
        let e = worst(87.0, |x| (f64::from(exp(x)) / f64::from(x).exp() - 1.0).abs());
        assert!(e < 2e-7, "{e}");
        assert!(exp(1e30).is_finite() && exp(-1e30) < 1e-37);
    }

    #[test]
    fn sin_and_cos_keep_their_bound() {
        for range in [1.0, 30.0, f64::from(SIN_COS_RANGE)] {
            let s = worst(range, |x| (f64::from(sin_cos(x).0) - f64::from(x).sin()).abs());
            let c = worst(range, |x| (f64::from(sin_cos(x).1) - f64::from(x).cos()).abs());
            assert!(s < 1.5e-7 && c < 1.5e-7, "{s} {c} up to {range}");
        }
    }

    #[test]
    fn tanh_keeps_its_bounds() {
        let absolute = worst(50.0, |x| (f64::from(tanh(x)) - f64::from(x).tanh()).abs());
        let relative =
            worst(50.0, |x| (f64::from(tanh(x)) - f64::from(x).tanh()).abs() / f64::from(x.abs()).tanh().max(1e-30));
        assert!(absolute < 2e-7 && relative < 4e-7, "{absolute} {relative}");
    }

    #[test]
    fn sigmoid_and_ln_1p_keep_their_bounds() {
        let s = worst(87.0, |x| (f64::from(sigmoid(x)) * (1.0 + (-f64::from(x)).exp()) - 1.0).abs());
        assert!(s < 4e-7, "{s}");
        let l = worst(1.0, |x| {
            (f64::from(ln_1p(x.abs())) / f64::from(x.abs()).ln_1p().max(1e-300) - 1.0).abs() * f64::from(x != 0.0)
        });
        assert!(l < 3e-7, "{l}");
    }
}
