//! Sample-to-sample measures, as the literature tabulates them: chamfer distances, F1, edge chamfer. They have a sampling
//! floor, so always print the truth against itself beside them.

use super::distance::Mesh;
use super::nearest::Nearest;
use super::sampling::{Samples, by_area};
use super::{corners, doubled_normal, map_chunks};
use crate::settings::{Canceled, Settings};
use glam::DVec3;

/// Two samples closer than this, with normals as far apart as [`EDGE_COSINE`], make an edge sample (NDC protocol).
pub const EDGE_RADIUS: f64 = 0.004;
/// Edge samples have a neighbour with |n . n'| under this.
pub const EDGE_COSINE: f64 = 0.2;
/// Thresholds of F1, finer first.
pub const F1_AT: [f64; 2] = [0.001, 0.003];
/// Threshold of the edge F1.
pub const EF1_AT: f64 = 0.005;

/// Sample-to-sample measures, in the units of the meshes (NDC: the longest side is 0.9).
#[derive(Clone, Copy, Debug, Default, PartialEq, serde::Serialize)]
pub struct Chamfer {
    /// mean d(G -> P) + mean d(P -> G).
    pub cd1: f64,
    /// mean d^2(G -> P) + mean d^2(P -> G).
    pub cd2: f64,
    /// F1 at each of [`F1_AT`].
    pub f1: [f64; 2],
    /// Mean over both directions of |n . n'|, face normals of nearest samples.
    pub normal_consistency: f64,
    /// Edge samples of the surface and of the truth; figures of a few are noise.
    pub edge_samples: [usize; 2],
    /// CD2 between edge samples; `None` when either side has none.
    pub edge_cd2: Option<f64>,
    /// F1 between edge samples at [`EF1_AT`]; `None` when either side has none.
    pub edge_f1: Option<f64>,
}

struct Cloud {
    points: Vec<DVec3>,
    normals: Vec<DVec3>,
    nearest: Nearest,
}

impl Cloud {
    fn new(points: Vec<DVec3>, normals: Vec<DVec3>) -> Self {
        Self { nearest: Nearest::of_points(&points), points, normals }
    }
    fn of(mesh: Mesh<'_>, count: usize, seed: u64) -> Self {
        let Samples { points, triangles } = by_area(mesh.vertices, mesh.triangles, count, seed);
        let normal = |&t: &u32| doubled_normal(corners(mesh.vertices, mesh.triangles[t as usize])).normalize_or_zero();
        let normals = triangles.iter().map(normal).collect();
        Self::new(points, normals)
    }
    /// The samples that have a neighbour across an edge.
    fn edges(&self, settings: &Settings<'_>) -> Result<Self, Canceled> {
        let on_edge = map_chunks(&self.points, settings, |i, &p| {
            self.nearest
                .any_within(p, EDGE_RADIUS, |j| self.normals[i].dot(self.normals[j as usize]).abs() < EDGE_COSINE)
        })?;
        let keep: Vec<usize> = (0..self.points.len()).filter(|&i| on_edge[i]).collect();
        Ok(Self::new(keep.iter().map(|&i| self.points[i]).collect(), keep.iter().map(|&i| self.normals[i]).collect()))
    }
}

/// Means over the samples of `from`: distance, squared distance, share within each threshold, |n . n'|.
fn one_way(
    from: &Cloud,
    to: &Cloud,
    at: &[f64],
    settings: &Settings<'_>,
) -> Result<(f64, f64, Vec<f64>, f64), Canceled> {
    let n = from.points.len() as f64;
    let (mut d1, mut d2, mut cosine) = (0.0, 0.0, 0.0);
    let mut within = vec![0.0; at.len()];
    for (i, hit) in to.nearest.closest_all(&from.points, settings)?.iter().enumerate() {
        d1 += hit.distance();
        d2 += hit.distance_squared;
        cosine += from.normals[i].dot(to.normals[hit.triangle as usize]).abs();
        for (share, &threshold) in within.iter_mut().zip(at) {
            *share += f64::from(u8::from(hit.distance() <= threshold));
        }
    }
    within.iter_mut().for_each(|share| *share /= n);
    Ok((d1 / n, d2 / n, within, cosine / n))
}

