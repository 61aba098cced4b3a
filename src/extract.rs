//! From a field to a surface that is certified: shrinks, measures, and tries again with more effort where the result does not
//! pass, telling the next attempt where the last ones went wrong.
//!
//! Guarantees: the first attempt that passes is the result; when none does, the best one is, with a verdict that says what is
//! wrong and where. Only its chart is relaxed, where that is asked for. Every evaluation of every attempt is counted into the sampler's tally; those of measuring are not. Like
//! the rooms it stands on, it knows no clock: a caller who has one is told when a [`Part`] begins.
//!
//! A warm start, where one is given, comes before the attempts: what it makes has to pass the same certificate, or the attempts
//! follow as if it had not been tried.

pub mod path;

use crate::field::sampler::Tally;
use crate::field::{Field, Sampler};
use crate::measure::moved::moved;
use crate::measure::report::{Evaluations, Report, WarmStart, measure};
use crate::settings::{Canceled, Progress, Settings};
use crate::shrink::lattice::SphereLattice;
use crate::shrink::study::{DEEPEST, Study, Topology, study};
use crate::shrink::warm::{Earlier, warm};
use crate::shrink::{Effort, Method, OnTopology, ShrinkError, ShrinkSpec, Wrap, mend, shrink};
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

/// Where the share of every attempt in the progress ends, a warm start being the first where there is one. The first one
/// mostly is the last.
const ENDS: [f32; 2 + Effort::ATTEMPTS as usize] = [0.0, 0.85, 0.93, 0.97, 1.0];
/// Where relaxing the chart of the surface that was chosen starts.
const RELAXING: f32 = 0.95;
/// Repairs of one attempt's surface, each followed by a measurement, ...
const REPAIRS: u32 = 2;
/// ... and further ones while no more than this is left to repair, ...
const FEW: u64 = 60;
/// ... at most so many, ...
const MOST_REPAIRS: u32 = 10;
/// ... of which so many in a row may bring nothing.
const VAIN: u32 = 4;
/// Share of an attempt's time that shrinking takes; measuring takes the rest.
const SHRINKING: f32 = 0.8;

