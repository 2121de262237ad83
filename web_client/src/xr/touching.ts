// Aligning a headset by touching the marks of a sheet: what the person does next, what is reported to the session, and the
// words for it. A state machine over frames and answers of the session. Pure.
//
// The tip of a controller is calibrated by turning the controller while its tip stays in a hole. Then the tip is put on one
// mark after the other. Bare hands touch with a fingertip, and the other hand pinches: pinching moves the finger itself.

import type { AnchorPlace, Filled, ObservationInput, ParticipantInfo } from "../core/api.ts";
import type * as wire from "../protocol/messages.g.ts";
import { capitalize, formatMillimetres } from "../ui/words.ts";
import { angleBetween, compose, distanceBetween, fitLevel, IDENTITY, invert, transform } from "./poses.ts";
import { BUTTON, type FrameReading, type InputReading, type Side, type Vec3 } from "./reading.ts";
import { describeAlignment, drawBar, isPlaced, isViewOnly, wrap } from "./words.ts";

/** Tip of a controller in the frame of its pose, as the session calibrated it. `covariance`: 3x3 row-major [m^2]. */
export interface Tip {
  p: Vec3;
  covariance: number[];
  error_m: number;
}

/** What the session says at a frame. */
export interface Facts {
  /** Sheet whose marks are touched, null: the session has none. */
  anchor: AnchorPlace | null;
  alignment: ParticipantInfo["alignment"] | undefined;
  /** The session takes observations of this headset now. */
  isReady: boolean;
  /** Begin without being asked to when the headset is not aligned. */
  isOffered: boolean;
  /** Sides whose trigger means something else now. */
  busy: readonly Side[];
}

export type Outcome =
  | { type: "observe"; observation: ObservationInput }
  | { type: "pulse"; side: Side }
  /** A new alignment run is wanted. */
  | { type: "restart" }
  /**
   * Marks were touched, and the alignment is in force. `isConfirmed`: that of the kept place, by fewer marks. `isMeasured`:
   * a new one, by the marks alone.
   */
  | { type: "finish"; anchor: AnchorPlace; isConfirmed: boolean; isMeasured: boolean };

type Stage =
  | { name: "off" }
  | { name: "tip" }
  | { name: "turn"; side: Side; device: wire.Device; poses: wire.Pose[] }
  | { name: "solve"; device: wire.Device; since_ms: number }
  | { name: "touch" }
  /** `isCheck`: of a point that others touch too, while the squeeze is held; else of a mark. */
  | { name: "rest"; pressing: Side; touching: Side; device: wire.Device; points: Vec3[]; since_ms: number; isCheck: boolean }
  | { name: "wait"; since_ms: number }
  | { name: "done"; since_ms: number };

interface Presses {
  triggers: Side[];
  squeezes: Side[];
  buttons: number;
}

/** A trigger or a squeeze is pressed from the first on, and until it falls below the second. */
const PRESS = 0.6;
const LET_GO = 0.4;
/** A trigger held this long at nothing begins a new alignment [ms]. */
export const BEGIN_MS = 2000;
/** Orientations of a calibration, and the angle between any two of them [rad]: together a cone of more than 20 degrees. */
export const TIP_POSES = 80;
const TIP_STEP_RAD = (5 * Math.PI) / 180;
/** The session wants at least so many. */
const MIN_TIP_POSES = 20;
/** A touch is the mean over this time [ms], in which a tip and a fingertip move less than this [m]. */
export const REST_MS = 350;
const STILL_M = { controller: 0.004, hand: 0.012 } as const;
/** Name of the point that wearers touch to compare their worlds. */
const POINT = "point";
/** Noise of a touch per axis [m] and [rad], as docs/protocol.md (section 5) has it. */
const TOUCH_SIGMA_M = 0.0015;
const TOUCH_SIGMA_RAD = 0.01;
/** So many marks make an alignment. */
export const MIN_TOUCHES = 3;
/** Time for an answer [ms], for a refusal after the last touch, and that the result is shown. */
const ANSWER_MS = 4000;
const REFUSAL_MS = 1500;
const DONE_MS = 8000;

