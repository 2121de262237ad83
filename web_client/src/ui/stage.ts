// The picture and what lies over it: choice of camera, progress of loading, and words when there is no picture.

import type { PhaseUpdate } from "../core/api.ts";
import type { View } from "../view/view.ts";
import { button, h, setOptions, setText } from "./dom.ts";
import type { PageState } from "./state.ts";
import { capitalize, formatBytes } from "./words.ts";

const PHASE_WORDS: Record<string, string> = {
  idle: "Not joined",
  joining: "Joining the session …",
  syncing: "Fetching the state of the session …",
  waiting: "The connection is lost. Trying again …",
  refused: "The session refused this browser",
  closed: "The session has ended",
};

function phaseWords({ phase, refusal, ended }: PhaseUpdate): string {
  if (refusal === "unpaired") return "This browser is not paired yet";
  return ended && phase !== "refused" ? "The session has ended" : (PHASE_WORDS[phase] ?? phase);
}

export interface Stage {
  element: HTMLElement;
  canvas: HTMLCanvasElement;
  /** The bar over the picture. */
  tools: HTMLElement;
  /** Set the view, or the reason why there is none. */
  setView(view: View | null, problem: string): void;
  update(): void;
}

export function makeStage(state: PageState, actions: { pair: () => void; retry: () => void }): Stage {
  const canvas = h("canvas", {
    id: "scene",
    tabindex: 0,
    role: "img",
    aria: { label: "The scene. Arrow keys turn the view, with Shift they move it, plus and minus go nearer and farther." },
  });
  const camera = h("select", { class: "small", aria: { label: "Camera" } });
  let view: View | null = null;
  camera.addEventListener("change", () => view?.viewpoint.choose(Number(camera.value)));
  const home = button("Whole scene", () => {
    view?.showWhole();
    camera.value = "-1";
  }, { class: "small" });
  const names = h("input", { type: "checkbox", attributes: { checked: "" } });
  names.addEventListener("change", () => {
    if (!view) return;
    view.anchors.group.visible = view.avatars.group.visible = names.checked;
    element.classList.toggle("no-names", !names.checked);
    view.touch();
  });
  // On phones the tools lie behind one button, so that the picture is seen.
  const more = button("View", () => more.setAttribute("aria-expanded", String(tools.classList.toggle("open"))), { class: "small more-tools", aria: { expanded: "false" } });
  const tools = h("div", { class: "tools" }, more, camera, home, h("label", { class: "check" }, names, h("span", {}, "Labels and people")));
  const bar = h("progress", { attributes: { max: "1" }, aria: { label: "Loading the scene" } });
  const loaded = h("span");
  const progress = h("div", { class: "loading", hidden: true }, bar, loaded);
  const title = h("h2");
  const words = h("p");
  const advice = h("p", { class: "note" });
  const pair = button("Enter a join code", () => actions.pair(), { class: "primary" });
  const retry = button("Join again", () => actions.retry());
  const message = h(
    "div",
    { class: "message card", role: "status", hidden: true },
    title,
    words,
    advice,
    h("div", { class: "controls" }, pair, retry),
  );
  const trouble = h("p", { class: "trouble", hidden: true });
  const element = h("section", { class: "stage", aria: { label: "Scene" } }, canvas, tools, trouble, progress, message);
  return {
    element,
    canvas,
    tools,
    setView: (made, problem) => {
      view = made;
      setText(trouble, problem);
      trouble.hidden = problem === "";
      tools.hidden = made === null;
    },
    update: () => {
      const { phase, info, spec } = state;
      const cameras = spec?.cameras ?? [];
      setOptions(camera, [["-1", "Free view"], ...cameras.map((one, i) => [String(i), one.name || `camera ${i}`] as const)]);
      const { progress: loading } = state;
      const isLoading = loading !== null && loading.done < loading.wanted;
      progress.hidden = !isLoading;
      if (isLoading) {
        bar.value = loading.bytes > 0 ? loading.bytes_done / loading.bytes : loading.done / loading.wanted;
        setText(loaded, `${formatBytes(loading.bytes_done)} of ${formatBytes(loading.bytes)}`);
      }
      const isStale = phase.phase === "ready" && phase.stalled;
      message.hidden = phase.phase === "ready" && !isStale;
      message.classList.toggle("slim", spec !== null);
      canvas.classList.toggle("outdated", !message.hidden);
      setText(title, isStale ? "The session does not step" : phaseWords(phase));
      setText(words, capitalize(phase.text || info?.text || ""));
      setText(advice, phase.advice);
      pair.hidden = !(phase.phase === "refused" && (phase.refusal === "unpaired" || phase.refusal === "code"));
      retry.hidden = !["refused", "closed", "idle"].includes(phase.phase);
    },
  };
}
