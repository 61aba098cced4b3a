//! The Hessian and gradient of a map's energy, and a direction of descent from them.

use super::super::energy::{Objective, Reference, inverse_positive, larger_axis};
use super::level::{CHUNK, Level, PARALLEL};
use crate::settings::{Canceled, Settings};
use glam::{DMat2, DVec2, DVec3, Mat2};
use rayon::prelude::*;

/// The Hessian at a map, in tangent coordinates: a 2 x 2 block per vertex and per edge, and the gradient.
pub struct System {
    /// Gradient at every vertex.
    pub gradients: Vec<DVec2>,
    /// Inverses of the diagonal blocks with their eigenvalues made positive.
    inverses: Vec<DMat2>,
    /// Blocks of every vertex against itself, rounded: products with them are bound by memory, and a direction of descent
    /// needs few digits.
    diagonal: Vec<Mat2>,
    /// Blocks of every vertex against its ring, in the ring's order. That of `v` against `u` is rounded as that of `u`
    /// against `v` is, so the matrix stays symmetric.
    edges: Vec<Mat2>,
}

impl System {
    /// Gathers what the triangles have.
    pub fn new(level: &Level, triangles: &[Triangle], settings: &Settings<'_>) -> Self {
        // every triangle that a vertex is at, turned to start there
        let around = |v: usize| {
            level.places[level.range(v)]
                .iter()
                .map(|place| (&triangles[place.triangle as usize], place.corner as usize))
        };
        let nodes = level.map_rows(settings, |v, out: &mut Vec<Node>| {
            let (mut gradient, mut diagonal, mut inward) = (DVec2::ZERO, DMat2::ZERO, 0.0);
            for (t, corner) in around(v) {
                gradient += t.gradient[corner];
                inward += t.inward[corner];
                diagonal += t.own[corner];
            }
            // the sphere's own curvature, where it does not bend the energy downwards
            diagonal += DMat2::from_diagonal(DVec2::splat(f64::max(inward, 0.0)));
            let inverse = inverse_positive(diagonal);
            out.push(Node { gradient, inverse, diagonal: diagonal.as_mat2() });
        });
        let edges = level.map_rows(settings, |v, out: &mut Vec<Mat2>| {
            // the edge to a ring's entry has a triangle on either side: the one from there on, and the one before
            let mut last = around(v).next_back().map_or(DMat2::ZERO, |(t, corner)| t.before(corner));
            for (t, corner) in around(v) {
                out.push((last + t.after(corner)).as_mat2());
                last = t.before(corner);
            }
        });
        let mut system = Self {
            gradients: Vec::with_capacity(nodes.len()),
            inverses: Vec::with_capacity(nodes.len()),
            diagonal: Vec::with_capacity(nodes.len()),
            edges,
        };
        for node in nodes {
            system.gradients.push(node.gradient);
            system.inverses.push(node.inverse);
            system.diagonal.push(node.diagonal);
        }
        system
    }

    /// Hessian times `p`; returns the product of both.
    fn product(&self, level: &Level, p: &[DVec2], out: &mut [DVec2], settings: &Settings<'_>) -> f64 {
        let piece = |(k, out): (usize, &mut [DVec2])| {
            let mut curvature = 0.0;
            for (i, y) in out.iter_mut().enumerate() {
                let v = k * CHUNK + i;
                let range = level.range(v);
                let mut sum = times(&self.diagonal[v], p[v]);
                for (m, &u) in self.edges[range.clone()].iter().zip(&level.ring[range]) {
                    sum += times(m, p[u as usize]);
                }
                *y = sum;
                curvature += p[v].dot(sum);
            }
            curvature
        };
        if level.len() < PARALLEL {
            return out.chunks_mut(CHUNK).enumerate().map(piece).sum();
        }
        let pieces: Vec<f64> = settings.pool.install(|| out.par_chunks_mut(CHUNK).enumerate().map(piece).collect());
        pieces.into_iter().sum()
    }

