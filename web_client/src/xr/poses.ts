// Arithmetic of poses `[p, q]` of the wire, q = `[w, x, y, z]`, and of covariances in their axes. Pure.

import type * as wire from "../protocol/messages.g.ts";
import { rotate, type Vec3 } from "./reading.ts";

export type Quat = readonly [number, number, number, number];

export const IDENTITY: wire.Pose = [
  [0, 0, 0],
  [1, 0, 0, 0],
];

/** Return the product of two rotations. */
export function multiply([aw, ax, ay, az]: Quat, [bw, bx, by, bz]: Quat): [number, number, number, number] {
  return [aw * bw - ax * bx - ay * by - az * bz, aw * bx + ax * bw + ay * bz - az * by, aw * by - ax * bz + ay * bw + az * bx, aw * bz + ax * by - ay * bx + az * bw];
}

/** Return a point of the frame B in the frame A. */
export function transform([p, q]: wire.Pose, point: Vec3): [number, number, number] {
  const turned = rotate(q, point);
  return [p[0] + turned[0], p[1] + turned[1], p[2] + turned[2]];
}

/** Return `T_A_C` of `T_A_B` and `T_B_C`. */
export function compose(T_A_B: wire.Pose, T_B_C: wire.Pose): wire.Pose {
  return [transform(T_A_B, T_B_C[0]), multiply(T_A_B[1], T_B_C[1])];
}

/** Return `T_B_A` of `T_A_B`. */
export function invert([p, [w, x, y, z]]: wire.Pose): wire.Pose {
  const back = rotate([w, -x, -y, -z], p);
  return [
    [-back[0], -back[1], -back[2]],
    [w, -x, -y, -z],
  ];
}

/** Return the angle between two rotations [rad]. */
export function angleBetween(a: Quat, b: Quat): number {
  return 2 * Math.acos(Math.min(1, Math.abs(a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3])));
}

export function distanceBetween(a: Vec3, b: Vec3): number {
  return Math.hypot(a[0] - b[0], a[1] - b[1], a[2] - b[2]);
}

/**
 * Return the covariance of an alignment at an anchor, in its axes, empty where it is not known: what is kept with a
 * persistent anchor (docs/protocol.md, section 5; `covariance_at_anchor` in `anchors/persistent.py`).
 */
export function covarianceAtAnchor(alignment: { covariance: readonly number[]; pivot_world: Vec3 }, [p, [w, x, y, z]]: wire.Pose): number[] {
  const { covariance, pivot_world } = alignment;
  if (covariance.length !== 36) return [];
  // A small rotation v about the pivot moves the anchor by v x r; both are turned into its axes.
  const back: Quat = [w, -x, -y, -z];
  const r: Vec3 = [p[0] - pivot_world[0], p[1] - pivot_world[1], p[2] - pivot_world[2]];
  const units: Vec3[] = [[1, 0, 0], [0, 1, 0], [0, 0, 1]];
  const columns = [
    ...units.map((unit) => [...rotate(back, unit), 0, 0, 0]),
    ...units.map((unit) => [...rotate(back, cross(unit, r)), ...rotate(back, unit)]),
  ];
  const indices = [0, 1, 2, 3, 4, 5];
  const half = indices.map((i) => indices.map((j) => indices.reduce((sum, k) => sum + columns[k]![i]! * covariance[6 * k + j]!, 0)));
  return indices.flatMap((i) => indices.map((j) => indices.reduce((sum, k) => sum + half[i]![k]! * columns[k]![j]!, 0)));
}

function cross([ax, ay, az]: Vec3, [bx, by, bz]: Vec3): Vec3 {
  return [ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx];
}

/**
 * Return `T_to_from` of two frames that are both level, by points known in both: a turn about the vertical and a shift.
 * Null for points that do not determine the turn.
 */
export function fitLevel(pairs: readonly { from: Vec3; to: Vec3 }[]): wire.Pose | null {
  const mean = (select: (pair: { from: Vec3; to: Vec3 }) => Vec3): Vec3 => {
    const sum = pairs.map(select).reduce((a, b) => [a[0] + b[0], a[1] + b[1], a[2] + b[2]], [0, 0, 0]);
    return [sum[0] / pairs.length, sum[1] / pairs.length, sum[2] / pairs.length];
  };
  const [from, to] = [mean((pair) => pair.from), mean((pair) => pair.to)];
  let [sine, cosine] = [0, 0];
  for (const pair of pairs) {
    const [ax, ay, bx, by] = [pair.from[0] - from[0], pair.from[1] - from[1], pair.to[0] - to[0], pair.to[1] - to[1]];
    sine += ax * by - ay * bx;
    cosine += ax * bx + ay * by;
  }
  if (Math.hypot(sine, cosine) < MIN_SPREAD_M ** 2) return null;
  const yaw = Math.atan2(sine, cosine);
  const q: [number, number, number, number] = [Math.cos(yaw / 2), 0, 0, Math.sin(yaw / 2)];
  const turned = rotate(q, from);
  return [[to[0] - turned[0], to[1] - turned[1], to[2] - turned[2]], q];
}

/** Points nearer together than this do not tell a turn [m]. */
const MIN_SPREAD_M = 0.05;
