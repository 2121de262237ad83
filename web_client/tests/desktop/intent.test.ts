import { describe, expect, it } from "vitest";

import { DRIVE_KEYS, DragPath, KEY_WORDS, makeIdle, merge, type PadReading, readKeys, readPad, readSpaceMouse } from "../../src/desktop/intent.ts";
import { SpaceMouseState } from "../../src/desktop/spacemouse.ts";

const keys = (...codes: string[]): ReturnType<typeof readKeys> => readKeys(new Set(codes));

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

  it("hold the dead-man with the left Shift key only", () => {
    expect(keys("KeyW").clutch).toBe(false);
    expect(keys("ShiftRight", "KeyW").clutch).toBe(false);
    expect(keys("ShiftLeft").clutch).toBe(true);
  });

  it("do not have the e-stop among them", () => {
    expect(DRIVE_KEYS.has("Space")).toBe(false);
    expect(KEY_WORDS.length).toBeGreaterThan(0);
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
    state.take(1, report(350, 0, 0));
    state.take(2, report(0, 0, 175));
    expect(state.axes).toEqual([1, 0, 0, 0, 0, 0.5]);
    state.take(1, report(0, 35, 0, 0, -350, 0));
    expect(state.axes).toEqual([0, 0.1, 0, 0, -1, 0]);
  });

  it("has axes to the right, to the person, and down", () => {
    const state = new SpaceMouseState();
    state.take(1, report(350, 350, 350, 350, 350, 350));
    expect(readSpaceMouse(state).move).toEqual([1, -1, -1]);
    expect(readSpaceMouse(state).turn).toEqual([1, -1, -1]);
  });

  it("holds the dead-man with its first button", () => {
    const state = new SpaceMouseState();
    state.take(3, new DataView(Uint8Array.of(1, 0).buffer));
    expect(readSpaceMouse(state).clutch).toBe(true);
    state.take(3, new DataView(Uint8Array.of(2, 0).buffer));
    expect(readSpaceMouse(state)).toMatchObject({ clutch: false, toggle: true });
  });

  it("ignores short and unknown reports, and bounds what is beyond its range", () => {
    const state = new SpaceMouseState();
    state.take(1, report(100, 100));
    state.take(23, report(100, 100, 100));
    state.take(3, new DataView(new ArrayBuffer(0)));
    expect(state.axes).toEqual([0, 0, 0, 0, 0, 0]);
    state.take(1, report(32767, -32768, 0));
    expect(state.axes.slice(0, 2)).toEqual([1, -1]);
  });
});

describe("merge", () => {
  it("adds up to at most full speed on each axis", () => {
    const merged = merge([keys("KeyW"), keys("KeyW", "KeyD"), { ...makeIdle(), clutch: true }]);
    expect(merged.move).toEqual([1, 1, 0]);
    expect(merged.clutch).toBe(true);
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
