//! The verdict: whether a result succeeds, and if not, what is wrong with it and where.
//!
//! A fault makes a result fail. A warning says that a figure is outside its bar for a reason that lies in the request.

use super::certificate::{Certificate, Topology};
use super::distance::Comparison;
use super::report::{Flips, MAX_DISTANCE};
use glam::DVec3;

/// A lattice of fewer vertices has edges of more than about 2 % of a round shape's diagonal, so that what is as small as
/// [`MAX_DISTANCE`] falls between them: it is warned where it misses that bar by no more than such an [`edge`].
pub const FINE_ENOUGH: u64 = 2_000;

/// Edge of `vertices` vertices spread evenly over a ball, in parts of the diagonal of its bounding box: every vertex has the
/// area of two equilateral triangles, sqrt(3)/2 e^2 = 4 pi r^2 / vertices, and the diagonal is 2 sqrt(3) r.
pub fn edge(vertices: u64) -> f64 {
    (4.0 * std::f64::consts::PI / (0.5 * 3f64.sqrt() * vertices.max(1) as f64)).sqrt() / 12f64.sqrt()
}

/// What is wrong with a result, or worth knowing about it.
#[derive(Clone, Debug, Default, PartialEq, serde::Serialize, serde::Deserialize, utoipa::ToSchema)]
pub struct Finding {
    /// Stable name: `not_closed`, `euler`, `charts`, `folded`, `sphere_turned`, `chart_turned`, `self_intersections`,
    /// `distance`; or the code of the problem that a closer look at the shape ended in, such as `genus`.
    pub code: String,
    /// A sentence for a person.
    pub detail: String,
    /// Scene positions where it was found; at most 16 of each kind.
    pub places: Vec<[f64; 3]>,
}

/// Whether a result succeeds.
#[derive(Clone, Debug, Default, PartialEq, serde::Serialize, serde::Deserialize, utoipa::ToSchema)]
pub struct Verdict {
    /// Whether there is no fault.
    pub passed: bool,
    /// Conditions that do not hold.
    pub faults: Vec<Finding>,
    /// Conditions that this lattice cannot be held to, and does not meet.
    pub warnings: Vec<Finding>,
}

impl Verdict {
    /// Adds a fault.
    pub fn fail(&mut self, code: &str, detail: String, places: &[DVec3]) {
        self.faults.push(finding(code, detail, places));
        self.passed = false;
    }

    /// Every place where something is wrong, in scene units.
    pub fn places(&self) -> Vec<DVec3> {
        self.faults.iter().flat_map(|fault| &fault.places).map(|&p| DVec3::from(p)).collect()
    }

    /// The faults in one sentence.
    pub fn summary(&self) -> String {
        let faults: Vec<&str> = self.faults.iter().map(|fault| fault.detail.as_str()).collect();
        faults.join("; ")
    }
}

fn finding(code: &str, detail: String, places: &[DVec3]) -> Finding {
    Finding { code: code.to_owned(), detail, places: places.iter().map(DVec3::to_array).collect() }
}

/// The figures that a surface is judged by.
#[derive(Clone, Copy, Debug)]
pub struct Figures {
    /// Whether it is closed, and its Euler number.
    pub topology: Topology,
    /// Charts.
    pub charts: u64,
    /// Folded triangles.
    pub flips: Flips,
    /// Pairs of triangles that intersect.
    pub self_intersections: u64,
    /// Largest distance both ways, in parts of the diagonal.
    pub max_distance: f64,
}

impl Figures {
    /// Those of a surface with nothing wrong.
    pub const SOUND: Self = Self {
        topology: Topology { closed: true, euler: 2, components: 1 },
        charts: 1,
        flips: Flips { surface: 0, sphere: 0, uv: 0 },
        self_intersections: 0,
        max_distance: 0.0,
    };

    /// The conditions of success that do not hold, by code and sentence: closed, Euler 2, one chart, no flip of any kind, no
    /// self-intersection, and nowhere farther than [`MAX_DISTANCE`] of the diagonal from the truth, both ways.
    pub fn misses(&self) -> Vec<(&'static str, String)> {
        let Self { topology: Topology { closed, euler, .. }, charts, self_intersections: pairs, .. } = *self;
        let Flips { surface, sphere, uv } = self.flips;
        let far = too_far(self.max_distance);
        [
            (closed, "not_closed", "the surface is not closed".to_owned()),
            (euler == 2, "euler", format!("the Euler number is {euler} instead of 2")),
            (charts == 1, "charts", format!("there are {charts} charts instead of 1")),
            (surface == 0, "folded", format!("{surface} triangles are folded over on the surface")),
            (sphere == 0, "sphere_turned", format!("{sphere} triangles are turned over on the sphere")),
            (uv == 0, "chart_turned", format!("{uv} triangles are turned over in the chart")),
            (pairs == 0, "self_intersections", format!("{pairs} pairs of triangles intersect")),
            (far.is_none(), "distance", far.unwrap_or_default()),
        ]
        .into_iter()
        .filter_map(|(holds, code, detail)| (!holds).then_some((code, detail)))
        .collect()
    }
}

