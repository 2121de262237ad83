// What a person's hands mean, frame by frame: which hand drives which robot, what is asked of the session, and the samples
// that are sent. Pure.
//
// A trigger pressed at a robot acquires it; held at one's own robot it releases it; pressed at an answer it gives it, at an
// item of a menu it chooses it. A squeeze moves the robot of that hand, and the trigger is its gripper meanwhile. While marks
// are touched, only answers are given. Buttons that are held when a hand appears count from their next press; only the e-stop counts always.

import type { SampleInput } from "../core/api.ts";
import { Grips } from "./grips.ts";
import type { MenuItem } from "./picture_places.ts";
import type { Answer } from "./question.ts";
import { BUTTON, type FrameReading, type InputReading, type Side } from "./reading.ts";

/** A value is pressed from the first on, and until it falls below the second. */
const PRESS = 0.6;
const LET_GO = 0.4;
/** A trigger held this long at one's own robot releases it [ms]. */
export const RELEASE_MS = 800;
/** A trigger pressed at nothing for no longer than this asks to be placed [ms]: a longer press is no tap. */
const TAP_MS = 800;
/** After so long without a frame hands are new ones [ms]: what they did meanwhile is not known. */
const GAP_MS = 500;
/** A lease that was granted is seen within this time [ms]. */
const GRANTED_MS = 2000;
/** The clutch of a hand that has got a robot stays open this long [ms]: a session engages after it has seen it open. */
const OPEN_MS = 100;

/** What a hand can point at, and press, that is no robot. */
export type Target = Answer | MenuItem;

export type Intent =
  | { type: "acquire"; robot: string }
  | { type: "release"; robot: string }
  | { type: "press"; target: Target }
  /** Stay where the scene is shown. */
  | { type: "place" };

/** What the session and the picture say at a frame. */
export interface Context {
  /** Robots that this participant holds. */
  held: readonly string[];
  /** Of each robot that no other participant holds, too: what changes when another may have moved its gripper. */
  tenures: ReadonlyMap<string, string>;
  /** Robots that the session moves for this participant. */
  following: readonly string[];
  /** Robots that hold because the pose of their device is an estimate. */
  guessed: readonly string[];
  /** The robot that each hand points at. */
  pointed: Partial<Record<Side, string>>;
  /** The answer to a question, or the item of a menu, that each hand points at; it is nearer than robots. */
  aimed: Partial<Record<Side, Target>>;
  /** This participant may place itself, and is not aligned. */
  canPlace: boolean;
  /** The person touches marks: a trigger that is pressed at no target is meant for them. */
  isTouching: boolean;
}

interface Hand {
  kind: InputReading["kind"];
  trigger: boolean;
  squeeze: boolean;
  /** The squeeze was held when the hand appeared, and has not been let go since. */
  mustLetGo: boolean;
  /** The same of the trigger. */
  mustLetGoTrigger: boolean;
  buttons: number;
  /** When the trigger was pressed at one's own robot [ms], null: it was not. */
  pressed_ms: number | null;
  pressedAt: string;
  /** When the trigger was pressed at nothing [ms], null: it was not. */
  tapped_ms: number | null;
}

/** State of both hands. */
export class Hands {
  /** The robot that each hand drives. */
  readonly driven = new Map<Side, string>();
  private readonly hands = new Map<Side, Hand>();
  /** Robots that were asked for, until they are held or denied, and until when they are waited for [ms]. */
  private readonly wanted = new Map<Side, { robot: string; until_ms: number }>();
  /** When each hand got its robot [ms]. */
  private readonly bound_ms = new Map<Side, number>();
  /** Robots that hold for an estimated pose, as the session says. */
  private guessed: readonly string[] = [];
  private isTouching = false;
  private wasTouching = false;
  private readonly withheld = new Map<Side, number>();
  private readonly grips = new Grips();
  /** What is asked of the gripper of each hand in this frame. */
  private readonly grasps = new Map<Side, number | null>();
  /** Devices whose button of the e-stop was pressed in the last frame. */
  private stops: readonly object[] = [];
  private frame_ms = Number.NEGATIVE_INFINITY;

  /** Take the devices whose button of the e-stop is pressed. Returns whether one is that was not in the frame before. */
  takeStops(stops: readonly object[]): boolean {
    const isPress = stops.some((device) => !this.stops.includes(device));
    this.stops = stops;
    return isPress;
  }

