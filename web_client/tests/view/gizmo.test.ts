// The handles at a gripper: what a pointer at their arrows and rings drags.

import { PerspectiveCamera, Quaternion, Scene, Vector3 } from "three";
import { afterEach, beforeEach, expect, test, vi } from "vitest";

import { makeWorldRoot, T_THREE_WORLD } from "../../src/view/axes.ts";
import { Gizmo, type PicturePlace } from "../../src/view/gizmo.ts";

const TIP = new Vector3(0.3, -0.2, 0.4);
const TURNED = new Quaternion().setFromAxisAngle(new Vector3(0, 1, 0), 1.2);
const camera = new PerspectiveCamera(45, 1.5, 0.01, 100);
let scene: Scene;
let gizmo: Gizmo;

beforeEach(() => {
  vi.stubGlobal("matchMedia", () => ({ matches: false }));
  camera.position.set(1.2, 1.1, 1.5);
  camera.lookAt(TIP.clone().applyMatrix4(T_THREE_WORLD));
  camera.updateMatrixWorld();
  gizmo = new Gizmo(camera, () => undefined);
  const world = makeWorldRoot();
  world.add(gizmo.object);
  scene = new Scene().add(world);
  gizmo.object.visible = true;
  draw();
});
afterEach(() => vi.unstubAllGlobals());

/** Move the handles to the gripper and update what is drawn. */
function draw(tip = TIP): void {
  gizmo.place(tip, TURNED, camera);
  scene.updateMatrixWorld();
}

/** Return where a point of the world is in the picture. */
const find = (x: number, y: number, z: number): PicturePlace => new Vector3(x, y, z).applyMatrix4(T_THREE_WORLD).project(camera);

function readWay(): { move: number[]; turn: number[] } {
  const [move, turn]: [number, number, number][] = [[9, 9, 9], [9, 9, 9]];
  gizmo.readWay(move!, turn!);
  return { move: move!, turn: turn! };
}

const length = 0.8 * 0.5 * camera.position.set(1.2, 1.1, 1.5).distanceTo(TIP.clone().applyMatrix4(T_THREE_WORLD)) * 1.9 * Math.tan(Math.PI / 8) / 4 * 0.9;

test.each([0, 1, 2])("the arrow of axis %i moves along that axis of the world, and comes back when it is let go", (axis) => {
  const along = new Vector3().setComponent(axis, 1);
  const at = (way: number): [number, number, number] => TIP.clone().addScaledVector(along, way).toArray();
  expect(gizmo.grab(find(...at(length)))).toBe(true);
  draw();
  gizmo.drag(find(...at(length + 0.1)));
  const { move, turn } = readWay();
  expect(move).toEqual([0, 1, 2].map((i) => expect.closeTo(i === axis ? 0.1 : 0, 6)));
  expect(turn).toEqual([0, 0, 0]);
  draw(new Vector3(...at(0.06))); // the gripper follows, the handles stay
  expect(readWay().move[axis]).toBeCloseTo(0.04, 6);
  gizmo.letGo();
  expect(readWay()).toEqual({ move: [0, 0, 0], turn: [0, 0, 0] });
  draw(new Vector3(...at(0.06)));
  expect(gizmo.grab(find(...at(0.06 + length)))).toBe(true);
});

test("a ring turns about its axis, and the way is what is left", () => {
  const ring = 0.65 * (length / 0.8);
  const at = (angle: number): PicturePlace => find(TIP.x + ring * Math.cos(angle), TIP.y + ring * Math.sin(angle), TIP.z);
  const isRing = (angle: number): boolean => gizmo.hover(at(angle)) && gizmo["turner"].axis === "Z";
  const before = Array.from({ length: 24 }, (_, i) => (i * Math.PI) / 12).find(isRing);
  expect(gizmo.grab(at(before!))).toBe(true);
  draw();
  gizmo.drag(at(before! + 0.3));
  const { move, turn } = readWay();
  expect(move).toEqual([0, 0, 0]);
  expect(Math.hypot(turn[0]!, turn[1]!)).toBeLessThan(1e-6);
  expect(turn[2]!).toBeGreaterThan(0.05);
  const followed = new Quaternion().setFromAxisAngle(new Vector3(0, 0, 1), turn[2]!).multiply(TURNED);
  gizmo.place(TIP, followed, camera);
  expect(Math.hypot(...readWay().turn)).toBeLessThan(1e-6);
});

test("nothing is held beside the handles, or where they are not shown", () => {
  expect(gizmo.grab({ x: 0.9, y: 0.9 })).toBe(false);
  gizmo.object.visible = false;
  expect(gizmo.grab(find(TIP.x, TIP.y, TIP.z + length))).toBe(false);
});

test("handles that are hidden are not updated", () => {
  gizmo.object.visible = false;
  const { elements } = gizmo["pivot"].matrixWorld;
  const before = [...elements];
  draw(new Vector3(0, 0, 1));
  expect(elements).toEqual(before);
  gizmo.object.visible = true;
  draw(new Vector3(0, 0, 1));
  expect(elements).not.toEqual(before);
});
