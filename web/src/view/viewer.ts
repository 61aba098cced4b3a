/** Surface and UV square side by side: the same triangles in the same colours, and what is pointed at in one is marked in both. */

import { announce, el, fill, uniqueId } from "../dom";
import { count, figure, fixed, percent } from "../format";
import { Orbit, project, Window } from "./camera";
import { css, DIVERGING, gridLine, MAJOR, SEQUENTIAL, type Ramp } from "./colors";
import { MODES, type Drawn, type Mode } from "./drawn";
import type { Front } from "./front";
import { angles, direction, isOctahedral, latticeName, type Lattice, type Vec3 } from "./lattice";
import { areaRatios, quantile, roundUp } from "./measures";
import { BoxTree, UvGrid, type Hit } from "./picking";
import { bounds, triangleCount, vertexNormals, type Surface } from "./surface";
import { Viewport } from "./viewport";

const NAMES: Record<Mode, string> = {
  checker: "Checkerboard",
  grid: "UV grid",
  normals: "Normals",
  area: "Area distortion",
  distance: "Distance error",
  wireframe: "Wireframe",
};
/** Area ratios at the ends of the scale, as powers of two. */
const OCTAVES = 2;
const TURN = Math.PI / 24;
/** Steps of the crosshair along a side of the square. */
const STEPS = 100;

/** Distances of triangles as parts of the diagonal, or why there are none. */
export type Distances = Float32Array | string;

export class Viewer {
  readonly element: HTMLElement;
  private readonly orbit = new Orbit();
  private readonly window = new Window();
  private readonly space: Viewport;
  private readonly chart: Viewport;
  private readonly legend = el("div", { class: "legend" });
  private readonly probe = el("p", { class: "probe", id: "probe" }, "Point at the surface or its chart: the place is marked in both.");
  private readonly toolbar: HTMLElement;
  private readonly title = el("figcaption", {}, "Surface");
  private mode: Mode = "checker";
  private surface: Surface | null = null;
  private distances: Distances = "is known when the job has made its surface";
  private ratios: Float32Array | null = null;
  private tree: BoxTree | null = null;
  private grid: UvGrid | null = null;
  private crosshair: [number, number] = [0.5, 0.5];
  private spoken = 0;
  private frontLattice: Lattice | null = null;

  constructor() {
    this.space = new Viewport({
      label: "Surface in space",
      hint: "Arrow keys orbit, plus and minus zoom, 0 resets",
      sight: (aspect) => this.orbit.sight(aspect),
      hover: (place, aspect) => this.hoverSpace(place, aspect),
      drag: (dx, dy, size) => this.turned(() => this.orbit.turn((-3 * dx) / size, (3 * dy) / size)),
      magnify: (by) => this.turned(() => this.orbit.magnify(by)),
      key: (event) => this.orbitKey(event.key),
    });
    this.chart = new Viewport({
      label: "UV square",
      hint: "Arrow keys move a crosshair whose place is marked on the surface, with shift in small steps; plus and minus zoom, 0 resets",
      sight: (aspect) => this.window.sight(aspect),
      hover: (place, aspect) => this.hoverChart(place && this.window.place(place[0], place[1], aspect)),
      drag: (dx, dy, size) => this.panned(() => this.window.move(-dx / size / this.window.zoom, -dy / size / this.window.zoom)),
      magnify: (by, place, aspect) => this.panned(() => this.window.magnify(by, this.window.place(place[0], place[1], aspect))),
      key: (event) => this.chartKey(event),
    });
    this.toolbar = this.modes();
    this.element = el(
      "div",
      { class: "viewer" },
      el(
        "div",
        { class: "viewer-bar" },
        this.toolbar,
        el(
          "div",
          { class: "zoom", role: "group", "aria-label": "View of the surface" },
          el("button", { type: "button", title: "Zoom in", "aria-label": "Zoom in", onclick: () => this.orbitKey("+") }, "+"),
          el("button", { type: "button", title: "Zoom out", "aria-label": "Zoom out", onclick: () => this.orbitKey("-") }, "\u2212"),
          el("button", { type: "button", onclick: () => this.orbitKey("0") }, "Reset view"),
        ),
      ),
      el(
        "div",
        { class: "pictures" },
        el("figure", { class: "space" }, this.space.element, this.title),
        el(
          "figure",
          { class: "chart" },
          this.chart.element,
          el("figcaption", {}, "UV square ", el("span", { class: "hint" }, "u \u2192 right, v \u2193 down")),
        ),
      ),
      this.legend,
      this.probe,
    );
  }

