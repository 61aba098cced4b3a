//! The same tetrahedron in every format, and every format broken in its own way.

use super::*;
use proptest::prelude::*;

const CORNERS: [[f32; 3]; 4] = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
const SIDES: [[u32; 3]; 4] = [[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]];

fn tetrahedron() -> TriangleMesh {
    TriangleMesh { vertices: CORNERS.map(|c| c.map(f64::from)).to_vec(), triangles: SIDES.to_vec() }
}

/// The same surface: the same triangles of places, whatever the numbering.
fn same_surface(a: &TriangleMesh, b: &TriangleMesh) -> bool {
    let places = |m: &TriangleMesh| {
        let mut list: Vec<Vec<[u64; 3]>> = m
            .triangles
            .iter()
            .map(|t| {
                let mut corners = t.map(|i| m.vertices[i as usize].map(f64::to_bits)).to_vec();
                let least = (0..3).min_by_key(|&k| corners[k]).unwrap();
                corners.rotate_left(least);
                corners
            })
            .collect();
        list.sort();
        list
    };
    a.vertices.len() == b.vertices.len() && places(a) == places(b)
}

fn check(bytes: &[u8], format: MeshFormat) {
    assert_eq!(MeshFormat::detect(bytes), Some(format));
    let mesh = TriangleMesh::read(bytes).unwrap();
    assert!(same_surface(&mesh, &tetrahedron()), "{mesh:?}");
}

/// PLY with a colour and a normal to walk over, a quality per face behind the list, and an element of edges between.
fn ply(encoding: &str) -> Vec<u8> {
    let mut bytes = format!(
        "ply\nformat {encoding} 1.0\ncomment by hand\nelement vertex 4\nproperty uchar red\nproperty float x\n\
         property float y\nproperty double z\nelement edge 1\nproperty list uchar short ends\nelement face 4\n\
         property list uchar int vertex_indices\nproperty float quality\nend_header\n"
    )
    .into_bytes();
    let big = encoding == "binary_big_endian";
    let mut put = |little: &[u8], text: String| {
        if encoding == "ascii" {
            bytes.extend_from_slice(text.as_bytes());
            bytes.push(b' ');
        } else if big {
            bytes.extend(little.iter().rev());
        } else {
            bytes.extend_from_slice(little);
        }
    };
    for [x, y, z] in CORNERS {
        put(&[7], "7".into());
        put(&x.to_le_bytes(), x.to_string());
        put(&y.to_le_bytes(), y.to_string());
        put(&f64::from(z).to_le_bytes(), z.to_string());
    }
    put(&[2], "2".into());
    put(&0i16.to_le_bytes(), "0".into());
    put(&1i16.to_le_bytes(), "1".into());
    for side in SIDES {
        put(&[3], "3".into());
        for corner in side {
            put(&corner.to_le_bytes(), corner.to_string());
        }
        put(&0.5f32.to_le_bytes(), "0.5".into());
    }
    bytes
}

fn stl_binary() -> Vec<u8> {
    // "solid" at the beginning must not make it text
    let mut bytes = b"solid but binary".to_vec();
    bytes.resize(80, 0);
    bytes.extend(4u32.to_le_bytes());
    for side in SIDES {
        bytes.extend([0; 12]);
        for corner in side {
            bytes.extend(CORNERS[corner as usize].iter().flat_map(|c| c.to_le_bytes()));
        }
        bytes.extend([0; 2]);
    }
    bytes
}

fn stl_text() -> Vec<u8> {
    let mut text = "solid vertex facet\n".to_owned();
    for side in SIDES {
        text += "facet normal 0 0 0\n outer loop\n";
        for corner in side {
            let [x, y, z] = CORNERS[corner as usize];
            text += &format!("  vertex {x:e} {y} {z}\n");
        }
        text += " endloop\nendfacet\n";
    }
    (text + "endsolid vertex facet\n").into_bytes()
}

