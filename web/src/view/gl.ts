/** The renderer by WebGL 2, through three.js. Every mode is one shader, so no picture depends on how fine the mesh is. */

import {
  BufferAttribute,
  BufferGeometry,
  Camera,
  DataTexture,
  DoubleSide,
  GLSL3,
  LinearFilter,
  LinearMipmapLinearFilter,
  Matrix4,
  Mesh,
  RawShaderMaterial,
  RepeatWrapping,
  Scene,
  SRGBColorSpace,
  Vector3,
  WebGLRenderer,
} from "three";
import type { Sight } from "./camera";
import { gridLine, MAJOR, MINOR, type Picture } from "./colors";
import { MODES, type Drawn, type Mode, type Renderer } from "./drawn";

const VERTEX = `
in vec3 position; in vec3 normal; in vec2 uv; in vec3 place; in vec3 carried; in float value;
uniform mat4 uMatrix;
out vec3 vNormal; out vec2 vUv; out vec3 vPlace; out vec3 vCarried; out vec3 vCorner; flat out float vValue;
void main() {
  vNormal = normal; vUv = uv; vPlace = place; vCarried = carried; vValue = value;
  int corner = gl_VertexID % 3;
  vCorner = vec3(corner == 0, corner == 1, corner == 2);
  gl_Position = uMatrix * vec4(position, 1.0);
}`;

const FRAGMENT = `
precision highp float;
in vec3 vNormal; in vec2 vUv; in vec3 vPlace; in vec3 vCarried; in vec3 vCorner; flat in float vValue;
uniform int uMode; uniform float uArrived; uniform bool uPlaces; uniform bool uOctahedral; uniform bool uLit;
uniform vec3 uLight; uniform sampler2D uMap; uniform sampler2D uRamp; uniform sampler2D uLines;
out vec4 outColor;
const float PI = 3.141592653589793;

vec2 chartPlace(vec3 d) {
  if (!uOctahedral) {
    float turn = atan(d.y, d.x) / (2.0 * PI);
    return vec2(turn < 0.0 ? turn + 1.0 : turn, acos(clamp(d.z, -1.0, 1.0)) / PI);
  }
  float r = sqrt(max(0.0, 1.0 - abs(d.z)));
  float b = r * 2.0 * atan(abs(d.y), abs(d.x)) / PI;
  vec2 p = vec2(r - b, b);
  if (d.z < 0.0) p = 1.0 - p.yx;
  p *= vec2(d.x < 0.0 ? -1.0 : 1.0, d.y < 0.0 ? -1.0 : 1.0);
  return vec2(p.x + 1.0, 1.0 - p.y) / 2.0;
}

// the service's checkerboard: hue runs with u, lightness falls with v
vec3 checker(vec2 uv) {
  vec2 tiles = uOctahedral ? vec2(32.0) : vec2(32.0, 16.0);
  vec2 tile = clamp(floor(uv * tiles), vec2(0.0), tiles - 1.0);
  vec2 middle = (tile + 0.5) / tiles;
  bool pale = mod(tile.x + tile.y, 2.0) < 0.5;
  float lightness = pale ? 0.95 - 0.12 * middle.y : 0.80 - 0.34 * middle.y;
  float chroma = pale ? 0.035 : 0.125;
  float a = chroma * cos(2.0 * PI * middle.x), b = chroma * sin(2.0 * PI * middle.x);
  vec3 lms = vec3(lightness + 0.39633778 * a + 0.21580376 * b, lightness - 0.105561346 * a - 0.06385417 * b,
                  lightness - 0.08948418 * a - 1.2914855 * b);
  lms = lms * lms * lms;
  return clamp(vec3(4.0767417 * lms.x - 3.3077116 * lms.y + 0.23096994 * lms.z,
                    -1.268438 * lms.x + 2.6097574 * lms.y - 0.3413194 * lms.z,
                    -0.0041960863 * lms.x - 0.7034186 * lms.y + 1.7076147 * lms.z), 0.0, 1.0);
}

// four samples in a pixel, by directions: a chart has a seam, the sphere has none
vec3 checkerOf(vec3 place) {
  vec3 dx = dFdx(place) / 4.0, dy = dFdy(place) / 4.0;
  return 0.25 * (checker(chartPlace(normalize(place + dx + dy))) + checker(chartPlace(normalize(place + dx - dy)))
               + checker(chartPlace(normalize(place - dx + dy))) + checker(chartPlace(normalize(place - dx - dy))));
}

vec3 checkerOfPlaces() {
  vec3 color = checkerOf(vPlace);
  return uArrived < 1.0 ? mix(checkerOf(vCarried), color, uArrived) : color;
}

float line(float c, float parts, float width) {
  float x = c * parts;
  return 1.0 - smoothstep(width - 0.5, width + 0.5, abs(x - round(x)) / max(fwidth(x), 1e-9));
}

vec3 grid(vec2 uv) {
  vec3 color = vec3(0.87);
  float fine = float(${MAJOR * MINOR});
  color = mix(color, vec3(0.42), 0.55 * max(line(uv.x, fine, 0.4), line(uv.y, fine, 0.4)));
  float across = round(uv.x * float(${MAJOR})), down = round(uv.y * float(${MAJOR}));
  color = mix(color, texture(uLines, vec2((across + 0.5) / float(${MAJOR + 1}), 0.25)).rgb, line(uv.x, float(${MAJOR}), 1.2));
  return mix(color, texture(uLines, vec2((down + 0.5) / float(${MAJOR + 1}), 0.75)).rgb, line(uv.y, float(${MAJOR}), 1.2));
}

vec3 toSrgb(vec3 c) { return mix(12.92 * c, 1.055 * pow(c, vec3(1.0 / 2.4)) - 0.055, step(0.0031308, c)); }

void main() {
  vec3 n = normalize(vNormal);
  vec3 color; float shade = 0.42;
  if (uMode == 0) color = uPlaces ? checkerOfPlaces() : texture(uMap, vUv).rgb;
  else if (uMode == 1) color = grid(vUv);
  else if (uMode == 2) { color = pow(0.5 + 0.5 * n, vec3(2.2)); shade = 0.1; }
  else if (uMode == 3 || uMode == 4) { color = texture(uRamp, vec2(vValue * 255.0 / 256.0 + 0.5 / 256.0, 0.5)).rgb; shade = 0.22; }
  else {
    vec3 steps = max(fwidth(vCorner), vec3(1e-6));
    vec3 edge = vCorner / steps;
    float near = min(edge.x, min(edge.y, edge.z));
    // lines grow pale where triangles are hardly larger than they
    float size = 1.0 / max(steps.x, max(steps.y, steps.z));
    float strength = mix(0.3, 1.0, smoothstep(2.0, 9.0, size));
    color = mix(vec3(0.86), vec3(0.03, 0.07, 0.09), strength * (1.0 - smoothstep(0.2, 1.1, near)));
    shade = 0.3;
  }
  if (uLit) {
    color *= 1.0 - shade * (1.0 - max(0.0, dot(n, uLight)));
    // seen from behind: a fold
    if (!gl_FrontFacing) color = mix(color, vec3(0.7, 0.02, 0.02), 0.8);
  }
  outColor = vec4(toSrgb(color), 1.0);
}`;

