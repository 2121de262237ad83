import { beforeEach, describe, expect, it } from "vitest";

import type { SampleInput } from "../../src/core/api.ts";
import { DesktopDevice, SlownessWatch, SPEED_RANGE, type Situation, toHeading, toTwist } from "../../src/desktop/device.ts";
import { type Intent, makeIdle, readKeys } from "../../src/desktop/intent.ts";

const HOLDER: Situation = { isReady: true, isStopped: false, isPaused: false, isHolder: true };
const STILL = [0, 0, 0, 0, 0, 0];
/** Looking along +Y of the world: right is +X. */
const NORTH = [0, 1] as const;

const keys = (...codes: string[]): Intent => readKeys(new Set(codes), codes.includes("ShiftLeft"));
const FORWARD = keys("ShiftLeft", "KeyW");

let sent: SampleInput[] = [];
let device: DesktopDevice;
let now_ms = 0;

function tick(intent: Intent, situation = HOLDER): SampleInput {
  return tickAll({ keyboard: intent }, situation);
}

function tickAll(inputs: Record<string, Intent>, situation = HOLDER): SampleInput {
  now_ms += 17;
  device.tick(new Map(Object.entries(inputs)), NORTH, 0.1, situation, now_ms);
  return sent.at(-1)!;
}

beforeEach(() => {
  sent = [];
  now_ms = 0;
  device = new DesktopDevice((sample) => sent.push(sample));
});

describe("a device that is not armed", () => {
  it("sends nothing", () => {
    tick(FORWARD);
    device.release("blur", 2);
    device.disarm(3);
    expect(sent).toEqual([]);
  });
});

describe("an armed device", () => {
  beforeEach(() => {
    device.arm("left", 0);
    tick(makeIdle());
  });

  it("begins with an open clutch, at a stated time", () => {
    expect(sent[0]).toEqual({ device: "desktop", kind: "twist", pose: null, capture_ms: 0, robots: ["left"], clutch: false, twist: STILL });
  });

  it("stands still without the dead-man, whatever else is pressed", () => {
    expect(tick(keys("KeyW", "ArrowUp", "KeyC"))).toMatchObject({ clutch: false, twist: STILL });
    expect(device.isEngaged).toBe(false);
  });

  it("drives while the dead-man is held", () => {
    const sample = tick(FORWARD);
    expect(sample).toMatchObject({ clutch: true, capture_ms: 34, gripper: null });
    expect(sample.twist).toEqual([expect.closeTo(0), expect.closeTo(0.1), 0, 0, 0, 0]);
    expect(tick(keys("ShiftLeft"))).toMatchObject({ clutch: true, twist: STILL });
    expect(tick(makeIdle())).toMatchObject({ clutch: false, twist: STILL });
  });

  it("does not count a dead-man that was pressed before", () => {
    device.arm("right", 100);
    expect(tick(FORWARD).clutch).toBe(false);
    tick(makeIdle());
    expect(tick(FORWARD)).toMatchObject({ clutch: true, robots: ["right"] });
  });

  it("opens the clutch at once when it is released from outside, until the dead-man is pressed anew", () => {
    tick(FORWARD);
    device.release("the window lost the focus", 40);
    expect(sent.at(-1)).toMatchObject({ clutch: false, capture_ms: 40, twist: STILL });
    expect(device.released).toBe("the window lost the focus");
    expect(tick(FORWARD).clutch).toBe(false);
    expect(device.released).toBe("the window lost the focus");
    tick(makeIdle());
    expect(tick(FORWARD).clutch).toBe(true);
    expect(device.released).toBe("");
  });

  it.each([
    ["e-stop", { ...HOLDER, isStopped: true }],
    ["the session was paused", { ...HOLDER, isPaused: true }],
    ["the connection is lost", { ...HOLDER, isReady: false, isHolder: false }],
  ])("is released by: %s", (reason, situation) => {
    tick(FORWARD);
    expect(tick(FORWARD, situation).clutch).toBe(false);
    expect(device.released).toBe(reason);
    tick(makeIdle(), situation); // let go during the stop, pressed again before its end: still nothing
    expect(tick(FORWARD, situation).clutch).toBe(false);
    expect(tick(FORWARD).clutch).toBe(false);
    expect([device.released, device.mustLetGo]).toEqual(["", true]); // it has passed
    tick(makeIdle());
    expect(tick(FORWARD).clutch).toBe(true);
  });

  it("is disarmed when the lease is lost", () => {
    tick(FORWARD);
    expect(device.tick(new Map([["keyboard", FORWARD]]), NORTH, 0.1, { ...HOLDER, isHolder: false }, 50)).toBe(false);
    expect(sent.at(-1)).toMatchObject({ clutch: false, twist: STILL });
    expect(device.robot).toBe("");
    const count = sent.length;
    tick(FORWARD);
    expect(sent.length).toBe(count);
  });

  it("leaves the gripper as it is until a key says otherwise", () => {
    expect(tick(FORWARD).gripper).toBe(null);
    expect(tick(keys("ShiftLeft", "KeyC")).gripper).toBe(1);
    expect(tick(FORWARD).gripper).toBe(1);
    expect(tick(keys("ShiftLeft", "KeyC", "KeyV")).gripper).toBe(1);
    expect(tick(keys("ShiftLeft", "KeyV")).gripper).toBe(0);
    tick(makeIdle());
    expect(tick(FORWARD).gripper).toBe(null);
  });

  it("toggles the gripper once for a press", () => {
    const toggle = { ...FORWARD, toggle: true };
    expect(tick(toggle).gripper).toBe(1);
    expect(tick(toggle).gripper).toBe(1);
    expect(tick(FORWARD).gripper).toBe(1);
    expect(tick(toggle).gripper).toBe(0);
  });

  it("does not toggle the gripper for a press that began before the dead-man", () => {
    tick({ ...makeIdle(), toggle: true });
    expect(tick({ ...FORWARD, toggle: true })).toMatchObject({ clutch: true, gripper: null });
  });

  it("toggles the gripper of another robot as if it were open", () => {
    expect(tick({ ...FORWARD, toggle: true }).gripper).toBe(1);
    device.arm("right", 100);
    tick(makeIdle());
    expect(tick({ ...FORWARD, toggle: true })).toMatchObject({ robots: ["right"], gripper: 1 });
  });

  it("ends with an open clutch", () => {
    tick(FORWARD);
    device.disarm(60);
    expect(sent.at(-1)).toMatchObject({ robots: ["left"], clutch: false, capture_ms: 60 });
  });
});

