//! Warm starts: a lattice that lies on one zero level set is taken to another one nearby, such as that of the same network
//! with a latent code close by.
//!
//! Every vertex keeps its place on the sphere and every quad its diagonal, so the texture coordinates stay what they are, inside
//! triangles too, and surfaces that were made one from the other are morph targets of one mesh. Vertices go straight to the
//! new zero level set; what that folds, lifts off the surface or lets cross is repaired by the stages that repair a cold start,
//! where it is.
//!
//! Not guaranteed: that the result is any good. A part that is new, or that moved farther than vertices reach, is missed, and
//! only a certificate tells.

use super::Wrap;
use super::creases::snap;
use super::lattice::SphereLattice;
use super::separate::separate;
use super::slide::slide;
use super::unfold::Corners;
use super::untangle::{Tangle, normal};
use super::zero::project;
use crate::field::{Frame, Sampler};
use crate::settings::{Canceled, Front, Progress};
use glam::DVec3;

/// Farthest that a step towards the new zero level set goes, in edges of the lattice. Steps follow each other, and none is
/// taken that does not bring the value down.
const REACH: f64 = 8.0;
/// A surface of which one in so many triangles is turned away from the normals of its corners moved too far to be untangled, ...
const TURNED: usize = 4;
/// ... and one of which one in so many is folded when that has ended is past repair.
const FOLDED: usize = 20;

/// A surface that was made before: where a warm start begins.
#[derive(Clone, Debug, PartialEq)]
pub struct Earlier {
    /// Its lattice.
    pub lattice: SphereLattice,
    /// Position of every lattice vertex, in scene units.
    pub positions: Vec<DVec3>,
    /// Outward unit normal at every lattice vertex.
    pub normals: Vec<DVec3>,
    /// For every quad of the lattice, whether its other diagonal is taken.
    pub diagonals: Vec<bool>,
}

/// Takes an earlier surface to the zero level set of the sampler's field. `None` when too much of it folds.
///
/// # Errors
/// When the token is raised.
pub fn warm(scene: &Sampler<'_>, earlier: &Earlier) -> Result<Option<Wrap>, Canceled> {
    // no quad is free to turn
    let lattice = SphereLattice { free: vec![false; earlier.lattice.quads.len()], ..earlier.lattice.clone() };
    let triangles = lattice.triangles(&earlier.diagonals);
    let directions: Vec<[f32; 3]> = lattice.directions.iter().map(|d| d.as_vec3().to_array()).collect();
    let frame = frame_of(&earlier.positions);
    let stage = |name: &'static str, done: f32, front: Option<&[DVec3]>, flips: Option<u64>| {
        scene.tally().stage(name);
        let show = |places: &[DVec3]| Front {
            positions: places.iter().map(|&p| frame.to_scene(p).as_vec3().to_array()).collect(),
            triangles: triangles.clone(),
            places: directions.clone(),
        };
        let front = front.map(show);
        (scene.settings().progress)(Progress { stage: name, fraction: done, front, flips, ..Progress::default() });
    };
    let sampler = scene.framed(frame);
    let started: Vec<DVec3> = earlier.positions.iter().map(|&p| frame.from_scene(p)).collect();
    stage("warm", 0.0, Some(&started), None);
    let area: f64 = triangles.iter().map(|&t| 0.5 * normal(&started, t).length()).sum();
    if !(area > 0.0 && area.is_finite()) {
        return Ok(None);
    }
    let edge = (area / started.len() as f64).sqrt();
    let mut at = project(&sampler, started.clone(), &earlier.normals, REACH * edge, 1e-3 * edge)?;
    let outward = |t: &[u32; 3]| normal(&at.positions, *t).dot(t.iter().map(|&v| at.gradients[v as usize]).sum()) > 0.0;
    if TURNED * triangles.iter().filter(|t| !outward(t)).count() > triangles.len() {
        return Ok(None);
    }
    stage("untangle", 0.3, Some(&at.positions), None);
    let folds = Tangle::new(&sampler, &triangles, &at.positions).relax_patches(&mut at, &started, 2)?;
    if FOLDED * folds > triangles.len() || !at.positions.iter().all(|p| p.is_finite()) {
        return Ok(None);
    }
    stage("slide", 0.6, Some(&at.positions), Some(folds as u64));
    slide(&sampler, &lattice, &triangles, &mut at, edge)?;
    stage("sharpen", 0.8, Some(&at.positions), None);
    let blunt = at.positions.clone();
    snap(&sampler, &triangles, &Corners::new(at.positions.len(), &triangles), &mut at)?;
    stage("separate", 0.9, Some(&at.positions), None);
    let to_scene = |list: &[DVec3]| -> Vec<DVec3> { list.iter().map(|&p| frame.to_scene(p)).collect() };
    let mut wrap = Wrap {
        lattice,
        positions: to_scene(&at.positions),
        values: at.values.iter().map(|s| s * frame.scale).collect(),
        gradients: at.gradients,
        diagonals: earlier.diagonals.clone(),
    };
    let left = separate(scene, &mut wrap, &[&to_scene(&blunt)], &[], 0)?;
    stage("separate", 1.0, None, Some(left.folds as u64));
    Ok(Some(wrap))
}

