//! Layer norms (Ba, Kiros and Hinton 2016): the outputs of a layer at a point, less their mean and over their deviation.
//!
//! An activation is taken of every piece of a product as soon as it is there; a norm takes all outputs of a layer together, so it waits
//! for the last of them. What it makes of a point depends on that point alone, and sums go over the outputs in order: a point gets the
//! same bits in every tile.

use super::product::TILE;

/// The epsilon of PyTorch, which most files leave as it is.
pub const EPSILON: f32 = 1e-5;

/// `scale * (x - mean(x)) / sqrt(variance(x) + epsilon) + shift`, where mean and variance (the biased one: a mean of squares) are those of
/// all outputs of a layer at one point.
#[derive(Clone, Debug, PartialEq)]
pub struct LayerNorm {
    /// One factor per output.
    pub scale: Vec<f32>,
    /// One summand per output.
    pub shift: Vec<f32>,
    /// What is added to the variance; positive.
    pub epsilon: f32,
}

impl LayerNorm {
    /// Rows of a tile that [`Self::forward`] keeps for the way back: the normalised outputs, and one over their deviation.
    pub(super) fn kept(&self) -> usize {
        self.scale.len() + 1
    }

    /// Replaces the outputs in a tile, one row each, by their norm, and keeps what the way back needs where there is room for it.
    /// Rows of padding stay as they are.
    pub(super) fn forward(&self, tile: &mut [f32], kept: Option<&mut [f32]>) {
        let count = self.scale.len();
        let rows = &mut tile.as_chunks_mut::<TILE>().0[..count];
        let mut kept = kept.map(|kept| kept.as_chunks_mut::<TILE>().0);
        let mut mean = [0.0; TILE];
        for row in &*rows {
            mean.iter_mut().zip(row).for_each(|(sum, x)| *sum += x);
        }
        let share = 1.0 / count as f32;
        mean.iter_mut().for_each(|sum| *sum *= share);
        let mut squares = [0.0; TILE];
        for row in &mut *rows {
            for ((x, mean), sum) in row.iter_mut().zip(&mean).zip(&mut squares) {
                *x -= mean;
                *sum += *x * *x;
            }
        }
        let inverse = squares.map(|sum| 1.0 / (sum * share + self.epsilon).sqrt());
        for (i, row) in rows.iter_mut().enumerate() {
            row.iter_mut().zip(&inverse).for_each(|(x, inverse)| *x *= inverse);
            if let Some(kept) = &mut kept {
                kept[i] = *row;
            }
            let (scale, shift) = (self.scale[i], self.shift[i]);
            row.iter_mut().for_each(|x| *x = scale * *x + shift);
        }
        if let Some(kept) = kept {
            kept[count] = inverse;
        }
    }

