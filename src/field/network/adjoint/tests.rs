use super::super::{Activation, Encoding, Layer, LayerNorm, Skip};
use super::*;
use crate::field::{Domain, Metric};
use crate::measure::sampling::Splitmix;

/// A network with a latent code, a skip, an encoding and widths that are no multiples of anything.
fn network(activation: Activation, encoding: Encoding) -> Network {
    let mut random = Splitmix::new(7);
    let latent_size = 5;
    let input = latent_size + encoding.size();
    let mut layer = |outputs: usize, inputs: usize, activation: Activation, skip: Option<Skip>| {
        let size = if activation == (Activation::Sine { w0: 30.0 }) { 0.05 } else { 1.0 / (inputs as f64).sqrt() };
        let mut number = || ((2.0 * random.unit() - 1.0) * size) as f32;
        let weights = (0..outputs * inputs).map(|_| number()).collect();
        Layer { weights, bias: (0..outputs).map(|_| number()).collect(), norm: None, activation, skip }
    };
    let layers = vec![
        layer(19, input, activation, None),
        layer(50, 19, activation, None),
        layer(11, 50 + input, activation, Some(Skip { scale: 0.7 })),
        layer(1, 11, Activation::Tanh, None),
    ];
    let (domain, metric) = (Domain::default(), Metric::Bound);
    let network = Network { layers, encoding, latent_size, latent_codes: Vec::new(), domain, metric, lipschitz: None };
    network.check("test").unwrap();
    network
}

/// The network with a layer norm in every layer but the last.
fn with_norms(mut network: Network) -> Network {
    let mut random = Splitmix::new(11);
    for layer in &mut network.layers[..3] {
        // a sine of 30 x takes what is small
        let size = if layer.activation == (Activation::Sine { w0: 30.0 }) { 0.05 } else { 1.0 };
        let mut list = |middle: f64| {
            (0..layer.bias.len()).map(|_| ((middle + random.unit() - 0.5) * size) as f32).collect::<Vec<_>>()
        };
        layer.norm = Some(LayerNorm { scale: list(1.0), shift: list(0.0), epsilon: 1e-3 });
    }
    network.check("test").unwrap();
    network
}

/// Places of some parameters in the list of all: one of 37, and of a norm's one of 7.
fn some(network: &Network) -> Vec<usize> {
    let mut chosen: Vec<usize> = (0..network.parameters()).step_by(37).collect();
    let mut at = 0;
    for layer in &network.layers {
        let dense = layer.weights.len() + layer.bias.len();
        chosen.extend((at + dense..at + layer.parameters()).step_by(7));
        at += layer.parameters();
    }
    chosen
}

const CODE: [f32; 5] = [0.3, -0.2, 0.5, 0.1, -0.4];

/// A loss of values and gradients: the sum over the points of w v^2 / 2 + c . g + (|g|^2 - 1)^2 / 4, and its derivatives.
fn loss(i: usize, value: f64, gradient: [f64; 3]) -> (f64, f64, [f64; 3]) {
    let weight = 1.0 + 0.01 * i as f64;
    let c = [0.2, -0.1, 0.3];
    let excess = gradient.iter().map(|g| g * g).sum::<f64>() - 1.0;
    let linear: f64 = c.iter().zip(gradient).map(|(c, g)| c * g).sum();
    let by_gradient = std::array::from_fn(|a| c[a] + excess * gradient[a]);
    (0.5 * weight * value * value + linear + 0.25 * excess * excess, weight * value, by_gradient)
}

fn points(count: usize) -> [Vec<f32>; 3] {
    let mut random = Splitmix::new(3);
    std::array::from_fn(|_| (0..count).map(|_| (2.0 * random.unit() - 1.0) as f32).collect())
}

fn total(network: &Network, code: &[f32], [x, y, z]: &[Vec<f32>; 3], gradients: bool) -> f64 {
    use crate::field::{Field, Gradients};
    let field = network.field(code).unwrap();
    let n = x.len();
    let (mut v, mut gx, mut gy, mut gz) = (vec![0.0; n], vec![0.0; n], vec![0.0; n], vec![0.0; n]);
    field.gradients(Points { x, y, z }, &mut v, Gradients { x: &mut gx, y: &mut gy, z: &mut gz });
    let one = |i: usize| {
        let gradient = if gradients { [gx[i], gy[i], gz[i]].map(f64::from) } else { [0.0; 3] };
        loss(i, v[i].into(), gradient).0
    };
    (0..n).map(one).sum()
}

