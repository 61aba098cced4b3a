use super::*;
use crate::field::mesh::tests::thread_time;
use crate::field::network::{Activation, Encoding, Skip};
use crate::field::{Field, Gradients, Points};
use std::path::PathBuf;

/// Written by `tests/reference/write_onnx.py`: by PyTorch's two exporters with and without their simplifications, and by hand.
const FIXTURES: [&str; 17] = [
    "siren",
    "siren_torchscript",
    "deepsdf",
    "deepsdf_two_inputs",
    "deepsdf_one_code",
    "deepsdf_one_code_dynamo",
    "deepsdf_repeated_code",
    "deepsdf_weight_norm",
    "idr",
    "idr_unfolded",
    "idr_unoptimized",
    "idr_encoded",
    "tanh_mapped",
    "tanh_mapped_torchscript",
    "nerf_elu",
    "nerf_elu_torchscript",
    "elu_matmul",
];

fn committed() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/networks/onnx")
}

fn file(name: &str) -> Vec<u8> {
    std::fs::read(committed().join(name)).unwrap()
}

fn fixture(name: &str) -> Vec<u8> {
    file(&format!("{name}.onnx"))
}

fn opened(name: &str) -> Network {
    let network = read(&fixture(name)).unwrap_or_else(|error| panic!("{name}: {error}"));
    assert!(claims(&fixture(name)), "{name}");
    network
}

/// The error relative to what PyTorch's autograd gives in double precision: of a value to its magnitude, but not to less than
/// a hundredth of the largest (single precision rounds the sums that a value near zero is the difference of); of a
/// gradient to its length. `SHRINKD_ONNX` names a folder with the answers of ONNX' own evaluator at more points
/// (`tests/reference/evaluate_onnx.py`), some of them nearer to zero: there the least magnitude is that of the families' test.
#[test]
fn values_and_gradients_are_those_of_the_framework() {
    let (folder, small) = match std::env::var_os("SHRINKD_ONNX") {
        Some(folder) => (PathBuf::from(folder), 2e-2),
        None => (committed(), 1e-2),
    };
    for name in FIXTURES {
        let text = std::fs::read(folder.join(format!("{name}.json"))).unwrap();
        let expected: serde_json::Value = serde_json::from_slice(&text).unwrap();
        let list = |value: &serde_json::Value| -> Vec<f64> {
            value.as_array().unwrap().iter().map(|v| v.as_f64().unwrap()).collect()
        };
        let rows = |key: &str| -> Vec<Vec<f64>> { expected[key].as_array().unwrap().iter().map(list).collect() };
        let latent: Vec<f32> = list(&expected["latent"]).into_iter().map(|v| v as f32).collect();
        let (points, values, gradients) = (rows("points"), list(&expected["values"]), rows("gradients"));
        let field = opened(name).field(&latent).unwrap_or_else(|| panic!("{name} takes another latent code"));
        let column = |axis: usize| points.iter().map(|p| p[axis] as f32).collect::<Vec<f32>>();
        let (x, y, z) = (column(0), column(1), column(2));
        let mut found = vec![0.0; x.len()];
        let mut slopes = [found.clone(), found.clone(), found.clone()];
        let [gx, gy, gz] = &mut slopes;
        field.gradients(Points { x: &x, y: &y, z: &z }, &mut found, Gradients { x: gx, y: gy, z: gz });
        let largest = values.iter().fold(0.0, |m: f64, v| m.max(v.abs()));
        let (mut worst_value, mut worst_gradient) = (0.0f64, 0.0f64);
        for (i, value) in values.iter().enumerate() {
            let error = (f64::from(found[i]) - value).abs() / value.abs().max(small * largest);
            worst_value = worst_value.max(error);
            let length = gradients[i].iter().map(|g| g * g).sum::<f64>().sqrt();
            let off = (0..3).map(|a| (f64::from(slopes[a][i]) - gradients[i][a]).powi(2)).sum::<f64>().sqrt();
            worst_gradient = worst_gradient.max(off / length);
        }
        println!("{name}: {} points, value {worst_value:.1e}, gradient {worst_gradient:.1e}", values.len());
        assert!(worst_value < 1e-4 && worst_gradient < 1e-4, "{name}: {worst_value:e} {worst_gradient:e}");
        assert!(values.len() >= 50);
    }
}

