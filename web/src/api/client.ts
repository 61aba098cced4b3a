/** Requests to the service. Whatever is not a success is thrown as a `Refusal` that carries a problem document. */

import { askOnce, credentials, key } from "./key";
import type { Estimate, Input, Job, JobRequest, Output, Problem } from "./types";

/** A request that did not succeed, and why. */
export class Refusal extends Error {
  constructor(readonly problem: Problem) {
    super(`${problem.title}: ${problem.detail}`);
  }
}

/** The problem of anything that was thrown. */
export function problemOf(error: unknown): Problem {
  if (error instanceof Refusal) return error.problem;
  const detail = error instanceof Error ? error.message : String(error);
  return { title: "something in this page failed", detail, code: "page" };
}

/** A request; a service that wants a key is asked again once one was given. */
export async function send(path: string, init: RequestInit = {}): Promise<Response> {
  for (;;) {
    const tried = key();
    let answer: Response;
    try {
      answer = await fetch(path, { ...init, headers: { ...credentials(), ...(init.headers as Record<string, string>) } });
    } catch (error) {
      if ((error as Error).name === "AbortError") throw error;
      throw new Refusal({
        title: "the service cannot be reached",
        detail: "No answer came. It may be stopped, or the connection was lost.",
        code: "unreachable",
      });
    }
    if (answer.ok || answer.status === 304) return answer;
    const problem = await readProblem(answer);
    // another request may have brought a key meanwhile
    if (answer.status === 401 && (key() !== tried || (await askOnce(`The service asks who its callers are: ${problem.detail}.`)))) continue;
    throw new Refusal(problem);
  }
}

async function readProblem(answer: Response): Promise<Problem> {
  const text = await answer.text();
  if (answer.headers.get("content-type")?.startsWith("application/problem+json")) {
    try {
      return JSON.parse(text) as Problem;
    } catch {
      // told below as what it is
    }
  }
  return {
    title: `the answer was ${answer.status} ${answer.statusText}`.trim(),
    detail: text.slice(0, 500) || "The answer has no body.",
    code: "no_problem_document",
    status: answer.status,
  };
}

const JSON_TYPE = { "content-type": "application/json" };

export async function submitJob(request: JobRequest): Promise<Job> {
  const headers = { ...JSON_TYPE, "idempotency-key": crypto.randomUUID?.() ?? `page-${Date.now()}-${Math.random()}` };
  return (await send("/v1/jobs", { method: "POST", headers, body: JSON.stringify(request) })).json();
}

/** What the job may cost, or a refusal with every fault. */
export async function estimate(request: JobRequest, signal: AbortSignal): Promise<Estimate> {
  const init = { method: "POST", headers: JSON_TYPE, body: JSON.stringify(request), signal };
  return (await send("/v1/jobs?validate_only=true", init)).json();
}

export async function readJob(id: string): Promise<Job> {
  return (await send(`/v1/jobs/${encodeURIComponent(id)}`)).json();
}

/** What the job was asked for by, with every default written out. */
export async function readRequest(id: string): Promise<JobRequest> {
  return (await send(`/v1/jobs/${encodeURIComponent(id)}/request`)).json();
}

export async function cancelJob(id: string): Promise<Job> {
  return (await send(`/v1/jobs/${encodeURIComponent(id)}/cancel`, { method: "POST" })).json();
}

/** Options of a field without which some files cannot be read: they are said when a file is uploaded, too. */
const READING = ["family", "encoding", "activation", "w0", "skip"];

/** The query of an upload that says those of a field's options that it takes. */
export function readingQuery(options: Record<string, unknown>): string {
  const said = READING.filter((name) => options[name] !== undefined).map((name) => {
    const value = options[name];
    return [name, typeof value === "string" ? value : JSON.stringify(value)];
  });
  return said.length > 0 ? `?${new URLSearchParams(said)}` : "";
}

export async function uploadInput(file: Blob, options: Record<string, unknown>): Promise<Input> {
  const headers = { "content-type": "application/octet-stream" };
  return (await send(`/v1/inputs${readingQuery(options)}`, { method: "POST", headers, body: file })).json();
}

/** All bytes of an output, or some of them. */
export async function outputBytes(output: Output, range?: [from: number, to: number]): Promise<ArrayBuffer> {
  const headers: Record<string, string> = range ? { range: `bytes=${range[0]}-${range[1] - 1}` } : {};
  return (await send(output.href, { headers })).arrayBuffer();
}

/** An address for an image or a link: the output's own, or that of a copy where a key is needed to read it. */
export async function outputAddress(output: Output): Promise<string> {
  if (!key()) return output.href;
  const copy = new Blob([await outputBytes(output)], { type: output.media_type });
  return URL.createObjectURL(copy);
}
