//! The distortion energy of one triangle against a reference triangle, and the two-dimensional Newton step both the sphere
//! map and the untangling take.

use glam::{DMat2, DMat3, DVec2, DVec3};

/// A reference triangle: its area and the cotangents at its three corners, which give the Dirichlet energy of a map from
/// it (Pinkall and Polthier 1993).
#[derive(Clone, Copy, Debug)]
pub struct Reference {
    /// Area.
    pub area: f64,
    /// Cotangent at each corner.
    pub cotangents: [f64; 3],
}

impl Reference {
    /// From three corners scaled by `scale`; `softening` pulls slivers towards equilateral, relative to the mean squared
    /// edge.
    pub fn new(corners: [DVec3; 3], scale: f64, softening: f64) -> Self {
        let [a, b, c] = corners;
        let mut l = [(b - c), (c - a), (a - b)].map(|e| e.length_squared() * scale * scale);
        let mean = (l[0] + l[1] + l[2]) / 3.0;
        for e in &mut l {
            *e += softening * mean + 1e-14;
        }
        // Heron's formula on squared edges
        let heron = 2.0 * (l[0] * l[1] + l[1] * l[2] + l[2] * l[0]) - l[0] * l[0] - l[1] * l[1] - l[2] * l[2];
        let area = 0.25 * heron.max(1e-30).sqrt();
        let cotangent = |opposite: f64, p: f64, q: f64| (p + q - opposite) / (4.0 * area);
        Self {
            area,
            cotangents: [cotangent(l[0], l[1], l[2]), cotangent(l[1], l[2], l[0]), cotangent(l[2], l[0], l[1])],
        }
    }

    /// The same triangle seen from another of its corners.
    pub fn turned(&self, corner: usize) -> Self {
        let k = self.cotangents;
        Self { area: self.area, cotangents: [0, 1, 2].map(|i| k[(corner + i) % 3]) }
    }

    /// The equilateral triangle of this edge length.
    pub fn equilateral(edge: f64) -> Self {
        Self { area: 3f64.sqrt() / 4.0 * edge * edge, cotangents: [1.0 / 3f64.sqrt(); 3] }
    }

    /// Dirichlet energy per area: squared Frobenius norm of the Jacobian of the map that takes the reference to `x, b, c`.
    pub fn dirichlet(&self, x: DVec3, b: DVec3, c: DVec3) -> f64 {
        let [cx, cb, cc] = self.cotangents;
        (cc * x.distance_squared(b) + cb * x.distance_squared(c) + cx * b.distance_squared(c)) / (2.0 * self.area)
    }
    /// Gradient of [`Reference::dirichlet`] in `x`.
    pub fn dirichlet_gradient(&self, x: DVec3, b: DVec3, c: DVec3) -> DVec3 {
        let [_, cb, cc] = self.cotangents;
        (cc * (x - b) + cb * (x - c)) / self.area
    }
    /// The factor of the identity that is the Hessian of [`Reference::dirichlet`] in `x`.
    pub fn dirichlet_hessian(&self) -> f64 {
        (self.cotangents[1] + self.cotangents[2]) / self.area
    }
}

/// What a map is to keep, per area of a reference triangle, with T the Dirichlet energy per area and D the ratio of areas:
/// `isometry` T (1 + D^-2) / 4 + `area` (D^2 + 2/D) / 3 + `angle` T / (2 D). Each term is 1 for an isometry and infinite where
/// a triangle loses its area. The first is a quarter of the symmetric Dirichlet energy (Smith and Schaefer 2015,
/// "Bijective parameterization with free boundaries"), the last is MIPS (Hormann and Greiner 2000). The second is steeper
/// where a triangle gets too much than where it gets too little: what crowds in a limb's tip is missed everywhere else.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Objective {
    /// Weight of lengths.
    pub isometry: f64,
    /// Weight of areas.
    pub area: f64,
    /// Weight of angles.
    pub angle: f64,
}

/// An [`Objective`] and its derivatives by T and D; the second by T is zero.
#[derive(Clone, Copy, Debug)]
pub struct Derivatives {
    /// The value.
    pub value: f64,
    /// By T.
    pub by_t: f64,
    /// By D.
    pub by_d: f64,
    /// By T and D.
    pub by_td: f64,
    /// By D twice.
    pub by_dd: f64,
}

impl super::Distortion {
    /// The weights that stand for it. None is only one term: areas alone leave the angles open, and angles alone give a
    /// limb's tip less of the sphere than a lattice can sample.
    pub fn objective(self) -> Objective {
        match self {
            Self::Area => Objective { isometry: 0.5, area: 4.0, angle: 0.0 },
            Self::Angle => Objective { isometry: 0.1, area: 0.0, angle: 1.0 },
            Self::Isometric => Objective { isometry: 1.0, area: 1.3, angle: 0.5 },
        }
    }
    /// The weights that a chart is relaxed by: there is no lattice to come whose facets are to be good, so what is asked for
    /// counts alone.
    pub fn chart_objective(self) -> Objective {
        match self {
            Self::Isometric => Objective { isometry: 1.0, area: 1.0, angle: 0.0 },
            other => other.objective(),
        }
    }
}

