//! From a field to a surface that is certified: shrinks, measures, and tries again with more effort where the result does not
//! pass, telling the next attempt where the last ones went wrong.
//!
//! Guarantees: the first attempt that passes is the result; when none does, the best one is, with a verdict that says what is
//! wrong and where. Only its chart is relaxed, where that is asked for. Every evaluation of every attempt is counted into the sampler's tally; those of measuring are not. Like
//! the rooms it stands on, it knows no clock: a caller who has one is told when a [`Part`] begins.

use crate::field::sampler::Tally;
use crate::field::{Field, Sampler};
use crate::measure::report::{Evaluations, Report, measure};
use crate::settings::{Canceled, Progress, Settings};
use crate::shrink::study::{DEEPEST, Study, Topology, study};
use crate::shrink::{Effort, Method, OnTopology, ShrinkError, ShrinkSpec, mend, shrink};
use crate::surface::Surface;
use glam::{DVec3, Vec3};
use std::sync::atomic::{AtomicU32, Ordering};

/// What may be spent on one surface. Without a limit, as many attempts as are worth making.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Budget {
    /// Attempts at most, from 1 to 3; 3 when nothing is said.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(minimum = 1, maximum = 3)]
    pub attempts: Option<u32>,
    /// Field evaluations (values and gradients together). The first attempt is always made; another one only when it would
    /// stay within this, judged by the costliest so far.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(minimum = 1)]
    pub evaluations: Option<u64>,
}

impl Budget {
    /// Attempts that a method may make: the paper's loop has no effort to add.
    pub fn attempts(self, method: Method) -> u32 {
        match method {
            Method::Adaptive => self.attempts.unwrap_or(Effort::ATTEMPTS).clamp(1, Effort::ATTEMPTS),
            Method::Paper => 1,
        }
    }

    /// Whether an attempt of cost `next` may follow what was `spent`.
    pub fn allows(self, spent: u64, next: u64) -> bool {
        self.evaluations.is_none_or(|limit| spent.saturating_add(next) <= limit)
    }
}

/// What is being done; told to whoever has a clock.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Part {
    /// An attempt at the surface.
    Shrink,
    /// Its measurement.
    Measure,
}

/// A surface and what was measured about it.
#[derive(Clone, Debug)]
pub struct Extracted {
    /// The first surface that passed, or the best one.
    pub surface: Surface,
    /// Its report; `seconds` are left to the caller.
    pub report: Report,
    /// What a closer look found the shape to be, after an attempt that did not pass: not a sphere after all.
    pub refusal: Option<ShrinkError>,
}

/// Where the share of every attempt in the progress ends. The first one mostly is the last.
const ENDS: [f32; 1 + Effort::ATTEMPTS as usize] = [0.0, 0.85, 0.93, 1.0];
/// Where relaxing the chart of the surface that was chosen starts.
const RELAXING: f32 = 0.95;
/// Repairs of one attempt's surface, each followed by a measurement, ...
const REPAIRS: u32 = 2;
/// ... and further ones while no more than this is left to repair, ...
const FEW: u64 = 20;
/// ... at most so many, ...
const MOST_REPAIRS: u32 = 10;
/// ... of which so many in a row may bring nothing.
const VAIN: u32 = 4;
/// Share of an attempt's time that shrinking takes; measuring takes the rest.
const SHRINKING: f32 = 0.8;

