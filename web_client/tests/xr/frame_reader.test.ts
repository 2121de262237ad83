// Frames of an emulated headset (iwer) as readings. Nothing is drawn.

import { XRDevice, metaQuest3 } from "iwer";
import { beforeAll, expect, test, vi } from "vitest";

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
  const lost = await read();
  isGuess = false;
  expect([lost.headTracked, ...lost.inputs.map(({ tracked }) => tracked)]).toEqual([false, false, false]);
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
});
