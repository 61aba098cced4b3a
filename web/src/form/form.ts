/** The form of a new job. While it is filled in, the service says what the job may cost, or what is wrong with it. */

import { estimate, problemOf, Refusal, submitJob } from "../api/client";
import type { Job, JobRequest } from "../api/types";
import { announce, el, fill } from "../dom";
import { bytes, count } from "../format";
import { codePanel } from "../job/code";
import { problemBox } from "../job/problem";
import type { Lattice } from "../view/lattice";
import { FieldChooser } from "./field";
import { Options } from "./options";

/** A request, and the name of the file that its input was. */
interface Made {
  request: JobRequest;
  file: string | null;
}

/** Milliseconds without a change before the service is asked. */
const PAUSE = 500;

export class JobForm {
  readonly element: HTMLElement;
  private readonly field = new FieldChooser(() => this.changed());
  private readonly options = new Options(() => this.changed());
  private readonly cost = el("p", { class: "cost hint" });
  private readonly problem = el("div", {});
  private readonly code = codePanel(() => this.recipe());
  private readonly start = el("button", { type: "submit", class: "primary" }, "Shrink a sphere onto it");
  private timer = 0;
  private asking: AbortController | null = null;

  constructor(private readonly submitted: (job: Job) => void, private readonly latticeChanged: (lattice: Lattice) => void) {
    this.element = el(
      "form",
      {
        class: "job-form",
        novalidate: true,
        onsubmit: (event: Event) => {
          event.preventDefault();
          void this.submit();
        },
      },
      this.field.element,
      this.options.element,
      this.cost,
      this.problem,
      this.start,
      this.code.element,
    );
    this.changed();
  }

  /** The request and its file, or a sentence that says what is missing. */
  private request(): Made | string {
    const chosen = this.field.chosen();
    if (typeof chosen === "string") return chosen;
    const request: JobRequest = { field: chosen.field };
    const shrink = this.options.shrink();
    if (shrink) request.shrink = shrink;
    request.outputs = chosen.planar ? ["glb", "svg", "preview", "report"] : ["glb", "surface", "preview", "report"];
    request.labels = { name: chosen.name.slice(0, 60) };
    return { request, file: chosen.file };
  }

  private recipe(): Made | null {
    const made = this.request();
    return typeof made === "string" ? null : made;
  }

  private changed(): void {
    fill(this.problem);
    this.code.refresh();
    this.latticeChanged(this.options.lattice);
    clearTimeout(this.timer);
    this.timer = window.setTimeout(() => void this.check(), PAUSE);
  }

  private async check(): Promise<void> {
    const made = this.request();
    this.asking?.abort();
    if (typeof made === "string") {
      this.cost.textContent = made;
      return;
    }
    const asking = (this.asking = new AbortController());
    try {
      const { vertices, evaluations, memory_bytes } = await estimate(made.request, asking.signal);
      if (asking.signal.aborted) return;
      this.field.setFaults([]);
      this.cost.textContent = `${count(vertices)} vertices, about ${count(Number(evaluations.toPrecision(2)))} evaluations of the field, at most ${bytes(memory_bytes)} of memory`;
    } catch (error) {
      if (asking.signal.aborted) return;
      const problem = problemOf(error);
      this.field.setFaults(problem.errors ?? []);
      this.cost.textContent = `${problem.title.charAt(0).toUpperCase()}${problem.title.slice(1)}: ${problem.errors?.map((fault) => fault.detail).join("; ") || problem.detail}`;
    }
  }

  private async submit(): Promise<void> {
    const made = this.request();
    if (typeof made === "string") {
      fill(this.problem, problemBox({ title: "the job is not complete", detail: made, code: "page" }));
      return;
    }
    this.start.disabled = true;
    fill(this.problem);
    try {
      const job = await submitJob(made.request);
      announce("The job was submitted");
      this.submitted(job);
    } catch (error) {
      const problem = problemOf(error);
      if (error instanceof Refusal) this.field.setFaults(problem.errors ?? []);
      fill(this.problem, problemBox(problem));
    } finally {
      this.start.disabled = false;
    }
  }
}
