// Reads keyboard, mouse, fingers, gamepads and SpaceMouse of this browser while a robot is driven. What ends a hold of the
// dead-man from outside is reported at once; what the inputs mean is in `intent.ts`.

import { nowMs } from "../core/api.ts";
import { takesText } from "../ui/dom.ts";
import type { Heading } from "./device.ts";
import { ClutchKey, DRIVE_KEYS, DragPath, type Intent, makeIdle, readKeys, readPad, readSpaceMouse } from "./intent.ts";
import { type Handles, Pull } from "./pull.ts";
import { SpaceMouse } from "./spacemouse.ts";

/** Way of the tip for a pixel of the mouse at 1 m/s [m]: at 10 cm/s half a millimetre. */
const METRES_PER_PIXEL = 0.005;
/** Pixels of a step of a wheel that reports lines or pages. */
const WHEEL_PIXELS = [1, 30, 300] as const;
/** After the focus came back, or a gamepad, the browser may tell an old state of it for this long [ms]. */
const SETTLE_MS = 200;
/** After the slider of the gripper is let go, or moved by a key, the gripper has this long to get there [ms]. */
const FINISH_MS = 1500;

export interface InputEvents {
  /** The dead-man is void: `reason` in words for people. */
  onRelease: (reason: string) => void;
  /** The person wants to stop driving. */
  onQuit: () => void;
}

/**
 * What a page drives with beside its devices. `handle`: what mouse and fingers drag. `slider`: of the gripper, 0 to 100.
 * `handles`: those at the gripper in the picture, null without one.
 */
export interface Surfaces {
  handle: HTMLElement;
  slider: HTMLInputElement;
  handles: Handles | null;
}

/** The inputs of one page. */
export class DesktopInputs {
  readonly spaceMouse: SpaceMouse;
  private readonly clutchKey = new ClutchKey();
  private readonly pressed = new Set<string>();
  /** The window lost the focus: what is pressed meanwhile is meant for others, and not known of all inputs. */
  private isAway = false;
  private back_ms = Number.NEGATIVE_INFINITY;
  private readonly drag = new DragPath();
  private dragging: number | null = null;
  private last = { x: 0, y: 0 };
  private speed = 0;
  private listening: AbortController | null = null;

  private readonly handle: HTMLElement;
  private readonly slider: HTMLInputElement;
  private readonly pull: Pull | null;
  /** A pointer holds the slider. */
  isSliding = false;
  /** The slider was let go, or moved by a key: the gripper goes on until then [ms]. */
  private finishUntil_ms = 0;
  /** The robot has held since the pointer took the slider: then it does not go on. */
  private isSlideVoid = false;

  constructor(
    { handle, slider, handles }: Surfaces,
    private readonly events: InputEvents,
  ) {
    this.handle = handle;
    this.slider = slider;
    this.pull = handles && new Pull(handles);
    this.spaceMouse = new SpaceMouse(() => this.release("the SpaceMouse was disconnected"));
    // Also while nothing is driven: the click that begins it tells that no Shift key is held.
    for (const type of ["keydown", "keyup", "pointerdown", "pointermove"] as const) {
      window.addEventListener(type, (event) => this.trackClutchKey(event), { capture: true });
    }
    window.addEventListener("focus", () => this.setAway(false));
    window.addEventListener("blur", () => this.setAway(true));
  }

  /** Names of what is connected besides keyboard and mouse, gamepads without the standard order with a note. */
  listConnected(): string[] {
    const pads = listPads().map((pad) => (pad.mapping === "standard" ? pad.id : `${pad.id} (its buttons have no known order: not used)`));
    return this.spaceMouse.name ? [...pads, this.spaceMouse.name] : pads;
  }

