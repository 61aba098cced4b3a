//! glTF 2.0 in its binary container: the triangles of all meshes in the scene, with their nodes' transforms.
//!
//! Only what makes geometry is read. Extensions that a file requires are refused by name unless they change only looks,
//! and so are sparse accessors and buffers outside the file.

use super::{FieldError, Soup, limit, malformed};
use glam::{DMat4, DQuat, DVec3};
use serde::Deserialize;

const FORMAT: &str = "glb";
const JSON_CHUNK: u32 = 0x4E4F_534A;
const BIN_CHUNK: u32 = 0x004E_4942;
/// Most nodes walked; a node may be reached only once, so this is a limit on the list.
const MAX_NODES: usize = 100_000;

#[derive(Deserialize, Default)]
#[serde(rename_all = "camelCase", default)]
struct Document {
    scene: Option<usize>,
    scenes: Vec<Scene>,
    nodes: Vec<Node>,
    meshes: Vec<Mesh>,
    accessors: Vec<Accessor>,
    buffer_views: Vec<View>,
    buffers: Vec<Buffer>,
    extensions_required: Vec<String>,
    extras: serde_json::Value,
}

#[derive(Deserialize, Default)]
#[serde(default)]
struct Scene {
    nodes: Vec<usize>,
}

#[derive(Deserialize, Default)]
#[serde(default)]
struct Node {
    mesh: Option<usize>,
    children: Vec<usize>,
    matrix: Option<[f64; 16]>,
    translation: Option<[f64; 3]>,
    rotation: Option<[f64; 4]>,
    scale: Option<[f64; 3]>,
}

impl Node {
    fn transform(&self) -> DMat4 {
        if let Some(matrix) = &self.matrix {
            return DMat4::from_cols_array(matrix);
        }
        let rotation = DQuat::from_array(self.rotation.unwrap_or([0.0, 0.0, 0.0, 1.0]));
        DMat4::from_scale_rotation_translation(
            DVec3::from(self.scale.unwrap_or([1.0; 3])),
            // a rotation that is not of unit length would scale as well
            if rotation.length_squared() > 0.0 { rotation.normalize() } else { DQuat::IDENTITY },
            DVec3::from(self.translation.unwrap_or_default()),
        )
    }
}

#[derive(Deserialize, Default)]
#[serde(default)]
struct Mesh {
    primitives: Vec<Primitive>,
}

#[derive(Deserialize, Default)]
#[serde(default)]
struct Primitive {
    attributes: Attributes,
    indices: Option<usize>,
    mode: Option<u32>,
}

