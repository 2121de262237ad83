// The device `desktop`: from intents to samples of kind `twist` in the world. Pure: time, inputs and the session come
// in as arguments.
//
// It drives while a dead-man key or button is held. Whatever ends that from outside (the window lost the focus, an
// e-stop, ...) opens the clutch at once, and the dead-man has to be let go and pressed again. A dead-man counts only
// after it was seen let go on the same source, so that one that comes back pressed moves nothing.

import type { SampleInput } from "../core/api.ts";
import { type Intent, limitLength, merge, type Motion, type Vec3 } from "./intent.ts";

/** Least and greatest speed of the tip [m/s]. */
export const SPEED_RANGE = [0.01, 0.3] as const;
/** Angular speed that goes with a speed [rad/m]: 10 cm/s and 0.5 rad/s. */
export const TURN_PER_METRE = 5;

export type Twist = [number, number, number, number, number, number];
/** Horizontal direction of "forward" in the world: a unit vector (x, y). */
export type Heading = readonly [number, number];

/** What the session says about the robot that is driven. */
export interface Situation {
  /** The connection is there, with everything known. */
  isReady: boolean;
  isStopped: boolean;
  isPaused: boolean;
  isHolder: boolean;
}

/** Turns intents into samples that drive one robot. */
export class DesktopDevice {
  /** The robot that is driven, empty for none. */
  robot = "";
  isEngaged = false;
  /** Why the clutch was opened from outside, until the dead-man is pressed anew; else empty. */
  released = "";
  private isBlocked = false;
  /** A dead-man is held that does not count before it is let go. */
  mustLetGo = false;
  /** Sources whose dead-man was seen let go since dead-men were void. */
  private readonly ready = new Set<string>();
  private gripper: number | null = null;
  /** What the gripper was told last: 0 open, 1 closed; null: it was stopped on its way. */
  lastGripper: number | null = 0;
  private wasToggled = false;

  constructor(private readonly send: (sample: SampleInput) => void) {}

  /** Drive a robot from now on. Its first sample has the clutch open, as every engagement needs. */
  arm(robot: string, now_ms: number): void {
    if (this.robot !== "") this.disarm(now_ms);
    this.robot = robot;
    this.released = "";
    this.ready.clear();
    this.lastGripper = 0;
    this.sendHold(now_ms);
  }

  /** Drive no robot. */
  disarm(now_ms: number): void {
    if (this.robot === "") return;
    this.sendHold(now_ms);
    this.robot = "";
    this.released = "";
  }

  /** Open the clutch now, for a reason in words; the dead-man has to be let go and pressed again. */
  release(reason: string, now_ms: number): void {
    if (this.robot === "") return;
    this.ready.clear();
    if (!this.isEngaged) return;
    this.released = reason;
    this.sendHold(now_ms);
  }

  /**
   * Send the sample of this moment. Returns false when the robot is not held any more, and the device is disarmed.
   *
   * `inputs`: what each source asks for. `speed`: of the tip [m/s], within `SPEED_RANGE`. `heading`: where "forward" is.
   */
  tick(inputs: ReadonlyMap<string, Intent>, heading: Heading, speed: number, situation: Situation, now_ms: number): boolean {
    if (this.robot === "") return false;
    if (situation.isReady && !situation.isHolder) {
      this.disarm(now_ms);
      return false;
    }
    const blocked = findBlock(situation);
    if (blocked !== "") this.release(blocked, now_ms);
    else if (this.isBlocked) this.released = ""; // what blocked has passed
    this.isBlocked = blocked !== "";
    const isHeld = this.readDeadMen(inputs);
    const motion = merge(inputs.values());
    const isFlipped = motion.toggle && !this.wasToggled;
    this.wasToggled = motion.toggle;
    if (!isHeld || blocked !== "") {
      this.sendHold(now_ms);
      return true;
    }
    if (!this.isEngaged) this.gripper = null;
    this.isEngaged = true;
    this.released = "";
    this.readGripper(motion, isFlipped);
    this.send({ ...this.makeSample(now_ms), clutch: true, gripper: this.gripper, twist: toTwist(motion, heading, speed) });
    return true;
  }

