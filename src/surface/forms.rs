//! First and second fundamental forms on the lattice.
//!
//! With x(a, b) the surface over its grid coordinates and n the field's unit normal: E = x_a . x_a, F = x_a . x_b,
//! G = x_b . x_b, and L = -n_a . x_a, M = -(n_a . x_b + n_b . x_a)/2, N = -n_b . x_b (do Carmo 1976, sections 2.5 and 3.3; equal to
//! L = n . x_aa and so on, but only first differences of the field's exact normals are taken). With n outward, a sphere of
//! radius r has (L, M, N) = -(E, F, G)/r.
//!
//! The coordinates are (theta, phi), radians, on the lat-long lattice, and (u, v) of the UV square on the octahedral one. Derivatives
//! are central differences of second order along the grid, continued across the glued border: the neighbour beyond it is the
//! one on the sphere, reached through the gluing. At the poles of the lat-long lattice theta is no coordinate: there the
//! row's derivatives by theta vanish and so do E, F, L and M. On the folds of the octahedral chart (its diamond |a| + |b| = 1, its axes
//! and its border) the parameterization has a kink, and a difference across it is a mean of both sides.

use super::Surface;
use crate::shrink::lattice::{LatticeSpec, SphereLattice};
use glam::{DVec3, Vec3};
use std::f64::consts::PI;

/// The forms at every grid point, row by row (`rows x columns`; glued grid points hold equal places, not always equal forms).
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Forms {
    /// E, F, G.
    pub first: Vec<[f32; 3]>,
    /// L, M, N.
    pub second: Vec<[f32; 3]>,
}

/// Grid point beside (row, column), steps away, on the sphere: across the border through the gluing.
struct Walk<'a>(&'a SphereLattice);

impl Walk<'_> {
    /// Welded vertex at a grid point that may lie one step outside the grid on one axis.
    fn vertex(&self, row: i64, column: i64) -> u32 {
        let (rows, columns) = (self.0.rows as i64, self.0.columns as i64);
        let (row, column) = match self.0.spec {
            LatticeSpec::Latlong { .. } => {
                // over a pole to the meridian on the other side: half a turn. With an odd number of columns there is none,
                // and the one half a step before it stands in
                let turn = columns - 1;
                if row < 0 || row >= rows {
                    let mirrored = if row < 0 { -row } else { 2 * (rows - 1) - row };
                    (mirrored, (column + turn / 2).rem_euclid(turn))
                } else {
                    (row, column.rem_euclid(turn))
                }
            }
            // leaving over a side enters over the same side, turned by half a turn about its middle
            LatticeSpec::Octahedral { .. } => {
                let last = rows - 1;
                if row < 0 {
                    (-row, last - column)
                } else if row > last {
                    (2 * last - row, last - column)
                } else if column < 0 {
                    (last - row, -column)
                } else if column > last {
                    (last - row, 2 * last - column)
                } else {
                    (row, column)
                }
            }
        };
        self.0.grid[(row * columns + column) as usize]
    }
}

/// Both forms at every grid point of a surface.
pub fn forms(surface: &Surface) -> Forms {
    let lattice = &surface.lattice;
    let walk = Walk(lattice);
    let [da, db] = match lattice.spec {
        LatticeSpec::Latlong { n_theta, n_phi } => [2.0 * PI / f64::from(n_theta), PI / f64::from(n_phi)],
        LatticeSpec::Octahedral { n } => [0.5 / f64::from(n); 2],
    };
    let position = |v: u32| Vec3::from(surface.positions[v as usize]).as_dvec3();
    let normal = |v: u32| Vec3::from(surface.normals[v as usize]).as_dvec3().normalize_or_zero();
    let mut forms = Forms::default();
    for row in 0..lattice.rows as i64 {
        for column in 0..lattice.columns as i64 {
            let (west, east) = (walk.vertex(row, column - 1), walk.vertex(row, column + 1));
            let (north, south) = (walk.vertex(row - 1, column), walk.vertex(row + 1, column));
            let along =
                |f: &dyn Fn(u32) -> DVec3| ((f(east) - f(west)) / (2.0 * da), (f(south) - f(north)) / (2.0 * db));
            let (xa, xb) = along(&position);
            let (na, nb) = along(&normal);
            forms.first.push([xa.dot(xa), xa.dot(xb), xb.dot(xb)].map(|x| x as f32));
            forms.second.push([-na.dot(xa), -0.5 * (na.dot(xb) + nb.dot(xa)), -nb.dot(xb)].map(|x| x as f32));
        }
    }
    forms
}

