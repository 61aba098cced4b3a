//! Sampled fields: values on a regular grid, joined by a smooth interpolant.
//!
//! The interpolant is the tensor product of Catmull-Rom cubics: it passes through the samples, its gradient is
//! continuous, and the gradient that is returned is exactly its own. Samples beyond the rim are continued linearly.

pub mod npy;

use super::{Domain, Field, FieldError, Gradients, Metric, Points};

/// Most samples (512 MiB as `f32`): a cube of 512.
pub const MAX_SAMPLES: usize = 1 << 27;
/// Samples beyond this are refused: their products must stay finite.
const MAX_VALUE: f64 = 1e18;

/// Samples of a field on a regular grid whose outermost samples lie on the faces of the domain, as a [`Field`].
pub struct Grid {
    shape: [usize; 3],
    /// Samples with one more on either end of every axis, last axis fastest.
    padded: Vec<f32>,
    /// Steps in `padded` along the first and the second axis.
    step: [usize; 2],
    domain: Domain,
    /// Grid steps per scene unit.
    per_unit: [f64; 3],
    lipschitz: f32,
}

impl Grid {
    /// Reads an `.npy` array of shape [nx, ny, nz] (`f4` or `f8`, C or Fortran order) over the box `domain`. Sample
    /// (i, j, k) lies at `min + (i / (nx - 1), j / (ny - 1), k / (nz - 1)) * (max - min)`.
    ///
    /// # Errors
    /// [`FieldError::Malformed`] with the byte, or with the index of a sample that is not finite;
    /// [`FieldError::Unsupported`] when the array has not three axes of at least two; [`FieldError::Limit`].
    pub fn read(bytes: &[u8], domain: Domain) -> Result<Self, FieldError> {
        let header = npy::header(bytes, MAX_SAMPLES)?;
        let &[nx, ny, nz] = header.shape.as_slice() else {
            let detail = format!("a grid of {} axes instead of 3", header.shape.len());
            return Err(FieldError::Unsupported { detail });
        };
        let shape = [nx, ny, nz];
        if shape.iter().any(|&n| n < 2) {
            return Err(FieldError::Unsupported {
                detail: format!("a grid of shape {shape:?}: two samples an axis or more"),
            });
        }
        let step = [(ny + 2) * (nz + 2), nz + 2];
        let mut padded = vec![0.0; (nx + 2) * step[0]];
        for i in 0..nx {
            for j in 0..ny {
                for k in 0..nz {
                    let at = if header.fortran { i + nx * (j + ny * k) } else { (i * ny + j) * nz + k };
                    let sample = header.number(bytes, at);
                    if sample.is_nan() || sample.abs() > MAX_VALUE {
                        let byte = (header.body + at * header.width) as u64;
                        let detail = format!("sample [{i}, {j}, {k}] is {sample}");
                        return Err(FieldError::Malformed { format: "npy", at: Some(byte), detail });
                    }
                    padded[(i + 1) * step[0] + (j + 1) * step[1] + k + 1] = sample as f32;
                }
            }
        }
        let mut grid = Self {
            shape,
            padded,
            step,
            domain,
            per_unit: std::array::from_fn(|a| (shape[a] - 1) as f64 / (domain.max[a] - domain.min[a])),
            lipschitz: 0.0,
        };
        grid.continue_beyond_the_rim();
        grid.lipschitz = grid.steepest();
        Ok(grid)
    }

    /// Samples along each axis.
    pub fn shape(&self) -> [usize; 3] {
        self.shape
    }

    /// Fills the outermost layers: v(-1) = 2 v(0) - v(1) along one axis after the other.
    fn continue_beyond_the_rim(&mut self) {
        let steps = [self.step[0], self.step[1], 1];
        let sizes = self.shape.map(|n| n + 2);
        for axis in 0..3 {
            let (b, c) = ((axis + 1) % 3, (axis + 2) % 3);
            for i in 0..sizes[b] {
                for j in 0..sizes[c] {
                    let start = i * steps[b] + j * steps[c];
                    let at = |n: usize| start + n * steps[axis];
                    self.padded[at(0)] = 2.0 * self.padded[at(1)] - self.padded[at(2)];
                    let end = sizes[axis] - 1;
                    self.padded[at(end)] = 2.0 * self.padded[at(end - 1)] - self.padded[at(end - 2)];
                }
            }
        }
    }

    /// The steepest slope between neighbouring samples: at every sample the larger difference of either side, per axis.
    /// An estimate of the Lipschitz bound; between samples the cubics may be steeper.
    fn steepest(&self) -> f32 {
        let steps = [self.step[0], self.step[1], 1];
        let mut most = 0.0f64;
        for i in 1..=self.shape[0] {
            for j in 1..=self.shape[1] {
                let row = i * self.step[0] + j * self.step[1];
                for at in row + 1..=row + self.shape[2] {
                    let here = f64::from(self.padded[at]);
                    let squared: f64 = (0..3)
                        .map(|axis| {
                            let forward = f64::from(self.padded[at + steps[axis]]) - here;
                            let backward = here - f64::from(self.padded[at - steps[axis]]);
                            (forward.abs().max(backward.abs()) * self.per_unit[axis]).powi(2)
                        })
                        .sum();
                    most = most.max(squared);
                }
            }
        }
        // a field that is the same everywhere still needs a positive bound
        (most.sqrt() as f32).max(f32::MIN_POSITIVE)
    }

