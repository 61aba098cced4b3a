//! Adam (Kingma and Ba 2015, "Adam: a method for stochastic optimization", algorithm 1).

/// Decay of the mean of the derivatives, and of their squares.
const DECAY: [f64; 2] = [0.9, 0.999];
/// Keeps the step finite where there never was a derivative.
const TINY: f32 = 1e-8;

/// Numbers that are trained, with their moments.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Trained {
    /// The numbers.
    pub values: Vec<f32>,
    /// Running means of the derivatives.
    pub means: Vec<f32>,
    /// Running means of their squares.
    pub squares: Vec<f32>,
}

impl Trained {
    /// Numbers that no step was made with yet.
    pub fn new(values: Vec<f32>) -> Self {
        let zeros = vec![0.0; values.len()];
        Self { values, means: zeros.clone(), squares: zeros }
    }
}

/// One step, with its learning rate and the corrections of moments that began at zero.
pub struct Adam {
    rate: f32,
    root: f32,
}

impl Adam {
    /// Step `number`, from 1.
    pub fn new(rate: f64, number: u64) -> Self {
        let left = DECAY.map(|decay| 1.0 - decay.powf(number as f64));
        Self { rate: (rate / left[0]) as f32, root: (1.0 / left[1].sqrt()) as f32 }
    }

    /// Moves the numbers against these derivatives.
    pub fn step(&self, trained: &mut Trained, derivatives: &[f32]) {
        let [mean, square] = DECAY.map(|decay| decay as f32);
        let lists = trained.values.iter_mut().zip(&mut trained.means).zip(&mut trained.squares).zip(derivatives);
        for (((value, m), v), &d) in lists {
            *m = mean * *m + (1.0 - mean) * d;
            *v = square * *v + (1.0 - square) * d * d;
            *value -= self.rate * *m / (v.sqrt() * self.root + TINY);
        }
    }
}
