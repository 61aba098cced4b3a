//! Everything that can be said of any mesh beside its truth, whoever made it; `docs/metrics.md` has the definitions.

use super::baseline::{FILL, PAPER_SIDE, cubes_at, side_for};
use super::certificate::{Topology, crossings, surface_flips, topology};
use super::chamfer::{Chamfer, chamfer};
use super::chart::{ChartFigures, SphereChart, chart_figures};
use super::distance::{Comparison, FIELD_SAMPLES, Mesh, SAMPLES};
use super::report::{Closeness, Flips};
use super::sampling::by_area;
use super::truth::Truth;
use super::verdict;
use crate::field::mesh::ChartedMesh;
use crate::settings::Canceled;
use glam::DVec3;

/// Seed of the samples at which the field's own value is taken: any that the distances do not use.
const SEED: u64 = 5;

/// What was measured of one mesh.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub struct Figures {
    /// Vertices, those at one place counted once.
    pub vertices: u64,
    /// Triangles.
    pub triangles: u64,
    /// Samples per side of the grid that marching cubes ran on.
    pub side: Option<usize>,
    /// Field values that all of that grid takes.
    pub field_values: Option<u64>,
    /// Whether every edge has exactly two triangles, oppositely oriented.
    pub closed: bool,
    /// Euler characteristic V - E + F.
    pub euler: i64,
    /// Components through shared vertices.
    pub components: u64,
    /// Triangles whose normal opposes the truth's gradient at their centroid.
    pub flips: u64,
    /// Triangles of exactly no area.
    pub degenerate: u64,
    /// Pairs of triangles that meet in more than what they share, by exact predicates.
    pub self_intersections: u64,
    /// Distances, in parts of the truth's diagonal, all 1 when there is nothing to compare; and how face normals agree.
    #[serde(flatten)]
    pub closeness: Closeness,
    /// Where the largest distances were met, scene units: on this mesh, on the truth.
    pub worst_places: [[f64; 3]; 2],
    /// The field's own |value| at samples of this mesh, in parts of the truth's diagonal. A distance only where the field is one.
    pub values: Values,
    /// Sample-to-sample measures with the longest side of the truth at 0.9 (NDC); only against a mesh.
    pub chamfer: Option<Chamfer>,
}

/// Absolute values of a field.
#[derive(Clone, Copy, Debug, Default, PartialEq, serde::Serialize)]
pub struct Values {
    /// Mean.
    pub mean: f64,
    /// Root mean square.
    pub rms: f64,
    /// Largest.
    pub max: f64,
}

/// A mesh beside marching cubes and the truth itself.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub struct Evaluation {
    /// Diagonal of the truth's bounding box, scene units: distances are parts of it.
    pub diagonal: f64,
    /// Factor from scene units to NDC, where the truth's longest side is 0.9.
    pub ndc_scale: f64,
    /// The mesh.
    pub surface: Figures,
    /// Its parameterization, where it has texture coordinates.
    pub parameterization: Option<ChartFigures>,
    /// Marching cubes on the same field: at 27 samples per side, and where it has as many vertices.
    pub marching_cubes: Vec<Figures>,
    /// The truth against itself, where it is a mesh: the floor of the sampled measures.
    pub truth: Option<Figures>,
}

impl Evaluation {
    /// Whether the mesh succeeds, by the conditions of [`super::report::passes`]. A mesh without texture coordinates has no
    /// chart, and its sphere is only judged where it is known.
    ///
    /// # Errors
    /// One sentence for every condition that does not hold.
    pub fn succeeds(&self) -> Result<(), Vec<String>> {
        let (surface, chart) = (&self.surface, self.parameterization.as_ref());
        let figures = verdict::Figures {
            topology: Topology { closed: surface.closed, euler: surface.euler, components: surface.components },
            charts: chart.map_or(0, |c| c.charts),
            flips: Flips {
                surface: surface.flips,
                sphere: chart.and_then(|c| c.sphere_flips).unwrap_or(0),
                uv: chart.map_or(0, |c| c.uv_flips),
            },
            self_intersections: surface.self_intersections,
            max_distance: surface.closeness.distance.max,
        };
        let faults: Vec<String> = figures.misses().into_iter().map(|(_, detail)| detail).collect();
        if faults.is_empty() { Ok(()) } else { Err(faults) }
    }
}

