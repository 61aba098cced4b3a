//! Vertices slid along the surface until facets agree with its normals.
//!
//! On a limb the map's cells are long and thin, and where the surface bends along them, a vertex halfway between two others
//! lifts its facets off the tangent plane, like the folds of Schwarz's lantern. Sliding by a fraction of a cell takes that away. Vertices move
//! on the surface to second order, as their neighbours' normals give it; the field is asked once, where they end.

use super::colours::colours;
use super::energy::{inverse_positive, tangents};
use super::unfold::Corners;
use super::zero::{OnZero, project};
use crate::field::Sampler;
use crate::settings::{Canceled, Settings};
use glam::{DMat2, DMat3, DVec2, DVec3};
use rayon::prelude::*;

/// Sweeps over all vertices that slide.
const SWEEPS: usize = 6;
/// Weight of a facet's change of area against its normal's deviation.
const KEEP: f64 = 0.15;
/// Weight of how much the normals of a facet's corners differ: what is curved gets smaller facets.
const SPREAD: f64 = 1.5;
/// A vertex whose facets deviate less than this, on average, stays.
const CALM: f64 = 0.008;
/// A vertex goes at most this share of its mean edge.
const REACH: f64 = 0.6;
/// Vertices worth a piece of parallel work.
const CHUNK: usize = 256;

/// The surface around a vertex, to second order.
struct Patch {
    place: DVec3,
    normal: DVec3,
    frame: [DVec3; 2],
    /// Derivative of the normal along the surface.
    turn: DMat2,
    /// How far the vertex may go.
    reach: f64,
}

impl Patch {
    /// `None` where the surface has an edge or a tip, which is no place to leave.
    fn new(places: &[DVec3], normals: &[DVec3], v: usize, ring: &[u32]) -> Option<Self> {
        /// Normals of neighbours on a smooth surface agree this well.
        const SMOOTH: f64 = 0.5;
        let (place, normal) = (places[v], normals[v]);
        let frame: [DVec3; 2] = tangents(normal).into();
        let plane = |w: DVec3| DVec2::new(frame[0].dot(w), frame[1].dot(w));
        // least squares for a symmetric matrix with the entries xx, xy, yy
        let (mut system, mut right, mut edges) = (DMat3::ZERO, DVec3::ZERO, 0.0);
        for &u in ring {
            let u = u as usize;
            if normals[u].dot(normal) < SMOOTH {
                return None;
            }
            let (along, turned) = (plane(places[u] - place), plane(normals[u] - normal));
            let weight = 1.0 / along.length_squared().max(1e-30);
            for (row, value) in
                [(DVec3::new(along.x, along.y, 0.0), turned.x), (DVec3::new(0.0, along.x, along.y), turned.y)]
            {
                system += weight * DMat3::from_cols(row * row.x, row * row.y, row * row.z);
                right += weight * value * row;
            }
            edges += along.length();
        }
        let turn = system.inverse() * right;
        let turn = DMat2::from_cols(DVec2::new(turn.x, turn.y), DVec2::new(turn.y, turn.z));
        turn.is_finite().then_some(Self { place, normal, frame, turn, reach: REACH * edges / ring.len() as f64 })
    }

    /// Place and unit normal after a move in the tangent plane.
    fn at(&self, to: DVec2) -> (DVec3, DVec3) {
        let turned = self.turn * to;
        let lift = |w: DVec2| w.x * self.frame[0] + w.y * self.frame[1];
        (self.place + lift(to) - 0.5 * to.dot(turned) * self.normal, (self.normal + lift(turned)).normalize())
    }
}

/// A facet of a vertex's star: its other two corners, the sum of their normals, and twice the area it began with.
struct Facet {
    others: [DVec3; 2],
    normals: DVec3,
    area: f64,
}

impl Facet {
    /// Twice the area times how far the facet is from the normals of its corners, and from the area it had.
    fn energy(&self, place: DVec3, normal: DVec3) -> f64 {
        let across = (self.others[0] - place).cross(self.others[1] - place);
        let (area, sum) = (across.length(), self.normals + normal);
        let length = sum.length().max(1e-9);
        let along = across.dot(sum) / length * (1.0 - SPREAD * (1.0 - length / 3.0));
        let ratio = area / self.area;
        area - along + KEEP * self.area * (ratio + 1.0 / ratio.max(1e-6) - 2.0)
    }
}

