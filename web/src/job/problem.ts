/** Shows a problem as its document says it. */

import type { Problem } from "../api/types";
import { el } from "../dom";
import { fixed } from "../format";

/** The problem's box; with `alert` it is read out at once. */
export function problemBox(problem: Problem, alert = true): HTMLElement {
  const { title, detail, code, request_id, errors = [], places = [], hint } = problem;
  return el(
    "div",
    { class: "problem", role: alert ? "alert" : "group", "aria-label": alert ? null : "Problem" },
    el("p", { class: "problem-title" }, sentence(title)),
    el("p", {}, sentence(detail)),
    hint && el("p", { class: "problem-hint" }, sentence(hint)),
    errors.length > 0 &&
      el(
        "ul",
        { class: "faults" },
        ...errors.map((fault) =>
          el("li", {}, el("code", { class: "pointer" }, fault.pointer || "/"), " ", el("span", {}, fault.detail), " ", el("code", { class: "code" }, fault.code)),
        ),
      ),
    places.length > 0 &&
      el("p", { class: "places" }, places.length === 1 ? "At " : "At the places ", places.map((p) => `(${p.map((c) => fixed(c, 3)).join(", ")})`).join(", ")),
    el("p", { class: "hint" }, el("code", {}, code), request_id && [" request ", request_id].join("")),
  );
}

/** The service's sentences begin with a small letter and have no full stop. */
function sentence(text: string): string {
  return text.charAt(0).toUpperCase() + text.slice(1);
}
