//! Distances between a surface and its truth, both ways, with no sampling floor: from samples of one to the closest point
//! of the other. The truth is a mesh where there is one, otherwise the zero level set of the field itself.

use super::certificate::positions;
use super::nearest::Nearest;
use super::report::{Closeness, MAX_DISTANCE};
use super::sampling::{Samples, by_area};
use super::tallied::Tallied;
use super::truth::Truth;
use super::zero_set::{self, ZeroSet};
use super::{corners, diagonal, doubled_normal};
use crate::field::mesh::TriangleMesh;
use crate::field::{Metric, Sampler};
use crate::settings::{Canceled, Settings};
use crate::surface::Surface;
use glam::DVec3;

/// Samples of each surface when the truth is a mesh.
pub const SAMPLES: usize = 100_000;
/// Samples of the surface when the truth is a field: each costs several evaluations, of a network perhaps.
pub const FIELD_SAMPLES: usize = 20_000;
/// Seeds of the samples of the surface and of the truth: any two that differ.
const SEEDS: [u64; 2] = [1, 2];
/// How far from the surface the field's zero set is looked for along the gradient, in parts of the diagonal. Beyond, the
/// nearest point that the grid found counts.
const REACH: f64 = 0.05;
/// Places listed at most.
const PLACES: usize = 16;
/// Places closer than this are one, in parts of the diagonal: twice the bar, so that both sides of one miss are.
const APART: f64 = 2.0 * MAX_DISTANCE;

/// A mesh by reference: positions in scene units, and triangles.
#[derive(Clone, Copy, Debug)]
pub struct Mesh<'a> {
    /// Positions.
    pub vertices: &'a [DVec3],
    /// Triangles, counter-clockwise outward.
    pub triangles: &'a [[u32; 3]],
}

/// Distances and normal consistency, both ways.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Comparison {
    /// Distances, in parts of the truth's diagonal, and how the normals agree.
    pub closeness: Closeness,
    /// Places of either side that are farther than [`MAX_DISTANCE`] from the other, scene units: the farthest first, and
    /// of those close together one; at most 16.
    pub far: Vec<DVec3>,
    /// Where the largest distances were met, scene units: on the surface, on the truth.
    pub worst_places: [DVec3; 2],
    /// Distance of every triangle of the surface from the truth, scene units: the largest that was met at its corners and at the
    /// samples on it; where no sample fell on it, the mean of what its neighbours met counts as one.
    pub by_triangle: Vec<f32>,
}

impl Comparison {
    /// Of nothing that could be compared.
    pub fn nothing() -> Self {
        Self { closeness: Closeness::nothing(), ..Self::default() }
    }
}

fn both(there: Tallied, back: Tallied, size: f64, by_triangle: Vec<f32>) -> Comparison {
    Comparison {
        closeness: Closeness::both(there.one_way(size), back.one_way(size)),
        worst_places: [there.worst, back.worst],
        far: thinned([there.far, back.far].concat(), APART * size),
        by_triangle,
    }
}

/// What [`Comparison::by_triangle`] says, of the distances at samples and at vertices.
fn by_triangle(surface: Mesh<'_>, samples: &Samples, at_samples: &[f64], at_vertices: &[f64]) -> Vec<f32> {
    let mut met: Vec<Option<f64>> = vec![None; surface.triangles.len()];
    let mut around = vec![(0.0, 0u32); surface.vertices.len()];
    for (&t, &distance) in samples.triangles.iter().zip(at_samples) {
        let largest = &mut met[t as usize];
        *largest = Some(largest.map_or(distance, |known| known.max(distance)));
    }
    for (triangle, distance) in surface.triangles.iter().zip(&met) {
        for &v in triangle.iter().filter(|_| distance.is_some()) {
            let (sum, count) = &mut around[v as usize];
            (*sum, *count) = (*sum + distance.unwrap_or(0.0), *count + 1);
        }
    }
    let of = |(triangle, met): (&[u32; 3], &Option<f64>)| {
        let corners = triangle.iter().map(|&v| at_vertices[v as usize]).fold(0.0, f64::max);
        let (sum, count) =
            triangle.iter().fold((0.0, 0), |(s, n), &v| (s + around[v as usize].0, n + around[v as usize].1));
        let inside = met.unwrap_or(if count > 0 { sum / f64::from(count) } else { 0.0 });
        corners.max(inside) as f32
    };
    surface.triangles.iter().zip(&met).map(of).collect()
}

/// The farthest places, no two of them closer than `apart`.
fn thinned(mut list: Vec<(f64, DVec3)>, apart: f64) -> Vec<DVec3> {
    list.sort_by(|a, b| b.0.total_cmp(&a.0));
    let mut kept: Vec<DVec3> = Vec::new();
    for (_, place) in list {
        if kept.len() == PLACES {
            break;
        }
        if kept.iter().all(|k| k.distance_squared(place) > apart * apart) {
            kept.push(place);
        }
    }
    kept
}

