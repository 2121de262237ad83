// The page as a whole: composes header, picture and dashboard, joins the session, and keeps them up to date.

import type { WorkerClient } from "../core/page_client.ts";
import { makeDrive } from "../desktop/drive.ts";
import { listDrawn } from "../view/anchors.ts";
import { type AvatarInfo, participantColor } from "../view/avatars.ts";
import { Gizmo } from "../view/gizmo.ts";
import { View } from "../view/view.ts";
import { Actions } from "./actions.ts";
import { makeAlignmentPanel, makeAnchorsPanel } from "./alignment.ts";
import { makeCameras } from "./cameras.ts";
import { h, setText } from "./dom.ts";
import { makeEpisodeStrip } from "./episodes.ts";
import { makeBadge, makeEstop, makePause, makeSelf } from "./header.ts";
import { Joining } from "./joining.ts";
import {
  makeAdvicePanel,
  makeEventsPanel,
  makeLoopPanel,
  makeRecordingPanel,
} from "./operation.ts";
import { makePairing } from "./pairing.ts";
import { makePictures } from "./pictures.ts";
import { makeParticipantsPanel } from "./participants.ts";
import { makeRobotOverlay } from "./robot_overlay.ts";
import { makeRobotsPanel } from "./robots.ts";
import { makeStage } from "./stage.ts";
import { PageState } from "./state.ts";
import { StreamChoices } from "./stream_choices.ts";
import { makeStreamsPanel } from "./streams.ts";
import { type EventLevel, formatMillimetres } from "./words.ts";
import { makeWelcome } from "./welcome.ts";
import { type HeadsetControls, makeHeadsetControls } from "../xr/controls.ts";

const STATUS_PERIOD_MS = 1000;
/** Between the tools and what lies below them. */
const TOOLS_GAP_PX = 10;
const NOTICE_MS = 8000;
/** What tests and the console may look at. */
export interface PageHandle {
  state: PageState;
  view: View | null;
  gizmo: Gizmo | null;
  headset: HeadsetControls | null;
}

