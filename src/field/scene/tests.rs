//! Claims about scenes: gradients, bounds and exactness over random trees, known values, and every fault by its name.

use super::{KINDS, Kind, Scene, trust};
use crate::field::{Field, FieldError, Gradients, Metric, Points};
use proptest::prelude::*;
use serde_json::{Value, json};

fn scene(value: &Value) -> Scene {
    Scene::from_value(value).unwrap_or_else(|e| panic!("{e}: {value}"))
}

fn value(scene: &Scene, p: [f32; 3]) -> f32 {
    let mut v = [0.0];
    scene.values(Points { x: &[p[0]], y: &[p[1]], z: &[p[2]] }, &mut v);
    v[0]
}

fn gradient(scene: &Scene, p: [f32; 3]) -> (f32, [f32; 3]) {
    let (mut v, mut x, mut y, mut z) = ([0.0], [0.0], [0.0], [0.0]);
    let g = Gradients { x: &mut x, y: &mut y, z: &mut z };
    scene.gradients(Points { x: &[p[0]], y: &[p[1]], z: &[p[2]] }, &mut v, g);
    (v[0], [x[0], y[0], z[0]])
}

fn norm(v: [f32; 3]) -> f32 {
    (v[0] * v[0] + v[1] * v[1] + v[2] * v[2]).sqrt()
}

/// A number between `lo` and `hi` of few digits.
fn number(lo: f64, hi: f64) -> impl Strategy<Value = f64> {
    (0..=1000u32).prop_map(move |k| ((lo + (hi - lo) * f64::from(k) / 1000.0) * 1e4).round() / 1e4)
}

fn vector(lo: f64, hi: f64) -> impl Strategy<Value = [f64; 3]> {
    [number(lo, hi), number(lo, hi), number(lo, hi)]
}

/// A star-shaped polygon, so that it is simple; reversed now and then.
fn polygon() -> impl Strategy<Value = Vec<[f64; 2]>> {
    (prop::collection::vec(number(0.15, 0.6), 3..9), any::<bool>()).prop_map(|(radii, reverse)| {
        let n = radii.len() as f64;
        let mut points: Vec<_> = radii
            .iter()
            .enumerate()
            .map(|(i, r)| {
                let (s, c) = (std::f64::consts::TAU * i as f64 / n + 0.1).sin_cos();
                [r * c, r * s]
            })
            .collect();
        if reverse {
            points.reverse();
        }
        points
    })
}

/// The right half of a star-shaped outline, closed along the axis.
fn profile() -> impl Strategy<Value = Vec<[f64; 2]>> {
    prop::collection::vec(number(0.15, 0.6), 3..8).prop_map(|radii| {
        let last = radii.len() - 1;
        let angle = |i: usize| std::f64::consts::PI * (i as f64 / last as f64 - 0.5);
        radii
            .iter()
            .enumerate()
            .map(|(i, r)| [if i == 0 || i == last { 0.0 } else { r * angle(i).cos() }, r * angle(i).sin()])
            .collect()
    })
}

fn leaf() -> BoxedStrategy<Value> {
    let l = || number(0.1, 0.6);
    let lengths = || [l(), l(), l()];
    prop_oneof![
        l().prop_map(|radius| json!({"sphere": {"radius": radius}})),
        lengths().prop_map(|radii| json!({"ellipsoid": {"radii": radii}})),
        lengths().prop_map(|h| json!({"box": {"half_extents": h}})),
        (lengths(), number(0.01, 0.1)).prop_map(|(h, r)| json!({"rounded_box": {"half_extents": h, "radius": r}})),
        (vector(-0.5, 0.5), vector(-0.5, 0.5), l())
            .prop_map(|(a, b, r)| json!({"capsule": {"from": a, "to": b, "radius": r}})),
        (l(), l()).prop_map(|(r, h)| json!({"cylinder": {"radius": r, "half_height": h}})),
        (l(), prop_oneof![Just(0.0), l()], l())
            .prop_map(|(r, t, h)| json!({"cone": {"radius": r, "top_radius": t, "half_height": h}})),
        (l(), number(0.05, 0.3)).prop_map(|(a, b)| json!({"torus": {"major": a, "minor": b}})),
        (vector(0.1, 1.0), number(-0.3, 0.3)).prop_map(|(n, o)| json!({"half_space": {"normal": n, "offset": o}})),
        l().prop_map(|s| json!({"octahedron": {"size": s}})),
        (l(), l()).prop_map(|(r, h)| json!({"hex_prism": {"radius": r, "half_height": h}})),
        (polygon(), l()).prop_map(|(p, h)| json!({"extrude": {"polygon": p, "half_height": h}})),
        profile().prop_map(|p| json!({"revolve": {"polygon": p, "offset": 0.0}})),
        (polygon(), number(0.6, 0.8)).prop_map(|(p, o)| json!({"revolve": {"polygon": p, "offset": o}})),
    ]
    .boxed()
}

