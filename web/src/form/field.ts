/** Choosing the field: an example, a scene written out, or a file that is uploaded and described. */

import { problemOf, uploadInput } from "../api/client";
import type { Fault, Input, JobRequest } from "../api/types";
import { announce, el, fill } from "../dom";
import { bytes, count } from "../format";
import { problemBox } from "../job/problem";
import { EXAMPLES, isPlanar, locate, title } from "./scenes";

/** The field as a request has it. */
export interface Chosen {
  field: JobRequest["field"];
  name: string;
  file: string | null;
  planar: boolean;
}

const FIRST = "starfish";
/** A longer file is uploaded, and not shown in the editor. */
const MOST_SCENE_BYTES = 200_000;

export class FieldChooser {
  readonly element: HTMLElement;
  private readonly examples: HTMLSelectElement;
  private readonly file = el("input", { type: "file", id: "file", class: "sr", "aria-label": "A file with a field", onchange: () => this.file.files?.[0] && this.read(this.file.files[0]) });
  private readonly scene = el("textarea", { id: "scene", rows: 9, spellcheck: "false", autocapitalize: "off", "aria-describedby": "scene-faults" });
  private readonly faults = el("ul", { class: "faults", id: "scene-faults" });
  private readonly editor: HTMLElement;
  private readonly described = el("div", { class: "described", "aria-live": "polite" });
  private readonly drop: HTMLElement;
  private readonly options = el("textarea", { id: "field-options", rows: 3, spellcheck: "false", autocapitalize: "off", placeholder: '{"w0": 12, "domain": {"min": [-1, -1, -1], "max": [1, 1, 1]}}' });
  private readonly said: HTMLElement;
  private input: Input | null = null;
  /** Why there is no field now, where there is none. */
  private missing: string | null = null;
  /** Counts what was chosen, so that an upload that ends late does not replace what was chosen after it. */
  private choices = 0;
  private name = FIRST;
  private fileName: string | null = null;
  private latentRow = el("input", { type: "number", id: "latent-row", min: 0, step: 1, value: 0, oninput: () => this.changed() });
  private latentCode = el("textarea", { id: "latent-code", rows: 2, spellcheck: "false", oninput: () => this.changed() });

  constructor(private readonly changed: () => void) {
    const options = (planar: boolean): HTMLOptionElement[] =>
      EXAMPLES.filter((e) => e.planar === planar).map((e) => el("option", { value: EXAMPLES.indexOf(e), selected: e.name === FIRST && !planar }, title(e.name)));
    this.examples = el(
      "select",
      { id: "example", onchange: () => this.example(EXAMPLES[Number(this.examples.value)]) },
      el("option", { value: "", disabled: true, hidden: true }, "Your own"),
      el("optgroup", { label: "Surfaces" }, ...options(false)),
      el("optgroup", { label: "Curves in the plane" }, ...options(true)),
    );
    this.editor = el(
      "details",
      { class: "editor" },
      el("summary", {}, "Scene as JSON"),
      el("label", { for: "scene", class: "sr" }, "Scene as JSON"),
      this.scene,
    );
    this.scene.addEventListener("input", () => {
      this.faults.replaceChildren();
      this.changed();
    });
    // a file that was refused for want of them is read again by choosing it again
    this.options.addEventListener("input", () => this.changed());
    this.said = el(
      "details",
      { class: "editor" },
      el("summary", {}, "What a file does not say"),
      el("label", { for: "field-options", class: "hint" }, "Options of a network or a grid as JSON, taken with the file: its w0, family, domain, sign and others"),
      this.options,
    );
    this.drop = el(
      "div",
      { class: "drop" },
      el("p", {}, "Drop a scene, weights, a mesh or a grid here, or ", el("button", { type: "button", onclick: () => this.file.click() }, "choose a file")),
      el("p", { class: "hint" }, ".json \u00b7 .pth .onnx .safetensors .npz .zip \u00b7 .ply .obj .stl .off .glb \u00b7 .npy"),
    );
    this.file.tabIndex = -1;
    this.listenForDrops();
    this.element = el(
      "div",
      { class: "field" },
      el("label", { for: "example" }, "Example"),
      this.examples,
      this.drop,
      this.file,
      this.said,
      this.described,
      this.editor,
      this.faults,
    );
    this.example(EXAMPLES.find((e) => e.name === FIRST) ?? EXAMPLES[0], false);
  }

  /** The field, or a sentence that says what is missing. */
  chosen(): Chosen | string {
    const { name, fileName: file } = this;
    if (this.missing !== null) return this.missing;
    if (this.input) {
      const options = this.fieldOptions();
      if (typeof options === "string") return options;
      const field: JobRequest["field"] = { ...options, input: this.input.id };
      const { latent_size: size, latent_rows: rows, dimension } = this.input.description as { latent_size?: number; latent_rows?: number; dimension?: number };
      if (size) {
        const numbers = this.latentCode.value.split(/[\s,;[\]]+/).filter(Boolean).map(Number);
        if (numbers.length > 0) {
          if (numbers.some((n) => !Number.isFinite(n))) return "The latent code has to be numbers.";
          field.latent = numbers;
        } else if (rows) field.latent_row = Number(this.latentRow.value);
        else return `The network needs a latent code of ${size} numbers.`;
      }
      return { field, name, file, planar: dimension === 2 };
    }
    try {
      const scene: unknown = JSON.parse(this.scene.value);
      return { field: { scene }, name, file: null, planar: isPlanar(scene) };
    } catch (error) {
      return `The scene is not JSON: ${(error as Error).message}`;
    }
  }

