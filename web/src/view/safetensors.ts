/** Safetensors, read in parts: the header tells where in the file each tensor lies. */

export interface Tensor {
  dtype: string;
  shape: number[];
  /** First byte and the byte after the last, from the start of the file. */
  range: [number, number];
}

/** Bytes that the header takes with its length in front, told by the first eight bytes. */
export function headerEnd(start: ArrayBuffer): number {
  if (start.byteLength < 8) throw new Error("the file ends before its header");
  const length = new DataView(start).getBigUint64(0, true);
  if (length > 100_000_000n) throw new Error("the file is no safetensors");
  return 8 + Number(length);
}

/** The tensors of a file, from its beginning up to `headerEnd`. */
export function readHeader(start: ArrayBuffer): Record<string, Tensor> {
  const end = headerEnd(start);
  if (start.byteLength < end) throw new Error("the header is not complete");
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(start, 8, end - 8))) as Record<string, unknown>;
  const tensors: Record<string, Tensor> = {};
  for (const [name, entry] of Object.entries(header)) {
    if (name === "__metadata__") continue;
    const { dtype, shape, data_offsets } = entry as { dtype: string; shape: number[]; data_offsets: [number, number] };
    tensors[name] = { dtype, shape, range: [end + data_offsets[0], end + data_offsets[1]] };
  }
  return tensors;
}

/** A tensor of type F32 from its bytes. */
export function floats(tensor: Tensor, bytes: ArrayBuffer): Float32Array {
  const length = tensor.shape.reduce((a, b) => a * b, 1);
  if (tensor.dtype !== "F32" || bytes.byteLength !== 4 * length) throw new Error(`a tensor of ${tensor.dtype} where F32 was expected`);
  return new Float32Array(bytes);
}
