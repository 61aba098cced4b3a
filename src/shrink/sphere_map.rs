//! A bijection from a closed genus-0 mesh to the unit sphere.
//!
//! The mesh is decimated to a tetrahedron, the tetrahedron is laid on the sphere, and the vertices come back in reverse
//! order, each into the kernel of its ring, so that no spherical triangle ever turns over (Praun and Hoppe 2003,
//! "Spherical parametrization and remeshing"). After every insertion the neighbourhood is relaxed under an
//! [`Objective`]; each time the mesh has grown by a fixed factor the whole map is (`level`), and at the end Newton steps of
//! the whole map bring it to its minimum (`newton`). Every term of an objective is a barrier that is infinite where a
//! triangle would turn over.

mod decimate;
mod level;
mod newton;
mod star;
pub(super) mod system;

use super::density::Sampling;
use super::energy::{Objective, Reference};
use super::rings::{Mesh, Rings};
use crate::settings::{CancelToken, Canceled, Settings};
use decimate::decimate;
use glam::DVec3;
use level::Level;
use newton::{Descent, Effort, descend};
use star::Star;
use std::collections::HashSet;
use std::f64::consts::PI;

/// Softening of slivers in the reference triangles.
const SOFTENING: f64 = 0.02;
/// The whole map is relaxed each time it has grown by this factor.
const GROWTH: f64 = 1.6;
/// Sweeps at every such growth: while the mesh is small, and later.
const SWEEPS: (usize, usize) = (24, 2);
/// A mesh of fewer vertices is small.
const SMALL: usize = 500;
/// Sweeps before the last descent.
const LAST_SWEEPS: usize = 4;

/// How many Newton steps a growth is worth: this many vertices moved in all, within bounds. What is smooth over the whole
/// surface, the opening of a limb above all, is settled while the mesh is coarse and steps are cheap.
struct Steps {
    work: usize,
    fewest: usize,
    most: usize,
}
const NEWTON: Steps = Steps { work: 5_000, fewest: 2, most: 40 };
/// A descent at a growth.
const COARSE: Effort = Effort { steps: 0, products: 40, tolerance: 1e-3 };
/// The last descent.
const FINE: Effort = Effort { steps: 24, products: 40, tolerance: 2e-4 };
/// A new vertex whose energy per area is above this is in trouble, and a growing patch around it is relaxed.
const TROUBLE: f64 = 100.0;
/// A new vertex whose energy per area is below this many times the ideal leaves its ring as it is.
const CALM: f64 = 2.0;

/// A map at its minimum.
#[derive(Clone, Debug)]
pub struct SphereMap {
    /// Unit direction of every vertex.
    pub directions: Vec<DVec3>,
    /// Mean energy per area (ideal [`Objective::ideal`]).
    pub energy: f64,
}

/// Maps `mesh` to the sphere, for its surface to be sampled as `sampling` says: a unit direction for every vertex, every
/// spherical triangle positively oriented, and not far from the minimum, which [`settled`] takes it to. `None` when the mesh cannot be
/// decimated to a tetrahedron or an insertion finds no kernel.
pub fn sphere_map(
    mesh: &Mesh,
    sampling: &Sampling,
    objective: Objective,
    settings: &Settings<'_>,
) -> Result<Option<Vec<DVec3>>, Canceled> {
    // one visit to the pool: its threads stay awake between the many short parallel loops
    settings.pool.install(|| inserted(mesh, sampling, objective, settings))
}

/// The map that is at its minimum, from one of the same mesh, perhaps for another `sampling`.
pub fn settled(
    mesh: &Mesh,
    directions: Vec<DVec3>,
    sampling: &Sampling,
    objective: Objective,
    settings: &Settings<'_>,
) -> Result<SphereMap, Canceled> {
    let (directions, descent) = settings.pool.install(|| descended(mesh, directions, sampling, objective, settings))?;
    Ok(SphereMap { directions, energy: descent.energy / (4.0 * PI) })
}

/// All vertices brought to the minimum, and how that went.
fn descended(
    mesh: &Mesh,
    directions: Vec<DVec3>,
    sampling: &Sampling,
    objective: Objective,
    settings: &Settings<'_>,
) -> Result<(Vec<DVec3>, Descent), Canceled> {
    let (rings, shapes) = (mesh.rings.clone(), Shapes::new(mesh, sampling));
    let mut map = Inserter { directions, rings, shapes, objective, star: Star::default() };
    let mut active: Vec<u32> = (0..mesh.positions.len() as u32).collect();
    let (level, mut places) = map.level(&mut active, settings);
    sweep(&level, &mut places, LAST_SWEEPS, &objective, settings)?;
    let descent = descend(&level, &mut places, &objective, FINE, settings)?;
    map.take(&level, &places);
    Ok((map.directions, descent))
}

