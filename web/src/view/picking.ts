/** Which triangle is under the pointer: in space by a tree of boxes, in the UV square by a grid of cells. */

export interface Hit {
  triangle: number;
  /** Weights of its three corners. */
  weights: [number, number, number];
  /** Along the ray, where there was one. */
  distance: number;
}

const LEAF = 8;

/** A tree of boxes over triangles, halved at the middle triangle along the longest side. */
export class BoxTree {
  private readonly order: Uint32Array;
  private readonly boxes: number[] = [];
  /** First triangle and number of triangles of a leaf; the right child and 0 of a branch, whose left child follows it. */
  private readonly nodes: number[] = [];

  constructor(private readonly positions: Float32Array, private readonly triangles: Uint32Array) {
    const n = triangles.length / 3;
    const middles = new Float32Array(3 * n);
    for (let t = 0; t < n; t++) {
      for (let k = 0; k < 3; k++) middles[3 * t + k] = this.corner(t, 0, k) + this.corner(t, 1, k) + this.corner(t, 2, k);
    }
    this.order = Uint32Array.from({ length: n }, (_, t) => t);
    if (n > 0) this.build(0, n, middles);
  }

  private corner(t: number, corner: number, axis: number): number {
    return this.positions[3 * this.triangles[3 * t + corner] + axis];
  }

  private build(from: number, to: number, middles: Float32Array): void {
    const box = [Infinity, Infinity, Infinity, -Infinity, -Infinity, -Infinity];
    for (let i = from; i < to; i++) {
      for (let c = 0; c < 3; c++) {
        for (let k = 0; k < 3; k++) {
          const x = this.corner(this.order[i], c, k);
          if (x < box[k]) box[k] = x;
          if (x > box[3 + k]) box[3 + k] = x;
        }
      }
    }
    const node = this.nodes.length / 2;
    this.boxes.push(...box);
    if (to - from <= LEAF) {
      this.nodes.push(from, to - from);
      return;
    }
    const sides = [0, 1, 2].map((k) => box[3 + k] - box[k]);
    const axis = sides.indexOf(Math.max(...sides));
    const part = this.order.subarray(from, to);
    part.sort((a, b) => middles[3 * a + axis] - middles[3 * b + axis]);
    const half = (from + to) >> 1;
    this.nodes.push(0, 0);
    this.build(from, half, middles);
    this.nodes[2 * node] = this.nodes.length / 2;
    this.build(half, to, middles);
  }

  /** The first triangle that a ray meets. */
  first(origin: readonly number[], ray: readonly number[]): Hit | null {
    let best: Hit | null = null;
    const inverse = ray.map((r) => 1 / r);
    const stack = this.nodes.length > 0 ? [0] : [];
    while (stack.length > 0) {
      const node = stack.pop()!;
      let [near, far] = [0, best?.distance ?? Infinity];
      for (let k = 0; k < 3; k++) {
        const one = (this.boxes[6 * node + k] - origin[k]) * inverse[k];
        const two = (this.boxes[6 * node + 3 + k] - origin[k]) * inverse[k];
        near = Math.max(near, Math.min(one, two));
        far = Math.min(far, Math.max(one, two));
      }
      // a hair wider, for boxes without a thickness
      if (near > far * (1 + 1e-6)) continue;
      const [first, size] = [this.nodes[2 * node], this.nodes[2 * node + 1]];
      if (size === 0) {
        stack.push(first, node + 1);
        continue;
      }
      for (let i = first; i < first + size; i++) {
        const hit = this.meet(this.order[i], origin, ray);
        if (hit && hit.distance < (best?.distance ?? Infinity)) best = hit;
      }
    }
    return best;
  }

