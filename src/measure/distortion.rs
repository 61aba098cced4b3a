//! Distortion of the parameterization: singular values per triangle of sphere -> surface and of chart -> surface.

use super::certificate::positions;
use super::report::{Distortion, Distortions};
use crate::shrink::lattice::LatticeSpec;
use crate::surface::Surface;
use glam::{DVec2, DVec3};

/// Distortion of a surface against the unit sphere (flat triangles of directions) and against its chart. The chart of a
/// lat-long lattice is taken as the 2 : 1 rectangle (theta, phi) that its UV square is a picture of, that of an octahedral
/// one as the square.
pub fn distortions(surface: &Surface) -> Distortions {
    let vertices = positions(surface);
    let triangle = |t: &[u32; 3]| t.map(|v| vertices[v as usize]);
    let aspect = match surface.lattice.spec {
        LatticeSpec::Latlong { .. } => 2.0,
        LatticeSpec::Octahedral { .. } => 1.0,
    };
    let sphere =
        surface.triangles.iter().map(|t| (flatten(t.map(|v| surface.lattice.directions[v as usize])), triangle(t)));
    let chart = |uv: &[[f64; 2]]| {
        // welded and chart triangles are in the same order; v points down, so it is turned up
        distortion(surface.chart_triangles.iter().zip(&surface.triangles).map(|(c, t)| {
            let place = c.map(|v| {
                let [u, v] = uv[v as usize];
                DVec2::new(aspect * u, -v)
            });
            (place, triangle(t))
        }))
    };
    Distortions {
        sphere: distortion(sphere),
        uv: chart(surface.uv()),
        uv_before: surface.relaxed_uv.as_ref().map(|_| chart(&surface.lattice.uv)),
    }
}

/// Distortion of a piecewise linear map given by its triangles, in the domain's plane and in space. The domain is scaled
/// so that both areas are the same; means are weighted by area on the surface. With s1 >= s2 the singular values:
/// `qc` is the mean of s1 / s2, `symmetric_dirichlet` that of s1^2 + s2^2 + s1^-2 + s2^-2 (Smith and Schaefer 2015),
/// `l2_stretch` the root of that of (s1^2 + s2^2) / 2 (Sander et al. 2001), `log_area_rms` the root of that of
/// log(s1 s2)^2; the percentiles and extremes of the area ratio are over triangles. A triangle without area on either side
/// has no singular values and is left out of the means (its area ratio still counts).
pub fn distortion(triangles: impl Iterator<Item = ([DVec2; 3], [DVec3; 3])>) -> Distortion {
    let pairs: Vec<([DVec2; 3], [DVec2; 3])> = triangles.map(|(from, to)| (from, flatten(to))).collect();
    let area = |[a, b, c]: [DVec2; 3]| 0.5 * (b - a).perp_dot(c - a).abs();
    let from_total: f64 = pairs.iter().map(|p| area(p.0)).sum();
    let to_total: f64 = pairs.iter().map(|p| area(p.1)).sum();
    if from_total <= 0.0 || to_total <= 0.0 {
        return Distortion::default();
    }
    let scale = (to_total / from_total).sqrt();
    let mut sums = [0.0; 5];
    let mut ratios = Vec::with_capacity(pairs.len());
    for (from, to) in pairs {
        let (domain_area, surface_area) = (area(from) * scale * scale, area(to));
        if domain_area > 0.0 {
            ratios.push(surface_area / domain_area);
        }
        let Some([s1, s2]) = singular_values(from.map(|p| scale * p), to) else { continue };
        let (a, b) = (s1 * s1, s2 * s2);
        let log_area = (s1 * s2).ln();
        let terms = [1.0, s1 / s2, log_area * log_area, a + b + 1.0 / a + 1.0 / b, 0.5 * (a + b)];
        for (sum, term) in sums.iter_mut().zip(terms) {
            *sum += surface_area * term;
        }
    }
    ratios.sort_unstable_by(f64::total_cmp);
    let percentile = |share: f64| ratios[((ratios.len() - 1) as f64 * share).round() as usize];
    let [weight, qc, log_area, symmetric, stretch] = sums;
    Distortion {
        qc: qc / weight,
        log_area_rms: (log_area / weight).sqrt(),
        area_min: percentile(0.0),
        area_max: percentile(1.0),
        area_p1: percentile(0.01),
        area_p99: percentile(0.99),
        symmetric_dirichlet: symmetric / weight,
        l2_stretch: (stretch / weight).sqrt(),
    }
}

