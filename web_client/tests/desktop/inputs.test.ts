import { afterEach, beforeEach, expect, it, vi } from "vitest";

import type { SampleInput } from "../../src/core/api.ts";
import { DesktopDevice } from "../../src/desktop/device.ts";
import { DesktopInputs } from "../../src/desktop/inputs.ts";
import type { Vec3 } from "../../src/desktop/intent.ts";

class Target extends EventTarget {
  readonly classList = { remove: (): void => undefined };
}

const NONE = { shiftKey: false, ctrlKey: false, metaKey: false, altKey: false };
const SITUATION = { isReady: true, isStopped: false, isPaused: false, isHolder: true };

let page: EventTarget;
let hid: EventTarget & { getDevices: () => Promise<EventTarget[]> };
let mouse: EventTarget;
let pads: object[];
let inputs: DesktopInputs;
let device: DesktopDevice;
let sent: SampleInput[];
let slider: HTMLInputElement;
let handles: { isHeld: boolean; lag_s: number; readWay: (move: Vec3) => void; letGo: () => void };

const makePad = (isHeld: boolean): object => ({
  connected: true,
  id: "pad",
  index: 0,
  mapping: "standard",
  axes: [0, -1, 0, 0],
  buttons: Array.from({ length: 17 }, (_, i) => ({ pressed: i === 5 && isHeld })),
});

function dispatch(type: string, properties: object = {}): void {
  vi.advanceTimersByTime(17);
  page.dispatchEvent(Object.assign(new Event(type), properties));
}

function press(code: string): void {
  dispatch("keydown", { ...NONE, shiftKey: true, code });
}

function reportButtons(bits: number): void {
  mouse.dispatchEvent(Object.assign(new Event("inputreport"), { reportId: 3, data: new DataView(Uint8Array.of(bits, 0).buffer) }));
}

/** Tick for some time [ms]; return the last sample. */
function tick(for_ms = 34): SampleInput {
  for (let t_ms = 0; t_ms < for_ms; t_ms += 17) {
    vi.advanceTimersByTime(17);
    const now_ms = performance.timeOrigin + performance.now();
    device.tick(inputs.read(0.1, 0.017, now_ms, [0, 1]), [0, 1], 0.1, SITUATION, now_ms);
  }
  return sent.at(-1)!;
}

beforeEach(async () => {
  vi.useFakeTimers();
  pads = [];
  sent = [];
  page = new EventTarget();
  mouse = Object.assign(new EventTarget(), { opened: true, productName: "SpaceMouse", vendorId: 0x256f });
  hid = Object.assign(new EventTarget(), { getDevices: () => Promise.resolve([mouse]) });
  vi.stubGlobal("window", page);
  vi.stubGlobal("document", Object.assign(new EventTarget(), { hidden: false, pointerLockElement: null }));
  vi.stubGlobal("navigator", { getGamepads: () => pads, hid });
  vi.stubGlobal("HTMLElement", class {});
  slider = Object.assign(new EventTarget(), { value: "0" }) as HTMLInputElement;
  handles = { isHeld: false, lag_s: 0, readWay: (move) => (move[2] = 1), letGo: () => (handles.isHeld = false) };
  device = new DesktopDevice((sample) => sent.push(sample));
  inputs = new DesktopInputs({ handle: new Target() as unknown as HTMLElement, slider, handles }, {
    onRelease: (reason) => device.release(reason, 0),
    onQuit: () => undefined,
  });
  dispatch("pointerdown", NONE); // on "Drive"
  device.arm("left", 0);
  inputs.start();
  await vi.advanceTimersByTimeAsync(17);
  tick();
});

afterEach(() => {
  inputs.stop();
  vi.unstubAllGlobals();
  vi.useRealTimers();
});

it("the first press of the key after the click that begins driving counts", () => {
  press("ShiftLeft");
  press("KeyW");
  expect(tick()).toMatchObject({ clutch: true, twist: [0, 0.1, 0, 0, 0, 0] });
});

it("the right Shift key voids the dead-man", () => {
  press("ShiftLeft");
  expect(tick().clutch).toBe(true);
  press("ShiftRight");
  expect(tick().clutch).toBe(false);
  dispatch("keyup", { ...NONE, code: "ShiftRight" });
  tick();
  press("ShiftLeft");
  expect(tick().clutch).toBe(true);
});

it("a key that is held while the focus is away has to be let go", () => {
  press("ShiftLeft");
  tick();
  dispatch("blur");
  expect(tick()).toMatchObject({ clutch: false });
  expect(device.released).toBe("the window lost the focus");
  dispatch("focus");
  press("ShiftLeft"); // some systems do not mark it as repeated
  expect(tick(300).clutch).toBe(false);
  dispatch("keyup", { ...NONE, code: "ShiftLeft" });
  tick();
  press("ShiftLeft");
  expect(tick().clutch).toBe(true);
});

