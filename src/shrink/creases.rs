//! Vertices onto creases and corners: where the field's gradient jumps between neighbours, a vertex goes to the place that
//! the tangent planes around it meet in (the quadric error function of dual contouring, Ju et al. 2002), if the field is
//! zero there and no triangle suffers.

use super::lattice::SphereLattice;
use super::rings::unit_normal;
use super::unfold::Corners;
use super::zero::OnZero;
use crate::field::Sampler;
use crate::settings::Canceled;
use glam::{DMat3, DVec3};

/// Neighbouring normals with a smaller product than this have a crease between them.
const SMOOTH: f64 = 0.85;
/// The field must be this close to zero where the planes meet, in edges; otherwise the place is a fillet.
const ON_ZERO: f64 = 0.03;
/// How far a vertex may go to a crease and to a corner, in edges.
const REACH: (f64, f64) = (0.7, 1.0);

struct Candidate {
    vertex: u32,
    to: DVec3,
    corner: bool,
    /// Length of an edge there.
    edge: f64,
    /// Distance to go, in edges.
    distance: f64,
}

/// Moves vertices near creases and corners onto them. Returns which moved.
pub fn snap(
    sampler: &Sampler<'_>,
    triangles: &[[u32; 3]],
    corners: &Corners,
    at: &mut OnZero,
) -> Result<Vec<u32>, Canceled> {
    let normals: Vec<DVec3> = at.gradients.iter().map(|g| g.normalize_or_zero()).collect();
    let found = candidates(triangles, corners, &at.positions, &normals);
    let places: Vec<DVec3> = found.iter().map(|c| c.to).collect();
    let values = sampler.values(&places)?;
    let mut candidates: Vec<Candidate> =
        found.into_iter().zip(values).filter(|(c, s)| s.abs() <= ON_ZERO * c.edge).map(|(c, _)| c).collect();
    candidates
        .sort_by(|a, b| b.corner.cmp(&a.corner).then(a.distance.total_cmp(&b.distance)).then(a.vertex.cmp(&b.vertex)));
    let mut done = vec![false; at.positions.len()];
    let mut moved = Vec::new();
    for c in candidates {
        if !done[c.vertex as usize] && keeps_shape(triangles, corners, &at.positions, &normals, c.vertex, c.to) {
            at.positions[c.vertex as usize] = c.to;
            done[c.vertex as usize] = true;
            moved.push(c.vertex);
        }
    }
    let points: Vec<DVec3> = moved.iter().map(|&v| at.positions[v as usize]).collect();
    let (values, gradients) = sampler.gradients(&points)?;
    for (k, &v) in moved.iter().enumerate() {
        (at.values[v as usize], at.gradients[v as usize]) = (values[k], gradients[k]);
    }
    Ok(moved)
}

/// Places that vertices could go to.
fn candidates(triangles: &[[u32; 3]], corners: &Corners, positions: &[DVec3], normals: &[DVec3]) -> Vec<Candidate> {
    let mut list = Vec::new();
    let mut ring = Vec::new();
    for v in 0..positions.len() {
        ring.clear();
        for &k in corners.at(v as u32) {
            let (t, c) = (triangles[k as usize / 3], k as usize % 3);
            ring.extend([t[(c + 1) % 3] as usize, t[(c + 2) % 3] as usize]);
        }
        ring.sort_unstable();
        ring.dedup();
        let (here, normal) = (positions[v], normals[v]);
        let across = |u: &usize| normals[*u].dot(normal) < SMOOTH;
        if !ring.iter().any(across) {
            continue;
        }
        let edge = ring.iter().map(|&u| positions[u].distance(here)).sum::<f64>() / ring.len() as f64;
        let mut add = |to: DVec3, corner: bool| {
            let distance = to.distance(here) / edge;
            let reach = if corner { REACH.1 } else { REACH.0 };
            if distance <= reach {
                list.push(Candidate { vertex: v as u32, to, corner, edge, distance });
            }
        };
        // all planes around: a corner where they fix a point
        let (mut quadratic, mut linear) = (DMat3::ZERO, DVec3::ZERO);
        for u in ring.iter().copied().chain([v]) {
            super::energy::add_outer(&mut quadratic, normals[u], normals[u], 1.0);
            linear += normals[u] * normals[u].dot(positions[u] - here);
        }
        let (offset, rank) = least_squares(quadratic, linear);
        add(here + offset, rank == 3);
        // the nearest plane across: a crease
        let nearest = ring
            .iter()
            .copied()
            .filter(|u| across(u))
            .min_by(|&a, &b| positions[a].distance_squared(here).total_cmp(&positions[b].distance_squared(here)));
        if let Some(u) = nearest {
            let along = normal.dot(normals[u]);
            // the point of both planes nearest to the vertex
            let gap = normals[u].dot(positions[u] - here);
            let offset = (normals[u] - along * normal) * (gap / (1.0 - along * along).max(1e-9));
            add(here + offset, false);
        }
    }
    list
}

