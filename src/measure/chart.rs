//! The parameterization of a mesh that carries texture coordinates, whoever made it: charts, mirrored triangles, distortion
//! from the chart, and from the sphere where the chart is one of ours and a place in it names a direction.

use super::certificate::topology;
use super::distortion::distortion;
use super::report::Distortion;
use crate::field::mesh::ChartedMesh;
use crate::shrink::lattice::LatticeSpec;
use glam::{DVec2, DVec3};
use std::collections::HashMap;
use std::f64::consts::{FRAC_PI_4, PI, TAU};

/// A chart in which every place is a direction on the sphere.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "snake_case")]
pub enum SphereChart {
    /// u is the longitude over 2 pi, v the polar angle over pi.
    Latlong,
    /// The square is an unfolded octahedron of equal areas.
    Octahedral,
}

impl SphereChart {
    /// The chart that a GLB of ours names in its report (`extras.report.lattice`).
    pub fn named_in(extras: &serde_json::Value) -> Option<Self> {
        let lattice = extras.pointer("/report/lattice")?;
        match serde_json::from_value(lattice.clone()).ok()? {
            LatticeSpec::Latlong { .. } => Some(SphereChart::Latlong),
            LatticeSpec::Octahedral { .. } => Some(SphereChart::Octahedral),
        }
    }

    /// The direction at (u, v), v downwards.
    pub fn direction(self, [u, v]: [f64; 2]) -> DVec3 {
        match self {
            SphereChart::Latlong => {
                let (theta, phi) = (TAU * u, PI * v);
                DVec3::new(phi.sin() * theta.cos(), phi.sin() * theta.sin(), phi.cos())
            }
            SphereChart::Octahedral => unfolded(2.0 * u - 1.0, 1.0 - 2.0 * v),
        }
    }

    /// Width of the chart by its height, as distortion takes it.
    fn aspect(self) -> f64 {
        match self {
            SphereChart::Latlong => 2.0,
            SphereChart::Octahedral => 1.0,
        }
    }
}

/// The direction at (a, b) of the square [-1, 1]^2, by an equal-area map of the octahedron's faces (Clarberg 2008, "Fast
/// equal-area mapping of the (hemi)sphere using SIMD", section 3): the middle is +z, the corners are -z.
fn unfolded(a: f64, b: f64) -> DVec3 {
    let (x, y) = (a.abs(), b.abs());
    // from the nearer pole, 0 there and 1 on the equator
    let northern = x + y <= 1.0;
    let (p, q) = if northern { (x, y) } else { (1.0 - y, 1.0 - x) };
    let r = p + q;
    let angle = if r > 0.0 { FRAC_PI_4 * ((q - p) / r + 1.0) } else { 0.0 };
    let height = if northern { 1.0 - r * r } else { r * r - 1.0 };
    let ring = r * (2.0 - r * r).max(0.0).sqrt();
    DVec3::new((ring * angle.cos()).copysign(a), (ring * angle.sin()).copysign(b), height)
}

/// What was found.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub struct ChartFigures {
    /// Charts: components of the triangles through vertices that agree in position and in the chart.
    pub charts: u64,
    /// Triangles that are mirrored in the chart or have no area there; v points down, so right is a negative area in (u, v).
    pub uv_flips: u64,
    /// Distortion from the chart.
    pub uv: Distortion,
    /// Which sphere the chart is a picture of.
    pub sphere_chart: Option<SphereChart>,
    /// Triangles that are not counter-clockwise on the sphere, seen from outside.
    pub sphere_flips: Option<u64>,
    /// Distortion from the sphere.
    pub sphere: Option<Distortion>,
}

/// Examines the parameterization of a mesh. Without `chart` nothing is said of the sphere, and the UV square is taken as a
/// square.
pub fn chart_figures(mesh: &ChartedMesh, chart: Option<SphereChart>) -> ChartFigures {
    let places: Vec<DVec2> = mesh.uv.iter().map(|uv| DVec2::from(uv.map(f64::from))).collect();
    let positions: Vec<DVec3> = mesh.vertices.iter().map(|&p| DVec3::from(p)).collect();
    let at = |t: &[u32; 3]| t.map(|v| positions[v as usize]);
    let area = |t: &[u32; 3]| {
        let [a, b, c] = t.map(|v| places[v as usize]);
        (b - a).perp_dot(c - a)
    };
    let aspect = chart.map_or(1.0, SphereChart::aspect);
    let from_chart = mesh.triangles.iter().map(|t| {
        let place = t.map(|v| DVec2::new(aspect * places[v as usize].x, -places[v as usize].y));
        (place, at(t))
    });
    // a chart that was relaxed names no directions any more; the second coordinates do
    let on_chart = mesh.second_uv.as_ref().filter(|_| relaxed(&mesh.extras)).unwrap_or(&mesh.uv);
    let directions: Option<Vec<DVec3>> =
        chart.map(|chart| on_chart.iter().map(|uv| chart.direction(uv.map(f64::from))).collect());
    let on_sphere = |t: &[u32; 3], directions: &[DVec3]| t.map(|v| directions[v as usize]);
    ChartFigures {
        charts: charts(mesh),
        uv_flips: mesh.triangles.iter().filter(|t| area(t) >= 0.0).count() as u64,
        uv: distortion(from_chart),
        sphere_chart: chart,
        sphere_flips: directions.as_deref().map(|directions| {
            let turned = |t: &&[u32; 3]| {
                let [a, b, c] = on_sphere(t, directions);
                a.dot(b.cross(c)) <= 0.0
            };
            mesh.triangles.iter().filter(turned).count() as u64
        }),
        sphere: directions.as_deref().map(|directions| {
            distortion(mesh.triangles.iter().map(|t| (super::distortion::flatten(on_sphere(t, directions)), at(t))))
        }),
    }
}

