//! Tests of the request and its reader.

use super::*;
use crate::shrink::Density;
use serde_json::json;

fn shrinking(spec: &JobSpec) -> &Shrinking {
    match &spec.work {
        Work::Shrink(work) => work,
        other => panic!("{other:?}"),
    }
}

fn faults(value: Value) -> Vec<(String, &'static str)> {
    JobSpec::from_value(&value).expect_err("faulty").into_iter().map(|f| (f.pointer, f.code)).collect()
}

#[test]
fn a_field_alone_is_a_good_job() {
    let spec = JobSpec::from_value(&json!({"field": {"scene": {"sphere": {"radius": 0.5}}}})).expect("good");
    assert_eq!(shrinking(&spec).shrink, ShrinkSpec::default());
    assert_eq!(spec.outputs, [OutputName::Glb, OutputName::Preview, OutputName::Report]);
}

#[test]
fn a_stored_request_is_read_back_as_it_was() {
    let value = json!({
        "field": {"input": format!("sha256:{}", "ab".repeat(32)), "latent": [0.5, -1.0], "level": 0.25,
                  "domain": {"min": [-1, -1, -1], "max": [1, 1, 2]}},
        "shrink": {"method": "paper", "lattice": {"octahedral": {"n": 9}}, "density": "reach", "distortion": "angle",
                   "relax_uv": true, "on_topology": "wrap", "component": 2},
        "budget": {"attempts": 2, "evaluations": 5_000_000_000u64},
        "outputs": ["report", "glb"], "labels": {"project": "demo"},
    });
    let spec = JobSpec::from_value(&value).expect("good");
    let stored = serde_json::to_value(&spec).expect("serializes");
    assert_eq!(stored["shrink"]["component"], 2);
    assert_eq!(JobSpec::from_value(&stored), Ok(spec));
    let largest = json!({"field": {"scene": {}}, "shrink": {"component": "largest"}});
    let spec = JobSpec::from_value(&largest).expect("good");
    let stored = serde_json::to_value(&spec).expect("serializes");
    assert_eq!(stored["shrink"]["component"], "largest");
    let shrink = serde_json::from_value(stored["shrink"].clone()).expect("reads");
    let work = shrinking(&spec);
    assert_eq!((work.shrink.clone(), work.budget), (shrink, Budget::default()), "the record's own reader agrees");
}

#[test]
fn options_and_budget_are_checked_member_by_member() {
    let found = faults(json!({
        "field": {"scene": {}},
        "shrink": {"density": "even", "distortion": 3, "relax_uv": "yes", "on_topology": "ignore",
                   "component": -1, "smooth": true},
        "budget": {"attempts": 4, "evaluations": 0, "seconds": 3},
    }));
    let expected = [
        ("/shrink/smooth", "unknown_member"),
        ("/shrink/density", "unknown_value"),
        ("/shrink/distortion", "wrong_type"),
        ("/shrink/on_topology", "unknown_value"),
        ("/shrink/relax_uv", "wrong_type"),
        ("/shrink/component", "wrong_type"),
        ("/budget/seconds", "unknown_member"),
        ("/budget/attempts", "out_of_range"),
        ("/budget/evaluations", "out_of_range"),
    ];
    assert_eq!(found, expected.map(|(p, c)| (p.to_owned(), c)));
    let odd = |component: Value| faults(json!({"field": {"scene": {}}, "shrink": {"component": component}}));
    assert_eq!(odd(json!("smallest")), [("/shrink/component".to_owned(), "unknown_value")]);
    assert_eq!(odd(json!([0])), [("/shrink/component".to_owned(), "wrong_type")]);
    let odd = |budget: Value| faults(json!({"field": {"scene": {}}, "budget": budget}));
    assert_eq!(odd(json!({"evaluations": 1.5})), [("/budget/evaluations".to_owned(), "wrong_type")]);
    assert_eq!(odd(json!({"attempts": 0})), [("/budget/attempts".to_owned(), "out_of_range")]);
    assert_eq!(odd(json!(3)), [("/budget".to_owned(), "wrong_type")]);
}

