//! Surfaces of one lattice with the same triangles as one GLB: the first is the mesh, the others are its morph targets, and an
//! animation goes from each to the next. Texture coordinates, triangles and material are there once.
//!
//! Targets are differences in single precision, so a later surface is met to a rounding of its own coordinates, not to the bit.

use super::{accessor, bounds, document, json, little_endian, unit, written};
use crate::surface::Surface;
use json::Index;
use json::accessor::{ComponentType, Type};
use json::animation::{Channel, Interpolation, Property, Sampler, Target};
use json::validation::Checked::Valid;
use serde_json::Value;

/// What a later surface has for itself, over the welded vertices.
#[derive(Clone, Debug)]
pub struct Shape {
    /// Positions, scene units.
    pub positions: Vec<[f32; 3]>,
    /// Unit gradients of the field.
    pub normals: Vec<[f32; 3]>,
}

impl Shape {
    /// The shape of a surface.
    pub fn of(surface: &Surface) -> Self {
        Self { positions: surface.positions.clone(), normals: surface.normals.clone() }
    }
}

/// Bytes that so many later shapes of a surface take at least; a GLB has room for 4 GiB.
pub fn bytes_of(surface: &Surface, shapes: usize) -> u64 {
    let (targets, weights) = (24 * surface.lattice.chart.len() as u64, 4 * (shapes as u64 + 1));
    shapes as u64 * (targets + weights)
}

