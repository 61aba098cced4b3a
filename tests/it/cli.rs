//! The command line: what it writes, says and returns.

use crate::app::{App, BINARY};
use serde_json::Value;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

const SMALL: &str = "latlong:32x16";

fn extract(folder: &Path, scene: &str, further: &[&str]) -> Output {
    let field = folder.join("field.json");
    std::fs::write(&field, scene).expect("writes");
    let mut command = Command::new(BINARY);
    command.arg("extract").arg(&field).arg("-o").arg(folder.join("out.glb")).args(further).output().expect("runs")
}

fn stderr(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

#[test]
fn extract_writes_every_file_it_was_asked_for_and_one_line() {
    let folder = tempfile::tempdir().expect("folder");
    let path = |name: &str| -> String { folder.path().join(name).to_string_lossy().into_owned() };
    let (report, preview, surface) = (path("r.json"), path("p.png"), path("s.safetensors"));
    let files = ["--lattice", SMALL, "--report", &report, "--preview", &preview, "--surface", &surface];
    let output = extract(folder.path(), r#"{"ellipsoid": {"radii": [0.6, 0.5, 0.4]}}"#, &files);
    assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
    let said = String::from_utf8_lossy(&output.stdout);
    assert_eq!(said.lines().count(), 1, "{said}");
    assert!(said.contains("482 vertices") && said.contains("0 flips"), "{said}");
    assert!(said.trim_end().ends_with("; passed every check"), "{said}");
    assert_eq!(stderr(&output), "", "no progress bar where there is no terminal");
    assert!(std::fs::read(path("out.glb")).expect("reads").starts_with(b"glTF"));
    assert!(std::fs::read(&preview).expect("reads").starts_with(b"\x89PNG"));
    assert!(std::fs::metadata(&surface).expect("is there").len() > 0);
    let report: Value = serde_json::from_slice(&std::fs::read(&report).expect("reads")).expect("JSON");
    assert_eq!((report["vertices"].as_u64(), report["euler"].as_i64()), (Some(482), Some(2)));
    for part in ["load", "shrink", "finish", "write"] {
        assert!(report["seconds"][part].as_f64().is_some(), "{part} is timed");
    }
}

#[test]
fn exit_codes_tell_usage_from_input_from_shape() {
    let folder = tempfile::tempdir().expect("folder");
    let code = |scene: &str, further: &[&str]| {
        let output = extract(folder.path(), scene, further);
        (output.status.code(), stderr(&output))
    };
    let ball = r#"{"sphere": {"radius": 0.5}}"#;
    for further in [["--lattice", "cube:3"], ["--method", "magic"], ["--lattice", "octahedral:501"]] {
        assert_eq!(code(ball, &further).0, Some(2), "{further:?}");
    }
    let (found, said) = code(r#"{"sphere": {"radius": -1}}"#, &[]);
    assert_eq!(found, Some(3));
    assert!(said.contains("/sphere/radius"), "{said}");
    assert_eq!(code("no field at all", &[]).0, Some(3));
    let (found, said) = code(r#"{"torus": {"major": 0.5, "minor": 0.2}}"#, &[]);
    assert_eq!(found, Some(4));
    assert!(said.contains("genus"), "{said}");
    let missing =
        Command::new(BINARY).args(["extract", "/nowhere/x.json", "-o", "/nowhere/y.glb"]).output().expect("runs");
    assert_eq!(missing.status.code(), Some(3));
}

#[test]
fn every_fault_of_a_scene_is_told_once() {
    let folder = tempfile::tempdir().expect("folder");
    let output = extract(folder.path(), r#"{"union": {"of": [{"sphere": {"radios": 1}}, {"box": {}}]}}"#, &[]);
    let said = stderr(&output);
    let (first, faults) = said.split_once('\n').expect("lines");
    assert!(first.ends_with("field.json: the field's description is invalid"), "{said}");
    let mut pointers: Vec<&str> =
        faults.lines().filter_map(|line| line.trim().split_once(':')).map(|(p, _)| p).collect();
    let told = pointers.len();
    pointers.sort_unstable();
    pointers.dedup();
    assert!(pointers.contains(&"/union/of/0/sphere/radios"), "{said}");
    assert_eq!((pointers.len(), told), (told, said.lines().count() - 1), "{said}");
}

#[test]
fn describe_says_what_a_file_is_taken_for() {
    let describe = |arguments: &[&str]| {
        let output = Command::new(BINARY).arg("describe").args(arguments).output().expect("runs");
        (output.status.code(), String::from_utf8_lossy(&output.stdout).into_owned(), stderr(&output))
    };
    let fixtures = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/fixtures/networks");
    let (code, said, _) = describe(&[&format!("{fixtures}/morph.safetensors")]);
    let network: Value = serde_json::from_str(&said).expect("JSON");
    assert_eq!((code, &network["kind"], &network["latent_rows"]), (Some(0), &"network".into(), &5.into()), "{said}");
    // what a file cannot be is said as `extract` and the service say it
    let folder = tempfile::tempdir().expect("folder");
    let file = folder.path().join("noise.ply");
    std::fs::write(&file, "no mesh at all").expect("writes");
    let (code, said, refused) = describe(&[file.to_str().expect("text")]);
    assert_eq!((code, said.as_str()), (Some(3), ""), "{refused}");
    assert!(refused.contains("noise.ply"), "{refused}");
    assert_eq!(describe(&[&format!("{fixtures}/blob.npz"), "--field-options", "{"]).0, Some(2));
}

#[test]
fn doctor_says_what_is_wrong_with_a_set_up_and_exits_with_it() {
    let folder = tempfile::tempdir().expect("folder");
    let doctor = |arguments: &[&str]| {
        let output = Command::new(BINARY).arg("doctor").args(arguments).output().expect("runs");
        (output.status.code(), String::from_utf8_lossy(&output.stdout).into_owned(), stderr(&output))
    };
    let data = folder.path().join("data");
    let data = data.to_str().expect("text");
    let (code, said, _) = doctor(&["--data", data, "--listen", "127.0.0.1:0"]);
    assert_eq!(code, Some(0), "{said}");
    assert!(!Path::new(data).exists(), "nothing is left behind");

    let taken = std::net::TcpListener::bind("127.0.0.1:0").expect("a port");
    let listen = taken.local_addr().expect("an address").to_string();
    let file = folder.path().join("file");
    std::fs::write(&file, "").expect("writes");
    let below_a_file = file.join("data");
    // nothing is served at port 1
    let (code, said, _) = doctor(&[
        "--data",
        below_a_file.to_str().expect("text"),
        "--listen",
        &listen,
        "--engine",
        "nats://127.0.0.1:1",
    ]);
    assert_eq!(code, Some(1), "{said}");
    let wrong: Vec<&str> = said.lines().filter(|line| line.starts_with("WRONG")).collect();
    for (what, detail) in [("folder", "is no folder"), ("address", "is taken"), ("engine", "127.0.0.1:1")] {
        assert!(wrong.iter().any(|line| line.contains(what) && line.contains(detail)), "{what}: {said}");
    }

    let settings = folder.path().join("shrinkd.toml");
    std::fs::write(&settings, "[worker]\nslotz = 2\n").expect("writes");
    let (code, _, refused) = doctor(&["--config", settings.to_str().expect("text")]);
    assert_eq!(code, Some(2), "{refused}");
    assert!(refused.contains("slotz"), "{refused}");
}

#[test]
fn what_is_piped_has_no_colours_and_no_bars() {
    let folder = tempfile::tempdir().expect("folder");
    let out = |name: &str| folder.path().join(name).to_string_lossy().into_owned();
    let scenes = folder.path().join("scenes");
    std::fs::create_dir(&scenes).expect("makes");
    std::fs::write(scenes.join("ball.json"), r#"{"sphere": {"radius": 0.5}}"#).expect("writes");
    let morph = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/fixtures/networks/morph.safetensors");
    let path = folder.path().join("path.json");
    std::fs::write(&path, r#"{"from": 0, "to": 1, "frames": 2}"#).expect("writes");
    let (scenes, path) = (scenes.to_string_lossy(), path.to_string_lossy());
    let commands: [&[&str]; 5] = [
        &["--help"],
        &["extract"],
        &["extract", morph, "--latent-row", "0", "-o", &out("morph.glb"), "--lattice", SMALL],
        &["animate", morph, "--latents", &path, "-o", &out("way.glb"), "--lattice", SMALL],
        &["compare", &scenes, "--lattice", SMALL],
    ];
    for command in commands {
        let output = Command::new(BINARY).args(command).output().expect("runs");
        for bytes in [&output.stdout, &output.stderr] {
            let said = String::from_utf8_lossy(bytes);
            assert!(!said.contains(['\x1b', '\r']), "{command:?}: {said:?}");
        }
    }
}

#[test]
fn the_same_bytes_come_out_for_any_number_of_threads() {
    let folder = tempfile::tempdir().expect("folder");
    let scene = std::fs::read_to_string(scenes().join("snowman.json")).expect("reads");
    let glb = |threads: &str| {
        let output = extract(folder.path(), &scene, &["--threads", threads, "--lattice", "octahedral:24"]);
        assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
        std::fs::read(folder.path().join("out.glb")).expect("reads")
    };
    assert!(glb("1") == glb("16"), "one thread and sixteen make the same file");
}

#[test]
fn a_flat_scene_gives_an_svg_and_a_line_loop() {
    let folder = tempfile::tempdir().expect("folder");
    let scene = std::fs::read_to_string(scenes().join("2d/disc.json")).expect("reads");
    let output = extract(folder.path(), &scene, &[]);
    assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
    assert!(std::fs::read(folder.path().join("out.glb")).expect("reads").starts_with(b"glTF"));
    assert!(std::fs::read_to_string(folder.path().join("out.svg")).expect("reads").contains("<svg"));
}

#[tokio::test]
async fn healthcheck_asks_a_service_whether_it_is_ready() {
    let folder = tempfile::tempdir().expect("folder");
    let app = App::start(folder.path());
    let check = |url: &str| Command::new(BINARY).args(["healthcheck", url]).output().expect("runs").status.code();
    assert_eq!(check(&app.url), Some(0));
    assert_eq!(check(&format!("{}/nowhere", app.url)), Some(1));
    let url = app.url.clone();
    app.kill();
    assert_eq!(check(&url), Some(1));
    assert_eq!(check("ftp://x"), Some(2));
}

/// The example scenes.
pub fn scenes() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("examples/scenes")
}
