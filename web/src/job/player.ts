/** Plays the fronts of `mesh` events: each flows into the next, and none is skipped because events came in a burst. */

import type { MeshEvent } from "../api/types";
import { calm } from "../dom";
import { firstFront, nextFront, type Front } from "../view/front";
import type { Lattice } from "../view/lattice";
import { bounds } from "../view/surface";
import type { Viewer } from "../view/viewer";

/** Milliseconds from the ball to the first front, and from front to front. */
const FIRST = 900;
const NEXT = 420;
/** Milliseconds a front rests at least. */
const REST = 120;
/** With more fronts waiting than this, they are not animated: a job that has long been running is caught up with. */
const MOST_WAITING = 5;

export class Player {
  private queue: MeshEvent[] = [];
  private front: Front | null = null;
  private playing: Promise<void> | null = null;
  private stopped = false;
  /** Fronts that were shown. */
  shown = 0;

  constructor(private readonly viewer: Viewer, private readonly lattice: Lattice) {}

  push(event: MeshEvent): void {
    this.queue.push(event);
    this.playing ??= this.play().finally(() => (this.playing = null));
  }

  /** When everything that came was shown. */
  async finish(): Promise<void> {
    await this.playing;
  }

  stop(): void {
    this.stopped = true;
    this.queue = [];
  }

  private async play(): Promise<void> {
    while (this.queue.length > 0 && !this.stopped) {
      const event = this.queue.shift()!;
      const [first, before] = [this.front === null, this.front];
      this.front = before ? nextFront(event, before) : firstFront(event);
      await this.flow(this.front, before ? bounds(before.positions) : ballOf(this.front), first ? FIRST : NEXT);
      this.shown++;
      this.viewer.element.dataset.fronts = String(this.shown);
    }
  }

  /** From where the vertices come to where they are; the view follows. */
  private async flow(front: Front, from: { middle: number[]; radius: number }, time: number): Promise<void> {
    const to = bounds(front.positions);
    const still = calm() || document.hidden || this.queue.length > MOST_WAITING;
    if (still) {
      this.viewer.showFront({ ...front, carried: null }, this.lattice, 0);
      return this.viewer.aim(to.middle, to.radius);
    }
    const moving = { ...front, positions: front.from.slice() };
    const { positions } = moving;
    this.viewer.showFront(moving, this.lattice, 0);
    const begin = performance.now();
    for (let part = 0; part < 1 && !this.stopped; ) {
      part = Math.min(1, (performance.now() - begin) / time);
      const t = part * part * (3 - 2 * part);
      for (let k = 0; k < positions.length; k++) positions[k] = front.from[k] + t * (front.positions[k] - front.from[k]);
      this.viewer.aim(to.middle.map((c, k) => from.middle[k] + t * (c - from.middle[k])), from.radius + t * (to.radius - from.radius));
      this.viewer.showFront(moving, this.lattice, t);
      await frame();
    }
    await new Promise((resolve) => setTimeout(resolve, REST));
  }
}

function ballOf(front: Front): { middle: number[]; radius: number } {
  const { middle, radius } = bounds(front.from);
  return { middle, radius };
}

/** The next frame; a page that is not seen has none, so a little later at the latest. */
function frame(): Promise<void> {
  return new Promise((resolve) => {
    const timer = setTimeout(resolve, 250);
    requestAnimationFrame(() => (clearTimeout(timer), resolve()));
  });
}