/// What the layers are, without their numbers.
fn outline(network: &Network) -> Vec<(usize, Activation, bool)> {
    network.layers.iter().map(|l| (l.outputs(), l.activation, l.skip == Some(Skip { scale: 1.0 }))).collect()
}

#[test]
fn a_spelled_out_activation_is_the_activation_it_is() {
    let sine = Activation::Sine { w0: 30.0 };
    let siren = vec![(24, sine, false), (24, sine, false), (24, sine, false), (1, Activation::Identity, false)];
    assert_eq!(outline(&opened("siren")), siren);
    assert_eq!(outline(&opened("siren_torchscript")), siren);
    let soft = Activation::Softplus { beta: 100.0 };
    let idr = vec![
        (20, soft, false),
        (17, soft, false),
        (20, soft, true),
        (20, soft, false),
        (1, Activation::Identity, false),
    ];
    for name in ["idr", "idr_unfolded", "idr_unoptimized"] {
        assert_eq!(outline(&opened(name)), idr, "{name}");
    }
}

#[test]
fn a_latent_code_may_be_an_input_of_its_own_or_columns() {
    let relu = |outputs, skip| (outputs, Activation::Relu, skip);
    let last = (1, Activation::Tanh, false);
    let deepsdf = vec![relu(20, false), relu(12, false), relu(20, true), relu(20, false), relu(20, false), last];
    for name in ["deepsdf", "deepsdf_two_inputs", "deepsdf_one_code", "deepsdf_one_code_dynamo", "deepsdf_weight_norm"]
    {
        let network = opened(name);
        assert_eq!((network.latent_size, outline(&network)), (5, deepsdf.clone()), "{name}");
    }
}

#[test]
fn sines_of_the_coordinates_are_the_encoding_of_the_point() {
    assert_eq!(opened("idr_encoded").encoding, Encoding::Positional { frequencies: 3, base: 1.0 });
    assert_eq!(opened("idr_encoded").layers.len(), 5);
    for name in ["nerf_elu", "nerf_elu_torchscript"] {
        let network = opened(name);
        let Encoding::Positional { frequencies: 4, base } = network.encoding else { panic!("{name}") };
        assert!((base - std::f64::consts::PI).abs() < 1e-6, "{name}: {base}");
        assert_eq!(network.layers.len(), 3);
    }
    assert_eq!(opened("siren").encoding, Encoding::Identity);
}

// a writer of the few messages, so that a test can say what is wrong with a model

fn varint(mut value: u64) -> Vec<u8> {
    let mut bytes = Vec::new();
    while value >= 128 {
        bytes.push(value as u8 | 128);
        value >>= 7;
    }
    bytes.push(value as u8);
    bytes
}

fn bytes(number: u64, content: &[u8]) -> Vec<u8> {
    [varint(number << 3 | 2), varint(content.len() as u64), content.to_vec()].concat()
}

fn int(number: u64, value: i64) -> Vec<u8> {
    [varint(number << 3), varint(value.cast_unsigned())].concat()
}

fn named_int(name: &str, value: i64) -> Vec<u8> {
    bytes(5, &[bytes(1, name.as_bytes()), int(3, value), int(20, 2)].concat())
}

fn node(operator: &str, inputs: &[&str], output: &str, attributes: &[Vec<u8>]) -> Vec<u8> {
    let mut content = inputs.iter().flat_map(|name| bytes(1, name.as_bytes())).collect::<Vec<u8>>();
    content.extend(bytes(2, output.as_bytes()));
    content.extend(bytes(3, format!("my {operator}").as_bytes()));
    content.extend(bytes(4, operator.as_bytes()));
    content.extend(attributes.concat());
    bytes(1, &content)
}

fn raw_tensor(name: &str, dims: &[i64], kind: i64, raw: &[u8]) -> Vec<u8> {
    let dims: Vec<u8> = dims.iter().flat_map(|&d| int(1, d)).collect();
    bytes(5, &[dims, int(2, kind), bytes(8, name.as_bytes()), bytes(9, raw)].concat())
}

fn tensor(name: &str, dims: &[i64], numbers: &[f32]) -> Vec<u8> {
    raw_tensor(name, dims, 1, &numbers.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>())
}

