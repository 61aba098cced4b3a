//! Vertices slid along the surface until facets agree with its normals.
//!
//! On a limb the map's cells are long and thin, and where the surface bends along them, a vertex halfway between two others
//! lifts its facets off the tangent plane, like the folds of Schwarz's lantern. Sliding by a fraction of a cell takes that away. Vertices move
//! on the surface to second order, as their neighbours' normals give it; the field is asked only where they end.

use super::colours::colours;
use super::energy::{inverse_positive, tangents};
use super::lattice::SphereLattice;
use super::unfold::Corners;
use super::untangle::normal;
use super::zero::{OnZero, project};
use crate::field::Sampler;
use crate::settings::{Canceled, Settings};
use glam::{DMat2, DMat3, DVec2, DVec3};
use rayon::prelude::*;

/// Sweeps over all vertices that slide.
const SWEEPS: usize = 6;
/// Weight of a facet's change of area against its normal's deviation.
const KEEP: f64 = 0.15;
/// What has less than this share of its due on the sphere is drawn up to it.
const FLOOR: f64 = 0.7;
/// Weight of how much the normals of a facet's corners differ: what is curved gets smaller facets.
const SPREAD: f64 = 1.5;
/// A vertex whose facets deviate less than this, on average, stays.
const CALM: f64 = 0.012;
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

/// A facet of a vertex's star.
struct Facet {
    /// Its other two corners, ...
    others: [DVec3; 2],
    /// ... and the sum of their normals.
    normals: DVec3,
    /// Twice the area it is to have.
    area: f64,
}

