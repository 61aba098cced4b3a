//! Activation functions: their names in files, and their values and derivatives over a row of numbers.

use super::functions::{SIN_COS_RANGE, exp, ln_1p, sigmoid, sin_cos, tanh};

/// What is done to every output of a layer.
#[derive(Clone, Copy, Debug, Default, PartialEq, serde::Serialize, serde::Deserialize, utoipa::ToSchema)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum Activation {
    /// x.
    #[default]
    Identity,
    /// max(x, 0).
    Relu,
    /// x for positive x, e^x - 1 otherwise.
    Elu,
    /// Hyperbolic tangent.
    Tanh,
    /// 1 / (1 + e^-x).
    Sigmoid,
    /// sin(w0 x).
    Sine {
        /// Frequency, in radians per unit of x; 30 in most SIREN code.
        w0: f32,
    },
    /// ln(1 + e^(beta x)) / beta.
    Softplus {
        /// Sharpness; 100 in IDR and its descendants.
        beta: f32,
    },
}

impl Activation {
    /// The name in files and descriptions, without the parameter.
    pub fn name(self) -> &'static str {
        match self {
            Self::Identity => "identity",
            Self::Relu => "relu",
            Self::Elu => "elu",
            Self::Tanh => "tanh",
            Self::Sigmoid => "sigmoid",
            Self::Sine { .. } => "sine",
            Self::Softplus { .. } => "softplus",
        }
    }

    /// Whether its parameter, if it has one, is one that can be worked with.
    pub fn is_valid(self) -> bool {
        const LARGEST: f32 = 1e4;
        match self {
            Self::Sine { w0: p } | Self::Softplus { beta: p } => p > 0.0 && p <= LARGEST,
            _ => true,
        }
    }

    /// Whether a good part of all numbers have zero for the activation, and for its derivative.
    pub(super) fn has_zeros(self) -> bool {
        matches!(self, Self::Relu | Self::Softplus { .. })
    }

    /// Replaces every number by its activation.
    pub(super) fn apply(self, row: &mut [f32]) {
        self.widest(row, None);
    }

    /// Replaces every number by its activation and writes the derivative there.
    pub(super) fn apply_with_derivative(self, row: &mut [f32], derivative: &mut [f32]) {
        self.widest(row, Some(derivative));
    }

    /// Multiplies every number by the second derivative, which the activation `value` and its derivative `slope` tell.
    pub(super) fn multiply_by_curvature(self, row: &mut [f32], value: &[f32], slope: &[f32]) {
        let all = row.iter_mut().zip(value).zip(slope);
        match self {
            Self::Identity | Self::Relu => row.fill(0.0),
            Self::Elu => all.for_each(|((r, &v), &s)| *r *= if v < 0.0 { s } else { 0.0 }),
            Self::Tanh => all.for_each(|((r, &v), &s)| *r *= -2.0 * v * s),
            Self::Sigmoid => all.for_each(|((r, &v), &s)| *r *= s * (1.0 - 2.0 * v)),
            Self::Sine { w0 } => all.for_each(|((r, &v), _)| *r *= -w0 * w0 * v),
            Self::Softplus { beta } => all.for_each(|((r, _), &s)| *r *= beta * s * (1.0 - s)),
        }
    }

    /// Chooses the loops that were compiled for the widest registers. Their bits are the same for every width.
    fn widest(self, row: &mut [f32], derivative: Option<&mut [f32]>) {
        #[cfg(target_arch = "x86_64")]
        if std::is_x86_feature_detected!("avx2") {
            // SAFETY: the processor has AVX2, as was just asked, which is all that the function requires.
            return unsafe { self.with_avx2(row, derivative) };
        }
        self.run(row, derivative);
    }

    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx2")]
    fn with_avx2(self, row: &mut [f32], derivative: Option<&mut [f32]>) {
        self.run(row, derivative);
    }

    #[inline(always)]
    fn run(self, row: &mut [f32], derivative: Option<&mut [f32]>) {
        match self {
            Self::Identity => {
                if let Some(derivative) = derivative {
                    derivative.fill(1.0);
                }
            }
            Self::Relu => each(row, derivative, |x| if x > 0.0 { (x, 1.0) } else { (0.0, 0.0) }),
            Self::Elu => each(row, derivative, |x| {
                let e = flushed(exp(x));
                if x > 0.0 { (x, 1.0) } else { (e - 1.0, e) }
            }),
            Self::Tanh => each(row, derivative, |x| {
                let t = tanh(x);
                (t, 1.0 - t * t)
            }),
            Self::Sigmoid => each(row, derivative, |x| {
                let s = flushed(sigmoid(x));
                (s, s * (1.0 - s))
            }),
            Self::Softplus { beta } => {
                let inverse = 1.0 / beta;
                each(row, derivative, |x| {
                    let t = beta * x;
                    let e = flushed(exp(-t.abs()));
                    let positive = if x > 0.0 { x } else { 0.0 };
                    let slope = 1.0 / (1.0 + e);
                    (positive + ln_1p(e) * inverse, if x > 0.0 { slope } else { e * slope })
                });
            }
            Self::Sine { w0 } => {
                // rare: a row with an argument too large for the fast reduction goes number by number
                if row.iter().all(|x| (w0 * x).abs() <= SIN_COS_RANGE) {
                    each(row, derivative, |x| {
                        let (s, c) = sin_cos(w0 * x);
                        (s, w0 * c)
                    });
                } else {
                    each(row, derivative, |x| {
                        let t = w0 * x;
                        let (s, c) = if t.abs() <= SIN_COS_RANGE { sin_cos(t) } else { far_sin_cos(t) };
                        (s, w0 * c)
                    });
                }
            }
        }
    }
}