fn unit_normals(mesh: Mesh<'_>) -> Vec<DVec3> {
    mesh.triangles.iter().map(|&t| doubled_normal(corners(mesh.vertices, t)).normalize_or_zero()).collect()
}

/// Compares a surface with a mesh: `samples` points of each, uniform by area, for means and normals, and every vertex of
/// both besides for the maximum. `None` when either has no area.
///
/// # Errors
/// When the token is raised.
pub fn between(
    surface: Mesh<'_>,
    truth: Mesh<'_>,
    samples: usize,
    settings: &Settings<'_>,
) -> Result<Option<Comparison>, Canceled> {
    let on_surface = by_area(surface.vertices, surface.triangles, samples, SEEDS[0]);
    let on_truth = by_area(truth.vertices, truth.triangles, samples, SEEDS[1]);
    if on_surface.points.is_empty() || on_truth.points.is_empty() {
        return Ok(None);
    }
    let size = diagonal(truth.vertices);
    let bar = MAX_DISTANCE * size;
    let (there, [at_samples, at_vertices]) = one_way(surface, &on_surface, truth, bar, settings)?;
    let (back, _) = one_way(truth, &on_truth, surface, bar, settings)?;
    Ok(Some(both(there, back, size, by_triangle(surface, &on_surface, &at_samples, &at_vertices))))
}

/// One way, and the distances at samples and at vertices.
fn one_way(
    from: Mesh<'_>,
    samples: &Samples,
    to: Mesh<'_>,
    bar: f64,
    settings: &Settings<'_>,
) -> Result<(Tallied, [Vec<f64>; 2]), Canceled> {
    let nearest = Nearest::new(to.vertices, to.triangles);
    let (from_normals, to_normals) = (unit_normals(from), unit_normals(to));
    let mut tallied = Tallied::default();
    let hits = nearest.closest_all(&samples.points, settings)?;
    for (hit, &t) in hits.iter().zip(&samples.triangles) {
        tallied.add(1.0, hit.distance(), from_normals[t as usize].dot(to_normals[hit.triangle as usize]));
    }
    let at_samples: Vec<f64> = hits.iter().map(|hit| hit.distance()).collect();
    tallied.extremes(bar, at_samples.iter().copied().zip(samples.points.iter().copied()));
    let hits = nearest.closest_all(from.vertices, settings)?;
    let at_vertices: Vec<f64> = hits.iter().map(|hit| hit.distance()).collect();
    tallied.extremes(bar, at_vertices.iter().copied().zip(from.vertices.iter().copied()));
    Ok((tallied, [at_samples, at_vertices]))
}

/// Compares a surface with the field behind `sampler`.
///
/// There: from every sample of the surface (and, for the maximum, every vertex) to the zero level set: |s| where the field is
/// an exact distance, otherwise the smaller of the way along the gradient and the distance to the nearest point of
/// [`zero_set::find`]. Back: from the points of [`zero_set::find`] over the whole domain to the closest point of the
/// surface, weighted by the area that they stand for. Normals are the field's gradients on the zero set. `None` when the
/// surface has no area or no zero was found.
///
/// # Errors
/// When the token is raised.
pub fn to_field(surface: Mesh<'_>, samples: usize, sampler: &Sampler<'_>) -> Result<Option<Comparison>, Canceled> {
    to_zero_set(surface, samples, &zero_set::find(sampler)?, sampler)
}

/// As [`to_field`], with the points on its zero level set found already.
///
/// # Errors
/// When the token is raised.
pub fn to_zero_set(
    surface: Mesh<'_>,
    samples: usize,
    zeros: &ZeroSet,
    sampler: &Sampler<'_>,
) -> Result<Option<Comparison>, Canceled> {
    let settings = sampler.settings();
    let on_surface = by_area(surface.vertices, surface.triangles, samples, SEEDS[0]);
    if on_surface.points.is_empty() || zeros.points.is_empty() {
        return Ok(None);
    }
    let size = diagonal(&zeros.points);
    let normals = unit_normals(surface);

    let mut starts = on_surface.points.clone();
    starts.extend_from_slice(surface.vertices);
    let landed = land(&starts, zeros, REACH * size, sampler)?;
    let mut there = Tallied::default();
    for (i, (distance, normal)) in landed.iter().enumerate() {
        if let Some(&t) = on_surface.triangles.get(i) {
            there.add(1.0, *distance, normals[t as usize].dot(*normal));
        }
    }
    let bar = MAX_DISTANCE * size;
    there.extremes(bar, landed.iter().map(|(distance, _)| *distance).zip(starts.iter().copied()));
    let nearest = Nearest::new(surface.vertices, surface.triangles);
    let mut back = Tallied::default();
    let hits = nearest.closest_all(&zeros.points, settings)?;
    for (i, hit) in hits.iter().enumerate() {
        back.add(zeros.weights[i], hit.distance(), normals[hit.triangle as usize].dot(zeros.normals[i]));
    }
    back.extremes(bar, hits.iter().map(|hit| hit.distance()).zip(zeros.points.iter().copied()));
    let distances: Vec<f64> = landed.iter().map(|(distance, _)| *distance).collect();
    let (at_samples, at_vertices) = distances.split_at(on_surface.points.len());
    Ok(Some(both(there, back, size, by_triangle(surface, &on_surface, at_samples, at_vertices))))
}

