use super::*;
use crate::field::Metric;
use crate::field::sampler::Tally;
use crate::measure::fixtures::{Formula, with_settings};
use crate::shrink::lattice::LatticeSpec;

const THICK: f64 = 0.02;

/// A round plate of radius 1 and thickness [`THICK`] in the plane z = 0, far thinner than the lattice's edges.
fn plate(p: DVec3) -> (f64, DVec3) {
    let (ball, plate) = (p.length() - 1.0, p.z.abs() - 0.5 * THICK);
    if plate >= ball { (plate, DVec3::new(0.0, 0.0, p.z.signum())) } else { (ball, p.normalize_or(DVec3::X)) }
}

fn with_sampler<R>(threads: usize, work: impl FnOnce(&Sampler<'_>) -> R) -> R {
    let (field, tally) = (Formula { at: plate, metric: Metric::Bound }, Tally::new());
    with_settings(threads, |settings| work(&Sampler::new(&field, *settings, &tally)))
}

/// The upper and lower halves of a sphere lattice pressed onto the plate's two faces.
fn pressed(sampler: &Sampler<'_>) -> Wrap {
    let lattice = SphereLattice::new(LatticeSpec::Octahedral { n: 16 });
    let positions: Vec<DVec3> = lattice
        .directions
        .iter()
        .map(|d| {
            let flat = DVec3::new(d.x, d.y, 0.0);
            // equal areas: the disc's radius grows like the chord to the pole
            let radius = (1.0 - d.z.abs()).sqrt() * (1.0 - 1e-3);
            flat.normalize_or_zero() * radius + DVec3::Z * (0.5 * THICK).min(d.z.abs()).copysign(d.z)
        })
        .collect();
    let (values, gradients) = sampler.gradients(&positions).unwrap();
    let diagonals = vec![false; lattice.quads.len()];
    Wrap { lattice, positions, values, gradients, diagonals }
}

fn crossing(sampler: &Sampler<'_>, wrap: &Wrap) -> usize {
    let triangles = wrap.lattice.triangles(&wrap.diagonals);
    let all: Vec<u32> = (0..triangles.len() as u32).collect();
    crossings(&Index::new(&wrap.positions, &triangles), &wrap.positions, &triangles, &all, sampler.settings())
        .unwrap()
        .len()
}

#[test]
fn sheets_that_went_through_a_thin_wall_come_apart_and_stay_near_it() {
    let repaired = [1, 2].map(|threads| {
        with_sampler(threads, |sampler| {
            let mut wrap = pressed(sampler);
            assert_eq!(crossing(sampler, &wrap), 0);
            // three places of the upper sheet are pushed through the lower one, as a Newton step past the middle does
            let up: Vec<usize> = (0..wrap.positions.len())
                .filter(|&v| wrap.positions[v].z > 0.0 && wrap.positions[v].truncate().length() < 0.7)
                .step_by(97)
                .take(3)
                .collect();
            for v in up {
                wrap.positions[v].z = -1.3 * THICK;
            }
            assert!(crossing(sampler, &wrap) > 10);
            let left = separate(sampler, &mut wrap, &[], &[], 0).unwrap();
            assert_eq!(left, Faults::default());
            assert_eq!(crossing(sampler, &wrap), 0);
            let limit = OFF * 8f64.sqrt();
            assert!(wrap.values.iter().all(|s| s.abs() < limit));
            wrap
        })
    });
    assert_eq!(repaired[0].positions, repaired[1].positions, "one thread or two");
}

#[test]
fn a_fold_is_smoothed_out() {
    with_sampler(1, |sampler| {
        let mut wrap = pressed(sampler);
        let v = (0..wrap.positions.len()).find(|&v| wrap.positions[v].z > 0.0 && wrap.positions[v].x > 0.3).unwrap();
        wrap.positions[v].x += 0.2;
        let left = separate(sampler, &mut wrap, &[], &[], 0).unwrap();
        assert_eq!((left, crossing(sampler, &wrap)), (Faults::default(), 0));
    });
}
