// Hands: which robot they take, drive and release, what their buttons ask for, and the samples of a frame.

import { beforeEach, describe, expect, test } from "vitest";

import type { SampleInput } from "../../src/core/api.ts";
import { type Context, Hands, type Intent, RELEASE_MS } from "../../src/xr/hands.ts";
import { type FrameReading, BUTTON, type InputReading, STOP_BUTTONS } from "../../src/xr/reading.ts";

const POSE: InputReading["pose"] = [[0.1, 0.2, 1.0], [1, 0, 0, 0]];

function input(fields: Partial<InputReading> = {}): InputReading {
  return { side: "right", kind: "controller", pose: POSE, tracked: true, emulated: false, ray: null, trigger: 0, squeeze: 0, buttons: 0, tip: null, joints: [], ...fields };
}

const DEVICES = { left: {}, right: {} };

let hands: Hands;
let now = 0;
beforeEach(() => {
  hands = new Hands();
  now = 1000;
});

function reading(...inputs: InputReading[]): FrameReading {
  now += 10;
  const stops = inputs.filter(({ buttons }) => buttons & STOP_BUTTONS).map(({ side }) => DEVICES[side]);
  return { capture_ms: now, head: POSE, headTracked: true, headEmulated: false, inputs, stops };
}

const NOTHING: Context = { held: [], tenures: new Map(), following: [], guessed: [], pointed: {}, aimed: {}, canPlace: false, isTouching: false };

function step(context: Partial<Context>, ...inputs: InputReading[]): Intent[] {
  return hands.update(reading(...inputs), { ...NOTHING, ...context });
}

/** Take a frame, and return the sample of the right hand, or of the other one. */
function sample(context: Partial<Context>, inputs: readonly InputReading[], side: InputReading["side"] = "right"): SampleInput | undefined {
  const frame = reading(...inputs);
  hands.update(frame, { ...NOTHING, ...context });
  return hands.makeSamples(frame, true).find(({ device }) => device.endsWith(side));
}

