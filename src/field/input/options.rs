//! What may be asked of a field beside its bytes, and whether that makes sense.

use crate::field::mesh::TriangleMesh;
use crate::field::network::family::Family;
use crate::field::network::{Activation, Encoding, Network, Skip};
use crate::field::{Domain, Fault, FieldError};
use glam::{DMat3, DVec3};

/// Coordinates and factors beyond this are refused: in `f32` little of the shape would be left.
const MAX_SIZE: f64 = 1e6;
/// Factors below this are refused for the same reason.
const MIN_SCALE: f64 = 1e-6;

/// What to do with a field. Members that make no sense for the kind of field are refused.
#[derive(Clone, Debug, Default, PartialEq, serde::Serialize, serde::Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields, default)]
pub struct FieldOptions {
    /// The latent code of a network that takes one.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub latent: Option<Vec<f32>>,
    /// The row of the latent code among those that come with the network, from 0.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub latent_row: Option<u32>,
    /// A similarity that is applied to the shape.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub transform: Option<Transform>,
    /// `"fit"` (scenes and meshes), or a box in scene units after the transform. For a grid: the box that its samples
    /// span, before the transform.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub domain: Option<DomainOption>,
    /// The value of the field that is taken as its zero, in scene units after the transform.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub level: Option<f32>,
    /// The activation of a network's hidden layers, in place of the file's.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub activation: Option<Activation>,
    /// The family of a network's file, in place of the one that is detected.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub family: Option<Family>,
    /// The frequency of a network's sines, which no file of a SIREN says: one for all, or that of the first layer and that
    /// of the others.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub w0: Option<Frequency>,
    /// How the input is joined to the layers that take it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub skip: Option<Skip>,
    /// How a point becomes the network's input.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub encoding: Option<Encoding>,
    /// On which side a network's or a grid's values are positive; outside by default.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub sign: Option<Sign>,
    /// What a network's or a grid's values are multiplied by to be lengths in its own units, before the transform.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub scale: Option<f32>,
}

/// Where values are positive.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize, utoipa::ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum Sign {
    /// Outside the solid, as signed distances are here.
    PositiveOutside,
    /// Inside, as occupancies are.
    PositiveInside,
}

/// Frequencies of a network's sines.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, serde::Deserialize, utoipa::ToSchema)]
#[serde(untagged)]
pub enum Frequency {
    /// Of all layers.
    All(f32),
    /// Of the first layer, and of the others.
    FirstAndOthers([f32; 2]),
}

impl Frequency {
    /// That of the first layer.
    pub fn first(self) -> f32 {
        match self {
            Self::All(w0) | Self::FirstAndOthers([w0, _]) => w0,
        }
    }
    /// That of the other layers.
    pub fn others(self) -> f32 {
        match self {
            Self::All(w0) | Self::FirstAndOthers([_, w0]) => w0,
        }
    }
}

/// A similarity: first the scale, then the rotation, then the translation.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, serde::Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Transform {
    /// Factor on all lengths, about the origin; positive.
    pub scale: f64,
    /// Rotation about an axis through the origin.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub rotate: Option<Rotation>,
    /// Shift in scene units.
    pub translate: [f64; 3],
}

impl Default for Transform {
    fn default() -> Self {
        Self { scale: 1.0, rotate: None, translate: [0.0; 3] }
    }
}

/// A rotation, counter-clockwise as seen from the tip of its axis.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, serde::Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub struct Rotation {
    /// The axis, of any length but 0.
    pub axis: [f64; 3],
    /// The angle in degrees.
    pub angle: f64,
}

/// A domain that is asked for.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, serde::Deserialize, utoipa::ToSchema)]
#[serde(untagged)]
pub enum DomainOption {
    /// One that is found.
    Named(DomainName),
    /// One that is given.
    Box(Domain),
}

/// Domains that are found.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize, utoipa::ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum DomainName {
    /// A box about the shape, with a margin.
    Fit,
}

pub(super) fn fault(pointer: &str, code: &'static str, detail: impl Into<String>) -> Fault {
    Fault { pointer: pointer.to_owned(), code, detail: detail.into() }
}

/// An error with these faults, if there are any.
pub(super) fn refuse(faults: Vec<Fault>) -> Result<(), FieldError> {
    if faults.is_empty() { Ok(()) } else { Err(FieldError::Invalid { faults }) }
}

impl FieldOptions {
    /// Checks what can be told without the field.
    ///
    /// # Errors
    /// [`FieldError::Invalid`] with every fault; pointers from the root of the options.
    pub fn check(&self) -> Result<(), FieldError> {
        refuse(self.faults())
    }

