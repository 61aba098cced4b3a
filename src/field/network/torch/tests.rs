use super::*;
use std::path::PathBuf;

mod hostile;

/// What was written once; `SHRINKD_TORCH` names a folder that was written anew.
fn folder() -> PathBuf {
    let committed = || PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/networks/torch");
    std::env::var_os("SHRINKD_TORCH").map_or_else(committed, PathBuf::from)
}

fn fixture(name: &str) -> Vec<u8> {
    std::fs::read(folder().join(name)).unwrap()
}

/// What `tests/reference/write_torch.py` says is in a fixture.
fn expected(case: &str) -> Tensors {
    let number = |v: &serde_json::Value| match v.as_str() {
        Some(text) => text.parse::<f32>().unwrap(),
        None => v.as_f64().unwrap() as f32,
    };
    let document: serde_json::Value = serde_json::from_slice(&fixture(&format!("{case}.json"))).unwrap();
    let tensor = |entry: &serde_json::Value| super::super::tensors::Tensor {
        shape: entry["shape"].as_array().unwrap().iter().map(|n| n.as_u64().unwrap() as usize).collect(),
        values: entry["values"].as_array().unwrap().iter().map(number).collect(),
    };
    document.as_object().unwrap().iter().map(|(name, entry)| (name.clone(), tensor(entry))).collect()
}

/// Names, shapes and the bits of all numbers; all that is not a number is one value.
fn bits(tensors: &Tensors) -> Vec<(&str, &[usize], Vec<u32>)> {
    let bits = |v: &f32| if v.is_nan() { f32::NAN.to_bits() } else { v.to_bits() };
    tensors.iter().map(|(n, t)| (n.as_str(), t.shape.as_slice(), t.values.iter().map(bits).collect())).collect()
}

/// Both containers of a case hold what PyTorch says.
fn check(case: &str) -> Tensors {
    let expected = expected(case);
    assert!(!expected.is_empty());
    for file in [format!("{case}.pth"), format!("{case}.legacy.pth")] {
        let read = read(&fixture(&file)).unwrap_or_else(|error| panic!("{file}: {error}"));
        assert_eq!(bits(&read), bits(&expected), "{file}");
    }
    expected
}

#[test]
fn a_state_dict_has_the_names_of_its_modules() {
    let tensors = check("siren");
    assert_eq!(tensors["net.net.0.0.weight"].shape, [8, 3]);
    assert_eq!(tensors["net.net.2.0.bias"].shape, [1]);
    assert_eq!(tensors.len(), 6);
}

#[test]
fn weight_norm_is_read_in_both_spellings() {
    let old = check("deepsdf");
    assert!(old["model_state_dict.module.lin0.weight_g"].shape == [6, 1]);
    assert!(old["model_state_dict.module.lin0.weight_v"].shape == [6, 7]);
    let new = check("parametrized");
    assert!(new["model_state_dict.lin1.parametrizations.weight.original0"].shape == [6, 1]);
    assert!(new["model_state_dict.lin1.parametrizations.weight.original1"].shape == [6, 6]);
}

#[test]
fn an_optimizer_and_the_options_of_a_command_line_may_lie_beside_the_weights() {
    let tensors = check("parametrized");
    assert!(tensors.contains_key("optimizer_state_dict.state.0.exp_avg"));
    assert!(tensors.keys().all(|name| !name.starts_with("args")));
}

#[test]
fn latent_codes_are_read_as_an_embedding_a_tensor_and_a_file_of_their_own() {
    assert_eq!(check("latent_embedding")["latent_codes.weight"].shape, [5, 4]);
    assert_eq!(check("latent_tensor")["latent_codes"].shape, [5, 1, 4]);
    assert_eq!(check("latent_code")[""].shape, [1, 1, 4]);
}

#[test]
fn offsets_strides_and_shared_storages_are_honoured() {
    let tensors = check("views");
    assert_eq!(tensors["transposed"].shape, [4, 3]);
    assert_eq!(tensors["scalar"].shape, [0; 0]);
    assert_eq!(tensors["empty"].shape, [0, 3]);
    assert_eq!(tensors["tied"], tensors["tied_again"]);
}

#[test]
fn every_type_of_number_becomes_the_nearest_single() {
    let tensors = check("types");
    assert_eq!(tensors["half"].values[4], 65504.0);
    assert!(tensors["half"].values[11].is_nan());
}

#[test]
fn values_that_are_no_tensors_are_read_past() {
    let tensors = check("nested");
    assert!(tensors.contains_key("deep.0.a.1.0") && tensors.contains_key("by_number.-7"));
}

#[test]
fn tensors_and_parameters_with_attributes_are_tensors() {
    check("attributes");
}

