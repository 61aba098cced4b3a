//! The tree that a scene is compiled to: shapes at the leaves, operators above them, all lengths in `f32`.

use super::polygon::Polygon;

/// A shape or an operator on shapes. A node of a 2-D scene sees a third coordinate of 0.
#[derive(Clone, Debug)]
pub(super) enum Node {
    Shape(Shape),
    Combine { how: Combine, smooth: Option<f32>, of: Vec<Node> },
    Round { radius: f32, of: Box<Node> },
    Shell { thickness: f32, of: Box<Node> },
    Displace { amplitude: f32, frequency: [f32; 3], of: Box<Node> },
    Place { similarity: Similarity, kernel: Placement, of: Box<Node> },
    Mirror { axis: usize, of: Box<Node> },
    Repeat { repeat: Repeat, of: Box<Node> },
}

/// How a list of shapes becomes one; folded from the left.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Combine {
    Union,
    Intersection,
    Difference,
}

/// A shape about the origin; solids with an axis have it along z.
#[derive(Clone, Debug)]
pub(super) enum Shape {
    Sphere {
        radius: f32,
    },
    Ellipsoid {
        radii: [f64; 3],
    },
    /// Also the rounded box: `half_extents` are those before rounding by `radius`.
    Box {
        half_extents: [f32; 3],
        radius: f32,
    },
    Capsule {
        from: [f32; 3],
        along: [f32; 3],
        aside: [f32; 3],
        radius: f32,
    },
    Cylinder {
        radius: f32,
        half_height: f32,
    },
    Torus {
        major: f32,
        minor: f32,
    },
    HalfSpace {
        normal: [f32; 3],
        offset: f32,
    },
    Octahedron {
        size: f32,
    },
    Rectangle {
        half_extents: [f32; 2],
    },
    Polygon {
        polygon: Polygon,
    },
    Extrude {
        polygon: Polygon,
        half_height: f32,
    },
    /// About the z axis, polygon in (distance from the axis, z).
    Revolve {
        polygon: Polygon,
    },
}

/// Copies of a shape on a grid about the origin.
#[derive(Clone, Debug)]
pub(super) struct Repeat {
    /// Distance between neighbours; 0 where there is only one copy.
    pub spacing: [f32; 3],
    /// Copies per axis, at least 1.
    pub count: [u32; 3],
    /// Copies per axis that are evaluated at a point, the nearest ones; at most `count`.
    pub near: [u32; 3],
    /// Whether leaving the other copies out can be seen in the values (then these are not continuous).
    pub torn: bool,
}

/// `outer = translation + scale * rotation * inner`, in `f64` until the whole chain is known.
#[derive(Clone, Copy, Debug)]
pub(super) struct Similarity {
    pub rotation: [[f64; 3]; 3],
    pub translation: [f64; 3],
    pub scale: f64,
}

/// What evaluation needs of a [`Similarity`]: `inner = matrix * (outer - translation)`, `gradient = transpose * inner gradient`.
#[derive(Clone, Copy, Debug)]
pub(super) struct Placement {
    pub translation: [f32; 3],
    /// Rotation by the inverse, divided by the scale; none for a translation alone.
    pub matrix: Option<[[f32; 3]; 3]>,
    /// The rotation, for gradients.
    pub rotation: [[f32; 3]; 3],
    pub scale: f32,
}

const IDENTITY: [[f64; 3]; 3] = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];

impl Similarity {
    pub fn translation(by: [f64; 3]) -> Self {
        Self { rotation: IDENTITY, translation: by, scale: 1.0 }
    }

    pub fn scaling(factor: f64) -> Self {
        Self { rotation: IDENTITY, translation: [0.0; 3], scale: factor }
    }

    /// Rotation by `angle` radians about the unit vector `axis`, counter-clockwise seen from its tip (Rodrigues' formula).
    pub fn rotation(axis: [f64; 3], angle: f64) -> Self {
        let ([x, y, z], (s, c)) = (axis, angle.sin_cos());
        let d = 1.0 - c;
        let rotation = [
            [c + x * x * d, x * y * d - z * s, x * z * d + y * s],
            [y * x * d + z * s, c + y * y * d, y * z * d - x * s],
            [z * x * d - y * s, z * y * d + x * s, c + z * z * d],
        ];
        Self { rotation, translation: [0.0; 3], scale: 1.0 }
    }

    /// From the inner frame to the outer one.
    pub fn apply(&self, p: [f64; 3]) -> [f64; 3] {
        std::array::from_fn(|i| {
            let r = self.rotation[i];
            self.translation[i] + self.scale * (r[0] * p[0] + r[1] * p[1] + r[2] * p[2])
        })
    }

    /// `self` after `inner`.
    fn after(&self, inner: &Self) -> Self {
        let rotation = std::array::from_fn(|i| {
            std::array::from_fn(|j| (0..3).map(|k| self.rotation[i][k] * inner.rotation[k][j]).sum())
        });
        Self { rotation, translation: self.apply(inner.translation), scale: self.scale * inner.scale }
    }

    fn kernel(&self) -> Placement {
        let moved_only = self.rotation == IDENTITY && self.scale == 1.0;
        let r = self.rotation;
        Placement {
            translation: self.translation.map(|t| t as f32),
            matrix: (!moved_only)
                .then(|| std::array::from_fn(|i| std::array::from_fn(|j| (r[j][i] / self.scale) as f32))),
            rotation: r.map(|row| row.map(|c| c as f32)),
            scale: self.scale as f32,
        }
    }
}

/// Places `of`; a chain of placements becomes one.
pub(super) fn place(similarity: Similarity, of: Node) -> Node {
    match of {
        Node::Place { similarity: inner, of, .. } => {
            let similarity = similarity.after(&inner);
            Node::Place { similarity, kernel: similarity.kernel(), of }
        }
        of => Node::Place { similarity, kernel: similarity.kernel(), of: Box::new(of) },
    }
}

impl Node {
    /// Blocks of scratch (one value per point each) that evaluation needs below this node.
    pub fn scratch(&self) -> usize {
        match self {
            Node::Shape(_) => 0,
            Node::Combine { of, .. } => {
                let first = of.first().map_or(0, Node::scratch);
                of.iter().skip(1).map(|n| 4 + n.scratch()).max().unwrap_or(0).max(first)
            }
            Node::Round { of, .. } | Node::Shell { of, .. } | Node::Displace { of, .. } => of.scratch(),
            Node::Place { of, .. } => 3 + of.scratch(),
            Node::Mirror { of, .. } => 1 + of.scratch(),
            Node::Repeat { of, .. } => 7 + of.scratch(),
        }
    }

    /// Shapes evaluated per point, an edge of a polygon counted as a quarter.
    pub fn cost(&self) -> u64 {
        match self {
            Node::Shape(Shape::Polygon { polygon } | Shape::Extrude { polygon, .. } | Shape::Revolve { polygon }) => {
                1 + polygon.edges.len() as u64 / 4
            }
            Node::Shape(_) => 1,
            Node::Combine { of, .. } => of.iter().map(Node::cost).fold(0, u64::saturating_add),
            Node::Round { of, .. }
            | Node::Shell { of, .. }
            | Node::Displace { of, .. }
            | Node::Place { of, .. }
            | Node::Mirror { of, .. } => of.cost(),
            Node::Repeat { repeat, of } => repeat.near.iter().fold(of.cost(), |c, &n| c.saturating_mul(u64::from(n))),
        }
    }
}
