import { Box3, Group, Vector3 } from "three";
import { describe, expect, it } from "vitest";

import {
  aspectOf,
  directView,
  findFirstSight,
  findWholeBox,
  FIRST_AZIMUTH,
  isInPicture,
  type Lens,
  listWatched,
  type Placed,
} from "../../src/view/framing.ts";
import type { SceneSpec } from "../../src/view/spec.ts";

const LENS: Lens = { fovy: 90, orthographic: false, resolution: [200, 100] };

describe("isInPicture", () => {
  it("is true in the middle and false behind the camera", () => {
    expect(isInPicture([0, 0, -1], LENS, 0.05)).toBe(true);
    expect(isInPicture([0, 0, 1], LENS, 0.05)).toBe(false);
    expect(isInPicture([0, 0, 0], LENS, 0)).toBe(false);
  });

  it("ends at the edges, less the margin: half the height is the depth at 90 degrees", () => {
    expect(isInPicture([0, 0.94, -1], LENS, 0.05)).toBe(true);
    expect(isInPicture([0, 0.96, -1], LENS, 0.05)).toBe(false);
    expect(isInPicture([0, -0.96, -1], LENS, 0.05)).toBe(false);
    expect(isInPicture([1.88, 0, -1], LENS, 0.05)).toBe(true);
    expect(isInPicture([-1.92, 0, -1], LENS, 0.05)).toBe(false);
    expect(isInPicture([-1.92, 0, -2], LENS, 0.05)).toBe(true);
  });

  it("does not depend on the distance from an orthographic camera", () => {
    const lens: Lens = { fovy: 2, orthographic: true, resolution: [1, 1] };
    for (const z of [-0.1, -50]) {
      expect(isInPicture([1.3, 0.9, z], lens, 0)).toBe(true);
      expect(isInPicture([1.4, 0, z], lens, 0)).toBe(false);
      expect(isInPicture([0, 1.1, z], lens, 0)).toBe(false);
    }
  });

  it("is false for what is not finite", () => {
    expect(isInPicture([Number.NaN, 0, -1], LENS, 0)).toBe(false);
  });

  it("takes pictures without a stated size as 4 : 3", () => {
    expect(aspectOf({ resolution: [1, 1] })).toBeCloseTo(4 / 3);
    expect(aspectOf({ resolution: [640, 360] })).toBeCloseTo(16 / 9);
  });
});