/// Evaluates a mesh: `surface` with vertices at one place merged, `charted` as it stands in its file, where it has texture
/// coordinates. Marching cubes is left out without `baseline`. `None` when the truth is empty.
///
/// # Errors
/// When the token is raised.
pub fn evaluate(
    surface: Mesh<'_>,
    charted: Option<(&ChartedMesh, Option<SphereChart>)>,
    truth: &Truth<'_, '_>,
    baseline: bool,
) -> Result<Option<Evaluation>, Canceled> {
    let Some(bounds) = truth.bounds() else { return Ok(None) };
    let ndc_scale = FILL / (bounds.max - bounds.min).max_element();
    let mut marching_cubes = Vec::new();
    let sides = [Some(PAPER_SIDE), side_for(truth, surface.vertices.len() as u64)];
    for side in sides.into_iter().flatten().filter(|_| baseline) {
        if let Some(cubes) = cubes_at(truth, side)? {
            let mesh = Mesh { vertices: &cubes.vertices, triangles: &cubes.triangles };
            let found = figures(mesh, truth, ndc_scale)?;
            marching_cubes.push(Figures { side: Some(side), field_values: Some(cubes.values), ..found });
        }
    }
    Ok(Some(Evaluation {
        diagonal: truth.diagonal(),
        ndc_scale,
        surface: figures(surface, truth, ndc_scale)?,
        parameterization: charted.map(|(mesh, chart)| chart_figures(mesh, chart)),
        marching_cubes,
        truth: truth.mesh().map(|mesh| figures(mesh, truth, ndc_scale)).transpose()?,
    }))
}

/// Measures one mesh against the truth.
fn figures(mesh: Mesh<'_>, truth: &Truth<'_, '_>, ndc_scale: f64) -> Result<Figures, Canceled> {
    let (sampler, diagonal) = (truth.sampler(), truth.diagonal());
    let settings = sampler.settings();
    let shape = topology(mesh.vertices.len(), mesh.triangles);
    let (folded, degenerate) = surface_flips(mesh.vertices, mesh.triangles, sampler)?;
    let (self_intersections, _) = crossings(mesh.vertices, mesh.triangles, settings)?;
    let comparison = truth.compare(mesh)?.unwrap_or_else(Comparison::nothing);
    let to_ndc = |vertices: &[DVec3]| -> Vec<DVec3> { vertices.iter().map(|&p| ndc_scale * p).collect() };
    let chamfer = match truth.mesh() {
        None => None,
        Some(other) => {
            let (a, b) = (to_ndc(mesh.vertices), to_ndc(other.vertices));
            let (a, b) = (Mesh { vertices: &a, ..mesh }, Mesh { vertices: &b, ..other });
            chamfer(a, b, SAMPLES, settings)?
        }
    };
    Ok(Figures {
        vertices: mesh.vertices.len() as u64,
        triangles: mesh.triangles.len() as u64,
        side: None,
        field_values: None,
        closed: shape.closed,
        euler: shape.euler,
        components: shape.components,
        flips: folded.len() as u64,
        degenerate,
        self_intersections,
        closeness: comparison.closeness,
        worst_places: comparison.worst_places.map(|p| p.to_array()),
        values: values(mesh, truth, diagonal)?,
        chamfer,
    })
}

fn values(mesh: Mesh<'_>, truth: &Truth<'_, '_>, diagonal: f64) -> Result<Values, Canceled> {
    let samples = by_area(mesh.vertices, mesh.triangles, FIELD_SAMPLES, SEED);
    let found = truth.sampler().values(&samples.points)?;
    let n = (found.len() as f64).max(1.0);
    let (sum, squares, max) = found
        .iter()
        .fold((0.0, 0.0, 0.0f64), |(sum, squares, max), s| (sum + s.abs(), squares + s * s, max.max(s.abs())));
    Ok(Values { mean: sum / n / diagonal, rms: (squares / n).sqrt() / diagonal, max: max / diagonal })
}

