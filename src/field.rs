//! Signed distance fields: the only way the algorithm sees a shape.
//!
//! A [`Field`] answers batches of points, structure of arrays in `f32`, with values (positive outside) or with values and
//! gradients. A [`Sampler`] wraps a field for the algorithm: it splits batches over the pool, counts evaluations by stage,
//! watches the cancel token, and closes the field at its [`Domain`] box, beyond which the distance to the box takes over.

pub mod grid;
pub mod input;
pub mod mesh;
pub mod network;
pub mod sampler;
pub mod scene;

pub use sampler::{Counts, Frame, Sampler};

/// A batch of points, one slice per coordinate, all of the same length, in scene units.
#[derive(Clone, Copy, Debug)]
pub struct Points<'a> {
    /// First coordinates.
    pub x: &'a [f32],
    /// Second coordinates.
    pub y: &'a [f32],
    /// Third coordinates; ignored by a field of dimension 2.
    pub z: &'a [f32],
}

impl Points<'_> {
    /// Number of points.
    pub fn len(&self) -> usize {
        self.x.len()
    }
    /// Whether the batch has no point.
    pub fn is_empty(&self) -> bool {
        self.x.is_empty()
    }
}

/// Where a batch of gradients is written, one slice per component, as long as the batch.
pub struct Gradients<'a> {
    /// First components.
    pub x: &'a mut [f32],
    /// Second components.
    pub y: &'a mut [f32],
    /// Third components; a field of dimension 2 writes 0.
    pub z: &'a mut [f32],
}

/// An axis-aligned box in scene units that holds the zero level set.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, serde::Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub struct Domain {
    /// Corner with the smallest coordinates.
    pub min: [f64; 3],
    /// Corner with the largest coordinates.
    pub max: [f64; 3],
}

impl Default for Domain {
    /// The cube of half extent 1 about the origin.
    fn default() -> Self {
        Self { min: [-1.0; 3], max: [1.0; 3] }
    }
}

/// How far a field's values can be trusted.
#[derive(
    Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, serde::Serialize, serde::Deserialize, utoipa::ToSchema,
)]
#[serde(rename_all = "snake_case")]
pub enum Metric {
    /// The value is the Euclidean distance to the zero level set.
    Exact,
    /// The magnitude is at most the distance (after division by the Lipschitz bound).
    Bound,
    /// Only the sign means something.
    Sign,
}

/// A signed function on space whose zero level set is the surface: positive outside, negative inside.
///
/// Implementations are pure: the same point gives the same bits whatever the batch around it and the thread it runs on.
/// Values and gradients are finite for every finite point in the domain.
pub trait Field: Send + Sync {
    /// The box that holds the zero level set.
    fn domain(&self) -> Domain;
    /// What the values mean.
    fn metric(&self) -> Metric;
    /// An upper bound of the gradient's length over the domain, where one is known; 1 for an exact distance.
    fn lipschitz(&self) -> Option<f32>;
    /// 3 for surfaces, 2 for curves (the third coordinate is then ignored).
    fn dimension(&self) -> u8 {
        3
    }
    /// Writes the value at every point. `values` is as long as the batch.
    fn values(&self, points: Points<'_>, values: &mut [f32]);
    /// Writes value and gradient at every point. All slices are as long as the batch.
    fn gradients(&self, points: Points<'_>, values: &mut [f32], gradients: Gradients<'_>);
    /// The triangle mesh whose distance this is, where it is one: the truth that a report measures against.
    fn truth(&self) -> Option<&mesh::TriangleMesh> {
        None
    }
}

/// One thing wrong with a document, at a place in it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Fault {
    /// JSON Pointer to the member, from the root of the scene or of the field's options.
    pub pointer: String,
    /// Stable short name of the fault, such as `unknown_member` or `not_finite`.
    pub code: &'static str,
    /// A sentence for a person.
    pub detail: String,
}

/// What a JSON value is, for a fault's detail.
pub(crate) fn type_name(value: &serde_json::Value) -> &'static str {
    match value {
        serde_json::Value::Null => "null",
        serde_json::Value::Bool(_) => "a boolean",
        serde_json::Value::Number(_) => "a number",
        serde_json::Value::String(_) => "a string",
        serde_json::Value::Array(_) => "a list",
        serde_json::Value::Object(_) => "an object",
    }
}

/// Why bytes could not be read as a field. Messages are lower case, without a full stop, and safe to show to a client.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum FieldError {
    /// A scene or an option is wrong; at least one fault.
    #[error("{}", faults.first().map_or("the document is invalid".to_owned(), |f| format!("{} at {:?}", f.detail, f.pointer)))]
    Invalid {
        /// What is wrong, in the order of the document.
        faults: Vec<Fault>,
    },
    /// The bytes are of no format that is known.
    #[error("the bytes are of no known format: {detail}")]
    Unrecognized {
        /// What was looked for, and what was found instead.
        detail: String,
    },
    /// The bytes claim a format and break it.
    #[error("{format}: {detail}{}", at.map_or(String::new(), |b| format!(" (at byte {b})")))]
    Malformed {
        /// Name of the format.
        format: &'static str,
        /// Offset of the byte at fault, when it is known.
        at: Option<u64>,
        /// What is wrong.
        detail: String,
    },
    /// A limit on size, depth or count was passed.
    #[error("{what}: {found} is over the limit of {limit}")]
    Limit {
        /// What is limited.
        what: &'static str,
        /// What was found.
        found: u64,
        /// What is allowed.
        limit: u64,
    },
    /// The format is understood, and asks for something that is not offered.
    #[error("unsupported: {detail}")]
    Unsupported {
        /// What is asked for, by its name in the file.
        detail: String,
    },
}
