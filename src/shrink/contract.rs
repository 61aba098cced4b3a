//! Topology-keeping contraction: a ball on a graded lattice gives up its outermost simple nodes, in order of distance,
//! until only the solid is left. Because only simple nodes go, the front stays one sphere.

use super::complex::{Complex, Kept, Rings as Links};
use super::graded::Graded;
use super::rings::{Mesh, Rings};
use super::{ShrinkError, topology};
use crate::field::{Frame, Metric, Sampler};
use crate::settings::{self as shown, CancelToken, Canceled, Progress};
use glam::DVec3;
use rayon::prelude::*;
use std::collections::HashMap;

/// Cells along the longest side of the first lattice; each level halves them near the zero level set.
const COARSE: usize = 12;
/// How much farther than the field's own change of value allows the zero level set is looked for, in all levels but the last
/// and in the last.
const MARGIN: (f64, f64) = (1.5, 1.3);
/// A shape that fills less than this share of the domain's longest side gets a lattice of its own.
const FOCUS: f64 = 0.7;
/// A node with a value up to this many spacings outside is probed for a thin wall behind it.
const THIN: f64 = 0.87;
/// How far below the surface the probe looks, in spacings.
const PROBE: f64 = 1.5;
/// The probe finds a thin wall where the value is above minus this many spacings.
const SOLID: f64 = 0.45;
/// Nodes that could not be given up and are farther outside than this many spacings are the membrane of a handle, the
/// bridge to another component, or a void.
const OBSTRUCTION: f64 = 1.8;
/// An obstruction that reaches farther outside than this many spacings is no matter of resolution.
const CERTAIN: f64 = 6.0;
/// Rounds of halving around an obstruction that is not certain.
const LOOKS: u32 = 2;
/// Places where a surface was found wanting are looked at finer within this many spacings.
const NEAR: f64 = 4.0;
/// Local halving stops at this many nodes.
const MOST: usize = 600_000;

/// The front after the contraction: a closed surface of genus 0 around the lattice's inside nodes.
pub struct Front {
    /// The surface, in frame units.
    pub mesh: Mesh,
    /// The frame that the front is in: about unit size, centred on the shape.
    pub frame: Frame,
}

/// Why there is no front, and whether a finer lattice could see it differently.
pub struct Refusal {
    /// The cause.
    pub error: ShrinkError,
    /// Whether no finer lattice would change it.
    pub certain: bool,
}

impl<E: Into<ShrinkError>> From<E> for Refusal {
    fn from(error: E) -> Self {
        Self { error: error.into(), certain: true }
    }
}

/// How finely to contract.
#[derive(Clone, Copy, Debug)]
pub struct Resolution {
    /// Doublings of the coarsest lattice.
    pub levels: u32,
    /// Rounds of halving beside thin walls, narrow gaps and places that were found wanting.
    pub local: u32,
}

/// What the contraction works on.
pub(super) struct Lattice {
    /// The lattice, in frame units, with values that change by about 1 per length.
    pub grid: Graded,
    /// The frame that the lattice is in: about unit size, centred on the shape.
    pub frame: Frame,
    /// Change of the field's own value per length, by which values were divided.
    pub slope: f64,
}

/// Evaluates the field on a lattice over the shape, near the zero level set.
pub(super) fn lattice(scene: &Sampler<'_>, resolution: Resolution) -> Result<Lattice, Refusal> {
    let domain = scene.domain();
    let (mut lo, mut hi) = (DVec3::from(domain.min), DVec3::from(domain.max));
    let mut size = (hi - lo).max_element();
    let first = |lo, hi, size: f64| -> Result<(Graded, f64), Canceled> {
        let mut grid = Graded::new(scene, lo, hi, size / COARSE as f64)?;
        let slope = slope_of(scene, &grid);
        grid.halve(scene, slope, MARGIN.0)?;
        Ok((grid, slope))
    };
    let (mut grid, slope) = first(lo, hi, size)?;
    let mut deeper = 0;
    // a shape smaller than the lattice's cells shows itself only in a finer one
    while grid.solid_box(slope).is_none() && deeper < 3 {
        grid.halve(scene, slope, MARGIN.0)?;
        deeper += 1;
    }
    let Some((solid_lo, solid_hi)) = grid.solid_box(slope) else {
        let (min, max) = grid.values.iter().fold((f32::MAX, f32::MIN), |(a, b), &v| (a.min(v), b.max(v)));
        return Err(ShrinkError::Empty { min: f64::from(min), max: f64::from(max) }.into());
    };
    let solid = (solid_hi - solid_lo).max_element();
    let focused = solid < FOCUS * size;
    if focused {
        (lo, hi, size) = (solid_lo, solid_hi, solid);
    }
    if focused || deeper > 0 {
        (grid, _) = first(lo, hi, size)?;
    }
    let slope = slope_of(scene, &grid);
    for level in 2..=resolution.levels {
        grid.halve(scene, slope, if level == resolution.levels { MARGIN.1 } else { MARGIN.0 })?;
    }
    // from here on in a frame of unit size, with values that change by about 1 per length
    let frame = Frame { center: 0.5 * (lo + hi), scale: 0.5 * size };
    grid.enter(frame, slope);
    Ok(Lattice { grid, frame, slope })
}

