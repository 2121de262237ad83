// The e-stop of bare hands: a ball above the left wrist that the index finger of the right hand touches. Pure.

import { type FrameReading, type InputReading, rotate, type Vec3 } from "./reading.ts";

/** Centre of the ball in the frame of the wrist: above the back of the hand, toward the elbow [m]; and its radius [m]. */
const OFFSET_M: Vec3 = [-0.04, 0, 0.08];
export const STOP_RADIUS_M = 0.035;
/** The index finger is stretched when its tip is this far from the wrist [m]: 15 to 19 cm are usual, 8 to 10 in a fist, which drives. */
const STRETCHED_M = 0.12;
/** A touch counts when it has lasted this long [ms]: longer than one wrong reading, shorter than a finger on its way through. */
const TOUCH_MS = 40;
/** The ball stays where it was for this long when the wrist is lost [ms]: the other hand comes between it and the cameras. */
const KEEP_MS = 700;

/** Finds the touch that stops. */
export class WristStop {
  /** Where the ball is in the tracking frame, null: there is none. */
  center: Vec3 | null = null;
  private seen_ms = Number.NEGATIVE_INFINITY;
  /** Since when the finger is in the ball [ms], null: it is not. */
  private since_ms: number | null = null;
  /** The finger was outside since the ball has appeared, and since the last stop. */
  private isArmed = false;

  /** Take a frame. Returns whether it stops. */
  update({ inputs, capture_ms }: FrameReading): boolean {
    const find = (side: InputReading["side"]): InputReading | undefined => inputs.find((input) => input.side === side && input.kind === "hand");
    this.moveBall(find("left"), capture_ms);
    const right = find("right");
    if (this.center === null) this.isArmed = false;
    if (this.center === null || !right?.tip || !right.pose) {
      this.since_ms = null;
      return false;
    }
    const isInside = distance(this.center, right.tip) <= STOP_RADIUS_M;
    const isStretched = distance(right.tip, right.pose[0]) >= STRETCHED_M;
    if (!isInside) this.isArmed = true;
    if (!isInside || !isStretched) this.since_ms = null;
    else this.since_ms ??= capture_ms;
    if (!this.isArmed || this.since_ms === null || capture_ms - this.since_ms < TOUCH_MS) return false;
    this.isArmed = false;
    return true;
  }

  /** Input does not reach the scene now: a finger that is in the ball when it does again stops nothing. */
  suspend(): void {
    [this.center, this.since_ms, this.isArmed] = [null, null, false];
    this.seen_ms = Number.NEGATIVE_INFINITY;
  }

  private moveBall(left: InputReading | undefined, now_ms: number): void {
    if (left?.tracked && left.pose) {
      const [p, q] = left.pose;
      this.center = rotate(q, OFFSET_M).map((value, i) => value + p[i]!) as unknown as Vec3;
      this.seen_ms = now_ms;
    } else if (now_ms - this.seen_ms > KEEP_MS) {
      this.center = null;
    }
  }
}

function distance(a: Vec3, b: Vec3): number {
  return Math.hypot(a[0] - b[0], a[1] - b[1], a[2] - b[2]);
}