/** The procedure of one headset, from frame to frame. */
export class Touching {
  /** Calibrated tips by device. */
  readonly tips = new Map<string, Tip>();
  private stage: Stage = { name: "off" };
  private anchor: AnchorPlace | null = null;
  /** Marks still to be touched, the next one first. */
  private queue: string[] = [];
  /** Where marks were touched, in the tracking frame. */
  private readonly touched = new Map<string, Vec3>();
  /** Marks that the session asked for once more. */
  private readonly repeated = new Set<string>();
  private readonly pressed = new Map<Side, { trigger: boolean; squeeze: boolean; buttons: number; since_ms: number | null }>();
  /** Words about what happened last. */
  private advice = "";
  private wasAsked = false;
  private isDeclined = false;
  private wasPlaced = false;
  private wasReady = false;
  /** Version of the alignment when the first mark was touched. */
  private version: number | undefined;
  private isConfirming = false;
  private wantsTip = false;
  /** There are hands, and no controller. */
  private isBare = false;

  /** The person is at it: triggers, squeezes and buttons have the meaning that they have here. */
  get isActive(): boolean {
    return this.stage.name !== "off" && this.stage.name !== "done";
  }

  /** Begin, by the person's own word: aligned or not. */
  begin(): void {
    this.reset();
    this.wasAsked = true;
    this.stage = { name: "touch" };
  }

  /** The tracking frame is another one: touches are void. Tips are of the controllers, and stay. */
  reset(): void {
    this.touched.clear();
    this.repeated.clear();
    this.queue = this.anchor?.marks.map(({ id }) => id) ?? [];
    this.advice = "";
    this.isDeclined = this.isConfirming = this.wantsTip = false;
    if (this.isActive) this.stage = { name: "touch" };
  }

  /** Take a frame. */
  update(reading: FrameReading, facts: Facts): Outcome[] {
    const outcomes: Outcome[] = [];
    this.isBare = reading.inputs.length > 0 && reading.inputs.every(({ kind }) => kind === "hand");
    const placed = isPlaced(facts.alignment);
    const isConnectedAnew = facts.isReady && !this.wasReady; // the session has forgotten the touches of the last connection
    if ((this.wasPlaced && !placed) || (isConnectedAnew && this.touched.size > 0)) this.reset();
    [this.wasPlaced, this.wasReady] = [placed, facts.isReady];
    if (facts.anchor?.anchor_id !== this.anchor?.anchor_id) {
      this.anchor = facts.anchor;
      this.reset();
    }
    this.anchor = facts.anchor;
    if (!this.anchor) this.stage = { name: "off" };
    const presses = this.readPresses(reading, facts, outcomes);
    if (this.anchor && facts.isReady) this.step(reading, facts, presses, outcomes);
    return outcomes;
  }

  /** Take the session's answer about a tip. */
  onTip({ device, refused, advice, p_grip_tip, covariance, error_m }: Filled<wire.TipCalibrated>): void {
    const isAwaited = this.stage.name === "solve" && this.stage.device === device;
    if (refused) {
      if (!isAwaited) return;
      this.advice = advice;
      this.stage = { name: "tip" };
      return;
    }
    this.tips.set(device, { p: p_grip_tip, covariance, error_m });
    if (!isAwaited) return;
    this.reset(); // touches with the earlier tip no longer count
    this.advice = `The tip is known to ± ${formatMillimetres(error_m)}.`;
    this.stage = { name: "touch" };
  }

  /** Take a refusal of the session: marks that it names are touched next. A mark that does not fit again comes last. */
  onRefused(text: string): void {
    if (!this.isActive) return;
    this.advice = text.replace(/^alignment of .*? refused: /, "");
    const named = this.listMarks().filter((mark) => text.includes(`'${this.anchor?.anchor_id}/${mark}'`));
    const first = named.filter((mark) => !this.repeated.has(mark));
    const last = named.filter((mark) => this.repeated.has(mark));
    for (const mark of named) {
      this.repeated.add(mark);
      this.touched.delete(mark);
    }
    this.queue = [...first, ...this.queue.filter((mark) => !named.includes(mark)), ...last];
    if (this.queue.length === 0) this.queue = this.listMarks();
    if (this.stage.name === "wait") this.stage = { name: "touch" };
  }

