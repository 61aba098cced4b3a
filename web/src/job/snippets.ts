/** The same job as programs that can be run: curl, Python with requests, and Rust with reqwest. */

import { readingQuery } from "../api/client";
import type { JobRequest } from "../api/types";

/** What a program needs to know to make a job. */
export interface Recipe {
  /** Where the service is, without a slash at the end. */
  base: string;
  request: JobRequest;
  /** Name of the file that is uploaded first, where the field is an input. */
  file: string | null;
  /** Whether the service wants a key, which is then read from SHRINKD_KEY. */
  key: boolean;
}

export const LANGUAGES = ["curl", "Python", "Rust"] as const;
export type Language = (typeof LANGUAGES)[number];

/** The program. */
export function snippet(language: Language, recipe: Recipe): string {
  return { curl, Python: python, Rust: rust }[language](recipe);
}

/** Where the file is uploaded to. */
function upload({ request }: Recipe): string {
  return `/v1/inputs${readingQuery(request.field)}`;
}

/** The name a result is saved under. */
function target({ request }: Recipe): string {
  return `${(request.labels?.name ?? "shape").replace(/[^A-Za-z0-9_-]+/g, "_")}.glb`;
}

/** Stands for the name of the uploaded input while JSON is written. */
const PLACEHOLDER = "@input@";

function withPlaceholder(recipe: Recipe): JobRequest {
  const { request, file } = recipe;
  return file === null ? request : { ...request, field: { ...request.field, input: PLACEHOLDER } };
}

/** A word of a POSIX shell. */
function quoted(text: string): string {
  return /^[A-Za-z0-9_./:@%+=-]+$/.test(text) ? text : `'${text.replaceAll("'", "'\\''")}'`;
}

