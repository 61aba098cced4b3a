/**
 * The two lattices of the service: their charts and what a place in the UV square means on the unit sphere.
 *
 * theta runs from +x towards +y, phi from +z. u goes to the right and v downwards, as in the GLB.
 */

export type Lattice = { latlong: { n_theta: number; n_phi: number } } | { octahedral: { n: number } };
export type Vec3 = [number, number, number];

export const DEFAULT_LATTICE: Lattice = { latlong: { n_theta: 200, n_phi: 100 } };

export function isOctahedral(lattice: Lattice): boolean {
  return "octahedral" in lattice;
}

/** The lattice as the command line writes it. */
export function latticeName(lattice: Lattice): string {
  return "latlong" in lattice ? `latlong:${lattice.latlong.n_theta}x${lattice.latlong.n_phi}` : `octahedral:${lattice.octahedral.n}`;
}

/** Vertices of the surface that the lattice gives. */
export function latticeVertices(lattice: Lattice): number {
  if ("latlong" in lattice) return lattice.latlong.n_theta * Math.max(0, lattice.latlong.n_phi - 1) + 2;
  return 4 * lattice.octahedral.n ** 2 + 2;
}

/** Unit vector of a place in the UV square. */
export function direction(u: number, v: number, octahedral: boolean): Vec3 {
  if (octahedral) return octahedralDirection(2 * u - 1, 1 - 2 * v);
  const theta = 2 * Math.PI * u;
  const phi = Math.PI * v;
  return [Math.sin(phi) * Math.cos(theta), Math.sin(phi) * Math.sin(theta), Math.cos(phi)];
}

/** The equal-area map of the square [-1, 1]^2 through the octahedron (Clarberg 2008, section 3): the centre is +z. */
function octahedralDirection(a: number, b: number): Vec3 {
  const d = 1 - (Math.abs(a) + Math.abs(b));
  const r = 1 - Math.abs(d);
  const angle = r === 0 ? 0 : (((Math.abs(b) - Math.abs(a)) / r + 1) * Math.PI) / 4;
  const ring = r * Math.sqrt(2 - r * r);
  return [sign(a) * ring * Math.cos(angle), sign(b) * ring * Math.sin(angle), sign(d) * (1 - r * r)];
}

/** The place in the UV square of a unit vector. */
export function chartPlace([x, y, z]: Vec3, octahedral: boolean): [u: number, v: number] {
  if (!octahedral) {
    const turn = Math.atan2(y, x) / (2 * Math.PI);
    return [turn < 0 ? turn + 1 : turn, Math.acos(Math.min(1, Math.max(-1, z))) / Math.PI];
  }
  const r = Math.sqrt(Math.max(0, 1 - Math.abs(z)));
  const b = (r * 2 * Math.atan2(Math.abs(y), Math.abs(x))) / Math.PI;
  const a = r - b;
  const [across, up] = z < 0 ? [1 - b, 1 - a] : [a, b];
  return [(sign(x) * across + 1) / 2, (1 - sign(y) * up) / 2];
}

/** theta in [0, 360) and phi in [0, 180], degrees. */
export function angles([x, y, z]: Vec3): [theta: number, phi: number] {
  const theta = (Math.atan2(y, x) * 180) / Math.PI;
  return [theta < 0 ? theta + 360 : theta, (Math.acos(Math.min(1, Math.max(-1, z))) * 180) / Math.PI];
}

function sign(value: number): number {
  return value < 0 || Object.is(value, -0) ? -1 : 1;
}