#[derive(Deserialize, Default)]
#[serde(default)]
struct Attributes {
    #[serde(rename = "POSITION")]
    position: Option<usize>,
    #[serde(rename = "TEXCOORD_0")]
    place: Option<usize>,
    #[serde(rename = "TEXCOORD_1")]
    second_place: Option<usize>,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct Accessor {
    buffer_view: Option<usize>,
    #[serde(default)]
    byte_offset: usize,
    component_type: u32,
    count: usize,
    #[serde(rename = "type")]
    kind: String,
    sparse: Option<serde_json::Value>,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct View {
    buffer: usize,
    #[serde(default)]
    byte_offset: usize,
    byte_length: usize,
    byte_stride: Option<usize>,
}

#[derive(Deserialize)]
struct Buffer {
    uri: Option<String>,
}

pub(super) fn read(bytes: &[u8]) -> Result<Soup, FieldError> {
    collect(bytes, Soup::new(FORMAT)).map(|(soup, _)| soup)
}

/// The same with the places in the first two charts of every vertex, and the document's `extras`. The places of a chart are gone
/// from the soup when a primitive has none there.
pub(super) fn read_charted(bytes: &[u8]) -> Result<(Soup, serde_json::Value), FieldError> {
    collect(bytes, Soup { places: [Some(Vec::new()), Some(Vec::new())], ..Soup::new(FORMAT) })
}

fn collect(bytes: &[u8], mut soup: Soup) -> Result<(Soup, serde_json::Value), FieldError> {
    let (json, json_at, binary) = chunks(bytes)?;
    let document: Document = serde_json::from_slice(json).map_err(|e| {
        malformed(FORMAT, Some(json_at), format!("the JSON chunk, line {} column {}: {e}", e.line(), e.column()))
    })?;
    for name in &document.extensions_required {
        let looks = ["KHR_materials_", "KHR_texture_", "KHR_lights_", "EXT_texture_"];
        if !looks.iter().any(|prefix| name.starts_with(prefix)) {
            return Err(unsupported(format!("the glTF extension {name}")));
        }
    }
    if document.nodes.len() > MAX_NODES {
        return Err(limit("nodes of a GLB", document.nodes.len(), MAX_NODES));
    }
    let mut reached = vec![false; document.nodes.len()];
    let mut stack: Vec<(usize, DMat4)> = Vec::new();
    match document.scenes.get(document.scene.unwrap_or(0)) {
        Some(scene) => stack.extend(scene.nodes.iter().rev().map(|&n| (n, DMat4::IDENTITY))),
        // without a scene every mesh is taken as it stands
        None => {
            for mesh in &document.meshes {
                add_mesh(&document, mesh, DMat4::IDENTITY, binary, &mut soup)?;
            }
        }
    }
    while let Some((index, above)) = stack.pop() {
        let node = document.nodes.get(index).ok_or_else(|| fault(format!("no node has the index {index}")))?;
        if std::mem::replace(&mut reached[index], true) {
            return Err(fault(format!("node {index} is reached twice")));
        }
        let transform = above * node.transform();
        stack.extend(node.children.iter().rev().map(|&n| (n, transform)));
        if let Some(mesh) = node.mesh {
            let mesh = document.meshes.get(mesh).ok_or_else(|| fault(format!("no mesh has the index {mesh}")))?;
            add_mesh(&document, mesh, transform, binary, &mut soup)?;
        }
    }
    Ok((soup, document.extras))
}

fn fault(detail: String) -> FieldError {
    malformed(FORMAT, None, detail)
}

fn unsupported(detail: String) -> FieldError {
    FieldError::Unsupported { detail }
}

/// The JSON chunk, where it begins, and the binary chunk (empty when there is none).
fn chunks(bytes: &[u8]) -> Result<(&[u8], usize, &[u8]), FieldError> {
    let word = |at: usize| {
        let chunk = bytes.get(at..).and_then(|b| b.first_chunk::<4>());
        chunk.map(|c| u32::from_le_bytes(*c)).ok_or_else(|| malformed(FORMAT, Some(bytes.len()), "the file ends early"))
    };
    let (version, length) = (word(4)?, word(8)? as usize);
    if version != 2 {
        return Err(unsupported(format!("glTF container version {version}")));
    }
    if length > bytes.len() {
        let detail = format!("the header says {length} bytes and there are {}", bytes.len());
        return Err(malformed(FORMAT, Some(8), detail));
    }
    let (mut at, mut json, mut binary) = (12, None, &bytes[..0]);
    while at + 8 <= length {
        let (size, kind, start) = (word(at)? as usize, word(at + 4)?, at + 8);
        let end = start.checked_add(size).filter(|&end| end <= length);
        let end = end.ok_or_else(|| malformed(FORMAT, Some(at), format!("a chunk of {size} bytes passes the end")))?;
        match (kind, json) {
            (JSON_CHUNK, None) => json = Some((&bytes[start..end], start)),
            (BIN_CHUNK, Some(_)) if binary.is_empty() => binary = &bytes[start..end],
            _ => {}
        }
        at = end;
    }
    let (json, json_at) = json.ok_or_else(|| malformed(FORMAT, Some(12), "there is no JSON chunk"))?;
    Ok((json, json_at, binary))
}

fn add_mesh(
    document: &Document,
    mesh: &Mesh,
    transform: DMat4,
    binary: &[u8],
    soup: &mut Soup,
) -> Result<(), FieldError> {
    // a reflection turns triangles inside out
    let reflected = transform.determinant() < 0.0;
    for primitive in &mesh.primitives {
        let mode = primitive.mode.unwrap_or(4);
        if mode < 4 {
            continue; // points and lines bound nothing
        }
        let Some(position) = primitive.attributes.position else { continue };
        let first = soup.vertices.len();
        let positions = Elements::of(document, position, binary, "VEC3")?;
        if positions.component != 5126 {
            return Err(unsupported(format!("positions of component type {}", positions.component)));
        }
        for i in 0..positions.count {
            let (at, bytes) = positions.element(i);
            let value = |k: usize| {
                let start = 4 * k;
                f64::from(f32::from_le_bytes([bytes[start], bytes[start + 1], bytes[start + 2], bytes[start + 3]]))
            };
            let placed = transform.transform_point3(DVec3::new(value(0), value(1), value(2)));
            soup.vertex(placed.to_array(), at)?;
        }
        let count = positions.count;
        let charts = [primitive.attributes.place, primitive.attributes.second_place];
        for (known, chart) in soup.places.iter_mut().zip(charts) {
            let (Some(places), Some(chart)) = (known.as_mut(), chart) else {
                *known = None;
                continue;
            };
            let elements = Elements::of(document, chart, binary, "VEC2")?;
            if elements.count != count {
                return Err(fault(format!("{count} positions have {} texture coordinates", elements.count)));
            }
            for i in 0..count {
                places.push(elements.pair(i)?);
            }
        }
        let indices = primitive.indices.map(|index| Elements::of(document, index, binary, "SCALAR")).transpose()?;
        let corners = indices.as_ref().map_or(count, |e| e.count);
        let corner = |i: usize| -> Result<u32, FieldError> {
            let index = match &indices {
                None => i,
                Some(elements) => elements.index(i)?,
            };
            if index < count {
                Ok((first + index) as u32)
            } else {
                Err(fault(format!("no vertex has the index {index}")))
            }
        };
        let mut add = |a: usize, b: usize, c: usize| -> Result<(), FieldError> {
            let (b, c) = if reflected { (c, b) } else { (b, c) };
            let triangle = [corner(a)?, corner(b)?, corner(c)?];
            soup.polygon(&triangle)
        };
        match mode {
            4 => (0..corners / 3).try_for_each(|t| add(3 * t, 3 * t + 1, 3 * t + 2))?,
            // every other triangle of a strip is wound the other way
            5 => (2..corners).try_for_each(|t| if t % 2 == 0 { add(t - 2, t - 1, t) } else { add(t - 1, t - 2, t) })?,
            6 => (2..corners).try_for_each(|t| add(0, t - 1, t))?,
            _ => return Err(fault(format!("unknown primitive mode {mode}"))),
        }
    }
    Ok(())
}

/// The elements of an accessor, checked to lie inside the binary chunk.
struct Elements<'a> {
    binary: &'a [u8],
    start: usize,
    stride: usize,
    size: usize,
    count: usize,
    component: u32,
}

impl<'a> Elements<'a> {
    fn of(document: &Document, index: usize, binary: &'a [u8], kind: &str) -> Result<Self, FieldError> {
        let accessor =
            document.accessors.get(index).ok_or_else(|| fault(format!("no accessor has the index {index}")))?;
        if accessor.sparse.is_some() {
            return Err(unsupported(format!("the sparse accessor {index}")));
        }
        if accessor.kind != kind {
            return Err(fault(format!("accessor {index} is {} instead of {kind}", accessor.kind)));
        }
        let component_size = match accessor.component_type {
            5120 | 5121 => 1,
            5122 | 5123 => 2,
            5125 | 5126 => 4,
            other => return Err(fault(format!("accessor {index} has the unknown component type {other}"))),
        };
        let parts = match kind {
            "VEC3" => 3,
            "VEC2" => 2,
            _ => 1,
        };
        let size = component_size * parts;
        let view = accessor.buffer_view.ok_or_else(|| fault(format!("accessor {index} has no buffer view")))?;
        let view =
            document.buffer_views.get(view).ok_or_else(|| fault(format!("no buffer view has the index {view}")))?;
        if view.buffer != 0 || document.buffers.first().is_some_and(|b| b.uri.is_some()) {
            return Err(unsupported(format!("accessor {index} in a buffer outside the binary chunk")));
        }
        let stride = view.byte_stride.unwrap_or(size).max(size);
        let bytes_needed = match accessor.count {
            0 => Some(0),
            n => stride.checked_mul(n - 1).and_then(|b| b.checked_add(size)),
        };
        let inside = bytes_needed
            .and_then(|n| n.checked_add(accessor.byte_offset))
            .filter(|&n| n <= view.byte_length)
            .and_then(|_| view.byte_offset.checked_add(view.byte_length))
            .is_some_and(|end| end <= binary.len());
        if !inside {
            return Err(fault(format!("accessor {index} reaches beyond the binary chunk")));
        }
        let start = view.byte_offset + accessor.byte_offset;
        Ok(Self { binary, start, stride, size, count: accessor.count, component: accessor.component_type })
    }

