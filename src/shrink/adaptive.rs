//! `method: adaptive`: contract, remesh, map, resample, untangle; again and finer where the result is folded.

use super::base::base;
use super::cells;
use super::contract::{Refusal, Resolution, contract};
use super::creases::{choose_diagonals, snap};
use super::denser::{denser, denser_at};
use super::density::Sampling;
use super::lattice::{LatticeSpec, SphereLattice};
use super::reclaim::{Base, missed, reclaim};
use super::resample::{land, orient};
use super::rings::Mesh;
use super::separate::separate;
use super::slide::slide;
use super::sphere_map::{SphereMap, settled, sphere_map};
use super::unfold::Corners;
use super::untangle::Tangle;
use super::zero::{OnZero, project};
use super::{Density, Distortion, Effort, ShrinkError, ShrinkSpec, Wrap};
use crate::field::{Field, Frame, Sampler};
use crate::settings::{Canceled, Front, Progress, Settings};
use glam::DVec3;

/// What one attempt works with.
struct Attempt {
    resolution: Resolution,
    /// Factor on [`base_vertices`].
    fineness: f64,
    /// Share of the base's diagonal that the lattice may miss the base by before more of the sphere is asked for there: in
    /// the first attempt a little more than half of what a result may miss, because the field still has to be met.
    missed: f64,
    /// Rounds of asking for more of the sphere there,
    denser: usize,
    /// and by how much at most in each.
    rise: f64,
    /// Factor on the density around the places where the attempt before went wrong.
    insist: f64,
    /// Where its share of the progress starts and ends.
    share: (f32, f32),
}

const ATTEMPTS: [Attempt; 3] = [
    Attempt {
        resolution: Resolution { levels: 3, local: 0 },
        fineness: 1.0,
        missed: 0.0055,
        denser: 4,
        rise: 2.0,
        insist: 1.0,
        share: (0.0, 0.7),
    },
    Attempt {
        resolution: Resolution { levels: 3, local: 2 },
        fineness: 2.0,
        missed: 0.003,
        denser: 6,
        rise: 2.0,
        insist: 1.2,
        share: (0.7, 0.9),
    },
    Attempt {
        resolution: Resolution { levels: 4, local: 1 },
        fineness: 2.0,
        missed: 0.0015,
        denser: 6,
        rise: 3.0,
        insist: 3.0,
        share: (0.9, 1.0),
    },
];

/// Vertices of the base surface that a lattice is sampled from: half as many as the default lattice has, and more slowly
/// growing than the lattice, because what is finer than the base the field itself says.
fn base_vertices(lattice: &SphereLattice) -> f64 {
    /// Base vertices of a lattice of 20,000.
    const USUAL: f64 = 10_000.0;
    /// A coarser base loses limbs that the front has.
    const FEWEST: f64 = 2_000.0;
    const GROWTH: f64 = 0.6;
    (USUAL * (lattice.directions.len() as f64 / 20_000.0).powf(GROWTH)).max(FEWEST)
}

/// Makes one attempt; a refusal that a finer lattice could see differently is looked at by the later ones.
pub fn run(
    sampler: &Sampler<'_>,
    spec: &ShrinkSpec,
    weight: Option<&dyn Field>,
    effort: &Effort,
) -> Result<Wrap, ShrinkError> {
    let lattice = SphereLattice::new(spec.lattice);
    let first = (effort.attempt as usize).min(ATTEMPTS.len() - 1);
    let mut refusal = None;
    for attempt in &ATTEMPTS[first..] {
        match one(sampler, spec, weight, &lattice, attempt, &effort.places) {
            Ok(wrap) => return Ok(wrap),
            Err(refused) if !refused.certain => refusal = Some(refused.error),
            Err(refused) => return Err(refused.error),
        }
    }
    Err(refusal.unwrap_or(ShrinkError::Unmapped))
}