/// Contracts a sphere around the domain onto the zero level set; finer, where `resolution` allows it, near `places` (scene
/// units) and where the shape is thinner than the lattice.
///
/// # Errors
/// A [`Refusal`] with [`ShrinkError::Empty`], [`ShrinkError::Components`], [`ShrinkError::Genus`] or
/// [`ShrinkError::Canceled`].
pub fn contract(scene: &Sampler<'_>, resolution: Resolution, places: &[DVec3]) -> Result<Front, Refusal> {
    let settings = *scene.settings();
    let Lattice { mut grid, frame, .. } = lattice(scene, resolution)?;
    let sampler = scene.framed(frame);
    let places: Vec<DVec3> = places.iter().map(|&p| frame.from_scene(p)).collect();
    let h = grid.h();
    let mut round = 0;
    loop {
        let complex = grid.complex(&settings)?;
        let Marked { target, walls, gaps, narrow } = mark(&sampler, &grid, &complex)?;
        let levels = if settings.watched { levels(&complex, &target) } else { Vec::new() };
        let inside = carve(&complex, &target, settings.cancel, &levels, &mut |inside, level| {
            let (positions, triangles) = boundary(&complex, &grid.values, inside, level, &HashMap::new());
            let positions = positions.iter().map(|&p| frame.to_scene(p).as_vec3().to_array()).collect();
            let front = Some(shown::Front { positions, triangles, places: Vec::new() });
            let max_distance = Some(f64::from(level) * frame.scale);
            (settings.progress)(Progress { stage: "contract", front, max_distance, ..Progress::default() });
        })?;
        let limit = (OBSTRUCTION * h) as f32;
        let stuck = |i: usize| inside[i] && target[i] > 0.0;
        let far: Vec<bool> = (0..complex.len()).map(|i| inside[i] && target[i] > limit).collect();
        let farthest = (0..complex.len()).filter(|&i| far[i]).map(|i| target[i]).fold(0.0, f32::max);
        let certain = f64::from(farthest) > CERTAIN * h;
        let obstructed = farthest > 0.0;
        let refined = if (round < resolution.local || (obstructed && !certain && round < LOOKS)) && grid.len() < MOST {
            let least = (h / complex.unit).round() as i32 >> resolution.local.max(LOOKS);
            let fault = |i: usize| places.iter().any(|p| p.distance(complex.positions[i]) < NEAR * h);
            let wanted = |i: &usize| {
                complex.sides[*i] > least && (narrow[*i] || stuck(*i) || (f64::from(target[*i].abs()) < h && fault(*i)))
            };
            let nodes: Vec<(usize, i32)> = (0..complex.len()).filter(wanted).map(|i| (i, complex.sides[i])).collect();
            !nodes.is_empty() && grid.halve_around(&sampler, nodes, 1.0, MARGIN.1)?
        } else {
            false
        };
        round += 1;
        if refined {
            continue;
        }
        if obstructed {
            topology::explain(&complex, &far, &inside, frame).map_err(|error| Refusal { error, certain })?;
        }
        let walls = walls.into_iter().filter(|&(i, _)| inside[i]);
        let moved = embedded(&complex, walls.chain(gaps.into_iter().filter(|&(i, _)| !inside[i])).collect());
        settings.cancel.check()?;
        let (positions, triangles) = boundary(&complex, &grid.values, &inside, 0.0, &moved);
        let rings = Rings::new(positions.len(), &triangles).expect("the front of a carved ball is a closed manifold");
        let mesh = Mesh { positions, rings };
        return Ok(Front { mesh, frame });
    }
}