describe("the dead-man of a source", () => {
  const idle = makeIdle();
  const held: Intent = { ...idle, clutch: true, move: [0, 1, 0] };
  const unknown: Intent = { ...idle, clutch: null };

  beforeEach(() => device.arm("left", 0));

  it("does not count when it comes back pressed, until it is let go", () => {
    tickAll({ keyboard: idle, pad: idle });
    expect(tickAll({ keyboard: idle, pad: held }).clutch).toBe(true);
    expect(tickAll({ keyboard: idle }).clutch).toBe(false); // unplugged
    expect(tickAll({ keyboard: idle, pad: held })).toMatchObject({ clutch: false, twist: STILL });
    expect(device.mustLetGo).toBe(true);
    tickAll({ keyboard: idle, pad: idle });
    expect(device.mustLetGo).toBe(false);
    expect(tickAll({ keyboard: idle, pad: held }).clutch).toBe(true);
  });

  it("does not count when it was not known in between", () => {
    tickAll({ mouse: idle });
    expect(tickAll({ mouse: held }).clutch).toBe(true);
    expect(tickAll({ mouse: unknown }).clutch).toBe(false);
    expect(tickAll({ mouse: held }).clutch).toBe(false);
  });

  it("is not let go by another source", () => {
    tickAll({ keyboard: idle, pad: held });
    expect(tickAll({ keyboard: idle, pad: held }).clutch).toBe(false);
    expect(tickAll({ keyboard: held, pad: held }).clutch).toBe(true);
    device.release("the window lost the focus", 60);
    tickAll({ keyboard: idle, pad: held });
    expect(tickAll({ keyboard: idle, pad: held }).clutch).toBe(false);
  });

  it("goes on while another one that counts is held", () => {
    tickAll({ keyboard: idle, pad: idle });
    tickAll({ keyboard: held, pad: held });
    expect(tickAll({ keyboard: held }).clutch).toBe(true);
  });
});

describe("toTwist", () => {
  it("is relative to the view", () => {
    const right = { ...makeIdle(), move: [1, 0, 0] as [number, number, number] };
    expect(toTwist(right, [0, 1], 0.1).slice(0, 3)).toEqual([expect.closeTo(0.1), expect.closeTo(0), 0]);
    expect(toTwist(right, [1, 0], 0.1).slice(0, 3)).toEqual([expect.closeTo(0), expect.closeTo(-0.1), 0]);
  });

  it("turns about the axes of the view, 5 rad for a metre", () => {
    const tilt = { ...makeIdle(), turn: [1, 0, 0] as [number, number, number] };
    expect(toTwist(tilt, [0, 1], 0.1).slice(3)).toEqual([expect.closeTo(0.5), expect.closeTo(0), 0]);
  });

  it("is bounded, in every direction and for every speed", () => {
    const all = { ...makeIdle(), move: [1, 1, 1] as [number, number, number], turn: [1, -1, 1] as [number, number, number] };
    for (const speed of [0.05, 0.3, 100, Number.POSITIVE_INFINITY]) {
      const twist = toTwist(all, [0.6, 0.8], speed);
      expect(Math.hypot(...twist.slice(0, 3))).toBeCloseTo(Math.min(speed, SPEED_RANGE[1]), 9);
      expect(Math.hypot(...twist.slice(3))).toBeCloseTo(5 * Math.min(speed, SPEED_RANGE[1]), 9);
    }
  });
});

describe("toHeading", () => {
  it("is where the camera looks, levelled", () => {
    expect(toHeading([0.6, 0, -0.8], [0.8, 0, 0.6])).toEqual([1, 0]);
    expect(toHeading([0, -1, 0], [0, 0, 1])).toEqual([0, -1]);
  });

  it("is the top of the picture of a camera that looks down, and its bottom when it looks up", () => {
    expect(toHeading([0, 0, -1], [0, 1, 0])).toEqual([0, 1]);
    expect(toHeading([0, 0, 1], [0, 1, 0])).toEqual([-0, -1]);
  });
});

describe("a page that draws slowly", () => {
  /** A drag of half a second in which so many pictures are drawn, and then one without the robot. */
  const drag = (watch: SlownessWatch, pictures: number, isLate: boolean): string => {
    watch.note(true, false, 100, 1000);
    watch.note(true, isLate, 100 + pictures, 1500);
    watch.note(false, false, 160 + pictures, 2500);
    return watch.words;
  };

  it("says so when that ends a drag, until the next one", () => {
    const watch = new SlownessWatch();
    expect(drag(watch, 3, true)).toMatch(/draws only 6 pictures a second.*smaller window/);
    expect(drag(watch, 3, false)).toBe("");
  });

  it("is not the reason where enough is drawn, or where there is no picture", () => {
    const watch = new SlownessWatch();
    expect([drag(watch, 30, true), drag(watch, Number.NaN, true)]).toEqual(["", ""]);
  });
});
