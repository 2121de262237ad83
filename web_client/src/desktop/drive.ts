// Driving a robot from the desk: the panel over the picture, the clock of the samples, and what connects inputs, device
// and session.

import { nowMs } from "../core/api.ts";
import type { WorkerClient } from "../core/page_client.ts";
import { HoldReason } from "../protocol/messages.g.ts";
import { button, h, setOptions, setText } from "../ui/dom.ts";
import type { PageState } from "../ui/state.ts";
import { recall, remember } from "../ui/storage.ts";
import { holdReasonWords, limitWords, pauseWords } from "../ui/words.ts";
import { DesktopDevice, type Heading, SlownessWatch, SPEED_RANGE, toHeading } from "./device.ts";
import { DesktopInputs } from "./inputs.ts";
import { KEY_WORDS, type Vec3 } from "./intent.ts";
import type { Handles } from "./pull.ts";

/** Time between samples [ms]: 59 a second. */
const PERIOD_MS = 17;
/** Longest time that one sample stands for [s]: after a pause of the page a drag does not catch up. */
const MAX_DT_S = 0.1;
/** The session's answer to an engagement takes this long at most [ms]; before, its hold reason is the one before. */
const ANSWER_MS = 400;
/** Why a robot holds whose samples come too late. */
const LATE: readonly string[] = [HoldReason.STALE, HoldReason.REJECTED];
const STORAGE_KEY = "iris-session.desktop";
/** What moves the robot. */
const HOW = matchMedia("(pointer: coarse)").matches
  ? "Drag the arrows and rings at the gripper."
  : "Drag the arrows and rings at the gripper, or hold left Shift and press W A S D, R F.";
const DEFAULTS = { speed_cm_s: 10, relativeTo: "view" };

/** Axes of the camera in the session's world. */
export interface CameraAxes {
  forward: Vec3;
  up: Vec3;
}

export interface Drive {
  element: HTMLElement;
  /** The robot that is driven, empty for none. */
  readonly robot: string;
  /** A dead-man is held, and the robot does not follow. */
  readonly isHeldBack: boolean;
  /** Drive a robot from now on. */
  begin(robot: string): void;
  /** Drive a robot, or stop when it is the one that is driven. */
  toggle(robot: string): void;
  update(): void;
}

/**
 * Make the panel. `getCamera`: from where the person looks, null without a picture. `warn`: shows a line for a while.
 * `scene`: gets the focus, so that keys press no button meanwhile. `handles`: at the gripper in the picture.
 * `countPictures`: how many the page could draw since it began.
 */
