//! The second-order finish: truncated Newton steps of the whole map at once, with conjugate gradients inside (Nocedal and
//! Wright 2006, "Numerical optimization", algorithm 7.1), on the product of unit spheres.
//!
//! Vertex sweeps take rough errors away and leave smooth ones; a Newton step sees the whole map and takes both. The energy
//! is infinite where a triangle is not positive, so the line search keeps the bijection.

use super::super::energy::{Objective, Reference, inverse_positive, larger_axis, tangents};
use super::level::{CHUNK, Level, PARALLEL};
use crate::settings::{Canceled, Settings};
use glam::{DMat2, DVec2, DVec3, Mat2};
use rayon::prelude::*;

/// When to stop a descent.
#[derive(Clone, Copy, Debug)]
pub struct Effort {
    /// Newton steps at most.
    pub steps: usize,
    /// Products with the Hessian in each, at most.
    pub products: usize,
    /// Share of the energy that may be left to gain.
    pub tolerance: f64,
}

/// How a descent went.
#[derive(Clone, Copy, Debug, Default)]
pub struct Descent {
    /// Newton steps taken.
    pub steps: usize,
    /// Products with the Hessian.
    pub products: usize,
    /// Energy at the end.
    pub energy: f64,
    /// Half the last step's slope over the energy: about the share of the energy that was still to be gained.
    pub decrement: f64,
}

/// The Hessian at a map, in tangent coordinates: a 2 x 2 block per vertex and per edge, and the gradient.
struct System {
    frames: Vec<[DVec3; 2]>,
    gradients: Vec<DVec2>,
    /// Inverses of the diagonal blocks with their eigenvalues made positive.
    inverses: Vec<DMat2>,
    /// Blocks of every vertex against itself, rounded: products with them are bound by memory, and a direction of descent
    /// needs few digits.
    diagonal: Vec<Mat2>,
    /// Blocks of every vertex against its ring, in the ring's order. That of `v` against `u` is rounded as that of `u`
    /// against `v` is, so the matrix stays symmetric.
    edges: Vec<Mat2>,
}

/// Takes Newton steps until the energy that is left to gain is small, each followed by a sweep of vertex steps. The energy
/// never rises.
pub fn descend(
    level: &Level,
    places: &mut Vec<DVec3>,
    objective: &Objective,
    effort: Effort,
    settings: &Settings<'_>,
) -> Result<Descent, Canceled> {
    let mut descent = Descent { energy: level.energy(places, objective, settings), ..Descent::default() };
    for _ in 0..effort.steps {
        settings.cancel.check()?;
        let system = System::new(level, places, objective, settings);
        let (direction, used) = system.solve(level, effort.products, settings)?;
        descent.products += used;
        let slope: f64 = level.sum(level.len(), settings, |v| system.gradients[v].dot(direction[v]));
        descent.decrement = -0.5 * slope / descent.energy;
        if slope.is_nan() || slope >= 0.0 || descent.decrement < effort.tolerance {
            break;
        }
        let Some((to, energy)) = search(level, places, &system, &direction, descent.energy, objective, settings) else {
            break;
        };
        *places = to;
        descent.energy = energy;
        descent.steps += 1;
        // a step may leave single triangles nearly flat, and only vertex steps see them
        descent.energy -= level.sweep(places, objective, settings)?;
    }
    Ok(descent)
}

/// Backtracking from the full step. Before the energy is asked, vertices of triangles that the step would all but flatten
/// take half of it, again and again: few triangles must not hold the whole map back.
fn search(
    level: &Level,
    places: &[DVec3],
    system: &System,
    direction: &[DVec2],
    energy: f64,
    objective: &Objective,
    settings: &Settings<'_>,
) -> Option<(Vec<DVec3>, f64)> {
    /// A triangle keeps at least this share of its determinant.
    const KEPT: f64 = 0.1;
    /// Rounds of local halving.
    const ROUNDS: usize = 8;
    let mut fractions = vec![1.0f64; level.len()];
    let step = |v: usize, fraction: f64| {
        let [e1, e2] = system.frames[v];
        (places[v] + fraction * (direction[v].x * e1 + direction[v].y * e2)).normalize_or_zero()
    };
    let determinant = |places: &[DVec3], t: usize| {
        let [a, b, c] = level.triangles[t].map(|v| places[v as usize]);
        a.dot(b.cross(c))
    };
    let count = level.triangles.len();
    let before = level.map(count, settings, |t| determinant(places, t));
    for _ in 0..10 {
        let mut to = level.map(level.len(), settings, |v| step(v, fractions[v]));
        for _ in 0..ROUNDS {
            let kept = level.map(count, settings, |t| determinant(&to, t) >= KEPT * before[t]);
            let flat = (0..count).filter(|&t| !kept[t]);
            let mut squeezed: Vec<u32> = flat.flat_map(|t| level.triangles[t]).collect();
            if squeezed.is_empty() {
                break;
            }
            squeezed.sort_unstable();
            squeezed.dedup();
            for v in squeezed {
                fractions[v as usize] *= 0.5;
                to[v as usize] = step(v as usize, fractions[v as usize]);
            }
        }
        let after = level.energy(&to, objective, settings);
        if after < energy {
            return Some((to, after));
        }
        fractions.iter_mut().for_each(|f| *f *= 0.5);
    }
    None
}

impl System {
    fn new(level: &Level, places: &[DVec3], objective: &Objective, settings: &Settings<'_>) -> Self {
        let frames: Vec<[DVec3; 2]> = level.map(level.len(), settings, |v| tangents(places[v]).into());
        let triangles = level.map(level.triangles.len(), settings, |t| {
            Triangle::new(level.triangles[t].map(|v| v as usize), places, &frames, &level.shapes[t], objective)
        });
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
            frames,
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

    /// Conjugate gradients with the diagonal blocks as preconditioner, stopped early: where the residual is small enough
    /// for the gradient that is left, or where the Hessian curves downwards.
    fn solve(&self, level: &Level, products: usize, settings: &Settings<'_>) -> Result<(Vec<DVec2>, usize), Canceled> {
        let n = level.len();
        let mut x = vec![DVec2::ZERO; n];
        let mut r: Vec<DVec2> = self.gradients.iter().map(|g| -*g).collect();
        let mut z: Vec<DVec2> = r.iter().zip(&self.inverses).map(|(r, m)| *m * *r).collect();
        let mut p = z.clone();
        let mut q = vec![DVec2::ZERO; n];
        let mut rz: f64 = (0..n).map(|v| r[v].dot(z[v])).sum();
        let start = rz;
        /// The residual's share at which a solution is good enough far from the minimum.
        const FORCING: f64 = 0.05;
        for k in 0..products {
            settings.cancel.check()?;
            let curvature = self.product(level, &p, &mut q, settings);
            if curvature.is_nan() || curvature <= 0.0 {
                return Ok((if k == 0 { p } else { x }, k + 1));
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
            if next <= FORCING * FORCING * start {
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
struct Triangle {
    gradient: [DVec2; 3],
    /// Minus the gradient's part along the corner's direction.
    inward: [f64; 3],
    /// The Hessian's blocks of every corner with itself,
    own: [DMat2; 3],
    /// and with the next one.
    next: [DMat2; 3],
}

impl Triangle {
    fn new(
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