/// Makes a certified surface of the sampler's field, or the best there is. `weight` is what [`shrink`] takes.
///
/// # Errors
/// [`ShrinkError`] when the token was raised, or when no attempt gave a surface.
pub fn extract(
    sampler: &Sampler<'_>,
    spec: &ShrinkSpec,
    weight: Option<&dyn Field>,
    budget: Budget,
    begins: &dyn Fn(Part),
) -> Result<Extracted, ShrinkError> {
    let told = Told { settings: *sampler.settings(), fraction: AtomicU32::new(0) };
    let (mut depth, mut mended) = (0, None);
    begins(Part::Shrink);
    if spec.method == Method::Adaptive {
        told.tell(0, 0.0, 0.0, Progress { stage: "topology", ..Progress::default() });
        mended = study(sampler, spec, depth)?;
    }
    let spent = || sampler.tally().total().total();
    let (mut effort, mut costliest, mut made) = (Effort::default(), 0, 0);
    let mut best: Option<(Surface, Report)> = None;
    let (mut refusal, mut nothing) = (None, ShrinkError::Unmapped);
    for attempt in 0..budget.attempts(spec.method) {
        let before = spent();
        if attempt > 0 && !budget.allows(before, costliest) {
            break;
        }
        if attempt > 0 {
            begins(Part::Shrink);
        }
        // what went wrong may be a handle or a gap narrower than the first look's lattice
        if attempt > 0 && mended.is_some() && depth < DEEPEST {
            depth += 1;
            mended = study(sampler, spec, depth)?;
        }
        (effort.attempt, made) = (attempt, attempt + 1);
        let (start, end) = (ENDS[attempt as usize], ENDS[attempt as usize + 1]);
        let measured_from = start + SHRINKING * (end - start);
        let progress = |progress: Progress| told.tell(attempt, start, measured_from, progress);
        let settings = Settings { progress: &progress, ..told.settings };
        let field = field_of(sampler, mended.as_ref());
        let wrap = match shrink(&Sampler::new(field, settings, sampler.tally()), spec, weight, &effort) {
            Ok(wrap) => wrap,
            // a handle that the first look missed; plugs that a finer look finds may close it
            Err(error @ (ShrinkError::Genus { .. } | ShrinkError::Components { .. }))
                if spec.on_topology == OnTopology::Wrap && depth < DEEPEST =>
            {
                costliest = costliest.max(spent() - before);
                nothing = error;
                continue;
            }
            // more effort may find a map
            Err(error @ ShrinkError::Unmapped) => {
                costliest = costliest.max(spent() - before);
                nothing = error;
                continue;
            }
            Err(error) if best.is_none() || matches!(error, ShrinkError::Canceled(_)) => return Err(error),
            Err(error) => {
                refusal = Some(error);
                break;
            }
        };
        let mut wrap = wrap;
        // what the certificate finds folded or crossing is first repaired where it is
        let (mut least, mut vain) = (u64::MAX, 0);
        for repair in 0.. {
            begins(Part::Measure);
            told.tell(attempt, measured_from, end, Progress { stage: "measure", ..Progress::default() });
            let quiet = Sampler::new(field, told.settings, sampler.tally());
            let surface = Surface::new(wrap.clone());
            let mut report = measure(&surface, &quiet, &sampler.tally().by_stage(), spec)?;
            if let Some(study) = &mended {
                let invented_area = invented(&surface, study, sampler)?;
                report.topology = Some(Topology { invented_area, ..study.topology.clone() });
            }
            let (passed, places) = (report.verdict.passed, report.verdict.places());
            let local = report.flips.surface + report.self_intersections;
            vain = if local < least { 0 } else { vain + 1 };
            least = least.min(local);
            // of equals the later one: it was made with more effort
            if passed || best.as_ref().is_none_or(|(_, other)| rank(&report) <= rank(other)) {
                best = Some((surface, report));
            }
            let enough = repair >= REPAIRS && (local > FEW || repair == MOST_REPAIRS || vain == VAIN);
            if passed || local == 0 || enough || spec.method == Method::Paper {
                effort.places.extend(places);
                break;
            }
            begins(Part::Shrink);
            mend(&quiet, &mut wrap, &places, 1 + repair)?;
        }
        costliest = costliest.max(spent() - before);
        if best.as_ref().is_some_and(|(_, report)| report.verdict.passed) {
            break;
        }
    }
    let Some((mut surface, mut report)) = best else { return Err(nothing) };
    if spec.relax_uv {
        begins(Part::Shrink);
        let progress = |progress: Progress| told.tell(made - 1, RELAXING, 1.0, progress);
        surface.relax_uv(spec.distortion, &Settings { progress: &progress, ..told.settings })?;
        begins(Part::Measure);
        report.measure_chart(&surface);
    }
    report.attempts = made;
    report.evaluations = Evaluations::new(&sampler.tally().by_stage(), report.vertices);
    if let Some(error) = &refusal {
        report.verdict.fail(error.code(), error.to_string(), &error.places());
    }
    Ok(Extracted { surface, report, refusal })
}

/// The field to wrap: as it is, or mended.
fn field_of<'s, 'a: 's>(sampler: &Sampler<'a>, study: Option<&'s Study<'a>>) -> &'s dyn Field {
    match study.and_then(|study| study.field.as_ref()) {
        Some(field) => field,
        None => sampler.field(),
    }
}