export function makeDrive(
  state: PageState,
  client: WorkerClient,
  getCamera: () => CameraAxes | null,
  warn: (text: string) => void,
  scene: HTMLElement,
  handles: Handles | null,
  countPictures: () => number,
): Drive {
  const device = new DesktopDevice((sample) => client.post({ type: "samples", samples: [sample] }));
  const slowness = new SlownessWatch();
  const chosen = recall(STORAGE_KEY, DEFAULTS);
  let timer = 0;
  let ticked_ms = 0;
  let engaged_ms = Number.NEGATIVE_INFINITY;
  let isHeldBack = false;

  const robot = h("strong");
  const mark = h("span", { class: "tag" });
  const why = h("p", { class: "why", role: "status" });
  const handle = h("div", { class: "handle", role: "img", aria: { label: "Handle: press and drag with the mouse or a finger" } }, "Mouse pad: drag along the table, wheel for the height");
  const speedText = h("output");
  const speed = h("input", {
    type: "range",
    attributes: { min: String(100 * SPEED_RANGE[0]), max: String(100 * SPEED_RANGE[1]), step: "1" },
    on: { input: () => setSpeed(Number(speed.value)) },
  });
  const relativeTo = h("select", { class: "small", on: { change: () => keep({ relativeTo: relativeTo.value }) } });
  setOptions(relativeTo, [["view", "the view"], ["world", "the world"]]);
  const slider = h("input", { type: "range", aria: { label: "Gripper: left is open, right is closed" }, attributes: { min: "0", max: "100", step: "1", value: "0" } });
  const inputs = new DesktopInputs({ handle, slider, handles }, {
    onRelease: (reason) => {
      device.release(reason, nowMs());
      show();
    },
    onQuit: () => stop(),
  });
  const connect = button("Connect a SpaceMouse", () => void inputs.spaceMouse.choose().then(show, show), { class: "small" });
  connect.hidden = !inputs.spaceMouse.isSupported;
  const connected = h("p", { class: "note" });
  const keys = h("dl", { class: "facts keys" }, ...KEY_WORDS.map(([key, action]) => h("div", {}, h("dt", {}, key), h("dd", {}, action))));
  const pads = h("p", { class: "note" }, "Gamepad: hold the right shoulder button; sticks, cross, A closes, B opens.");
  const more = h("details", { class: "more" }, h("summary", {}, "Speed, keys, other devices"), h("label", { class: "field" }, h("span", {}, "Speed"), speed, speedText), keys, handle, h("label", { class: "field" }, h("span", {}, "Relative to"), relativeTo), pads, connected, connect);
  const unfinished = h("small", { class: "unfinished", role: "status" });
  const gripper = h("div", {}, h("label", { class: "field" }, h("span", {}, "Gripper"), h("small", {}, "open"), slider, h("small", {}, "closed")), unfinished);
  const element = h(
    "section",
    { class: "drive card", hidden: true, aria: { label: "Driving from the desk" } },
    h("div", { class: "line" }, robot, mark, button("Stop driving", () => stop(), { class: "small" })),
    why,
    gripper,
    more,
  );

  function keep(changed: Partial<typeof DEFAULTS>): void {
    Object.assign(chosen, changed);
    remember(STORAGE_KEY, chosen);
  }

  function setSpeed(cm_s: number): void {
    const inRange = Math.min(100 * SPEED_RANGE[1], Math.max(100 * SPEED_RANGE[0], Number(cm_s) || DEFAULTS.speed_cm_s));
    keep({ speed_cm_s: inRange });
    speed.value = String(inRange);
    setText(speedText, `${inRange.toFixed(0)} cm/s`);
  }

  function findHeading(): Heading {
    const camera = relativeTo.value === "view" ? getCamera() : null;
    return camera ? toHeading(camera.forward, camera.up) : [1, 0];
  }

  function tick(): void {
    const now = nowMs();
    const metresPerSecond = chosen.speed_cm_s / 100;
    const heading = findHeading();
    const intents = inputs.read(metresPerSecond, Math.min(MAX_DT_S, (now - ticked_ms) / 1000), now, heading);
    ticked_ms = now;
    const { session } = state;
    const situation = {
      isReady: state.isReady && (session?.synced ?? false),
      isStopped: session?.estop ?? false,
      isPaused: state.pause !== null,
      isHolder: state.heldBy(state.selfId).includes(device.robot),
    };
    const { isEngaged: wasEngaged, mustLetGo, lastGripper } = device;
    if (!device.tick(intents, heading, metresPerSecond, situation, now)) {
      warn("Driving has ended: you do not hold the robot any more.");
      stop();
    } else if (device.isEngaged !== wasEngaged) {
      engaged_ms = device.isEngaged ? now : Number.POSITIVE_INFINITY;
      show();
    } else if (device.mustLetGo !== mustLetGo) {
      show();
    }
    const reason = state.feedback.get(device.robot)?.hold_reason ?? "";
    slowness.note(device.isEngaged, LATE.includes(reason) && isHeldBySession(now), countPictures(), now);
    const wasHeldBack = isHeldBack;
    isHeldBack = device.robot !== "" && (device.mustLetGo || isHeldBySession(now));
    if (inputs.isGripperAsked(now) && (isHeldBack || !device.isEngaged)) {
      inputs.endSlide();
      device.lastGripper = null;
    }
    if (isHeldBack !== wasHeldBack || device.lastGripper !== lastGripper) state.touch();
    if (!inputs.isSliding) slider.value = String(100 * (device.lastGripper ?? 0.5));
  }

  /** Return whether the session holds the robot though the clutch is closed. */
  function isHeldBySession(now: number): boolean {
    const reason = state.feedback.get(device.robot)?.hold_reason ?? "";
    return device.isEngaged && reason !== "" && now - engaged_ms > ANSWER_MS;
  }

  function start(name: string): void {
    device.arm(name, nowMs());
    inputs.start();
    scene.focus({ preventScroll: true });
    ticked_ms = nowMs();
    clearInterval(timer);
    timer = window.setInterval(tick, PERIOD_MS);
    state.touch();
  }

  function stop(): void {
    clearInterval(timer);
    device.disarm(nowMs());
    inputs.stop();
    isHeldBack = false;
    state.touch();
  }

  function show(): void {
    const isHeadset = state.isReady && state.self?.devices.includes("desktop") === false;
    if (device.robot !== "" && isHeadset) {
      warn("Driving has ended: this browser is a headset now.");
      stop();
    }
    element.hidden = device.robot === "";
    if (device.robot === "") return;
    setText(robot, `Driving ${device.robot}`);
    const { hold_reason: reason = "", limits = [] } = state.feedback.get(device.robot) ?? {};
    gripper.hidden = state.session?.robots.find(({ name }) => name === device.robot)?.gripper === false;
    slider.classList.toggle("unknown", device.lastGripper === null);
    setText(unfinished, device.lastGripper === null ? "not finished: the robot held" : "");
    const isHeld = !device.isEngaged || state.phase.stalled || isHeldBySession(nowMs());
    setText(mark, isHeld ? "held" : "engaged");
    mark.classList.toggle("good", !isHeld);
    element.classList.toggle("engaged", !isHeld);
    setText(why, describe(device, state, reason, limits, isHeld, slowness.words));
    setText(connected, inputs.listConnected().join(", "));
    connect.hidden = !inputs.spaceMouse.isSupported || inputs.spaceMouse.name !== "";
  }

  setSpeed(chosen.speed_cm_s);
  relativeTo.value = chosen.relativeTo === "world" ? "world" : "view";
  return {
    element,
    get robot() {
      return device.robot;
    },
    get isHeldBack() {
      return isHeldBack;
    },
    begin: (name) => {
      if (device.robot !== name) start(name);
    },
    toggle: (name) => {
      if (device.robot === name) stop();
      else start(name);
    },
    update: show,
  };
}

/** Return in words why the robot holds, or that it follows, and what keeps it from going on. */
function describe(device: DesktopDevice, state: PageState, reason: string, limits: readonly string[], isHeld: boolean, slow: string): string {
  if (!state.isReady) return "Held: not connected.";
  const who = state.isDirector ? "Press" : "A director presses";
  if (state.session?.estop) return `Held: e-stop. ${who} Clear, above.`;
  if (state.pause) return `${pauseWords(state.pause.by, "")}. ${who} Resume, above.`;
  if (state.phase.stalled) return "Held: the session stands still. Let go, and hold again when it goes on.";
  if (!isHeld) return limits.length > 0 ? `It follows you: ${limitWords(limits)}.` : "The robot follows you.";
  if (slow) return device.isEngaged || device.mustLetGo ? `${slow} Let go, then hold again.` : slow;
  if (device.isEngaged) return `Held by the session: ${holdReasonWords(reason, true)}.`;
  const how = device.mustLetGo ? "Let go, then hold again." : HOW;
  return device.released ? `Held: ${device.released}. ${how}` : `Held. ${how}`;
}
