// What of the scene is inside the picture of a camera, of whose gripper a camera takes notice, and what the free camera
// shows of all that is drawn. Pure.

import { Box3, Matrix4, type Object3D, Quaternion, Ray, Vector3 } from "three";

import type { SceneSpec, Visual } from "./spec.ts";

/** A lens: vertical field of view [deg], or the height of what an orthographic camera sees [m]. */
export interface Lens {
  fovy: number;
  orthographic: boolean;
  /** Size of its pictures [pixels], 1 x 1 where the scene does not say. */
  resolution: readonly [number, number];
}

/** Width / height of pictures without a stated size. */
const DEFAULT_ASPECT = 4 / 3;
/** Edge of what is shown of a scene in which nothing is drawn [m], at least. */
const LEAST_EXTENT_M = 0.2;
/** Azimuths of the first view [deg], the usual one first, and its elevation. */
const AZIMUTHS = [145, 215, 90, 35, 325, 270, 180, 0] as const;
export const FIRST_AZIMUTH = AZIMUTHS[0];
export const FIRST_ELEVATION = -22;
/** Share of a robot that may be behind something in the first view. */
const HIDDEN_SHARE = 0.25;
/** What is shown around robots, as a share of their diagonal. */
const AROUND_ROBOTS = 0.1;
/** How much larger a scene is that is not shown as a whole: than its robots, which are to be large enough to be driven, or than what it says. */
const [MORE_THAN_ROBOTS, MORE_THAN_IT_SAYS] = [1.05, 1.8];
/** How far bodies may be from where the scene began to count, in its diagonals. */
const MAX_DRIFT = 2;
/** Share of half the picture that is filled. */
const FILLED_SHARE = 0.85;

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

/** Where parts of a scene are: those of `SceneView`. Bodies that are not visible have diverged. */
export interface Placed {
  readonly spec: SceneSpec;
  readonly bodies: ReadonlyMap<number, Object3D>;
  readonly rest: ReadonlyMap<number, Matrix4>;
}

/** What a picture shows, in the session's world. */
export interface Sight {
  box: Box3;
  /** Azimuth of the view [deg], as MuJoCo's. */
  azimuth: number;
}

const matrix = new Matrix4();
const corner = new Vector3();

/**
 * Return the box around everything that is drawn, without planes, and what is drawn `beside` it. Bodies that have gone
 * far from where the scene began, because they fall or fly, are left out.
 */
export function findWholeBox(scene: Placed, beside: Box3): Box3 {
  const { spec } = scene;
  const begin = unionOf(spec.visuals.map((visual) => boxAtRest(scene, visual)));
  if (begin.isEmpty() || spec.deformables.length > 0) begin.union(boxOfEnvironment(spec.environment));
  const center = begin.getCenter(new Vector3());
  const reach = MAX_DRIFT * begin.getSize(corner).length();
  const near = spec.visuals.filter(({ body }) => {
    const object = scene.bodies.get(body);
    return object?.visible && object.position.distanceTo(center) <= reach;
  });
  const now = unionOf(near.map((visual) => boxNow(scene, visual)));
  if (now.isEmpty() || spec.deformables.length > 0) now.union(boxOfEnvironment(spec.environment));
  return now.union(beside);
}

/**
 * Return what the first picture of a scene shows: its robots with what is around them, without any what the scene says
 * (`environment`), or all of it where that is hardly more. `bases`: bodies at the feet of the robots, by id.
 */
export function findFirstSight(scene: Placed, bases: readonly number[], beside: Box3): Sight {
  const whole = findWholeBox(scene, beside);
  const links = listDescendants(scene.spec, bases);
  const robots = scene.spec.visuals.filter((visual) => links.has(visual.body) && isSolid(scene.spec, visual));
  const focus = unionOf(robots.map((visual) => boxNow(scene, visual)));
  const size = new Vector3();
  const hasRobots = !focus.isEmpty();
  const more = hasRobots ? MORE_THAN_ROBOTS : MORE_THAN_IT_SAYS;
  if (hasRobots) focus.expandByScalar(AROUND_ROBOTS * focus.getSize(size).length());
  else focus.union(boxOfEnvironment(scene.spec.environment));
  const isPart = whole.getSize(corner).length() > more * focus.getSize(size).length();
  const box = isPart ? focus : whole;
  if (hasRobots) box.max.z = Math.max(box.max.z, focus.max.z); // labels and arrows are above grippers
  return { box, azimuth: findAzimuth(scene, robots, links, box) };
}

/** Return the first azimuth from which most of `robots` is not behind something else that is drawn. */
function findAzimuth(scene: Placed, robots: readonly Visual[], links: ReadonlySet<number>, box: Box3): number {
  const points = robots.map((visual) => boxNow(scene, visual).getCenter(new Vector3()));
  const others = scene.spec.visuals.filter((visual) => !links.has(visual.body) && visual.rgba[3] > 0.5 && isSolid(scene.spec, visual));
  const obstacles = others.map((visual) => ({ box: boundShape(scene.spec, visual), inverse: matrixNow(scene, visual).clone().invert() }));
  const [center, reach] = [box.getCenter(new Vector3()), box.getSize(corner).length()];
  const [ray, hit] = [new Ray(), new Vector3()];
  let [best, least] = [FIRST_AZIMUTH as number, Number.POSITIVE_INFINITY];
  for (const azimuth of AZIMUTHS) {
    const eye = center.clone().addScaledVector(directView(azimuth, FIRST_ELEVATION), -reach);
    const hidden = points.filter((point) =>
      obstacles.some(({ box: obstacle, inverse }) => {
        ray.origin.copy(eye).applyMatrix4(inverse);
        const to = hit.copy(point).applyMatrix4(inverse);
        if (obstacle.containsPoint(to)) return false; // the box around a hood, in which the robot is
        const distance = ray.origin.distanceTo(to);
        ray.direction.copy(to).sub(ray.origin).normalize();
        const found = ray.intersectBox(obstacle, hit);
        return found !== null && found.distanceTo(ray.origin) < distance;
      }),
    ).length;
    if (hidden < least) [best, least] = [azimuth, hidden];
    if (hidden <= HIDDEN_SHARE * points.length) break;
  }
  return best;
}