  /** Take how far apart two worlds are at the point that was touched. `other`: the other one's name. */
  onCompared(other: string, { error_m, expected_p95_m }: Filled<wire.HeadsetsCompared>): void {
    const verdict = error_m > 2 * expected_p95_m ? "too much" : `expected at most ${formatMillimetres(expected_p95_m)}`;
    this.advice = `You and ${other} are ${formatMillimetres(error_m)} apart at the touched point: ${verdict}.`;
  }

  /** Return where the next mark is expected, with the axes of its sheet, in the tracking frame; null: not known, or none is. */
  findExpected({ alignment }: Pick<Facts, "alignment">): { mark: string; pose: wire.Pose } | null {
    const { anchor } = this;
    const [mark] = this.queue;
    if (!anchor || mark === undefined || !["touch", "rest"].includes(this.stage.name)) return null;
    const known = [...this.touched].map(([id, p]) => ({ from: this.findMark(id), to: p }));
    const T_tracking_world = alignment && isPlaced(alignment) ? invert(alignment.T_world_tracking) : known.length >= 2 ? fitLevel(known) : null;
    return T_tracking_world && { mark, pose: compose(T_tracking_world, [this.findMark(mark), anchor.T_world_anchor[1]]) };
  }

  /** Return the points that may touch marks, in the tracking frame: calibrated tips and fingertips. */
  listTips({ inputs }: FrameReading): Vec3[] {
    if (!this.isActive) return [];
    return inputs.map((input) => (input.tracked ? this.findTip(input) : null)).filter((p) => p !== null);
  }

  /** Return the lines of the panel, none when there is nothing to do. `memory`: what becomes of the place. */
  describe({ alignment }: Pick<Facts, "alignment">, now_ms: number, memory: string): string[] {
    const { stage } = this;
    const sheet = `sheet '${this.anchor?.anchor_id ?? ""}'`;
    const advice = this.advice === "" ? [] : wrap(this.advice);
    switch (stage.name) {
      case "off":
        return [];
      case "tip":
        return ["Calibrate the tip of a controller", ...advice, ...wrap(`Put the tip into a pricked hole of the ${sheet}, and press the trigger.`), "B or Y: not now"];
      case "turn":
        return ["Turn the controller, its tip in the hole", "Tilt it to every side, and twist it.", drawBar(stage.poses.length / TIP_POSES), "Trigger: that is enough"];
      case "solve":
        return ["The session computes where the tip is"];
      case "rest":
        return [`${stage.isCheck ? "Your common point" : `Mark ${this.queue[0]}`}: hold still`, drawBar((now_ms - stage.since_ms) / REST_MS)];
      case "wait":
        return ["The session computes the alignment"];
      case "done":
        return [capitalize(describeAlignment(alignment)), ...(memory === "" ? [] : wrap(memory))];
      default:
        return [...this.describeNext(alignment), ...advice, ...this.describeHow(sheet), ...this.describeCheck(alignment)];
    }
  }

  private describeNext(alignment: Facts["alignment"]): string[] {
    const [mark] = this.queue;
    if (alignment?.kind === "persistent" && this.touched.size === 0) return [`Touch mark ${mark}: it confirms the kept place`];
    const before = alignment && this.touched.size > 0 && isPlaced(alignment) ? [`So far: ${describeAlignment(alignment)}`] : [];
    return [`Touch mark ${mark} (${this.touched.size + 1} of ${this.listMarks().length})`, ...before];
  }

  private describeHow(sheet: string): string[] {
    if (!this.isBare) return [...wrap(`Put the tip into hole ${this.queue[0]} of the ${sheet}, press the trigger and hold still.`), "A or X: calibrate the tip again", this.touched.size < MIN_TOUCHES ? "B or Y: not now" : "B or Y: that is enough"];
    return wrap(`Put a fingertip on cross ${this.queue[0]} of the ${sheet}, and pinch with the other hand. A finger is good enough to look; to drive, take a controller.`);
  }