/// The frame of unit size that holds the positions.
fn frame_of(positions: &[DVec3]) -> Frame {
    let (lo, hi) = positions.iter().fold((DVec3::INFINITY, DVec3::NEG_INFINITY), |(lo, hi), &p| (lo.min(p), hi.max(p)));
    let size = (hi - lo).max_element();
    Frame { center: 0.5 * (lo + hi), scale: if size > 0.0 { 0.5 * size } else { 1.0 } }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::field::Field;
    use crate::field::sampler::Tally;
    use crate::field::scene::Scene;
    use crate::measure::fixtures::{sphere_surface, with_settings};
    use crate::shrink::lattice::LatticeSpec;
    use serde_json::json;

    const LATTICE: LatticeSpec = LatticeSpec::Latlong { n_theta: 48, n_phi: 24 };

    fn scene(value: &serde_json::Value) -> Scene {
        Scene::from_value(value).expect("a scene")
    }

    fn warmed(field: &dyn Field, earlier: &Earlier, threads: usize) -> (Option<Wrap>, u64) {
        with_settings(threads, |settings| {
            let tally = Tally::new();
            let wrap = warm(&Sampler::new(field, *settings, &tally), earlier).expect("not canceled");
            (wrap, tally.total().total())
        })
    }

    /// A ball of radius 0.5 with some diagonals turned.
    fn ball() -> Earlier {
        let mut earlier = sphere_surface(LATTICE, 0.5).earlier();
        earlier.diagonals.iter_mut().step_by(5).for_each(|other| *other = true);
        earlier
    }

    #[test]
    fn a_ball_becomes_a_larger_one_straight_ahead_for_two_evaluations_a_vertex() {
        let earlier = ball();
        let field = scene(&json!({"sphere": {"radius": 0.55}}));
        let (wrap, spent) = warmed(&field, &earlier, 1);
        let wrap = wrap.expect("a surface");
        for (p, d) in wrap.positions.iter().zip(&earlier.lattice.directions) {
            assert!(p.distance(0.55 * d) < 1e-6, "{p} {d}");
        }
        assert_eq!(wrap.diagonals, earlier.diagonals, "triangles stay");
        assert!(spent <= 2 * earlier.positions.len() as u64, "{spent}");
    }

    #[test]
    fn an_ellipsoid_that_is_far_from_the_ball_is_met_without_a_fold_and_the_same_for_any_number_of_threads() {
        let earlier = ball();
        let field = scene(&json!({"translate": {"by": [0.1, 0, 0], "of": {"ellipsoid": {"radii": [0.8, 0.45, 0.4]}}}}));
        let wrap = warmed(&field, &earlier, 1).0.expect("a surface");
        let on = |p: &DVec3| {
            let q = (*p - DVec3::new(0.1, 0.0, 0.0)) / DVec3::new(0.8, 0.45, 0.4);
            (q.length() - 1.0).abs() < 1e-4
        };
        assert!(wrap.positions.iter().all(on));
        for t in wrap.lattice.triangles(&wrap.diagonals) {
            let gradients = t.iter().map(|&v| wrap.gradients[v as usize]).sum::<DVec3>();
            assert!(normal(&wrap.positions, t).dot(gradients) > 0.0, "{t:?} is folded");
        }
        let other = warmed(&field, &earlier, 3).0.expect("a surface");
        assert_eq!((other.positions, other.diagonals), (wrap.positions, wrap.diagonals));
    }

    #[test]
    fn a_surface_without_any_shape_is_past_repair() {
        let field = scene(&json!({"sphere": {"radius": 0.5}}));
        let sound = ball();
        let nothing = Earlier { positions: vec![DVec3::ZERO; sound.positions.len()], ..sound.clone() };
        // the high bits of a product with the golden ratio's: neighbours end anywhere
        let shuffled = |i: usize| {
            let bits = (i as u64 + 1).wrapping_mul(0x9e37_79b9_7f4a_7c15);
            sound.positions[((bits ^ (bits << 21)) >> 20) as usize % sound.positions.len()]
        };
        let tangled = Earlier { positions: (0..sound.positions.len()).map(shuffled).collect(), ..sound.clone() };
        for (name, earlier) in [("nothing", nothing), ("tangled", tangled)] {
            assert!(warmed(&field, &earlier, 1).0.is_none(), "{name}");
        }
    }
}
