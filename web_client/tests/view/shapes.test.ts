import { expect, test } from "vitest";

import type { MeshArrays } from "../../src/view/arrays.ts";
import { addTextureCoordinates, buildHeightField, buildPrimitive, cubeDirections } from "../../src/view/shapes.ts";
import type { Geometry, Material } from "../../src/view/spec.ts";

const geometry = (kind: string, size: [number, number, number]): Geometry => ({ kind, size, mesh: -1, hfield: -1 });
const material = (repeat: [number, number], uniform: boolean): Material => ({
  name: "",
  rgba: [1, 1, 1, 1],
  emission: 0,
  specular: 0.5,
  shininess: 0.5,
  reflectance: 0,
  metallic: -1,
  roughness: -1,
  textures: [],
  repeat,
  uniform,
});

/** Return the signed volume inside the triangles: positive when they are counter-clockwise from outside. */
function volume({ position, index }: MeshArrays): number {
  let sum = 0;
  for (let i = 0; i < index.length; i += 3) {
    const [a, b, c] = [0, 1, 2].map((k) => [...position.subarray(3 * index[i + k]!, 3 * index[i + k]! + 3)]);
    const [ax, ay, az] = a as [number, number, number];
    const [bx, by, bz] = b as [number, number, number];
    const [cx, cy, cz] = c as [number, number, number];
    sum += ax * (by * cz - bz * cy) + ay * (bz * cx - bx * cz) + az * (bx * cy - by * cx);
  }
  return sum / 6;
}

test.each([
  ["box", [0.1, 0.2, 0.3], 8 * 0.1 * 0.2 * 0.3, 1e-6],
  ["sphere", [0.5, 0.5, 0.5], (4 / 3) * Math.PI * 0.125, 0.03],
  ["ellipsoid", [0.1, 0.2, 0.3], (4 / 3) * Math.PI * 0.006, 0.03],
  ["cylinder", [0.2, 0.2, 0.5], Math.PI * 0.04, 0.02],
  ["capsule", [0.2, 0.2, 0.5], Math.PI * 0.04 + (4 / 3) * Math.PI * 0.008, 0.03],
  ["unknown-kind", [0.1, 0.2, 0.3], 8 * 0.1 * 0.2 * 0.3, 1e-6],
] as const)("a %s is closed and faces outward", (kind, size, expected, tolerance) => {
  const mesh = buildPrimitive(geometry(kind, [...size]));
  expect(Math.abs(volume(mesh) / expected - 1)).toBeLessThan(tolerance);
  for (let i = 0; i < mesh.normal.length; i += 3) {
    expect(Math.hypot(...mesh.normal.subarray(i, i + 3))).toBeCloseTo(1, 5);
  }
});

test("a height field has its surface, walls and floor", () => {
  const field = { name: "", rows: 2, columns: 3, size: [1, 2, 0.5, 0.25], address: "", bytes: 0, encoding: "arrays" };
  const mesh = buildHeightField({ ...field, size: [1, 2, 0.5, 0.25] }, new Float32Array([1, 1, 1, 1, 1, 1]));
  expect(volume(mesh)).toBeCloseTo(2 * 4 * 0.75, 5);
});

test("an infinite plane is drawn finite, and its texture is laid per metre", () => {
  const plane = geometry("plane", [0, 0, 1]);
  const mesh = addTextureCoordinates(buildPrimitive(plane), plane, material([2, 2], true));
  const i = [...mesh.index].find((v) => mesh.position[3 * v]! > 0 && mesh.position[3 * v + 1]! > 0)!;
  expect(mesh.uv![2 * i]).toBeCloseTo(0.5 * 2 * 50 - 0.5, 4);
  expect(mesh.uv![2 * i + 1]).toBeCloseTo(-0.5 * 2 * 50 - 0.5, 4);
});

test("the sides of a box have the whole texture each, times its repetition", () => {
  const box = geometry("box", [0.1, 0.2, 0.3]);
  const mesh = addTextureCoordinates(buildPrimitive(box), box, material([3, 2], false));
  expect(Math.min(...mesh.uv!)).toBeCloseTo(0, 6);
  expect(Math.max(...mesh.uv!.filter((_, i) => i % 2 === 0))).toBeCloseTo(3, 6);
  expect(Math.max(...mesh.uv!.filter((_, i) => i % 2 === 1))).toBeCloseTo(2, 6);
});

test("no triangle of a round shape spans its seam backwards", () => {
  for (const kind of ["sphere", "cylinder", "capsule"]) {
    const shape = geometry(kind, [0.2, 0.2, 0.3]);
    const { uv, index } = addTextureCoordinates(buildPrimitive(shape), shape, material([1, 1], false));
    for (let i = 0; i < index.length; i += 3) {
      const u = [0, 1, 2].map((k) => uv![2 * index[i + k]!]!);
      if (kind !== "cylinder") expect(Math.max(...u) - Math.min(...u)).toBeLessThan(0.2);
    }
  }
});

test("caps of a capsule are looked up in a cube as if its half length were 1", () => {
  const capsule = geometry("capsule", [0.2, 0.2, 0.5]);
  const { mesh, direction } = cubeDirections(buildPrimitive(capsule), capsule, material([1, 1], false), undefined);
  const heights = [...direction].filter((_, i) => i % 3 === 2);
  expect(direction.length).toBe(mesh.position.length);
  expect(Math.max(...heights)).toBeCloseTo(2, 5);
  expect(Math.min(...heights)).toBeCloseTo(-2, 5);
});
