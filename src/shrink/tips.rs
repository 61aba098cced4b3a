//! Vertices onto tips, rims and the bottoms of slits, which steps along the gradient never reach: from a place short of a
//! tip they lead to its flanks.
//!
//! A vertex looks where the tangent planes around it meet (the quadric error function of dual contouring, Ju et al. 2002).
//! On a sharp feature the field is zero there; before a rounded one the place lies beyond the surface, in line with the
//! tip, and from there the gradient leads to the tip itself.

use super::collide::{Index, meet};
use super::creases::least_squares;
use super::energy::add_outer;
use super::rings::Mesh;
use super::unfold::Corners;
use super::zero::step_to_zero;
use crate::field::mesh::closest_on_triangle;
use crate::field::{Metric, Sampler};
use crate::settings::{CancelToken, Canceled};
use glam::{DMat3, DVec3};

/// A vertex moves only to a place that its triangles miss by this many edges; nearer ones are curvature, not features.
const MISSED: f64 = 0.1;
/// How far a vertex may move, in edges.
const REACH: f64 = 1.5;
/// The gradient at a tip agrees with the vertex's normal at least this well; otherwise the tip is another sheet's.
const AGREES: f64 = 0.3;
/// Where values are no distances, the field at a tip must be this close to zero, in edges.
const ON_ZERO: f64 = 0.05;
/// Twice the area over the longest edge squared that no triangle may fall below, unless it was below before.
const THIN: f64 = 0.1;

/// A tangent plane of the zero level set.
#[derive(Clone, Copy, Debug)]
pub struct Plane {
    /// A point of it, on the zero level set.
    pub point: DVec3,
    /// Its unit normal, or zero where there is none.
    pub normal: DVec3,
}

/// Moves vertices to the tips, rims and slit bottoms that the mesh misses. `planes` has the tangent plane that was found
/// for every vertex, `edge` is the usual length of an edge. No triangle turns by more than acos(`turn`).
pub fn reach_tips(
    mesh: &mut Mesh,
    planes: &[Plane],
    edge: f64,
    turn: f64,
    sampler: &Sampler<'_>,
) -> Result<(), Canceled> {
    let (vertices, beyond): (Vec<u32>, Vec<DVec3>) =
        (0..mesh.positions.len() as u32).filter_map(|v| Some((v, meeting_place(mesh, planes, v, edge)?))).unzip();
    let (values, gradients) = sampler.gradients(&beyond)?;
    let exact = sampler.field().metric() == Metric::Exact;
    let mut tips: Vec<(f64, u32, DVec3)> = Vec::new();
    for (k, &v) in vertices.iter().enumerate() {
        let tip = beyond[k] + step_to_zero(values[k], gradients[k], REACH * edge);
        let agrees = gradients[k].dot(mesh.vertex_normal(v)) > AGREES * gradients[k].length();
        let missed = missed_by(mesh, v, tip);
        if agrees && missed > MISSED * edge && tip.distance(mesh.positions[v as usize]) <= REACH * edge {
            tips.push((missed, v, tip));
        }
    }
    if !exact {
        let places: Vec<DVec3> = tips.iter().map(|tip| tip.2).collect();
        let mut values = sampler.values(&places)?.into_iter();
        tips.retain(|_| values.next().is_some_and(|s| s.abs() <= ON_ZERO * edge));
    }
    if tips.is_empty() {
        return Ok(());
    }
    tips.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
    let triangles = mesh.rings.triangles();
    let corners = Corners::new(mesh.positions.len(), &triangles);
    let mut apart = Apart::new(&mesh.positions, &triangles, &corners);
    for (_, v, tip) in tips {
        // a neighbour that went before may have got there
        if missed_by(mesh, v, tip) > MISSED * edge && mesh.may_move(v, tip, None, turn) && stays_decent(mesh, v, tip) {
            apart.try_move(&mut mesh.positions, v, tip);
        }
    }
    Ok(())
}

/// Takes triangles that cross apart where moving a vertex towards the middle of its neighbours does it.
pub fn part(mesh: &mut Mesh, cancel: &CancelToken) -> Result<(), Canceled> {
    /// Rounds over the vertices that are left with crossings.
    const SWEEPS: usize = 4;
    /// Shares of the way that are tried.
    const STEPS: [f64; 3] = [0.3, 0.6, 1.0];
    let triangles = mesh.rings.triangles();
    let corners = Corners::new(mesh.positions.len(), &triangles);
    let mut apart = Apart::new(&mesh.positions, &triangles, &corners);
    let mut crossed: Vec<u32> = (0..triangles.len() as u32)
        .filter(|&t| apart.crosses(&mesh.positions, t))
        .flat_map(|t| triangles[t as usize])
        .collect();
    for _ in 0..SWEEPS {
        cancel.check()?;
        crossed.sort_unstable();
        crossed.dedup();
        crossed.retain(|&v| apart.crossings_at(&mesh.positions, v) > 0);
        for &v in &crossed {
            let ring = mesh.rings.ring(v);
            let middle = ring.iter().map(|&u| mesh.positions[u as usize]).sum::<DVec3>() / ring.len() as f64;
            let from = mesh.positions[v as usize];
            for step in STEPS {
                if apart.try_part(&mut mesh.positions, v, from.lerp(middle, step)) {
                    break;
                }
            }
        }
    }
    Ok(())
}

