//! `filmstrip`: the shrinking in six frames, from the sphere to the surface, with the checkerboard of its chart on all of them.
//!
//! A front that the contraction has made has no map onto the sphere yet: that is made once the contraction has ended. So its places are
//! found from the end: every vertex takes the place of the nearest point of the front after it. Such places are for looking at; nothing
//! is promised of them. The sphere is turned so that its places lie as near to those of the first front as they can.

use crate::measure::nearest::{Closest, Nearest};
use crate::settings::{Canceled, Front, Progress, Settings};
use crate::surface::Surface;
use crate::surface::preview::row;
use crate::surface::raster::{Model, Paint, smooth_normals};
use glam::{DMat3, DQuat, DVec3, DVec4, Vec3};
use std::sync::{Mutex, PoisonError};

/// Frames of a strip.
const FRAMES: usize = 6;
/// Side of a frame, pixels.
const SIDE: usize = 512;

/// Fronts of the attempt that is being made, as they are told.
#[derive(Default)]
pub struct Film(Mutex<(u32, Vec<Front>)>);

impl Film {
    /// Keeps the front that a progress tells of, if it tells of one.
    pub fn see(&self, progress: &Progress) {
        let Some(front) = &progress.front else { return };
        let mut seen = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        if seen.0 != progress.attempt {
            *seen = (progress.attempt, Vec::new());
        }
        if !front.triangles.is_empty() && front.positions.iter().flatten().all(|c| c.is_finite()) {
            seen.1.push(front.clone());
        }
    }

    /// The strip as a PNG, with the surface at its end.
    ///
    /// # Errors
    /// When the token is raised.
    pub fn to_png(&self, surface: &Surface, settings: &Settings<'_>) -> Result<Vec<u8>, Canceled> {
        let mut fronts = self.0.lock().unwrap_or_else(PoisonError::into_inner).1.clone();
        let directions: Vec<DVec3> = surface.lattice.directions.clone();
        fronts.push(Front {
            positions: surface.positions.clone(),
            triangles: surface.triangles.clone(),
            places: directions.iter().map(|d| d.as_vec3().to_array()).collect(),
        });
        for i in (0..fronts.len() - 1).rev() {
            if fronts[i].places.is_empty() {
                fronts[i].places = places_from(&fronts[i + 1], &fronts[i], settings)?;
            }
        }
        let ball = ball_around(&fronts, surface);
        let camera_for = with_margin(&ball);
        fronts.insert(0, ball);
        let chosen = evenly(&fronts.iter().map(size).collect::<Vec<_>>());
        let drawn: Vec<Drawn> = chosen.into_iter().map(|i| Drawn::new(&fronts[i])).collect();
        let spec = surface.lattice.spec;
        let models: Vec<Model<'_>> = drawn
            .iter()
            .map(|front| Model {
                positions: &front.positions,
                normals: &front.normals,
                triangles: &front.triangles,
                paint: Paint::Places(&front.places, spec),
            })
            .collect();
        row(&models, &camera_for, SIDE, settings)
    }
}

/// A front in the form in which it is drawn.
struct Drawn {
    positions: Vec<Vec3>,
    normals: Vec<Vec3>,
    triangles: Vec<[u32; 3]>,
    places: Vec<Vec3>,
}

impl Drawn {
    fn new(front: &Front) -> Self {
        let positions: Vec<Vec3> = front.positions.iter().map(|&p| Vec3::from(p)).collect();
        let normals = smooth_normals(&positions, &front.triangles);
        let places = front.places.iter().map(|&p| Vec3::from(p)).collect();
        Self { positions, normals, triangles: front.triangles.clone(), places }
    }
}

fn wide(list: &[[f32; 3]]) -> Vec<DVec3> {
    list.iter().map(|&p| Vec3::from(p).as_dvec3()).collect()
}

/// The places of the points of `known` that are nearest to the vertices of `front`.
fn places_from(known: &Front, front: &Front, settings: &Settings<'_>) -> Result<Vec<[f32; 3]>, Canceled> {
    let (positions, places) = (wide(&known.positions), wide(&known.places));
    let nearest = Nearest::new(&positions, &known.triangles).closest_all(&wide(&front.positions), settings)?;
    let place = |hit: &Closest| {
        let triangle = known.triangles[hit.triangle as usize];
        let [a, b, c] = triangle.map(|v| positions[v as usize]);
        let normal = (b - a).cross(c - a);
        let share = |p: DVec3, q: DVec3| (p - hit.point).cross(q - hit.point).dot(normal).max(0.0);
        let weights = DVec3::new(share(b, c), share(c, a), share(a, b));
        // a triangle without area has its first corner's
        let weights = if weights.element_sum() > 0.0 { weights.to_array() } else { [1.0, 0.0, 0.0] };
        let mean: DVec3 = (0..3).map(|k| weights[k] * places[triangle[k] as usize]).sum();
        mean.normalize_or(DVec3::Z).as_vec3().to_array()
    };
    Ok(nearest.iter().map(place).collect())
}

/// What the camera looks at: the largest front, and room for its shadow.
fn with_margin(largest: &Front) -> Vec<Vec3> {
    const ROOM: f32 = 1.15;
    let positions = largest.positions.iter().map(|&p| Vec3::from(p));
    let center = positions.clone().sum::<Vec3>() / largest.positions.len().max(1) as f32;
    positions.map(|p| center + ROOM * (p - center)).collect()
}

