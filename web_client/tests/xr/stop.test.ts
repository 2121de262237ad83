// The e-stop of bare hands, with readings as hand tracking gives them: noise, single wrong poses, a hand that is lost.

import { beforeEach, expect, test } from "vitest";

import type * as wire from "../../src/protocol/messages.g.ts";
import type { FrameReading, InputReading, Vec3 } from "../../src/xr/reading.ts";
import { WristStop } from "../../src/xr/stop.ts";

/** A frame of 72 Hz [ms]. */
const FRAME_MS = 1000 / 72;
const WRIST: wire.Pose = [[0.3, 0.2, 1.1], [1, 0, 0, 0]];
/** Above the back of the hand, toward the elbow. */
const BALL: Vec3 = [0.26, 0.2, 1.18];
const AWAY: Vec3 = [0.3, 0, 1.2];

let stop: WristStop;
let now = 0;
let noise = 1;
beforeEach(() => {
  stop = new WristStop();
  [now, noise] = [5000, 1];
});

/** Hand tracking is uncertain by some millimetres: the same numbers at each run. */
function jitter(at: Vec3): Vec3 {
  return at.map((value) => {
    noise = (noise * 48271) % 2147483647;
    return value + 0.008 * (noise / 2147483647 - 0.5);
  }) as unknown as Vec3;
}

function hand(side: InputReading["side"], fields: Partial<InputReading>): InputReading {
  return { side, kind: "hand", pose: WRIST, tracked: true, emulated: false, ray: null, trigger: 0, squeeze: 0, buttons: 0, tip: null, joints: [], ...fields };
}

interface Frame {
  tip: Vec3 | null;
  left?: Partial<InputReading>;
  /** From the right wrist to the tip [m]. */
  finger_m?: number;
}

/** Show frames for a while, return how often they stop. */
function show(duration_ms: number, { tip, left = {}, finger_m = 0.17 }: Frame): number {
  let stops = 0;
  for (const end = now + duration_ms; now < end; now += FRAME_MS) {
    const inputs = [hand("left", { pose: [[...jitter(WRIST[0])], WRIST[1]], ...left }), hand("right", { tip: tip && jitter(tip), pose: tip && [[tip[0] - finger_m, tip[1], tip[2]], [1, 0, 0, 0]] })];
    const reading: FrameReading = { capture_ms: now, head: null, headTracked: true, headEmulated: false, inputs, stops: [] };
    if (stop.update(reading)) stops += 1;
  }
  return stops;
}

test("a fingertip that stays in the ball stops, once; and again after it has left", () => {
  expect(show(300, { tip: AWAY })).toBe(0);
  expect(show(100, { tip: BALL })).toBe(1);
  expect(show(2000, { tip: BALL })).toBe(0);
  show(300, { tip: AWAY });
  expect(show(100, { tip: BALL })).toBe(1);
});

test("the ball goes with the wrist", () => {
  const half = Math.SQRT1_2;
  show(FRAME_MS, { tip: AWAY, left: { pose: [[1, 1, 1], [half, half, 0, 0]] } }); // turned about the arm: its back looks to -y
  stop.center!.forEach((value, i) => expect(value).toBeCloseTo([0.96, 0.92, 1][i]!, 6));
});

test("the wrist is lost while the other hand is over it: the ball stays for a moment", () => {
  show(300, { tip: AWAY });
  expect(show(200, { tip: AWAY, left: { tracked: false } })).toBe(0);
  expect(show(100, { tip: BALL, left: { tracked: false } })).toBe(1);
  show(1000, { tip: AWAY, left: { tracked: false } });
  expect(stop.center).toBeNull();
  expect(show(300, { tip: BALL, left: { tracked: false } })).toBe(0);
});

test("no stop: one wrong reading, a finger that passes beside it, a fist, a hand that is lost", () => {
  show(300, { tip: AWAY });
  for (let i = 0; i < 20; i++) {
    expect(show(FRAME_MS, { tip: BALL })).toBe(0);
    show(3 * FRAME_MS, { tip: AWAY });
  }
  expect(show(500, { tip: [BALL[0], BALL[1] - 0.05, BALL[2]] })).toBe(0);
  expect(show(500, { tip: BALL, finger_m: 0.09 })).toBe(0);
  show(300, { tip: AWAY });
  expect(show(500, { tip: null })).toBe(0);
});

test("a fist beside the ball whose finger straightens into it stops", () => {
  const beside: Vec3 = [BALL[0] - 0.07, BALL[1], BALL[2]];
  expect(show(300, { tip: beside, finger_m: 0.09 })).toBe(0);
  expect(show(100, { tip: BALL, finger_m: 0.16 })).toBe(1);
});

test("no stop: a finger that is there when the ball appears, or when a menu is gone", () => {
  expect(show(500, { tip: BALL })).toBe(0);
  show(300, { tip: AWAY });
  stop.suspend();
  expect(stop.center).toBeNull();
  expect(show(500, { tip: BALL })).toBe(0);
});

test("a controller at the left has no ball: it has a thumbstick", () => {
  show(300, { tip: AWAY, left: { kind: "controller" } });
  expect(stop.center).toBeNull();
});
