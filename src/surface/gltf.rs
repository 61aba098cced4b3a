//! A surface as binary glTF: one mesh, one primitive, one material with an embedded checkerboard.
//!
//! Positions are scene units as they are; no axis is turned (glTF viewers take +y as up). Vertices are the chart's, so the seam is
//! doubled and every polar sector has a pole of its own. Where the chart was relaxed, `TEXCOORD_0` is what it became and `TEXCOORD_1`
//! the place on the sphere. The same surface and the same JSON give the same bytes.

pub mod morph;

use super::Surface;
use super::checkerboard::{Tiles, texture};
use glam::Vec3;
use gltf_json as json;
use json::Index;
use json::validation::Checked::Valid;
use json::validation::USize64;
use serde_json::{Value, json};
use std::collections::BTreeMap;

/// Pixels per side of a tile of the embedded texture.
const TILE_PIXELS: u32 = 16;
/// Largest index that is written in 16 bits; 65535 restarts primitives and is not allowed.
const LAST_SHORT: usize = 65_534;

/// The binary buffer while it is filled: every view starts on a multiple of four bytes.
#[derive(Default)]
struct Buffer {
    bytes: Vec<u8>,
    views: Vec<json::buffer::View>,
}

impl Buffer {
    fn push(&mut self, bytes: &[u8], target: Option<json::buffer::Target>, name: &str) -> Index<json::buffer::View> {
        let offset = self.bytes.len();
        self.bytes.extend_from_slice(bytes);
        self.bytes.resize(self.bytes.len().next_multiple_of(4), 0);
        let view = json::buffer::View {
            buffer: Index::new(0),
            byte_length: USize64::from(bytes.len()),
            byte_offset: Some(USize64::from(offset)),
            byte_stride: None,
            name: Some(name.to_owned()),
            target: target.map(Valid),
            extensions: None,
            extras: Default::default(),
        };
        Index::push(&mut self.views, view)
    }
}

fn accessor(
    view: Index<json::buffer::View>,
    count: usize,
    component: json::accessor::ComponentType,
    kind: json::accessor::Type,
    range: Option<[Value; 2]>,
    name: &str,
) -> json::Accessor {
    let (min, max) = range.map_or((None, None), |[min, max]| (Some(min), Some(max)));
    json::Accessor {
        buffer_view: Some(view),
        byte_offset: None,
        count: USize64::from(count),
        component_type: Valid(json::accessor::GenericComponentType(component)),
        type_: Valid(kind),
        min,
        max,
        name: Some(name.to_owned()),
        normalized: false,
        sparse: None,
        extensions: None,
        extras: Default::default(),
    }
}

/// The range of positions.
fn bounds(positions: &[[f32; 3]]) -> [Value; 2] {
    let range = positions.iter().fold([[f32::INFINITY; 3], [f32::NEG_INFINITY; 3]], |[lo, hi], p| {
        [0, 1].map(|side| std::array::from_fn(|k| if side == 0 { lo[k].min(p[k]) } else { hi[k].max(p[k]) }))
    });
    range.map(|b| json!(b))
}

fn little_endian<const N: usize>(items: &[[f32; N]]) -> Vec<u8> {
    items.iter().flatten().flat_map(|x| x.to_le_bytes()).collect()
}

/// A normal whose length is 1 in single precision. A zero or broken one becomes +y, as the format has no "none".
fn unit(normal: [f32; 3]) -> [f32; 3] {
    Vec3::from(normal).as_dvec3().normalize_or(glam::DVec3::Y).as_vec3().to_array()
}

/// The surface as a GLB. `report` and `provenance` (where the field came from) become the members of the asset's root `extras`.
pub fn to_glb(surface: &Surface, report: &Value, provenance: &Value) -> Vec<u8> {
    let (root, buffer) = document(surface, report, provenance);
    written(root, buffer)
}

/// A document whose buffer is complete as a file.
fn written(mut root: json::Root, buffer: Buffer) -> Vec<u8> {
    root.buffers[0].byte_length = USize64::from(buffer.bytes.len());
    root.buffer_views = buffer.views;
    container(root.to_vec().expect("glTF of plain values is always JSON"), buffer.bytes)
}