    /// Replaces the derivatives by the outputs of the norm, in a tile of one row each, by those by its inputs.
    ///
    /// With g the derivatives by the normalised outputs n and r one over the deviation: r (g - mean(g) - n mean(g n)).
    pub(super) fn backward(&self, tile: &mut [f32], kept: &[f32]) {
        let count = self.scale.len();
        let rows = &mut tile.as_chunks_mut::<TILE>().0[..count];
        let (normed, inverse) = kept.as_chunks::<TILE>().0.split_at(count);
        let (mut mean, mut along) = ([0.0; TILE], [0.0; TILE]);
        for ((row, normed), scale) in rows.iter_mut().zip(normed).zip(&self.scale) {
            for (((g, n), mean), along) in row.iter_mut().zip(normed).zip(&mut mean).zip(&mut along) {
                *g *= scale;
                *mean += *g;
                *along += *g * n;
            }
        }
        let share = 1.0 / count as f32;
        mean.iter_mut().chain(&mut along).for_each(|sum| *sum *= share);
        for (row, normed) in rows.iter_mut().zip(normed) {
            for (((g, n), inverse), (mean, along)) in
                row.iter_mut().zip(normed).zip(&inverse[0]).zip(mean.iter().zip(&along))
            {
                *g = inverse * (*g - mean - n * along);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::field::network::product::padded;

    const COUNT: usize = 11;

    fn number(i: usize) -> f32 {
        ((i * 7919 + 13) % 1009) as f32 / 504.5 - 1.0
    }

    fn norm() -> LayerNorm {
        let list = |from: usize| (0..COUNT).map(|i| number(from + i)).collect();
        LayerNorm { scale: list(100), shift: list(300), epsilon: 1e-3 }
    }

    /// The norm of numbers in double precision.
    fn plainly(norm: &LayerNorm, x: &[f64]) -> Vec<f64> {
        let mean = x.iter().sum::<f64>() / x.len() as f64;
        let variance = x.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / x.len() as f64;
        let deviation = (variance + f64::from(norm.epsilon)).sqrt();
        let parameters = norm.scale.iter().zip(&norm.shift);
        x.iter().zip(parameters).map(|(x, (&a, &b))| f64::from(a) * (x - mean) / deviation + f64::from(b)).collect()
    }

    fn lane(tile: &[f32], lane: usize) -> Vec<f64> {
        tile.chunks_exact(TILE).take(COUNT).map(|row| row[lane].into()).collect()
    }

    #[test]
    fn every_lane_is_the_plain_norm_kept_or_not_and_padding_stays_nothing() {
        let norm = norm();
        let mut tile: Vec<f32> = (0..COUNT * TILE).map(number).collect();
        tile.resize(padded(COUNT) * TILE, 0.0);
        let (mut alone, mut kept) = (tile.clone(), vec![0.0; norm.kept() * TILE]);
        let before = tile.clone();
        norm.forward(&mut tile, Some(&mut kept));
        norm.forward(&mut alone, None);
        assert_eq!(tile, alone);
        assert!(tile[COUNT * TILE..].iter().all(|x| x.to_bits() == 0));
        for at in 0..TILE {
            let expected = plainly(&norm, &lane(&before, at));
            let error = lane(&tile, at).iter().zip(&expected).fold(0.0, |m: f64, (a, b)| m.max((a - b).abs()));
            assert!(error < 1e-6, "{at}: {error:.1e}");
        }
    }

    #[test]
    fn the_way_back_gives_the_derivatives_of_finite_differences() {
        let norm = norm();
        let mut tile: Vec<f32> = (0..padded(COUNT) * TILE).map(number).collect();
        let before = tile.clone();
        let mut kept = vec![0.0; norm.kept() * TILE];
        norm.forward(&mut tile, Some(&mut kept));
        // of a sum of the outputs with these weights
        let weights: Vec<f32> = (0..padded(COUNT) * TILE).map(|i| number(i + 57)).collect();
        let mut adjoint = weights.clone();
        norm.backward(&mut adjoint, &kept);
        assert_eq!(adjoint[COUNT * TILE..], weights[COUNT * TILE..], "padding stays as it is");
        for at in 0..TILE {
            let (x, weights) = (lane(&before, at), lane(&weights, at));
            for (i, found) in lane(&adjoint, at).into_iter().enumerate() {
                let moved = |by: f64| {
                    let mut x = x.clone();
                    x[i] += by;
                    plainly(&norm, &x).iter().zip(&weights).map(|(y, w)| y * w).sum::<f64>()
                };
                let slope = (moved(1e-5) - moved(-1e-5)) / 2e-5;
                assert!((slope - found).abs() < 1e-5, "lane {at}, output {i}: {slope} {found}");
            }
        }
    }

    #[test]
    fn outputs_that_are_all_the_same_become_the_shift() {
        let norm = norm();
        let mut tile = vec![3.0; padded(COUNT) * TILE];
        let mut kept = vec![0.0; norm.kept() * TILE];
        norm.forward(&mut tile, Some(&mut kept));
        let mut adjoint = vec![1.0; padded(COUNT) * TILE];
        norm.backward(&mut adjoint, &kept);
        // a mean of equal numbers is rounded, and one over the deviation is at most 1 / sqrt(epsilon)
        for (row, shift) in tile.chunks_exact(TILE).zip(&norm.shift) {
            assert!(row.iter().all(|x| (x - shift).abs() < 1e-4), "{row:?} {shift}");
        }
        assert!(adjoint.iter().chain(&kept).all(|x| x.is_finite()));
    }
}