fn tree() -> impl Strategy<Value = Value> {
    leaf().prop_recursive(4, 12, 3, |inner| {
        let some = || prop::collection::vec(inner.clone(), 1..4);
        let one = inner.clone();
        let small = || number(0.02, 0.2);
        prop_oneof![
            some().prop_map(|of| json!({"union": {"of": of}})),
            some().prop_map(|of| json!({"intersection": {"of": of}})),
            some().prop_map(|of| json!({"difference": {"of": of}})),
            (small(), some()).prop_map(|(k, of)| json!({"smooth_union": {"k": k, "of": of}})),
            (small(), some()).prop_map(|(k, of)| json!({"smooth_intersection": {"k": k, "of": of}})),
            (small(), some()).prop_map(|(k, of)| json!({"smooth_difference": {"k": k, "of": of}})),
            (small(), one.clone()).prop_map(|(r, of)| json!({"round": {"radius": r, "of": of}})),
            (small(), one.clone()).prop_map(|(t, of)| json!({"shell": {"thickness": t, "of": of}})),
            (number(-0.05, 0.05), vector(-9.0, 9.0), one.clone())
                .prop_map(|(a, f, of)| json!({"displace": {"amplitude": a, "frequency": f, "of": of}}))
                .prop_filter("some frequency", |v| v["displace"]["frequency"] != json!([0.0, 0.0, 0.0])),
            (vector(-0.5, 0.5), one.clone()).prop_map(|(by, of)| json!({"translate": {"by": by, "of": of}})),
            (vector(0.1, 1.0), number(-180.0, 180.0), one.clone())
                .prop_map(|(axis, angle, of)| json!({"rotate": {"axis": axis, "angle": angle, "of": of}})),
            (number(0.4, 2.0), one.clone()).prop_map(|(f, of)| json!({"scale": {"factor": f, "of": of}})),
            (prop::sample::select(vec!["x", "y", "z"]), one.clone())
                .prop_map(|(axis, of)| json!({"mirror": {"axis": axis, "of": of}})),
            (vector(0.5, 1.5), [1..5u32, 1..4u32, 1..4u32], one)
                .prop_map(|(s, n, of)| json!({"repeat": {"spacing": s, "count": n, "of": of}})),
        ]
    })
}

fn points() -> impl Strategy<Value = Vec<[f32; 3]>> {
    prop::collection::vec(vector(-1.5, 1.5).prop_map(|p| p.map(|c| c as f32 + 1.3e-4)), 40)
}

/// A tree that the parser takes; overlapping copies can be too many.
fn valid(tree: &Value) -> Option<Scene> {
    match Scene::from_value(tree) {
        Ok(scene) => Some(scene),
        Err(FieldError::Invalid { faults }) if faults.iter().all(|f| f.code == "overlapping_copies") => None,
        Err(e) => panic!("{e}: {tree}"),
    }
}

fn planar_tree() -> impl Strategy<Value = Value> {
    let l = || number(0.1, 0.6);
    let v = |lo: f64, hi: f64| [number(lo, hi), number(lo, hi)];
    let leaf = prop_oneof![
        l().prop_map(|radius| json!({"circle": {"radius": radius}})),
        [l(), l()].prop_map(|h| json!({"rectangle": {"half_extents": h}})),
        polygon().prop_map(|p| json!({"polygon": {"points": p}})),
        (v(-0.5, 0.5), v(-0.5, 0.5), l()).prop_map(|(a, b, r)| json!({"capsule": {"from": a, "to": b, "radius": r}})),
        (v(0.1, 1.0), number(-0.3, 0.3)).prop_map(|(n, o)| json!({"half_space": {"normal": n, "offset": o}})),
    ];
    leaf.prop_recursive(3, 8, 3, move |inner| {
        let some = prop::collection::vec(inner.clone(), 1..4);
        let kinds = vec!["smooth_union", "smooth_intersection", "smooth_difference"];
        prop_oneof![
            (prop::sample::select(vec!["union", "intersection", "difference"]), some.clone())
                .prop_map(|(kind, of)| json!({kind: {"of": of}})),
            (prop::sample::select(kinds), number(0.02, 0.2), some).prop_map(|(kind, k, of)| json!({kind: {"k": k, "of": of}})),
            (number(0.02, 0.2), inner.clone()).prop_map(|(t, of)| json!({"shell": {"thickness": t, "of": of}})),
            (number(0.02, 0.05), v(1.0, 9.0), inner.clone())
                .prop_map(|(a, f, of)| json!({"displace": {"amplitude": a, "frequency": f, "of": of}})),
            (v(-0.5, 0.5), number(-180.0, 180.0), number(0.4, 2.0), inner.clone()).prop_map(|(by, angle, f, of)| {
                json!({"translate": {"by": by, "of": {"rotate": {"angle": angle, "of": {"scale": {"factor": f, "of": of}}}}}})
            }),
            inner.clone().prop_map(|of| json!({"mirror": {"axis": "y", "of": of}})),
            (v(0.5, 1.5), [1..5u32, 1..4u32], inner)
                .prop_map(|(s, n, of)| json!({"repeat": {"spacing": s, "count": n, "of": of}})),
        ]
    })
}