/// Zero for what is positive and next to nothing: products of such numbers leave the range in which a processor is fast.
#[inline(always)]
fn flushed(x: f32) -> f32 {
    const NOTHING: f32 = 1e-18;
    if x > NOTHING { x } else { 0.0 }
}

#[cold]
fn far_sin_cos(t: f32) -> (f32, f32) {
    let (s, c) = f64::from(t).sin_cos();
    (s as f32, c as f32)
}

#[inline(always)]
fn each(row: &mut [f32], derivative: Option<&mut [f32]>, f: impl Fn(f32) -> (f32, f32)) {
    match derivative {
        None => row.iter_mut().for_each(|x| *x = f(*x).0),
        Some(derivative) => row.iter_mut().zip(derivative).for_each(|(x, d)| (*x, *d) = f(*x)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    pub(crate) const ALL: [Activation; 8] = [
        Activation::Identity,
        Activation::Relu,
        Activation::Elu,
        Activation::Tanh,
        Activation::Sigmoid,
        Activation::Sine { w0: 30.0 },
        Activation::Softplus { beta: 1.0 },
        Activation::Softplus { beta: 100.0 },
    ];

    fn reference(activation: Activation, x: f64) -> f64 {
        match activation {
            Activation::Identity => x,
            Activation::Relu => x.max(0.0),
            Activation::Elu => {
                if x > 0.0 {
                    x
                } else {
                    x.exp_m1()
                }
            }
            Activation::Tanh => x.tanh(),
            Activation::Sigmoid => 1.0 / (1.0 + (-x).exp()),
            Activation::Sine { w0 } => (f64::from(w0) * x).sin(),
            Activation::Softplus { beta } => {
                let t = f64::from(beta) * x;
                (t.max(0.0) + (-t.abs()).exp().ln_1p()) / f64::from(beta)
            }
        }
    }

    #[test]
    fn every_activation_has_its_value_and_its_derivative() {
        let arguments: Vec<f32> = (-4000..4000).map(|i| (i as f32 + 0.5) / 500.0).collect();
        for activation in ALL {
            let (mut values, mut derivatives) = (arguments.clone(), vec![0.0; arguments.len()]);
            activation.apply_with_derivative(&mut values, &mut derivatives);
            let mut alone = arguments.clone();
            activation.apply(&mut alone);
            assert_eq!(values, alone);
            for (i, &x) in arguments.iter().enumerate() {
                let x = f64::from(x);
                let (h, scale) = (1e-6, if let Activation::Sine { w0 } = activation { f64::from(w0) } else { 1.0 });
                let slope = (reference(activation, x + h) - reference(activation, x - h)) / (2.0 * h);
                // 30 x is rounded once before its sine is taken
                let rounding = 2e-7 * x.abs().max(1.0) * scale;
                assert!(
                    (f64::from(values[i]) - reference(activation, x)).abs() < 2e-7 + rounding,
                    "{activation:?} at {x}"
                );
                assert!(
                    (f64::from(derivatives[i]) - slope).abs() < (1e-6 + rounding) * scale,
                    "{activation:?}' at {x}"
                );
            }
        }
    }

    #[test]
    fn curvature_is_the_slope_of_the_slope() {
        for activation in ALL {
            for x in (-40..40).map(|i| (i as f32 + 0.5) / 20.0) {
                let h = 1e-3;
                let mut arguments = [x - h, x, x + h];
                let mut slopes = arguments;
                activation.apply_with_derivative(&mut arguments, &mut slopes);
                let mut curvature = [1.0];
                activation.multiply_by_curvature(&mut curvature, &arguments[1..2], &slopes[1..2]);
                let (expected, found) =
                    (f64::from(slopes[2] - slopes[0]) / f64::from(2.0 * h), f64::from(curvature[0]));
                let tolerance = if let Activation::Sine { w0 } = activation { 2e-3 * f64::from(w0 * w0) } else { 2e-2 };
                assert!((expected - found).abs() < tolerance, "{activation:?} at {x}: {expected} {found}");
            }
        }
    }

    #[test]
    fn every_argument_gives_a_finite_answer() {
        for activation in ALL {
            let mut values = [0.0, -0.0, 1e-40, 1e30, -1e30, 1e6, -1e6, 90.0, -90.0];
            let mut derivatives = values;
            activation.apply_with_derivative(&mut values, &mut derivatives);
            assert!(
                values.iter().chain(&derivatives).all(|v| v.is_finite()),
                "{activation:?} {values:?} {derivatives:?}"
            );
        }
    }

    #[test]
    fn both_widths_give_the_same_bits() {
        let arguments: Vec<f32> = (-1000..1000).map(|i| i as f32 / 77.0).collect();
        for activation in ALL {
            let (mut wide, mut plain) = (arguments.clone(), arguments.clone());
            let (mut wide_d, mut plain_d) = (arguments.clone(), arguments.clone());
            activation.widest(&mut wide, Some(&mut wide_d));
            activation.run(&mut plain, Some(&mut plain_d));
            assert_eq!((wide, wide_d), (plain, plain_d), "{activation:?}");
        }
    }
}
