/** Downloads of what a job made. */

import { outputBytes } from "../api/client";
import { key } from "../api/key";
import type { Job, Output } from "../api/types";
import { announce, el } from "../dom";
import { bytes } from "../format";

const ENDINGS: Record<string, string> = {
  glb: "glb",
  surface: "safetensors",
  network: "safetensors",
  sensitivity: "safetensors",
  preview: "png",
  report: "json",
  svg: "svg",
};
const SENTENCES: Record<string, string> = {
  glb: "The surface with UVs and checkerboard",
  surface: "Positions, normals, forms and triangles on the grid, for numeric code",
  preview: "Four views",
  report: "Every figure",
  svg: "The outline with its parameter",
  network: "The fitted network",
  sensitivity: "Derivatives by latent code and weights",
};

/** The name an output is saved under. */
export function fileName(job: Job, output: Output): string {
  const stem = (job.labels.name ?? job.id).replace(/[^A-Za-z0-9_-]+/g, "_");
  return `${stem}${output.name === "report" ? ".report" : ""}.${ENDINGS[output.name] ?? "bin"}`;
}

/** The list of downloads. */
export function outputList(job: Job, failed: (error: unknown) => void): HTMLElement {
  return el(
    "ul",
    { class: "outputs" },
    ...job.outputs.map((output) => {
      const link = el("a", { class: "download", href: output.href, download: fileName(job, output) }, output.name);
      link.addEventListener("click", (event) => {
        // a link cannot carry a key: the bytes are fetched with it, and handed on
        if (!key() || link.href.startsWith("blob:")) return;
        event.preventDefault();
        void save(link, output).catch(failed);
      });
      return el(
        "li",
        {},
        link,
        el("span", {}, SENTENCES[output.name] ?? "", output.certified === false && el("strong", { class: "uncertified" }, " not certified")),
        el("span", { class: "hint", title: `SHA-256 ${output.sha256}` }, bytes(output.bytes)),
      );
    }),
  );
}

async function save(link: HTMLAnchorElement, output: Output): Promise<void> {
  const address = URL.createObjectURL(new Blob([await outputBytes(output)], { type: output.media_type }));
  const plain = link.href;
  link.href = address;
  link.click();
  link.href = plain;
  announce(`${output.name} was downloaded`);
  setTimeout(() => URL.revokeObjectURL(address), 60_000);
}
