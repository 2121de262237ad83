// Hands: which robot they take, drive and release, what their buttons ask for, and the samples of a frame.

import { beforeEach, describe, expect, test } from "vitest";

import { type Context, Hands, type Intent, RELEASE_MS } from "../../src/xr/hands.ts";
import { BUTTON, type FrameReading, type InputReading } from "../../src/xr/reading.ts";

const POSE: InputReading["pose"] = [[0.1, 0.2, 1.0], [1, 0, 0, 0]];

function input(fields: Partial<InputReading> = {}): InputReading {
  return { side: "right", kind: "controller", pose: POSE, tracked: true, ray: null, trigger: 0, squeeze: 0, buttons: 0, ...fields };
}

let hands: Hands;
let now = 0;
beforeEach(() => {
  hands = new Hands();
  now = 1000;
});

function reading(...inputs: InputReading[]): FrameReading {
  now += 10;
  return { capture_ms: now, head: POSE, headTracked: true, inputs };
}

function step(context: Partial<Context>, ...inputs: InputReading[]): Intent[] {
  return hands.update(reading(...inputs), { held: [], pointed: {}, isEpisodeRunning: false, ...context });
}

/** Take `robot` with a hand, as far as the session's grant. */
function take(robot: string, side: InputReading["side"] = "right"): void {
  step({}, input({ side }));
  step({ pointed: { [side]: robot } }, input({ side, trigger: 1 }));
  step({ held: [robot] }, input({ side }));
}

describe("leases", () => {
  test("a trigger pressed at a robot asks for it, once, and the hand drives it when it is granted", () => {
    step({}, input());
    const context = { pointed: { right: "left" } };
    expect(step(context, input({ trigger: 1 }))).toEqual([{ type: "acquire", robot: "left" }]);
    expect(step(context, input({ trigger: 1 }))).toEqual([]);
    expect(hands.driven.size).toBe(0);
    step({ held: ["left"] }, input());
    expect(hands.driven.get("right")).toBe("left");
    step({}, input());
    expect(hands.driven.size).toBe(0); // the lease is gone
  });

  test("a trigger that is held when the hand appears is not pressed", () => {
    expect(step({ pointed: { right: "left" } }, input({ trigger: 1, buttons: BUTTON.thumbstick }))).toEqual([]);
    expect(step({ pointed: { right: "left" } }, input({ trigger: 1, buttons: BUTTON.thumbstick }))).toEqual([]);
  });

  test("what is pressed while a menu covers the scene is not pressed afterwards", () => {
    step({}, input());
    hands.suspend();
    const context = { pointed: { right: "left" } };
    expect(step(context, input({ trigger: 1, buttons: BUTTON.lower }))).toEqual([]);
    expect(step(context, input({ trigger: 1, buttons: BUTTON.lower }))).toEqual([]);
    step(context, input());
    expect(step(context, input({ trigger: 1 }))).toEqual([{ type: "acquire", robot: "left" }]);
  });

  test("held at one's own robot it releases, unless the hand squeezes, lets go or turns away", () => {
    take("left");
    const context = { held: ["left"], pointed: { right: "left" } };
    const hold = (ms: number, fields: Partial<InputReading> = {}, more: Partial<Context> = {}): Intent[] => {
      now += ms;
      return step({ ...context, ...more }, input({ trigger: 1, ...fields }));
    };
    hold(0);
    expect(hands.releaseShare("right", now + RELEASE_MS / 2)).toBeCloseTo(0.5);
    expect(hold(RELEASE_MS / 2, { squeeze: 1 })).toEqual([]);
    expect(hold(RELEASE_MS)).toEqual([]);
    step(context, input());
    hold(0);
    expect(hold(RELEASE_MS / 2, {}, { pointed: {} })).toEqual([]);
    expect(hold(RELEASE_MS)).toEqual([]);
    step(context, input());
    expect(hold(0)).toEqual([]);
    expect(hold(RELEASE_MS)).toEqual([{ type: "release", robot: "left" }]);
    expect(hold(RELEASE_MS)).toEqual([]);
  });

  test("a squeeze drives a robot that was assigned: the one named after the hand, or the only one", () => {
    const held = { held: ["arm_left", "arm_right"] };
    step(held, input(), input({ side: "left" }));
    step(held, input({ squeeze: 1 }), input({ side: "left" }));
    step(held, input({ squeeze: 1 }), input({ side: "left", squeeze: 1 }));
    expect([...hands.driven]).toEqual([["right", "arm_right"], ["left", "arm_left"]]);
  });

  test("a robot has one hand: the one that took it last", () => {
    take("left", "left");
    const context = { held: ["left"], pointed: { right: "left" } };
    step(context, input({ side: "left" }), input());
    step(context, input({ side: "left" }), input({ trigger: 1 }));
    expect([...hands.driven]).toEqual([["right", "left"]]);
  });
});