impl Facet {
    /// Twice the area times how far the facet is from the normals of its corners, and from the area it is to have.
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
    /// Twice the area that every triangle is to have: what it began with, and not much less than its due.
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

/// Slides the vertices whose facets deviate from the normals, and returns which moved. `triangles` are those of the lattice,
/// `edge` its typical edge on the surface.
pub fn slide(
    sampler: &Sampler<'_>,
    lattice: &SphereLattice,
    triangles: &[[u32; 3]],
    at: &mut OnZero,
    edge: f64,
) -> Result<Vec<u32>, Canceled> {
    /// A move below this share of the reach is none.
    const MOVED: f64 = 0.02;
    let settings = sampler.settings();
    let corners = Corners::new(at.positions.len(), triangles);
    let normals: Vec<DVec3> = at.gradients.iter().map(|g| g.normalize_or(DVec3::Z)).collect();
    let areas = |places: &[DVec3]| -> Vec<f64> { triangles.iter().map(|&t| normal(places, t).length()).collect() };
    let (mut areas, dues) = (areas(&at.positions), areas(&lattice.directions));
    let scale = FLOOR * areas.iter().sum::<f64>() / dues.iter().sum::<f64>();
    for (area, due) in areas.iter_mut().zip(dues) {
        *area = area.max(scale * due);
    }
    let next = |&corner: &u32| triangles[corner as usize / 3][(corner as usize % 3 + 1) % 3];
    let rings: Vec<Vec<u32>> = (0..normals.len() as u32).map(|v| corners.at(v).iter().map(next).collect()).collect();
    let mut surface =
        Slide { triangles, corners: &corners, places: at.positions.clone(), normals: normals.clone(), areas };
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
    take_back(triangles, &corners, &moved, &before, at);
    Ok(moved.into_iter().map(|v| v as u32).collect())
}

/// Takes the corners of triangles back that the field turns over, where it is not what their neighbours' normals promised.
fn take_back(triangles: &[[u32; 3]], corners: &Corners, moved: &[usize], before: &OnZero, at: &mut OnZero) {
    /// How well a triangle agrees with the normals of its corners that none is taken back for.
    const AGREES: f64 = 0.3;
    let agreement = |at: &OnZero, t: u32| {
        let t = triangles[t as usize];
        let normal = normal(&at.positions, t).normalize_or_zero();
        t.iter().map(|&v| normal.dot(at.gradients[v as usize].normalize_or_zero())).fold(1.0, f64::min)
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

#[cfg(test)]
mod tests {
    use super::super::lattice::LatticeSpec;
    use super::*;
    use crate::field::sampler::Tally;
    use crate::field::scene::Scene;
    use crate::measure::fixtures::with_settings;
    use serde_json::json;

    const MAJOR: f64 = 0.6;
    const MINOR: f64 = 0.1;

    /// The middle of the tube at an angle around the z axis, and the tube's direction there.
    fn bend(angle: f64) -> (DVec3, DVec3) {
        (MAJOR * DVec3::new(angle.cos(), angle.sin(), 0.0), DVec3::new(-angle.sin(), angle.cos(), 0.0))
    }

    /// A lattice on a limb that is bent almost to a ring, a torus but for its ends: cells ten times as long as they are wide,
    /// every other vertex `pushed` along the limb.
    fn limb(pushed: f64) -> (SphereLattice, Vec<[u32; 3]>, Scene, OnZero) {
        let lattice = SphereLattice::new(LatticeSpec::Octahedral { n: 12 });
        let triangles = lattice.triangles(&vec![false; lattice.quads.len()]);
        let field = Scene::from_value(&json!({"torus": {"major": MAJOR, "minor": MINOR}})).expect("a scene");
        let place = |(v, d): (usize, &DVec3)| {
            let push = if v % 2 == 0 { pushed * (1.0 - d.z.abs()) } else { 0.0 };
            let (middle, along) = bend(2.8 * (d.z + push));
            let flat = DVec3::new(d.x, d.y, 0.0).normalize_or_zero();
            let normal = flat.x * middle.normalize() - flat.y * DVec3::Z;
            if d.z.abs() > 0.98 { (middle, along * d.z.signum()) } else { (middle + MINOR * normal, normal) }
        };
        let (positions, gradients): (Vec<DVec3>, _) = lattice.directions.iter().enumerate().map(place).unzip();
        (lattice, triangles, field, OnZero { values: vec![0.0; positions.len()], positions, gradients })
    }

    /// Mean deviation of facets from the torus's normals at their middles, away from the ends.
    fn deviation(triangles: &[[u32; 3]], lattice: &SphereLattice, at: &OnZero) -> f64 {
        let normal = |p: DVec3| (p - MAJOR * DVec3::new(p.x, p.y, 0.0).normalize()).normalize();
        let (mut deviation, mut whole) = (0.0, 0.0);
        for t in triangles.iter().filter(|t| t.iter().all(|&v| lattice.directions[v as usize].z.abs() < 0.9)) {
            let across = super::normal(&at.positions, *t);
            let middle = t.iter().map(|&v| at.positions[v as usize]).sum::<DVec3>() / 3.0;
            deviation += across.length() - across.dot(normal(middle));
            whole += across.length();
        }
        deviation / whole
    }

    fn slid(
        threads: usize,
        at: &OnZero,
        field: &Scene,
        triangles: &[[u32; 3]],
        lattice: &SphereLattice,
    ) -> (OnZero, usize, u64) {
        with_settings(threads, |settings| {
            let (tally, mut at) = (Tally::new(), at.clone());
            let sampler = Sampler::new(field, *settings, &tally);
            let moved = slide(&sampler, lattice, triangles, &mut at, 0.05).expect("slides");
            (at, moved.len(), tally.total().gradient)
        })
    }

    #[test]
    fn facets_agree_better_and_vertices_stay_on_the_zero_level_set() {
        let (lattice, triangles, field, at) = limb(0.06);
        let (after, moved, evaluated) = slid(2, &at, &field, &triangles, &lattice);
        let (first, last) = (deviation(&triangles, &lattice, &at), deviation(&triangles, &lattice, &after));
        assert!(last < 0.7 * first, "{first} to {last}");
        assert!(moved > 100 && evaluated <= 3 * moved as u64, "{moved} moved, {evaluated} evaluated");
        let off = |p: &DVec3| (p.z.hypot(p.x.hypot(p.y) - MAJOR) - MINOR).abs();
        let tube = (0..at.positions.len()).filter(|&v| lattice.directions[v].z.abs() < 0.9);
        assert!(tube.into_iter().all(|v| off(&after.positions[v]) < 1e-3));
        let (alone, ..) = slid(1, &at, &field, &triangles, &lattice);
        assert_eq!(alone.positions, after.positions, "the same bits for any number of threads");
    }

    #[test]
    fn what_agrees_already_stays_and_costs_nothing() {
        let lattice = SphereLattice::new(LatticeSpec::Octahedral { n: 24 });
        let triangles = lattice.triangles(&vec![false; lattice.quads.len()]);
        let field = Scene::from_value(&json!({"sphere": {"radius": 1}})).expect("a scene");
        let positions = lattice.directions.clone();
        let at = OnZero { values: vec![0.0; positions.len()], gradients: positions.clone(), positions };
        let (after, moved, evaluated) = slid(1, &at, &field, &triangles, &lattice);
        assert_eq!((after.positions == at.positions, moved, evaluated), (true, 0, 0));
    }

    #[test]
    fn edges_and_tips_are_not_left() {
        let ring: Vec<u32> = (1..5).collect();
        let places = [DVec3::ZERO, DVec3::X, DVec3::Y, -DVec3::X, -DVec3::Y];
        let flat = [DVec3::Z; 5];
        let patch = Patch::new(&places, &flat, 0, &ring).expect("a flat place");
        assert_eq!(patch.at(DVec2::new(0.1, 0.0)).0.z, 0.0);
        let mut edge = flat;
        edge[1] = DVec3::X;
        assert!(Patch::new(&places, &edge, 0, &ring).is_none());
    }

    #[test]
    fn a_patch_follows_a_sphere_to_second_order() {
        let (lattice, triangles, ..) = limb(0.0);
        let sphere = &lattice.directions;
        let corners = Corners::new(sphere.len(), &triangles);
        let v = 100;
        let ring: Vec<u32> =
            corners.at(v).iter().map(|&c| triangles[c as usize / 3][(c as usize % 3 + 1) % 3]).collect();
        let patch = Patch::new(sphere, sphere, v as usize, &ring).expect("a smooth place");
        let (place, normal) = patch.at(DVec2::new(0.02, -0.01));
        assert!((place.length() - 1.0).abs() < 1e-5 && normal.dot(place.normalize()) > 1.0 - 1e-5, "{place} {normal}");
    }
}
