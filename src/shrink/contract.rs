//! Topology-keeping contraction: a ball on the Freudenthal lattice gives up its outermost simple nodes, in order of
//! distance, until only the solid is left. Because only simple nodes go, the front stays one sphere.
//!
//! A node is simple when both its inside and its outside neighbours are non-empty and connected in the 14-vertex link;
//! removing it then changes no topology (Bertrand 1994, for the link of a triangulated 3-manifold).

use super::grid3::{Grid3, NEIGHBOURS};
use super::rings::{Mesh, Rings};
use super::{ShrinkError, topology};
use crate::field::{Frame, Metric, Sampler};
use crate::settings::{CancelToken, Canceled};
use glam::DVec3;
use std::collections::HashMap;
use std::sync::OnceLock;

/// Cells along the longest side of the first lattice; each refinement doubles it.
const COARSE: usize = 12;
/// Nodes within this many cell diagonals of the zero level set are evaluated when a lattice that is refined again is made,
/// and when the last one is.
const REACH: (f64, f64) = (2.0, 1.3);
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

/// The orders in which the six Kuhn tetrahedra of a cell go through the axes; every other one is left-handed.
const ORDERS: [[usize; 3]; 6] = [[0, 1, 2], [0, 2, 1], [1, 2, 0], [1, 0, 2], [2, 0, 1], [2, 1, 0]];

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
    /// Whether thin walls are probed for (a probe can also bridge a narrow gap).
    pub probe: bool,
}

/// What the contraction works on.
pub(super) struct Lattice {
    /// The lattice, in frame units, with values that change by about 1 per length.
    pub grid: Grid3,
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
    let mut grid = Grid3::new(scene, lo, hi, size / COARSE as f64)?;
    let mut slope = slope_of(scene, &grid);
    grid = grid.refine(scene, reach(&grid, slope, false))?;
    // a shape smaller than the lattice's cells shows itself only in a finer one
    for _ in 0..3 {
        if grid.solid_box(slope).is_some() {
            break;
        }
        grid = grid.refine(scene, reach(&grid, slope, false))?;
    }
    let Some((solid_lo, solid_hi)) = grid.solid_box(slope) else {
        let (min, max) = grid.values.iter().fold((f32::MAX, f32::MIN), |(a, b), &v| (a.min(v), b.max(v)));
        return Err(ShrinkError::Empty { min: f64::from(min), max: f64::from(max) }.into());
    };
    let solid = (solid_hi - solid_lo).max_element();
    if solid < FOCUS * size {
        (lo, hi, size) = (solid_lo, solid_hi, solid);
        grid = Grid3::new(scene, lo, hi, size / COARSE as f64)?;
        grid = grid.refine(scene, reach(&grid, slope, false))?;
    } else {
        while grid.nodes.iter().max() > Some(&(2 * COARSE + 8)) {
            // the search above went finer than the first level
            grid = Grid3::new(scene, lo, hi, size / COARSE as f64)?;
            grid = grid.refine(scene, reach(&grid, slope, false))?;
        }
    }
    slope = slope_of(scene, &grid);
    for level in 2..=resolution.levels {
        grid = grid.refine(scene, reach(&grid, slope, level == resolution.levels))?;
    }

    // from here on in a frame of unit size, with values that change by about 1 per length
    let frame = Frame { center: 0.5 * (lo + hi), scale: 0.5 * size };
    grid.origin = frame.from_scene(grid.origin);
    grid.h /= frame.scale;
    for v in &mut grid.values {
        *v = (f64::from(*v) / (slope * frame.scale)) as f32;
    }
    Ok(Lattice { grid, frame, slope })
}

/// Contracts a sphere around the domain onto the zero level set.
///
/// # Errors
/// A [`Refusal`] with [`ShrinkError::Empty`], [`ShrinkError::Components`], [`ShrinkError::Genus`] or
/// [`ShrinkError::Canceled`].
pub fn contract(scene: &Sampler<'_>, resolution: Resolution) -> Result<Front, Refusal> {
    let settings = *scene.settings();
    let Lattice { grid, frame, .. } = lattice(scene, resolution)?;
    let sampler = scene.framed(frame);
    let Marked { target, walls, gaps } = mark(&sampler, &grid, resolution.probe)?;
    let inside = carve(&grid, &target, settings.cancel)?;

    let limit = (OBSTRUCTION * grid.h) as f32;
    let stuck = (0..grid.len()).filter(|&i| inside[i]).map(|i| target[i]).fold(0.0, f32::max);
    if stuck > limit {
        let certain = f64::from(stuck) > CERTAIN * grid.h;
        topology::explain(&grid, &target, &inside, limit, frame).map_err(|error| Refusal { error, certain })?;
    }
    let walls = walls.into_iter().filter(|&(i, _)| inside[i]);
    let moved = embedded(&grid, walls.chain(gaps.into_iter().filter(|&(i, _)| !inside[i])).collect());
    let mesh = extract(&grid, &inside, &moved, settings.cancel)?;
    Ok(Front { mesh, frame })
}

