import { describe, expect, it } from "vitest";
import { isPlanar, locate } from "../../src/form/scenes";
import { snippet, type Recipe } from "../../src/job/snippets";

const SCENE: Recipe = {
  base: "http://127.0.0.1:8080",
  request: { field: { scene: { sphere: { radius: 0.5 } } }, shrink: { relax_uv: true }, labels: { name: "it's $HOME" } },
  file: null,
  key: false,
};
const FILE: Recipe = { ...SCENE, request: { field: { input: "sha256:0", latent: [0.25, -1] }, labels: { name: "a" } }, file: "my net's.pth", key: true };

describe("programs", () => {
  it("hold the request as it is", () => {
    const body = /<<'JSON'[^\n]*\n([\s\S]*)\nJSON\n/.exec(snippet("curl", SCENE))![1];
    expect(JSON.parse(body)).toEqual(SCENE.request);
    expect(snippet("Python", SCENE)).toContain('"relax_uv": True');
    expect(snippet("Rust", SCENE)).toContain('"relax_uv": true');
  });

  it("upload a file first, and put its name in place of the one it had", () => {
    for (const language of ["curl", "Python", "Rust"] as const) {
      const text = snippet(language, FILE);
      expect(text).toContain("/v1/inputs");
      expect(text).not.toContain("sha256:0");
      expect(text).not.toContain("@input@");
      expect(text).toContain("SHRINKD_KEY");
    }
    expect(snippet("curl", FILE)).toContain("@'my net'\\''s.pth'");
    expect(snippet("curl", FILE)).toContain('"input": "$INPUT"');
    expect(snippet("Rust", FILE)).toContain('"input": input,');
  });

  it("say what a file does not say when they upload it, too", () => {
    const request = { field: { input: "sha256:0", w0: [30, 1], family: "siren", domain: "fit" } };
    for (const language of ["curl", "Python", "Rust"] as const) {
      expect(snippet(language, { ...FILE, request })).toContain("/v1/inputs?family=siren&w0=%5B30%2C1%5D");
    }
  });

  it("in Rust are compiled with the service's examples", async () => {
    const request = { field: { input: "sha256:0", latent_row: 1 }, shrink: { lattice: { octahedral: { n: 24 } }, relax_uv: true }, labels: { name: "blob" } };
    const program = snippet("Rust", { base: SCENE.base, request, file: "blob.safetensors", key: true });
    await expect(`${program}\n`).toMatchFileSnapshot("../../../examples/page_program.rs");
  });

  it("let the shell read nothing in a request with an input", () => {
    const text = snippet("curl", { ...FILE, request: { ...FILE.request, labels: { name: "`id` $HOME \\" } } });
    expect(text).toContain("\\`id\\` \\$HOME");
  });
});

describe("scenes", () => {
  it("say whether they are planar", () => {
    expect(isPlanar({ translate: { by: [1, 0], of: { circle: { radius: 1 } } } })).toBe(true);
    expect(isPlanar({ union: { of: [{ capsule: { from: [0, 0], to: [1, 1], radius: 1 } }] } })).toBe(true);
    expect(isPlanar({ union: { of: [{ capsule: { from: [0, 0, 0], to: [1, 1, 1], radius: 1 } }] } })).toBe(false);
    expect(isPlanar({ extrude: { polygon: [[0, 0]], half_height: 1 } })).toBe(false);
    expect(isPlanar(null)).toBe(false);
  });

  it("are searched by pointers", () => {
    const text = '{ "union": {"of": [ {"sphere": {"radios": 1}}, {"box": {"half_extents": [1, 2, "x"]}} ]} }';
    const found = (pointer: string): string => text.slice(...locate(text, pointer)!);
    expect(found("/union/of/0/sphere/radios")).toBe('"radios": 1');
    expect(found("/union/of/1/box/half_extents/2")).toBe('"x"');
    // what is not there leads to what it should be in
    expect(found("/union/of/0/sphere/radius")).toBe('{"radios": 1}');
  });
});
