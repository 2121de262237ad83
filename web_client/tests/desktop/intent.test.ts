import { beforeEach, describe, expect, it } from "vitest";

import { ClutchKey, DRIVE_KEYS, DragPath, KEY_WORDS, makeIdle, merge, type ModifierReading, type PadReading, readKeys, readPad, readSpaceMouse } from "../../src/desktop/intent.ts";
import { SpaceMouseState } from "../../src/desktop/spacemouse.ts";

const keys = (...codes: string[]): ReturnType<typeof readKeys> => readKeys(new Set(codes), false);

describe("keys", () => {
  it("move and turn along the axes of the view", () => {
    expect(keys("KeyW").move).toEqual([0, 1, 0]);
    expect(keys("KeyS", "KeyD").move).toEqual([1, -1, 0]);
    expect(keys("KeyR").move).toEqual([0, 0, 1]);
    expect(keys("KeyF").move).toEqual([0, 0, -1]);
    expect(keys("KeyA", "KeyD").move).toEqual([0, 0, 0]);
    expect(keys("ArrowLeft", "ArrowUp").turn).toEqual([1, 0, 1]);
    expect(keys("KeyQ").turn).toEqual([0, -1, 0]);
  });

  it("ask for the dead-man as its key says", () => {
    for (const clutch of [true, false, null]) expect(readKeys(new Set(["KeyW"]), clutch).clutch).toBe(clutch);
  });

  it("do not have the e-stop among them", () => {
    expect(DRIVE_KEYS.has("Space")).toBe(false);
    expect(KEY_WORDS.length).toBeGreaterThan(0);
  });
});

describe("the dead-man key", () => {
  const NONE = { shiftKey: false, ctrlKey: false, metaKey: false, altKey: false };
  let key: ClutchKey;

  function take(type: string, code: string, shiftKey: boolean, more: Partial<ModifierReading> = {}): boolean | null {
    key.take({ ...NONE, type, code, shiftKey, ...more });
    return key.isHeld;
  }

  beforeEach(() => {
    key = new ClutchKey();
    key.take({ ...NONE, type: "pointermove" });
  });

  it("is the left Shift key only, held until it is let go", () => {
    expect(key.isHeld).toBe(false);
    expect(take("keydown", "KeyW", false)).toBe(false);
    expect(take("keydown", "ShiftLeft", true)).toBe(true);
    expect(take("keydown", "KeyW", true)).toBe(true);
    expect(take("keyup", "ShiftLeft", false)).toBe(false);
  });

  it("is let go by any event that tells of no Shift key", () => {
    take("keydown", "ShiftLeft", true);
    expect(take("pointermove", "", false)).toBe(false);
  });

  it("is void beside the right Shift key, in either order, until both are let go", () => {
    take("keydown", "ShiftLeft", true);
    expect(take("keydown", "ShiftRight", true)).toBe(null);
    expect(take("keydown", "ShiftLeft", true)).toBe(null);
    expect(take("keyup", "ShiftRight", true)).toBe(null);
    expect(take("keyup", "ShiftLeft", false)).toBe(false);
    expect(take("keydown", "ShiftRight", true)).toBe(null);
    expect(take("keydown", "ShiftLeft", true)).toBe(null);
    expect(take("keyup", "ShiftLeft", true)).toBe(null);
  });

  it("is void beside Ctrl, Alt and Meta", () => {
    for (const modifier of ["ctrlKey", "altKey", "metaKey"] as const) {
      take("keydown", "ShiftLeft", false);
      expect(take("keydown", "KeyW", true, { [modifier]: true })).toBe(null);
      expect(take("keydown", "ShiftLeft", true)).toBe(null);
      take("keyup", "ShiftLeft", false);
    }
  });

  it("does not begin with a repeated key event, or with one whose first press came elsewhere", () => {
    expect(take("keydown", "ShiftLeft", true, { repeat: true })).toBe(false);
    key.forget();
    expect(take("keydown", "ShiftLeft", true)).toBe(null);
    expect(take("keyup", "ShiftLeft", false)).toBe(false);
    expect(take("keydown", "ShiftLeft", true)).toBe(true);
  });
});

describe("gamepads", () => {
  const pad = (axes: number[], pressed: number[], mapping = "standard"): PadReading => ({
    mapping,
    axes,
    buttons: Array.from({ length: 17 }, (_, i) => ({ pressed: pressed.includes(i) })),
  });

  it("move with the sticks: pushing them away is forward and up", () => {
    const intent = readPad(pad([0, -1, 0, -1], [5]));
    expect(intent.clutch).toBe(true);
    expect(intent.move).toEqual([0, 1, 1]);
    expect(readPad(pad([1, 0, 1, 0], [12, 14])).turn).toEqual([1, -1, -1]);
    expect(readPad(pad([0, 0, 0, 0], [0])).close).toBe(true);
    expect(readPad(pad([0, 0, 0, 0], [1])).open).toBe(true);
  });

  it("rest around zero, and go on from there without a step", () => {
    expect(readPad(pad([0.14, -0.1, 0, 0], [])).move.map(Math.abs)).toEqual([0, 0, 0]);
    expect(readPad(pad([0.16, 0, 0, 0], [])).move[0]).toBeCloseTo(0.0118, 3);
  });

  it("count for nothing with an unknown order, or with numbers that are none", () => {
    expect(readPad(pad([1, 1, 1, 1], [0, 5], ""))).toEqual(makeIdle());
    expect(readPad({ mapping: "standard", axes: [Number.NaN], buttons: [] }).move.map(Math.abs)).toEqual([0, 0, 0]);
  });
});

