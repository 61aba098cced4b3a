/** The front while it shrinks: decoding `mesh` events, and a place on the sphere for every vertex. */

import type { MeshEvent } from "../api/types";
import { bounds } from "./surface";

export interface Front {
  positions: Float32Array;
  triangles: Uint32Array;
  /** Unit vectors: where on the sphere each vertex is. */
  places: Float32Array;
  /** The places of the front before, carried along, where the event had its own: their checkerboard fades into that of `places`. */
  carried: Float32Array | null;
  /** Where each vertex comes from on the front before, so that one front flows into the next. */
  from: Float32Array;
}

/** Positions, triangles and, where the event has them, places. */
export function decode(event: MeshEvent): { positions: Float32Array; triangles: Uint32Array; places: Float32Array | null } {
  const quantized = view16(event.positions);
  const positions = new Float32Array(3 * event.vertices);
  for (let k = 0; k < positions.length; k++) positions[k] = event.origin[k % 3] + quantized.getUint16(2 * k, true) * event.step[k % 3];
  const indices = view16(event.triangles);
  const triangles = new Uint32Array(3 * event.faces);
  for (let k = 0; k < triangles.length; k++) {
    triangles[k] = event.index_bytes === 2 ? indices.getUint16(2 * k, true) : indices.getUint32(4 * k, true);
  }
  if (event.places === undefined) return { positions, triangles, places: null };
  const units = view16(event.places);
  const places = new Float32Array(3 * event.vertices);
  for (let k = 0; k < places.length; k++) places[k] = units.getInt16(2 * k, true) / 32767;
  return { positions, triangles, places: normalized(places) };
}

function view16(base64: string): DataView {
  return new DataView(Uint8Array.from(atob(base64), (c) => c.charCodeAt(0)).buffer);
}

/** The first front: places are directions from its middle, and it comes from a ball around it. */
export function firstFront(event: MeshEvent): Front {
  const { positions, triangles, places } = decode(event);
  const { middle, radius } = bounds(positions);
  const outward = normalized(positions.map((c, k) => c - middle[k % 3]));
  return { positions, triangles, places: places ?? outward, carried: places && outward, from: outward.map((c, k) => middle[k % 3] + radius * c) };
}

/** A later front: places flow on from the nearest vertices of the front before, until the event has its own. */
export function nextFront(event: MeshEvent, before: Front): Front {
  const { positions, triangles, places } = decode(event);
  const cells = new Cells(before.positions);
  const carried = new Float32Array(positions.length);
  const from = new Float32Array(positions.length);
  for (let v = 0; v < positions.length; v += 3) {
    const nearest = cells.nearest(positions[v], positions[v + 1], positions[v + 2]);
    let total = 0;
    for (const [w, distance] of nearest) {
      const weight = 1 / (distance + 1e-9);
      total += weight;
      for (let k = 0; k < 3; k++) {
        carried[v + k] += weight * before.places[3 * w + k];
        from[v + k] += weight * before.positions[3 * w + k];
      }
    }
    for (let k = 0; k < 3; k++) from[v + k] /= total || 1;
  }
  const flown = normalized(carried);
  return { positions, triangles, places: places ?? flown, carried: places && flown, from };
}

function normalized(vectors: Float32Array): Float32Array {
  for (let k = 0; k < vectors.length; k += 3) {
    const length = Math.hypot(vectors[k], vectors[k + 1], vectors[k + 2]);
    if (length > 0) for (let j = 0; j < 3; j++) vectors[k + j] /= length;
    else vectors[k + 2] = 1;
  }
  return vectors;
}

/** Points in cubic cells, for the nearest three. */
class Cells {
  private readonly cells = new Map<number, number[]>();
  private readonly low: number[];
  private readonly size: number;
  private static readonly SIDE = 1024;

  constructor(private readonly points: Float32Array) {
    const box = bounds(points);
    this.low = box.low;
    // a surface of n points has one in each of some n cells of this size
    this.size = Math.max(box.diagonal / Math.sqrt(Math.max(1, points.length / 3)), 1e-9);
    for (let v = 0; v < points.length / 3; v++) {
      const cell = this.cell([0, 1, 2].map((k) => this.along(points[3 * v + k], k)));
      const members = this.cells.get(cell);
      if (members) members.push(v);
      else this.cells.set(cell, [v]);
    }
  }

  private along(coordinate: number, axis: number): number {
    return Math.min(Cells.SIDE - 2, Math.max(1, 1 + Math.floor((coordinate - this.low[axis]) / this.size)));
  }

  private cell([i, j, k]: number[]): number {
    return (i * Cells.SIDE + j) * Cells.SIDE + k;
  }

  /** At most three vertices and their distances, nearest first. */
  nearest(x: number, y: number, z: number): [vertex: number, distance: number][] {
    const centre = [this.along(x, 0), this.along(y, 1), this.along(z, 2)];
    const found: [number, number][] = [];
    let ringsLeft = Infinity;
    for (let ring = 0; ring < Cells.SIDE && ringsLeft > 0; ring++, ringsLeft--) {
      for (const cell of shell(centre, ring)) {
        for (const v of this.cells.get(this.cell(cell)) ?? []) {
          found.push([v, Math.hypot(this.points[3 * v] - x, this.points[3 * v + 1] - y, this.points[3 * v + 2] - z)]);
        }
      }
      // what is nearer than anything found so far may still lie one ring further out
      if (found.length >= 3 && ringsLeft === Infinity) ringsLeft = 2;
    }
    return found.sort((a, b) => a[1] - b[1]).slice(0, 3);
  }
}

function* shell([i, j, k]: number[], ring: number): Generator<number[]> {
  for (let a = -ring; a <= ring; a++) {
    for (let b = -ring; b <= ring; b++) {
      const edge = Math.abs(a) === ring || Math.abs(b) === ring;
      for (let c = -ring; c <= ring; c += edge ? 1 : Math.max(1, 2 * ring)) {
        if (i + a >= 0 && j + b >= 0 && k + c >= 0) yield [i + a, j + b, k + c];
      }
    }
  }
}
