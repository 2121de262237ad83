import { expect, test } from "vitest";

import { type Budget, chooseLevels } from "../../src/view/budget.ts";
import type { SceneSpec } from "../../src/view/spec.ts";

const NO_LIMIT: Budget = { triangles: 0, textureBytes: 0, objects: 0, points: Number.POSITIVE_INFINITY, shadows: 0, shadowSide: 0, shadowPeriod_ms: 0 };
const level = (triangles: number, max_error_m: number) => ({
  address: "",
  bytes: 0,
  encoding: "arrays",
  vertices: triangles,
  triangles,
  max_error_m,
});
const mesh = (...levels: ReturnType<typeof level>[]) => ({
  name: "",
  low: [0, 0, 0],
  high: [1, 1, 1],
  textured: false,
  levels,
});
const visual = (id: number, mesh: number, side: number) => ({
  id,
  body: 0,
  group: 0,
  rgba: [1, 1, 1, 1],
  geometry: { kind: mesh < 0 ? "box" : "mesh", size: [side, side, side], mesh, hfield: -1 },
});
const spec = {
  visuals: [visual(1, 0, 1), visual(2, 1, 1), visual(3, -1, 0.01)],
  meshes: [mesh(level(1000, 0), level(250, 0.01)), mesh(level(1000, 0), level(250, 0.001))],
  textures: [],
  materials: [],
  hfields: [],
  deformables: [],
  groups_shown: [0],
} as unknown as SceneSpec;

test("without a limit everything is exact", () => {
  expect(chooseLevels(spec, NO_LIMIT)).toMatchObject({ meshLevels: [0, 0], triangles: 2012 });
});

test("what loses least is coarsened first", () => {
  expect(chooseLevels(spec, { ...NO_LIMIT, triangles: 1500 })).toMatchObject({ meshLevels: [0, 1], triangles: 1262 });
  expect(chooseLevels(spec, { ...NO_LIMIT, triangles: 1 })).toMatchObject({ meshLevels: [1, 1], triangles: 512 });
});

test("the smallest objects are left out first", () => {
  expect([...chooseLevels(spec, { ...NO_LIMIT, objects: 2 }).hidden]).toEqual([3]);
});

test("shapes that are drawn at once count once", () => {
  const visuals = Array.from({ length: 400 }, (_, i) => visual(i, -1, 0.01 * (1 + i)));
  const many = { ...spec, visuals } as unknown as SceneSpec;
  expect(chooseLevels(many, { ...NO_LIMIT, objects: 200 }).hidden.size).toBe(0);
});