const OBJ: &[u8] = b"# by hand\r\nmtllib a.mtl\no part\nv 0 0 0\nv 1 0 0 1.0\nv 0 1 0\nvt 0 0\nvn 0 0 1\nf 1/1 3/1 2/1 # down\nv 0 0 1\n\
f 1//1 2//1 4//1\nf -3/1/1 -2/1/1 -1/1/1\nf 3 1 4\n";
const OFF: &[u8] = b"OFF # by hand\n4 4 6\n0 0 0\n1 0 0\n\n0 1 0\n0 0 1\n3 0 2 1 255 0 0\n3 0 1 3\n3 1 2 3\n3 2 0 3\n";

/// A GLB whose node reflects the first axis, over positions reflected beforehand.
fn glb(change: impl Fn(&mut serde_json::Value)) -> Vec<u8> {
    let mut binary = Vec::new();
    for [x, y, z] in CORNERS {
        binary.extend([-x, y, z].iter().flat_map(|c| c.to_le_bytes()));
    }
    for [a, b, c] in SIDES {
        binary.extend([a, c, b].iter().flat_map(|&i| (i as u16).to_le_bytes()));
    }
    let mut json = serde_json::json!({
        "asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}],
        "nodes": [{"children": [1], "translation": [1.0, 0.0, 0.0]}, {"mesh": 0, "scale": [-1.0, 1.0, 1.0], "translation": [-1.0, 0.0, 0.0]}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3"},
                      {"bufferView": 1, "componentType": 5123, "count": 12, "type": "SCALAR"}],
        "bufferViews": [{"buffer": 0, "byteLength": 48}, {"buffer": 0, "byteOffset": 48, "byteLength": 24}],
        "buffers": [{"byteLength": 72}]
    });
    change(&mut json);
    let mut text = json.to_string().into_bytes();
    text.resize(text.len().next_multiple_of(4), b' ');
    let mut bytes = b"glTF".to_vec();
    bytes.extend(2u32.to_le_bytes());
    bytes.extend((12 + 8 + text.len() as u32 + 8 + binary.len() as u32).to_le_bytes());
    for (kind, chunk) in [(b"JSON", text), (b"BIN\0", binary)] {
        bytes.extend((chunk.len() as u32).to_le_bytes());
        bytes.extend(kind);
        bytes.extend(chunk);
    }
    bytes
}

#[test]
fn every_format_gives_the_same_tetrahedron() {
    for encoding in ["ascii", "binary_little_endian", "binary_big_endian"] {
        check(&ply(encoding), MeshFormat::Ply);
    }
    check(OBJ, MeshFormat::Obj);
    check(&stl_binary(), MeshFormat::Stl);
    check(&stl_text(), MeshFormat::Stl);
    check(OFF, MeshFormat::Off);
    // the counts right behind the keyword, as some data sets have it
    check(&[b"OFF", &OFF[14..]].concat(), MeshFormat::Off);
    check(&glb(|_| {}), MeshFormat::Glb);
}

#[test]
fn polygons_become_fans() {
    let square = b"OFF\n4 1 0\n0 0 0\n1 0 0\n1 1 0\n0 1 0\n4 0 1 2 3\n";
    assert_eq!(TriangleMesh::read(square).unwrap().triangles, [[0, 1, 2], [0, 2, 3]]);
}

#[test]
fn vertices_at_one_place_are_merged_and_unused_ones_dropped() {
    let text = b"v 9 9 9\nv 0 0 0\nv 1 0 0\nv 0 1 0\nv -0 0 0\nv 0 1 0\nv 0 0 1\nf 2 3 4\nf 5 6 7\nf 2 5 3\n";
    let mesh = TriangleMesh::read(text).unwrap();
    assert_eq!((mesh.vertices.len(), mesh.triangles.len()), (4, 2));
}