describe("a SpaceMouse", () => {
  const report = (...values: number[]): DataView => new DataView(Int16Array.from(values).buffer);

  it("reports translation and rotation apart, or together", () => {
    const state = new SpaceMouseState();
    state.take(1, report(350, 0, 0), 0);
    state.take(2, report(0, 0, 175), 0);
    expect(state.axes).toEqual([1, 0, 0, 0, 0, 0.5]);
    state.take(1, report(0, 35, 0, 0, -350, 0), 0);
    expect(state.axes).toEqual([0, 0.1, 0, 0, -1, 0]);
  });

  it("has axes to the right, to the person, and down", () => {
    const state = new SpaceMouseState();
    state.take(1, report(350, 350, 350, 350, 350, 350), 0);
    expect(readSpaceMouse(state, 0).move).toEqual([1, -1, -1]);
    expect(readSpaceMouse(state, 0).turn).toEqual([1, -1, -1]);
  });

  it("holds the dead-man with its first button", () => {
    const state = new SpaceMouseState();
    state.take(3, new DataView(Uint8Array.of(1, 0).buffer), 0);
    expect(readSpaceMouse(state, 0).clutch).toBe(true);
    state.take(3, new DataView(Uint8Array.of(2, 0).buffer), 0);
    expect(readSpaceMouse(state, 0)).toMatchObject({ clutch: false, toggle: true });
  });

  it("ignores short and unknown reports, and bounds what is beyond its range", () => {
    const state = new SpaceMouseState();
    state.take(1, report(100, 100), 0);
    state.take(23, report(100, 100, 100), 0);
    state.take(3, new DataView(new ArrayBuffer(0)), 0);
    expect(state.axes).toEqual([0, 0, 0, 0, 0, 0]);
    state.take(1, report(32767, -32768, 0), 0);
    expect(state.axes.slice(0, 2)).toEqual([1, -1]);
  });

  it("has a dead-man that is not known before a report", () => {
    const state = new SpaceMouseState();
    expect(readSpaceMouse(state, 0).clutch).toBe(null);
    state.take(3, new DataView(Uint8Array.of(0, 0).buffer), 0);
    expect(readSpaceMouse(state, 0).clutch).toBe(false);
    state.clear();
    expect(readSpaceMouse(state, 0).clutch).toBe(null);
  });

  it("stands still, its dead-man not known, when a deflected cap is silent for 200 ms", () => {
    const state = new SpaceMouseState();
    state.take(3, new DataView(Uint8Array.of(1, 0).buffer), 0);
    state.take(1, report(350, 0, 0), 1000);
    expect(readSpaceMouse(state, 1200)).toMatchObject({ clutch: true, move: [1, -0, -0] });
    expect(readSpaceMouse(state, 1201)).toEqual({ ...makeIdle(), clutch: null });
    state.take(1, report(0, 0, 0), 1300);
    expect(readSpaceMouse(state, 9000).clutch).toBe(true); // a cap at rest reports nothing
  });

  it("has a dead-man that is not known after ten seconds without a report, if it was held", () => {
    const state = new SpaceMouseState();
    state.take(3, new DataView(Uint8Array.of(1, 0).buffer), 1000);
    expect(readSpaceMouse(state, 11_000).clutch).toBe(true);
    expect(readSpaceMouse(state, 11_001)).toEqual({ ...makeIdle(), clutch: null });
    state.take(23, report(0, 0, 0), 12_000); // the receiver may send others without its link
    expect(readSpaceMouse(state, 12_000).clutch).toBe(null);
    state.take(3, new DataView(Uint8Array.of(0, 0).buffer), 13_000);
    expect(readSpaceMouse(state, 60_000).clutch).toBe(false); // let go: the next press counts
  });
});

describe("merge", () => {
  it("adds up to at most full speed on each axis", () => {
    expect(merge([keys("KeyW"), keys("KeyW", "KeyD")]).move).toEqual([1, 1, 0]);
  });
});

describe("a dragged way", () => {
  it("is done at the full speed at most, and completely when it is slow", () => {
    const path = new DragPath();
    path.add([0.003, -0.004, 0]);
    expect(path.take(0.1, 0.1)).toEqual([expect.closeTo(0.3), expect.closeTo(-0.4), 0]);
    expect(path.take(0.1, 0.1)).toEqual([0, 0, 0]);
  });

  it("does not go on for long after a fast mouse", () => {
    const path = new DragPath();
    path.add([1, 0, 0]);
    let done = 0;
    for (let i = 0; i < 100; i++) done += path.take(0.1, 0.017)[0] * 0.1 * 0.017;
    expect(done).toBeCloseTo(0.1 * (0.1 + 0.017), 6);
  });

  it("takes no number that is none", () => {
    const path = new DragPath();
    path.add([Number.NaN, Number.POSITIVE_INFINITY, 0]);
    expect(path.take(0.1, 0.1)).toEqual([0, 0, 0]);
  });
});
