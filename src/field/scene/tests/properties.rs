//! What holds for every scene, over random trees and points.

use super::super::{Scene, trust};
use super::{gradient, norm, value};
use crate::field::{Field, FieldError, Metric};
use proptest::prelude::*;
use serde_json::{Value, json};

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
