//! A bijection from a closed genus-0 mesh to the unit sphere.
//!
//! The mesh is decimated to a tetrahedron, the tetrahedron is laid on the sphere, and the vertices come back in reverse
//! order, each into the kernel of its ring, so that no spherical triangle ever turns over (Praun and Hoppe 2003,
//! "Spherical parametrization and remeshing"). After every insertion the neighbourhood is relaxed under
//! E = A (T/4 (1 + D^-2) + beta (D + 1/D)/2), T the Dirichlet energy per area and D the ratio of areas: a barrier that is
//! infinite where a triangle would turn over.

use super::energy::{Reference, add_outer, newton_direction, tangents};
use super::rings::{Mesh, Rings};
use crate::settings::{CancelToken, Canceled};
use glam::{DMat3, DVec3};
use std::cmp::Ordering;
use std::collections::{BinaryHeap, HashSet};
use std::f64::consts::PI;

/// Softening of slivers in the reference triangles.
const SOFTENING: f64 = 0.02;
/// The whole map is relaxed each time it has grown by this factor.
const GROWTH: f64 = 1.4;
/// Sweeps at every such growth, and at the end.
const SWEEPS: (usize, usize) = (6, 20);
/// A new vertex whose energy per area is above this is in trouble, and a growing patch around it is relaxed.
const TROUBLE: f64 = 100.0;

/// The map, and what it cost.
#[derive(Clone, Debug)]
pub struct SphereMap {
    /// Unit direction of every vertex.
    pub directions: Vec<DVec3>,
    /// Mean energy per area (ideal 0.5 + beta).
    pub energy: f64,
}

/// Maps `mesh` to the sphere; every spherical triangle is positively oriented. `beta` weighs area against angle;
/// `density` is the share of the sphere per area that every vertex asks for, up to a common factor. `None` when the mesh cannot be decimated to a tetrahedron or an insertion finds no kernel.
pub fn sphere_map(
    mesh: &Mesh,
    density: &[f64],
    beta: f64,
    cancel: &CancelToken,
) -> Result<Option<SphereMap>, Canceled> {
    let mut rings = mesh.rings.clone();
    let Some(log) = decimate(mesh, &mut rings, cancel)? else {
        return Ok(None);
    };
    let n = mesh.positions.len();
    let weighted: f64 = mesh
        .rings
        .triangles()
        .into_iter()
        .map(|t| 0.5 * mesh.normal(t).length() * t.iter().map(|&v| density[v as usize]).sum::<f64>() / 3.0)
        .sum();
    let scales = density.iter().map(|d| d * 4.0 * PI / weighted).collect();
    let mut map =
        Relaxer { positions: &mesh.positions, directions: vec![DVec3::ZERO; n], rings, scales, beta, star: Vec::new() };
    let mut active: Vec<u32> = (0..n as u32).filter(|&v| map.rings.alive(v)).collect();
    let top = active[0];
    map.directions[top as usize] = DVec3::Z;
    for (i, v) in map.rings.ring(top).to_vec().into_iter().enumerate() {
        let angle = 2.0 * PI * i as f64 / 3.0;
        let radius = 8f64.sqrt() / 3.0;
        map.directions[v as usize] = DVec3::new(radius * angle.cos(), radius * angle.sin(), -1.0 / 3.0);
    }
    let mut next_sweep = (4.0 * GROWTH) as usize + 1;
    for (v, ring) in log.iter().rev() {
        let Some(q) = map.kernel(ring) else {
            return Ok(None);
        };
        map.directions[*v as usize] = q;
        map.rings.uncollapse(*v, ring);
        active.push(*v);
        map.settle(*v, ring, active.len(), cancel)?;
        if active.len() >= next_sweep && active.len() < n {
            next_sweep = (active.len() as f64 * GROWTH).ceil() as usize + 1;
            map.sweep(&active, if active.len() < 500 { 4 * SWEEPS.0 } else { SWEEPS.0 }, cancel)?;
        }
    }
    map.sweep(&active, SWEEPS.1, cancel)?;
    let energy = map.mean_energy(&active);
    Ok(Some(SphereMap { directions: map.directions, energy }))
}

/// A collapsed vertex and its ring, from the vertex it went into.
type Collapse = (u32, Vec<u32>);

#[derive(PartialEq)]
struct Candidate {
    cost: f64,
    vertex: u32,
    stamp: u32,
}
impl Eq for Candidate {}
impl PartialOrd for Candidate {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}
impl Ord for Candidate {
    fn cmp(&self, other: &Self) -> Ordering {
        // the heap's top is the cheapest; equal costs go by vertex number
        other.cost.total_cmp(&self.cost).then(other.vertex.cmp(&self.vertex))
    }
}

