// What of the scene is inside the picture of a camera, of whose gripper a camera takes notice, and what the free camera
// shows of all that is drawn. Pure.

import { type Box3, Sphere, Vector3 } from "three";

/** A lens: vertical field of view [deg], or the height of what an orthographic camera sees [m]. */
export interface Lens {
  fovy: number;
  orthographic: boolean;
  /** Size of its pictures [pixels], 1 x 1 where the scene does not say. */
  resolution: readonly [number, number];
}

/** Width / height of pictures without a stated size. */
const DEFAULT_ASPECT = 4 / 3;
/** A scene of one small part is seen from no nearer. */
const LEAST_EXTENT_M = 0.2;
/** Radius that is shown, as a share of the extent: MuJoCo's viewer is at first two extents away, at 45 degrees. */
export const SHOWN_SHARE = 2 * Math.sin(Math.PI / 8);

/** Return width / height of the pictures of a camera. */
export function aspectOf({ resolution: [width, height] }: Pick<Lens, "resolution">): number {
  return width > 1 && height > 1 ? width / height : DEFAULT_ASPECT;
}

/**
 * Return whether a point is inside the picture, at least `margin` from its edge.
 *
 * `p_camera`: in the frame of the camera, which looks along -z, y up [m]. `margin`: share of half the picture's height
 * and width. Points behind the camera, and such that are not finite, are outside.
 */
export function isInPicture(p_camera: readonly [number, number, number], lens: Lens, margin: number): boolean {
  const [x, y, z] = p_camera;
  const depth = -z;
  const halfHeight = lens.orthographic ? lens.fovy / 2 : depth * Math.tan((lens.fovy * Math.PI) / 360);
  const reach = halfHeight * (1 - margin);
  return depth > 0 && Math.abs(y) <= reach && Math.abs(x) <= reach * aspectOf(lens);
}

/**
 * Return the ball that a picture of the whole scene shows, by the `center` and `extent` of the scene [m], and what is
 * drawn beside it. `beside`: box in the session's world; where it is empty or inside, the ball is that of the scene.
 */
export function findBall(environment: { center: readonly [number, number, number]; extent: number }, beside: Box3): Sphere {
  const extent = Math.max(environment.extent, LEAST_EXTENT_M);
  const ball = new Sphere(new Vector3(...environment.center), SHOWN_SHARE * extent);
  return beside.isEmpty() ? ball : ball.union(beside.getBoundingSphere(new Sphere()));
}

/**
 * Return those of `robots` whose grippers a camera has to see: a camera that a robot carries is about that robot only.
 *
 * `parents`: parent of each body by id, -1 for none.
 */
export function listWatched<T extends { base_body: number }>(
  cameraBody: number,
  robots: readonly T[],
  parents: ReadonlyMap<number, number>,
): T[] {
  const above = new Set<number>();
  for (let body = cameraBody; body > 0 && !above.has(body); body = parents.get(body) ?? -1) above.add(body);
  const carriers = robots.filter((robot) => above.has(robot.base_body));
  return carriers.length > 0 ? carriers : [...robots];
}
