//! The triangles around one vertex of the map: their energy and the Newton step that lowers it.

use super::super::energy::{Objective, Reference, planar_newton_step, tangents};
use glam::{DVec2, DVec3};

/// A positive triangle's determinant over its reference's is at least this.
pub const POSITIVE: f64 = 1e-14;

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

/// A step that lowers the energy of a star.
#[derive(Clone, Copy, Debug)]
pub struct Relaxed {
    /// Where the vertex goes.
    pub to: DVec3,
    /// Energy before; infinite where a triangle was not positive.
    pub before: f64,
    /// Energy after.
    pub after: f64,
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

    /// One Riemannian Newton step from `x` with backtracking. `None` when no step lowers the energy.
    pub fn relax(&self, x: DVec3, objective: &Objective) -> Option<Relaxed> {
        let (e1, e2) = tangents(x);
        let (mut gradient, mut inward, mut before, mut longest) = (DVec2::ZERO, 0.0, 0.0, 0.0f64);
        // the Hessian in the tangent plane: a multiple of the identity, and three entries
        let (mut diagonal, mut a, mut b, mut c) = (0.0, 0.0, 0.0, 0.0);
        for t in &self.wedges {
            let d = x.dot(t.normal);
            let (to_b, to_c) = (x - t.b, x - t.c);
            let (squared_b, squared_c) = (to_b.length_squared(), to_c.length_squared());
            let k = objective.derivatives(t.to_b * squared_b + t.to_c * squared_c + t.fixed, d);
            before += if d.is_nan() || d <= POSITIVE { f64::INFINITY } else { t.area * k.value };
            let slope = 2.0 * (t.to_b * to_b + t.to_c * to_c);
            let flat_slope = DVec2::new(e1.dot(slope), e2.dot(slope));
            let flat_normal = DVec2::new(e1.dot(t.normal), e2.dot(t.normal));
            gradient += t.area * (k.by_t * flat_slope + k.by_d * flat_normal);
            inward += t.area * (k.by_t * slope.dot(x) + k.by_d * d);
            diagonal += t.area * k.by_t * 2.0 * (t.to_b + t.to_c);
            // slope m^T + m slope^T + m m^T in two outer products
            let mixed = t.area * (k.by_td * flat_slope + 0.5 * k.by_dd * flat_normal);
            a += 2.0 * mixed.x * flat_normal.x;
            b += mixed.x * flat_normal.y + mixed.y * flat_normal.x;
            c += 2.0 * mixed.y * flat_normal.y;
            longest = longest.max(squared_b);
        }
        let shift = diagonal - inward;
        let planar = planar_newton_step(gradient, a + shift, b, c + shift);
        let mut step = planar.x * e1 + planar.y * e2;
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
                return Some(Relaxed { to, before, after });
            }
            fraction *= 0.4;
        }
        None
    }
}
