//! Jobs of dimension 2: from a field to a certified curve and its outputs.

use super::{Asked, MEASURED_SHARE, Opened, lasting, pretty};
use crate::field::Sampler;
use crate::field::sampler::Tally;
use crate::job::failure::{Ended, Failure};
use crate::job::spec::OutputName;
use crate::measure::curve::{CurveReport, measure};
use crate::measure::report::Evaluations;
use crate::settings::{Progress, Settings};
use crate::shrink::curve::{Curve, CurveSpec, shrink_curve};
use crate::shrink::{Effort, Method, ShrinkError};
use crate::surface;
use std::time::Instant;

/// Side of the picture, pixels.
const PICTURE: u32 = 1024;
/// Where the share of every attempt in the progress ends. The first one mostly is the last.
const ENDS: [f32; 1 + Effort::ATTEMPTS as usize] = [0.0, 0.85, 0.93, 1.0];

/// What a field of dimension 2 made.
pub struct CurveMade {
    /// The report, with the seconds that each part took.
    pub report: CurveReport,
    /// The outputs that were asked for, in the order of [`OutputName`].
    pub files: Vec<(OutputName, Vec<u8>)>,
}

impl CurveMade {
    /// Whether the curve passed every check of its verdict.
    pub fn is_sound(&self) -> bool {
        self.report.verdict.passed
    }

    /// Why this is no success, if it is none. The paper's loop is a baseline: what it makes is what was asked for.
    pub fn problem(&self) -> Option<Failure> {
        if self.is_sound() || self.report.method == Method::Paper {
            return None;
        }
        let failure = Failure::not_certified(&self.report.verdict);
        let detail = format!("{}; {} samples may be too few for this curve", failure.detail, self.report.vertices);
        Some(Failure { detail, ..failure })
    }
}

/// How bad a curve is: first by the number of its faults, then by its distance.
fn rank(report: &CurveReport) -> (u64, f64) {
    (
        report.flips.surface + report.flips.uv + report.self_intersections + report.degenerate,
        report.closeness.distance.max,
    )
}

/// Makes a certified curve of a field of dimension 2, or the best there is, and writes it. Tried again with more effort
/// where it does not pass; a refusal for its topology is believed when a closer look finds the same.
pub fn make_curve(opened: &Opened, asked: &Asked<'_>, settings: Settings<'_>) -> Result<CurveMade, Ended> {
    let Asked { shrink: spec, budget, load_seconds, .. } = *asked;
    let tally = Tally::new();
    let spent = || tally.total().total();
    let (mut best, mut refusal): (Option<(Curve, CurveReport)>, Option<ShrinkError>) = (None, None);
    let (mut shrinking, mut measuring, mut costliest, mut attempts) = (0.0, 0.0, 0, 0);
    for attempt in 0..budget.attempts(spec.method) {
        let before = spent();
        if attempt > 0 && !budget.allows(before, costliest) {
            break;
        }
        attempts = attempt + 1;
        let (start, end) = (ENDS[attempt as usize], ENDS[attempt as usize + 1]);
        let told = |progress: Progress| {
            let fraction = MEASURED_SHARE * (start + (end - start) * progress.fraction);
            (settings.progress)(Progress { fraction, attempt: attempt + 1, ..progress });
        };
        let sampler = Sampler::new(opened.field.as_ref(), Settings { progress: &told, ..settings }, &tally);
        let clock = Instant::now();
        let made = shrink_curve(&sampler, &CurveSpec::from(spec), &Effort { attempt, ..Effort::default() });
        shrinking += clock.elapsed().as_secs_f64();
        costliest = costliest.max(spent() - before);
        let curve = match made {
            Ok(curve) => curve,
            // what is joined by something thin may look apart at first
            Err(
                error @ (ShrinkError::Components { .. } | ShrinkError::NoComponent { .. } | ShrinkError::Holes { .. }),
            ) => {
                let again = refusal.as_ref().is_some_and(|before| before.to_string() == error.to_string());
                refusal = Some(error);
                if again {
                    break;
                }
                continue;
            }
            Err(error) => return Err(error.into()),
        };
        let clock = Instant::now();
        told(Progress { stage: "measure", fraction: 0.8, ..Progress::default() });
        let report = measure(&curve, &sampler, &tally.by_stage(), spec)?;
        measuring += clock.elapsed().as_secs_f64();
        let passed = report.verdict.passed;
        if passed || best.as_ref().is_none_or(|(_, other)| rank(&report) <= rank(other)) {
            best = Some((curve, report));
        }
        if passed {
            break;
        }
    }
    let (curve, mut report) = match (best, refusal) {
        // a closer look that finds one loop is believed
        (Some(best), _) => best,
        (None, Some(refusal)) => return Err(refusal.into()),
        (None, None) => return Err(Failure::internal().into()),
    };
    report.attempts = attempts;
    report.evaluations = Evaluations::new(&tally.by_stage(), report.vertices);
    (report.seconds.load, report.seconds.shrink, report.seconds.finish) = (load_seconds, shrinking, measuring);

    (settings.progress)(Progress {
        stage: "write",
        fraction: MEASURED_SHARE,
        attempt: attempts,
        ..Progress::default()
    });
    let clock = Instant::now();
    let lasting = lasting(&report);
    let files = asked.written(&settings, |output| {
        Ok(match output {
            OutputName::Glb => surface::curve::to_glb(&curve, &lasting, &opened.provenance),
            OutputName::Surface => surface::curve::to_safetensors(&curve),
            OutputName::Svg => surface::curve::to_svg(&curve).into_bytes(),
            OutputName::Preview => surface::curve::to_png(&curve, PICTURE, &settings)?,
            OutputName::Network | OutputName::Sensitivity | OutputName::Filmstrip => {
                return Err(Failure::internal().into());
            }
            OutputName::Report => {
                report.seconds.write = clock.elapsed().as_secs_f64();
                pretty(&report)
            }
        })
    })?;
    Ok(CurveMade { report, files })
}
