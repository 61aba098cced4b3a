//! How far the vertices of a surface are from where they were on an earlier one of the same lattice, and how much of that is
//! drift: way along the surface, which texture coordinates go and the shape does not ask for.

use super::certificate::positions;
use super::nearest::Nearest;
use super::{corners, diagonal, doubled_normal, map_chunks};
use crate::settings::{Canceled, Settings};
use crate::surface::Surface;
use glam::{DVec3, Vec3};

/// Lengths over the vertices of a surface, in parts of the diagonal of its bounding box; means are by area.
#[derive(Clone, Copy, Debug, Default, PartialEq, serde::Serialize, serde::Deserialize, utoipa::ToSchema)]
pub struct Lengths {
    /// Mean.
    pub mean: f64,
    /// Root mean square.
    pub rms: f64,
    /// Largest.
    pub max: f64,
}

/// How far vertices are from where they were.
#[derive(Clone, Copy, Debug, Default, PartialEq, serde::Serialize, serde::Deserialize, utoipa::ToSchema)]
pub struct Moved {
    /// From where a vertex was to where it is.
    pub moved: Lengths,
    /// From the place of the surface that is straight ahead of where a vertex was, where the surface's normal leads to it, to
    /// where it is: 0 for a vertex that moved along that normal.
    pub drift: Lengths,
}

/// Compares a surface with the `earlier` positions of its vertices, scene units.
///
/// # Errors
/// When the token is raised.
///
/// # Panics
/// When there are not as many positions as vertices.
pub fn moved(earlier: &[DVec3], surface: &Surface, settings: &Settings<'_>) -> Result<Moved, Canceled> {
    let now = positions(surface);
    assert_eq!(earlier.len(), now.len(), "a position for every vertex");
    let size = diagonal(&now);
    if size <= 0.0 {
        return Ok(Moved::default());
    }
    let facets = Facets { nearest: Nearest::new(&now, &surface.triangles), positions: &now, surface };
    let ways = map_chunks(earlier, settings, |v, &before| {
        let ahead = facets.ahead(before).unwrap_or(now[v]);
        [before.distance(now[v]) / size, ahead.distance(now[v]) / size]
    })?;
    // every corner has a third of its triangle's area, a factor that all share
    let mut areas = vec![0.0; now.len()];
    for &t in &surface.triangles {
        let area = doubled_normal(corners(&now, t)).length();
        t.iter().for_each(|&v| areas[v as usize] += area);
    }
    let total: f64 = areas.iter().sum();
    let lengths = |which: usize| {
        let mean = |power: i32| ways.iter().zip(&areas).map(|(w, a)| w[which].powi(power) * a).sum::<f64>() / total;
        Lengths { mean: mean(1), rms: mean(2).sqrt(), max: ways.iter().map(|w| w[which]).fold(0.0, f64::max) }
    };
    Ok(Moved { moved: lengths(0), drift: lengths(1) })
}

/// A surface, smooth between its vertices as their normals say.
struct Facets<'s> {
    nearest: Nearest,
    positions: &'s [DVec3],
    surface: &'s Surface,
}

impl Facets<'_> {
    /// The place of the surface that is straight ahead of `p`: from there the normal leads to `p`. The place of the facets that is
    /// nearest is off by the distance times the tilt of a facet; stepping along the surface by what the interpolated normal
    /// misses `p` by takes that away, as long as it misses by less each time.
    fn ahead(&self, p: DVec3) -> Option<DVec3> {
        /// Each step leaves the distance times the curvature of what was left; more are not worth it.
        const STEPS: usize = 4;
        let (mut best, mut beside) = self.at(p, p)?;
        for _ in 0..STEPS {
            let (place, left) = self.at(best + beside, p)?;
            if left.length_squared() >= beside.length_squared() {
                break;
            }
            (best, beside) = (place, left);
        }
        Some(best)
    }

    /// The place of the facets nearest to `near`, and by what its normal misses `p`.
    fn at(&self, near: DVec3, p: DVec3) -> Option<(DVec3, DVec3)> {
        let closest = self.nearest.closest(near)?;
        let t = self.surface.triangles[closest.triangle as usize];
        let [a, b, c] = corners(self.positions, t);
        let place = closest.point;
        let weights = [[b, c], [c, a], [a, b]].map(|[u, v]| doubled_normal([place, u, v]).length());
        let normal = |v: u32| Vec3::from(self.surface.normals[v as usize]).as_dvec3();
        let normal = (0..3).map(|k| weights[k] * normal(t[k])).sum::<DVec3>().normalize_or_zero();
        Some((place, p - place - normal * normal.dot(p - place)))
    }
}

#[cfg(test)]
mod tests {
    use super::super::fixtures::{sphere_surface, with_settings};
    use super::*;
    use crate::shrink::lattice::LatticeSpec;

    #[test]
    fn a_ball_that_grows_moves_and_does_not_drift_and_one_that_turns_drifts() {
        let spec = LatticeSpec::Octahedral { n: 40 };
        let surface = sphere_surface(spec, 0.5);
        let size = 3f64.sqrt();
        let directions = &surface.lattice.directions;
        with_settings(2, |settings| {
            let small: Vec<DVec3> = directions.iter().map(|&d| 0.4 * d).collect();
            let grown = moved(&small, &surface, settings).unwrap();
            assert!((grown.moved.mean * size - 0.1).abs() < 1e-3 && (grown.moved.max * size - 0.1).abs() < 1e-3);
            assert!(grown.drift.max * size < 2e-4, "{grown:?}");
            let turn = glam::DQuat::from_rotation_z(0.2);
            let turned: Vec<DVec3> = directions.iter().map(|&d| turn * (0.5 * d)).collect();
            let drifted = moved(&turned, &surface, settings).unwrap().drift;
            // the chord of the turn at the equator; on average over the sphere pi/4 of it
            let chord = 2.0 * 0.5 * (0.1f64).sin();
            assert!((drifted.max * size - chord).abs() < 1e-3, "{drifted:?}");
            assert!((drifted.mean * size - chord * std::f64::consts::FRAC_PI_4).abs() < 1e-3, "{drifted:?}");
            assert!((drifted.rms * size - chord * (2f64 / 3.0).sqrt()).abs() < 1e-3, "{drifted:?}");
        });
    }
}