#[cfg(test)]
mod tests {
    use super::super::certificate::positions;
    use super::super::fixtures::*;
    use super::*;
    use crate::field::Sampler;
    use crate::field::mesh::{MeshField, TriangleMesh};
    use crate::field::sampler::Tally;
    use crate::shrink::lattice::LatticeSpec;
    use crate::surface::gltf::to_glb;
    use serde_json::{Value, json};

    const SPEC: LatticeSpec = LatticeSpec::Octahedral { n: 24 };

    #[test]
    fn a_sphere_against_a_ball_succeeds_and_its_values_are_its_distances() {
        with_settings(2, |settings| {
            let (field, tally) = (Balls::one(0.5), Tally::new());
            let sampler = Sampler::new(&field, *settings, &tally);
            let truth = Truth::of(&sampler).unwrap();
            let surface = sphere_surface(SPEC, 0.5);
            let glb = to_glb(&surface, &json!({"lattice": SPEC}), &Value::Null);
            let charted = ChartedMesh::read(&glb).unwrap().unwrap();
            let vertices = positions(&surface);
            let mesh = Mesh { vertices: &vertices, triangles: &surface.triangles };
            let chart = SphereChart::named_in(&charted.extras);
            let found = evaluate(mesh, Some((&charted, chart)), &truth, true).unwrap().unwrap();
            assert_eq!(found.succeeds(), Ok(()));
            let (surface, there) = (found.surface, found.surface.closeness.distance.surface_to_truth);
            assert!((surface.values.mean / there.mean - 1.0).abs() < 0.05, "{surface:?}");
            assert!(surface.values.max <= there.max * 1.0001, "{surface:?}");
            assert_eq!((found.truth, surface.chamfer), (None, None), "no mesh to sample");
            assert_eq!(found.marching_cubes[0].side, Some(27));
            let ratio = found.marching_cubes[1].vertices as f64 / surface.vertices as f64;
            assert!((0.97..1.15).contains(&ratio), "{ratio}");
            assert!(found.marching_cubes.iter().all(|cubes| cubes.closed && cubes.flips == 0));
        });
    }

    #[test]
    fn against_a_mesh_the_floor_stands_beside_the_sampled_measures_and_the_scale_does_not_matter() {
        with_settings(2, |settings| {
            let measured = |scale: f64| {
                let (vertices, triangles) = sphere_mesh(60, 30, scale, DVec3::ZERO);
                let truth_mesh = TriangleMesh {
                    vertices: vertices.iter().map(|p| p.to_array()).collect(),
                    triangles: triangles.clone(),
                };
                let field = MeshField::new(truth_mesh).unwrap();
                let tally = Tally::new();
                let sampler = Sampler::new(&field, *settings, &tally);
                let truth = Truth::of(&sampler).unwrap();
                let larger: Vec<DVec3> = vertices.iter().map(|&p| 1.02 * p).collect();
                let mesh = Mesh { vertices: &larger, triangles: &triangles };
                evaluate(mesh, None, &truth, false).unwrap().unwrap()
            };
            let (small, large) = (measured(0.1), measured(40.0));
            assert!((small.diagonal / 0.1 - large.diagonal / 40.0).abs() < 1e-6);
            for found in [&small, &large] {
                let (cd, floor) = (found.surface.chamfer.unwrap(), found.truth.unwrap().chamfer.unwrap());
                // spheres of radius 0.45 in NDC, 2 % apart
                assert!((cd.cd1 / 2.0 / 0.009 - 1.0).abs() < 0.05, "{cd:?}");
                assert!(floor.cd2 < 0.1 * cd.cd2 && floor.cd2 > 0.0);
                assert!(found.truth.unwrap().closeness.distance.max < 1e-15, "nothing but rounding");
                assert!(found.marching_cubes.is_empty());
                let faults = found.succeeds().unwrap_err();
                assert!(faults.iter().any(|f| f.contains("0 charts")), "{faults:?}");
            }
            assert!((small.surface.closeness.distance.mean - large.surface.closeness.distance.mean).abs() < 1e-6);
        });
    }
}