  /** The way the pictures are drawn; Canvas 2D where there is no WebGL. */
  get rendererName(): string {
    return this.space.element.dataset.renderer ?? "";
  }

  /** Another surface. */
  show(surface: Surface, name: string, distances: Distances, keepSight = false): void {
    const { middle, radius } = bounds(surface.positions);
    this.frontLattice = null;
    this.surface = surface;
    this.distances = distances;
    this.ratios = this.tree = this.grid = null;
    this.orbit.middle = middle;
    this.orbit.radius = radius;
    if (!keepSight) this.orbit.reset();
    this.window.reset();
    this.title.textContent = name;
    this.point(null);
    this.refresh();
  }

  /** The distances, once they are known. */
  setDistances(distances: Distances): void {
    this.distances = distances;
    this.refresh();
  }

  /** A front while it shrinks, `arrived` from 0 to 1 on its way; its checkerboard is that of `places`, into which that of `carried` fades. */
  showFront(front: Omit<Front, "from">, lattice: Lattice, arrived: number): void {
    const normals = vertexNormals(front.positions, front.triangles);
    if (arrived > 0) return this.space.move(front.positions, normals, arrived);
    const octahedral = isOctahedral(lattice);
    this.surface = null;
    this.point(null);
    this.space.take({ ...front, normals, uv: null, texture: null, octahedral, values: null, ramp: null, lit: true });
    // there is no map to the sphere yet that other pictures could be of
    this.choose("checker");
    this.toolbar.querySelector<HTMLInputElement>("input[value=checker]")!.checked = true;
    (this.toolbar as HTMLFieldSetElement).disabled = true;
    this.space.setMode("checker");
    this.chart.setMode("checker");
    this.title.textContent = "Front";
    this.frontLattice = lattice;
    this.tell();
  }

  /** What the camera looks at, while fronts are shown. */
  aim(middle: number[], radius: number): void {
    this.orbit.middle = middle;
    this.orbit.radius = radius;
    this.space.ask();
  }

  private modes(): HTMLElement {
    const name = uniqueId("mode");
    return el(
      "fieldset",
      { class: "modes" },
      el("legend", { class: "sr" }, "Shown on the surface"),
      ...MODES.map((mode) =>
        el(
          "label",
          {},
          el("input", { type: "radio", name, value: mode, checked: mode === this.mode, onchange: () => this.choose(mode) }),
          el("span", {}, NAMES[mode]),
        ),
      ),
    );
  }

  private choose(mode: Mode): void {
    this.mode = mode;
    this.refresh();
  }

