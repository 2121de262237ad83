// A question before the eyes and its two answers: where they are, and which one a ray points at. All in the tracking
// frame. Pure.

import type * as wire from "../protocol/messages.g.ts";
import { type Ray, rotate, type Vec3 } from "./reading.ts";

/** Distance from the eyes [m], and angle above the middle of the view [rad]: robots that are looked at stay free. */
const DISTANCE_M = 0.8;
const ABOVE = 0.26;
/** A question that is farther than this from where it appeared in the view comes back before the eyes [rad]. */
const MAX_OFF = 0.7;
/** Answers: this far below the lower edge of the question and beside its middle; as large as a ball of this radius [m]. */
const BELOW_M = 0.06;
const BESIDE_M = 0.11;
const RADIUS_M = 0.055;

export type Answer = "grant" | "refuse";
export const ANSWERS: readonly Answer[] = ["grant", "refuse"];

export interface QuestionPlace {
  at: Vec3;
  answers: Record<Answer, Vec3>;
}

/** Return the direction in which a question appears to a head. */
function findDirection([, q]: wire.Pose): Vec3 {
  return rotate(q, [Math.cos(ABOVE), 0, Math.sin(ABOVE)]);
}

/** Return where a question appears to a head: it stays there in the room. */
export function placeQuestion(head: wire.Pose): QuestionPlace {
  const [p, q] = head;
  const direction = findDirection(head);
  const side = rotate(q, [0, 1, 0]);
  const up = rotate(q, [-Math.sin(ABOVE), 0, Math.cos(ABOVE)]);
  const move = (left: number, down: number): Vec3 =>
    [0, 1, 2].map((i) => p[i]! + DISTANCE_M * direction[i]! + left * side[i]! - down * up[i]!) as unknown as Vec3;
  return { at: move(0, 0), answers: { grant: move(BESIDE_M, BELOW_M), refuse: move(-BESIDE_M, BELOW_M) } };
}

/** Return whether a question is still about where it appeared in the view. */
export function isBeforeEyes(head: wire.Pose, { at }: QuestionPlace): boolean {
  const [p] = head;
  const offset: Vec3 = [at[0] - p[0], at[1] - p[1], at[2] - p[2]];
  const direction = findDirection(head);
  const along = offset[0] * direction[0] + offset[1] * direction[1] + offset[2] * direction[2];
  return along > Math.cos(MAX_OFF) * Math.hypot(...offset);
}

/** Return the answer that a ray points at and how far away it is [m], null for none. */
export function findAnswer({ origin, direction }: Ray, answers: QuestionPlace["answers"]): { answer: Answer; distance: number } | null {
  for (const answer of ANSWERS) {
    const offset = answers[answer].map((value, i) => value - origin[i]!) as unknown as Vec3;
    const distance = offset[0] * direction[0] + offset[1] * direction[1] + offset[2] * direction[2];
    const beside = Math.hypot(...offset.map((value, i) => value - distance * direction[i]!));
    if (distance > 0 && beside <= RADIUS_M) return { answer, distance };
  }
  return null;
}