/// The map once every vertex is inserted.
fn inserted(
    mesh: &Mesh,
    sampling: &Sampling,
    objective: Objective,
    settings: &Settings<'_>,
) -> Result<Option<Vec<DVec3>>, Canceled> {
    let mut rings = mesh.rings.clone();
    let Some(log) = decimate(mesh, &mut rings, settings.cancel)? else {
        return Ok(None);
    };
    let n = mesh.positions.len();
    let mut map = Inserter {
        directions: vec![DVec3::ZERO; n],
        rings,
        shapes: Shapes::new(mesh, sampling),
        objective,
        star: Star::default(),
    };
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
        map.settle(*v, ring, active.len(), settings.cancel)?;
        if active.len() >= next_sweep && active.len() < n {
            next_sweep = (active.len() as f64 * GROWTH).ceil() as usize + 1;
            let sweeps = if active.len() < SMALL { SWEEPS.0 } else { SWEEPS.1 };
            let (level, mut places) = map.level(&mut active, settings);
            sweep(&level, &mut places, sweeps, &objective, settings)?;
            let effort = Effort { steps: (NEWTON.work / active.len()).clamp(NEWTON.fewest, NEWTON.most), ..COARSE };
            descend(&level, &mut places, &objective, effort, settings)?;
            map.take(&level, &places);
        }
    }
    Ok(Some(map.directions))
}

/// Sweeps until the energy falls slowly, at most six times as often as asked.
fn sweep(
    level: &Level,
    places: &mut [DVec3],
    sweeps: usize,
    objective: &Objective,
    settings: &Settings<'_>,
) -> Result<(), Canceled> {
    for round in 0..6 * sweeps {
        let fallen = level.sweep(places, objective, f64::INFINITY, settings)?;
        // an energy that was infinite falls by infinity
        if fallen < 1e-7 || (round + 1 >= sweeps && fallen < 0.5) {
            break;
        }
    }
    Ok(())
}

/// The map while vertices come back.
struct Inserter<'a> {
    shapes: Shapes<'a>,
    directions: Vec<DVec3>,
    rings: Rings,
    objective: Objective,
    star: Star,
}

/// What the triangles of the mesh are to look like on the sphere.
struct Shapes<'a> {
    positions: &'a [DVec3],
    sampling: &'a Sampling,
    /// Squared lengths on the sphere per squared length on the mesh and density, so that the whole mesh asks for the whole
    /// sphere.
    scale: f64,
}

impl<'a> Shapes<'a> {
    fn new(mesh: &'a Mesh, sampling: &'a Sampling) -> Self {
        let shapes = Self { positions: &mesh.positions, sampling, scale: 1.0 };
        let area = |t: [u32; 3]| {
            let [a, b, c] = shapes.stretched(t);
            0.5 * (b - a).cross(c - a).length() * shapes.density(t)
        };
        let whole: f64 = mesh.rings.triangles().into_iter().map(area).sum();
        Self { scale: 4.0 * PI / whole, ..shapes }
    }

    fn density(&self, t: [u32; 3]) -> f64 {
        t.iter().map(|&v| self.sampling.density[v as usize]).sum::<f64>() / 3.0
    }

    /// The corners of a triangle, stretched as its vertices ask for on average.
    fn stretched(&self, t: [u32; 3]) -> [DVec3; 3] {
        let [a, b, c] = t.map(|v| self.sampling.stretch[v as usize]);
        let mean = (a + b + c) * (1.0 / 3.0);
        t.map(|v| mean * self.positions[v as usize])
    }

    fn reference(&self, t: [u32; 3]) -> Reference {
        Reference::new(self.stretched(t), (self.scale * self.density(t)).sqrt(), SOFTENING)
    }
}