fn one(
    scene: &Sampler<'_>,
    spec: &ShrinkSpec,
    weight: Option<&dyn Field>,
    lattice: &SphereLattice,
    attempt: &Attempt,
    places: &[DVec3],
) -> Result<Wrap, Refusal> {
    let settings = *scene.settings();
    let (start, end) = attempt.share;
    let stage = |name: &'static str, done: f32, told: Progress| {
        scene.tally().stage(name);
        (settings.progress)(Progress { stage: name, fraction: start + (end - start) * done, ..told });
    };
    let nothing = Progress::default;
    stage("contract", 0.0, nothing());
    let front = contract(scene, attempt.resolution, places)?;
    let frame = front.frame;
    let show = |positions: &[DVec3], triangles: Vec<[u32; 3]>, places: &[DVec3]| Front {
        positions: positions.iter().map(|&p| frame.to_scene(p).as_vec3().to_array()).collect(),
        triangles,
        places: places.iter().map(|d| d.as_vec3().to_array()).collect(),
    };
    let farthest = |at: &OnZero| frame.scale * at.values.iter().fold(0.0, |far: f64, value| far.max(value.abs()));
    let on_lattice = |at: &OnZero, triangles, flips: usize| Progress {
        front: Some(show(&at.positions, triangles, &lattice.directions)),
        max_distance: Some(farthest(at)),
        flips: Some(flips as u64),
        ..Progress::default()
    };
    let unmapped = |mesh: &Mesh| Progress {
        front: Some(show(&mesh.positions, mesh.rings.triangles(), &[])),
        ..Progress::default()
    };
    stage("remesh", 0.25, unmapped(&front.mesh));
    let sampler = scene.framed(frame);
    let mesh = base(front, (attempt.fineness * base_vertices(lattice)) as usize, &sampler)?;
    stage("map", 0.45, unmapped(&mesh));
    let mut sampling = sampling(&mesh, scene, frame, spec, weight)?;
    let wanting: Vec<DVec3> = places.iter().map(|&p| frame.from_scene(p)).collect();
    denser_at(&mesh, &wanting, attempt.insist, &mut sampling.density);
    let mut objective = spec.distortion.objective();
    let directions = sphere_map(&mesh, &sampling, objective, &settings)?.ok_or(ShrinkError::Unmapped)?;
    let mut map = match suits_cells(spec) {
        false => settled(&mesh, directions, &sampling, objective, &settings)?,
        true => {
            objective.area *= cells::AREA;
            let plain = sampling.stretch.clone();
            let mut fitted = |directions: Vec<DVec3>| {
                let fit = cells::fit(&mesh, &directions);
                sampling.stretch = plain.iter().zip(fit).map(|(plain, fit)| fit * *plain).collect();
                settled(&mesh, directions, &sampling, objective, &settings)
            };
            // a map that has moved has other cells
            let first = fitted(directions)?;
            fitted(first.directions)?
        }
    };
    stage("resample", 0.75, Progress { energy: Some(map.energy), ..nothing() });
    let mut landing = Landing::new(&mesh, &map, lattice, &settings)?;
    let mapped = show(&mesh.positions, mesh.rings.triangles(), &landing.directions);
    stage("resample", 0.76, Progress { front: Some(mapped), energy: Some(map.energy), ..nothing() });
    for round in 1..=attempt.denser {
        let base = Base { mesh: &mesh, directions: &landing.directions };
        let missed = missed(&base, lattice, &landing.positions, settings.cancel)?;
        if !denser(&mesh, &missed, attempt.missed, attempt.rise, &mut sampling.density) {
            break;
        }
        map = settled(&mesh, map.directions, &sampling, objective, &settings)?;
        stage("resample", 0.76 + 0.02 * round as f32, Progress { energy: Some(map.energy), ..nothing() });
        landing = Landing::new(&mesh, &map, lattice, &settings)?;
    }
    let Landing { directions, positions: landed, normals } = landing;
    let edge = (mesh.area() / lattice.directions.len() as f64).sqrt();
    let mut at = project(&sampler, landed.clone(), &normals, edge, 1e-3 * edge)?;
    stage("untangle", 0.85, Progress { max_distance: Some(farthest(&at)), ..nothing() });
    let mut diagonals = vec![false; lattice.quads.len()];
    choose_diagonals(&sampler, lattice, &at, &mut diagonals, |_| true)?;
    let triangles = lattice.triangles(&diagonals);
    let tangle = Tangle::new(&sampler, &triangles, &at.positions);
    let folds = tangle.relax_patches(&mut at, &landed, 2)?;
    stage("slide", 0.92, on_lattice(&at, triangles.clone(), folds));
    let moved = slide(&sampler, lattice, &triangles, &mut at, edge)?;
    turn_diagonals(&sampler, lattice, &at, &mut diagonals, &moved)?;
    let triangles = lattice.triangles(&diagonals);
    stage("sharpen", 0.95, on_lattice(&at, triangles, folds));
    let blunt = at.positions.clone();
    let base = Base { mesh: &mesh, directions: &directions };
    let diagonals = sharpen(&sampler, &base, lattice, &mut at, diagonals)?;
    let triangles = lattice.triangles(&diagonals);
    stage("separate", 0.97, on_lattice(&at, triangles, folds));
    let to_scene = |list: &[DVec3]| -> Vec<DVec3> { list.iter().map(|&p| frame.to_scene(p)).collect() };
    let mut wrap = Wrap {
        lattice: lattice.clone(),
        positions: to_scene(&at.positions),
        values: at.values.iter().map(|s| s * frame.scale).collect(),
        gradients: at.gradients,
        diagonals,
    };
    let left = separate(scene, &mut wrap, &[&to_scene(&blunt), &to_scene(&landed)], places, 0)?;
    stage("separate", 1.0, Progress { flips: Some(left.folds as u64), ..nothing() });
    Ok(wrap)
}