#[test]
fn every_fault_is_found_at_once_and_named_by_its_place() {
    let found = faults(json!({
        "feild": 1,
        "field": {"scene": {}, "levle": 1, "latent": [1, "x", 1e300]},
        "shrink": {"method": "magic", "lattice": {"latlong": {"n_theta": 4, "n_phi": 5000}}},
        "outputs": ["glb", "stl", "glb"],
        "labels": {"a b": "c", "x": 3},
    }));
    let expected = [
        ("/feild", "unknown_member"),
        ("/field/levle", "unknown_member"),
        ("/field/latent/1", "wrong_type"),
        ("/field/latent/2", "not_finite"),
        ("/shrink/method", "unknown_value"),
        ("/shrink/lattice/latlong/n_theta", "out_of_range"),
        ("/shrink/lattice/latlong/n_phi", "out_of_range"),
        ("/outputs/1", "unknown_value"),
        ("/outputs/2", "duplicate"),
        ("/labels/a b", "invalid_label"),
        ("/labels/x", "wrong_type"),
    ];
    assert_eq!(found, expected.map(|(p, c)| (p.to_owned(), c)));
}

#[test]
fn a_weight_is_read_like_a_field_and_makes_the_density() {
    let weight = json!({"input": format!("sha256:{}", "ab".repeat(32)), "level": 0.5});
    let spec = JobSpec::from_value(&json!({"field": {"scene": {}}, "weight": weight})).expect("good");
    assert_eq!(shrinking(&spec).shrink.density, Density::Weight);
    let stored = serde_json::to_value(&spec).expect("serializes");
    assert_eq!((&stored["weight"]["level"], JobSpec::from_value(&stored)), (&json!(0.5), Ok(spec)));
    let other = json!({"field": {"scene": {}}, "weight": weight, "shrink": {"density": "area"}});
    assert_eq!(faults(other), [("/shrink/density".to_owned(), "ambiguous")]);
    let none = json!({"field": {"scene": {}}, "shrink": {"density": "weight"}});
    assert_eq!(faults(none), [("/weight".to_owned(), "missing_member")]);
    let odd =
        json!({"field": {"scene": {}}, "weight": {"scene": {}, "levle": 1, "latent": [1, "x"], "domain": "large"}});
    let places = ["/weight/levle", "/weight/latent/1", "/weight/domain"];
    assert_eq!(faults(odd).into_iter().map(|f| f.0).collect::<Vec<_>>(), places);
}

#[test]
fn what_is_not_an_object_or_has_no_field_is_refused() {
    assert_eq!(faults(json!([1])), [(String::new(), "wrong_type")]);
    assert_eq!(faults(json!({})), [("/field".to_owned(), "missing_member")]);
    assert_eq!(faults(json!({"field": {}})), [("/field".to_owned(), "missing_member")]);
    assert_eq!(faults(json!({"field": {"scene": {}, "input": "x"}})), [("/field".to_owned(), "ambiguous")]);
    let empty = json!({"field": {"scene": {}, "domain": {"min": [0, 0, 0], "max": [1, 0, 1]}}});
    assert_eq!(faults(empty), [("/field/domain/max/1".to_owned(), "empty")]);
    let odd = json!({"field": {"scene": {}, "domain": "large", "activation": "magic", "transform": {"scael": 2}}});
    let places = ["/field/transform", "/field/domain", "/field/activation"];
    assert_eq!(faults(odd), places.map(|p| (p.to_owned(), "invalid_value")));
}

#[test]
fn what_only_curves_have_is_refused_for_surfaces_by_its_place() {
    let request = json!({"field": {"scene": {}}, "shrink": {"samples": 500}, "outputs": ["report", "svg"]});
    let spec = JobSpec::from_value(&request).expect("good for a curve");
    assert_eq!(spec.clone().for_dimension(2, &request), Ok(spec.clone()));
    let found = spec.for_dimension(3, &request).expect_err("no curve");
    let places: Vec<&str> = found.iter().map(|f| f.pointer.as_str()).collect();
    assert_eq!(places, ["/outputs/1", "/shrink/samples"]);
    let silent = json!({"field": {"scene": {}}});
    let spec = JobSpec::from_value(&silent).expect("good").for_dimension(2, &silent).expect("good");
    assert_eq!(spec.outputs, [OutputName::Glb, OutputName::Svg, OutputName::Preview, OutputName::Report]);
    for samples in [7, 100_001] {
        let value = json!({"field": {"scene": {}}, "shrink": {"samples": samples}});
        assert_eq!(faults(value), [("/shrink/samples".to_owned(), "out_of_range")]);
    }
}

