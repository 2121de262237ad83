// Cloths: what is drawn of a sheet of vertices.

import type { BufferAttribute, Mesh, ShaderMaterial } from "three";
import { expect, test } from "vitest";

import { DeformableView } from "../../src/view/deformables.ts";
import type { Deformable } from "../../src/view/spec.ts";

const SIDE = 3;
const RADIUS = 0.01;
/** A grid of vertices in the plane z = 0, two triangles for each square. */
const POSITION = Float32Array.from({ length: 3 * SIDE * SIDE }, (_, i) => [Math.floor(i / 3) % SIDE, Math.floor(i / 3 / SIDE), 0][i % 3]!);
const ELEMENTS = Uint16Array.from(
  [0, 1].flatMap((y) => [0, 1].flatMap((x) => [0, 1, SIDE + 1, 0, SIDE + 1, SIDE].map((k) => k + x + SIDE * y))),
);
const FACES = ELEMENTS.length / 3;
const RIM = 4 * (SIDE - 1);

function draw(part: Partial<Deformable>, uv?: Float32Array): (name: string) => BufferAttribute {
  const given = { name: "cloth", stream: "flex-0", vertices: SIDE * SIDE, dim: 2, radius: RADIUS, flat: false, ...part } as Deformable;
  const view = new DeformableView(given, { position: POSITION, elements: ELEMENTS, uv }, {} as ShaderMaterial);
  view.setVertices(POSITION.map((value, i) => (i % 3 === 2 ? 0.5 : value)));
  const { geometry } = view.object as Mesh;
  return (name) => (name === "index" ? geometry.index! : geometry.getAttribute(name)) as BufferAttribute;
}

test.each([false, true])("both sides of a thick sheet follow its vertices, flat: %s", (flat) => {
  const get = draw({ flat });
  expect(get("index").count).toBe(2 * 3 * FACES + 6 * RIM);
  const [positions, normals] = [get("position"), get("normal")];
  for (let k = 0; k < 2 * 3 * FACES; k++) {
    const at = get("index").getX(k);
    const side = k < 3 * FACES ? 1 : -1;
    expect(normals.getZ(at)).toBeCloseTo(side);
    expect(positions.getZ(at)).toBeCloseTo(0.5 + side * RADIUS);
  }
  for (let k = 2 * 3 * FACES; k < get("index").count; k++) expect(normals.getZ(get("index").getX(k))).toBeCloseTo(0);
});

test("triangles share their vertices, unless they are flat or the texture has a seam", () => {
  expect(draw({})("position").count).toBe(2 * SIDE * SIDE + 6 * RIM);
  expect(draw({ flat: true })("position").count).toBe(2 * 3 * FACES + 6 * RIM);
  const uv = Float32Array.from({ length: 2 * ELEMENTS.length }, (_, i) => Math.floor(i / 6)); // each triangle elsewhere
  expect(draw({}, uv)("position").count).toBe(2 * 3 * FACES + 6 * RIM);
  expect(draw({ radius: 0 })("position").count).toBe(SIDE * SIDE);
});
