/** A picture that can be pointed at: a canvas with its renderer, and over it the mark of what is pointed at. */

import { el, svg } from "../dom";
import { project, type Sight } from "./camera";
import type { Drawn, Mode, Renderer } from "./drawn";
import { glRenderer } from "./gl";
import { SoftRenderer } from "./soft";

/** A marked triangle and the place in it, in the coordinates of the picture's shape. */
export interface Mark {
  corners: number[][];
  point: number[];
  /** Whether something lies in front of it. */
  hidden: boolean;
}

export interface ViewportOptions {
  /** What it is, for a screen reader. */
  label: string;
  hint: string;
  sight: (aspect: number) => Sight;
  /** Place in the picture, from -1 to 1 to the right and up; `null` when the pointer left. */
  hover: (place: [number, number] | null, aspect: number) => void;
  /** Pixels that the pointer was dragged. */
  drag: (dx: number, dy: number, size: number) => void;
  magnify: (by: number, place: [number, number], aspect: number) => void;
  /** Whether the key meant something. */
  key: (event: KeyboardEvent) => boolean;
}

/** Pixels of a canvas at most, so that software rendering keeps up. */
const MOST_PIXELS = 1_400_000;
const MOST_SOFT_PIXELS = 360_000;

export class Viewport {
  readonly element: HTMLElement;
  private canvas!: HTMLCanvasElement;
  private renderer!: Renderer;
  private readonly overlay = svg("svg", { class: "overlay", "aria-hidden": "true" });
  private readonly picture = el("div", { class: "picture" });
  private readonly pointers = new Map<number, [number, number]>();
  private drawn: Drawn | null = null;
  private mode: Mode = "checker";
  private mark: Mark | null = null;
  private asked = 0;

  constructor(private readonly options: ViewportOptions) {
    this.element = el(
      "div",
      {
        class: "viewport",
        role: "application",
        tabindex: 0,
        "aria-label": `${options.label}. ${options.hint}`,
        onkeydown: (event: KeyboardEvent) => {
          if (!event.altKey && !event.ctrlKey && !event.metaKey && options.key(event)) event.preventDefault();
        },
      },
      this.picture,
    );
    this.mount((canvas) => glRenderer(canvas, () => this.mount((other) => new SoftRenderer(other))));
    this.listen();
    new ResizeObserver(() => this.fit()).observe(this.picture);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.ask());
  }

  /** Puts a new canvas in place of the one before, for a renderer that could be made. */
  private mount(make: (canvas: HTMLCanvasElement) => Renderer | null): void {
    const known = this.canvas?.getAttribute("aria-label") ?? this.options.label;
    const fresh = (): HTMLCanvasElement => (this.canvas = el("canvas", { role: "img", "aria-label": known }));
    this.renderer = make(fresh()) ?? new SoftRenderer(fresh());
    this.picture.replaceChildren(this.canvas, this.overlay);
    this.element.dataset.renderer = this.renderer.name;
    if (this.drawn) this.renderer.take(this.drawn);
    this.fit();
  }

  /** What is seen, in words. */
  describe(text: string): void {
    this.canvas.setAttribute("aria-label", text);
  }

  take(drawn: Drawn): void {
    this.drawn = drawn;
    this.renderer.take(drawn);
    this.ask();
  }

  move(positions: Float32Array, normals: Float32Array, arrived: number): void {
    if (this.drawn) this.drawn = { ...this.drawn, positions, normals };
    this.renderer.move(positions, normals, arrived);
    this.ask();
  }

  setMode(mode: Mode): void {
    this.mode = mode;
    this.ask();
  }

  setMark(mark: Mark | null): void {
    this.mark = mark;
    this.drawMark();
  }

  get aspect(): number {
    return Math.max(1, this.picture.clientWidth) / Math.max(1, this.picture.clientHeight);
  }

  /** Draws with the next frame. */
  ask(): void {
    this.asked ||= requestAnimationFrame(() => {
      this.asked = 0;
      this.renderer.draw(this.mode, this.options.sight(this.aspect));
      this.drawMark();
      this.element.dataset.drawn = String(Number(this.element.dataset.drawn ?? 0) + 1);
    });
  }

  private fit(): void {
    const { clientWidth, clientHeight } = this.picture;
    if (clientWidth === 0 || clientHeight === 0) return;
    const most = this.renderer.name === "WebGL" ? MOST_PIXELS : MOST_SOFT_PIXELS;
    const scale = Math.min(devicePixelRatio, Math.sqrt(most / (clientWidth * clientHeight)));
    this.renderer.resize(Math.round(clientWidth * scale), Math.round(clientHeight * scale));
    this.overlay.setAttribute("viewBox", `0 0 ${clientWidth} ${clientHeight}`);
    this.ask();
  }

  private drawMark(): void {
    if (!this.mark) return this.overlay.replaceChildren();
    const { matrix } = this.options.sight(this.aspect);
    const at = ([x, y, z]: number[]): [number, number] => {
      const [px, py] = project(matrix, x, y, z);
      return [((px + 1) / 2) * this.picture.clientWidth, ((1 - py) / 2) * this.picture.clientHeight];
    };
    const corners = this.mark.corners.map((corner) => at(corner).map((c) => c.toFixed(1)).join(","));
    const [x, y] = at(this.mark.point);
    const kind = this.mark.hidden ? "mark hidden" : "mark";
    this.overlay.replaceChildren(
      svg("polygon", { class: `${kind} halo`, points: corners.join(" ") }),
      svg("polygon", { class: kind, points: corners.join(" ") }),
      svg("circle", { class: `${kind} halo`, cx: x, cy: y, r: 6 }),
      svg("circle", { class: kind, cx: x, cy: y, r: 6 }),
    );
  }

  private place(event: { clientX: number; clientY: number }): [number, number] {
    const box = this.picture.getBoundingClientRect();
    return [(2 * (event.clientX - box.left)) / box.width - 1, 1 - (2 * (event.clientY - box.top)) / box.height];
  }

  private listen(): void {
    const { picture, pointers, options } = this;
    picture.addEventListener("pointerdown", (event) => {
      picture.setPointerCapture(event.pointerId);
      pointers.set(event.pointerId, [event.clientX, event.clientY]);
      options.hover(this.place(event), this.aspect);
    });
    picture.addEventListener("pointermove", (event) => {
      const before = pointers.get(event.pointerId);
      if (!before) return options.hover(this.place(event), this.aspect);
      if (pointers.size === 1) options.drag(event.clientX - before[0], event.clientY - before[1], Math.min(picture.clientWidth, picture.clientHeight));
      else {
        const spread = (): number => {
          const [a, b] = [...pointers.values()];
          return Math.hypot(a[0] - b[0], a[1] - b[1]) || 1;
        };
        const old = spread();
        pointers.set(event.pointerId, [event.clientX, event.clientY]);
        options.magnify(spread() / old, this.place(event), this.aspect);
      }
      pointers.set(event.pointerId, [event.clientX, event.clientY]);
    });
    for (const end of ["pointerup", "pointercancel"] as const) picture.addEventListener(end, (event) => pointers.delete(event.pointerId));
    picture.addEventListener("pointerleave", () => options.hover(null, this.aspect));
    picture.addEventListener(
      "wheel",
      (event) => {
        // the page scrolls on unless this picture was chosen
        if (!event.ctrlKey && !this.element.contains(document.activeElement)) return;
        event.preventDefault();
        options.magnify(Math.exp(-Math.max(-100, Math.min(100, event.deltaY)) / 400), this.place(event), this.aspect);
      },
      { passive: false },
    );
  }
}
