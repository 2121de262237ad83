// What a person asks for with keys, a gamepad, a SpaceMouse or the mouse, as shares of the full speed relative to the
// view. Pure: `inputs.ts` reads the browser, `device.ts` makes samples of it.

import type { SpaceMouseState } from "./spacemouse.ts";

export type Vec3 = [number, number, number];

/** The motion that is asked for at one moment. Axes: right, forward (horizontal), up, as seen from the view. */
export interface Motion {
  /** Shares of the full speed along the axes, each -1 to 1. */
  move: Vec3;
  /** Shares of the full angular speed about the axes, right-handed. */
  turn: Vec3;
  close: boolean;
  open: boolean;
  /** How far the gripper is to be closed, 0 to 1; null: nothing of this kind. */
  gripper: number | null;
  /** Closes a gripper that was opened last, and the other way round; counts when it begins. */
  toggle: boolean;
}

/** What one source (the keyboard, a gamepad, ...) asks for. */
export interface Intent extends Motion {
  /** Its dead-man is held. Null: not known, which neither lets the robot follow nor counts as let go. */
  clutch: boolean | null;
}

/** What is needed of a `Gamepad`. */
export interface PadReading {
  mapping: string;
  axes: readonly number[];
  buttons: readonly { pressed: boolean }[];
}

/** The key that lets the robot follow, by its place (`KeyboardEvent.code`). */
export const CLUTCH_KEY = "ShiftLeft";

/** Axis and sign of a key, by its place on a QWERTY keyboard. */
const MOVE_KEYS: Readonly<Record<string, readonly [axis: 0 | 1 | 2, sign: number]>> = {
  KeyD: [0, 1],
  KeyA: [0, -1],
  KeyW: [1, 1],
  KeyS: [1, -1],
  KeyR: [2, 1],
  KeyF: [2, -1],
};
const TURN_KEYS: Readonly<Record<string, readonly [axis: 0 | 1 | 2, sign: number]>> = {
  ArrowUp: [0, 1],
  ArrowDown: [0, -1],
  KeyE: [1, 1],
  KeyQ: [1, -1],
  ArrowLeft: [2, 1],
  ArrowRight: [2, -1],
};
const CLOSE_KEY = "KeyC";
const OPEN_KEY = "KeyV";

/** Keys that mean something while the dead-man key is held. */
export const DRIVE_KEYS: ReadonlySet<string> = new Set([
  ...Object.keys(MOVE_KEYS),
  ...Object.keys(TURN_KEYS),
  CLOSE_KEY,
  OPEN_KEY,
]);

/** The keys for people. */
export const KEY_WORDS: readonly (readonly [keys: string, action: string])[] = [
  ["left Shift", "hold to let the robot follow"],
  ["W S, A D", "away, near; left, right"],
  ["R F", "up and down"],
  ["← →, ↑ ↓, Q E", "turn, tilt, roll"],
  ["C, V", "close, open the gripper"],
  ["Esc", "stop driving"],
];

/** Buttons and axes of the standard mapping (W3C Gamepad, "Remapping"). */
const PAD = { a: 0, b: 1, rightShoulder: 5, up: 12, down: 13, left: 14, right: 15 } as const;
/** Sticks rest this far from zero. */
const STICK_REST = 0.15;
/** Share of its range within which the cap of a SpaceMouse rests. */
const CAP_REST = 0.05;
/** A deflected cap reports about 100 times a second. After this long without a report its link is lost [ms]. */
const CAP_SILENT_MS = 200;
/** A cap at rest reports nothing. A dead-man that is held beside it may have been let go after this long without a report [ms]. */
const BUTTON_SILENT_MS = 10_000;

/** Return the intent of nothing pressed. */
export function makeIdle(): Intent {
  return { clutch: false, move: [0, 0, 0], turn: [0, 0, 0], close: false, open: false, gripper: null, toggle: false };
}

/** Return what the pressed keys ask for. `pressed`: values of `KeyboardEvent.code`. `clutch`: of the dead-man key. */
export function readKeys(pressed: ReadonlySet<string>, clutch: boolean | null): Intent {
  const intent = { ...makeIdle(), clutch };
  for (const code of pressed) {
    const move = MOVE_KEYS[code];
    if (move) intent.move[move[0]] += move[1];
    const turn = TURN_KEYS[code];
    if (turn) intent.turn[turn[0]] += turn[1];
  }
  intent.close = pressed.has(CLOSE_KEY);
  intent.open = pressed.has(OPEN_KEY);
  return intent;
}

/** Return what a gamepad asks for: nothing unless its buttons have the standard order. */
export function readPad(pad: PadReading): Intent {
  const intent = makeIdle();
  if (pad.mapping !== "standard") return intent;
  const axis = (index: number): number => cutRest(pad.axes[index] ?? 0, STICK_REST);
  const pressed = (index: number): boolean => pad.buttons[index]?.pressed ?? false;
  const between = (plus: number, minus: number): number => Number(pressed(plus)) - Number(pressed(minus));
  intent.move = [axis(0), -axis(1), -axis(3)];
  intent.turn = [between(PAD.up, PAD.down), between(PAD.right, PAD.left), -axis(2)];
  intent.clutch = pressed(PAD.rightShoulder);
  intent.close = pressed(PAD.a);
  intent.open = pressed(PAD.b);
  return intent;
}