  /** Draws the surface anew in the mode that was chosen. */
  private refresh(): void {
    const { surface } = this;
    const distance = this.toolbar.querySelector<HTMLInputElement>("input[value=distance]")!;
    distance.disabled = typeof this.distances === "string";
    distance.parentElement!.title = typeof this.distances === "string" ? `The distance error ${this.distances}` : "";
    if (distance.disabled && this.mode === "distance") {
      this.mode = "checker";
      this.toolbar.querySelector<HTMLInputElement>("input[value=checker]")!.checked = true;
    }
    if (!surface) return this.tell();
    (this.toolbar as HTMLFieldSetElement).disabled = false;
    let values: Float32Array | null = null;
    let ramp: Ramp | null = null;
    if (this.mode === "area") {
      this.ratios ??= areaRatios(surface);
      values = this.ratios.map((ratio) => Math.min(1, Math.max(0, 0.5 + Math.log2(ratio) / (2 * OCTAVES))));
      ramp = DIVERGING;
    } else if (this.mode === "distance" && typeof this.distances !== "string") {
      const end = roundUp(quantile(this.distances, 1));
      values = this.distances.map((distance) => distance / end);
      ramp = SEQUENTIAL;
    }
    const octahedral = isOctahedral(surface.lattice);
    const same = { uv: surface.uv, places: null, carried: null, triangles: surface.triangles, texture: surface.texture, octahedral, values, ramp };
    const flat = new Float32Array((3 * surface.uv.length) / 2);
    for (let v = 0; v < surface.uv.length / 2; v++) flat.set([surface.uv[2 * v], 1 - surface.uv[2 * v + 1], 0], 3 * v);
    const inSpace: Drawn = { ...same, positions: surface.positions, normals: surface.normals, lit: true };
    this.space.take(inSpace);
    this.chart.take({ ...same, positions: flat, normals: surface.normals, lit: false });
    this.space.setMode(this.mode);
    this.chart.setMode(this.mode);
    this.tell();
  }

  private tell(): void {
    fill(this.legend, ...this.legendOf());
    const { surface } = this;
    if (!surface) {
      const lattice = this.frontLattice ? `, ${latticeName(this.frontLattice)}` : "";
      this.space.describe(`The front while it shrinks${lattice}, with the checkerboard of the sphere on it`);
      return;
    }
    const shape = `${count(triangleCount(surface))} triangles on the lattice ${latticeName(surface.lattice)}`;
    this.space.describe(`${this.title.textContent}: ${shape}, shown as ${NAMES[this.mode].toLowerCase()}. ${this.summary()}`);
    this.chart.describe(`The UV square of the same ${shape}, shown as ${NAMES[this.mode].toLowerCase()}. ${this.summary()}`);
  }

  private summary(): string {
    if (this.mode === "area" && this.ratios) {
      const [low, high] = [quantile(this.ratios, 0.01), quantile(this.ratios, 0.99)];
      return `98 % of the triangles have between ${figure(low, 3)} and ${figure(high, 3)} times the mean area per area of the sphere.`;
    }
    if (this.mode === "distance" && typeof this.distances !== "string") {
      return `Half of the triangles are nearer than ${percent(quantile(this.distances, 0.5))}, all nearer than ${percent(quantile(this.distances, 1))} of the bounding box's diagonal.`;
    }
    return "";
  }

  private legendOf(): (Node | string)[] {
    const why = typeof this.distances === "string" ? el("p", { class: "hint" }, `The distance error ${this.distances}.`) : "";
    if (!this.surface) {
      return [el("p", {}, "The checkerboard is that of the sphere. Before the map to the sphere is made, it is carried along with the front.")];
    }
    switch (this.mode) {
      case "checker":
        return [el("p", {}, "Hue runs once round with u, lightness falls with v: every tile has its own place in the square."), why];
      case "grid":
        return [
          el("p", {}, `Lines of constant u and v, every ${MAJOR}th of the square numbered:`),
          el("ul", { class: "keys" }, ...[false, true].flatMap((alongV) => Array.from({ length: MAJOR + 1 }, (_, k) => lineKey(k, alongV)))),
          why,
        ];
      case "normals":
        return [
          el(
            "ul",
            { class: "keys" },
            ...[["+x", [255, 128, 128]], ["\u2212x", [0, 128, 128]], ["+y", [128, 255, 128]], ["\u2212y", [128, 0, 128]], ["+z", [128, 128, 255]], ["\u2212z", [128, 128, 0]]].map(
              ([text, color]) => swatch(text as string, css(color as [number, number, number])),
            ),
          ),
          why,
        ];
      case "area":
        return [
          el("p", {}, "Area on the surface per area on the sphere, in parts of the mean."),
          scale(DIVERGING, ["\u2264 \u00bc", "\u00bd", "1", "2", "\u2265 4"]),
          el("p", {}, this.summary()),
          why,
        ];
      case "distance": {
        const end = roundUp(quantile(this.distances as Float32Array, 1));
        return [
          el("p", {}, "Largest measured distance of each triangle from the zero level set, of the bounding box's diagonal."),
          scale(SEQUENTIAL, [0, 0.25, 0.5, 0.75, 1].map((part) => percent(part * end))),
          el("p", {}, this.summary()),
        ];
      }
      case "wireframe":
        return [el("p", {}, `The ${count(triangleCount(this.surface))} triangles.`), why];
    }
  }