/// Distances from the solid, falling, at which a front is worth a look: as parts of half its size.
fn levels(complex: &Complex, values: &[f32]) -> Vec<f32> {
    const SHARES: [f64; 7] = [0.5, 0.35, 0.24, 0.16, 0.1, 0.05, 0.02];
    let solid = (0..complex.len()).filter(|&i| values[i] <= 0.0).map(|i| complex.positions[i]);
    let (low, high) = solid.fold((DVec3::INFINITY, DVec3::NEG_INFINITY), |(l, h), p| (l.min(p), h.max(p)));
    let half = (0.5 * (high - low).length()).max(0.0);
    SHARES.iter().map(|share| (share * half) as f32).collect()
}

fn slope_of(sampler: &Sampler<'_>, grid: &Graded) -> f64 {
    match (sampler.field().metric(), sampler.field().lipschitz()) {
        (Metric::Exact, _) => 1.0,
        (Metric::Bound, Some(l)) => f64::from(l).max(1e-6),
        _ => grid.slope().max(1e-6),
    }
}

/// What the contraction takes the nodes for.
pub(super) struct Marked {
    /// The values, with the signs that the nodes count with.
    pub target: Vec<f32>,
    /// Nodes that count as inside though the field is positive, beside thin walls, and where they stand.
    walls: Vec<(usize, DVec3)>,
    /// Nodes that count as outside though the field is not, beside narrow gaps, and where they stand.
    gaps: Vec<(usize, DVec3)>,
    /// Nodes beside something thinner than the lattice, whether it changed what they count as or not.
    narrow: Vec<bool>,
}

/// Finds thin walls and narrow gaps.
pub(super) fn mark(sampler: &Sampler<'_>, grid: &Graded, complex: &Complex) -> Result<Marked, Canceled> {
    let mut narrow = vec![false; complex.len()];
    let walls = thin(sampler, grid, complex, Thin::Wall, &mut narrow)?;
    let gaps = thin(sampler, grid, complex, Thin::Gap, &mut narrow)?;
    let mut target = grid.values.clone();
    for &(i, _) in &walls {
        target[i] = -f32::MIN_POSITIVE;
    }
    for &(i, _) in &gaps {
        target[i] = f32::MIN_POSITIVE;
    }
    Ok(Marked { target, walls, gaps, narrow })
}

/// Which side of the surface is looked at for being thinner than the lattice can hold.
#[derive(Clone, Copy, PartialEq)]
enum Thin {
    /// Walls: nodes just outside one.
    Wall,
    /// Gaps: nodes just inside the solid beside one.
    Gap,
}

