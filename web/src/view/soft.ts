/** The renderer for machines without WebGL: triangles into a depth buffer, shaded pixel by pixel, shown by Canvas 2D. */

import type { Sight } from "./camera";
import { checker, gridLine, MAJOR, MINOR, type Rgb } from "./colors";
import type { Drawn, Mode, Renderer } from "./drawn";
import { chartPlace } from "./lattice";

const PALE: Rgb = [239, 239, 239];
const FINE: Rgb = [188, 190, 192];
const EDGE: Rgb = [46, 72, 84];
const BEHIND: Rgb = [215, 45, 45];
/** How much of a colour the light takes away at most. */
const SHADE: Record<Mode, number> = { checker: 0.3, grid: 0.3, normals: 0.08, area: 0.15, distance: 0.15, wireframe: 0.22 };

export class SoftRenderer implements Renderer {
  readonly name = "Canvas 2D";
  private readonly context: CanvasRenderingContext2D;
  private drawn: Drawn | null = null;
  private arrived = 0;
  private image!: ImageData;
  private depth!: Float32Array;

  constructor(private readonly canvas: HTMLCanvasElement) {
    const context = canvas.getContext("2d");
    if (!context) throw new Error("this browser draws on no canvas");
    this.context = context;
    this.resize(canvas.width, canvas.height);
  }

  take(drawn: Drawn): void {
    this.drawn = drawn;
    this.arrived = drawn.carried ? 0 : 1;
  }

  move(positions: Float32Array, normals: Float32Array, arrived: number): void {
    this.drawn = { ...this.drawn!, positions, normals };
    if (this.drawn.carried) this.arrived = arrived;
  }

  resize(width: number, height: number): void {
    this.canvas.width = Math.max(1, width);
    this.canvas.height = Math.max(1, height);
    this.image = this.context.createImageData(this.canvas.width, this.canvas.height);
    this.depth = new Float32Array(this.canvas.width * this.canvas.height);
  }

  dispose(): void {
    this.drawn = null;
  }

  draw(mode: Mode, sight: Sight): void {
    this.image.data.fill(0);
    this.depth.fill(Infinity);
    if (this.drawn) this.triangles(this.drawn, mode, sight);
    this.context.putImageData(this.image, 0, 0);
  }

  private triangles(drawn: Drawn, mode: Mode, { matrix: m, light }: Sight): void {
    const { width, height } = this.canvas;
    const { positions, normals, triangles } = drawn;
    const pixels = this.image.data;
    const vertices = positions.length / 3;
    // x and y in pixels, depth, and how bright the vertex is
    const seen = new Float32Array(4 * vertices);
    for (let v = 0; v < vertices; v++) {
      const [x, y, z] = [positions[3 * v], positions[3 * v + 1], positions[3 * v + 2]];
      const w = m[3] * x + m[7] * y + m[11] * z + m[15];
      seen[4 * v] = (((m[0] * x + m[4] * y + m[8] * z + m[12]) / w + 1) / 2) * width;
      seen[4 * v + 1] = ((1 - (m[1] * x + m[5] * y + m[9] * z + m[13]) / w) / 2) * height;
      seen[4 * v + 2] = (m[2] * x + m[6] * y + m[10] * z + m[14]) / w;
      const facing = normals[3 * v] * light[0] + normals[3 * v + 1] * light[1] + normals[3 * v + 2] * light[2];
      seen[4 * v + 3] = drawn.lit ? 1 - SHADE[mode] * (1 - Math.max(0, facing)) : 1;
    }
    const shader = shaderOf(drawn, mode, this.arrived);
    const out: Rgb = [0, 0, 0];
    for (let t = 0; t < triangles.length; t += 3) {
      const [a, b, c] = [4 * triangles[t], 4 * triangles[t + 1], 4 * triangles[t + 2]];
      const [ax, ay, bx, by, cx, cy] = [seen[a], seen[a + 1], seen[b], seen[b + 1], seen[c], seen[c + 1]];
      const area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax);
      if (area === 0 || Number.isNaN(area)) continue;
      const behind = drawn.lit && area > 0;
      const left = Math.max(0, Math.floor(Math.min(ax, bx, cx)));
      const right = Math.min(width - 1, Math.ceil(Math.max(ax, bx, cx)));
      const top = Math.max(0, Math.floor(Math.min(ay, by, cy)));
      const bottom = Math.min(height - 1, Math.ceil(Math.max(ay, by, cy)));
      // how the weights change from pixel to pixel, for lines of even width
      const slopes = [(by - cy) / area, (cx - bx) / area, (cy - ay) / area, (ax - cx) / area, (ay - by) / area, (bx - ax) / area];
      for (let y = top; y <= bottom; y++) {
        for (let x = left; x <= right; x++) {
          const [px, py] = [x + 0.5, y + 0.5];
          const wa = ((bx - px) * (cy - py) - (by - py) * (cx - px)) / area;
          const wb = ((cx - px) * (ay - py) - (cy - py) * (ax - px)) / area;
          const wc = 1 - wa - wb;
          if (wa < 0 || wb < 0 || wc < 0) continue;
          const z = wa * seen[a + 2] + wb * seen[b + 2] + wc * seen[c + 2];
          const k = y * width + x;
          if (z >= this.depth[k]) continue;
          this.depth[k] = z;
          shader(t / 3, wa, wb, wc, slopes, out);
          const bright = wa * seen[a + 3] + wb * seen[b + 3] + wc * seen[c + 3];
          for (let j = 0; j < 3; j++) pixels[4 * k + j] = bright * (behind ? 0.2 * out[j] + 0.8 * BEHIND[j] : out[j]);
          pixels[4 * k + 3] = 255;
        }
      }
    }
  }
}