fn f1(precision: f64, recall: f64) -> f64 {
    if precision + recall > 0.0 { 2.0 * precision * recall / (precision + recall) } else { 0.0 }
}

/// Compares `samples` points of each mesh, uniform by area. `None` when either has no area.
///
/// # Errors
/// When the token is raised.
pub fn chamfer(
    surface: Mesh<'_>,
    truth: Mesh<'_>,
    samples: usize,
    settings: &Settings<'_>,
) -> Result<Option<Chamfer>, Canceled> {
    let (p, g) = (Cloud::of(surface, samples, 3), Cloud::of(truth, samples, 4));
    if p.points.is_empty() || g.points.is_empty() {
        return Ok(None);
    }
    let (p1, p2, precision, pc) = one_way(&p, &g, &F1_AT, settings)?;
    let (g1, g2, recall, gc) = one_way(&g, &p, &F1_AT, settings)?;
    let (pe, ge) = (p.edges(settings)?, g.edges(settings)?);
    let (mut edge_cd2, mut edge_f1) = (None, None);
    if !pe.points.is_empty() && !ge.points.is_empty() {
        let (_, a, precision, _) = one_way(&pe, &ge, &[EF1_AT], settings)?;
        let (_, b, recall, _) = one_way(&ge, &pe, &[EF1_AT], settings)?;
        (edge_cd2, edge_f1) = (Some(a + b), Some(f1(precision[0], recall[0])));
    }
    Ok(Some(Chamfer {
        cd1: p1 + g1,
        cd2: p2 + g2,
        f1: [0, 1].map(|i| f1(precision[i], recall[i])),
        normal_consistency: 0.5 * (pc + gc),
        edge_samples: [pe.points.len(), ge.points.len()],
        edge_cd2,
        edge_f1,
    }))
}

#[cfg(test)]
mod tests {
    use super::super::fixtures::*;
    use super::*;

    #[test]
    fn the_floor_of_a_square_is_that_of_a_poisson_process() {
        // n samples per unit area have a mean squared nearest distance of 1 / (pi n)
        let vertices = [DVec3::ZERO, DVec3::X, DVec3::ONE - DVec3::Z, DVec3::Y];
        let mesh = Mesh { vertices: &vertices, triangles: &[[0, 1, 2], [0, 2, 3]] };
        let c = with_settings(2, |s| chamfer(mesh, mesh, 20_000, s).unwrap().unwrap());
        let expected = 2.0 / (std::f64::consts::PI * 20_000.0);
        assert!((c.cd2 / expected - 1.0).abs() < 0.05, "{} {expected}", c.cd2);
        assert!(c.normal_consistency > 0.999_999 && c.f1[1] > 0.3 && c.f1[1] > c.f1[0]);
        assert_eq!((c.edge_cd2, c.edge_samples), (None, [0, 0]), "a plane has no edge");
    }

    #[test]
    fn planes_apart_have_the_distance_between_them() {
        let low = [DVec3::ZERO, DVec3::X, DVec3::ONE - DVec3::Z, DVec3::Y];
        let high = low.map(|p| p + 0.1 * DVec3::Z);
        let triangles = [[0, 1, 2], [0, 2, 3]];
        let (a, b) = (Mesh { vertices: &low, triangles: &triangles }, Mesh { vertices: &high, triangles: &triangles });
        let c = with_settings(1, |s| chamfer(a, b, 5000, s).unwrap().unwrap());
        assert!((c.cd1 - 0.2).abs() < 2e-3 && (c.cd2 - 0.02).abs() < 4e-4, "{c:?}");
        assert_eq!(c.f1, [0.0, 0.0]);
    }

    #[test]
    fn a_folded_sheet_has_samples_on_its_crease() {
        let vertices = [DVec3::ZERO, DVec3::X, DVec3::Y, DVec3::Z].map(|p| 0.1 * p);
        let mesh = Mesh { vertices: &vertices, triangles: &[[0, 1, 2], [0, 3, 1]] };
        let c = with_settings(1, |s| chamfer(mesh, mesh, 20_000, s).unwrap().unwrap());
        assert!(c.edge_f1.unwrap() > 0.99 && c.edge_samples.iter().all(|&n| n > 100), "{c:?}");
    }
}
