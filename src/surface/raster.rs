//! A small software rasterizer for pictures of surfaces: perspective, depth buffer, supersampling, two lights, ambient
//! occlusion from the depth buffer and a soft shadow on the ground. +y is up. Triangles seen from behind are painted red, so that a
//! fold or an inside-out part is seen at once.
//!
//! The same input gives the same pixels: triangles are drawn in order, and pixels are shaded each by itself.

use super::checkerboard::{Tiles, color};
use crate::settings::{Canceled, Settings};
use crate::shrink::lattice::LatticeSpec;
use glam::{Vec2, Vec3};
use rayon::prelude::*;

/// Colours of a mesh, linear RGB.
#[derive(Clone, Copy, Debug)]
pub enum Paint<'a> {
    /// The checkerboard over texture coordinates, one pair per vertex.
    Checkerboard(&'a [[f32; 2]], Tiles),
    /// The checkerboard of a lattice's chart over places on the unit sphere, one per vertex.
    Places(&'a [Vec3], LatticeSpec),
    /// One colour per vertex.
    Vertices(&'a [[f32; 3]]),
    /// One colour.
    Plain([f32; 3]),
}

/// A mesh to be drawn.
#[derive(Clone, Copy, Debug)]
pub struct Model<'a> {
    /// Positions.
    pub positions: &'a [Vec3],
    /// Normals for shading, one per vertex.
    pub normals: &'a [Vec3],
    /// Triangles, counter-clockwise outward.
    pub triangles: &'a [[u32; 3]],
    /// Colours.
    pub paint: Paint<'a>,
}

/// A perspective camera.
#[derive(Clone, Copy, Debug)]
pub struct Camera {
    eye: Vec3,
    right: Vec3,
    up: Vec3,
    forward: Vec3,
    /// Half the picture's height at distance 1 is `1 / focal`.
    focal: f32,
    /// Shift of the picture, in half heights.
    shift: Vec2,
}

/// Eye distance in radii of the model's bounding sphere: a mild perspective, about 20 degrees.
const EYE_DISTANCE: f32 = 5.5;
/// Share of the picture that the model may fill.
const FILL: f32 = 0.86;
/// Linear colour of a triangle seen from behind.
const BEHIND: [f32; 3] = [0.75, 0.03, 0.03];
/// Linear background at the top and at the bottom.
const BACKGROUND: [f32; 2] = [0.92, 0.80];
/// How much of the light the darkest ground shadow takes.
const SHADOW: f32 = 0.36;
/// Cells per side of the ground shadow's map.
const SHADOW_CELLS: usize = 192;

impl Camera {
    /// Looks at the model from `azimuth` (0 is +z, a quarter turn is +x) and `elevation` above the ground, both in radians, so that
    /// it fills the picture.
    pub fn around(positions: &[Vec3], azimuth: f32, elevation: f32) -> Self {
        let (lo, hi) = bounds(positions);
        let center = 0.5 * (lo + hi);
        let radius = (0.5 * (hi - lo).length()).max(f32::MIN_POSITIVE);
        let back = Vec3::new(azimuth.sin() * elevation.cos(), elevation.sin(), azimuth.cos() * elevation.cos());
        let forward = -back;
        let right = forward.cross(Vec3::Y).normalize_or(Vec3::X);
        let up = right.cross(forward);
        let eye = center + EYE_DISTANCE * radius * back;
        let mut camera = Self { eye, right, up, forward, focal: 1.0, shift: Vec2::ZERO };
        let (mut low, mut high) = (Vec2::INFINITY, Vec2::NEG_INFINITY);
        for &p in positions {
            let q = camera.project(p).truncate();
            (low, high) = (low.min(q), high.max(q));
        }
        if low.x <= high.x {
            camera.focal = 2.0 * FILL / (high - low).max_element().max(f32::MIN_POSITIVE);
            camera.shift = -0.5 * (low + high) * camera.focal;
        }
        camera
    }

    /// Place in the picture (x to the right, y up, the middle is 0, half the height is 1), and distance along the view.
    fn project(&self, p: Vec3) -> Vec3 {
        let d = p - self.eye;
        let z = d.dot(self.forward);
        let place = Vec2::new(d.dot(self.right), d.dot(self.up)) * (self.focal / z) + self.shift;
        place.extend(z)
    }

    /// Direction through a place in the picture, of length 1 along the view.
    fn ray(&self, place: Vec2) -> Vec3 {
        let q = (place - self.shift) / self.focal;
        self.forward + q.x * self.right + q.y * self.up
    }
}

fn bounds(positions: &[Vec3]) -> (Vec3, Vec3) {
    if positions.is_empty() {
        return (Vec3::ZERO, Vec3::ZERO);
    }
    positions.iter().fold((Vec3::INFINITY, Vec3::NEG_INFINITY), |(lo, hi), &p| (lo.min(p), hi.max(p)))
}

/// A square picture of linear RGB, row by row from the top.
#[derive(Clone, Debug, PartialEq)]
pub struct Picture {
    /// Pixels per side.
    pub side: usize,
    /// Pixels.
    pub pixels: Vec<[f32; 3]>,
}

/// What the nearest surface at a sample looks like.
#[derive(Clone, Copy, Default)]
struct Look {
    normal: Vec3,
    albedo: [f32; 3],
}

/// The nearest surface at every sample, `wide` to a row; nothing where the depth is infinite. Depths lie by themselves, as the
/// occlusion reads many of them and nothing else.
struct Samples {
    wide: usize,
    depths: Vec<f32>,
    looks: Vec<Look>,
}

/// Draws a model into a square picture of `side` pixels, with `oversampling`^2 samples per pixel.
///
/// # Errors
/// When the token is raised.
pub fn render_mesh(
    model: Model<'_>,
    camera: &Camera,
    side: usize,
    oversampling: usize,
    settings: &Settings<'_>,
) -> Result<Picture, Canceled> {
    let wide = side * oversampling;
    let samples = rasterize(model, camera, wide);
    settings.cancel.check()?;
    let (lo, hi) = bounds(model.positions);
    let ground = Ground::new(model, lo, hi);
    let reach = 0.12 * (hi - lo).length();
    let rows: Vec<Vec<[f32; 3]>> = settings.pool.install(|| {
        (0..side)
            .into_par_iter()
            .map(|y| {
                settings.cancel.check()?;
                let mut row = vec![[0.0; 3]; side];
                for (x, pixel) in row.iter_mut().enumerate() {
                    let grid = (0..oversampling * oversampling)
                        .map(|k| (x * oversampling + k % oversampling, y * oversampling + k / oversampling));
                    // occlusion is smooth: one covered sample answers for its pixel
                    let open = grid
                        .clone()
                        .find(|&(x, y)| samples.depths[y * wide + x] < f32::INFINITY)
                        .map_or(1.0, |at| openness(&samples, at, camera, reach));
                    for at in grid {
                        let light = shade(&samples, at, camera, open, &ground);
                        for (sum, c) in pixel.iter_mut().zip(light) {
                            *sum += c / (oversampling * oversampling) as f32;
                        }
                    }
                }
                Ok(row)
            })
            .collect::<Result<_, Canceled>>()
    })?;
    Ok(Picture { side, pixels: rows.concat() })
}

/// Fills the depth buffer; the middle of sample (x, y) decides.
fn rasterize(model: Model<'_>, camera: &Camera, wide: usize) -> Samples {
    let mut depths = vec![f32::INFINITY; wide * wide];
    let mut looks = vec![Look::default(); wide * wide];
    let half = 0.5 * wide as f32;
    let placed: Vec<Vec3> = model
        .positions
        .iter()
        .map(|&p| {
            let q = camera.project(p);
            Vec3::new((q.x + 1.0) * half, (1.0 - q.y) * half, q.z)
        })
        .collect();
    for &triangle in model.triangles {
        let [a, b, c] = triangle.map(|v| placed[v as usize]);
        if a.z.min(b.z).min(c.z) <= 0.0 {
            continue;
        }
        let area = (b - a).truncate().perp_dot((c - a).truncate());
        if area == 0.0 || !area.is_finite() {
            continue;
        }
        // y points down here, so counter-clockwise is negative
        let front = area < 0.0;
        let (low, high) = (a.min(b).min(c), a.max(b).max(c));
        let first = |x: f32| (x - 0.5).ceil().clamp(0.0, wide as f32) as usize;
        let last = |x: f32| ((x - 0.5).floor() + 1.0).clamp(0.0, wide as f32) as usize;
        let inverse = Vec3::new(1.0 / a.z, 1.0 / b.z, 1.0 / c.z);
        for y in first(low.y)..last(high.y) {
            for x in first(low.x)..last(high.x) {
                let p = Vec2::new(x as f32 + 0.5, y as f32 + 0.5);
                let edge = |s: Vec3, e: Vec3| (e - s).truncate().perp_dot(p - s.truncate()) / area;
                let flat = Vec3::new(edge(b, c), edge(c, a), edge(a, b));
                if flat.min_element() < 0.0 {
                    continue;
                }
                // attributes are linear in space, and so is 1/depth in the picture
                let share = flat * inverse;
                let depth = 1.0 / share.element_sum();
                let at = y * wide + x;
                if depth < depths[at] {
                    depths[at] = depth;
                    looks[at] = look(model, triangle, share * depth, front);
                }
            }
        }
    }
    Samples { wide, depths, looks }
}

fn look(model: Model<'_>, triangle: [u32; 3], weights: Vec3, front: bool) -> Look {
    let weight = weights.to_array();
    let mix = |values: [Vec3; 3]| (0..3).fold(Vec3::ZERO, |sum, k| sum + weight[k] * values[k]);
    let normal = mix(triangle.map(|v| model.normals[v as usize])).normalize_or_zero();
    let albedo = match model.paint {
        _ if !front => BEHIND,
        Paint::Plain(c) => c,
        Paint::Vertices(colors) => mix(triangle.map(|v| Vec3::from(colors[v as usize]))).to_array(),
        Paint::Places(places, spec) => {
            let place = mix(triangle.map(|v| places[v as usize])).normalize_or(Vec3::Z);
            let [u, v] = spec.place(place.as_dvec3());
            color(u as f32, v as f32, Tiles::of(spec))
        }
        Paint::Checkerboard(uv, tiles) => {
            let place = mix(triangle.map(|v| Vec3::new(uv[v as usize][0], uv[v as usize][1], 0.0)));
            color(place.x, place.y, tiles)
        }
    };
    Look { normal: if front { normal } else { -normal }, albedo }
}

/// Place in the picture of the middle of sample (x, y).
fn place(x: usize, y: usize, wide: usize) -> Vec2 {
    Vec2::new((x as f32 + 0.5) / wide as f32 * 2.0 - 1.0, 1.0 - (y as f32 + 0.5) / wide as f32 * 2.0)
}

fn shade(samples: &Samples, (x, y): (usize, usize), camera: &Camera, open: f32, ground: &Ground) -> [f32; 3] {
    let wide = samples.wide;
    let (depth, look) = (samples.depths[y * wide + x], samples.looks[y * wide + x]);
    let ray = camera.ray(place(x, y, wide));
    if depth == f32::INFINITY {
        let t = (y as f32 + 0.5) / wide as f32;
        let light = BACKGROUND[0] + (BACKGROUND[1] - BACKGROUND[0]) * t;
        let open = 1.0 - SHADOW * ground.shadow(camera.eye, ray);
        return [light * open, light * open, (light * 1.01 * open).min(1.0)];
    }
    let toward = -ray.normalize();
    let world = |v: Vec3| (v.x * camera.right + v.y * camera.up - v.z * camera.forward).normalize();
    let (key, fill) = (world(Vec3::new(-0.5, 0.75, 0.65)), world(Vec3::new(0.9, 0.1, 0.5)));
    let n = look.normal;
    // light from the whole sky, a little from the ground
    let ambient = (0.38 + 0.14 * n.y) * open;
    let diffuse = ambient + 0.62 * n.dot(key).max(0.0) * (0.4 + 0.6 * open) + 0.16 * n.dot(fill).max(0.0) * open;
    let gloss = 0.06 * n.dot((key + toward).normalize_or_zero()).max(0.0).powi(40) * open;
    look.albedo.map(|c| (c * diffuse + gloss).min(1.0))
}

/// Share of the sky that a sample sees, from the depth buffer around it (McGuire et al. 2011, "The Alchemy screen-space ambient
/// obscurance algorithm", equation 10), on a spiral of fixed offsets turned by a hash of the pixel.
fn openness(samples: &Samples, (x, y): (usize, usize), camera: &Camera, reach: f32) -> f32 {
    /// Offsets; enough that the turn, another in every pixel, leaves no visible noise.
    const TAPS: u32 = 16;
    /// Radians between offsets: the golden angle spreads them evenly.
    const GOLDEN: f32 = 2.399_963_2;
    let wide = samples.wide;
    let (depth, normal) = (samples.depths[y * wide + x], samples.looks[y * wide + x].normal);
    let spot = camera.ray(place(x, y, wide)) * depth;
    let radius = reach * camera.focal / depth * 0.5 * wide as f32;
    let hash = (x as u32).wrapping_mul(0x9e37_79b9) ^ (y as u32).wrapping_mul(0x85eb_ca6b);
    let turn = (hash ^ (hash >> 15)).wrapping_mul(0x2c1b_3c6d) as f32 / u32::MAX as f32 * std::f32::consts::TAU;
    let mut blocked = 0.0;
    for k in 0..TAPS {
        let share = ((k as f32 + 0.5) / TAPS as f32).sqrt();
        let angle = turn + GOLDEN * k as f32;
        let (tx, ty) = (x as f32 + share * radius * angle.cos(), y as f32 + share * radius * angle.sin());
        if tx < 0.0 || ty < 0.0 || tx >= wide as f32 || ty >= wide as f32 {
            continue;
        }
        let (tx, ty) = (tx as usize, ty as usize);
        let other = samples.depths[ty * wide + tx];
        if other == f32::INFINITY {
            continue;
        }
        let way = camera.ray(place(tx, ty, wide)) * other - spot;
        let bias = 0.02 * reach;
        blocked += (way.dot(normal) - bias).max(0.0) * reach / (way.length_squared() + 0.05 * reach * reach);
    }
    (1.0 - 1.1 * blocked / TAPS as f32).clamp(0.0, 1.0)
}

/// The soft shadow on the plane under the model: its outline seen from a high light, blurred.
struct Ground {
    height: f32,
    corner: Vec2,
    cell: f32,
    dark: Vec<f32>,
}

impl Ground {
    fn new(model: Model<'_>, lo: Vec3, hi: Vec3) -> Self {
        let size = (hi - lo).length();
        // how far the light leans per unit of height
        let lean = Vec2::new(0.22, -0.12);
        let extent = size * 1.8;
        let middle = Vec2::new(lo.x + hi.x, lo.z + hi.z) * 0.5;
        let corner = middle - 0.5 * extent;
        let cell = (extent / SHADOW_CELLS as f32).max(f32::MIN_POSITIVE);
        let mut dark = vec![0.0f32; SHADOW_CELLS * SHADOW_CELLS];
        for &triangle in model.triangles {
            let [a, b, c] = triangle.map(|v| {
                let p = model.positions[v as usize];
                (Vec2::new(p.x, p.z) + lean * (p.y - lo.y) - corner) / cell
            });
            let area = (b - a).perp_dot(c - a);
            let (low, high) = (a.min(b).min(c).floor().max(Vec2::ZERO), a.max(b).max(c).ceil());
            let top = high.min(Vec2::splat(SHADOW_CELLS as f32));
            for y in low.y as usize..top.y.max(0.0) as usize {
                for x in low.x as usize..top.x.max(0.0) as usize {
                    let p = Vec2::new(x as f32 + 0.5, y as f32 + 0.5);
                    let edges = [(b, c), (c, a), (a, b)].map(|(s, e)| (e - s).perp_dot(p - s) * area.signum());
                    if edges.iter().all(|&e| e >= 0.0) {
                        dark[y * SHADOW_CELLS + x] = 1.0;
                    }
                }
            }
        }
        for radius in [3, 5, 7] {
            dark = blurred(&dark, radius);
        }
        Self { height: lo.y, corner, cell, dark }
    }

    /// Darkness, from 0 to 1, of the ground where a ray meets it; 0 where it does not, and from below.
    fn shadow(&self, eye: Vec3, ray: Vec3) -> f32 {
        let t = (self.height - eye.y) / ray.y;
        let from_below = eye.y < self.height;
        if from_below || !(t > 0.0 && t.is_finite()) {
            return 0.0;
        }
        let hit = eye + t * ray;
        let at = (Vec2::new(hit.x, hit.z) - self.corner) / self.cell - 0.5;
        let base = at.floor();
        let (fx, fy) = (at.x - base.x, at.y - base.y);
        let read = |dx: f32, dy: f32| {
            let (x, y) = (base.x + dx, base.y + dy);
            let inside = x >= 0.0 && y >= 0.0 && x < SHADOW_CELLS as f32 && y < SHADOW_CELLS as f32;
            if inside { self.dark[y as usize * SHADOW_CELLS + x as usize] } else { 0.0 }
        };
        let low = read(0.0, 0.0) * (1.0 - fx) + read(1.0, 0.0) * fx;
        let high = read(0.0, 1.0) * (1.0 - fx) + read(1.0, 1.0) * fx;
        low * (1.0 - fy) + high * fy
    }
}

/// Box blur of the shadow's map along both axes.
fn blurred(map: &[f32], radius: usize) -> Vec<f32> {
    let n = SHADOW_CELLS;
    let pass = |source: &[f32], stride: usize, other: usize| -> Vec<f32> {
        let mut out = vec![0.0; n * n];
        for line in 0..n {
            for i in 0..n {
                let (from, to) = (i.saturating_sub(radius), (i + radius + 1).min(n));
                let sum: f32 = (from..to).map(|j| source[line * other + j * stride]).sum();
                out[line * other + i * stride] = sum / (2 * radius + 1) as f32;
            }
        }
        out
    };
    pass(&pass(map, 1, n), n, 1)
}

/// Vertex normals of a bare mesh: face normals weighted by area.
pub fn smooth_normals(positions: &[Vec3], triangles: &[[u32; 3]]) -> Vec<Vec3> {
    let mut normals = vec![Vec3::ZERO; positions.len()];
    for &t in triangles {
        let [a, b, c] = t.map(|v| positions[v as usize]);
        for v in t {
            normals[v as usize] += (b - a).cross(c - a);
        }
    }
    normals.into_iter().map(Vec3::normalize_or_zero).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::measure::fixtures::{sphere_mesh, with_settings};

    fn ball(triangles: impl Fn(&[[u32; 3]]) -> Vec<[u32; 3]>, threads: usize) -> Picture {
        let (vertices, faces) = sphere_mesh(32, 16, 1.0, glam::DVec3::ZERO);
        let positions: Vec<Vec3> = vertices.iter().map(|p| p.as_vec3()).collect();
        let model = Model {
            positions: &positions,
            normals: &positions,
            triangles: &triangles(&faces),
            paint: Paint::Plain([0.1, 0.2, 0.6]),
        };
        let camera = Camera::around(&positions, 0.5, 0.3);
        with_settings(threads, |settings| render_mesh(model, &camera, 64, 2, settings).unwrap())
    }

    #[test]
    fn a_ball_is_a_shaded_disc_on_a_light_background() {
        let picture = ball(<[_]>::to_vec, 2);
        let [r, _, b] = picture.pixels[32 * 64 + 32];
        assert!(b > 2.0 * r && b > 0.1, "blue in the middle");
        let corner = picture.pixels[0];
        assert!(corner.iter().all(|&c| c > 0.8), "{corner:?}");
        let covered = picture.pixels.iter().filter(|p| p[2] > 1.5 * p[0]).count() as f32 / 4096.0;
        let disc = std::f32::consts::PI / 4.0 * FILL * FILL;
        assert!((covered - disc).abs() < 0.03, "{covered} {disc}");
        let light = |x: usize, y: usize| picture.pixels[y * 64 + x][2];
        assert!(light(24, 16) > light(42, 52), "lit from above");
    }

    #[test]
    fn a_ball_turned_inside_out_is_red() {
        let picture = ball(|faces| faces.iter().map(|&[a, b, c]| [a, c, b]).collect(), 1);
        let [r, g, _] = picture.pixels[32 * 64 + 32];
        assert!(r > 4.0 * g, "{r} {g}");
    }

    #[test]
    fn threads_do_not_change_a_pixel() {
        assert_eq!(ball(<[_]>::to_vec, 1), ball(<[_]>::to_vec, 3));
    }
}
