// From where the scene is seen: a free camera that mouse, fingers and keys move, or a camera of the scene.

import { type Box3, Matrix4, OrthographicCamera, PerspectiveCamera, Quaternion, Vector3 } from "three";
import { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";

import { T_THREE_WORLD } from "./axes.ts";
import { directView, FIRST_ELEVATION, fitView, type Sight } from "./framing.ts";
import { directFollower, placeFollower, tracks, watches, restRotation } from "./lighting.ts";
import type { SceneView } from "./scene_view.ts";
import type { Camera } from "./spec.ts";

/** A free camera in MuJoCo's terms [deg, m], in the session's world. */
export interface FreeCamera {
  lookat: [number, number, number];
  azimuth: number;
  elevation: number;
  distance: number;
  fovy?: number;
}

const T_WORLD_THREE = T_THREE_WORLD.clone().invert();
const DEFAULT_FOVY = 45;
/** Nearest and farthest distance that is drawn of scenes of a usual size [m]. */
const [NEAR_M, FAR_M] = [0.01, 200];
const KEY_STEP_RAD = 0.08;
const KEY_ZOOM = 1.1;

/** The camera of the page, and its controls. */
export class Viewpoint {
  readonly free = new PerspectiveCamera(DEFAULT_FOVY, 1, NEAR_M, FAR_M);
  private readonly orthographic = new OrthographicCamera();
  private readonly controls: OrbitControls;
  private aspect = 1;
  /** Index of the scene's camera that is looked through, -1 for the free one. */
  private chosen = -1;
  private readonly lastMatrix = new Matrix4();
  private readonly matrix = new Matrix4();

  constructor(canvas: HTMLCanvasElement) {
    this.controls = new OrbitControls(this.free, canvas);
    this.controls.enableDamping = false;
    this.controls.zoomSpeed = 0.8;
    this.controls.minDistance = 0.05;
    this.controls.maxDistance = 100;
    canvas.addEventListener("keydown", (event) => {
      if (this.chosen < 0 && this.moveByKey(event)) event.preventDefault();
    });
  }

  get index(): number {
    return this.chosen;
  }

  get camera(): PerspectiveCamera | OrthographicCamera {
    return this.isOrthographic ? this.orthographic : this.free;
  }

  /** Where the camera looks, and what is up in its picture: unit vectors in the session's world. */
  get axes(): { forward: [number, number, number]; up: [number, number, number] } {
    const { quaternion } = this.camera;
    const toWorld = (axis: Vector3): [number, number, number] => {
      const { x, y, z } = axis.applyQuaternion(quaternion).applyMatrix4(T_WORLD_THREE);
      return [x, y, z];
    };
    return { forward: toWorld(new Vector3(0, 0, -1)), up: toWorld(new Vector3(0, 1, 0)) };
  }

  private isOrthographic = false;

  /**
   * Look at a box from where all of it is seen, and let the view go on to the ends of the scene. `whole`: box of that;
   * `above`: share of the picture's height over which a bar lies.
   */
  frame({ box, azimuth }: Sight, whole: Box3, zfar: number, above: number): void {
    const reach = Math.max(whole.getSize(new Vector3()).length() / 2, 1e-3);
    // As near and as far as parts of this size and halls of that size need; in between the depth is resolved.
    this.free.near = Math.max(Math.min(NEAR_M, reach / 20), reach / 2000);
    this.free.far = Math.max(FAR_M, zfar, 30 * reach);
    this.controls.minDistance = Math.min(0.05, reach / 10);
    this.controls.maxDistance = Math.max(100, 20 * reach);
    const { lookat, distance } = fitView(box, azimuth, FIRST_ELEVATION, DEFAULT_FOVY, this.aspect, above);
    this.setFree({ lookat: lookat.toArray(), azimuth, elevation: FIRST_ELEVATION, distance });
  }

  /** Choose a camera of the scene by its index, or the free one (-1). */
  choose(index: number): void {
    if (index < 0 && this.chosen >= 0) {
      this.free.fov = DEFAULT_FOVY;
      // The free camera goes on where the other one was, looking at a point before it.
      const forward = new Vector3(0, 0, -1).applyQuaternion(this.free.quaternion);
      this.controls.target.copy(this.free.position).addScaledVector(forward, 1);
    }
    this.chosen = index;
    this.isOrthographic = false;
    this.controls.enabled = index < 0;
  }

  setFree({ lookat, azimuth, elevation, distance, fovy }: FreeCamera): void {
    const target = new Vector3(...lookat);
    const position = target.clone().addScaledVector(directView(azimuth, elevation), -distance);
    this.choose(-1);
    this.free.fov = fovy ?? DEFAULT_FOVY;
    this.controls.target.copy(target.applyMatrix4(T_THREE_WORLD));
    this.free.position.copy(position.applyMatrix4(T_THREE_WORLD));
    this.free.updateProjectionMatrix();
    this.controls.update();
  }

  setAspect(aspect: number): void {
    this.aspect = aspect;
    this.free.aspect = aspect;
    this.free.updateProjectionMatrix();
  }

  /** Move to where the scene has the camera. Returns whether what is seen has changed. */
  update(view: SceneView | null): boolean {
    const spec = view?.spec.cameras[this.chosen];
    if (view && spec) {
      this.isOrthographic = spec.orthographic;
      placeSceneCamera(view, spec, this.free, this.orthographic, this.aspect);
    } else {
      this.controls.update();
    }
    const { camera } = this;
    camera.updateMatrixWorld();
    this.matrix.multiplyMatrices(camera.projectionMatrix, camera.matrixWorldInverse);
    if (this.matrix.equals(this.lastMatrix)) return false;
    this.lastMatrix.copy(this.matrix);
    return true;
  }

  /** Arrow keys turn, with Shift they move, + and - go nearer and farther. */
  private moveByKey(event: KeyboardEvent): boolean {
    const { target } = this.controls;
    const offset = this.free.position.clone().sub(target);
    if (event.ctrlKey || event.metaKey || event.altKey) return false;
    const sideways = new Vector3(1, 0, 0).applyQuaternion(this.free.quaternion);
    const upward = new Vector3(0, 1, 0).applyQuaternion(this.free.quaternion);
    const arrows: Record<string, [number, number]> = {
      ArrowLeft: [-1, 0],
      ArrowRight: [1, 0],
      ArrowUp: [0, 1],
      ArrowDown: [0, -1],
    };
    const arrow = arrows[event.key];
    if (arrow && event.shiftKey) {
      const step = 0.05 * offset.length();
      const move = sideways.multiplyScalar(arrow[0] * step).addScaledVector(upward, arrow[1] * step);
      target.add(move);
      this.free.position.add(move);
    } else if (arrow) {
      offset.applyAxisAngle(new Vector3(0, 1, 0), arrow[0] * KEY_STEP_RAD);
      const polar = offset.angleTo(new Vector3(0, 1, 0)) - arrow[1] * KEY_STEP_RAD;
      if (polar > 0.05 && polar < Math.PI - 0.05) offset.applyAxisAngle(sideways, -arrow[1] * KEY_STEP_RAD);
      this.free.position.copy(target).add(offset);
    } else if (event.key === "+" || event.key === "=" || event.key === "-") {
      offset.multiplyScalar(event.key === "-" ? KEY_ZOOM : 1 / KEY_ZOOM);
      this.free.position.copy(target).add(offset);
    } else {
      return false;
    }
    this.controls.update();
    return true;
  }

  dispose(): void {
    this.controls.dispose();
  }
}

/** Move the camera of three.js that is of the kind of `spec`, one of the scene's cameras, to where that is, and return it. */
export function placeSceneCamera(
  view: SceneView,
  spec: Camera,
  perspective: PerspectiveCamera,
  orthographic: OrthographicCamera,
  aspect: number,
): PerspectiveCamera | OrthographicCamera {
  const [p_body, q] = spec.T_body_camera;
  const at = { body: spec.body, p_body, follow: spec.follow, target: spec.target };
  const p_world = placeFollower(at, view.bodies, view.rest, new Vector3());
  const turn = new Quaternion(q[1], q[2], q[3], q[0]);
  const body = view.bodies.get(spec.body);
  if (tracks(at)) turn.premultiply(restRotation(spec.body, view.rest));
  else if (body) turn.premultiply(body.quaternion);
  if (watches(at) && view.bodies.has(spec.target)) {
    const forward = new Vector3();
    directFollower(at, [0, 0, -1], p_world, view.bodies, view.rest, forward);
    turn.setFromRotationMatrix(new Matrix4().lookAt(new Vector3(), forward, new Vector3(0, 0, 1)));
  }
  const camera = spec.orthographic ? orthographic : perspective;
  if (camera instanceof OrthographicCamera) {
    [camera.top, camera.bottom] = [spec.fovy / 2, -spec.fovy / 2];
    [camera.right, camera.left] = [camera.top * aspect, -camera.top * aspect];
    [camera.near, camera.far] = [NEAR_M, FAR_M];
  } else {
    camera.fov = spec.fovy;
    camera.aspect = aspect;
  }
  camera.updateProjectionMatrix();
  camera.position.copy(p_world).applyMatrix4(T_THREE_WORLD);
  camera.quaternion.setFromRotationMatrix(T_THREE_WORLD).multiply(turn);
  return camera;
}