fn slope_of(sampler: &Sampler<'_>, grid: &Grid3) -> f64 {
    match (sampler.field().metric(), sampler.field().lipschitz()) {
        (Metric::Exact, _) => 1.0,
        (Metric::Bound, Some(l)) => f64::from(l).max(1e-6),
        _ => grid.slope().max(1e-6),
    }
}

fn reach(grid: &Grid3, slope: f64, last: bool) -> f64 {
    let diagonal = 3f64.sqrt() * 0.5 * grid.h;
    slope * diagonal * if last { REACH.1 } else { REACH.0 }
}

/// What the contraction takes the nodes for.
pub(super) struct Marked {
    /// The values, with the signs that the nodes count with.
    pub target: Vec<f32>,
    /// Nodes that count as inside though the field is positive, beside thin walls, and where they stand.
    walls: Vec<(usize, DVec3)>,
    /// Nodes that count as outside though the field is not, beside narrow gaps, and where they stand.
    gaps: Vec<(usize, DVec3)>,
}

/// Finds thin walls, if `probe` asks for it, and narrow gaps.
pub(super) fn mark(sampler: &Sampler<'_>, grid: &Grid3, probe: bool) -> Result<Marked, Canceled> {
    let walls = if probe { thin(sampler, grid, Thin::Wall)? } else { Vec::new() };
    let gaps = thin(sampler, grid, Thin::Gap)?;
    let mut target = grid.values.clone();
    for &(i, _) in &walls {
        target[i] = -f32::MIN_POSITIVE;
    }
    for &(i, _) in &gaps {
        target[i] = f32::MIN_POSITIVE;
    }
    Ok(Marked { target, walls, gaps })
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
fn thin(sampler: &Sampler<'_>, grid: &Grid3, what: Thin) -> Result<Vec<(usize, DVec3)>, Canceled> {
    /// Interpolation across a cell can be this wrong, in spacings.
    const SLACK: f64 = 0.3;
    /// The solid beside a gap is at least this thick, in spacings: nothing is opened into a thin wall.
    const BACKED: f64 = 1.5;
    /// Places across a gap, from its near side, in spacings; one of them at least must be outside the solid.
    const WITHIN: [f64; 5] = [0.03, 0.1, 0.25, 0.5, 1.0];
    let h = grid.h;
    // seen from the other side a gap is a wall
    let sign = if what == Thin::Wall { 1.0 } else { -1.0 };
    let mut nodes = Vec::new();
    for i in 0..grid.len() {
        let value = sign * f64::from(grid.values[i]);
        if !grid.known[i] || value <= 0.0 || value > THIN * h || grid.on_border(i) {
            continue;
        }
        let difference = |axis: usize| {
            let stride = [grid.nodes[1] * grid.nodes[2], grid.nodes[2], 1][axis];
            sign * f64::from(grid.values[i + stride] - grid.values[i - stride])
        };
        let downhill = DVec3::new(difference(0), difference(1), difference(2)).normalize_or_zero();
        let below = grid.interpolate(grid.position(i) - downhill * (value + PROBE * h)).map(|b| sign * b);
        if downhill == DVec3::ZERO || below.is_none_or(|b| b > -(SOLID + SLACK) * h) {
            nodes.push(i);
        }
    }
    let points: Vec<DVec3> = nodes.iter().map(|&i| grid.position(i)).collect();
    let (values, gradients) = sampler.gradients(&points)?;
    let mut feet = Vec::with_capacity(nodes.len());
    let mut probes = Vec::with_capacity(nodes.len());
    for k in 0..nodes.len() {
        let steep = gradients[k].length().max(1e-9);
        let (normal, distance) = (sign * gradients[k] / steep, (sign * values[k] / steep).min(THIN * h));
        feet.push(points[k] - normal * (distance + 0.05 * h));
        probes.push(points[k] - normal * (distance + PROBE * h));
    }
    let below = sampler.values(&probes)?;
    let is_thin = |&k: &usize| {
        let steep = gradients[k].length().max(1e-9);
        let behind = || grid.interpolate(points[k] - gradients[k] * (BACKED * h / steep));
        sign * below[k] > -SOLID * h * steep && (what == Thin::Wall || behind().is_some_and(|b| b < -SOLID * h))
    };
    let mut found: Vec<usize> = (0..nodes.len()).filter(is_thin).collect();
    if what == Thin::Gap {
        // parts of a union that only touch have a zero level set between them, but no gap
        let across: Vec<DVec3> = found
            .iter()
            .flat_map(|&k| {
                let beyond = (probes[k] - points[k]).normalize_or_zero();
                WITHIN.map(|t| feet[k] + (t - 0.05) * h * beyond)
            })
            .collect();
        let between = sampler.values(&across)?;
        let mut open = between.chunks_exact(WITHIN.len()).map(|s| s.iter().any(|&v| v > 0.0));
        found.retain(|_| open.next().unwrap_or(false));
    }
    Ok(found.into_iter().map(|k| (nodes[k], feet[k])).collect())
}

/// The moves of nodes, each shortened until no tetrahedron around it turns inside out, so that the front stays embedded.
fn embedded(grid: &Grid3, moves: Vec<(usize, DVec3)>) -> HashMap<usize, DVec3> {
    /// A tetrahedron keeps this share of its volume.
    const SHARE: f64 = 0.05;
    /// Rounds of shortening; what is left after them does not move.
    const ROUNDS: usize = 12;
    let least = SHARE * grid.h.powi(3);
    let mut moved: HashMap<usize, DVec3> = moves.iter().copied().collect();
    for round in 0..=ROUNDS {
        let place = |i: usize| moved.get(&i).copied().unwrap_or_else(|| grid.position(i));
        let squeezed = |&&(i, _): &&(usize, DVec3)| {
            (0..4).any(|k| {
                ORDERS.iter().enumerate().any(|(n, order)| {
                    let sign = if n % 2 == 0 { 1.0 } else { -1.0 };
                    let strides = order.map(|axis| grid.stride(NEIGHBOURS[axis]) as usize);
                    let mut node = i - strides[..k].iter().sum::<usize>();
                    let mut corners = [place(node); 4];
                    for c in 1..4 {
                        node += strides[c - 1];
                        corners[c] = place(node);
                    }
                    let [a, b, c] = [1, 2, 3].map(|j| corners[j] - corners[0]);
                    a.cross(b).dot(c) * sign < least
                })
            })
        };
        let list: Vec<(usize, DVec3)> = moves.iter().filter(squeezed).copied().collect();
        if list.is_empty() {
            break;
        }
        for (i, _) in list {
            let here = grid.position(i);
            let now = moved[&i];
            moved.insert(i, if round == ROUNDS { here } else { here.lerp(now, 0.6) });
        }
    }
    moved
}

/// For every set of inside neighbours (a bit each) whether the node between them is simple.
fn simple_table() -> &'static [bool] {
    static TABLE: OnceLock<Vec<bool>> = OnceLock::new();
    TABLE.get_or_init(|| {
        let mut adjacent = [0u16; 14];
        for (set, from) in adjacent.iter_mut().zip(NEIGHBOURS) {
            for (j, to) in NEIGHBOURS.into_iter().enumerate() {
                if NEIGHBOURS.contains(&(to - from)) {
                    *set |= 1 << j;
                }
            }
        }
        let connected = |set: u16| {
            let mut seen = set & set.wrapping_neg();
            loop {
                let grown = (0..14).filter(|i| seen >> i & 1 == 1).fold(seen, |s, i| s | adjacent[i] & set);
                if grown == seen {
                    return set != 0 && seen == set;
                }
                seen = grown;
            }
        };
        (0..1u16 << 14).map(|set| connected(set) && connected(!set & 0x3fff)).collect()
    })
}