  /** Note which dead-men are let go. Return whether one is held that counts. */
  private readDeadMen(inputs: ReadonlyMap<string, Intent>): boolean {
    for (const source of this.ready) if (!inputs.has(source)) this.ready.delete(source);
    for (const [source, { clutch }] of inputs) {
      if (clutch === false) this.ready.add(source);
      else if (clutch === null) this.ready.delete(source);
    }
    const held = [...inputs].filter(([, { clutch }]) => clutch).map(([source]) => source);
    const isHeld = held.some((source) => this.ready.has(source));
    this.mustLetGo = held.length > 0 && !isHeld;
    return isHeld;
  }

  private readGripper({ close, open, gripper }: Motion, isFlipped: boolean): void {
    if (gripper !== null) this.gripper = gripper;
    else if (close !== open) this.gripper = close ? 1 : 0;
    else if (isFlipped) this.gripper = 1 - (this.lastGripper ?? 0);
    this.lastGripper = this.gripper ?? this.lastGripper;
  }

  private sendHold(now_ms: number): void {
    this.isEngaged = false;
    this.send(this.makeSample(now_ms));
  }

  /** A sample with the clutch open that stands still. */
  private makeSample(now_ms: number): SampleInput {
    const { robot } = this;
    return { device: "desktop", kind: "twist", pose: null, capture_ms: now_ms, robots: [robot], clutch: false, twist: [0, 0, 0, 0, 0, 0] };
  }
}

/** Pictures a second with which samples are sent in time, whatever is drawn. */
const ENOUGH_HZ = 15;

/** Notes that drags end because this page draws slowly: its samples wait meanwhile. */
export class SlownessWatch {
  /** What is wrong and what helps, from a drag that ended so until the next one; else empty. */
  words = "";
  private isEngaged = false;
  private begin = { pictures: 0, ms: 0 };

  /** `pictures`: that the page could draw since it began. `isLate`: the session holds the robot since samples came too late. */
  note(isEngaged: boolean, isLate: boolean, pictures: number, now_ms: number): void {
    if (isEngaged && !this.isEngaged) {
      this.words = "";
      this.begin = { pictures, ms: now_ms };
    }
    this.isEngaged = isEngaged;
    const hz = (1000 * (pictures - this.begin.pictures)) / (now_ms - this.begin.ms);
    if (!isEngaged || !isLate || !(hz < ENOUGH_HZ) || this.words !== "") return;
    this.words = `This page draws only ${Math.max(2, Math.ceil(hz))} pictures a second, so what you drag comes too late. A smaller window helps, or “Labels and people” off, or another browser.`;
  }
}

/** Return in words what keeps every dead-man from counting, empty for nothing. */
function findBlock({ isReady, isStopped, isPaused }: Situation): string {
  if (!isReady) return "the connection is lost";
  if (isStopped) return "e-stop";
  return isPaused ? "the session was paused" : "";
}

/** Return the twist of a motion in the world [m/s, rad/s]: no faster than `speed`, whatever the direction. */
export function toTwist(motion: Motion, heading: Heading, speed: number): Twist {
  const bounded = Math.min(SPEED_RANGE[1], Math.max(SPEED_RANGE[0], speed));
  const v = toWorld(limitLength(motion.move), heading, bounded);
  const w = toWorld(limitLength(motion.turn), heading, bounded * TURN_PER_METRE);
  return [...v, ...w];
}

/**
 * Return the horizontal direction in which a camera looks, in the world. `forward`, `up`: its axes in the world.
 *
 * One that looks straight down or up has the top of its picture, or the bottom, there.
 */
export function toHeading(forward: Readonly<Vec3>, up: Readonly<Vec3>): Heading {
  const isSteep = Math.hypot(forward[0], forward[1]) < 0.2;
  const sign = isSteep && forward[2] > 0 ? -1 : 1;
  const [x, y] = isSteep ? [sign * up[0], sign * up[1]] : [forward[0], forward[1]];
  const length = Math.hypot(x, y);
  return length > 0 ? [x / length, y / length] : [1, 0];
}

/** Return a vector (right, forward, up) of a view in the world, times `scale`. */
function toWorld([right, forward, up]: Vec3, [x, y]: Heading, scale: number): Vec3 {
  return [scale * (right * y + forward * x), scale * (forward * y - right * x), scale * up];
}