/// What rounding to `f32` does to values of scenes of this size: coordinates up to 10 with a few operations each.
const ROUNDING: f32 = 2e-5;

/// Finite values and gradients, the same values with and without gradients, and gradients that agree with differences.
fn check_gradient(scene: &Scene, p: [f32; 3]) -> Result<(), TestCaseError> {
    let (v, g) = gradient(scene, p);
    prop_assert!(v.is_finite() && g.iter().all(|c| c.is_finite()), "{v} {g:?} at {p:?}");
    prop_assert_eq!(v.to_bits(), value(scene, p).to_bits(), "values with and without gradients differ");
    if scene.metric() == Metric::Sign {
        return Ok(());
    }
    for k in 0..3 {
        // the difference quotient is the mean of the derivative between the two points, so it lies among the
        // derivatives there; they spread where there is a crease or a tight curvature, and nowhere else
        const HALF: f32 = 1e-3;
        let beside = |t: f32| {
            let mut q = p;
            q[k] += t * HALF;
            q
        };
        let slopes = [-1.0, -0.5, 0.0, 0.5, 1.0].map(|t| gradient(scene, beside(t)).1[k]);
        let (low, high) = slopes.iter().fold((g[k], g[k]), |(a, b), &c| (a.min(c), b.max(c)));
        let (from, to) = (beside(-1.0), beside(1.0));
        let quotient = (value(scene, to) - value(scene, from)) / (to[k] - from[k]);
        let slack = 0.005 + ROUNDING / (10.0 * HALF) + 0.5 * (high - low);
        prop_assert!(
            quotient > low - slack && quotient < high + slack,
            "component {k} of {g:?} at {p:?}: {quotient} is not in {low} to {high}"
        );
    }
    Ok(())
}

/// A unit gradient that leads to the zero set, where the tree says that the value is exact.
fn check_exactness(scene: &Scene, p: [f32; 3]) -> Result<(), TestCaseError> {
    let trust = trust::trust(&scene.root);
    let (v, g) = gradient(scene, p);
    if if v > 0.0 { trust.outside } else { trust.inside } {
        prop_assert_eq!(scene.lipschitz(), Some(1.0));
        prop_assert!((norm(g) - 1.0).abs() < 1e-4, "{g:?}");
        let left = value(scene, std::array::from_fn(|k| p[k] - v * g[k]));
        prop_assert!(left.abs() < ROUNDING, "{left} is left of {v} at {p:?}");
    }
    Ok(())
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 600, ..ProptestConfig::default() })]

    #[test]
    fn gradients_are_finite_and_agree_with_central_differences(tree in tree(), points in points()) {
        let Some(scene) = valid(&tree) else { return Ok(()) };
        points.into_iter().try_for_each(|p| check_gradient(&scene, p))?;
    }

    #[test]
    fn planar_scenes_ignore_z_and_keep_the_same_promises(tree in planar_tree(), points in points()) {
        let Some(scene) = valid(&tree) else { return Ok(()) };
        for p in points {
            check_gradient(&scene, p)?;
            check_exactness(&scene, p)?;
            prop_assert_eq!(gradient(&scene, p), gradient(&scene, [p[0], p[1], f32::NAN]));
            prop_assert_eq!(gradient(&scene, p).1[2], 0.0);
        }
    }

    #[test]
    fn values_change_no_faster_than_the_lipschitz_bound(tree in tree(), points in points()) {
        let Some(scene) = valid(&tree) else { return Ok(()) };
        let Some(bound) = scene.lipschitz() else { return Ok(()) };
        for pair in points.windows(2) {
            for t in [1.0, 0.1, 0.01] {
                let (p, q) = (pair[0], std::array::from_fn(|k| pair[0][k] + t * (pair[1][k] - pair[0][k])));
                let step = norm(std::array::from_fn(|k| p[k] - q[k]));
                let change = (value(&scene, p) - value(&scene, q)).abs();
                prop_assert!(change <= bound * step * 1.0001 + ROUNDING, "{change} over {step}, bound {bound}");
            }
        }
    }

    /// With the Lipschitz bound 1 this makes the value the distance: the zero set is nowhere nearer, and there it is.
    #[test]
    fn where_the_distance_is_exact_the_gradient_is_unit_and_leads_to_the_zero_set(tree in tree(), points in points()) {
        let Some(scene) = valid(&tree) else { return Ok(()) };
        points.into_iter().try_for_each(|p| check_exactness(&scene, p))?;
    }

    #[test]
    fn the_solid_lies_in_the_fitted_domain(tree in tree(), points in points()) {
        let Some(scene) = valid(&tree) else { return Ok(()) };
        let Some(domain) = scene.fit_domain() else { return Ok(()) };
        for p in points {
            let held = (0..3).all(|k| f64::from(p[k]) >= domain.min[k] && f64::from(p[k]) <= domain.max[k]);
            prop_assert!(held || value(&scene, p) > 0.0, "{p:?} is inside, and not in {domain:?}");
        }
    }

    #[test]
    fn any_json_is_answered_with_a_scene_or_an_error(text in r#"[\[\]{}":,0-9a-z ]{0,60}"#) {
        let _ = Scene::from_slice(text.as_bytes());
    }

    #[test]
    fn a_damaged_scene_is_answered_with_a_scene_or_an_error(tree in tree(), at in any::<prop::sample::Index>(), byte in 32u8..127) {
        let mut bytes = tree.to_string().into_bytes();
        let at = at.index(bytes.len());
        bytes[at] = byte;
        if let Ok(scene) = Scene::from_slice(&bytes) {
            prop_assert!(value(&scene, [0.1, 0.2, 0.3]).is_finite());
        }
    }
}

