use super::*;
use crate::field::input::{FieldOptions, open_network};
use crate::field::network::{Activation, Encoding, Layer, LayerNorm, Network, safetensors as own};
use crate::field::{Domain, Metric};
use crate::measure::fixtures::with_settings;

/// |p| - 1/2 - z, nearly: a layer of sine has value and slope of the first coordinate, which is all that the tests look at.
fn wave() -> Network {
    // f(p) = sin(p_x + z): zero at p_x = -z
    Network {
        layers: vec![
            Layer {
                weights: vec![1.0, 1.0, 0.0, 0.0],
                bias: vec![0.0],
                norm: None,
                activation: Activation::Sine { w0: 1.0 },
                skip: None,
            },
            Layer { weights: vec![2.0], bias: vec![0.0], norm: None, activation: Activation::Identity, skip: None },
        ],
        encoding: Encoding::Identity,
        latent_size: 1,
        latent_codes: vec![0.25],
        domain: Domain::default(),
        metric: Metric::Bound,
        lipschitz: None,
    }
}

fn placed(options: &str) -> Placed {
    let options: FieldOptions = serde_json::from_str(options).unwrap();
    open_network(&own::write(&wave()), &options).unwrap().0
}

#[test]
fn a_plane_moves_as_its_code_says() {
    // the plane x = -z moves by -1 in x per unit of z, whatever the slope of the field
    let vertices = [[-0.25, 0.1, 0.2], [-0.25, -0.3, 0.4]];
    with_settings(2, |settings| {
        let placed = placed("{}");
        let motion = latent_motion(&placed, &vertices, settings).unwrap();
        assert!(motion.iter().all(|m| (m + 1.0).abs() < 1e-6), "{motion:?}");
        let made = sensitivity(&placed, &vertices, &[[3.0, 7.0, 7.0], [1.0, 0.0, 0.0]], settings).unwrap();
        assert!((made.latent[0] + 4.0).abs() < 1e-5, "{made:?}");
        // the last bias adds 1 to f, whose slope is 2
        assert!((made.weights[6] + 2.0).abs() < 1e-5, "{made:?}");
        // the weight of x adds x = -1/4 inside the sine, and that of the code z = 1/4
        assert!((made.weights[1] - 1.0).abs() < 1e-5 && (made.weights[0] + 1.0).abs() < 1e-5, "{made:?}");
    });
}

#[test]
fn a_transform_turns_and_stretches_the_motion_and_a_sign_does_not_change_it() {
    let turned = r#"{"transform": {"scale": 3, "rotate": {"axis": [0, 0, 1], "angle": 90}, "translate": [5, 0, 0]},
                     "sign": "positive_inside"}"#;
    with_settings(1, |settings| {
        let placed = placed(turned);
        // x = -1/4 becomes y = -3/4
        let vertices = [[5.3, -0.75, 0.6]];
        let motion = latent_motion(&placed, &vertices, settings).unwrap();
        assert!((motion[0] + 3.0).abs() < 1e-5, "{motion:?}");
        let made = sensitivity(&placed, &vertices, &[[9.0, 2.0, 9.0]], settings).unwrap();
        assert!((made.latent[0] + 6.0).abs() < 1e-4, "{made:?}");
    });
}

#[test]
fn the_sums_are_the_same_for_any_number_of_threads() {
    let vertices: Vec<[f32; 3]> = (0..9000).map(|i| [-0.25, i as f32 * 1e-4, 0.3]).collect();
    let by_vertex: Vec<[f64; 3]> = (0..9000).map(|i| [f64::from(i).sin(), 0.0, 0.0]).collect();
    let of = |threads| with_settings(threads, |s| sensitivity(&placed("{}"), &vertices, &by_vertex, s).unwrap());
    assert_eq!(of(1), of(4));
}

#[test]
fn gradients_are_read_by_vertex_and_by_grid_point() {
    let welded = Welded { positions: vec![[0.0; 3]; 3], grid: [2, 2], vertex: vec![0, 0, 1, 2] };
    let file = |shape: &[usize], list: &[f64]| {
        let bytes: Vec<u8> = list.iter().flat_map(|v| v.to_le_bytes()).collect();
        let view = TensorView::new(Dtype::F64, shape.to_vec(), &bytes).unwrap();
        safetensors::serialize([("gradient", view)], None).unwrap()
    };
    let numbers: Vec<f64> = (0..12).map(f64::from).collect();
    let by_vertex = welded.gradient(&file(&[3, 3], &numbers[..9])).unwrap();
    assert_eq!(by_vertex, [[0.0, 1.0, 2.0], [3.0, 4.0, 5.0], [6.0, 7.0, 8.0]]);
    let by_point = welded.gradient(&file(&[2, 2, 3], &numbers)).unwrap();
    assert_eq!(by_point, [[3.0, 5.0, 7.0], [6.0, 7.0, 8.0], [9.0, 10.0, 11.0]]);
    assert!(welded.gradient(&file(&[4, 3], &numbers)).unwrap_err().contains("takes [3, 3] or [2, 2, 3]"));
    assert!(welded.gradient(&file(&[1, 3], &[f64::NAN, 0.0, 0.0])).unwrap_err().contains("not finite"));
    assert!(welded.gradient(b"no safetensors").is_err());
}

#[test]
fn derivatives_by_a_layer_norm_are_written_under_the_names_of_its_tensors() {
    let mut network = wave();
    let norm = LayerNorm { scale: vec![2.0, 1.0], shift: vec![0.5, 0.25], epsilon: 1e-5 };
    let (weights, bias) = (vec![1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 1.0], vec![0.0; 2]);
    network.layers[0] = Layer { weights, bias, norm: Some(norm), activation: Activation::Tanh, skip: None };
    network.layers[1].weights = vec![2.0, -1.0];
    let placed = open_network(&own::write(&network), &FieldOptions::default()).unwrap().0;
    // by all parameters in their order, the number of each
    let made = Sensitivity { latent: vec![7.0], weights: (0..17).map(|i| i as f32).collect() };
    let bytes = to_safetensors(&placed, &made);
    let tensors = SafeTensors::deserialize(&bytes).unwrap();
    for (name, shape, first) in [
        ("latent", &[1][..], 7.0),
        ("layers.0.weight", &[2, 4], 0.0),
        ("layers.0.bias", &[2], 8.0),
        ("layers.0.norm.scale", &[2], 10.0),
        ("layers.0.norm.shift", &[2], 12.0),
        ("layers.1.weight", &[1, 2], 14.0),
        ("layers.1.bias", &[1], 16.0),
    ] {
        let (found, numbers) = floats(&tensors, name).unwrap();
        assert_eq!((found.as_slice(), numbers[0]), (shape, first), "{name}");
    }
    assert_eq!(tensors.len(), 7);
}
