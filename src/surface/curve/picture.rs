//! The picture of a curve (PNG): the solid, its boundary coloured by the parameter, and ticks at equal steps of it.

use super::{TICK, TICKS, at_parameter, bounds, hue};
use crate::settings::{Canceled, Settings};
use crate::shrink::curve::Curve;
use crate::surface::checkerboard::{png, to_srgb};

/// Room around the curve, in parts of the picture.
const MARGIN: f64 = 0.08;
/// Half widths of the curve and of a tick, and radii of a sample's dot and of that at parameter 0, in pixels.
const CURVE: f64 = 2.5;
const HAIR: f64 = 0.7;
const DOT: f64 = 1.6;
const START: f64 = 7.0;
/// Samples get their dots where they are this many pixels apart on average.
const APART: f64 = 9.0;
/// Colours of paper, solid and dots, linear.
const PAPER: [f32; 3] = [1.0; 3];
const SOLID: [f32; 3] = [0.87, 0.85, 0.80];
const INK: [f32; 3] = [0.02; 3];

/// The curve as a PNG of `width` x `width` pixels, y upwards, in the colours that [`super::to_svg`] has: red at parameter 0 and
/// once around the colour circle. Lines are smoothed by how much of a pixel they cover.
///
/// # Errors
/// When the token is raised.
pub fn to_png(curve: &Curve, width: u32, settings: &Settings<'_>) -> Result<Vec<u8>, Canceled> {
    let side = width.max(1) as usize;
    let (lo, hi) = bounds(&curve.positions);
    let longest = (hi[0] - lo[0]).max(hi[1] - lo[1]).max(f64::MIN_POSITIVE);
    let scale = (1.0 - 2.0 * MARGIN) * side as f64 / longest;
    let middle = [0.5 * (lo[0] + hi[0]), 0.5 * (lo[1] + hi[1])];
    let half = 0.5 * side as f64;
    let to_pixels = |p: [f64; 2]| [half + scale * (p[0] - middle[0]), half - scale * (p[1] - middle[1])];

    let n = curve.positions.len();
    let points: Vec<[f64; 2]> = curve.positions.iter().map(|&p| to_pixels(p)).collect();
    let mut canvas = Canvas { side, pixels: vec![PAPER; side * side] };
    canvas.fill(&points);
    settings.cancel.check()?;
    let mut ticks = Lines::new(side);
    for k in 0..TICKS {
        let u = k as f64 / TICKS as f64;
        let (p, normal) = at_parameter(curve, u);
        let end = |sign: f64| to_pixels([0, 1].map(|c| p[c] + sign * 0.5 * TICK * longest * normal[c]));
        ticks.add([end(-1.0), end(1.0)], [u, u], HAIR);
    }
    canvas.draw(&ticks, HAIR);
    let mut line = Lines::new(side);
    for i in 0..n {
        let end = curve.parameters.get(i + 1).copied().unwrap_or(1.0);
        line.add([points[i], points[(i + 1) % n]], [curve.parameters[i], end], CURVE);
    }
    settings.cancel.check()?;
    canvas.draw(&line, CURVE);
    let length: f64 = (0..n).map(|i| distance(points[i], points[(i + 1) % n])).sum();
    if length > APART * n as f64 {
        points.iter().for_each(|&p| canvas.dot(p, DOT, INK));
    }
    if let Some(&first) = points.first() {
        canvas.dot(first, START, linear(hue(0.0)));
        canvas.dot(first, 0.4 * START, PAPER);
    }
    let rgb: Vec<u8> = canvas.pixels.iter().flat_map(|pixel| pixel.map(to_srgb)).collect();
    Ok(png(&rgb, side as u32, side as u32))
}

fn distance(a: [f64; 2], b: [f64; 2]) -> f64 {
    (a[0] - b[0]).hypot(a[1] - b[1])
}

/// Linear RGB of an 8-bit sRGB colour (IEC 61966-2-1).
fn linear(srgb: [u8; 3]) -> [f32; 3] {
    srgb.map(|c| {
        let c = f32::from(c) / 255.0;
        if c <= 0.040_45 { c / 12.92 } else { ((c + 0.055) / 1.055).powf(2.4) }
    })
}

/// Pixels near a box, as ranges of columns and rows.
fn near(side: usize, lo: [f64; 2], hi: [f64; 2], reach: f64) -> [std::ops::Range<usize>; 2] {
    [0, 1].map(|c| {
        let clamp = |x: f64| x.clamp(0.0, side as f64) as usize;
        clamp((lo[c] - reach).floor())..clamp((hi[c] + reach).ceil() + 1.0)
    })
}

/// For every pixel the nearest of some lines: how far, and the parameter there.
struct Lines {
    side: usize,
    nearest: Vec<(f32, f32)>,
}

impl Lines {
    fn new(side: usize) -> Self {
        Self { side, nearest: vec![(f32::INFINITY, 0.0); side * side] }
    }

