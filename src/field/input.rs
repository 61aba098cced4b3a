//! From bytes to a [`Field`]: the kind is told by the content, the options are applied or refused, one by one.
//!
//! [`describe`] reads a file as [`open`] does and says what it holds, so a bad file is refused when it arrives and not
//! when a job begins.

mod network;
mod options;
mod sniff;
mod wrap;

pub use options::{DomainName, DomainOption, FieldOptions, Frequency, Rotation, Sign, Transform};
pub use sniff::Format;

use super::grid::Grid;
use super::mesh::{MeshField, Soundness, TriangleMesh};
use super::network::family::Detected;
use super::network::{Activation, Network, NetworkField};
use super::scene::Scene;
use super::{Domain, Field, FieldError, Metric};
use glam::DVec3;
use options::refuse;
use wrap::{Boxed, Leveled, Scaled, Transformed};

/// What a file holds.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize, utoipa::ToSchema)]
#[serde(tag = "kind", rename_all = "snake_case")]
pub enum Description {
    /// An analytic scene.
    Scene {
        /// `json`.
        format: String,
        /// 3 for surfaces, 2 for curves.
        dimension: u8,
        /// What the values mean.
        metric: Metric,
        /// The box that holds the zero level set.
        domain: Domain,
    },
    /// A neural field.
    Network {
        /// `safetensors`, `torch`, `deep_sdf_folder` (a zip archive of one), `onnx` or `npz`.
        format: String,
        /// What it was taken for.
        #[serde(flatten)]
        detected: Detected,
        /// Outputs of every layer, in order.
        layers: Vec<u32>,
        /// Activation of the hidden layers, by name; `mixed` when they differ.
        activation: String,
        /// Entries of a latent code; 0 for a network of one shape.
        latent_size: u32,
        /// Latent codes that come with the network.
        latent_rows: u32,
        /// Weights and biases.
        parameters: u64,
        /// What the values mean.
        metric: Metric,
        /// The box that holds the zero level set.
        domain: Domain,
    },
    /// A triangle mesh, taken as the exact distance to it.
    Mesh {
        /// `ply`, `obj`, `stl`, `off` or `glb`.
        format: String,
        /// Vertices, those at one place counted once.
        vertices: u64,
        /// Triangles.
        triangles: u64,
        /// Smallest and largest coordinates.
        bounds: Domain,
        /// Fitness to bound a solid.
        #[serde(flatten)]
        soundness: Soundness,
    },
    /// A sampled field.
    Grid {
        /// `npy`.
        format: String,
        /// Samples along each axis.
        shape: [u32; 3],
        /// The steepest slope between neighbouring samples, were the grid to span the cube of half extent 1.
        lipschitz: f32,
    },
}

/// A field, and what its file was taken for.
pub struct Opened {
    /// The field.
    pub field: Box<dyn Field>,
    /// What a network's file was taken for.
    pub detected: Option<Detected>,
}

impl From<Box<dyn Field>> for Opened {
    fn from(field: Box<dyn Field>) -> Self {
        Self { field, detected: None }
    }
}

/// Reads a field from the bytes of any known format, with `options` applied.
///
/// # Errors
/// [`FieldError::Invalid`] with a fault per option that does not fit (pointers from the root of the options), otherwise
/// what the format's reader says.
pub fn open(bytes: &[u8], options: &FieldOptions) -> Result<Opened, FieldError> {
    let format = Format::detect(bytes)?;
    let mut faults = options.faults();
    match format {
        Format::Scene => {
            faults.extend(options.refuse_network_members("a scene"));
            faults.extend(options.refuse_value_members("a scene"));
            refuse(faults)?;
            // a fitted domain moves with the scene; one that is given holds for the scene as it was moved
            let fit = DomainOption::Named(DomainName::Fit);
            let on_scene = options.domain.filter(|&domain| domain == fit || options.transform.is_none());
            let field = scene_from_slice(bytes, on_scene)?;
            if field.dimension() == 2 && options.transform.is_some_and(|t| !t.stays_in_plane()) {
                let detail = "a scene of dimension 2 can only be turned and moved in its plane";
                refuse(vec![options::fault("/transform", "not_offered", detail)])?;
            }
            Ok(finish(field, options, on_scene.is_some()).into())
        }
        Format::Safetensors | Format::Npz | Format::Torch | Format::Folder | Format::Onnx => {
            let (placed, detected) = open_network(bytes, options)?;
            Ok(Opened { field: finish(Box::new(placed.field()), options, false), detected: Some(detected) })
        }
        Format::Mesh(_) => {
            faults.extend(options.refuse_network_members("a mesh"));
            faults.extend(options.refuse_value_members("a mesh"));
            refuse(faults)?;
            let mut mesh = TriangleMesh::read(bytes)?;
            if let Some(transform) = &options.transform {
                transform.apply_to(&mut mesh);
            }
            // the transform is in the vertices already, where it costs nothing
            let rest = FieldOptions { transform: None, ..options.clone() };
            Ok(finish(Box::new(MeshField::new(mesh)?), &rest, false).into())
        }
        Format::Grid => {
            faults.extend(options.refuse_network_members("a grid"));
            let domain = match options.domain {
                None => Domain::default(),
                Some(DomainOption::Box(domain)) => domain,
                Some(DomainOption::Named(DomainName::Fit)) => {
                    faults.push(options::fault("/domain", "not_offered", "a grid needs the box that its samples span"));
                    Domain::default()
                }
            };
            refuse(faults)?;
            Ok(finish(Box::new(Grid::read(bytes, domain)?), options, true).into())
        }
    }
}