    /// What is wrong whatever the field.
    pub(super) fn faults(&self) -> Vec<Fault> {
        let mut faults = Vec::new();
        if let Some(i) = self.latent.iter().flatten().position(|v| !v.is_finite()) {
            faults.push(fault(&format!("/latent/{i}"), "not_finite", "an entry of the latent code is not finite"));
        }
        if self.latent.is_some() && self.latent_row.is_some() {
            faults.push(fault("/latent_row", "conflict", "latent and latent_row exclude each other"));
        }
        if let Some(transform) = &self.transform {
            if !(MIN_SCALE..=MAX_SIZE).contains(&transform.scale) {
                faults.push(fault("/transform/scale", "out_of_range", "the scale is not from 1e-6 to 1e6"));
            }
            if let Some(rotation) = &transform.rotate {
                let length = DVec3::from(rotation.axis).length();
                if !(length > 0.0 && length <= MAX_SIZE) {
                    faults.push(fault("/transform/rotate/axis", "out_of_range", "the axis has no usable length"));
                }
                if !rotation.angle.is_finite() {
                    faults.push(fault("/transform/rotate/angle", "not_finite", "the angle is not finite"));
                }
            }
            if let Some(i) = transform.translate.iter().position(|t| t.is_nan() || t.abs() > MAX_SIZE) {
                let detail = "a shift is beyond a million units";
                faults.push(fault(&format!("/transform/translate/{i}"), "out_of_range", detail));
            }
        }
        if let Some(DomainOption::Box(domain)) = &self.domain {
            for axis in 0..3 {
                let (low, high) = (domain.min[axis], domain.max[axis]);
                for (member, value) in [("min", low), ("max", high)] {
                    if value.is_nan() || value.abs() > MAX_SIZE {
                        let detail = "a corner is beyond a million units";
                        faults.push(fault(&format!("/domain/{member}/{axis}"), "out_of_range", detail));
                    }
                }
                if low >= high {
                    faults.push(fault(
                        &format!("/domain/max/{axis}"),
                        "empty",
                        "the domain has no extent on this axis",
                    ));
                }
            }
        }
        if self.level.is_some_and(|l| !l.is_finite() || f64::from(l.abs()) > MAX_SIZE) {
            faults.push(fault("/level", "out_of_range", "the level is beyond a million units"));
        }
        if self.activation.is_some_and(|a| !a.is_valid()) {
            faults.push(fault("/activation", "out_of_range", "the activation's parameter is out of range"));
        }
        let is_frequency = |w0: f32| Activation::Sine { w0 }.is_valid();
        if self.w0.is_some_and(|w0| !is_frequency(w0.first()) || !is_frequency(w0.others())) {
            faults.push(fault("/w0", "out_of_range", "a frequency is not from 0 to 10,000"));
        }
        if self.skip.is_some_and(|skip| !(skip.scale.abs() > 0.0 && skip.scale.is_finite())) {
            faults.push(fault("/skip/scale", "out_of_range", "the factor is not a finite number other than 0"));
        }
        if self.scale.is_some_and(|s| !(MIN_SCALE..=MAX_SIZE).contains(&f64::from(s))) {
            faults.push(fault("/scale", "out_of_range", "the scale is not from 1e-6 to 1e6"));
        }
        faults
    }

    /// Faults for members that only fields with values of their own have.
    pub(super) fn refuse_value_members(&self, kind: &str) -> Vec<Fault> {
        let members = [("/sign", self.sign.is_some()), ("/scale", self.scale.is_some())];
        not_offered(&members, kind)
    }

    /// Faults for members that only a network has.
    pub(super) fn refuse_network_members(&self, kind: &str) -> Vec<Fault> {
        let members = [
            ("/latent", self.latent.is_some()),
            ("/latent_row", self.latent_row.is_some()),
            ("/activation", self.activation.is_some()),
            ("/family", self.family.is_some()),
            ("/w0", self.w0.is_some()),
            ("/skip", self.skip.is_some()),
            ("/encoding", self.encoding.is_some()),
        ];
        not_offered(&members, kind)
    }

    /// The latent code for a network. A network that comes with one code takes it unasked.
    pub(super) fn latent_of(&self, network: &Network, faults: &mut Vec<Fault>) -> Vec<f32> {
        let (size, rows) = (network.latent_size, network.latent_rows());
        if let Some(latent) = &self.latent {
            if latent.len() != size {
                let detail = format!("the latent code has {} entries and the network takes {size}", latent.len());
                faults.push(fault("/latent", "wrong_length", detail));
            }
            return latent.clone();
        }
        let row = match self.latent_row {
            Some(row) => row as usize,
            None if size == 0 || rows == 1 => 0,
            None => {
                let row = if rows > 0 { format!(", or a row below {rows}") } else { String::new() };
                let detail = format!("the network takes a latent code of {size} entries{row}");
                faults.push(fault("/latent", "missing", detail));
                return Vec::new();
            }
        };
        if size == 0 && self.latent_row.is_none() {
            return Vec::new();
        }
        network.latent_code(row).map(<[f32]>::to_vec).unwrap_or_else(|| {
            faults.push(fault("/latent_row", "out_of_range", format!("the network comes with {rows} latent codes")));
            Vec::new()
        })
    }
}

fn not_offered(members: &[(&str, bool)], kind: &str) -> Vec<Fault> {
    let given = members.iter().filter(|member| member.1);
    given.map(|(pointer, _)| fault(pointer, "not_offered", format!("{kind} has no {}", &pointer[1..]))).collect()
}

impl Transform {
    /// The rotation as a matrix.
    pub(super) fn rotation(&self) -> DMat3 {
        self.rotate.map_or(DMat3::IDENTITY, |r| {
            DMat3::from_axis_angle(DVec3::from(r.axis).normalize_or(DVec3::Z), r.angle.to_radians())
        })
    }

    /// Whether it takes the plane of the first two axes to itself.
    pub(super) fn stays_in_plane(&self) -> bool {
        self.translate[2] == 0.0 && self.rotate.is_none_or(|r| r.axis[0] == 0.0 && r.axis[1] == 0.0)
    }

    /// Moves a mesh's vertices.
    pub(super) fn apply_to(&self, mesh: &mut TriangleMesh) {
        let (rotation, shift) = (self.rotation(), DVec3::from(self.translate));
        for vertex in &mut mesh.vertices {
            *vertex = (rotation * (self.scale * DVec3::from(*vertex)) + shift).to_array();
        }
    }
}
