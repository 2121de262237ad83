// Robots in the picture: a label at each, a menu where one is clicked, and the handles at the gripper of the one that this
// person may drive.

import { type Camera, Quaternion, Vector3 } from "three";

import type { RobotInfo } from "../core/api.ts";
import type { Drive } from "../desktop/drive.ts";
import { participantColor } from "../view/avatars.ts";
import { T_THREE_WORLD } from "../view/axes.ts";
import type { Gizmo, PicturePlace } from "../view/gizmo.ts";
import { RobotPlaces } from "../view/robot_places.ts";
import type { View } from "../view/view.ts";
import type { Actions } from "./actions.ts";
import { h, KeyedList, type Row, setText } from "./dom.ts";
import { findOffer, makeRobotControls } from "./robot_controls.ts";
import type { PageState } from "./state.ts";

/** A press is a click up to this way [pixels]; else it turns the view. */
const CLICK_PX = 6;
/** Between two samples, and until the arm has moved [s]. */
const STEP_S = 0.05;
/** A label that is nearer to where it was is not moved [pixels]. */
const STILL_PX = 0.5;
/** Shortest time between two choices of the labels that are shown [ms]: they do not flicker where arms move fast. */
const THIN_PERIOD_MS = 200;

/** Where a label is in the picture: the middle of its lower edge, and its size [pixels]. */
export interface LabelBox {
  x: number;
  y: number;
  width: number;
  height: number;
  /** Distance into the picture: of labels of one rank the nearer one stays. */
  depth: number;
  /** The greatest stays. */
  rank: number;
}

interface LabelRow extends LabelBox {
  robot: string;
  element: HTMLElement;
  isSeen: boolean;
}

const YOU_DRIVE = "you drive";

/** Return what the label of the robot says that this person drives. */
export function drivenWords(state: PageState, isHeldBack: boolean): string {
  if (!state.isReady) return state.phase.ended ? "ended" : "not connected";
  if (state.session?.estop) return "stopped";
  if (state.pause) return "paused";
  return isHeldBack || state.phase.stalled ? "held" : YOU_DRIVE;
}

/** Return the labels that would cover others, and are left out for them. */
export function findCrowded<T extends LabelBox>(labels: readonly T[]): Set<T> {
  const shown: T[] = [];
  const crowded = new Set<T>();
  for (const one of [...labels].sort((a, b) => b.rank - a.rank || a.depth - b.depth)) {
    const covers = (other: T): boolean =>
      Math.abs(one.x - other.x) < (one.width + other.width) / 2 && one.y > other.y - other.height && other.y > one.y - one.height;
    if (shown.some(covers)) crowded.add(one);
    else shown.push(one);
  }
  return crowded;
}

export interface RobotOverlay {
  /** Labels and menu, over the picture. */
  element: HTMLElement;
  update(): void;
}