/// A network with the latent code and the place in the scene that options give it.
pub struct Placed {
    /// The network, in a frame of its own.
    pub network: Network,
    /// Its latent code, of its latent size; empty for a network without.
    pub latent: Vec<f32>,
    transform: Transform,
}

impl Placed {
    /// The network's field in its own frame.
    pub fn field(&self) -> NetworkField {
        self.network.field(&self.latent).unwrap_or_else(|| unreachable!("the code was checked when it was read"))
    }

    /// A place of the scene in the network's frame.
    pub fn from_scene(&self, p: DVec3) -> DVec3 {
        self.transform.rotation().transpose() * (p - DVec3::from(self.transform.translate)) / self.transform.scale
    }

    /// The derivative by a place in the network's frame of what has this derivative by the place in the scene.
    pub fn pulled_back(&self, gradient: DVec3) -> DVec3 {
        self.transform.scale * (self.transform.rotation().transpose() * gradient)
    }

    /// How far something in the scene moves when it moves by 1 in the network's frame.
    pub fn scale(&self) -> f64 {
        self.transform.scale
    }
}

/// Reads a network from the bytes of any known format of networks, with `options` applied but for those of values (sign, scale, level
/// and domain). Says what the file was taken for.
///
/// # Errors
/// [`FieldError::Unsupported`] for a field of another kind, otherwise as [`open`].
pub fn open_network(bytes: &[u8], options: &FieldOptions) -> Result<(Placed, Detected), FieldError> {
    let format = Format::detect(bytes)?;
    if !format.is_network() {
        let detail = format!("only a network has weights and codes, and this is {}", format.name());
        return Err(FieldError::Unsupported { detail });
    }
    let mut faults = options.faults();
    refuse(std::mem::take(&mut faults))?;
    let (network, detected) = network::read(bytes, format, options, &mut faults)?;
    let latent = options.latent_of(&network, &mut faults);
    if options.domain == Some(DomainOption::Named(DomainName::Fit)) {
        faults.push(options::fault("/domain", "not_offered", "a network's domain cannot be fitted"));
    }
    refuse(faults)?;
    if latent.iter().any(|z| !z.is_finite()) {
        return Err(FieldError::Unsupported { detail: "a latent code that is not finite".to_owned() });
    }
    Ok((Placed { network, latent, transform: options.transform.unwrap_or_default() }, detected))
}

/// Reads a mesh from the bytes of any known format of meshes.
///
/// # Errors
/// [`FieldError::Unsupported`] for a field of another kind, otherwise what the format's reader says.
pub fn open_mesh(bytes: &[u8]) -> Result<MeshField, FieldError> {
    match Format::detect(bytes)? {
        Format::Mesh(_) => MeshField::new(TriangleMesh::read(bytes)?),
        other => {
            let detail = format!("a network is fitted to meshes, and this is {}", other.name());
            Err(FieldError::Unsupported { detail })
        }
    }
}

/// The latent code that `options` choose for the network in the bytes: the one that they give, or a row of those that come
/// with it.
///
/// # Errors
/// As [`open`]; [`FieldError::Invalid`] when the bytes are no network, or when it takes no latent code.
pub fn latent_code(bytes: &[u8], options: &FieldOptions) -> Result<Vec<f32>, FieldError> {
    let format = Format::detect(bytes)?;
    let no_code = || vec![options::fault("/latent", "not_offered", "the field has no latent code")];
    refuse(if format.is_network() { options.faults() } else { no_code() })?;
    let mut faults = Vec::new();
    let (network, _) = network::read(bytes, format, options, &mut faults)?;
    if network.latent_size == 0 {
        faults = no_code();
    }
    let code = options.latent_of(&network, &mut faults);
    refuse(faults)?;
    Ok(code)
}