/// Whether a GLB of ours says that its chart was relaxed.
fn relaxed(extras: &serde_json::Value) -> bool {
    extras.pointer("/report/options/relax_uv").is_some_and(|relaxed| relaxed == true)
}

/// Components through vertices of one position and one place in the chart: a vertex may be there twice for its normals.
fn charts(mesh: &ChartedMesh) -> u64 {
    let mut known: HashMap<([u64; 3], [u32; 2]), u32> = HashMap::with_capacity(mesh.vertices.len());
    let merged: Vec<u32> = (0u32..)
        .zip(mesh.vertices.iter().zip(&mesh.uv))
        .map(|(i, (p, uv))| *known.entry((p.map(f64::to_bits), uv.map(|c| (c + 0.0).to_bits()))).or_insert(i))
        .collect();
    let triangles: Vec<[u32; 3]> = mesh.triangles.iter().map(|t| t.map(|v| merged[v as usize])).collect();
    topology(mesh.vertices.len(), &triangles).components
}

#[cfg(test)]
mod tests {
    use super::super::distortion::distortions;
    use super::super::fixtures::*;
    use super::*;
    use crate::shrink::lattice::SphereLattice;
    use crate::surface::gltf::to_glb;
    use serde_json::{Value, json};

    const SPECS: [LatticeSpec; 2] =
        [LatticeSpec::Latlong { n_theta: 40, n_phi: 20 }, LatticeSpec::Octahedral { n: 12 }];

    #[test]
    fn a_place_in_the_chart_names_the_direction_of_the_lattice() {
        for (spec, chart) in SPECS.into_iter().zip([SphereChart::Latlong, SphereChart::Octahedral]) {
            let lattice = SphereLattice::new(spec);
            for (&uv, &v) in lattice.uv.iter().zip(&lattice.chart) {
                let (found, expected) = (chart.direction(uv), lattice.directions[v as usize]);
                assert!(found.distance(expected) < 1e-9, "{spec:?} {uv:?}: {found} {expected}");
            }
        }
    }

    #[test]
    fn a_glb_of_ours_has_the_figures_of_its_surface() {
        for spec in SPECS {
            let surface = surface_of(spec, |d| (d * (1.0 + 0.3 * d.x), d));
            let glb = to_glb(&surface, &json!({"lattice": spec}), &Value::Null);
            let mesh = ChartedMesh::read(&glb).unwrap().unwrap();
            let found = chart_figures(&mesh, SphereChart::named_in(&mesh.extras));
            assert_eq!((found.charts, found.uv_flips, found.sphere_flips), (1, 0, Some(0)), "{spec:?}");
            let expected = distortions(&surface);
            for (a, b) in [(found.uv, expected.uv), (found.sphere.unwrap(), expected.sphere)] {
                assert!((a.qc / b.qc - 1.0).abs() < 1e-4, "{spec:?} {a:?} {b:?}");
                assert!((a.symmetric_dirichlet / b.symmetric_dirichlet - 1.0).abs() < 1e-4);
                assert!((a.area_p99 / b.area_p99 - 1.0).abs() < 1e-4);
            }
        }
    }

    #[test]
    fn a_mirrored_chart_in_two_parts_is_seen() {
        let mesh = ChartedMesh {
            vertices: vec![
                [0.0, 0.0, 0.0],
                [1.0, 0.0, 0.0],
                [0.0, 1.0, 0.0],
                [5.0, 0.0, 0.0],
                [6.0, 0.0, 0.0],
                [5.0, 1.0, 0.0],
            ],
            // v downwards: the first triangle is right, the second mirrored
            uv: vec![[0.0, 1.0], [0.4, 1.0], [0.0, 0.6], [0.6, 0.0], [1.0, 0.0], [0.6, 0.4]],
            triangles: vec![[0, 1, 2], [3, 4, 5]],
            second_uv: None,
            extras: Value::Null,
        };
        let found = chart_figures(&mesh, None);
        assert_eq!((found.charts, found.uv_flips, found.sphere), (2, 1, None));
        assert!((found.uv.qc - 1.0).abs() < 1e-6);
    }
}
