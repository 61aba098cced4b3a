//! Claims about curves: closed, simple, on the zero set, through the corners; and clear refusals.

use super::*;
use crate::field::{Domain, Field, Gradients, Metric, Points, sampler::Tally, scene::Scene};
use crate::settings::{CancelToken, Canceled, Settings};
use serde_json::{Value, json};

fn shrunk(field: &dyn Field, spec: &CurveSpec, threads: usize) -> Result<Curve, ShrinkError> {
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
    let (cancel, tally) = (CancelToken::new(), Tally::new());
    let settings = Settings { pool: &pool, cancel: &cancel, progress: &|_| {} };
    shrink_curve(&Sampler::new(field, settings, &tally), spec)
}

fn adaptive_curve(scene: &Value, samples: u32) -> Result<Curve, ShrinkError> {
    let scene = Scene::from_value(scene).unwrap();
    shrunk(&scene, &CurveSpec { method: Method::Adaptive, samples }, 1)
}

fn example(name: &str) -> Scene {
    let path = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join(format!("examples/scenes/2d/{name}.json"));
    Scene::from_slice(&std::fs::read(path).unwrap()).unwrap()
}

fn disc(radius: f64, at: [f64; 2]) -> Value {
    json!({"translate": {"by": at, "of": {"circle": {"radius": radius}}}})
}

#[test]
fn every_planar_example_becomes_a_closed_simple_curve_on_its_zero_set() {
    for name in ["blend", "disc", "gear", "letter_g", "letter_s", "plate"] {
        let curve = shrunk(&example(name), &CurveSpec::default(), 2).unwrap();
        let report = curve.report;
        assert!(report.closed && report.simple, "{name}: {report:?}");
        // a chord of length l leaves an arc of radius r by l^2/8r: 400 chords, roundings of 0.025 or more, a diagonal of 2
        assert!(report.to_zero_set.max.max(report.from_zero_set.max) < 6e-4, "{name}: {report:?}");
        assert!(report.to_zero_set.mean < 1e-4 && report.from_zero_set.mean < 1e-4, "{name}: {report:?}");
        assert_eq!(curve.positions.len(), 400);
        assert_eq!(curve.parameters[0], 0.0);
        assert!(curve.parameters.windows(2).all(|w| w[0] < w[1]) && curve.parameters[399] < 1.0, "{name}");
        assert!(curve.normals.iter().all(|n| (n[0].hypot(n[1]) - 1.0).abs() < 1e-6), "{name}");
    }
}

#[test]
fn the_samples_of_a_disc_are_on_its_circle_and_even() {
    let curve = adaptive_curve(&disc(0.5, [0.2, -0.1]), 100).unwrap();
    for (i, p) in curve.positions.iter().enumerate() {
        let angle = (p[1] + 0.1).atan2(p[0] - 0.2).rem_euclid(std::f64::consts::TAU) / std::f64::consts::TAU;
        assert!(((p[0] - 0.2).hypot(p[1] + 0.1) - 0.5).abs() < 1e-6);
        let turned = (angle - curve.parameters[i]).rem_euclid(1.0);
        assert!(turned.min(1.0 - turned) < 2e-3, "sample {i} is at {angle} of the circle");
        assert!((curve.parameters[i] - i as f64 / 100.0).abs() < 1e-12);
    }
}

#[test]
fn every_corner_of_a_polygon_is_a_sample() {
    let corners = [[-0.7, -0.6], [0.8, -0.5], [0.75, 0.1], [0.2, 0.0], [0.3, 0.7], [-0.1, 0.15], [-0.6, 0.6]];
    let curve = adaptive_curve(&json!({"polygon": {"points": corners}}), 64).unwrap();
    assert_eq!(curve.report.corners, 7);
    assert_eq!(curve.positions.len(), 64);
    for corner in corners {
        let near = |p: &[f64; 2]| (p[0] - corner[0]).hypot(p[1] - corner[1]);
        let (i, _) = curve.positions.iter().enumerate().min_by(|a, b| near(a.1).total_cmp(&near(b.1))).unwrap();
        assert!(curve.corners[i] && near(&curve.positions[i]) < 1e-6, "{corner:?}: {:?}", curve.positions[i]);
    }
    assert!(curve.report.from_zero_set.max < 1e-6, "{:?}", curve.report);
}

#[test]
fn a_rounding_is_no_corner() {
    let rounded = json!({"round": {"radius": 0.1, "of": {"rectangle": {"half_extents": [0.5, 0.3]}}}});
    assert_eq!(adaptive_curve(&rounded, 200).unwrap().report.corners, 0);
}

#[test]
fn a_zero_set_that_is_not_one_loop_is_refused_with_its_places() {
    let two = json!({"union": {"of": [disc(0.3, [-0.5, 0.0]), disc(0.2, [0.5, 0.0])]}});
    let Err(ShrinkError::Components { count: 2, places }) = adaptive_curve(&two, 100) else { panic!() };
    assert!((places[0][0] + 0.5).hypot(places[0][1]) < 0.3 && (places[1][0] - 0.5).hypot(places[1][1]) < 0.2);
    let ring = json!({"shell": {"thickness": 0.1, "of": {"circle": {"radius": 0.5}}}});
    assert!(matches!(adaptive_curve(&ring, 100), Err(ShrinkError::Genus { genus: 1, .. })));
    let none = json!({"intersection": {"of": [disc(0.3, [-0.5, 0.0]), disc(0.2, [0.5, 0.0])]}});
    let Err(ShrinkError::Empty { min, max }) = adaptive_curve(&none, 100) else { panic!() };
    assert!(min > 0.0 && max > min);
    let ball = json!({"sphere": {"radius": 0.5}});
    assert_eq!(adaptive_curve(&ball, 100), Err(ShrinkError::Dimension { found: 3, wanted: 2 }));
}

