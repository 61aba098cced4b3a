//! The triangles around one vertex of the map: their energy and the Newton step that lowers it.

use super::super::energy::{Objective, Reference, add_outer, newton_direction, tangents};
use glam::{DMat3, DVec3};

/// A positive triangle's determinant over its reference's is at least this.
const POSITIVE: f64 = 1e-14;

/// One triangle of a star: what its energy as a function of the vertex needs.
#[derive(Clone, Copy)]
struct Wedge {
    b: DVec3,
    c: DVec3,
    /// D = x . normal.
    normal: DVec3,
    area: f64,
    /// T = to_b |x - b|^2 + to_c |x - c|^2 + fixed.
    to_b: f64,
    to_c: f64,
    fixed: f64,
}

impl Wedge {
    fn dirichlet(&self, x: DVec3) -> f64 {
        self.to_b * x.distance_squared(self.b) + self.to_c * x.distance_squared(self.c) + self.fixed
    }
}

/// The star of a vertex, reused from vertex to vertex.
#[derive(Default)]
pub struct Star {
    wedges: Vec<Wedge>,
}

impl Star {
    /// Forgets the triangles.
    pub fn clear(&mut self) {
        self.wedges.clear();
    }

    /// Adds a triangle by its other two corners on the sphere, counter-clockwise, and its reference seen from the vertex.
    pub fn push(&mut self, b: DVec3, c: DVec3, reference: &Reference) {
        let half = 0.5 / reference.area;
        let [cx, cb, cc] = reference.cotangents;
        self.wedges.push(Wedge {
            b,
            c,
            normal: half * b.cross(c),
            area: reference.area,
            to_b: half * cc,
            to_c: half * cb,
            fixed: half * cx * b.distance_squared(c),
        });
    }

    /// Sum of the references' areas.
    pub fn area(&self) -> f64 {
        self.wedges.iter().map(|t| t.area).sum()
    }

    /// Energy with the vertex at `x`; infinite where a triangle is not positive.
    pub fn energy(&self, x: DVec3, objective: &Objective) -> f64 {
        let mut sum = 0.0;
        for t in &self.wedges {
            let d = x.dot(t.normal);
            if d.is_nan() || d <= POSITIVE {
                return f64::INFINITY;
            }
            sum += t.area * objective.value(t.dirichlet(x), d);
        }
        sum
    }

    /// One Riemannian Newton step from `x` with backtracking: the new place and by how much the energy fell. `None` when
    /// no step lowers it.
    pub fn relax(&self, x: DVec3, objective: &Objective) -> Option<(DVec3, f64)> {
        let (mut gradient, mut hessian, mut diagonal, mut before) = (DVec3::ZERO, DMat3::ZERO, 0.0, 0.0);
        let mut longest = 0.0f64;
        for t in &self.wedges {
            let d = x.dot(t.normal);
            let dirichlet = t.dirichlet(x);
            let slope = 2.0 * (t.to_b * (x - t.b) + t.to_c * (x - t.c));
            let k = objective.derivatives(dirichlet, d);
            before += if d.is_nan() || d <= POSITIVE { f64::INFINITY } else { t.area * k.value };
            gradient += t.area * (k.by_t * slope + k.by_d * t.normal);
            diagonal += t.area * k.by_t * 2.0 * (t.to_b + t.to_c);
            // slope m^T + m slope^T + m m^T in two outer products
            let mixed = t.area * (k.by_td * slope + 0.5 * k.by_dd * t.normal);
            add_outer(&mut hessian, mixed, t.normal, 1.0);
            add_outer(&mut hessian, t.normal, mixed, 1.0);
            longest = longest.max(x.distance_squared(t.b));
        }
        let (e1, e2) = tangents(x);
        let mut step = newton_direction(gradient, &hessian, diagonal - gradient.dot(x), e1, e2);
        let length = step.length();
        if length.is_nan() || length <= 1e-15 {
            return None;
        }
        let reach = 0.7 * longest.sqrt();
        if length > reach {
            step *= reach / length;
        }
        let mut fraction = 1.0;
        for _ in 0..8 {
            let to = (x + fraction * step).normalize_or_zero();
            let after = self.energy(to, objective);
            if after < before {
                return Some((to, before - after));
            }
            fraction *= 0.4;
        }
        None
    }
}
