//! A surface as safetensors, for numeric use: everything on the grid, row by row.
//!
//! | tensor | shape | type |
//! |---|---|---|
//! | `positions` | [rows, columns, 3] | f32, scene units |
//! | `normals` | [rows, columns, 3] | f32, unit gradients |
//! | `uv` | [rows, columns, 2] | f32, the place on the sphere, v downwards |
//! | `gradient_norm`, `value` | [rows, columns] | f32 |
//! | `first_form` | [rows, columns, 3] | f32: E, F, G (see [`forms`](super::forms)) |
//! | `second_form` | [rows, columns, 3] | f32: L, M, N |
//! | `vertex` | [rows, columns] | u32, the welded vertex of each grid point |
//! | `triangles` | [n, 3] | u32, welded vertices, counter-clockwise outward |
//! | `triangle_distance` | \[n\] | f32, scene units: how far each triangle was measured to be from the truth |
//!
//! A surface whose chart was relaxed has three more, over the vertices of the chart (m of them):
//!
//! | tensor | shape | type |
//! |---|---|---|
//! | `chart_uv` | [m, 2] | f32, relaxed, v downwards |
//! | `chart_vertex` | \[m\] | u32, the welded vertex of each |
//! | `chart_triangles` | [n, 3] | u32, chart vertices, in the order of `triangles` |
//!
//! A surface of a network with a latent code has one more on request:
//!
//! | tensor | shape | type |
//! |---|---|---|
//! | `latent_motion` | [rows, columns, size of the code] | f32, scene units: dv/dz is the normal times this |
//!
//! The metadata has one entry, `shrinkd`: JSON with `format`, `version`, `lattice`, `rows`, `columns`, `vertices` and
//! `coordinates` (what the forms are taken by). The same surface gives the same bytes.

mod read;

pub use read::{Unreadable, from_safetensors};

use super::Surface;
use super::forms::forms;
use crate::shrink::lattice::LatticeSpec;
use safetensors::tensor::{Dtype, TensorView};
use serde_json::{Value, json};
use std::collections::HashMap;

/// Version of the layout above.
const FORMAT: u32 = 1;

/// The surface as a safetensors file. `by_triangle` is how far every triangle was measured to be from the truth, `latent_motion` has a row of every vertex, see
/// [`latent_motion`](super::sensitivity::latent_motion).
pub fn to_safetensors(surface: &Surface, by_triangle: &[f32], latent_motion: Option<&[f32]>) -> Vec<u8> {
    let lattice = &surface.lattice;
    let (rows, columns) = (lattice.rows, lattice.columns);
    let forms = forms(surface);
    let on_grid = |values: &[[f32; 3]]| -> Vec<u8> {
        lattice.grid.iter().flat_map(|&v| values[v as usize]).flat_map(f32::to_le_bytes).collect()
    };
    let scalar =
        |values: &[f32]| -> Vec<u8> { lattice.grid.iter().flat_map(|&v| values[v as usize].to_le_bytes()).collect() };
    let bytes = |values: &[[f32; 3]]| -> Vec<u8> { values.iter().flatten().flat_map(|x| x.to_le_bytes()).collect() };
    // on both lattices the UV of a grid point is its place in the square, the poles' row included
    let uv: Vec<u8> = (0..rows * columns)
        .flat_map(|k| [(k % columns) as f32 / (columns - 1) as f32, (k / columns) as f32 / (rows - 1) as f32])
        .flat_map(f32::to_le_bytes)
        .collect();
    let whole = |values: &mut dyn Iterator<Item = u32>| -> Vec<u8> { values.flat_map(u32::to_le_bytes).collect() };
    let mut tensors: Vec<Tensor> = vec![
        ("positions", Dtype::F32, vec![rows, columns, 3], on_grid(&surface.positions)),
        ("normals", Dtype::F32, vec![rows, columns, 3], on_grid(&surface.normals)),
        ("uv", Dtype::F32, vec![rows, columns, 2], uv),
        ("gradient_norm", Dtype::F32, vec![rows, columns], scalar(&surface.gradient_norms)),
        ("value", Dtype::F32, vec![rows, columns], scalar(&surface.values)),
        ("first_form", Dtype::F32, vec![rows, columns, 3], bytes(&forms.first)),
        ("second_form", Dtype::F32, vec![rows, columns, 3], bytes(&forms.second)),
        ("vertex", Dtype::U32, vec![rows, columns], whole(&mut lattice.grid.iter().copied())),
        (
            "triangles",
            Dtype::U32,
            vec![surface.triangles.len(), 3],
            whole(&mut surface.triangles.iter().flatten().copied()),
        ),
    ];
    if by_triangle.len() == surface.triangles.len() {
        let distances = by_triangle.iter().flat_map(|d| d.to_le_bytes()).collect();
        tensors.push(("triangle_distance", Dtype::F32, vec![by_triangle.len()], distances));
    }
    if let Some(uv) = &surface.relaxed_uv {
        let places = uv.iter().flatten().flat_map(|&c| (c as f32).to_le_bytes()).collect();
        let triangles = &surface.chart_triangles;
        tensors.push(("chart_uv", Dtype::F32, vec![uv.len(), 2], places));
        tensors.push(("chart_vertex", Dtype::U32, vec![uv.len()], whole(&mut lattice.chart.iter().copied())));
        let corners = whole(&mut triangles.iter().flatten().copied());
        tensors.push(("chart_triangles", Dtype::U32, vec![triangles.len(), 3], corners));
    }
    if let Some(motion) = latent_motion {
        let size = motion.len() / surface.positions.len().max(1);
        let row = |&v: &u32| &motion[v as usize * size..][..size];
        let data = lattice.grid.iter().flat_map(row).flat_map(|z| z.to_le_bytes()).collect();
        tensors.push(("latent_motion", Dtype::F32, vec![rows, columns, size], data));
    }
    let about = json!({
        "format": FORMAT,
        "version": env!("CARGO_PKG_VERSION"),
        "lattice": lattice.spec,
        "rows": rows,
        "columns": columns,
        "vertices": surface.positions.len(),
        "coordinates": match lattice.spec {
            LatticeSpec::Latlong { .. } => ["theta", "phi"],
            LatticeSpec::Octahedral { .. } => ["u", "v"],
        },
    });
    file(&tensors, &about)
}

