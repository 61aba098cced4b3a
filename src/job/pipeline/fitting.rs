//! From meshes to a network: the part of the pipeline that trains.

use super::{Finished, pretty};
use crate::blobs::BlobId;
use crate::field::mesh::MeshField;
use crate::field::network::safetensors;
use crate::fit::{Checkpoint, FitError, Training, fit};
use crate::job::failure::{Ended, Failure};
use crate::job::spec::{Fitting, OutputName};
use crate::settings::Settings;
use serde_json::json;

/// Makes the bytes of a training's state.
pub type StateBytes<'a> = dyn Fn() -> Vec<u8> + 'a;

/// What a training keeps while it runs.
pub struct Kept<'a> {
    /// The bytes of the last state, from this run of the job or another.
    pub before: Option<&'a [u8]>,
    /// Called after every epoch with what makes the state, should it be time to keep one.
    pub keep: &'a dyn Fn(&StateBytes<'_>),
}

/// Fits a network to meshes, whose files are `meshes` in the order of the request.
pub fn run_fit(
    fitting: &Fitting,
    meshes: &[impl AsRef<[u8]>],
    outputs: &[OutputName],
    kept: &Kept<'_>,
    settings: &Settings<'_>,
) -> Result<Finished, Ended> {
    let fields = meshes.iter().enumerate().map(|(i, bytes)| {
        settings.cancel.check()?;
        open_mesh(bytes.as_ref(), &format!("/meshes/{i}")).map_err(Ended::Failed)
    });
    let fields: Vec<MeshField> = fields.collect::<Result<_, _>>()?;
    let names: Vec<String> = fitting.meshes.iter().map(BlobId::hex).collect();
    let (spec, fingerprint) = (&fitting.fit, names.join(" "));
    let from = kept.before.and_then(|bytes| Checkpoint::from_bytes(bytes, spec, fields.len(), &fingerprint));
    let checkpoint = |state: &Checkpoint| (kept.keep)(&|| state.to_bytes(spec, &fingerprint));
    let made =
        fit(&fields, Training { spec, from, checkpoint: &checkpoint }, settings).map_err(|error| match error {
            FitError::Canceled => Ended::Canceled,
            FitError::Diverged { .. } => {
                Ended::Failed(Box::new(Failure::new("diverged", "training diverged", error.to_string())))
            }
        })?;
    let files = outputs.iter().map(|&output| {
        let bytes = match output {
            OutputName::Network => safetensors::write(&made.network),
            _ => pretty(&made.report),
        };
        (output, bytes)
    });
    let certified = made.report.shapes.iter().all(|shape| shape.closeness.is_some());
    Ok(Finished { metrics: json!(made.report), certified, files: files.collect(), problem: None })
}

/// Opens a mesh that a network is fitted to; faults are pointed to below `at`.
pub fn open_mesh(bytes: &[u8], at: &str) -> Result<MeshField, Box<Failure>> {
    crate::field::input::open_mesh(bytes).map_err(|e| Box::new(Failure::from_field(&e, at)))
}
