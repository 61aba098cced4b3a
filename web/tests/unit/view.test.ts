import { describe, expect, it } from "vitest";
import { decode, firstFront, nextFront } from "../../src/view/front";
import { checker, checkerPicture, oklch } from "../../src/view/colors";
import { Orbit, project, Window } from "../../src/view/camera";
import { angles, chartPlace, direction, latticeName, latticeVertices, type Lattice, type Vec3 } from "../../src/view/lattice";
import { areaRatios, quantile, roundUp } from "../../src/view/measures";
import { BoxTree, UvGrid } from "../../src/view/picking";
import { floats, headerEnd, readHeader } from "../../src/view/safetensors";
import { ball, bounds, triangleCount } from "../../src/view/surface";
import type { MeshEvent } from "../../src/api/types";

const LATTICES: Lattice[] = [{ latlong: { n_theta: 200, n_phi: 100 } }, { octahedral: { n: 72 } }];

function base64(bytes: Uint8Array): string {
  return btoa(String.fromCharCode(...bytes));
}

/** A front as the service sends it. */
function event(points: number[][], triangles: number[][], places?: number[][]): MeshEvent {
  const [low, high] = [0, 1, 2].map((k) => points.map((p) => p[k])).reduce(
    ([lows, highs], values) => [[...lows, Math.min(...values)], [...highs, Math.max(...values)]],
    [[], []] as number[][],
  );
  const step = low.map((l, k) => (high[k] - l) / 65535) as [number, number, number];
  const quantized = Uint16Array.from(points.flatMap((p) => p.map((c, k) => (step[k] > 0 ? Math.round((c - low[k]) / step[k]) : 0))));
  return {
    vertices: points.length,
    faces: triangles.length,
    origin: low as [number, number, number],
    step,
    positions: base64(new Uint8Array(quantized.buffer)),
    triangles: base64(new Uint8Array(Uint16Array.from(triangles.flat()).buffer)),
    index_bytes: 2,
    ...(places ? { places: base64(new Uint8Array(Int16Array.from(places.flat().map((c) => Math.round(32767 * c))).buffer)) } : {}),
  };
}

const TETRAHEDRON = [[0, 0, 1], [0.9, 0, -0.3], [-0.5, 0.8, -0.3], [-0.5, -0.8, -0.3]];
const FACES = [[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]];

describe("fronts", () => {
  it("are decoded to half a step", () => {
    const front = decode(event(TETRAHEDRON, FACES));
    TETRAHEDRON.flat().forEach((c, k) => expect(front.positions[k]).toBeCloseTo(c, 4));
    expect([...front.triangles]).toEqual(FACES.flat());
    expect(front.places).toBeNull();
  });

  it("take the places of the event where it has them", () => {
    const places = [[0, 0, 1], [1, 0, 0], [0, -1, 0], [-0.6, 0.8, 0]];
    for (const front of [firstFront(event(TETRAHEDRON, FACES, places)), nextFront(event(TETRAHEDRON, FACES, places), firstFront(event(TETRAHEDRON, FACES)))]) {
      places.flat().forEach((c, k) => expect(front.places[k]).toBeCloseTo(c, 4));
      // what was carried so far, to fade from
      expect(front.carried).toHaveLength(front.places.length);
      expect(Math.hypot(...front.carried!.subarray(0, 3))).toBeCloseTo(1, 5);
    }
  });

  it("carry places along where it has none", () => {
    const first = firstFront(event(TETRAHEDRON, FACES));
    expect(first.carried).toBeNull();
    const { middle } = bounds(first.positions);
    const outward = TETRAHEDRON[1].map((c, k) => c - middle[k]);
    const length = Math.hypot(...outward);
    outward.forEach((c, k) => expect(first.places[3 + k]).toBeCloseTo(c / length, 3));
    // the same front, moved far away: every vertex keeps its place
    const shrunk = nextFront(event(TETRAHEDRON.map((p) => p.map((c) => 0.8 * c)), FACES), first);
    for (let v = 0; v < 4; v++) {
      const cosine = [0, 1, 2].reduce((sum, k) => sum + shrunk.places[3 * v + k] * first.places[3 * v + k], 0);
      expect(cosine).toBeGreaterThan(0.85);
      expect(Math.hypot(...shrunk.places.subarray(3 * v, 3 * v + 3))).toBeCloseTo(1, 5);
    }
  });
});

