use crate::field::input::{self, Description, FieldOptions};
use crate::field::network::tensors::{Tensor, Tensors};
use crate::field::{Field, FieldError, Gradients, Points};
use std::path::{Path, PathBuf};

/// What PyTorch says of a file (`tests/reference/write_families.py`).
#[derive(serde::Deserialize)]
struct Expected {
    file: String,
    family: String,
    assumed: Vec<String>,
    options: FieldOptions,
    points: Vec<[f32; 3]>,
    values: Vec<f64>,
    gradients: Vec<[f64; 3]>,
}

fn committed() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/networks/families")
}

/// The cases of a folder; `SHRINKD_FAMILIES` names one with more points than are committed.
fn cases() -> Vec<(Expected, Vec<u8>)> {
    let folder = std::env::var_os("SHRINKD_FAMILIES").map_or_else(committed, PathBuf::from);
    let names = std::fs::read_dir(&folder).unwrap().map(|entry| entry.unwrap().path());
    let mut documents: Vec<PathBuf> = names.filter(|path| path.extension().is_some_and(|e| e == "json")).collect();
    documents.sort();
    let read = |path: &PathBuf| {
        let expected: Expected = serde_json::from_slice(&std::fs::read(path).unwrap()).unwrap();
        let bytes = std::fs::read(folder.join(&expected.file)).unwrap();
        (expected, bytes)
    };
    documents.iter().map(read).collect()
}

fn ask(field: &dyn Field, points: &[[f32; 3]]) -> (Vec<f32>, Vec<[f32; 3]>) {
    let [x, y, z] = [0, 1, 2].map(|axis| points.iter().map(|p| p[axis]).collect::<Vec<f32>>());
    let mut values = vec![0.0; points.len()];
    let [mut gx, mut gy, mut gz] = [0; 3].map(|_| values.clone());
    let into = Gradients { x: &mut gx, y: &mut gy, z: &mut gz };
    field.gradients(Points { x: &x, y: &y, z: &z }, &mut values, into);
    (values, (0..points.len()).map(|i| [gx[i], gy[i], gz[i]]).collect())
}

#[test]
fn every_family_is_told_and_agrees_with_pytorch_in_value_and_gradient() {
    /// Relative error that is allowed.
    const ERROR: f64 = 1e-4;
    /// Values this much smaller than the largest count as that large: they are differences of larger numbers, and with
    /// half of it PyTorch's own single precision is off by 9e-5 on these SIRENs.
    const SMALL: f64 = 2e-2;
    let cases = cases();
    assert!(cases.len() >= 15);
    for (expected, bytes) in cases {
        let file = &expected.file;
        let opened = input::open(&bytes, &expected.options).unwrap_or_else(|e| panic!("{file}: {e}"));
        let detected = opened.detected.expect("a network");
        assert_eq!(serde_json::json!(detected.family), serde_json::json!(expected.family), "{file}: {detected:?}");
        for word in &expected.assumed {
            assert!(detected.assumed.iter().any(|a| a.contains(word)), "{file}: {word} in {detected:?}");
        }
        let (values, gradients) = ask(opened.field.as_ref(), &expected.points);
        let floor = SMALL * expected.values.iter().fold(0.0, |m: f64, v| m.max(v.abs()));
        let (mut worst, mut steepest) = (0.0f64, 0.0f64);
        for i in 0..expected.points.len() {
            let value = expected.values[i];
            worst = worst.max((f64::from(values[i]) - value).abs() / value.abs().max(floor));
            let gradient = glam::DVec3::from(expected.gradients[i]);
            let found = glam::Vec3::from(gradients[i]).as_dvec3();
            steepest = steepest.max((found - gradient).length() / gradient.length());
        }
        println!("{file}: {} points, value {worst:.1e}, gradient {steepest:.1e}", expected.points.len());
        assert!(worst < ERROR && steepest < ERROR, "{file}: value {worst:.1e}, gradient {steepest:.1e}");
    }
}

#[test]
fn a_description_names_the_family_and_what_was_assumed() {
    let bytes = std::fs::read(committed().join("siren.pth")).unwrap();
    let Description::Network { format, detected, layers, .. } =
        input::describe(&bytes, &FieldOptions::default()).unwrap()
    else {
        panic!()
    };
    assert_eq!((format.as_str(), layers), ("torch", vec![24, 24, 24, 24, 1]));
    assert!(detected.because.contains("net.net.0.0"), "{detected:?}");
    let w0 = input::open(&bytes, &options(serde_json::json!({"w0": 12.0}))).unwrap();
    let plain = input::open(&bytes, &FieldOptions::default()).unwrap();
    let p = [[0.3, 0.1, -0.2]];
    assert_ne!(ask(w0.field.as_ref(), &p), ask(plain.field.as_ref(), &p));
}