/// Nodes beside a wall or a gap thinner than the lattice can hold, with the place just beyond the surface that stands for
/// them once they count as belonging to it. The lattice's own values rule out most nodes before the field is asked.
fn thin(
    sampler: &Sampler<'_>,
    grid: &Graded,
    complex: &Complex,
    what: Thin,
    narrow: &mut [bool],
) -> Result<Vec<(usize, DVec3)>, Canceled> {
    /// Nodes worth a piece of parallel work.
    const CHUNK: usize = 2048;
    /// Interpolation across a cell can be this wrong, in spacings.
    const SLACK: f64 = 0.3;
    /// The solid beside a gap is at least this thick, in spacings: nothing is opened into a thin wall.
    const BACKED: f64 = 1.5;
    /// Places across a gap, from its near side, in spacings; one of them at least must be outside the solid.
    const WITHIN: [f64; 5] = [0.03, 0.1, 0.25, 0.5, 1.0];
    // seen from the other side a gap is a wall
    let sign = if what == Thin::Wall { 1.0 } else { -1.0 };
    let beside = |i: usize| sign * f64::from(grid.values[i]);
    let near =
        |&i: &usize| grid.known[i] && beside(i) > 0.0 && beside(i) <= THIN * complex.spacing(i) && !complex.border[i];
    let candidate = |rings: &mut Links<'_>, i: usize| {
        let (value, h) = (beside(i), complex.spacing(i));
        let here = complex.positions[i];
        let slope: DVec3 = rings
            .of(i)
            .nodes
            .iter()
            .map(|&j| {
                let along = complex.positions[j as usize] - here;
                along * (f64::from(grid.values[j as usize] - grid.values[i]) / along.length_squared())
            })
            .sum();
        let downhill = sign * slope.normalize_or_zero();
        let below = grid.interpolate(here - downhill * (value + PROBE * h)).map(|b| sign * b);
        downhill == DVec3::ZERO || below.is_none_or(|b| b > -(SOLID + SLACK) * h)
    };
    let nodes: Vec<usize> = (0..complex.len()).filter(near).collect();
    let chosen = |nodes: &[usize]| {
        let mut rings = Links::new(complex);
        nodes.iter().copied().filter(|&i| candidate(&mut rings, i)).collect()
    };
    let pieces: Vec<Vec<usize>> = sampler.settings().pool.install(|| nodes.par_chunks(CHUNK).map(chosen).collect());
    let nodes = pieces.concat();
    let points: Vec<DVec3> = nodes.iter().map(|&i| complex.positions[i]).collect();
    let (values, gradients) = sampler.gradients(&points)?;
    let mut feet = Vec::with_capacity(nodes.len());
    let mut probes = Vec::with_capacity(nodes.len());
    for (k, &i) in nodes.iter().enumerate() {
        let (h, steep) = (complex.spacing(i), gradients[k].length().max(1e-9));
        let (normal, distance) = (sign * gradients[k] / steep, (sign * values[k] / steep).min(THIN * h));
        feet.push(points[k] - normal * (distance + 0.05 * h));
        probes.push(points[k] - normal * (distance + PROBE * h));
    }
    let below = sampler.values(&probes)?;
    let is_thin = |&k: &usize| sign * below[k] > -SOLID * complex.spacing(nodes[k]) * gradients[k].length().max(1e-9);
    let mut found: Vec<usize> = (0..nodes.len()).filter(is_thin).collect();
    if what == Thin::Gap {
        // parts of a union that only touch have a zero level set between them, but no gap
        let across: Vec<DVec3> = found
            .iter()
            .flat_map(|&k| {
                let (h, beyond) = (complex.spacing(nodes[k]), (probes[k] - points[k]).normalize_or_zero());
                WITHIN.map(|t| feet[k] + (t - 0.05) * h * beyond)
            })
            .collect();
        let between = sampler.values(&across)?;
        let mut open = between.chunks_exact(WITHIN.len()).map(|s| s.iter().any(|&v| v > 0.0));
        found.retain(|_| open.next().unwrap_or(false));
    }
    for &k in &found {
        narrow[nodes[k]] = true;
    }
    let backed = |&k: &usize| {
        let (h, steep) = (complex.spacing(nodes[k]), gradients[k].length().max(1e-9));
        grid.interpolate(points[k] - gradients[k] * (BACKED * h / steep)).is_some_and(|b| b < -SOLID * h)
    };
    let counts = found.into_iter().filter(|k| what == Thin::Wall || backed(k));
    Ok(counts.map(|k| (nodes[k], feet[k])).collect())
}

/// The moves of nodes, each shortened until no tetrahedron around it turns inside out, so that the front stays embedded.
fn embedded(complex: &Complex, moves: Vec<(usize, DVec3)>) -> HashMap<usize, DVec3> {
    /// A tetrahedron keeps this share of its volume.
    const SHARE: f64 = 0.05;
    /// Rounds of shortening; what is left after them does not move.
    const ROUNDS: usize = 12;
    let mut moved: HashMap<usize, DVec3> = moves.iter().copied().collect();
    for round in 0..=ROUNDS {
        let place = |v: u32| moved.get(&(v as usize)).copied().unwrap_or(complex.positions[v as usize]);
        let squeezed = |&&(i, _): &&(usize, DVec3)| {
            complex.star(i).any(|t| {
                let tet = complex.tets[t];
                volume(tet.map(place)) < SHARE * volume(tet.map(|v| complex.positions[v as usize]))
            })
        };
        let list: Vec<(usize, DVec3)> = moves.iter().filter(squeezed).copied().collect();
        if list.is_empty() {
            break;
        }
        for (i, _) in list {
            let (here, now) = (complex.positions[i], moved[&i]);
            moved.insert(i, if round == ROUNDS { here } else { here.lerp(now, 0.6) });
        }
    }
    moved
}

/// Six times the volume of a tetrahedron, positive for a right-handed one.
fn volume([a, b, c, d]: [DVec3; 4]) -> f64 {
    (b - a).cross(c - a).dot(d - a)
}