    /// Value and gradient at a point of the box; a point outside counts as the nearest one of the box.
    fn interpolate(&self, p: [f32; 3]) -> (f64, [f64; 3]) {
        let mut cell = [0; 3];
        let mut weights = [[0.0; 4]; 3];
        let mut slopes = [[0.0; 4]; 3];
        for axis in 0..3 {
            let last = (self.shape[axis] - 1) as f64;
            let at = ((f64::from(p[axis]) - self.domain.min[axis]) * self.per_unit[axis]).clamp(0.0, last);
            // the far face belongs to the last cell
            let lower = at.floor().min(last - 1.0);
            cell[axis] = lower as usize;
            (weights[axis], slopes[axis]) = catmull_rom(at - lower);
        }
        let corner = cell[0] * self.step[0] + cell[1] * self.step[1] + cell[2];
        let (mut value, mut gradient) = (0.0, [0.0; 3]);
        for i in 0..4 {
            let (mut v, mut vy, mut vz) = (0.0, 0.0, 0.0);
            for j in 0..4 {
                let start = corner + i * self.step[0] + j * self.step[1];
                let row = &self.padded[start..start + 4];
                let along = |w: &[f64; 4]| -> f64 { row.iter().zip(w).map(|(&s, w)| f64::from(s) * w).sum() };
                let (straight, sloped) = (along(&weights[2]), along(&slopes[2]));
                v += weights[1][j] * straight;
                vy += slopes[1][j] * straight;
                vz += weights[1][j] * sloped;
            }
            value += weights[0][i] * v;
            gradient[0] += slopes[0][i] * v;
            gradient[1] += weights[0][i] * vy;
            gradient[2] += weights[0][i] * vz;
        }
        (value, std::array::from_fn(|axis| gradient[axis] * self.per_unit[axis]))
    }
}

/// Weights of four samples at -1, 0, 1, 2 for the value at t in [0, 1], and for the derivative there
/// (E. Catmull and R. Rom, A class of local interpolating splines, 1974; tension 1/2).
fn catmull_rom(t: f64) -> ([f64; 4], [f64; 4]) {
    let (t2, t3) = (t * t, t * t * t);
    (
        [
            0.5 * (-t3 + 2.0 * t2 - t),
            0.5 * (3.0 * t3 - 5.0 * t2 + 2.0),
            0.5 * (-3.0 * t3 + 4.0 * t2 + t),
            0.5 * (t3 - t2),
        ],
        [
            0.5 * (-3.0 * t2 + 4.0 * t - 1.0),
            0.5 * (9.0 * t2 - 10.0 * t),
            0.5 * (-9.0 * t2 + 8.0 * t + 1.0),
            0.5 * (3.0 * t2 - 2.0 * t),
        ],
    )
}