/// Share of the area of triangles whose middle is on what was invented, not on the zero level set.
fn invented(surface: &Surface, study: &Study<'_>, sampler: &Sampler<'_>) -> Result<f64, Canceled> {
    let Some(field) = &study.field else { return Ok(0.0) };
    let corner = |v: u32| Vec3::from(surface.positions[v as usize]).as_dvec3();
    let middles: Vec<DVec3> =
        surface.triangles.iter().map(|t| t.iter().map(|&v| corner(v)).sum::<DVec3>() / 3.0).collect();
    let own = Tally::new();
    let values = Sampler::new(sampler.field(), *sampler.settings(), &own).values(&middles)?;
    let (mut all, mut invented) = (0.0, 0.0);
    for (t, is) in surface.triangles.iter().zip(field.invents(&middles, &values)) {
        let [a, b, c] = t.map(corner);
        let area = (b - a).cross(c - a).length();
        all += area;
        invented += if is { area } else { 0.0 };
    }
    Ok(if all > 0.0 { invented / all } else { 0.0 })
}

/// How bad a result is: first whether it is a sphere at all, then by the number of its faults, then by its distance.
fn rank(report: &Report) -> (bool, u64, OrderedDistance) {
    let whole = report.closed && report.euler == 2 && report.charts == 1;
    let flips = report.flips;
    let faults = flips.surface + flips.sphere + flips.uv + report.self_intersections;
    (!whole, faults, OrderedDistance(report.closeness.distance.max))
}

/// A distance by its total order.
#[derive(PartialEq)]
struct OrderedDistance(f64);

impl PartialOrd for OrderedDistance {
    fn partial_cmp(&self, other: &Self) -> Option<std::cmp::Ordering> {
        Some(self.0.total_cmp(&other.0))
    }
}

/// Passes progress on as that of the whole, never falling.
struct Told<'a> {
    settings: Settings<'a>,
    /// Bits of the largest fraction told; those of numbers that are not negative have their order.
    fraction: AtomicU32,
}

