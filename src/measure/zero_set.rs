//! Points on the zero level set of a field, every component of it, found without the surface that is to be judged.
//!
//! A grid over the whole domain is refined where the zero set may pass: a cell is kept when its centre's value is within reach
//! (of the Lipschitz bound, or of a multiple of the local gradient where there is none) or its sign differs from a neighbour's.
//! On the finest grid every edge whose ends differ in sign holds a point, found by bisection-guarded secants; and every cell
//! near the zero set whose edges all agree is searched once along the gradient, for sheets thinner than the grid.
//!
//! Not guaranteed: that a sheet or a component smaller than a cell is met when the field has no Lipschitz bound.

use super::bvh::Aabb;
use super::certificate::topology;
use crate::field::Sampler;
use crate::settings::Canceled;
use glam::{DVec3, IVec3};
use std::collections::HashMap;

/// Points on the zero level set with what is known about them.
#[derive(Clone, Debug, Default)]
pub struct ZeroSet {
    /// Positions.
    pub points: Vec<DVec3>,
    /// Unit gradients of the field there.
    pub normals: Vec<DVec3>,
    /// Area that each point stands for: the grid's cell face over |nx| + |ny| + |nz|, the number of grid edges of
    /// all three directions that a plane of that normal crosses per face (Cauchy-Crofton); 0 for the points searched along
    /// the gradient, which serve the maximum only.
    pub weights: Vec<f64>,
    /// Spacing of the finest grid, in the sampler's units.
    pub spacing: f64,
}

/// Cells per longest side of the domain on the first level when the field has a Lipschitz bound.
const FIRST_BOUNDED: i32 = 16;
/// The same without a bound: dense enough to meet what the gradient does not announce.
const FIRST_UNBOUNDED: i32 = 48;
/// Refinement ends on the level that gives this many points, ...
const ENOUGH: usize = 10_000;
/// ... or at this many cells per longest side.
const FINEST: i32 = 384;
/// Without a Lipschitz bound, a cell is kept when |s| <= SLACK * |grad s| * half its diagonal.
const SLACK: f64 = 2.0;
/// Rounds of bracketed root finding; every third one halves the bracket, so that it ends at 2^-14 of its length at worst.
const ROUNDS: usize = 42;
/// Share of the grid spacing to which a root is found: a millionth of the domain, near the end of single precision.
pub(super) const TIGHT: f64 = 1e-4;

/// Finds points on the zero level set over the sampler's whole domain.
///
/// # Errors
/// When the token is raised.
pub fn find(sampler: &Sampler<'_>) -> Result<ZeroSet, Canceled> {
    let domain = sampler.domain();
    let (lo, hi) = (DVec3::from(domain.min), DVec3::from(domain.max));
    let bound = sampler.field().lipschitz().map(f64::from);
    let mut side = if bound.is_some() { FIRST_BOUNDED } else { FIRST_UNBOUNDED };
    let longest = (hi - lo).max_element();
    let mut grid = Grid { origin: lo, spacing: longest / f64::from(side) };
    let counts = ((hi - lo) / grid.spacing - 1e-9).ceil().max(DVec3::ONE).as_ivec3();
    let mut cells: Vec<IVec3> = (0..counts.z)
        .flat_map(|z| (0..counts.y).flat_map(move |y| (0..counts.x).map(move |x| IVec3::new(x, y, z))))
        .collect();
    loop {
        cells = near(&grid, cells, bound, sampler)?;
        // a surface crosses about 1.5 edges per cell it passes, and about a third of the cells kept are passed
        if cells.len() / 2 >= ENOUGH || 2 * side > FINEST {
            break;
        }
        side *= 2;
        grid.spacing *= 0.5;
        cells = cells.into_iter().flat_map(|c| CORNERS.map(|d| 2 * c + d)).collect();
    }
    collect(&grid, &cells, sampler)
}

#[derive(Clone, Copy)]
struct Grid {
    origin: DVec3,
    spacing: f64,
}

impl Grid {
    fn node(&self, c: IVec3) -> DVec3 {
        self.origin + self.spacing * c.as_dvec3()
    }
    fn center(&self, c: IVec3) -> DVec3 {
        self.origin + self.spacing * (c.as_dvec3() + 0.5)
    }
}