it("a gamepad that comes back with its button held has to be let go", () => {
  pads = [makePad(false)];
  tick();
  pads = [makePad(true)];
  expect(tick().clutch).toBe(true);
  pads = [];
  dispatch("gamepaddisconnected");
  expect(tick().clutch).toBe(false);
  pads = [makePad(false)]; // not read yet
  dispatch("gamepadconnected");
  tick(17);
  pads = [makePad(true)];
  expect(tick(500).clutch).toBe(false);
  pads = [makePad(false)];
  tick();
  pads = [makePad(true)];
  expect(tick().clutch).toBe(true);
});

it("a gamepad that is pressed while the focus is away has to be let go", () => {
  pads = [makePad(false)];
  tick();
  dispatch("blur");
  tick();
  pads = [makePad(true)];
  expect(tick().clutch).toBe(false);
  pads = [makePad(false)]; // an old state
  dispatch("focus");
  tick(17);
  pads = [makePad(true)];
  expect(tick(500).clutch).toBe(false);
});

it("a SpaceMouse whose button stays held while the focus is away has to be let go", () => {
  reportButtons(0);
  tick();
  reportButtons(1);
  expect(tick().clutch).toBe(true);
  dispatch("blur");
  tick();
  dispatch("focus");
  tick(300);
  reportButtons(3); // its second button
  expect(tick().clutch).toBe(false);
  reportButtons(0);
  tick();
  reportButtons(1);
  expect(tick()).toMatchObject({ clutch: true, gripper: null });
});

it("a SpaceMouse that reported nothing for ten seconds while its button was held has to be let go", () => {
  reportButtons(0);
  tick();
  reportButtons(1);
  expect(tick(9000).clutch).toBe(true);
  expect(tick(1100).clutch).toBe(false);
  mouse.dispatchEvent(Object.assign(new Event("inputreport"), { reportId: 1, data: new DataView(new ArrayBuffer(6)) }));
  expect(tick().clutch).toBe(false);
  reportButtons(0);
  tick();
  reportButtons(1);
  expect(tick().clutch).toBe(true);
});

it("a SpaceMouse that comes back with its button held has to be let go", async () => {
  reportButtons(0);
  tick();
  reportButtons(1);
  expect(tick().clutch).toBe(true);
  hid.dispatchEvent(Object.assign(new Event("disconnect"), { device: mouse }));
  expect(tick().clutch).toBe(false);
  await inputs.spaceMouse.reopen();
  reportButtons(1);
  expect(tick().clutch).toBe(false);
});

it("the slider moves the gripper alone, while it is held and a moment longer", () => {
  slider.value = "60";
  expect(tick()).toMatchObject({ clutch: false });
  slider.dispatchEvent(new Event("pointerdown"));
  expect(tick()).toMatchObject({ clutch: true, gripper: 0.6, twist: [0, 0, 0, 0, 0, 0] });
  pads = [{ ...makePad(false), axes: [1, -1, 1, 1] }]; // its button is not held
  expect(tick().twist).toEqual([0, 0, 0, 0, 0, 0]);
  dispatch("pointerup", NONE);
  expect(tick(1400)).toMatchObject({ clutch: true, gripper: 0.6, twist: [0, 0, 0, 0, 0, 0] });
  expect(tick(200).clutch).toBe(false);
  slider.dispatchEvent(new Event("input")); // an arrow key
  expect(tick(1400).clutch).toBe(true);
  expect(tick(200).clutch).toBe(false);
});

it("a gripper that finishes ends with the focus, another input, or a hold, and does not begin anew", () => {
  const slide = (): boolean => {
    slider.dispatchEvent(new Event("pointerdown"));
    tick();
    dispatch("pointerup", NONE);
    return tick().clutch === true;
  };
  expect(slide()).toBe(true);
  dispatch("blur");
  expect(tick().clutch).toBe(false);
  dispatch("focus");
  expect(tick(500).clutch).toBe(false);
  expect(slide()).toBe(true);
  handles.isHeld = true;
  expect(tick(51)).toMatchObject({ clutch: true, twist: [0, 0, expect.closeTo(0.1), 0, 0, 0] });
  handles.isHeld = false;
  expect(tick().clutch).toBe(false);
  expect(slide()).toBe(true);
  inputs.endSlide();
  expect(tick().clutch).toBe(false);
  slider.dispatchEvent(new Event("pointerdown"));
  tick();
  inputs.endSlide();
  expect(tick().clutch).toBe(true); // as long as it is held
  dispatch("pointerup", NONE);
  expect(tick().clutch).toBe(false);
});

it("handles that are held when the focus is lost are let go, and do not count when it is back", () => {
  handles.isHeld = true;
  expect(tick()).toMatchObject({ clutch: true, gripper: null, twist: [0, 0, expect.closeTo(0.1), 0, 0, 0] });
  dispatch("blur");
  expect(handles.isHeld).toBe(false);
  expect(tick().clutch).toBe(false);
  dispatch("focus");
  expect(tick(500).clutch).toBe(false);
});
