//! From JSON to the tree, under limits, with as many faults found in one pass as there are.

mod values;

use super::kinds::{KINDS, Kind};
use super::node::{Combine, Node, Shape, Similarity, place};
use super::polygon::Polygon;
use super::trust::neighbours;
use crate::field::{Fault, FieldError, type_name};
use serde_json::{Map, Value};

/// Bytes of a scene's JSON.
pub(super) const MAX_BYTES: u64 = 1 << 20;
/// Nodes on a path from the root. A node takes at most three levels of JSON, so a scene of this depth inside a job stays
/// within the 128 levels that serde_json reads.
pub(super) const MAX_DEPTH: usize = 40;
/// Levels of JSON in a scene: those of the deepest node, and two for the points of a polygon.
pub(super) const MAX_NESTING: u64 = 3 * MAX_DEPTH as u64 + 2;
/// Nodes of a scene.
const MAX_NODES: usize = 4096;
/// Points of one polygon: looking for self-intersections compares all pairs of edges.
const MAX_POLYGON: usize = 2048;
/// Points of all polygons together.
const MAX_POINTS: usize = 1 << 14;
/// Shapes evaluated per point, copies of a repetition counted.
const MAX_COST: u64 = 1 << 16;
/// Copies of a repetition that are evaluated per point.
const MAX_COPIES: u64 = 64;
/// Largest magnitude of a number: lengths far beyond lose the surface in the rounding of `f32`.
const LARGEST: f64 = 1e6;
/// Smallest length, factor or vector.
const SMALLEST: f64 = 1e-6;
/// Faults that are reported; more help nobody.
const MAX_FAULTS: usize = 64;

/// Dimension of a node.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Dimension {
    Two,
    Three,
}

impl Dimension {
    fn of_length(length: usize) -> Option<Self> {
        match length {
            2 => Some(Dimension::Two),
            3 => Some(Dimension::Three),
            _ => None,
        }
    }
    fn length(self) -> usize {
        match self {
            Dimension::Two => 2,
            Dimension::Three => 3,
        }
    }
}

/// The tree of a scene, and its dimension.
pub(super) fn parse(value: &Value) -> Result<(Node, Dimension), FieldError> {
    let mut parser = Parser { faults: Vec::new(), path: Vec::new(), nodes: 0, points: 0, scale: 1.0 };
    let parsed = parser.node(value, 1);
    if let Some((node, _)) = &parsed
        && node.cost() > MAX_COST
    {
        let cost = node.cost();
        parser.fault("too_costly", format!("a point costs {cost} shapes, copies counted; the limit is {MAX_COST}"));
    }
    match parsed {
        Some(parsed) if parser.faults.is_empty() => Ok(parsed),
        _ => Err(FieldError::Invalid { faults: parser.faults }),
    }
}

/// What is where in the document.
struct Parser {
    faults: Vec<Fault>,
    path: Vec<Step>,
    nodes: usize,
    points: usize,
    /// Product of the factors of the `scale` nodes above.
    scale: f64,
}

enum Step {
    Name(String),
    Index(usize),
}

type Members<'v> = &'v Map<String, Value>;
type Parsed = Option<(Node, Dimension)>;

impl Parser {
    fn fault(&mut self, code: &'static str, detail: impl Into<String>) {
        if self.faults.len() >= MAX_FAULTS {
            return;
        }
        let mut pointer = String::new();
        for step in &self.path {
            pointer.push('/');
            match step {
                Step::Name(name) => pointer.push_str(&name.replace('~', "~0").replace('/', "~1")),
                Step::Index(i) => pointer.push_str(&i.to_string()),
            }
        }
        self.faults.push(Fault { pointer, code, detail: detail.into() });
    }

    fn at<T>(&mut self, name: &str, read: impl FnOnce(&mut Self) -> T) -> T {
        // names come from the document: long ones are cut
        self.path.push(Step::Name(name.chars().take(64).collect()));
        let result = read(self);
        self.path.pop();
        result
    }

    fn item<T>(&mut self, index: usize, read: impl FnOnce(&mut Self) -> T) -> T {
        self.path.push(Step::Index(index));
        let result = read(self);
        self.path.pop();
        result
    }