  private orbitKey(key: string): boolean {
    const turns: Record<string, [number, number]> = { ArrowLeft: [-TURN, 0], ArrowRight: [TURN, 0], ArrowUp: [0, TURN], ArrowDown: [0, -TURN] };
    if (turns[key]) this.turned(() => this.orbit.turn(...turns[key]));
    else if (key === "+" || key === "=") this.turned(() => this.orbit.magnify(1.2));
    else if (key === "-" || key === "_") this.turned(() => this.orbit.magnify(1 / 1.2));
    else if (key === "0" || key === "Home") this.turned(() => this.orbit.reset());
    else return false;
    return true;
  }

  private chartKey(event: KeyboardEvent): boolean {
    const step = (event.shiftKey ? 0.1 : 1) / STEPS;
    const moves: Record<string, [number, number]> = { ArrowLeft: [-step, 0], ArrowRight: [step, 0], ArrowUp: [0, -step], ArrowDown: [0, step] };
    const move = moves[event.key];
    if (move) {
      this.crosshair = this.crosshair.map((c, k) => Math.min(1, Math.max(0, c + move[k]))) as [number, number];
      this.hoverChart(this.crosshair);
      this.speak();
    } else if (event.key === "+" || event.key === "=") this.panned(() => this.window.magnify(1.2, this.crosshair));
    else if (event.key === "-" || event.key === "_") this.panned(() => this.window.magnify(1 / 1.2, this.crosshair));
    else if (event.key === "0" || event.key === "Home") this.panned(() => this.window.reset());
    else return false;
    return true;
  }

  /** Says where the crosshair is once it rests. */
  private speak(): void {
    clearTimeout(this.spoken);
    this.spoken = window.setTimeout(() => announce(this.probe.textContent ?? ""), 400);
  }

  private turned(change: () => void): void {
    change();
    this.space.ask();
  }

  private panned(change: () => void): void {
    change();
    this.chart.ask();
  }

  private hoverSpace(place: [number, number] | null, aspect: number): void {
    const { surface } = this;
    if (!surface) return;
    if (!place) return this.point(null);
    const sight = this.orbit.sight(aspect);
    this.tree ??= new BoxTree(surface.positions, surface.triangles);
    this.point(this.tree.first(sight.eye, this.ray(place, sight.matrix, sight.eye)));
  }