#[test]
fn batches_of_any_length_give_the_bits_of_single_points() {
    let scene = scene(&json!({"smooth_union": {"k": 0.2, "of": [
        {"ellipsoid": {"radii": [0.5, 0.3, 0.2]}},
        {"translate": {"by": [0.2, 0.1, 0.0], "of": {"rotate": {"axis": [1, 1, 0], "angle": 30, "of": {"box": {"half_extents": [0.2, 0.3, 0.1]}}}}}},
        {"extrude": {"polygon": [[0, 0], [0.5, 0], [0.1, 0.6]], "half_height": 0.2}}
    ]}}));
    let n = 1000;
    let c = |k: usize, f: f32| (0..n).map(|i| ((i * k) as f32 * f).sin()).collect::<Vec<_>>();
    let (x, y, z) = (c(3, 0.31), c(7, 0.17), c(11, 0.23));
    let (mut v, mut gx, mut gy, mut gz) = (vec![0.0; n], vec![0.0; n], vec![0.0; n], vec![0.0; n]);
    let points = Points { x: &x, y: &y, z: &z };
    scene.gradients(points, &mut v, Gradients { x: &mut gx, y: &mut gy, z: &mut gz });
    for i in 0..n {
        let (single, g) = gradient(&scene, [x[i], y[i], z[i]]);
        assert_eq!((single, g), (v[i], [gx[i], gy[i], gz[i]]), "point {i}");
    }
}

#[test]
fn shapes_have_the_distances_of_geometry() {
    let root2 = 2f32.sqrt();
    let cases: &[(Value, [f32; 3], f32)] = &[
        (json!({"sphere": {"radius": 0.5}}), [0.0, 3.0, 4.0], 4.5),
        (json!({"ellipsoid": {"radii": [3, 2, 1]}}), [0.0, 0.0, 0.0], -1.0),
        (json!({"ellipsoid": {"radii": [3, 2, 1]}}), [5.0, 0.0, 0.0], 2.0),
        (json!({"ellipsoid": {"radii": [2, 2, 2]}}), [0.0, 0.0, 1.0], -1.0),
        // the centre of curvature of an ellipse's tip, (a^2 - b^2)/a from the centre, is b^2/a from it
        (json!({"ellipsoid": {"radii": [2, 1, 1]}}), [1.5, 0.0, 0.0], -0.5),
        (json!({"box": {"half_extents": [1, 2, 3]}}), [2.0, 3.0, 0.0], root2),
        (json!({"box": {"half_extents": [1, 2, 3]}}), [0.5, 0.0, 0.0], -0.5),
        (json!({"rounded_box": {"half_extents": [1, 2, 3], "radius": 0.5}}), [2.0, 0.0, 0.0], 1.0),
        (json!({"rounded_box": {"half_extents": [1, 1, 1], "radius": 0.5}}), [1.5, 1.5, 0.0], root2 - 0.5),
        (json!({"capsule": {"from": [0, 0, 0], "to": [2, 0, 0], "radius": 0.5}}), [1.0, 1.0, 0.0], 0.5),
        (json!({"capsule": {"from": [0, 0, 0], "to": [2, 0, 0], "radius": 0.5}}), [5.0, 4.0, 0.0], 4.5),
        (json!({"cylinder": {"radius": 1, "half_height": 2}}), [2.0, 0.0, 3.0], root2),
        (json!({"cone": {"radius": 1, "top_radius": 0, "half_height": 1}}), [0.0, 0.0, 2.0], 1.0),
        (json!({"cone": {"radius": 1, "top_radius": 1, "half_height": 1}}), [0.0, 0.0, 0.5], -0.5),
        (json!({"cone": {"radius": 2, "top_radius": 1, "half_height": 1}}), [0.0, 3.0, -1.0], 1.0),
        (json!({"torus": {"major": 2, "minor": 0.5}}), [0.0, 0.0, 0.0], 1.5),
        (json!({"half_space": {"normal": [0, 0, 2], "offset": 1}}), [5.0, 0.0, 3.0], 2.0),
        (json!({"octahedron": {"size": 1}}), [2.0, 0.0, 0.0], 1.0),
        (json!({"octahedron": {"size": 1}}), [1.0, 1.0, 0.0], 0.5 * root2),
        (json!({"octahedron": {"size": 1}}), [0.0, 0.0, 0.0], -1.0 / 3f32.sqrt()),
        (json!({"hex_prism": {"radius": 1, "half_height": 1}}), [2.0, 0.0, 0.0], 1.0),
        (json!({"hex_prism": {"radius": 1, "half_height": 1}}), [0.0, 1.0, 0.0], 1.0 - 0.75f32.sqrt()),
        (json!({"extrude": {"polygon": [[0, 0], [1, 0], [1, 1], [0, 1]], "half_height": 1}}), [2.0, 0.5, 2.0], root2),
        (json!({"revolve": {"polygon": [[-1, -1], [1, -1], [1, 1], [-1, 1]], "offset": 3}}), [0.0, 0.0, 0.0], 2.0),
        (json!({"circle": {"radius": 0.5}}), [3.0, 4.0, 99.0], 4.5),
        (json!({"rectangle": {"half_extents": [1, 2]}}), [2.0, 3.0, 99.0], root2),
        (json!({"polygon": {"points": [[0, 0], [0, 1], [1, 1], [1, 0]]}}), [0.5, 0.25, 99.0], -0.25),
        (json!({"capsule": {"from": [0, 0], "to": [2, 0], "radius": 0.5}}), [1.0, 1.0, 99.0], 0.5),
        (json!({"half_space": {"normal": [0, 1], "offset": 1}}), [5.0, 3.0, 99.0], 2.0),
    ];
    for (shape, p, distance) in cases {
        let found = value(&scene(shape), *p);
        assert!((found - distance).abs() < 1e-5 * distance.abs().max(1.0), "{shape} at {p:?}: {found}, not {distance}");
    }
}

