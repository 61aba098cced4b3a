//! Analytic scenes: shapes and operators on shapes, written as JSON, evaluated with exact gradients.
//!
//! Guaranteed: values and gradients are finite for coordinates up to 10^6; a gradient is the derivative wherever there is
//! one, and one of the one-sided derivatives elsewhere; it has unit length where the value is an exact distance; the
//! [`Metric`] and the Lipschitz bound hold (the rules are in `scene/trust.rs` and `docs/scenes.md`). The same point gives the
//! same bits whatever the batch around it.
//!
//! Not guaranteed: that the zero set is connected, has no handles, or lies inside the domain; that a difference of solids
//! leaves anything.
//!
//! ```
//! use shrinkd::field::{Field, Metric, Points, scene::Scene};
//! let scene = Scene::from_slice(br#"{"translate": {"by": [0, 0, 0.25], "of": {"sphere": {"radius": 0.5}}}}"#)?;
//! let mut value = [0.0];
//! scene.values(Points { x: &[0.0], y: &[0.0], z: &[1.0] }, &mut value);
//! assert_eq!(value, [0.25]);
//! assert_eq!(scene.metric(), Metric::Exact);
//! # Ok::<(), shrinkd::field::FieldError>(())
//! ```

mod evaluate;
mod kinds;
mod node;
mod parse;
mod polygon;
mod shape;
#[cfg(test)]
mod tests;
#[cfg(test)]
mod topology;
mod trust;

pub use kinds::{KINDS, Kind};

use super::{Domain, Field, FieldError, Gradients, Metric, Points};
use evaluate::{CHUNK, Out, blocks, evaluate};
use node::Node;
use parse::{Dimension, MAX_BYTES, MAX_NESTING};
use serde_json::Value;
use std::cell::RefCell;

/// Room that a fitted domain leaves around the solid, in parts of its longest side.
const FIT_MARGIN: f64 = 0.05;

/// A scene, ready to be evaluated.
#[derive(Clone, Debug)]
pub struct Scene {
    root: Node,
    dimension: Dimension,
    domain: Domain,
    metric: Metric,
    lipschitz: Option<f32>,
    /// Blocks of scratch that an evaluation needs: the tree's, a gradient that is not asked for, and a third coordinate.
    blocks: usize,
}

impl Scene {
    /// Reads a scene from JSON. Its domain is the default cube.
    ///
    /// # Errors
    /// [`FieldError::Limit`] for too many bytes or too deep a nesting, [`FieldError::Malformed`] for broken JSON (with the byte), and
    /// [`FieldError::Invalid`] with the faults of the scene, up to 64 of them.
    pub fn from_slice(bytes: &[u8]) -> Result<Self, FieldError> {
        if bytes.len() as u64 > MAX_BYTES {
            return Err(FieldError::Limit { what: "bytes of a scene", found: bytes.len() as u64, limit: MAX_BYTES });
        }
        let nesting = nesting(bytes);
        if nesting > MAX_NESTING {
            return Err(FieldError::Limit { what: "nesting of a scene", found: nesting, limit: MAX_NESTING });
        }
        let value = serde_json::from_slice(bytes).map_err(|e| FieldError::Malformed {
            format: "scene JSON",
            at: offset(bytes, e.line(), e.column()),
            detail: e.to_string(),
        })?;
        Self::from_value(&value)
    }

    /// Reads a scene from JSON that has been parsed already. Its domain is the default cube.
    ///
    /// # Errors
    /// [`FieldError::Invalid`] with the faults of the scene, up to 64 of them; pointers start at `value`.
    pub fn from_value(value: &Value) -> Result<Self, FieldError> {
        let (root, dimension) = parse::parse(value)?;
        let trust = trust::trust(&root);
        let blocks = root.scratch() + 4;
        let lipschitz = trust.lipschitz.map(|l| l as f32);
        Ok(Self { root, dimension, domain: Domain::default(), metric: trust.metric(), lipschitz, blocks })
    }

    /// The same scene in another domain, in scene units.
    #[must_use]
    pub fn with_domain(self, domain: Domain) -> Self {
        Self { domain, ..self }
    }

