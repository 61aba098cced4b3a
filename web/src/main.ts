/** The page: a form, the job that is open, and the newest jobs. The address after `#` says which job is open. */

import { askForKey } from "./api/key";
import type { Job } from "./api/types";
import { el } from "./dom";
import { JobForm } from "./form/form";
import { JobList } from "./job/list";
import { JobView } from "./job/view";
import { themeSelect } from "./theme";
import { DEFAULT_LATTICE, type Lattice } from "./view/lattice";

let lattice: Lattice = DEFAULT_LATTICE;
/** A job that was just answered, so that it need not be read again. */
let fresh: Job | null = null;

const view: JobView = new JobView(() => void list?.refresh());
const list: JobList = new JobList(() => view.openId);
const form = new JobForm(
  (job) => {
    fresh = job;
    location.hash = `#/jobs/${job.id}`;
  },
  (chosen) => {
    if (JSON.stringify(chosen) === JSON.stringify(lattice)) return;
    lattice = chosen;
    view.lattice(chosen);
  },
);

async function route(focus: boolean): Promise<void> {
  const id = /^#\/jobs\/([^/]+)$/.exec(location.hash)?.[1];
  const job = fresh?.id === id ? fresh : null;
  fresh = null;
  if (!id) {
    view.idle(lattice);
    if (focus) view.focus();
    void list.refresh();
    return;
  }
  await view.open(job ?? decodeURIComponent(id), focus);
}

document.getElementById("app")!.replaceChildren(
  el("a", { class: "skip", href: "#job-heading", onclick: (event: Event) => (event.preventDefault(), view.focus()) }, "Skip to the surface"),
  el(
    "header",
    {},
    el("h1", {}, el("a", { href: "#/" }, "shrinkd")),
    el("p", { class: "tagline" }, "Signed distance fields in, parameterized surfaces out"),
    el(
      "div",
      { class: "tools" },
      el("a", { href: "/docs/" }, "API"),
      el(
        "button",
        { type: "button", class: "small", onclick: async () => (await askForKey("The service may ask who its callers are.")) && list.refresh() },
        "Key\u2026",
      ),
      themeSelect(),
    ),
  ),
  el(
    "main",
    {},
    el("section", { class: "new", "aria-labelledby": "new-heading" }, el("h2", { id: "new-heading" }, "New job"), form.element),
    view.element,
    list.element,
  ),
  el("div", { id: "announcements", class: "sr", "aria-live": "polite", role: "status" }),
);
addEventListener("hashchange", () => void route(true));
void route(false);
