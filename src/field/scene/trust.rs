//! How far a scene's values can be trusted, and where its solid lies: both follow from the tree, without evaluating it.
//!
//! Rules, with "exact outside" for a value that is the distance wherever it is positive, "exact inside" where negative:
//!
//! | node | exact outside | exact inside | Lipschitz bound |
//! |---|---|---|---|
//! | shapes | yes | yes (a torus without a hole: no) | 1 |
//! | union | if all are | if all are and their boxes are disjoint | the largest |
//! | intersection | no | if all are | the largest |
//! | difference | no | first inside and the rest outside | the largest |
//! | smooth forms | no | no | the largest |
//! | round | if the child is | if the child is exact and convex | the child's |
//! | shell | if the child is exact on both sides | no | the child's |
//! | displace | no | no | the child's + abs(amplitude) max abs(frequency) |
//! | translate, rotate, scale | the child's | the child's | the child's |
//! | mirror | if the child stays on its side | the same | the child's |
//! | repeat | if the child is | and copies are apart | the child's; none where copies left out can be seen |
//!
//! The distance is that to the zero set of the function. A continuous function with Lipschitz bound L has |s| <= L times that
//! distance, so every scene with a bound is at least a [`Metric::Bound`].

use super::node::{Combine, Node, Repeat, Shape};
use crate::field::Metric;

/// What is known of a node's values.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Trust {
    pub outside: bool,
    pub inside: bool,
    pub convex: bool,
    /// None where the function jumps.
    pub lipschitz: Option<f64>,
}

impl Trust {
    pub fn metric(self) -> Metric {
        match self.lipschitz {
            None => Metric::Sign,
            Some(_) if self.outside && self.inside => Metric::Exact,
            Some(_) => Metric::Bound,
        }
    }
}

/// An axis-aligned box that may be unbounded, or empty (some `min` above its `max`).
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Extent {
    pub min: [f64; 3],
    pub max: [f64; 3],
}

impl Extent {
    const EMPTY: Extent = Extent { min: [f64::INFINITY; 3], max: [f64::NEG_INFINITY; 3] };
    const ALL: Extent = Extent { min: [f64::NEG_INFINITY; 3], max: [f64::INFINITY; 3] };

    fn about_origin(half: [f64; 3]) -> Self {
        Self { min: half.map(|h| -h), max: half }
    }

    pub fn is_empty(&self) -> bool {
        (0..3).any(|k| self.min[k] > self.max[k])
    }

    pub fn is_bounded(&self) -> bool {
        self.min.iter().chain(&self.max).all(|c| c.is_finite())
    }

    fn hull(self, other: Self) -> Self {
        if self.is_empty() {
            return other;
        }
        if other.is_empty() {
            return self;
        }
        Self {
            min: std::array::from_fn(|k| self.min[k].min(other.min[k])),
            max: std::array::from_fn(|k| self.max[k].max(other.max[k])),
        }
    }

    fn common(self, other: Self) -> Self {
        Self {
            min: std::array::from_fn(|k| self.min[k].max(other.min[k])),
            max: std::array::from_fn(|k| self.max[k].min(other.max[k])),
        }
    }

    pub fn grown(self, by: f64) -> Self {
        Self { min: self.min.map(|c| c - by), max: self.max.map(|c| c + by) }
    }

    fn disjoint(&self, other: &Self) -> bool {
        self.common(*other).is_empty()
    }
}

/// Children of a union up to which all pairs are looked at for being apart.
const PAIRS: usize = 64;