const CORNERS: [IVec3; 8] = [
    IVec3::new(0, 0, 0),
    IVec3::new(1, 0, 0),
    IVec3::new(0, 1, 0),
    IVec3::new(1, 1, 0),
    IVec3::new(0, 0, 1),
    IVec3::new(1, 0, 1),
    IVec3::new(0, 1, 1),
    IVec3::new(1, 1, 1),
];

/// The cells that the zero set may pass.
fn near(grid: &Grid, cells: Vec<IVec3>, bound: Option<f64>, sampler: &Sampler<'_>) -> Result<Vec<IVec3>, Canceled> {
    let centers: Vec<DVec3> = cells.iter().map(|&c| grid.center(c)).collect();
    let reach = 0.5 * 3f64.sqrt() * grid.spacing;
    let (values, mut keep): (Vec<f64>, Vec<bool>) = match bound {
        Some(bound) => {
            let values = sampler.values(&centers)?;
            let keep = values.iter().map(|s| s.abs() <= bound * reach).collect();
            (values, keep)
        }
        None => {
            let (values, gradients) = sampler.gradients(&centers)?;
            let keep = values.iter().zip(&gradients).map(|(s, g)| s.abs() <= SLACK * g.length() * reach).collect();
            (values, keep)
        }
    };
    if bound.is_none() {
        let at: HashMap<IVec3, u32> = cells.iter().zip(0..).map(|(&c, i)| (c, i)).collect();
        for (i, &c) in cells.iter().enumerate() {
            for step in [IVec3::X, IVec3::Y, IVec3::Z] {
                if let Some(&j) = at.get(&(c + step))
                    && (values[i] < 0.0) != (values[j as usize] < 0.0)
                {
                    (keep[i], keep[j as usize]) = (true, true);
                }
            }
        }
    }
    Ok(cells.into_iter().zip(keep).filter_map(|(c, k)| k.then_some(c)).collect())
}

fn collect(grid: &Grid, cells: &[IVec3], sampler: &Sampler<'_>) -> Result<ZeroSet, Canceled> {
    // nodes of the cells, each once, in the order they are met
    let mut index: HashMap<IVec3, u32> = HashMap::with_capacity(2 * cells.len());
    let mut nodes: Vec<IVec3> = Vec::new();
    for &c in cells {
        for d in CORNERS {
            index.entry(c + d).or_insert_with(|| {
                nodes.push(c + d);
                nodes.len() as u32 - 1
            });
        }
    }
    let places: Vec<DVec3> = nodes.iter().map(|&n| grid.node(n)).collect();
    let values = sampler.values(&places)?;
    let mut brackets = Vec::new();
    for (i, &n) in nodes.iter().enumerate() {
        for step in [IVec3::X, IVec3::Y, IVec3::Z] {
            if let Some(&j) = index.get(&(n + step)) {
                let (s, t) = (values[i], values[j as usize]);
                if (s < 0.0) != (t < 0.0) {
                    brackets.push(Bracket { from: places[i], to: places[j as usize], at_from: s, at_to: t });
                }
            }
        }
    }
    let mut points = roots(brackets, TIGHT * grid.spacing, sampler)?;
    let on_edges = points.len();
    let quiet = |c: &&IVec3| {
        let inside = CORNERS.iter().filter(|&&d| values[index[&(**c + d)] as usize] < 0.0).count();
        inside == 0 || inside == 8
    };
    let starts: Vec<DVec3> = cells.iter().filter(quiet).map(|&c| grid.center(c)).collect();
    let reach = 0.5 * 3f64.sqrt() * grid.spacing;
    points.extend(trace(&starts, reach, sampler)?.into_iter().flatten());
    let (_, gradients) = sampler.gradients(&points)?;
    let normals: Vec<DVec3> = gradients.iter().map(|g| g.normalize_or_zero()).collect();
    let face = grid.spacing * grid.spacing;
    let weight = |(i, n): (usize, &DVec3)| match n.abs().element_sum() {
        crossings if i < on_edges && crossings > 0.0 => face / crossings,
        _ => 0.0,
    };
    let weights = normals.iter().enumerate().map(weight).collect();
    Ok(ZeroSet { points, normals, weights, spacing: grid.spacing })
}