  private describeCheck(alignment: Facts["alignment"]): string[] {
    return this.isBare || !isCompared(alignment) ? [] : ["Squeeze: compare a point with another one"];
  }

  // --- frames ---------------------------------------------------------------------------------------------------------

  /** Find the triggers and buttons that are pressed at this frame; those that are held when a hand appears are not. */
  private readPresses({ inputs, capture_ms }: FrameReading, facts: Facts, outcomes: Outcome[]): Presses {
    const triggers: Side[] = [];
    const squeezes: Side[] = [];
    let buttons = 0;
    for (const side of this.pressed.keys()) if (!inputs.some((input) => input.side === side)) this.pressed.delete(side);
    for (const input of inputs) {
      const before = this.pressed.get(input.side);
      const trigger = before?.trigger ? input.trigger > LET_GO : input.trigger >= PRESS;
      const isPress = before !== undefined && trigger && !before.trigger && input.tracked;
      if (isPress && !facts.busy.includes(input.side)) triggers.push(input.side);
      const squeeze = before?.squeeze ? input.squeeze > LET_GO : input.squeeze >= PRESS;
      if (before && squeeze && !before.squeeze && input.tracked && input.kind === "controller") squeezes.push(input.side);
      if (before) buttons |= input.buttons & ~before.buttons;
      const mayBegin = trigger && input.kind === "controller" && !this.isActive && !facts.busy.includes(input.side) && input.squeeze < LET_GO;
      const since_ms = mayBegin ? (isPress ? capture_ms : (before?.since_ms ?? null)) : null;
      const isHeld = since_ms !== null && capture_ms - since_ms >= BEGIN_MS;
      if (isHeld && this.anchor && facts.isReady) outcomes.push({ type: "restart" });
      this.pressed.set(input.side, { trigger, squeeze, buttons: input.buttons, since_ms: isHeld ? null : since_ms });
    }
    return { triggers, squeezes, buttons };
  }

  private step(reading: FrameReading, facts: Facts, { triggers, squeezes, buttons }: Presses, outcomes: Outcome[]): void {
    const { alignment } = facts;
    const now_ms = reading.capture_ms;
    const isNeeded = !isPlaced(alignment) || alignment?.kind === "persistent";
    if (this.stage.name === "off") {
      if (!isNeeded || !facts.isOffered || this.isDeclined) return;
      this.reset();
      this.wasAsked = false;
      this.stage = { name: "touch" };
    }
    if (this.isActive && buttons & BUTTON.upper) return this.leave(alignment, now_ms, outcomes);
    if (this.isActive && !this.wasAsked && alignment?.kind === "placed") this.stage = { name: "off" };
    const { stage } = this;
    switch (stage.name) {
      case "turn":
        return this.stepTurn(stage, reading, triggers, outcomes);
      case "rest":
        return this.stepRest(stage, reading, facts, outcomes);
      case "solve":
        if (now_ms - stage.since_ms > ANSWER_MS) [this.stage, this.advice] = [{ name: "tip" }, "The session did not answer: once more."];
        return;
      case "wait":
        return this.stepWait(stage.since_ms, now_ms, alignment, outcomes);
      case "done":
        if (now_ms - stage.since_ms > DONE_MS) this.stage = { name: "off" };
        return;
      case "tip":
      case "touch":
        if (this.isConfirming && alignment?.kind === "measured") return this.finish(alignment, now_ms, outcomes);
        if (buttons & BUTTON.lower) this.wantsTip = true;
        this.stage = { name: !this.wantsTip && this.canTouch(reading) ? "touch" : "tip" };
        for (const side of triggers) this.press(side, reading, false);
        if (isCompared(alignment)) for (const side of squeezes) this.press(side, reading, true);
    }
  }

  /** Return whether there is something to touch with: a hand, or a controller whose tip is known. */
  private canTouch({ inputs }: FrameReading): boolean {
    return inputs.some(({ kind, side }) => kind === "hand" || this.tips.has(`${kind}/${side}`));
  }

