//! Results against stored results: every example scene, every network among the fixtures, and some of the shared meshes where
//! that folder is beside the repository.
//!
//! A file in `tests/metrics` holds what a field's result was when the file was written. A result may be better; it may be
//! worse by no more than the tolerances below. After a change that is meant to move the figures:
//!
//! ```text
//! SHRINKD_RENEW_METRICS=1 cargo test --release --test it metrics
//! ```
//!
//! writes the files anew; the difference belongs into the commit that moved them.

use crate::app::BINARY;
use crate::cli::scenes;
use crate::losses::{Losses, count, number};
use serde::{Deserialize, Serialize};
use serde_json::Value;
use shrinkd::field::input::{Description, FieldOptions, describe};
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};

/// Relative; distances are sampled at fixed places, so that only the surface moves them. A tenth covers what another
/// processor's rounding does to places where the method decides (a diagonal turned, a vertex moved); a loss is larger.
const DISTANCE: f64 = 0.10;
/// Absolute, of a figure whose best is 1. Marching cubes of as many vertices stays 0.006 below 1 on Spot: a twenty-fourth
/// of that is what is let pass.
const NORMAL_CONSISTENCY: f64 = 0.000_25;
/// Relative, of figures whose best is known. As for distances.
const DISTORTION: f64 = 0.10;
/// Relative; the count is exact on one machine, and follows the decisions that rounding may turn.
const EVALUATIONS: f64 = 0.05;

/// What is stored of a result.
#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Metrics {
    vertices: u64,
    flips: u64,
    self_intersections: u64,
    distance_mean: f64,
    distance_max: f64,
    normal_consistency: f64,
    sphere_qc: f64,
    sphere_symmetric_dirichlet: f64,
    sphere_log_area_rms: f64,
    evaluations_per_vertex: f64,
}

impl Metrics {
    fn of(report: &Value) -> Self {
        Self {
            vertices: count(report, "/vertices"),
            flips: count(report, "/flips/surface") + count(report, "/flips/sphere") + count(report, "/flips/uv"),
            self_intersections: count(report, "/self_intersections"),
            distance_mean: number(report, "/distance/mean"),
            distance_max: number(report, "/distance/max"),
            normal_consistency: number(report, "/normal_consistency"),
            sphere_qc: number(report, "/distortion/sphere/qc"),
            sphere_symmetric_dirichlet: number(report, "/distortion/sphere/symmetric_dirichlet"),
            sphere_log_area_rms: number(report, "/distortion/sphere/log_area_rms"),
            evaluations_per_vertex: number(report, "/evaluations/per_vertex"),
        }
    }

    /// What got worse.
    fn losses(&self, stored: &Metrics) -> Vec<String> {
        let mut losses = Losses::default();
        losses.at_most("flips", self.flips as f64, stored.flips as f64);
        losses.at_most("self-intersections", self.self_intersections as f64, stored.self_intersections as f64);
        losses.at_most("mean distance", self.distance_mean, stored.distance_mean * (1.0 + DISTANCE));
        losses.at_most("largest distance", self.distance_max, stored.distance_max * (1.0 + DISTANCE));
        losses.at_most("1 - NC", 1.0 - self.normal_consistency, 1.0 - stored.normal_consistency + NORMAL_CONSISTENCY);
        losses.at_most("QC", self.sphere_qc, stored.sphere_qc * (1.0 + DISTORTION));
        let (found, stored_energy) = (self.sphere_symmetric_dirichlet, stored.sphere_symmetric_dirichlet);
        losses.at_most("symmetric Dirichlet", found, stored_energy * (1.0 + DISTORTION));
        losses.at_most("log area RMS", self.sphere_log_area_rms, stored.sphere_log_area_rms * (1.0 + DISTORTION));
        losses.at_most("evaluations", self.evaluations_per_vertex, stored.evaluations_per_vertex * (1.0 + EVALUATIONS));
        if self.vertices != stored.vertices {
            losses.0.push(format!("there are {} vertices instead of {}", self.vertices, stored.vertices));
        }
        losses.0
    }
}

/// Every field there are metrics of: the example scenes of dimension 3, and the networks among the fixtures.
fn fields() -> Vec<PathBuf> {
    let networks = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/networks");
    let mut fields: Vec<PathBuf> = [scenes(), networks]
        .iter()
        .filter_map(|folder| std::fs::read_dir(folder).ok())
        .flat_map(|entries| entries.flatten().map(|entry| entry.path()))
        .filter(|path| path.extension().is_some_and(|e| ["json", "safetensors", "npz"].iter().any(|known| e == *known)))
        .collect();
    fields.sort();
    fields
}

