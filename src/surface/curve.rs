//! Curves as files: a drawing (SVG), a line loop (GLB), a picture (PNG) and numbers (safetensors), in scene units with y
//! upwards.

mod picture;
mod tensors;

pub use picture::to_png;
pub use tensors::{curvatures, to_safetensors};

use crate::shrink::curve::Curve;
use gltf_json as json;
use json::accessor::Type;
use json::mesh::Semantic;
use json::validation::{Checked, USize64};
use std::collections::BTreeMap;
use std::fmt::Write;

/// Ticks that show the parameter, evenly spaced in it.
const TICKS: usize = 64;
/// Room around the drawing, length of a tick and width of a line, in parts of the curve's longer side.
const MARGIN: f64 = 0.1;
const TICK: f64 = 0.04;
const LINE: f64 = 0.004;

/// The curve as an SVG drawing: its outline, and across it ticks at equal steps of the parameter, coloured from red at 0
/// once around the colour circle; a dot marks parameter 0. User units are scene units.
pub fn to_svg(curve: &Curve) -> String {
    let (lo, hi) = bounds(&curve.positions);
    let longest = (hi[0] - lo[0]).max(hi[1] - lo[1]).max(f64::MIN_POSITIVE);
    let margin = MARGIN * longest;
    let (width, height) = (hi[0] - lo[0] + 2.0 * margin, hi[1] - lo[1] + 2.0 * margin);
    // six digits of a curve of size 1, as many of any other
    let digits = (6.0 - longest.log10().floor()).clamp(0.0, 16.0) as usize;
    let mut svg = String::new();
    // y is turned by the group, so the box starts at the negated top; writing to a string cannot fail
    let _ = writeln!(
        svg,
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"{:.digits$} {:.digits$} {width:.digits$} {height:.digits$}\">",
        lo[0] - margin,
        -(hi[1] + margin)
    );
    let _ = writeln!(svg, "<title>parameterized curve of {} samples</title>", curve.positions.len());
    let line = LINE * longest;
    let _ = writeln!(svg, "<g transform=\"scale(1 -1)\" fill=\"none\" stroke-width=\"{line:.digits$}\">");
    let _ = write!(svg, "<path stroke=\"#222\" stroke-linejoin=\"round\" fill=\"#f4f1ea\" d=\"");
    for (i, p) in curve.positions.iter().enumerate() {
        let _ = write!(svg, "{}{:.digits$} {:.digits$}", if i == 0 { "M" } else { "L" }, p[0], p[1]);
    }
    svg.push_str("Z\"/>\n");
    for k in 0..TICKS {
        let u = k as f64 / TICKS as f64;
        let (p, n) = at_parameter(curve, u);
        let [r, g, b] = hue(u);
        let half = 0.5 * TICK * longest;
        let _ = writeln!(
            svg,
            "<path stroke=\"#{r:02x}{g:02x}{b:02x}\" d=\"M{:.digits$} {:.digits$}L{:.digits$} {:.digits$}\"/>",
            p[0] - half * n[0],
            p[1] - half * n[1],
            p[0] + half * n[0],
            p[1] + half * n[1]
        );
    }
    if let Some(p) = curve.positions.first() {
        let _ = writeln!(
            svg,
            "<circle cx=\"{:.digits$}\" cy=\"{:.digits$}\" r=\"{:.digits$}\" fill=\"#f00\"/>",
            p[0],
            p[1],
            2.5 * line
        );
    }
    svg.push_str("</g>\n</svg>\n");
    svg
}

fn bounds(positions: &[[f64; 2]]) -> ([f64; 2], [f64; 2]) {
    positions.iter().fold(([f64::INFINITY; 2], [f64::NEG_INFINITY; 2]), |(lo, hi), p| {
        ([lo[0].min(p[0]), lo[1].min(p[1])], [hi[0].max(p[0]), hi[1].max(p[1])])
    })
}

/// Position and normal at parameter `u` in [0, 1).
fn at_parameter(curve: &Curve, u: f64) -> ([f64; 2], [f64; 2]) {
    let n = curve.positions.len();
    let after = curve.parameters.partition_point(|&p| p <= u);
    let (a, b) = (after.saturating_sub(1), after % n);
    let (start, end) = (curve.parameters[a], curve.parameters.get(after).copied().unwrap_or(1.0));
    let t = if end > start { (u - start) / (end - start) } else { 0.0 };
    let mix = |v: &[[f64; 2]]| [0, 1].map(|k| v[a][k] + t * (v[b][k] - v[a][k]));
    (mix(&curve.positions), mix(&curve.normals))
}

/// The colour circle: red, yellow, green, cyan, blue, magenta, red.
fn hue(u: f64) -> [u8; 3] {
    let channel = |shift: f64| {
        let k = (6.0 * u + shift).rem_euclid(6.0);
        (255.0 * (1.0 - k.min(4.0 - k).clamp(0.0, 1.0))).round() as u8
    };
    [channel(5.0), channel(3.0), channel(1.0)]
}