/// The trust in `node`'s values.
pub(super) fn trust(node: &Node) -> Trust {
    match node {
        Node::Shape(shape) => Trust {
            outside: true,
            inside: !matches!(shape, Shape::Torus { major, minor } if minor > major),
            convex: match shape {
                Shape::Torus { .. } => false,
                Shape::Polygon { polygon } | Shape::Extrude { polygon, .. } | Shape::Revolve { polygon } => {
                    polygon.convex
                }
                _ => true,
            },
            lipschitz: Some(1.0),
        },
        Node::Combine { how, smooth, of } => {
            let each: Vec<Trust> = of.iter().map(trust).collect();
            let lipschitz = each.iter().map(|t| t.lipschitz).reduce(|a, b| Some(a?.max(b?))).flatten();
            if let [only] = each[..] {
                return only;
            }
            let sharp = smooth.is_none();
            let (outside, inside, convex) = match how {
                Combine::Union => (each.iter().all(|t| t.outside), each.iter().all(|t| t.inside) && apart(of), false),
                Combine::Intersection => (false, each.iter().all(|t| t.inside), each.iter().all(|t| t.convex)),
                Combine::Difference => (false, each[0].inside && each[1..].iter().all(|t| t.outside), false),
            };
            // the smooth maximum of convex functions is convex; an exact child is one where its solid is
            Trust { outside: sharp && outside, inside: sharp && inside, convex: sharp && convex, lipschitz }
        }
        Node::Round { of, .. } => {
            let child = trust(of);
            Trust { inside: child.inside && child.outside && child.convex, ..child }
        }
        Node::Shell { of, .. } => {
            let child = trust(of);
            Trust { outside: child.outside && child.inside, inside: false, convex: false, ..child }
        }
        Node::Displace { amplitude, frequency, of } => {
            let fastest = frequency.iter().fold(0f64, |a, f| a.max(f64::from(f.abs())));
            let steeper = f64::from(amplitude.abs()) * fastest;
            let lipschitz = trust(of).lipschitz.map(|l| l + steeper);
            Trust { outside: false, inside: false, convex: false, lipschitz }
        }
        Node::Place { of, .. } => trust(of),
        Node::Mirror { axis, of } => {
            let child = trust(of);
            let on_its_side = extent(of, 0.0).min[*axis] >= 0.0;
            let (outside, inside) = (child.outside && on_its_side, child.inside && on_its_side);
            Trust { outside, inside, convex: false, ..child }
        }
        Node::Repeat { repeat, of } => {
            let (child, one) = (trust(of), extent(of, 0.0));
            let apart = (0..3).all(|k| {
                let width = one.max[k] - one.min[k];
                repeat.count[k] == 1 || width <= f64::from(repeat.spacing[k])
            });
            Trust {
                outside: child.outside && !repeat.torn,
                inside: child.inside && apart && !repeat.torn,
                convex: child.convex && repeat.count == [1; 3],
                lipschitz: child.lipschitz.filter(|_| !repeat.torn),
            }
        }
    }
}

fn apart(of: &[Node]) -> bool {
    if of.len() > PAIRS {
        return false;
    }
    let boxes: Vec<Extent> = of.iter().map(|n| extent(n, 0.0)).collect();
    boxes.iter().enumerate().all(|(i, a)| boxes[..i].iter().all(|b| a.disjoint(b)))
}

/// A box that holds every point where `node`'s value is at most `level`, for `level` >= 0. Asking for a level, not only for the
/// solid, is what makes the bulge of a smooth union at a sharp edge come out right.
pub(super) fn extent(node: &Node, level: f64) -> Extent {
    match node {
        Node::Shape(shape) => shape_extent(shape, level),
        Node::Combine { how: Combine::Union, smooth, of } => {
            // folded from the left: every later step can add its bulge of at most k/4
            let bulge = smooth.map_or(0.0, |k| 0.25 * f64::from(k));
            let steps = |i: usize| if i == 0 { of.len() - 1 } else { of.len() - i };
            of.iter()
                .enumerate()
                .fold(Extent::EMPTY, |all, (i, n)| all.hull(extent(n, level + bulge * steps(i) as f64)))
        }
        Node::Combine { how: Combine::Intersection, of, .. } => {
            of.iter().fold(Extent::ALL, |all, n| all.common(extent(n, level)))
        }
        Node::Combine { how: Combine::Difference, of, .. } => of.first().map_or(Extent::EMPTY, |n| extent(n, level)),
        Node::Round { radius, of } => extent(of, level + f64::from(*radius)),
        Node::Shell { thickness, of } => extent(of, level + 0.5 * f64::from(*thickness)),
        Node::Displace { amplitude, of, .. } => extent(of, level + f64::from(amplitude.abs())),
        Node::Place { similarity, of, .. } => {
            let inner = extent(of, level / similarity.scale);
            if inner.is_empty() {
                return Extent::EMPTY;
            }
            let reach = |row: [f64; 3], pick: fn(f64, f64) -> f64| -> f64 {
                // a coordinate that does not enter may be unbounded
                let product = |k: usize, c: f64| if row[k] == 0.0 { 0.0 } else { row[k] * c };
                (0..3).map(|k| pick(product(k, inner.min[k]), product(k, inner.max[k]))).sum()
            };
            let (t, s, r) = (similarity.translation, similarity.scale, similarity.rotation);
            Extent {
                min: std::array::from_fn(|i| t[i] + s * reach(r[i], f64::min)),
                max: std::array::from_fn(|i| t[i] + s * reach(r[i], f64::max)),
            }
        }
        Node::Mirror { axis, of } => {
            let mut all = extent(of, level);
            if all.is_empty() || all.max[*axis] < 0.0 {
                return Extent::EMPTY;
            }
            all.min[*axis] = -all.max[*axis];
            all
        }
        Node::Repeat { repeat, of } => {
            let one = extent(of, level);
            let reach = |k: usize| 0.5 * f64::from(repeat.spacing[k]) * f64::from(repeat.count[k] - 1);
            Extent {
                min: std::array::from_fn(|k| one.min[k] - reach(k)),
                max: std::array::from_fn(|k| one.max[k] + reach(k)),
            }
        }
    }
}

