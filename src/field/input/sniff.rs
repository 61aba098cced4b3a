//! Which format the bytes are of, by their beginning.

use crate::field::FieldError;
use crate::field::grid::npy;
use crate::field::mesh::MeshFormat;
use crate::field::network::{niq, safetensors, zip};

/// A format that is read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Format {
    /// A scene as JSON.
    Scene,
    /// Neural weights as safetensors.
    Safetensors,
    /// Neural weights as the npz of neural-implicit-queries.
    Npz,
    /// A sampled grid as npy.
    Grid,
    /// A mesh.
    Mesh(MeshFormat),
}

/// How a PyTorch file of version 1.5 or earlier begins: a pickled magic number.
const PYTORCH_LEGACY: &[u8] = b"\x80\x02\x8a\x0al\xfc\x9cF\xf9 j\xa8P\x19";

impl Format {
    /// The format of the bytes.
    ///
    /// # Errors
    /// [`FieldError::Unsupported`] with the name of a format that is recognised and not read, and
    /// [`FieldError::Unrecognized`] for all else.
    pub fn detect(bytes: &[u8]) -> Result<Self, FieldError> {
        let not_yet = |what: &str| Err(FieldError::Unsupported { detail: format!("{what} (not read yet)") });
        if zip::claims(bytes) {
            let entries = zip::entries(bytes)?;
            if niq::claims(&entries) {
                return Ok(Self::Npz);
            }
            if entries.iter().any(|e| e.name == "data.pkl" || e.name.ends_with("/data.pkl")) {
                return not_yet("a PyTorch checkpoint");
            }
            let detail = "a zip archive that is neither a network of neural-implicit-queries nor a PyTorch checkpoint";
            return Err(FieldError::Unsupported { detail: detail.to_owned() });
        }
        if npy::claims(bytes) {
            return Ok(Self::Grid);
        }
        if safetensors::claims(bytes) {
            return Ok(Self::Safetensors);
        }
        if bytes.starts_with(PYTORCH_LEGACY) {
            return not_yet("a PyTorch checkpoint of version 1.5 or earlier");
        }
        let text = bytes.strip_prefix(b"\xef\xbb\xbf").unwrap_or(bytes);
        if text.iter().find(|b| !b.is_ascii_whitespace()) == Some(&b'{') {
            return Ok(Self::Scene);
        }
        if let Some(mesh) = MeshFormat::detect(bytes) {
            return Ok(Self::Mesh(mesh));
        }
        if onnx_claims(bytes) {
            return not_yet("an ONNX model");
        }
        if bytes.first() == Some(&0x80) && bytes.get(1).is_some_and(|v| (2..=5).contains(v)) {
            return not_yet("a Python pickle");
        }
        Err(FieldError::Unrecognized {
            detail: "looked for a scene (JSON), a network (safetensors, npz), a mesh (PLY, OBJ, STL, OFF, GLB) and a grid (npy)"
                .to_owned(),
        })
    }

    /// The short lower-case name in a description.
    pub fn name(self) -> &'static str {
        match self {
            Self::Scene => "json",
            Self::Safetensors => "safetensors",
            Self::Npz => "npz",
            Self::Grid => "npy",
            Self::Mesh(mesh) => mesh.name(),
        }
    }
}

/// Whether the bytes begin as the protocol buffer of an ONNX model: field 1, a small version, then a known field.
fn onnx_claims(bytes: &[u8]) -> bool {
    const FIELDS_OF_A_MODEL: [u8; 7] = [0x12, 0x1a, 0x22, 0x28, 0x32, 0x3a, 0x42];
    matches!(bytes, [0x08, 1..=32, tag, ..] if FIELDS_OF_A_MODEL.contains(tag))
}
