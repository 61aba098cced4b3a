/** The newest jobs with their states and small pictures, kept up to date while the page is seen. */

import { cancelJob, outputAddress, problemOf, send } from "../api/client";
import { ended, type Job } from "../api/types";
import { el, fill } from "../dom";
import { moment, percent } from "../format";
import { latticeName } from "../view/lattice";
import { problemBox } from "./problem";
import { badge, canRetry, retryJob } from "./view";

/** Jobs that are shown at first, and that are added with every press of the button below them. */
const SHOWN = 12;
/** Most that the service lists in one page. */
const MOST = 200;
const EVERY = 5000;

export class JobList {
  readonly element: HTMLElement;
  private readonly list = el("ul", { class: "jobs" });
  private readonly trouble = el("div", {});
  private readonly rows = new Map<string, { element: HTMLElement; told: string }>();
  private readonly pictures = new Map<string, string>();
  private readonly more = el("button", { type: "button", class: "small", hidden: true, onclick: () => this.showMore() }, "Show more");
  private shown = SHOWN;
  private etag: string | null = null;
  private timer = 0;
  private reading = false;

  constructor(private readonly open: () => string | null) {
    this.element = el(
      "section",
      { class: "recent", "aria-labelledby": "recent-heading" },
      el("h2", { id: "recent-heading" }, "Recent jobs"),
      this.trouble,
      this.list,
      this.more,
    );
    document.addEventListener("visibilitychange", () => !document.hidden && this.refresh());
    void this.refresh();
  }

  /** Reads the list now, and again after a while. */
  async refresh(): Promise<void> {
    clearTimeout(this.timer);
    if (this.reading) return;
    this.reading = true;
    try {
      const answer = await send(`/v1/jobs?limit=${this.shown}`, this.etag ? { headers: { "if-none-match": this.etag } } : {});
      if (answer.status !== 304) {
        this.etag = answer.headers.get("etag");
        const { jobs, next_cursor } = (await answer.json()) as { jobs: Job[]; next_cursor?: string | null };
        this.show(jobs);
        this.more.hidden = !next_cursor || this.shown >= MOST;
      }
      this.trouble.replaceChildren();
    } catch (error) {
      fill(this.trouble, problemBox(problemOf(error), false));
    } finally {
      this.reading = false;
      clearTimeout(this.timer);
      this.timer = window.setTimeout(() => !document.hidden && void this.refresh(), EVERY);
    }
  }

  private async showMore(): Promise<void> {
    const before = this.list.children.length;
    this.shown = Math.min(MOST, this.shown + SHOWN);
    this.etag = null;
    await this.refresh();
    // who came by keys goes on at the first that is new
    this.list.children[before]?.querySelector("a")?.focus();
  }

  private show(jobs: Job[]): void {
    const gone = new Set(this.rows.keys());
    const items = jobs.map((job) => {
      gone.delete(job.id);
      const told = JSON.stringify([job.state, job.progress?.stage, job.progress?.fraction, job.outputs.length, this.open() === job.id]);
      const known = this.rows.get(job.id);
      if (known?.told === told) return known.element;
      const element = this.row(job);
      // what had the focus keeps it when its row is made anew
      const focused = known?.element.contains(document.activeElement) ? document.activeElement?.textContent : null;
      this.rows.set(job.id, { element, told });
      if (focused) queueMicrotask(() => [...element.querySelectorAll<HTMLElement>("a, button")].find((one) => one.textContent === focused)?.focus());
      return element;
    });
    for (const id of gone) this.rows.delete(id);
    fill(this.list, ...(items.length > 0 ? items : [el("li", { class: "hint" }, "No jobs yet.")]));
  }

  private row(job: Job): HTMLElement {
    const name = job.labels.name ?? job.id.slice(0, 8);
    const told = !ended(job.state) && job.progress ? `${job.progress.stage} ${percent(job.progress.fraction, 2)}` : (job.problem?.title ?? "");
    const button = (text: string, action: () => Promise<unknown>): HTMLElement =>
      el("button", { type: "button", class: "small", "aria-label": `${text} ${name}`, onclick: () => this.act(action) }, text);
    return el(
      "li",
      { class: this.open() === job.id ? "open" : "" },
      this.picture(job),
      el(
        "div",
        { class: "about" },
        el("a", { href: `#/jobs/${job.id}`, "aria-current": this.open() === job.id ? "true" : null }, name),
        el("span", { class: "hint" }, moment(job.created_at), job.shrink ? ` \u00b7 ${latticeName(job.shrink.lattice)}` : ` \u00b7 ${job.kind}`),
        el("span", { class: "states" }, badge(job.state), told && el("span", { class: "hint" }, ` ${told}`)),
      ),
      el(
        "div",
        { class: "acts" },
        !ended(job.state) && button("Cancel", () => cancelJob(job.id)),
        canRetry(job) && button("Retry", async () => (location.hash = `#/jobs/${(await retryJob(job.id)).id}`)),
      ),
    );
  }

  private picture(job: Job): HTMLElement {
    const preview = job.outputs.find((output) => output.name === "preview");
    if (!preview) return el("div", { class: "thumb" });
    const image = el("img", { class: "thumb", alt: "", loading: "lazy", width: 64, height: 64 });
    const known = this.pictures.get(preview.sha256);
    if (known) image.src = known;
    else {
      outputAddress(preview).then(
        (address) => {
          this.pictures.set(preview.sha256, address);
          image.src = address;
        },
        // the job's own page says what is wrong with its outputs
        () => image.replaceWith(el("div", { class: "thumb", title: "The picture cannot be read" })),
      );
    }
    return image;
  }

  private async act(action: () => Promise<unknown>): Promise<void> {
    try {
      await action();
      await this.refresh();
    } catch (error) {
      fill(this.trouble, problemBox(problemOf(error)));
    }
  }
}