/// Distance from every start to the zero set, and the unit gradient where it lands.
fn land(starts: &[DVec3], zeros: &ZeroSet, reach: f64, sampler: &Sampler<'_>) -> Result<Vec<(f64, DVec3)>, Canceled> {
    if sampler.field().metric() == Metric::Exact {
        // the gradient is the same all along the way to the closest point
        let (values, gradients) = sampler.gradients(starts)?;
        return Ok(values.iter().zip(&gradients).map(|(s, g)| (s.abs(), g.normalize_or_zero())).collect());
    }
    let traced = zero_set::trace(starts, reach, sampler)?;
    let nearby = Nearest::of_points(&zeros.points).closest_all(starts, sampler.settings())?;
    let ends: Vec<DVec3> = (0..starts.len())
        .map(|i| match traced[i] {
            Some(end) if end.distance_squared(starts[i]) <= nearby[i].distance_squared => end,
            _ => nearby[i].point,
        })
        .collect();
    let (_, gradients) = sampler.gradients(&ends)?;
    Ok((0..starts.len()).map(|i| (ends[i].distance(starts[i]), gradients[i].normalize_or_zero())).collect())
}

/// A truth mesh's positions.
pub fn mesh_vertices(mesh: &TriangleMesh) -> Vec<DVec3> {
    mesh.vertices.iter().map(|&p| DVec3::from(p)).collect()
}

/// Compares a surface with what it was made from: the field's own mesh where it has one, otherwise the field.
///
/// # Errors
/// When the token is raised.
pub fn to_truth(surface: &Surface, sampler: &Sampler<'_>) -> Result<Option<Comparison>, Canceled> {
    let vertices = positions(surface);
    Truth::of(sampler)?.compare(Mesh { vertices: &vertices, triangles: &surface.triangles })
}

#[cfg(test)]
mod tests {
    use super::super::fixtures::*;
    use super::*;
    use crate::field::Field;
    use crate::field::sampler::Tally;
    use glam::Vec3;

    /// Diagonal of the bounding box of the unit sphere.
    const UNIT: f64 = 2.0 * 1.732_050_807_568_877_2;

    #[test]
    fn concentric_spheres_are_apart_by_the_difference_of_their_radii() {
        let (inner, triangles) = sphere_mesh(120, 60, 0.9, DVec3::ZERO);
        let (outer, _) = sphere_mesh(120, 60, 1.0, DVec3::ZERO);
        let (a, b) =
            (Mesh { vertices: &inner, triangles: &triangles }, Mesh { vertices: &outer, triangles: &triangles });
        let c = with_settings(2, |s| between(a, b, 5000, s).unwrap().unwrap());
        for way in [c.closeness.distance.surface_to_truth, c.closeness.distance.truth_to_surface] {
            assert!((way.mean * UNIT - 0.1).abs() < 1e-3, "{c:?}");
            assert!((way.rms - way.mean).abs() < 1e-3);
        }
        assert!((c.closeness.distance.max * UNIT - 0.1).abs() < 1e-3);
        assert!(c.closeness.normal_consistency > 0.999 && c.closeness.normal_consistency_signed > 0.999);
    }

    #[test]
    fn a_surface_against_itself_is_at_distance_zero_whatever_the_samples() {
        let (vertices, triangles) = sphere_mesh(40, 20, 1.0, DVec3::ZERO);
        let mesh = Mesh { vertices: &vertices, triangles: &triangles };
        let c = with_settings(1, |s| between(mesh, mesh, 5000, s).unwrap().unwrap());
        assert!(c.closeness.distance.max < 1e-15, "{c:?}");
        assert!(c.closeness.normal_consistency > 0.9999);
    }