/// The shortest solution of a symmetric system, small eigenvalues left out, and its rank.
pub(super) fn least_squares(matrix: DMat3, right: DVec3) -> (DVec3, usize) {
    /// Eigenvalues below this share of the largest say nothing.
    const SMALL: f64 = 0.04;
    let (values, vectors) = symmetric_eigen(matrix);
    let largest = values.max_element();
    let (mut x, mut rank) = (DVec3::ZERO, 0);
    for k in 0..3 {
        if values[k] > SMALL * largest && largest > 0.0 {
            x += vectors.col(k) * (vectors.col(k).dot(right) / values[k]);
            rank += 1;
        }
    }
    (x, rank)
}

/// Eigenvalues and eigenvectors of a symmetric matrix by cyclic Jacobi rotations.
fn symmetric_eigen(matrix: DMat3) -> (DVec3, DMat3) {
    /// What is smaller than this beside the diagonal changes nothing.
    const NONE: f64 = 1e-18;
    let (mut a, mut vectors) = (matrix, DMat3::IDENTITY);
    for _ in 0..12 {
        for (p, q) in [(0, 1), (0, 2), (1, 2)] {
            let off = a.col(p)[q];
            if off.abs() <= NONE * (a.col(p)[p].abs() + a.col(q)[q].abs()) {
                continue;
            }
            let theta = (a.col(q)[q] - a.col(p)[p]) / (2.0 * off);
            let t = theta.signum() / (theta.abs() + (theta * theta + 1.0).sqrt());
            let c = 1.0 / (t * t + 1.0).sqrt();
            let mut rotation = DMat3::IDENTITY;
            rotation.col_mut(p)[p] = c;
            rotation.col_mut(q)[q] = c;
            rotation.col_mut(q)[p] = t * c;
            rotation.col_mut(p)[q] = -t * c;
            a = rotation.transpose() * a * rotation;
            vectors *= rotation;
        }
    }
    (DVec3::new(a.x_axis.x, a.y_axis.y, a.z_axis.z), vectors)
}

/// Whether every triangle around `v` stays a decent triangle that agrees with its corners' normals when `v` goes to `to`.
pub(super) fn keeps_shape(
    triangles: &[[u32; 3]],
    corners: &Corners,
    positions: &[DVec3],
    normals: &[DVec3],
    v: u32,
    to: DVec3,
) -> bool {
    /// Twice the area over the longest edge squared that a triangle may not fall below, unless it was below before.
    const THIN: f64 = 0.12;
    /// Agreement with the best of its corners' normals that a triangle must have.
    const AGREES: f64 = 0.6;
    let shape = |k: [DVec3; 3]| {
        let longest = k[0].distance_squared(k[1]).max(k[1].distance_squared(k[2])).max(k[2].distance_squared(k[0]));
        (k[1] - k[0]).cross(k[2] - k[0]).length() / longest
    };
    corners.at(v).iter().all(|&c| {
        let t = triangles[c as usize / 3];
        let before = t.map(|u| positions[u as usize]);
        let after = t.map(|u| if u == v { to } else { positions[u as usize] });
        let normal = unit_normal(after);
        let best = t.iter().map(|&u| normal.dot(normals[u as usize])).fold(f64::NEG_INFINITY, f64::max);
        let turned = normal.dot(unit_normal(before));
        shape(after) >= THIN.min(shape(before)) && best >= AGREES && turned > 0.0
    })
}

/// A quad's triangles with its first diagonal, and with the other.
const FIRST: [[usize; 3]; 2] = [[0, 1, 2], [0, 2, 3]];
const OTHER: [[usize; 3]; 2] = [[0, 1, 3], [1, 2, 3]];