    /// A direction of descent and the products it took, but for that of `start`: conjugate gradients with the diagonal blocks
    /// as preconditioner, from `start` where there is one, stopped early: where the residual is small enough for the gradient
    /// that is left, or where the Hessian curves downwards.
    pub fn solve(
        &self,
        level: &Level,
        products: usize,
        start: Option<Vec<DVec2>>,
        settings: &Settings<'_>,
    ) -> Result<(Vec<DVec2>, usize), Canceled> {
        /// The residual's share at which a solution is good enough far from the minimum.
        const FORCING: f64 = 0.1;
        let n = level.len();
        let fresh = start.is_none();
        let mut x = start.unwrap_or_else(|| vec![DVec2::ZERO; n]);
        let mut q = vec![DVec2::ZERO; n];
        if !fresh {
            self.product(level, &x, &mut q, settings);
        }
        let mut r: Vec<DVec2> = self.gradients.iter().zip(&q).map(|(g, q)| -*g - *q).collect();
        let mut z: Vec<DVec2> = r.iter().zip(&self.inverses).map(|(r, m)| *m * *r).collect();
        let mut p = z.clone();
        let mut rz: f64 = (0..n).map(|v| r[v].dot(z[v])).sum();
        let whole: f64 = self.gradients.iter().zip(&self.inverses).map(|(g, m)| g.dot(*m * *g)).sum();
        for k in 0..products {
            settings.cancel.check()?;
            let curvature = self.product(level, &p, &mut q, settings);
            if curvature.is_nan() || curvature <= 0.0 {
                return Ok((if k == 0 && fresh { p } else { x }, k + 1));
            }
            let alpha = rz / curvature;
            // too little work to wake threads for
            let mut next = 0.0;
            for v in 0..n {
                x[v] += alpha * p[v];
                r[v] -= alpha * q[v];
                z[v] = self.inverses[v] * r[v];
                next += r[v].dot(z[v]);
            }
            if next <= FORCING * FORCING * whole {
                return Ok((x, k + 1));
            }
            let beta = next / rz;
            rz = next;
            for v in 0..n {
                p[v] = z[v] + beta * p[v];
            }
        }
        Ok((x, products))
    }
}

/// One vertex's share of a [`System`].
struct Node {
    gradient: DVec2,
    inverse: DMat2,
    diagonal: Mat2,
}

/// A rounded block times a vector.
fn times(m: &Mat2, v: DVec2) -> DVec2 {
    let [a, b, c, d] = m.to_cols_array().map(f64::from);
    DVec2::new(a * v.x + c * v.y, b * v.x + d * v.y)
}

/// u v^T.
fn outer(u: DVec2, v: DVec2) -> DMat2 {
    DMat2::from_cols(u * v.x, u * v.y)
}

/// One triangle's exact gradient, and its Hessian made positive, in its corners' tangent coordinates.
pub struct Triangle {
    gradient: [DVec2; 3],
    /// Minus the gradient's part along the corner's direction.
    inward: [f64; 3],
    /// The Hessian's blocks of every corner with itself,
    own: [DMat2; 3],
    /// and with the next one.
    next: [DMat2; 3],
}

impl Triangle {
    /// Of a triangle with these corners, whose tangent planes have these `frames`.
    pub fn new(
        corners: [usize; 3],
        places: &[DVec3],
        frames: &[[DVec3; 2]],
        reference: &Reference,
        objective: &Objective,
    ) -> Self {
        let p = corners.map(|v| places[v]);
        let frame = corners.map(|v| frames[v]);
        let [cx, cb, cc] = reference.cotangents;
        let (area, half) = (reference.area, 0.5 / reference.area);
        let by_place_d = [half * p[1].cross(p[2]), half * p[2].cross(p[0]), half * p[0].cross(p[1])];
        let edge = |i: usize, j: usize, cot: f64| 2.0 * half * cot * (p[i] - p[j]);
        let by_place_t =
            [edge(0, 1, cc) + edge(0, 2, cb), edge(1, 0, cc) + edge(1, 2, cx), edge(2, 0, cb) + edge(2, 1, cx)];
        let t = reference.dirichlet(p[0], p[1], p[2]);
        let k = objective.derivatives(t, p[0].dot(by_place_d[0]));
        let (mut gradient, mut inward) = ([DVec2::ZERO; 3], [0.0; 3]);
        for i in 0..3 {
            let g = area * (k.by_t * by_place_t[i] + k.by_d * by_place_d[i]);
            gradient[i] = DVec2::new(frame[i][0].dot(g), frame[i][1].dot(g));
            inward[i] = -g.dot(p[i]);
        }

        // the reference in its own plane: x at the origin, b along the first axis
        let base = (2.0 * area * (cx + cb)).sqrt();
        let apex = DVec2::new(2.0 * area * cx / base, 2.0 * area / base);
        // gradients of the three hat functions there
        let hat_b = DVec2::new(1.0, -apex.x / apex.y) / base;
        let hat_c = DVec2::new(0.0, 1.0 / apex.y);
        let hats = [-hat_b - hat_c, hat_b, hat_c];
        // the triangle in its plane
        let (ab, ac) = (p[1] - p[0], p[2] - p[0]);
        let u1 = ab.normalize_or(frame[0][0]);
        let across = ac - u1 * ac.dot(u1);
        let u2 = across.normalize_or(frame[0][1]);
        let (b, c) = (DVec2::new(ab.length(), 0.0), DVec2::new(ac.dot(u1), across.length()));
        let jacobian = outer(b, hat_b) + outer(c, hat_c);
        // hat functions' gradients in the corners' tangent planes: a mode m of the Jacobian moves corner i by planes[i] m hats[i]
        let planes = [0, 1, 2].map(|i| {
            DMat2::from_cols(
                DVec2::new(frame[i][0].dot(u1), frame[i][1].dot(u1)),
                DVec2::new(frame[i][0].dot(u2), frame[i][1].dot(u2)),
            )
        });
        let (mut own, mut next) = ([DMat2::ZERO; 3], [DMat2::ZERO; 3]);
        for mode in positive_modes(jacobian, area, objective) {
            let moves = [0, 1, 2].map(|i| planes[i] * (mode * hats[i]));
            for i in 0..3 {
                own[i] += outer(moves[i], moves[i]);
                next[i] += outer(moves[i], moves[(i + 1) % 3]);
            }
        }
        Self { gradient, inward, own, next }
    }

