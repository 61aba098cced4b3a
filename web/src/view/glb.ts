/** Reading the service's own GLB: one mesh, one primitive, one embedded picture (docs/outputs.md). */

import type { Picture } from "./colors";
import type { Lattice } from "./lattice";
import type { Surface } from "./surface";

interface Document {
  accessors: { bufferView: number; byteOffset?: number; componentType: number; count: number; type: string }[];
  bufferViews: { byteOffset?: number; byteLength: number }[];
  meshes: { primitives: { attributes: Record<string, number>; indices?: number; mode?: number }[] }[];
  images?: { bufferView: number; mimeType: string }[];
  extras?: { report?: { lattice?: Lattice; dimension?: number } };
}

const MAGIC = 0x46546c67;
const TRIANGLES = 4;
const COMPONENTS: Record<string, number> = { SCALAR: 1, VEC2: 2, VEC3: 3 };

export interface Parsed extends Omit<Surface, "texture"> {
  /** The embedded picture as a file. */
  picture: Blob | null;
  /** A closed curve of a 2-D field instead of triangles. */
  curve: boolean;
}

/** Throws when the bytes are no such file. */
export function parseGlb(file: ArrayBuffer, lattice: Lattice): Parsed {
  const view = new DataView(file);
  if (file.byteLength < 20 || view.getUint32(0, true) !== MAGIC) throw new Error("the output glb is no binary glTF");
  const jsonLength = view.getUint32(12, true);
  const document = JSON.parse(new TextDecoder().decode(new Uint8Array(file, 20, jsonLength))) as Document;
  const buffer = 20 + jsonLength + 8;
  const primitive = document.meshes[0].primitives[0];
  const read = (index: number): Float32Array | Uint32Array => {
    const accessor = document.accessors[index];
    const length = accessor.count * COMPONENTS[accessor.type];
    const start = buffer + (document.bufferViews[accessor.bufferView].byteOffset ?? 0) + (accessor.byteOffset ?? 0);
    if (accessor.componentType === 5126) return new Float32Array(file.slice(start, start + 4 * length));
    if (accessor.componentType === 5125) return new Uint32Array(file.slice(start, start + 4 * length));
    if (accessor.componentType === 5123) return Uint32Array.from(new Uint16Array(file.slice(start, start + 2 * length)));
    throw new Error(`the output glb has components of an unknown type ${accessor.componentType}`);
  };
  const { POSITION, NORMAL, TEXCOORD_0, TEXCOORD_1 } = primitive.attributes;
  const uv = read(TEXCOORD_0) as Float32Array;
  const image = document.images?.[0];
  const imageView = image && document.bufferViews[image.bufferView];
  const imageStart = buffer + (imageView?.byteOffset ?? 0);
  return {
    lattice: document.extras?.report?.lattice ?? lattice,
    positions: read(POSITION) as Float32Array,
    normals: read(NORMAL) as Float32Array,
    uv,
    sphereUv: TEXCOORD_1 === undefined ? uv : (read(TEXCOORD_1) as Float32Array),
    triangles: primitive.indices === undefined ? new Uint32Array() : (read(primitive.indices) as Uint32Array),
    picture: imageView ? new Blob([file.slice(imageStart, imageStart + imageView.byteLength)], { type: image.mimeType }) : null,
    curve: (primitive.mode ?? TRIANGLES) !== TRIANGLES,
  };
}

/** The pixels of a picture, as the file has them. */
export async function decodePicture(file: Blob): Promise<Picture> {
  const bitmap = await createImageBitmap(file, { colorSpaceConversion: "none", premultiplyAlpha: "none" });
  const canvas = document.createElement("canvas");
  canvas.width = bitmap.width;
  canvas.height = bitmap.height;
  const context = canvas.getContext("2d", { willReadFrequently: true })!;
  context.drawImage(bitmap, 0, 0);
  const { width, height, data } = context.getImageData(0, 0, canvas.width, canvas.height);
  return { width, height, data };
}
