//! How well a fitted network does: on samples that it was not trained with, and by its zero level set.

use super::FitSpec;
use super::samples::around;
use crate::field::input::Transform;
use crate::field::mesh::MeshField;
use crate::field::network::Network;
use crate::field::sampler::Tally;
use crate::field::{Field, Sampler};
use crate::measure::certificate::topology;
use crate::measure::distance::{Mesh, SAMPLES, between};
use crate::measure::marching_cubes::marching_cubes;
use crate::measure::report::Closeness;
use crate::settings::{Canceled, Progress, Settings};
use glam::DVec3;
use serde::{Deserialize, Serialize};

/// Samples of every mesh that the network is judged by and was not trained with.
const HELD_OUT: usize = 20_000;
/// What makes their seed another than that of training.
const OTHER_SEED: u64 = 0x5851_f42d_4c95_7f2d;
/// Side of the grid that the zero level set is taken from.
const SIDE: usize = 128;

/// Everything measured about a fit.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct FitReport {
    /// What was asked for.
    pub fit: FitSpec,
    /// Weights and biases of the network.
    pub parameters: u64,
    /// Mean of the loss in every epoch, in parts of the longest half side of the domain.
    pub losses: Vec<f64>,
    /// One for every mesh, in the order they were given.
    pub shapes: Vec<ShapeReport>,
    /// Version of the program.
    pub version: String,
}

/// How well a network does on one mesh.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct ShapeReport {
    /// Mean of |f - d| over held-out samples that are spread as those of training, in parts of the mesh's diagonal.
    pub error: f64,
    /// Distances between the zero level set (by marching cubes on a grid of 128 x 128 x 128) and the mesh, both ways, in parts of
    /// the diagonal, and how the normals agree. Nothing when the network has no zero level set.
    pub closeness: Option<Closeness>,
    /// Components of that zero level set: more than the mesh has are specks that the network imagines.
    pub components: u64,
    /// Where every mesh was brought to one cube (`normalize`): what takes the network's surface to its mesh, as the option `transform`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub transform: Option<Transform>,
}

/// Measures a network against its meshes, which are in its units; `back` takes them to where they were, if they were moved.
pub(super) fn measure(
    network: &Network,
    meshes: &[MeshField],
    back: &[Transform],
    spec: &FitSpec,
    losses: &[f32],
    settings: &Settings<'_>,
) -> Result<FitReport, Canceled> {
    let mut shapes = Vec::with_capacity(meshes.len());
    for (i, mesh) in meshes.iter().enumerate() {
        let done = i as f32 / meshes.len() as f32;
        let fraction = super::TRAINED_SHARE + (1.0 - super::TRAINED_SHARE) * done;
        (settings.progress)(Progress { stage: "measure", fraction, ..Progress::default() });
        let shape = shape(network, mesh, i, spec, settings)?;
        shapes.push(ShapeReport { transform: back.get(i).copied(), ..shape });
    }
    Ok(FitReport {
        fit: *spec,
        parameters: network.parameters() as u64,
        losses: losses.iter().map(|&loss| loss.into()).collect(),
        shapes,
        version: env!("CARGO_PKG_VERSION").to_owned(),
    })
}

fn shape(
    network: &Network,
    mesh: &MeshField,
    index: usize,
    spec: &FitSpec,
    settings: &Settings<'_>,
) -> Result<ShapeReport, Canceled> {
    let field = network.field(network.latent_code(index).unwrap_or_default());
    let field = field.unwrap_or_else(|| unreachable!("a code per mesh, and finite weights"));
    let domain = mesh.domain();
    let (low, high) = (DVec3::from(domain.min), DVec3::from(domain.max));
    let (tally, told) = (Tally::new(), |_: Progress| {});
    let settings = Settings { progress: &told, ..*settings };
    let sampler = Sampler::new(&field, settings, &tally);
    let points = around(mesh, 0.5 * (high - low).max_element(), HELD_OUT, spec.seed ^ OTHER_SEED);
    let (found, truth) = (sampler.values(&points)?, Sampler::new(mesh, settings, &tally).values(&points)?);
    let vertices: Vec<DVec3> = mesh.mesh().vertices.iter().map(|&v| DVec3::from(v)).collect();
    let (least, most) = mesh.mesh().bounds();
    let diagonal = (DVec3::from(most) - DVec3::from(least)).length();
    let error = found.iter().zip(&truth).map(|(f, d)| (f - d).abs()).sum::<f64>() / points.len() as f64 / diagonal;
    let zeros = marching_cubes(&sampler, low, high, SIDE)?;
    let components = topology(zeros.vertices.len(), &zeros.triangles).components;
    let zeros = Mesh { vertices: &zeros.vertices, triangles: &zeros.triangles };
    let truth = Mesh { vertices: &vertices, triangles: &mesh.mesh().triangles };
    let closeness = between(zeros, truth, SAMPLES, &settings)?.map(|comparison| comparison.closeness);
    Ok(ShapeReport { error, closeness, components, transform: None })
}