#[test]
fn broken_files_are_refused_with_the_byte() {
    let cases: [(&[u8], u64); 7] = [
        (b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\nend_header\n0 zero 0\n", 102),
        (b"ply\nformat binary 1.0\n", 4),
        (b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n", 30),
        (b"v 0 0 0\nv 1 0\n", 13),
        (b"v 0 0 inf\nf 1 1 1\n", 0),
        (b"OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 3\n", 34),
        (b"solid x\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nendloop\n", 51),
    ];
    for (bytes, expected) in cases {
        match TriangleMesh::read(bytes) {
            Err(FieldError::Malformed { at: Some(at), .. }) => {
                assert_eq!(at, expected, "{}", String::from_utf8_lossy(bytes));
            }
            other => panic!("{} gave {other:?}", String::from_utf8_lossy(bytes)),
        }
    }
}

#[test]
fn a_count_that_the_file_cannot_hold_allocates_nothing() {
    let header = "ply\nformat binary_little_endian 1.0\nelement vertex 11000000\nproperty float x\nproperty float y\n\
                  property float z\nend_header\n";
    assert!(matches!(TriangleMesh::read(header.as_bytes()), Err(FieldError::Malformed { .. })));
    assert!(matches!(TriangleMesh::read(b"OFF\n99999999 1 0\n"), Err(FieldError::Limit { .. })));
}

#[test]
fn glb_features_that_are_not_read_are_refused_by_name() {
    let draco = glb(|json| json["extensionsRequired"] = serde_json::json!(["KHR_draco_mesh_compression"]));
    let sparse = glb(|json| json["accessors"][0]["sparse"] = serde_json::json!({"count": 1}));
    let outside = glb(|json| json["buffers"][0]["uri"] = "data.bin".into());
    for (bytes, name) in [(draco, "KHR_draco_mesh_compression"), (sparse, "sparse"), (outside, "outside")] {
        match TriangleMesh::read(&bytes) {
            Err(FieldError::Unsupported { detail }) => assert!(detail.contains(name), "{detail}"),
            other => panic!("{name} gave {other:?}"),
        }
    }
    let cycle = glb(|json| json["nodes"][1]["children"] = serde_json::json!([0]));
    let beyond = glb(|json| json["accessors"][1]["count"] = 13.into());
    let huge = glb(|json| json["accessors"][0]["count"] = u64::MAX.into());
    for bytes in [cycle, beyond, huge] {
        assert!(matches!(TriangleMesh::read(&bytes), Err(FieldError::Malformed { .. })));
    }
}

#[test]
fn a_glb_with_texture_coordinates_is_read_as_it_stands() {
    use crate::measure::fixtures::sphere_surface;
    use crate::shrink::lattice::LatticeSpec;
    let surface = sphere_surface(LatticeSpec::Octahedral { n: 4 }, 0.5);
    let bytes = crate::surface::gltf::to_glb(&surface, &serde_json::json!({"n": 4}), &serde_json::Value::Null);
    let charted = ChartedMesh::read(&bytes).unwrap().unwrap();
    assert_eq!(charted.triangles, surface.chart_triangles);
    let uv: Vec<[f32; 2]> = surface.lattice.uv.iter().map(|uv| uv.map(|c| c as f32)).collect();
    assert_eq!(charted.uv, uv);
    assert_eq!(charted.extras["report"]["n"], 4);
    assert_eq!(ChartedMesh::read(&glb(|_| {})), Ok(None), "no texture coordinates");
    assert_eq!(ChartedMesh::read(OFF), Ok(None));
    let short = glb(|json| {
        json["meshes"][0]["primitives"][0]["attributes"]["TEXCOORD_0"] = 0.into();
    });
    assert!(matches!(ChartedMesh::read(&short), Err(FieldError::Malformed { .. })), "positions are no pairs");
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(200))]

    /// No cut and no change of bytes makes a reader panic.
    #[test]
    fn broken_bytes_never_panic(cut in 0usize..2000, changes in prop::collection::vec((0usize..2000, any::<u8>()), 0..4)) {
        let files = [ply("ascii"), ply("binary_little_endian"), ply("binary_big_endian"), OBJ.to_vec(), stl_binary(), stl_text(),
                     OFF.to_vec(), glb(|_| {})];
        for mut bytes in files {
            for &(at, value) in &changes {
                let at = at % bytes.len();
                bytes[at] = value;
            }
            bytes.truncate(cut % (2 * bytes.len()));
            if let Ok(mesh) = TriangleMesh::read(&bytes) {
                let _ = MeshField::new(mesh);
            }
        }
    }
}
