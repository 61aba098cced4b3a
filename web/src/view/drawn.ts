/** What the renderers draw. Both take the same, so that a machine without WebGL shows the same pictures. */

import type { Picture, Ramp } from "./colors";
import type { Sight } from "./camera";

export const MODES = ["checker", "grid", "normals", "area", "distance", "wireframe"] as const;
export type Mode = (typeof MODES)[number];

export interface Drawn {
  positions: Float32Array;
  normals: Float32Array;
  uv: Float32Array | null;
  /** Unit vectors: the checkerboard is then that of places on the sphere. */
  places: Float32Array | null;
  /** Places whose checkerboard fades into that of `places`. */
  carried: Float32Array | null;
  triangles: Uint32Array;
  texture: Picture | null;
  octahedral: boolean;
  /** Of every triangle, from 0 to 1 along the ramp. */
  values: Float32Array | null;
  ramp: Ramp | null;
  /** Whether light falls on it. */
  lit: boolean;
}

export interface Renderer {
  readonly name: "WebGL" | "Canvas 2D";
  /** Another shape, or other values on it. */
  take(drawn: Drawn): void;
  /** The same shape with vertices elsewhere, and how much of the checkerboard is that of `places`: all of it at 1. */
  move(positions: Float32Array, normals: Float32Array, arrived: number): void;
  draw(mode: Mode, sight: Sight): void;
  resize(width: number, height: number): void;
  dispose(): void;
}