/// Gives up simple nodes with a positive value, farthest outside first, starting from the outermost layer. Returns which
/// nodes stay inside. `watch` sees which nodes are left when those above each of the `levels`, which fall, are gone, as far as they can be.
pub(super) fn carve(
    complex: &Complex,
    values: &[f32],
    cancel: &CancelToken,
    levels: &[f32],
    watch: &mut dyn FnMut(&[bool], f32),
) -> Result<Vec<bool>, Canceled> {
    /// Buckets that positive values are sorted into; within a bucket the order is that of arrival.
    const BUCKETS: usize = 4096;
    let mut inside: Vec<bool> = complex.border.iter().map(|b| !b).collect();
    let top = values.iter().fold(f32::MIN_POSITIVE, |a, &b| a.max(b));
    let bucket = |v: f32| ((v / top * (BUCKETS - 1) as f32) as usize).min(BUCKETS - 1);
    let mut queue: Vec<Vec<u32>> = vec![Vec::new(); BUCKETS];
    let mut rings = Kept::new(complex);
    for i in (0..complex.len()).filter(|&i| complex.border[i]) {
        for &j in rings.of(i).nodes {
            if inside[j as usize] && values[j as usize] > 0.0 {
                queue[bucket(values[j as usize])].push(j);
            }
        }
    }
    let (mut current, mut popped) = (BUCKETS - 1, 0u64);
    let mut levels = levels.iter().copied().filter(|&level| level < top).peekable();
    loop {
        while let Some(level) = levels.next_if(|&level| current <= bucket(level)) {
            watch(&inside, level);
        }
        let Some(i) = queue[current].pop() else {
            if current == 0 {
                return Ok(inside);
            }
            current -= 1;
            continue;
        };
        popped += 1;
        if popped.is_multiple_of(1 << 14) {
            cancel.check()?;
        }
        let i = i as usize;
        if !inside[i] {
            continue;
        }
        let ring = rings.of(i);
        if !ring.simple(&inside) {
            continue;
        }
        inside[i] = false;
        for &j in ring.nodes {
            if inside[j as usize] && values[j as usize] > 0.0 {
                let b = bucket(values[j as usize]);
                queue[b].push(j);
                current = current.max(b);
            }
        }
    }
}

