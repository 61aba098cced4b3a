//! Area-weighted samples of a triangle mesh, from a generator of our own, so that a seed means the same everywhere.

use super::{corners, doubled_normal};
use glam::DVec3;

/// SplitMix64 (Steele, Lea and Flood 2014, "Fast splittable pseudorandom number generators"): small, seedable, good enough
/// for placing samples.
#[derive(Clone, Debug)]
pub struct Splitmix(u64);

impl Splitmix {
    /// A generator for a seed.
    pub fn new(seed: u64) -> Self {
        Self(seed)
    }
    /// The next 64 bits.
    pub fn bits(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let z = (self.0 ^ (self.0 >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        let z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }
    /// A number in [0, 1), uniform over multiples of 2^-53.
    pub fn unit(&mut self) -> f64 {
        (self.bits() >> 11) as f64 * 2f64.powi(-53)
    }
    /// A point in the cube of half extent 1, uniform.
    pub fn point(&mut self) -> DVec3 {
        DVec3::new(self.unit(), self.unit(), self.unit()) * 2.0 - 1.0
    }
}

/// Samples of a surface: where, and on which triangle.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Samples {
    /// Positions.
    pub points: Vec<DVec3>,
    /// Triangle of every sample.
    pub triangles: Vec<u32>,
}

/// `count` samples, uniform by area: the surface's area is cut into `count` equal strata in the order of its triangles, one
/// sample falls at random into each, and is placed uniformly on its triangle. None when the area is 0.
pub fn by_area(vertices: &[DVec3], triangles: &[[u32; 3]], count: usize, seed: u64) -> Samples {
    let areas: Vec<f64> = triangles.iter().map(|&t| 0.5 * doubled_normal(corners(vertices, t)).length()).collect();
    let total: f64 = areas.iter().sum();
    if total <= 0.0 || !total.is_finite() {
        return Samples::default();
    }
    let mut random = Splitmix::new(seed);
    let mut samples = Samples { points: Vec::with_capacity(count), triangles: Vec::with_capacity(count) };
    let last = areas.iter().rposition(|&a| a > 0.0).unwrap_or(0);
    let (mut triangle, mut passed) = (0, areas[0]);
    for i in 0..count {
        let target = (i as f64 + random.unit()) / count as f64 * total;
        while passed <= target && triangle < last {
            triangle += 1;
            passed += areas[triangle];
        }
        // uniform on a triangle: Osada et al. 2002, "Shape distributions", section 4.2
        let (r, s) = (random.unit().sqrt(), random.unit());
        let [a, b, c] = corners(vertices, triangles[triangle]);
        samples.points.push((1.0 - r) * a + r * (1.0 - s) * b + r * s * c);
        samples.triangles.push(triangle as u32);
    }
    samples
}

#[cfg(test)]
mod tests {
    use super::super::fixtures::*;
    use super::*;

    #[test]
    fn samples_fall_in_proportion_to_area() {
        // two squares of four triangles, one of three times the side
        let square = |x: f64, s: f64| {
            [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)].map(|(u, v)| DVec3::new(x + s * u, s * v, 0.0))
        };
        let vertices: Vec<DVec3> = square(0.0, 1.0).into_iter().chain(square(5.0, 3.0)).collect();
        let triangles = [[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]];
        let samples = by_area(&vertices, &triangles, 10_000, 5);
        let small = samples.triangles.iter().filter(|&&t| t < 2).count();
        assert!((small as i64 - 1000).abs() <= 1, "{small}");
        for (p, &t) in samples.points.iter().zip(&samples.triangles) {
            assert!(if t < 2 { p.x <= 1.0 } else { p.x >= 5.0 });
        }
        let mean = samples.points[small..].iter().sum::<DVec3>() / 9000.0;
        assert!((mean - DVec3::new(6.5, 1.5, 0.0)).length() < 0.02, "{mean}");
    }

    #[test]
    fn samples_of_a_sphere_average_to_its_center() {
        let (vertices, triangles) = sphere_mesh(60, 30, 1.0, DVec3::ONE);
        let samples = by_area(&vertices, &triangles, 20_000, 1);
        let mean = samples.points.iter().sum::<DVec3>() / 20_000.0;
        assert!((mean - DVec3::ONE).length() < 0.01, "{mean}");
    }

    #[test]
    fn nothing_is_sampled_on_no_area() {
        assert!(by_area(&[DVec3::ZERO; 3], &[[0, 1, 2]], 10, 0).points.is_empty());
        assert!(by_area(&[], &[], 10, 0).points.is_empty());
    }
}