/// The document of a surface, and its buffer so far: their sizes are entered when it is written.
fn document(surface: &Surface, report: &Value, provenance: &Value) -> (json::Root, Buffer) {
    use json::accessor::{ComponentType, Type};
    use json::buffer::Target;
    let lattice = &surface.lattice;
    let positions: Vec<[f32; 3]> = lattice.chart.iter().map(|&v| surface.positions[v as usize]).collect();
    let normals: Vec<[f32; 3]> = lattice.chart.iter().map(|&v| unit(surface.normals[v as usize])).collect();
    let single = |uv: &[[f64; 2]]| -> Vec<u8> { uv.iter().flatten().flat_map(|&c| (c as f32).to_le_bytes()).collect() };
    let corners = surface.chart_triangles.iter().flatten();
    let (index_bytes, index_type): (Vec<u8>, ComponentType) = if positions.len() <= LAST_SHORT + 1 {
        (corners.flat_map(|&v| (v as u16).to_le_bytes()).collect(), ComponentType::U16)
    } else {
        (corners.flat_map(|&v| v.to_le_bytes()).collect(), ComponentType::U32)
    };

    let mut buffer = Buffer::default();
    let mut accessors = Vec::new();
    let mut attributes = BTreeMap::new();
    let mut written = vec![
        (json::mesh::Semantic::Positions, little_endian(&positions), Type::Vec3, Some(bounds(&positions)), "positions"),
        (json::mesh::Semantic::Normals, little_endian(&normals), Type::Vec3, None, "normals"),
        (json::mesh::Semantic::TexCoords(0), single(surface.uv()), Type::Vec2, None, "uv"),
    ];
    if surface.relaxed_uv.is_some() {
        written.push((json::mesh::Semantic::TexCoords(1), single(&lattice.uv), Type::Vec2, None, "sphere"));
    }
    for (semantic, bytes, kind, range, name) in written {
        let view = buffer.push(&bytes, Some(Target::ArrayBuffer), name);
        let entry = accessor(view, positions.len(), ComponentType::F32, kind, range, name);
        attributes.insert(Valid(semantic), Index::push(&mut accessors, entry));
    }
    let view = buffer.push(&index_bytes, Some(Target::ElementArrayBuffer), "indices");
    let count = 3 * surface.chart_triangles.len();
    let indices = Index::push(&mut accessors, accessor(view, count, index_type, Type::Scalar, None, "indices"));
    let image = buffer.push(&texture(Tiles::of(lattice.spec), TILE_PIXELS), None, "checkerboard");

    let root = json::Root {
        accessors,
        asset: json::Asset {
            generator: Some(concat!("shrinkd ", env!("CARGO_PKG_VERSION")).to_owned()),
            ..Default::default()
        },
        buffers: vec![json::Buffer {
            byte_length: USize64(0),
            name: None,
            uri: None,
            extensions: None,
            extras: Default::default(),
        }],
        extras: serde_json::value::to_raw_value(&json!({ "report": report, "provenance": provenance })).ok(),
        images: vec![json::Image {
            buffer_view: Some(image),
            mime_type: Some(json::image::MimeType("image/png".to_owned())),
            name: Some("checkerboard".to_owned()),
            uri: None,
            extensions: None,
            extras: Default::default(),
        }],
        materials: vec![material()],
        meshes: vec![json::Mesh {
            extensions: None,
            extras: Default::default(),
            name: Some("surface".to_owned()),
            primitives: vec![json::mesh::Primitive {
                attributes,
                extensions: None,
                extras: Default::default(),
                indices: Some(indices),
                material: Some(Index::new(0)),
                mode: Valid(json::mesh::Mode::Triangles),
                targets: None,
            }],
            weights: None,
        }],
        nodes: vec![json::Node { mesh: Some(Index::new(0)), name: Some("surface".to_owned()), ..Default::default() }],
        samplers: vec![json::texture::Sampler {
            mag_filter: Some(Valid(json::texture::MagFilter::Linear)),
            min_filter: Some(Valid(json::texture::MinFilter::LinearMipmapLinear)),
            wrap_s: Valid(json::texture::WrappingMode::Repeat),
            wrap_t: Valid(json::texture::WrappingMode::Repeat),
            ..Default::default()
        }],
        scene: Some(Index::new(0)),
        scenes: vec![json::Scene {
            extensions: None,
            extras: Default::default(),
            name: None,
            nodes: vec![Index::new(0)],
        }],
        textures: vec![json::Texture {
            name: None,
            sampler: Some(Index::new(0)),
            source: Index::new(0),
            extensions: None,
            extras: Default::default(),
        }],
        ..Default::default()
    };
    (root, buffer)
}