/** Make labels, menu and handles over `canvas`, which is in `stage`. */
export function makeRobotOverlay(
  state: PageState,
  actions: Actions,
  drive: Drive,
  view: View,
  gizmo: Gizmo,
  stage: HTMLElement,
  canvas: HTMLCanvasElement,
): RobotOverlay {
  const places = new RobotPlaces(view);
  const menu = makeMenu(state, actions, drive, stage);
  let labels: LabelRow[] = [];
  const list = h("div", { class: "robot-labels" });
  const rows = new KeyedList<RobotInfo>(list, ({ name }) => makeLabel(name));
  const [p_world, q_world] = [new Vector3(), new Quaternion()];
  /** Where the handles are in the picture. */
  const p_handles = new Vector3();
  /** The robot with the handles, empty for none. */
  let chosen = "";
  let holding: number | null = null;
  let isHeldBack = false;
  let pressed = { pointer: -1, x: 0, y: 0 };
  /** Labels are where they were when they were thinned out, and when that was. */
  let [isThinned, thinned_ms] = [true, 0];
  /** The robot that the pointer is at, empty for none. */
  let pointed = "";
  let [width, height] = [1, 1];
  const sizes = new ResizeObserver((entries) => {
    for (const { target, borderBoxSize } of entries) {
      const label = labels.find(({ element }) => element === target);
      const size = borderBoxSize[0];
      if (label && size && size.inlineSize > 0) [label.width, label.height] = [size.inlineSize, size.blockSize];
    }
    thinOut();
  });
  view.addToWorld(gizmo.object);
  new ResizeObserver(() => ([width, height] = [canvas.clientWidth, canvas.clientHeight])).observe(canvas);

  function makeLabel(name: string): Row<RobotInfo> {
    const dot = h("span", { class: "dot", aria: { hidden: "true" } });
    const who = h("span");
    const element = h("button", { type: "button", class: "robot-label", data: { label: name } }, dot, h("strong", {}, name), who);
    const label: LabelRow = { robot: name, element, x: Number.NEGATIVE_INFINITY, y: 0, width: 0, height: 0, depth: 0, rank: 0, isSeen: true };
    element.addEventListener("click", () => menu.open(name, label));
    labels.push(label);
    sizes.observe(element);
    const update = (): void => {
      const holder = state.lease(name)?.holder ?? "";
      const isMine = state.heldBy(state.selfId).includes(name);
      dot.style.background = holder === "" ? "transparent" : participantColor(holder);
      dot.classList.toggle("hollow", holder === "");
      const isDriven = drive.robot === name;
      setText(who, isDriven ? drivenWords(state, drive.isHeldBack) : isMine ? "you" : holder === "" ? "free" : state.nameOf(holder));
      element.classList.toggle("driven", isDriven && drivenWords(state, drive.isHeldBack) === YOU_DRIVE);
    };
    return { element, update };
  }

  function toPlace(event: PointerEvent): PicturePlace {
    const box = canvas.getBoundingClientRect();
    return { x: (2 * (event.clientX - box.x)) / box.width - 1, y: 1 - (2 * (event.clientY - box.y)) / box.height };
  }

  /** Turn a point of the world into a place on the canvas [pixels], with its depth; nearer than -1 or farther than 1 is not seen. */
  function toPixels(p: Vector3, camera: Camera): Vector3 {
    p.applyMatrix4(T_THREE_WORLD).project(camera);
    p.x = ((1 + p.x) / 2) * width;
    p.y = ((1 - p.y) / 2) * height;
    return p;
  }

  /** Move labels and handles to where the robots are drawn. */
  function place(): void {
    const { camera } = view.viewpoint;
    const isOnScreen = state.mode === "screen";
    gizmo.object.visible = isOnScreen && chosen !== "" && places.readTip(chosen, p_world, q_world);
    gizmo.lag_s = (view.delay_ms + (state.rtt_ms || 0)) / 1000 + STEP_S;
    if (!isOnScreen) return;
    let isChanged = false;
    if (gizmo.object.visible) {
      gizmo.place(p_world, q_world, camera);
      toPixels(p_world, camera);
      isChanged = Math.abs(p_handles.x - p_world.x) > STILL_PX || Math.abs(p_handles.y - p_world.y) > STILL_PX;
      if (isChanged) p_handles.copy(p_world);
    }
    for (const label of labels) {
      const isKnown = places.readLabel(label.robot, p_world);
      const { x, y, z } = toPixels(p_world, camera);
      const isSeen = isKnown && Math.abs(z) < 1;
      if (isSeen !== label.isSeen) {
        label.isSeen = isSeen;
        label.element.hidden = !isSeen;
        isChanged = true;
      }
      if (!isSeen || (Math.abs(x - label.x) < STILL_PX && Math.abs(y - label.y) < STILL_PX)) continue;
      isChanged = true;
      label.x = x;
      label.y = y;
      label.depth = z;
      label.element.style.transform = `translate(${x.toFixed(1)}px, ${y.toFixed(1)}px) translate(-50%, -100%)`;
    }
    isThinned &&= !isChanged;
    const now = performance.now();
    if (isThinned || now - thinned_ms < THIN_PERIOD_MS) return;
    [isThinned, thinned_ms] = [true, now];
    thinOut();
  }
  view.onDraw = place;

  /** Let the handles be seen and taken through labels that cover them. */
  function makeWayForHandles(): void {
    const isShown = gizmo.object.visible;
    const { x, y } = p_handles;
    const reach = gizmo.reach * height;
    for (const label of labels) {
      const isNear = Math.abs(label.x - x) < reach + label.width / 2 && label.y > y - reach && label.y - label.height < y + reach;
      label.element.classList.toggle("beside-handles", isShown && isNear);
    }
  }

  /** Leave out labels that would cover others: first those of robots that are neither pointed at, nor held by this person. */
  function thinOut(): void {
    const mine = state.heldBy(state.selfId);
    for (const label of labels) {
      const { robot, element } = label;
      label.rank = robot === pointed || element === document.activeElement ? 3 : robot === drive.robot ? 2 : mine.includes(robot) ? 1 : 0;
    }
    const crowded = findCrowded(labels.filter(({ isSeen }) => isSeen));
    for (const label of labels) label.element.classList.toggle("crowded", crowded.has(label));
    makeWayForHandles();
  }

  function onDown(event: PointerEvent): void {
    if (event.target !== canvas) return;
    menu.close();
    pressed = { pointer: event.isPrimary ? event.pointerId : -1, x: event.clientX, y: event.clientY };
    if (event.button !== 0 || !event.isPrimary || !gizmo.hover(toPlace(event))) return;
    drive.begin(chosen); // before the handles are held: it lets go of everything
    if (!gizmo.grab(toPlace(event))) return;
    holding = event.pointerId;
    pressed.pointer = -1;
    canvas.setPointerCapture(event.pointerId);
    event.preventDefault();
    event.stopPropagation(); // the view does not turn
  }

  function onMove(event: PointerEvent): void {
    if (event.pointerId === holding) gizmo.drag(toPlace(event));
    else if (event.target === canvas && event.buttons === 0) {
      const at = toPlace(event);
      const isHandle = gizmo.hover(at);
      const robot = places.pick(at, view.viewpoint.camera) ?? "";
      canvas.style.cursor = isHandle ? "grab" : robot === "" ? "" : "pointer";
      if (robot !== pointed) {
        pointed = robot;
        thinOut();
      }
    } else return;
    view.touchOverlay();
  }

  function onUp(event: PointerEvent): void {
    if (event.pointerId === holding) {
      holding = null;
      gizmo.letGo();
      view.touchOverlay();
      return;
    }
    const { pointer, x, y } = pressed;
    const isClick = event.pointerId === pointer && Math.hypot(event.clientX - x, event.clientY - y) <= CLICK_PX;
    pressed.pointer = -1;
    if (!isClick || event.type !== "pointerup") return;
    const robot = places.pick(toPlace(event), view.viewpoint.camera);
    const box = canvas.getBoundingClientRect();
    if (robot) menu.open(robot, { x: event.clientX - box.x, y: event.clientY - box.y });
  }
  stage.addEventListener("pointerdown", onDown, { capture: true });
  stage.addEventListener("pointermove", onMove, { capture: true });
  for (const type of ["pointerup", "pointercancel"] as const) stage.addEventListener(type, onUp, { capture: true });

  return {
    element: h("div", { class: "robots" }, list, menu.element),
    update: () => {
      const robots = state.session?.robots ?? [];
      if (state.spec) places.set(robots, state.spec);
      const names = robots.map(({ name }) => name);
      labels = labels.filter(({ robot }) => names.includes(robot));
      const mine = state.isReady ? state.heldBy(state.selfId).filter((name) => names.includes(name) && state.followsPoses(name)) : [];
      const before = chosen;
      chosen = mine.includes(drive.robot) ? drive.robot : mine.includes(chosen) ? chosen : (mine[0] ?? "");
      const { length } = labels;
      rows.update(robots, ({ name }) => name);
      menu.update();
      if (chosen !== before) gizmo.letGo();
      if (isHeldBack !== drive.isHeldBack) {
        isHeldBack = drive.isHeldBack;
        gizmo.setHeldBack(isHeldBack);
        view.touchOverlay();
      }
      thinOut();
      if (chosen !== before || labels.length !== length) view.touchOverlay();
    },
  };
}

