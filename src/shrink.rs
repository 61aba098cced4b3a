//! Sphere to surface: contracts a sphere onto the zero level set of a field and keeps every vertex's place on the sphere.
//!
//! [`shrink`] is the driver. `method: adaptive` is topology-keeping contraction, remeshing, a bijective sphere map and
//! resampling; `method: paper` is the literal loop of the paper, the baseline. Both end in a [`Wrap`]: one position per
//! vertex of a [`SphereLattice`].

mod adaptive;
mod base;
mod cells;
pub mod chart;
mod collide;
mod colours;
mod complex;
mod contract;
mod creases;
pub mod curve;
mod denser;
mod density;
mod energy;
mod graded;
pub mod lattice;
mod locate;
pub mod mend;
mod paper;
mod points;
mod reclaim;
mod remesh;
mod resample;
mod rings;
mod separate;
mod slide;
mod sphere_map;
pub mod study;
mod tips;
mod topology;
mod unfold;
mod untangle;
pub mod warm;
mod zero;

use crate::field::{Field, Sampler};
use crate::settings::Canceled;
use glam::DVec3;
use lattice::{LatticeSpec, SphereLattice};

/// How the sphere is contracted.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize, utoipa::ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum Method {
    /// Topology-keeping contraction and a bijective sphere map; no fold-overs.
    #[default]
    Adaptive,
    /// The paper's loop as printed, with the sign mended; folds over on most shapes.
    Paper,
}

/// What to make.
#[derive(Clone, Debug, Default, PartialEq, serde::Serialize, serde::Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields, default)]
pub struct ShrinkSpec {
    /// How the sphere is contracted.
    pub method: Method,
    /// Where the sphere is sampled.
    pub lattice: LatticeSpec,
    /// How the samples are spread over the surface.
    pub density: Density,
    /// What the sphere map keeps best.
    pub distortion: Distortion,
    /// Whether the UVs are relaxed further inside the chart, by what `distortion` keeps. The sphere's coordinates are then
    /// written beside them.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub relax_uv: bool,
    /// What to do with a shape that is no sphere.
    pub on_topology: OnTopology,
    /// Which component to wrap where there are several; without it several are refused.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(value_type = Option<SpelledComponent>)]
    pub component: Option<Component>,
    /// Samples of the curve that a 2-D field gives; without it, as many as the lattice has columns. A 3-D field has none.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub samples: Option<u32>,
}

impl ShrinkSpec {
    /// Samples of the curve that a 2-D field gives: those asked for, or as many as a row of the lattice has at its equator.
    pub fn curve_samples(&self) -> u32 {
        self.samples.unwrap_or(match self.lattice {
            LatticeSpec::Latlong { n_theta, .. } => n_theta,
            LatticeSpec::Octahedral { n } => 4 * n,
        })
    }
}

/// How the samples are spread over the surface.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize, utoipa::ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum Density {
    /// Evenly by area.
    Area,
    /// More where the surface is curved, and closer together across the curvature than along it.
    #[default]
    Curvature,
    /// More where the solid or the space beside it is thin.
    Reach,
    /// In proportion to the weight, a field of its own that is given beside this.
    Weight,
}

/// What the sphere map keeps best.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize, utoipa::ToSchema)]
#[serde(rename_all = "snake_case")]
// the report's figures of distortion have the plain name
#[schema(as = DistortionKept)]
pub enum Distortion {
    /// Areas, as far as the density allows.
    Area,
    /// Angles.
    Angle,
    /// Both: lengths.
    #[default]
    Isometric,
}

/// What to do with a shape that is no sphere.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize, utoipa::ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum OnTopology {
    /// Say how many components or handles there are and where.
    #[default]
    Refuse,
    /// Wrap it in a sphere all the same and say how much area had to be invented.
    Wrap,
}