fn whole(name: &str, numbers: &[i64]) -> Vec<u8> {
    raw_tensor(name, &[numbers.len() as i64], 7, &numbers.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>())
}

fn info(number: u64, name: &str, dims: &[i64]) -> Vec<u8> {
    let dims: Vec<u8> = dims.iter().flat_map(|&d| bytes(1, &if d < 0 { bytes(2, b"n") } else { int(1, d) })).collect();
    let kind = bytes(1, &[int(1, 1), bytes(2, &dims)].concat());
    bytes(number, &[bytes(1, name.as_bytes()), bytes(2, &kind)].concat())
}

fn model(parts: &[Vec<u8>]) -> Vec<u8> {
    let opset = bytes(8, &[bytes(1, b""), int(2, 17)].concat());
    [int(1, 8), opset, bytes(7, &parts.concat())].concat()
}

/// A model from `xyz` to `sdf`.
fn graph(parts: &[Vec<u8>]) -> Vec<u8> {
    model(&[parts.concat(), info(11, "xyz", &[-1, 3]), info(12, "sdf", &[-1, 1])])
}

fn numbers(count: usize) -> Vec<f32> {
    (0..count).map(|i| ((i * 37 + 11) % 101) as f32 / 101.0 - 0.5).collect()
}

fn refusal(bytes: &[u8]) -> String {
    match read(bytes) {
        Ok(network) => panic!("read as {:?}", outline(&network)),
        Err(error) => error.to_string(),
    }
}

/// One hidden layer of four, then `parts`.
fn after_a_layer(parts: &[Vec<u8>]) -> Vec<u8> {
    let layer = [
        tensor("w", &[3, 4], &numbers(12)),
        tensor("v", &[4, 1], &numbers(4)),
        tensor("u", &[4, 4], &numbers(16)),
        tensor("one", &[], &[1.0]),
        node("MatMul", &["xyz", "w"], "a", &[]),
        node("Relu", &["a"], "h", &[]),
    ];
    graph(&[layer.concat(), parts.concat()])
}

#[test]
fn what_is_not_read_is_refused_by_its_name() {
    let last = || node("MatMul", &["b", "v"], "sdf", &[]);
    let cases: [(Vec<u8>, &str); 14] = [
        (
            node("Loop", &["", "", "h"], "b", &[bytes(5, &[bytes(1, b"body"), bytes(6, b""), int(20, 5)].concat())]),
            "Loop named \"my Loop\"",
        ),
        (node("LeakyRelu", &["h"], "b", &[]), "LeakyRelu named \"my LeakyRelu\""),
        (node("Mul", &["h", "a"], "b", &[]), "a product of two values that depend on the point"),
        (node("Softmax", &["h"], "b", &[]), "Softmax"),
        (node("Exp", &["h"], "b", &[]), "Exp named \"my Exp\": of a value that depends on the point"),
        (
            node(
                "Elu",
                &["h"],
                "b",
                &[bytes(5, &[bytes(1, b"alpha"), vec![0x15], 0.5f32.to_le_bytes().to_vec(), int(20, 1)].concat())],
            ),
            "with the factor 0.5",
        ),
        (node("Clip", &["h", "", "one"], "b", &[]), "a clamp"),
        (node("ReduceSum", &["h"], "b", &[]), "ReduceSum"),
        (node("Transpose", &["h"], "b", &[]), "points with columns"),
        (
            [node("Relu", &["h"], "c", &[]), node("Tanh", &["c"], "d", &[]), node("Add", &["d", "h"], "b", &[])]
                .concat(),
            "residual connections",
        ),
        (
            [node("Sin", &["h"], "c", &[]), node("Relu", &["h"], "d", &[]), node("Add", &["c", "d"], "b", &[])]
                .concat(),
            "in one layer",
        ),
        (
            [tensor("rows", &[2, 4], &numbers(8)), node("Add", &["h", "rows"], "b", &[])].concat(),
            "another one for every point",
        ),
        (node("Cast", &["h"], "b", &[named_int("to", 7)]), "Cast"),
        ([whole("shape", &[-1]), node("Reshape", &["h", "shape"], "b", &[])].concat(), "points and columns are mixed"),
    ];
    for (part, expected) in cases {
        let error = refusal(&after_a_layer(&[part, last()]));
        assert!(error.contains(expected), "{error:?} instead of {expected:?}");
        assert!(error.starts_with("unsupported: the "), "{error}");
    }
    let elsewhere = [bytes(1, b"x"), bytes(2, b"y"), bytes(4, b"Gelu"), bytes(7, b"com.microsoft")].concat();
    let elsewhere = graph(&[bytes(1, &elsewhere), node("Relu", &["y"], "sdf", &[])]);
    assert!(refusal(&elsewhere).contains("com.microsoft::Gelu that gives \"y\""), "{}", refusal(&elsewhere));
}