/** Return the direction of a view, a unit vector in the session's world, by azimuth and elevation [deg] as MuJoCo's. */
export function directView(azimuth: number, elevation: number): Vector3 {
  const [az, el] = [(azimuth * Math.PI) / 180, (elevation * Math.PI) / 180];
  return new Vector3(Math.cos(el) * Math.cos(az), Math.cos(el) * Math.sin(az), Math.sin(el));
}

/**
 * Return from where a camera sees all of a box: what it looks at, and how far from there it is [m].
 *
 * `fovy`: [deg], of a picture `aspect` times as wide as high. `above`: share of its height over which a bar lies.
 */
export function fitView(box: Box3, azimuth: number, elevation: number, fovy: number, aspect: number, above: number): { lookat: Vector3; distance: number } {
  const forward = directView(azimuth, elevation);
  const right = forward.clone().cross(new Vector3(0, 0, 1)).normalize();
  const up = right.clone().cross(forward);
  const tan = Math.tan((fovy * Math.PI) / 360);
  // From the middle of the picture to the upper edge of what is filled, and to the lower one, in halves of its height.
  const [upper, lower] = [Math.min(FILLED_SHARE, 1 - 2 * above), FILLED_SHARE];
  const filled = (upper + lower) / 2;
  const shift = (lower - upper) / 2;
  const half = box.getSize(new Vector3()).multiplyScalar(0.5);
  let distance = 0;
  for (let i = 0; i < 8; i++) {
    corner.set(i & 1 ? half.x : -half.x, i & 2 ? half.y : -half.y, i & 4 ? half.z : -half.z);
    const [x, y, z] = [corner.dot(right) / tan, corner.dot(up) / tan, corner.dot(forward)];
    const across = Math.abs(x) / (FILLED_SHARE * aspect) - z;
    distance = Math.max(distance, across, (y - upper * z) / filled, (-y - lower * z) / filled);
  }
  return { lookat: box.getCenter(new Vector3()).addScaledVector(up, shift * tan * distance), distance };
}

function listDescendants({ bodies }: SceneSpec, bases: readonly number[]): Set<number> {
  const found = new Set(bases.filter((base) => base > 0));
  for (const { id, parent } of bodies) if (found.has(parent)) found.add(id); // parents are listed before their children
  return found;
}

function unionOf(boxes: readonly Box3[]): Box3 {
  return boxes.reduce((all, box) => all.union(box), new Box3());
}

/** Return whether a visual is drawn and has an inside: planes have none, and may be endless. */
function isSolid(spec: SceneSpec, { geometry, group, rgba }: Visual): boolean {
  return rgba[3] > 0 && spec.groups_shown.includes(group) && geometry.kind !== "plane";
}

function boxNow(scene: Placed, visual: Visual): Box3 {
  if (!isSolid(scene.spec, visual)) return new Box3();
  return boundShape(scene.spec, visual).applyMatrix4(matrixNow(scene, visual));
}

function boxAtRest(scene: Placed, visual: Visual): Box3 {
  const T_world_body = scene.rest.get(visual.body);
  if (!T_world_body || !isSolid(scene.spec, visual)) return new Box3();
  return boundShape(scene.spec, visual).applyMatrix4(matrix.multiplyMatrices(T_world_body, matrixOf(visual)));
}

function matrixNow(scene: Placed, visual: Visual): Matrix4 {
  return matrix.multiplyMatrices(scene.bodies.get(visual.body)!.matrix, matrixOf(visual));
}

function matrixOf({ T_body_visual: [p, [qw, qx, qy, qz]] }: Visual): Matrix4 {
  return new Matrix4().compose(new Vector3(...p), new Quaternion(qx, qy, qz, qw).normalize(), new Vector3(1, 1, 1));
}

/** Return the box around a shape, in its own frame. */
function boundShape(spec: SceneSpec, { geometry }: Visual): Box3 {
  const mesh = spec.meshes[geometry.mesh];
  if (mesh) return new Box3(new Vector3(...mesh.low), new Vector3(...mesh.high));
  const field = spec.hfields[geometry.hfield];
  if (field) {
    const [x, y, top, base] = field.size;
    return new Box3(new Vector3(-x, -y, -base), new Vector3(x, y, top));
  }
  const half = new Vector3(...geometry.size);
  if (geometry.kind === "capsule") half.z += half.x;
  return new Box3(half.clone().negate(), half);
}

function boxOfEnvironment({ center, extent }: SceneSpec["environment"]): Box3 {
  return new Box3().setFromCenterAndSize(new Vector3(...center), new Vector3().setScalar(Math.max(extent, LEAST_EXTENT_M)));
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