/// One component of several; in JSON `"largest"` or its index.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(from = "SpelledComponent", into = "SpelledComponent")]
pub enum Component {
    /// The one of the largest volume.
    Largest,
    /// The one with this index, from 0, in the order of volume, largest first.
    Index(u32),
}

/// A [`Component`] as it is written.
#[derive(Clone, Copy, serde::Serialize, serde::Deserialize, utoipa::ToSchema)]
#[serde(untagged)]
#[schema(as = Component)]
enum SpelledComponent {
    /// By its rank.
    Name(ComponentName),
    /// By its index, from 0, in the order of volume, largest first.
    Index(u32),
}

/// A component by its rank.
#[derive(Clone, Copy, serde::Serialize, serde::Deserialize, utoipa::ToSchema)]
#[serde(rename_all = "snake_case")]
enum ComponentName {
    /// The one of the largest volume.
    Largest,
}

impl From<SpelledComponent> for Component {
    fn from(spelled: SpelledComponent) -> Self {
        match spelled {
            SpelledComponent::Name(ComponentName::Largest) => Component::Largest,
            SpelledComponent::Index(index) => Component::Index(index),
        }
    }
}

impl From<Component> for SpelledComponent {
    fn from(component: Component) -> Self {
        match component {
            Component::Largest => SpelledComponent::Name(ComponentName::Largest),
            Component::Index(index) => SpelledComponent::Index(index),
        }
    }
}

/// How hard to try, and what is known from the attempts before.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Effort {
    /// Number of the attempt, from 0, below [`Effort::ATTEMPTS`]; later ones work finer.
    pub attempt: u32,
    /// Places in scene units where the attempts before went wrong; this one looks closer there.
    pub places: Vec<DVec3>,
}

impl Effort {
    /// Attempts worth making.
    pub const ATTEMPTS: u32 = 3;
}

/// A sphere lattice laid onto the zero level set.
#[derive(Clone, Debug)]
pub struct Wrap {
    /// The lattice.
    pub lattice: SphereLattice,
    /// One position per lattice vertex, in scene units.
    pub positions: Vec<DVec3>,
    /// The field's value at every position, in scene units.
    pub values: Vec<f64>,
    /// The field's gradient at every position.
    pub gradients: Vec<DVec3>,
    /// For every quad of the lattice, whether its other diagonal is taken.
    pub diagonals: Vec<bool>,
}

/// Why a shape could not be wrapped.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum ShrinkError {
    /// The token was raised.
    #[error(transparent)]
    Canceled(#[from] Canceled),
    /// The field has no zero level set in its domain.
    #[error("the field has no zero level set in its domain: its values there run from {min:.4} to {max:.4}")]
    Empty {
        /// Smallest value that was seen.
        min: f64,
        /// Largest value that was seen.
        max: f64,
    },
    /// The zero level set has several components: solids apart from each other, or voids in them.
    #[error(
        "the zero level set has {} components ({}), and one can be wrapped: `component` chooses a solid{}",
        .solids + .voids,
        listed(&[(*.solids, "solid"), (*.voids, "void")]),
        if *.voids > 0 { " and fills its voids" } else { "" }
    )]
    Components {
        /// Solids that were found.
        solids: usize,
        /// Voids that were found.
        voids: usize,
        /// Scene positions, one inside each solid, largest first, then one inside each void; at most 16.
        places: Vec<[f64; 3]>,
    },
    /// The component that was asked for is not there.
    #[error("there is no component {index}: {count} were found, counted from 0")]
    NoComponent {
        /// The index that was asked for.
        index: u32,
        /// How many were found.
        count: usize,
        /// Scene positions, one inside each, largest first; at most 16.
        places: Vec<[f64; 3]>,
    },
    /// The zero level set has handles.
    #[error(
        "the zero level set has genus {genus} (so many handles), and only genus 0 can be wrapped: `on_topology: wrap` closes \
         handles"
    )]
    Genus {
        /// Number of handles.
        genus: usize,
        /// Scene positions on the handles that were found; at most 16.
        places: Vec<[f64; 3]>,
    },
    /// The zero level set of a field of dimension 2 has holes: the plane's kind of handles.
    #[error(
        "the solid in the plane has {}, and only one without holes is followed: `on_topology: wrap` goes around it",
        listed(&[(*.count, "hole")])
    )]
    Holes {
        /// Number of holes.
        count: usize,
        /// Scene positions, one inside each; at most 16.
        places: Vec<[f64; 3]>,
    },
    /// The density asks for a weight, and there is none on the surface.
    #[error("the weight is positive nowhere on the surface, so it says nothing about where samples should be")]
    NoWeight,
    /// The base surface could not be mapped to the sphere.
    #[error("the surface could not be mapped to the sphere without folding")]
    Unmapped,
    /// The field's dimension does not fit what is asked.
    #[error("the field is {found}-dimensional, and this needs one of dimension {wanted}")]
    Dimension {
        /// The field's dimension.
        found: u8,
        /// The dimension that is needed.
        wanted: u8,
    },
}