fn derivatives(network: &Network, places: &[Vec<f32>; 3], gradients: bool) -> (Vec<f32>, Vec<f32>) {
    let prepared = Prepared::new(network);
    let mut sums = Sums::new(network);
    let [x, y, z] = places;
    prepared.sum(&CODE, Points { x, y, z }, gradients, &mut sums, |these, asked| {
        for (k, i) in these.enumerate() {
            let gradient = if gradients { asked.gradients.map(|row| row[k].into()) } else { [0.0; 3] };
            let (_, by_value, by_gradient) = loss(i, asked.values[k].into(), gradient);
            asked.by_value[k] = by_value as f32;
            (0..3).for_each(|a| asked.by_gradient[a][k] = by_gradient[a] as f32);
        }
    });
    let (mut weights, mut latent) = (vec![0.0; network.parameters()], vec![0.0; CODE.len()]);
    sums.add_to(network, &mut weights);
    sums.add_code_to(network, &CODE, &mut weights, &mut latent);
    (weights, latent)
}

#[test]
fn derivatives_by_weights_and_codes_are_those_of_finite_differences() {
    let positional = Encoding::Positional { frequencies: 2, base: 1.0 };
    for encoding in [Encoding::Identity, positional] {
        for activation in [
            Activation::Tanh,
            Activation::Sigmoid,
            Activation::Softplus { beta: 5.0 },
            Activation::Sine { w0: 30.0 },
            Activation::Identity,
        ] {
            for (gradients, norms) in [(false, false), (true, false), (false, true)] {
                let plain = network(activation, encoding);
                let mut network = if norms { with_norms(plain) } else { plain };
                // more than a block, and no whole number of tiles
                let places = points(BLOCK + 77);
                let (weights, latent) = derivatives(&network, &places, gradients);
                let kept = network.weights();
                let largest = weights.iter().fold(0f32, |m, w| m.max(w.abs()));
                // a sine of 30 x turns within a tenth
                let step = if activation == (Activation::Sine { w0: 30.0 }) { 1e-4 } else { 2e-3 };
                for at in some(&network) {
                    let mut moved = |by: f32| {
                        let mut list = kept.clone();
                        list[at] += by;
                        network.set_weights(&list);
                        total(&network, &CODE, &places, gradients)
                    };
                    let slope = (moved(step) - moved(-step)) / f64::from(2.0 * step);
                    let error = (slope - f64::from(weights[at])).abs();
                    let what = format!("{activation:?} {encoding:?} {gradients} {norms} weight {at}");
                    assert!(error < 6e-3 * f64::from(largest), "{what}: {slope} {}", weights[at]);
                }
                network.set_weights(&kept);
                for at in 0..CODE.len() {
                    let moved = |by: f32| {
                        let mut code = CODE;
                        code[at] += by;
                        total(&network, &code, &places, gradients)
                    };
                    let slope = (moved(step) - moved(-step)) / f64::from(2.0 * step);
                    let error = (slope - f64::from(latent[at])).abs();
                    let largest = latent.iter().fold(0f32, |m, w| m.max(w.abs()));
                    let what = format!("{activation:?} {gradients} {norms} code {at}");
                    assert!(error < 6e-3 * f64::from(largest), "{what}: {slope} {}", latent[at]);
                }
            }
        }
    }
}

#[test]
fn derivatives_of_every_value_by_the_code_are_those_of_finite_differences() {
    use crate::field::Field;
    let plain = network(Activation::Tanh, Encoding::Identity);
    for network in [with_norms(plain.clone()), plain] {
        let [x, y, z] = &points(TILE + 5);
        let places = Points { x, y, z };
        let mut rows = vec![0.0; x.len() * CODE.len()];
        Prepared::new(&network).by_code(&CODE, places, &mut rows);
        let largest = rows.iter().fold(0f32, |m, d| m.max(d.abs()));
        for at in 0..CODE.len() {
            let moved = |by: f32| {
                let (mut code, mut values) = (CODE, vec![0.0; x.len()]);
                code[at] += by;
                network.field(&code).unwrap().values(places, &mut values);
                values
            };
            for (i, (ahead, behind)) in moved(2e-3).into_iter().zip(moved(-2e-3)).enumerate() {
                let (slope, found) = ((ahead - behind) / 4e-3, rows[i * CODE.len() + at]);
                assert!((slope - found).abs() < 5e-3 * largest, "point {i}, entry {at}: {slope} {found}");
            }
        }
    }
}

#[test]
#[should_panic(expected = "no gradients of gradients through layer norms")]
fn a_loss_of_gradients_is_not_offered_with_layer_norms() {
    derivatives(&with_norms(network(Activation::Tanh, Encoding::Identity)), &points(3), true);
}