impl Inserter<'_> {
    /// The vertices that are there as a [`Level`], and their places. Sorts them, which keeps neighbours together in memory.
    fn level(&self, active: &mut [u32], settings: &Settings<'_>) -> (Level, Vec<DVec3>) {
        active.sort_unstable();
        let places = active.iter().map(|&v| self.directions[v as usize]).collect();
        let ring = |v| self.rings.ring(v);
        (Level::new(active.to_vec(), self.directions.len(), ring, |t| self.shapes.reference(t), settings), places)
    }

    /// Takes places back from a level.
    fn take(&mut self, level: &Level, places: &[DVec3]) {
        for (&v, &x) in level.vertices.iter().zip(places) {
            self.directions[v as usize] = x;
        }
    }

    fn gather(&mut self, v: u32) {
        self.star.clear();
        let ring = self.rings.ring(v);
        for (i, &b) in ring.iter().enumerate() {
            let c = ring[(i + 1) % ring.len()];
            let reference = self.shapes.reference([v, b, c]);
            self.star.push(self.directions[b as usize], self.directions[c as usize], &reference);
        }
    }

    /// Newton steps of one vertex; returns by how much the energy of its star fell, and that energy.
    fn relax(&mut self, v: u32, steps: usize) -> (f64, f64) {
        self.gather(v);
        let (mut fallen, mut energy) = (0.0, None);
        for _ in 0..steps {
            let Some(step) = self.star.relax(self.directions[v as usize], &self.objective) else { break };
            self.directions[v as usize] = step.to;
            fallen += step.before - step.after;
            energy = Some(step.after);
        }
        (fallen, energy.unwrap_or_else(|| self.star.energy(self.directions[v as usize], &self.objective)))
    }

    /// Energy and reference area of the star of `v`.
    fn star_energy(&mut self, v: u32) -> (f64, f64) {
        self.gather(v);
        (self.star.energy(self.directions[v as usize], &self.objective), self.star.area())
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
        let (_, mut energy) = self.relax(v, 2);
        // the sweeps at the next growth are enough for a ring that is well
        let calm = size >= SMALL && energy < CALM * self.objective.ideal() * self.star.area();
        let (rounds, most) = (if size < 200 { 3 } else { 1 }, if calm { 0 } else { 80 });
        for round in 0..most {
            let around: f64 = ring.iter().map(|&u| self.relax(u, 1).0).sum();
            let (fallen, left) = self.relax(v, 1);
            energy = left;
            if round + 1 >= rounds && energy.is_finite() && around + fallen < 0.05 * energy {
                break;
            }
        }
        // the star is still that of `v`
        let area = self.star.area();
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
                    self.relax(if round % 2 == 0 { patch[i] } else { patch[patch.len() - 1 - i] }, 1);
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
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::measure::fixtures::with_settings;
    use crate::settings::Progress;

    /// A sphere of `rows` x `columns` with a limb of this length drawn out of its top.
    pub(super) fn limb(rows: usize, columns: usize, length: f64) -> Mesh {
        let mut positions = vec![DVec3::new(0.0, 0.0, 1.0 + length)];
        for row in 1..rows {
            let polar = PI * row as f64 / rows as f64;
            for column in 0..columns {
                let around = 2.0 * PI * column as f64 / columns as f64;
                let stretch = length * (-(polar / 0.35).powi(4)).exp();
                let p = DVec3::new(polar.sin() * around.cos(), polar.sin() * around.sin(), polar.cos() + stretch);
                positions.push(p);
            }
        }
        positions.push(-DVec3::Z);
        let at = |row: usize, column: usize| match row {
            0 => 0,
            row if row == rows => (1 + (rows - 1) * columns) as u32,
            row => (1 + (row - 1) * columns + column % columns) as u32,
        };
        let mut triangles = Vec::new();
        for row in 0..rows {
            for column in 0..columns {
                let quad = [at(row, column), at(row + 1, column), at(row + 1, column + 1), at(row, column + 1)];
                if row + 1 < rows {
                    triangles.push([quad[0], quad[1], quad[2]]);
                }
                if row > 0 {
                    triangles.push([quad[0], quad[2], quad[3]]);
                }
            }
        }
        let rings = Rings::new(positions.len(), &triangles).expect("a closed mesh");
        Mesh { positions, rings }
    }

    pub(super) const ISOMETRIC: Objective = Objective { isometry: 1.0, area: 1.0, angle: 0.0 };

    pub(super) fn map(mesh: &Mesh, objective: Objective, threads: usize) -> (Vec<DVec3>, Descent) {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        let cancel = CancelToken::new();
        let settings = Settings { pool: &pool, cancel: &cancel, progress: &|_: Progress| {}, watched: false };
        let sampling = Sampling::even(mesh.positions.len());
        let rough = sphere_map(mesh, &sampling, objective, &settings).unwrap().expect("a map");
        descended(mesh, rough, &sampling, objective, &settings).unwrap()
    }

    fn bijective(mesh: &Mesh, map: &[DVec3]) {
        let mut whole = 0.0;
        for t in mesh.rings.triangles() {
            let [a, b, c] = t.map(|v| map[v as usize]);
            let volume = a.dot(b.cross(c));
            assert!(volume > 0.0, "{t:?} is turned over");
            // solid angle (Van Oosterom and Strackee 1983)
            whole += 2.0 * volume.atan2(1.0 + a.dot(b) + b.dot(c) + c.dot(a));
        }
        assert!((whole - 4.0 * PI).abs() < 1e-9, "covered {} times", whole / (4.0 * PI));
    }

    #[test]
    fn a_sphere_goes_to_itself_without_distortion() {
        let mesh = limb(24, 36, 0.0);
        let (map, descent) = map(&mesh, ISOMETRIC, 1);
        bijective(&mesh, &map);
        // the slivers at the poles are softened, which makes their references a little wrong
        let energy = descent.energy / (4.0 * PI);
        assert!(energy < 1.05 * ISOMETRIC.ideal(), "{energy}");
    }

    #[test]
    fn a_long_limb_is_mapped_bijectively_for_every_objective_and_the_descent_converges() {
        let mesh = limb(60, 40, 8.0);
        for objective in [
            ISOMETRIC,
            Objective { isometry: 0.1, area: 0.0, angle: 1.0 },
            Objective { isometry: 0.5, area: 8.0, angle: 0.0 },
        ] {
            let (map, descent) = map(&mesh, objective, 2);
            bijective(&mesh, &map);
            assert!(descent.decrement < 1e-3, "{objective:?} {descent:?}");
        }
    }

    #[test]
    fn the_map_has_the_same_bits_for_any_number_of_threads() {
        let mesh = limb(80, 64, 2.0);
        assert!(mesh.positions.len() > level::PARALLEL, "large enough to run in parallel");
        assert_eq!(map(&mesh, ISOMETRIC, 1).0, map(&mesh, ISOMETRIC, 7).0);
    }

    /// A mesh with a map that is a bijection, and a bad one: the direction from inside the limb's foot.
    pub(super) fn bad(mesh: &Mesh, settings: &Settings<'_>) -> (Level, Vec<DVec3>) {
        let sampling = Sampling::even(mesh.positions.len());
        let shapes = Shapes::new(mesh, &sampling);
        let vertices: Vec<u32> = (0..mesh.positions.len() as u32).collect();
        let level =
            Level::new(vertices, mesh.positions.len(), |v| mesh.rings.ring(v), |t| shapes.reference(t), settings);
        (level, mesh.positions.iter().map(|p| (*p - 0.5 * DVec3::Z).normalize()).collect())
    }

    #[test]
    fn sweeps_and_newton_steps_never_raise_the_energy() {
        let mesh = limb(30, 30, 3.0);
        with_settings(1, |settings| {
            let (level, mut places) = bad(&mesh, settings);
            let mut last = level.energy(&places, &ISOMETRIC, settings);
            for round in 0..12 {
                if round % 2 == 0 {
                    level.sweep(&mut places, &ISOMETRIC, f64::INFINITY, settings).unwrap();
                } else {
                    let effort = Effort { steps: 1, products: 30, tolerance: 0.0 };
                    descend(&level, &mut places, &ISOMETRIC, effort, settings).unwrap();
                }
                let energy = level.energy(&places, &ISOMETRIC, settings);
                assert!(energy <= last + 1e-9 * last, "{last} -> {energy} in round {round}");
                last = energy;
            }
            assert!(last.is_finite());
        });
    }

    #[test]
    fn a_sweep_follows_what_still_moves() {
        let mesh = limb(30, 30, 3.0);
        with_settings(1, |settings| {
            let (level, places) = bad(&mesh, settings);
            let fallen = |notable: f64| {
                let mut places = places.clone();
                let before = level.energy(&places, &ISOMETRIC, settings);
                let told = level.sweep(&mut places, &ISOMETRIC, notable, settings).unwrap();
                let fallen = before - level.energy(&places, &ISOMETRIC, settings);
                assert!((told - fallen).abs() < 1e-9 * before, "told {told}, fell by {fallen}");
                fallen
            };
            assert!(fallen(0.0) > 1.2 * fallen(f64::INFINITY), "{} {}", fallen(0.0), fallen(f64::INFINITY));
        });
    }
}
