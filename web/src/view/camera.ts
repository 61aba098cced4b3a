/** Where a picture is seen from: an orbit about a shape, or a window onto the UV square. Matrices are column by column. */

export type Matrix = Float32Array;

/** A camera as the renderers take it. */
export interface Sight {
  /** World to clip space. */
  matrix: Matrix;
  /** Towards the viewer, unit: where the light comes from. */
  light: [number, number, number];
  eye: [number, number, number];
}

const FIELD = (32 * Math.PI) / 180;
const STEEPEST = (89 * Math.PI) / 180;
/** Seen a little from the right and from above. */
const HOME = { yaw: 0.6, pitch: 0.45, zoom: 1 };

export class Orbit {
  yaw = HOME.yaw;
  pitch = HOME.pitch;
  zoom = HOME.zoom;
  middle: number[] = [0, 0, 0];
  radius = 1;

  reset(): void {
    Object.assign(this, HOME);
  }

  turn(yaw: number, pitch: number): void {
    this.yaw += yaw;
    this.pitch = Math.min(STEEPEST, Math.max(-STEEPEST, this.pitch + pitch));
  }

  magnify(by: number): void {
    this.zoom = Math.min(20, Math.max(0.4, this.zoom * by));
  }

  sight(aspect: number): Sight {
    const [sy, cy, sp, cp] = [Math.sin(this.yaw), Math.cos(this.yaw), Math.sin(this.pitch), Math.cos(this.pitch)];
    const back: [number, number, number] = [sy * cp, sp, cy * cp];
    const right = [cy, 0, -sy];
    const up = [-sy * sp, cp, -cy * sp];
    const narrow = Math.tan(FIELD / 2) * Math.min(1, aspect);
    const distance = ((this.radius * 1.03) / Math.sin(Math.atan(narrow))) / this.zoom;
    const eye = back.map((b, k) => this.middle[k] + distance * b) as [number, number, number];
    const view = [right, up, back].map((axis) => [...axis, -axis.reduce((sum, a, k) => sum + a * eye[k], 0)]);
    const far = distance + 2.2 * this.radius;
    const near = Math.max(distance - 2.2 * this.radius, far / 1000);
    const f = 1 / Math.tan(FIELD / 2);
    const [depth, shift] = [(far + near) / (near - far), (2 * far * near) / (near - far)];
    const matrix = new Float32Array(16);
    for (let c = 0; c < 4; c++) {
      matrix[4 * c] = (f / aspect) * view[0][c];
      matrix[4 * c + 1] = f * view[1][c];
      matrix[4 * c + 2] = depth * view[2][c] + (c === 3 ? shift : 0);
      matrix[4 * c + 3] = -view[2][c];
    }
    // the light is a little above the viewer's left shoulder
    const light = back.map((b, k) => b + 0.45 * up[k] - 0.35 * right[k]);
    const length = Math.hypot(...light);
    return { matrix, eye, light: light.map((c) => c / length) as [number, number, number] };
  }
}

/** A window onto the UV square, whose point (u, v) is drawn at (u, 1 - v). */
export class Window {
  middle: [number, number] = [0.5, 0.5];
  zoom = 1;

  reset(): void {
    this.middle = [0.5, 0.5];
    this.zoom = 1;
  }

  /** Magnifies about a place that stays where it is. */
  magnify(by: number, [u, v]: [number, number]): void {
    const zoom = Math.min(60, Math.max(1, this.zoom * by));
    const part = this.zoom / zoom;
    this.middle = [u + (this.middle[0] - u) * part, v + (this.middle[1] - v) * part];
    this.zoom = zoom;
    this.keep();
  }

  move(du: number, dv: number): void {
    this.middle = [this.middle[0] + du, this.middle[1] + dv];
    this.keep();
  }

  /** Never so far that nothing is seen. */
  private keep(): void {
    const slack = 0.5 - 0.5 / this.zoom;
    this.middle = this.middle.map((c) => Math.min(0.5 + slack, Math.max(0.5 - slack, c))) as [number, number];
  }

  /** A margin keeps the square's border in the picture. */
  private scale(aspect: number): [number, number] {
    const scale = 1.94 * this.zoom;
    return aspect > 1 ? [scale / aspect, scale] : [scale, scale * aspect];
  }

  sight(aspect: number): Sight {
    const [sx, sy] = this.scale(aspect);
    const [u, v] = [this.middle[0], 1 - this.middle[1]];
    const matrix = new Float32Array([sx, 0, 0, 0, 0, sy, 0, 0, 0, 0, -0.5, 0, -sx * u, -sy * v, 0, 1]);
    return { matrix, eye: [u, v, 2], light: [0, 0, 1] };
  }

  /** The place in the UV square at a place of the picture, from -1 to 1 to the right and up. */
  place(x: number, y: number, aspect: number): [number, number] {
    const [sx, sy] = this.scale(aspect);
    return [this.middle[0] + x / sx, this.middle[1] - y / sy];
  }
}

/** A point in the picture, from -1 to 1, with its depth. */
export function project(matrix: Matrix, x: number, y: number, z: number): [number, number, number] {
  const row = (k: number): number => matrix[k] * x + matrix[4 + k] * y + matrix[8 + k] * z + matrix[12 + k];
  const w = row(3);
  return [row(0) / w, row(1) / w, row(2) / w];
}
