/** The example scenes, put into the page when it is built, and what can be said of a scene without the service. */

const files = import.meta.glob<string>("../../../examples/scenes/**/*.json", { query: "?raw", import: "default", eager: true });

export interface Example {
  name: string;
  text: string;
  planar: boolean;
}

export const EXAMPLES: Example[] = Object.entries(files)
  .map(([path, text]) => ({ name: /([^/]+)\.json$/.exec(path)![1], text: text.trimEnd(), planar: path.includes("/2d/") }))
  .sort((a, b) => Number(a.planar) - Number(b.planar) || a.name.localeCompare(b.name));

/** A scene's name for a person. */
export function title(name: string): string {
  const words = name.replaceAll("_", " ");
  return words.charAt(0).toUpperCase() + words.slice(1);
}

/** Whether a scene is one of dimension 2: the first shape in it tells. */
export function isPlanar(scene: unknown): boolean {
  if (typeof scene !== "object" || scene === null) return false;
  for (const [kind, members] of Object.entries(scene as Record<string, unknown>)) {
    if (["circle", "rectangle", "polygon"].includes(kind)) return true;
    const inner = (members ?? {}) as Record<string, unknown>;
    if (kind === "capsule") return Array.isArray(inner.from) && inner.from.length === 2;
    if (kind === "half_space") return Array.isArray(inner.normal) && inner.normal.length === 2;
    const of = inner.of;
    if (of !== undefined) return isPlanar(Array.isArray(of) ? of[0] : of);
  }
  return false;
}

/** Where in a JSON text the value of a pointer begins and ends, or the nearest value above it. */
export function locate(text: string, pointer: string): [from: number, to: number] | null {
  const path = pointer.split("/").slice(1).map((part) => part.replaceAll("~1", "/").replaceAll("~0", "~"));
  let position = 0;
  const space = (): void => {
    while (/\s/.test(text[position] ?? "")) position++;
  };
  const string = (): string => {
    const begin = position++;
    while (position < text.length && text[position] !== '"') position += text[position] === "\\" ? 2 : 1;
    return JSON.parse(text.slice(begin, ++position)) as string;
  };
  let found: [number, number] | null = null;
  const value = (depth: number, wanted: boolean): void => {
    space();
    const begin = position;
    const open = text[position];
    if (open === "{" || open === "[") {
      position++;
      for (let k = 0; ; k++) {
        space();
        if (text[position] === "}" || text[position] === "]" || position >= text.length) break;
        let name = String(k);
        const key = position;
        if (open === "{") {
          name = string();
          space();
          position++;
        }
        const match = wanted && path[depth] === name;
        value(depth + 1, match);
        // a member is marked with its name, which may be what is wrong
        if (match && depth === path.length - 1) found = [key, position];
        space();
        if (text[position] === ",") position++;
      }
      position++;
    } else if (open === '"') string();
    else while (position < text.length && !/[\s,\]}]/.test(text[position])) position++;
    if (wanted) found ??= [begin, position];
  };
  try {
    value(0, true);
  } catch {
    return null;
  }
  return found;
}