    fn node(&mut self, value: &Value, depth: usize) -> Parsed {
        if depth > MAX_DEPTH {
            self.fault("too_deep", format!("nodes are nested more than {MAX_DEPTH} deep"));
            return None;
        }
        self.nodes += 1;
        if self.nodes > MAX_NODES {
            if self.nodes == MAX_NODES + 1 {
                self.fault("too_many_nodes", format!("the scene has more than {MAX_NODES} nodes"));
            }
            return None;
        }
        let Some(object) = value.as_object() else {
            self.fault("wrong_type", format!("a node is an object, and this is {}", type_name(value)));
            return None;
        };
        let mut names = object.iter();
        let (Some((name, body)), None) = (names.next(), names.next()) else {
            let count = object.len();
            self.fault("not_one_member", format!("a node has exactly one member, its kind, and this one has {count}"));
            return None;
        };
        self.at(name, |parser| {
            let Some(kind) = KINDS.iter().find(|k| k.name == name) else {
                let known: Vec<_> = KINDS.iter().map(|k| k.name).collect();
                let name: String = name.chars().take(64).collect();
                parser.fault("unknown_kind", format!("there is no kind {name:?}; the kinds are {}", known.join(", ")));
                return None;
            };
            let members = parser.members(kind, body, depth)?;
            parser.body(kind, members, depth)
        })
    }