    /// A box that holds the solid, with a margin of 5 % of its longest side; found from the tree, so it may be larger than
    /// needed (a difference or an intersection is no larger than its parts). The third side of a 2-D scene is as long as the
    /// longest. None where the tree says no bound, as for a half-space, or where it says that there is no solid.
    pub fn fit_domain(&self) -> Option<Domain> {
        let mut extent = trust::extent(&self.root, 0.0);
        if self.dimension == Dimension::Two {
            (extent.min[2], extent.max[2]) = (0.0, 0.0);
        }
        if extent.is_empty() || !extent.is_bounded() {
            return None;
        }
        let longest = (0..3).map(|k| extent.max[k] - extent.min[k]).fold(0.0, f64::max);
        let mut fitted = extent.grown(FIT_MARGIN * longest);
        if self.dimension == Dimension::Two {
            let half = (0.5 + FIT_MARGIN) * longest;
            (fitted.min[2], fitted.max[2]) = (-half, half);
        }
        (longest > 0.0).then_some(Domain { min: fitted.min, max: fitted.max })
    }

    fn run<const G: bool>(&self, points: Points<'_>, values: &mut [f32], gradients: Option<Gradients<'_>>) {
        thread_local! {
            /// Temporaries, kept from batch to batch; written before they are read, so they carry nothing over.
            static SCRATCH: RefCell<Vec<f32>> = const { RefCell::new(Vec::new()) };
        }
        SCRATCH.with_borrow_mut(|scratch| {
            let needed = self.blocks * CHUNK;
            if scratch.len() < needed {
                scratch.resize(needed, 0.0);
            }
            let mut gradients = gradients;
            for start in (0..values.len()).step_by(CHUNK) {
                let range = start..values.len().min(start + CHUNK);
                let n = range.len();
                let ([flat, gx, gy, gz], rest) = blocks::<4>(scratch, n);
                let z = if self.dimension == Dimension::Two {
                    flat.fill(0.0);
                    &*flat
                } else {
                    &points.z[range.clone()]
                };
                let place = [&points.x[range.clone()], &points.y[range.clone()], z];
                let gradient = match &mut gradients {
                    Some(g) => [&mut g.x[range.clone()], &mut g.y[range.clone()], &mut g.z[range.clone()]],
                    None => [gx, gy, gz],
                };
                let mut out = Out { value: &mut values[range], gradient };
                evaluate::<G>(&self.root, place, &mut out, rest);
            }
        });
    }
}

impl Field for Scene {
    fn domain(&self) -> Domain {
        self.domain
    }

    fn metric(&self) -> Metric {
        self.metric
    }

    fn lipschitz(&self) -> Option<f32> {
        self.lipschitz
    }

    fn dimension(&self) -> u8 {
        match self.dimension {
            Dimension::Two => 2,
            Dimension::Three => 3,
        }
    }

    fn values(&self, points: Points<'_>, values: &mut [f32]) {
        self.run::<false>(points, values, None);
    }

    fn gradients(&self, points: Points<'_>, values: &mut [f32], gradients: Gradients<'_>) {
        self.run::<true>(points, values, Some(gradients));
    }
}

/// How deep arrays and objects are nested; found before parsing, which is recursive.
fn nesting(bytes: &[u8]) -> u64 {
    let (mut depth, mut deepest, mut quoted, mut escaped) = (0u64, 0u64, false, false);
    for &byte in bytes {
        if quoted {
            (quoted, escaped) = (escaped || byte != b'"', !escaped && byte == b'\\');
            continue;
        }
        match byte {
            b'"' => quoted = true,
            b'[' | b'{' => {
                depth += 1;
                deepest = deepest.max(depth);
            }
            b']' | b'}' => depth = depth.saturating_sub(1),
            _ => {}
        }
    }
    deepest
}

/// The byte at a line and column as serde_json counts them, both from 1.
fn offset(bytes: &[u8], line: usize, column: usize) -> Option<u64> {
    let start = match line {
        0 => return None,
        1 => 0,
        line => bytes.iter().enumerate().filter(|(_, b)| **b == b'\n').nth(line - 2)?.0 + 1,
    };
    Some((start + column.saturating_sub(1)) as u64)
}
