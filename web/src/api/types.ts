/** The parts of the service's documents that the page reads; `openapi.yaml` has them in full. */

import type { Lattice } from "../view/lattice";

export type State = "queued" | "running" | "canceling" | "succeeded" | "failed" | "canceled";

export interface Progress {
  stage: string;
  attempt: number;
  fraction: number;
  energy: number | null;
  max_distance: number | null;
  flips: number | null;
  eta_s: number | null;
}

export interface Output {
  name: string;
  href: string;
  media_type: string;
  bytes: number;
  sha256: string;
  certified?: boolean;
}

export interface Fault {
  pointer: string;
  code: string;
  detail: string;
}

/** A problem document, or the one inside a failed job. */
export interface Problem {
  type?: string;
  title: string;
  detail: string;
  code: string;
  status?: number;
  request_id?: string;
  errors?: Fault[];
  places?: number[][];
  hint?: string;
}

export interface Job {
  id: string;
  kind: string;
  state: State;
  attempt: number;
  created_at: string;
  started_at: string | null;
  finished_at: string | null;
  labels: Record<string, string>;
  shrink?: { method: string; lattice: Lattice; [option: string]: unknown } | null;
  progress: Progress | null;
  metrics: Record<string, unknown> | null;
  outputs: Output[];
  problem: Problem | null;
}

/** The body of a job's request, as the page makes it. */
export interface JobRequest {
  field: { scene?: unknown; input?: string; latent?: number[]; latent_row?: number; [option: string]: unknown };
  shrink?: Record<string, unknown>;
  outputs?: string[];
  labels?: Record<string, string>;
}

export interface Input {
  id: string;
  bytes: number;
  description: { kind: "scene" | "network" | "mesh" | "grid"; [member: string]: unknown };
}

export interface Estimate {
  valid: boolean;
  vertices: number;
  evaluations: number;
  memory_bytes: number;
}

export interface MeshEvent {
  vertices: number;
  faces: number;
  origin: [number, number, number];
  step: [number, number, number];
  positions: string;
  triangles: string;
  index_bytes: number;
  places?: string;
}

/** Whether a job has come to its end. */
export function ended(state: State): boolean {
  return state === "succeeded" || state === "failed" || state === "canceled";
}
