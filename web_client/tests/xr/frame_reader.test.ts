// Frames of an emulated headset (iwer) as readings. Nothing is drawn.

import { XRDevice, metaQuest3 } from "iwer";
import { beforeAll, describe, expect, test, vi } from "vitest";

import { nowMs } from "../../src/core/api.ts";
import { FrameReader } from "../../src/xr/frame_reader.ts";
import { BUTTON, type FrameReading } from "../../src/xr/reading.ts";

let quest: XRDevice;
let isGuess = false;
/** Reads the next frame. */
let read: () => Promise<FrameReading>;
beforeAll(async () => {
  vi.stubGlobal("requestAnimationFrame", (callback: FrameRequestCallback) => setTimeout(() => callback(performance.now()), 5));
  class Context {
    canvas = { width: 640, height: 360, style: {}, parentElement: null };
    getContextAttributes = () => ({ xrCompatible: true });
    constructor() {
      const nothing = (): number[] => [0, 0, 0, 0]; // nothing is drawn
      return new Proxy(this, { get: (target, name) => Reflect.get(target, name) ?? nothing });
    }
  }
  class Point {
    constructor(readonly x = 0, readonly y = 0, readonly z = 0, readonly w = 1) {}
  }
  vi.stubGlobal("DOMPointReadOnly", Point);
  vi.stubGlobal("WebGL2RenderingContext", Context);
  vi.stubGlobal("WebGLRenderingContext", Context);
  const element = (): object => ({ style: {}, dataset: {}, appendChild: () => null, addEventListener: () => undefined });
  vi.stubGlobal("document", { createElement: element, body: element() });
  vi.stubGlobal("window", globalThis);
  vi.stubGlobal("localStorage", { getItem: () => null, setItem: () => undefined });
  quest = new XRDevice(metaQuest3);
  quest.installRuntime({ forceInstall: true });
  // The emulator says of every pose that it is a guess; headsets say so of devices that they have lost.
  Object.defineProperty(XRPose.prototype, "emulatedPosition", { get: () => isGuess });
  const session = await navigator.xr!.requestSession("immersive-ar", { requiredFeatures: ["local-floor"], optionalFeatures: ["hand-tracking"] });
  const space = await session.requestReferenceSpace("local-floor");
  await session.updateRenderState({ baseLayer: new XRWebGLLayer(session, new WebGL2RenderingContext()) });
  const reader = new FrameReader(session);
  read = () => new Promise((resolve) => session.requestAnimationFrame((_time, frame) => resolve(reader.read(frame, space))));
  for (let i = 0; i < 3; i++) await read();
});

test("head and controllers: poses in the axes of the wire, buttons, time of the frame", async () => {
  const { right } = quest.controllers;
  quest.position.set(0, 1.6, 0);
  right!.position.set(0.2, 1.1, -0.4); // ahead is -z, right is x
  right!.quaternion.set(0, 0, 0, 1);
  right!.updateButtonValue("trigger", 0.25);
  right!.updateButtonValue("squeeze", 1);
  right!.updateButtonValue("a-button", 1);
  await read();
  const before = nowMs();
  const reading = await read();
  expect(reading.capture_ms).toBeGreaterThanOrEqual(before);
  expect(reading.capture_ms).toBeLessThanOrEqual(nowMs());
  expect(reading.headTracked).toBe(true);
  reading.head![0].forEach((value, i) => expect(value).toBeCloseTo([0, 0, 1.6][i]!, 5));
  const input = reading.inputs.find(({ side }) => side === "right")!;
  expect(input).toMatchObject({ kind: "controller", tracked: true, squeeze: 1, buttons: BUTTON.trigger | BUTTON.squeeze | BUTTON.lower });
  expect(input.trigger).toBeCloseTo(0.25);
  input.ray!.origin.forEach((value, i) => expect(value).toBeCloseTo([0.4, -0.2, 1.1][i]!, 5));
  input.ray!.direction.forEach((value, i) => expect(value).toBeCloseTo([1, 0, 0][i]!, 5));
  input.pose![1].forEach((value, i) => expect(value).toBeCloseTo([1, 0, 0, 0][i]!, 5)); // others see its x axis as the ray
  expect(Math.hypot(...input.pose![0].map((value, i) => value - input.ray!.origin[i]!))).toBeLessThan(0.15); // where it is held

  isGuess = true;
  const guessed = await read();
  isGuess = false;
  expect(guessed).toMatchObject({ headTracked: false, headEmulated: true, inputs: [0, 1].map(() => ({ tracked: false, emulated: true })) });
});