/// A symmetric 4 x 4 form: squared distance to planes (Garland and Heckbert 1997).
#[derive(Clone, Copy, Default)]
struct Quadric {
    quadratic: DMat3,
    linear: DVec3,
    constant: f64,
}
impl Quadric {
    fn add_plane(&mut self, normal: DVec3, point: DVec3, weight: f64) {
        let offset = -normal.dot(point);
        add_outer(&mut self.quadratic, normal, normal, weight);
        self.linear += weight * offset * normal;
        self.constant += weight * offset * offset;
    }
    fn add(&mut self, other: &Quadric) {
        self.quadratic += other.quadratic;
        self.linear += other.linear;
        self.constant += other.constant;
    }
    fn at(&self, p: DVec3) -> f64 {
        p.dot(self.quadratic * p) + 2.0 * self.linear.dot(p) + self.constant
    }
}

/// Collapses to four vertices, cheapest half-edge first (quadric plus squared length, worse for slivers, folds and high
/// valence). `None` when that is impossible.
fn decimate(mesh: &Mesh, rings: &mut Rings, cancel: &CancelToken) -> Result<Option<Vec<Collapse>>, Canceled> {
    let n = mesh.positions.len();
    let (mut quadrics, mut area) = (vec![Quadric::default(); n], 0.0);
    for t in mesh.rings.triangles() {
        let normal = mesh.normal(t);
        let a = 0.5 * normal.length();
        area += a;
        for v in t {
            quadrics[v as usize].add_plane(normal.normalize_or_zero(), mesh.positions[t[0] as usize], a);
        }
    }
    let length_weight = area / n as f64;
    let cost = |rings: &Rings, quadrics: &[Quadric], v: u32, w: u32| -> f64 {
        let to = mesh.positions[w as usize];
        let mut quadric = quadrics[v as usize];
        quadric.add(&quadrics[w as usize]);
        let ring = rings.ring(v);
        let (mut aspect, mut folds) = (1.0f64, 0);
        for (i, &a) in ring.iter().enumerate() {
            let b = ring[(i + 1) % ring.len()];
            if a == w || b == w {
                continue;
            }
            let (pa, pb) = (mesh.positions[a as usize], mesh.positions[b as usize]);
            let (after, before) = ((pa - to).cross(pb - to), mesh.normal([v, a, b]));
            let edges = pa.distance_squared(pb) + pa.distance_squared(to) + pb.distance_squared(to);
            // 1 for an equilateral triangle
            aspect = aspect.max(edges / (12f64.sqrt() * after.length()).max(1e-9 * edges));
            folds += i32::from(before.dot(after) < 0.2 * before.length() * after.length());
        }
        let squared = to.distance_squared(mesh.positions[v as usize]);
        let mut cost = (quadric.at(to).max(0.0) + length_weight * squared) * (1.0 + 0.1 * aspect.min(100.0));
        let merged = ring.len() + rings.valence(w) - 4;
        for valence in [merged, ring.len()] {
            if valence > 9 {
                cost *= 1.0 + ((valence - 9) as f64).powi(2);
            }
        }
        if folds > 0 {
            cost *= 50.0 * f64::from(1 + folds);
        }
        cost + 1e-30 * squared
    };
    let cheapest = |rings: &Rings, quadrics: &[Quadric], v: u32| -> Option<(f64, u32)> {
        let choices = rings.ring(v).iter().filter(|&&w| rings.collapsible(v, w));
        choices.map(|&w| (cost(rings, quadrics, v, w), w)).min_by(|a, b| a.0.total_cmp(&b.0))
    };
    let (mut stamps, mut targets) = (vec![0u32; n], vec![u32::MAX; n]);
    let mut heap = BinaryHeap::new();
    let mut log = Vec::with_capacity(n);
    let mut alive = (0..n as u32).filter(|&v| rings.alive(v)).count();
    let mut refilled_at = usize::MAX;
    while alive > 4 {
        let Some(Candidate { vertex: v, stamp, .. }) = heap.pop() else {
            // edges become collapsible again when links change farther away
            if refilled_at == alive {
                return Ok(None);
            }
            refilled_at = alive;
            for v in (0..n as u32).filter(|&v| rings.alive(v)) {
                if v.is_multiple_of(1024) {
                    cancel.check()?;
                }
                stamps[v as usize] += 1;
                if let Some((cost, w)) = cheapest(rings, &quadrics, v) {
                    targets[v as usize] = w;
                    heap.push(Candidate { cost, vertex: v, stamp: stamps[v as usize] });
                }
            }
            continue;
        };
        if !rings.alive(v) || stamp != stamps[v as usize] {
            continue;
        }
        let w = targets[v as usize];
        let mut touched = vec![v];
        if rings.joined(v, w) && rings.collapsible(v, w) {
            log.push((v, rings.collapse(v, w)));
            let gone = quadrics[v as usize];
            quadrics[w as usize].add(&gone);
            alive -= 1;
            if alive.is_multiple_of(256) {
                cancel.check()?;
            }
            touched = rings.ring(w).to_vec();
            touched.push(w);
        }
        for u in touched {
            stamps[u as usize] += 1;
            if let Some((cost, x)) = cheapest(rings, &quadrics, u) {
                targets[u as usize] = x;
                heap.push(Candidate { cost, vertex: u, stamp: stamps[u as usize] });
            }
        }
    }
    Ok(Some(log))
}