#[test]
fn every_protocol_of_pickles_is_read() {
    for case in ["protocol_3", "protocol_4", "protocol_5"] {
        check(case);
    }
}

#[test]
fn a_file_of_a_whole_module_is_refused_and_says_what_to_save_instead() {
    for file in ["whole_module.pth", "whole_module.legacy.pth"] {
        let Err(FieldError::Unsupported { detail }) = read(&fixture(file)) else { panic!("{file} was read") };
        assert!(detail.contains("__main__.Single") && detail.contains("save the state_dict"), "{detail}");
        assert!(detail.contains("nothing of this one was run"), "{detail}");
    }
}

#[test]
fn complex_numbers_are_refused_by_name() {
    for file in ["complex.pth", "complex.legacy.pth"] {
        let Err(FieldError::Unsupported { detail }) = read(&fixture(file)) else { panic!("{file} was read") };
        assert!(detail.contains("torch.ComplexFloatStorage"), "{detail}");
    }
}

#[test]
fn both_containers_are_told_from_other_files() {
    for file in std::fs::read_dir(folder()).unwrap() {
        let path = file.unwrap().path();
        let bytes = std::fs::read(&path).unwrap();
        let name = path.to_str().unwrap();
        assert_eq!(claims_legacy(&bytes), name.ends_with(".legacy.pth"), "{name}");
        let is_archive = name.ends_with(".pth") && !name.ends_with(".legacy.pth");
        assert_eq!(zip::claims(&bytes) && claims_zip(&zip::entries(&bytes).unwrap()), is_archive, "{name}");
    }
    let npz = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/fixtures/networks/blob.npz");
    let niq = std::fs::read(npz).unwrap();
    assert!(!claims_zip(&zip::entries(&niq).unwrap()));
    for other in [&niq[..], b"", b"\x80", b"{}", b"\x80\x02"] {
        assert!(matches!(read(other), Err(FieldError::Unrecognized { .. })));
    }
}

/// The fixtures are the reader's seeds for fuzzing too.
#[test]
fn the_kept_seeds_hold_no_panic() {
    let seeds = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("fuzz/seeds/torch");
    for file in std::fs::read_dir(seeds).unwrap() {
        let _ = read(&std::fs::read(file.unwrap().path()).unwrap());
    }
}

fn shared(name: &str) -> Option<Tensors> {
    let root = std::env::var_os("SHRINKD_DATA")
        .map_or_else(|| PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../shared/data"), PathBuf::from);
    match std::fs::read(root.join("networks").join(name)) {
        Ok(bytes) => Some(read(&bytes).unwrap_or_else(|error| panic!("{name}: {error}"))),
        Err(_) => {
            println!("skipped: no shared network {name}");
            None
        }
    }
}

/// The dense layers of a checkpoint of the given widths, with weight norm as PyTorch 2 spells it.
fn normalized(prefix: &str, widths: &[(usize, usize)]) -> Vec<(String, Vec<usize>)> {
    let layers = widths.iter().enumerate().flat_map(|(i, &(inputs, outputs))| {
        [("bias", vec![outputs]), ("original0", vec![outputs, 1]), ("original1", vec![outputs, inputs])].map(
            |(name, shape)| {
                let path = if name == "bias" { "" } else { "parametrizations.weight." };
                (format!("{prefix}lin{i}.{path}{name}"), shape)
            },
        )
    });
    layers.collect()
}

fn shapes(tensors: &Tensors) -> Vec<(String, Vec<usize>)> {
    for (name, tensor) in tensors {
        assert_eq!(tensor.values.len(), tensor.shape.iter().product::<usize>(), "{name}");
        assert!(tensor.values.iter().all(|v| v.is_finite()), "{name}");
    }
    tensors.iter().map(|(name, tensor)| (name.clone(), tensor.shape.clone())).collect()
}

#[test]
fn real_checkpoints_of_deep_sdf_have_their_names_and_shapes() {
    if let Some(model) = shared("round_cross/ModelParameters/latest.pth") {
        let widths = [(4, 128), (128, 124), (128, 128), (128, 128), (128, 128), (128, 128), (128, 1)];
        assert_eq!(shapes(&model), normalized("model_state_dict.module.", &widths));
    }
    if let Some(model) = shared("primitives/ModelParameters/latest.pth") {
        let widths = [(67, 128), (128, 128), (128, 128), (128, 128), (128, 1)];
        assert_eq!(shapes(&model), normalized("model_state_dict.", &widths));
    }
    for (file, shape) in [("round_cross", vec![20, 1]), ("primitives", vec![9824, 64])] {
        if let Some(codes) = shared(&format!("{file}/LatentCodes/latest.pth")) {
            assert_eq!(shapes(&codes), [("latent_codes.weight".to_owned(), shape)]);
        }
    }
}