  private press(side: Side, reading: FrameReading, isCheck: boolean): void {
    const pressing = reading.inputs.find((input) => input.side === side)!;
    const device: wire.Device = `${pressing.kind}/${side}`;
    const since_ms = reading.capture_ms;
    if (this.stage.name === "tip") {
      if (pressing.kind !== "controller" || isCheck) return;
      this.advice = "";
      this.stage = { name: "turn", side, device, poses: [] };
      return;
    }
    if (this.stage.name !== "touch") return;
    const touching = pressing.kind === "hand" ? reading.inputs.find((input) => input.side !== side) : pressing;
    if (!touching || touching.kind !== pressing.kind || !touching.tracked || this.findTip(touching) === null) {
      this.advice = pressing.kind === "hand" ? "The finger of the other hand is not seen." : `The tip of the ${side} controller is not calibrated: A or X begins that.`;
      return;
    }
    this.stage = { name: "rest", pressing: side, touching: touching.side, device: `${touching.kind}/${touching.side}`, points: [], since_ms, isCheck };
  }

  private stepTurn(stage: Extract<Stage, { name: "turn" }>, reading: FrameReading, triggers: Side[], outcomes: Outcome[]): void {
    const { poses, device, side } = stage;
    const input = reading.inputs.find((one) => one.side === side && one.kind === "controller");
    if (input?.tracked && input.pose) {
      const [, q] = input.pose;
      if (poses.every((pose) => angleBetween(pose[1], q) >= TIP_STEP_RAD)) poses.push(input.pose);
    }
    const isEnough = poses.length >= TIP_POSES || (triggers.includes(side) && poses.length >= MIN_TIP_POSES);
    if (isEnough) {
      const observation = { anchor_id: "", kind: "tip", T_tracking_anchor: IDENTITY, device, grip_poses: poses, capture_ms: reading.capture_ms } as const;
      outcomes.push({ type: "observe", observation: { ...observation, grip_poses: [...poses] } }, { type: "pulse", side });
      this.wantsTip = false;
      this.stage = { name: "solve", device, since_ms: reading.capture_ms };
    } else if (triggers.includes(side)) {
      this.advice = "That was too little: go on turning until the bar is full.";
      this.stage = { name: "tip" };
    }
  }

  private stepRest(stage: Extract<Stage, { name: "rest" }>, reading: FrameReading, facts: Facts, outcomes: Outcome[]): void {
    const { points, device } = stage;
    const now_ms = reading.capture_ms;
    const touching = reading.inputs.find((input) => input.side === stage.touching && `${input.kind}/${input.side}` === device);
    const p = touching?.tracked ? this.findTip(touching) : null;
    const isHeld = this.pressed.get(stage.pressing)?.[stage.isCheck ? "squeeze" : "trigger"] ?? false;
    if (!touching || p === null || !isHeld) {
      this.advice = `Keep the ${stage.isCheck ? "squeeze" : "trigger"} pressed for a moment, and hold still.`;
      this.stage = { name: "touch" };
      return;
    }
    if (points[0] && distanceBetween(points[0], p) > STILL_M[touching.kind]) {
      this.stage = { ...stage, points: [p], since_ms: now_ms };
      return;
    }
    points.push(p);
    if (now_ms - stage.since_ms >= REST_MS) this.report(stage, touching, facts, now_ms, outcomes);
  }

  private report({ device, points, isCheck }: Extract<Stage, { name: "rest" }>, touching: InputReading, { alignment }: Facts, capture_ms: number, outcomes: Outcome[]): void {
    const sum = points.reduce((a, b) => [a[0] + b[0], a[1] + b[1], a[2] + b[2]]);
    const p: [number, number, number] = [sum[0] / points.length, sum[1] / points.length, sum[2] / points.length];
    const tip = this.tips.get(device);
    const T_tracking_anchor: wire.Pose = [p, [...(touching.pose?.[1] ?? IDENTITY[1])]];
    const covariance = tip ? makeTouchCovariance(tip) : [];
    outcomes.push({ type: "pulse", side: touching.side });
    if (isCheck) {
      outcomes.push({ type: "observe", observation: { anchor_id: POINT, kind: "point", device, T_tracking_anchor, covariance, capture_ms } });
      [this.stage, this.advice] = [{ name: "touch" }, "Touched. Now another one, within a minute."];
      return;
    }
    const { anchor } = this;
    const mark = this.queue.shift();
    if (!anchor || mark === undefined) return;
    this.isConfirming = this.touched.size === 0 ? alignment?.kind === "persistent" && tip !== undefined : this.isConfirming;
    if (this.touched.size === 0) this.version = alignment?.version;
    this.touched.set(mark, p);
    this.advice = "";
    outcomes.push({ type: "observe", observation: { anchor_id: anchor.anchor_id, kind: "touch", mark, device, T_tracking_anchor, covariance, capture_ms } });
    this.stage = this.queue.length > 0 ? { name: "touch" } : { name: "wait", since_ms: capture_ms };
  }

