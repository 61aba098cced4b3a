//! Claims about curves: closed, simple, on the zero set, through the corners; and clear refusals.

use super::*;
use crate::field::{Domain, Field, Gradients, Metric, Points, sampler::Tally, scene::Scene};
use crate::measure::curve::{CurveReport, measure};
use crate::settings::{CancelToken, Canceled, Settings};
use serde_json::{Value, json};
use std::f64::consts::TAU;

/// The first attempt at a curve, and what the certificate says.
fn shrunk(field: &dyn Field, spec: &CurveSpec, threads: usize) -> Result<(Curve, CurveReport), ShrinkError> {
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
    let (cancel, tally) = (CancelToken::new(), Tally::new());
    let settings = Settings { pool: &pool, cancel: &cancel, progress: &|_| {}, watched: false };
    let sampler = Sampler::new(field, settings, &tally);
    let curve = shrink_curve(&sampler, spec, &Effort::default())?;
    let options = ShrinkSpec { method: spec.method, ..ShrinkSpec::default() };
    let report = measure(&curve, &sampler, &tally.by_stage(), &options)?;
    Ok((curve, CurveReport { threads: 0, ..report }))
}

fn adaptive_curve(scene: &Value, samples: u32) -> Result<(Curve, CurveReport), ShrinkError> {
    let scene = Scene::from_value(scene).unwrap();
    shrunk(&scene, &CurveSpec { samples, ..CurveSpec::default() }, 1)
}

/// A curve that must pass.
fn sound(scene: &Value, samples: u32) -> (Curve, CurveReport) {
    let (curve, report) = adaptive_curve(scene, samples).unwrap();
    assert!(report.verdict.passed, "{scene}: {report:?}");
    (curve, report)
}

fn example(name: &str) -> Scene {
    let path = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join(format!("examples/scenes/2d/{name}.json"));
    Scene::from_slice(&std::fs::read(path).unwrap()).unwrap()
}

fn disc(radius: f64, at: [f64; 2]) -> Value {
    json!({"translate": {"by": at, "of": {"circle": {"radius": radius}}}})
}

fn difference(of: &[Value]) -> Value {
    json!({"difference": {"of": of}})
}

fn rectangle(half_extents: [f64; 2], at: [f64; 2]) -> Value {
    json!({"translate": {"by": at, "of": {"rectangle": {"half_extents": half_extents}}}})
}

/// A star polygon: `n` tips at radius 1, `n` notches at `inner`, times `size`.
fn star(n: usize, inner: f64, size: f64) -> Vec<[f64; 2]> {
    let at =
        |i: usize| (size * if i.is_multiple_of(2) { 1.0 } else { inner }, std::f64::consts::PI * i as f64 / n as f64);
    (0..2 * n).map(at).map(|(r, a)| [r * a.cos(), r * a.sin()]).collect()
}

/// Whether every place is a sample that is a corner.
fn assert_corners(curve: &Curve, places: &[[f64; 2]]) {
    for place in places {
        let near = |p: &[f64; 2]| (p[0] - place[0]).hypot(p[1] - place[1]);
        let (i, _) = curve.positions.iter().enumerate().min_by(|a, b| near(a.1).total_cmp(&near(b.1))).unwrap();
        assert!(curve.corners[i] && near(&curve.positions[i]) < 2e-6, "{place:?}: {:?}", curve.positions[i]);
    }
}

