// Who is here, in which role, and what directors may change about it.

import type { ParticipantInfo } from "../core/api.ts";
import { participantColor } from "../view/avatars.ts";
import type { Actions } from "./actions.ts";
import { button, h, KeyedList, type Row, setLabel, setOptions, setText, setValue } from "./dom.ts";
import type { Joining } from "./joining.ts";
import { makeSection, type Panel } from "./panel.ts";
import type { PageState } from "./state.ts";
import { alignmentWords, formatMilliseconds, formatShare, roleWords } from "./words.ts";

const ROLES = ["operator", "observer", "director"] as const;

export function makeParticipantsPanel(state: PageState, actions: Actions, joining: Joining): Panel {
  const list = h("ul", { class: "rows" });
  const empty = h("p", { class: "empty" }, "No participants.");
  const section = makeSection("participants", "Participants", h("div", {}, list, empty));
  const rows = new KeyedList<ParticipantInfo>(list, (item) => makeRow(item, state, actions, joining), empty);
  return {
    element: section.element,
    update: () => {
      const participants = (state.session?.participants ?? []).filter((one) => one.role !== "gateway");
      section.setCount(participants.length > 0 ? String(participants.length) : "");
      rows.update(participants, (participant) => participant.id);
    },
  };
}

function makeRow({ id }: ParticipantInfo, state: PageState, actions: Actions, joining: Joining): Row<ParticipantInfo> {
  const dot = h("span", { class: "dot", aria: { hidden: "true" } });
  const name = h("strong", { class: "name" });
  const you = h("span", { class: "tag", hidden: true }, "you");
  const facts = h("span", { class: "note" });
  const role = h("select", { class: "small" });
  const nameField = h("input", { class: "small", type: "text", attributes: { maxlength: "64", spellcheck: "false" } });
  const rename = h("form", { class: "inline" }, nameField, h("button", { class: "small" }, "Rename"));
  rename.addEventListener("submit", (event) => {
    event.preventDefault();
    const wanted = nameField.value.trim();
    if (wanted && id === state.selfId) void joining.rename(wanted);
    else if (wanted) void actions.request({ type: "rename", participant: id, name: wanted });
  });
  role.addEventListener("change", () => {
    void actions
      .request({ type: "set_role", participant: id, role: role.value })
      .then((granted) => granted || setValue(role, state.participant(id)?.role ?? ""));
  });
  const remove = button(
    "Remove",
    () => {
      const who = state.nameOf(id);
      if (confirm(`Remove ${who} from the session? They can join again.`)) {
        void actions.request({ type: "remove_participant", participant: id });
      }
    },
    { class: "small quiet" },
  );
  const more = h("details", { class: "more" }, h("summary", {}, "Change"), h("div", { class: "controls" }, rename, role, remove));
  const element = h("li", { class: "row" }, h("div", { class: "line" }, dot, name, you, facts), more);
  return {
    element,
    update: (item) => {
      dot.style.background = participantColor(id);
      setText(name, state.nameOf(id));
      you.hidden = id !== state.selfId;
      const report = state.status?.participants.find((one) => one.id === id);
      const held = state.heldBy(id);
      const parts = [
        roleWords(item.role),
        item.connected ? "" : "disconnected",
        item.connected && !item.worn ? "headset off" : "",
        held.length > 0 ? `holds ${held.join(", ")}` : "",
        item.alignment && item.alignment.kind !== "not_needed" ? alignmentWords(item.alignment.kind) : "",
        report?.state_age ? `sees ${formatMilliseconds(report.state_age[0])} old` : "",
        report && report.rtt_ms > 0 ? `round trip ${formatMilliseconds(report.rtt_ms)}` : "",
        report && report.battery >= 0 ? `battery ${formatShare(report.battery)}${report.charging ? ", charging" : ""}` : "",
      ];
      setText(facts, parts.filter((part) => part !== "").join(" · "));
      element.classList.toggle("away", !item.connected);
      more.hidden = !state.isDirector || !state.isReady;
      setOptions(role, [...new Set([item.role, ...ROLES])].map((one) => [one, roleWords(one)] as const));
      setValue(role, item.role);
      setLabel(role, `Role of ${item.name}`);
      setLabel(nameField, `New name of ${item.name}`);
      setLabel(remove, `Remove: ${item.name}`);
      setValue(nameField, nameField.value || item.name);
      remove.hidden = id === state.selfId;
    },
  };
}
