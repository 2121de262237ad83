// Helpers around the DOM, with elements of the test.

import { afterEach, expect, test, vi } from "vitest";

import { closeOutside } from "../../src/ui/dom.ts";

afterEach(() => vi.unstubAllGlobals());

test("what a summary opens is closed by Escape and by a press elsewhere, not by one inside", () => {
  const page = new EventTarget();
  vi.stubGlobal("document", page);
  const popover = { open: true, contains: (target: unknown) => target === popover };
  const summary = { focus: vi.fn() };
  closeOutside(popover as unknown as HTMLDetailsElement, summary as unknown as HTMLElement);
  const dispatch = (type: string, properties: object): boolean => {
    const event = Object.defineProperties(new Event(type), Object.getOwnPropertyDescriptors(properties));
    page.dispatchEvent(event);
    return popover.open;
  };
  expect(dispatch("pointerdown", { target: popover })).toBe(true);
  expect(dispatch("pointerdown", { target: page })).toBe(false);
  popover.open = true;
  expect([dispatch("keydown", { key: "a" }), dispatch("keydown", { key: "Escape" })]).toEqual([true, false]);
  expect(summary.focus).toHaveBeenCalledOnce();
});