    /// The bytes of element `i`, and where they begin in the binary chunk.
    fn element(&self, i: usize) -> (usize, &'a [u8]) {
        let at = self.start + i * self.stride;
        (at, &self.binary[at..at + self.size])
    }

    /// Texture coordinates, which may be normalized integers (glTF 2.0, section 3.7.2.1).
    fn pair(&self, i: usize) -> Result<[f32; 2], FieldError> {
        match (self.component, self.element(i).1) {
            (5126, &[a, b, c, d, e, f, g, h]) => {
                Ok([f32::from_le_bytes([a, b, c, d]), f32::from_le_bytes([e, f, g, h])])
            }
            (5123, &[a, b, c, d]) => {
                Ok([[a, b], [c, d]].map(|short| f32::from(u16::from_le_bytes(short)) / f32::from(u16::MAX)))
            }
            (5121, &[a, b]) => Ok([a, b].map(|byte| f32::from(byte) / f32::from(u8::MAX))),
            (other, _) => Err(unsupported(format!("texture coordinates of component type {other}"))),
        }
    }

    fn index(&self, i: usize) -> Result<usize, FieldError> {
        match (self.component, self.element(i).1) {
            (5121, &[a]) => Ok(usize::from(a)),
            (5123, &[a, b]) => Ok(usize::from(u16::from_le_bytes([a, b]))),
            (5125, &[a, b, c, d]) => Ok(u32::from_le_bytes([a, b, c, d]) as usize),
            (other, _) => Err(fault(format!("indices of component type {other}"))),
        }
    }
}
