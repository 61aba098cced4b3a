use super::*;
use crate::field::{Gradients, Points};
use std::path::PathBuf;

fn fixture(name: &str) -> Vec<u8> {
    std::fs::read(PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/networks").join(name)).unwrap()
}

fn options(json: serde_json::Value) -> FieldOptions {
    serde_json::from_value(json).unwrap()
}

/// The cube from 0 to 1 as OFF, one side after the other.
const CUBE: &[u8] = b"OFF\n8 6 12\n0 0 0\n1 0 0\n1 1 0\n0 1 0\n0 0 1\n1 0 1\n1 1 1\n0 1 1\n\
4 0 3 2 1\n4 4 5 6 7\n4 0 1 5 4\n4 2 3 7 6\n4 1 2 6 5\n4 0 4 7 3\n";

/// The field alone.
fn open(bytes: &[u8], options: &FieldOptions) -> Result<Box<dyn Field>, FieldError> {
    super::open(bytes, options).map(|opened| opened.field)
}

/// Value and gradient at one point.
fn at(field: &dyn Field, p: [f32; 3]) -> (f32, [f32; 3]) {
    let (mut v, mut g) = ([0.0], [[0.0]; 3]);
    let [gx, gy, gz] = &mut g;
    let batch = Points { x: &p[..1], y: &p[1..2], z: &p[2..] };
    field.gradients(batch, &mut v, Gradients { x: gx, y: gy, z: gz });
    let mut alone = [0.0];
    field.values(batch, &mut alone);
    assert_eq!(alone, v);
    (v[0], [g[0][0], g[1][0], g[2][0]])
}

/// The pointers and codes of the faults that the options meet on these bytes.
fn faults(bytes: &[u8], json: serde_json::Value) -> Vec<(String, &'static str)> {
    match open(bytes, &options(json)) {
        Err(FieldError::Invalid { faults }) => faults.into_iter().map(|f| (f.pointer, f.code)).collect(),
        other => panic!("{:?}", other.map(|f| f.domain())),
    }
}

#[test]
fn networks_are_opened_with_their_latent_code() {
    let blob = open(&fixture("blob.safetensors"), &FieldOptions::default()).unwrap();
    assert!(at(&*blob, [0.0, -0.15, 0.0]).0 < -0.3 && at(&*blob, [0.9, 0.9, 0.9]).0 > 0.3);
    let morph = fixture("morph.safetensors");
    let by_row = open(&morph, &options(serde_json::json!({"latent_row": 1}))).unwrap();
    let code = crate::field::network::safetensors::read(&morph).unwrap().latent_code(1).unwrap().to_vec();
    let by_code = open(&morph, &options(serde_json::json!({"latent": code}))).unwrap();
    let other = open(&morph, &options(serde_json::json!({"latent": [code[0], -code[1]]}))).unwrap();
    let p = [0.4, 0.1, -0.2];
    assert_eq!(at(&*by_row, p), at(&*by_code, p));
    assert_ne!(at(&*by_row, p), at(&*other, p));
}

#[test]
fn options_that_do_not_fit_are_refused_at_their_member() {
    let morph = fixture("morph.safetensors");
    let one = |pointer: &str, code| vec![(pointer.to_owned(), code)];
    assert_eq!(faults(&morph, serde_json::json!({})), one("/latent", "missing"));
    assert_eq!(faults(&morph, serde_json::json!({"latent": [1.0]})), one("/latent", "wrong_length"));
    assert_eq!(faults(&morph, serde_json::json!({"latent_row": 5})), one("/latent_row", "out_of_range"));
    assert_eq!(
        faults(&morph, serde_json::json!({"latent": [0.0, 0.0], "latent_row": 5})),
        one("/latent_row", "conflict")
    );
    assert_eq!(faults(&morph, serde_json::json!({"latent_row": 0, "domain": "fit"})), one("/domain", "not_offered"));
    let blob = fixture("blob.npz");
    assert_eq!(faults(&blob, serde_json::json!({"latent": [1.0]})), one("/latent", "wrong_length"));
    assert_eq!(faults(&blob, serde_json::json!({"latent_row": 0})), one("/latent_row", "out_of_range"));
    assert_eq!(
        faults(&blob, serde_json::json!({"activation": {"sine": {"w0": -3.0}}})),
        one("/activation", "out_of_range")
    );
    assert_eq!(
        faults(CUBE, serde_json::json!({"latent": [1.0], "activation": "relu", "transform": {"scale": 0.0}})),
        [
            ("/transform/scale".to_owned(), "out_of_range"),
            ("/latent".to_owned(), "not_offered"),
            ("/activation".to_owned(), "not_offered")
        ]
    );
    let turned =
        serde_json::json!({"transform": {"rotate": {"axis": [0, 0, 0], "angle": 1}, "translate": [0, 1e9, 0]}});
    assert_eq!(
        faults(CUBE, turned),
        [("/transform/rotate/axis".to_owned(), "out_of_range"), ("/transform/translate/1".to_owned(), "out_of_range")]
    );
    let empty = serde_json::json!({"domain": {"min": [0, 0, 0], "max": [1, 0, 1]}});
    assert_eq!(faults(CUBE, empty), one("/domain/max/1", "empty"));
    assert_eq!(faults(CUBE, serde_json::json!({"level": 1e9})), one("/level", "out_of_range"));
    let unknown = serde_json::from_value::<FieldOptions>(serde_json::json!({"latents": []}));
    assert!(unknown.unwrap_err().to_string().contains("latents"));
}

#[test]
fn a_mesh_moves_with_its_transform_and_stays_the_truth() {
    let transform =
        serde_json::json!({"scale": 2.0, "rotate": {"axis": [0, 0, 3], "angle": 90}, "translate": [5, 0, 0]});
    let field = open(CUBE, &options(serde_json::json!({"transform": transform}))).unwrap();
    // x from 0 to 1 became y from 0 to 2, and y became -x
    let (value, gradient) = at(&*field, [4.0, 2.5, 1.0]);
    assert!((value - 0.5).abs() < 1e-6 && (gradient[1] - 1.0).abs() < 1e-6, "{value} {gradient:?}");
    let (min, max) = field.truth().unwrap().bounds();
    for (found, expected) in min.into_iter().chain(max).zip([3.0, 0.0, 0.0, 5.0, 2.0, 2.0]) {
        assert!((found - expected).abs() < 1e-12);
    }
    assert_eq!(field.metric(), Metric::Exact);
}

#[test]
fn a_network_moves_with_its_transform() {
    let bytes = fixture("blob.npz");
    let plain = open(&bytes, &FieldOptions::default()).unwrap();
    let transform =
        serde_json::json!({"scale": 3.0, "rotate": {"axis": [0, 0, 1], "angle": 90}, "translate": [0, 0, 1]});
    let moved = open(&bytes, &options(serde_json::json!({"transform": transform}))).unwrap();
    for p in [[0.25, 0.5, 0.125], [-0.5, 0.25, 0.0], [0.0, -0.75, 0.5f32]] {
        let (v, g) = at(&*plain, p);
        let (w, h) = at(&*moved, [-3.0 * p[1], 3.0 * p[0], 3.0 * p[2] + 1.0]);
        assert!((w - 3.0 * v).abs() < 1e-5, "{w} {v}");
        for (found, expected) in h.into_iter().zip([-g[1], g[0], g[2]]) {
            assert!((found - expected).abs() < 1e-5, "{h:?} {g:?}");
        }
    }
    // beyond the moved box the distance to it takes over
    let (value, gradient) = at(&*moved, [0.0, 0.0, 10.0]);
    assert!(value >= 6.0 && gradient[2] == 1.0);
    for (found, expected) in moved.domain().max.into_iter().zip([3.0, 3.0, 4.0]) {
        assert!((found - expected).abs() < 1e-9);
    }
}

#[test]
fn a_level_grows_a_mesh_with_its_domain() {
    let plain = open(CUBE, &FieldOptions::default()).unwrap();
    let grown = open(CUBE, &options(serde_json::json!({"level": 0.25}))).unwrap();
    assert_eq!(at(&*grown, [0.5, 0.5, 1.5]).0, 0.25);
    assert_eq!(grown.domain().max[0], plain.domain().max[0] + 0.25);
    assert!(plain.truth().is_some() && grown.truth().is_none());
    assert_eq!(grown.metric(), Metric::Bound);
}

#[test]
fn a_domain_that_is_given_is_the_field_s() {
    let given = serde_json::json!({"min": [-2, -2, -2], "max": [2, 2, 3]});
    for bytes in [CUBE.to_vec(), fixture("blob.npz")] {
        let field = open(&bytes, &options(serde_json::json!({"domain": given}))).unwrap();
        assert_eq!(field.domain().max, [2.0, 2.0, 3.0]);
    }
    assert_eq!(open(CUBE, &options(serde_json::json!({"domain": "fit"}))).unwrap().domain().max, [1.12; 3]);
}

#[test]
fn an_activation_takes_the_place_of_the_file_s() {
    let plain = open(&fixture("blob.npz"), &FieldOptions::default()).unwrap();
    let same = open(&fixture("blob.npz"), &options(serde_json::json!({"activation": "elu"}))).unwrap();
    let other = open(&fixture("blob.npz"), &options(serde_json::json!({"activation": "tanh"}))).unwrap();
    let p = [0.2, 0.3, 0.4];
    assert_eq!(at(&*plain, p), at(&*same, p));
    assert_ne!(at(&*plain, p), at(&*other, p));
}

#[test]
fn a_scene_takes_its_domain_before_or_after_its_transform() {
    let sphere = br#"{"sphere": {"radius": 0.5}}"#;
    let transform = serde_json::json!({"scale": 2.0, "translate": [4, 0, 0]});
    let open = |json| open(sphere, &options(json)).unwrap();
    let plain = open(serde_json::json!({"transform": transform}));
    assert!((at(&*plain, [5.5, 0.0, 0.0]).0 - 0.5).abs() < 1e-6);
    assert_eq!((plain.domain().min[0], plain.domain().max[0]), (2.0, 6.0));
    let fitted = open(serde_json::json!({"transform": transform, "domain": "fit"})).domain();
    assert!(fitted.min[0] > 2.0 && fitted.min[0] < 3.0 && fitted.max[0] > 5.0 && fitted.max[0] < 6.0, "{fitted:?}");
    let given = serde_json::json!({"min": [2.5, -2, -2], "max": [5.5, 2, 2]});
    assert_eq!(open(serde_json::json!({"transform": transform, "domain": given})).domain().min, [2.5, -2.0, -2.0]);
    assert_eq!(open(serde_json::json!({"domain": given})).domain().min, [2.5, -2.0, -2.0]);
}

#[test]
fn a_flat_scene_only_moves_in_its_plane() {
    let circle = br#"{"circle": {"radius": 0.5}}"#;
    let turned = serde_json::json!({"transform": {"rotate": {"axis": [0, 0, 1], "angle": 30}, "translate": [1, 0, 0]}});
    let field = open(circle, &options(turned)).unwrap();
    assert_eq!(field.dimension(), 2);
    let (value, gradient) = at(&*field, [1.75, 0.0, 9.0]);
    assert!((value - 0.25).abs() < 1e-6 && (gradient[0] - 1.0).abs() < 1e-6 && gradient[2] == 0.0);
    let tilted = serde_json::json!({"transform": {"rotate": {"axis": [1, 0, 0], "angle": 30}}});
    assert_eq!(faults(circle, tilted), [("/transform".to_owned(), "not_offered")]);
}

#[test]
fn files_are_described() {
    let describe = |bytes: &[u8]| serde_json::to_value(describe(bytes, &FieldOptions::default()).unwrap()).unwrap();
    let blob = describe(&fixture("blob.npz"));
    assert_eq!(blob["kind"], "network");
    assert_eq!(blob["format"], "npz");
    assert_eq!(blob["layers"], serde_json::json!([32, 32, 32, 32, 1]));
    assert_eq!(blob["activation"], "elu");
    let morph = describe(&fixture("morph.safetensors"));
    assert_eq!((&morph["latent_size"], &morph["latent_rows"]), (&2.into(), &5.into()));
    let cube = describe(CUBE);
    assert_eq!((&cube["kind"], &cube["vertices"], &cube["triangles"]), (&"mesh".into(), &8.into(), &12.into()));
    assert_eq!((&cube["closed"], &cube["euler"]), (&true.into(), &2.into()));
    let read: Description = serde_json::from_value(cube.clone()).unwrap();
    assert_eq!(serde_json::to_value(read).unwrap(), cube);
}

#[test]
fn files_that_are_not_read_are_refused_by_the_name_of_what_they_are() {
    let zip_of = |name: &str| {
        let mut bytes = b"PK\x03\x04".to_vec();
        bytes.resize(30, 0);
        let central = bytes.len() as u32;
        bytes.extend(b"PK\x01\x02");
        bytes.resize(bytes.len() + 24, 0);
        bytes.extend((name.len() as u16).to_le_bytes());
        bytes.resize(central as usize + 46, 0);
        bytes.extend(name.bytes());
        let size = bytes.len() as u32 - central;
        bytes.extend(b"PK\x05\x06\0\0\0\0\x01\0\x01\0");
        bytes.extend(size.to_le_bytes());
        bytes.extend(central.to_le_bytes());
        bytes.extend([0, 0]);
        bytes
    };
    let cases = [
        (zip_of("archive/data.pkl"), "PyTorch"),
        (zip_of("readme.txt"), "zip archive"),
        (b"\x80\x02\x8a\x0al\xfc\x9cF\xf9 j\xa8P\x19.".to_vec(), "PyTorch"),
        (b"\x08\x08\x12\x07pytorch".to_vec(), "ONNX"),
        (b"\x80\x04\x95".to_vec(), "pickle"),
    ];
    for (bytes, name) in cases {
        let refusal = describe(&bytes, &FieldOptions::default()).expect_err("no field").to_string();
        assert!(refusal.contains(name), "{refusal}");
    }
    for bytes in [&b""[..], b"\0", b"<html></html>", b"hello", &[0xff; 300]] {
        assert!(matches!(describe(bytes, &FieldOptions::default()), Err(FieldError::Unrecognized { .. })), "{bytes:?}");
    }
}

#[test]
fn seeds_of_the_fuzz_targets_are_read_but_for_those_that_are_there_to_be_refused() {
    let seeds = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("fuzz/seeds");
    let refused = [
        ("mesh", &["too_long.stl", "too_many.ply", "own_child.glb"][..]),
        ("npy", &["codes_fortran", "cut", "integers", "no_columns", "not_finite", "too_many", "two_axes"]),
        (
            "safetensors",
            &["deep_sdf_half_a_norm", "long_header", "overflowing_shape", "own_not_finite", "own_wrong_width"],
        ),
        ("scene", &["cut", "deep", "faults", "numbers"]),
    ];
    let mut wrong = Vec::new();
    for (target, refused) in refused {
        for entry in std::fs::read_dir(seeds.join(target)).unwrap() {
            let path = entry.unwrap().path();
            let name = path.file_name().unwrap().to_str().unwrap();
            let described = describe(&std::fs::read(&path).unwrap(), &FieldOptions::default());
            if described.is_err() != refused.contains(&name) {
                wrong.push(format!("{target}/{name}: {described:?}"));
            }
        }
    }
    assert!(wrong.is_empty(), "{wrong:#?}");
}