  /** Listen until `stop`. Keys that are already pressed do not count. */
  start(): void {
    this.stop();
    this.listening = new AbortController();
    const options = { signal: this.listening.signal, capture: true };
    window.addEventListener("keydown", (event) => this.onKey(event), options);
    window.addEventListener("keyup", (event) => this.onKey(event), options);
    window.addEventListener("blur", (event) => event.target === window && this.release("the window lost the focus"), options);
    window.addEventListener("pagehide", () => this.release("the page was left"), options);
    window.addEventListener("gamepadconnected", () => this.onPad(), options);
    window.addEventListener("gamepaddisconnected", () => this.release("the gamepad was disconnected"), options);
    document.addEventListener("visibilitychange", () => document.hidden && this.release("the page is hidden"), options);
    document.addEventListener("pointerlockchange", () => this.onLockChange(), options);
    const { handle } = this;
    handle.addEventListener("pointerdown", (event) => this.beginDrag(event), options);
    handle.addEventListener("pointermove", (event) => this.moveDrag(event), options);
    handle.addEventListener("pointerup", (event) => this.endDrag(event), options);
    handle.addEventListener("pointercancel", (event) => this.endDrag(event), options);
    handle.addEventListener("wheel", (event) => this.turnWheel(event), { ...options, passive: false });
    this.slider.addEventListener("pointerdown", () => this.beginSlide(), options);
    window.addEventListener("pointerup", () => this.finishSlide(), options);
    window.addEventListener("pointercancel", () => (this.isSliding = false), options);
    this.slider.addEventListener("input", () => !this.isSliding && (this.finishUntil_ms = nowMs() + FINISH_MS), options);
    void this.spaceMouse.reopen().catch(() => undefined); // taken away meanwhile, or in use by another program
  }

  stop(): void {
    this.listening?.abort();
    this.listening = null;
    this.forget();
  }

  /**
   * Return what each source asks for at a time. `speed`: of the tip [m/s]; `dt`: since the last call [s]; `heading`: where
   * "forward" is.
   */
  read(speed: number, dt: number, now_ms: number, heading: Heading): ReadonlyMap<string, Intent> {
    this.speed = speed;
    const dragged = { ...makeIdle(), clutch: this.dragging !== null, move: this.drag.take(speed, dt) };
    const inputs = new Map<string, Intent>([
      ["keyboard", readKeys(this.pressed, this.clutchKey.isHeld)],
      ["SpaceMouse", readSpaceMouse(this.spaceMouse.state, now_ms)],
      ["handle", dragged],
    ]);
    if (this.pull) inputs.set("gizmo", this.pull.read(heading, speed));
    for (const pad of listPads()) inputs.set(`gamepad ${pad.index} ${pad.id}`, readPad(pad));
    this.addSlider(inputs, now_ms);
    const isKnown = !this.isAway && !document.hidden && now_ms - this.back_ms > SETTLE_MS;
    return isKnown ? inputs : new Map();
  }

  /** Whether the slider asks for the gripper: held, or let go a moment ago. */
  isGripperAsked(now_ms: number): boolean {
    return this.isSliding || now_ms < this.finishUntil_ms;
  }

  /** The robot holds: the gripper does not go on once the slider is let go. */
  endSlide(): void {
    this.finishUntil_ms = 0;
    this.isSlideVoid = true;
  }

  /** Add what the slider asks for: the gripper alone, unless a dead-man of another input is held, which ends what was let go. */
  private addSlider(inputs: Map<string, Intent>, now_ms: number): void {
    const isOtherHeld = [...inputs.values()].some(({ clutch }) => clutch);
    if (isOtherHeld) this.finishUntil_ms = 0;
    const isAsked = this.isGripperAsked(now_ms);
    if (isAsked && !isOtherHeld) for (const [source, { clutch }] of inputs) inputs.set(source, { ...makeIdle(), clutch });
    inputs.set("slider", { ...makeIdle(), clutch: isAsked, gripper: isAsked ? Number(this.slider.value) / 100 : null });
  }

  private beginSlide(): void {
    this.isSliding = true;
    this.isSlideVoid = false;
    this.finishUntil_ms = 0;
  }

