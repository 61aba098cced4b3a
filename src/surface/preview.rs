//! `preview.png`: the surface with its checkerboard from four sides, drawn by the program itself.

use super::Surface;
use super::checkerboard::{Tiles, png, to_srgb};
use super::raster::{Camera, Model, Paint, Picture, render_mesh};
use crate::settings::{Canceled, Settings};
use glam::Vec3;

/// Width that a picture has unless another is asked for.
pub const WIDTH: u32 = 1024;
/// Directions of the four views, in degrees about +y from +z: a quarter turn apart, the first from the front right.
const AZIMUTHS: [f32; 4] = [35.0, 125.0, 215.0, 305.0];
/// Height of the four views, degrees above the ground; the last one looks from below.
const ELEVATIONS: [f32; 4] = [18.0, 18.0, 18.0, -25.0];
/// Samples per pixel and axis.
const OVERSAMPLING: usize = 2;

/// The surface from four sides, two by two, as a PNG of `width` x `width` pixels (rounded down to even, at least 2). +y is up.
///
/// # Errors
/// When the token is raised.
pub fn to_png(surface: &Surface, width: u32, settings: &Settings<'_>) -> Result<Vec<u8>, Canceled> {
    let chart = &surface.lattice.chart;
    let positions: Vec<Vec3> = chart.iter().map(|&v| Vec3::from(surface.positions[v as usize])).collect();
    let normals: Vec<Vec3> = chart.iter().map(|&v| Vec3::from(surface.normals[v as usize])).collect();
    let uv: Vec<[f32; 2]> = surface.uv().iter().map(|&[u, v]| [u as f32, v as f32]).collect();
    let model = Model {
        positions: &positions,
        normals: &normals,
        triangles: &surface.chart_triangles,
        paint: Paint::Checkerboard(&uv, Tiles::of(surface.lattice.spec)),
    };
    four_views(model, width, settings)
}

/// Any mesh from the same four sides, as a PNG.
///
/// # Errors
/// When the token is raised.
pub fn four_views(model: Model<'_>, width: u32, settings: &Settings<'_>) -> Result<Vec<u8>, Canceled> {
    let side = (width as usize / 2).max(1);
    let mut views = Vec::with_capacity(4);
    for (azimuth, elevation) in AZIMUTHS.into_iter().zip(ELEVATIONS) {
        let camera = Camera::around(model.positions, azimuth.to_radians(), elevation.to_radians());
        views.push(render_mesh(model, &camera, side, OVERSAMPLING, settings)?);
    }
    Ok(tiled(&views, 2))
}

/// One view of a mesh as a PNG of `width` x `width` pixels, from an azimuth about +y (0 is +z) and an elevation, in degrees.
///
/// # Errors
/// When the token is raised.
pub fn one_view(
    model: Model<'_>,
    azimuth: f32,
    elevation: f32,
    width: u32,
    settings: &Settings<'_>,
) -> Result<Vec<u8>, Canceled> {
    let camera = Camera::around(model.positions, azimuth.to_radians(), elevation.to_radians());
    let picture = render_mesh(model, &camera, (width as usize).max(1), OVERSAMPLING, settings)?;
    Ok(tiled(&[picture], 1))
}

/// Models side by side as one PNG, each `side` pixels wide, all from the same place: one from which `whole` fills the picture.
///
/// # Errors
/// When the token is raised.
pub fn row(models: &[Model<'_>], whole: &[Vec3], side: usize, settings: &Settings<'_>) -> Result<Vec<u8>, Canceled> {
    let camera = Camera::around(whole, AZIMUTHS[0].to_radians(), ELEVATIONS[0].to_radians());
    let render = |model: &Model<'_>| render_mesh(*model, &camera, side, OVERSAMPLING, settings);
    let views: Vec<Picture> = models.iter().map(render).collect::<Result<_, _>>()?;
    Ok(tiled(&views, models.len()))
}

/// Pictures of one size side by side, `columns` to a row.
fn tiled(views: &[Picture], columns: usize) -> Vec<u8> {
    let side = views[0].side;
    let (width, height) = (columns * side, views.len().div_ceil(columns) * side);
    let mut rgb = vec![0u8; 3 * width * height];
    for (i, view) in views.iter().enumerate() {
        let (left, top) = (i % columns * side, i / columns * side);
        for (k, pixel) in view.pixels.iter().enumerate() {
            let at = 3 * ((top + k / side) * width + left + k % side);
            rgb[at..at + 3].copy_from_slice(&pixel.map(to_srgb));
        }
    }
    png(&rgb, width as u32, height as u32)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::measure::fixtures::{sphere_surface, with_settings};
    use crate::settings::CancelToken;
    use crate::shrink::lattice::LatticeSpec;

    const SPEC: LatticeSpec = LatticeSpec::Latlong { n_theta: 32, n_phi: 16 };

    #[test]
    fn four_views_of_a_sphere_show_its_colours_and_never_its_back() {
        let surface = sphere_surface(SPEC, 0.5);
        let bytes = with_settings(2, |s| to_png(&surface, 128, s).unwrap());
        assert_eq!(bytes, with_settings(1, |s| to_png(&surface, 128, s).unwrap()), "the same bytes for any pool");
        let picture = image::load_from_memory(&bytes).unwrap().to_rgb8();
        assert_eq!(picture.dimensions(), (128, 128));
        for (x, y) in [(32, 32), (96, 32), (32, 96), (96, 96)] {
            let [r, g, b] = picture.get_pixel(x, y).0;
            assert!(!(r > 150 && g < 80 && b < 80), "red at {x} {y}: seen from behind");
        }
    }

    #[test]
    fn a_raised_token_stops_the_drawing() {
        let surface = sphere_surface(SPEC, 0.5);
        let cancel = CancelToken::new();
        cancel.cancel();
        let stopped = with_settings(1, |s| to_png(&surface, 64, &Settings { cancel: &cancel, ..*s }));
        assert_eq!(stopped, Err(Canceled));
    }
}