/// What is said of a largest distance over [`MAX_DISTANCE`].
pub fn too_far(max: f64) -> Option<String> {
    // written so that NaN is a miss
    let near = matches!(max.partial_cmp(&MAX_DISTANCE), Some(std::cmp::Ordering::Less | std::cmp::Ordering::Equal));
    let (found, bar) = (100.0 * max, 100.0 * MAX_DISTANCE);
    (!near).then(|| format!("the largest distance is {found:.3} % of the diagonal, over {bar} %"))
}

/// Judges a surface of so many vertices by [`Figures::misses`]. One that is too coarse for the bar of distances is warned.
pub fn judge(certificate: &Certificate, comparison: &Comparison, vertices: u64) -> Verdict {
    let mut verdict = Verdict { passed: true, ..Verdict::default() };
    let max = comparison.closeness.distance.max;
    let figures = Figures {
        topology: certificate.topology,
        charts: certificate.charts,
        flips: certificate.flips,
        self_intersections: certificate.self_intersections,
        max_distance: max,
    };
    for (code, detail) in figures.misses() {
        let places: &[DVec3] = match code {
            "folded" => &certificate.flip_places,
            "self_intersections" => &certificate.intersection_places,
            "distance" => &comparison.far,
            _ => &[],
        };
        if code == "distance" && vertices < FINE_ENOUGH && max <= edge(vertices) {
            let detail = format!("{detail}, which a lattice of {vertices} vertices is not held to");
            verdict.warnings.push(finding(code, detail, places));
        } else {
            verdict.fail(code, detail, places);
        }
    }
    verdict
}

#[cfg(test)]
mod tests {
    use super::super::report::{Closeness, Distance};
    use super::*;

    fn sound() -> Certificate {
        Certificate {
            topology: Topology { closed: true, euler: 2, components: 1 },
            charts: 1,
            ..Certificate::default()
        }
    }

    fn at_distance(max: f64) -> Comparison {
        let far = if max > MAX_DISTANCE { vec![DVec3::X] } else { Vec::new() };
        let closeness = Closeness { distance: Distance { max, ..Distance::default() }, ..Closeness::default() };
        Comparison { closeness, far, ..Comparison::default() }
    }

    #[test]
    fn a_sound_result_passes_without_a_word() {
        let verdict = judge(&sound(), &at_distance(0.01), 20_000);
        assert_eq!(verdict, Verdict { passed: true, ..Verdict::default() });
    }

    #[test]
    fn every_fault_has_a_code_a_sentence_and_its_places() {
        let folded = Certificate {
            flips: Flips { surface: 2, ..Flips::default() },
            flip_places: vec![DVec3::Y, DVec3::Z],
            charts: 2,
            ..sound()
        };
        let verdict = judge(&folded, &at_distance(f64::NAN), 20_000);
        let codes: Vec<&str> = verdict.faults.iter().map(|f| f.code.as_str()).collect();
        assert_eq!(codes, ["charts", "folded", "distance"]);
        assert!(!verdict.passed);
        assert_eq!(verdict.places(), [DVec3::Y, DVec3::Z]);
        assert!(verdict.summary().contains("2 triangles are folded over"));
    }

    #[test]
    fn a_lattice_too_coarse_for_the_bar_is_warned_and_one_that_folds_still_fails() {
        assert!((edge(FINE_ENOUGH) - 0.0246).abs() < 1e-4);
        let coarse = judge(&sound(), &at_distance(0.02), FINE_ENOUGH - 1);
        assert!(coarse.passed && coarse.warnings.len() == 1, "{coarse:?}");
        assert!(!judge(&sound(), &at_distance(0.03), FINE_ENOUGH - 1).passed, "an edge is the end of it");
        assert!(!judge(&sound(), &at_distance(0.02), FINE_ENOUGH).passed);
        let folded = Certificate { flips: Flips { uv: 1, ..Flips::default() }, ..sound() };
        assert!(!judge(&folded, &at_distance(0.0), 26).passed);
    }
}