/// How the base `mesh`, which is in `frame`, is to be sampled.
fn sampling(
    mesh: &Mesh,
    scene: &Sampler<'_>,
    frame: Frame,
    spec: &ShrinkSpec,
    weight: Option<&dyn Field>,
) -> Result<Sampling, ShrinkError> {
    let even = Sampling::even(mesh.positions.len());
    let sampling = match spec.density {
        Density::Area => even,
        Density::Curvature if spec.distortion == Distortion::Angle => {
            // a stretched surface has other angles
            Sampling { stretch: even.stretch, ..Sampling::by_curvature(mesh) }
        }
        Density::Curvature => Sampling::by_curvature(mesh),
        Density::Reach => Sampling::by_reach(mesh, scene.settings()),
        Density::Weight => {
            let weight = Sampler::new(weight.ok_or(ShrinkError::NoWeight)?, *scene.settings(), scene.tally());
            let places = mesh.positions.iter().map(|&p| frame.to_scene(p));
            Sampling::by_weight(mesh, places, &weight)?.ok_or(ShrinkError::NoWeight)?
        }
    };
    Ok(sampling)
}

/// Whether the map is to suit the cells of the lattice: where facets are what counts, and the cells are uneven.
fn suits_cells(spec: &ShrinkSpec) -> bool {
    matches!(spec.lattice, LatticeSpec::Octahedral { .. })
        && spec.density == Density::Curvature
        && spec.distortion != Distortion::Angle
}

/// A lattice on the base surface.
struct Landing {
    /// Direction of every base vertex, in the lattice's turn.
    directions: Vec<DVec3>,
    /// Where every lattice vertex landed.
    positions: Vec<DVec3>,
    /// The base's normals there.
    normals: Vec<DVec3>,
}

impl Landing {
    fn new(mesh: &Mesh, map: &SphereMap, lattice: &SphereLattice, settings: &Settings<'_>) -> Result<Self, Canceled> {
        let directions = orient(mesh, &map.directions, lattice.spec, settings);
        let (positions, normals) = land(mesh, &directions, lattice, settings)?;
        Ok(Self { directions, positions, normals })
    }
}

/// Moves vertices onto creases and to what the base has and the lattice misses, and turns diagonals along them. What that
/// folds or lets cross is repaired later.
fn sharpen(
    sampler: &Sampler<'_>,
    base: &Base<'_>,
    lattice: &SphereLattice,
    at: &mut OnZero,
    mut diagonals: Vec<bool>,
) -> Result<Vec<bool>, ShrinkError> {
    let triangles = lattice.triangles(&diagonals);
    let corners = Corners::new(at.positions.len(), &triangles);
    let mut moved = snap(sampler, &triangles, &corners, at)?;
    let edge = (base.mesh.area() / lattice.directions.len() as f64).sqrt();
    moved.extend(reclaim(sampler, base, lattice, &triangles, &corners, at, edge)?);
    turn_diagonals(sampler, lattice, at, &mut diagonals, &moved)?;
    Ok(diagonals)
}

/// Chooses the diagonals around vertices that have moved.
fn turn_diagonals(
    sampler: &Sampler<'_>,
    lattice: &SphereLattice,
    at: &OnZero,
    diagonals: &mut [bool],
    moved: &[u32],
) -> Result<(), Canceled> {
    let mut mask = vec![false; at.positions.len()];
    moved.iter().for_each(|&v| mask[v as usize] = true);
    choose_diagonals(sampler, lattice, at, diagonals, |v| mask[v])
}
