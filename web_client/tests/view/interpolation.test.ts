import { expect, test } from "vitest";

import { DelayEstimator, FrameBuffer, interpolatePoses, interpolateValues } from "../../src/view/interpolation.ts";

const pose = (x: number, q: [number, number, number, number] = [1, 0, 0, 0]): Float32Array =>
  new Float32Array([x, 0, 0, ...q]);

test("a frame between two others is found with its share, and older ones are given back", () => {
  const released: Float32Array[] = [];
  const buffer = new FrameBuffer(({ values }) => released.push(values));
  const first = pose(0);
  buffer.push({ session_ms: 100, values: first });
  buffer.push({ session_ms: 110, values: pose(1) });
  buffer.push({ session_ms: 120, values: pose(2) });
  const found = buffer.around(115)!;
  expect([found.before.session_ms, found.after.session_ms, found.share]).toEqual([110, 120, 0.5]);
  expect(released).toEqual([first]);
});

test("before the first and after the last frame there is no extrapolation", () => {
  const buffer = new FrameBuffer();
  expect(buffer.around(0)).toBeNull();
  buffer.push({ session_ms: 100, values: pose(0) });
  buffer.push({ session_ms: 110, values: pose(1) });
  expect(buffer.around(50)!.share).toBe(0);
  expect(buffer.around(500)!.before.session_ms).toBe(110);
});

test("time that goes back, or another number of bodies, begins anew", () => {
  const buffer = new FrameBuffer();
  buffer.push({ session_ms: 100, values: pose(0) });
  buffer.push({ session_ms: 20, values: pose(1) });
  expect(buffer.around(1000)!.before.values[0]).toBe(1);
  buffer.push({ session_ms: 30, values: new Float32Array(14) });
  expect(buffer.around(25)!.before.values.length).toBe(14);
});

test("a frame that is sent again replaces the one before", () => {
  const buffer = new FrameBuffer();
  buffer.push({ session_ms: 100, values: pose(0) });
  buffer.push({ session_ms: 100, values: pose(7) });
  expect(buffer.around(100)!.before.values[0]).toBe(7);
});

test("rotations take the short way and stay of unit length", () => {
  const out = new Float32Array(7);
  const half = Math.SQRT1_2;
  interpolatePoses(pose(0, [1, 0, 0, 0]), pose(1, [-half, 0, 0, -half]), 0.5, out);
  expect(out[0]).toBeCloseTo(0.5);
  expect(Math.hypot(...out.subarray(3))).toBeCloseTo(1, 6);
  expect(out[3]!).toBeGreaterThan(0.9); // 45 degrees, not 135
});

test("values that are written again have not changed", () => {
  const [a, b, out] = [Float32Array.of(0.1, 2), Float32Array.of(0.3, 2), new Float32Array(2)];
  expect(interpolateValues(a, b, 0.25, out)).toBe(true);
  expect(out[0]).toBeCloseTo(0.15);
  expect(interpolateValues(a, b, 0.25, out)).toBe(false);
  expect(interpolateValues(a, b, 0.5, out)).toBe(true);
});

test("the delay covers the age of late frames at once and shrinks slowly", () => {
  const delay = new DelayEstimator();
  for (let i = 0; i < 100; i++) delay.add(5, 16, i * 16);
  const calm = delay.delay_ms;
  for (let i = 0; i < 30; i++) delay.add(90, 16, 1600 + i * 16);
  expect(delay.delay_ms).toBeGreaterThan(90);
  expect(calm).toBeLessThan(60);
  const before = delay.delay_ms;
  delay.add(5, 16, 2100);
  expect(before - delay.delay_ms).toBeLessThan(10);
});