test("bare hands: a wrist, and a pinch for the trigger", async () => {
  quest.primaryInputMode = "hand";
  await read();
  const open = (await read()).inputs.find(({ side }) => side === "left")!;
  expect(open).toMatchObject({ kind: "hand", tracked: true, buttons: 0 });
  quest.hands.left!.updatePinchValue(1);
  await read();
  const pinched = (await read()).inputs.find(({ side }) => side === "left")!;
  expect(pinched.trigger).toBeGreaterThan(open.trigger);
  expect(open.tip).not.toBeNull();
});

test("bare hands: 25 joints in the tracking frame, the wrist first, at most 30 times a second", async () => {
  quest.primaryInputMode = "hand";
  await read();
  const frames: FrameReading[] = [];
  const begin = performance.now();
  while (performance.now() - begin < 200) frames.push(await read());
  const told = frames.flatMap(({ inputs }) => inputs.filter(({ joints }) => joints.length > 0));
  expect(told.length).toBeGreaterThanOrEqual(4);
  expect(told.length).toBeLessThanOrEqual(2 * 7);
  for (const { pose, joints, tip } of told) {
    expect(joints.length).toBe(25 * 7);
    expect(joints.slice(0, 7)).toEqual(pose!.flat());
    expect(joints.slice(9 * 7, 9 * 7 + 3)).toEqual(tip); // index-finger-tip is the tenth
    for (let i = 0; i < 25; i++) expect(Math.hypot(...joints.slice(7 * i + 3, 7 * i + 7))).toBeCloseTo(1, 4);
  }
});

describe("devices that the emulator does not have", () => {
  const pose = (x: number): XRPose => ({ transform: { position: { x, y: 0, z: 0 }, orientation: { x: 0, y: 0, z: 0, w: 1 } }, emulatedPosition: false }) as unknown as XRPose;
  const poses = { aim: pose(0.06), grip: pose(0) as XRPose | null };
  const frame = { getViewerPose: () => pose(0), getPose: (name: keyof typeof poses) => poses[name] } as unknown as XRFrame;
  const readSources = (...inputSources: object[]): FrameReading => new FrameReader({ inputSources } as unknown as XRSession).read(frame, {} as XRReferenceSpace);
  const controller = (pressed: readonly number[] = [], handedness = "right"): object => {
    const buttons = [0, 1, 2, 3].map((i) => ({ value: 0, pressed: pressed.includes(i) }));
    return { handedness, targetRaySpace: "aim", gripSpace: "grip", gamepad: { buttons } };
  };

  test("a controller whose grip is lost stays where it was, not tracked: it is nowhere else", () => {
    const reader = new FrameReader({ inputSources: [controller()] } as unknown as XRSession);
    const [before] = reader.read(frame, {} as XRReferenceSpace).inputs;
    poses.grip = null;
    const [lost] = reader.read(frame, {} as XRReferenceSpace).inputs;
    poses.grip = pose(0);
    expect([before!, lost!].map(({ tracked, emulated }) => [tracked, emulated])).toEqual([[true, false], [false, false]]);
    expect(lost!.pose).toEqual(before!.pose);
    const handheld = { handedness: "right", targetRaySpace: "aim" };
    expect(readSources(handheld).inputs[0]).toMatchObject({ tracked: true }); // has no grip at all
  });

  test("buttons of the e-stop count on every device: of no side, and the second one of a hand", () => {
    expect(readSources(controller(), controller([2], "none"), controller([3])).stops.length).toBe(2);
    expect(readSources(controller([0, 1]), { handedness: "left", targetRaySpace: "aim" }).stops).toEqual([]);
  });
});