  /** Take a frame. Returns what it asks of the session. */
  update(reading: FrameReading, context: Context): Intent[] {
    const { capture_ms } = reading;
    const dt_ms = capture_ms - this.frame_ms;
    if (dt_ms > GAP_MS) this.suspend();
    this.frame_ms = capture_ms;
    this.guessed = context.guessed;
    [this.wasTouching, this.isTouching] = [this.isTouching, context.isTouching];
    for (const [side, robot] of this.driven) if (!context.held.includes(robot)) this.driven.delete(side);
    const intents: Intent[] = [];
    const inputs = reading.inputs.filter(({ tracked }) => tracked);
    for (const side of this.hands.keys()) if (!inputs.some((input) => input.side === side)) this.hands.delete(side);
    for (const input of inputs) this.updateHand(input, capture_ms, context, intents);
    this.bindWanted(context.held, capture_ms);
    this.updateGrips(inputs, context, dt_ms / 1000);
    return intents;
  }

  /** Input does not reach the scene now: what is pressed when it does again counts from its next press. */
  suspend(): void {
    this.hands.clear();
  }

  /** The session has answered a request for a robot. */
  settle(robot: string, isGranted: boolean, now_ms: number): void {
    for (const [side, wish] of this.wanted) {
      if (wish.robot !== robot) continue;
      if (isGranted) wish.until_ms = now_ms + GRANTED_MS;
      else this.wanted.delete(side);
    }
  }

  /** Return whether a hand holds its squeeze. */
  isSqueezing(side: Side): boolean {
    return this.hands.get(side)?.squeeze ?? false;
  }

  /** Return what a hand holds that does not count before it is let go, null: nothing. */
  findIgnored(side: Side): "squeeze" | "trigger" | null {
    const hand = this.hands.get(side);
    if (hand?.mustLetGo) return "squeeze";
    return hand?.mustLetGoTrigger && !hand.squeeze ? "trigger" : null;
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
    const judge = (tracked: boolean, emulated: boolean) => ({ tracked: isVisible && (tracked || emulated), ...(isVisible && emulated && { emulated }) });
    if (reading.head) samples.push({ device: "head", pose: reading.head, capture_ms, ...judge(reading.headTracked, reading.headEmulated) });
    for (const input of reading.inputs) {
      if (!input.pose) continue;
      const { side } = input;
      const robot = this.driven.get(side);
      // A sample of an estimated pose that names its robot is rejected: until the session says that it holds for that.
      const isNamed = robot !== undefined && !(input.emulated && this.guessed.includes(robot));
      const clutch = this.isSqueezing(side) && capture_ms - (this.bound_ms.get(side) ?? 0) >= OPEN_MS;
      samples.push({
        device: `${input.kind}/${side}`,
        pose: input.pose,
        capture_ms,
        ...judge(input.tracked, input.emulated),
        robots: isNamed ? [robot] : [],
        clutch,
        gripper: clutch ? (this.grasps.get(side) ?? null) : null,
        buttons: input.buttons & ~this.withhold(side, input.buttons),
        ...(isVisible && input.joints.length > 0 && { hand_joints: [...input.joints] }),
      });
    }
    return samples;
  }

  /** Return the buttons of episodes that are pressed for marks that are touched: they are not sent until they are let go. */
  private withhold(side: Side, buttons: number): number {
    const isForMarks = this.isTouching || this.wasTouching; // the press that ends it, too
    const withheld = buttons & (isForMarks ? BUTTON.lower | BUTTON.upper : (this.withheld.get(side) ?? 0));
    this.withheld.set(side, withheld);
    return withheld;
  }

  private updateHand(input: InputReading, now_ms: number, context: Context, intents: Intent[]): void {
    const { side, kind, buttons } = input;
    const before = this.hands.get(side);
    const isNew = before?.kind !== kind;
    const isSqueezed = isPressed(input.squeeze, isNew || before.squeeze || before.mustLetGo);
    const mustLetGo = isSqueezed && (isNew || before.mustLetGo);
    const trigger = isPressed(input.trigger, isNew || before.trigger);
    const hand: Hand = {
      kind,
      trigger,
      squeeze: isSqueezed && !mustLetGo,
      mustLetGo,
      mustLetGoTrigger: trigger && (isNew || before.mustLetGoTrigger),
      buttons,
      pressed_ms: isNew ? null : before.pressed_ms,
      pressedAt: isNew ? "" : before.pressedAt,
      tapped_ms: isNew ? null : before.tapped_ms,
    };
    this.hands.set(side, hand);
    if (isNew) return;
    if (hand.squeeze && !before.squeeze) this.beginSqueeze(side, context.held);
    this.readTrigger(side, hand, before.trigger, now_ms, context, intents);
  }

