// Robots and their leases: who drives, why a robot holds; take, release, assign, hand over, mode, scale, consent.

import type { RobotInfo } from "../core/api.ts";
import { HoldReason } from "../protocol/messages.g.ts";
import { participantColor } from "../view/avatars.ts";
import type { Drive } from "../desktop/drive.ts";
import type { Actions } from "./actions.ts";
import { button, h, KeyedList, type Row, setOptions, setText, setValue } from "./dom.ts";
import { makeSection, type Panel } from "./panel.ts";
import { makeRobotControls } from "./robot_controls.ts";
import type { ConsentAsked, PageState } from "./state.ts";
import { graceWords, holdReasonWords, leaseModeWords, limitWords, needsAgain } from "./words.ts";

const MODES = ["exclusive", "request", "takeover", "priority", "shared"] as const;
/** Why a robot holds that its holder does not move now. */
const WAITS_FOR_HOLDER: readonly string[] = [HoldReason.NO_SAMPLE, HoldReason.CLUTCH_OPEN];
const SCALES = [0.1, 0.25, 0.5, 1, 2] as const;

export function makeRobotsPanel(state: PageState, actions: Actions, drive: Drive): Panel {
  const list = h("ul", { class: "rows" });
  const asked = h("ul", { class: "rows asked" });
  const empty = h("p", { class: "empty" }, "This scene has no robots.");
  const section = makeSection("robots", "Robots", h("div", {}, asked, list, empty));
  const rows = new KeyedList<RobotInfo>(list, (item) => makeRow(item, state, actions, drive), empty);
  const consents = new KeyedList<ConsentAsked>(asked, (item) => makeConsentRow(item, state, actions));
  return {
    element: section.element,
    update: () => {
      const robots = state.session?.robots ?? [];
      section.setCount(robots.length > 0 ? String(robots.length) : "");
      rows.update(robots, (robot) => robot.name);
      state.consents = state.consents.filter((consent) => consent.until_ms > performance.now());
      setText(empty, state.session ? "This scene has no robots." : "Not joined.");
      consents.update(state.consents, (consent) => String(consent.consent_id));
    },
  };
}

function makeRow({ name }: RobotInfo, state: PageState, actions: Actions, drive: Drive): Row<RobotInfo> {
  const dot = h("span", { class: "dot", aria: { hidden: "true" } });
  const title = h("strong", { class: "name" }, name);
  const holder = h("span", { class: "holder" });
  const why = h("div", { class: "note why" });
  const controls = makeRobotControls(() => name, state, actions, drive);
  const mode = h("select", { class: "small", aria: { label: `Lease mode of ${name}` } });
  setOptions(mode, MODES.map((one) => [one, leaseModeWords(one)] as const));
  mode.addEventListener("change", () => {
    void actions.request({ type: "set_mode", robot: name, mode: mode.value }).then((granted) => {
      if (!granted) mode.value = state.lease(name)?.mode ?? "exclusive";
    });
  });
  const scale = h("select", { class: "small", aria: { label: `Motion scale of ${name}` } });
  scale.addEventListener("change", () => {
    void actions.request({ type: "set_scale", robots: [name], scale: Number(scale.value) }).then((granted) => {
      if (!granted) scale.value = String(state.lease(name)?.scale ?? 1);
    });
  });
  const modeLabel = h("label", { class: "field" }, h("span", {}, "Mode"), mode);
  const scaleLabel = h("label", { class: "field" }, h("span", {}, "Scale"), scale);
  const fields = h("div", { class: "fields" }, controls.assign, modeLabel, scaleLabel);
  const element = h(
    "li",
    { class: "row", data: { robot: name } },
    h("div", { class: "line" }, dot, title, holder),
    why,
    h("div", { class: "controls" }, ...controls.buttons),
    fields,
  );
  return {
    element,
    update: () => {
      const lease = state.lease(name);
      const isMine = state.heldBy(state.selfId).includes(name);
      const isFree = !lease || lease.holder === "";
      dot.style.background = isFree ? "transparent" : participantColor(lease.holder);
      dot.classList.toggle("hollow", isFree);
      setText(holder, isFree ? "free" : isMine ? "you" : state.holderName(lease.holder));
      holder.classList.toggle("free", isFree);
      setText(why, describe(state, drive, name));
      controls.update();
      modeLabel.hidden = !state.isDirector || !state.isReady;
      scaleLabel.hidden = !(state.isDirector || isMine) || isFree || !state.isReady;
      fields.hidden = modeLabel.hidden && scaleLabel.hidden;
      setValue(mode, lease?.mode ?? "exclusive");
      const scales = [...new Set([...SCALES, lease?.scale ?? 1])].sort((a, b) => a - b);
      setOptions(scale, scales.map((one) => [String(one), `${one} ×`] as const));
      setValue(scale, String(lease?.scale ?? 1));
    },
  };
}

/** Return the line below the name of a robot: what it does now and why, who waits for it, what keeps it from going on. */
export function describe(state: PageState, drive: Pick<Drive, "robot" | "isHeldBack">, robot: string): string {
  if (!state.isReady) return "not known: not connected";
  const lease = state.lease(robot);
  const isMine = state.heldBy(state.selfId).includes(robot);
  const reason = state.holdReason(robot);
  const isPressed = state.mode !== "screen" || (drive.robot === robot && drive.isHeldBack);
  const isReady = isMine && (WAITS_FOR_HOLDER.includes(reason) || (needsAgain(reason) && !isPressed));
  const parts: string[] = [];
  if (state.session?.estop) parts.push("stopped");
  else if (state.pause) parts.push("paused");
  else if (isReady) parts.push(state.followsPoses(robot) ? "ready: drag the arrows at its gripper" : "ready: a program or a glove moves its joints");
  else if (reason === HoldReason.DISCONNECTED && lease && lease.expires_ns > 0) parts.push("holds");
  else if (reason) parts.push(`holds: ${holdReasonWords(reason, isMine)}`);
  else if (state.isMoved(robot)) parts.push(lease?.holder ? "driven" : "goes to its home");
  if (lease && lease.expires_ns > 0) parts.push(graceWords(lease.expires_ns, state.sessionTime()));
  if (lease && lease.sub_holders.length > 1) parts.push(`shared by ${lease.sub_holders.map((id) => state.nameOf(id)).join(", ")}`);
  if (lease && lease.queue.length > 0) parts.push(`waiting: ${lease.queue.map((id) => state.nameOf(id)).join(", ")}`);
  const limits = isMine ? (state.feedback.get(robot)?.limits ?? []) : [];
  if (limits.length > 0) parts.push(limitWords(limits));
  return parts.join(" · ");
}

/** Answer a participant who asks for a robot that one holds. */
export function answerConsent(asked: ConsentAsked, grant: boolean, state: PageState, actions: Actions): void {
  void actions.request({ type: "consent", consent_id: asked.consent_id, grant });
  state.consents = state.consents.filter((one) => one.consent_id !== asked.consent_id);
  state.touch();
}

function makeConsentRow(asked: ConsentAsked, state: PageState, actions: Actions): Row<ConsentAsked> {
  const text = h("div", { class: "line" }, `${state.nameOf(asked.requester)} asks you for ${asked.target}.`);
  const controls = h(
    "div",
    { class: "controls" },
    button("Give it", () => answerConsent(asked, true, state, actions), { class: "small primary" }),
    button("Keep it", () => answerConsent(asked, false, state, actions), { class: "small" }),
  );
  return { element: h("li", { class: "row", role: "alert" }, text, controls), update: () => undefined };
}