/// Gives up simple nodes with a positive value, farthest outside first, starting from the outermost layer. Returns which
/// nodes stay inside.
pub(super) fn carve(grid: &Grid3, values: &[f32], cancel: &CancelToken) -> Result<Vec<bool>, Canceled> {
    /// Buckets that positive values are sorted into; within a bucket the order is that of arrival.
    const BUCKETS: usize = 4096;
    let simple = simple_table();
    let strides = NEIGHBOURS.map(|o| grid.stride(o));
    let mut inside: Vec<bool> = (0..grid.len()).map(|i| !grid.on_border(i)).collect();
    let top = values.iter().fold(f32::MIN_POSITIVE, |a, &b| a.max(b));
    let bucket = |v: f32| ((v / top * (BUCKETS - 1) as f32) as usize).min(BUCKETS - 1);
    let mut queue: Vec<Vec<u32>> = vec![Vec::new(); BUCKETS];
    for i in 0..grid.len() {
        let near =
            inside[i] && values[i] > 0.0 && grid.place(i).iter().zip(grid.nodes).any(|(&c, n)| c == 1 || c + 2 == n);
        if near {
            queue[bucket(values[i])].push(i as u32);
        }
    }
    let (mut current, mut popped) = (BUCKETS - 1, 0u64);
    loop {
        let Some(i) = queue[current].pop() else {
            if current == 0 {
                return Ok(inside);
            }
            current -= 1;
            continue;
        };
        popped += 1;
        if popped.is_multiple_of(1 << 16) {
            cancel.check()?;
        }
        let i = i as usize;
        if !inside[i] {
            continue;
        }
        let around = |k: usize| (i as isize + strides[k]) as usize;
        let set = (0..14).fold(0usize, |set, k| set | usize::from(inside[around(k)]) << k);
        if !simple[set] {
            continue;
        }
        inside[i] = false;
        for k in 0..14 {
            let j = around(k);
            if inside[j] && values[j] > 0.0 {
                let b = bucket(values[j]);
                queue[b].push(j as u32);
                current = current.max(b);
            }
        }
    }
}

