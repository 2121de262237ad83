// The buttons that enter a headset, on the stage; or one line that says why there are none.

import type { WorkerClient } from "../core/page_client.ts";
import type { Actions } from "../ui/actions.ts";
import { button, h, setText } from "../ui/dom.ts";
import type { PageState } from "../ui/state.ts";
import type { StreamChoices } from "../ui/stream_choices.ts";
import type { View } from "../view/view.ts";
import { Headset, type Mode } from "./headset.ts";

const MODES: readonly (readonly [Mode, string])[] = [
  ["immersive-ar", "Enter AR"],
  ["immersive-vr", "Enter VR"],
];

export interface HeadsetControls {
  element: HTMLElement;
  /** The immersive session, null without one. */
  headset: Headset | null;
}

/** Return why this page cannot enter a headset, empty: it can try. */
export function describeMissing(isSecure: boolean, hasWebXr: boolean): string {
  if (!isSecure) return "No AR and VR: this address is neither HTTPS nor of this machine.";
  return hasWebXr ? "" : "No AR and VR: this browser has no WebXR.";
}

export function makeHeadsetControls(
  view: View | null,
  state: PageState,
  client: WorkerClient,
  choices: StreamChoices,
  makeActions: (show: (text: string) => void) => Actions,
): HeadsetControls {
  const words = h("span", { class: "check note" });
  const element = h("span", { class: "headset" }, words);
  const controls: HeadsetControls = { element, headset: null };
  if (!view) return controls;
  const buttons = MODES.map(([mode, text]) => {
    const enter = async (): Promise<void> => {
      for (const one of buttons) one.disabled = true;
      try {
        controls.headset = await begin(mode, view, (session, show) => new Headset(session, mode, view, state, client, choices, makeActions(show)));
        controls.headset.session.addEventListener("end", () => {
          controls.headset = null;
          for (const one of buttons) one.disabled = false;
        });
        setText(words, "");
      } catch (error) {
        for (const one of buttons) one.disabled = false;
        setText(words, `${text}: ${(error as Error).message}`);
      }
    };
    return button(text, () => void enter(), { class: "small primary", hidden: true });
  });
  const emulate = button("Try an emulated headset", () => void startEmulator(), { class: "small", hidden: true });
  const startEmulator = async (): Promise<void> => {
    emulate.disabled = true;
    try {
      const { installEmulator } = await import("./emulator.ts"); // large, and for few
      installEmulator();
      await update();
    } catch (error) {
      emulate.disabled = false;
      setText(words, `The emulated headset cannot be loaded: ${(error as Error).message}`);
    }
  };
  /** Say why there is no headset, empty: there is one. Where there is a mouse the emulator takes the place of the words. */
  const offerEmulator = (why: string): void => {
    emulate.hidden = why === "" || !isSecureContext || matchMedia("(pointer: coarse)").matches;
    emulate.title = why;
    setText(words, emulate.hidden ? why : "");
  };
  element.prepend(...buttons);
  element.append(emulate);
  const update = async (): Promise<void> => {
    const supported = await Promise.all(MODES.map(([mode]) => navigator.xr?.isSessionSupported(mode).catch(() => false) ?? false));
    buttons.forEach((one, i) => (one.hidden = !supported[i]));
    state.offersAr = supported[0] ?? false;
    offerEmulator(supported.some(Boolean) ? "" : "No headset at this browser.");
  };
  const missing = describeMissing(isSecureContext, "xr" in navigator && navigator.xr !== undefined);
  if (missing !== "") {
    offerEmulator(missing);
    return controls;
  }
  navigator.xr?.addEventListener("devicechange", () => void update());
  void update();
  return controls;
}

async function begin(mode: Mode, view: View, make: (session: XRSession, show: (text: string) => void) => Headset): Promise<Headset> {
  const session = await navigator.xr!.requestSession(mode, { requiredFeatures: ["local-floor"], optionalFeatures: ["hand-tracking", "anchors"] });
  const headset: Headset = make(session, (text) => headset.show(text));
  session.addEventListener("end", () => headset.dispose());
  try {
    await view.present(session, headset);
  } catch (error) {
    await session.end();
    throw error;
  }
  return headset;
}