/// A tensor before it is written: name, type, shape, and its bytes, little-endian.
pub(super) type Tensor = (&'static str, Dtype, Vec<usize>, Vec<u8>);

/// Tensors and the metadata's one entry as a safetensors file.
///
/// # Panics
/// When a tensor has not as many bytes as its shape says.
pub(super) fn file(tensors: &[Tensor], about: &Value) -> Vec<u8> {
    // one entry: the order of several would change from run to run
    let metadata = HashMap::from([("shrinkd".to_owned(), about.to_string())]);
    let views = tensors.iter().map(|(name, dtype, shape, data)| {
        (*name, TensorView::new(*dtype, shape.clone(), data).expect("as many bytes as the shape says"))
    });
    safetensors::serialize(views, Some(metadata)).expect("a header far under the format's limit")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::measure::fixtures::sphere_surface;
    use safetensors::SafeTensors;

    #[test]
    fn every_tensor_is_there_in_its_shape_and_the_bytes_do_not_change() {
        let surface = sphere_surface(LatticeSpec::Latlong { n_theta: 12, n_phi: 6 }, 0.5);
        let bytes = to_safetensors(&surface, &[], None);
        assert_eq!(bytes, to_safetensors(&surface, &[], None));
        let file = SafeTensors::deserialize(&bytes).unwrap();
        for (name, shape) in [
            ("positions", vec![7, 13, 3]),
            ("normals", vec![7, 13, 3]),
            ("uv", vec![7, 13, 2]),
            ("gradient_norm", vec![7, 13]),
            ("value", vec![7, 13]),
            ("first_form", vec![7, 13, 3]),
            ("second_form", vec![7, 13, 3]),
            ("vertex", vec![7, 13]),
            ("triangles", vec![surface.triangles.len(), 3]),
        ] {
            assert_eq!(file.tensor(name).unwrap().shape(), shape, "{name}");
        }
        let (_, header) = SafeTensors::read_metadata(&bytes).unwrap();
        let about = header.metadata().as_ref().unwrap()["shrinkd"].clone();
        let about: serde_json::Value = serde_json::from_str(&about).unwrap();
        assert_eq!(about["coordinates"], json!(["theta", "phi"]));
        // the last grid row is the south pole in every column
        let data = file.tensor("positions").unwrap().data().to_vec();
        let z = f32::from_le_bytes(data[data.len() - 4..].try_into().unwrap());
        assert_eq!(z, -0.5);
    }

    #[test]
    fn a_surface_is_read_back_with_its_diagonals() {
        for spec in [LatticeSpec::Latlong { n_theta: 12, n_phi: 6 }, LatticeSpec::Octahedral { n: 3 }] {
            let mut surface = sphere_surface(spec, 0.5);
            let mut diagonals = vec![false; surface.lattice.quads.len()];
            for i in (0..diagonals.len()).step_by(3) {
                diagonals[i] = surface.lattice.free[i];
            }
            surface.triangles = surface.lattice.triangles(&diagonals);
            let read = from_safetensors(&to_safetensors(&surface, &[], None), spec).expect("reads");
            assert_eq!(read, surface.earlier());
            assert!(diagonals.contains(&true) && read.diagonals == diagonals);
        }
    }

    #[test]
    fn what_is_no_surface_on_the_lattice_is_refused_by_what_is_wrong() {
        let spec = LatticeSpec::Latlong { n_theta: 12, n_phi: 6 };
        let mut surface = sphere_surface(spec, 0.5);
        let good = to_safetensors(&surface, &[], None);
        let refusal = |bytes: &[u8], spec| from_safetensors(bytes, spec).expect_err("is refused").to_string();
        for cut in [0, 7, 8, 100, good.len() - 1] {
            assert!(refusal(&good[..cut], spec).contains("no safetensors"), "{cut}");
        }
        let huge = [u64::MAX.to_le_bytes().as_slice(), b"{}"].concat();
        assert!(refusal(&huge, spec).contains("no safetensors"));
        assert!(refusal(&good, LatticeSpec::Octahedral { n: 3 }).contains("on the lattice {\"latlong\""));
        let weights = file(&[("positions", Dtype::F32, vec![1], vec![0; 4])], &json!({"format": FORMAT}));
        assert!(refusal(&weights, spec).contains("metadata"));
        surface.triangles.swap(0, 1);
        assert!(refusal(&to_safetensors(&surface, &[], None), spec).contains("triangles"));
        surface.triangles.swap(0, 1);
        for wrong in [f32::NAN, f32::INFINITY, 1e7] {
            surface.positions[5][1] = wrong;
            assert!(refusal(&to_safetensors(&surface, &[], None), spec).contains("of positions is"), "{wrong}");
        }
    }
}
