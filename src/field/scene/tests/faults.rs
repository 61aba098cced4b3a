//! Every fault by its code and place, and the limits.

use super::super::Scene;
use crate::field::FieldError;
use serde_json::{Value, json};

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
