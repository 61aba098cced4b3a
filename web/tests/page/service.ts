/** The service that the tests speak to: the real program on a free port, with a folder of its own, and the built page before it. */

import { spawn, spawnSync, type ChildProcess } from "node:child_process";
import { once } from "node:events";
import { mkdtempSync, readFileSync, rmSync } from "node:fs";
import http from "node:http";
import { tmpdir } from "node:os";
import { extname, join } from "node:path";
import { createInterface } from "node:readline";

const PROGRAM = process.env.SHRINKD ?? join(import.meta.dirname, "../../../target/release/shrinkd");
const DIST = join(import.meta.dirname, "../../dist");
/** What the program says beside the page; a test fails when the page needs more. */
export const POLICY =
  "default-src 'self'; img-src 'self' data: blob:; connect-src 'self' blob: data:; style-src 'self'; script-src 'self'; " +
  "worker-src 'self' blob:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'";
const TYPES: Record<string, string> = { ".html": "text/html", ".js": "text/javascript", ".css": "text/css", ".svg": "image/svg+xml" };

export interface Service {
  /** Address of the page, without a slash at the end. */
  address: string;
  /** Address of the service itself. */
  api: string;
  /** A new key of the tenant `team`. */
  key(): string;
  /** Ends the service, and starts it again at the same place. */
  restart(): Promise<void>;
  stop(): Promise<void>;
}

/** Starts the service; with `keys` it asks who its callers are. */
export async function startService(keys = false): Promise<Service> {
  const data = mkdtempSync(join(tmpdir(), "shrinkd-page-"));
  const environment = { ...process.env, SHRINKD_LOG__FORMAT: "json", ...(keys ? { SHRINKD_AUTH__MODE: "required" } : {}) };
  let { process: child, address: listening } = await launch(data, "127.0.0.1:0", environment);
  const api = `http://${listening}`;
  const front = (await servesThePage(api)) ? null : await startFront(api);
  return {
    api,
    address: front?.address ?? api,
    key: () => {
      const made = spawnSync(PROGRAM, ["keys", "create", "--tenant", "team", "--scope", "read,write", "--data", data], { encoding: "utf8" });
      const found = /shrinkd_\w+/.exec(made.stdout);
      if (!found) throw new Error(`no key was made: ${made.stderr}`);
      return found[0];
    },
    restart: async () => {
      await end(child);
      ({ process: child } = await launch(data, listening, environment));
    },
    stop: async () => {
      await end(child);
      front?.server.close();
      front?.server.closeAllConnections();
      rmSync(data, { recursive: true, force: true });
    },
  };
}

async function launch(data: string, listen: string, env: NodeJS.ProcessEnv): Promise<{ process: ChildProcess; address: string }> {
  const child = spawn(PROGRAM, ["serve", "--listen", listen, "--data", data], { env, stdio: ["ignore", "ignore", "pipe"] });
  const lines = createInterface({ input: child.stderr! });
  const address = await new Promise<string>((resolve, reject) => {
    child.once("error", reject);
    child.once("exit", (code) => reject(new Error(`the service ended with ${code}`)));
    lines.on("line", (line) => {
      const entry = JSON.parse(line) as Record<string, string>;
      if (entry.message === "listening") resolve(entry["http.address"]);
    });
  });
  child.removeAllListeners("exit");
  return { process: child, address };
}

async function end(child: ChildProcess): Promise<void> {
  if (child.exitCode !== null) return;
  child.kill("SIGKILL");
  await once(child, "exit");
}

async function servesThePage(api: string): Promise<boolean> {
  return (await (await fetch(api)).text()).includes('<div id="app"');
}

/** Stands in for the program while it has no page embedded: files of `dist` with its policy, the rest handed on. */
async function startFront(api: string): Promise<{ server: http.Server; address: string }> {
  const server = http.createServer((request, answer) => {
    const path = new URL(request.url!, api).pathname;
    if (path === "/" || path.startsWith("/assets/")) {
      try {
        const file = join(DIST, path === "/" ? "index.html" : path);
        const body = readFileSync(file);
        answer.writeHead(200, { "content-type": TYPES[extname(file)] ?? "application/octet-stream", "content-security-policy": POLICY });
        answer.end(body);
      } catch {
        answer.writeHead(404).end();
      }
      return;
    }
    const onward = http.request(new URL(request.url!, api), { method: request.method, headers: request.headers }, (reply) => {
      answer.writeHead(reply.statusCode!, reply.headers);
      reply.pipe(answer);
      reply.on("error", () => answer.destroy());
    });
    onward.on("error", () => answer.destroy());
    answer.on("close", () => onward.destroy());
    request.pipe(onward);
  });
  server.listen(0, "127.0.0.1");
  await once(server, "listening");
  return { server, address: `http://127.0.0.1:${(server.address() as { port: number }).port}` };
}