impl Objective {
    /// Energy per area.
    pub fn value(&self, t: f64, d: f64) -> f64 {
        let inverse = 1.0 / d;
        0.25 * self.isometry * t * (1.0 + inverse * inverse)
            + self.area * (d * d + 2.0 * inverse) / 3.0
            + 0.5 * self.angle * t * inverse
    }
    /// Energy per area and its derivatives.
    pub fn derivatives(&self, t: f64, d: f64) -> Derivatives {
        let i1 = 1.0 / d;
        let (i2, i3) = (i1 * i1, i1 * i1 * i1);
        Derivatives {
            value: 0.25 * self.isometry * t * (1.0 + i2)
                + self.area * (d * d + 2.0 * i1) / 3.0
                + 0.5 * self.angle * t * i1,
            by_t: 0.25 * self.isometry * (1.0 + i2) + 0.5 * self.angle * i1,
            by_d: -0.5 * self.isometry * t * i3 + self.area * (d - i2) * (2.0 / 3.0) - 0.5 * self.angle * t * i2,
            by_td: -0.5 * self.isometry * i3 - 0.5 * self.angle * i2,
            by_dd: 1.5 * self.isometry * t * i2 * i2 + self.area * (2.0 + 4.0 * i3) / 3.0 + self.angle * t * i3,
        }
    }
    /// The value at an isometry: the sum of the weights.
    pub fn ideal(&self) -> f64 {
        self.isometry + self.area + self.angle
    }
}

/// Two unit vectors that complete `n` to a right-handed frame.
pub fn tangents(n: DVec3) -> (DVec3, DVec3) {
    let axis = if n.x.abs() < 0.6 { DVec3::X } else { DVec3::Y };
    let e1 = axis.cross(n).normalize_or(DVec3::X);
    (e1, n.cross(e1))
}

/// Newton direction in the plane of `e1, e2` with the Hessian's eigenvalues made positive; `shift` is added to the
/// Hessian's diagonal (the curvature of a sphere the point stays on).
pub fn newton_direction(gradient: DVec3, hessian: &DMat3, shift: f64, e1: DVec3, e2: DVec3) -> DVec3 {
    let (h1, h2) = (*hessian * e1, *hessian * e2);
    let g = DVec2::new(gradient.dot(e1), gradient.dot(e2));
    let step = planar_newton_step(g, e1.dot(h1) + shift, e1.dot(h2), e2.dot(h2) + shift);
    e1 * step.x + e2 * step.y
}

/// Newton step in a plane with the Hessian `[a b; b c]`, its eigenvalues made positive.
pub fn planar_newton_step(gradient: DVec2, a: f64, b: f64, c: f64) -> DVec2 {
    let inverse = inverse_positive(DMat2::from_cols(DVec2::new(a, b), DVec2::new(b, c)));
    -(inverse * gradient)
}

/// The inverse of a symmetric matrix with its eigenvalues made positive and none much smaller than the other.
pub fn inverse_positive(m: DMat2) -> DMat2 {
    /// Smallest eigenvalue kept, relative to the largest.
    const FLOOR: f64 = 1e-3;
    let (a, b, c) = (m.x_axis.x, m.x_axis.y, m.y_axis.y);
    let (mean, radius) = (0.5 * (a + c), (0.25 * (a - c) * (a - c) + b * b).sqrt());
    let (large, small) = (mean + radius, mean - radius);
    let floor = FLOOR * large.abs().max(small.abs()) + 1e-300;
    let axis = larger_axis(a, b, c, large);
    let across = axis.perp();
    let (l, s) = (1.0 / large.abs().max(floor), 1.0 / small.abs().max(floor));
    DMat2::from_cols(l * axis * axis.x + s * across * across.x, l * axis * axis.y + s * across * across.y)
}

/// Unit eigenvector of the symmetric matrix `[a b; b c]` for its larger eigenvalue.
pub fn larger_axis(a: f64, b: f64, c: f64, large: f64) -> DVec2 {
    if b.abs() > 1e-300 {
        DVec2::new(large - c, b).normalize_or(DVec2::X)
    } else if a >= c {
        DVec2::X
    } else {
        DVec2::Y
    }
}

/// Adds `weight * u v^T` to `m`.
pub fn add_outer(m: &mut DMat3, u: DVec3, v: DVec3, weight: f64) {
    *m += DMat3::from_cols(u * v.x, u * v.y, u * v.z) * weight;
}
