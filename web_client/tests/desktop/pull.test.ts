// Handles at the gripper: what they ask for, and where the gripper comes to rest that is seen late.

import { beforeEach, describe, expect, it } from "vitest";

import { DesktopDevice, type Heading, toTwist } from "../../src/desktop/device.ts";
import type { Vec3 } from "../../src/desktop/intent.ts";
import { Pull } from "../../src/desktop/pull.ts";

const handles = {
  isHeld: false,
  lag_s: 0.15,
  move: [0, 0, 0] as Vec3,
  turn: [0, 0, 0] as Vec3,
  readWay: (move: Vec3, turn: Vec3) => {
    for (const i of [0, 1, 2] as const) [move[i], turn[i]] = [handles.move[i], handles.turn[i]];
  },
  letGo: () => {
    handles.isHeld = false;
  },
};
const EAST: Heading = [1, 0];
const SITUATION = { isReady: true, isStopped: false, isPaused: false, isHolder: true };
let pull: Pull;

beforeEach(() => {
  Object.assign(handles, { isHeld: false, lag_s: 0.15, move: [0, 0, 0], turn: [0, 0, 0] });
  pull = new Pull(handles);
});

describe("handles", () => {
  it("ask for nothing unless they are held, and begin each hold open", () => {
    handles.move = [0.1, 0, 0];
    expect(pull.read(EAST, 0.1)).toMatchObject({ clutch: false, move: [0, 0, 0] });
    handles.isHeld = true;
    expect(pull.read(EAST, 0.1).clutch).toBe(false); // the edge that a dead-man needs
    expect(pull.read(EAST, 0.1).clutch).toBe(true);
    pull.letGo();
    expect(pull.read(EAST, 0.1).clutch).toBe(false);
    expect(handles.isHeld).toBe(false);
  });

  it.each([[1, 0], [0, 1], [-0.6, 0.8]] as Heading[])("move along their way in the world, whatever the view: %j", (x, y) => {
    const heading: Heading = [x, y];
    handles.isHeld = true;
    handles.move = [0.3, -0.4, 1.2];
    handles.turn = [0, 0.4, -0.3];
    pull.read(heading, 0.1);
    const [vx, vy, vz, ...w] = toTwist(pull.read(heading, 0.1), heading, 0.1);
    expect([vx, vy, vz].map((v) => v * 13)).toEqual([0.3, -0.4, 1.2].map((v) => expect.closeTo(v, 9))); // 10 cm/s of 1.3 m
    expect(Math.hypot(...w)).toBeCloseTo(0.5, 9);
    expect(w[1]! / w[2]!).toBeCloseTo(-4 / 3, 9);
  });

  it.each([0.05, 0.15, 0.5, 1.5])("bring a gripper that is seen %f s late to where they are, and no farther", (lag_s) => {
    handles.isHeld = true;
    handles.lag_s = lag_s;
    const [dt, goal] = [0.017, 0.2];
    const places: number[] = [0];
    for (let t = 0; t < 10 + 20 * lag_s; t += dt) {
      const seen = places[Math.max(0, places.length - 1 - Math.round(lag_s / dt))]!;
      handles.move = [goal - seen, 0, 0];
      places.push(places.at(-1)! + dt * toTwist(pull.read(EAST, 0.1), EAST, 0.1)[0]);
    }
    expect(places.at(-1)).toBeCloseTo(goal, 3);
    expect(Math.max(...places)).toBeLessThan(1.02 * goal);
    expect(Math.max(...places.slice(1).map((place, i) => place - places[i]!))).toBeLessThanOrEqual(0.1 * dt + 1e-12);
  });

  it("do not go on by themselves after an e-stop or a pause: they have to be let go", () => {
    const clutches: boolean[] = [];
    const device = new DesktopDevice((sample) => clutches.push(sample.clutch ?? false));
    device.arm("left", 0);
    const tick = (situation: typeof SITUATION): boolean | undefined => {
      device.tick(new Map([["gizmo", pull.read(EAST, 0.1)]]), EAST, 0.1, situation, 0);
      return clutches.at(-1);
    };
    handles.isHeld = true;
    tick(SITUATION);
    expect(tick(SITUATION)).toBe(true);
    for (const stopped of [{ ...SITUATION, isPaused: true }, { ...SITUATION, isStopped: true }]) {
      expect(tick(stopped)).toBe(false);
      expect(tick(SITUATION)).toBe(false);
      pull.letGo();
      tick(SITUATION);
      handles.isHeld = true;
      tick(SITUATION);
      expect(tick(SITUATION)).toBe(true);
    }
  });
});
