// Pictures of the scene's cameras, beside what the person looks at: each is drawn into a texture of its own at a limited
// rate, without people, anchors and point clouds, and copied onto the canvas where its panel is.

import {
  LinearFilter,
  Mesh,
  MeshBasicMaterial,
  type Object3D,
  OrthographicCamera,
  PerspectiveCamera,
  PlaneGeometry,
  type Scene,
  Vector3,
  type WebGLRenderer,
  WebGLRenderTarget,
} from "three";

import { T_THREE_WORLD } from "./axes.ts";
import { placeSceneCamera } from "./camera.ts";
import { aspectOf, isInPicture } from "./framing.ts";
import type { SceneView } from "./scene_view.ts";
import type { Pose } from "./spec.ts";

/** Width of the textures [pixels]. */
const WIDTH = 320;
/** Time between two pictures of one camera [ms]. */
const PERIOD_MS = 100;
const PERIOD_SOFTWARE_MS = 300;

/** A picture: index of the camera in the scene, and the element whose place on the canvas it takes. */
export interface PicturePanel {
  index: number;
  element: HTMLElement;
}

interface Picture extends PicturePanel {
  target: WebGLRenderTarget;
  drawn_ms: number;
  isOutdated: boolean;
}

/** The pictures that are shown now. */
export class CameraPictures {
  private pictures: Picture[] = [];
  private readonly perspective = new PerspectiveCamera(45, 1, 0.01, 200);
  private readonly orthographic = new OrthographicCamera();
  private readonly flatCamera = new OrthographicCamera(-1, 1, 1, -1, 0, 1);
  private readonly material = new MeshBasicMaterial({ depthTest: false, depthWrite: false });
  private readonly plane = new Mesh(new PlaneGeometry(2, 2), this.material);
  private readonly period_ms: number;

  constructor(
    private readonly renderer: WebGLRenderer,
    private readonly isSoftware: boolean,
  ) {
    this.period_ms = isSoftware ? PERIOD_SOFTWARE_MS : PERIOD_MS;
    this.plane.frustumCulled = false;
  }

  /** Show these and no others. */
  setPanels(panels: readonly PicturePanel[]): void {
    for (const picture of this.pictures) picture.target.dispose();
    this.pictures = panels.map((panel) => {
      const target = new WebGLRenderTarget(1, 1, { samples: this.isSoftware ? 0 : 4, magFilter: LinearFilter, minFilter: LinearFilter });
      return { ...panel, target, drawn_ms: Number.NEGATIVE_INFINITY, isOutdated: true };
    });
  }

  /** The scene looks otherwise than before. */
  markOutdated(): void {
    for (const picture of this.pictures) picture.isOutdated = true;
  }

  /** Draw the picture that is due the longest, if any, without `hidden`. Returns whether one was drawn: the canvas is outdated then. */
  drawDue(root: Scene, hidden: readonly Object3D[], scene: SceneView | null, now_ms: number): boolean {
    const due = this.pictures
      .filter((one) => one.isOutdated && now_ms - one.drawn_ms >= this.period_ms && scene?.spec.cameras[one.index])
      .sort((a, b) => a.drawn_ms - b.drawn_ms)[0];
    if (!due || !scene) return false;
    const camera = this.place(scene, due.index);
    if (!camera) return false;
    due.target.setSize(WIDTH, Math.round(WIDTH / aspectOf(scene.spec.cameras[due.index]!)));
    const shown = hidden.filter((object) => object.visible);
    for (const object of shown) object.visible = false;
    this.renderer.setRenderTarget(due.target);
    this.renderer.render(root, camera);
    this.renderer.setRenderTarget(null);
    for (const object of shown) object.visible = true;
    due.drawn_ms = now_ms;
    due.isOutdated = false;
    return true;
  }

  /** Copy the pictures onto the canvas. */
  show(): void {
    if (this.pictures.length === 0) return;
    const { renderer } = this;
    const canvas = renderer.domElement.getBoundingClientRect();
    if (canvas.width === 0) return;
    renderer.autoClear = false;
    renderer.setScissorTest(true);
    for (const { element, target, drawn_ms } of this.pictures) {
      if (!Number.isFinite(drawn_ms)) continue;
      const { left, bottom, width, height } = element.getBoundingClientRect();
      const at = [left - canvas.left, canvas.bottom - bottom, width, height] as const;
      this.material.map = target.texture;
      renderer.setViewport(...at);
      renderer.setScissor(...at);
      renderer.render(this.plane, this.flatCamera);
    }
    renderer.setScissorTest(false);
    renderer.setViewport(0, 0, canvas.width, canvas.height);
    renderer.autoClear = true;
  }

  /**
   * Return whether a place on a body is inside the picture of a camera of the scene as it is drawn now, at least `margin`
   * (share of half the picture) from its edge. True without the scene, camera or body.
   */
  isInside(scene: SceneView | null, index: number, body: number, T_body_site: Pose, margin: number): boolean {
    const group = scene?.bodies.get(body);
    const camera = scene && group ? this.place(scene, index) : null;
    const spec = scene?.spec.cameras[index];
    if (!camera || !group || !spec) return true;
    camera.updateMatrixWorld();
    const p = new Vector3(...T_body_site[0]).applyQuaternion(group.quaternion).add(group.position);
    p.applyMatrix4(T_THREE_WORLD).applyMatrix4(camera.matrixWorldInverse);
    return isInPicture([p.x, p.y, p.z], spec, margin);
  }

  private place(scene: SceneView, index: number): PerspectiveCamera | OrthographicCamera | null {
    const spec = scene.spec.cameras[index];
    if (!spec) return null;
    return placeSceneCamera(scene, spec, this.perspective, this.orthographic, aspectOf(spec));
  }
}
