// Interpolation on the shared clock: what is drawn lies between two received frames, a delay behind session time. Pure.

import { MAX_KEPT_FRAMES } from "../core/api.ts";

/** Rows of a pose: x y z qw qx qy qz. */
export const POSE_FLOATS = 7;
const MIN_DELAY_MS = 10;
const MAX_DELAY_MS = 300;
/** The delay shrinks by at most this much per second [ms]: motion looks 2 % slower for a while, not jerky. */
const SHRINK_MS_PER_S = 20;
/** Frames whose ages are looked at: those of two seconds. */
const KEPT_AGES = 120;

/** A received frame of numbers at a session time. */
export interface TimedFrame {
  session_ms: number;
  values: Float32Array;
}

/** Two frames, and the share of the later one. */
export interface Between<T> {
  before: T;
  after: T;
  share: number;
}

/** The newest frames of one stream, oldest first. */
export class FrameBuffer<T extends TimedFrame = TimedFrame> {
  private frames: T[] = [];

  /** `onRelease` gets frames that are not needed any more. */
  constructor(private readonly onRelease: (frame: T) => void = () => undefined) {}

  get newest(): T | undefined {
    return this.frames.at(-1);
  }

  /** Add a frame. One of another length, or from before the newest, replaces all. */
  push(frame: T): void {
    const { newest } = this;
    if (newest && (newest.values.length !== frame.values.length || frame.session_ms < newest.session_ms)) this.clear();
    else if (newest && frame.session_ms === newest.session_ms) this.release(this.frames.pop()!);
    this.frames.push(frame);
    while (this.frames.length > MAX_KEPT_FRAMES) this.release(this.frames.shift()!);
  }

  clear(): void {
    for (const frame of this.frames) this.release(frame);
    this.frames = [];
  }

  /**
   * Return the two frames around a session time and the share of the later one; frames before them are released. Before
   * the first frame it is the first alone, after the last one the last alone.
   */
  around(session_ms: number): Between<T> | null {
    while (this.frames.length >= 2 && this.frames[1]!.session_ms <= session_ms) this.release(this.frames.shift()!);
    const [before, after] = [this.frames[0], this.frames[1]];
    if (!before) return null;
    if (!after || session_ms <= before.session_ms) return { before, after: before, share: 0 };
    return { before, after, share: (session_ms - before.session_ms) / (after.session_ms - before.session_ms) };
  }

  private release(frame: T): void {
    this.onRelease(frame);
  }
}

/** Write poses between `a` and `b` to `out`: positions straight, quaternions the short way. */
export function interpolatePoses(a: Float32Array, b: Float32Array, share: number, out: Float32Array): void {
  const rest = 1 - share;
  for (let i = 0; i < out.length; i += POSE_FLOATS) {
    for (let k = 0; k < 3; k++) out[i + k] = rest * a[i + k]! + share * b[i + k]!;
    const dot = a[i + 3]! * b[i + 3]! + a[i + 4]! * b[i + 4]! + a[i + 5]! * b[i + 5]! + a[i + 6]! * b[i + 6]!;
    const toward = dot < 0 ? -share : share;
    let square = 0;
    for (let k = 3; k < POSE_FLOATS; k++) {
      const value = rest * a[i + k]! + toward * b[i + k]!;
      out[i + k] = value;
      square += value * value;
    }
    const length = Math.sqrt(square) || 1;
    for (let k = 3; k < POSE_FLOATS; k++) out[i + k]! /= length;
  }
}

/** Write values between `a` and `b` to `out`. Returns whether one has changed. */
export function interpolateValues(a: Float32Array, b: Float32Array, share: number, out: Float32Array): boolean {
  let isChanged = false;
  for (let i = 0; i < out.length; i++) {
    const value = Math.fround(a[i]! + share * (b[i]! - a[i]!));
    if (value === out[i]) continue;
    out[i] = value;
    isChanged = true;
  }
  return isChanged;
}

/** The delay behind session time at which frames are shown: so long that the next frame is usually there. */
export class DelayEstimator {
  private delay = 50;
  /** The newest ages, and the same in order: a frame comes 60 times a second, so nothing is allocated. */
  private readonly ages = new Float64Array(KEPT_AGES);
  private readonly sorted = new Float64Array(KEPT_AGES);
  private count = 0;
  private lastUpdate = 0;

  /** Note the age of a frame on arrival [ms], and the time between frames [ms]. */
  add(age_ms: number, period_ms: number, now_ms: number): void {
    if (!Number.isFinite(age_ms)) return;
    this.ages[this.count % KEPT_AGES] = age_ms;
    this.count += 1;
    const kept = Math.min(this.count, KEPT_AGES);
    this.sorted.fill(Number.POSITIVE_INFINITY); // what is not known yet is behind the rest
    this.sorted.set(kept < KEPT_AGES ? this.ages.subarray(0, kept) : this.ages);
    this.sorted.sort();
    const wanted = this.sorted[Math.floor(0.95 * (kept - 1))]! + 1.2 * period_ms;
    const target = Math.min(MAX_DELAY_MS, Math.max(MIN_DELAY_MS, wanted));
    const elapsed = this.lastUpdate ? Math.max(0, now_ms - this.lastUpdate) : 0;
    this.lastUpdate = now_ms;
    this.delay = Math.max(target, this.delay - (SHRINK_MS_PER_S * elapsed) / 1000);
  }

  get delay_ms(): number {
    return this.delay;
  }
}
