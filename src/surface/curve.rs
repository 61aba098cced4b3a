//! Curves as files: a drawing (SVG) and a line loop (GLB), both in scene units with y upwards.

use crate::shrink::curve::Curve;
use gltf_json as json;
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
    let mut svg = String::new();
    // y is turned by the group, so the box starts at the negated top; writing to a string cannot fail
    let _ = writeln!(
        svg,
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"{:.6} {:.6} {width:.6} {height:.6}\">",
        lo[0] - margin,
        -(hi[1] + margin)
    );
    let _ = writeln!(svg, "<title>parameterized curve of {} samples</title>", curve.positions.len());
    let line = LINE * longest;
    let _ = writeln!(svg, "<g transform=\"scale(1 -1)\" fill=\"none\" stroke-width=\"{line:.6}\">");
    let _ = write!(svg, "<path stroke=\"#222\" stroke-linejoin=\"round\" fill=\"#f4f1ea\" d=\"");
    for (i, p) in curve.positions.iter().enumerate() {
        let _ = write!(svg, "{}{:.6} {:.6}", if i == 0 { "M" } else { "L" }, p[0], p[1]);
    }
    svg.push_str("Z\"/>\n");
    for k in 0..TICKS {
        let u = k as f64 / TICKS as f64;
        let (p, n) = at_parameter(curve, u);
        let [r, g, b] = hue(u);
        let half = 0.5 * TICK * longest;
        let _ = writeln!(
            svg,
            "<path stroke=\"#{r:02x}{g:02x}{b:02x}\" d=\"M{:.6} {:.6}L{:.6} {:.6}\"/>",
            p[0] - half * n[0],
            p[1] - half * n[1],
            p[0] + half * n[0],
            p[1] + half * n[1]
        );
    }
    if let Some(p) = curve.positions.first() {
        let _ = writeln!(svg, "<circle cx=\"{:.6}\" cy=\"{:.6}\" r=\"{:.6}\" fill=\"#f00\"/>", p[0], p[1], 2.5 * line);
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
/// TEXCOORD_0 (u = the parameter, v = 0). The extras of the mesh hold the report.
pub fn to_glb(curve: &Curve) -> Vec<u8> {
    let count = curve.positions.len();
    let narrow = |v: &[[f64; 2]]| -> Vec<[f32; 2]> { v.iter().map(|p| [p[0] as f32, p[1] as f32]).collect() };
    let (positions, normals) = (narrow(&curve.positions), narrow(&curve.normals));
    let mut bytes: Vec<u8> = Vec::with_capacity(count * 32);
    let mut root = json::Root {
        asset: json::Asset {
            generator: Some(concat!("shrinkd ", env!("CARGO_PKG_VERSION")).to_owned()),
            ..json::Asset::default()
        },
        ..json::Root::default()
    };
    let buffer = root.push(json::Buffer {
        byte_length: USize64::from(count * 32),
        name: None,
        uri: None,
        extensions: None,
        extras: None,
    });
    let mut attributes = BTreeMap::new();
    let mut attribute = |root: &mut json::Root, semantic, shape, range: Option<[[f32; 3]; 2]>, values: &[f32]| {
        let offset = bytes.len();
        values.iter().for_each(|v| bytes.extend_from_slice(&v.to_le_bytes()));
        let view = root.push(json::buffer::View {
            buffer,
            byte_length: USize64::from(bytes.len() - offset),
            byte_offset: Some(USize64::from(offset)),
            byte_stride: None,
            name: None,
            target: Some(Checked::Valid(json::buffer::Target::ArrayBuffer)),
            extensions: None,
            extras: None,
        });
        let accessor = root.push(json::Accessor {
            buffer_view: Some(view),
            byte_offset: None,
            count: USize64::from(count),
            component_type: Checked::Valid(json::accessor::GenericComponentType(json::accessor::ComponentType::F32)),
            extensions: None,
            extras: None,
            type_: Checked::Valid(shape),
            min: range.map(|r| json::Value::from(r[0].to_vec())),
            max: range.map(|r| json::Value::from(r[1].to_vec())),
            name: None,
            normalized: false,
            sparse: None,
        });
        attributes.insert(Checked::Valid(semantic), accessor);
    };
    let flat = |v: &[[f32; 2]]| -> Vec<f32> { v.iter().flat_map(|p| [p[0], p[1], 0.0]).collect() };
    let fold = |f: fn(f32, f32) -> f32| -> [f32; 3] {
        let along = |k: usize| positions.iter().map(|p| p[k]).reduce(f).unwrap_or(0.0);
        [along(0), along(1), 0.0]
    };
    let range = Some([fold(f32::min), fold(f32::max)]);
    let uv: Vec<f32> = curve.parameters.iter().flat_map(|&u| [u as f32, 0.0]).collect();
    use json::accessor::Type;
    use json::mesh::Semantic;
    attribute(&mut root, Semantic::Positions, Type::Vec3, range, &flat(&positions));
    attribute(&mut root, Semantic::Normals, Type::Vec3, None, &flat(&normals));
    attribute(&mut root, Semantic::TexCoords(0), Type::Vec2, None, &uv);
    let primitive = json::mesh::Primitive {
        attributes,
        extensions: None,
        extras: None,
        indices: None,
        material: None,
        mode: Checked::Valid(json::mesh::Mode::LineLoop),
        targets: None,
    };
    let report = serde_json::json!({ "report": curve.report });
    let mesh = root.push(json::Mesh {
        extensions: None,
        extras: serde_json::value::to_raw_value(&report).ok(),
        name: Some("curve".to_owned()),
        primitives: vec![primitive],
        weights: None,
    });
    let node = root.push(json::Node { mesh: Some(mesh), name: Some("curve".to_owned()), ..json::Node::default() });
    let scene = root.push(json::Scene { extensions: None, extras: None, name: None, nodes: vec![node] });
    root.scene = Some(scene);
    container(root.to_string().unwrap_or_default().into_bytes(), bytes)
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
