//! From a gradient of a surface's vertices to one of its network: the part of the pipeline that differentiates.

use super::{Finished, pretty};
use crate::field::input::{self, FieldOptions};
use crate::job::failure::{Ended, Failure};
use crate::job::spec::OutputName;
use crate::settings::Settings;
use crate::surface::sensitivity::{Welded, sensitivity, to_safetensors};
use serde::{Deserialize, Serialize};
use serde_json::json;

/// What there is to say about derivatives.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct SensitivityReport {
    /// Vertices of the surface.
    pub vertices: u64,
    /// Length of the gradient of the vertices.
    pub gradient_norm: f64,
    /// Length of the gradient of the latent code; 0 for a network without.
    pub latent_norm: f64,
    /// Length of the gradient of all weights and biases.
    pub weights_norm: f64,
}

/// Derivatives, written.
pub struct Carried {
    /// The safetensors file.
    pub bytes: Vec<u8>,
    /// What there is to say about it.
    pub report: SensitivityReport,
}

/// Carries a gradient back as a job does: `blobs` are the network, the surface and the gradient.
pub fn run_sensitivity(
    options: &FieldOptions,
    blobs: &[impl AsRef<[u8]>],
    outputs: &[OutputName],
    settings: &Settings<'_>,
) -> Result<Finished, Ended> {
    let [field, surface, gradient] = blobs else { return Err(Failure::internal().into()) };
    let made = sensitivity_of(field.as_ref(), options, surface.as_ref(), gradient.as_ref(), settings)?;
    let files = outputs.iter().map(|&output| {
        let bytes = match output {
            OutputName::Sensitivity => made.bytes.clone(),
            _ => pretty(&made.report),
        };
        (output, bytes)
    });
    Ok(Finished { metrics: json!(made.report), certified: true, files: files.collect(), problem: None })
}

/// Carries the gradient in `gradient` from the vertices in `surface` to the network in `field`.
///
/// # Errors
/// As those of the field, `malformed_surface` and `malformed_gradient`; and when the token is raised.
pub fn sensitivity_of(
    field: &[u8],
    options: &FieldOptions,
    surface: &[u8],
    gradient: &[u8],
    settings: &Settings<'_>,
) -> Result<Carried, Ended> {
    let (placed, _) =
        input::open_network(field, options).map_err(|e| Ended::from(Failure::from_field(&e, "/field")))?;
    let malformed = |what: &str, detail: String| {
        Ended::from(Failure::new(&format!("malformed_{what}"), &format!("the {what} cannot be used"), detail))
    };
    let welded = Welded::read(surface).map_err(|detail| malformed("surface", detail))?;
    let by_vertex = welded.gradient(gradient).map_err(|detail| malformed("gradient", detail))?;
    let made = sensitivity(&placed, &welded.positions, &by_vertex, settings)?;
    let norm = |list: &mut dyn Iterator<Item = f64>| list.map(|v| v * v).sum::<f64>().sqrt();
    let report = SensitivityReport {
        vertices: welded.positions.len() as u64,
        gradient_norm: norm(&mut by_vertex.iter().flatten().copied()),
        latent_norm: norm(&mut made.latent.iter().map(|&v| v.into())),
        weights_norm: norm(&mut made.weights.iter().map(|&v| v.into())),
    };
    Ok(Carried { bytes: to_safetensors(&placed, &made), report })
}