/// The surface between the nodes that are inside and the others, where the values cross `level`, by marching tetrahedra. Nodes in
/// `moved` stand at another place.
fn boundary(
    complex: &Complex,
    values: &[f32],
    inside: &[bool],
    level: f32,
    moved: &HashMap<usize, DVec3>,
) -> (Vec<DVec3>, Vec<[u32; 3]>) {
    /// An edge's vertex keeps this share of the edge from either end, so that no triangle vanishes.
    const EDGE: f64 = 0.05;
    let mut numbers: HashMap<(u32, u32), u32> = HashMap::new();
    let (mut positions, mut triangles) = (Vec::new(), Vec::<[u32; 3]>::new());
    let place = |v: u32| moved.get(&(v as usize)).copied().unwrap_or(complex.positions[v as usize]);
    for &tet in &complex.tets {
        let solid = tet.iter().filter(|&&v| inside[v as usize]).count();
        if solid == 0 || solid == 4 {
            continue;
        }
        // the inside nodes first; an odd change of order changes the hand
        let mut order = tet;
        let mut odd = false;
        for a in 1..4 {
            for b in (1..=a).rev() {
                if inside[order[b] as usize] && !inside[order[b - 1] as usize] {
                    order.swap(b, b - 1);
                    odd = !odd;
                }
            }
        }
        let mut vertex = |a: u32, b: u32| -> u32 {
            *numbers.entry((a, b)).or_insert_with(|| {
                let (sa, sb) = (f64::from(values[a as usize] - level), f64::from(values[b as usize] - level));
                let t = if sa <= 0.0 && sb > 0.0 {
                    (sa / (sa - sb)).clamp(EDGE, 1.0 - EDGE)
                } else if sa > 0.0 {
                    // kept inside although the field is positive: stay close to the node
                    0.3
                } else {
                    // given up although the field is not positive
                    0.7
                };
                positions.push(place(a).lerp(place(b), t));
                (positions.len() - 1) as u32
            })
        };
        let [a, b, c, d] = order;
        let faces = match solid {
            1 => [Some([vertex(a, b), vertex(a, c), vertex(a, d)]), None],
            3 => [Some([vertex(a, d), vertex(b, d), vertex(c, d)]), None],
            _ => {
                let quad = [vertex(a, c), vertex(a, d), vertex(b, d), vertex(b, c)];
                [Some([quad[0], quad[1], quad[2]]), Some([quad[0], quad[2], quad[3]])]
            }
        };
        for mut t in faces.into_iter().flatten() {
            if odd {
                t.swap(1, 2);
            }
            triangles.push(t);
        }
    }
    (positions, triangles)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::field::sampler::Tally;
    use crate::field::scene::Scene;
    use crate::measure::fixtures::with_settings;
    use crate::measure::nearest::Nearest;
    use serde_json::{Value, json};

    const FIRST: Resolution = Resolution { levels: 2, local: 0 };

    fn contracted(scene: Value, resolution: Resolution, places: &[DVec3]) -> Result<Front, ShrinkError> {
        let scene = Scene::from_value(&scene).unwrap();
        with_settings(2, |settings| {
            let tally = Tally::new();
            contract(&Sampler::new(&scene, *settings, &tally), resolution, places).map_err(|refusal| refusal.error)
        })
    }

    /// Largest distance of places from a front, scene units.
    fn distance(front: &Front, places: &[DVec3]) -> f64 {
        let positions: Vec<DVec3> = front.mesh.positions.iter().map(|&q| front.frame.to_scene(q)).collect();
        let triangles = front.mesh.rings.triangles();
        let nearest = Nearest::new(&positions, &triangles);
        places.iter().map(|&p| nearest.closest(p).unwrap().point.distance(p)).fold(0.0, f64::max)
    }

    /// A box that no lattice plane goes along, and its corners.
    fn block(half: DVec3, center: DVec3) -> (Value, Vec<DVec3>) {
        let place = json!({"translate": {"by": center.to_array(), "of": {"box": {"half_extents": half.to_array()}}}});
        let sign = |k: usize, a: usize| if k >> a & 1 == 1 { 1.0 } else { -1.0 };
        (place, (0..8).map(|k| center + half * DVec3::new(sign(k, 0), sign(k, 1), sign(k, 2))).collect())
    }

    #[test]
    fn a_fin_thinner_than_the_lattice_is_kept_and_sharper_where_the_lattice_is_halved() {
        // the fin is a third of a spacing thick
        let (fin, corners) = block(DVec3::new(0.313, 0.006, 0.352), DVec3::new(0.017, 0.011, 0.451));
        let tips: Vec<DVec3> = corners.into_iter().filter(|p| p.z > 0.5).collect();
        let scene = json!({"union": {"of": [{"sphere": {"radius": 0.5}}, fin]}});
        let coarse = distance(&contracted(scene.clone(), FIRST, &[]).unwrap(), &tips);
        let fine = distance(&contracted(scene, Resolution { local: 2, ..FIRST }, &[]).unwrap(), &tips);
        // a spacing of the first lattice is 2 / 48
        assert!(coarse < 2.0 / 48.0, "{coarse}");
        assert!(fine < 0.6 * coarse, "{fine} beside {coarse}");
    }

    #[test]
    fn a_place_that_was_found_wanting_is_looked_at_finer() {
        let (scene, corners) = block(DVec3::new(0.613, 0.471, 0.427), DVec3::new(0.013, 0.021, -0.017));
        let resolution = Resolution { local: 2, ..FIRST };
        let coarse = distance(&contracted(scene.clone(), resolution, &[]).unwrap(), &corners);
        let fine = distance(&contracted(scene, resolution, &corners).unwrap(), &corners);
        assert!(fine < 0.6 * coarse, "{fine} beside {coarse}");
    }

    #[test]
    fn handles_and_components_are_refused_with_their_number() {
        let torus = json!({"torus": {"major": 0.6, "minor": 0.2}});
        assert!(matches!(contracted(torus, FIRST, &[]), Err(ShrinkError::Genus { genus: 1, .. })));
        let ball = |x: f64| json!({"translate": {"by": [x, 0, 0], "of": {"sphere": {"radius": 0.25}}}});
        let two = json!({"union": {"of": [ball(-0.5), ball(0.5)]}});
        assert!(matches!(contracted(two, FIRST, &[]), Err(ShrinkError::Components { solids: 2, voids: 0, .. })));
        let hollow = json!({"difference": {"of": [{"sphere": {"radius": 0.7}}, {"sphere": {"radius": 0.3}}]}});
        let Err(refusal) = contracted(hollow, FIRST, &[]) else { panic!("it has a void") };
        assert!(refusal.to_string().contains("2 components (1 solid and 1 void)"), "{refusal}");
        assert_eq!(refusal.places().len(), 2);
    }
}