/// The surface and what it becomes as a GLB, `seconds` from each to the next. `report` and `provenance` become the members of
/// the asset's root `extras`.
///
/// # Panics
/// When a shape has not as many vertices as the surface.
pub fn to_glb(first: &Surface, later: &[Shape], seconds: f32, report: &Value, provenance: &Value) -> Vec<u8> {
    let (mut root, mut buffer) = document(first, report, provenance);
    let chart = &first.lattice.chart;
    let difference = |from: [f32; 3], to: [f32; 3]| -> [f32; 3] { std::array::from_fn(|k| to[k] - from[k]) };
    let mut targets = Vec::with_capacity(later.len());
    for (i, shape) in later.iter().enumerate() {
        assert_eq!(shape.positions.len(), first.positions.len(), "one position for every vertex");
        let moves = chart.iter().map(|&v| v as usize).map(|v| difference(first.positions[v], shape.positions[v]));
        let moves: Vec<[f32; 3]> = moves.collect();
        let turns =
            chart.iter().map(|&v| v as usize).map(|v| difference(unit(first.normals[v]), unit(shape.normals[v])));
        let turns: Vec<[f32; 3]> = turns.collect();
        let mut add = |list: &[[f32; 3]], range: Option<[Value; 2]>, name: &str| {
            let name = format!("{name} of frame {}", i + 1);
            let view = buffer.push(&little_endian(list), Some(json::buffer::Target::ArrayBuffer), &name);
            let entry = accessor(view, list.len(), ComponentType::F32, Type::Vec3, range, &name);
            Index::push(&mut root.accessors, entry)
        };
        let positions = Some(add(&moves, Some(bounds(&moves)), "positions"));
        let normals = Some(add(&turns, None, "normals"));
        targets.push(json::mesh::MorphTarget { positions, normals, tangents: None });
    }
    let frames = later.len() + 1;
    let times: Vec<[f32; 1]> = (0..frames).map(|i| [i as f32 * seconds]).collect();
    // at the time of a frame its own target counts, and no other
    let weights: Vec<[f32; 1]> =
        (0..frames).flat_map(|i| (1..frames).map(move |k| [if k == i { 1.0 } else { 0.0 }])).collect();
    let mut track = |list: &[[f32; 1]], range: Option<[Value; 2]>, name: &str| {
        let view = buffer.push(&little_endian(list), None, name);
        let entry = accessor(view, list.len(), ComponentType::F32, Type::Scalar, range, name);
        Index::push(&mut root.accessors, entry)
    };
    let range = [json!(times[0]), json!(times[frames - 1])];
    let (input, output) = (track(&times, Some(range), "times"), track(&weights, None, "weights"));
    let mesh = &mut root.meshes[0];
    let names: Vec<String> = (1..frames).map(|i| format!("frame {i}")).collect();
    mesh.extras = serde_json::value::to_raw_value(&json!({ "targetNames": names })).ok();
    mesh.weights = Some(vec![0.0; later.len()]);
    mesh.primitives[0].targets = Some(targets);
    root.animations = vec![json::Animation {
        extensions: None,
        extras: Default::default(),
        channels: vec![Channel {
            sampler: Index::new(0),
            target: Target {
                extensions: None,
                extras: Default::default(),
                node: Index::new(0),
                path: Valid(Property::MorphTargetWeights),
            },
            extensions: None,
            extras: Default::default(),
        }],
        name: Some("path".to_owned()),
        samplers: vec![Sampler {
            extensions: None,
            extras: Default::default(),
            input,
            interpolation: Valid(Interpolation::Linear),
            output,
        }],
    }];
    written(root, buffer)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::measure::fixtures::sphere_surface;
    use crate::shrink::lattice::LatticeSpec;
    use gltf::animation::util::ReadOutputs;

    #[test]
    fn every_frame_is_read_back_at_its_time_with_the_texture_coordinates_of_the_first() {
        for spec in [LatticeSpec::Latlong { n_theta: 12, n_phi: 6 }, LatticeSpec::Octahedral { n: 3 }] {
            let surfaces = [0.5, 0.625, 0.25].map(|radius| sphere_surface(spec, radius));
            let later: Vec<Shape> = surfaces[1..].iter().map(Shape::of).collect();
            let bytes = to_glb(&surfaces[0], &later, 0.5, &json!({"frames": 3}), &Value::Null);
            assert_eq!(bytes, to_glb(&surfaces[0], &later, 0.5, &json!({"frames": 3}), &Value::Null));
            let (document, buffers, _) = gltf::import_slice(&bytes).expect("a GLB");
            let data = |b: gltf::Buffer<'_>| Some(buffers[b.index()].0.as_slice());
            let mesh = document.meshes().next().expect("a mesh");
            assert_eq!(mesh.weights(), Some([0.0, 0.0].as_slice()));
            let primitive = mesh.primitives().next().expect("a primitive");
            let reader = primitive.reader(data);
            let base: Vec<[f32; 3]> = reader.read_positions().expect("positions").collect();
            assert_eq!(reader.read_tex_coords(0).expect("texture coordinates").into_f32().count(), base.len());
            let mut shown = vec![base.clone()];
            for (moves, normals, _) in reader.read_morph_targets() {
                let moves: Vec<[f32; 3]> = moves.expect("positions").collect();
                // balls about one centre have the same normals
                assert!(normals.expect("normals").all(|n| n == [0.0; 3]));
                shown.push(base.iter().zip(moves).map(|(p, d)| std::array::from_fn(|k| p[k] + d[k])).collect());
            }
            assert_eq!(shown.len(), 3);
            for (surface, shown) in surfaces.iter().zip(&shown) {
                let expected = surface.lattice.chart.iter().map(|&v| surface.positions[v as usize]);
                for (p, q) in expected.zip(shown) {
                    assert!(p.iter().zip(q).all(|(a, b)| (a - b).abs() < 1e-7), "{p:?} {q:?}");
                }
            }
            let channel = document.animations().next().expect("an animation").channels().next().expect("a channel");
            let reader = channel.reader(data);
            assert_eq!(reader.read_inputs().expect("times").collect::<Vec<_>>(), [0.0, 0.5, 1.0]);
            let Some(ReadOutputs::MorphTargetWeights(weights)) = reader.read_outputs() else { panic!("no weights") };
            assert_eq!(weights.into_f32().collect::<Vec<_>>(), [0.0, 0.0, 1.0, 0.0, 0.0, 1.0]);
        }
    }
}
