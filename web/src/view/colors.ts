/** Colours of the pictures: the service's own checkerboard, scales of figures, and the lines of the UV grid. All 8-bit sRGB. */

export type Rgb = [number, number, number];

/** Tiles of the checkerboard along u and v. */
export function tiles(octahedral: boolean): [number, number] {
  return octahedral ? [32, 32] : [32, 16];
}

/** The checkerboard of the GLB at a place in the UV square: hue runs with u, lightness falls with v. */
export function checker(u: number, v: number, octahedral: boolean): Rgb {
  const [columns, rows] = tiles(octahedral);
  const column = Math.min(columns - 1, Math.max(0, Math.floor(u * columns)));
  const row = Math.min(rows - 1, Math.max(0, Math.floor(v * rows)));
  const down = (row + 0.5) / rows;
  const pale = (column + row) % 2 === 0;
  return oklch(pale ? 0.95 - 0.12 * down : 0.8 - 0.34 * down, pale ? 0.035 : 0.125, (2 * Math.PI * (column + 0.5)) / columns);
}

/** OKLCh (Ottosson 2020, "A perceptual color space for image processing"), clipped to sRGB. */
export function oklch(lightness: number, chroma: number, hue: number): Rgb {
  const a = chroma * Math.cos(hue);
  const b = chroma * Math.sin(hue);
  const l = (lightness + 0.39633778 * a + 0.21580376 * b) ** 3;
  const m = (lightness - 0.105561346 * a - 0.06385417 * b) ** 3;
  const s = (lightness - 0.08948418 * a - 1.2914855 * b) ** 3;
  return [
    toSrgb(4.0767417 * l - 3.3077116 * m + 0.23096994 * s),
    toSrgb(-1.268438 * l + 2.6097574 * m - 0.3413194 * s),
    toSrgb(-0.0041960863 * l - 0.7034186 * m + 1.7076147 * s),
  ];
}

/** An 8-bit sRGB sample of a linear one (IEC 61966-2-1). */
export function toSrgb(linear: number): number {
  const x = Math.min(1, Math.max(0, linear));
  const encoded = x <= 0.0031308 ? 12.92 * x : 1.055 * x ** (1 / 2.4) - 0.055;
  return Math.floor(encoded * 255 + 0.5);
}

/** A linear sample of an 8-bit sRGB one. */
export function toLinear(sample: number): number {
  const x = sample / 255;
  return x <= 0.04045 ? x / 12.92 : ((x + 0.055) / 1.055) ** 2.4;
}

export interface Picture {
  width: number;
  height: number;
  /** RGBA, row by row, row 0 at v = 0. */
  data: Uint8ClampedArray;
}

/** The checkerboard as a picture, as it is embedded in a GLB. */
export function checkerPicture(octahedral: boolean, pixels = 16): Picture {
  const [columns, rows] = tiles(octahedral);
  const [width, height] = [columns * pixels, rows * pixels];
  const data = new Uint8ClampedArray(4 * width * height);
  for (let y = 0; y < height; y++) {
    for (let x = 0; x < width; x++) {
      data.set([...checker((x + 0.5) / width, (y + 0.5) / height, octahedral), 255], 4 * (y * width + x));
    }
  }
  return { width, height, data };
}

/** Colours of a scale, 256 of them. */
export type Ramp = Rgb[];

function ramp(color: (t: number) => Rgb): Ramp {
  return Array.from({ length: 256 }, (_, k) => color(k / 255));
}

/** Blue over near white to orange: less, as much, more. Lightness falls to both sides. */
export const DIVERGING: Ramp = ramp((t) => {
  const off = Math.abs(2 * t - 1);
  return oklch(0.96 - 0.46 * off, 0.15 * Math.min(1, 1.2 * off), t < 0.5 ? 4.4 : 0.85);
});

/** Dark blue over green to pale yellow. */
export const SEQUENTIAL: Ramp = ramp((t) => oklch(0.28 + 0.68 * t, 0.09 + 0.06 * Math.sin(Math.PI * t), 4.9 - 3 * t));

/** Parts that the numbered lines of the UV grid divide the square into, along u and v. */
export const MAJOR = 8;
/** Fine lines between two numbered ones, with the one that closes the part. */
export const MINOR = 4;

/** The colour of the numbered line k = 0 … 8 of constant u, or of constant v, which is darker. */
export function gridLine(k: number, alongV: boolean): Rgb {
  return oklch(alongV ? 0.45 : 0.62, 0.17, (2 * Math.PI * k) / (MAJOR + 1));
}

export const css = ([r, g, b]: Rgb): string => `rgb(${r}, ${g}, ${b})`;