describe("what the free camera shows", () => {
  const NOWHERE = new Box3();
  const shape = (body: number, half: number[], p: number[], kind = "box") => ({
    id: body, body, name: "", group: 0, material: -1, rgba: [1, 1, 1, 1],
    T_body_visual: [p, [1, 0, 0, 0]], geometry: { kind, size: half, mesh: -1, hfield: -1 },
  });
  /** A robot of two links at the origin, on bodies 1 and 2; body 3 is an object. */
  const makeScene = (...visuals: ReturnType<typeof shape>[]): Placed => {
    const bodies = [[0, -1], [1, 0], [2, 1], [3, 0]].map(([id, parent]) => ({ id, parent }));
    const groups = new Map(bodies.map(({ id }) => [id!, new Group()]));
    const environment = { center: [0, 0, 0], extent: 1, zfar: 50 };
    const spec = { visuals, bodies, environment, meshes: [], hfields: [], deformables: [], groups_shown: [0] } as unknown as SceneSpec;
    return { spec, bodies: groups, rest: new Map([...groups].map(([id, group]) => [id, group.matrix.clone()])) };
  };
  const move = (scene: Placed, body: number, x: number): void => {
    const group = scene.bodies.get(body)!;
    group.position.x = x;
    group.updateMatrix();
  };
  const robot = [shape(1, [0.1, 0.1, 0.5], [0, 0, 0.5]), shape(2, [0.1, 0.1, 0.2], [0, 0, 1.2])];

  it("is around all shapes but planes, and the clouds", () => {
    const scene = makeScene(shape(3, [1, 2, 3], [1, 0, 0]), shape(0, [0, 0, 1], [0, 0, 0], "plane"), shape(3, [0.1, 0.1, 1], [0, 0, 3], "capsule"));
    expect(findWholeBox(scene, NOWHERE)).toEqual(new Box3(new Vector3(-0.1, -2, -3), new Vector3(2, 2, 4.1)));
    const cloud = new Box3(new Vector3(-9, 0, 0), new Vector3(-8, 1, 1));
    expect(findWholeBox(scene, cloud).min.x).toBe(-9);
  });

  it("is around what moves, unless that has fallen out of the scene", () => {
    const scene = makeScene(shape(1, [1, 1, 1], [0, 0, 0]), shape(3, [1, 1, 1], [0, 0, 0]));
    move(scene, 3, 5);
    expect(findWholeBox(scene, NOWHERE).max.x).toBe(6);
    move(scene, 3, 5000);
    expect(findWholeBox(scene, NOWHERE).max.x).toBe(1);
  });

  it("is not empty where nothing is drawn", () => {
    expect(findWholeBox(makeScene(), NOWHERE).getSize(new Vector3()).x).toBe(1);
  });

  it("is at first the robots in a large scene, and all of a small one", () => {
    const kitchen = makeScene(...robot, shape(0, [5, 0.1, 2], [0, 8, 2]));
    const { box } = findFirstSight(kitchen, [1], NOWHERE);
    expect(box.containsPoint(new Vector3(0, 0, 1.4))).toBe(true);
    expect(box.max.y).toBeLessThan(1);
    const table = makeScene(...robot, shape(0, [0.8, 0.4, 0.02], [0, 0, 0]));
    expect(findFirstSight(table, [1], NOWHERE).box.max.x).toBeLessThan(0.5);
    const board = makeScene(...robot, shape(0, [0.3, 0.3, 0.02], [0, 0, 0]));
    const whole = findWholeBox(board, NOWHERE);
    const { box: shown } = findFirstSight(board, [1], NOWHERE);
    expect(shown.max.z).toBeGreaterThan(whole.max.z + 0.1); // labels and arrows above the gripper
    whole.max.z = shown.max.z;
    expect(shown).toEqual(whole);
    expect(findFirstSight(table, [], NOWHERE).box).toEqual(findWholeBox(table, NOWHERE));
    expect(findFirstSight(kitchen, [], NOWHERE).box.max.y).toBe(0.5); // its environment
  });

  it("is seen from where no wall is before the robots", () => {
    expect(findFirstSight(makeScene(...robot), [1], NOWHERE).azimuth).toBe(FIRST_AZIMUTH);
    const before = directView(FIRST_AZIMUTH, 0).multiplyScalar(-1);
    const wall = shape(0, [0.5, 0.5, 3], [before.x, before.y, 0]);
    const { azimuth } = findFirstSight(makeScene(...robot, wall), [1], NOWHERE);
    expect(directView(azimuth, 0).dot(directView(FIRST_AZIMUTH, 0))).toBeLessThan(0.8);
  });
});

describe("listWatched", () => {
  const robots = [
    { name: "left", base_body: 1 },
    { name: "right", base_body: 5 },
  ];
  const parents = new Map([[0, -1], [1, 0], [2, 1], [3, 2], [5, 0], [6, 5], [9, 0]]);
  const names = (camera: number): string[] => listWatched(camera, robots, parents).map(({ name }) => name);

  it("is all robots for a camera of the room", () => {
    expect(names(0)).toEqual(["left", "right"]);
    expect(names(9)).toEqual(["left", "right"]);
  });

  it("is the robot that carries the camera", () => {
    expect(names(3)).toEqual(["left"]);
    expect(names(6)).toEqual(["right"]);
  });

  it("ends in a tree that is none", () => {
    expect(listWatched(2, robots, new Map([[2, 3], [3, 2]]))).toEqual(robots);
  });
});