/// Marching tetrahedra over the six Kuhn tetrahedra of every cell. Nodes in `moved` stand at another place.
fn extract(
    grid: &Grid3,
    inside: &[bool],
    moved: &HashMap<usize, DVec3>,
    cancel: &CancelToken,
) -> Result<Mesh, Canceled> {
    /// An edge's vertex keeps this share of the edge from either end, so that no triangle vanishes.
    const EDGE: f64 = 0.05;
    let strides = [grid.nodes[1] * grid.nodes[2], grid.nodes[2], 1];
    let mut numbers: HashMap<(usize, usize), u32> = HashMap::new();
    let (mut positions, mut middles, mut triangles) = (Vec::new(), Vec::<DVec3>::new(), Vec::<[u32; 3]>::new());
    let place = |i: usize| moved.get(&i).copied().unwrap_or_else(|| grid.position(i));
    for x in 0..grid.nodes[0] - 1 {
        cancel.check()?;
        for y in 0..grid.nodes[1] - 1 {
            for z in 0..grid.nodes[2] - 1 {
                let corner = grid.index(x, y, z);
                let count = (0..8usize)
                    .filter(|c| inside[corner + (c & 1) * strides[0] + (c >> 1 & 1) * strides[1] + (c >> 2)])
                    .count();
                if count == 0 || count == 8 {
                    continue;
                }
                for order in ORDERS {
                    let mut nodes = [corner; 4];
                    for k in 0..3 {
                        nodes[k + 1] = nodes[k] + strides[order[k]];
                    }
                    let (mut solid, mut void) = (([0usize; 4], 0), ([0usize; 4], 0));
                    for i in nodes {
                        let side = if inside[i] { &mut solid } else { &mut void };
                        side.0[side.1] = i;
                        side.1 += 1;
                    }
                    if solid.1 == 0 || void.1 == 0 {
                        continue;
                    }
                    let mut vertex = |a: usize, b: usize| -> u32 {
                        *numbers.entry((a, b)).or_insert_with(|| {
                            let (sa, sb) = (f64::from(grid.values[a]), f64::from(grid.values[b]));
                            let t = if sa <= 0.0 && sb > 0.0 {
                                (sa / (sa - sb)).clamp(EDGE, 1.0 - EDGE)
                            } else if sa > 0.0 {
                                // kept inside although the field is positive: stay close to the node
                                0.3
                            } else if sb <= 0.0 {
                                // given up although the field is not positive
                                0.7
                            } else {
                                0.5
                            };
                            positions.push(place(a).lerp(place(b), t));
                            middles.push(0.5 * (grid.position(a) + grid.position(b)));
                            (positions.len() - 1) as u32
                        })
                    };
                    let (s, v) = (solid.0, void.0);
                    let faces: [Option<[u32; 3]>; 2] = match solid.1 {
                        1 => [Some([vertex(s[0], v[0]), vertex(s[0], v[1]), vertex(s[0], v[2])]), None],
                        3 => [Some([vertex(s[0], v[0]), vertex(s[1], v[0]), vertex(s[2], v[0])]), None],
                        _ => {
                            let [a, b] = [vertex(s[0], v[0]), vertex(s[0], v[1])];
                            let [c, d] = [vertex(s[1], v[1]), vertex(s[1], v[0])];
                            [Some([a, b, c]), Some([a, c, d])]
                        }
                    };
                    let mean = |side: ([usize; 4], usize)| {
                        side.0[..side.1].iter().map(|&i| grid.position(i)).sum::<DVec3>() / side.1 as f64
                    };
                    let outward = mean(void) - mean(solid);
                    for mut t in faces.into_iter().flatten() {
                        let [a, b, c] = t.map(|v| middles[v as usize]);
                        if (b - a).cross(c - a).dot(outward) < 0.0 {
                            t.swap(1, 2);
                        }
                        triangles.push(t);
                    }
                }
            }
        }
    }
    let rings = Rings::new(positions.len(), &triangles).expect("the front of a carved ball is a closed manifold");
    Ok(Mesh { positions, rings })
}