/// The curve as a binary glTF: one mesh with one primitive of mode `LINE_LOOP` in the plane z = 0, with POSITION, NORMAL and
/// TEXCOORD_0 (u = the parameter, v = 1/2), and a texture of the colour circle that shows u in any viewer. `report` and
/// `provenance` (where the field came from) become the members of the root's `extras`.
pub fn to_glb(curve: &Curve, report: &serde_json::Value, provenance: &serde_json::Value) -> Vec<u8> {
    let narrow = |v: &[[f64; 2]]| -> Vec<[f32; 3]> { v.iter().map(|p| [p[0] as f32, p[1] as f32, 0.0]).collect() };
    let (positions, normals) = (narrow(&curve.positions), narrow(&curve.normals));
    let fold = |f: fn(f32, f32) -> f32| -> json::Value {
        let along = |k: usize| positions.iter().map(|p| p[k]).reduce(f).unwrap_or(0.0);
        json::Value::from(vec![along(0), along(1), along(2)])
    };
    let range = Some((fold(f32::min), fold(f32::max)));
    let uv: Vec<[f32; 2]> = curve.parameters.iter().map(|&u| [u as f32, 0.5]).collect();

    let mut file = File::default();
    let attributes = BTreeMap::from([
        (Checked::Valid(Semantic::Positions), file.attribute(Type::Vec3, &positions, range)),
        (Checked::Valid(Semantic::Normals), file.attribute(Type::Vec3, &normals, None)),
        (Checked::Valid(Semantic::TexCoords(0)), file.attribute(Type::Vec2, &uv, None)),
    ]);
    let material = file.material();
    let primitive = json::mesh::Primitive {
        attributes,
        extensions: None,
        extras: None,
        indices: None,
        material: Some(material),
        mode: Checked::Valid(json::mesh::Mode::LineLoop),
        targets: None,
    };
    let mesh = file.root.push(json::Mesh {
        extensions: None,
        extras: None,
        name: Some("curve".to_owned()),
        primitives: vec![primitive],
        weights: None,
    });
    let node = json::Node { mesh: Some(mesh), name: Some("curve".to_owned()), ..json::Node::default() };
    let node = file.root.push(node);
    let scene = file.root.push(json::Scene { extensions: None, extras: None, name: None, nodes: vec![node] });
    file.root.scene = Some(scene);
    let extras = serde_json::json!({ "report": report, "provenance": provenance });
    file.root.extras = serde_json::value::to_raw_value(&extras).ok();
    file.finish()
}

/// A glTF in the making: the document, and the bytes of its one buffer.
#[derive(Default)]
struct File {
    root: json::Root,
    bytes: Vec<u8>,
}

impl File {
    /// Appends bytes as a view, which starts at a multiple of 4.
    fn view(&mut self, bytes: &[u8], target: Option<json::buffer::Target>) -> json::Index<json::buffer::View> {
        self.bytes.resize(self.bytes.len().next_multiple_of(4), 0);
        let offset = self.bytes.len();
        self.bytes.extend_from_slice(bytes);
        self.root.push(json::buffer::View {
            buffer: json::Index::new(0),
            byte_length: USize64::from(bytes.len()),
            byte_offset: Some(USize64::from(offset)),
            byte_stride: None,
            name: None,
            target: target.map(Checked::Valid),
            extensions: None,
            extras: None,
        })
    }

    fn attribute<const N: usize>(
        &mut self,
        shape: Type,
        values: &[[f32; N]],
        range: Option<(json::Value, json::Value)>,
    ) -> json::Index<json::Accessor> {
        let bytes: Vec<u8> = values.iter().flatten().flat_map(|v| v.to_le_bytes()).collect();
        let view = self.view(&bytes, Some(json::buffer::Target::ArrayBuffer));
        let (min, max) = range.unzip();
        self.root.push(json::Accessor {
            buffer_view: Some(view),
            byte_offset: None,
            count: USize64::from(values.len()),
            component_type: Checked::Valid(json::accessor::GenericComponentType(json::accessor::ComponentType::F32)),
            extensions: None,
            extras: None,
            type_: Checked::Valid(shape),
            min,
            max,
            name: None,
            normalized: false,
            sparse: None,
        })
    }

    /// A material with the colour circle along u.
    fn material(&mut self) -> json::Index<json::Material> {
        /// Pixels around the circle; linear filtering fills in.
        const PIXELS: u32 = 64;
        let picture =
            image::RgbImage::from_fn(PIXELS, 1, |x, _| image::Rgb(hue((f64::from(x) + 0.5) / f64::from(PIXELS))));
        let mut png = std::io::Cursor::new(Vec::new());
        // writing a picture of known size to memory cannot fail
        let _ = picture.write_to(&mut png, image::ImageFormat::Png);
        let view = self.view(&png.into_inner(), None);
        let source = self.root.push(json::Image {
            buffer_view: Some(view),
            mime_type: Some(json::image::MimeType("image/png".to_owned())),
            name: None,
            uri: None,
            extensions: None,
            extras: None,
        });
        let sampler = self.root.push(json::texture::Sampler {
            mag_filter: Some(Checked::Valid(json::texture::MagFilter::Linear)),
            min_filter: Some(Checked::Valid(json::texture::MinFilter::Linear)),
            ..json::texture::Sampler::default()
        });
        let index = self.root.push(json::Texture {
            name: None,
            sampler: Some(sampler),
            source,
            extensions: None,
            extras: None,
        });
        self.root.push(json::Material {
            pbr_metallic_roughness: json::material::PbrMetallicRoughness {
                base_color_texture: Some(json::texture::Info { index, tex_coord: 0, extensions: None, extras: None }),
                metallic_factor: json::material::StrengthFactor(0.0),
                ..json::material::PbrMetallicRoughness::default()
            },
            ..json::Material::default()
        })
    }

