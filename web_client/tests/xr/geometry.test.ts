// Axes, rays and gestures; pointing at robots; where the scene stands before a headset is aligned.

import { describe, expect, test } from "vitest";

import type { RobotInfo, SceneSpec } from "../../src/core/api.ts";
import { placeBeforeScene } from "../../src/xr/placement.ts";
import { findPointed, listChains } from "../../src/xr/pointing.ts";
import { findAnswer, isBeforeEyes, placeQuestion } from "../../src/xr/question.ts";
import { packButtons, readGesture, toPose, toRay, toRow, toWorldRay, type Vec3 } from "../../src/xr/reading.ts";
import { readGolden } from "../golden.ts";

const conversions = readGolden<{ conversions: { world: number[]; three: number[] }[] }>("golden").conversions;
const point = (x: number, y: number, z: number, w = 1): DOMPointReadOnly => ({ x, y, z, w }) as DOMPointReadOnly;

describe("readings", () => {
  test.each(conversions)("axes of WebXR: $world", ({ world, three }) => {
    const [x, y, z, qx, qy, qz, qw] = three as [number, number, number, number, number, number, number];
    const pose = toPose(point(x, y, z), point(qx, qy, qz, qw));
    [...pose[0], ...pose[1]].forEach((value, i) => expect(value).toBeCloseTo(world[i]!, 12));
    toRow(pose).forEach((value, i) => expect(value).toBeCloseTo(three[i]!, 12));
  });

  test("a ray goes forward from a pose, and turns with the alignment", () => {
    const half = Math.SQRT1_2;
    const ray = toRay(toPose(point(0, 1.2, -0.5), point(0, 0, 0, 1))); // half a metre ahead, 1.2 m high
    expect(ray).toEqual({ origin: [0.5, -0, 1.2], direction: [1, 0, 0] });
    const world = toWorldRay([[2, 0, 0], [half, 0, 0, half]], ray); // the tracking frame is turned to the left
    world.origin.forEach((value, i) => expect(value).toBeCloseTo([2, 0.5, 1.2][i]!, 12));
    world.direction.forEach((value, i) => expect(value).toBeCloseTo([0, 1, 0][i]!, 12));
  });

  test("buttons are bits", () => {
    expect(packButtons([true, false, false, true, false, true])).toBe(1 + 8 + 32);
    expect(packButtons(new Array<boolean>(20).fill(true))).toBe(255);
  });

  test("a pinch and a fist", () => {
    const joints = { thumb: [0, 0, 0], index: [0.1, 0, 0], wrist: [0, 0, 0], knuckle: [0, 0, 0.09], middle: [0, 0, 0.18] } as const;
    expect(readGesture(joints)).toEqual({ trigger: 0, squeeze: 0 });
    expect(readGesture({ ...joints, index: [0.01, 0, 0] }).trigger).toBe(1);
    expect(readGesture({ ...joints, index: [0.03, 0, 0] }).trigger).toBeCloseTo(0.5);
    expect(readGesture({ ...joints, middle: [0, 0, 0.08] }).squeeze).toBe(1);
    expect(readGesture({ ...joints, knuckle: [0, 0, 0] }).squeeze).toBe(0);
  });
});