#[test]
fn every_planar_example_becomes_a_closed_simple_curve_on_its_zero_set() {
    for entry in std::fs::read_dir(concat!(env!("CARGO_MANIFEST_DIR"), "/examples/scenes/2d")).unwrap() {
        let path = entry.unwrap().path();
        let name = path.file_stem().unwrap().to_string_lossy().into_owned();
        let (curve, report) = shrunk(&example(&name), &CurveSpec::default(), 2).unwrap();
        assert!(report.verdict.passed, "{name}: {report:?}");
        assert!(report.closeness.distance.max < 2e-3 && report.closeness.distance.mean < 3e-4, "{name}: {report:?}");
        assert!(report.arc_length.deviation_max < 0.01, "{name}: {report:?}");
        assert_eq!(curve.positions.len(), 400);
        assert_eq!(curve.parameters[0], 0.0);
        assert!(curve.parameters.windows(2).all(|w| w[0] < w[1]) && curve.parameters[399] < 1.0, "{name}");
        assert!(curve.normals.iter().all(|n| (n[0].hypot(n[1]) - 1.0).abs() < 1e-6), "{name}");
    }
}

#[test]
fn the_samples_of_a_disc_are_on_its_circle_and_even() {
    let (curve, report) = sound(&disc(0.5, [0.2, -0.1]), 100);
    for (i, p) in curve.positions.iter().enumerate() {
        let angle = (p[1] + 0.1).atan2(p[0] - 0.2).rem_euclid(TAU) / TAU;
        assert!(((p[0] - 0.2).hypot(p[1] + 0.1) - 0.5).abs() < 1e-6);
        // the first sample is the rightmost crossing of the mesh, near angle 0
        let start = (curve.positions[0][1] + 0.1).atan2(curve.positions[0][0] - 0.2) / TAU;
        let turned = (angle - start - curve.parameters[i]).rem_euclid(1.0);
        assert!(turned.min(1.0 - turned) < 1e-5, "sample {i} is at {angle} of the circle");
        assert!((curve.parameters[i] - i as f64 / 100.0).abs() < 1e-6);
    }
    assert!(report.arc_length.deviation_max < 1e-4, "{report:?}");
}

#[test]
fn every_corner_of_a_polygon_is_a_sample() {
    let corners = [[-0.7, -0.6], [0.8, -0.5], [0.75, 0.1], [0.2, 0.0], [0.3, 0.7], [-0.1, 0.15], [-0.6, 0.6]];
    let (curve, report) = sound(&json!({"polygon": {"points": corners}}), 64);
    assert_eq!((report.corners, report.vertices), (7, 64));
    assert_corners(&curve, &corners);
    assert!(report.closeness.distance.max < 1e-6, "{report:?}");
}

#[test]
fn the_tips_of_a_sharp_star_are_samples_to_the_last_digit() {
    // tips of some 8 degrees, which the mesh loses long before they end
    let corners = star(9, 0.2, 0.85);
    let (curve, report) = sound(&json!({"polygon": {"points": corners}}), 500);
    assert_eq!(report.corners, 18);
    assert_corners(&curve, &corners);
}

#[test]
fn corners_of_curved_sides_are_found_where_the_sides_meet() {
    let lens = json!({"intersection": {"of": [disc(0.7, [-0.5, 0.0]), disc(0.7, [0.5, 0.0])]}});
    let (curve, report) = sound(&lens, 200);
    assert_eq!(report.corners, 2);
    let tip = 0.24f64.sqrt();
    assert_corners(&curve, &[[0.0, tip], [0.0, -tip]]);
}

#[test]
fn a_rounding_is_no_corner_however_small() {
    // as many samples as put some on every rounding
    for (radius, samples) in [(0.1, 200), (0.01, 1000), (0.002, 8000)] {
        let half = [0.5 - radius, 0.3 - radius];
        let rounded = json!({"round": {"radius": radius, "of": {"rectangle": {"half_extents": half}}}});
        let (_, report) = sound(&rounded, samples);
        assert_eq!(report.corners, 0, "{radius}: {report:?}");
        let length = 4.0 * (half[0] + half[1]) + TAU * radius;
        assert!((report.arc_length.length - length).abs() < 1e-3 * length, "{radius}: {report:?}");
    }
}