  private stepWait(since_ms: number, now_ms: number, alignment: Facts["alignment"], outcomes: Outcome[]): void {
    const isAligned = isPlaced(alignment) && alignment?.kind !== "persistent";
    if (isAligned && now_ms - since_ms >= REFUSAL_MS) this.finish(alignment, now_ms, outcomes);
    else if (now_ms - since_ms >= ANSWER_MS) {
      this.reset();
      [this.stage, this.advice] = [{ name: "touch" }, "The session did not answer: touch the marks once more."];
    }
  }

  private finish(alignment: Facts["alignment"], now_ms: number, outcomes: Outcome[]): void {
    const isMeasured = this.touched.size >= MIN_TOUCHES && alignment?.version !== this.version;
    if (this.anchor) outcomes.push({ type: "finish", anchor: this.anchor, isConfirmed: this.isConfirming && this.touched.size < MIN_TOUCHES, isMeasured });
    this.stage = { name: "done", since_ms: now_ms };
  }

  /** End before all is touched: what is aligned so far counts. */
  private leave(alignment: Facts["alignment"], now_ms: number, outcomes: Outcome[]): void {
    this.isDeclined = true;
    if (this.touched.size > 0 && isPlaced(alignment) && !isViewOnly(alignment)) this.finish(alignment, now_ms, outcomes);
    else this.stage = { name: "off" };
  }

  // --- marks ----------------------------------------------------------------------------------------------------------

  private listMarks(): string[] {
    return this.anchor?.marks.map(({ id }) => id) ?? [];
  }

  /** Return the position of a mark in the world. */
  private findMark(mark: string): [number, number, number] {
    const { anchor } = this;
    return anchor ? transform(anchor.T_world_anchor, anchor.marks.find(({ id }) => id === mark)?.p_anchor ?? [0, 0, 0]) : [0, 0, 0];
  }

  /** Return the point of a hand that touches, in the tracking frame; null: not known. */
  private findTip({ kind, side, pose, tip: fingertip }: InputReading): Vec3 | null {
    if (kind === "hand") return fingertip;
    const tip = this.tips.get(`controller/${side}`);
    return tip && pose ? transform(pose, tip.p) : null;
  }
}

/** Return whether an alignment states an error, with which it can be compared. */
function isCompared(alignment: Facts["alignment"]): boolean {
  return isPlaced(alignment) && alignment?.kind !== "placed";
}

/**
 * Return the covariance of a touch, 6x6 row-major. It includes that of the tip: a session that has forgotten the tip takes
 * the touch for what it is. One that knows it counts the tip twice, half a millimetre at most.
 */
function makeTouchCovariance({ covariance }: Tip): number[] {
  const variance = TOUCH_SIGMA_M ** 2 + (covariance[0] ?? 0) + (covariance[4] ?? 0) + (covariance[8] ?? 0);
  return Array.from({ length: 36 }, (_, i) => (i % 7 !== 0 ? 0 : i < 18 ? variance : TOUCH_SIGMA_RAD ** 2));
}

/** Return where a sheet lies in the tracking frame by an alignment. */
export function locateAnchor({ T_world_tracking }: Pick<wire.Alignment, "T_world_tracking">, { T_world_anchor }: AnchorPlace): wire.Pose {
  return compose(invert(T_world_tracking), T_world_anchor);
}
