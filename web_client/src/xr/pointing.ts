// Which robot a ray points at. A robot is the chain of its links from the base to the end effector, as thick as an arm;
// tests against meshes would take longer than a display frame. Pure.

import type { RobotInfo, SceneSpec } from "../core/api.ts";
import type { Ray, Vec3 } from "./reading.ts";

/** Distance from the axis of a link that counts as hit [m], and what is added per metre away [m]. */
const RADIUS_M = 0.08;
const SPREAD = 0.03;
const REACH_M = 8;

/** Bodies of a robot from its end effector to its base, by id. */
export type Chain = readonly number[];

export interface Hit {
  robot: string;
  /** Along the ray [m]. */
  distance: number;
}

/** Return the chains of robots, by name. */
export function listChains(robots: readonly RobotInfo[], bodies: SceneSpec["bodies"]): Map<string, Chain> {
  const parents = new Map(bodies.map(({ id, parent }) => [id, parent]));
  const chains = new Map<string, Chain>();
  for (const { name, site_body, base_body } of robots) {
    const chain = [site_body];
    while (chain.at(-1) !== base_body && chain.length <= bodies.length) {
      const parent = parents.get(chain.at(-1)!);
      if (!parent) break; // the world, or unknown: no link of the robot
      chain.push(parent);
    }
    chains.set(name, chain);
  }
  return chains;
}

/** Return the robot that a ray comes nearest to, null when it passes all of them. All in one frame. */
export function findPointed(ray: Ray, chains: ReadonlyMap<string, Chain>, positionOf: (body: number) => Vec3 | null): Hit | null {
  let best: (Hit & { offset: number }) | null = null;
  for (const [robot, chain] of chains) {
    const points = chain.map(positionOf).filter((point) => point !== null);
    for (let i = 0; i < points.length; i++) {
      const found = measure(ray, points[i]!, points[Math.min(i + 1, points.length - 1)]!);
      if (found.distance > REACH_M || found.offset > RADIUS_M + SPREAD * found.distance) continue;
      if (best === null || found.offset < best.offset) best = { robot, ...found };
    }
  }
  return best && { robot: best.robot, distance: best.distance };
}

/** Return how far along a ray it is nearest to the segment from `a` to `b`, and how far from it there. */
function measure({ origin, direction }: Ray, a: Vec3, b: Vec3): { distance: number; offset: number } {
  const link = subtract(b, a);
  const toStart = subtract(a, origin);
  const square = dot(link, link);
  const along = dot(link, direction);
  const start = dot(toStart, direction);
  const denominator = square - along * along;
  // Nearest points of two lines, with that of the link kept on it.
  const share = denominator > 1e-12 ? (along * start - dot(link, toStart)) / denominator : 0;
  const u = Math.min(1, Math.max(0, share));
  const point: Vec3 = [toStart[0] + u * link[0], toStart[1] + u * link[1], toStart[2] + u * link[2]];
  const distance = Math.max(0, dot(point, direction));
  const off: Vec3 = [point[0] - distance * direction[0], point[1] - distance * direction[1], point[2] - distance * direction[2]];
  return { distance, offset: Math.hypot(...off) };
}

function subtract(a: Vec3, b: Vec3): Vec3 {
  return [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
}

function dot(a: Vec3, b: Vec3): number {
  return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}
