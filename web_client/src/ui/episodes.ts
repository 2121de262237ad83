// Episodes: the strip over the picture with the task, how far it is, the countdown and the buttons; and its words, which headsets show too.

import type { SessionUpdate } from "../core/api.ts";
import type { Actions } from "./actions.ts";
import { button, h, setText } from "./dom.ts";
import { makeSection, type Panel } from "./panel.ts";
import type { PageState } from "./state.ts";
import { episodeStateWords } from "./words.ts";

export type EpisodeNow = NonNullable<SessionUpdate["episode"]>;

/** Roles that may start and end episodes. */
const EPISODE_ROLES = ["operator", "director", "agent", "leader"];
const OVER = ["idle", "success", "failure", "discarded", "unknown", "cancelled"];
const RECORDED = ["running", "confirm", "left"];
/** Keys of the page: the number row drives nothing. */
const KEYS: Record<string, string> = { Digit1: "begin", Digit2: "failure", Digit3: "discard", Digit4: "rerecord" };

/** Return whether no episode is counted down, recorded or closed. */
export const isEpisodeOver = (now: EpisodeNow | null): boolean => now === null || OVER.includes(now.state);

/** Return the whole seconds until something ends; `now_ns`: session time. */
export const secondsLeft = (now: EpisodeNow | null, now_ns: number): number =>
  now === null || now.until_ns === 0 || now_ns === 0 ? 0 : Math.max(0, Math.ceil((now.until_ns - now_ns) / 1e9));

/** Return whether people wait for its countdown, or it for an answer. */
export const isUrgent = (now: EpisodeNow | null): boolean => now !== null && ["countdown", "confirm", "left", "closing"].includes(now.state);

/** Return "Episode 13, 12 of 50"; `next`: of the next one while there is none. */
export function episodeTitle(now: EpisodeNow | null): string {
  if (now === null) return "No episode yet";
  const count = now.wanted > 0 ? `, ${now.successes} of ${now.wanted}` : "";
  return `${now.state === "idle" ? `${now.number} episodes so far` : `Episode ${now.number}`}${count}`;
}

/** Return what there is to know or to do now, empty: nothing. `leader`: name of the participant that leads it. */
export function episodeAdvice(now: EpisodeNow | null, now_ns: number, leader: string): string {
  if (now === null) return "";
  const left = secondsLeft(now, now_ns);
  switch (now.state) {
    case "countdown":
      return `begins in ${left}`;
    case "running":
      return leader ? `is recorded, led by ${leader}` : "is recorded";
    case "confirm":
      return `discard it? Press Discard again within ${left} s`;
    case "left":
      return `${leader || "its leader"} is disconnected: take it over within ${left} s`;
    case "closing":
      return now.verdict ? `${episodeStateWords(now.verdict)}: the scene is made ready` : `robots hold: was it a success? ${left} s`;
    case "idle":
      return "";
    default:
      return episodeStateWords(now.state);
  }
}

/** Return the lines of a board: the task, the episode, what to do. None without an episode and a task. */
export function describeEpisode(state: PageState): string[] {
  const now = state.session?.episode ?? null;
  if (now === null) return [];
  const advice = adviseOnEpisode(state);
  return [now.instruction || now.task, `${episodeTitle(now)}${advice ? `: ${advice}` : ""}`].filter((line) => line !== "");
}

/** Return `episodeAdvice` for this page, and between episodes what keeps it from starting the next one. */
export function adviseOnEpisode(state: PageState): string {
  const now = state.session?.episode ?? null;
  const advice = episodeAdvice(now, state.sessionTime(), now?.led_by ? state.nameOf(now.led_by) : "");
  if (!isEpisodeOver(now) || !mayAct(state) || mayBegin(state)) return advice;
  const robots = listTaskRobots(state);
  const which = robots.length > 2 ? `one of ${robots.join(", ")}` : robots.join(" or ");
  return [advice, `take ${which} to start`].filter((one) => one !== "").join("; ");
}

/** Return whether the role of this page starts and ends episodes. */
const mayAct = (state: PageState): boolean => state.isReady && EPISODE_ROLES.includes(state.role);

/** Return whether the session lets this page start an episode or reset the scene: directors and holders of a robot of the task. */
export function mayBegin(state: PageState): boolean {
  const robots = listTaskRobots(state);
  const held = state.heldBy(state.selfId);
  return state.isDirector || robots.length === 0 || robots.some((name) => held.includes(name));
}

function listTaskRobots(state: PageState): string[] {
  const wanted = state.welcome?.task_robots ?? [];
  return (state.session?.robots ?? []).map(({ name }) => name).filter((name) => wanted.length === 0 || wanted.includes(name));
}

export interface EpisodeStrip {
  /** Over the picture. */
  element: HTMLElement;
  /** Of the dashboard: the label, and what is seldom needed. */
  panel: Panel;
  update(): void;
}

