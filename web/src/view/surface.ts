/** A parameterized surface: vertices of the chart with their places in space, in the UV square and on the sphere. */

import { checkerPicture, type Picture } from "./colors";
import { direction, isOctahedral, type Lattice } from "./lattice";

export interface Surface {
  lattice: Lattice;
  positions: Float32Array;
  normals: Float32Array;
  uv: Float32Array;
  /** Places on the sphere as UVs; other than `uv` where the chart was relaxed. */
  sphereUv: Float32Array;
  triangles: Uint32Array;
  texture: Picture;
}

/** Triangles of a surface. */
export function triangleCount(surface: Surface): number {
  return surface.triangles.length / 3;
}

/** The unit ball before anything was shrunk, with the lattice's own chart. */
export function ball(lattice: Lattice, columns = 96): Surface {
  const octahedral = isOctahedral(lattice);
  const rows = octahedral ? columns : columns / 2;
  const positions: number[] = [];
  const uv: number[] = [];
  const triangles: number[] = [];
  const add = (u: number, v: number, at = direction(u, v, octahedral)): number => {
    positions.push(...at);
    uv.push(u, v);
    return uv.length / 2 - 1;
  };
  for (let row = 0; row <= rows; row++) {
    for (let column = 0; column <= columns; column++) add(column / columns, row / rows);
  }
  const at = (row: number, column: number): number => row * (columns + 1) + column;
  for (let row = 0; row < rows; row++) {
    for (let column = 0; column < columns; column++) {
      const [nw, sw, se, ne] = [at(row, column), at(row + 1, column), at(row + 1, column + 1), at(row, column + 1)];
      if (!octahedral && row === 0) triangles.push(add((column + 0.5) / columns, 0), sw, se);
      else if (!octahedral && row === rows - 1) triangles.push(nw, add((column + 0.5) / columns, 1), ne);
      // the diagonal lies along |a| + |b| = const
      else if (octahedral && row < rows / 2 === column < columns / 2) triangles.push(sw, se, ne, sw, ne, nw);
      else triangles.push(nw, sw, se, nw, se, ne);
    }
  }
  const places = new Float32Array(positions);
  const square = new Float32Array(uv);
  return {
    lattice,
    positions: places,
    normals: places,
    uv: square,
    sphereUv: square,
    triangles: new Uint32Array(triangles),
    texture: checkerPicture(octahedral),
  };
}

/** Middle and radius of a ball around all positions, and their bounding box. */
export function bounds(positions: Float32Array): { low: number[]; high: number[]; middle: number[]; radius: number; diagonal: number } {
  const low = [Infinity, Infinity, Infinity];
  const high = [-Infinity, -Infinity, -Infinity];
  for (let k = 0; k < positions.length; k++) {
    low[k % 3] = Math.min(low[k % 3], positions[k]);
    high[k % 3] = Math.max(high[k % 3], positions[k]);
  }
  const middle = low.map((l, k) => (l + high[k]) / 2);
  let radius = 0;
  for (let k = 0; k < positions.length; k += 3) {
    radius = Math.max(radius, Math.hypot(positions[k] - middle[0], positions[k + 1] - middle[1], positions[k + 2] - middle[2]));
  }
  return { low, high, middle, radius, diagonal: Math.hypot(high[0] - low[0], high[1] - low[1], high[2] - low[2]) };
}

/** Unit normals of vertices, the mean of their triangles' by area. */
export function vertexNormals(positions: Float32Array, triangles: Uint32Array): Float32Array {
  const normals = new Float32Array(positions.length);
  for (let t = 0; t < triangles.length; t += 3) {
    const [a, b, c] = [3 * triangles[t], 3 * triangles[t + 1], 3 * triangles[t + 2]];
    const ux = positions[b] - positions[a], uy = positions[b + 1] - positions[a + 1], uz = positions[b + 2] - positions[a + 2];
    const vx = positions[c] - positions[a], vy = positions[c + 1] - positions[a + 1], vz = positions[c + 2] - positions[a + 2];
    const n = [uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx];
    for (const corner of [a, b, c]) for (let k = 0; k < 3; k++) normals[corner + k] += n[k];
  }
  for (let k = 0; k < normals.length; k += 3) {
    const length = Math.hypot(normals[k], normals[k + 1], normals[k + 2]) || 1;
    for (let j = 0; j < 3; j++) normals[k + j] /= length;
  }
  return normals;
}