fn star_energy(star: &[Facet], patch: &Patch, to: DVec2) -> f64 {
    let (place, normal) = patch.at(to);
    star.iter().map(|facet| facet.energy(place, normal)).sum()
}

/// A Newton step with backtracking from `from`; `None` when none lowers the energy.
fn step(star: &[Facet], patch: &Patch, from: DVec2) -> Option<DVec2> {
    /// Differences are taken over this share of the reach.
    const NEAR: f64 = 0.01;
    /// Steps tried, each half of the one before.
    const TRIALS: usize = 4;
    let energy = |to: DVec2| star_energy(star, patch, to);
    let before = energy(from);
    let e = NEAR * patch.reach;
    let (x, y) = (DVec2::new(e, 0.0), DVec2::new(0.0, e));
    let ahead = DVec2::new(energy(from + x), energy(from + y));
    let behind = DVec2::new(energy(from - x), energy(from - y));
    let own = (ahead - 2.0 * before + behind) / (e * e);
    let mixed = (energy(from + x + y) - ahead.x - ahead.y + before) / (e * e);
    let hessian = DMat2::from_cols(DVec2::new(own.x, mixed), DVec2::new(mixed, own.y));
    let mut step = -(inverse_positive(hessian) * (ahead - behind) / (2.0 * e)).clamp_length_max(0.5 * patch.reach);
    for _ in 0..TRIALS {
        let to = (from + step).clamp_length_max(patch.reach);
        if energy(to) < before {
            return Some(to);
        }
        step *= 0.5;
    }
    None
}

/// A lattice surface while its vertices slide.
struct Slide<'a> {
    triangles: &'a [[u32; 3]],
    corners: &'a Corners,
    places: Vec<DVec3>,
    normals: Vec<DVec3>,
    /// Twice the area that every triangle began with.
    areas: Vec<f64>,
}

impl Slide<'_> {
    fn star(&self, v: u32, star: &mut Vec<Facet>) {
        star.clear();
        star.extend(self.corners.at(v).iter().map(|&corner| {
            let (t, c) = (corner as usize / 3, corner as usize % 3);
            let [u, w] = [1, 2].map(|i| self.triangles[t][(c + i) % 3] as usize);
            let others = [self.places[u], self.places[w]];
            Facet { others, normals: self.normals[u] + self.normals[w], area: self.areas[t] }
        }));
    }

    /// Patches of the vertices that slide: those whose facets deviate.
    fn patches(&self, rings: &[Vec<u32>], settings: &Settings<'_>) -> Vec<Option<Patch>> {
        let patch = |star: &mut Vec<Facet>, v: usize| {
            let patch = Patch::new(&self.places, &self.normals, v, &rings[v])?;
            self.star(v as u32, star);
            let area: f64 = star.iter().map(|facet| facet.area).sum();
            (star_energy(star, &patch, DVec2::ZERO) > CALM * area).then_some(patch)
        };
        let work = (0..rings.len()).into_par_iter().with_min_len(CHUNK);
        settings.pool.install(|| work.map_init(Vec::new, patch).collect())
    }

    /// Moves every vertex that has a patch; returns how far each went in it.
    fn run(
        &mut self,
        rings: &[Vec<u32>],
        patches: &[Option<Patch>],
        settings: &Settings<'_>,
    ) -> Result<Vec<DVec2>, Canceled> {
        let mut moves = vec![DVec2::ZERO; rings.len()];
        let sliding = |v: &u32| patches[*v as usize].is_some();
        let colours: Vec<Vec<u32>> = colours(rings.len(), |v| &rings[v])
            .into_iter()
            .map(|colour| colour.into_iter().filter(sliding).collect())
            .collect();
        for colour in colours.iter().cycle().take(SWEEPS * colours.len()) {
            settings.cancel.check()?;
            let to = |star: &mut Vec<Facet>, &v: &u32| {
                self.star(v, star);
                step(star, patches[v as usize].as_ref()?, moves[v as usize])
            };
            let work = colour.par_iter().with_min_len(CHUNK);
            let steps: Vec<Option<DVec2>> = settings.pool.install(|| work.map_init(Vec::new, to).collect());
            for (&v, step) in colour.iter().zip(steps) {
                if let (Some(to), Some(patch)) = (step, &patches[v as usize]) {
                    moves[v as usize] = to;
                    (self.places[v as usize], self.normals[v as usize]) = patch.at(to);
                }
            }
        }
        Ok(moves)
    }
}