describe("pointing", () => {
  const body = (id: number, parent: number): SceneSpec["bodies"][number] => ({ id, parent }) as SceneSpec["bodies"][number];
  const robot = (name: string, base_body: number, site_body: number): RobotInfo => ({ name, base_body, site_body }) as RobotInfo;
  const bodies = [body(0, 0), body(1, 0), body(2, 1), body(3, 2), body(4, 0), body(5, 4), body(6, 2)];
  const chains = listChains([robot("left", 1, 3), robot("right", 4, 5)], bodies);
  const places = new Map<number, Vec3>([[1, [1, 0.5, 0]], [2, [1, 0.5, 0.5]], [3, [1, 0.5, 1]], [4, [1, -0.5, 0]], [5, [1, -0.5, 1]]]);
  const point = (origin: Vec3, direction: Vec3) => findPointed({ origin, direction }, chains, (id) => places.get(id) ?? null);

  test("a chain goes from the end effector to the base, not to the world", () => {
    expect([...chains]).toEqual([["left", [3, 2, 1]], ["right", [5, 4]]]);
    expect(listChains([robot("odd", 9, 3)], bodies).get("odd")).toEqual([3, 2, 1]);
  });

  test("a ray hits the robot that it passes nearest, as thick as an arm", () => {
    expect(point([0, 0.5, 0.7], [1, 0, 0])).toEqual({ robot: "left", distance: 1 });
    expect(point([0, -0.45, 0.3], [1, 0, 0])?.robot).toBe("right");
    expect(point([0, 0.4, 0.7], [1, 0, 0])?.robot).toBe("left"); // 10 cm beside it, from 1 m away
    expect(point([0, 0, 0.7], [1, 0, 0])).toBeNull();
    expect(point([0, 0.5, 1.3], [1, 0, 0])).toBeNull(); // above its tip
    expect(point([2, 0.5, 0.7], [1, 0, 0])).toBeNull(); // behind
  });

  test("along a link, and with bodies that are nowhere", () => {
    expect(point([1, 0.5, 2], [0, 0, -1])?.robot).toBe("left");
    expect(findPointed({ origin: [0, 0, 0], direction: [1, 0, 0] }, chains, () => null)).toBeNull();
  });
});

describe("a question", () => {
  const head: [Vec3, readonly [number, number, number, number]] = [[1, 2, 1.6], [Math.SQRT1_2, 0, 0, Math.SQRT1_2]]; // looks along y
  const place = placeQuestion(head as never);

  test("it is before the eyes and above the middle of the view, the answers below it, left and right", () => {
    expect(place.at[0]).toBeCloseTo(1);
    expect(place.at[1]).toBeGreaterThan(2.6);
    expect(place.at[2]).toBeGreaterThan(1.75);
    expect(place.answers.grant[0]).toBeLessThan(0.95); // left of a head that looks along y is -x
    expect(place.answers.refuse[0]).toBeGreaterThan(1.05);
    expect(place.answers.grant[2]).toBeLessThan(place.at[2] - 0.05);
  });

  test("it stays where it is while it is in view", () => {
    const turned = (angle: number) => [head[0], [Math.cos((Math.PI / 2 + angle) / 2), 0, 0, Math.sin((Math.PI / 2 + angle) / 2)]];
    expect(isBeforeEyes(turned(0.3) as never, place)).toBe(true);
    expect(isBeforeEyes(turned(1.2) as never, place)).toBe(false);
    expect(isBeforeEyes(turned(Math.PI) as never, place)).toBe(false);
  });

  test("a ray points at one answer, or at none", () => {
    const origin: Vec3 = [1.2, 2.1, 1.2];
    const toward = (target: Vec3, sign = 1) => {
      const offset = target.map((value, i) => sign * (value - origin[i]!));
      return { origin, direction: offset.map((value) => value / Math.hypot(...offset)) as unknown as Vec3 };
    };
    for (const answer of ["grant", "refuse"] as const) {
      const found = findAnswer(toward(place.answers[answer]), place.answers);
      expect(found?.answer).toBe(answer);
      expect(found?.distance).toBeCloseTo(Math.hypot(...place.answers[answer].map((value, i) => value - origin[i]!)));
      expect(findAnswer(toward(place.answers[answer], -1), place.answers)).toBeNull(); // behind
    }
    expect(findAnswer(toward(place.at), place.answers)).toBeNull();
  });
});

test("the scene stands before a person, a metre above the floor", () => {
  const environment = { center: [0.3, 0, 0.2], extent: 1 } as SceneSpec["environment"];
  const [p, q] = placeBeforeScene(environment, [0, 2, -1]); // looking along y, and down
  [0.3, -0.9, -0.8].forEach((value, i) => expect(p[i]).toBeCloseTo(value));
  expect(toRay([p, q]).direction[1]).toBeCloseTo(1);
});