impl Told<'_> {
    fn tell(&self, attempt: u32, start: f32, end: f32, progress: Progress) {
        let here = (start + (end - start) * progress.fraction.clamp(0.0, 1.0)).max(0.0);
        let before = f32::from_bits(self.fraction.fetch_max(here.to_bits(), Ordering::Relaxed));
        (self.settings.progress)(Progress { attempt: attempt + 1, fraction: here.max(before), ..progress });
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::field::sampler::Tally;
    use crate::field::scene::Scene;
    use crate::field::{Domain, Field, Gradients, Metric, Points};
    use crate::measure::fixtures::with_settings;
    use crate::settings::CancelToken;
    use crate::shrink::lattice::LatticeSpec;
    use serde_json::json;
    use std::sync::Mutex;

    fn scene(value: serde_json::Value) -> Scene {
        Scene::from_value(&value).expect("a scene")
    }

    fn spec(lattice: LatticeSpec) -> ShrinkSpec {
        ShrinkSpec { lattice, ..ShrinkSpec::default() }
    }

    /// A field whose gradients point inward: whatever is made of it, no triangle agrees with them.
    struct Contrary(Scene);

    impl Field for Contrary {
        fn domain(&self) -> Domain {
            self.0.domain()
        }
        fn metric(&self) -> Metric {
            self.0.metric()
        }
        fn lipschitz(&self) -> Option<f32> {
            self.0.lipschitz()
        }
        fn values(&self, points: Points<'_>, values: &mut [f32]) {
            self.0.values(points, values);
        }
        fn gradients(&self, points: Points<'_>, values: &mut [f32], gradients: Gradients<'_>) {
            let Gradients { x, y, z } = gradients;
            self.0.gradients(points, values, Gradients { x: &mut *x, y: &mut *y, z: &mut *z });
            for g in x.iter_mut().chain(y).chain(z) {
                *g = -*g;
            }
        }
    }

    fn hopeless() -> (Contrary, ShrinkSpec) {
        let ball = scene(json!({"sphere": {"radius": 0.6}}));
        (Contrary(ball), spec(LatticeSpec::Octahedral { n: 6 }))
    }

    /// Runs and returns what was told besides.
    fn run(
        field: &dyn Field,
        spec: &ShrinkSpec,
        budget: Budget,
    ) -> (Result<Extracted, ShrinkError>, Vec<Progress>, Vec<Part>, u64) {
        let (news, parts) = (Mutex::new(Vec::new()), Mutex::new(Vec::new()));
        with_settings(2, |settings| {
            let progress = |p: Progress| news.lock().expect("no panic").push(p);
            let tally = Tally::new();
            let settings = Settings { progress: &progress, ..*settings };
            let sampler = Sampler::new(field, settings, &tally);
            let made = extract(&sampler, spec, None, budget, &|part| parts.lock().expect("no panic").push(part));
            let (news, parts) = (news.lock().expect("no panic").clone(), parts.lock().expect("no panic").clone());
            (made, news, parts, tally.total().total())
        })
    }

    #[test]
    fn a_good_shape_takes_one_attempt() {
        let field = scene(json!({"ellipsoid": {"radii": [0.6, 0.5, 0.4]}}));
        let (made, news, parts, spent) = run(&field, &spec(LatticeSpec::Octahedral { n: 24 }), Budget::default());
        let made = made.expect("a surface");
        assert!(made.report.verdict.passed, "{:?}", made.report.verdict);
        assert_eq!((made.report.attempts, parts), (1, vec![Part::Shrink, Part::Measure]));
        assert_eq!(made.report.evaluations.value + made.report.evaluations.gradient, spent);
        assert!(news.iter().all(|p| p.attempt == 1));
        let energies = news.iter().filter(|p| p.stage == "resample").filter_map(|p| p.energy);
        assert!(energies.clone().count() > 0 && energies.into_iter().all(f64::is_finite), "the map's energy is told");
        let stages = &made.report.evaluations.by_stage;
        assert!(stages["resample"].gradient > 0 && !stages.contains_key("map"), "{stages:?}");
    }

    #[test]
    fn what_does_not_pass_is_tried_again_and_the_best_is_kept_with_its_faults() {
        let (field, spec) = hopeless();
        let (made, news, parts, spent) = run(&field, &spec, Budget::default());
        let made = made.expect("a surface");
        let verdict = &made.report.verdict;
        assert!(!verdict.passed && !verdict.faults.is_empty());
        assert!(verdict.faults.iter().any(|f| !f.places.is_empty()), "it says where: {verdict:?}");
        assert_eq!(made.report.attempts, Effort::ATTEMPTS);
        // folded triangles are first repaired where they are
        let repairs = parts.len() / 2 - Effort::ATTEMPTS as usize;
        let bounds = [REPAIRS, MOST_REPAIRS].map(|each| (each * Effort::ATTEMPTS) as usize);
        assert!((bounds[0]..=bounds[1]).contains(&repairs), "{repairs} repairs");
        let counted = made.report.evaluations.value + made.report.evaluations.gradient;
        assert_eq!(counted, spent, "the evaluations of all attempts are counted");
        assert!(news.windows(2).all(|w| w[0].fraction <= w[1].fraction), "progress never falls");
        let attempts: Vec<u32> = news.iter().map(|p| p.attempt).collect();
        assert!(attempts.is_sorted() && attempts.last() == Some(&Effort::ATTEMPTS), "{attempts:?}");
    }

    #[test]
    fn a_budget_limits_the_attempts() {
        let (field, spec) = hopeless();
        let attempts = |budget| run(&field, &spec, budget).0.expect("a surface").report.attempts;
        assert_eq!(attempts(Budget { attempts: Some(2), evaluations: None }), 2);
        assert_eq!(attempts(Budget { attempts: None, evaluations: Some(1) }), 1, "the first one is always made");
        let paper = ShrinkSpec { method: Method::Paper, ..spec.clone() };
        assert_eq!(run(&field, &paper, Budget::default()).0.expect("a surface").report.attempts, 1);
    }

    #[test]
    fn a_raised_token_ends_it_in_any_part() {
        let (field, spec) = hopeless();
        for stop_at in 1..=3 {
            let cancel = CancelToken::new();
            let begun = Mutex::new(0);
            with_settings(1, |settings| {
                let tally = Tally::new();
                let settings = Settings { cancel: &cancel, ..*settings };
                let begins = |_: Part| {
                    let mut begun = begun.lock().expect("no panic");
                    *begun += 1;
                    if *begun == stop_at {
                        cancel.cancel();
                    }
                };
                let made = extract(&Sampler::new(&field, settings, &tally), &spec, None, Budget::default(), &begins);
                assert!(matches!(made, Err(ShrinkError::Canceled(_))), "stopped at part {stop_at}");
            });
        }
    }
}