describe("lattices", () => {
  it("lead from the square to the sphere and back", () => {
    for (const octahedral of [false, true]) {
      for (let k = 0; k < 400; k++) {
        const [u, v] = [((k * 0.618034) % 1) * 0.98 + 0.01, ((k * 0.414214) % 1) * 0.98 + 0.01];
        const at = direction(u, v, octahedral);
        expect(Math.hypot(...at)).toBeCloseTo(1, 12);
        const [u2, v2] = chartPlace(at, octahedral);
        expect(u2).toBeCloseTo(u, 9);
        expect(v2).toBeCloseTo(v, 9);
      }
    }
    expect(direction(0, 0.5, false)).toEqual([1, 0, expect.closeTo(0, 12)] as unknown as Vec3);
    expect(direction(0.5, 0.5, true)[2]).toBe(1);
    expect(angles([0, -1, 0])).toEqual([270, 90]);
  });

  it("have the service's names and numbers of vertices", () => {
    expect(LATTICES.map(latticeName)).toEqual(["latlong:200x100", "octahedral:72"]);
    expect(LATTICES.map(latticeVertices)).toEqual([19802, 20738]);
  });

  it("give a closed ball that is counter-clockwise from outside and not mirrored in the chart", () => {
    for (const lattice of LATTICES) {
      const surface = ball(lattice, 32);
      for (let t = 0; t < triangleCount(surface); t++) {
        const [a, b, c] = [0, 1, 2].map((k) => surface.triangles[3 * t + k]);
        const p = [a, b, c].map((v) => [...surface.positions.subarray(3 * v, 3 * v + 3)]);
        const determinant =
          p[0][0] * (p[1][1] * p[2][2] - p[1][2] * p[2][1]) - p[0][1] * (p[1][0] * p[2][2] - p[1][2] * p[2][0]) + p[0][2] * (p[1][0] * p[2][1] - p[1][1] * p[2][0]);
        expect(determinant).toBeGreaterThan(0);
        const q = [a, b, c].map((v) => [...surface.uv.subarray(2 * v, 2 * v + 2)]);
        expect((q[1][0] - q[0][0]) * (q[2][1] - q[0][1]) - (q[1][1] - q[0][1]) * (q[2][0] - q[0][0])).toBeLessThan(0);
      }
    }
  });
});

describe("colours", () => {
  it("are those of the service's checkerboard", () => {
    // as src/surface/checkerboard.rs writes them: the tile (0, 0) is pale, the next one is not
    expect(checker(0.01, 0.01, false)).toEqual(oklch(0.95 - 0.12 / 32, 0.035, Math.PI / 32));
    expect(checker(0.04, 0.01, false)).toEqual(oklch(0.8 - 0.34 / 32, 0.125, (3 * Math.PI) / 32));
    const picture = checkerPicture(true, 4);
    expect([picture.width, picture.height]).toEqual([128, 128]);
    expect([...picture.data.subarray(0, 3)]).toEqual(checker(0.001, 0.001, true));
  });
});

describe("area distortion", () => {
  it("is 1 all over the ball", () => {
    for (const lattice of LATTICES) for (const ratio of areaRatios(ball(lattice, 48))) expect(ratio).toBeCloseTo(1, 4);
  });

  it("is what a stretched ball has, with a mean of 1 by area of the sphere", () => {
    const surface = ball(LATTICES[1], 64);
    const long = { ...surface, positions: surface.positions.map((c, k) => (k % 3 === 2 ? 4 * c : c)) };
    const ratios = areaRatios(long);
    // at the poles the area stays, at the equator it grows by 4
    expect(quantile(ratios, 1) / quantile(ratios, 0)).toBeCloseTo(4, 0);
    expect(ratios.reduce((a, b) => a + b, 0) / ratios.length).toBeCloseTo(1, 1);
  });

  it("has scales that end at 1, 2 or 5", () => {
    expect([0.0031, 0.012, 0.7, 1, 0.5].map(roundUp)).toEqual([0.005, 0.02, 1, 1, 0.5]);
  });
});

