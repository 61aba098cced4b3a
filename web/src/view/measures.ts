/** Figures per triangle: how the map stretches areas, and how far the surface is from the zero level set. */

import { direction, isOctahedral } from "./lattice";
import { bounds, triangleCount, type Surface } from "./surface";

/**
 * Area on the surface over area on the sphere of every triangle, with both totals the same: 1 where the map keeps areas. Triangles on
 * the sphere are flat, between the directions of their corners, as in the report's `distortion.sphere`.
 */
export function areaRatios(surface: Surface): Float32Array {
  const octahedral = isOctahedral(surface.lattice);
  const vertices = surface.sphereUv.length / 2;
  const directions = new Float64Array(3 * vertices);
  for (let v = 0; v < vertices; v++) {
    directions.set(direction(surface.sphereUv[2 * v], surface.sphereUv[2 * v + 1], octahedral), 3 * v);
  }
  const n = triangleCount(surface);
  const ratios = new Float32Array(n);
  let [onSurface, onSphere] = [0, 0];
  for (let t = 0; t < n; t++) {
    const corners: [number, number, number] = [surface.triangles[3 * t], surface.triangles[3 * t + 1], surface.triangles[3 * t + 2]];
    const [here, there] = [area(surface.positions, corners), area(directions, corners)];
    ratios[t] = here / there;
    onSurface += here;
    onSphere += there;
  }
  return ratios.map((ratio) => (ratio * onSphere) / onSurface);
}

function area(points: ArrayLike<number>, [a, b, c]: [number, number, number]): number {
  const at = (v: number, k: number): number => points[3 * v + k] - points[3 * a + k];
  const [ux, uy, uz, vx, vy, vz] = [at(b, 0), at(b, 1), at(b, 2), at(c, 0), at(c, 1), at(c, 2)];
  return Math.hypot(uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx) / 2;
}

/** Distances in scene units as parts of the bounding box's diagonal. */
export function ofDiagonal(distances: Float32Array, surface: Surface): Float32Array {
  const { diagonal } = bounds(surface.positions);
  return distances.map((distance) => distance / diagonal);
}

/** The value that a share of all are not larger than. */
export function quantile(values: Float32Array, share: number): number {
  const sorted = Float32Array.from(values).sort();
  return sorted[Math.min(sorted.length - 1, Math.floor(share * sorted.length))];
}

/** The next larger of 1, 2, 5 times a power of ten: the end of a scale. */
export function roundUp(value: number): number {
  if (!(value > 0)) return 1;
  const power = 10 ** Math.floor(Math.log10(value));
  return [1, 2, 5, 10].map((k) => k * power).find((step) => step >= value * (1 - 1e-9))!;
}
