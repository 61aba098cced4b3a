//! `relax_uv`: the chart of a lattice relaxed inside its square, towards the least distortion against the surface.
//!
//! The cut stays where the lattice has it: chart vertices on its two sides are apart and move by themselves. Vertices on
//! the square's border slide along their side, corners stay. So every place of the square is kept in use, no two parts of the
//! border can meet, and the map stays a bijection for a simple reason: its border runs once around the square in order and
//! every triangle is positive, so every place is covered once (the degree of the map). A free border could
//! lower the distortion further, at the price of the square: its parts may meet, and must be kept apart one by one.
//!
//! The poles of a lat-long chart are teeth, one per sector, with gaps between them. The gaps are filled with triangles that
//! stand for no surface, so that the argument holds there, too.
//!
//! The energy is the objective of the sphere map, infinite where a triangle would turn over, brought to its minimum by
//! Newton steps of the whole chart (`system`). Every step ends at coordinates in single precision, as they are written: what
//! is positive here is positive in the file.

mod sweep;
mod system;

use super::Distortion;
use super::colours::colours;
use super::energy::{Objective, Reference};
use super::lattice::{LatticeSpec, SphereLattice};
use crate::settings::{Canceled, Progress, Settings};
use glam::{DMat2, DVec2, DVec3};
use rayon::prelude::*;
use system::{Rows, System};

/// Softening of slivers in the reference triangles, as in the sphere map.
const SOFTENING: f64 = 0.02;
/// Weight of a triangle that stands for no surface, against one that does: it may be squeezed to some hundredth of what
/// it was, and not further.
const FILLING: f64 = 1e-3;
/// Newton steps at most.
const STEPS: usize = 60;
/// Products with the Hessian in each, at most.
const PRODUCTS: usize = 100;
/// Share of the energy that may be left to gain.
const TOLERANCE: f64 = 5e-4;
/// Least ratio of areas that counts as positive.
const POSITIVE: f64 = 1e-12;
/// Items per piece of parallel work; fixed, so that sums do not depend on the number of threads.
const CHUNK: usize = 512;

/// Width of a lattice's chart by its height: the lat-long square is a picture of the 2 : 1 rectangle (theta, phi), and is
/// relaxed as that.
fn aspect(spec: LatticeSpec) -> f64 {
    match spec {
        LatticeSpec::Latlong { .. } => 2.0,
        LatticeSpec::Octahedral { .. } => 1.0,
    }
}

/// UVs of every chart vertex, relaxed: in [0, 1] squared, v downwards, exact in single precision. `positions` are those of
/// the welded vertices, `triangles` are over chart vertices. A surface without area keeps its chart. Tells the stage `relax` with
/// the energy per area, from 0 to 1.
///
/// # Errors
/// When the token is raised.
pub fn relax(
    lattice: &SphereLattice,
    triangles: &[[u32; 3]],
    positions: &[DVec3],
    distortion: Distortion,
    settings: &Settings<'_>,
) -> Result<Vec<[f64; 2]>, Canceled> {
    let Some((chart, mut places)) = Chart::new(lattice, triangles, positions, distortion.chart_objective()) else {
        return Ok(lattice.uv.clone());
    };
    // one visit to the pool: its threads stay awake between the many short parallel loops
    settings.pool.install(|| chart.descend(&mut places, settings))?;
    Ok(places[..lattice.uv.len()].iter().map(|p| [p.x / aspect(lattice.spec), -p.y]).collect())
}

/// A triangle of the chart and what it is measured against.
struct Piece {
    corners: [u32; 3],
    /// Gradients of the corners' hat functions on the reference triangle.
    hats: [DVec2; 3],
    /// Area of the reference triangle.
    area: f64,
    /// Factor on its energy per area: its area, unless it stands for no surface.
    weight: f64,
}

impl Piece {
    fn new(corners: [u32; 3], reference: &Reference, weight: f64) -> Self {
        let ([cx, cb, _], area) = (reference.cotangents, reference.area);
        // the reference in its own plane: the first corner at the origin, the second along the first axis
        let base = (2.0 * area * (cx + cb)).sqrt();
        let apex = DVec2::new(2.0 * area * cx / base, 2.0 * area / base);
        let hat_b = DVec2::new(1.0, -apex.x / apex.y) / base;
        let hat_c = DVec2::new(0.0, 1.0 / apex.y);
        Self { corners, hats: [-hat_b - hat_c, hat_b, hat_c], area, weight: weight * area }
    }