#[test]
fn models_of_another_kind_are_refused_with_what_they_have() {
    let w = || tensor("w", &[3, 1], &numbers(3));
    let dense = |output: &str| node("MatMul", &["xyz", "w"], output, &[]);
    let external = [int(1, 3), int(1, 1), int(2, 1), bytes(8, b"w"), bytes(13, b""), int(14, 1)].concat();
    let cases = [
        (graph(&[bytes(5, &external), dense("sdf")]), "tensor \"w\" with its numbers in another file"),
        (graph(&[raw_tensor("w", &[3, 1], 3, &[1, 2, 3]), dense("sdf")]), "of the type INT8"),
        (graph(&[w(), dense("sdf"), info(12, "more", &[-1])]), "several outputs, \"more\" and \"sdf\""),
        (graph(&[w(), dense("sdf"), info(11, "a", &[4]), info(11, "b", &[4])]), "third ONNX input"),
        (graph(&[w(), dense("sdf"), info(11, "a", &[-1, 3])]), "which is the point?"),
        (
            model(&[w(), dense("sdf"), info(11, "xyz", &[-1, -1]), info(12, "sdf", &[])]),
            "without a declared number of columns",
        ),
        (model(&[w(), dense("sdf"), info(11, "xyz", &[-1, 2]), info(12, "sdf", &[])]), "points with 2 coordinates"),
        (graph(&[tensor("w", &[3, 2], &numbers(6)), dense("sdf")]), "of 2 numbers for a point, not one"),
        ([int(1, 8), bytes(8, &int(2, 6)), bytes(7, &[])].concat(), "version 6 of the ONNX operators"),
        ([graph(&[]), bytes(25, &bytes(1, b"Mine"))].concat(), "own function \"Mine\""),
    ];
    for (bytes, expected) in cases {
        let error = refusal(&bytes);
        assert!(error.contains(expected) && error.starts_with("unsupported: "), "{error:?} instead of {expected:?}");
    }
}