/// Chooses the diagonals of the quads that have a corner for which `changed` holds: the one that runs closer to the zero
/// level set where the normals around differ, the one that agrees with them elsewhere.
pub fn choose_diagonals(
    sampler: &Sampler<'_>,
    lattice: &SphereLattice,
    at: &OnZero,
    choice: &mut [bool],
    changed: impl Fn(usize) -> bool,
) -> Result<(), Canceled> {
    /// Of quads whose normals agree at least this well the field is not asked.
    const EVEN: f64 = 0.97;
    /// A diagonal that leaves a triangle of less than this share of the other one's smaller triangle is not taken.
    const SLIVER: f64 = 0.1;
    let normals: Vec<DVec3> = at.gradients.iter().map(|g| g.normalize_or_zero()).collect();
    let (mut asked, mut middles) = (Vec::new(), Vec::new());
    for (i, quad) in lattice.quads.iter().enumerate() {
        let k = quad.map(|c| lattice.chart[c as usize] as usize);
        if !k.iter().any(|&v| changed(v)) {
            continue;
        }
        choice[i] = false;
        if !lattice.free[i] {
            continue;
        }
        let mean = k.iter().map(|&v| normals[v]).sum::<DVec3>().normalize_or_zero();
        let p = k.map(|v| at.positions[v]);
        // a triangle without area has no normal that could be wrong
        let least = |t: [[usize; 3]; 2]| -> f64 {
            t.iter().map(|c| twice_area(c.map(|j| p[j])).length()).fold(f64::INFINITY, f64::min)
        };
        let (kept, turned) = (least(FIRST), least(OTHER));
        if kept < SLIVER * turned || turned < SLIVER * kept {
            choice[i] = kept < turned;
            continue;
        }
        let flat = k.iter().all(|&v| normals[v].dot(mean) > EVEN);
        let first = unit_normal([p[0], p[1], p[2]]).dot(mean).min(unit_normal([p[0], p[2], p[3]]).dot(mean));
        if flat && first > 0.9 {
            let wrong = |t: [[usize; 3]; 2]| -> f64 {
                t.iter().map(|c| deviation(c.map(|j| p[j]), c.map(|j| normals[k[j]]))).sum()
            };
            choice[i] = wrong(OTHER) < wrong(FIRST);
        } else {
            asked.push(i);
            middles.extend([p[0].midpoint(p[2]), p[1].midpoint(p[3])]);
        }
    }
    let values = sampler.values(&middles)?;
    for (n, &i) in asked.iter().enumerate() {
        let k = lattice.quads[i].map(|c| lattice.chart[c as usize] as usize);
        let p = k.map(|v| at.positions[v]);
        let size = p[0].distance(p[2]) + p[1].distance(p[3]);
        let cost = |t: [[usize; 3]; 2], value: f64| {
            let least = t
                .iter()
                .map(|c| {
                    let normal = unit_normal(c.map(|j| p[j]));
                    c.iter().map(|&j| normal.dot(normals[k[j]])).sum::<f64>() / 3.0
                })
                .fold(f64::INFINITY, f64::min);
            value.abs() / size + (0.3 - least).max(0.0)
        };
        let first = cost(FIRST, values[2 * n]);
        let other = cost(OTHER, values[2 * n + 1]);
        choice[i] = other < first - 1e-3;
    }
    Ok(())
}

/// How far a triangle's normal is from those of its corners: twice its area times one less their product.
fn deviation(corners: [DVec3; 3], normals: [DVec3; 3]) -> f64 {
    let normal = twice_area(corners);
    normal.length() - normal.dot(normals.iter().sum::<DVec3>().normalize_or_zero())
}

/// Along the normal, twice the area of a triangle.
fn twice_area([a, b, c]: [DVec3; 3]) -> DVec3 {
    (b - a).cross(c - a)
}

#[cfg(test)]
mod tests {
    use super::super::lattice::LatticeSpec;
    use super::*;
    use crate::field::sampler::Tally;
    use crate::field::scene::Scene;
    use crate::measure::fixtures::with_settings;
    use serde_json::json;

    #[test]
    fn no_diagonal_is_turned_so_that_a_triangle_loses_its_area() {
        let lattice = SphereLattice::new(LatticeSpec::Latlong { n_theta: 48, n_phi: 24 });
        let quad = 48 * 11 + 7;
        let corners = lattice.quads[quad].map(|c| lattice.chart[c as usize] as usize);
        let field = Scene::from_value(&json!({"sphere": {"radius": 1}})).expect("a scene");
        // a corner put onto the diagonal between two others, almost
        for (moved, [u, v], other) in [(3, [0, 2], true), (1, [0, 2], true), (0, [1, 3], false), (2, [1, 3], false)] {
            let mut positions = lattice.directions.clone();
            let middle = positions[corners[u]].midpoint(positions[corners[v]]);
            positions[corners[moved]] = middle.lerp(positions[corners[moved]], 1e-3).normalize();
            let at = OnZero { gradients: positions.clone(), values: vec![0.0; positions.len()], positions };
            let mut choice = vec![false; lattice.quads.len()];
            with_settings(1, |settings| {
                let tally = Tally::new();
                choose_diagonals(&Sampler::new(&field, *settings, &tally), &lattice, &at, &mut choice, |_| true)
            })
            .unwrap();
            assert_eq!(choice[quad], other, "corner {moved}");
        }
    }
}
