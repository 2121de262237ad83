// The bar above everything: which session, how fresh the picture is, who you are, and the e-stop.

import type { Actions } from "./actions.ts";
import { button, closeOutside, h, setOptions, setText, setValue, takesText } from "./dom.ts";
import type { Joining } from "./joining.ts";
import type { Panel } from "./panel.ts";
import type { PageState } from "./state.ts";
import { formatMilliseconds, pauseWords, roleWords } from "./words.ts";

/** Ages above which the badge warns [ms]: of the picture that is shown. */
const GOOD_AGE_MS = 120;
const BAD_AGE_MS = 400;

/** Age of what is shown, rate and round trip. `getDelay`: delay of the interpolation [ms]. */
export function makeBadge(state: PageState, getDelay: () => number): Panel {
  const dot = h("span", { class: "signal", aria: { hidden: "true" } });
  const age = h("span");
  const rate = h("span");
  const trip = h("span");
  const element = h(
    "div",
    { class: "badge", role: "group", aria: { label: "Connection" }, title: "Age of the picture, states per second, round trip" },
    dot,
    h("span", { class: "item" }, h("small", {}, "age"), age),
    h("span", { class: "item" }, h("small", {}, "rate"), rate),
    h("span", { class: "item" }, h("small", {}, "round trip"), trip),
  );
  return {
    element,
    update: () => {
      const { stats } = state;
      const isFresh = state.isReady && stats !== null;
      const shown = isFresh ? Math.max(stats.age_ms_p50, getDelay()) : Number.NaN;
      setText(age, formatMilliseconds(shown));
      setText(rate, !isFresh ? "–" : state.pause ? "paused" : `${stats.state_hz.toFixed(0)} Hz`);
      setText(trip, isFresh ? formatMilliseconds(stats.rtt_ms > 0 ? stats.rtt_ms : state.rtt_ms) : "–");
      const quality = !isFresh || stats.state_hz < 1 || shown > BAD_AGE_MS ? "bad" : shown > GOOD_AGE_MS || state.pause ? "fair" : "good";
      dot.className = `signal ${quality}`;
    },
  };
}

/**
 * The e-stop: a large button and a key. Stopping needs one press, clearing is for directors. `isDriving`: a robot is driven
 * from the desk, so the key stops whatever else it would press.
 */
export function makeEstop(state: PageState, actions: Actions, isDriving: () => boolean): { stop: HTMLElement; banner: HTMLElement; update: () => void } {
  const word = h("span", { class: "word" }, "E-STOP");
  const key = h("small", {}, "Space");
  const stop = h("button", { type: "button", class: "estop", id: "estop", aria: { keyshortcuts: "Space" } }, word, key);
  const press = (reason: string): void => {
    actions.estop(reason);
    stop.classList.add("pressed");
    setTimeout(() => stop.classList.remove("pressed"), 300);
  };
  stop.addEventListener("click", () => press("button of the dashboard"));
  document.addEventListener(
    "keydown",
    (event) => {
      if (stop.disabled || event.key !== " " || event.repeat || event.ctrlKey || event.metaKey || event.altKey) return;
      if (!event.shiftKey && (isDriving() ? takesText(event.target) : takesSpace(event.target))) return;
      event.preventDefault();
      press("key in the dashboard");
    },
    { capture: true },
  );
  const text = h("strong");
  const clear = button(
    "Clear",
    () => void actions.request({ type: "clear_estop", stop_seq: state.session?.stop_seq ?? 0 }, "The e-stop is cleared."),
    { class: "clear", id: "clear-estop" },
  );
  const note = h("span", { class: "note" });
  const banner = h("div", { class: "banner stopped", role: "alert", hidden: true }, text, note, clear);
  return {
    stop,
    banner,
    update: () => {
      const isStopped = state.session?.estop ?? false;
      stop.classList.toggle("active", isStopped);
      stop.disabled = state.phase.ended && !state.isReady;
      stop.title = !state.isReady
        ? "Not connected: use the stop at the robot"
        : isStopped
          ? "The e-stop is in force. Press to stop again"
          : "Stop all robots";
      setText(word, isStopped ? "STOPPED" : "E-STOP");
      if (banner.hidden === isStopped) banner.hidden = !isStopped;
      if (!isStopped) return;
      const newest = state.status?.stops[0];
      const name = newest?.participant ? state.nameOf(newest.participant, newest.name) : newest?.name;
      const who = name ? ` by ${name}` : "";
      setText(text, `Stopped${who}${newest?.reason ? `: ${newest.reason}` : ""}`);
      setText(note, !state.isReady ? "Before the connection was lost." : state.isDirector ? "All robots hold." : "All robots hold. A director can clear it.");
      clear.hidden = !state.isDirector || !state.isReady;
    },
  };
}

