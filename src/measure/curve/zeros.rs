//! Points on the zero set of a two-dimensional field, every loop of it, found without the curve that is to be judged: a grid over
//! the whole domain, refined where the zero set may pass, whose crossed edges hold one point each. The points of one loop
//! are told apart from those of others by the cells they share.

use super::super::zero_set::{Bracket, TIGHT, roots, trace};
use crate::field::Sampler;
use crate::settings::Canceled;
use glam::{DVec2, DVec3, IVec2};
use std::collections::HashMap;

/// Points of the zero set.
#[derive(Default)]
pub(super) struct Zeros {
    pub points: Vec<DVec3>,
    /// Unit gradients there.
    pub normals: Vec<DVec3>,
    /// Length that each stands for: the grid's spacing over |nx| + |ny|, the number of grid edges of both directions that
    /// a line of that normal crosses per spacing (Cauchy-Crofton); 0 for those searched along the gradient.
    pub weights: Vec<f64>,
    /// The loop of each, an arbitrary number; none for those searched along the gradient.
    pub loops: Vec<Option<usize>>,
}

/// Cells per longest side of the domain on the first level with a Lipschitz bound, and without.
const FIRST: (i32, i32) = (16, 96);
/// Refinement ends on the level that keeps this many cells, ...
const ENOUGH: usize = 12_000;
/// ... or at this many cells per longest side.
const FINEST: i32 = 4096;
/// Without a Lipschitz bound, a cell is kept when |s| <= SLACK * |grad s| * half its diagonal.
const SLACK: f64 = 2.0;

const CORNERS: [IVec2; 4] = [IVec2::new(0, 0), IVec2::new(1, 0), IVec2::new(1, 1), IVec2::new(0, 1)];

#[derive(Clone, Copy)]
struct Grid {
    origin: DVec2,
    spacing: f64,
}

impl Grid {
    fn at(&self, c: DVec2) -> DVec3 {
        (self.origin + self.spacing * c).extend(0.0)
    }
    fn centers(&self, cells: &[IVec2]) -> Vec<DVec3> {
        cells.iter().map(|c| self.at(c.as_dvec2() + 0.5)).collect()
    }
    /// No point of a cell is farther from its center.
    fn reach(&self) -> f64 {
        0.5 * 2f64.sqrt() * self.spacing
    }
}

/// Finds them over the sampler's whole domain.
///
/// # Errors
/// When the token is raised.
pub(super) fn find(sampler: &Sampler<'_>) -> Result<Zeros, Canceled> {
    let domain = sampler.domain();
    let (lo, hi) = (DVec3::from(domain.min).truncate(), DVec3::from(domain.max).truncate());
    let bound = sampler.field().lipschitz().map(f64::from);
    let mut side = if bound.is_some() { FIRST.0 } else { FIRST.1 };
    let mut grid = Grid { origin: lo, spacing: (hi - lo).max_element() / f64::from(side) };
    let counts = ((hi - lo) / grid.spacing - 1e-9).ceil().max(DVec2::ONE).as_ivec2();
    let mut cells: Vec<IVec2> = (0..counts.y).flat_map(|y| (0..counts.x).map(move |x| IVec2::new(x, y))).collect();
    loop {
        cells = near(grid, cells, bound, sampler)?;
        if cells.len() >= ENOUGH || 2 * side > FINEST {
            break;
        }
        side *= 2;
        grid.spacing *= 0.5;
        cells = cells.into_iter().flat_map(|c| CORNERS.map(|d| 2 * c + d)).collect();
    }
    collect(grid, &cells, sampler)
}

/// The cells that the zero set may pass.
fn near(grid: Grid, cells: Vec<IVec2>, bound: Option<f64>, sampler: &Sampler<'_>) -> Result<Vec<IVec2>, Canceled> {
    let centers = grid.centers(&cells);
    let keep: Vec<bool> = match bound {
        Some(bound) => sampler.values(&centers)?.iter().map(|s| s.abs() <= bound * grid.reach()).collect(),
        None => {
            let (values, gradients) = sampler.gradients(&centers)?;
            let near = |(s, g): (&f64, &DVec3)| s.abs() <= SLACK * g.length() * grid.reach();
            let mut keep: Vec<bool> = values.iter().zip(&gradients).map(near).collect();
            let at: HashMap<IVec2, usize> = cells.iter().enumerate().map(|(i, &c)| (c, i)).collect();
            for (i, &c) in cells.iter().enumerate() {
                for step in [IVec2::X, IVec2::Y] {
                    if let Some(&j) = at.get(&(c + step))
                        && (values[i] < 0.0) != (values[j] < 0.0)
                    {
                        (keep[i], keep[j]) = (true, true);
                    }
                }
            }
            keep
        }
    };
    Ok(cells.into_iter().zip(keep).filter_map(|(c, k)| k.then_some(c)).collect())
}

