// Axes. Everything in the world hangs below one root, whose matrix turns Z up into three.js's Y up (protocol.md,
// section 11): three = (-y, z, -x). Inside the root positions and quaternions are those of the wire.

import { Group, Matrix4, type Object3D } from "three";

import type { Pose } from "./spec.ts";

/** Matrix from the world of the session to that of three.js. */
export const T_THREE_WORLD = new Matrix4().set(0, -1, 0, 0, 0, 0, 1, 0, -1, 0, 0, 0, 0, 0, 0, 1);

/** Return a group in whose frame coordinates are those of the session's world. */
export function makeWorldRoot(): Group {
  const root = new Group();
  root.name = "world";
  root.matrixAutoUpdate = false;
  root.matrix.copy(T_THREE_WORLD);
  root.matrixWorldNeedsUpdate = true;
  return root;
}

/** Place an object at a pose of the wire, `[w, x, y, z]`. */
export function setPose(object: Object3D, pose: Pose): void {
  const [[x, y, z], [qw, qx, qy, qz]] = pose;
  object.position.set(x, y, z);
  object.quaternion.set(qx, qy, qz, qw).normalize();
}