/** Take `robot` with a hand, as far as the session's grant. */
function take(robot: string, side: InputReading["side"] = "right"): void {
  step({}, input({ side }));
  step({ pointed: { [side]: robot } }, input({ side, trigger: 1 }));
  step({ held: [robot] }, input({ side }));
  for (let i = 0; i < 10; i++) step({ held: [robot] }, input({ side }));
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
    expect(step({ pointed: { right: "left" } }, input({ trigger: 1, buttons: BUTTON.lower }))).toEqual([]);
    expect(step({ pointed: { right: "left" } }, input({ trigger: 1, buttons: BUTTON.lower }))).toEqual([]);
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

  test("a squeeze that is held when the hand appears, or through a menu, opens first", () => {
    const clutch = (squeeze: number, tracked = true): boolean | undefined => {
      now += 100; // longer than the clutch stays open of a hand that has got a robot
      return sample({ held: ["left"] }, [input({ squeeze, tracked })])?.clutch;
    };
    expect([1, 0.5, 1, 0, 1, 1].map((value) => clutch(value))).toEqual([false, false, false, false, false, true]);
    hands.suspend();
    expect([1, 1, 0, 1].map((value) => clutch(value))).toEqual([false, false, false, true]);
    hands.suspend();
    expect([clutch(1, false), clutch(1), clutch(0), clutch(1)]).toEqual([false, false, false, true]);
  });

  test("a squeeze and a trigger that are held while the hand is lost, or while no frames come, count from the next press", () => {
    take("left");
    const context = { held: ["left"], pointed: { right: "left" } };
    const clutch = (fields: Partial<InputReading>): boolean | undefined => sample(context, [input(fields)])?.clutch;
    expect([clutch({ squeeze: 1 }), clutch({ squeeze: 1, tracked: false }), clutch({ squeeze: 0.5 }), clutch({ squeeze: 1 })]).toEqual([true, false, false, false]);
    clutch({});
    expect(clutch({ squeeze: 1 })).toBe(true);
    now += 10_000;
    expect(clutch({ squeeze: 1 })).toBe(false);
    step(context, input());
    step(context, input({ trigger: 1 }));
    now += 10_000;
    expect(step(context, input({ trigger: 1 }))).toEqual([]);
    step(context, input());
    step(context, input({ trigger: 1 }));
    step(context, input({ trigger: 1, tracked: false }));
    now += 400;
    step(context, input({ trigger: 1, tracked: false }));
    now += 450;
    expect(step(context, input({ trigger: 1 }))).toEqual([]);
    expect(hands.releaseShare("right", now)).toBe(0);
  });

  test("held at one's own robot it releases, unless the hand squeezes, lets go or turns away", () => {
    take("left");
    const context = { held: ["left"], pointed: { right: "left" } };
    const hold = (ms: number, fields: Partial<InputReading> = {}, more: Partial<Context> = {}): Intent[] => {
      const press = (): Intent[] => step({ ...context, ...more }, input({ trigger: 1, ...fields }));
      const intents: Intent[] = [];
      for (const end = now + ms; now < end; ) intents.push(...press());
      return ms > 0 ? intents : press();
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

  test("the session sees an open clutch at the robot before the first squeeze that moves it", () => {
    const held = { held: ["arm"] };
    sample(held, [input()]);
    const squeeze = (wait_ms: number): unknown[] => {
      now += wait_ms;
      const { robots, clutch } = sample(held, [input({ squeeze: 1 })])!;
      return [robots, clutch];
    };
    expect([0, 0, 100, 0].map(squeeze)).toEqual([[["arm"], false], [["arm"], false], [["arm"], true], [["arm"], true]]);
    sample(held, [input()]);
    expect(squeeze(0)).toEqual([["arm"], true]);
  });

  test("a robot has one hand: the one that took it last, but none is taken from a hand that squeezes", () => {
    take("left", "left");
    const context = { held: ["left"], pointed: { right: "left" } };
    step(context, input({ side: "left", squeeze: 1 }), input());
    step(context, input({ side: "left", squeeze: 1 }), input({ trigger: 1 }));
    expect([...hands.driven]).toEqual([["left", "left"]]);
    step(context, input({ side: "left" }), input());
    step(context, input({ side: "left" }), input({ trigger: 1 }));
    expect([...hands.driven]).toEqual([["right", "left"]]);
  });

  describe("a robot that was asked for", () => {
    const ask = (): void => {
      step({ held: ["b"] }, input());
      step({ held: ["b"], pointed: { right: "a" } }, input({ trigger: 1 }));
      step({ held: ["b"] }, input());
    };

    test("comes to the hand, but not to one that has squeezed since", () => {
      take("b");
      ask();
      step({ held: ["b"] }, input({ squeeze: 1 }));
      expect(sample({ held: ["b", "a"] }, [input({ squeeze: 1 })])).toMatchObject({ robots: ["b"], clutch: true });
      step({ held: ["b", "a"] }, input());
      expect(hands.driven.get("right")).toBe("b");
      step({ held: ["b"] }, input());
      ask();
      step({ held: ["b", "a"] }, input());
      expect(hands.driven.get("right")).toBe("a");
    });

    test("does not after a denial, another choice of the hand, or too late", () => {
      ask();
      hands.settle("a", false, now);
      step({ held: ["b", "a"] }, input());
      expect(hands.driven.size).toBe(0);
      ask();
      step({ held: ["b"], pointed: { right: "b" } }, input({ trigger: 1 }));
      step({ held: ["b", "a"] }, input());
      expect(hands.driven.get("right")).toBe("b");
      step({}, input());
      ask();
      hands.settle("a", true, now);
      for (let i = 0; i < 30; i++) {
        now += 90;
        step({ held: ["b"] }, input());
      }
      step({ held: ["b", "a"] }, input());
      expect(hands.driven.size).toBe(0);
    });

    test("comes when the reply is there before the lease", () => {
      ask();
      hands.settle("a", true, now);
      step({ held: ["b", "a"] }, input());
      expect(hands.driven.get("right")).toBe("a");
    });
  });
});

describe("answers", () => {
  const context: Partial<Context> = { held: ["left"], pointed: { right: "left" }, aimed: { right: "grant" } };

  test("a trigger pressed at an answer gives it, once, and does nothing to a robot behind it", () => {
    take("left");
    expect(step(context, input({ trigger: 1 }))).toEqual([{ type: "press", target: "grant" }]);
    now += RELEASE_MS;
    expect(step(context, input({ trigger: 1 }))).toEqual([]);
  });

  test("no answer: a trigger of a hand that drives, one that was pressed before, and the other hand's", () => {
    take("left");
    expect(step(context, input({ squeeze: 1, trigger: 1 }))).toEqual([]);
    step({ held: ["left"] }, input({ trigger: 1 }));
    expect(step(context, input({ trigger: 1 }))).toEqual([]);
    step(context, input(), input({ side: "left" }));
    expect(step(context, input(), input({ side: "left", trigger: 1 }))).toEqual([]);
  });
});

describe("buttons", () => {
  test("those of episodes are in the samples, for the session to act on", () => {
    step({}, input());
    expect(step({}, input({ buttons: BUTTON.lower }))).toEqual([]);
    expect(sample({}, [input({ buttons: BUTTON.lower })])?.buttons).toBe(BUTTON.lower);
  });

  test("those that are pressed for marks are not, and the one that ends it only from its next press", () => {
    const touching = { isTouching: true };
    step(touching, input());
    expect(sample(touching, [input({ buttons: BUTTON.lower | BUTTON.squeeze })])?.buttons).toBe(BUTTON.squeeze);
    step(touching, input());
    for (let i = 0; i < 3; i++) expect(sample({}, [input({ buttons: BUTTON.upper })])?.buttons).toBe(0);
    sample({}, [input()]);
    expect(sample({}, [input({ buttons: BUTTON.upper })])?.buttons).toBe(BUTTON.upper);
  });

  test("a thumbstick stops, and the pad of a controller without one: once for each press, of each controller", () => {
    const stops = (...inputs: InputReading[]): boolean => hands.takeStops(reading(...inputs).stops);
    for (const buttons of [BUTTON.thumbstick, BUTTON.touchpad]) {
      const [right, left] = [input({ buttons }), input({ side: "left", buttons })];
      expect([stops(input()), stops(right), stops(right, input({ side: "left" }))]).toEqual([false, true, false]);
      expect(stops(right, left)).toBe(true);
      expect([stops(right), stops(left)]).toEqual([false, true]); // one is let go in the frame in which the other is pressed
    }
  });

  test("a hand that is not tracked asks for nothing else", () => {
    step({}, input());
    expect(step({ pointed: { right: "left" } }, input({ tracked: false, trigger: 1, buttons: BUTTON.lower }))).toEqual([]);
  });
});

describe("while marks are touched", () => {
  const touching = { isTouching: true, aimed: { right: "grant" as const } };

  test("a trigger that is held on a mark gives no answer when its ray crosses one; a press at it does", () => {
    step({ isTouching: true }, input());
    expect(step({ isTouching: true }, input({ trigger: 1 }))).toEqual([]);
    expect(step(touching, input({ trigger: 1 }))).toEqual([]);
    expect(step(touching, input())).toEqual([]);
    expect(step(touching, input({ trigger: 1 }))).toEqual([{ type: "press", target: "grant" }]);
  });

  test("a short press is no wish to be placed", () => {
    for (const trigger of [0, 1, 0]) expect(step({ isTouching: true, canPlace: true }, input({ trigger }))).toEqual([]);
  });
});

describe("one's own place in VR", () => {
  const tap = (context: Partial<Context>, held_ms = 100, fields: Partial<InputReading> = {}): Intent[] => {
    step(context, input());
    step(context, input({ trigger: 1, ...fields }));
    for (const end = now + held_ms; now < end; ) step(context, input({ trigger: 1, ...fields }));
    return step(context, input(fields));
  };

  test("a short press of the trigger at nothing asks for it, where that is possible", () => {
    expect(tap({ canPlace: true })).toEqual([{ type: "place" }]);
    expect(tap({ canPlace: false })).toEqual([]);
  });

  test("a long press, one at a robot, an answer or while squeezing does not", () => {
    expect(tap({ canPlace: true }, 900)).toEqual([]);
    expect(tap({ canPlace: true, pointed: { right: "left" } })).toEqual([]);
    expect(tap({ canPlace: true, aimed: { right: "grant" } })).toEqual([]);
    expect(tap({ canPlace: true }, 100, { squeeze: 1 })).toEqual([]);
  });
});

describe("samples", () => {
  test("head and controllers, with the time of the frame, the robot of the hand, clutch and gripper", () => {
    take("left");
    const frame = reading(input({ squeeze: 0.9, trigger: 1, buttons: 3 }), input({ side: "left", kind: "hand" }));
    hands.update(frame, { ...NOTHING, held: ["left"], following: ["left"] });
    const [head, right, left] = hands.makeSamples(frame, true);
    expect(head).toEqual({ device: "head", pose: POSE, capture_ms: frame.capture_ms, tracked: true });
    expect(right).toMatchObject({ device: "controller/right", robots: ["left"], clutch: true, gripper: 1, buttons: 3, tracked: true });
    expect(left).toMatchObject({ device: "hand/left", robots: [], clutch: false });
  });

  test("a gripper stays as it is until the trigger has closed at least as far, and in each squeeze anew", () => {
    take("arm");
    const tenures = new Map([["arm", "1"]]);
    const following = { held: ["arm"], tenures, following: ["arm"] };
    const grip = (squeeze: number, trigger: number, context: Partial<Context> = following): number | null | undefined => sample(context, [input({ squeeze, trigger })])?.gripper;
    const wait = (trigger: number): void => {
      for (let i = 0; i < 100; i++) grip(1, trigger);
    };
    expect([0, 0.5, 0.97, 0.6].map((trigger) => grip(1, trigger))).toEqual([null, null, 0.97, 0.6]); // it may be closed
    wait(0.6);
    expect([grip(0, 0), grip(1, 0), grip(1, 0.5), grip(1, 0.7), grip(1, 0.2)]).toEqual([null, null, null, 0.7, 0.2]);
    wait(1);
    expect([grip(1, 0), grip(0, 0), grip(1, 0), grip(1, 0.5)]).toEqual([0, null, null, null]); // it has had no time to open
    expect(grip(1, 1)).toBe(1);
    wait(0);
    expect([grip(0, 0), grip(1, 0), grip(1, 0.3)]).toEqual([null, 0, 0.3]); // it is open
    expect(grip(1, 0, { held: ["arm"], tenures })).toBe(null); // the session holds the robot
    expect([grip(0, 0), grip(1, 0), grip(1, 0.5), grip(1, 1)]).toEqual([null, null, null, 1]);
    step({}, input());
    expect([grip(0, 0), grip(1, 0), grip(1, 0)]).toEqual([null, null, null]); // another participant had it
  });

  test("a gripper that others may have moved stays as it is", () => {
    take("arm");
    const grip = (squeeze: number, trigger: number, tenure?: string): number | null | undefined => {
      const tenures = new Map(tenure === undefined ? [] : [["arm", tenure]]);
      return sample({ held: ["arm"], tenures, following: ["arm"] }, [input({ squeeze, trigger })])?.gripper;
    };
    const open = (tenure?: string): void => {
      grip(1, 1, tenure);
      for (let i = 0; i < 100; i++) grip(1, 0, tenure);
      expect(grip(1, 0, tenure)).toBe(0);
    };
    open("1 1");
    expect([grip(0, 0, "1 1"), grip(1, 0, "1 1")]).toEqual([null, 0]); // only this person may have moved it
    for (const other of ["2 1", "1 2", undefined]) {
      open("1 1");
      expect([grip(0, 0, "1 1"), grip(1, 0, other), grip(1, 0, other)]).toEqual([null, null, null]);
    }
    open(); // an agent drives while this person lets go, and grasps
    expect([grip(0, 0), grip(1, 0)]).toEqual([null, null]);
  });

  test("a squeeze opens below where it closes", () => {
    const squeeze = (value: number): boolean => {
      step({}, input({ squeeze: value }));
      return hands.isSqueezing("right");
    };
    expect([0, 0.5, 0.7, 0.5, 0.3].map(squeeze)).toEqual([false, false, true, true, false]);
  });

  test("joints of a hand are sent when they were read, unless a menu covers the scene", () => {
    const joints = [1, 2, 3, 1, 0, 0, 0];
    const find = (frame: FrameReading, isVisible: boolean) => hands.makeSamples(frame, isVisible)[1]?.hand_joints;
    expect(find(reading(input({ kind: "hand", joints })), true)).toEqual(joints);
    expect(find(reading(input({ kind: "hand", joints })), false)).toBeUndefined();
    expect(find(reading(input({ kind: "hand" })), true)).toBeUndefined();
  });

  test("an estimated pose is sent as one, names its robot until the session holds it, and what is held through it counts from its next press", () => {
    take("arm");
    const context = { held: ["arm"] };
    const guess = { tracked: false, emulated: true, squeeze: 1 };
    sample(context, [input({ squeeze: 1 })]);
    expect(sample(context, [input(guess)])).toMatchObject({ tracked: true, emulated: true, clutch: false, robots: ["arm"] });
    expect(sample({ ...context, guessed: ["arm"] }, [input(guess)])).toMatchObject({ emulated: true, robots: [] });
    expect(hands.findIgnored("right")).toBe(null);
    const back = sample(context, [input({ squeeze: 1 })]);
    expect(back).toMatchObject({ tracked: true, clutch: false, robots: ["arm"] });
    expect(back).not.toHaveProperty("emulated");
    expect(hands.findIgnored("right")).toBe("squeeze");
    expect([0, 1].map((squeeze) => sample(context, [input({ squeeze })])?.clutch)).toEqual([false, true]);
    expect(hands.findIgnored("right")).toBe(null);
    const covered = hands.makeSamples({ ...reading(input(guess)), headTracked: false, headEmulated: true }, false);
    for (const one of covered) expect(one).not.toHaveProperty("emulated");
  });

  test("a press that begins while no frames come does not count, and is told until it is let go", () => {
    const press = (trigger: number): Intent[] => step({ pointed: { right: "arm" } }, input({ trigger }));
    press(0);
    now += 600;
    expect(press(1)).toEqual([]);
    expect(hands.findIgnored("right")).toBe("trigger");
    press(0);
    expect(hands.findIgnored("right")).toBe(null);
    expect(press(1)).toEqual([{ type: "acquire", robot: "arm" }]);
    expect(hands.findIgnored("right")).toBe(null);
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
