/** One job: followed while it runs, then its result, report and downloads. */

import { cancelJob, outputAddress, outputBytes, problemOf, readJob, readRequest, submitJob } from "../api/client";
import { follow } from "../api/sse";
import { ended, type Job, type JobRequest, type MeshEvent, type Output, type Progress, type State } from "../api/types";
import { announce, el, fill } from "../dom";
import { moment, seconds } from "../format";
import { checkerPicture } from "../view/colors";
import { decodePicture, parseGlb } from "../view/glb";
import { DEFAULT_LATTICE, isOctahedral, latticeName, type Lattice } from "../view/lattice";
import { ofDiagonal } from "../view/measures";
import { floats, headerEnd, readHeader } from "../view/safetensors";
import { ball, triangleCount, type Surface } from "../view/surface";
import { Viewer, type Distances } from "../view/viewer";
import { codePanel } from "./code";
import { Figures, ranFor } from "./figures";
import { outputList } from "./outputs";
import { Player } from "./player";
import { problemBox } from "./problem";
import { reportView } from "./report";

/** Bytes of a safetensors file that nearly always hold its header. */
const HEADER = 16_384;
const FACES = "triangle_distance";

export class JobView {
  readonly element: HTMLElement;
  private readonly viewer = new Viewer();
  private readonly heading = el("h2", { id: "job-heading", tabindex: -1 });
  private readonly lead = el("p", { class: "lead" });
  private readonly head = el("div", { class: "job-head" });
  private readonly live = el("div", {});
  private readonly trouble = el("div", {});
  private readonly planar = el("figure", { class: "planar", hidden: true });
  private readonly results = el("div", { class: "results" });
  private readonly code = codePanel(() => (this.request ? { request: this.request, file: null } : null));
  private job: Job | null = null;
  private request: JobRequest | null = null;
  private opened = new AbortController();
  private addresses: string[] = [];
  /** Whether the heading is to have the focus once it says what is open. */
  private focusing = false;

  constructor(private readonly changed: () => void) {
    this.element = el(
      "section",
      { class: "job", "aria-labelledby": "job-heading" },
      this.heading,
      this.lead,
      this.head,
      this.live,
      this.trouble,
      this.viewer.element,
      this.planar,
      this.results,
      this.code.element,
    );
  }

  get openId(): string | null {
    return this.job?.id ?? null;
  }

  /** No job: the ball that everything begins with. */
  idle(lattice: Lattice): void {
    this.reset();
    this.heading.textContent = "From a sphere to a surface";
    this.lead.textContent =
      "A sphere is shrunk onto the zero level set of a signed distance field, and every point of the surface keeps its place on it: " +
      "one chart, no fold-over. This is the ball it begins with, and its UV square.";
    this.viewer.show(ball(lattice), "Ball", "is known when a job has made its surface");
  }

  /** Another ball, where no job is shown. */
  lattice(lattice: Lattice): void {
    if (!this.job) this.viewer.show(ball(lattice), "Ball", "is known when a job has made its surface", true);
  }

  /** Opens a job by its name, or as it was just answered. */
  async open(what: string | Job, focus: boolean): Promise<void> {
    this.reset();
    this.focusing = focus;
    const { signal } = this.opened;
    try {
      const job = typeof what === "string" ? await readJob(what) : what;
      if (signal.aborted) return;
      this.take(job);
      void this.showCode(job, signal);
      if (ended(job.state)) await this.result(job, signal);
      else await this.watch(job, signal);
    } catch (error) {
      if (signal.aborted) return;
      if (!this.job) {
        this.heading.textContent = "Job";
        this.viewer.element.hidden = true;
        if (this.focusing) this.focus();
      }
      fill(this.trouble, problemBox(problemOf(error)));
    }
  }

  focus(): void {
    this.heading.focus();
  }

  private reset(): void {
    this.opened.abort();
    this.opened = new AbortController();
    this.job = this.request = null;
    for (const address of this.addresses.splice(0)) URL.revokeObjectURL(address);
    for (const part of [this.head, this.live, this.trouble, this.results, this.planar]) part.replaceChildren();
    this.lead.textContent = "";
    this.planar.hidden = true;
    this.viewer.element.hidden = false;
    delete this.viewer.element.dataset.fronts;
    this.code.element.hidden = true;
  }

  /** The job's head: what it is, its state, and what can be done with it. */
  private take(job: Job): void {
    const before = this.job;
    this.job = job;
    this.heading.textContent = job.labels.name ?? `Job ${job.id.slice(0, 8)}`;
    const lattice = job.shrink ? latticeName(job.shrink.lattice) : job.kind;
    const acting = this.head.contains(document.activeElement);
    fill(
      this.head,
      badge(job.state),
      el("span", {}, lattice),
      job.shrink && el("span", {}, job.shrink.method),
      el("span", {}, `from ${moment(job.created_at)}`),
      ended(job.state) && el("span", {}, `ran ${ranFor(job)}`),
      el("code", { class: "id" }, job.id),
      el("span", { class: "spacer" }),
      !ended(job.state) && el("button", { type: "button", disabled: job.state === "canceling", onclick: () => this.act(() => cancelJob(job.id)) }, "Cancel"),
      canRetry(job) && el("button", { type: "button", onclick: () => this.retry(job) }, "Retry"),
    );
    // the button that was pressed may be gone
    if (this.focusing || acting) this.focus();
    this.focusing = false;
    if (before?.id === job.id && before.state !== job.state) announce(`The job is ${job.state}`);
    this.changed();
  }

  private async act(action: () => Promise<Job>): Promise<void> {
    try {
      const job = await action();
      // the stream may have told the end already
      if (this.job?.id === job.id && !ended(this.job.state)) this.take(job);
    } catch (error) {
      fill(this.trouble, problemBox(problemOf(error)));
    }
  }

