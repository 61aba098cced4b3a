//! The sums behind distances and normal consistency of one side against the other, of a surface or of a curve.

use super::report::OneWay;
use glam::DVec3;

/// Distances and cosines of normals from samples of one side, weighted.
#[derive(Default)]
pub struct Tallied {
    weight: f64,
    sum: f64,
    squares: f64,
    /// The largest distance.
    pub max: f64,
    /// Where it was met.
    pub worst: DVec3,
    cosine: f64,
    cosine_absolute: f64,
    /// Distance and place of what is farther than the bar.
    pub far: Vec<(f64, DVec3)>,
}

impl Tallied {
    /// Adds a sample: its weight, its distance to the other side, and the cosine between the normals of both.
    pub fn add(&mut self, weight: f64, distance: f64, cosine: f64) {
        self.weight += weight;
        self.sum += weight * distance;
        self.squares += weight * distance * distance;
        self.cosine += weight * cosine;
        self.cosine_absolute += weight * cosine.abs();
    }
    /// Notes the places whose distance is over `bar`, and the largest distance of all.
    pub fn extremes(&mut self, bar: f64, list: impl Iterator<Item = (f64, DVec3)>) {
        for (distance, place) in list {
            if distance > self.max {
                (self.max, self.worst) = (distance, place);
            }
            if distance > bar {
                self.far.push((distance, place));
            }
        }
    }
    /// Means and the maximum, in parts of `diagonal`.
    pub fn one_way(&self, diagonal: f64) -> OneWay {
        let n = self.weight.max(f64::MIN_POSITIVE);
        OneWay {
            mean: self.sum / n / diagonal,
            rms: (self.squares / n).sqrt() / diagonal,
            max: self.max / diagonal,
            normal_consistency: self.cosine_absolute / n,
            normal_consistency_signed: self.cosine / n,
        }
    }
}