#[test]
fn operators_do_what_their_formulas_say() {
    let sphere = |r: f64| json!({"sphere": {"radius": r}});
    let smooth = |kind: &str, k: f64, a: f64, b: f64| json!({kind: {"k": k, "of": [sphere(a), sphere(b)]}});
    let at = [0.0, 0.0, 2.0];
    // |a - b| = 0.5, k = 1: h = 0.5, h^2 k/4 = 0.0625
    let cases = [
        (smooth("smooth_union", 1.0, 1.0, 0.5), 1.0 - 0.0625),
        (smooth("smooth_intersection", 1.0, 1.0, 0.5), 1.5 + 0.0625),
        (smooth("smooth_difference", 0.1, 1.0, 0.5), 1.0),
        (json!({"difference": {"of": [sphere(1.0), sphere(3.0)]}}), 1.0),
        (json!({"round": {"radius": 0.25, "of": sphere(1.0)}}), 0.75),
        (json!({"shell": {"thickness": 0.5, "of": sphere(3.0)}}), 0.75),
        (
            json!({"displace": {"amplitude": 0.5, "frequency": [0, 0, 0.25], "of": sphere(1.0)}}),
            1.0 + 0.5 * 0.5f32.sin(),
        ),
        (json!({"translate": {"by": [0, 0, 0.5], "of": sphere(1.0)}}), 0.5),
        (json!({"scale": {"factor": 2, "of": sphere(0.5)}}), 1.0),
        (
            json!({"rotate": {"axis": [1, 0, 0], "angle": 90, "of": {"translate": {"by": [0, 1, 0], "of": sphere(0.5)}}}}),
            0.5,
        ),
        (json!({"mirror": {"axis": "z", "of": {"translate": {"by": [0, 0, 1], "of": sphere(0.5)}}}}), 0.5),
        (json!({"repeat": {"spacing": [1, 1, 1], "count": [1, 1, 4], "of": sphere(0.25)}}), 0.25),
        (json!({"repeat": {"spacing": [1, 1, 1], "count": [1, 1, 3], "of": sphere(0.25)}}), 0.75),
    ];
    for (node, expected) in cases {
        let found = value(&scene(&node), at);
        assert!((found - expected).abs() < 1e-6, "{node}: {found}, not {expected}");
    }
}

#[test]
fn degenerate_points_have_unit_gradients() {
    for shape in [
        json!({"sphere": {"radius": 0.5}}),
        json!({"ellipsoid": {"radii": [0.5, 0.4, 0.3]}}),
        json!({"ellipsoid": {"radii": [0.4, 0.4, 0.4]}}),
        json!({"ellipsoid": {"radii": [0.3, 0.4, 0.3]}}),
        json!({"box": {"half_extents": [0.5, 0.5, 0.5]}}),
        json!({"capsule": {"from": [-1, -1, -1], "to": [1, 1, 1], "radius": 0.2}}),
        json!({"capsule": {"from": [0, 0, 0], "to": [0, 0, 0], "radius": 0.2}}),
        json!({"cylinder": {"radius": 0.5, "half_height": 0.5}}),
        json!({"cone": {"radius": 0.5, "top_radius": 0, "half_height": 0.5}}),
        json!({"torus": {"major": 0.5, "minor": 0.1}}),
        json!({"octahedron": {"size": 0.5}}),
        json!({"hex_prism": {"radius": 0.5, "half_height": 0.5}}),
    ] {
        let scene = scene(&shape);
        for p in [
            [0.0; 3],
            [-0.0; 3],
            [0.5, 0.0, 0.0],
            [0.0, 0.0, 0.5],
            [0.5, 0.5, 0.5],
            [1e-30, 0.0, 0.0],
            [0.25, -0.0, 0.0],
        ] {
            let (v, g) = gradient(&scene, p);
            assert!(v.is_finite() && (norm(g) - 1.0).abs() < 1e-5, "{shape} at {p:?}: {v} {g:?}");
        }
    }
}