/// Says what the bytes hold, having read and checked them as [`open`] would. Of the options those count that say how to
/// read a network: `family`, `encoding`, `activation`, `w0` and `skip`.
///
/// # Errors
/// As [`open`]; with one of those options given, every [`FieldError::Invalid`] is about the options.
pub fn describe(bytes: &[u8], options: &FieldOptions) -> Result<Description, FieldError> {
    let format = Format::detect(bytes)?;
    let name = format.name().to_owned();
    let mut faults = options.faults();
    match format {
        Format::Scene => faults.extend(options.refuse_network_members("a scene")),
        Format::Mesh(_) => faults.extend(options.refuse_network_members("a mesh")),
        Format::Grid => faults.extend(options.refuse_network_members("a grid")),
        _ => {}
    }
    refuse(std::mem::take(&mut faults))?;
    Ok(match format {
        Format::Scene => {
            let scene = scene_from_slice(bytes, None)?;
            let (dimension, metric, domain) = (scene.dimension(), scene.metric(), scene.domain());
            Description::Scene { format: name, dimension, metric, domain }
        }
        Format::Safetensors | Format::Npz | Format::Torch | Format::Folder | Format::Onnx => {
            let (network, detected) = network::read(bytes, format, options, &mut faults)?;
            refuse(faults)?;
            Description::Network {
                format: name,
                detected,
                layers: network.layers.iter().map(|l| l.outputs() as u32).collect(),
                activation: hidden_activation(&network).to_owned(),
                latent_size: network.latent_size as u32,
                latent_rows: network.latent_rows() as u32,
                parameters: network.parameters() as u64,
                metric: network.metric,
                domain: network.domain,
            }
        }
        Format::Mesh(_) => {
            let mesh = MeshField::new(TriangleMesh::read(bytes)?)?;
            let (min, max) = mesh.mesh().bounds();
            Description::Mesh {
                format: name,
                vertices: mesh.mesh().vertices.len() as u64,
                triangles: mesh.mesh().triangles.len() as u64,
                bounds: Domain { min, max },
                soundness: *mesh.soundness(),
            }
        }
        Format::Grid => {
            let grid = Grid::read(bytes, Domain::default())?;
            let lipschitz = grid.lipschitz().unwrap_or(0.0);
            Description::Grid { format: name, shape: grid.shape().map(|n| n as u32), lipschitz }
        }
    })
}

fn hidden_activation(network: &Network) -> &'static str {
    let hidden = &network.layers[..network.layers.len().saturating_sub(1)];
    let first = hidden.first().map_or(Activation::Identity, |l| l.activation);
    if hidden.iter().all(|l| l.activation.name() == first.name()) { first.name() } else { "mixed" }
}

/// Puts sign, scale, transform, level and domain around a field. `placed` says that the domain option was used up on the way.
fn finish(mut field: Box<dyn Field>, options: &FieldOptions, placed: bool) -> Box<dyn Field> {
    let sign = if options.sign == Some(Sign::PositiveInside) { -1.0 } else { 1.0 };
    let factor = sign * options.scale.unwrap_or(1.0);
    if factor != 1.0 {
        field = Box::new(Scaled::new(field, factor));
    }
    if let Some(transform) = &options.transform {
        field = Box::new(Transformed::new(field, transform));
    }
    if let Some(level) = options.level.filter(|&l| l != 0.0) {
        field = Box::new(Leveled::new(field, level));
    }
    match options.domain {
        Some(DomainOption::Box(domain)) if !placed => Box::new(Boxed::new(field, domain)),
        _ => field,
    }
}

/// The scene in the bytes, over the domain that is asked for.
fn scene_from_slice(bytes: &[u8], domain: Option<DomainOption>) -> Result<Box<dyn Field>, FieldError> {
    let scene = Scene::from_slice(bytes)?;
    let domain = match domain {
        None => scene.domain(),
        Some(DomainOption::Box(domain)) => domain,
        Some(DomainOption::Named(DomainName::Fit)) => scene.fit_domain().ok_or_else(|| FieldError::Invalid {
            faults: vec![options::fault("/domain", "unbounded", "the scene has no bounded solid to fit a domain to")],
        })?,
    };
    Ok(Box::new(scene.with_domain(domain)))
}

#[cfg(test)]
mod tests;