fn collect(grid: Grid, cells: &[IVec2], sampler: &Sampler<'_>) -> Result<Zeros, Canceled> {
    // nodes of the cells, each once, in the order they are met
    let mut index: HashMap<IVec2, usize> = HashMap::with_capacity(2 * cells.len());
    let mut places: Vec<DVec3> = Vec::new();
    for &c in cells {
        for d in CORNERS {
            index.entry(c + d).or_insert_with(|| {
                places.push(grid.at((c + d).as_dvec2()));
                places.len() - 1
            });
        }
    }
    let values = sampler.values(&places)?;
    let inside = |node: IVec2| values[index[&node]] < 0.0;
    let (mut brackets, mut crossings) = (Vec::new(), HashMap::new());
    // edges of a cell from its corners k to k + 1, the lower end first
    let edge = |c: IVec2, k: usize| {
        let (a, b) = (c + CORNERS[k], c + CORNERS[(k + 1) % 4]);
        if (a.y, a.x) < (b.y, b.x) { (a, b) } else { (b, a) }
    };
    let mut pairs: Vec<[usize; 2]> = Vec::new();
    let mut saddles: Vec<(IVec2, [usize; 4])> = Vec::new();
    for &c in cells {
        let mut crossed: [Option<usize>; 4] = [None; 4];
        for (k, slot) in crossed.iter_mut().enumerate() {
            let (a, b) = edge(c, k);
            if inside(a) != inside(b) {
                *slot = Some(*crossings.entry((a, b)).or_insert_with(|| {
                    let [i, j] = [index[&a], index[&b]];
                    brackets.push(Bracket { from: places[i], to: places[j], at_from: values[i], at_to: values[j] });
                    brackets.len() - 1
                }));
            }
        }
        let found: Vec<usize> = crossed.iter().flatten().copied().collect();
        match found[..] {
            [a, b] => pairs.push([a, b]),
            [a, b, c0, d] => saddles.push((c, [a, b, c0, d])),
            _ => {}
        }
    }
    // edge k runs from corner k to corner k + 1; what the center agrees with is joined through it
    let middles: Vec<IVec2> = saddles.iter().map(|s| s.0).collect();
    for ((c, [a, b, c0, d]), center) in saddles.into_iter().zip(sampler.values(&grid.centers(&middles))?) {
        let around_even = inside(c) != (center < 0.0);
        pairs.extend(if around_even { [[d, a], [b, c0]] } else { [[a, b], [c0, d]] });
    }
    let mut points = roots(brackets, TIGHT * grid.spacing, sampler)?;
    let mut loops: Vec<Option<usize>> = components(points.len(), &pairs).into_iter().map(Some).collect();
    let on_edges = points.len();
    let quiet = |c: &&IVec2| CORNERS.iter().all(|&d| inside(**c + d) == inside(**c));
    let starts: Vec<IVec2> = cells.iter().filter(quiet).copied().collect();
    points.extend(trace(&grid.centers(&starts), grid.reach(), sampler)?.into_iter().flatten());
    loops.resize(points.len(), None);
    let (_, gradients) = sampler.gradients(&points)?;
    let normals: Vec<DVec3> = gradients.iter().map(|g| g.normalize_or_zero()).collect();
    let weight = |(i, n): (usize, &DVec3)| match n.x.abs() + n.y.abs() {
        crossings if i < on_edges && crossings > 0.0 => grid.spacing / crossings,
        _ => 0.0,
    };
    let weights = normals.iter().enumerate().map(weight).collect();
    Ok(Zeros { points, normals, weights, loops })
}

/// Numbers `count` things so that those of a pair have the same number.
fn components(count: usize, pairs: &[[usize; 2]]) -> Vec<usize> {
    let mut parent: Vec<usize> = (0..count).collect();
    fn root(parent: &mut [usize], mut i: usize) -> usize {
        while parent[i] != i {
            parent[i] = parent[parent[i]];
            i = parent[i];
        }
        i
    }
    for &[a, b] in pairs {
        let (a, b) = (root(&mut parent, a), root(&mut parent, b));
        parent[a.max(b)] = a.min(b);
    }
    (0..count).map(|i| root(&mut parent, i)).collect()
}
