//! A contact sheet: many small pictures in rows, each with a caption on a coloured bar.

use super::checkerboard::{Tiles, png, to_srgb};
use super::lettering;
use super::raster::{Camera, Model, Paint, render_mesh, smooth_normals};
use crate::field::mesh::ChartedMesh;
use crate::settings::{Canceled, Settings};
use glam::{DVec3, Vec3};
use std::collections::HashMap;

/// Side of one view of a tile, pixels.
pub const VIEW: usize = 224;
/// The two views of a tile, azimuth about +y (0 is +z) and elevation in degrees: from the front above, from the back below.
const VIEWS: [[f32; 2]; 2] = [[35.0, 20.0], [215.0, -25.0]];
/// Width of a tile, pixels.
const WIDTH: usize = VIEWS.len() * VIEW;
/// Height of the bar with the caption, pixels.
const BAR: usize = 2 * lettering::HEIGHT + 9;
/// Room around a tile, pixels.
const GAP: usize = 6;
/// Tiles in a row of a contact sheet.
pub const COLUMNS: usize = 6;
/// Samples per pixel and axis.
const OVERSAMPLING: usize = 2;
/// Linear colour of what has no chart.
const CLAY: [f32; 3] = [0.55, 0.52, 0.48];
/// The paper that tiles lie on.
const PAPER: [u8; 3] = [255, 255, 255];
/// Where there is no picture.
const BLANK: [u8; 3] = [228, 228, 228];

/// What the bar of a tile says by its colour.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Mark {
    /// Green.
    Good,
    /// Red.
    Bad,
    /// Grey: refused as expected.
    Aside,
}

impl Mark {
    fn color(self) -> [u8; 3] {
        match self {
            Mark::Good => [34, 122, 60],
            Mark::Bad => [190, 30, 30],
            Mark::Aside => [95, 95, 105],
        }
    }
}

/// One picture with its caption.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Tile {
    /// Two lines; what does not fit is cut off.
    pub caption: [String; 2],
    /// What the bar says.
    pub mark: Mark,
    /// sRGB pixels, `2 * VIEW` by `VIEW`, row by row; empty for none.
    pub pixels: Vec<u8>,
}

/// Draws a mesh with the checkerboard of its chart, once from the front and once from the back.
///
/// # Errors
/// When the token is raised.
pub fn picture(mesh: &ChartedMesh, tiles: Tiles, settings: &Settings<'_>) -> Result<Vec<u8>, Canceled> {
    let positions: Vec<Vec3> = mesh.vertices.iter().map(|p| Vec3::from(p.map(|c| c as f32))).collect();
    // both sides of a seam are to be lit alike
    let mut known = HashMap::with_capacity(positions.len());
    let merged: Vec<u32> =
        (0u32..).zip(&mesh.vertices).map(|(i, p)| *known.entry(p.map(f64::to_bits)).or_insert(i)).collect();
    let welded: Vec<[u32; 3]> = mesh.triangles.iter().map(|t| t.map(|v| merged[v as usize])).collect();
    let lit = smooth_normals(&positions, &welded);
    let normals: Vec<Vec3> = merged.iter().map(|&v| lit[v as usize]).collect();
    let model = Model {
        positions: &positions,
        normals: &normals,
        triangles: &mesh.triangles,
        paint: Paint::Checkerboard(&mesh.uv, tiles),
    };
    views(model, settings)
}

/// Draws a mesh without a chart, in one colour, from the same two places.
///
/// # Errors
/// When the token is raised.
pub fn plain_picture(vertices: &[DVec3], triangles: &[[u32; 3]], settings: &Settings<'_>) -> Result<Vec<u8>, Canceled> {
    let positions: Vec<Vec3> = vertices.iter().map(|p| p.as_vec3()).collect();
    let normals = smooth_normals(&positions, triangles);
    views(Model { positions: &positions, normals: &normals, triangles, paint: Paint::Plain(CLAY) }, settings)
}

