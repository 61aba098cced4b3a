//! Which format the bytes are of, by their beginning.

use crate::field::FieldError;
use crate::field::grid::npy;
use crate::field::mesh::MeshFormat;
use crate::field::network::{folder, niq, onnx, safetensors, torch, zip};

/// A format that is read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Format {
    /// A scene as JSON.
    Scene,
    /// Neural weights as safetensors.
    Safetensors,
    /// Neural weights as the npz of neural-implicit-queries.
    Npz,
    /// Neural weights as a PyTorch checkpoint.
    Torch,
    /// Neural weights as a DeepSDF folder in a zip archive.
    Folder,
    /// Neural weights as an ONNX model.
    Onnx,
    /// A sampled grid as npy.
    Grid,
    /// A mesh.
    Mesh(MeshFormat),
}

impl Format {
    /// Whether files of this format hold networks.
    pub fn is_network(self) -> bool {
        matches!(self, Self::Safetensors | Self::Npz | Self::Torch | Self::Folder | Self::Onnx)
    }

    /// The format of the bytes.
    ///
    /// # Errors
    /// [`FieldError::Unsupported`] with the name of a format that is recognised and not read, and
    /// [`FieldError::Unrecognized`] for all else.
    pub fn detect(bytes: &[u8]) -> Result<Self, FieldError> {
        if zip::claims(bytes) {
            let entries = zip::entries(bytes)?;
            if niq::claims(&entries) {
                return Ok(Self::Npz);
            }
            if torch::claims_zip(&entries) {
                return Ok(Self::Torch);
            }
            if folder::claims(&entries) {
                return Ok(Self::Folder);
            }
            let detail = "a zip archive that is neither a network of neural-implicit-queries, nor a PyTorch checkpoint, nor a \
                          folder with a specs.json";
            return Err(FieldError::Unsupported { detail: detail.to_owned() });
        }
        if npy::claims(bytes) {
            return Ok(Self::Grid);
        }
        if safetensors::claims(bytes) {
            return Ok(Self::Safetensors);
        }
        if torch::claims_legacy(bytes) {
            return Ok(Self::Torch);
        }
        let text = bytes.strip_prefix(b"\xef\xbb\xbf").unwrap_or(bytes);
        if text.iter().find(|b| !b.is_ascii_whitespace()) == Some(&b'{') {
            return Ok(Self::Scene);
        }
        if let Some(mesh) = MeshFormat::detect(bytes) {
            return Ok(Self::Mesh(mesh));
        }
        if onnx::claims(bytes) {
            return Ok(Self::Onnx);
        }
        if bytes.first() == Some(&0x80) && bytes.get(1).is_some_and(|v| (2..=5).contains(v)) {
            let detail = "a Python pickle that no PyTorch wrote; nothing of it was run".to_owned();
            return Err(FieldError::Unsupported { detail });
        }
        Err(FieldError::Unrecognized {
            detail: "looked for a scene (JSON), a network (safetensors, PyTorch, ONNX, npz), a mesh (PLY, OBJ, STL, OFF, GLB) and a grid (npy)"
                .to_owned(),
        })
    }

    /// The short lower-case name in a description.
    pub fn name(self) -> &'static str {
        match self {
            Self::Scene => "json",
            Self::Safetensors => "safetensors",
            Self::Npz => "npz",
            Self::Torch => "torch",
            Self::Folder => "deep_sdf_folder",
            Self::Onnx => "onnx",
            Self::Grid => "npy",
            Self::Mesh(mesh) => mesh.name(),
        }
    }
}
