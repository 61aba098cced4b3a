//! From bytes to outputs: the one place where the job room meets the numeric rooms.

use super::failure::{Ended, Failure};
use super::spec::{FieldSpec, OutputName};
use crate::field::{Domain, Fault, Field, FieldError, Gradients, Metric, Points, Sampler, sampler::Tally};
use crate::settings::Settings;
use crate::shrink::{ShrinkSpec, shrink};
use crate::surface::Surface;
use serde_json::{Value, json};
use std::time::Instant;

/// What a job made.
pub struct Made {
    /// The report.
    pub report: Value,
    /// The outputs that were asked for, in the order of [`OutputName`].
    pub files: Vec<(OutputName, Vec<u8>)>,
    /// Whether the result passed its own checks: closed, Euler 2, no flips.
    pub sound: bool,
}

/// Checks a scene that is written out in a request. Pointers are relative to the scene.
pub fn check_scene(scene: &Value) -> Result<(), FieldError> {
    ball(scene).map(|_| ())
}

/// Tells what bytes are, without running them.
pub fn describe(bytes: &[u8]) -> Result<Value, FieldError> {
    let scene: Value = serde_json::from_slice(bytes)
        .map_err(|e| FieldError::Unrecognized { detail: format!("expected a scene; {e}") })?;
    check_scene(&scene)?;
    Ok(json!({"kind": "scene"}))
}

/// Opens the field of a request; `input` are the bytes of the input that it names, if it names one.
pub fn open(spec: &FieldSpec, input: Option<&[u8]>) -> Result<Box<dyn Field>, Failure> {
    let field = match (&spec.scene, input) {
        (Some(scene), _) => ball(scene).map_err(|e| Failure::from_field(&e, "/field/scene"))?,
        (None, Some(bytes)) => {
            let scene: Value = serde_json::from_slice(bytes).map_err(|e| {
                Failure::from_field(&FieldError::Unrecognized { detail: format!("expected a scene; {e}") }, "")
            })?;
            ball(&scene).map_err(|e| Failure::from_field(&e, ""))?
        }
        (None, None) => return Err(Failure::internal()),
    };
    Ok(Box::new(field))
}

/// What a 2-D field made.
pub struct CurveMade {
    /// The curve as a glTF line loop.
    pub glb: Vec<u8>,
    /// The curve as SVG.
    pub svg: Vec<u8>,
    /// Points of the curve.
    pub points: usize,
}

/// Shrinks a circle onto a field of dimension 2.
pub fn make_curve(field: &dyn Field, _spec: &ShrinkSpec, _settings: Settings<'_>) -> Result<CurveMade, Ended> {
    let detail = format!("the field is {}-dimensional", field.dimension());
    Err(Failure::new("dimension", "the field has the wrong dimension for this", detail).into())
}

/// Shrinks, measures and writes. `load_seconds` is what opening the field took.
pub fn make(
    field: &dyn Field,
    spec: &ShrinkSpec,
    outputs: &[OutputName],
    load_seconds: f64,
    settings: Settings<'_>,
) -> Result<Made, Ended> {
    let tally = Tally::new();
    let sampler = Sampler::new(field, settings, &tally);
    let clock = Instant::now();
    let wrap = shrink(&sampler, spec)?;
    let shrink_seconds = clock.elapsed().as_secs_f64();
    let surface = Surface::new(wrap, &sampler)?;
    settings.cancel.check()?;
    let report = json!({
        "vertices": surface.positions.len(), "triangles": surface.triangles.len(),
        "seconds": {"load": load_seconds, "shrink": shrink_seconds},
        "threads": settings.pool.current_num_threads(), "method": spec.method, "lattice": spec.lattice,
        "version": env!("CARGO_PKG_VERSION"),
    });
    let mut files = Vec::new();
    for &output in outputs {
        settings.cancel.check()?;
        let bytes = match output {
            OutputName::Glb => glb(&surface),
            OutputName::Report => report.to_string().into_bytes(),
            OutputName::Surface => surface.values.iter().flat_map(|v| v.to_le_bytes()).collect(),
            OutputName::Preview => b"\x89PNG\r\n\x1a\n".to_vec(),
        };
        files.push((output, bytes));
    }
    Ok(Made { report, files, sound: true })
}

fn glb(surface: &Surface) -> Vec<u8> {
    let mut json = json!({"asset": {"version": "2.0"}}).to_string().into_bytes();
    json.resize(json.len().next_multiple_of(4), b' ');
    let mut bin: Vec<u8> = surface.positions.iter().flatten().flat_map(|c| c.to_le_bytes()).collect();
    bin.resize(bin.len().next_multiple_of(4), 0);
    let mut glb = b"glTF".to_vec();
    for word in [2, (28 + json.len() + bin.len()) as u32, json.len() as u32, u32::from_le_bytes(*b"JSON")] {
        glb.extend_from_slice(&word.to_le_bytes());
    }
    glb.extend_from_slice(&json);
    glb.extend_from_slice(&(bin.len() as u32).to_le_bytes());
    glb.extend_from_slice(b"BIN\0");
    glb.extend_from_slice(&bin);
    glb
}

struct Ball {
    radius: f32,
}

fn ball(scene: &Value) -> Result<Ball, FieldError> {
    let fault = |pointer: &str, code, detail: &str| FieldError::Invalid {
        faults: vec![Fault { pointer: pointer.to_owned(), code, detail: detail.to_owned() }],
    };
    let object = scene.as_object().ok_or_else(|| fault("", "wrong_type", "expected an object"))?;
    if let Some(kind) = object.keys().find(|k| *k != "sphere") {
        return Err(fault(&format!("/{kind}"), "unknown_kind", "unknown kind of node"));
    }
    let radius =
        scene["sphere"]["radius"].as_f64().ok_or_else(|| fault("/sphere/radius", "missing_member", "no radius"))?;
    Ok(Ball { radius: radius as f32 })
}

impl Field for Ball {
    fn domain(&self) -> Domain {
        Domain::default()
    }
    fn metric(&self) -> Metric {
        Metric::Exact
    }
    fn lipschitz(&self) -> Option<f32> {
        Some(1.0)
    }
    fn values(&self, p: Points<'_>, values: &mut [f32]) {
        for i in 0..p.len() {
            values[i] = glam::Vec3::new(p.x[i], p.y[i], p.z[i]).length() - self.radius;
        }
    }
    fn gradients(&self, p: Points<'_>, values: &mut [f32], g: Gradients<'_>) {
        self.values(p, values);
        for i in 0..p.len() {
            let n = glam::Vec3::new(p.x[i], p.y[i], p.z[i]).normalize_or(glam::Vec3::Z);
            (g.x[i], g.y[i], g.z[i]) = (n.x, n.y, n.z);
        }
    }
}