/// A triangle in its own plane: the first corner at the origin, the first edge along x, counter-clockwise.
pub(super) fn flatten([a, b, c]: [DVec3; 3]) -> [DVec2; 3] {
    let (ab, ac) = (b - a, c - a);
    let x = ab.normalize_or(DVec3::X);
    let along = ac.dot(x);
    [DVec2::ZERO, DVec2::new(ab.length(), 0.0), DVec2::new(along, (ac - along * x).length())]
}

/// Singular values, larger first, of the linear map between two triangles; `None` when either has no area.
fn singular_values(from: [DVec2; 3], to: [DVec2; 3]) -> Option<[f64; 2]> {
    let (f1, f2) = (from[1] - from[0], from[2] - from[0]);
    let (t1, t2) = (to[1] - to[0], to[2] - to[0]);
    let det = f1.perp_dot(f2);
    if det == 0.0 || t1.perp_dot(t2) == 0.0 {
        return None;
    }
    // J = [t1 t2] [f1 f2]^-1
    let (a, c) = ((t1.x * f2.y - t2.x * f1.y) / det, (t1.y * f2.y - t2.y * f1.y) / det);
    let (b, d) = ((t2.x * f1.x - t1.x * f2.x) / det, (t2.y * f1.x - t1.y * f2.x) / det);
    // J is half a sum of a similarity and an anti-similarity, of scales p and q
    let (p, q) = ((a + d).hypot(c - b), (a - d).hypot(b + c));
    let largest = 0.5 * (p + q);
    // the product is the determinant: no cancellation on slivers
    let smallest = (t1.perp_dot(t2) / det).abs() / largest;
    (smallest > 0.0 && largest.is_finite()).then_some([largest, smallest])
}

#[cfg(test)]
mod tests {
    use super::super::fixtures::*;
    use super::*;
    use std::f64::consts::PI;

    const LATLONG: LatticeSpec = LatticeSpec::Latlong { n_theta: 200, n_phi: 100 };

    #[test]
    fn a_sphere_of_any_size_is_the_ideal() {
        for spec in [LATLONG, LatticeSpec::Octahedral { n: 20 }] {
            let d = distortions(&sphere_surface(spec, 0.3)).sphere;
            for (found, ideal) in [
                (d.qc, 1.0),
                (d.symmetric_dirichlet, 4.0),
                (d.l2_stretch, 1.0),
                (d.area_min, 1.0),
                (d.area_max, 1.0),
                (d.log_area_rms, 0.0),
            ] {
                assert!((found - ideal).abs() < 1e-3, "{spec:?} {d:?}");
            }
        }
    }

    #[test]
    fn a_sphere_in_the_two_to_one_rectangle_has_qc_of_half_pi() {
        // the singular values of the lat-long chart are in the ratio 1 / sin(phi); its mean over the sphere is pi / 2
        let d = distortions(&sphere_surface(LATLONG, 1.0)).uv;
        assert!((d.qc - PI / 2.0).abs() < 0.02, "{d:?}");
        // area on the sphere per area of the chart is (pi / 2) sin(phi), of which the polar sectors leave out 1 / n_phi
        let covered = 0.99 * PI / 2.0;
        assert!((d.area_max - covered).abs() < 1e-3, "{d:?}");
        assert!((d.area_min - covered * (PI / 100.0).sin()).abs() < 1e-3, "{d:?}");
    }

    #[test]
    fn a_stretched_square_has_the_singular_values_of_its_stretch() {
        // (x, y) -> (4 x, y), areas matched: singular values 2 and 1/2
        let square = [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]].map(DVec2::from);
        let triangles = [[0, 1, 2], [0, 2, 3]]
            .map(|t| (t.map(|i: usize| square[i]), t.map(|i| DVec3::new(4.0 * square[i].x, 0.0, square[i].y))));
        let d = distortion(triangles.into_iter());
        assert!((d.qc - 4.0).abs() < 1e-12);
        assert!((d.symmetric_dirichlet - 8.5).abs() < 1e-12);
        assert!((d.l2_stretch - (4.25f64 / 2.0).sqrt()).abs() < 1e-12);
        assert!(d.log_area_rms < 1e-12 && (d.area_min - 1.0).abs() < 1e-12);
    }

    #[test]
    fn triangles_without_area_do_not_poison_the_means() {
        let flat = ([DVec2::ZERO, DVec2::X, DVec2::Y], [DVec3::ZERO, DVec3::X, DVec3::X]);
        let whole = ([DVec2::ZERO, DVec2::X, DVec2::Y], [DVec3::ZERO, DVec3::X, DVec3::Y]);
        let d = distortion([flat, whole].into_iter());
        assert!(d.qc.is_finite() && d.symmetric_dirichlet.is_finite() && d.log_area_rms.is_finite());
        assert_eq!(d.area_min, 0.0);
    }
}