impl Field for Grid {
    fn domain(&self) -> Domain {
        self.domain
    }
    /// Interpolation of a distance is one no more; the estimated slope makes it a bound.
    fn metric(&self) -> Metric {
        Metric::Bound
    }
    fn lipschitz(&self) -> Option<f32> {
        Some(self.lipschitz)
    }
    fn values(&self, points: Points<'_>, values: &mut [f32]) {
        for (i, value) in values.iter_mut().enumerate() {
            *value = self.interpolate([points.x[i], points.y[i], points.z[i]]).0 as f32;
        }
    }
    fn gradients(&self, points: Points<'_>, values: &mut [f32], gradients: Gradients<'_>) {
        for (i, value) in values.iter_mut().enumerate() {
            let (v, g) = self.interpolate([points.x[i], points.y[i], points.z[i]]);
            *value = v as f32;
            (gradients.x[i], gradients.y[i], gradients.z[i]) = (g[0] as f32, g[1] as f32, g[2] as f32);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const BOX: Domain = Domain { min: [-1.0, -0.5, 0.0], max: [1.0, 1.5, 3.0] };

    /// An array of `f` over [`BOX`] as NumPy writes it.
    fn array(shape: [usize; 3], descr: &str, fortran: bool, f: impl Fn([f64; 3]) -> f64) -> Vec<u8> {
        let order = if fortran { "True" } else { "False" };
        let shape_text = format!("({}, {}, {})", shape[0], shape[1], shape[2]);
        let mut header = format!("{{'descr': '{descr}', 'fortran_order': {order}, 'shape': {shape_text}, }}");
        header += &" ".repeat(117 - header.len());
        header.push('\n');
        let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
        bytes.extend((header.len() as u16).to_le_bytes());
        bytes.extend(header.bytes());
        for n in 0..shape.iter().product() {
            let index = if fortran {
                [n % shape[0], n / shape[0] % shape[1], n / (shape[0] * shape[1])]
            } else {
                [n / (shape[1] * shape[2]), n / shape[2] % shape[1], n % shape[2]]
            };
            let place = |a: usize| BOX.min[a] + (BOX.max[a] - BOX.min[a]) * index[a] as f64 / (shape[a] - 1) as f64;
            let value = f([place(0), place(1), place(2)]);
            match descr {
                "<f4" => bytes.extend((value as f32).to_le_bytes()),
                "<f8" => bytes.extend(value.to_le_bytes()),
                _ => bytes.extend((value as f32).to_be_bytes()),
            }
        }
        bytes
    }

    fn linear(p: [f64; 3]) -> f64 {
        0.5 * p[0] - 0.25 * p[1] + 2.0 * p[2] - 1.0
    }

    #[test]
    fn a_linear_field_comes_back_whole_up_to_the_rim_in_every_type_and_order() {
        for (descr, fortran) in [("<f4", false), ("<f8", false), (">f4", false), ("<f4", true), ("<f8", true)] {
            let grid = Grid::read(&array([4, 5, 7], descr, fortran, linear), BOX).unwrap();
            assert_eq!(grid.shape(), [4, 5, 7]);
            assert!((grid.lipschitz - 4.3125f32.sqrt()).abs() < 1e-5);
            for p in [[-1.0, -0.5, 0.0], [1.0, 1.5, 3.0], [0.3, 0.2, 1.7], [-0.99, 1.49, 2.99]] {
                let (value, gradient) = grid.interpolate(p.map(|x: f64| x as f32));
                assert!((value - linear(p)).abs() < 1e-5, "{value} at {p:?}");
                for (found, expected) in gradient.into_iter().zip([0.5, -0.25, 2.0]) {
                    assert!((found - expected).abs() < 1e-5, "{gradient:?} at {p:?}");
                }
            }
        }
    }

    #[test]
    fn refuses_a_sample_that_is_not_finite_with_its_index() {
        let bytes = array([3, 3, 3], "<f4", false, |p| if p == [0.0, 1.5, 0.0] { f64::NAN } else { 1.0 });
        match Grid::read(&bytes, BOX) {
            Err(FieldError::Malformed { at: Some(at), detail, .. }) => {
                assert_eq!((at, detail.as_str()), (128 + 15 * 4, "sample [1, 2, 0] is NaN"));
            }
            other => panic!("{:?}", other.map(|g| g.shape())),
        }
    }

    #[test]
    fn refuses_arrays_that_are_no_grid() {
        let whole = array([3, 3, 3], "<f4", false, linear);
        assert!(matches!(Grid::read(&whole[..whole.len() - 1], BOX), Err(FieldError::Malformed { .. })));
        assert!(matches!(Grid::read(&whole[..20], BOX), Err(FieldError::Malformed { .. })));
        let swap = |from: &str, to: &str| {
            let at = whole.windows(from.len()).position(|w| w == from.as_bytes()).unwrap();
            let mut changed = whole.clone();
            changed[at..at + to.len()].copy_from_slice(to.as_bytes());
            Grid::read(&changed, BOX).map(|g| g.shape())
        };
        assert!(matches!(swap("'<f4'", "'<i4'"), Err(FieldError::Unsupported { .. })));
        assert!(matches!(swap("(3, 3, 3)", "(3, 9,  )"), Err(FieldError::Unsupported { .. })));
        assert!(matches!(swap("(3, 3, 3)", "(1, 3, 3)"), Err(FieldError::Unsupported { .. })));
        assert!(matches!(swap("(3, 3, 3)", "(9,99,99)"), Err(FieldError::Malformed { .. })));
        assert!(matches!(
            swap("(3, 3, 3), }", "(9999999999)"),
            Err(FieldError::Malformed { .. } | FieldError::Limit { .. })
        ));
    }

    proptest! {
        /// The gradient is the interpolant's own, also across the faces of cells.
        #[test]
        fn the_gradient_agrees_with_differences(x in -0.99..0.99f64, y in -0.49..1.49f64, z in 0.01..2.99f64) {
            let f = |p: [f64; 3]| (2.0 * p[0]).sin() * (p[1] - 0.3) + (p[2] * p[0]).cos();
            let grid = Grid::read(&array([9, 8, 11], "<f8", false, f), BOX).unwrap();
            let p = [x as f32, y as f32, z as f32];
            let (_, gradient) = grid.interpolate(p);
            for axis in 0..3 {
                let h = 2f32.powi(-9);
                let (mut a, mut b) = (p, p);
                a[axis] += h;
                b[axis] -= h;
                let slope = (grid.interpolate(a).0 - grid.interpolate(b).0) / f64::from(a[axis] - b[axis]);
                // second derivatives jump at faces: the difference is off by about h times the jump
                prop_assert!((slope - gradient[axis]).abs() < 0.02, "{slope} {gradient:?}");
            }
        }

        #[test]
        fn broken_bytes_never_panic(changes in prop::collection::vec((0usize..236, any::<u8>()), 1..5), cut in 0usize..400) {
            let mut bytes = array([3, 3, 3], "<f4", false, linear);
            for (at, value) in changes {
                bytes[at] = value;
            }
            bytes.truncate(cut);
            let _ = Grid::read(&bytes, BOX);
        }
    }
}
