// The form for the join code: by hand, or filled in from the address `#c=CODE`.

import type { WorkerClient } from "../core/page_client.ts";
import { h, setText } from "./dom.ts";

export interface Pairing {
  dialog: HTMLDialogElement;
  open(code: string, text: string): void;
}

/** `onPaired` gets the name and the roles that this browser may join as; an empty list means any. */
export function makePairing(
  client: WorkerClient,
  baseUrl: string,
  getName: () => string,
  onPaired: (name: string, roles: string[]) => void,
): Pairing {
  const code = h("input", {
    type: "text",
    id: "pair-code",
    attributes: { required: "", autocomplete: "one-time-code", autocapitalize: "characters", spellcheck: "false", placeholder: "XXXX-XXXX-XXXX" },
  });
  const name = h("input", { type: "text", id: "pair-name", attributes: { required: "", maxlength: "64" } });
  const why = h("p", {});
  const result = h("p", { class: "advice", role: "alert" });
  const submit = h("button", { class: "primary" }, "Pair this browser");
  const cancel = h("button", { type: "button" }, "Not now");
  const form = h(
    "form",
    { attributes: { method: "dialog" } },
    h("h2", { id: "pair-title" }, "Pair this browser"),
    why,
    h("p", { class: "note" }, "On the computer of the session run: iris-session pair --web"),
    h("label", { class: "field" }, h("span", {}, "Join code"), code),
    h("label", { class: "field" }, h("span", {}, "Name of this browser"), name),
    result,
    h("div", { class: "controls" }, submit, cancel),
  );
  const dialog = h("dialog", { class: "card", aria: { labelledby: "pair-title" } }, form);
  const setBusy = (isBusy: boolean): void => {
    submit.disabled = isBusy;
    setText(submit, isBusy ? "Pairing …" : "Pair this browser");
  };
  cancel.addEventListener("click", () => dialog.close());
  form.addEventListener("submit", (event) => {
    event.preventDefault();
    setText(result, "");
    setBusy(true);
    client.post({ type: "pair", base_url: baseUrl, code: code.value.trim(), name: name.value.trim() });
  });
  client.on("paired", ({ ok, roles, text }) => {
    setBusy(false);
    if (!ok) {
      setText(result, text || "The code does not fit.");
      code.focus();
      code.select();
      return;
    }
    dialog.close();
    onPaired(name.value.trim(), roles);
  });
  return {
    dialog,
    open: (filled, text) => {
      if (dialog.open) return;
      if (filled) code.value = filled;
      if (!name.value) name.value = getName();
      setText(why, text);
      setText(result, "");
      dialog.showModal();
      (code.value ? submit : code).focus();
    },
  };
}
