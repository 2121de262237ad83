// What a headset says at one display frame, as plain numbers in the axes of the wire: the border between WebXR and the
// rest of this folder. Also what a bare hand means: pinch and fist as values of a trigger and a squeeze. Pure.

import { fromThree, toThree } from "../core/axes.ts";
import type * as wire from "../protocol/messages.g.ts";

export type Side = "left" | "right";
export type Vec3 = readonly [number, number, number];

/** A ray in some frame. `direction`: unit vector. */
export interface Ray {
  origin: Vec3;
  direction: Vec3;
}

/** A controller or a hand at one frame. Poses in the tracking frame. */
export interface InputReading {
  side: Side;
  kind: "controller" | "hand";
  /** `T_tracking_device`, the last known one of a device that is lost; null: never seen. */
  pose: wire.Pose | null;
  /** The pose is measured. */
  tracked: boolean;
  /** The position is the headset's estimate: cameras do not see the device. One that is lost is neither. */
  emulated: boolean;
  /** Where it points, null while that is unknown. */
  ray: Ray | null;
  /** 0 open to 1 closed. */
  trigger: number;
  squeeze: number;
  /** Bits of `Sample.buttons`. */
  buttons: number;
  /** Tip of the index finger of a bare hand that is tracked, else null. */
  tip: Vec3 | null;
  /** Poses of a bare hand's joints, as in `Sample.hand_joints`; none at most frames. */
  joints: readonly number[];
}

/** A headset at one frame. */
export interface FrameReading {
  /** Shared clock at the beginning of the frame's callback [ms]. */
  capture_ms: number;
  /** `T_tracking_head`, null: never seen. */
  head: wire.Pose | null;
  headTracked: boolean;
  headEmulated: boolean;
  inputs: InputReading[];
  /** Devices whose button of the e-stop is pressed, tracked or not. */
  stops: readonly object[];
}

/** Bits of `Sample.buttons` by their place in the WebXR gamepad mapping `xr-standard`. */
export const BUTTON = { trigger: 1, squeeze: 2, touchpad: 4, thumbstick: 8, lower: 16, upper: 32, rest: 64, menu: 128 } as const;
const BUTTON_COUNT = 8;
/** Buttons of the e-stop: controllers without a thumbstick have a pad. */
export const STOP_BUTTONS = BUTTON.thumbstick | BUTTON.touchpad;

/** Distances between the tips of thumb and index finger of a closed and of an open pinch [m]. */
const PINCH_M = [0.015, 0.045] as const;
/** The same for a fist: from the wrist to the tip of the middle finger, in lengths from the wrist to its knuckle. */
const FIST = [1.0, 1.4] as const;

/** Return the pose of the wire for a transform of WebXR. */
export function toPose(position: DOMPointReadOnly, orientation: DOMPointReadOnly): wire.Pose {
  const row = [0, 0, 0, 0, 0, 0, 0];
  fromThree([position.x, position.y, position.z, orientation.x, orientation.y, orientation.z, orientation.w], row);
  return [row.slice(0, 3) as [number, number, number], row.slice(3) as [number, number, number, number]];
}

/** Return `x y z qx qy qz qw` in the axes of three.js for a pose of the wire. */
export function toRow([p, q]: wire.Pose): number[] {
  const row = [0, 0, 0, 0, 0, 0, 0];
  toThree([...p, ...q], row);
  return row;
}

/** Return the ray along the forward axis of a pose: x, in the axes of the wire. */
export function toRay([p, q]: wire.Pose): Ray {
  return { origin: p, direction: rotate(q, [1, 0, 0]) };
}

/** Return `v` rotated by the unit quaternion `[w, x, y, z]`. */
export function rotate([w, x, y, z]: readonly [number, number, number, number], v: Vec3): Vec3 {
  const tx = 2 * (y * v[2] - z * v[1]);
  const ty = 2 * (z * v[0] - x * v[2]);
  const tz = 2 * (x * v[1] - y * v[0]);
  return [v[0] + w * tx + y * tz - z * ty, v[1] + w * ty + z * tx - x * tz, v[2] + w * tz + x * ty - y * tx];
}

/** Return a ray of the tracking frame in the world. */
export function toWorldRay([p, q]: wire.Pose, { origin, direction }: Ray): Ray {
  const at = rotate(q, origin);
  return { origin: [p[0] + at[0], p[1] + at[1], p[2] + at[2]], direction: rotate(q, direction) };
}

/** Return the bits of pressed buttons. */
export function packButtons(pressed: readonly boolean[]): number {
  return pressed.slice(0, BUTTON_COUNT).reduce((bits, isPressed, i) => bits | (isPressed ? 1 << i : 0), 0);
}

/** Return trigger and squeeze of a hand: how far it pinches, and how far it is a fist. Positions in any one frame [m]. */
export function readGesture(joints: { thumb: Vec3; index: Vec3; middle: Vec3; knuckle: Vec3; wrist: Vec3 }): { trigger: number; squeeze: number } {
  const palm = distance(joints.wrist, joints.knuckle);
  return {
    trigger: closedness(distance(joints.thumb, joints.index), PINCH_M),
    squeeze: palm > 0 ? closedness(distance(joints.wrist, joints.middle) / palm, FIST) : 0,
  };
}

function closedness(value: number, [closed, open]: readonly [number, number]): number {
  return Math.min(1, Math.max(0, (open - value) / (open - closed)));
}

function distance(a: Vec3, b: Vec3): number {
  return Math.hypot(a[0] - b[0], a[1] - b[1], a[2] - b[2]);
}
