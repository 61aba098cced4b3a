/** The options of a job: lattice and method with a sentence each, and what is rarely changed behind them. */

import { el, fill, uniqueId } from "../dom";
import { count } from "../format";
import { DEFAULT_LATTICE, latticeVertices, type Lattice } from "../view/lattice";

interface Choice {
  value: string;
  name: string;
  sentence: string;
}

const LATTICES: Choice[] = [
  { value: "latlong", name: "Lat-long", sentence: "Rows of latitude and columns of longitude; one meridian is the seam." },
  { value: "octahedral", name: "Octahedral", sentence: "An unfolded octahedron with equal areas: a geometry image without crowded poles." },
];
const METHODS: Choice[] = [
  { value: "adaptive", name: "Adaptive", sentence: "Contracts, maps and measures until the surface passes its checks." },
  { value: "paper", name: "Paper", sentence: "The paper\u2019s loop as printed, a baseline that folds over on most shapes." },
];
const DENSITIES: [string, string][] = [
  ["curvature", "More samples where it is curved"],
  ["area", "Evenly by area"],
  ["reach", "More samples where it is thin"],
];
const DISTORTIONS: [string, string][] = [
  ["isometric", "Lengths, as far as can be"],
  ["area", "Areas"],
  ["angle", "Angles"],
];
const TOPOLOGIES: [string, string][] = [
  ["refuse", "Refuse handles and several components"],
  ["wrap", "Wrap around them: close handles, join components"],
];
const LATLONG_SIZES = ["100x50", "200x100", "400x200"];
const OCTAHEDRAL_SIZES = ["36", "72", "144"];
const OTHER = "other";

export class Options {
  readonly element: HTMLElement;
  private kind = "latlong";
  private method = "adaptive";
  private readonly size: HTMLSelectElement;
  private readonly numbers = el("div", { class: "numbers" });
  private readonly density = select("density", DENSITIES, () => this.changed());
  private readonly distortion = select("distortion", DISTORTIONS, () => this.changed());
  private readonly topology = select("on-topology", TOPOLOGIES, () => this.changed());
  private readonly relax = el("input", { type: "checkbox", id: "relax-uv", onchange: () => this.changed() });
  private values = { n_theta: 200, n_phi: 100, n: 72 };

  constructor(private readonly changed: () => void) {
    this.size = el("select", { id: "size", onchange: () => this.sized() });
    this.element = el(
      "div",
      { class: "options" },
      radios("Lattice", LATTICES, this.kind, (value) => {
        this.kind = value;
        this.sizes();
        this.sized();
      }),
      el("div", { class: "row" }, el("label", { for: "size" }, "Size"), this.size),
      this.numbers,
      radios("Method", METHODS, this.method, (value) => {
        this.method = value;
        this.changed();
      }),
      el(
        "details",
        { class: "more" },
        el("summary", {}, "More options"),
        el("label", { for: "density" }, "Samples are spread"),
        this.density,
        el("label", { for: "distortion" }, "The map to the sphere keeps"),
        this.distortion,
        el("label", { for: "on-topology" }, "A shape that is no sphere"),
        this.topology,
        el("div", { class: "check" }, this.relax, el("label", { for: "relax-uv" }, "Relax the UVs further inside the chart")),
      ),
    );
    this.sizes();
  }

  get lattice(): Lattice {
    const { n_theta, n_phi, n } = this.values;
    return this.kind === "latlong" ? { latlong: { n_theta, n_phi } } : { octahedral: { n } };
  }

  /** The member `shrink` of the request: only what is other than the default. */
  shrink(): Record<string, unknown> | undefined {
    const made: Record<string, unknown> = {};
    if (this.method !== "adaptive") made.method = this.method;
    if (JSON.stringify(this.lattice) !== JSON.stringify(DEFAULT_LATTICE)) made.lattice = this.lattice;
    if (this.density.value !== "curvature") made.density = this.density.value;
    if (this.distortion.value !== "isometric") made.distortion = this.distortion.value;
    if (this.topology.value !== "refuse") made.on_topology = this.topology.value;
    if (this.relax.checked) made.relax_uv = true;
    return Object.keys(made).length > 0 ? made : undefined;
  }

  /** The sizes that go with the kind of lattice. */
  private sizes(): void {
    const sizes = this.kind === "latlong" ? LATLONG_SIZES : OCTAHEDRAL_SIZES;
    fill(
      this.size,
      ...sizes.map((size, k) => el("option", { value: size, selected: k === 1 }, `${size.replace("x", " \u00d7 ")}, ${count(latticeVertices(latticeOf(size)))} vertices`)),
      el("option", { value: OTHER }, "Other\u2026"),
    );
    this.take(sizes[1]);
  }

  private take(size: string): void {
    const lattice = latticeOf(size);
    Object.assign(this.values, "latlong" in lattice ? lattice.latlong : lattice.octahedral);
  }

  private sized(): void {
    const other = this.size.value === OTHER;
    if (!other) this.take(this.size.value);
    const members: [keyof Options["values"], string][] = this.kind === "latlong" ? [["n_theta", "Columns"], ["n_phi", "Rows"]] : [["n", "Subdivisions of an edge"]];
    fill(
      this.numbers,
      ...(other
        ? members.map(([member, label]) =>
            el(
              "label",
              {},
              label,
              el("input", {
                type: "number",
                min: 1,
                step: 1,
                name: member,
                value: this.values[member],
                oninput: (event: InputEvent) => {
                  this.values[member] = Math.trunc(Number((event.target as HTMLInputElement).value));
                  this.changed();
                },
              }),
            ),
          )
        : []),
    );
    this.changed();
  }
}

function latticeOf(size: string): Lattice {
  const [a, b] = size.split("x").map(Number);
  return b === undefined ? { octahedral: { n: a } } : { latlong: { n_theta: a, n_phi: b } };
}

function radios(legend: string, choices: Choice[], chosen: string, change: (value: string) => void): HTMLElement {
  const name = uniqueId("choice");
  return el(
    "fieldset",
    { class: "choices" },
    el("legend", {}, legend),
    ...choices.map(({ value, name: label, sentence }) => {
      const id = uniqueId("sentence");
      return el(
        "label",
        {},
        el("input", { type: "radio", name, value, checked: value === chosen, "aria-describedby": id, onchange: () => change(value) }),
        el("span", { class: "choice" }, el("span", { class: "choice-name" }, label), el("span", { class: "hint", id }, sentence)),
      );
    }),
  );
}

function select(id: string, options: [value: string, text: string][], change: () => void): HTMLSelectElement {
  return el("select", { id, onchange: change }, ...options.map(([value, text]) => el("option", { value }, text)));
}