    /// Makes the Hessian stiffer by a factor.
    pub fn stiffen(&mut self, factor: f64) {
        for block in self.own.iter_mut().chain(&mut self.next) {
            *block *= factor;
        }
    }

    /// The block of a corner with the next one.
    fn after(&self, corner: usize) -> DMat2 {
        self.next[corner]
    }
    /// The block of a corner with the one before.
    fn before(&self, corner: usize) -> DMat2 {
        self.next[(corner + 2) % 3].transpose()
    }
}

/// The Hessian of the energy as a function of a planar Jacobian, times `area`, its negative eigenvalues left out: four
/// matrices whose squares sum to it (Smith, de Goes and Kim 2019, "Analytic eigensystems for isotropic distortion
/// energies", in the plane).
pub fn positive_modes(jacobian: DMat2, area: f64, objective: &Objective) -> [DMat2; 4] {
    /// No direction is taken for flatter than this share of the Dirichlet term's own curvature.
    const FLAT: f64 = 0.02;
    let [[a, c], [b, d]] = jacobian.to_cols_array_2d();
    // a similarity of scale q and an anti-similarity of scale r
    let similar = DVec2::new(a + d, c - b) * 0.5;
    let mirror = DVec2::new(a - d, b + c) * 0.5;
    let (q, r) = (similar.length(), mirror.length());
    let (s1, s2) = (q + r, (q - r).max(1e-9 * q));
    let k = objective.derivatives(s1 * s1 + s2 * s2, s1 * s2);
    let (e, f) = (similar.normalize_or(DVec2::X), mirror.normalize_or(DVec2::X));
    let root = 0.5f64.sqrt();
    let conformal = |v: DVec2| DMat2::from_cols(DVec2::new(v.x, v.y), DVec2::new(-v.y, v.x)) * root;
    let anticonformal = |v: DVec2| DMat2::from_cols(DVec2::new(v.x, v.y), DVec2::new(v.y, -v.x)) * root;
    let twist = 2.0 * k.by_t + k.by_d;
    let flip = 2.0 * k.by_t - k.by_d;
    let (by_11, by_22) = (
        2.0 * k.by_t + 4.0 * s1 * s2 * k.by_td + s2 * s2 * k.by_dd,
        2.0 * k.by_t + 4.0 * s1 * s2 * k.by_td + s1 * s1 * k.by_dd,
    );
    let by_12 = k.by_d + 2.0 * (s1 * s1 + s2 * s2) * k.by_td + s1 * s2 * k.by_dd;
    // in the basis of s1 + s2 and s1 - s2
    let (plus, minus, mixed) = (0.5 * (by_11 + by_22) + by_12, 0.5 * (by_11 + by_22) - by_12, 0.5 * (by_11 - by_22));
    let (mean, radius) = (0.5 * (plus + minus), (0.25 * (plus - minus) * (plus - minus) + mixed * mixed).sqrt());
    let axis = larger_axis(plus, mixed, minus, mean + radius);
    let scaling = |v: DVec2| v.x * conformal(e) + v.y * anticonformal(f);
    let floor = FLAT * k.by_t;
    let square = |value: f64| (area * value.max(floor)).sqrt();
    [
        square(twist) * conformal(e.perp()),
        square(flip) * anticonformal(f.perp()),
        square(mean + radius) * scaling(axis),
        square(mean - radius) * scaling(axis.perp()),
    ]
}
