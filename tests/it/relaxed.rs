//! Relaxed UVs: less distorted, nothing turned over, and the sphere's coordinates kept beside them.

use crate::app::BINARY;
use crate::cli::scenes;
use crate::losses::{count, number};
use serde_json::Value;
use shrinkd::field::mesh::ChartedMesh;
use std::path::{Path, PathBuf};
use std::process::Command;

/// Runs the program and returns what it printed.
fn shrinkd(arguments: &[&str]) -> String {
    let output = Command::new(BINARY).args(arguments).output().expect("runs");
    assert!(output.status.success(), "{arguments:?}: {}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).expect("text")
}

/// A scene wrapped, with the chart relaxed or not: the GLB, its report and the tensors.
struct Wrapped {
    glb: PathBuf,
    report: Value,
    tensors: Vec<u8>,
}

fn wrap(folder: &Path, scene: &Path, lattice: &str, further: &[&str]) -> Wrapped {
    let path = |name: &str| folder.join(format!("{name}{}", further.len()));
    let (glb, report, tensors) = (path("out.glb"), path("report.json"), path("out.safetensors"));
    let text = |path: &Path| path.to_string_lossy().into_owned();
    let [scene, out, report_path, tensors_path] = [scene, &glb, &report, &tensors].map(text);
    let files = ["extract", &scene, "-o", &out, "--report", &report_path, "--surface", &tensors_path];
    shrinkd(&[&files, &["--lattice", lattice][..], further].concat());
    Wrapped {
        glb,
        report: serde_json::from_slice(&std::fs::read(&report).expect("reads")).expect("JSON"),
        tensors: std::fs::read(&tensors).expect("reads"),
    }
}

#[test]
fn a_relaxed_chart_is_less_distorted_has_no_flip_and_keeps_the_sphere() {
    // the symmetric Dirichlet energy is one of the two terms that are lowered, areas are the other; the poles of a lat-long chart
    // keep a whole side each, and what is gained there are the areas
    for (scene, lattice, energy_left, areas_left) in
        [("starfish", "latlong:96x48", 1.0, 0.9), ("pawn", "octahedral:32", 0.8, f64::INFINITY)]
    {
        let folder = tempfile::tempdir().expect("folder");
        let scene = scenes().join(format!("{scene}.json"));
        let plain = wrap(folder.path(), &scene, lattice, &[]);
        let relaxed = wrap(folder.path(), &scene, lattice, &["--relax-uv"]);
        let (before, after) = (&plain.report, &relaxed.report);
        assert_eq!(count(after, "/flips/uv"), 0);
        assert_eq!(before["distortion"]["uv"], after["distortion"]["uv_before"]);
        assert_eq!(before["distortion"]["uv_before"], Value::Null, "only where it was asked for");
        assert_eq!(before["distortion"]["sphere"], after["distortion"]["sphere"]);
        assert_eq!((&before["evaluations"], &before["distance"]), (&after["evaluations"], &after["distance"]));
        let dirichlet = |report: &Value| number(report, "/distortion/uv/symmetric_dirichlet") - 4.0;
        assert!(dirichlet(after) < energy_left * dirichlet(before), "{} to {}", dirichlet(before), dirichlet(after));
        let areas = |report: &Value| number(report, "/distortion/uv/log_area_rms");
        assert!(areas(after) < areas_left * areas(before), "{} to {}", areas(before), areas(after));

        let read =
            |glb: &Path| ChartedMesh::read(&std::fs::read(glb).expect("reads")).expect("a GLB").expect("a chart");
        let (old, new) = (read(&plain.glb), read(&relaxed.glb));
        assert_eq!((old.second_uv, Some(old.uv)), (None, new.second_uv), "the sphere's coordinates are the second");
        assert_eq!((old.vertices, old.triangles), (new.vertices, new.triangles.clone()), "the surface is the same");

        let glb = relaxed.glb.to_string_lossy();
        let said = shrinkd(&["evaluate", &glb, "--truth", &scene.to_string_lossy(), "--json", "--no-baseline"]);
        let said: Value = serde_json::from_str(&said).expect("JSON");
        let chart = &said["evaluation"]["parameterization"];
        assert_eq!((count(chart, "/uv_flips"), count(chart, "/sphere_flips")), (0, 0));
        for map in ["uv", "sphere"] {
            let path = format!("/{map}/symmetric_dirichlet");
            let (told, reported) = (number(chart, &path), number(&after["distortion"], &path));
            assert!((told / reported - 1.0).abs() < 1e-3, "{map}: {told} and {reported}");
        }

        let file = safetensors::SafeTensors::deserialize(&relaxed.tensors).expect("safetensors");
        assert_eq!(file.tensor("chart_uv").expect("is there").shape(), [new.uv.len(), 2]);
        assert_eq!(file.tensor("chart_triangles").expect("is there").shape(), [new.triangles.len(), 3]);
        assert!(
            safetensors::SafeTensors::deserialize(&plain.tensors).expect("safetensors").tensor("chart_uv").is_err()
        );
    }
}
