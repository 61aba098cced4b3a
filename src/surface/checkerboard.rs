//! The checkerboard that shows a parameterization: hue runs with u, lightness falls with v, so that every place in the UV
//! square has its own colour and a mirrored or turned chart is seen.

use crate::shrink::lattice::LatticeSpec;

/// Tiles of the checkerboard along u and v.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Tiles {
    /// Columns.
    pub u: u32,
    /// Rows.
    pub v: u32,
}

impl Tiles {
    /// Tiles that are about square on the sphere: 2 : 1 for longitude and latitude, square for the octahedral chart. Powers
    /// of two, so that the texture's sides are.
    pub fn of(spec: LatticeSpec) -> Self {
        match spec {
            LatticeSpec::Latlong { .. } => Tiles { u: 32, v: 16 },
            LatticeSpec::Octahedral { .. } => Tiles { u: 32, v: 32 },
        }
    }
}

/// Linear RGB, from 0 to 1, of the checkerboard at (u, v).
pub fn color(u: f32, v: f32, tiles: Tiles) -> [f32; 3] {
    let column = (u * tiles.u as f32).floor().clamp(0.0, tiles.u as f32 - 1.0);
    let row = (v * tiles.v as f32).floor().clamp(0.0, tiles.v as f32 - 1.0);
    // the middle of the tile gives the colour, so that a tile is of one colour
    let (hue, down) = ((column + 0.5) / tiles.u as f32, (row + 0.5) / tiles.v as f32);
    let pale = (column as u32 + row as u32).is_multiple_of(2);
    let (lightness, chroma) = if pale { (0.95 - 0.12 * down, 0.035) } else { (0.80 - 0.34 * down, 0.125) };
    from_oklch(lightness, chroma, hue * std::f32::consts::TAU)
}

/// Linear RGB of a colour in OKLCh (Ottosson 2020, "A perceptual color space for image processing"), clipped.
fn from_oklch(lightness: f32, chroma: f32, hue: f32) -> [f32; 3] {
    let (a, b) = (chroma * hue.cos(), chroma * hue.sin());
    let l = (lightness + 0.396_337_78 * a + 0.215_803_76 * b).powi(3);
    let m = (lightness - 0.105_561_346 * a - 0.063_854_17 * b).powi(3);
    let s = (lightness - 0.089_484_18 * a - 1.291_485_5 * b).powi(3);
    [
        4.076_741_7 * l - 3.307_711_6 * m + 0.230_969_94 * s,
        -1.268_438 * l + 2.609_757_4 * m - 0.341_319_4 * s,
        -0.004_196_086_3 * l - 0.703_418_6 * m + 1.707_614_7 * s,
    ]
    .map(|c: f32| c.clamp(0.0, 1.0))
}

/// An 8-bit sRGB sample of a linear one (IEC 61966-2-1).
pub fn to_srgb(linear: f32) -> u8 {
    let x = linear.clamp(0.0, 1.0);
    let encoded = if x <= 0.003_130_8 { 12.92 * x } else { 1.055 * x.powf(1.0 / 2.4) - 0.055 };
    (encoded * 255.0 + 0.5) as u8
}

/// The checkerboard as a PNG of `pixels` by `pixels` per tile, row 0 at v = 0.
pub fn texture(tiles: Tiles, pixels: u32) -> Vec<u8> {
    let (width, height) = (tiles.u * pixels, tiles.v * pixels);
    let mut rgb = Vec::with_capacity(3 * (width * height) as usize);
    for y in 0..height {
        for x in 0..width {
            let (u, v) = ((x as f32 + 0.5) / width as f32, (y as f32 + 0.5) / height as f32);
            rgb.extend(color(u, v, tiles).map(to_srgb));
        }
    }
    png(&rgb, width, height)
}

/// 8-bit RGB, row by row, as a PNG. The same pixels give the same bytes.
pub(crate) fn png(rgb: &[u8], width: u32, height: u32) -> Vec<u8> {
    use image::ImageEncoder;
    use image::codecs::png::{CompressionType, FilterType, PngEncoder};
    let mut bytes = Vec::new();
    PngEncoder::new_with_quality(&mut bytes, CompressionType::Default, FilterType::Adaptive)
        .write_image(rgb, width, height, image::ExtendedColorType::Rgb8)
        .expect("a buffer of the stated size, written to memory");
    bytes
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn neighbouring_tiles_and_distant_ones_differ() {
        let tiles = Tiles { u: 8, v: 8 };
        let tile = |x: u32, y: u32| color((x as f32 + 0.5) / 8.0, (y as f32 + 0.5) / 8.0, tiles);
        let far = |a: [f32; 3], b: [f32; 3]| (0..3).map(|i| (a[i] - b[i]).abs()).sum::<f32>() > 0.02;
        let all: Vec<[f32; 3]> = (0..64).map(|i| tile(i % 8, i / 8)).collect();
        for i in 0..63 {
            assert!(far(all[i], all[i + 1]), "{i}");
            assert!(i + 8 > 63 || far(all[i], all[i + 8]), "{i}");
        }
    }

    #[test]
    fn the_texture_is_a_png_of_whole_tiles() {
        let bytes = texture(Tiles { u: 4, v: 2 }, 4);
        let picture = image::load_from_memory(&bytes).unwrap().to_rgb8();
        assert_eq!(picture.dimensions(), (16, 8));
        assert_eq!(picture.get_pixel(0, 0), picture.get_pixel(3, 3));
        assert_ne!(picture.get_pixel(3, 3), picture.get_pixel(4, 3));
    }
}