/** What may be done with a robot, where it was clicked. */
function makeMenu(state: PageState, actions: Actions, drive: Drive, stage: HTMLElement) {
  let robot = "";
  const name = h("strong", { class: "name" });
  const holder = h("span", { class: "note" });
  const controls = makeRobotControls(() => robot, state, actions, drive);
  const none = h("p", { class: "note" });
  const element = h("div", { class: "robot-menu card", role: "dialog", hidden: true, aria: { label: "Robot" } }, h("div", { class: "line" }, name, holder), h("div", { class: "controls" }, ...controls.buttons), none, controls.assign);
  const close = (): void => {
    element.hidden = true;
  };
  const update = (): void => {
    if (element.hidden) return;
    controls.update();
    setText(name, robot);
    const lease = state.lease(robot);
    setText(holder, !lease?.holder ? "free" : `held by ${lease.holder === state.selfId ? "you" : state.holderName(lease.holder)}`);
    setText(none, controls.buttons.some((one) => !one.hidden) ? "" : findOffer(state, robot).none);
  };
  for (const type of ["click", "change"] as const) {
    element.addEventListener(type, (event) => {
      const isDone = event.target instanceof HTMLButtonElement || type === "change";
      if (isDone) close();
    });
  }
  element.addEventListener("keydown", (event) => event.key === "Escape" && close());
  return {
    element,
    close,
    update,
    /** Open at a point of the picture [pixels]. */
    open: (which: string, { x, y }: { x: number; y: number }) => {
      robot = which;
      element.hidden = false;
      update();
      const left = Math.min(x, stage.clientWidth - element.offsetWidth - 8);
      const top = Math.min(y, stage.clientHeight - element.offsetHeight - 8);
      element.style.left = `${Math.max(8, left)}px`;
      element.style.top = `${Math.max(8, top)}px`;
      element.querySelector<HTMLElement>("button:not([hidden]), select")?.focus({ preventScroll: true });
    },
  };
}
