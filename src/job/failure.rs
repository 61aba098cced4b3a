//! Why a job failed, as clients read it: an embedded problem object with a stable code.

use crate::field::{Fault, FieldError};
use crate::measure::Verdict;
use crate::shrink::ShrinkError;
use serde::{Deserialize, Serialize};
use std::time::Duration;

/// Prefix of every problem type: `urn:shrinkd:problem:` and the code.
pub const TYPE_PREFIX: &str = "urn:shrinkd:problem:";

/// Places that a problem names, at most.
const PLACES: usize = 32;

/// One thing wrong in a request, at a place in it.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct FaultView {
    /// JSON Pointer into the request.
    pub pointer: String,
    /// Stable short name of the fault.
    pub code: String,
    /// A sentence for a person.
    pub detail: String,
}

impl FaultView {
    /// The fault, with its pointer moved below `prefix`.
    pub fn below(prefix: &str, fault: &Fault) -> Self {
        Self {
            pointer: format!("{prefix}{}", fault.pointer),
            code: fault.code.to_owned(),
            detail: fault.detail.clone(),
        }
    }
}

/// Why a job failed: a problem object without the HTTP parts. Everything in it may be shown to the client.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct Failure {
    /// Stable name of the problem type, a URN.
    #[serde(rename = "type")]
    pub kind: String,
    /// The last part of the type.
    pub code: String,
    /// What kind of problem it is, the same for every occurrence.
    pub title: String,
    /// What is wrong this time.
    pub detail: String,
    /// Faults by place, where the request or the input was at fault.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub errors: Vec<FaultView>,
    /// Scene positions that belong to the problem, such as one in each component.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub places: Vec<[f64; 3]>,
}

impl Failure {
    /// A failure with a code and a title.
    pub fn new(code: &str, title: &str, detail: impl Into<String>) -> Self {
        Self {
            kind: format!("{TYPE_PREFIX}{code}"),
            code: code.to_owned(),
            title: title.to_owned(),
            detail: detail.into(),
            errors: Vec::new(),
            places: Vec::new(),
        }
    }

    /// Something went wrong inside; the cause goes to the log and not to the client.
    pub fn internal() -> Self {
        Self::new("internal", "internal error", "the service failed; the log has the cause under the job's id")
    }

    /// The job was taken up too often without coming to an end.
    pub fn attempts_exhausted(attempts: u32) -> Self {
        let detail = format!("{attempts} workers took this job up and none brought it to an end");
        Self::new("attempts_exhausted", "every attempt was lost", detail)
    }

    /// The attempt ran for as long as it may.
    pub fn deadline_exceeded(allowed: Duration) -> Self {
        let detail = format!("the job did not come to its end within {} s", allowed.as_secs());
        Self::new("deadline_exceeded", "the job ran for too long", detail)
    }

    /// The job needs more memory than there is.
    pub fn memory_exceeded(needed: u64, limit: u64) -> Self {
        let mib = |bytes: u64| bytes.div_ceil(1 << 20);
        let detail = format!(
            "the job is estimated to need {} MiB of memory, and {} MiB may be used: ask for fewer vertices, or a smaller input",
            mib(needed),
            mib(limit)
        );
        Self::new("memory_exceeded", "the job needs too much memory", detail)
    }

    /// Whether the input is at fault (and not the shape it describes).
    pub fn is_bad_input(&self) -> bool {
        matches!(
            self.code.as_str(),
            "invalid_scene"
                | "unrecognized_input"
                | "malformed_input"
                | "over_limit"
                | "unsupported_input"
                | "unknown_input"
                | "no_weight"
                | "warm_start"
        )
    }

    /// A field that could not be opened; pointers are moved below `prefix`.
    pub fn from_field(error: &FieldError, prefix: &str) -> Self {
        let detail = error.to_string();
        match error {
            FieldError::Invalid { faults } => Self {
                errors: faults.iter().map(|f| FaultView::below(prefix, f)).collect(),
                ..Self::new("invalid_scene", "the field's description is invalid", detail)
            },
            FieldError::Unrecognized { .. } => {
                Self::new("unrecognized_input", "the input's format is not known", detail)
            }
            FieldError::Malformed { .. } => Self::new("malformed_input", "the input breaks its format", detail),
            FieldError::Limit { .. } => Self::new("over_limit", "the input is over a limit", detail),
            FieldError::Unsupported { .. } => {
                Self::new("unsupported_input", "the input asks for something that is not offered", detail)
            }
        }
    }
}

/// How a shrink can end badly: stopped, or failed.
#[derive(Clone, Debug, PartialEq)]
pub enum Ended {
    /// The cancel token was raised.
    Canceled,
    /// It failed.
    Failed(Box<Failure>),
}

impl From<crate::settings::Canceled> for Ended {
    fn from(_: crate::settings::Canceled) -> Self {
        Ended::Canceled
    }
}

impl From<Failure> for Ended {
    fn from(failure: Failure) -> Self {
        Ended::Failed(Box::new(failure))
    }
}

impl From<Box<Failure>> for Ended {
    fn from(failure: Box<Failure>) -> Self {
        Ended::Failed(failure)
    }
}

impl Failure {
    /// A shape that gave no surface, or turned out to be none that a sphere can wrap. Not for [`ShrinkError::Canceled`],
    /// which is no failure.
    pub fn from_shrink(error: &ShrinkError) -> Self {
        let title = match error {
            ShrinkError::Canceled(_) => "the job was canceled",
            ShrinkError::Empty { .. } => "the field has no zero level set in its domain",
            ShrinkError::Components { .. } => "the zero level set has several components",
            ShrinkError::NoComponent { .. } => "there is no such component",
            ShrinkError::Genus { .. } => "the zero level set has handles",
            ShrinkError::Holes { .. } => "the solid in the plane has holes",
            ShrinkError::NoWeight => "the weight is positive nowhere on the surface",
            ShrinkError::Unmapped => "the surface could not be mapped to the sphere",
            ShrinkError::Dimension { .. } => "the field has the wrong dimension for this",
        };
        let places = error.places().into_iter().map(|p| p.to_array()).collect();
        Self { places, ..Self::new(error.code(), title, error.to_string()) }
    }

    /// A surface that did not pass its certificate; what is wrong with it is in the verdict.
    pub fn not_certified(verdict: &Verdict) -> Self {
        let places = verdict.places().into_iter().take(PLACES).map(|p| p.to_array()).collect();
        Self { places, ..Self::new("not_certified", "no attempt gave a surface that passes", verdict.summary()) }
    }
}

impl From<ShrinkError> for Ended {
    fn from(error: ShrinkError) -> Self {
        match error {
            ShrinkError::Canceled(_) => Ended::Canceled,
            error => Ended::from(Failure::from_shrink(&error)),
        }
    }
}
