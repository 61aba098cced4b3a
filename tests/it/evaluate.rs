//! `shrinkd evaluate` and `shrinkd compare`: what they write, say and return.

use crate::app::{BINARY, PATIENCE};
use serde_json::Value;
use std::io::{BufRead as _, BufReader};
use std::path::Path;
use std::process::{Command, Output, Stdio};
use std::time::Instant;

const BALL: &str = r#"{"sphere": {"radius": 0.5}}"#;
const EGG: &str = r#"{"ellipsoid": {"radii": [0.6, 0.5, 0.4]}}"#;
const RING: &str = r#"{"torus": {"major": 0.5, "minor": 0.2}}"#;
/// Fine enough to stay within 1 % of the diagonal on a ball.
const SMALL: &str = "octahedral:24";

fn shrinkd(arguments: &[&str]) -> Output {
    Command::new(BINARY).args(arguments).output().expect("runs")
}

fn stdout(output: &Output) -> String {
    String::from_utf8_lossy(&output.stdout).into_owned()
}

fn stderr(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

fn put(folder: &Path, name: &str, text: &str) -> String {
    let path = folder.join(name);
    std::fs::create_dir_all(path.parent().expect("a folder")).expect("folder");
    std::fs::write(&path, text).expect("writes");
    path.to_string_lossy().into_owned()
}

fn json(path: &Path) -> Value {
    serde_json::from_slice(&std::fs::read(path).expect("reads")).expect("JSON")
}

/// The cube of side 1 about the origin, as OFF, twelve triangles.
const CUBE: &str = "OFF\n8 12 0\n-.5 -.5 -.5\n.5 -.5 -.5\n.5 .5 -.5\n-.5 .5 -.5\n-.5 -.5 .5\n.5 -.5 .5\n.5 .5 .5\n-.5 .5 .5\n\
    3 0 2 1\n3 0 3 2\n3 4 5 6\n3 4 6 7\n3 0 1 5\n3 0 5 4\n3 2 3 7\n3 2 7 6\n3 1 2 6\n3 1 6 5\n3 0 4 7\n3 0 7 3\n";

#[test]
fn a_result_is_evaluated_as_its_own_report_says() {
    let folder = tempfile::tempdir().expect("folder");
    let path = |name: &str| folder.path().join(name).to_string_lossy().into_owned();
    let field = put(folder.path(), "egg.json", EGG);
    for lattice in [SMALL, "latlong:64x32"] {
        let (glb, report) = (path("egg.glb"), path("egg.report.json"));
        let made = shrinkd(&["extract", &field, "-o", &glb, "--lattice", lattice, "--report", &report]);
        assert_eq!(made.status.code(), Some(0), "{}", stderr(&made));
        let output = shrinkd(&["evaluate", &glb, "--truth", &field, "--json", "--check"]);
        assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
        let found: Value = serde_json::from_str(&stdout(&output)).expect("JSON");
        let report = json(Path::new(&report));
        assert_eq!(found["succeeds"], true);
        let surface = &found["evaluation"]["surface"];
        for member in ["vertices", "triangles", "closed", "euler", "self_intersections", "degenerate"] {
            assert_eq!(surface[member], report[member], "{lattice} {member}");
        }
        let near = |a: &Value, b: &Value, what: &str| {
            let (a, b) = (a.as_f64().expect(what), b.as_f64().expect(what));
            assert!((a - b).abs() <= 1e-3 * b.abs(), "{lattice} {what}: {a} and {b}");
        };
        for member in ["mean", "max"] {
            near(&surface["distance"][member], &report["distance"][member], member);
        }
        let chart = &found["evaluation"]["parameterization"];
        assert_eq!((&chart["charts"], &chart["uv_flips"], &chart["sphere_flips"]), (&1.into(), &0.into(), &0.into()));
        for member in ["qc", "symmetric_dirichlet", "area_p1", "area_p99"] {
            near(&chart["sphere"][member], &report["distortion"]["sphere"][member], member);
            near(&chart["uv"][member], &report["distortion"]["uv"][member], member);
        }
        assert_eq!(found["evaluation"]["marching_cubes"][0]["field_values"], 27 * 27 * 27);
    }
}

#[test]
fn a_mesh_of_another_program_is_evaluated_and_the_table_says_where_it_is_worst() {
    let folder = tempfile::tempdir().expect("folder");
    let cube = put(folder.path(), "cube.off", CUBE);
    // one corner pulled out
    let pulled = put(folder.path(), "pulled.off", &CUBE.replace("\n.5 .5 .5\n", "\n.6 .6 .6\n"));
    let output = shrinkd(&["evaluate", &pulled, "--truth", &cube]);
    assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
    let said = stdout(&output);
    for part in [
        "CD2 x 1e5",
        "truth itself",
        "MC 27^3",
        "farthest from the truth: 10.000 % of the diagonal, at (0.60000, 0.60000, 0.60000)",
        "does not succeed",
    ] {
        assert!(said.contains(part), "{part}: {said}");
    }
    assert!(!said.contains("Parameterization"), "an OFF file has no texture coordinates");
    let output = shrinkd(&["evaluate", &pulled, "--truth", &cube, "--check", "--no-baseline"]);
    assert_eq!(output.status.code(), Some(1));
    assert!(stderr(&output).contains("largest distance"), "{}", stderr(&output));
    assert!(!stdout(&output).contains("MC 27^3"));
}

#[test]
fn what_cannot_be_evaluated_is_refused_by_its_name() {
    let folder = tempfile::tempdir().expect("folder");
    let (ball, cube) = (put(folder.path(), "ball.json", BALL), put(folder.path(), "cube.off", CUBE));
    let disc = put(folder.path(), "disc.json", r#"{"circle": {"radius": 0.5}}"#);
    let cases = [
        (["evaluate", "/nowhere/x.glb", "--truth", &ball], 3, "/nowhere/x.glb"),
        (["evaluate", &cube, "--truth", "/nowhere/y"], 3, "/nowhere/y"),
        (["evaluate", &ball, "--truth", &cube], 3, "not a mesh"),
        (["evaluate", &cube, "--truth", &disc], 3, "a curve"),
    ];
    for (arguments, code, part) in cases {
        let output = shrinkd(&arguments);
        assert_eq!(output.status.code(), Some(code), "{arguments:?} {}", stderr(&output));
        assert!(stderr(&output).contains(part), "{arguments:?} {}", stderr(&output));
    }
    assert_eq!(shrinkd(&["evaluate", &cube]).status.code(), Some(2), "--truth is missing");
    let output = shrinkd(&["evaluate", &cube, "--truth", &ball, "--chart", "latlong"]);
    assert_eq!(output.status.code(), Some(3));
    assert!(stderr(&output).contains("no texture coordinates"));
}

#[test]
fn a_folder_is_compared_with_a_row_per_shape_and_lattice() {
    let folder = tempfile::tempdir().expect("folder");
    let shapes = folder.path().join("shapes");
    put(&shapes, "round/ball.json", BALL);
    put(&shapes, "round/egg.json", EGG);
    put(&shapes, "handles/ring.json", RING);
    put(&shapes, "flat.json", r#"{"circle": {"radius": 0.5}}"#);
    put(&shapes, "manifest.json", r#"{"count": 3, "licence": "none"}"#);
    put(&shapes, "notes.md", "no field");
    let out = folder.path().join("out");
    let (dir, out_name) = (shapes.to_string_lossy(), out.to_string_lossy());
    let lattices = ["--lattice", SMALL, "--lattice", "latlong:48x24"];
    let compare = |further: &[&str]| {
        let mut arguments = vec!["compare", &*dir, "--out", &*out_name];
        arguments.extend(lattices);
        arguments.extend(further);
        shrinkd(&arguments)
    };
    let output = compare(&["--expect-refusal", "handles/*", "--glb"]);
    assert_eq!(output.status.code(), Some(0), "{}{}", stdout(&output), stderr(&output));
    let table = std::fs::read_to_string(out.join("compare.md")).expect("reads");
    assert_eq!(table, stdout(&output), "the file holds what was said");
    let passed = |line: &&str| line.starts_with("| round/") && line.contains("| pass |");
    assert_eq!(table.lines().filter(passed).count(), 4, "{table}");
    assert_eq!(table.matches("genus 1").count(), 2, "{table}");
    assert!(table.contains("- flat.json: a curve") && table.contains("- manifest.json:"), "{table}");
    assert!(!table.contains("notes.md"));

    let found = json(&out.join("compare.json"));
    assert_eq!((found["partial"].as_bool(), found["rows"].as_array().map(Vec::len)), (Some(false), Some(6)));
    let row =
        |shape: &str| found["rows"].as_array().expect("rows").iter().find(|r| r["shape"] == shape).expect("a row");
    let ball = row("round/ball.json");
    assert_eq!(
        (ball["result"].as_str(), row("handles/ring.json")["result"].as_str()),
        (Some("passed"), Some("refused"))
    );
    assert_eq!(row("handles/ring.json")["code"], "genus");
    let (ours, cubes) = (ball["report"]["vertices"].as_f64(), ball["baseline"]["vertices"].as_f64());
    let ratio = cubes.expect("a baseline") / ours.expect("a report");
    assert!((0.95..1.2).contains(&ratio), "as many vertices: {ratio}");
    assert!(ball["field_seconds"].as_f64() <= ball["report"]["seconds"]["shrink"].as_f64());
    let all = found["summary"].as_array().expect("groups").iter().find(|g| g["folder"] == "all").expect("all");
    assert_eq!((all["shapes"].as_u64(), all["passed"].as_u64(), all["refused"].as_u64()), (Some(3), Some(2), Some(1)));
    assert_eq!(all["share"], 1.0);
    for sheet in ["contact-octahedral-24.png", "contact-latlong-48x24.png"] {
        assert!(std::fs::read(out.join(sheet)).expect("reads").starts_with(b"\x89PNG"), "{sheet}");
    }
    assert!(out.join("glb/round/ball.json.octahedral-24.glb").exists());

    let output = compare(&["--only", "ring", "--no-baseline"]);
    assert_eq!(output.status.code(), Some(1), "a refusal that nobody expected");
    assert!(stdout(&output).contains("**refused**"));
    let output = compare(&["--only", "ball", "--expect-refusal", "ball", "--no-baseline"]);
    assert_eq!(output.status.code(), Some(1));
    assert!(stdout(&output).contains("a refusal was expected"), "{}", stdout(&output));
}

#[test]
fn a_folder_is_compared_as_the_options_say() {
    let folder = tempfile::tempdir().expect("folder");
    put(folder.path(), "ring.json", RING);
    put(folder.path(), "egg.json", EGG);
    let (dir, file) = (folder.path().to_string_lossy(), folder.path().join("found"));
    let file_name = file.to_string_lossy();
    let compare = |further: &[&str]| {
        let mut arguments = vec!["compare", &*dir, "--json", &*file_name, "--no-baseline", "--lattice", SMALL];
        arguments.extend(further);
        let output = shrinkd(&arguments);
        assert_eq!(output.status.code(), Some(0), "{}{}", stdout(&output), stderr(&output));
        (json(&file), stdout(&output))
    };
    let (found, table) = compare(&["--on-topology", "wrap", "--attempts", "2"]);
    let ring = found["rows"].as_array().and_then(|rows| rows.iter().find(|r| r["shape"] == "ring.json"));
    let ring = ring.expect("a row");
    assert_eq!(ring["result"], "passed");
    assert!(ring["report"]["topology"]["invented_area"].as_f64() > Some(0.0), "{:#}", ring["report"]);
    assert_eq!((&found["options"]["on_topology"], &found["options"]["attempts"]), (&"wrap".into(), &2.into()));
    assert!(table.starts_with("Options: ") && table.contains("on_topology wrap"), "{table}");

    let angles = |distortion: &str| {
        let (found, _) = compare(&["--only", "egg", "--distortion", distortion, "--density", "area"]);
        found["rows"][0]["report"]["distortion"]["sphere"].clone()
    };
    let (angle, area) = (angles("angle"), angles("area"));
    assert!(angle["log_area_rms"].as_f64() > area["log_area_rms"].as_f64(), "{angle} {area}");
}

#[test]
fn a_folder_without_fields_and_bad_arguments_are_told_apart() {
    let folder = tempfile::tempdir().expect("folder");
    put(folder.path(), "notes.md", "no field");
    let dir = folder.path().to_string_lossy();
    let output = shrinkd(&["compare", &dir]);
    assert_eq!(output.status.code(), Some(3));
    assert!(stderr(&output).contains("no field is here"), "{}", stderr(&output));
    assert_eq!(shrinkd(&["compare", "/nowhere"]).status.code(), Some(3));
    for wrong in [&["--lattice", "cube:3"][..], &["--glb"], &["--limit", "soon"]] {
        let arguments: Vec<&str> = ["compare", &dir].into_iter().chain(wrong.iter().copied()).collect();
        assert_eq!(shrinkd(&arguments).status.code(), Some(2), "{wrong:?}");
    }
}

#[test]
fn a_signal_ends_the_run_and_leaves_the_rows_that_were_done() {
    let folder = tempfile::tempdir().expect("folder");
    let shapes = folder.path().join("shapes");
    for i in 0..50 {
        put(&shapes, &format!("{i:02}.json"), EGG);
    }
    let out = folder.path().join("out");
    let mut child = Command::new(BINARY)
        .arg("compare")
        .arg(&shapes)
        .args(["--lattice", "octahedral:72", "--no-baseline", "--out"])
        .arg(&out)
        .stdout(Stdio::piped())
        .stderr(Stdio::null())
        .spawn()
        .expect("starts");
    let mut lines = BufReader::new(child.stdout.take().expect("piped")).lines();
    let first = lines.find(|line| line.as_ref().is_ok_and(|l| l.contains("| pass |")));
    assert!(first.is_some(), "a row comes before the end");
    let pid = child.id().to_string();
    assert!(Command::new("kill").args(["-INT", &pid]).status().expect("runs").success());
    let start = Instant::now();
    let rest: Vec<String> = lines.map_while(Result::ok).collect();
    assert_eq!(child.wait().expect("ends").code(), Some(1));
    assert!(start.elapsed() < PATIENCE);
    assert!(rest.iter().any(|line| line.starts_with("Interrupted after")), "{rest:?}");
    let found = json(&out.join("compare.json"));
    let rows = found["rows"].as_array().expect("rows").len();
    assert!((1..50).contains(&rows), "{rows}");
    assert_eq!(found["partial"], true);
}