fn options(json: serde_json::Value) -> FieldOptions {
    serde_json::from_value(json).unwrap()
}

#[test]
fn options_that_a_file_has_no_place_for_are_refused_by_name() {
    let file = |name: &str| std::fs::read(committed().join(name)).unwrap();
    for (name, json, pointer) in [
        ("siren.pth", serde_json::json!({"skip": {"scale": 0.5}}), "/skip"),
        ("igr.pth", serde_json::json!({"w0": 30.0}), "/w0"),
        ("siren.pth", serde_json::json!({"w0": -1.0}), "/w0"),
        ("siren.pth", serde_json::json!({"scale": 0.0}), "/scale"),
        ("deep_sdf_folder.zip", serde_json::json!({"latent_row": 3}), "/latent_row"),
    ] {
        match input::open(&file(name), &options(json)).map(|_| ()) {
            Err(FieldError::Invalid { faults }) => assert_eq!(faults[0].pointer, pointer),
            other => panic!("{name}: {other:?}"),
        }
    }
}

#[test]
fn sign_and_scale_multiply_the_values() {
    let bytes = std::fs::read(committed().join("igr.pth")).unwrap();
    let turned = options(serde_json::json!({"sign": "positive_inside", "scale": 2.0}));
    let points = [[0.1, 0.2, 0.3]];
    let plain = ask(input::open(&bytes, &FieldOptions::default()).unwrap().field.as_ref(), &points);
    let other = ask(input::open(&bytes, &turned).unwrap().field.as_ref(), &points);
    assert_eq!(other.0[0], -2.0 * plain.0[0]);
    assert_eq!(other.1[0], plain.1[0].map(|g| -2.0 * g));
}

fn tensor(shape: &[usize]) -> Tensor {
    Tensor { shape: shape.to_vec(), values: vec![0.1; shape.iter().product()] }
}

fn refusal(list: &[(&str, &[usize])]) -> String {
    let tensors: Tensors = list.iter().map(|(name, shape)| ((*name).to_owned(), tensor(shape))).collect();
    super::read(&tensors, None, None, &super::Hints::default()).expect_err("nothing to be read").to_string()
}

#[test]
fn what_is_not_understood_is_refused_with_the_names_that_are_there_and_what_was_missing() {
    let odd = refusal(&[("encoder.conv1.weight", &[8, 3, 3]), ("encoder.conv1.bias", &[8])]);
    assert!(odd.contains("encoder.conv1.weight") && odd.contains("lin0.weight"), "{odd}");
    let hole = refusal(&[("lin0.weight", &[8, 3]), ("lin0.bias", &[8]), ("lin2.weight", &[1, 8]), ("lin2.bias", &[1])]);
    assert!(hole.contains("layer 1 is missing"), "{hole}");
    let narrow =
        refusal(&[("lin0.weight", &[8, 3]), ("lin0.bias", &[8]), ("lin1.weight", &[1, 9]), ("lin1.bias", &[1])]);
    assert!(narrow.contains("\"lin1\" takes 9 inputs"), "{narrow}");
    let bare = refusal(&[("lin0.weight", &[1, 3])]);
    assert!(bare.contains("\"lin0\" has no bias"), "{bare}");
    let wide = refusal(&[
        ("net.0.0.weight", &[4, 3]),
        ("net.0.0.bias", &[4]),
        ("net.1.0.weight", &[3, 4]),
        ("net.1.0.bias", &[3]),
    ]);
    assert!(wide.contains("3 outputs"), "{wide}");
}

/// A tensor's name and shape.
type Named = (&'static str, &'static [usize]);

/// Two layers with more tensors beside them.
fn two_layers(more: &[Named]) -> Vec<Named> {
    let layers: [Named; 4] =
        [("a.lin0.weight", &[8, 3]), ("a.lin0.bias", &[8]), ("a.lin1.weight", &[1, 8]), ("a.lin1.bias", &[1])];
    [&layers, more].concat()
}