  private async retry(job: Job): Promise<void> {
    try {
      location.hash = `#/jobs/${(await retryJob(job.id)).id}`;
    } catch (error) {
      fill(this.trouble, problemBox(problemOf(error)));
    }
  }

  /** The same job as a program, once the service has said what it was asked for. */
  private async showCode(job: Job, signal: AbortSignal): Promise<void> {
    if (job.kind === "sensitivity") return;
    const request = await readRequest(job.id).catch(() => null);
    if (signal.aborted) return;
    this.request = request;
    this.code.element.hidden = request === null;
    this.code.refresh();
  }

  private async watch(job: Job, signal: AbortSignal): Promise<void> {
    const lattice = job.shrink?.lattice ?? DEFAULT_LATTICE;
    const figures = new Figures();
    const player = new Player(this.viewer, lattice);
    signal.addEventListener("abort", () => player.stop());
    const connection = el("p", { class: "hint", role: "status" });
    fill(this.live, figures.element, connection);
    this.viewer.show(ball(lattice), "Ball", "is known when the job has made its surface");
    let last: Job | null = null;
    await follow(job.id, {
      signal,
      cut: (again) => {
        connection.textContent = again === null ? "" : `The connection was cut. It is tried again in ${seconds(again / 1000)}.`;
      },
      event: (type, data) => {
        if (signal.aborted) return;
        if (type === "progress") figures.push(data as Progress);
        else if (type === "mesh") player.push(data as MeshEvent);
        else if (type === "state") this.take({ ...this.job!, ...(data as { state: State; attempt: number }) });
        else if (type === "snapshot" || type === "done") {
          last = data as Job;
          if (last.progress && !ended(last.state)) figures.push(last.progress);
          this.take(last);
        }
      },
    });
    if (signal.aborted) return;
    const end = last !== null && ended((last as Job).state) ? (last as Job) : await readJob(job.id);
    this.take(end);
    await player.finish();
    if (!signal.aborted) await this.result(end, signal);
  }

  /** What an ended job made, and why it made no more. */
  private async result(job: Job, signal: AbortSignal): Promise<void> {
    const fronts = this.viewer.element.dataset.fronts !== undefined;
    if (job.state === "succeeded") this.live.replaceChildren();
    fill(this.trouble, job.problem && problemBox(job.problem));
    const failed = (error: unknown): void => fill(this.trouble, problemBox(problemOf(error)));
    fill(
      this.results,
      job.outputs.length > 0 && el("div", {}, el("h3", {}, "Outputs"), outputList(job, failed)),
      job.metrics && el("div", {}, el("h3", {}, "Report"), reportView(job.metrics)),
    );
    const output = (name: string): Output | undefined => job.outputs.find((one) => one.name === name);
    const glb = job.kind === "shrink" ? output("glb") : undefined;
    if (!glb) {
      // the last front stays; without one there is nothing to show
      this.viewer.element.hidden = !fronts;
      return;
    }
    const lattice = job.shrink?.lattice ?? DEFAULT_LATTICE;
    const parsed = parseGlb(await outputBytes(glb), lattice);
    if (signal.aborted) return;
    if (parsed.curve) {
      const picture = output("svg") ?? output("preview");
      this.viewer.element.hidden = true;
      if (picture) await this.showPlanar(picture, job);
      return;
    }
    const texture = parsed.picture ? await decodePicture(parsed.picture) : checkerPicture(isOctahedral(lattice));
    if (signal.aborted) return;
    const surface: Surface = { ...parsed, texture };
    const missing = output("surface") ? "is being read" : "is not among this job\u2019s outputs: it is in the output surface";
    this.viewer.show(surface, "Surface", missing, fronts);
    const file = output("surface");
    if (file) {
      const distances = await readDistances(file, surface);
      if (!signal.aborted) this.viewer.setDistances(distances);
    }
  }

  private async showPlanar(picture: Output, job: Job): Promise<void> {
    const address = await outputAddress(picture);
    if (address !== picture.href) this.addresses.push(address);
    this.planar.hidden = false;
    fill(
      this.planar,
      el("img", { src: address, alt: `The curve of ${job.labels.name ?? "the job"}, with ticks at equal steps of u` }),
      el("figcaption", {}, "The zero level set as a closed curve; ticks are at 64 equal steps of u, red at 0 and once around the colour circle."),
    );
  }
}

/** Distances of the triangles from the zero level set, in parts of the diagonal; read alone from the file. */
async function readDistances(file: Output, surface: Surface): Promise<Distances> {
  let start = await outputBytes(file, [0, Math.min(HEADER, file.bytes)]);
  const end = headerEnd(start);
  if (start.byteLength < end) start = await outputBytes(file, [0, end]);
  const tensor = readHeader(start)[FACES];
  if (!tensor) return `is not in this job\u2019s surface (it has no tensor ${FACES})`;
  const distances = floats(tensor, await outputBytes(file, tensor.range));
  if (distances.length !== triangleCount(surface)) return "is of other triangles than the GLB has";
  return ofDiagonal(distances, surface);
}

/** Whether a job came to nothing, and can be sent again: a sensitivity was asked for by a file. */
export function canRetry(job: Job): boolean {
  return (job.state === "failed" || job.state === "canceled") && job.kind !== "sensitivity";
}

/** Sends a job's request again. */
export async function retryJob(id: string): Promise<Job> {
  const job = await submitJob(await readRequest(id));
  announce("The job was submitted again");
  return job;
}

/** A state in a word and a colour. */
export function badge(state: State): HTMLElement {
  return el("span", { class: `badge ${state}` }, state);
}
