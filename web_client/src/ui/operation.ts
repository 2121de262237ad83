// The session itself: its loop, recording, and the advice of its own checks.

import type { Actions } from "./actions.ts";
import { button, h, KeyedList, setText } from "./dom.ts";
import { makeFacts, makeSection, type Panel } from "./panel.ts";
import type { PageState } from "./state.ts";
import { formatBytes, formatMilliseconds, formatShare, formatSessionTime } from "./words.ts";

export function makeLoopPanel(state: PageState, actions: Actions): Panel {
  const facts = makeFacts(["Time", "Rate", "Late ticks", "Processor", "Memory", "State after"]);
  const control = (text: string, action: string): HTMLButtonElement =>
    button(text, () => void actions.request({ type: "control", action }), { class: "small" });
  const [pause, resume, step, reset] = [control("Pause", "pause"), control("Resume", "resume"), control("One step", "step"), control("Reset", "reset")];
  const controls = h("div", { class: "controls" }, pause, resume, step, reset);
  const section = makeSection("loop", "Loop", h("div", {}, facts.element, controls));
  return {
    element: section.element,
    update: () => {
      const { status, session } = state;
      const period = session?.tick_period_ns || state.welcome?.tick_period_ns || 0;
      facts.set("Time", status ? formatSessionTime(status.session_time) : "–");
      facts.set("Rate", period > 0 ? `${(1e9 / period).toFixed(0)} Hz${session?.paused ? ", paused" : ""}` : "–");
      facts.set("Late ticks", status ? formatShare(status.late_share) : "–");
      facts.set("Processor", status ? `${formatShare(status.cpu_share)} of one, load ${status.load.toFixed(1)} of ${status.cpus}` : "–");
      facts.set("Memory", status ? formatBytes(status.memory_bytes) : "–");
      facts.set("State after", status?.step_to_publish ? formatMilliseconds(status.step_to_publish[0]) : "–");
      section.setCount(session?.paused ? "paused" : state.phase.stalled ? "stalled" : "");
      controls.hidden = !state.isDirector;
      pause.hidden = session?.paused ?? false;
      resume.hidden = step.hidden = !(session?.paused ?? false);
    },
  };
}

export function makeRecordingPanel(state: PageState, actions: Actions): Panel {
  const facts = makeFacts(["State", "File", "Written", "Disk free", "Lost"]);
  const words = h("p", { class: "advice", hidden: true });
  const note = h("input", { type: "text", id: "marker-text", attributes: { maxlength: "512", placeholder: "Note for the recording" } });
  const form = h("form", { class: "controls" }, h("label", { for: "marker-text", class: "hidden-text" }, "Note for the recording"), note, h("button", { class: "small" }, "Add note"));
  form.addEventListener("submit", (event) => {
    event.preventDefault();
    const text = note.value.trim();
    if (!text) return;
    void actions.request({ type: "marker", text }, "Note added.").then((granted) => {
      if (granted) note.value = "";
    });
  });
  const section = makeSection("recording", "Recording", h("div", {}, facts.element, words, form));
  return {
    element: section.element,
    update: () => {
      const recorder = state.status?.recorder ?? null;
      const names: Record<string, string> = {
        off: "off: nothing is recorded",
        running: "running",
        hangs: "hangs",
        dead: "is being replaced",
        failed: "failed: the file cannot be written",
        ended: "ended: its budget is used up",
      };
      const { isReady, phase } = state;
      facts.set("State", !isReady ? (phase.ended ? "the session has ended" : "not known: not connected") : recorder ? (names[recorder.state] ?? recorder.state) : "–");
      facts.set("File", recorder?.path || "–");
      const rate = recorder && recorder.bytes_per_hour > 0 ? `, ${formatBytes(recorder.bytes_per_hour)} an hour now` : "";
      facts.set("Written", recorder ? formatBytes(recorder.bytes_written) + rate : "–");
      facts.set("Disk free", recorder && recorder.disk_free_bytes > 0 ? formatBytes(recorder.disk_free_bytes) : "–");
      facts.set("Lost", recorder ? `${recorder.lost_rows} steps` : "–");
      const text = recorder?.text ?? "";
      setText(words, text);
      words.hidden = text === "";
      section.setCount(isReady ? (recorder?.state ?? "") : "");
      form.hidden = !isReady;
    },
  };
}

export function makeAdvicePanel(state: PageState): Panel {
  const list = h("ul", { class: "notes" });
  const rows = new KeyedList<string>(list, (text) => ({ element: h("li", {}, text), update: () => undefined }));
  const section = makeSection("advice", "Advice", list);
  return {
    element: section.element,
    update: () => {
      const { status } = state;
      const found = [...(status?.warnings ?? [])];
      if (status?.pause_reason && !status.paused) found.unshift(status.pause_reason); // else the banner says it
      if (state.progress?.refusal) found.push(`Loading the scene waits: ${state.progress.refusal}`);
      rows.update(found, (text) => text);
      section.element.hidden = found.length === 0;
      section.setCount(String(found.length));
    },
  };
}

export function makeEventsPanel(state: PageState): Panel {
  const list = h("ol");
  const empty = h("p", { class: "empty" }, "Nothing has happened yet.");
  const log = h("div", { class: "log", role: "log", tabindex: 0, aria: { live: "off", label: "Events, newest first" } }, list);
  const section = makeSection("events", "Events", h("div", {}, log, empty));
  const rows = new KeyedList<PageState["log"][number]>(
    list,
    (entry) => {
      const text = h("span", {}, entry.text);
      const element = h("li", { class: entry.level }, h("span", { class: "time" }, formatSessionTime(entry.session_time)), text);
      return { element, update: (item) => setText(text, item.text) };
    },
    empty,
  );
  return {
    element: section.element,
    update: () => rows.update(state.log.slice(0, 100), (entry) => String(entry.seq)),
  };
}