#[test]
fn layer_norms_that_do_not_fit_are_refused_by_name() {
    let both: [Named; 2] = [("a.bn0.weight", &[8]), ("a.bn0.bias", &[8])];
    let cases: [(&[Named], &str); 8] = [
        (&[("a.bn0.weight", &[8])], "\"a.bn0\" has no bias"),
        (&[("a.bn0.bias", &[8])], "\"a.bn0\" has no weight"),
        (&[("a.bn0.weight", &[7]), ("a.bn0.bias", &[8])], "\"a.bn0.weight\" has the shape [7], and \"a.lin0\" has 8"),
        (&[("a.bn0.weight", &[8]), ("a.bn0.bias", &[8, 1])], "\"a.bn0.bias\" has the shape [8, 1]"),
        (&[both[0], both[1], ("a.bn2.weight", &[1])], "\"a.bn2.weight\" belongs to no layer"),
        (&[both[0], both[1], ("a.bn00.bias", &[8])], "\"a.bn00.bias\" belongs to no layer"),
        (&[both[0], both[1], ("a.bn0.running_mean", &[8])], "no layer norm (\"a.bn0.running_mean\")"),
        (&[both[0], both[1], ("a.lin0.weight_v", &[8, 3]), ("a.lin0.weight_g", &[8, 1])], "\"bn0\" beside weight norm"),
    ];
    for (more, expected) in cases {
        let error = refusal(&two_layers(more));
        assert!(error.contains(expected), "{error}");
    }
    let siren: [Named; 5] = [
        ("net.0.0.weight", &[8, 3]),
        ("net.0.0.bias", &[8]),
        ("net.1.0.weight", &[1, 8]),
        ("net.1.0.bias", &[1]),
        ("bn0.weight", &[8]),
    ];
    let error = refusal(&[&siren[..], &[("bn0.bias", &[8])]].concat());
    assert!(error.contains("a layer norm \"bn0\" beside layers named like \"net.0.0\""), "{error}");
}

/// Reads two layers with layer norms of both, with what a specs.json says of their network.
fn normed(specs: &str, norms: bool) -> Result<(super::Network, super::Detected), FieldError> {
    let norm: [Named; 4] = [("a.bn0.weight", &[8]), ("a.bn0.bias", &[8]), ("a.bn1.weight", &[1]), ("a.bn1.bias", &[1])];
    let list = two_layers(if norms { &norm } else { &[] });
    let tensors: Tensors = list.into_iter().map(|(name, shape)| (name.to_owned(), tensor(shape))).collect();
    let specs = (!specs.is_empty()).then(|| serde_json::from_str(specs).unwrap());
    super::read(&tensors, None, specs.as_ref(), &super::Hints::default())
}

#[test]
fn layer_norms_tell_a_deep_sdf_and_that_of_the_last_layer_is_passed_over() {
    let (network, detected) = normed("", true).unwrap();
    assert_eq!(detected.family, super::Family::DeepSdf);
    assert!(detected.because.contains("with layer norms"), "{detected:?}");
    let kept: Vec<bool> = network.layers.iter().map(|layer| layer.norm.is_some()).collect();
    assert_eq!(kept, [true, false]);
    assert_eq!(network.layers[0].norm.as_ref().unwrap().epsilon, 1e-5);
    for said in ["layer norms add 1e-5 to the variance", "the layer norm of the last layer is not used"] {
        assert!(detected.assumed.iter().any(|a| a == said), "{said}: {detected:?}");
    }
    assert_eq!(normed("", false).unwrap().1.family, super::Family::Igr);
}

#[test]
fn layer_norms_that_a_specs_json_says_nothing_of_are_refused() {
    let specs = |network: &str| format!(r#"{{"CodeLength": 0, "NetworkSpecs": {network}}}"#);
    for (network, norms, expected) in [
        (r#"{"weight_norm": true, "norm_layers": [0, 1]}"#, true, "specs.json has weight_norm"),
        (r#"{"norm_layers": [1]}"#, true, "\"bn0\", and no 0 among norm_layers"),
        (
            r#"{"weight_norm": false, "norm_layers": [0]}"#,
            false,
            "0 among norm_layers, and there is no layer norm \"bn0\"",
        ),
    ] {
        let error = normed(&specs(network), norms).unwrap_err().to_string();
        assert!(error.contains(expected), "{error}");
    }
    // as many layers as the example of DeepSDF lists, whatever the network has
    let listed = specs(r#"{"weight_norm": false, "norm_layers": [0, 1, 2, 3, 4, 5, 6, 7]}"#);
    assert!(normed(&listed, true).unwrap().0.layers[0].norm.is_some());
    for nothing in [r#"{}"#, r#"{"norm_layers": null}"#] {
        assert!(normed(&specs(nothing), true).unwrap().0.layers[0].norm.is_some());
    }
}

#[test]
fn the_real_deep_sdf_folders_are_read() {
    let root = std::env::var_os("SHRINKD_DATA")
        .map_or_else(|| PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../shared/data"), PathBuf::from);
    for (name, size, rows, last) in [("round_cross", 1, 20, "identity"), ("primitives", 64, 9824, "tanh")] {
        let Ok(bytes) = super::super::folder::pack(&root.join("networks").join(name)) else {
            println!("skipped: no shared network {name}");
            continue;
        };
        let (network, detected) = super::super::folder::read(&bytes, &super::Hints::default()).unwrap();
        assert_eq!(detected.family, super::Family::DeepSdfStruct);
        assert_eq!((network.latent_size, network.latent_rows()), (size, rows));
        assert_eq!(network.layers.last().unwrap().activation.name(), last);
    }
}
