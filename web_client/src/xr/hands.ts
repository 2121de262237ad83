// What a person's hands mean, frame by frame: which hand drives which robot, what is asked of the session, and the samples
// that are sent. Pure.
//
// A trigger pressed at a robot acquires it; held at one's own robot it releases it. A squeeze moves the robot of that hand,
// and the trigger is its gripper meanwhile. Buttons that are held when a hand appears count from their next press.

import type { SampleInput } from "../core/api.ts";
import { BUTTON, type FrameReading, type InputReading, type Side } from "./reading.ts";

/** A value is pressed from the first on, and until it falls below the second. */
const PRESS = 0.6;
const LET_GO = 0.4;
/** A trigger held this long at one's own robot releases it [ms]. */
export const RELEASE_MS = 800;

export type Intent =
  | { type: "acquire"; robot: string }
  | { type: "release"; robot: string }
  | { type: "episode"; action: "start" | "success" | "discard" }
  | { type: "estop" };

/** What the session and the picture say at a frame. */
export interface Context {
  /** Robots that this participant holds. */
  held: readonly string[];
  /** The robot that each hand points at. */
  pointed: Partial<Record<Side, string>>;
  isEpisodeRunning: boolean;
}

interface Hand {
  kind: InputReading["kind"];
  trigger: boolean;
  squeeze: boolean;
  buttons: number;
  /** When the trigger was pressed at one's own robot [ms], null: it was not. */
  pressed_ms: number | null;
  pressedAt: string;
}

/** State of both hands. */
export class Hands {
  /** The robot that each hand drives. */
  readonly driven = new Map<Side, string>();
  private readonly hands = new Map<Side, Hand>();
  /** Robots that were asked for, until they are held. */
  private readonly wanted = new Map<Side, string>();
  private isSuspended = false;

  /** Take a frame. Returns what it asks of the session. */
  update(reading: FrameReading, context: Context): Intent[] {
    for (const [side, robot] of this.driven) if (!context.held.includes(robot)) this.driven.delete(side);
    for (const [side, robot] of this.wanted) {
      if (!context.held.includes(robot)) continue;
      this.wanted.delete(side);
      this.bind(side, robot);
    }
    const intents: Intent[] = [];
    const seen = new Set(reading.inputs.map(({ side }) => side));
    for (const side of this.hands.keys()) if (!seen.has(side)) this.hands.delete(side);
    for (const input of reading.inputs) if (input.tracked) this.updateHand(input, reading.capture_ms, context, intents);
    this.isSuspended = false;
    return intents;
  }

  /** Input does not reach the scene now: what is pressed when it does again counts from its next press. */
  suspend(): void {
    this.isSuspended = true;
  }

  /** Return whether a hand holds its squeeze. */
  isSqueezing(side: Side): boolean {
    return this.hands.get(side)?.squeeze ?? false;
  }

  /** Return how far a hand is on the way to release its robot, from 0 to 1. */
  releaseShare(side: Side, now_ms: number): number {
    const since = this.hands.get(side)?.pressed_ms ?? null;
    return since === null ? 0 : Math.min(1, (now_ms - since) / RELEASE_MS);
  }

  /** Make the samples of a frame. `isVisible`: the person sees the scene and their input reaches it. */
  makeSamples(reading: FrameReading, isVisible: boolean): SampleInput[] {
    const { capture_ms } = reading;
    const samples: SampleInput[] = [];
    if (reading.head) samples.push({ device: "head", pose: reading.head, capture_ms, tracked: isVisible && reading.headTracked });
    for (const input of reading.inputs) {
      if (!input.pose) continue;
      const robot = this.driven.get(input.side);
      samples.push({
        device: `${input.kind}/${input.side}`,
        pose: input.pose,
        capture_ms,
        tracked: isVisible && input.tracked,
        robots: robot === undefined ? [] : [robot],
        clutch: this.isSqueezing(input.side),
        gripper: input.trigger,
        buttons: input.buttons,
      });
    }
    return samples;
  }

  private updateHand(input: InputReading, now_ms: number, context: Context, intents: Intent[]): void {
    const { side, kind, buttons } = input;
    const before = this.hands.get(side);
    const isNew = this.isSuspended || before?.kind !== kind;
    const hand: Hand = {
      kind,
      trigger: isPressed(input.trigger, before?.trigger ?? false),
      squeeze: isPressed(input.squeeze, before?.squeeze ?? false),
      buttons,
      pressed_ms: isNew ? null : before.pressed_ms,
      pressedAt: isNew ? "" : before.pressedAt,
    };
    this.hands.set(side, hand);
    if (isNew) return;
    const robot = context.pointed[side];
    if (hand.squeeze && !before.squeeze && !this.driven.has(side)) this.bindFree(side, context.held);
    if (!hand.trigger || hand.squeeze || robot !== hand.pressedAt) hand.pressed_ms = null;
    if (hand.trigger && !before.trigger && !hand.squeeze && robot !== undefined) {
      if (!context.held.includes(robot)) {
        this.wanted.set(side, robot);
        intents.push({ type: "acquire", robot });
      } else if (this.driven.get(side) !== robot) {
        this.bind(side, robot);
      } else {
        [hand.pressed_ms, hand.pressedAt] = [now_ms, robot];
      }
    }
    if (hand.pressed_ms !== null && now_ms - hand.pressed_ms >= RELEASE_MS) {
      hand.pressed_ms = null;
      intents.push({ type: "release", robot: hand.pressedAt });
    }
    const pressed = buttons & ~before.buttons;
    if (pressed & BUTTON.thumbstick) intents.push({ type: "estop" });
    if (pressed & BUTTON.lower) intents.push({ type: "episode", action: context.isEpisodeRunning ? "success" : "start" });
    if (pressed & BUTTON.upper && context.isEpisodeRunning) intents.push({ type: "episode", action: "discard" });
  }

  /** Let a hand drive a robot, and no other hand. */
  private bind(side: Side, robot: string): void {
    for (const [other, driven] of this.driven) if (driven === robot) this.driven.delete(other);
    this.driven.set(side, robot);
  }

  /** Let a hand drive a robot that is held and that no hand drives: the one named after its side, or the first. */
  private bindFree(side: Side, held: readonly string[]): void {
    const driven = new Set(this.driven.values());
    const free = held.filter((robot) => !driven.has(robot));
    const robot = free.find((name) => name.toLowerCase().includes(side)) ?? free[0];
    if (robot !== undefined) this.bind(side, robot);
  }
}

function isPressed(value: number, before: boolean): boolean {
  return before ? value > LET_GO : value >= PRESS;
}