/** Makes one, or `null` where this machine has no WebGL 2. */
export function glRenderer(canvas: HTMLCanvasElement, lost: () => void): Renderer | null {
  const context = canvas.getContext("webgl2", { alpha: true, antialias: true });
  if (!context) return null;
  canvas.addEventListener("webglcontextlost", lost, { once: true });
  return new GlRenderer(canvas, context);
}

class GlRenderer implements Renderer {
  readonly name = "WebGL";
  private readonly renderer: WebGLRenderer;
  private readonly scene = new Scene();
  private readonly camera = new Camera();
  private readonly mesh: Mesh<BufferGeometry, RawShaderMaterial>;
  private drawn: Drawn | null = null;
  private texture: Picture | null = null;

  constructor(canvas: HTMLCanvasElement, context: WebGL2RenderingContext) {
    this.renderer = new WebGLRenderer({ canvas, context });
    this.renderer.setClearAlpha(0);
    const material = new RawShaderMaterial({
      glslVersion: GLSL3,
      vertexShader: VERTEX,
      fragmentShader: FRAGMENT,
      side: DoubleSide,
      uniforms: {
        uMatrix: { value: new Matrix4() },
        uLight: { value: new Vector3() },
        uMode: { value: 0 },
        uArrived: { value: 1 },
        uPlaces: { value: false },
        uOctahedral: { value: false },
        uLit: { value: true },
        uMap: { value: strip([[255, 255, 255]], 1) },
        uRamp: { value: strip([[255, 255, 255]], 1) },
        uLines: { value: strip([false, true].flatMap((v) => Array.from({ length: MAJOR + 1 }, (_, k) => gridLine(k, v))), 2) },
      },
    });
    this.mesh = new Mesh(new BufferGeometry(), material);
    this.mesh.frustumCulled = false;
    this.scene.add(this.mesh);
  }