/** A pause: the button over the picture, and the banner with who paused, why, and what ends it. */
export function makePause(state: PageState, actions: Actions): { button: HTMLElement; element: HTMLElement; update: () => void } {
  const text = h("strong");
  const note = h("span", { class: "note" });
  const resume = button("Resume", () => void actions.request({ type: "control", action: "resume" }), { id: "resume" });
  const element = h("div", { class: "banner paused", role: "alert", hidden: true }, text, note, resume);
  const begin = button("Pause", () => void actions.request({ type: "control", action: "pause" }), { class: "small pause", title: "Let robots and objects stand still, for everyone" });
  return {
    button: begin,
    element,
    update: () => {
      const { pause } = state;
      begin.hidden = !state.isDirector || !state.isReady;
      begin.toggleAttribute("disabled", pause !== null);
      element.hidden = pause === null;
      if (pause === null) return;
      setText(text, pauseWords(pause.by, pause.reason));
      const who = state.isDirector ? "you resume" : "a director resumes";
      setText(note, `Robots and objects stand still until ${who}${pause.reason ? ", from the beginning of the scene" : ""}.`);
      setText(resume, pause.reason ? "Reset and resume" : "Resume");
      resume.hidden = !state.isDirector || !state.isReady;
    },
  };
}

/** Return whether a key press of Space means something else to what has the focus. */
function takesSpace(target: EventTarget | null): boolean {
  return target instanceof HTMLElement && target.closest("button, input, select, textarea, summary, a, dialog") !== null;
}

/** Who this page is: name and role, to change them. */
export function makeSelf(state: PageState, joining: Joining): Panel {
  const summary = h("summary", {});
  const name = h("input", { type: "text", id: "self-name", attributes: { maxlength: "64", spellcheck: "false", autocomplete: "nickname" } });
  const role = h("select", { id: "self-role" });
  const identity = h("p", { class: "note" });
  const submit = h("button", { class: "primary" });
  const form = h(
    "form",
    { class: "popover" },
    h("label", { class: "field" }, h("span", {}, "Your name"), name),
    h("label", { class: "field" }, h("span", {}, "Join as"), role),
    submit,
    identity,
  );
  const element = h("details", { class: "self" }, summary, form);
  form.addEventListener("submit", (event) => {
    event.preventDefault();
    element.open = false;
    joining.answer(name.value.trim() || joining.name, role.value);
  });
  const describe = (): void => setText(submit, joining.describeAnswer(role.value));
  role.addEventListener("change", describe);
  closeOutside(element, summary);
  return {
    element,
    update: () => {
      const { self } = state;
      const roles = new Set([...joining.listRoles(), ...(self ? [self.role] : [])]); // a director may have given it another one
      setOptions(role, [...roles].map((one) => [one, roleWords(one)] as const));
      setText(summary, self ? `${self.name}, ${roleWords(self.role)}` : "Not joined");
      if (!element.open && self) {
        setValue(name, self.name);
        setValue(role, self.role);
      }
      describe();
      const fingerprint = state.identity?.fingerprint ?? "";
      setText(identity, fingerprint ? `Fingerprint of this browser: ${fingerprint}` : "");
    },
  };
}
