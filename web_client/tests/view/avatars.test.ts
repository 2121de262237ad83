// People in the scene: until when they are shown.

import { afterEach, beforeEach, expect, test, vi } from "vitest";

import type { PresenceItem } from "../../src/core/api.ts";
import { Avatars } from "../../src/view/avatars.ts";

const ANN = { name: "ann", color: "#3d9be9", detail: "", isSelf: false };

let avatars: Avatars;
beforeEach(() => {
  vi.stubGlobal("document", { createElement: () => ({ getContext: () => null }) });
  avatars = new Avatars();
  avatars.setPeople(new Map([["p2", ANN]]));
});
afterEach(() => vi.unstubAllGlobals());

/** A hand of ann is at x, at a session time. */
function say(x: number, capture_ms: number): void {
  const item = ["p2", "hand/left", [[x, 0, 0], [1, 0, 0, 0]], 1e6 * capture_ms] as unknown as PresenceItem;
  avatars.setPresence([item], capture_ms);
}

/** Draw at a session time, and return where hands are. */
function draw(session_ms: number): number[] {
  avatars.update(session_ms);
  return avatars.group.children.map(({ position }) => position.x);
}

test("a hand that is not reported any more disappears", () => {
  say(1, 10_000);
  expect(draw(10_300)).toEqual([1]);
  expect(draw(9_700)).toEqual([1]); // what is drawn lies behind session time
  expect(draw(11_600)).toEqual([]);
});

test("after a restart of the session its participants are shown, and none of the session before, also under the same id", () => {
  say(1, 3_600_000);
  expect(draw(3_600_000)).toEqual([1]);
  say(2, 900); // the clock of the page is still that of the session before
  expect(draw(1_000)).toEqual([]);
  say(3, 1_100);
  expect(draw(1_100)).toEqual([3]);
});