  take(drawn: Drawn): void {
    this.drawn = drawn;
    const corners = drawn.triangles.length;
    const geometry = new BufferGeometry();
    const spread = (items: Float32Array | null, size: number): BufferAttribute => {
      const out = new Float32Array(size * corners);
      if (items) for (let c = 0; c < corners; c++) for (let k = 0; k < size; k++) out[size * c + k] = items[size * drawn.triangles[c] + k];
      return new BufferAttribute(out, size);
    };
    geometry.setAttribute("position", spread(drawn.positions, 3));
    geometry.setAttribute("normal", spread(drawn.normals, 3));
    geometry.setAttribute("uv", spread(drawn.uv, 2));
    geometry.setAttribute("place", spread(drawn.places, 3));
    geometry.setAttribute("carried", spread(drawn.carried, 3));
    const values = new Float32Array(corners);
    if (drawn.values) for (let c = 0; c < corners; c++) values[c] = drawn.values[Math.floor(c / 3)];
    geometry.setAttribute("value", new BufferAttribute(values, 1));
    this.mesh.geometry.dispose();
    this.mesh.geometry = geometry;
    const { uniforms } = this.mesh.material;
    uniforms.uArrived.value = drawn.carried ? 0 : 1;
    uniforms.uPlaces.value = drawn.places !== null;
    uniforms.uOctahedral.value = drawn.octahedral;
    uniforms.uLit.value = drawn.lit;
    if (drawn.texture && drawn.texture !== this.texture) {
      this.texture = drawn.texture;
      this.swap("uMap", mapped(drawn.texture, this.renderer.capabilities.getMaxAnisotropy()));
    }
    if (drawn.ramp) this.swap("uRamp", strip(drawn.ramp, 1));
  }

  move(positions: Float32Array, normals: Float32Array, arrived: number): void {
    if (this.drawn!.carried) this.mesh.material.uniforms.uArrived.value = arrived;
    const triangles = this.drawn!.triangles;
    for (const [name, items] of [["position", positions], ["normal", normals]] as const) {
      const attribute = this.mesh.geometry.getAttribute(name) as BufferAttribute;
      const out = attribute.array as Float32Array;
      for (let c = 0; c < triangles.length; c++) for (let k = 0; k < 3; k++) out[3 * c + k] = items[3 * triangles[c] + k];
      attribute.needsUpdate = true;
    }
  }

  draw(mode: Mode, sight: Sight): void {
    const { uniforms } = this.mesh.material;
    uniforms.uMode.value = MODES.indexOf(mode);
    (uniforms.uMatrix.value as Matrix4).fromArray(sight.matrix);
    (uniforms.uLight.value as Vector3).fromArray(sight.light);
    this.renderer.render(this.scene, this.camera);
  }

  resize(width: number, height: number): void {
    this.renderer.setSize(width, height, false);
  }

  dispose(): void {
    this.mesh.geometry.dispose();
    this.renderer.dispose();
  }

  private swap(name: string, texture: DataTexture): void {
    (this.mesh.material.uniforms[name].value as DataTexture).dispose();
    this.mesh.material.uniforms[name].value = texture;
  }
}

function strip(colors: readonly (readonly number[])[], rows: number): DataTexture {
  const data = new Uint8Array(colors.flatMap((c) => [...c, 255]));
  const texture = new DataTexture(data, colors.length / rows, rows);
  texture.colorSpace = SRGBColorSpace;
  texture.needsUpdate = true;
  return texture;
}

function mapped(picture: Picture, anisotropy: number): DataTexture {
  const texture = new DataTexture(new Uint8Array(picture.data), picture.width, picture.height);
  texture.colorSpace = SRGBColorSpace;
  texture.wrapS = texture.wrapT = RepeatWrapping;
  texture.magFilter = LinearFilter;
  texture.minFilter = LinearMipmapLinearFilter;
  texture.generateMipmaps = true;
  texture.anisotropy = Math.min(8, anisotropy);
  texture.needsUpdate = true;
  return texture;
}