/// How many there are of what, leaving out what there is none of: "2 solids and 1 void".
fn listed(counts: &[(usize, &str)]) -> String {
    let there = counts.iter().filter(|(count, _)| *count > 0);
    let words = there.map(|(count, what)| format!("{count} {what}{}", if *count == 1 { "" } else { "s" }));
    words.collect::<Vec<_>>().join(" and ")
}

impl ShrinkError {
    /// Its stable name.
    pub fn code(&self) -> &'static str {
        match self {
            ShrinkError::Canceled(_) => "canceled",
            ShrinkError::Empty { .. } => "empty_zero_set",
            ShrinkError::Components { .. } => "components",
            ShrinkError::NoComponent { .. } => "no_such_component",
            ShrinkError::Genus { .. } | ShrinkError::Holes { .. } => "genus",
            ShrinkError::NoWeight => "no_weight",
            ShrinkError::Unmapped => "unmapped",
            ShrinkError::Dimension { .. } => "dimension",
        }
    }
    /// The scene positions that it names.
    pub fn places(&self) -> Vec<DVec3> {
        match self {
            ShrinkError::Components { places, .. }
            | ShrinkError::NoComponent { places, .. }
            | ShrinkError::Genus { places, .. }
            | ShrinkError::Holes { places, .. } => places.iter().map(|&p| DVec3::from(p)).collect(),
            _ => Vec::new(),
        }
    }
}

/// Contracts a sphere onto the zero level set of the sampler's field. `weight`, in scene units, is what
/// [`Density::Weight`] goes by.
///
/// # Errors
/// [`ShrinkError`] when the run was canceled, or when the zero level set is empty, in several pieces or has handles.
pub fn shrink(
    sampler: &Sampler<'_>,
    spec: &ShrinkSpec,
    weight: Option<&dyn Field>,
    effort: &Effort,
) -> Result<Wrap, ShrinkError> {
    if sampler.field().dimension() != 3 {
        return Err(ShrinkError::Dimension { found: sampler.field().dimension(), wanted: 3 });
    }
    match spec.method {
        Method::Adaptive => adaptive::run(sampler, spec, weight, effort),
        Method::Paper => paper::run(sampler, spec),
    }
}

/// Repairs a wrap that a certificate complained about: the triangles at `places` (scene units) are shown to the field,
/// and what is folded or crosses anywhere is moved apart, by other moves for every `seed`. Returns the folded triangles and the crossing pairs that are
/// left, as far as they are seen.
///
/// # Errors
/// When the token is raised.
pub fn mend(sampler: &Sampler<'_>, wrap: &mut Wrap, places: &[DVec3], seed: u32) -> Result<(usize, usize), Canceled> {
    sampler.tally().stage("mend");
    let left = separate::separate(sampler, wrap, &[], places, seed)?;
    Ok((left.folds, left.crossings))
}
