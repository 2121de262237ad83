// Pictures of the scene's cameras: what is drawn into them, and when they are drawn again.

import { Group, Scene, type WebGLRenderer } from "three";
import { expect, test } from "vitest";

import { CameraPictures } from "../../src/view/pictures.ts";
import type { SceneView } from "../../src/view/scene_view.ts";
import { View } from "../../src/view/view.ts";

const CAMERA = { body: 0, follow: "fixed", target: -1, T_body_camera: [[0, 0, 1], [1, 0, 0, 0]], fovy: 45, orthographic: false, resolution: [1, 1] };
const scene = { spec: { cameras: [CAMERA] }, bodies: new Map(), rest: new Map() } as unknown as SceneView;

function makePictures(onRender: () => void): CameraPictures {
  const renderer = { setRenderTarget: () => undefined, render: onRender } as unknown as WebGLRenderer;
  const pictures = new CameraPictures(renderer, true);
  pictures.setPanels([{ index: 0, element: {} as HTMLElement }]);
  return pictures;
}

test("people, anchors and clouds are not in a picture, and are shown again after it", () => {
  const [people, clouds, absent] = [new Group(), new Group(), new Group()];
  absent.visible = false;
  const hidden = [people, clouds, absent];
  let seen: boolean[] = [];
  const pictures = makePictures(() => (seen = hidden.map((object) => object.visible)));
  expect(pictures.drawDue(new Scene(), hidden, scene, 0)).toBe(true);
  expect(seen).toEqual([false, false, false]);
  expect(hidden.map((object) => object.visible)).toEqual([true, true, false]);
});

/** What `View.draw` uses of a view, and what it hides in pictures. */
class FakeView {
  headset = null;
  lastTried_ms = 0;
  lastDrawn_ms = Number.POSITIVE_INFINITY;
  framesToDraw = 0;
  sceneCount = 0;
  scene = null;
  drawn = 0;
  drawnSinceReport = 0;
  outdated = 0;
  isMoved = false;
  isCloudNew = false;
  hidden: readonly unknown[] = [];
  root = {};
  overlay = "overlay";
  device = { framePeriod_ms: 0 };
  delay = { delay_ms: 0 };
  avatars = { update: () => false };
  viewpoint = { update: () => false, camera: {} };
  shadows = { markOld: () => undefined, renew: () => false };
  renderer = { xr: { getReferenceSpace: () => null, isPresenting: false }, render: () => undefined };
  clouds = { group: "clouds", popChanged: () => this.isCloudNew };
  pictures = {
    markOutdated: () => (this.outdated += 1),
    drawDue: (_root: unknown, hidden: readonly unknown[]) => {
      this.hidden = hidden;
      return false;
    },
    show: () => undefined,
  };
  touch = View.prototype.touch;
  touchOverlay = View.prototype.touchOverlay;
  sessionTime = () => 0;
  moveBodies = () => this.isMoved;
  moveDeformables = () => false;
}

test("a new cloud is drawn, and outdates no picture of the scene's cameras", () => {
  const view = new FakeView();
  const draw = (changes: Partial<FakeView>): void => {
    Object.assign(view, changes, { framesToDraw: 0 });
    (View.prototype as unknown as { draw(this: FakeView): void }).draw.call(view);
  };
  draw({});
  expect([view.drawn, view.outdated]).toEqual([0, 0]);
  draw({ isCloudNew: true });
  expect([view.drawn, view.outdated]).toEqual([1, 0]);
  draw({ isCloudNew: false, isMoved: true });
  expect([view.drawn, view.outdated]).toEqual([2, 1]);
  expect(view.hidden).toEqual(["overlay", "clouds"]);
});