  private readTrigger(side: Side, hand: Hand, wasPressed: boolean, now_ms: number, context: Context, intents: Intent[]): void {
    const robot = context.pointed[side];
    const target = context.aimed[side];
    const isPress = hand.trigger && !wasPressed && !hand.squeeze;
    if (!hand.trigger || hand.squeeze || robot !== hand.pressedAt) hand.pressed_ms = null;
    if (hand.squeeze || robot !== undefined || target !== undefined) hand.tapped_ms = null;
    if (isPress && target !== undefined) intents.push({ type: "press", target });
    else if (context.isTouching) [hand.pressed_ms, hand.tapped_ms] = [null, null];
    else if (isPress && robot !== undefined) this.pressAt(robot, side, hand, now_ms, context, intents);
    else if (isPress) hand.tapped_ms = now_ms;
    if (hand.pressed_ms !== null && now_ms - hand.pressed_ms >= RELEASE_MS) {
      hand.pressed_ms = null;
      intents.push({ type: "release", robot: hand.pressedAt });
    }
    if (hand.trigger || hand.tapped_ms === null) return;
    if (now_ms - hand.tapped_ms <= TAP_MS && context.canPlace) intents.push({ type: "place" });
    hand.tapped_ms = null;
  }

  private pressAt(robot: string, side: Side, hand: Hand, now_ms: number, { held }: Context, intents: Intent[]): void {
    const isMoved = [...this.driven].some(([other, driven]) => driven === robot && this.isSqueezing(other));
    if (!held.includes(robot)) {
      this.wanted.set(side, { robot, until_ms: Number.POSITIVE_INFINITY });
      intents.push({ type: "acquire", robot });
    } else if (this.driven.get(side) === robot) {
      [hand.pressed_ms, hand.pressedAt] = [now_ms, robot];
    } else if (!isMoved) {
      this.bind(side, robot);
    }
  }

  /** Give hands the robots that they asked for. */
  private bindWanted(held: readonly string[], now_ms: number): void {
    for (const [side, { robot, until_ms }] of this.wanted) {
      if (held.includes(robot)) this.bind(side, robot);
      else if (now_ms > until_ms) this.wanted.delete(side);
    }
  }

  private updateGrips(inputs: readonly InputReading[], { held, following, tenures }: Context, dt_s: number): void {
    this.grips.keepOnly(held);
    this.grasps.clear();
    for (const [side, robot] of this.driven) {
      const trigger = inputs.find((input) => input.side === side)?.trigger;
      if (trigger === undefined || !this.isSqueezing(side)) this.grips.letGo(robot);
      else this.grasps.set(side, this.grips.follow(robot, tenures.get(robot), trigger, following.includes(robot), dt_s));
    }
  }

  /** Let a hand drive a robot, and no other hand. */
  private bind(side: Side, robot: string): void {
    for (const [other, driven] of this.driven) if (driven === robot) this.driven.delete(other);
    for (const [other, wish] of this.wanted) if (other === side || wish.robot === robot) this.wanted.delete(other);
    this.driven.set(side, robot);
    this.bound_ms.set(side, this.frame_ms);
  }

  /**
   * A hand without a robot drives one that is held and that no hand drives: the one named after its side, or the first.
   *
   * What it asked for before is not given to it any more: a hand that works must not find itself at another robot.
   */
  private beginSqueeze(side: Side, held: readonly string[]): void {
    this.wanted.delete(side);
    if (this.driven.has(side)) return;
    const driven = new Set(this.driven.values());
    const free = held.filter((robot) => !driven.has(robot));
    const robot = free.find((name) => name.toLowerCase().includes(side)) ?? free[0];
    if (robot !== undefined) this.bind(side, robot);
  }
}

function isPressed(value: number, before: boolean): boolean {
  return before ? value > LET_GO : value >= PRESS;
}