fn views(model: Model<'_>, settings: &Settings<'_>) -> Result<Vec<u8>, Canceled> {
    let mut pixels = vec![0; 3 * WIDTH * VIEW];
    for (k, [azimuth, elevation]) in VIEWS.into_iter().enumerate() {
        let camera = Camera::around(model.positions, azimuth.to_radians(), elevation.to_radians());
        let view = render_mesh(model, &camera, VIEW, OVERSAMPLING, settings)?;
        for (i, pixel) in view.pixels.iter().enumerate() {
            let at = 3 * (i / VIEW * WIDTH + k * VIEW + i % VIEW);
            pixels[at..at + 3].copy_from_slice(&pixel.map(to_srgb));
        }
    }
    Ok(pixels)
}

/// The sheet as a PNG with at most so many `columns`; a sheet without tiles is one blank tile.
pub fn to_png(tiles: &[Tile], columns: usize) -> Vec<u8> {
    let columns = tiles.len().clamp(1, columns);
    let rows = tiles.len().max(1).div_ceil(columns);
    let (across, down) = (WIDTH + GAP, VIEW + BAR + GAP);
    let (width, height) = (columns * across + GAP, rows * down + GAP);
    let mut rgb: Vec<u8> = PAPER.iter().copied().cycle().take(3 * width * height).collect();
    for (i, tile) in tiles.iter().enumerate() {
        let (left, top) = (GAP + i % columns * across, GAP + i / columns * down);
        let mut set = |x: usize, y: usize, color: [u8; 3]| {
            let at = 3 * ((top + y) * width + left + x);
            rgb[at..at + 3].copy_from_slice(&color);
        };
        for y in 0..VIEW {
            for x in 0..WIDTH {
                let at = 3 * (y * WIDTH + x);
                let pixel = tile.pixels.get(at..at + 3).map_or(BLANK, |p| [p[0], p[1], p[2]]);
                set(x, y, pixel);
            }
        }
        for y in VIEW..VIEW + BAR {
            for x in 0..WIDTH {
                set(x, y, tile.mark.color());
            }
        }
        for (line, caption) in tile.caption.iter().enumerate() {
            let (indent, drop) = (4, VIEW + 3 + line * (lettering::HEIGHT + 3));
            lettering::write(caption, |x, y| {
                if indent + x < WIDTH {
                    set(indent + x, drop + y, PAPER);
                }
            });
        }
    }
    png(&rgb, width as u32, height as u32)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::measure::fixtures::{sphere_surface, with_settings};
    use crate::shrink::lattice::LatticeSpec;
    use crate::surface::gltf::to_glb;
    use serde_json::Value;

    #[test]
    fn a_tile_shows_its_shape_and_its_mark() {
        let spec = LatticeSpec::Octahedral { n: 12 };
        let glb = to_glb(&sphere_surface(spec, 0.5), &Value::Null, &Value::Null);
        let mesh = ChartedMesh::read(&glb).unwrap().unwrap();
        let pixels = with_settings(2, |s| picture(&mesh, Tiles::of(spec), s).unwrap());
        let tile = |mark, pixels| Tile { caption: ["ball".to_owned(), "x".repeat(500)], mark, pixels };
        let tiles = [tile(Mark::Good, pixels), tile(Mark::Bad, Vec::new())];
        let sheet = image::load_from_memory(&to_png(&tiles, COLUMNS)).unwrap().to_rgb8();
        assert_eq!(sheet.width() as usize, 2 * (WIDTH + GAP) + GAP);
        let at = |column: usize, x: usize, y: usize| {
            sheet.get_pixel((GAP + column * (WIDTH + GAP) + x) as u32, (GAP + y) as u32).0
        };
        assert_eq!((at(0, 1, VIEW + 1), at(1, 1, VIEW + 1)), (Mark::Good.color(), Mark::Bad.color()));
        assert_eq!(at(1, VIEW / 2, VIEW / 2), BLANK);
        for view in 0..2 {
            let (middle, corner) = (at(0, view * VIEW + VIEW / 2, VIEW / 2), at(0, view * VIEW + 2, 2));
            assert_ne!(middle, corner);
            assert!(!(middle[0] > 150 && middle[1] < 80), "red: seen from behind");
        }
        assert!(!to_png(&[], COLUMNS).is_empty());
    }
}