    fn finish(mut self) -> Vec<u8> {
        self.root.asset.generator = Some(concat!("shrinkd ", env!("CARGO_PKG_VERSION")).to_owned());
        self.root.push(json::Buffer {
            byte_length: USize64::from(self.bytes.len()),
            name: None,
            uri: None,
            extensions: None,
            extras: None,
        });
        container(self.root.to_string().unwrap_or_default().into_bytes(), self.bytes)
    }
}

/// A GLB of a JSON chunk and a binary chunk (glTF 2.0, section 4.4), each padded to 4 bytes.
fn container(mut text: Vec<u8>, mut binary: Vec<u8>) -> Vec<u8> {
    const MAGIC: &[u8; 4] = b"glTF";
    const VERSION: u32 = 2;
    text.resize(text.len().next_multiple_of(4), b' ');
    binary.resize(binary.len().next_multiple_of(4), 0);
    let length = 12 + 8 + text.len() + 8 + binary.len();
    let mut glb = Vec::with_capacity(length);
    glb.extend_from_slice(MAGIC);
    glb.extend_from_slice(&VERSION.to_le_bytes());
    glb.extend_from_slice(&(length as u32).to_le_bytes());
    for (kind, chunk) in [(b"JSON", text), (b"BIN\0", binary)] {
        glb.extend_from_slice(&(chunk.len() as u32).to_le_bytes());
        glb.extend_from_slice(kind);
        glb.extend_from_slice(&chunk);
    }
    glb
}

#[cfg(test)]
mod tests {
    use super::*;

    pub(super) fn diamond() -> Curve {
        let positions = vec![[2.0, 0.0], [0.0, 1.0], [-2.0, 0.0], [0.0, -1.0]];
        Curve {
            normals: positions.iter().map(|p: &[f64; 2]| p.map(|c| c.signum() * f64::from(c != 0.0))).collect(),
            positions,
            parameters: vec![0.0, 0.25, 0.5, 0.75],
            corners: vec![true; 4],
            values: vec![0.0; 4],
            gradient_norms: vec![1.0; 4],
            left_out: crate::shrink::curve::LeftOut::default(),
        }
    }

    #[test]
    fn the_drawing_holds_the_whole_curve_with_y_upwards() {
        let svg = to_svg(&diamond());
        assert!(svg.contains("viewBox=\"-2.400000 -1.400000 4.800000 2.800000\""), "{svg}");
        assert!(svg.contains("<g transform=\"scale(1 -1)\""));
        assert!(svg.contains("M2.000000 0.000000L0.000000 1.000000L-2.000000 0.000000L0.000000 -1.000000Z"));
        assert_eq!(svg.matches("<path stroke=\"#").count(), 1 + TICKS);
        assert!(svg.contains("#ff0000\" d=\"M1.92"), "the tick at parameter 0 is red, across the first sample: {svg}");
    }

    #[test]
    fn the_glb_reads_back_as_a_line_loop_with_the_parameter_as_u() {
        let glb = to_glb(&diamond(), &serde_json::json!({"vertices": 4}), &serde_json::json!({}));
        let file = gltf::Gltf::from_slice(&glb).unwrap();
        let primitive = file.meshes().next().unwrap().primitives().next().unwrap();
        assert_eq!(primitive.mode(), gltf::mesh::Mode::LineLoop);
        let blob = file.blob.as_deref();
        let reader = primitive.reader(|_| blob);
        let positions: Vec<_> = reader.read_positions().unwrap().collect();
        assert_eq!(positions[1], [0.0, 1.0, 0.0]);
        let uv: Vec<_> = reader.read_tex_coords(0).unwrap().into_f32().collect();
        assert_eq!(uv, [[0.0, 0.5], [0.25, 0.5], [0.5, 0.5], [0.75, 0.5]]);
        assert_eq!(primitive.bounding_box().min, [-2.0, -1.0, 0.0]);
        assert_eq!(glb.len() % 4, 0);
    }

    #[test]
    fn colours_go_once_around_the_circle() {
        assert_eq!([0.0, 1.0 / 3.0, 2.0 / 3.0].map(hue), [[255, 0, 0], [0, 255, 0], [0, 0, 255]]);
        assert_eq!(hue(1.0 / 6.0), [255, 255, 0]);
    }
}