/// Makes a certified surface of the sampler's field, or the best there is. `weight` is what [`shrink`] takes. From an
/// `earlier` surface on the lattice of the spec a warm start is made first, and is the result if it passes; it is not among the
/// attempts of the budget.
///
/// # Errors
/// [`ShrinkError`] when the token was raised, or when no attempt gave a surface.
///
/// # Panics
/// When the earlier surface is on another lattice.
pub fn extract(
    sampler: &Sampler<'_>,
    spec: &ShrinkSpec,
    weight: Option<&dyn Field>,
    budget: Budget,
    earlier: Option<&Earlier>,
    begins: &dyn Fn(Part),
) -> Result<Extracted, ShrinkError> {
    let told = Told { settings: *sampler.settings(), fraction: AtomicU32::new(0) };
    let run = Run { sampler, spec, told: &told, begins };
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
    let mut cooled = None;
    if let Some(earlier) = earlier {
        made = 1;
        match run.warm(earlier, mended.as_ref())? {
            Ok(passed) => best = Some(passed),
            Err(reason) => cooled = Some(reason),
        }
    }
    let warmed = best.is_some();
    let attempts = if warmed { 0 } else { budget.attempts(spec.method) };
    for attempt in 0..attempts {
        let before = spent();
        if attempt > 0 && !budget.allows(before, costliest) {
            break;
        }
        if made > 0 {
            begins(Part::Shrink);
        }
        // what went wrong may be a handle or a gap narrower than the first look's lattice
        if attempt > 0 && mended.is_some() && depth < DEEPEST {
            depth += 1;
            mended = study(sampler, spec, depth)?;
        }
        let turn = Turn { index: made };
        (effort.attempt, made) = (attempt, made + 1);
        let progress = |progress: Progress| turn.shrinking(&told, progress);
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
        effort.places.extend(run.certified(wrap, mended.as_ref(), turn, &mut best)?);
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
    if let Some(earlier) = earlier {
        let moved = moved(&earlier.positions, &surface, &told.settings)?;
        report.warm_start = Some(WarmStart { used: warmed, reason: cooled, moved });
    }
    report.attempts = made;
    report.evaluations = Evaluations::new(&sampler.tally().by_stage(), report.vertices);
    if let Some(error) = &refusal {
        report.verdict.fail(error.code(), error.to_string(), &error.places());
    }
    Ok(Extracted { surface, report, refusal })
}

/// A surface that passed its certificate, or why there is none.
type Passed = Result<(Surface, Report), String>;

/// Makes a surface of the sampler's field by a warm start from an `earlier` one and by nothing else. `spec` is what the earlier
/// one was made by; its lattice is taken, and what it says of components and handles.
///
/// # Errors
/// [`ShrinkError`] when the token was raised, or when the shape has not the component that is asked for.
///
/// # Panics
/// When the earlier surface is on another lattice.
fn warmed(sampler: &Sampler<'_>, spec: &ShrinkSpec, earlier: &Earlier) -> Result<Passed, ShrinkError> {
    let told = Told { settings: *sampler.settings(), fraction: AtomicU32::new(0) };
    let mended = study(sampler, spec, 0)?;
    Ok(Run { sampler, spec, told: &told, begins: &|_| {} }.warm(earlier, mended.as_ref())?)
}

/// A `surface` of the sampler's field with other `diagonals`, measured, and repaired where that folds it or lets it cross.
///
/// # Errors
/// [`ShrinkError`] when the token was raised, or when the shape has not the component that is asked for.
fn relaid(
    sampler: &Sampler<'_>,
    spec: &ShrinkSpec,
    surface: &Surface,
    diagonals: &[bool],
) -> Result<(Surface, Report), ShrinkError> {
    let told = Told { settings: *sampler.settings(), fraction: AtomicU32::new(0) };
    let mended = study(sampler, spec, 0)?;
    let Earlier { lattice, positions, normals, .. } = surface.earlier();
    let wrap = Wrap {
        lattice: SphereLattice { free: vec![false; lattice.quads.len()], ..lattice },
        positions,
        values: surface.values.iter().map(|&value| value.into()).collect(),
        gradients: normals.iter().zip(&surface.gradient_norms).map(|(n, &length)| *n * f64::from(length)).collect(),
        diagonals: diagonals.to_vec(),
    };
    let mut best = None;
    let run = Run { sampler, spec, told: &told, begins: &|_| {} };
    run.certified(wrap, mended.as_ref(), Turn { index: 0 }, &mut best)?;
    Ok(best.expect("one surface at least was measured"))
}

/// What all attempts of an extraction share.
struct Run<'r, 'a> {
    sampler: &'r Sampler<'a>,
    spec: &'r ShrinkSpec,
    told: &'r Told<'r>,
    begins: &'r dyn Fn(Part),
}

/// The place of an attempt among all, a warm start included, from 0.
#[derive(Clone, Copy)]
struct Turn {
    index: u32,
}

impl Turn {
    /// Where its share of the progress starts, where measuring begins, and where it ends.
    fn share(self) -> [f32; 3] {
        let (start, end) = (ENDS[self.index as usize], ENDS[self.index as usize + 1]);
        [start, start + SHRINKING * (end - start), end]
    }
    fn shrinking(self, told: &Told<'_>, progress: Progress) {
        let [start, measured_from, _] = self.share();
        told.tell(self.index, start, measured_from, progress);
    }
    fn measuring(self, told: &Told<'_>) {
        let [_, measured_from, end] = self.share();
        told.tell(self.index, measured_from, end, Progress { stage: "measure", ..Progress::default() });
    }
}

impl Run<'_, '_> {
    /// The surface that a warm start makes.
    fn warm(&self, earlier: &Earlier, mended: Option<&Study<'_>>) -> Result<Passed, Canceled> {
        assert_eq!(earlier.lattice.spec, self.spec.lattice, "a warm start keeps the lattice");
        let turn = Turn { index: 0 };
        let progress = |progress: Progress| turn.shrinking(self.told, progress);
        let settings = Settings { progress: &progress, ..self.told.settings };
        let field = field_of(self.sampler, mended);
        let Some(wrap) = warm(&Sampler::new(field, settings, self.sampler.tally()), earlier)? else {
            return Ok(Err("too much of the earlier surface folds over on the way".to_owned()));
        };
        let mut best = None;
        self.certified(wrap, mended, turn, &mut best)?;
        let (surface, report) = best.expect("one surface at least was measured");
        Ok(if report.verdict.passed { Ok((surface, report)) } else { Err(report.verdict.summary()) })
    }

    /// Measures a wrap; what the certificate finds folded or crossing is first repaired where it is, and measured again.
    /// Every surface is held against the best one. Returns the places where the last one was found wanting.
    fn certified(
        &self,
        mut wrap: Wrap,
        mended: Option<&Study<'_>>,
        turn: Turn,
        best: &mut Option<(Surface, Report)>,
    ) -> Result<Vec<DVec3>, Canceled> {
        let tally = self.sampler.tally();
        let quiet = Sampler::new(field_of(self.sampler, mended), self.told.settings, tally);
        let (mut least, mut vain) = (u64::MAX, 0);
        for repair in 0.. {
            (self.begins)(Part::Measure);
            turn.measuring(self.told);
            let surface = Surface::new(wrap.clone());
            let mut report = measure(&surface, &quiet, &tally.by_stage(), self.spec)?;
            if let Some(study) = mended {
                let invented_area = invented(&surface, study, self.sampler)?;
                report.topology = Some(Topology { invented_area, ..study.topology.clone() });
            }
            let (passed, places) = (report.verdict.passed, report.verdict.places());
            let local = report.flips.surface + report.self_intersections;
            vain = if local < least { 0 } else { vain + 1 };
            least = least.min(local);
            // of equals the later one: it was made with more effort
            if passed || best.as_ref().is_none_or(|(_, other)| rank(&report) <= rank(other)) {
                *best = Some((surface, report));
            }
            let enough = repair >= REPAIRS && (local > FEW || repair == MOST_REPAIRS || vain == VAIN);
            if passed || local == 0 || enough || self.spec.method == Method::Paper {
                return Ok(places);
            }
            (self.begins)(Part::Shrink);
            mend(&quiet, &mut wrap, &places, 1 + repair)?;
        }
        unreachable!("the last repair returns")
    }
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
            let made = extract(&sampler, spec, None, budget, None, &|part| parts.lock().expect("no panic").push(part));
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

    /// What becomes of a scene that begins from another one's surface.
    fn began(from: serde_json::Value, to: serde_json::Value, budget: Budget) -> Result<Extracted, ShrinkError> {
        let spec = spec(LatticeSpec::Octahedral { n: 24 });
        let earlier = run(&scene(from), &spec, Budget::default()).0.expect("a surface").surface.earlier();
        with_settings(2, |settings| {
            let (field, tally) = (scene(to), Tally::new());
            let sampler = Sampler::new(&field, *settings, &tally);
            extract(&sampler, &spec, None, budget, Some(&earlier), &|_| {})
        })
    }

    #[test]
    fn a_warm_start_that_passes_is_the_result_and_keeps_triangles_and_places() {
        let pill = |length: f64| json!({"capsule": {"from": [-length, 0, 0], "to": [length, 0, 0], "radius": 0.35}});
        let made = began(pill(0.3), pill(0.33), Budget::default()).expect("a surface");
        let report = &made.report;
        let warm_start = report.warm_start.clone().expect("it was asked for");
        assert!(report.verdict.passed && warm_start.used && warm_start.reason.is_none(), "{report:?}");
        assert_eq!(report.attempts, 1);
        assert!(report.evaluations.per_vertex < 4.0 && !report.evaluations.by_stage.contains_key("contract"));
        assert!(warm_start.moved.moved.max > 0.01 && warm_start.moved.drift.mean < 1e-3, "{warm_start:?}");
    }

    #[test]
    fn a_warm_start_that_does_not_pass_is_followed_by_the_attempts_and_says_why() {
        let (from, to) = (json!({"sphere": {"radius": 0.2}}), json!({"ellipsoid": {"radii": [0.9, 0.12, 0.12]}}));
        let far = json!({"translate": {"by": [0, 0.7, 0], "of": to}});
        let made =
            began(from.clone(), far.clone(), Budget { attempts: Some(1), evaluations: None }).expect("a surface");
        let warm_start = made.report.warm_start.expect("it was asked for");
        assert!(made.report.verdict.passed && !warm_start.used, "{warm_start:?}");
        assert!(warm_start.reason.is_some_and(|reason| !reason.is_empty()));
        assert_eq!(made.report.attempts, 2, "the warm start is none of the budget's attempts");
        assert!(made.report.evaluations.by_stage.contains_key("warm"), "what it took is counted");
        // the other ball is beyond the reach of the first one's surface, and the certificate misses it
        let two =
            json!({"union": {"of": [from, {"translate": {"by": [0.6, 0, 0], "of": {"sphere": {"radius": 0.2}}}}]}});
        let refused = began(from, two, Budget::default()).expect_err("two balls");
        assert!(matches!(refused, ShrinkError::Components { .. }), "{refused}");
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
                let made =
                    extract(&Sampler::new(&field, settings, &tally), &spec, None, Budget::default(), None, &begins);
                assert!(matches!(made, Err(ShrinkError::Canceled(_))), "stopped at part {stop_at}");
            });
        }
    }
}