/** Return what a SpaceMouse asks for at a time. Its axes point right, to the person, and down. */
export function readSpaceMouse(state: SpaceMouseState, now_ms: number): Intent {
  const [x, y, z, rx, ry, rz] = state.axes.map((value) => cutRest(value, CAP_REST)) as [number, number, number, number, number, number];
  const isDeflected = [x, y, z, rx, ry, rz].some((value) => value !== 0);
  const { buttons } = state;
  const isPressed = (button: number): boolean => buttons !== null && (buttons & (1 << button)) !== 0;
  const isCapLost = isDeflected && now_ms - state.moved_ms > CAP_SILENT_MS;
  if (isCapLost || (isPressed(0) && now_ms - state.reported_ms > BUTTON_SILENT_MS)) return { ...makeIdle(), clutch: null };
  const clutch = buttons === null ? null : isPressed(0);
  return { ...makeIdle(), clutch, move: [x, -y, -z], turn: [rx, -ry, -rz], toggle: isPressed(1) };
}

/** Return all motions together: they add up, at most full speed on each axis. */
export function merge(intents: Iterable<Motion>): Motion {
  const merged: Motion = makeIdle();
  for (const intent of intents) {
    for (const axis of [0, 1, 2] as const) {
      merged.move[axis] += intent.move[axis];
      merged.turn[axis] += intent.turn[axis];
    }
    merged.close ||= intent.close;
    merged.open ||= intent.open;
    merged.gripper ??= intent.gripper;
    merged.toggle ||= intent.toggle;
  }
  merged.move = merged.move.map(clipShare) as Vec3;
  merged.turn = merged.turn.map(clipShare) as Vec3;
  return merged;
}

/** What is needed of a `KeyboardEvent` or a `PointerEvent`. */
export interface ModifierReading {
  type: string;
  code?: string;
  repeat?: boolean;
  shiftKey: boolean;
  ctrlKey: boolean;
  metaKey: boolean;
  altKey: boolean;
}

/** The dead-man key, as far as events tell. */
export class ClutchKey {
  /** Null: not known. Its end is not reported while the right Shift key is held, nor to a window without the focus. */
  isHeld: boolean | null = null;

  take(event: ModifierReading): void {
    const isBegin = event.type === "keydown" && !event.repeat;
    if (event.shiftKey === false) this.isHeld = false; // the only evidence that it is let go
    if (isBegin && event.code === CLUTCH_KEY && this.isHeld === false) this.isHeld = true;
    const isEnd = event.type === "keyup" && event.code === CLUTCH_KEY && event.shiftKey;
    const isBeside = event.ctrlKey || event.metaKey || event.altKey || (isBegin && event.code === "ShiftRight");
    if (isEnd || isBeside) this.forget();
  }

  forget(): void {
    this.isHeld = null;
  }
}

/** The way of a mouse that has not been sent yet [m], along the axes of an intent. */
export class DragPath {
  private rest: Vec3 = [0, 0, 0];

  add(way: Readonly<Vec3>): void {
    for (const axis of [0, 1, 2] as const) this.rest[axis] += Number.isFinite(way[axis]) ? way[axis] : 0;
  }

  clear(): void {
    this.rest = [0, 0, 0];
  }

  /**
   * Take what can be done in `dt` [s] at `speed` [m/s] off the way; return it as shares of the speed.
   *
   * A mouse that is faster than the robot may be ahead by `MAX_AHEAD_S`: farther ways are cut, so that the robot stops
   * when the mouse does.
   */
  take(speed: number, dt: number): Vec3 {
    const reach = speed * dt;
    const length = Math.hypot(...this.rest);
    if (length === 0 || reach <= 0) return [0, 0, 0];
    const part = Math.min(1, reach / length);
    const left = length * (1 - part);
    const keep = left > 0 ? (1 - part) * Math.min(1, (speed * MAX_AHEAD_S) / left) : 0;
    const shares = this.rest.map((way) => (way * part) / reach) as Vec3;
    this.rest = this.rest.map((way) => way * keep) as Vec3;
    return shares;
  }
}

const MAX_AHEAD_S = 0.1;

/** Return a value without the part around zero in which a stick rests, again from -1 to 1. Not a number: 0. */
function cutRest(value: number, rest: number): number {
  const size = Math.abs(value);
  return size > rest ? clipShare((Math.sign(value) * (size - rest)) / (1 - rest)) : 0;
}

/** Return a vector that is no longer than 1. */
export function limitLength(vector: Vec3): Vec3 {
  const length = Math.hypot(...vector);
  return length > 1 ? (vector.map((part) => part / length) as Vec3) : vector;
}

function clipShare(value: number): number {
  return Math.min(1, Math.max(-1, value));
}