#[test]
fn normals_next_to_the_surface_keep_their_digits() {
    let square = json!({"polygon": {"points": [[0.1, 0.1], [0.9, 0.1], [0.9, 0.9], [0.1, 0.9]]}});
    let (_, g) = gradient(&scene(&square), [0.9 + 1e-7, 0.4, 0.0]);
    assert_eq!(g, [1.0, 0.0, 0.0]);
    let ellipsoid = scene(&json!({"ellipsoid": {"radii": [0.8, 0.5, 0.3]}}));
    let p = [0.8 * 0.6, 0.5 * 0.48, 0.3 * 0.64];
    let (v, g) = gradient(&ellipsoid, p);
    let n = [0.6 / 0.8, 0.48 / 0.5, 0.64 / 0.3];
    assert!(v.abs() < 1e-7 && (0..3).all(|k| (g[k] - n[k] / norm(n)).abs() < 1e-6), "{v} {g:?}");
}

#[test]
fn the_metric_follows_the_rules() {
    let cases = [
        (json!({"ellipsoid": {"radii": [0.5, 0.4, 0.3]}}), Metric::Exact, Some(1.0)),
        (json!({"torus": {"major": 0.1, "minor": 0.3}}), Metric::Bound, Some(1.0)),
        (
            json!({"union": {"of": [{"sphere": {"radius": 1}}, {"box": {"half_extents": [1, 1, 1]}}]}}),
            Metric::Bound,
            Some(1.0),
        ),
        (
            json!({"union": {"of": [{"sphere": {"radius": 1}}, {"translate": {"by": [3, 0, 0], "of": {"sphere": {"radius": 1}}}}]}}),
            Metric::Exact,
            Some(1.0),
        ),
        (json!({"round": {"radius": 0.1, "of": {"box": {"half_extents": [1, 1, 1]}}}}), Metric::Exact, Some(1.0)),
        (json!({"round": {"radius": 0.1, "of": {"torus": {"major": 1, "minor": 0.2}}}}), Metric::Bound, Some(1.0)),
        (
            json!({"displace": {"amplitude": 0.1, "frequency": [3, 4, 0], "of": {"sphere": {"radius": 1}}}}),
            Metric::Bound,
            Some(1.4),
        ),
        (
            json!({"repeat": {"spacing": [2, 0, 0], "count": [900, 1, 1], "of": {"sphere": {"radius": 1}}}}),
            Metric::Exact,
            Some(1.0),
        ),
        (
            json!({"repeat": {"spacing": [2, 0, 0], "count": [900, 1, 1], "of": {"displace": {"amplitude": 0.1, "frequency": [1, 1, 1], "of": {"sphere": {"radius": 1}}}}}}),
            Metric::Sign,
            None,
        ),
    ];
    for (node, metric, lipschitz) in cases {
        let scene = scene(&node);
        assert_eq!((scene.metric(), scene.lipschitz()), (metric, lipschitz), "{node}");
    }
}

#[test]
fn a_half_space_has_no_fitted_domain_and_a_cut_sphere_has() {
    assert_eq!(scene(&json!({"half_space": {"normal": [0, 0, 1], "offset": 0}})).fit_domain(), None);
    let cut = json!({"intersection": {"of": [{"sphere": {"radius": 1}}, {"half_space": {"normal": [0, 0, 1], "offset": 0}}]}});
    let domain = scene(&cut).fit_domain().unwrap();
    assert!((domain.max[2] - 0.1).abs() < 1e-9 && (domain.min[2] + 1.1).abs() < 1e-9, "{domain:?}");
    let flat = scene(&json!({"translate": {"by": [1, 2], "of": {"circle": {"radius": 0.5}}}})).fit_domain().unwrap();
    assert!((flat.min[0] - 0.45).abs() < 1e-9 && (flat.max[1] - 2.55).abs() < 1e-9, "{flat:?}");
}

fn faults(value: &Value) -> Vec<(String, &'static str)> {
    match Scene::from_value(value) {
        Err(FieldError::Invalid { faults }) => faults.into_iter().map(|f| (f.pointer, f.code)).collect(),
        other => panic!("{other:?}: {value}"),
    }
}

