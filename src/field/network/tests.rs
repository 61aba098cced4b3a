use super::*;
use crate::field::grid::npy;
use crate::field::{Field, Gradients, Points};
use proptest::prelude::*;
use std::path::PathBuf;

fn shared(name: &str) -> Option<Vec<u8>> {
    let root = std::env::var_os("SHRINKD_DATA")
        .map_or_else(|| PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../shared/data"), PathBuf::from);
    let read = std::fs::read(root.join("networks").join(name));
    if read.is_err() {
        println!("skipped: no shared network {name}");
    }
    read.ok()
}

fn fixture(name: &str) -> Vec<u8> {
    std::fs::read(PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/networks").join(name)).unwrap()
}

/// Numbers of a fixed sequence that looks random, from -1 to 1 (a Weyl sequence through a mixing step).
fn numbers(seed: u64) -> impl Iterator<Item = f32> {
    let mut state = seed.wrapping_mul(0x9E37_79B9_7F4A_7C15);
    std::iter::repeat_with(move || {
        state = state.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = (state ^ (state >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        ((z >> 40) as f32 / (1u64 << 23) as f32) - 1.0
    })
}

/// A network of the given widths with weights that keep the signal's size.
fn made(
    widths: &[usize],
    activation: Activation,
    encoding: Encoding,
    latent_size: usize,
    skip: Option<(usize, f32)>,
) -> Network {
    let input = latent_size + encoding.size();
    let mut random = numbers(widths.len() as u64 + 17);
    let mut previous = input;
    let layers = (0..=widths.len())
        .map(|i| {
            let outputs = widths.get(i).copied().unwrap_or(1);
            let skip = skip.filter(|s| s.0 == i).map(|s| Skip { scale: s.1 });
            let inputs = previous + if skip.is_some() { input } else { 0 };
            let gain = if let Activation::Sine { w0 } = activation { 2.4 / w0 } else { 1.8 } / (inputs as f32).sqrt();
            let layer = Layer {
                weights: random.by_ref().take(inputs * outputs).map(|r| r * gain).collect(),
                bias: random.by_ref().take(outputs).map(|r| r * 0.1).collect(),
                norm: None,
                activation: if i < widths.len() { activation } else { Activation::Identity },
                skip,
            };
            previous = outputs;
            layer
        })
        .collect();
    let network = Network { encoding, latent_size, ..Network::of_layers(layers) };
    network.check("test").unwrap();
    network
}

/// The network with a layer norm in every layer but the last.
fn with_norms(mut network: Network) -> Network {
    let mut random = numbers(23);
    let hidden = network.layers.len() - 1;
    for layer in &mut network.layers[..hidden] {
        // a sine takes what is small
        let size = if let Activation::Sine { w0 } = layer.activation { 1.5 / w0 } else { 1.0 };
        let outputs = layer.outputs();
        layer.norm = Some(LayerNorm {
            scale: random.by_ref().take(outputs).map(|r| size * (1.0 + 0.5 * r)).collect(),
            shift: random.by_ref().take(outputs).map(|r| size * 0.3 * r).collect(),
            epsilon: 1e-5,
        });
    }
    network.check("test").unwrap();
    network
}

/// The network's value in f64, layer by layer and number by number.
fn plainly(network: &Network, latent: &[f32], p: [f64; 3]) -> f64 {
    let mut input: Vec<f64> = latent.iter().map(|&z| f64::from(z)).collect();
    input.extend(p);
    if let Encoding::Positional { frequencies, base } = network.encoding {
        for k in 0..frequencies {
            let w = base * f64::from(1u32 << k);
            input.extend(p.map(|x| (w * x).sin()));
            input.extend(p.map(|x| (w * x).cos()));
        }
    }
    let mut h = input.clone();
    for layer in &network.layers {
        if let Some(skip) = layer.skip {
            h.extend(&input);
            h.iter_mut().for_each(|x| *x *= f64::from(skip.scale));
        }
        let rows = layer.weights.chunks_exact(h.len()).zip(&layer.bias);
        h = rows
            .map(|(row, &b)| f64::from(b) + row.iter().zip(&h).map(|(&w, x)| f64::from(w) * x).sum::<f64>())
            .collect();
        if let Some(norm) = &layer.norm {
            let mean = h.iter().sum::<f64>() / h.len() as f64;
            let variance = h.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / h.len() as f64;
            let deviation = (variance + f64::from(norm.epsilon)).sqrt();
            for ((x, &scale), &shift) in h.iter_mut().zip(&norm.scale).zip(&norm.shift) {
                *x = f64::from(scale) * (*x - mean) / deviation + f64::from(shift);
            }
        }
        for x in &mut h {
            *x = match layer.activation {
                Activation::Identity => *x,
                Activation::Relu => x.max(0.0),
                Activation::Elu => {
                    if *x > 0.0 {
                        *x
                    } else {
                        x.exp_m1()
                    }
                }
                Activation::Tanh => x.tanh(),
                Activation::Sigmoid => 1.0 / (1.0 + (-*x).exp()),
                Activation::Sine { w0 } => (f64::from(w0) * *x).sin(),
                Activation::Softplus { beta } => {
                    let t = f64::from(beta) * *x;
                    (t.max(0.0) + (-t.abs()).exp().ln_1p()) / f64::from(beta)
                }
            };
        }
    }
    h[0]
}

fn ask(field: &dyn Field, points: &[[f32; 3]]) -> Vec<(f32, [f32; 3])> {
    let column = |axis: usize| points.iter().map(|p| p[axis]).collect::<Vec<f32>>();
    let (x, y, z) = (column(0), column(1), column(2));
    let mut values = vec![0.0; x.len()];
    let (mut gx, mut gy, mut gz) = (values.clone(), values.clone(), values.clone());
    let batch = Points { x: &x, y: &y, z: &z };
    field.gradients(batch, &mut values, Gradients { x: &mut gx, y: &mut gy, z: &mut gz });
    let mut alone = vec![0.0; x.len()];
    field.values(batch, &mut alone);
    assert_eq!(values, alone, "a value does not depend on whether the gradient is asked for");
    (0..x.len()).map(|i| (values[i], [gx[i], gy[i], gz[i]])).collect()
}

fn points(count: usize) -> Vec<[f32; 3]> {
    let mut random = numbers(5);
    (0..count).map(|_| [0; 3].map(|_| random.next().unwrap())).collect()
}

const ACTIVATIONS: [Activation; 8] = [
    Activation::Identity,
    Activation::Relu,
    Activation::Elu,
    Activation::Tanh,
    Activation::Sigmoid,
    Activation::Sine { w0: 30.0 },
    Activation::Softplus { beta: 1.0 },
    Activation::Softplus { beta: 100.0 },
];

#[test]
fn every_activation_encoding_skip_and_norm_gives_the_plain_value_and_its_gradient() {
    for activation in ACTIVATIONS {
        for (encoding, latent_size, skip) in [
            (Encoding::Identity, 0, None),
            (Encoding::Identity, 2, Some((2, 1.0))),
            (Encoding::Positional { frequencies: 3, base: std::f64::consts::PI }, 3, Some((1, 0.70710677))),
        ] {
            let plain = made(&[24, 17, 30], activation, encoding, latent_size, skip);
            let latent: Vec<f32> = numbers(9).take(latent_size).collect();
            for network in [with_norms(plain.clone()), plain] {
                let field = network.field(&latent).unwrap();
                for (p, (value, gradient)) in points(150).iter().zip(ask(&field, &points(150))) {
                    let p = p.map(f64::from);
                    let expected = plainly(&network, &latent, p);
                    let norm = network.layers[0].norm.is_some();
                    let what = format!("{activation:?} {encoding:?} {latent_size} {skip:?} {norm} at {p:?}");
                    assert!(
                        (f64::from(value) - expected).abs() < 2e-5 * expected.abs().max(1.0),
                        "{value} {expected} {what}"
                    );
                    let slopes = |h: f64| {
                        [0, 1, 2].map(|axis| {
                            let at = |step: f64| {
                                let mut q = p;
                                q[axis] += step;
                                plainly(&network, &latent, q)
                            };
                            (at(h) - at(-h)) / (2.0 * h)
                        })
                    };
                    let (fine, coarse) = (slopes(1e-6), slopes(2e-6));
                    let size = fine.iter().fold(1.0f64, |m, g| m.max(g.abs()));
                    for axis in 0..3 {
                        // a kink (ReLU) within the step shows in the two steps' disagreement
                        if (fine[axis] - coarse[axis]).abs() < 1e-5 * size {
                            let difference = (f64::from(gradient[axis]) - fine[axis]).abs();
                            assert!(difference < 2e-4 * size, "{gradient:?} {fine:?} {what}");
                        }
                    }
                }
            }
        }
    }
}

#[test]
fn a_point_gets_the_same_bits_in_every_batch() {
    let plain = made(&[64, 64, 48], Activation::Elu, Encoding::Identity, 0, None);
    let normed = with_norms(made(&[61, 64, 45], Activation::Relu, Encoding::Identity, 0, Some((1, 1.0))));
    for network in [plain, normed] {
        let field = network.field(&[]).unwrap();
        let all = points(700);
        let together = ask(&field, &all);
        for count in [1, 2, 5, 16, 47, 127, 128, 129, 300] {
            for start in [0, 3, 131, 400] {
                assert_eq!(ask(&field, &all[start..start + count]), together[start..start + count], "{start} {count}");
            }
        }
    }
}

fn matches_reference(field: &dyn Field, reference: &[u8]) {
    let header = npy::header(reference, 1 << 20).unwrap();
    assert_eq!(header.shape[1], 7);
    let rows: Vec<[f64; 7]> =
        (0..header.shape[0]).map(|r| std::array::from_fn(|c| header.number(reference, 7 * r + c))).collect();
    let places: Vec<[f32; 3]> = rows.iter().map(|r| [r[0] as f32, r[1] as f32, r[2] as f32]).collect();
    let (mut worst_value, mut worst_gradient) = (0.0f64, 0.0f64);
    for (row, (value, gradient)) in rows.iter().zip(ask(field, &places)) {
        worst_value = worst_value.max((f64::from(value) - row[3]).abs());
        for axis in 0..3 {
            worst_gradient = worst_gradient.max((f64::from(gradient[axis]) - row[4 + axis]).abs());
        }
    }
    println!("against numpy at {} points: value {worst_value:.1e}, gradient {worst_gradient:.1e}", rows.len());
    // f32 against f64 through five to nine layers
    assert!(worst_value < 1e-5 && worst_gradient < 2e-4, "{worst_value} {worst_gradient}");
}

#[test]
fn the_fixtures_agree_with_numpy() {
    let blob = safetensors::read(&fixture("blob.safetensors")).unwrap();
    matches_reference(&blob.field(&[]).unwrap(), &fixture("blob.safetensors.reference.npy"));
    let blob = niq::read(&fixture("blob.npz")).unwrap();
    matches_reference(&blob.field(&[]).unwrap(), &fixture("blob.npz.reference.npy"));
    let morph = safetensors::read(&fixture("morph.safetensors")).unwrap();
    assert_eq!((morph.latent_size, morph.latent_rows()), (2, 5));
    let code = morph.latent_code(2).unwrap();
    matches_reference(&morph.field(code).unwrap(), &fixture("morph.safetensors.reference.npy"));
    assert!(morph.latent_code(5).is_none() && morph.field(&[]).is_none() && morph.field(&[f32::NAN, 0.0]).is_none());
}

#[test]
fn real_networks_of_neural_implicit_queries_are_read() {
    for (name, activation) in [("bunny.npz", Activation::Elu), ("birdcage_occ.npz", Activation::Relu)] {
        let Some(bytes) = shared(&format!("neural-implicit-queries/{name}")) else { return };
        let network = niq::read(&bytes).unwrap();
        assert_eq!(network.layers.len(), 9);
        assert!(network.layers[..8].iter().all(|l| l.activation == activation && l.outputs() == 64));
        let field = network.field(&[]).unwrap();
        for (p, (value, _)) in points(300).iter().zip(ask(&field, &points(300))) {
            let expected = plainly(&network, &[], p.map(f64::from));
            assert!((f64::from(value) - expected).abs() < 2e-5 * expected.abs().max(1.0), "{name} {value} {expected}");
        }
    }
    // written by tests/reference/niq.py, where somebody wants the comparison with numpy itself
    if let (Some(path), Some(bytes)) = (std::env::var_os("NIQ_REFERENCE"), shared("neural-implicit-queries/bunny.npz"))
    {
        let field = niq::read(&bytes).unwrap().field(&[]).unwrap();
        matches_reference(&field, &std::fs::read(path).unwrap());
    }
}

#[test]
fn what_is_written_is_read_back() {
    let encoding = Encoding::Positional { frequencies: 2, base: 1.0 };
    let mut network = made(&[8, 9], Activation::Softplus { beta: 100.0 }, encoding, 2, Some((1, 0.5)));
    network.latent_codes = vec![0.1, 0.2, 0.3, 0.4];
    network.lipschitz = Some(1.5);
    network.metric = Metric::Sign;
    network.domain = Domain { min: [-1.0, -2.0, -3.0], max: [1.0, 1.5, 0.1] };
    for network in [with_norms(network.clone()), network] {
        let bytes = safetensors::write(&network);
        assert_eq!(safetensors::read(&bytes).unwrap(), network);
        assert_eq!(safetensors::write(&network), bytes);
    }
}

#[test]
fn all_parameters_are_given_and_taken_in_one_order() {
    let mut network = with_norms(made(&[8, 9], Activation::Relu, Encoding::Identity, 0, None));
    let list: Vec<f32> = (0..network.parameters()).map(|i| i as f32).collect();
    assert_eq!(list.len(), 8 * 3 + 3 * 8 + 9 * 8 + 3 * 9 + 9 + 1);
    network.set_weights(&list);
    assert_eq!(network.weights(), list);
    let norm = network.layers[0].norm.as_ref().unwrap();
    assert_eq!((network.layers[0].bias[0], norm.scale[0], norm.shift[0]), (24.0, 32.0, 40.0));
}

/// The architecture of a written network, changed.
fn rewritten(change: impl Fn(&mut serde_json::Value)) -> Vec<u8> {
    rewritten_of(&made(&[8, 9], Activation::Relu, Encoding::Identity, 0, None), change)
}

fn rewritten_of(network: &Network, change: impl Fn(&mut serde_json::Value)) -> Vec<u8> {
    let bytes = safetensors::write(network);
    let length = u64::from_le_bytes(bytes[..8].try_into().unwrap()) as usize;
    let mut header: serde_json::Value = serde_json::from_slice(&bytes[8..8 + length]).unwrap();
    let mut architecture = serde_json::from_str(header["__metadata__"]["architecture"].as_str().unwrap()).unwrap();
    change(&mut architecture);
    header["__metadata__"]["architecture"] = architecture.to_string().into();
    let text = header.to_string().into_bytes();
    [&(text.len() as u64).to_le_bytes()[..], &text, &bytes[8 + length..]].concat()
}

#[test]
fn an_architecture_that_does_not_fit_its_tensors_is_refused_by_name() {
    type Change = fn(&mut serde_json::Value);
    let cases: [(Change, &str); 8] = [
        (|a| a["layers"][1]["outputs"] = 10.into(), "layer 1 has 10 outputs"),
        (|a| a["layers"][1]["skip"] = serde_json::json!({"scale": 1.0}), "layer 1 takes 8 inputs where 11 arrive"),
        (|a| a["latent_size"] = 1.into(), "layer 0 takes 3 inputs where 4 arrive"),
        (|a| a["layers"][0]["activation"] = serde_json::json!({"sine": {"w0": -1.0}}), "layer 0 has a parameter"),
        (|a| a["layers"][0]["activation"] = "swish".into(), "swish"),
        (|a| a["version"] = 2.into(), "version 2"),
        (|a| a["momentum"] = 2.into(), "momentum"),
        (|a| a["layers"].as_array_mut().unwrap().truncate(2), "belongs to no layer"),
    ];
    for (change, expected) in cases {
        let error = safetensors::read(&rewritten(change)).unwrap_err().to_string();
        assert!(error.contains(expected), "{error}");
    }
}

#[test]
fn a_layer_norm_that_does_not_fit_is_refused_by_name() {
    type Change = fn(&mut serde_json::Value);
    let plain = made(&[8, 9], Activation::Relu, Encoding::Identity, 0, None);
    let normed = with_norms(plain.clone());
    let without = |a: &mut serde_json::Value| _ = a["layers"][1].as_object_mut().unwrap().remove("layer_norm");
    let cases: [(&Network, Change, &str); 6] = [
        (&plain, |a| a["layers"][1]["layer_norm"] = serde_json::json!({}), "\"layers.1.norm.scale\" is missing"),
        (&normed, |a| a["layers"][0]["layer_norm"]["epsilon"] = 0.into(), "the epsilon of the layer norm of layer 0"),
        (
            &normed,
            |a| a["layers"][0]["layer_norm"]["epsilon"] = 1e300.into(),
            "the epsilon of the layer norm of layer 0",
        ),
        (&normed, |a| a["layers"][0]["layer_norm"]["eps"] = 1.into(), "eps"),
        (&normed, |a| a["layers"][0]["batch_norm"] = serde_json::json!({}), "batch_norm"),
        (&normed, without, "\"layers.1.norm.scale\" belongs to no layer"),
    ];
    for (network, change, expected) in cases {
        let error = safetensors::read(&rewritten_of(network, change)).unwrap_err().to_string();
        assert!(error.contains(expected), "{error}");
    }
    let default = safetensors::read(&rewritten_of(&normed, |a| a["layers"][1]["layer_norm"] = serde_json::json!({})));
    assert_eq!(default.unwrap(), normed);

    let broken = |change: fn(&mut Network)| {
        let mut network = normed.clone();
        change(&mut network);
        safetensors::read(&safetensors::write(&network)).unwrap_err().to_string()
    };
    let last = broken(|n| n.layers[2].norm = Some(LayerNorm { scale: vec![1.0], shift: vec![0.0], epsilon: 1e-5 }));
    assert!(last.contains("layer 2 has a layer norm"), "{last}");
    let short = broken(|n| n.layers[1].norm.as_mut().unwrap().shift.truncate(4));
    assert!(short.contains("layer 1 has 9 scales and 4 shifts for 9 outputs"), "{short}");
    let endless = broken(|n| n.layers[1].norm.as_mut().unwrap().scale[3] = f32::INFINITY);
    assert!(endless.contains("number 3 of tensor \"layers.1.norm.scale\" is not finite"), "{endless}");
}

#[test]
fn numbers_that_are_not_finite_are_refused_with_their_place() {
    let mut network = made(&[8, 9], Activation::Relu, Encoding::Identity, 0, None);
    network.layers[1].weights[5] = f32::NAN;
    let error = safetensors::read(&safetensors::write(&network)).unwrap_err().to_string();
    assert!(error.contains("number 5 of tensor \"layers.1.weight\" is not finite"), "{error}");
}

#[test]
fn broken_archives_are_refused_with_the_entry_or_the_byte() {
    let bytes = fixture("blob.npz");
    for cut in [10, 100, bytes.len() / 2, bytes.len() - 1] {
        assert!(matches!(niq::read(&bytes[..cut]), Err(FieldError::Malformed { at: Some(_), .. })), "cut at {cut}");
    }
    // one bit in the packed numbers of the first entry
    let mut flipped = bytes.clone();
    flipped[300] ^= 1;
    let error = niq::read(&flipped).unwrap_err().to_string();
    assert!(error.contains("0000.dense.A.npy"), "{error}");
    // the central directory claims a thousand times the size
    let mut bomb = bytes.clone();
    let record = bomb.windows(4).position(|w| w == b"PK\x01\x02").unwrap();
    bomb[record + 24..record + 28].copy_from_slice(&200_000_000u32.to_le_bytes());
    assert!(niq::read(&bomb).unwrap_err().to_string().contains("deflate"));
}

#[test]
fn limits_are_kept() {
    let mut deep = made(&[8; 60], Activation::Relu, Encoding::Identity, 0, None);
    let hidden = deep.layers[1].clone();
    deep.layers.splice(1..1, std::iter::repeat_n(hidden, 4));
    assert!(matches!(safetensors::read(&safetensors::write(&deep)), Err(FieldError::Limit { found: 65, .. })));
    let header = [&(u64::MAX / 2).to_le_bytes()[..], b"{}"].concat();
    assert!(matches!(safetensors::read(&header), Err(FieldError::Limit { .. })));
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(300))]

    /// No cut and no change of bytes makes a loader panic.
    #[test]
    fn broken_bytes_never_panic(cut in any::<usize>(), changes in prop::collection::vec((any::<usize>(), any::<u8>()), 0..4)) {
        let normed = with_norms(made(&[8, 9], Activation::Relu, Encoding::Identity, 0, None));
        for mut bytes in [fixture("blob.npz"), rewritten(|_| {}), safetensors::write(&normed)] {
            for &(at, value) in &changes {
                let at = at % bytes.len();
                bytes[at] = value;
            }
            bytes.truncate(cut % (2 * bytes.len()));
            let _ = niq::read(&bytes);
            let _ = safetensors::read(&bytes);
        }
    }

    /// Nor in the small parts that say how the rest is to be read.
    #[test]
    fn broken_headers_never_panic(at in 0usize..1200, value in any::<u8>()) {
        let mut tail = fixture("blob.npz");
        let end = tail.len() - 1 - at.min(tail.len() - 1);
        tail[end] = value;
        let _ = niq::read(&tail);
        let mut head = rewritten(|_| {});
        let at = at % head.len();
        head[at] = value;
        let _ = safetensors::read(&head);
    }
}