export function makeEpisodeStrip(state: PageState, actions: Actions): EpisodeStrip {
  const label = h("input", { type: "text", id: "episode-label", attributes: { maxlength: "512", placeholder: "Label (optional)" } });
  const send = (action: string): void => void actions.request({ type: "episode", action, label: label.value.trim() });
  const act = (text: string, action: string, className = "small"): HTMLButtonElement => button(text, () => send(action), { class: className });
  const task = h("p", { class: "task" });
  const title = h("strong");
  const advice = h("span", { aria: { live: "polite" } });
  const withKey = (one: HTMLButtonElement, key: string): HTMLButtonElement => {
    one.append(h("kbd", { class: "key", aria: { hidden: "true" } }, key));
    one.setAttribute("aria-keyshortcuts", key);
    return one;
  };
  const start = withKey(act("Start", "start", "small primary"), "1");
  const verdicts = [withKey(act("Success", "success", "small good"), "1"), withKey(act("Failure", "failure"), "2")];
  const discardText = h("span");
  const discard = button("", () => send("discard"), { class: "small" });
  discard.append(discardText);
  withKey(discard, "3");
  const again = withKey(act("Again", "rerecord"), "4");
  const [stop, takeOver] = [act("Stop", "stop"), act("Take over", "take_over")];
  const controls = h("div", { class: "controls" }, start, ...verdicts, discard, again, stop, takeOver);
  const strip = h("div", { class: "episode card", role: "group", hidden: true, aria: { label: "Episode" } }, task, h("p", {}, title, " ", advice), controls);
  const countdown = h("div", { class: "countdown", hidden: true, aria: { hidden: "true" } });
  const now = h("p", { class: "big" });
  const reset = act("Reset scene", "reset");
  const begin = act("Start", "start", "small primary");
  const extra = h("div", { class: "controls" }, begin, reset);
  const field = h("div", { class: "controls" }, h("label", { for: "episode-label", class: "hidden-text" }, "Label of the episode"), label);
  const section = makeSection("episodes", "Episodes", h("div", {}, now, field, extra));
  let timer = 0;

  window.addEventListener("keydown", (event) => {
    const isTyped = event.target instanceof HTMLElement && event.target.closest("input, select, textarea, dialog") !== null;
    const key = KEYS[event.code];
    const episode = state.session?.episode ?? null;
    if (key === undefined || isTyped || event.repeat || event.ctrlKey || event.metaKey || event.altKey || event.shiftKey || !mayAct(state) || strip.hidden) return;
    const isOver = isEpisodeOver(episode);
    if (!isOver) send(key === "begin" ? "success" : key);
    else if (key === "begin" && mayBegin(state)) send("start");
  });

  const update = (): void => {
    const episode = state.session?.episode ?? null;
    const [isOver, isRecorded] = [isEpisodeOver(episode), RECORDED.includes(episode?.state ?? "")];
    const isAwaited = episode?.state === "closing" && episode.verdict === "";
    // Without a task the strip is there from the first episode on.
    strip.hidden = episode === null;
    strip.classList.toggle("running", isRecorded);
    setText(task, episode?.instruction || episode?.task || "");
    task.hidden = task.textContent === "";
    setText(advice, adviseOnEpisode(state));
    setText(title, `${episodeTitle(episode)}${isOver && advice.textContent ? ":" : ""}`);
    const left = secondsLeft(episode, state.sessionTime());
    countdown.hidden = episode?.state !== "countdown" || left === 0;
    setText(countdown, String(left));
    setText(now, episode?.label ? `${episodeTitle(episode)} (${episode.label})` : episodeTitle(episode));
    now.classList.toggle("running", isRecorded);
    field.hidden = controls.hidden = extra.hidden = !mayAct(state);
    const hasLeft = episode?.state === "left";
    start.hidden = reset.hidden = !isOver || !mayBegin(state);
    begin.hidden = episode !== null || !mayBegin(state);
    stop.hidden = !isRecorded || hasLeft;
    for (const verdict of verdicts) verdict.hidden = hasLeft || !(isRecorded || isAwaited);
    discard.hidden = hasLeft || !(isRecorded || isAwaited || episode?.state === "countdown");
    setText(discardText, episode?.state === "countdown" ? "Cancel" : episode?.state === "confirm" ? "Discard: sure?" : "Discard");
    again.hidden = hasLeft || !(isRecorded || isAwaited);
    takeOver.hidden = !(hasLeft || (!isOver && episode?.led_by !== state.selfId && state.isDirector));
    clearTimeout(timer);
    if (left > 0) timer = window.setTimeout(() => state.touch(), 100);
  };
  const element = h("div", { class: "episodes" }, countdown, strip);
  return { element, panel: { element: section.element, update: () => undefined }, update };
}
