// Light of scenes that have none.

import { Group } from "three";
import { expect, test } from "vitest";

import { encodeStruct } from "../../src/core/codec.ts";
import { decodeScene } from "../../src/core/scene.ts";
import { Lighting } from "../../src/view/lighting.ts";

const DARK = { ambient: [0, 0, 0], diffuse: [0, 0, 0], specular: [0, 0, 0] };
const LAMP = { name: "lamp", kind: "directional", body: 0, p_body: [0, 0, 3], direction_body: [0, 0, -1], ...DARK };

/** Return the light on everything in a scene whose headlight is off. */
function readAmbient(lights: object[]): number[] {
  const environment = { headlight: { active: false } };
  const REST = [[0, 0, 0], [1, 0, 0, 0]];
  const world = { id: 0, name: "world", parent: -1, T_parent_body: REST, T_world_body: REST, moving: false };
  const spec = decodeScene(encodeStruct("SceneSpec", { name: "room", bodies: [world], environment, lights }));
  return new Lighting({ spec, bodies: new Map(), rest: new Map() }, new Group(), { shadows: 0, shadowSide: 0 }).uniforms.headlight.value.ambient!.toArray();
}

test("without any light that is on, colours are drawn as MuJoCo draws them: flat, at 0.3", () => {
  expect(readAmbient([])).toEqual([0.3, 0.3, 0.3]);
  expect(readAmbient([{ ...LAMP, active: false }])).toEqual([0.3, 0.3, 0.3]);
  expect(readAmbient([LAMP])).toEqual([0, 0, 0]);
});
