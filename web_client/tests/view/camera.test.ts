// The free camera of the page: what it shows of a scene.

import { Box3, Vector3 } from "three";
import { expect, test } from "vitest";

import { T_THREE_WORLD } from "../../src/view/axes.ts";
import { Viewpoint } from "../../src/view/camera.ts";

/** A canvas without listeners. */
function makeCanvas(): HTMLCanvasElement {
  const deaf = { addEventListener: () => undefined, removeEventListener: () => undefined };
  return { ...deaf, style: {}, ownerDocument: deaf, getRootNode: () => deaf } as unknown as HTMLCanvasElement;
}

/** Return the farthest of the corners of a box from the middle of the picture, and the highest; 1 is at its edge. */
function measureReach(viewpoint: Viewpoint, { min, max }: Box3): [reach: number, top: number] {
  viewpoint.update(null);
  const corners = [min.x, max.x].flatMap((x) => [min.y, max.y].flatMap((y) => [min.z, max.z].map((z) => new Vector3(x, y, z))));
  const seen = corners.map((corner) => corner.applyMatrix4(T_THREE_WORLD).project(viewpoint.camera));
  const reach = Math.max(...seen.map(({ x, y, z }) => (Math.abs(z) > 1 ? Number.POSITIVE_INFINITY : Math.max(Math.abs(x), Math.abs(y)))));
  return [reach, Math.max(...seen.map(({ y }) => y))];
}

test("all of a box is shown, and little more, whatever its size and the shape of the picture", () => {
  for (const size of [0.002, 0.3, 4, 300, 5000]) {
    for (const aspect of [0.5, 1.6]) {
      const viewpoint = new Viewpoint(makeCanvas());
      viewpoint.setAspect(aspect);
      const box = new Box3(new Vector3(size, 0, 0), new Vector3(1.5 * size, 0.7 * size, size));
      viewpoint.frame({ box, azimuth: 145 }, box, 50, 0);
      const [reach] = measureReach(viewpoint, box);
      expect(reach).toBeLessThan(1);
      expect(reach).toBeGreaterThan(0.8);
      const away = viewpoint.free.position.clone();
      viewpoint.update(null);
      expect(viewpoint.free.position.distanceTo(away)).toBeLessThan(1e-6 * size); // the controls leave it there
    }
  }
});

test("a tall box ends below the bar over the picture, and fills what is left", () => {
  for (const above of [0.05, 0.15, 0.3]) {
    const viewpoint = new Viewpoint(makeCanvas());
    viewpoint.setAspect(1.2);
    const box = new Box3(new Vector3(-0.2, -0.2, 0), new Vector3(0.2, 0.2, 1.4));
    viewpoint.frame({ box, azimuth: 145 }, box, 50, above);
    const [reach, top] = measureReach(viewpoint, box);
    expect(top).toBeCloseTo(Math.min(0.85, 1 - 2 * above), 5);
    expect(reach).toBeGreaterThan(0.8);
    expect(reach).toBeLessThan(0.85 + 1e-6);
  }
});