    #[test]
    fn an_inside_out_surface_is_seen_by_the_signed_normals_only() {
        let (vertices, triangles) = sphere_mesh(40, 20, 1.0, DVec3::ZERO);
        let turned: Vec<[u32; 3]> = triangles.iter().map(|&[a, b, c]| [a, c, b]).collect();
        let (a, b) =
            (Mesh { vertices: &vertices, triangles: &turned }, Mesh { vertices: &vertices, triangles: &triangles });
        let c = with_settings(1, |s| between(a, b, 1000, s).unwrap().unwrap());
        assert!(c.closeness.normal_consistency > 0.9999 && c.closeness.normal_consistency_signed < -0.9999);
    }

    #[test]
    fn a_triangle_that_stands_off_is_told_from_the_others() {
        let (mut vertices, triangles) = sphere_mesh(40, 20, 1.0, DVec3::ZERO);
        let truth = vertices.clone();
        let off = triangles[300];
        off.iter().for_each(|&v| vertices[v as usize] *= 1.1);
        let (a, b) =
            (Mesh { vertices: &vertices, triangles: &triangles }, Mesh { vertices: &truth, triangles: &triangles });
        // too few samples for every triangle to have one
        let c = with_settings(1, |s| between(a, b, 500, s).unwrap().unwrap());
        assert_eq!(c.by_triangle.len(), triangles.len());
        assert!((c.by_triangle[300] - 0.1).abs() < 5e-3, "{}", c.by_triangle[300]);
        let touches = |t: &[u32; 3]| t.iter().any(|v| off.contains(v));
        let far = triangles.iter().zip(&c.by_triangle).filter(|(t, _)| !touches(t)).map(|(_, d)| *d);
        assert!(far.clone().filter(|&d| d > 0.01).count() <= 12, "what is taken from neighbours stays beside them");
        assert!(far.fold(0.0, f32::max) < 0.1);
    }

    #[test]
    fn a_part_that_the_surface_misses_shows_in_one_direction() {
        let (vertices, triangles) = sphere_mesh(60, 30, 1.0, DVec3::ZERO);
        let (more, _) = sphere_mesh(60, 30, 0.1, DVec3::X * 2.0);
        let all: Vec<DVec3> = vertices.iter().chain(&more).copied().collect();
        let n = vertices.len() as u32;
        let both: Vec<[u32; 3]> = triangles.iter().copied().chain(triangles.iter().map(|t| t.map(|v| v + n))).collect();
        let (a, b) = (Mesh { vertices: &vertices, triangles: &triangles }, Mesh { vertices: &all, triangles: &both });
        let Comparison { closeness: Closeness { distance: c, .. }, worst_places: worst, .. } =
            with_settings(1, |s| between(a, b, 1000, s).unwrap().unwrap());
        assert!(c.surface_to_truth.max < 1e-15);
        let size = DVec3::new(3.1, 2.0, 2.0).length();
        assert!((c.truth_to_surface.max * size - 1.1).abs() < 1e-3, "{c:?}");
        assert!(worst[1].distance(2.1 * DVec3::X) < 0.05, "{worst:?}");
    }

    fn against_field(field: &dyn Field, radius: f64) -> Comparison {
        let (vertices, triangles) = sphere_mesh(120, 60, radius, DVec3::ZERO);
        let mesh = Mesh { vertices: &vertices, triangles: &triangles };
        with_settings(2, |s| to_field(mesh, 5000, &Sampler::new(field, *s, &Tally::new())).unwrap().unwrap())
    }

    #[test]
    fn distances_to_a_field_do_not_depend_on_what_its_values_mean() {
        for (slope, metric) in [(1.0, Metric::Exact), (200.0, Metric::Sign), (0.1, Metric::Bound)] {
            let field = Balls { slope, metric, ..Balls::one(0.5) };
            let size = 0.5 * UNIT;
            let c = against_field(&field, 0.52);
            for way in [c.closeness.distance.surface_to_truth, c.closeness.distance.truth_to_surface] {
                assert!((way.mean * size - 0.02).abs() < 5e-4, "{metric:?} {c:?}");
                assert!((way.max * size - 0.02).abs() < 5e-4, "{metric:?} {c:?}");
            }
            assert!(c.closeness.normal_consistency_signed > 0.999, "{c:?}");
            // too far to be traced: the grid's own points answer
            let c = against_field(&field, 0.7);
            assert!((c.closeness.distance.surface_to_truth.mean * size - 0.2).abs() < 1e-3, "{metric:?} {c:?}");
        }
    }

    #[test]
    fn a_floater_that_was_not_wrapped_counts() {
        let field = Balls { balls: vec![(Vec3::ZERO, 0.5), (Vec3::X * 0.9, 0.05)], slope: 1.0, metric: Metric::Bound };
        let c = against_field(&field, 0.5);
        let size = DVec3::new(1.45, 1.0, 1.0).length();
        assert!((c.closeness.distance.truth_to_surface.max * size - 0.45).abs() < 2e-3, "{c:?}");
        assert!(c.closeness.distance.surface_to_truth.max < 1e-3);
    }
}
