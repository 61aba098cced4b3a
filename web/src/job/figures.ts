/** What the progress events say, beside the picture: figures, a bar and the course of energy and distance. */

import type { Job, Progress } from "../api/types";
import { el, fill, svg } from "../dom";
import { count, figure, percent, seconds, UNKNOWN } from "../format";

const WIDTH = 160;
const HEIGHT = 34;

export class Figures {
  readonly element = el("div", { class: "figures" });
  private readonly bar = el("progress", { max: 1, value: 0, "aria-label": "Share of the job done" });
  private readonly list = el("dl", {});
  private readonly energies: number[] = [];
  private readonly distances: number[] = [];

  constructor() {
    this.element.append(this.bar, this.list);
    this.tell(null);
  }

  /** Another progress event. */
  push(progress: Progress): void {
    if (progress.energy !== null && progress.energy !== undefined) this.energies.push(progress.energy);
    if (progress.max_distance !== null && progress.max_distance !== undefined) this.distances.push(progress.max_distance);
    this.bar.value = progress.fraction;
    this.tell(progress);
  }

  private tell(progress: Progress | null): void {
    const row = (term: string, value: string, line?: SVGElement | null): Node =>
      el("div", {}, el("dt", {}, term), el("dd", {}, value, line ?? null));
    fill(
      this.list,
      row("Stage", progress?.stage || UNKNOWN),
      row("Attempt", progress?.attempt ? String(progress.attempt) : UNKNOWN),
      row("Done", progress ? percent(progress.fraction, 2) : UNKNOWN),
      row("Time left", progress ? seconds(progress.eta_s) : UNKNOWN),
      row("Energy", figure(progress?.energy), sparkline(this.energies, "energy")),
      row("Largest distance", figure(progress?.max_distance), sparkline(this.distances, "largest distance")),
      row("Flips", count(progress?.flips)),
    );
  }
}

/** The course of a figure; the text beside it says the last one. */
function sparkline(values: number[], name: string): SVGElement | null {
  if (values.length < 2) return null;
  const [low, high] = [Math.min(...values), Math.max(...values)];
  const points = values.map((value, k) => {
    const x = (k / (values.length - 1)) * (WIDTH - 4) + 2;
    const y = high > low ? HEIGHT - 3 - ((value - low) / (high - low)) * (HEIGHT - 6) : HEIGHT / 2;
    return `${x.toFixed(1)},${y.toFixed(1)}`;
  });
  const label = `Course of ${name} over ${values.length} events: from ${figure(values[0])} to ${figure(values[values.length - 1])}`;
  return svg(
    "svg",
    { class: "sparkline", viewBox: `0 0 ${WIDTH} ${HEIGHT}`, role: "img", "aria-label": label, preserveAspectRatio: "none" },
    svg("polyline", { points: points.join(" ") }),
  );
}

/** Seconds a job ran. */
export function ranFor(job: Job): string {
  if (!job.started_at) return UNKNOWN;
  const end = job.finished_at ? new Date(job.finished_at) : new Date();
  return seconds((end.getTime() - new Date(job.started_at).getTime()) / 1000);
}