#[test]
fn a_shape_smaller_than_a_cell_of_the_first_lattice_is_found() {
    let curve = adaptive_curve(&disc(0.012, [0.331, 0.207]), 60).unwrap();
    assert!(curve.report.simple && (curve.report.length - std::f64::consts::TAU * 0.012).abs() < 1e-4);
}

#[test]
fn a_gap_of_a_few_cells_of_the_last_lattice_stays_open() {
    // a slit 0.02 wide and 1 deep
    let slit = json!({"difference": {"of": [
        {"rectangle": {"half_extents": [0.6, 0.6]}},
        {"translate": {"by": [0.0, 0.1], "of": {"rectangle": {"half_extents": [0.01, 0.5]}}}},
        {"translate": {"by": [0.0, 0.6], "of": {"rectangle": {"half_extents": [0.01, 0.2]}}}}
    ]}});
    let curve = adaptive_curve(&slit, 300).unwrap();
    assert!(curve.report.simple && curve.report.corners == 8, "{:?}", curve.report);
    // the square's 4.8, and the two walls of the slit; its floor is what its mouth takes away
    assert!((curve.report.length - 6.8).abs() < 1e-5, "{}", curve.report.length);
}

#[test]
fn the_paper_reaches_a_disc_and_never_the_inside_of_a_letter() {
    let spec = CurveSpec { method: Method::Paper, samples: 400 };
    let round = shrunk(&example("disc"), &spec, 1).unwrap();
    assert!(round.report.simple && round.report.from_zero_set.max < 1e-4);
    let letter = shrunk(&example("letter_s"), &spec, 1).unwrap();
    let adaptive = shrunk(&example("letter_s"), &CurveSpec::default(), 1).unwrap();
    assert!(letter.report.from_zero_set.max > 100.0 * adaptive.report.from_zero_set.max, "{:?}", letter.report);
}

#[test]
fn any_number_of_threads_gives_the_same_curve() {
    for method in [Method::Adaptive, Method::Paper] {
        let spec = CurveSpec { method, samples: 700 };
        assert_eq!(shrunk(&example("letter_g"), &spec, 1), shrunk(&example("letter_g"), &spec, 5));
    }
}

#[test]
fn a_raised_token_ends_the_run() {
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
    let (cancel, tally) = (CancelToken::new(), Tally::new());
    cancel.cancel();
    let settings = Settings { pool: &pool, cancel: &cancel, progress: &|_| {} };
    let scene = example("disc");
    let found = shrink_curve(&Sampler::new(&scene, settings, &tally), &CurveSpec::default());
    assert_eq!(found, Err(ShrinkError::Canceled(Canceled)));
}

#[test]
fn numbers_of_samples_out_of_range_are_taken_to_the_nearest() {
    assert_eq!(adaptive_curve(&disc(0.5, [0.0, 0.0]), 0).unwrap().positions.len(), 8);
    assert_eq!(adaptive_curve(&disc(0.5, [0.0, 0.0]), 20_000).unwrap().positions.len(), 10_000);
}

/// A superellipse whose values are nothing like distances, in a domain that is neither square nor about the origin.
struct Steep;

impl Steep {
    fn at(x: f32, y: f32) -> (f32, [f32; 2]) {
        let (u, v) = ((x - 5.0) / 2.0, (y - 1.0) / 0.5);
        (900.0 * (u.powi(4) + v.powi(4) - 0.5), [900.0 * 4.0 * u.powi(3) / 2.0, 900.0 * 4.0 * v.powi(3) / 0.5])
    }
}

impl Field for Steep {
    fn domain(&self) -> Domain {
        Domain { min: [3.0, 0.4, -1.0], max: [7.0, 1.6, 1.0] }
    }
    fn metric(&self) -> Metric {
        Metric::Sign
    }
    fn lipschitz(&self) -> Option<f32> {
        None
    }
    fn dimension(&self) -> u8 {
        2
    }
    fn values(&self, points: Points<'_>, values: &mut [f32]) {
        for (i, v) in values.iter_mut().enumerate() {
            *v = Self::at(points.x[i], points.y[i]).0;
        }
    }
    fn gradients(&self, points: Points<'_>, values: &mut [f32], gradients: Gradients<'_>) {
        for (i, v) in values.iter_mut().enumerate() {
            let (value, [x, y]) = Self::at(points.x[i], points.y[i]);
            *v = value;
            (gradients.x[i], gradients.y[i], gradients.z[i]) = (x, y, 0.0);
        }
    }
}

#[test]
fn values_that_are_no_distances_do_no_harm() {
    let curve = shrunk(&Steep, &CurveSpec::default(), 1).unwrap();
    assert!(curve.report.closed && curve.report.simple && curve.report.corners == 0, "{:?}", curve.report);
    for p in &curve.positions {
        let (u, v) = ((p[0] - 5.0) / 2.0, (p[1] - 1.0) / 0.5);
        assert!((u.powi(4) + v.powi(4) - 0.5).abs() < 1e-4, "{p:?}");
    }
}