#[test]
fn a_zero_set_that_is_not_one_loop_is_refused_with_its_places() {
    let two = json!({"union": {"of": [disc(0.3, [-0.5, 0.0]), disc(0.2, [0.5, 0.0])]}});
    let Err(ShrinkError::Components { solids: 2, voids: 0, places }) = adaptive_curve(&two, 100) else { panic!() };
    assert!((places[0][0] + 0.5).hypot(places[0][1]) < 0.3 && (places[1][0] - 0.5).hypot(places[1][1]) < 0.2);
    let ring = json!({"shell": {"thickness": 0.1, "of": {"circle": {"radius": 0.5}}}});
    let Err(ShrinkError::Holes { count: 1, places }) = adaptive_curve(&ring, 100) else { panic!() };
    assert!(places[0][0].hypot(places[0][1]) < 0.45, "in the hole: {places:?}");
    let none = json!({"intersection": {"of": [disc(0.3, [-0.5, 0.0]), disc(0.2, [0.5, 0.0])]}});
    let Err(ShrinkError::Empty { min, max }) = adaptive_curve(&none, 100) else { panic!() };
    assert!(min > 0.0 && max > min);
    let ball = json!({"sphere": {"radius": 0.5}});
    assert_eq!(adaptive_curve(&ball, 100).unwrap_err(), ShrinkError::Dimension { found: 3, wanted: 2 });
}

#[test]
fn one_component_of_several_is_had_by_asking_for_it() {
    let scene = json!({"union": {"of": [disc(0.2, [-0.5, 0.0]), disc(0.3, [0.5, 0.0]), disc(0.1, [0.0, 0.6])]}});
    let scene = Scene::from_value(&scene).unwrap();
    for (component, middle, radius) in [
        (Component::Largest, [0.5, 0.0], 0.3),
        (Component::Index(1), [-0.5, 0.0], 0.2),
        (Component::Index(2), [0.0, 0.6], 0.1),
    ] {
        let spec = CurveSpec { component: Some(component), ..CurveSpec::default() };
        let (curve, report) = shrunk(&scene, &spec, 1).unwrap();
        assert!(report.verdict.passed, "{component:?}: {report:?}");
        assert_eq!(curve.left_out, LeftOut { components: 2, ..LeftOut::default() });
        for p in &curve.positions {
            assert!(((p[0] - middle[0]).hypot(p[1] - middle[1]) - radius).abs() < 1e-6, "{component:?}: {p:?}");
        }
    }
    let spec = CurveSpec { component: Some(Component::Index(3)), ..CurveSpec::default() };
    assert!(matches!(shrunk(&scene, &spec, 1), Err(ShrinkError::NoComponent { index: 3, count: 3, .. })));
}

#[test]
fn a_wrap_goes_around_the_holes_and_says_so() {
    let holed = difference(&[rectangle([0.6, 0.5], [0.0, 0.0]), disc(0.2, [-0.3, 0.0]), disc(0.1, [0.3, 0.2])]);
    let scene = Scene::from_value(&holed).unwrap();
    let spec = CurveSpec { on_topology: OnTopology::Wrap, ..CurveSpec::default() };
    let (curve, report) = shrunk(&scene, &spec, 1).unwrap();
    assert!(report.verdict.passed, "{report:?}");
    assert_eq!((curve.left_out.holes, curve.left_out.components, report.corners), (2, 0, 4));
    assert!((curve.left_out.hole_area - std::f64::consts::PI * 0.05).abs() < 1e-3, "{:?}", curve.left_out);
    assert!((report.arc_length.length - 4.4).abs() < 1e-5, "{report:?}");
}

#[test]
fn a_shape_smaller_than_a_cell_of_the_first_mesh_is_found() {
    let (_, report) = sound(&disc(0.012, [0.331, 0.207]), 60);
    assert!((report.arc_length.length - TAU * 0.012).abs() < 1e-4);
}

