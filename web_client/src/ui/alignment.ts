// Alignment of every headset and the anchors of the room: what is stated, what is wrong, what to do.

import type { AnchorPlace, ParticipantInfo } from "../core/api.ts";
import type { Actions } from "./actions.ts";
import { button, h, KeyedList, type Row, setLabel, setText } from "./dom.ts";
import { makeSection, type Panel } from "./panel.ts";
import type { PageState } from "./state.ts";
import { alignmentWords, capitalize, doubtWords, formatAge, formatMillimetres } from "./words.ts";

const HEADSET_DEVICES = /^(head|controller\/|hand\/)/;

export function makeAlignmentPanel(state: PageState, actions: Actions): Panel {
  const list = h("ul", { class: "rows" });
  const empty = h("p", { class: "empty" }, "No headset has joined.");
  const checks = h("ul", { class: "notes" });
  const section = makeSection("alignment", "Alignment", h("div", {}, list, empty, checks));
  const rows = new KeyedList<ParticipantInfo>(list, (item) => makeRow(item, state, actions), empty);
  const crossChecks = new KeyedList<string>(checks, (text) => ({
    element: h("li", {}, text),
    update: () => undefined,
  }));
  return {
    element: section.element,
    update: () => {
      const headsets = (state.session?.participants ?? []).filter(
        (one) => one.devices.some((device) => HEADSET_DEVICES.test(device)) && one.alignment?.kind !== "not_needed",
      );
      rows.update(headsets, (one) => one.id);
      section.setCount(headsets.length > 0 ? String(headsets.length) : "");
      const found = (state.status?.cross_checks ?? []).map(
        (check) =>
          `${state.nameOf(check.a)} and ${state.nameOf(check.b)} ${check.touched ? "touch" : "see"} ${check.anchor_id} ${formatMillimetres(check.error_m)} ` +
          `apart (expected up to ${formatMillimetres(check.expected_p95_m)}), ${formatAge(check.age_ns)} ago` +
          (check.outdated ? ", before one of them was aligned elsewhere" : ""),
      );
      const unverified = (state.status?.unverified ?? []).map(
        (pair) =>
          `${state.nameOf(pair.participant)} is to glance at ${pair.anchor_id}: ${state.nameOf(pair.other)} has aligned by it since`,
      );
      crossChecks.update([...found, ...unverified], (text) => text);
    },
  };
}

function makeRow({ id }: ParticipantInfo, state: PageState, actions: Actions): Row<ParticipantInfo> {
  const name = h("strong", { class: "name" });
  const kind = h("span", { class: "tag" });
  const errors = h("span", { class: "note" });
  const advice = h("div", { class: "advice", hidden: true });
  const start = button("Measure again", () => void actions.request({ type: "align", action: "start", participant: id }), {
    class: "small",
  });
  const stop = button("Keep", () => void actions.request({ type: "align", action: "stop", participant: id }), {
    class: "small",
  });
  const element = h(
    "li",
    { class: "row" },
    h("div", { class: "line" }, name, kind, errors),
    advice,
    h("div", { class: "controls" }, start, stop),
  );
  return {
    element,
    update: (item) => {
      setText(name, item.name);
      const alignment = item.alignment;
      const report = state.status?.participants.find((one) => one.id === id)?.alignment_report ?? null;
      const doubt = doubtWords(report);
      setText(kind, alignmentWords(alignment?.kind ?? "none") + (doubt && ", unconfirmed"));
      kind.classList.toggle("good", alignment?.kind === "measured" && doubt === "");
      kind.classList.toggle("bad", !alignment || alignment.kind === "none" || doubt !== "");
      const parts: string[] = [];
      if (alignment && alignment.error_at_robot_m > 0) parts.push(`± ${formatMillimetres(alignment.error_at_robot_m)} at the robot`);
      if (alignment && alignment.error_at_anchor_m > 0) parts.push(`± ${formatMillimetres(alignment.error_at_anchor_m)} at the sheet`);
      if (alignment?.offset) parts.push("with an offset by hand: no stated error");
      if (report && report.pending_m > 0) parts.push(`a correction of ${formatMillimetres(report.pending_m)} waits`);
      if (report && report.observations > 0) parts.push(`${report.observations} observations from ${report.viewpoints} places`);
      setText(errors, parts.join(" · "));
      const alarm = report?.alarm ? `Found wrong by ${formatMillimetres(report.alarm_size_m)}. ` : "";
      const glance = doubt && `Glance at a sheet: ${doubt}. `;
      const words = glance + alarm + (report?.advice ? capitalize(report.advice) : "");
      setText(advice, words);
      advice.hidden = words === "";
      const mayChange = state.isDirector || id === state.selfId;
      start.hidden = stop.hidden = !mayChange;
      stop.hidden ||= !(report?.running ?? false);
      setLabel(start, `Measure again: ${item.name}`);
      setLabel(stop, `Keep: ${item.name}`);
    },
  };
}

export function makeAnchorsPanel(state: PageState): Panel {
  const list = h("ul", { class: "rows" });
  const empty = h("p", { class: "empty" }, "This session has no anchors.");
  const section = makeSection("anchors", "Anchors", h("div", {}, list, empty), { open: false });
  const rows = new KeyedList<AnchorPlace>(list, () => makeAnchorRow(state), empty);
  return {
    element: section.element,
    update: () => {
      const anchors = state.session?.anchors ?? [];
      rows.update(anchors, (anchor) => anchor.anchor_id);
      section.setCount(anchors.length > 0 ? String(anchors.length) : "");
    },
  };
}

function makeAnchorRow(state: PageState): Row<AnchorPlace> {
  const name = h("strong", { class: "name" });
  const place = h("span", { class: "note" });
  return {
    element: h("li", { class: "row" }, h("div", { class: "line" }, name, place)),
    update: ({ anchor_id, T_world_anchor, size_m, error_m }) => {
      setText(name, anchor_id);
      const [x, y, z] = T_world_anchor[0];
      const seen = (state.status?.participants ?? []).filter((one) =>
        one.alignment_report?.seen.some((sight) => sight.anchor_id === anchor_id),
      );
      const parts = [
        `at ${x.toFixed(3)}, ${y.toFixed(3)}, ${z.toFixed(3)} m`,
        size_m > 0 ? `${(100 * size_m).toFixed(1)} cm wide` : "",
        error_m > 0 ? `± ${formatMillimetres(error_m)}` : "",
        seen.length > 0 ? `seen by ${seen.map((one) => one.name).join(", ")}` : "",
      ];
      setText(place, parts.filter((part) => part !== "").join(" · "));
    },
  };
}
