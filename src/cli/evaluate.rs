//! `shrinkd evaluate`: one mesh, whoever made it, against a mesh or a field, as a table or as JSON.

mod table;

use super::{BAD_INPUT, EvaluateArgs, FAILED, fail, interrupt};
use crate::field::Sampler;
use crate::field::input::{self, Description};
use crate::field::mesh::{ChartedMesh, MeshFormat, TriangleMesh};
use crate::field::sampler::Tally;
use crate::measure::chart::SphereChart;
use crate::measure::distance::{Mesh, mesh_vertices};
use crate::measure::evaluation::{Evaluation, evaluate};
use crate::measure::truth::Truth;
use crate::settings::{CancelToken, Canceled, Settings};
use serde_json::json;
use std::io::Write as _;
use std::path::Path;
use std::process::ExitCode;

/// Evaluates one mesh.
pub fn run(args: &EvaluateArgs) -> ExitCode {
    match measured(args) {
        Ok(Ok(())) => ExitCode::SUCCESS,
        Ok(Err(faults)) if args.check => fail(FAILED, &faults.join("; ")),
        Ok(Err(_)) => ExitCode::SUCCESS,
        Err((code, error)) => fail(code, &error),
    }
}

/// Whether the mesh succeeds, with the reasons why not; or an exit code and what to say.
fn measured(args: &EvaluateArgs) -> Result<Result<(), Vec<String>>, (u8, String)> {
    let (mesh, charted) = read_mesh(&args.mesh)?;
    let chart = charted.as_ref().and_then(|m| args.chart.map(SphereChart::from).or(SphereChart::named_in(&m.extras)));
    if args.chart.is_some() && charted.is_none() {
        return Err(wrong(&args.mesh, &"--chart was given, and the file has no texture coordinates"));
    }
    let bytes = super::read_field(&args.truth).map_err(|e| wrong(&args.truth, &e))?;
    let options = args.truth_options.read()?;
    let kind = input::describe(&bytes, &options).map_err(|e| wrong(&args.truth, &e))?;
    let opened = input::open(&bytes, &options).map_err(|e| wrong(&args.truth, &e))?;
    let field = opened.field;
    if field.dimension() != 3 {
        return Err(wrong(&args.truth, &"a curve, and a surface is needed"));
    }
    let pool = rayon::ThreadPoolBuilder::new().num_threads(args.threads).build();
    let pool = pool.map_err(|e| (FAILED, e.to_string()))?;
    let cancel = CancelToken::new();
    interrupt::raise_on_signal(&cancel).map_err(|e| (FAILED, e.to_string()))?;
    let settings = Settings { pool: &pool, cancel: &cancel, progress: &|_| {}, watched: false };
    let tally = Tally::new();
    let sampler = Sampler::new(field.as_ref(), settings, &tally);
    let vertices = mesh_vertices(&mesh);
    let surface = Mesh { vertices: &vertices, triangles: &mesh.triangles };
    let found = || -> Result<Option<Evaluation>, Canceled> {
        let truth = Truth::of(&sampler)?;
        evaluate(surface, charted.as_ref().map(|m| (m, chart)), &truth, !args.no_baseline)
    };
    let found = found().map_err(|e| (FAILED, e.to_string()))?;
    let found = found.ok_or_else(|| wrong(&args.truth, &"the field has no zero level set in its domain"))?;
    let verdict = found.succeeds();
    let text = if args.json {
        let document = json!({
            "mesh": args.mesh.to_string_lossy(),
            "against": args.truth.to_string_lossy(),
            "against_kind": kind_name(&kind),
            "version": env!("CARGO_PKG_VERSION"),
            "succeeds": verdict.is_ok(),
            "faults": verdict.as_ref().err(),
            "evaluation": found,
        });
        format!("{document:#}\n")
    } else {
        table::to_text(&found, &args.mesh, &args.truth, kind_name(&kind))
    };
    let mut out = std::io::stdout().lock();
    out.write_all(text.as_bytes()).and_then(|()| out.flush()).map_err(|e| (FAILED, e.to_string()))?;
    Ok(verdict)
}

/// The mesh with vertices at one place merged, and as it stands where it has texture coordinates.
fn read_mesh(path: &Path) -> Result<(TriangleMesh, Option<ChartedMesh>), (u8, String)> {
    let bytes = std::fs::read(path).map_err(|e| wrong(path, &e))?;
    if MeshFormat::detect(&bytes).is_none() {
        return Err(wrong(path, &"not a mesh in PLY, OBJ, STL, OFF or GLB"));
    }
    let mesh = TriangleMesh::read(&bytes).map_err(|e| wrong(path, &e))?;
    let charted = ChartedMesh::read(&bytes).map_err(|e| wrong(path, &e))?;
    Ok((mesh, charted))
}

fn kind_name(kind: &Description) -> &'static str {
    match kind {
        Description::Scene { .. } => "scene",
        Description::Network { .. } => "network",
        Description::Mesh { .. } => "mesh",
        Description::Grid { .. } => "grid",
    }
}

fn wrong(path: &Path, detail: &dyn std::fmt::Display) -> (u8, String) {
    (BAD_INPUT, format!("{}: {detail}", path.display()))
}
