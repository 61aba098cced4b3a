/** Figures as text. What is not known is an en dash. */

export const UNKNOWN = "\u2013";

/** A number with `digits` significant digits, very small and large ones with an exponent. */
export function figure(value: number | null | undefined, digits = 4): string {
  if (value === null || value === undefined || !Number.isFinite(value)) return UNKNOWN;
  if (value === 0) return "0";
  const size = Math.abs(value);
  if (size >= 1e6 || size < 1e-4) return value.toExponential(Math.max(0, digits - 2)).replace("-", "\u2212").replace("e+", "e");
  return minus(String(Number(value.toPrecision(digits))));
}

/** A fixed number of decimals. */
export function fixed(value: number, decimals: number): string {
  return minus(value.toFixed(decimals));
}

/** A whole number with its thousands apart. */
export function count(value: number | null | undefined): string {
  return value === null || value === undefined ? UNKNOWN : value.toLocaleString("en-US");
}

/** A share as a percentage. */
export function percent(share: number | null | undefined, digits = 3): string {
  return share === null || share === undefined ? UNKNOWN : `${figure(100 * share, digits)} %`;
}

/** Seconds as a person says them. */
export function seconds(value: number | null | undefined): string {
  if (value === null || value === undefined) return UNKNOWN;
  if (value < 10) return `${value.toFixed(1)} s`;
  if (value < 90) return `${Math.round(value)} s`;
  return `${Math.round(value / 60)} min`;
}

/** Bytes in kB and MB. */
export function bytes(value: number): string {
  if (value < 1000) return `${value} B`;
  return value < 1e6 ? `${figure(value / 1e3, 3)} kB` : `${figure(value / 1e6, 3)} MB`;
}

/** A time of today, or a day and a time. */
export function moment(text: string): string {
  const time = new Date(text);
  const clock = time.toLocaleTimeString("en-GB", { hour: "2-digit", minute: "2-digit", second: "2-digit" });
  const today = time.toDateString() === new Date().toDateString();
  return today ? clock : `${time.toLocaleDateString("en-GB", { day: "numeric", month: "short" })} ${clock}`;
}

function minus(text: string): string {
  return text.replace("-", "\u2212");
}
