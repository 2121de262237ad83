// A section of the dashboard: a heading that folds, and a body.

import { h } from "./dom.ts";
import type { PageState } from "./state.ts";

export interface Panel {
  element: HTMLElement;
  update(state: PageState): void;
}

/** Return a section that can be folded. `count` is shown beside the title. */
export function makeSection(
  id: string,
  title: string,
  body: HTMLElement,
  options: { open?: boolean } = {},
): { element: HTMLDetailsElement; setCount: (text: string) => void } {
  const count = h("span", { class: "count" });
  const heading = h("h2", {}, title);
  const element = h("details", { class: "panel", id: `panel-${id}` }, h("summary", {}, heading, count), body);
  element.open = options.open ?? true;
  return {
    element,
    setCount: (text) => {
      if (count.textContent !== text) count.textContent = text;
    },
  };
}

/** Return a row of facts: a list of terms and values, whose values can be set by name. */
export function makeFacts(names: readonly string[]): { element: HTMLDListElement; set: (name: string, value: string) => void } {
  const values = new Map<string, HTMLElement>();
  const rows = names.map((name) => {
    const value = h("dd");
    values.set(name, value);
    return h("div", {}, h("dt", {}, name), value);
  });
  return {
    element: h("dl", { class: "facts" }, ...rows),
    set: (name, value) => {
      const element = values.get(name);
      if (element && element.textContent !== value) element.textContent = value;
    },
  };
}
