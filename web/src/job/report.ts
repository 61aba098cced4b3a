/** The report for a person: the verdict, the main figures by what they tell, and all of it on request. */

import { el } from "../dom";
import { count, figure, percent, seconds } from "../format";

type Tree = Record<string, unknown>;

/** A value inside the report. */
function at(report: Tree, path: string): unknown {
  return path.split(".").reduce<unknown>((node, name) => (node as Tree | undefined)?.[name], report);
}

type Row = [label: string, path: string, show: (value: never) => string];

const yes = (value: boolean): string => (value ? "yes" : "no");
const whole = (value: number): string => count(value);
const plain = (value: number): string => figure(value);
const share = (value: number): string => percent(value);
const time = (value: number): string => seconds(value);

const GROUPS: [title: string, rows: Row[]][] = [
  [
    "Topology and folds",
    [
      ["Vertices", "vertices", whole],
      ["Triangles", "triangles", whole],
      ["Closed", "closed", yes],
      ["Euler characteristic", "euler", whole],
      ["Charts", "charts", whole],
      ["Flips on the surface", "flips.surface", whole],
      ["Flips on the sphere", "flips.sphere", whole],
      ["Flips in the chart", "flips.uv", whole],
      ["Self-intersections", "self_intersections", whole],
      ["Turning number", "turning_number", whole],
      ["Corners", "corners", whole],
    ],
  ],
  [
    "Distance, of the diagonal",
    [
      ["Mean", "distance.mean", share],
      ["Root mean square", "distance.rms", share],
      ["Largest", "distance.max", share],
      ["Normal consistency", "normal_consistency", plain],
      ["Deviation from arc length", "arc_length.deviation_max", share],
    ],
  ],
  [
    "Distortion from the sphere",
    [
      ["Stretch s1/s2", "distortion.sphere.qc", plain],
      ["Area, 1st percentile", "distortion.sphere.area_p1", plain],
      ["Area, 99th percentile", "distortion.sphere.area_p99", plain],
      ["Symmetric Dirichlet energy", "distortion.sphere.symmetric_dirichlet", plain],
      ["L2 stretch", "distortion.sphere.l2_stretch", plain],
    ],
  ],
  [
    "Distortion from the square",
    [
      ["Stretch s1/s2", "distortion.uv.qc", plain],
      ["Area, 1st percentile", "distortion.uv.area_p1", plain],
      ["Area, 99th percentile", "distortion.uv.area_p99", plain],
      ["Symmetric Dirichlet energy", "distortion.uv.symmetric_dirichlet", plain],
      ["L2 stretch", "distortion.uv.l2_stretch", plain],
    ],
  ],
  [
    "Cost",
    [
      ["Evaluations per vertex", "evaluations.per_vertex", plain],
      ["Values", "evaluations.value", whole],
      ["Values with gradient", "evaluations.gradient", whole],
      ["Attempts", "attempts", whole],
      ["Shrinking", "seconds.shrink", time],
      ["Measuring", "seconds.finish", time],
      ["Writing", "seconds.write", time],
    ],
  ],
];

/** The report's section. */
export function reportView(report: Tree): HTMLElement {
  const groups = GROUPS.map(([title, rows]) => {
    const known = rows.filter(([, path]) => at(report, path) !== undefined && at(report, path) !== null);
    return (
      known.length > 0 &&
      el(
        "table",
        {},
        el("caption", {}, title),
        el(
          "tbody",
          {},
          ...known.map(([label, path, show]) => el("tr", {}, el("th", { scope: "row" }, label), el("td", {}, show(at(report, path) as never)))),
        ),
      )
    );
  });
  const raw = el("pre", { tabindex: 0, "aria-label": "The whole report" });
  const all = el(
    "details",
    { ontoggle: () => (raw.textContent ||= JSON.stringify(report, null, 2)) },
    el("summary", {}, "The whole report"),
    raw,
  );
  return el("div", { class: "report" }, verdict(report), el("div", { class: "tables" }, ...groups), all);
}

interface Finding {
  code: string;
  detail: string;
}

function verdict(report: Tree): HTMLElement | null {
  const found = report.verdict as { passed: boolean; faults: Finding[]; warnings?: Finding[] } | undefined;
  if (!found) return null;
  const list = (findings: Finding[]): Node | false =>
    findings.length > 0 && el("ul", { class: "faults" }, ...findings.map((f) => el("li", {}, f.detail, " ", el("code", { class: "code" }, f.code))));
  return el(
    "div",
    { class: found.passed ? "verdict passed" : "verdict failed" },
    el("p", {}, found.passed ? "\u2713 It passed every check." : "\u2717 It did not pass its checks."),
    list(found.faults),
    list(found.warnings ?? []),
  );
}