/// Slides the vertices whose facets deviate from the normals, and returns which moved.
pub fn slide(
    sampler: &Sampler<'_>,
    triangles: &[[u32; 3]],
    corners: &Corners,
    at: &mut OnZero,
    edge: f64,
) -> Result<Vec<u32>, Canceled> {
    /// A triangle without area is measured against this share of the mean.
    const SLIVER: f64 = 0.1;
    /// A move below this share of the reach is none.
    const MOVED: f64 = 0.02;
    let settings = sampler.settings();
    let normals: Vec<DVec3> = at.gradients.iter().map(|g| g.normalize_or(DVec3::Z)).collect();
    let across = |t: &[u32; 3]| {
        let [a, b, c] = t.map(|v| at.positions[v as usize]);
        (b - a).cross(c - a).length()
    };
    let mut areas: Vec<f64> = triangles.iter().map(across).collect();
    let least = SLIVER * areas.iter().sum::<f64>() / areas.len() as f64;
    areas.iter_mut().for_each(|area| *area = area.max(least));
    let next = |&corner: &u32| triangles[corner as usize / 3][(corner as usize % 3 + 1) % 3];
    let rings: Vec<Vec<u32>> = (0..normals.len() as u32).map(|v| corners.at(v).iter().map(next).collect()).collect();
    let mut surface = Slide { triangles, corners, places: at.positions.clone(), normals: normals.clone(), areas };
    let patches = surface.patches(&rings, settings);
    let moves = surface.run(&rings, &patches, settings)?;
    let far = |v: usize| patches[v].as_ref().is_some_and(|p| moves[v].length() > MOVED * p.reach);
    let moved: Vec<usize> = (0..moves.len()).filter(|&v| far(v)).collect();
    let points = moved.iter().map(|&v| surface.places[v]).collect();
    let own: Vec<DVec3> = moved.iter().map(|&v| normals[v]).collect();
    let found = project(sampler, points, &own, edge, 1e-3 * edge)?;
    let before = at.clone();
    for (k, &v) in moved.iter().enumerate() {
        (at.positions[v], at.values[v], at.gradients[v]) = (found.positions[k], found.values[k], found.gradients[k]);
    }
    take_back(triangles, corners, &moved, &before, at);
    Ok(moved.into_iter().map(|v| v as u32).collect())
}

/// Takes the corners of triangles back that the field turns over, where it is not what their neighbours' normals promised.
fn take_back(triangles: &[[u32; 3]], corners: &Corners, moved: &[usize], before: &OnZero, at: &mut OnZero) {
    /// How well a triangle agrees with the normals of its corners that none is taken back for.
    const AGREES: f64 = 0.3;
    let agreement = |at: &OnZero, t: u32| {
        let t = triangles[t as usize].map(|v| v as usize);
        let [a, b, c] = t.map(|v| at.positions[v]);
        let normal = (b - a).cross(c - a).normalize_or_zero();
        t.iter().map(|&v| normal.dot(at.gradients[v].normalize_or_zero())).fold(1.0, f64::min)
    };
    let mut stars: Vec<u32> = moved.iter().flat_map(|&v| corners.at(v as u32)).map(|&c| c / 3).collect();
    while !stars.is_empty() {
        stars.sort_unstable();
        stars.dedup();
        let worse = |&&t: &&u32| {
            let now = agreement(at, t);
            now < AGREES && now < agreement(before, t)
        };
        let mut back: Vec<u32> = stars.iter().filter(worse).flat_map(|&t| triangles[t as usize]).collect();
        back.retain(|&v| at.positions[v as usize] != before.positions[v as usize]);
        for v in back.iter().map(|&v| v as usize) {
            (at.positions[v], at.values[v], at.gradients[v]) =
                (before.positions[v], before.values[v], before.gradients[v]);
        }
        stars = back.iter().flat_map(|&v| corners.at(v)).map(|&c| c / 3).collect();
    }
}