fn material() -> json::Material {
    json::Material {
        name: Some("checkerboard".to_owned()),
        pbr_metallic_roughness: json::material::PbrMetallicRoughness {
            base_color_texture: Some(json::texture::Info {
                index: Index::new(0),
                tex_coord: 0,
                extensions: None,
                extras: Default::default(),
            }),
            metallic_factor: json::material::StrengthFactor(0.0),
            roughness_factor: json::material::StrengthFactor(0.8),
            ..Default::default()
        },
        ..Default::default()
    }
}

/// Header and two chunks, each padded to four bytes: JSON with spaces, binary with zeros (glTF 2.0 specification, section 4.4).
pub(crate) fn container(mut json: Vec<u8>, mut binary: Vec<u8>) -> Vec<u8> {
    json.resize(json.len().next_multiple_of(4), b' ');
    binary.resize(binary.len().next_multiple_of(4), 0);
    let total = 12 + 8 + json.len() + 8 + binary.len();
    let mut glb = Vec::with_capacity(total);
    glb.extend(b"glTF");
    glb.extend(2u32.to_le_bytes());
    glb.extend((total as u32).to_le_bytes());
    for (kind, chunk) in [(b"JSON", &json), (b"BIN\0", &binary)] {
        glb.extend((chunk.len() as u32).to_le_bytes());
        glb.extend(kind);
        glb.extend(chunk);
    }
    glb
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::measure::fixtures::{sphere_surface, surface_of};
    use crate::shrink::lattice::LatticeSpec;

    fn glb(spec: LatticeSpec) -> (Surface, Vec<u8>) {
        let surface = sphere_surface(spec, 0.5);
        let bytes = to_glb(&surface, &json!({"vertices": 3}), &json!({"field": "sphere"}));
        (surface, bytes)
    }

    #[test]
    fn what_is_written_is_read_back() {
        for spec in [LatticeSpec::Latlong { n_theta: 24, n_phi: 12 }, LatticeSpec::Octahedral { n: 8 }] {
            let (surface, bytes) = glb(spec);
            let (document, buffers, images) = gltf::import_slice(&bytes).unwrap();
            let primitive = document.meshes().next().unwrap().primitives().next().unwrap();
            let reader = primitive.reader(|b| Some(&buffers[b.index()]));
            let positions: Vec<[f32; 3]> = reader.read_positions().unwrap().collect();
            let expected: Vec<[f32; 3]> =
                surface.lattice.chart.iter().map(|&v| surface.positions[v as usize]).collect();
            assert_eq!(positions, expected);
            let uv: Vec<[f32; 2]> = reader.read_tex_coords(0).unwrap().into_f32().collect();
            assert_eq!(uv.len(), positions.len());
            for normal in reader.read_normals().unwrap() {
                assert!((Vec3::from(normal).length() - 1.0).abs() < 1e-6);
            }
            let indices: Vec<u32> = reader.read_indices().unwrap().into_u32().collect();
            assert_eq!(indices, surface.chart_triangles.concat());
            assert_eq!(images.len(), 1);
            let extras: Value = serde_json::from_str(document.into_json().extras.unwrap().get()).unwrap();
            assert_eq!(extras["report"]["vertices"], 3);
            assert_eq!(extras["provenance"]["field"], "sphere");
        }
    }

    #[test]
    fn large_lattices_use_long_indices_and_the_bytes_do_not_change() {
        let (_, bytes) = glb(LatticeSpec::Octahedral { n: 130 });
        let document = gltf::Gltf::from_slice(&bytes).unwrap();
        let indices = document.meshes().next().unwrap().primitives().next().unwrap().indices().unwrap();
        assert_eq!(indices.data_type(), gltf::accessor::DataType::U32);
        assert_eq!(glb(LatticeSpec::Octahedral { n: 130 }).1, bytes);
    }

    #[test]
    fn a_vanishing_normal_is_written_as_a_unit_vector() {
        let mut surface = surface_of(LatticeSpec::Octahedral { n: 2 }, |d| (d, d));
        surface.normals[3] = [0.0; 3];
        let (document, buffers, _) = gltf::import_slice(to_glb(&surface, &Value::Null, &Value::Null)).unwrap();
        let primitive = document.meshes().next().unwrap().primitives().next().unwrap();
        let normals = primitive.reader(|b| Some(&buffers[b.index()])).read_normals().unwrap();
        assert!(normals.into_iter().all(|n| (Vec3::from(n).length() - 1.0).abs() < 1e-6));
    }
}
