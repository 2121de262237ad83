// When shadows are drawn anew.

import { expect, test } from "vitest";

import { Shadows } from "../../src/view/shadows.ts";

test("shadows follow what moves, at most once in a period, and the last motion is not left out", () => {
  const map = { autoUpdate: true, needsUpdate: false };
  const shadows = new Shadows(map, 100);
  const drawnAt = (now_ms: number, isMoved: boolean): boolean => {
    map.needsUpdate = false;
    if (isMoved) shadows.markOld();
    shadows.renew(now_ms);
    return map.needsUpdate;
  };
  expect(map.autoUpdate).toBe(false);
  expect([0, 30, 60, 90, 120].map((now_ms) => drawnAt(now_ms, true))).toEqual([true, false, false, false, true]);
  expect(drawnAt(150, true)).toBe(false);
  expect(shadows.renew(180)).toBe(true); // a frame is wanted for what moved
  expect(drawnAt(220, false)).toBe(true);
  expect(shadows.renew(400)).toBe(false);
});