#[test]
fn broken_graphs_are_refused_with_the_node_or_the_byte() {
    let w = || tensor("w", &[3, 1], &numbers(3));
    let dense = |output: &str| node("MatMul", &["xyz", "w"], output, &[]);
    let mut nan = numbers(3);
    nan[1] = f32::NAN;
    let cases = [
        (graph(&[tensor("w", &[3, 1], &nan), dense("sdf")]), "tensor \"w\" is not finite at number 1 (at byte"),
        (graph(&[tensor("w", &[3, 2], &numbers(3)), dense("sdf")]), "12 bytes for 6 numbers of 4"),
        (graph(&[tensor("w", &[4, 1], &numbers(4)), dense("sdf")]), "a matrix of 4 rows and 1 columns for 3 numbers"),
        (graph(&[tensor("w", &[-3, 1], &numbers(3)), dense("sdf")]), "an axis of length -3"),
        (graph(&[tensor("w", &[1 << 60, 1 << 60], &numbers(3)), dense("sdf")]), "over the limit"),
        (graph(&[tensor("w", &[0, 1], &[]), dense("sdf")]), "a matrix of 0 rows"),
        (
            graph(&[
                tensor("w", &[1 << 60, 1 << 60, 0], &[]),
                node("Transpose", &["w"], "t", &[]),
                node("MatMul", &["xyz", "t"], "sdf", &[]),
            ]),
            "MatMul",
        ),
        (graph(&[w(), w(), dense("sdf")]), "the name \"w\" is given twice"),
        (graph(&[w(), dense("sdf"), dense("sdf")]), "the name \"sdf\" is given twice"),
        (graph(&[dense("sdf")]), "takes \"w\", which nothing before it gives (at byte"),
        (
            graph(&[
                w(),
                node("Add", &["xyz", "b"], "a", &[]),
                node("Relu", &["a"], "b", &[]),
                node("MatMul", &["b", "w"], "sdf", &[]),
            ]),
            "takes \"b\", which nothing before it gives",
        ),
        (graph(&[w(), dense("other")]), "nothing gives the output \"sdf\""),
        (graph(&[node("Identity", &["w"], "sdf", &[]), w()]), "does not depend on the point"),
        (
            graph(&[
                w(),
                node("Div", &["xyz", "zero"], "a", &[]),
                tensor("zero", &[], &[0.0]),
                node("MatMul", &["a", "w"], "sdf", &[]),
            ]),
            "not finite",
        ),
        (model(&[w(), info(12, "sdf", &[])]), "without an input"),
        (model(&[w(), info(11, "xyz", &[-1, 3])]), "without an output"),
        (int(1, 8), "a model without a graph"),
        (
            [int(1, 8), vec![0x3a], varint(1 << 60)].concat(),
            "a field of 1152921504606846976 bytes where 0 are left (at byte 2)",
        ),
        ([int(1, 8), vec![0xff; 40]].concat(), "a number of more than 64 bits (at byte 2)"),
        ([int(1, 8), vec![0x3b]].concat(), "wire type 3"),
        (graph(&[bytes(1, &bytes(4, &[0xff, 0xfe]))]), "is not text in UTF-8"),
    ];
    for (bytes, expected) in cases {
        let error = refusal(&bytes);
        assert!(error.contains(expected), "{error:?} instead of {expected:?}");
    }
    // lengths within lengths: each nested message says that it is longer than the one around it
    let mut nested = vec![0x0a; 60];
    nested.iter_mut().skip(1).step_by(2).for_each(|length| *length = 100);
    assert!(refusal(&graph(&[bytes(1, &nested)])).contains("where 58 are left"));
}

#[test]
fn a_small_file_cannot_ask_for_much() {
    let square = || tensor("w", &[64, 64], &numbers(64 * 64));
    let first = || [tensor("f", &[3, 64], &numbers(192)), node("MatMul", &["xyz", "f"], "x0", &[])].concat();
    let chain = |operator: &str, other: &str| -> Vec<u8> {
        let step = |i: usize| node(operator, &[&format!("x{i}"), other], &format!("x{}", i + 1), &[]);
        let end = node(
            "ReduceSum",
            &["x10000"],
            "sdf",
            &[named_int("keepdims", 0), bytes(5, &[bytes(1, b"axes"), int(8, -1), int(20, 7)].concat())],
        );
        graph(&[square(), tensor("one", &[], &[1.0]), first(), (0..10_000).flat_map(step).collect(), end])
    };
    let huge = || {
        [whole("huge", &[8192, 8192]), tensor("v", &[1, 1], &[1.0]), node("Expand", &["v", "huge"], "e", &[])].concat()
    };
    let wide = || {
        [
            whole("wide", &[3, 2000]),
            tensor("v", &[1, 1], &[1.0]),
            node("Expand", &["v", "wide"], "e", &[]),
            node("MatMul", &["xyz", "e"], "a", &[]),
            node("Sin", &["a"], "b", &[]),
        ]
        .concat()
    };
    let cases = [
        ("ten thousand products", chain("MatMul", "w")),
        ("ten thousand sums", chain("Add", "x0")),
        ("a constant of 2^26 numbers", graph(&[huge(), node("Identity", &["e"], "sdf", &[])])),
        ("a layer of 2^26 weights", graph(&[huge(), node("MatMul", &["xyz", "e"], "sdf", &[])])),
        (
            "layers of sines",
            graph(&[
                wide(),
                node("Sin", &["b"], "c", &[]),
                node("Sin", &["c"], "d", &[]),
                node("ReduceSum", &["d"], "sdf", &[bytes(5, &[bytes(1, b"axes"), int(8, 1), int(20, 7)].concat())]),
            ]),
        ),
        (
            "a range of 2^40 numbers",
            graph(&[
                raw_tensor("a", &[], 7, &0i64.to_le_bytes()),
                raw_tensor("b", &[], 7, &(1i64 << 40).to_le_bytes()),
                raw_tensor("c", &[], 7, &1i64.to_le_bytes()),
                node("Range", &["a", "b", "c"], "sdf", &[]),
            ]),
        ),
    ];
    for (name, bytes) in cases {
        let start = thread_time();
        let error = read(&bytes).unwrap_err();
        let seconds = (thread_time() - start) / 1e9;
        assert!(matches!(error, FieldError::Limit { .. }), "{name}: {error}");
        println!("{name}: {seconds:.3} s, {error}");
        assert!(seconds < 1.0, "{name} took {seconds} s to be refused");
    }
    // multiplying by a number ten thousand times costs nothing but the numbers
    let scaled = read(&chain("Mul", "one")).map(|network| network.layers.len());
    assert!(matches!(scaled, Ok(1)), "{scaled:?}");
}