  /** The direction from the eye through a place of the picture: solved from the rows of the matrix. */
  private ray([x, y]: [number, number], m: Float32Array, eye: readonly number[]): number[] {
    // points p of the ray have (row0 - x row3) p = 0 and (row1 - y row3) p = 0, so it is along the product of those normals
    const row = (k: number): number[] => [0, 1, 2].map((c) => m[4 * c + k]);
    const [r0, r1, r3] = [row(0), row(1), row(3)];
    const a = r0.map((c, k) => c - x * r3[k]);
    const b = r1.map((c, k) => c - y * r3[k]);
    const d = [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
    const forward = this.orbit.middle.map((c, k) => c - eye[k]);
    const ahead = d.reduce((sum, c, k) => sum + c * forward[k], 0);
    const length = Math.hypot(...d) * (ahead < 0 ? -1 : 1);
    return d.map((c) => c / length);
  }

  private hoverChart(place: [number, number] | null): void {
    const { surface } = this;
    if (!surface) return;
    if (!place) return this.point(null);
    this.grid ??= new UvGrid(surface.uv, surface.triangles);
    this.point(place.every((c) => c >= 0 && c <= 1) ? this.grid.at(...place) : null);
  }

  /** Marks a place of the surface in both pictures, and says its coordinates. */
  private point(hit: Hit | null): void {
    const { surface } = this;
    if (!hit || !surface) {
      this.space.setMark(null);
      this.chart.setMark(null);
      return;
    }
    const corners = [0, 1, 2].map((c) => surface.triangles[3 * hit.triangle + c]);
    const mix = (items: Float32Array, size: number): number[] =>
      Array.from({ length: size }, (_, k) => corners.reduce((sum, v, c) => sum + hit.weights[c] * items[size * v + k], 0));
    const [point, uv, sphereUv] = [mix(surface.positions, 3), mix(surface.uv, 2), mix(surface.sphereUv, 2)];
    this.crosshair = uv as [number, number];
    const square = ([u, v]: number[]): number[] => [u, 1 - v, 0];
    this.space.setMark({ corners: corners.map((v) => [...surface.positions.subarray(3 * v, 3 * v + 3)]), point, hidden: this.hidden(point) });
    this.chart.setMark({ corners: corners.map((v) => square([...surface.uv.subarray(2 * v, 2 * v + 2)])), point: square(uv), hidden: false });
    const [theta, phi] = angles(direction(sphereUv[0], sphereUv[1], isOctahedral(surface.lattice)) as Vec3);
    const pair = (term: string, text: string): Node => el("span", {}, el("span", { class: "term" }, term), " ", text);
    const parts = [
      pair("u, v", `${fixed(uv[0], 3)}, ${fixed(uv[1], 3)}`),
      pair("\u03b8, \u03c6", `${fixed(theta, 1)}\u00b0, ${fixed(phi, 1)}\u00b0`),
      pair("x, y, z", point.map((c) => fixed(c, 3)).join(", ")),
      pair("triangle", count(hit.triangle)),
    ];
    if (this.mode === "area" && this.ratios) parts.push(pair("area", `\u00d7${figure(this.ratios[hit.triangle], 3)}`));
    if (this.mode === "distance" && typeof this.distances !== "string") parts.push(pair("distance", percent(this.distances[hit.triangle])));
    fill(this.probe, ...parts.flatMap((part, k) => (k === 0 ? [part] : [" ", part])));
  }

  /** Whether another part of the surface lies before a point of it. */
  private hidden(point: number[]): boolean {
    const surface = this.surface!;
    this.tree ??= new BoxTree(surface.positions, surface.triangles);
    const { eye, matrix } = this.orbit.sight(this.space.aspect);
    const ray = point.map((c, k) => c - eye[k]);
    const length = Math.hypot(...ray);
    const first = this.tree.first(eye, ray.map((c) => c / length));
    const seen = project(matrix, point[0], point[1], point[2]).every((c) => Math.abs(c) <= 1);
    return !seen || (first !== null && first.distance < length - 1e-3 * this.orbit.radius);
  }
}

function swatch(text: string, color: string): HTMLElement {
  const chip = el("span", { class: "chip", "aria-hidden": "true" });
  chip.style.background = color;
  return el("li", {}, chip, text);
}

function lineKey(k: number, alongV: boolean): HTMLElement {
  return swatch(`${alongV ? "v" : "u"} ${k}/${MAJOR}`, css(gridLine(k, alongV)));
}

/** A colour scale with its figures below. */
function scale(ramp: Ramp, figures: string[]): HTMLElement {
  const bar = el("div", { class: "bar", "aria-hidden": "true" });
  bar.style.background = `linear-gradient(to right, ${ramp.filter((_, k) => k % 15 === 0).map(css).join(", ")})`;
  return el("div", { class: "scale" }, bar, el("ol", {}, ...figures.map((text) => el("li", {}, text))));
}
