// Where pictures of real cameras and the menu of them stand about a person, and which row of the menu a ray points at: at
// the sides, so that the robots before the person stay free. All in the tracking frame. Pure.

import type * as wire from "../protocol/messages.g.ts";
import { type Ray, rotate, type Vec3 } from "./reading.ts";

/** Distance from the eyes, which the places keep while the person moves less than the second [m]. */
const DISTANCE_M = 1;
const MAX_MOVE_M = 0.8;
/** A person who turns farther than this has them at the new sides [rad]: more than to look at any of them. */
const MAX_TURN = 1.4;
/** Forward is known while it has so much of a horizontal part: not while the eyes look straight down. */
const MIN_HORIZONTAL = 0.3;
/** Places of panels: angle from straight ahead, to the left [rad], and height of their middle above the eyes [m]. */
const PANELS = [[-0.63, 0.22], [-0.63, -0.24], [-1.08, 0.22], [-1.08, -0.24]] as const;
/** Largest width and height of a picture [m]: 24 degrees. */
const WIDTH_M = 0.42;
const HEIGHT_M = 0.32;
/** The menu: angle, width, height of a row, and of the middle of the first one above the eyes. */
const MENU = 0.63;
const MENU_WIDTH_M = 0.4;
const ROW_M = 0.05;
const FIRST_M = 0.25;

/** What the menu offers: to open or close itself, and to open or close the panel of a stream. */
export type MenuItem = "menu" | `picture ${string}`;

/** A person as the places know it: where the eyes were, and the direction of straight ahead from the x axis [rad]. */
export interface Stand {
  eyes: Vec3;
  heading: number;
}

/** Return where the person stands: as before, unless it has turned or moved too far from there. Null: not known. */
export function followHead([eyes, q]: wire.Pose, before: Stand | null): Stand | null {
  const [x, y] = rotate(q, [1, 0, 0]);
  if (Math.hypot(x, y) < MIN_HORIZONTAL) return before;
  const heading = Math.atan2(y, x);
  if (before === null) return { eyes, heading };
  const turn = Math.abs(Math.atan2(Math.sin(heading - before.heading), Math.cos(heading - before.heading)));
  const move = Math.hypot(eyes[0] - before.eyes[0], eyes[1] - before.eyes[1], eyes[2] - before.eyes[2]);
  return turn <= MAX_TURN && move <= MAX_MOVE_M ? before : { eyes, heading };
}

/** Return the pose of the middle of a panel: x away from the person, z up. `slot`: 0 to 3. */
export function placePanel({ eyes, heading }: Stand, slot: number): wire.Pose {
  const [angle, up] = PANELS[slot % PANELS.length]!;
  const yaw = heading + angle;
  return [[...locate(eyes, yaw, 0, up)], [Math.cos(yaw / 2), 0, 0, Math.sin(yaw / 2)]];
}

/** Return width and height of a picture [m]. `aspect`: width / height. */
export function fitPicture(aspect: number): [width: number, height: number] {
  const width = Math.min(WIDTH_M, HEIGHT_M * aspect);
  return [width, width / aspect];
}

/** Return where the left end of a row of the menu is. */
export function placeRow({ eyes, heading }: Stand, row: number): Vec3 {
  return locate(eyes, heading + MENU, MENU_WIDTH_M / 2, FIRST_M - row * ROW_M);
}

/** Return the row of a menu of `count` rows that a ray points at and how far away it is [m], null for none. */
export function findRow({ origin, direction }: Ray, { eyes, heading }: Stand, count: number): { row: number; distance: number } | null {
  const [cos, sin] = [Math.cos(heading + MENU), Math.sin(heading + MENU)];
  const toward = direction[0] * cos + direction[1] * sin;
  const away = DISTANCE_M - (origin[0] - eyes[0]) * cos - (origin[1] - eyes[1]) * sin;
  const distance = away / toward;
  if (!(toward > 0 && distance > 0)) return null;
  const [x, y, z] = origin.map((value, i) => value + distance * direction[i]! - eyes[i]!) as [number, number, number];
  const row = Math.round((FIRST_M - z) / ROW_M);
  return Math.abs(y * cos - x * sin) <= MENU_WIDTH_M / 2 && row >= 0 && row < count ? { row, distance } : null;
}

/** Return a point about the eyes: ahead in direction `yaw` [rad], then to the left and up [m]. */
function locate(eyes: Vec3, yaw: number, left: number, up: number): Vec3 {
  const [cos, sin] = [Math.cos(yaw), Math.sin(yaw)];
  return [eyes[0] + DISTANCE_M * cos - left * sin, eyes[1] + DISTANCE_M * sin + left * cos, eyes[2] + up];
}