fn shape_extent(shape: &Shape, level: f64) -> Extent {
    let wide = f64::from;
    match shape {
        Shape::Sphere { radius } => Extent::about_origin([wide(*radius); 3]),
        Shape::Ellipsoid { radii } => Extent::about_origin(*radii),
        Shape::Box { half_extents, radius } => Extent::about_origin(half_extents.map(|h| wide(h) + wide(*radius))),
        Shape::Capsule { from, along, radius, .. } => {
            let ends = std::array::from_fn::<_, 3, _>(|k| (wide(from[k]), wide(from[k]) + wide(along[k])));
            Extent { min: ends.map(|(a, b)| a.min(b)), max: ends.map(|(a, b)| a.max(b)) }.grown(wide(*radius))
        }
        Shape::Cylinder { radius, half_height } => {
            Extent::about_origin([wide(*radius), wide(*radius), wide(*half_height)])
        }
        Shape::Torus { major, minor } => {
            let r = wide(*major) + wide(*minor);
            Extent::about_origin([r, r, wide(*minor)])
        }
        Shape::HalfSpace { normal, offset } => {
            // bounded on one side where the normal is along an axis
            let mut all = Extent::ALL;
            for k in 0..3 {
                if normal[(k + 1) % 3] == 0.0 && normal[(k + 2) % 3] == 0.0 {
                    if normal[k] > 0.0 {
                        all.max[k] = wide(*offset);
                    } else {
                        all.min[k] = -wide(*offset);
                    }
                }
            }
            all
        }
        Shape::Octahedron { size } => Extent::about_origin([wide(*size); 3]),
        Shape::Rectangle { half_extents: [a, b] } => Extent::about_origin([wide(*a), wide(*b), 0.0]),
        Shape::Polygon { polygon: g } => Extent { min: [g.min[0], g.min[1], 0.0], max: [g.max[0], g.max[1], 0.0] },
        Shape::Extrude { polygon: g, half_height } => {
            let h = wide(*half_height);
            Extent { min: [g.min[0], g.min[1], -h], max: [g.max[0], g.max[1], h] }
        }
        Shape::Revolve { polygon: g } => {
            let r = g.max[0];
            Extent { min: [-r, -r, g.min[1]], max: [r, r, g.max[1]] }
        }
    }
    .grown(level)
}

/// How many neighbouring copies of `of` matter along each axis of a repetition, and whether some that matter are left out
/// because all of them together would be more than `limit`. None when even the nearest are too many.
///
/// Copies that reach at most m/2 spacings to either side are ordered by distance: for every point the nearest solid is
/// among the m + 1 nearest copies. (For a coordinate u of a copy's point, |u| <= m s/2, the point of the next copy on
/// the near side is no farther.) That argument needs the child's values to be distances outside; otherwise all copies are taken.
pub(super) fn neighbours(of: &Node, spacing: [f32; 3], count: [u32; 3], limit: u64) -> Option<Repeat> {
    let one = extent(of, 0.0);
    let ordered: [u32; 3] = std::array::from_fn(|k| {
        let reach = one.max[k].max(-one.min[k]).max(0.0);
        let m = (2.0 * reach / f64::from(spacing[k])).ceil().max(1.0);
        if count[k] > 1 && m + 1.0 < f64::from(count[k]) { m as u32 + 1 } else { count[k] }
    });
    let product = |n: [u32; 3]| n.iter().fold(1u64, |a, &b| a.saturating_mul(u64::from(b)));
    let exact = trust(of).outside;
    let (near, torn) =
        if !exact && product(count) <= limit { (count, false) } else { (ordered, !exact && ordered != count) };
    (product(near) <= limit).then_some(Repeat { spacing, count, near, torn })
}