/// A segment whose ends differ in sign.
#[derive(Clone, Copy)]
pub(super) struct Bracket {
    pub(super) from: DVec3,
    pub(super) to: DVec3,
    pub(super) at_from: f64,
    pub(super) at_to: f64,
}

impl Bracket {
    /// The secant's root.
    fn secant(&self) -> DVec3 {
        self.from.lerp(self.to, self.at_from / (self.at_from - self.at_to))
    }
    /// Whether the root is known to within `tight`: by the bracket's length, or by one end's value over the bracket's slope.
    fn is_closed(&self, tight: f64) -> bool {
        let length = self.from.distance(self.to);
        let (s, t) = (self.at_from.abs(), self.at_to.abs());
        length <= tight || s.min(t) * length <= tight * (s + t)
    }
}

/// A root in every bracket, to within `tight`: two secant steps, one halving, and again, so that values that are no distance
/// cannot stall it.
pub(super) fn roots(mut brackets: Vec<Bracket>, tight: f64, sampler: &Sampler<'_>) -> Result<Vec<DVec3>, Canceled> {
    for round in 0..ROUNDS {
        let open: Vec<usize> = (0..brackets.len()).filter(|&i| !brackets[i].is_closed(tight)).collect();
        if open.is_empty() {
            break;
        }
        let halve = round % 3 == 2;
        let pick = |b: &Bracket| if halve { b.from.midpoint(b.to) } else { b.secant() };
        let tries: Vec<DVec3> = open.iter().map(|&i| pick(&brackets[i])).collect();
        for (&i, (&x, s)) in open.iter().zip(tries.iter().zip(sampler.values(&tries)?)) {
            let b = &mut brackets[i];
            if (s < 0.0) == (b.at_from < 0.0) {
                (b.from, b.at_from) = (x, s);
            } else {
                (b.to, b.at_to) = (x, s);
            }
        }
    }
    Ok(brackets.iter().map(Bracket::secant).collect())
}

/// From every start along the field's gradient to the zero level set: Newton steps, none longer than a quarter of `reach`, until
/// the sign changes, then bracketed root finding. `None` where `|s|` grows, the gradient vanishes, or the way is longer than
/// `reach`.
///
/// # Errors
/// When the token is raised.
pub fn trace(starts: &[DVec3], reach: f64, sampler: &Sampler<'_>) -> Result<Vec<Option<DVec3>>, Canceled> {
    /// Newton steps at most: four reach the end when every step is as long as allowed.
    const STEPS: usize = 8;
    let stride = 0.25 * reach;
    let tight = TIGHT * reach;
    let mut found: Vec<Option<DVec3>> = vec![None; starts.len()];
    let mut active: Vec<(usize, DVec3)> = starts.iter().copied().enumerate().collect();
    let (mut brackets, mut owners) = (Vec::new(), Vec::new());
    for _ in 0..STEPS {
        if active.is_empty() {
            break;
        }
        let here: Vec<DVec3> = active.iter().map(|a| a.1).collect();
        let (values, gradients) = sampler.gradients(&here)?;
        let step = |(&s, g): (&f64, &DVec3)| match g.length() {
            slope if slope > 0.0 => -(s / slope).clamp(-stride, stride) * (*g / slope),
            _ => DVec3::ZERO,
        };
        // a little past the predicted root, so that the sign changes and the bracket is tight from both sides
        let moves: Vec<DVec3> = values.iter().zip(&gradients).map(step).collect();
        let there: Vec<DVec3> = here.iter().zip(&moves).map(|(&x, &m)| x + m + m.normalize_or_zero() * tight).collect();
        let next = sampler.values(&there)?;
        let mut still = Vec::new();
        for (k, &(i, x)) in active.iter().enumerate() {
            let (s, t, y) = (values[k], next[k], there[k]);
            if s == 0.0 {
                found[i] = Some(x);
            } else if (s < 0.0) != (t < 0.0) {
                brackets.push(Bracket { from: x, to: y, at_from: s, at_to: t });
                owners.push(i);
            } else if t.abs() < s.abs() && y.distance(starts[i]) <= reach {
                still.push((i, y));
            }
        }
        active = still;
    }
    for (i, root) in owners.into_iter().zip(roots(brackets, tight, sampler)?) {
        if root.distance(starts[i]) <= reach {
            found[i] = Some(root);
        }
    }
    Ok(found)
}