/** Writes the colour at a place in triangle `t`, given by its weights of the corners and their slopes in x and y. */
type Shader = (t: number, wa: number, wb: number, wc: number, slopes: readonly number[], out: Rgb) => void;

function shaderOf(drawn: Drawn, mode: Mode, arrived: number): Shader {
  const { triangles, uv, places, carried, texture, values, ramp, normals } = drawn;
  const mean = (items: Float32Array, size: number, k: number, t: number, wa: number, wb: number, wc: number): number =>
    wa * items[size * triangles[3 * t] + k] + wb * items[size * triangles[3 * t + 1] + k] + wc * items[size * triangles[3 * t + 2] + k];
  const put = (out: Rgb, color: readonly number[]): void => {
    [out[0], out[1], out[2]] = [color[0], color[1], color[2]];
  };
  if (mode === "checker" && places) {
    const hue = memo(drawn.octahedral);
    const at = (of: Float32Array, t: number, wa: number, wb: number, wc: number): Rgb => {
      const d: [number, number, number] = [0, 1, 2].map((k) => mean(of, 3, k, t, wa, wb, wc)) as [number, number, number];
      const length = Math.hypot(...d) || 1;
      return hue(...chartPlace([d[0] / length, d[1] / length, d[2] / length], drawn.octahedral));
    };
    if (!carried || arrived >= 1) return (t, wa, wb, wc, _, out) => put(out, at(places, t, wa, wb, wc));
    return (t, wa, wb, wc, _, out) => {
      const [before, after] = [at(carried, t, wa, wb, wc), at(places, t, wa, wb, wc)];
      for (let k = 0; k < 3; k++) out[k] = before[k] + arrived * (after[k] - before[k]);
    };
  }
  if (mode === "checker" && texture && uv) {
    return (t, wa, wb, wc, _, out) => {
      const x = Math.min(texture.width - 1, Math.floor(mean(uv, 2, 0, t, wa, wb, wc) * texture.width));
      const y = Math.min(texture.height - 1, Math.floor(mean(uv, 2, 1, t, wa, wb, wc) * texture.height));
      const k = 4 * (y * texture.width + x);
      [out[0], out[1], out[2]] = [texture.data[k], texture.data[k + 1], texture.data[k + 2]];
    };
  }
  if (mode === "grid" && uv) {
    return (t, wa, wb, wc, slopes, out) => {
      put(out, PALE);
      let numbered = false;
      for (const k of [0, 1]) {
        const corners = [0, 1, 2].map((j) => uv[2 * triangles[3 * t + j] + k]);
        const c = wa * corners[0] + wb * corners[1] + wc * corners[2];
        const along = (axis: number): number => corners[0] * slopes[axis] + corners[1] * slopes[2 + axis] + corners[2] * slopes[4 + axis];
        const slope = Math.hypot(along(0), along(1));
        const to = (parts: number): number => Math.abs(c * parts - Math.round(c * parts)) / (slope * parts + 1e-9);
        if (to(MAJOR) < 1) {
          put(out, gridLine(Math.round(c * MAJOR), k === 1));
          numbered = true;
        } else if (!numbered && to(MAJOR * MINOR) < 0.5) put(out, FINE);
      }
    };
  }
  if ((mode === "area" || mode === "distance") && values && ramp) {
    return (t, _a, _b, _c, _, out) => put(out, ramp[Math.round(255 * Math.min(1, Math.max(0, values[t])))]);
  }
  if (mode === "wireframe") {
    return (_t, wa, wb, wc, slopes, out) => {
      const heights = [0, 2, 4].map((k) => 1 / Math.hypot(slopes[k], slopes[k + 1]));
      if (Math.min(wa * heights[0], wb * heights[1], wc * heights[2]) >= 0.6) return put(out, PALE);
      // lines grow pale where triangles are hardly larger than they
      const strength = 0.3 + 0.7 * Math.min(1, Math.max(0, (Math.min(...heights) - 2) / 7));
      for (let k = 0; k < 3; k++) out[k] = PALE[k] + strength * (EDGE[k] - PALE[k]);
    };
  }
  return (t, wa, wb, wc, _, out) => {
    for (let k = 0; k < 3; k++) out[k] = 255 * (0.5 + 0.5 * mean(normals, 3, k, t, wa, wb, wc));
  };
}

/** The checkerboard's colours, each tile's once. */
function memo(octahedral: boolean): (u: number, v: number) => Rgb {
  const known = new Map<number, Rgb>();
  return (u, v) => {
    const tile = 64 * Math.floor(u * 32) + Math.floor(v * (octahedral ? 32 : 16));
    let color = known.get(tile);
    if (!color) known.set(tile, (color = checker(u, v, octahedral)));
    return color;
  };
}
