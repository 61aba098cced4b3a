//! Fold-over-free relaxation of surface triangles against target normals.
//!
//! Per triangle E = A (T/2 + (D^2 + 1)/2) / chi(D), T the Dirichlet energy per area against a reference triangle, D its
//! signed area against the reference's, taken along a target normal, and chi(D) = (D + sqrt(eps^2 + D^2))/2, which stays
//! finite for an inverted triangle and pushes it back (Garanzha et al. 2021, "Foldover-free maps in 50 lines of code").
//! Vertices move in their tangent planes, one at a time, by Newton steps.

use super::energy::{Reference, add_outer, newton_direction, tangents};
use glam::{DMat3, DVec3};

/// For every vertex the corners (3 * triangle + corner; of cells with K corners, K * cell + corner) that it is at.
pub struct Corners {
    first: Vec<u32>,
    list: Vec<u32>,
}

impl Corners {
    /// From triangles, or other cells, over `vertices` vertices.
    pub fn new<const K: usize>(vertices: usize, cells: &[[u32; K]]) -> Self {
        let mut first = vec![0u32; vertices + 1];
        for &v in cells.iter().flatten() {
            first[v as usize + 1] += 1;
        }
        for v in 0..vertices {
            first[v + 1] += first[v];
        }
        let (mut next, mut list) = (first.clone(), vec![0; K * cells.len()]);
        for (corner, &v) in cells.iter().flatten().enumerate() {
            list[next[v as usize] as usize] = corner as u32;
            next[v as usize] += 1;
        }
        Self { first, list }
    }
    /// Corners at `v`.
    pub fn at(&self, v: u32) -> &[u32] {
        &self.list[self.first[v as usize] as usize..self.first[v as usize + 1] as usize]
    }
}

/// What a relaxation works against.
pub struct Problem<'a> {
    /// Triangles over the vertices that move.
    pub triangles: &'a [[u32; 3]],
    /// Which corners every vertex is at.
    pub corners: &'a Corners,
    /// Reference of the triangle seen from one of its corners.
    pub reference: &'a dyn Fn(usize, usize) -> Reference,
    /// Unit target normal of every triangle.
    pub targets: &'a [DVec3],
    /// Unit normal of every vertex's tangent plane.
    pub normals: &'a [DVec3],
    /// Where vertices are drawn to, with this weight (in units of the energy per squared length).
    pub anchors: Option<(&'a [DVec3], f64)>,
    /// The regularisation eps of chi.
    pub epsilon: f64,
}

struct Wedge {
    b: DVec3,
    c: DVec3,
    normal: DVec3,
    reference: Reference,
}

/// chi and its first two derivatives.
fn chi(d: f64, epsilon: f64) -> (f64, f64, f64) {
    let root = epsilon.hypot(d);
    // the second form does not cancel for very negative d
    let value = if d > 0.0 { 0.5 * (d + root) } else { 0.5 * epsilon * epsilon / (root - d) };
    (value, 0.5 * (1.0 + d / root), 0.5 * epsilon * epsilon / (root * root * root))
}

fn energy(star: &[Wedge], x: DVec3, epsilon: f64) -> f64 {
    star.iter()
        .map(|t| {
            let area = t.reference.area;
            let d = t.normal.dot((t.b - x).cross(t.c - x)) / (2.0 * area);
            area * 0.5 * (t.reference.dirichlet(x, t.b, t.c) + d * d + 1.0) / chi(d, epsilon).0
        })
        .sum()
}

/// Moves the `active` vertices by `sweeps` rounds of Newton steps, forth and back.
pub fn relax(problem: &Problem<'_>, positions: &mut [DVec3], active: &[u32], sweeps: usize) {
    let mut star = Vec::new();
    for round in 0..sweeps {
        for i in 0..active.len() {
            let v = if round % 2 == 0 { active[i] } else { active[active.len() - 1 - i] };
            relax_vertex(problem, positions, v, &mut star);
        }
    }
}