describe("safetensors", () => {
  const header = new TextEncoder().encode('{"__metadata__":{"a":"b"},"triangle_distance":{"dtype":"F32","shape":[2],"data_offsets":[4,12]},"x":{"dtype":"U8","shape":[4],"data_offsets":[0,4]}}');
  const file = new Uint8Array(8 + header.length + 12);
  new DataView(file.buffer).setBigUint64(0, BigInt(header.length), true);
  file.set(header, 8);
  new DataView(file.buffer).setFloat32(8 + header.length + 4, 0.25, true);
  new DataView(file.buffer).setFloat32(8 + header.length + 8, -3, true);

  it("are read in parts", () => {
    const end = headerEnd(file.buffer.slice(0, 8));
    const { triangle_distance: tensor, x } = readHeader(file.buffer.slice(0, end));
    expect(x.range).toEqual([end, end + 4]);
    expect([...floats(tensor, file.buffer.slice(...tensor.range))]).toEqual([0.25, -3]);
    expect(() => floats(x, file.buffer.slice(...x.range))).toThrow("F32");
  });

  it("are refused when they are something else", () => {
    expect(() => readHeader(file.buffer.slice(0, 20))).toThrow("not complete");
    expect(() => headerEnd(new TextEncoder().encode("glTF____").buffer as ArrayBuffer)).toThrow("no safetensors");
  });
});

describe("pointing", () => {
  it("meets the same triangles as looking at each", () => {
    for (const lattice of LATTICES) {
      const surface = ball(lattice, 32);
      const tree = new BoxTree(surface.positions, surface.triangles);
      const grid = new UvGrid(surface.uv, surface.triangles);
      for (let k = 0; k < 200; k++) {
        const [u, v] = [((k * 0.618034) % 1) * 0.96 + 0.02, ((k * 0.414214) % 1) * 0.84 + 0.08];
        const inChart = grid.at(u, v)!;
        const corners = [0, 1, 2].map((c) => surface.triangles[3 * inChart.triangle + c]);
        const mix = (items: Float32Array, size: number, j: number): number => corners.reduce((sum, w, c) => sum + inChart.weights[c] * items[size * w + j], 0);
        expect(mix(surface.uv, 2, 0)).toBeCloseTo(u, 5);
        expect(mix(surface.uv, 2, 1)).toBeCloseTo(v, 5);
        const point = [0, 1, 2].map((j) => mix(surface.positions, 3, j));
        // from outside along the way to the middle the first triangle is the one on this side
        const inSpace = tree.first(point.map((c) => 5 * c), point.map((c) => -c / Math.hypot(...point)))!;
        expect(inSpace.distance).toBeCloseTo(4 * Math.hypot(...point), 4);
      }
      expect(tree.first([5, 5, 5], [1, 0, 0])).toBeNull();
      expect(new UvGrid(new Float32Array([0, 0, 0.1, 0, 0, 0.1]), new Uint32Array([0, 1, 2])).at(0.9, 0.9)).toBeNull();
    }
  });
});

describe("cameras", () => {
  it("keep the whole ball in the picture, whatever its shape", () => {
    const orbit = new Orbit();
    orbit.middle = [3, -1, 2];
    orbit.radius = 0.7;
    for (const aspect of [0.5, 1, 2.2]) {
      const { matrix } = orbit.sight(aspect);
      const surface = ball(LATTICES[1], 16);
      for (let k = 0; k < surface.positions.length; k += 3) {
        const at = [0, 1, 2].map((j) => orbit.middle[j] + 0.7 * surface.positions[k + j]);
        for (const c of project(matrix, at[0], at[1], at[2])) expect(Math.abs(c)).toBeLessThan(1);
      }
    }
  });

  it("find the place in the square that is drawn at a place of the picture", () => {
    const window = new Window();
    window.magnify(3, [0.2, 0.9]);
    for (const aspect of [0.7, 1.4]) {
      const [x, y] = project(window.sight(aspect).matrix, 0.25, 1 - 0.85, 0);
      const [u, v] = window.place(x, y, aspect);
      expect(u).toBeCloseTo(0.25, 6);
      expect(v).toBeCloseTo(0.85, 6);
    }
  });
});
