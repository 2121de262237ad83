// Labels at robots: which of them stay where many would cover each other.

import { expect, test } from "vitest";

import { drivenWords, findCrowded, type LabelBox } from "../../src/ui/robot_overlay.ts";
import type { PageState } from "../../src/ui/state.ts";

const make = (x: number, y: number, depth: number, rank = 0): LabelBox => ({ x, y, width: 100, height: 20, depth, rank });

test("of labels that cover each other the nearer one stays", () => {
  const [far, near, below] = [make(100, 100, 0.9), make(160, 110, 0.5), make(100, 121, 0.7)] as const;
  expect(findCrowded([far, near, below])).toEqual(new Set([far, below]));
  expect(findCrowded([far, below])).toEqual(new Set());
});

test("one of a greater rank stays before nearer ones", () => {
  const [held, near] = [make(100, 100, 0.9, 1), make(150, 100, 0.5)];
  expect(findCrowded([near, held])).toEqual(new Set([near]));
});

test("what is left out makes no others disappear", () => {
  const row = [make(0, 100, 0.1), make(60, 100, 0.2), make(120, 100, 0.3)];
  expect(findCrowded(row)).toEqual(new Set([row[1]]));
});

test("the label of a driven robot says when it does not follow", () => {
  const make = (changed: object): PageState => ({ isReady: true, pause: null, session: { estop: false }, phase: { ended: false, stalled: false }, ...changed }) as unknown as PageState;
  expect(drivenWords(make({}), false)).toBe("you drive");
  expect(drivenWords(make({}), true)).toBe("held");
  expect(drivenWords(make({ session: { estop: true } }), true)).toBe("stopped");
  expect(drivenWords(make({ pause: { by: "", reason: "" } }), false)).toBe("paused");
  expect(drivenWords(make({ isReady: false, phase: { ended: true } }), false)).toBe("ended");
});