    /// Jacobian of the map from the reference, and the ratio of areas. The ratio's sign is that which the certificate finds in
    /// the chart.
    fn jacobian(&self, [a, b, c]: [DVec2; 3]) -> (DMat2, f64) {
        let (ab, ac) = (b - a, c - a);
        (outer(ab, self.hats[1]) + outer(ac, self.hats[2]), ab.perp_dot(ac) / (2.0 * self.area))
    }

    fn places(&self, places: &[DVec2]) -> [DVec2; 3] {
        self.corners.map(|v| places[v as usize])
    }

    fn energy(&self, places: &[DVec2], objective: &Objective) -> f64 {
        self.energy_at(self.places(places), objective)
    }

    fn energy_at(&self, corners: [DVec2; 3], objective: &Objective) -> f64 {
        let (jacobian, d) = self.jacobian(corners);
        if d.is_nan() || d <= POSITIVE {
            return f64::INFINITY;
        }
        self.weight * objective.value(squared(jacobian), d)
    }
}

/// Squared Frobenius norm.
fn squared(m: DMat2) -> f64 {
    m.x_axis.length_squared() + m.y_axis.length_squared()
}

/// u v^T.
fn outer(u: DVec2, v: DVec2) -> DMat2 {
    DMat2::from_cols(u * v.x, u * v.y)
}

/// The nearest place that single precision can write.
fn single(p: DVec2) -> DVec2 {
    p.as_vec2().as_dvec2()
}

/// A chart to be relaxed, in a rectangle with y upwards: (aspect u, -v).
struct Chart {
    pieces: Vec<Piece>,
    /// 1 for every coordinate that a vertex may change, 0 for one that the border holds.
    freedom: Vec<DVec2>,
    /// Edges on the border, and the way along their side.
    border: Vec<([u32; 2], DVec2)>,
    rows: Rows,
    /// Vertices by colour.
    colours: Vec<Vec<u32>>,
    objective: Objective,
}

impl Chart {
    /// The chart of a surface and its places, those of the square's corners after them where the lattice has no vertex there.
    /// `None` when the surface has no area.
    fn new(
        lattice: &SphereLattice,
        triangles: &[[u32; 3]],
        positions: &[DVec3],
        objective: Objective,
    ) -> Option<(Self, Vec<DVec2>)> {
        let aspect = aspect(lattice.spec);
        let place = |[u, v]: [f64; 2]| {
            let p = single(DVec2::new(u, -v));
            DVec2::new(aspect * p.x, p.y)
        };
        let mut places: Vec<DVec2> = lattice.uv.iter().map(|&uv| place(uv)).collect();
        let corners = |t: [u32; 3]| t.map(|v| positions[lattice.chart[v as usize] as usize]);
        let area: f64 = triangles.iter().map(|&t| doubled_area(corners(t))).sum::<f64>() / 2.0;
        if !(area > 0.0 && area.is_finite()) {
            return None;
        }
        let scale = (aspect / area).sqrt();
        let reference = |&t: &[u32; 3]| Piece::new(t, &Reference::new(corners(t), scale, SOFTENING), 1.0);
        let mut pieces: Vec<Piece> = triangles.iter().map(reference).collect();
        for t in filling(lattice, &mut places, place) {
            let flat = t.map(|v| places[v as usize].extend(0.0));
            pieces.push(Piece::new(t, &Reference::new(flat, 1.0, 0.0), FILLING));
        }
        let side = |x: f64, far: f64| if x == 0.0 || x == far { 0.0 } else { 1.0 };
        let freedom: Vec<DVec2> = places.iter().map(|p| DVec2::new(side(p.x, aspect), side(p.y, -1.0))).collect();
        let rows = Rows::new(places.len(), &pieces);
        let border = border(&pieces).into_iter().map(|e| (e, places[e[1] as usize] - places[e[0] as usize])).collect();
        let colours = colours(places.len(), |v| rows.neighbours(v));
        Some((Self { pieces, freedom, border, rows, colours, objective }, places))
    }

