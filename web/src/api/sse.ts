/** Server-sent events over `fetch`, which can carry a key where `EventSource` cannot. */

import { Refusal, send } from "./client";

export interface ServerEvent {
  type: string;
  data: string;
  id: string;
}

/** Takes the text of a stream in pieces, cut anywhere, and gives its events (WHATWG HTML, section 9.2). */
export class EventParser {
  /** Milliseconds to wait before coming back, as the stream said. */
  retry: number | null = null;
  /** The last number that was seen. */
  lastId = "";
  private rest = "";
  private type = "";
  private data: string[] = [];
  private begun = false;

  push(text: string): ServerEvent[] {
    this.rest += text;
    if (!this.begun && this.rest.length > 0) {
      this.rest = this.rest.replace(/^\uFEFF/, "");
      this.begun = true;
    }
    const events: ServerEvent[] = [];
    for (;;) {
      const end = /\r\n|\n|\r/.exec(this.rest);
      // a carriage return at the very end may be half of a line's end
      if (!end || (end[0] === "\r" && end.index === this.rest.length - 1)) return events;
      const line = this.rest.slice(0, end.index);
      this.rest = this.rest.slice(end.index + end[0].length);
      const event = this.line(line);
      if (event) events.push(event);
    }
  }

  private line(line: string): ServerEvent | null {
    if (line === "") {
      const event = this.data.length > 0 ? { type: this.type || "message", data: this.data.join("\n"), id: this.lastId } : null;
      this.type = "";
      this.data = [];
      return event;
    }
    const colon = line.indexOf(":");
    if (colon === 0) return null;
    const field = colon < 0 ? line : line.slice(0, colon);
    const value = colon < 0 ? "" : line.slice(colon + 1).replace(/^ /, "");
    if (field === "event") this.type = value;
    else if (field === "data") this.data.push(value);
    else if (field === "id" && !value.includes("\0")) this.lastId = value;
    else if (field === "retry" && /^\d+$/.test(value)) this.retry = Number(value);
    return null;
  }
}

export interface Follower {
  event(type: string, data: unknown): void;
  /** The stream was cut, and is tried again after so many milliseconds; `null` when it is there again. */
  cut(again: number | null): void;
  signal: AbortSignal;
}

/** Milliseconds before coming back when the stream said nothing. */
const RETRY = 2000;

/** Follows a job from its first event to `done`, coming back after cuts with the last number seen. */
export async function follow(id: string, follower: Follower): Promise<void> {
  const parser = { lastId: "0", retry: RETRY };
  let cut = false;
  while (!follower.signal.aborted) {
    try {
      const done = await read(id, parser, follower, () => {
        if (cut) follower.cut(null);
        cut = false;
      });
      if (done) return;
    } catch (error) {
      if (follower.signal.aborted) return;
      const passing = error instanceof Refusal ? error.problem.code === "unreachable" || (error.problem.status ?? 0) >= 500 : error instanceof TypeError;
      if (!passing) throw error;
    }
    cut = true;
    follower.cut(parser.retry);
    await pause(parser.retry, follower.signal);
  }
}

/** Reads one connection; true when nothing comes after it. */
async function read(id: string, known: { lastId: string; retry: number }, follower: Follower, open: () => void): Promise<boolean> {
  const headers = { accept: "text/event-stream", "last-event-id": known.lastId };
  const answer = await send(`/v1/jobs/${encodeURIComponent(id)}/events`, { headers, signal: follower.signal, cache: "no-store" });
  open();
  if (answer.status === 204 || !answer.body) return true;
  const parser = new EventParser();
  parser.lastId = known.lastId;
  const reader = answer.body.pipeThrough(new TextDecoderStream()).getReader();
  for (;;) {
    const { value, done } = await reader.read();
    if (done) return false;
    for (const event of parser.push(value)) {
      known.lastId = event.id;
      follower.event(event.type, JSON.parse(event.data));
      if (event.type === "done") {
        await reader.cancel();
        return true;
      }
    }
    known.retry = parser.retry ?? known.retry;
  }
}

function pause(milliseconds: number, signal: AbortSignal): Promise<void> {
  return new Promise((resolve) => {
    const timer = setTimeout(resolve, milliseconds);
    signal.addEventListener("abort", () => (clearTimeout(timer), resolve()), { once: true });
  });
}
