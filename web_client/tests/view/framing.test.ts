import { Box3, Vector3 } from "three";
import { describe, expect, it } from "vitest";

import { aspectOf, findBall, isInPicture, type Lens, listWatched, SHOWN_SHARE } from "../../src/view/framing.ts";

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

describe("findBall", () => {
  const scene = { center: [1, 0, 0] as const, extent: 2 };
  const box = (low: number[], high: number[]): Box3 => new Box3(new Vector3(...low), new Vector3(...high));

  it("is the scene's where nothing is drawn beside it, or only inside", () => {
    for (const beside of [new Box3(), box([0.5, -1, -1], [1.5, 1, 1])]) {
      const { center, radius } = findBall(scene, beside);
      expect([center.toArray(), radius]).toEqual([[1, 0, 0], 2 * SHOWN_SHARE]);
    }
    expect(findBall({ ...scene, extent: 0.01 }, new Box3()).radius).toBe(0.2 * SHOWN_SHARE);
  });

  it("holds the scene and a cloud that reaches beyond it", () => {
    const beside = box([-6, -3, 0], [-2, 3, 3]);
    const ball = findBall(scene, beside);
    for (const corner of [beside.min, beside.max, new Vector3(1 + 2 * SHOWN_SHARE, 0, 0)]) {
      expect(ball.center.distanceTo(corner)).toBeLessThanOrEqual(ball.radius + 1e-9);
    }
    expect(ball.radius).toBeLessThan(8);
    expect(ball.center.x).toBeLessThan(0);
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