  private finishSlide(): void {
    if (this.isSliding && !this.isSlideVoid) this.finishUntil_ms = nowMs() + FINISH_MS;
    this.isSliding = false;
  }

  private release(reason: string): void {
    this.forget();
    this.events.onRelease(reason);
  }

  private forget(): void {
    this.pressed.clear();
    this.drag.clear();
    this.isSliding = false;
    this.finishUntil_ms = 0;
    this.pull?.letGo();
    this.dragging = null;
    this.handle.classList.remove("held");
    if (document.pointerLockElement === this.handle) document.exitPointerLock();
  }

  private setAway(isAway: boolean): void {
    if (this.isAway && !isAway) this.back_ms = nowMs();
    this.isAway = isAway;
    if (isAway) this.clutchKey.forget();
  }

  private onPad(): void {
    this.back_ms = nowMs();
    this.release("a gamepad was connected");
  }

  private trackClutchKey(event: KeyboardEvent | PointerEvent): void {
    if (event.type !== "pointermove") this.setAway(false); // a window without the focus has only these
    if (!this.isAway) this.clutchKey.take(event);
    if (event.type === "keydown" && takesText(event.target)) this.clutchKey.forget();
  }

  private onKey(event: KeyboardEvent): void {
    if (event.ctrlKey || event.metaKey || event.altKey) this.pressed.clear(); // the end of a press may not be reported
    if (event.type === "keyup") {
      this.pressed.delete(event.code);
      return;
    }
    if (event.ctrlKey || event.metaKey || event.altKey || takesText(event.target)) return;
    if (event.code === "Escape") this.events.onQuit();
    if (!DRIVE_KEYS.has(event.code)) return;
    if (!event.repeat) this.pressed.add(event.code);
    if (!this.clutchKey.isHeld && this.dragging === null) return;
    event.preventDefault(); // the view, lists and scroll bars have these keys otherwise
    event.stopPropagation();
  }

  private beginDrag(event: PointerEvent): void {
    if (event.button !== 0 || this.dragging !== null) return;
    event.preventDefault();
    this.dragging = event.pointerId;
    this.last = { x: event.clientX, y: event.clientY };
    this.handle.classList.add("held");
    this.handle.setPointerCapture(event.pointerId);
    // With a lock the mouse does not end at the edge of the screen. Without one it works, too.
    if (event.pointerType === "mouse") void Promise.resolve(this.handle.requestPointerLock()).catch(() => undefined);
  }

  private moveDrag(event: PointerEvent): void {
    if (event.pointerId !== this.dragging) return;
    if ((event.buttons & 1) === 0) {
      this.endDrag(event);
      return;
    }
    const isLocked = document.pointerLockElement === this.handle;
    const dx = isLocked ? event.movementX : event.clientX - this.last.x;
    const dy = isLocked ? event.movementY : event.clientY - this.last.y;
    this.last = { x: event.clientX, y: event.clientY };
    const scale = METRES_PER_PIXEL * this.speed;
    this.drag.add([scale * dx, -scale * dy, 0]);
  }

  private endDrag(event: PointerEvent): void {
    if (event.pointerId !== this.dragging) return;
    this.dragging = null;
    this.drag.clear();
    this.handle.classList.remove("held");
    if (document.pointerLockElement === this.handle) document.exitPointerLock();
  }

  private turnWheel(event: WheelEvent): void {
    if (this.dragging === null) return;
    event.preventDefault();
    this.drag.add([0, 0, -event.deltaY * (WHEEL_PIXELS[event.deltaMode] ?? 1) * METRES_PER_PIXEL * this.speed]);
  }

  private onLockChange(): void {
    const isLocked = document.pointerLockElement === this.handle;
    if (isLocked && this.dragging === null) document.exitPointerLock(); // it came after the button was let go
    else if (!isLocked && this.dragging !== null) this.release("the mouse was taken away");
  }
}

function listPads(): Gamepad[] {
  return [...(navigator.getGamepads?.() ?? [])].filter((pad): pad is Gamepad => pad !== null && pad.connected);
}
