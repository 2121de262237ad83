// Where the scene appears before a headset is aligned, in immersive VR: nothing of the room is seen there. Pure.

import type { SceneSpec } from "../core/api.ts";
import type * as wire from "../protocol/messages.g.ts";

/** Height of the scene's centre above the floor [m], and the least distance of a person from it [m]. */
const HEIGHT_M = 1.0;
const MIN_DISTANCE_M = 0.9;
/** Distance from the centre in extents of the scene. */
const EXTENTS = 0.7;

/**
 * Return `T_world_tracking` with the scene before a person who looks along `forward` (in the world).
 *
 * The tracking frame has its origin on the floor below the person, as `local-floor` of WebXR.
 */
export function placeBeforeScene({ center, extent }: SceneSpec["environment"], forward: readonly [number, number, number]): wire.Pose {
  const yaw = Math.atan2(forward[1], forward[0]);
  const distance = Math.max(MIN_DISTANCE_M, EXTENTS * extent);
  return [
    [center[0] - distance * Math.cos(yaw), center[1] - distance * Math.sin(yaw), center[2] - HEIGHT_M],
    [Math.cos(yaw / 2), 0, 0, Math.sin(yaw / 2)],
  ];
}