/// Meshes of every kind: organic and mechanical, with limbs, sharp edges and thin walls.
const MESHES: [&str; 6] = [
    "paper/spot.ply",
    "paper/bunny.ply",
    "paper/duck.ply",
    "cad/fandisk.ply",
    "cad/gen_spur_gear.ply",
    "organic/koala.ply",
];

/// The [`MESHES`], where they are.
fn meshes() -> Vec<PathBuf> {
    let data = std::env::var_os("SHRINKD_DATA").map(PathBuf::from);
    let data = data.unwrap_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data"));
    let folder = data.join("meshes");
    if !folder.is_dir() {
        println!("{} is not there: its meshes are not looked at", folder.display());
        return Vec::new();
    }
    MESHES.iter().map(|name| folder.join(name)).collect()
}

fn is_mesh(field: &Path) -> bool {
    field.extension().is_some_and(|e| e == "ply")
}

/// The result of a field, or what the program says about it.
fn extract(field: &Path) -> Result<Metrics, String> {
    let folder = tempfile::tempdir().expect("folder");
    let report = folder.path().join("report.json");
    let mut command = Command::new(BINARY);
    command.arg("extract").arg(field).arg("-o").arg(folder.path().join("out.glb")).arg("--report").arg(&report);
    // a network of many shapes needs one to be named
    if takes_a_latent_code(field) {
        command.args(["--latent-row", "0"]);
    }
    // the other lattice has its turn with the meshes
    if is_mesh(field) {
        command.args(["--lattice", "octahedral:72"]);
    }
    // the figures do not depend on it, and the fields are spread over the cores already
    let output = command.args(["--threads", "1"]).output().expect("runs");
    println!("{}", String::from_utf8_lossy(&output.stdout).trim_end());
    if !output.status.success() {
        return Err(String::from_utf8_lossy(&output.stderr).into_owned());
    }
    let report: Value = serde_json::from_slice(&std::fs::read(&report).expect("reads")).expect("JSON");
    Ok(Metrics::of(&report))
}

fn takes_a_latent_code(field: &Path) -> bool {
    let described = describe(&std::fs::read(field).expect("reads"), &FieldOptions::default());
    matches!(described, Ok(Description::Network { latent_rows, .. }) if latent_rows > 0)
}

/// Compares a result with the stored one, or stores it.
fn check(field: &Path, renew: bool) -> Vec<String> {
    // two formats may hold fields of one name
    let name = field.file_name().expect("a name").to_string_lossy().trim_end_matches(".json").to_owned();
    let folder = if is_mesh(field) { "tests/metrics/meshes" } else { "tests/metrics" };
    let stored_in = Path::new(env!("CARGO_MANIFEST_DIR")).join(folder);
    let path = stored_in.join(format!("{name}.json"));
    let losses = match (extract(field), std::fs::read(&path)) {
        (Err(error), _) => vec![error],
        (Ok(found), _) if renew => {
            std::fs::create_dir_all(&stored_in).expect("a folder");
            std::fs::write(&path, serde_json::to_string_pretty(&found).expect("JSON") + "\n").expect("writes");
            Vec::new()
        }
        (Ok(found), Ok(stored)) => found.losses(&serde_json::from_slice(&stored).expect("stored metrics")),
        (Ok(_), Err(_)) => vec!["no stored metrics; renew them as the head of this file says".to_owned()],
    };
    losses.into_iter().map(|loss| format!("{name}: {loss}")).collect()
}

#[test]
fn results_are_as_good_as_the_stored_metrics() {
    let renew = std::env::var_os("SHRINKD_RENEW_METRICS").is_some();
    let mut fields = fields();
    fields.extend(meshes());
    assert!(fields.len() >= 10, "the example scenes are there");
    let (next, losses) = (AtomicUsize::new(0), Mutex::new(Vec::new()));
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    std::thread::scope(|scope| {
        for _ in 0..cores {
            scope.spawn(|| {
                while let Some(field) = fields.get(next.fetch_add(1, Ordering::Relaxed)) {
                    losses.lock().expect("no panic").extend(check(field, renew));
                }
            });
        }
    });
    let losses = losses.into_inner().expect("no panic");
    assert!(losses.is_empty(), "{}", losses.join("\n"));
}