#[test]
fn every_fault_is_named_at_its_place() {
    let ball = || json!({"sphere": {"radius": 1}});
    let cases = [
        (json!(3), "", "wrong_type"),
        (json!({}), "", "not_one_member"),
        (json!({"sphere": {"radius": 1}, "box": {}}), "", "not_one_member"),
        (json!({"spere": {"radius": 1}}), "/spere", "unknown_kind"),
        (json!({"a/b~c": {}}), "/a~1b~0c", "unknown_kind"),
        (json!({"sphere": 1}), "/sphere", "wrong_type"),
        (json!({"sphere": {}}), "/sphere/radius", "missing_member"),
        (json!({"sphere": {"radius": 1, "color": 2}}), "/sphere/color", "unknown_member"),
        (json!({"sphere": {"radius": "1"}}), "/sphere/radius", "wrong_type"),
        (json!({"sphere": {"radius": 0}}), "/sphere/radius", "not_positive"),
        (json!({"sphere": {"radius": -1}}), "/sphere/radius", "not_positive"),
        (json!({"sphere": {"radius": 1e-9}}), "/sphere/radius", "out_of_range"),
        (json!({"sphere": {"radius": 1e39}}), "/sphere/radius", "out_of_range"),
        (json!({"box": {"half_extents": [1, 1]}}), "/box/half_extents", "wrong_length"),
        (json!({"box": {"half_extents": [1, 0, 1]}}), "/box/half_extents/1", "not_positive"),
        (json!({"box": {"half_extents": 1}}), "/box/half_extents", "wrong_type"),
        (json!({"rounded_box": {"half_extents": [1, 1, 1], "radius": 2}}), "/rounded_box/radius", "out_of_range"),
        (json!({"cone": {"radius": 1, "top_radius": -1, "half_height": 1}}), "/cone/top_radius", "not_positive"),
        (json!({"half_space": {"normal": [0, 0, 0], "offset": 0}}), "/half_space/normal", "zero_vector"),
        (json!({"capsule": {"from": [0, 0, 0], "to": [1, 1], "radius": 1}}), "/capsule/to", "wrong_length"),
        (json!({"polygon": {"points": [[0, 0], [1, 1]]}}), "/polygon/points", "too_few_points"),
        (json!({"polygon": {"points": [[0, 0], [1, 1], [1, 1], [0, 1]]}}), "/polygon/points/2", "repeated_point"),
        (json!({"polygon": {"points": [[0, 0], [1, 1], [1, 0], [0, 1]]}}), "/polygon/points", "self_intersecting"),
        (json!({"polygon": {"points": [[0, 0], [1, null], [0, 1]]}}), "/polygon/points/1/1", "wrong_type"),
        (json!({"polygon": {"points": vec![[0, 0]; 2049]}}), "/polygon/points", "too_many_points"),
        (
            json!({"revolve": {"polygon": [[-1, 0], [1, 0], [0, 1]], "offset": 0.5}}),
            "/revolve/polygon/0",
            "crosses_axis",
        ),
        (json!({"union": {"of": []}}), "/union/of", "empty"),
        (json!({"union": {"of": ball()}}), "/union/of", "wrong_type"),
        (json!({"union": {"of": [ball(), {"circle": {"radius": 1}}]}}), "/union/of/1", "mixed_dimensions"),
        (json!({"smooth_union": {"of": [ball()]}}), "/smooth_union/k", "missing_member"),
        (json!({"translate": {"by": [1, 2], "of": ball()}}), "/translate/by", "wrong_length"),
        (json!({"rotate": {"angle": 3, "of": ball()}}), "/rotate/axis", "missing_member"),
        (
            json!({"rotate": {"angle": 3, "axis": [0, 0, 1], "of": {"circle": {"radius": 1}}}}),
            "/rotate/axis",
            "unknown_member",
        ),
        (json!({"mirror": {"axis": "w", "of": ball()}}), "/mirror/axis", "out_of_range"),
        (json!({"mirror": {"axis": 0, "of": ball()}}), "/mirror/axis", "wrong_type"),
        (
            json!({"displace": {"amplitude": 1, "frequency": [0, 0, 0], "of": ball()}}),
            "/displace/frequency",
            "zero_vector",
        ),
        (
            json!({"scale": {"factor": 1e-5, "of": {"scale": {"factor": 1e-5, "of": ball()}}}}),
            "/scale/of/scale/factor",
            "out_of_range",
        ),
        (
            json!({"repeat": {"spacing": [1, 1, 1], "count": [0, 1, 1], "of": ball()}}),
            "/repeat/count/0",
            "out_of_range",
        ),
        (
            json!({"repeat": {"spacing": [1, 1, 1], "count": [1.5, 1, 1], "of": ball()}}),
            "/repeat/count/0",
            "out_of_range",
        ),
        (
            json!({"repeat": {"spacing": [0, 1, 1], "count": [2, 1, 1], "of": ball()}}),
            "/repeat/spacing/0",
            "not_positive",
        ),
        (
            json!({"repeat": {"spacing": [0.1, 0.1, 0.1], "count": [9, 9, 9], "of": ball()}}),
            "/repeat",
            "overlapping_copies",
        ),
    ];
    for (value, pointer, code) in cases {
        assert_eq!(faults(&value), [(pointer.to_owned(), code)], "{value}");
    }
}