fn relax_vertex(problem: &Problem<'_>, positions: &mut [DVec3], v: u32, star: &mut Vec<Wedge>) {
    star.clear();
    for &corner in problem.corners.at(v) {
        let (t, c) = (corner as usize / 3, corner as usize % 3);
        let triangle = problem.triangles[t];
        star.push(Wedge {
            b: positions[triangle[(c + 1) % 3] as usize],
            c: positions[triangle[(c + 2) % 3] as usize],
            normal: problem.targets[t],
            reference: (problem.reference)(t, c),
        });
    }
    let x = positions[v as usize];
    let (anchor, pull) = problem.anchors.map_or((x, 0.0), |(a, k)| (a[v as usize], k));
    let total = |q: DVec3| energy(star, q, problem.epsilon) + 0.5 * pull * q.distance_squared(anchor);
    let before = total(x);
    let mut gradient = pull * (x - anchor);
    let (mut hessian, mut diagonal) = (DMat3::ZERO, pull);
    for t in star.iter() {
        let area = t.reference.area;
        let dirichlet = t.reference.dirichlet(x, t.b, t.c);
        let slope = t.reference.dirichlet_gradient(x, t.b, t.c);
        let d = t.normal.dot((t.b - x).cross(t.c - x)) / (2.0 * area);
        let m = t.normal.cross(t.c - t.b) * (0.5 / area);
        let (c, c1, c2) = chi(d, problem.epsilon);
        let top = 0.5 * (dirichlet + d * d + 1.0);
        let (by_t, by_d) = (0.5 / c, d / c - top * c1 / (c * c));
        let by_td = -0.5 * c1 / (c * c);
        let by_dd = 1.0 / c - 2.0 * d * c1 / (c * c) - top * c2 / (c * c) + 2.0 * top * c1 * c1 / (c * c * c);
        gradient += area * (by_t * slope + by_d * m);
        diagonal += area * by_t * t.reference.dirichlet_hessian();
        add_outer(&mut hessian, slope, m, area * by_td);
        add_outer(&mut hessian, m, slope, area * by_td);
        add_outer(&mut hessian, m, m, area * by_dd);
    }
    let (e1, e2) = tangents(problem.normals[v as usize]);
    let mut step = newton_direction(gradient, &hessian, diagonal, e1, e2);
    let length = step.length();
    if length.is_nan() || length <= 1e-15 {
        return;
    }
    let reach = 0.5 * star.iter().map(|t| x.distance_squared(t.b)).fold(0.0, f64::max).sqrt();
    if length > reach {
        step *= reach / length;
    }
    let mut fraction = 1.0;
    for _ in 0..8 {
        let to = x + fraction * step;
        if total(to) < before {
            positions[v as usize] = to;
            return;
        }
        fraction *= 0.4;
    }
}

/// `mask` grown by `rings` rings of triangles.
pub fn grow(mask: &mut [bool], triangles: &[[u32; 3]], rings: usize) {
    for _ in 0..rings {
        let touched: Vec<[u32; 3]> =
            triangles.iter().copied().filter(|t| t.iter().any(|&v| mask[v as usize])).collect();
        for v in touched.into_iter().flatten() {
            mask[v as usize] = true;
        }
    }
}

/// Mean of the neighbours of every masked vertex, mixed in with weight `step`.
pub fn smooth(positions: &mut [DVec3], triangles: &[[u32; 3]], corners: &Corners, mask: &[bool], step: f64) {
    let means: Vec<(usize, DVec3)> = (0..positions.len())
        .filter(|&v| mask[v])
        .map(|v| {
            let list = corners.at(v as u32);
            let sum: DVec3 =
                list.iter().map(|&k| positions[triangles[k as usize / 3][(k as usize % 3 + 1) % 3] as usize]).sum();
            (v, sum / list.len() as f64)
        })
        .collect();
    for (v, mean) in means {
        positions[v] = positions[v].lerp(mean, step);
    }
}

/// Adds the mean of the corners' normals to the targets of the triangles that `mask` touches.
pub fn mix_targets(targets: &mut [DVec3], triangles: &[[u32; 3]], mask: &[bool], normals: &[DVec3]) {
    for (t, target) in triangles.iter().zip(targets) {
        if t.iter().any(|&v| mask[v as usize]) {
            let mean = t.iter().map(|&v| normals[v as usize]).sum::<DVec3>().normalize_or_zero();
            *target = (*target + mean).normalize_or(mean);
        }
    }
}