#[test]
fn the_order_of_a_skip_does_not_matter() {
    let joined = |order: &[&str], weights: Vec<f32>| {
        let parts = [
            tensor("k", &[7, 4], &weights),
            node("Concat", order, "c", &[named_int("axis", -1)]),
            node("MatMul", &["c", "k"], "d", &[]),
            node("Relu", &["d"], "e", &[]),
            node("MatMul", &["e", "v"], "sdf", &[]),
        ];
        read(&after_a_layer(&parts)).unwrap()
    };
    let weights = numbers(28);
    let (first, second) = weights.split_at(12);
    let outputs_first = joined(&["h", "xyz"], [second, first].concat());
    assert_eq!(joined(&["xyz", "h"], weights), outputs_first);
    assert_eq!(outputs_first.layers[1].skip, Some(Skip { scale: 1.0 }));
}

#[test]
fn a_layer_may_be_computed_in_pieces() {
    let whole_layer = [
        tensor("k", &[4, 2], &[1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0]),
        tensor("m", &[2, 1], &[1.0, -1.0]),
        node("MatMul", &["h", "k"], "d", &[]),
        node("Tanh", &["d"], "e", &[]),
        node("MatMul", &["e", "m"], "sdf", &[]),
    ];
    let pieces = [
        tensor("k", &[4, 1], &[1.0, 3.0, 5.0, 7.0]),
        tensor("l", &[4, 1], &[2.0, 4.0, 6.0, 8.0]),
        node("MatMul", &["h", "k"], "d0", &[]),
        node("Tanh", &["d0"], "e0", &[]),
        node("MatMul", &["h", "l"], "d1", &[]),
        node("Tanh", &["d1"], "e1", &[]),
        node("Sub", &["e0", "e1"], "sdf", &[]),
    ];
    assert_eq!(read(&after_a_layer(&pieces)).unwrap(), read(&after_a_layer(&whole_layer)).unwrap());
}

#[test]
fn a_file_that_ends_early_is_refused() {
    for name in ["siren", "deepsdf_one_code", "idr_unoptimized", "elu_matmul"] {
        let bytes = fixture(name);
        let network = opened(name);
        for end in 0..bytes.len() {
            match read(&bytes[..end]) {
                Err(error) => assert!(!error.to_string().is_empty()),
                // behind the graph there is nothing that a network needs
                Ok(cut) => assert!(cut == network && end * 100 > bytes.len() * 95, "{name} cut at {end}"),
            }
        }
    }
}

#[test]
fn no_change_of_bytes_makes_it_panic() {
    let mut state = 0x9E37_79B9_7F4A_7C15u64;
    let mut random = move || {
        // xorshift64
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        state as usize
    };
    let mut accepted = 0;
    for name in FIXTURES {
        let original = fixture(name);
        // weights are most of a file and the least that can go wrong, so changes prefer the ends
        for round in 0..400 {
            let mut bytes = original.clone();
            for _ in 0..1 + random() % 3 {
                let range = if round % 2 == 0 { bytes.len() } else { 700 };
                let at = random() % range;
                let at = if round % 4 == 1 { bytes.len() - 1 - at } else { at };
                bytes[at] = match random() % 3 {
                    0 => random() as u8,
                    1 => bytes[at].wrapping_add(1),
                    _ => 1 << (random() % 8),
                };
            }
            accepted += usize::from(read(&bytes).is_ok());
        }
    }
    println!("{accepted} of {} changed files were still networks", FIXTURES.len() * 400);
    assert!(accepted > 0);
}