impl ZeroSet {
    /// Bounding box of the points.
    pub fn bounds(&self) -> Aabb {
        Aabb::of(&self.points)
    }
    /// Area by Cauchy-Crofton, in squared units.
    pub fn area(&self) -> f64 {
        self.weights.iter().sum()
    }
    /// Number of clusters of points, a count of the components of the zero set: points up to two grid spacings apart are in
    /// one cluster, points four apart are not joined directly.
    pub fn clusters(&self) -> u64 {
        // bins of two spacings: points two spacings apart in every coordinate are in neighbouring bins at most
        let bin = |p: DVec3| (p / (2.0 * self.spacing)).floor().as_ivec3();
        let mut index: HashMap<IVec3, u32> = HashMap::new();
        let mut bins: Vec<IVec3> = Vec::new();
        for &p in &self.points {
            index.entry(bin(p)).or_insert_with(|| {
                bins.push(bin(p));
                bins.len() as u32 - 1
            });
        }
        let mut links: Vec<[u32; 3]> = Vec::new();
        for (i, &b) in bins.iter().enumerate() {
            links.push([i as u32; 3]);
            for z in -1..=1 {
                for y in -1..=1 {
                    for x in -1..=1 {
                        if let Some(&j) = index.get(&(b + IVec3::new(x, y, z))) {
                            links.push([i as u32, j, j]);
                        }
                    }
                }
            }
        }
        topology(bins.len(), &links).components
    }
}

#[cfg(test)]
mod tests {
    use super::super::fixtures::*;
    use super::*;
    use crate::field::sampler::Tally;
    use crate::field::{Field, Metric};
    use glam::Vec3;
    use std::f64::consts::PI;

    fn found(field: &dyn Field) -> ZeroSet {
        with_settings(2, |settings| find(&Sampler::new(field, *settings, &Tally::new())).unwrap())
    }

    #[test]
    fn points_lie_on_the_sphere_and_add_up_to_its_area() {
        for (slope, metric) in [(1.0, Metric::Exact), (40.0, Metric::Bound), (0.02, Metric::Sign)] {
            let set = found(&Balls { slope, metric, ..Balls::one(0.6) });
            assert!(set.points.len() > 10_000, "{}", set.points.len());
            for (p, n) in set.points.iter().zip(&set.normals) {
                assert!((p.length() - 0.6).abs() < 2e-6, "{}", p.length());
                assert!(n.dot(p.normalize()) > 0.9999);
            }
            assert!((set.area() / (4.0 * PI * 0.36) - 1.0).abs() < 0.01, "{}", set.area());
            assert_eq!(set.clusters(), 1);
        }
    }

    #[test]
    fn a_floater_far_from_the_rest_is_found() {
        let balls = vec![(Vec3::new(-0.3, 0.0, 0.0), 0.4), (Vec3::new(0.8, 0.8, 0.8), 0.03)];
        for metric in [Metric::Exact, Metric::Bound] {
            let set = found(&Balls { balls: balls.clone(), slope: 1.0, metric });
            assert_eq!(set.clusters(), 2, "{metric:?}");
        }
    }

    #[test]
    fn tracing_stops_at_its_reach_and_never_passes_it() {
        let field = Balls { slope: 300.0, metric: Metric::Sign, ..Balls::one(0.5) };
        with_settings(1, |settings| {
            let tally = Tally::new();
            let sampler = Sampler::new(&field, *settings, &tally);
            let starts = [DVec3::X * 0.55, DVec3::Y * 0.45, DVec3::Z * 0.75, DVec3::ZERO];
            let ends = trace(&starts, 0.1, &sampler).unwrap();
            for (end, expected) in ends.iter().zip([Some(DVec3::X * 0.5), Some(DVec3::Y * 0.5), None, None]) {
                assert_eq!(end.is_some(), expected.is_some(), "{ends:?}");
                if let (Some(end), Some(expected)) = (end, expected) {
                    assert!(end.distance(expected) < 1e-5, "{end}");
                }
            }
        });
    }

    #[test]
    fn a_field_without_a_zero_set_has_no_points() {
        assert!(found(&Balls { balls: vec![(Vec3::ZERO, -0.5)], slope: 1.0, metric: Metric::Bound }).points.is_empty());
    }
}
