// Asked once in each browser: what others call this person, and as what they are here.

import { button, h, setOptions, setText, setValue } from "./dom.ts";
import type { Joining } from "./joining.ts";
import type { PageState } from "./state.ts";
import { roleWords } from "./words.ts";

const ROLE_NOTES: Record<string, string> = {
  director: "drives, assigns, pauses, clears stops",
  operator: "drives",
  observer: "looks and stops",
};

export interface Welcome {
  element: HTMLElement;
  update(): void;
}

/** Make the row that asks. */
export function makeWelcome(state: PageState, joining: Joining): Welcome {
  const why = h("p", { class: "note" });
  const name = h("input", { type: "text", id: "welcome-name", attributes: { maxlength: "64", spellcheck: "false", autocomplete: "nickname", placeholder: "Your name", required: "" } });
  const role = h("select", { id: "welcome-role", aria: { label: "Your role" } });
  const submit = h("button", { class: "primary" });
  const describe = (): void => setText(submit, joining.describeAnswer(role.value));
  role.addEventListener("change", describe);
  const element = h(
    "form",
    { class: "welcome", hidden: true, aria: { label: "Who are you?" } },
    why,
    h("label", { class: "hidden-text", for: "welcome-name" }, "Name for others"),
    name,
    role,
    submit,
    button("Not now", () => joining.answer("", ""), { class: "quiet" }),
  );
  element.addEventListener("submit", (event) => {
    event.preventDefault();
    if (name.value.trim()) joining.answer(name.value.trim(), role.value);
  });
  return {
    element,
    update: () => {
      const isShown = joining.isAsking && state.isReady && state.self !== undefined;
      element.hidden = !isShown;
      if (!isShown) return;
      const isOpen = state.info?.pairing === false && state.role === "director";
      setText(why, isOpen ? `You are “${state.self?.name}”, director like all on this machine.` : `You are “${state.self?.name}”, ${roleWords(state.role)}.`);
      setOptions(role, joining.listRoles().map((one) => [one, `${roleWords(one)}: ${ROLE_NOTES[one] ?? ""}`] as const));
      if (!role.dataset.isSet) {
        role.dataset.isSet = "yes";
        setValue(role, state.role);
      }
      describe();
    },
  };
}
