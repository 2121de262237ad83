// The panel "Streams": what media the session has, in which state they are, and which of them this page shows.

import type { WorkerClient } from "../core/page_client.ts";
import { StreamAudience } from "../protocol/messages.g.ts";
import { h, KeyedList, type Row, setText } from "./dom.ts";
import { makeSection, type Panel } from "./panel.ts";
import type { PageState } from "./state.ts";
import type { Stream, StreamChoices } from "./stream_choices.ts";
import { budgetWords, formatCount, isDoubtful, streamAgeWords, streamStateWords } from "./words.ts";

/** What the view tells of the clouds that it draws. */
export interface DrawnClouds {
  /** Points of the newest frame, and how many of them are drawn; undefined: it is not drawn. */
  getPoints(stream: string): { drawn: number; points: number } | undefined;
  /** Set the streams whose clouds are drawn, and those among them that show what was, or what is wrong. */
  setWanted(streams: readonly string[], doubtful: readonly string[]): void;
}

export function makeStreamsPanel(state: PageState, client: WorkerClient, choices: StreamChoices, clouds: DrawnClouds | null): Panel {
  const list = h("ul", { class: "rows" });
  const empty = h("p", { class: "empty" }, "This session has no streams.");
  const reason = h("p", { class: "note" });
  const section = makeSection("streams", "Streams", h("div", {}, list, empty, reason), { open: false });
  const hasProblem = (one: Stream): boolean => describeState(one, state) !== "";
  let sent = "";
  const send = (): void => {
    const streams = state.budget?.streams ?? [];
    const wanted = choices.listWanted(streams, state.mode);
    state.forgetFrames((stream) => !wanted.includes(stream));
    const dimmed = streams.filter((one) => isDoubtful(one, state.isBehind(one.stream)));
    clouds?.setWanted(wanted, dimmed.map(({ stream }) => stream));
    const key = `${state.welcome?.connection_epoch ?? 0} ${JSON.stringify(wanted)}`;
    if (key === sent || !state.isReady) return;
    sent = key;
    client.post({ type: "want_streams", streams: wanted });
  };
  const rows = new KeyedList<Stream>(list, (one) => makeRow(one, state, choices, clouds), empty);
  return {
    element: section.element,
    update: () => {
      const streams = state.budget?.streams ?? [];
      rows.update(streams, (one) => one.stream);
      const problems = streams.filter(hasProblem).length;
      section.setCount(streams.length === 0 ? "" : `${streams.length}${problems > 0 ? ` · ${problems} with a problem` : ""}`);
      section.element.classList.toggle("doubtful", problems > 0);
      setText(reason, state.budget?.reason ?? "");
      send();
    },
  };
}

/** Return why what is shown of a stream is not as things are now, in words; empty: it is. */
export function describeState(one: Stream, state: PageState): string {
  return streamStateWords(one, state.isBehind(one.stream));
}

function makeRow(first: Stream, state: PageState, choices: StreamChoices, clouds: DrawnClouds | null): Row<Stream> {
  const { stream } = first;
  let one = first;
  const box = h("input", { type: "checkbox" });
  const inAr = h("input", { type: "checkbox" });
  box.addEventListener("change", () => {
    choices.choose(one, box.checked, state.mode);
    state.touch();
  });
  inAr.addEventListener("change", () => {
    choices.choose(one, inAr.checked, "immersive-ar");
    state.touch();
  });
  const title = h("strong", { class: "name" });
  const warning = h("span", { class: "tag bad" });
  const facts = h("p", { class: "note" });
  const detail = h("p", { class: "advice" });
  const arLabel = h("label", { class: "line note" }, inAr, h("span", {}, "also in AR, where the room itself is seen"));
  return {
    element: h("li", { class: "row", data: { stream } }, h("label", { class: "line" }, box, title, warning), facts, detail, arLabel),
    update: (item) => {
      one = item;
      const report = state.status?.media.find((other) => other.stream === stream);
      const counters = state.stats?.media[stream];
      const shower = choices.findShower(one);
      const cloud = clouds?.getPoints(stream);
      box.disabled = shower === "";
      box.checked = choices.isShown(one, state.mode);
      arLabel.hidden = !(state.offersAr && shower !== "" && one.audience === StreamAudience.REMOTE && state.mode !== "immersive-ar");
      inAr.checked = choices.isShown(one, "immersive-ar");
      setText(title, one.title || stream);
      setText(warning, describeState(one, state));
      warning.hidden = warning.textContent === "";
      const parts = [
        one.title && one.title !== stream ? stream : "",
        shower === "" ? "not drawn by this page" : warning.textContent === budgetWords(one.budget_class) ? "" : budgetWords(one.budget_class),
        cloud ? `${cloud.drawn < cloud.points ? `${formatCount(cloud.drawn)} of ` : ""}${formatCount(cloud.points)} points` : "",
        report ? `${report.hz.toFixed(0)} Hz` : "",
        report ? `${report.mbit_per_s.toFixed(1)} Mbit/s` : "",
        streamAgeWords(state.ageOf(stream) ?? report?.age_ms ?? Number.NaN),
        counters && counters.superseded > 0 ? `${formatCount(counters.superseded)} of ${formatCount(counters.received)} left out for newer ones` : "",
        counters && counters.refused > 0 ? `${formatCount(counters.refused)} refused: damaged or too large` : "",
        report?.source ? `from ${report.source}` : "",
      ];
      setText(facts, parts.filter((part) => part !== "").join(" · "));
      setText(detail, one.detail);
    },
  };
}