/// One triangle of a vertex's star: the other two corners on the sphere, and the reference with the vertex first.
struct Wedge {
    b: DVec3,
    c: DVec3,
    reference: Reference,
}

struct Relaxer<'a> {
    positions: &'a [DVec3],
    directions: Vec<DVec3>,
    rings: Rings,
    /// Squared lengths on the sphere per squared length on the mesh, at every vertex.
    scales: Vec<f64>,
    beta: f64,
    star: Vec<Wedge>,
}

impl Relaxer<'_> {
    fn gather(&mut self, v: u32) {
        self.star.clear();
        let ring = self.rings.ring(v);
        let here = self.positions[v as usize];
        for (i, &b) in ring.iter().enumerate() {
            let c = ring[(i + 1) % ring.len()];
            let corners = [here, self.positions[b as usize], self.positions[c as usize]];
            let scale = (self.scales[v as usize] + self.scales[b as usize] + self.scales[c as usize]) / 3.0;
            self.star.push(Wedge {
                b: self.directions[b as usize],
                c: self.directions[c as usize],
                reference: Reference::new(corners, scale.sqrt(), SOFTENING),
            });
        }
    }

    /// Energy of the gathered star with its vertex at `x`; infinite where a triangle is not positive.
    fn energy(&self, x: DVec3) -> f64 {
        let mut sum = 0.0;
        for t in &self.star {
            let area = t.reference.area;
            let d = x.dot(t.b.cross(t.c)) / (2.0 * area);
            if d.is_nan() || d <= 1e-14 {
                return f64::INFINITY;
            }
            let dirichlet = t.reference.dirichlet(x, t.b, t.c);
            sum += area * (0.25 * dirichlet * (1.0 + 1.0 / (d * d)) + 0.5 * self.beta * (d + 1.0 / d));
        }
        sum
    }

    /// One Riemannian Newton step with backtracking; returns by how much the energy of the star fell.
    fn relax(&mut self, v: u32) -> f64 {
        self.gather(v);
        let x = self.directions[v as usize];
        let before = self.energy(x);
        let (mut gradient, mut hessian, mut diagonal) = (DVec3::ZERO, DMat3::ZERO, 0.0);
        for t in &self.star {
            let area = t.reference.area;
            let m = t.b.cross(t.c) * (0.5 / area);
            let d = x.dot(m);
            let dirichlet = t.reference.dirichlet(x, t.b, t.c);
            let slope = t.reference.dirichlet_gradient(x, t.b, t.c);
            let (i2, i3) = (1.0 / (d * d), 1.0 / (d * d * d));
            let c_slope = 0.25 * area * (1.0 + i2);
            gradient += c_slope * slope + area * (0.5 * self.beta * (1.0 - i2) - 0.5 * dirichlet * i3) * m;
            diagonal += c_slope * t.reference.dirichlet_hessian();
            add_outer(&mut hessian, slope, m, -0.5 * area * i3);
            add_outer(&mut hessian, m, slope, -0.5 * area * i3);
            add_outer(&mut hessian, m, m, area * (1.5 * dirichlet * i2 * i2 + self.beta * i3));
        }
        let (e1, e2) = tangents(x);
        let mut step = newton_direction(gradient, &hessian, diagonal - gradient.dot(x), e1, e2);
        let length = step.length();
        if length.is_nan() || length <= 1e-15 {
            return 0.0;
        }
        let reach = 0.7 * self.star.iter().map(|t| x.distance_squared(t.b)).fold(0.0, f64::max).sqrt();
        if length > reach {
            step *= reach / length;
        }
        let mut fraction = 1.0;
        for _ in 0..8 {
            let to = (x + fraction * step).normalize_or_zero();
            let after = self.energy(to);
            if after < before {
                self.directions[v as usize] = to;
                return before - after;
            }
            fraction *= 0.4;
        }
        0.0
    }

    /// Energy and reference area of the star of `v`.
    fn star_energy(&mut self, v: u32) -> (f64, f64) {
        self.gather(v);
        (self.energy(self.directions[v as usize]), self.star.iter().map(|t| t.reference.area).sum())
    }

    /// A direction strictly inside the kernel of a spherical polygon: the mean of the kernel's own corners, or a point
    /// pulled from the vertex that the new one split off from.
    fn kernel(&self, ring: &[u32]) -> Option<DVec3> {
        let n = ring.len();
        let x = |i: usize| self.directions[ring[i % n] as usize];
        let normals: Vec<DVec3> = (0..n).map(|i| x(i).cross(x(i + 1)).normalize_or_zero()).collect();
        let depth = |q: DVec3| normals.iter().map(|m| m.dot(q)).fold(f64::INFINITY, f64::min);
        let (mut sum, mut corners) = (DVec3::ZERO, 0);
        for i in 0..n {
            for j in i + 1..n {
                let axis = normals[i].cross(normals[j]);
                if axis.length() < 1e-12 {
                    continue;
                }
                for q in [axis.normalize(), -axis.normalize()] {
                    if depth(q) > -1e-9 {
                        sum += q;
                        corners += 1;
                    }
                }
            }
        }
        let center = sum.normalize_or_zero();
        if corners > 0 && depth(center) > 0.0 {
            return Some(center);
        }
        let origin = x(0);
        let mean = (0..n).map(x).sum::<DVec3>().normalize_or_zero();
        let bisector = (normals[0] + normals[n - 1]).normalize_or_zero();
        let mut pull = 1.0;
        for _ in 0..50 {
            for q in [origin.lerp(mean, pull).normalize_or_zero(), (origin + 0.3 * pull * bisector).normalize_or_zero()]
            {
                if depth(q) > 0.0 {
                    return Some(q);
                }
            }
            pull *= 0.5;
        }
        None
    }

    /// Relaxes a vertex that was just inserted, its ring, and a growing patch where that is not enough.
    fn settle(&mut self, v: u32, ring: &[u32], size: usize, cancel: &CancelToken) -> Result<(), Canceled> {
        cancel.check()?;
        self.relax(v);
        self.relax(v);
        let rounds = if size < 200 { 3 } else { 1 };
        for round in 0..80 {
            let fallen: f64 = ring.iter().map(|&u| self.relax(u)).sum::<f64>() + self.relax(v);
            if round + 1 >= rounds {
                let (energy, _) = self.star_energy(v);
                if energy.is_finite() && fallen < 0.05 * energy {
                    break;
                }
            }
        }
        let (energy, area) = self.star_energy(v);
        if energy < TROUBLE * area {
            return Ok(());
        }
        let (mut patch, mut seen, mut rim) = (vec![v], HashSet::from([v]), vec![v]);
        for grown in 0..6 {
            let mut next = Vec::new();
            for &u in &rim {
                for &y in self.rings.ring(u) {
                    if seen.insert(y) {
                        next.push(y);
                    }
                }
            }
            patch.extend_from_slice(&next);
            rim = next;
            if patch.len() > 600 {
                return Ok(());
            }
            if grown == 0 {
                continue;
            }
            let mut last = f64::INFINITY;
            for round in 0..40 {
                cancel.check()?;
                for i in 0..patch.len() {
                    self.relax(if round % 2 == 0 { patch[i] } else { patch[patch.len() - 1 - i] });
                }
                let (energy, _) = self.star_energy(v);
                if energy < 0.3 * TROUBLE * area || (energy > 0.98 * last && round > 4) {
                    break;
                }
                last = energy;
            }
            if self.star_energy(v).0 < TROUBLE * area {
                return Ok(());
            }
        }
        Ok(())
    }

    /// Gauss-Seidel sweeps, forth and back, until the energy falls slowly.
    fn sweep(&mut self, active: &[u32], sweeps: usize, cancel: &CancelToken) -> Result<(), Canceled> {
        for round in 0..6 * sweeps {
            let mut fallen = 0.0;
            for i in 0..active.len() {
                if i.is_multiple_of(1024) {
                    cancel.check()?;
                }
                fallen += self.relax(if round % 2 == 0 { active[i] } else { active[active.len() - 1 - i] });
            }
            // an energy that was infinite falls by infinity
            if fallen < 1e-7 || (round + 1 >= sweeps && fallen < 0.5) {
                break;
            }
        }
        Ok(())
    }

    /// Mean energy per area over the whole map.
    fn mean_energy(&mut self, active: &[u32]) -> f64 {
        let sum: f64 = active.iter().map(|&v| self.star_energy(v).0).sum();
        sum / 3.0 / (4.0 * PI)
    }
}