/// Lets vertices of a surface move only where no triangle then crosses one that it did not cross before.
pub(super) struct Apart<'a> {
    triangles: &'a [[u32; 3]],
    corners: &'a Corners,
    index: Index,
}

impl<'a> Apart<'a> {
    /// Over the triangles of a surface.
    pub fn new(positions: &[DVec3], triangles: &'a [[u32; 3]], corners: &'a Corners) -> Self {
        Self { triangles, corners, index: Index::new(positions, triangles) }
    }

    /// Moves `v` to `to`, unless the triangles there would cross more others than they do. Returns whether it moved.
    pub fn try_move(&mut self, positions: &mut [DVec3], v: u32, to: DVec3) -> bool {
        let (before, from) = (self.crossings_at(positions, v), positions[v as usize]);
        positions[v as usize] = to;
        self.follow(positions, v);
        if self.crossings_at(positions, v) > before {
            self.put_back(positions, v, from);
            return false;
        }
        true
    }

    /// Moves `v` to `to`, if the triangles there then cross fewer others. Returns whether it moved.
    pub fn try_part(&mut self, positions: &mut [DVec3], v: u32, to: DVec3) -> bool {
        let (before, from) = (self.crossings_at(positions, v), positions[v as usize]);
        self.put_back(positions, v, to);
        let parted = self.crossings_at(positions, v) < before;
        if !parted {
            self.put_back(positions, v, from);
        }
        parted
    }

    /// Whether a triangle crosses another.
    fn crosses(&self, positions: &[DVec3], t: u32) -> bool {
        self.crossings_of(positions, t) > 0
    }

    /// Moves `v` to `to`, whatever is there.
    pub fn put_back(&mut self, positions: &mut [DVec3], v: u32, to: DVec3) {
        positions[v as usize] = to;
        self.follow(positions, v);
    }

    fn follow(&mut self, positions: &[DVec3], v: u32) {
        for &k in self.corners.at(v) {
            self.index.update(k / 3, self.triangles[k as usize / 3].map(|u| positions[u as usize]));
        }
    }

    fn crossings_at(&self, positions: &[DVec3], v: u32) -> usize {
        self.corners.at(v).iter().map(|&k| self.crossings_of(positions, k / 3)).sum()
    }

    fn crossings_of(&self, positions: &[DVec3], t: u32) -> usize {
        let (corners, mut count) = (self.triangles[t as usize], 0);
        self.index.near(self.index.bounds(t), |other| {
            count += usize::from(other != t && meet(positions, corners, self.triangles[other as usize]));
        });
        count
    }
}

/// Where the planes of `v` and its neighbours meet, if that is a place that the triangles at `v` miss.
fn meeting_place(mesh: &Mesh, planes: &[Plane], v: u32, edge: f64) -> Option<DVec3> {
    let here = mesh.positions[v as usize];
    let (mut quadratic, mut linear) = (DMat3::ZERO, DVec3::ZERO);
    for &u in mesh.rings.ring(v).iter().chain([&v]) {
        let Plane { point, normal } = planes[u as usize];
        add_outer(&mut quadratic, normal, normal, 1.0);
        linear += normal * normal.dot(point - here);
    }
    let offset = least_squares(quadratic, linear).0;
    let length = offset.length();
    if !(MISSED * edge..).contains(&length) {
        return None;
    }
    let place = here + offset * (REACH * edge / length).min(1.0);
    (missed_by(mesh, v, place) > MISSED * edge).then_some(place)
}

/// Distance of a place from the triangles at `v`.
fn missed_by(mesh: &Mesh, v: u32, place: DVec3) -> f64 {
    let ring = mesh.rings.ring(v);
    (0..ring.len())
        .map(|i| {
            let corners = [v, ring[i], ring[(i + 1) % ring.len()]].map(|u| mesh.positions[u as usize]);
            closest_on_triangle(place, corners).distance_squared(place)
        })
        .fold(f64::INFINITY, f64::min)
        .sqrt()
}

/// Whether no triangle at `v` gets thinner than it may when `v` goes to `to`.
fn stays_decent(mesh: &Mesh, v: u32, to: DVec3) -> bool {
    let fatness = |k: [DVec3; 3]| {
        let longest = k[0].distance_squared(k[1]).max(k[1].distance_squared(k[2])).max(k[2].distance_squared(k[0]));
        (k[1] - k[0]).cross(k[2] - k[0]).length() / longest.max(1e-300)
    };
    let ring = mesh.rings.ring(v);
    (0..ring.len()).all(|i| {
        let (a, b) = (mesh.positions[ring[i] as usize], mesh.positions[ring[(i + 1) % ring.len()] as usize]);
        fatness([to, a, b]) >= THIN.min(fatness([mesh.positions[v as usize], a, b]))
    })
}