  /** What the file does not say, or a sentence about it. */
  private fieldOptions(): Record<string, unknown> | string {
    if (this.options.value.trim() === "") return {};
    try {
      const options: unknown = JSON.parse(this.options.value);
      const isObject = typeof options === "object" && options !== null && !Array.isArray(options);
      return isObject ? (options as Record<string, unknown>) : "What the file does not say has to be a JSON object.";
    } catch (error) {
      return `What the file does not say is not JSON: ${(error as Error).message}`;
    }
  }

  /** Shows what is wrong with the scene, each fault with the place it is at. */
  setFaults(faults: Fault[]): void {
    const ours = faults.filter((fault) => fault.pointer.startsWith("/field/"));
    this.scene.setAttribute("aria-invalid", String(ours.length > 0));
    if (ours.length > 0) (this.input ? this.said : this.editor).setAttribute("open", "");
    fill(
      this.faults,
      ...ours.map((fault) => {
        const inScene = fault.pointer.replace(/^\/field\/scene/, "");
        const place = el("button", { type: "button", class: "pointer", title: "Go to it", onclick: () => this.goTo(inScene) }, fault.pointer);
        return el("li", {}, this.input ? el("code", { class: "pointer" }, fault.pointer) : place, " ", fault.detail);
      }),
    );
  }

  private goTo(pointer: string): void {
    const range = locate(this.scene.value, pointer);
    this.editor.setAttribute("open", "");
    this.scene.focus();
    if (range) this.scene.setSelectionRange(...range);
  }

  private example(example: Example, tell = true): void {
    this.choices++;
    this.input = this.missing = null;
    this.fileName = null;
    this.name = example.name;
    this.scene.value = example.text;
    this.editor.hidden = false;
    this.faults.replaceChildren();
    this.described.replaceChildren();
    if (tell) this.changed();
  }

  private listenForDrops(): void {
    const over = (event: DragEvent): void => {
      event.preventDefault();
      this.drop.classList.add("over");
    };
    document.addEventListener("dragover", over);
    document.addEventListener("dragleave", (event) => {
      if (event.relatedTarget === null) this.drop.classList.remove("over");
    });
    document.addEventListener("drop", (event) => {
      event.preventDefault();
      this.drop.classList.remove("over");
      const file = event.dataTransfer?.files[0];
      if (file) void this.read(file);
    });
  }

  private async read(file: File): Promise<void> {
    const choice = ++this.choices;
    this.name = file.name.replace(/\.[^.]+$/, "");
    this.missing = `The file ${file.name} is being read.`;
    this.faults.replaceChildren();
    this.examples.value = "";
    fill(this.described, el("p", {}, `${file.name} is being read`));
    if (/\.json$/i.test(file.name) && file.size <= MOST_SCENE_BYTES) {
      const text = await file.text();
      if (choice !== this.choices) return;
      this.input = this.fileName = this.missing = null;
      this.scene.value = text;
      this.editor.hidden = false;
      this.editor.setAttribute("open", "");
      fill(this.described, el("p", {}, el("strong", {}, file.name), ", a scene that you may edit below"));
    } else {
      try {
        this.changed();
        const options = this.fieldOptions();
        const input = await uploadInput(file, typeof options === "string" ? {} : options);
        if (choice !== this.choices) return;
        this.input = input;
        this.missing = null;
        this.fileName = file.name;
        this.editor.hidden = true;
        this.describe(file.name, input);
      } catch (error) {
        if (choice !== this.choices) return;
        this.input = null;
        this.missing = `The file ${file.name} cannot be read as a field.`;
        const problem = problemOf(error);
        fill(this.described, problemBox(problem));
        // what it lacks may be said, where it is a file of a known kind
        if (problem.code !== "unrecognized_input") this.said.setAttribute("open", "");
      }
    }
    this.file.value = "";
    this.changed();
  }

  /** Says what the service found in a file. */
  private describe(name: string, input: Input): void {
    const { kind, ...found } = input.description;
    const rows = Object.entries(found)
      .filter(([, value]) => value !== null && value !== undefined)
      .map(([term, value]) => el("div", {}, el("dt", {}, term.replaceAll("_", " ")), el("dd", {}, said(value))));
    const size = Number(found.latent_size ?? 0);
    const kept = Number(found.latent_rows ?? 0);
    this.latentRow.max = String(Math.max(0, kept - 1));
    this.latentRow.value = "0";
    this.latentCode.value = "";
    const article = kind === "network" || kind === "mesh" || kind === "grid" || kind === "scene" ? "a " : "";
    fill(
      this.described,
      el("p", {}, el("strong", {}, name), `, ${article}${kind} of ${bytes(input.bytes)}`),
      el("dl", {}, ...rows),
      size > 0 && kept > 0 && el("label", { for: "latent-row" }, `Latent row, 0 to ${kept - 1}`),
      size > 0 && kept > 0 && this.latentRow,
      size > 0 && el("label", { for: "latent-code" }, kept > 0 ? `Or a latent code of ${size} numbers` : `Latent code of ${size} numbers`),
      size > 0 && this.latentCode,
    );
    announce(`${name} was uploaded: a ${kind}`);
  }
}

type Example = (typeof EXAMPLES)[number];

/** A described value in a few words. */
function said(value: unknown): string {
  if (typeof value === "number") return Number.isInteger(value) ? count(value) : String(Number(value.toPrecision(5)));
  if (typeof value === "boolean") return value ? "yes" : "no";
  if (Array.isArray(value)) return value.map(said).join(", ");
  if (typeof value === "object" && value !== null) {
    return Object.entries(value).map(([name, inner]) => `${name} ${said(inner)}`).join("; ");
  }
  return String(value);
}