/// Mean and Gaussian curvature of forms (E, F, G) and (L, M, N): H = (E N - 2 F M + G L) / (2 (E G - F^2)),
/// K = (L N - M^2)/(E G - F^2). `None` where the first form is singular. With outward normals a sphere has H < 0.
pub fn curvatures(first: [f32; 3], second: [f32; 3]) -> Option<[f64; 2]> {
    let ([e, f, g], [l, m, n]) = (first.map(f64::from), second.map(f64::from));
    let area = e * g - f * f;
    (area > 1e-12 * e.max(g).powi(2)).then(|| [(e * n - 2.0 * f * m + g * l) / (2.0 * area), (l * n - m * m) / area])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::measure::fixtures::{sphere_surface, surface_of};

    const LATLONG: LatticeSpec = LatticeSpec::Latlong { n_theta: 200, n_phi: 100 };

    #[test]
    fn a_lat_long_sphere_has_the_forms_of_the_textbook() {
        let r = 0.7;
        let found = forms(&sphere_surface(LATLONG, r));
        for row in 0..=100 {
            let phi = PI * f64::from(row) / 100.0;
            for column in [0, 1, 77, 199, 200] {
                let i = row as usize * 201 + column;
                // central differences of step h shorten a circle's derivative by sin(h)/h
                let expected = [r * r * phi.sin().powi(2), 0.0, r * r];
                for k in 0..3 {
                    let (first, second) = (f64::from(found.first[i][k]), f64::from(found.second[i][k]));
                    assert!((first - expected[k]).abs() < 5e-4, "{row} {column}: {:?} {expected:?}", found.first[i]);
                    assert!((second + expected[k] / r).abs() < 1e-3, "{row} {column}: {:?}", found.second[i]);
                }
            }
        }
    }

    #[test]
    fn the_octahedral_chart_keeps_the_spheres_area_and_curvature_everywhere() {
        // the map has equal areas: E G - F^2 = (4 pi)^2, away from the folds
        let n = 60;
        let found = forms(&sphere_surface(LatticeSpec::Octahedral { n }, 1.0));
        let side = 2 * n as usize + 1;
        for (i, (first, second)) in found.first.iter().zip(&found.second).enumerate() {
            let (a, b) = ((i % side) as i64 - i64::from(n), i64::from(n) - (i / side) as i64);
            let folds = [a, b, a.abs() + b.abs() - i64::from(n)];
            let border = a.abs() == i64::from(n) || b.abs() == i64::from(n);
            let corner = a.abs().min(b.abs()) + 6 > i64::from(n);
            // towards the centre and the corners the angle of the map turns within a step
            let center = a.abs() + b.abs() < 8 || a.abs() + b.abs() > 2 * i64::from(n) - 8;
            if folds.iter().any(|f| f.abs() <= 1) || corner || center {
                continue;
            }
            let [e, f, g] = first.map(f64::from);
            assert!((((e * g - f * f).sqrt()) / (4.0 * PI) - 1.0).abs() < 0.03, "{a} {b} {first:?} {border}");
            let [h, k] = curvatures(*first, *second).unwrap();
            assert!((h + 1.0).abs() < 0.01 && (k - 1.0).abs() < 0.02, "{a} {b} {h} {k}");
        }
    }

    #[test]
    fn an_ellipsoid_has_its_gaussian_curvature() {
        let (p, q, r) = (0.9, 0.6, 0.4);
        let scale = DVec3::new(p, q, r);
        let surface = surface_of(LATLONG, |d| (scale * d, d / scale));
        let found = forms(&surface);
        for row in 10..=90usize {
            for column in (0..200).step_by(7) {
                let x = Vec3::from(surface.positions[surface.lattice.grid[row * 201 + column] as usize]).as_dvec3();
                // K = 1 / (p q r (x^2/p^4 + y^2/q^4 + z^2/r^4))^2
                let w = (x * x / (scale * scale * scale * scale)).element_sum();
                let expected = 1.0 / (p * q * r * w).powi(2);
                let [h, k] = curvatures(found.first[row * 201 + column], found.second[row * 201 + column]).unwrap();
                assert!((k / expected - 1.0).abs() < 0.01, "{row} {column}: {k} {expected}");
                assert!(h < 0.0 && h * h >= k * 0.999);
            }
        }
    }
}