describe("buttons", () => {
  test("A starts an episode and ends it with success, B discards it", () => {
    step({}, input());
    expect(step({}, input({ buttons: BUTTON.lower }))).toEqual([{ type: "episode", action: "start" }]);
    const running = { isEpisodeRunning: true };
    expect(step(running, input({ buttons: BUTTON.lower }))).toEqual([]);
    step(running, input());
    expect(step(running, input({ buttons: BUTTON.lower }))).toEqual([{ type: "episode", action: "success" }]);
    expect(step(running, input({ buttons: BUTTON.lower | BUTTON.upper }))).toEqual([{ type: "episode", action: "discard" }]);
    step({}, input());
    expect(step({}, input({ buttons: BUTTON.upper }))).toEqual([]);
  });

  test("a thumbstick stops", () => {
    step({}, input());
    expect(step({}, input({ buttons: BUTTON.thumbstick }))).toEqual([{ type: "estop" }]);
  });

  test("a hand that is not tracked asks for nothing", () => {
    step({}, input());
    expect(step({ pointed: { right: "left" } }, input({ tracked: false, trigger: 1, buttons: BUTTON.lower }))).toEqual([]);
  });
});

describe("samples", () => {
  test("head and controllers, with the time of the frame, the robot of the hand, clutch and gripper", () => {
    take("left");
    const frame = reading(input({ squeeze: 0.9, trigger: 0.3, buttons: 3 }), input({ side: "left", kind: "hand" }));
    hands.update(frame, { held: ["left"], pointed: {}, isEpisodeRunning: false });
    const [head, right, left] = hands.makeSamples(frame, true);
    expect(head).toEqual({ device: "head", pose: POSE, capture_ms: frame.capture_ms, tracked: true });
    expect(right).toMatchObject({ device: "controller/right", robots: ["left"], clutch: true, gripper: 0.3, buttons: 3, tracked: true });
    expect(left).toMatchObject({ device: "hand/left", robots: [], clutch: false });
  });

  test("a squeeze opens below where it closes", () => {
    const squeeze = (value: number): boolean => {
      step({}, input({ squeeze: value }));
      return hands.isSqueezing("right");
    };
    expect([0, 0.5, 0.7, 0.5, 0.3].map(squeeze)).toEqual([false, false, true, true, false]);
  });

  test("tracked is false while hidden, and for a pose that is not measured", () => {
    const frame = reading(input(), input({ side: "left", tracked: false }));
    expect(hands.makeSamples(frame, false).map(({ tracked }) => tracked)).toEqual([false, false, false]);
    expect(hands.makeSamples(frame, true).map(({ tracked }) => tracked)).toEqual([true, true, false]);
    expect(hands.makeSamples({ ...frame, headTracked: false, inputs: [input({ pose: null })] }, true)).toEqual([
      { device: "head", pose: POSE, capture_ms: frame.capture_ms, tracked: false },
    ]);
  });
});
