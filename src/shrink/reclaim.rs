//! What the base surface has and a lattice would cut off: the vertex of the lattice that is nearest to such a tip, rim or
//! corner goes there, by less than an edge.

use super::creases::keeps_shape;
use super::lattice::SphereLattice;
use super::rings::Mesh;
use super::tips::Apart;
use super::unfold::Corners;
use super::zero::OnZero;
use crate::field::Sampler;
use crate::field::mesh::closest_on_triangle;
use crate::settings::{CancelToken, Canceled};
use glam::DVec3;

/// A vertex of the base farther than this from the lattice's triangles is lost, in usual edges of the lattice.
const LOST: f64 = 0.15;
/// Only places this close to zero are worth going to, in usual edges: a base vertex may have been held back from its sheet.
const ON_ZERO: f64 = 0.05;
/// How far a vertex may go, in edges at the place.
const REACH: f64 = 1.2;
/// The nearest so many vertices are tried.
const TRIES: usize = 4;
/// What a vertex leaves may be missed by this share of what it is sent to save.
const TRADE: f64 = 0.5;

/// A base surface with its map.
pub struct Base<'a> {
    /// The surface.
    pub mesh: &'a Mesh,
    /// Direction of every vertex, in the lattice's turn.
    pub directions: &'a [DVec3],
}

/// Moves vertices of a lattice of usual edge length `edge` to vertices of the base that its triangles miss, the farthest
/// first. Returns which moved.
pub fn reclaim(
    sampler: &Sampler<'_>,
    base: &Base<'_>,
    lattice: &SphereLattice,
    triangles: &[[u32; 3]],
    corners: &Corners,
    at: &mut OnZero,
    edge: f64,
) -> Result<Vec<u32>, Canceled> {
    let star = Star { triangles, corners };
    let mut lost: Vec<(f64, u32, DVec3)> = nearest_directions(base, lattice, &star)
        .into_iter()
        .enumerate()
        .map(|(b, v)| (star.missed_by(&at.positions, v, base.mesh.positions[b]), v, base.mesh.positions[b]))
        .filter(|(missed, ..)| *missed > LOST * edge)
        .collect();
    let places: Vec<DVec3> = lost.iter().map(|l| l.2).collect();
    let mut values = sampler.values(&places)?.into_iter();
    lost.retain(|_| values.next().is_some_and(|s| s.abs() <= ON_ZERO * edge));
    if lost.is_empty() {
        return Ok(Vec::new());
    }
    // a stable sort: equals stay in the order of the base's vertices
    lost.sort_by(|a, b| b.0.total_cmp(&a.0));
    let normals: Vec<DVec3> = at.gradients.iter().map(|g| g.normalize_or_zero()).collect();
    let mut apart = Apart::new(&at.positions, triangles, corners);
    let mut done = vec![false; at.positions.len()];
    let mut moved = Vec::new();
    for (_, near, place) in lost {
        let missed = star.missed_by(&at.positions, near, place);
        if missed <= LOST * edge {
            continue;
        }
        let mut choice = star.around(near);
        choice.sort_by(|&a, &b| {
            let distance = |v: u32| at.positions[v as usize].distance_squared(place);
            distance(a).total_cmp(&distance(b)).then(a.cmp(&b))
        });
        for &v in choice.iter().take(TRIES) {
            let here = at.positions[v as usize];
            if done[v as usize]
                || here.distance(place) > REACH * star.usual_edge(&at.positions, v)
                || !keeps_shape(triangles, corners, &at.positions, &normals, v, place)
            {
                continue;
            }
            if !apart.try_move(&mut at.positions, v, place) {
                continue;
            }
            if star.missed_by(&at.positions, v, here) > TRADE * missed {
                apart.put_back(&mut at.positions, v, here);
                continue;
            }
            done[v as usize] = true;
            moved.push(v);
            break;
        }
    }
    let points: Vec<DVec3> = moved.iter().map(|&v| at.positions[v as usize]).collect();
    let (values, gradients) = sampler.gradients(&points)?;
    for (k, &v) in moved.iter().enumerate() {
        (at.values[v as usize], at.gradients[v as usize]) = (values[k], gradients[k]);
    }
    Ok(moved)
}

/// How far every vertex of the base is from the triangles of a lattice that has landed on it.
pub fn missed(
    base: &Base<'_>,
    lattice: &SphereLattice,
    landed: &[DVec3],
    cancel: &CancelToken,
) -> Result<Vec<f64>, Canceled> {
    let triangles = lattice.triangles(&vec![false; lattice.quads.len()]);
    let corners = Corners::new(landed.len(), &triangles);
    let star = Star { triangles: &triangles, corners: &corners };
    let near = nearest_directions(base, lattice, &star);
    cancel.check()?;
    Ok(near.into_iter().zip(&base.mesh.positions).map(|(v, &p)| star.missed_by(landed, v, p)).collect())
}

/// The lattice's vertex in the direction of every vertex of the base, found by walking from the one that was found for a
/// neighbour.
fn nearest_directions(base: &Base<'_>, lattice: &SphereLattice, star: &Star<'_>) -> Vec<u32> {
    let walk = |mut v: u32, towards: DVec3| {
        let closeness = |u: u32| lattice.directions[u as usize].dot(towards);
        loop {
            let better = star.ring(v).fold(v, |best, u| if closeness(u) > closeness(best) { u } else { best });
            if better == v {
                return v;
            }
            v = better;
        }
    };
    let rings = &base.mesh.rings;
    let mut found = vec![u32::MAX; rings.len()];
    let mut queue = std::collections::VecDeque::from([0u32]);
    found[0] = walk(0, base.directions[0]);
    while let Some(b) = queue.pop_front() {
        for &c in rings.ring(b) {
            if found[c as usize] == u32::MAX {
                found[c as usize] = walk(found[b as usize], base.directions[c as usize]);
                queue.push_back(c);
            }
        }
    }
    found
}

/// The triangles around the vertices of the lattice.
struct Star<'a> {
    triangles: &'a [[u32; 3]],
    corners: &'a Corners,
}

impl Star<'_> {
    /// Every neighbour of `v`, twice.
    fn ring(&self, v: u32) -> impl Iterator<Item = u32> {
        self.corners.at(v).iter().flat_map(|&k| {
            let (t, c) = (self.triangles[k as usize / 3], k as usize % 3);
            [t[(c + 1) % 3], t[(c + 2) % 3]]
        })
    }

    /// `v` and its neighbours.
    fn around(&self, v: u32) -> Vec<u32> {
        let mut list: Vec<u32> = self.ring(v).chain([v]).collect();
        list.sort_unstable();
        list.dedup();
        list
    }

    /// Mean length of the edges at `v`.
    fn usual_edge(&self, positions: &[DVec3], v: u32) -> f64 {
        let (sum, count) = self
            .ring(v)
            .fold((0.0, 0), |(sum, count), u| (sum + positions[u as usize].distance(positions[v as usize]), count + 1));
        sum / f64::from(count.max(1))
    }

    /// Distance of a place from the triangles at `v` and at its neighbours.
    fn missed_by(&self, positions: &[DVec3], v: u32, place: DVec3) -> f64 {
        self.around(v)
            .into_iter()
            .flat_map(|u| self.corners.at(u))
            .map(|&k| {
                let corners = self.triangles[k as usize / 3].map(|u| positions[u as usize]);
                closest_on_triangle(place, corners).distance_squared(place)
            })
            .fold(f64::INFINITY, f64::min)
            .sqrt()
    }
}
