// The free camera of the page: what it shows of the whole scene.

import { Box3, Vector3 } from "three";
import { expect, test } from "vitest";

import { T_THREE_WORLD } from "../../src/view/axes.ts";
import { Viewpoint } from "../../src/view/camera.ts";
import type { SceneView } from "../../src/view/scene_view.ts";

/** A canvas without listeners. */
function makeCanvas(): HTMLCanvasElement {
  const deaf = { addEventListener: () => undefined, removeEventListener: () => undefined };
  return { ...deaf, style: {}, ownerDocument: deaf, getRootNode: () => deaf } as unknown as HTMLCanvasElement;
}

const scene = { spec: { environment: { center: [0, 0, 0.5], extent: 1, zfar: 50 } } } as unknown as SceneView;

/** Return the farthest of the corners of a box from the middle of the picture; 1 is at its edge. */
function measureReach(viewpoint: Viewpoint, { min, max }: Box3): number {
  viewpoint.update(null);
  const corners = [min.x, max.x].flatMap((x) => [min.y, max.y].flatMap((y) => [min.z, max.z].map((z) => new Vector3(x, y, z))));
  const seen = corners.map((corner) => corner.applyMatrix4(T_THREE_WORLD).project(viewpoint.camera));
  return Math.max(...seen.map(({ x, y, z }) => Math.max(Math.abs(x), Math.abs(y), Math.abs(z))));
}

test("the whole scene is shown from two extents away, and with the clouds beside it", () => {
  for (const aspect of [0.5, 1.6]) {
    const viewpoint = new Viewpoint(makeCanvas());
    viewpoint.setAspect(aspect);
    viewpoint.frame(scene, new Box3());
    const alone = viewpoint.free.position.clone();
    expect(alone.distanceTo(new Vector3(0, 0, 0.5).applyMatrix4(T_THREE_WORLD))).toBeCloseTo(2 / Math.min(1, aspect), 9);
    const cloud = new Box3(new Vector3(-4, -3, 0), new Vector3(-1, 3, 2.5));
    expect(measureReach(viewpoint, cloud)).toBeGreaterThan(1);
    viewpoint.frame(scene, cloud);
    expect(measureReach(viewpoint, cloud)).toBeLessThan(1);
    viewpoint.frame(scene, new Box3(new Vector3(-0.3, -0.3, 0.2), new Vector3(0.3, 0.3, 0.8)));
    expect(viewpoint.free.position.distanceTo(alone)).toBeCloseTo(0, 9);
  }
});