  /** Ray and triangle (Möller and Trumbore 1997). */
  private meet(t: number, o: readonly number[], d: readonly number[]): Hit | null {
    const at = (c: number, k: number): number => this.corner(t, c, k);
    const [e1x, e1y, e1z] = [at(1, 0) - at(0, 0), at(1, 1) - at(0, 1), at(1, 2) - at(0, 2)];
    const [e2x, e2y, e2z] = [at(2, 0) - at(0, 0), at(2, 1) - at(0, 1), at(2, 2) - at(0, 2)];
    const [px, py, pz] = [d[1] * e2z - d[2] * e2y, d[2] * e2x - d[0] * e2z, d[0] * e2y - d[1] * e2x];
    const determinant = e1x * px + e1y * py + e1z * pz;
    if (determinant === 0) return null;
    const [sx, sy, sz] = [o[0] - at(0, 0), o[1] - at(0, 1), o[2] - at(0, 2)];
    const u = (sx * px + sy * py + sz * pz) / determinant;
    const [qx, qy, qz] = [sy * e1z - sz * e1y, sz * e1x - sx * e1z, sx * e1y - sy * e1x];
    const v = (d[0] * qx + d[1] * qy + d[2] * qz) / determinant;
    const distance = (e2x * qx + e2y * qy + e2z * qz) / determinant;
    if (u < 0 || v < 0 || u + v > 1 || distance <= 0) return null;
    return { triangle: t, weights: [1 - u - v, u, v], distance };
  }
}

/** Triangles by cells of the UV square. */
export class UvGrid {
  private readonly side: number;
  private readonly starts: Uint32Array;
  private readonly members: Uint32Array;

  constructor(private readonly uv: Float32Array, private readonly triangles: Uint32Array) {
    const n = triangles.length / 3;
    this.side = Math.max(1, Math.min(1024, Math.round(Math.sqrt(n / 2))));
    const counts = new Uint32Array(this.side * this.side + 1);
    this.each((cell) => counts[cell + 1]++);
    for (let k = 1; k < counts.length; k++) counts[k] += counts[k - 1];
    this.starts = counts.slice();
    this.members = new Uint32Array(counts[counts.length - 1]);
    this.each((cell, t) => (this.members[counts[cell]++] = t));
  }

  private cell(c: number): number {
    return Math.min(this.side - 1, Math.max(0, Math.floor(c * this.side)));
  }

  private each(visit: (cell: number, triangle: number) => void): void {
    for (let t = 0; t < this.triangles.length / 3; t++) {
      const [us, vs] = [0, 1].map((k) => [0, 1, 2].map((c) => this.uv[2 * this.triangles[3 * t + c] + k]));
      for (let row = this.cell(Math.min(...vs)); row <= this.cell(Math.max(...vs)); row++) {
        for (let column = this.cell(Math.min(...us)); column <= this.cell(Math.max(...us)); column++) visit(row * this.side + column, t);
      }
    }
  }

  /** The triangle that covers a place, if one does. */
  at(u: number, v: number): Hit | null {
    const cell = this.cell(v) * this.side + this.cell(u);
    for (let i = this.starts[cell]; i < this.starts[cell + 1]; i++) {
      const t = this.members[i];
      const at = (c: number, k: number): number => this.uv[2 * this.triangles[3 * t + c] + k];
      const area = (at(1, 0) - at(0, 0)) * (at(2, 1) - at(0, 1)) - (at(1, 1) - at(0, 1)) * (at(2, 0) - at(0, 0));
      if (area === 0) continue;
      const wb = ((u - at(0, 0)) * (at(2, 1) - at(0, 1)) - (v - at(0, 1)) * (at(2, 0) - at(0, 0))) / area;
      const wc = ((at(1, 0) - at(0, 0)) * (v - at(0, 1)) - (at(1, 1) - at(0, 1)) * (u - at(0, 0))) / area;
      if (wb >= -1e-6 && wc >= -1e-6 && wb + wc <= 1 + 2e-6) return { triangle: t, weights: [1 - wb - wc, wb, wc], distance: 0 };
    }
    return null;
  }
}