    /// Energy of the chart; infinite where a triangle is not positive or two vertices of the border have changed places.
    fn energy(&self, places: &[DVec2]) -> f64 {
        let ordered =
            |([a, b], along): &([u32; 2], DVec2)| (places[*b as usize] - places[*a as usize]).dot(*along) > 0.0;
        if !self.border.iter().all(ordered) {
            return f64::INFINITY;
        }
        let sum = |pieces: &[Piece]| pieces.iter().map(|piece| piece.energy(places, &self.objective)).sum::<f64>();
        self.pieces.par_chunks(CHUNK).map(sum).collect::<Vec<f64>>().into_iter().sum()
    }

    /// Takes Newton steps until little is left to gain, each after a sweep of vertex steps: what holds a step of the whole
    /// chart back are single triangles that are nearly flat. The energy never rises.
    fn descend(&self, places: &mut Vec<DVec2>, settings: &Settings<'_>) -> Result<(), Canceled> {
        let area: f64 = self.pieces.iter().map(|piece| piece.weight).sum();
        for round in 0..STEPS {
            self.sweep(places, settings)?;
            let energy = self.energy(places);
            (settings.progress)(Progress {
                stage: "relax",
                fraction: round as f32 / STEPS as f32,
                energy: Some(energy / area),
                ..Progress::default()
            });
            let system = System::new(self, places);
            let direction = system.solve(&self.rows, PRODUCTS, settings)?;
            let slope = system.slope(&direction);
            if slope.is_nan() || slope >= 0.0 || -0.5 * slope < TOLERANCE * energy {
                break;
            }
            let Some(to) = self.search(places, &direction, energy) else { break };
            *places = to;
        }
        Ok(())
    }

    /// Backtracking from the full step, all vertices alike: a chart of which only a part moves is rough where that part ends.
    fn search(&self, places: &[DVec2], direction: &[DVec2], energy: f64) -> Option<Vec<DVec2>> {
        const SHORTER: f64 = 0.7;
        /// Down to a thousandth of the step.
        const TRIES: usize = 20;
        let mut fraction = 1.0;
        for _ in 0..TRIES {
            let to: Vec<DVec2> = places.par_iter().zip(direction).map(|(p, d)| single(*p + fraction * *d)).collect();
            if self.energy(&to) < energy {
                return Some(to);
            }
            fraction *= SHORTER;
        }
        None
    }
}

fn doubled_area([a, b, c]: [DVec3; 3]) -> f64 {
    (b - a).cross(c - a).length()
}

/// Triangles between the teeth of a lat-long chart's poles, and in its four corners, whose places are added.
fn filling(lattice: &SphereLattice, places: &mut Vec<DVec2>, place: impl Fn([f64; 2]) -> DVec2) -> Vec<[u32; 3]> {
    let sectors = lattice.caps.len() / 2;
    let mut filled = Vec::new();
    if sectors == 0 {
        return filled;
    }
    let (north, south) = lattice.caps.split_at(sectors);
    let mut corner = |uv| {
        places.push(place(uv));
        places.len() as u32 - 1
    };
    // a cap is its pole and, counter-clockwise, two vertices of the ring beside it: west and east of the north pole, east and
    // west of the south pole
    let (first, last) = (corner([0.0, 0.0]), corner([1.0, 0.0]));
    filled.push([first, north[0][1], north[0][0]]);
    filled.extend(north.windows(2).map(|pair| [pair[0][0], pair[0][2], pair[1][0]]));
    filled.push([north[sectors - 1][0], north[sectors - 1][2], last]);
    let (first, last) = (corner([0.0, 1.0]), corner([1.0, 1.0]));
    filled.push([first, south[0][0], south[0][2]]);
    filled.extend(south.windows(2).map(|pair| [pair[0][0], pair[1][0], pair[0][1]]));
    filled.push([south[sectors - 1][0], last, south[sectors - 1][1]]);
    filled
}

/// Edges that one triangle alone has, as it runs along them.
fn border(pieces: &[Piece]) -> Vec<[u32; 2]> {
    let edges = || pieces.iter().flat_map(|p| (0..3).map(move |i| [p.corners[i], p.corners[(i + 1) % 3]]));
    let mut all: Vec<[u32; 2]> = edges().collect();
    all.sort_unstable();
    edges().filter(|[a, b]| all.binary_search(&[*b, *a]).is_err()).collect()
}

#[cfg(test)]
mod tests;