/** Build the page into `root` and join the session. */
export function startPage(root: HTMLElement, client: WorkerClient): PageHandle {
  const state = new PageState(client);
  const baseUrl = location.origin;
  const notices = h("div", { class: "notices", role: "status", aria: { live: "polite" } });
  const show = (text: string, level: EventLevel): void => {
    const notice = h("div", { class: `notice ${level}` }, text);
    notices.append(notice);
    while (notices.childElementCount > 4) notices.firstElementChild?.remove();
    setTimeout(() => notice.remove(), NOTICE_MS);
  };
  const actions = new Actions(client, show);
  const joining = new Joining(client, state, actions, baseUrl);
  const pairing = makePairing(client, baseUrl, () => joining.name, (name, roles) => joining.joinPaired(name, roles));

  const stage = makeStage(state, { pair: () => pairing.open("", ""), retry: () => joining.join() });
  const measureTools = (): number => stage.tools.offsetTop + stage.tools.offsetHeight;
  new ResizeObserver(() => stage.element.style.setProperty("--tools-end", `${measureTools() + TOOLS_GAP_PX}px`)).observe(stage.tools);
  const handle: PageHandle = { state, view: null, gizmo: null, headset: null };
  try {
    handle.view = new View(stage.canvas, client, {
      onScene: (spec) => {
        state.spec = spec;
        state.touch();
      },
      onProblem: (text) => state.note(text, "warning"),
      measureTop: measureTools,
    });
    stage.setView(handle.view, "");
  } catch (error) {
    client.on("scene", ({ spec }) => {
      state.spec = spec;
    });
    stage.setView(null, (error as Error).message);
  }
  const { view } = handle;

  const gizmo = view && new Gizmo(view.viewpoint.camera, () => view.touchOverlay());
  handle.gizmo = gizmo;
  const drive = makeDrive(state, client, () => view?.viewpoint.axes ?? null, (text) => show(text, "warning"), stage.canvas, gizmo, () => view?.displayed ?? Number.NaN);
  const robots = view && gizmo && makeRobotOverlay(state, actions, drive, view, gizmo, stage.element, stage.canvas);
  const choices = new StreamChoices(() => state.spec?.deformables.map((part) => part.stream) ?? [], () => view !== null);
  const cameras = makeCameras(state, view, makePictures(state, client, choices));
  stage.tools.append(cameras.menu);
  stage.element.append(...(robots ? [robots.element] : []), cameras.element);
  handle.headset = makeHeadsetControls(view, state, client, choices, (showInside) => new Actions(client, (text, level) => {
    show(text, level);
    showInside(text);
  }));
  stage.tools.append(handle.headset.element);
  const badge = makeBadge(state, () => view?.delay_ms ?? 0);
  const estop = makeEstop(state, actions, () => drive.robot !== "");
  const pause = makePause(state, actions);
  const self = makeSelf(state, joining);
  const welcome = makeWelcome(state, joining);
  const title = h("h1", {}, "iris-session");
  const header = h("header", { class: "bar" }, title, badge.element, self.element, estop.stop);
  const episodes = makeEpisodeStrip(state, actions);
  stage.element.append(h("div", { class: "banners" }, estop.banner, pause.element), episodes.element);
  stage.tools.prepend(pause.button);
  const panels = [
    makeAdvicePanel(state),
    makeRobotsPanel(state, actions, drive),
    makeParticipantsPanel(state, actions, joining),
    episodes.panel,
    makeAlignmentPanel(state, actions),
    makeEventsPanel(state),
    makeRecordingPanel(state, actions),
    makeLoopPanel(state, actions),
    makeStreamsPanel(state, client, choices, view?.clouds ?? null),
    makeAnchorsPanel(state),
  ];
  const dashboard = h(
    "section",
    { class: "dashboard", id: "dashboard", tabindex: -1, aria: { label: "Dashboard" } },
    ...panels.map((panel) => panel.element),
  );
  root.replaceChildren(
    h("a", { class: "skip", attributes: { href: "#dashboard" } }, "Skip to the dashboard"),
    header,
    welcome.element,
    h("main", {}, stage.element, drive.element, dashboard),
    notices,
    pairing.dialog,
  );

  state.onChange(() => {
    const name = state.welcome?.session_name || state.info?.session_name || "";
    setText(title, name || "iris-session");
    const shownTitle = `${state.session?.estop ? "STOPPED, " : state.pause ? "PAUSED, " : ""}${name ? `${name}, ` : ""}iris-session`;
    if (document.title !== shownTitle) document.title = shownTitle;
    document.body.classList.toggle("is-stopped", state.session?.estop ?? false);
    document.body.classList.toggle("is-paused", state.pause !== null);
    estop.update();
    pause.update();
    badge.update(state);
    self.update(state);
    welcome.update();
    stage.update();
    drive.update();
    robots?.update();
    cameras.update();
    episodes.update();
    for (const panel of panels) panel.update(state);
    if (view) updateOverlay(view, state);
  });
  client.on("notice", ({ text, level }) => show(text, level));
  client.on("phase", (phase) => {
    if (phase.phase !== "refused") return;
    const warn = (): void => show(`${phase.text}. Joining with another role.`, "warning");
    if (phase.refusal === "role" && joining.tryNextRole(warn)) return;
    if (phase.refusal === "unpaired") pairing.open("", phase.text);
  });
  setInterval(() => {
    if (state.isReady && !document.hidden) client.post({ type: "get_status" });
  }, STATUS_PERIOD_MS);

  const code = new URLSearchParams(location.hash.slice(1)).get("c");
  if (code) {
    history.replaceState(null, "", location.pathname); // a code must not stay in the address
    pairing.open(code, "");
  } else {
    joining.join();
  }
  state.touch();
  return handle;
}

function updateOverlay(view: View, state: PageState): void {
  const participants = state.session?.participants ?? [];
  const people = new Map<string, AvatarInfo>();
  for (const participant of participants) {
    const held = state.heldBy(participant.id);
    const error = participant.alignment?.error_at_robot_m ?? 0;
    const detail = [held.join(", "), error > 0 ? `± ${formatMillimetres(error)}` : ""].filter((part) => part !== "");
    people.set(participant.id, {
      name: participant.name,
      color: participantColor(participant.id),
      detail: detail.join(" · "),
      isSelf: participant.id === state.selfId,
    });
  }
  view.avatars.setPeople(people);
  if (view.anchors.setAnchors(listDrawn(state.session?.anchors ?? [], participants))) view.touch();
}
