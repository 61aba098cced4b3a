/** The requests that were sent from this browser, by job: a record of a job does not say what its field was. */

import type { JobRequest } from "../api/types";

const STORED = "shrinkd.requests";
/** Requests that are kept; the oldest go first. */
const KEPT = 60;

export interface Sent {
  request: JobRequest;
  /** Name of the file that the input was, where there was one. */
  file: string | null;
}

function all(): [id: string, sent: Sent][] {
  try {
    return JSON.parse(localStorage.getItem(STORED) ?? "[]") as [string, Sent][];
  } catch {
    return [];
  }
}

/** What was sent for a job, if it was sent from here. */
export function sentFor(id: string): Sent | null {
  return all().find(([known]) => known === id)?.[1] ?? null;
}

/** Keeps what was sent. A full store loses the older half. */
export function keepSent(id: string, sent: Sent): void {
  const kept = [[id, sent] as [string, Sent], ...all()].slice(0, KEPT);
  for (let length = kept.length; length > 0; length = Math.floor(length / 2)) {
    try {
      localStorage.setItem(STORED, JSON.stringify(kept.slice(0, length)));
      return;
    } catch {
      // too much: fewer
    }
  }
}