    fn add(&mut self, [a, b]: [[f64; 2]; 2], u: [f64; 2], half_width: f64) {
        let along = [b[0] - a[0], b[1] - a[1]];
        let squared = along[0] * along[0] + along[1] * along[1];
        let (lo, hi) = ([a[0].min(b[0]), a[1].min(b[1])], [a[0].max(b[0]), a[1].max(b[1])]);
        let [columns, rows] = near(self.side, lo, hi, half_width + 1.0);
        for y in rows {
            for x in columns.clone() {
                let p = [x as f64 + 0.5, y as f64 + 0.5];
                let dot = (p[0] - a[0]) * along[0] + (p[1] - a[1]) * along[1];
                let t = if squared > 0.0 { (dot / squared).clamp(0.0, 1.0) } else { 0.0 };
                let d = distance(p, [a[0] + t * along[0], a[1] + t * along[1]]) as f32;
                let slot = &mut self.nearest[y * self.side + x];
                if d < slot.0 {
                    *slot = (d, (u[0] + t * (u[1] - u[0])) as f32);
                }
            }
        }
    }
}

struct Canvas {
    side: usize,
    pixels: Vec<[f32; 3]>,
}

impl Canvas {
    fn blend(&mut self, pixel: usize, color: [f32; 3], part: f32) {
        let under = &mut self.pixels[pixel];
        for c in 0..3 {
            under[c] += part * (color[c] - under[c]);
        }
    }

    /// The inside of a closed polygon by the parity of its crossings with every row; its border is drawn over.
    fn fill(&mut self, points: &[[f64; 2]]) {
        let n = points.len();
        let mut crossings: Vec<Vec<f64>> = vec![Vec::new(); self.side];
        for i in 0..n {
            let (a, b) = (points[i], points[(i + 1) % n]);
            let [_, rows] = near(self.side, [a[0], a[1].min(b[1])], [a[0], a[1].max(b[1])], 1.0);
            for row in rows {
                let y = row as f64 + 0.5;
                if (a[1] > y) != (b[1] > y) {
                    crossings[row].push(a[0] + (y - a[1]) / (b[1] - a[1]) * (b[0] - a[0]));
                }
            }
        }
        for (row, list) in crossings.iter_mut().enumerate() {
            list.sort_by(f64::total_cmp);
            for pair in list.chunks_exact(2) {
                let column = |x: f64| (x - 0.5).ceil().clamp(0.0, self.side as f64) as usize;
                for x in column(pair[0])..column(pair[1]) {
                    self.pixels[row * self.side + x] = SOLID;
                }
            }
        }
    }

    fn draw(&mut self, lines: &Lines, half_width: f64) {
        for (pixel, &(d, u)) in lines.nearest.iter().enumerate() {
            let part = (half_width as f32 + 0.5 - d).clamp(0.0, 1.0);
            if part > 0.0 {
                self.blend(pixel, linear(hue(f64::from(u))), part);
            }
        }
    }

    fn dot(&mut self, at: [f64; 2], radius: f64, color: [f32; 3]) {
        let [columns, rows] = near(self.side, at, at, radius + 1.0);
        for y in rows {
            for x in columns.clone() {
                let d = distance([x as f64 + 0.5, y as f64 + 0.5], at);
                let part = (radius + 0.5 - d).clamp(0.0, 1.0) as f32;
                self.blend(y * self.side + x, color, part);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::tests::diamond;
    use super::*;
    use crate::measure::fixtures::with_settings;
    use crate::settings::CancelToken;

    #[test]
    fn the_picture_shows_the_solid_inside_and_the_colours_around_it() {
        let picture = with_settings(1, |s| to_png(&diamond(), 200, s).unwrap());
        let picture = image::load_from_memory(&picture).unwrap().to_rgb8();
        assert_eq!(picture.dimensions(), (200, 200));
        assert_eq!(picture.get_pixel(0, 0).0, [255; 3]);
        assert_eq!(picture.get_pixel(100, 110).0, SOLID.map(to_srgb));
        // parameter 1/8 is halfway to the top, where the colour is between red and yellow-green
        let [r, g, b] = picture.get_pixel(142, 79).0;
        assert!(r > 200 && g > 130 && g < 235 && b < 60, "{r} {g} {b}");
        // parameter 0 is at the right
        let [r, g, b] = picture.get_pixel(184 + 5, 100).0;
        assert!(r > 200 && g < 60 && b < 60, "{r} {g} {b}");
    }

    #[test]
    fn a_raised_token_stops_the_drawing() {
        let cancel = CancelToken::new();
        cancel.cancel();
        let stopped = with_settings(1, |s| to_png(&diamond(), 64, &Settings { cancel: &cancel, ..*s }));
        assert_eq!(stopped, Err(Canceled));
    }
}