/// The sphere around all fronts, on the lattice.
fn ball_around(fronts: &[Front], surface: &Surface) -> Front {
    let first = wide(&fronts[0].positions);
    let (low, high) = first.iter().fold((DVec3::INFINITY, DVec3::NEG_INFINITY), |(l, h), &p| (l.min(p), h.max(p)));
    let center = 0.5 * (low + high);
    let all = fronts.iter().flat_map(|front| &front.positions).map(|&p| Vec3::from(p).as_dvec3().distance(center));
    let radius = all.fold(0.0, f64::max);
    let turn = turned(first.iter().map(|&p| (p - center).normalize_or_zero()).zip(wide(&fronts[0].places)));
    let directions = &surface.lattice.directions;
    Front {
        positions: directions.iter().map(|&d| (center + radius * (turn * d)).as_vec3().to_array()).collect(),
        triangles: surface.triangles.clone(),
        places: directions.iter().map(|d| d.as_vec3().to_array()).collect(),
    }
}

/// The rotation that takes the second of every pair as near to the first as one rotation can (Horn 1987, "Closed-form solution of
/// absolute orientation using unit quaternions"): the quaternion of the largest eigenvalue, by power iteration.
fn turned(pairs: impl Iterator<Item = (DVec3, DVec3)>) -> DQuat {
    /// The eigenvalue's multiple is found to the accuracy of a picture well before.
    const ROUNDS: usize = 200;
    let (mut sum, mut count) = (DMat3::ZERO, 0.0);
    for (to, from) in pairs {
        sum += DMat3::from_cols(from.x * to, from.y * to, from.z * to);
        count += 1.0;
    }
    // sum has entry (row, column) = to_row from_column
    let s = |row: usize, column: usize| sum.col(column)[row];
    let off = DVec3::new(s(2, 1) - s(1, 2), s(0, 2) - s(2, 0), s(1, 0) - s(0, 1));
    let trace = s(0, 0) + s(1, 1) + s(2, 2);
    let apply = |q: DVec4| {
        let v = DVec3::new(q.x, q.y, q.z);
        let symmetric = sum * v + sum.transpose() * v - trace * v;
        (symmetric + q.w * off).extend(q.w * trace + off.dot(v))
    };
    let mut q = DVec4::new(0.1, 0.2, 0.3, 1.0).normalize();
    for _ in 0..ROUNDS {
        // shifted, so that the largest eigenvalue is the largest by its amount
        q = (apply(q) + 3.0 * count * q).normalize_or(DVec4::W);
    }
    DQuat::from_xyzw(q.x, q.y, q.z, q.w)
}

/// The side of a cube of the volume that a front encloses.
fn size(front: &Front) -> f64 {
    let positions = wide(&front.positions);
    let volume: f64 = front
        .triangles
        .iter()
        .map(|t| {
            let [a, b, c] = t.map(|v| positions[v as usize]);
            a.dot(b.cross(c)) / 6.0
        })
        .sum();
    volume.max(0.0).cbrt()
}

/// Which of a sequence of sizes to show: the first, the last, and between them those whose sizes are the nearest to even steps.
fn evenly(sizes: &[f64]) -> Vec<usize> {
    let (last, frames) = (sizes.len() - 1, FRAMES.min(sizes.len()));
    let mut chosen = vec![0];
    for k in 1..frames - 1 {
        let wanted = sizes[0] + (sizes[last] - sizes[0]) * k as f64 / (frames - 1) as f64;
        let off = |&i: &usize| (sizes[i] - wanted).abs();
        // one is left for every frame that follows
        let range = chosen[k - 1] + 1..=last - (frames - 1 - k);
        chosen.extend(range.min_by(|a, b| off(a).total_cmp(&off(b))));
    }
    chosen.push(last);
    chosen
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_are_even_steps_from_the_first_to_the_last() {
        let sizes = [10.0, 9.9, 8.0, 6.1, 5.9, 4.0, 2.2, 2.1, 2.0, 0.0];
        assert_eq!(evenly(&sizes), [0, 2, 3, 5, 8, 9]);
        // all at the end, and fewer than there is room for
        assert_eq!(evenly(&[10.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0]).len(), 6);
        assert_eq!(evenly(&[3.0, 2.0, 1.0]), [0, 1, 2]);
        assert_eq!(evenly(&[3.0, 1.0]), [0, 1]);
    }

    #[test]
    fn a_turn_is_found_again() {
        let turn = DQuat::from_axis_angle(DVec3::new(1.0, 2.0, -0.5).normalize(), 2.4);
        let points =
            (0..50).map(|i| DVec3::new((1.3 * f64::from(i)).sin(), (0.7 * f64::from(i)).cos(), 0.3).normalize());
        let found = turned(points.map(|p| (turn * p, p)));
        assert!(found.angle_between(turn).min(found.angle_between(-turn)) < 1e-6, "{found} {turn}");
    }

    #[test]
    fn a_vertex_takes_the_place_of_the_nearest_point() {
        let known = Front {
            positions: vec![[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]],
            triangles: vec![[0, 1, 2]],
            places: vec![[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
        };
        let front = Front { positions: vec![[0.5, 0.0, 3.0], [0.0, 1.0, -1.0]], ..Front::default() };
        let places = crate::measure::fixtures::with_settings(1, |s| places_from(&known, &front, s).unwrap());
        let half = std::f32::consts::FRAC_1_SQRT_2;
        for (found, expected) in places.iter().zip([[half, half, 0.0], [0.0, 0.0, 1.0]]) {
            assert!(Vec3::from(*found).distance(Vec3::from(expected)) < 1e-6, "{found:?} {expected:?}");
        }
    }
}