function curl(recipe: Recipe): string {
  const key = recipe.key ? ` -H "authorization: Bearer $SHRINKD_KEY"` : "";
  const id = `sed -n 's/^{"id":"\\([^"]*\\)".*/\\1/p'`;
  const body = JSON.stringify(withPlaceholder(recipe), null, 2);
  const lines = [`BASE=${quoted(recipe.base)}`];
  if (recipe.file !== null) {
    lines.push(`INPUT=$(curl -sS --fail-with-body${key} --data-binary @${quoted(recipe.file)} "$BASE${upload(recipe)}" | ${id})`);
    // a body with the name of the input put in must be open to the shell, so what else it could read is guarded
    const open = body.replace(/[\\$`]/g, "\\$&").replace(PLACEHOLDER, "$INPUT");
    lines.push(`JOB=$(curl -sS --fail-with-body${key} -H 'content-type: application/json' --data-binary @- "$BASE/v1/jobs" <<JSON | ${id}`, open, "JSON", ")");
  } else {
    lines.push(`JOB=$(curl -sS --fail-with-body${key} -H 'content-type: application/json' --data-binary @- "$BASE/v1/jobs" <<'JSON' | ${id}`, body, "JSON", ")");
  }
  lines.push(
    "# the events end when the job has ended",
    `curl -sSN${key} "$BASE/v1/jobs/$JOB/events" > /dev/null`,
    `curl -sS --fail-with-body${key} "$BASE/v1/jobs/$JOB/outputs/glb" -o ${quoted(target(recipe))}`,
  );
  return lines.join("\n");
}

function python(recipe: Recipe): string {
  const body = pythonLiteral(withPlaceholder(recipe), 0).replace(`"${PLACEHOLDER}"`, "input_id");
  return [
    ...(recipe.key ? ["import os"] : []),
    "import requests",
    "",
    `base = ${JSON.stringify(recipe.base)}`,
    "session = requests.Session()",
    ...(recipe.key ? [`session.headers["Authorization"] = f"Bearer {os.environ['SHRINKD_KEY']}"`] : []),
    "",
    "def checked(answer):",
    "    if not answer.ok:",
    "        raise SystemExit(answer.text)",
    "    return answer",
    "",
    ...(recipe.file === null
      ? []
      : [`with open(${JSON.stringify(recipe.file)}, "rb") as file:`, `    input_id = checked(session.post(f"{base}${upload(recipe)}", data=file)).json()["id"]`, ""]),
    `request = ${body}`,
    `job = checked(session.post(f"{base}/v1/jobs", json=request)).json()`,
    `while job["state"] not in ("succeeded", "failed", "canceled"):`,
    `    job = checked(session.get(f"{base}/v1/jobs/{job['id']}", params={"wait": 30})).json()`,
    `if job["state"] != "succeeded":`,
    `    raise SystemExit(f"{job['state']}: {job['problem']}")`,
    `glb = checked(session.get(f"{base}/v1/jobs/{job['id']}/outputs/glb"))`,
    `with open(${JSON.stringify(target(recipe))}, "wb") as file:`,
    "    file.write(glb.content)",
  ].join("\n");
}

/** A value as Python writes it. */
function pythonLiteral(value: unknown, depth: number): string {
  const inner = "    ".repeat(depth + 1);
  const close = "    ".repeat(depth);
  if (value === null || value === undefined) return "None";
  if (value === true) return "True";
  if (value === false) return "False";
  if (Array.isArray(value)) {
    const items = value.map((item) => pythonLiteral(item, depth + 1));
    const short = `[${items.join(", ")}]`;
    return short.length < 80 && !short.includes("\n") ? short : `[\n${items.map((item) => inner + item).join(",\n")},\n${close}]`;
  }
  if (typeof value === "object") {
    const items = Object.entries(value).map(([name, item]) => `${JSON.stringify(name)}: ${pythonLiteral(item, depth + 1)}`);
    const short = `{${items.join(", ")}}`;
    return short.length < 80 && !short.includes("\n") ? short : `{\n${items.map((item) => inner + item).join(",\n")},\n${close}}`;
  }
  return JSON.stringify(value);
}

function rust(recipe: Recipe): string {
  const body = JSON.stringify(withPlaceholder(recipe), null, 4)
    .replace(`"${PLACEHOLDER}"`, "input")
    .replaceAll("\n", "\n    ");
  return [
    "//! Submits a job, waits for its end and saves what it made. Needs: cargo add serde_json; cargo add reqwest --features blocking,json",
    "",
    "use reqwest::blocking::{Client, RequestBuilder, Response};",
    "use serde_json::{Value, json};",
    "use std::error::Error;",
    "",
    "fn answer(request: RequestBuilder) -> Result<Response, Box<dyn Error>> {",
    recipe.key ? `    let answer = request.bearer_auth(std::env::var("SHRINKD_KEY")?).send()?;` : "    let answer = request.send()?;",
    "    if answer.status().is_success() { Ok(answer) } else { Err(answer.text()?.into()) }",
    "}",
    "",
    "fn main() -> Result<(), Box<dyn Error>> {",
    `    let base = ${JSON.stringify(recipe.base)};`,
    "    let client = Client::new();",
    ...(recipe.file === null
      ? []
      : [
          `    let file = std::fs::read(${JSON.stringify(recipe.file)})?;`,
          `    let described: Value = answer(client.post(format!("{base}${upload(recipe)}")).body(file))?.json()?;`,
          `    let input = described["id"].as_str().ok_or("no id")?;`,
        ]),
    `    let request = json!(${body});`,
    `    let mut job: Value = answer(client.post(format!("{base}/v1/jobs")).json(&request))?.json()?;`,
    `    let id = job["id"].as_str().ok_or("no id")?.to_owned();`,
    `    while !["succeeded", "failed", "canceled"].contains(&job["state"].as_str().unwrap_or_default()) {`,
    `        job = answer(client.get(format!("{base}/v1/jobs/{id}?wait=20")))?.json()?;`,
    "    }",
    `    if job["state"] != "succeeded" {`,
    `        return Err(format!("{}: {}", job["state"], job["problem"]).into());`,
    "    }",
    `    let glb = answer(client.get(format!("{base}/v1/jobs/{id}/outputs/glb")))?.bytes()?;`,
    `    std::fs::write(${JSON.stringify(target(recipe))}, glb)?;`,
    "    Ok(())",
    "}",
  ].join("\n");
}