#[test]
fn a_slit_far_thinner_than_any_triangle_of_the_first_mesh_stays_open() {
    // widths of 1/100 to 1/3000 of the square; the walls are too near for anything but straight edges between corners
    for width in [0.01, 0.001, 0.0004] {
        let slit = difference(&[rectangle([0.6, 0.6], [0.0, 0.0]), rectangle([0.5 * width, 0.5], [0.0313, 0.2])]);
        let (curve, report) = sound(&slit, 300);
        assert_eq!(report.corners, 8, "{width}: {report:?}");
        // the square's 4.8, and the two walls of the slit; its floor is what its mouth takes away
        assert!((report.arc_length.length - 6.6).abs() < 1e-4, "{width}: {}", report.arc_length.length);
        assert_eq!(curve.left_out, LeftOut::default());
    }
}

#[test]
fn a_strut_that_joins_two_discs_is_followed_and_never_cut() {
    for width in [0.01, 0.001] {
        let parts = [disc(0.2, [-0.7, 0.0]), disc(0.2, [0.7, 0.0]), rectangle([0.7, 0.5 * width], [0.0, 0.0])];
        let (_, report) = sound(&json!({"union": {"of": parts}}), 400);
        assert_eq!(report.corners, 4, "{width}: {report:?}");
    }
}

#[test]
fn from_sixteen_samples_to_a_hundred_thousand() {
    for (samples, distance) in [(16, 8e-3), (1000, 2e-6), (100_000, 5e-7)] {
        let (curve, report) = sound(&disc(0.5, [0.0, 0.0]), samples);
        assert_eq!(curve.positions.len(), samples as usize);
        assert!(report.closeness.distance.max < distance, "{samples}: {report:?}");
    }
    for (asked, got) in [(0, 8), (200_000, 100_000)] {
        assert_eq!(adaptive_curve(&disc(0.5, [0.0, 0.0]), asked).unwrap().0.positions.len(), got);
    }
}

#[test]
fn the_paper_reaches_a_disc_and_never_the_inside_of_a_letter() {
    let spec = CurveSpec { method: Method::Paper, ..CurveSpec::default() };
    let (_, round) = shrunk(&example("disc"), &spec, 1).unwrap();
    assert!(round.simple && round.closeness.distance.max < 1e-4, "{round:?}");
    let (_, letter) = shrunk(&example("letter_s"), &spec, 1).unwrap();
    let (_, adaptive) = shrunk(&example("letter_s"), &CurveSpec::default(), 1).unwrap();
    let missed = |r: &CurveReport| r.closeness.distance.truth_to_surface.max;
    assert!(missed(&letter) > 100.0 * missed(&adaptive) && !letter.verdict.passed, "{letter:?}");
}

#[test]
fn any_number_of_threads_gives_the_same_curve() {
    for method in [Method::Adaptive, Method::Paper] {
        let spec = CurveSpec { method, samples: 700, ..CurveSpec::default() };
        assert_eq!(shrunk(&example("letter_g"), &spec, 1), shrunk(&example("letter_g"), &spec, 5));
    }
}

#[test]
fn a_raised_token_ends_the_run() {
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
    let (cancel, tally) = (CancelToken::new(), Tally::new());
    cancel.cancel();
    let settings = Settings { pool: &pool, cancel: &cancel, progress: &|_| {}, watched: false };
    let scene = example("disc");
    let found = shrink_curve(&Sampler::new(&scene, settings, &tally), &CurveSpec::default(), &Effort::default());
    assert_eq!(found, Err(ShrinkError::Canceled(Canceled)));
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
    let (curve, report) = shrunk(&Steep, &CurveSpec::default(), 1).unwrap();
    assert_eq!((report.verdict.passed, report.corners), (true, 0), "{report:?}");
    for p in &curve.positions {
        let (u, v) = ((p[0] - 5.0) / 2.0, (p[1] - 1.0) / 0.5);
        assert!((u.powi(4) + v.powi(4) - 0.5).abs() < 1e-4, "{p:?}");
    }
}