#[test]
fn a_number_too_large_for_an_index_is_refused_and_not_wrapped() {
    let value = json!({"field": {"scene": {}}, "shrink": {"lattice": {"octahedral": {"n": 4_294_967_298u64}}}});
    assert_eq!(faults(value), [("/shrink/lattice/octahedral/n".to_owned(), "wrong_type")]);
}

#[test]
fn a_fit_is_read_with_its_meshes_and_read_back_as_it_was() {
    let name = |digit: &str| format!("sha256:{}", digit.repeat(64));
    let alone = JobSpec::from_value(&json!({"kind": "fit", "meshes": [name("a")]})).expect("good");
    assert_eq!(alone.outputs, [OutputName::Network, OutputName::Report]);
    let fit = json!({
        "layers": 3, "activation": {"sine": {"w0": 20}}, "learning_rate": 5e-4, "sampling": "grid", "normalize": true,
        "seed": 9,
    });
    let value = json!({"kind": "fit", "meshes": [name("a"), name("b")], "fit": fit, "outputs": ["network"]});
    let spec = JobSpec::from_value(&value).expect("good");
    let Work::Fit(fitting) = &spec.work else { panic!("{spec:?}") };
    assert_eq!((fitting.meshes.len(), fitting.fit.layers, fitting.fit.seed), (2, 3, 9));
    assert_eq!((fitting.fit.learning_rate, fitting.fit.normalize), (5e-4, true));
    assert_eq!(JobSpec::from_value(&serde_json::to_value(&spec).expect("serializes")), Ok(spec));
}

#[test]
fn the_faults_of_a_fit_have_their_places() {
    let found = faults(json!({
        "kind": "fit", "field": {"scene": {}}, "meshes": ["sha256:1", 3],
        "fit": {"layers": "four", "epochs": 0, "normal": -1, "momentum": 0.9, "activation": "swish"},
        "outputs": ["glb"],
    }));
    let expected = [
        ("/field", "unknown_member"),
        ("/meshes/0", "invalid_id"),
        ("/meshes/1", "wrong_type"),
        ("/fit/momentum", "unknown_member"),
        ("/fit/activation", "invalid_value"),
        ("/fit/layers", "invalid_value"),
        ("/fit/epochs", "out_of_range"),
        ("/fit/normal", "out_of_range"),
        ("/outputs/0", "unknown_value"),
    ];
    assert_eq!(found, expected.map(|(p, c)| (p.to_owned(), c)));
    assert_eq!(faults(json!({"kind": "fit"})), [("/meshes".to_owned(), "missing_member")]);
    assert_eq!(faults(json!({"kind": "fit", "meshes": []})), [("/meshes".to_owned(), "too_few")]);
    let kind = json!({"kind": "melt", "field": {"scene": {}}});
    assert_eq!(faults(kind), [("/kind".to_owned(), "unknown_value")]);
}

#[test]
fn what_was_read_is_read_again_as_it_was_stored() {
    let seeds = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("fuzz/seeds/request");
    let mut read = 0;
    for file in std::fs::read_dir(seeds).unwrap().map(|entry| entry.unwrap().path()) {
        let value = serde_json::from_slice(&std::fs::read(&file).unwrap()).unwrap();
        match JobSpec::from_value(&value) {
            Err(faults) => assert!(file.ends_with("faults") && faults.len() >= 4, "{file:?}: {faults:?}"),
            Ok(spec) => {
                read += 1;
                let spec = JobSpec { memory_bytes: Some(7), traceparent: Some("00-a-b-01".to_owned()), ..spec };
                let stored = serde_json::to_value(&spec).unwrap();
                assert_eq!(JobSpec::from_stored(stored.clone()).unwrap(), spec, "{file:?}");
                let faults = JobSpec::from_value(&stored).unwrap_err();
                assert!(
                    faults.iter().any(|fault| fault.pointer == "/memory_bytes"),
                    "no client can say it: {faults:?}"
                );
            }
        }
    }
    assert!(read >= 7);
}