    /// The members of a node, when all are there that must be; members that must not be there are faults, too.
    fn members<'v>(&mut self, kind: &Kind, body: &'v Value, depth: usize) -> Option<Members<'v>> {
        let Some(members) = body.as_object() else {
            self.fault(
                "wrong_type",
                format!("the members of {} are an object, and this is {}", kind.name, type_name(body)),
            );
            return None;
        };
        for name in members.keys().filter(|m| !kind.members.contains(&m.as_str())) {
            let known = kind.members.join(", ");
            let shown: String = name.chars().take(64).collect();
            self.at(name, |p| {
                p.fault("unknown_member", format!("{} has no member {shown:?}; its members are {known}", kind.name));
            });
        }
        let optional = |m: &str| kind.name == "rotate" && m == "axis";
        let mut complete = true;
        for member in kind.members.iter().filter(|&&m| !members.contains_key(m) && !optional(m)) {
            complete = false;
            self.at(member, |p| p.fault("missing_member", format!("{} needs the member {member:?}", kind.name)));
        }
        if !complete {
            // what is inside is looked at all the same
            if let Some(of) = members.get("of") {
                self.at("of", |p| match of {
                    Value::Array(list) => {
                        list.iter().enumerate().for_each(|(i, v)| drop(p.item(i, |p| p.node(v, depth + 1))));
                    }
                    one => drop(p.node(one, depth + 1)),
                });
            }
            return None;
        }
        Some(members)
    }

    fn body(&mut self, kind: &Kind, m: Members<'_>, depth: usize) -> Parsed {
        use Dimension::{Three, Two};
        let shape = |shape: Option<Shape>, dimension| Some((Node::Shape(shape?), dimension));
        let narrow = |v: f64| v as f32;
        match kind.name {
            "sphere" | "circle" => {
                let radius = self.length(m, "radius").map(narrow);
                shape(radius.map(|radius| Shape::Sphere { radius }), if kind.plane { Two } else { Three })
            }
            "ellipsoid" => shape(self.lengths::<3>(m, "radii").map(|radii| Shape::Ellipsoid { radii }), Three),
            "box" => {
                let half = self.lengths::<3>(m, "half_extents");
                shape(half.map(|h| Shape::Box { half_extents: h.map(narrow), radius: 0.0 }), Three)
            }
            "rounded_box" => {
                let (half, radius) = (self.lengths::<3>(m, "half_extents"), self.length(m, "radius"));
                let (half, radius) = (half?, radius?);
                if half.iter().any(|&h| h < radius) {
                    self.at("radius", |p| {
                        p.fault(
                            "out_of_range",
                            "the radius is larger than a half extent, which the rounding is part of",
                        );
                    });
                    return None;
                }
                let half_extents = half.map(|h| (h - radius) as f32);
                shape(Some(Shape::Box { half_extents, radius: radius as f32 }), Three)
            }
            "rectangle" => {
                let half = self.lengths::<2>(m, "half_extents");
                shape(half.map(|h| Shape::Rectangle { half_extents: h.map(narrow) }), Two)
            }
            "capsule" => self.capsule(m),
            "cylinder" => {
                let (radius, half_height) = (self.length(m, "radius"), self.length(m, "half_height"));
                shape(Some(Shape::Cylinder { radius: radius? as f32, half_height: half_height? as f32 }), Three)
            }
            "cone" => {
                let (radius, half_height) = (self.length(m, "radius"), self.length(m, "half_height"));
                let top = self.at("top_radius", |p| {
                    let top = p.number(&m["top_radius"])?;
                    if top != 0.0 && top < SMALLEST {
                        p.fault("not_positive", "the top radius is 0 (a tip) or a length");
                        return None;
                    }
                    Some(top)
                });
                let (r, h, top) = (radius?, half_height?, top?);
                let mut points = vec![[0.0, -h], [r, -h], [top, h]];
                if top > 0.0 {
                    points.push([0.0, h]);
                }
                shape(Some(Shape::Revolve { polygon: Polygon::profile(&points) }), Three)
            }
            "torus" => {
                let (major, minor) = (self.length(m, "major"), self.length(m, "minor"));
                shape(Some(Shape::Torus { major: major? as f32, minor: minor? as f32 }), Three)
            }
            "half_space" => {
                let offset = self.at("offset", |p| p.number(&m["offset"]));
                let normal = self.at("normal", |p| p.direction(&m["normal"], None));
                let ((normal, dimension), offset) = (normal?, offset?);
                shape(Some(Shape::HalfSpace { normal: normal.map(narrow), offset: offset as f32 }), dimension)
            }
            "octahedron" => shape(self.length(m, "size").map(|s| Shape::Octahedron { size: s as f32 }), Three),
            "hex_prism" => {
                let (radius, half_height) = (self.length(m, "radius"), self.length(m, "half_height"));
                let (radius, half_height) = (radius?, half_height?);
                let corner = |i: usize| {
                    let (s, c) = (i as f64 * std::f64::consts::FRAC_PI_3).sin_cos();
                    [radius * c, radius * s]
                };
                let polygon = Polygon::new(&std::array::from_fn::<_, 6, _>(corner));
                shape(Some(Shape::Extrude { polygon, half_height: half_height as f32 }), Three)
            }
            "polygon" => {
                let points = self.at("points", |p| p.polygon(&m["points"]))?;
                shape(Some(Shape::Polygon { polygon: Polygon::new(&points) }), Two)
            }
            "extrude" => {
                let half_height = self.length(m, "half_height");
                let points = self.at("polygon", |p| p.polygon(&m["polygon"]));
                let polygon = Polygon::new(&points?);
                shape(Some(Shape::Extrude { polygon, half_height: half_height? as f32 }), Three)
            }
            "revolve" => self.revolve(m),
            "union" => self.combine(Combine::Union, m, depth),
            "intersection" => self.combine(Combine::Intersection, m, depth),
            "difference" => self.combine(Combine::Difference, m, depth),
            "smooth_union" => self.combine(Combine::Union, m, depth),
            "smooth_intersection" => self.combine(Combine::Intersection, m, depth),
            "smooth_difference" => self.combine(Combine::Difference, m, depth),
            _ => self.unary(kind.name, m, depth),
        }
    }

    fn capsule(&mut self, m: Members<'_>) -> Parsed {
        let radius = self.length(m, "radius");
        let from = self.at("from", |p| p.vector(&m["from"], None));
        let to = self.at("to", |p| p.vector(&m["to"], from.map(|f| f.1)));
        let ((from, dimension), (to, _), radius) = (from?, to?, radius?);
        let along: [f64; 3] = std::array::from_fn(|k| to[k] - from[k]);
        let shape = Shape::Capsule {
            from: from.map(|c| c as f32),
            along: along.map(|c| c as f32),
            aside: across(along),
            radius: radius as f32,
        };
        Some((Node::Shape(shape), dimension))
    }

    fn revolve(&mut self, m: Members<'_>) -> Parsed {
        let offset = self.at("offset", |p| p.number(&m["offset"]));
        let points = self.at("polygon", |p| p.polygon(&m["polygon"]));
        let (mut points, offset) = (points?, offset?);
        for (i, point) in points.iter_mut().enumerate() {
            point[0] += offset;
            // what the sum of two decimal numbers leaves is on the axis
            if point[0].abs() < SMALLEST {
                point[0] = 0.0;
            }
            if point[0] < 0.0 {
                self.at("polygon", |p| {
                    p.item(i, |p| {
                        p.fault("crosses_axis", "with the offset this point is left of the axis of revolution")
                    });
                });
                return None;
            }
        }
        let polygon = Polygon::profile(&points);
        Some((Node::Shape(Shape::Revolve { polygon }), Dimension::Three))
    }

    fn combine(&mut self, how: Combine, m: Members<'_>, depth: usize) -> Parsed {
        let smooth = m.contains_key("k").then(|| self.length(m, "k"));
        let children = self.at("of", |p| {
            let Some(list) = m["of"].as_array() else {
                p.fault("wrong_type", format!("this is a list of nodes, and here is {}", type_name(&m["of"])));
                return None;
            };
            if list.is_empty() {
                p.fault("empty", "the list needs at least one node");
                return None;
            }
            let (mut nodes, mut dimension) = (Vec::new(), None);
            for (i, value) in list.iter().enumerate() {
                p.item(i, |p| {
                    let Some((node, own)) = p.node(value, depth + 1) else { return };
                    if *dimension.get_or_insert(own) != own {
                        p.fault("mixed_dimensions", "this node and the first one differ in dimension");
                    }
                    nodes.push(node);
                });
            }
            (nodes.len() == list.len()).then_some((nodes, dimension?))
        });
        let smooth = match smooth {
            None => None,
            Some(k) => Some(k? as f32),
        };
        let (of, dimension) = children?;
        Some((Node::Combine { how, smooth, of }, dimension))
    }

    fn unary(&mut self, kind: &str, m: Members<'_>, depth: usize) -> Parsed {
        let above = self.scale;
        let factor = if kind == "scale" { self.factor(m) } else { Some(1.0) };
        let child = self.at("of", |p| p.node(&m["of"], depth + 1));
        self.scale = above;
        // vectors must fit the child; without a child either length passes
        let own = child.as_ref().map(|c| c.1);
        let node = match kind {
            "round" => self.length(m, "radius").and_then(|radius| {
                let (of, _) = child?;
                Some(Node::Round { radius: radius as f32, of: Box::new(of) })
            }),
            "shell" => self.length(m, "thickness").and_then(|thickness| {
                let (of, _) = child?;
                Some(Node::Shell { thickness: thickness as f32, of: Box::new(of) })
            }),
            "displace" => {
                let amplitude = self.at("amplitude", |p| p.number(&m["amplitude"]));
                let frequency = self.at("frequency", |p| {
                    let (v, _) = p.vector(&m["frequency"], own)?;
                    if v == [0.0; 3] {
                        p.fault("zero_vector", "at least one frequency differs from 0");
                        return None;
                    }
                    Some(v.map(|f| f as f32))
                });
                let (amplitude, frequency, (of, _)) = (amplitude?, frequency?, child?);
                Some(Node::Displace { amplitude: amplitude as f32, frequency, of: Box::new(of) })
            }
            "translate" => self
                .at("by", |p| p.vector(&m["by"], own))
                .and_then(|(by, _)| Some(place(Similarity::translation(by), child?.0))),
            "rotate" => {
                let angle = self.at("angle", |p| p.number(&m["angle"]));
                let axis = self.rotation_axis(m, own);
                let (angle, axis) = (angle?, axis?);
                Some(place(Similarity::rotation(axis, angle.to_radians()), child?.0))
            }
            "scale" => factor.and_then(|f| Some(place(Similarity::scaling(f), child?.0))),
            "mirror" => {
                let axis = self.at("axis", |p| p.axis_name(&m["axis"], own));
                let (axis, (of, _)) = (axis?, child?);
                Some(Node::Mirror { axis, of: Box::new(of) })
            }
            _ => {
                let (spacing, count) = (self.at("spacing", |p| p.vector(&m["spacing"], own)), self.counts(m, own));
                let ((spacing, _), count) = (spacing?, count?);
                if let Some(k) = (0..3).find(|&k| count[k] > 1 && spacing[k] < SMALLEST) {
                    let detail = "copies need a positive spacing";
                    self.at("spacing", |p| p.item(k, |p| p.fault("not_positive", detail)));
                    return None;
                }
                let (of, _) = child?;
                let Some(repeat) = neighbours(&of, spacing.map(|s| s as f32), count, MAX_COPIES) else {
                    let detail =
                        "the copies overlap so far that more than 64 of them matter at one point; use a wider spacing";
                    self.fault("overlapping_copies", detail);
                    return None;
                };
                Some(Node::Repeat { repeat, of: Box::new(of) })
            }
        };
        Some((node?, own?))
    }

    /// A factor, with which the product of all factors above stays in range; remembered for the nodes below.
    fn factor(&mut self, m: Members<'_>) -> Option<f64> {
        let factor = self.length(m, "factor")?;
        self.scale *= factor;
        if !(SMALLEST..=LARGEST).contains(&self.scale) {
            let detail = format!("nested factors multiply to {:e}, beyond {SMALLEST:e} to {LARGEST:e}", self.scale);
            self.at("factor", |p| p.fault("out_of_range", detail));
            return None;
        }
        Some(factor)
    }

    fn rotation_axis(&mut self, m: Members<'_>, own: Option<Dimension>) -> Option<[f64; 3]> {
        match (m.get("axis"), own) {
            (None, Some(Dimension::Three)) => {
                self.at("axis", |p| p.fault("missing_member", "a rotation in space needs the member \"axis\""));
                None
            }
            (Some(_), Some(Dimension::Two)) => {
                self.at("axis", |p| p.fault("unknown_member", "a rotation in the plane has no axis"));
                None
            }
            (None, _) => Some([0.0, 0.0, 1.0]),
            (Some(axis), _) => self.at("axis", |p| p.direction(axis, Some(Dimension::Three))).map(|(v, _)| v),
        }
    }
}

/// A unit vector across `v`; across z where `v` is 0. In the plane (third component 0) it stays in the plane.
fn across(v: [f64; 3]) -> [f32; 3] {
    let flat = v[0].hypot(v[1]);
    if flat > 0.0 { [(-v[1] / flat) as f32, (v[0] / flat) as f32, 0.0] } else { [1.0, 0.0, 0.0] }
}