#[test]
fn all_faults_of_a_scene_are_found_at_once() {
    let broken = json!({"smooth_union": {"k": -1, "of": [
        {"sphere": {"radius": 0}},
        {"translate": {"by": [0, "0", 0], "of": {"torus": {"major": 1, "minor": true}}}},
        {"round": {"of": {"cylinder": {"radius": 1}}}},
    ]}});
    let mut found = faults(&broken);
    found.sort();
    let expected = [
        ("/smooth_union/k", "not_positive"),
        ("/smooth_union/of/0/sphere/radius", "not_positive"),
        ("/smooth_union/of/1/translate/by/1", "wrong_type"),
        ("/smooth_union/of/1/translate/of/torus/minor", "wrong_type"),
        ("/smooth_union/of/2/round/of/cylinder/half_height", "missing_member"),
        ("/smooth_union/of/2/round/radius", "missing_member"),
    ];
    assert_eq!(found, expected.map(|(p, c)| (p.to_owned(), c)));
}

fn nested(depth: usize) -> String {
    let mut text = r#"{"sphere": {"radius": 0.5}}"#.to_owned();
    for _ in 1..depth {
        text = format!(r#"{{"union": {{"of": [{text}]}}}}"#);
    }
    text
}

#[test]
fn depth_is_limited_and_never_overflows_the_stack() {
    assert!(Scene::from_slice(nested(40).as_bytes()).is_ok());
    let in_a_job: Value = serde_json::from_str(&format!(r#"{{"field": {{"scene": {}}}}}"#, nested(41))).unwrap();
    let found = faults(&in_a_job["field"]["scene"]);
    assert_eq!(found.len(), 1);
    assert_eq!((found[0].1, found[0].0.matches("/union/of/0").count()), ("too_deep", 40));
    let head = r#"{"union":{"of":["#.repeat(10_000);
    let deep = format!("{head}{{\"sphere\":{{\"radius\":1}}}}{}", "]}}".repeat(10_000));
    let found = Scene::from_slice(deep.as_bytes());
    assert_eq!(found.unwrap_err(), FieldError::Limit { what: "nesting of a scene", found: 30_002, limit: 122 });
    assert!(Scene::from_slice(&b"[".repeat(100_000)).is_err());
}

#[test]
fn size_count_and_cost_are_limited() {
    let spaces = vec![b' '; (1 << 20) + 1];
    assert!(matches!(Scene::from_slice(&spaces), Err(FieldError::Limit { what: "bytes of a scene", .. })));
    let many = json!({"union": {"of": vec![json!({"sphere": {"radius": 1}}); 4096]}});
    assert_eq!(faults(&many), [("/union/of/4095".to_owned(), "too_many_nodes")]);
    let copies = |of: Value| json!({"repeat": {"spacing": [1, 1, 1], "count": [4, 4, 4], "of": {"union": {"of": [of, {"half_space": {"normal": [0, 0, 1], "offset": 0}}]}}}});
    let costly = copies(copies(copies(json!({"sphere": {"radius": 1}}))));
    assert_eq!(faults(&costly), [(String::new(), "too_costly")]);
}

#[test]
fn broken_json_is_refused_with_the_byte() {
    let found = Scene::from_slice(b"{\"sphere\":\n {\"radius\": NaN}}").unwrap_err();
    assert!(matches!(found, FieldError::Malformed { format: "scene JSON", at: Some(22..=23), .. }), "{found:?}");
    let overflow = Scene::from_slice(br#"{"sphere": {"radius": 1e999}}"#).unwrap_err();
    assert!(matches!(overflow, FieldError::Malformed { .. }), "{overflow:?}");
    assert!(matches!(Scene::from_slice(b""), Err(FieldError::Malformed { .. })));
}

#[test]
fn the_schema_lists_the_kinds_and_members_that_the_parser_knows() {
    let schema: Value = serde_json::from_str(include_str!("../../../docs/scene.schema.json")).unwrap();
    for (definition, dimension) in [("node", 3), ("planar_node", 2)] {
        let kinds: Vec<&Kind> = KINDS.iter().filter(|k| if dimension == 3 { k.space } else { k.plane }).collect();
        let properties = schema["$defs"][definition]["properties"].as_object().unwrap();
        let mut listed: Vec<&str> = properties.keys().map(String::as_str).collect();
        let mut known: Vec<&str> = kinds.iter().map(|k| k.name).collect();
        (listed.sort_unstable(), known.sort_unstable());
        assert_eq!(listed, known, "{definition}");
        for kind in kinds {
            let body = &properties[kind.name];
            let members = |list: Vec<&str>| {
                let mut list: Vec<String> = list.into_iter().map(str::to_owned).collect();
                list.sort();
                list
            };
            let planar_rotation = kind.name == "rotate" && dimension == 2;
            let expected = kind.members.iter().copied().filter(|m| !(planar_rotation && *m == "axis")).collect();
            let required = body["required"].as_array().unwrap().iter().filter_map(Value::as_str).collect();
            assert_eq!(members(required), members(expected), "{}", kind.name);
            let properties = body["properties"].as_object().unwrap();
            assert_eq!(properties.len(), body["required"].as_array().unwrap().len(), "{}", kind.name);
            assert_eq!(body["additionalProperties"], false, "{}", kind.name);
        }
    }
}
