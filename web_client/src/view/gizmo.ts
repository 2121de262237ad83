// The handles at the gripper of a robot that this person holds: arrows move it, rings turn it (TransformControls of
// three.js). A drag pulls a pivot away from the gripper; `desktop/pull.ts` makes a motion of the way between.

import { type Camera, Group, Matrix4, Object3D, Quaternion, Vector3 } from "three";
import { TransformControls } from "three/examples/jsm/controls/TransformControls.js";

import { T_THREE_WORLD } from "./axes.ts";

/** A place in the picture: to the right and up, each -1 to 1. */
export interface PicturePlace {
  x: number;
  y: number;
}

/** Size of the arrows, and for fingers; those of size 1 end at an eighth of the picture's height. Rings are inside. */
const SIZE = 0.9;
const FINGER_SIZE = 1.5;
const RING_SHARE = 0.65;
/** `button` of pointer events: pressed, and moved. */
const LEFT_BUTTON = 0;
const NO_BUTTON = -1;

/** A group that costs nothing while it is hidden: three.js updates what is hidden, too. */
class HidableGroup extends Group {
  override updateMatrixWorld(force?: boolean): void {
    if (this.visible) super.updateMatrixWorld(force);
  }
}

/** Handles of one gripper. Add `object` to the session's world. `onChange`: they look different now. */
export class Gizmo {
  readonly object = new HidableGroup();
  /** The pointer drags a handle. */
  isHeld = false;
  /** How far the arrows reach, as a share of the height of the picture. */
  readonly reach: number;
  /** From a sample until its effect is drawn [s]. */
  lag_s = 0;
  /** Where the gripper is to go, while the handles are held: its axes are those of the world when that begins. */
  private readonly pivot = new Object3D();
  private readonly mover: TransformControls;
  private readonly turner: TransformControls;
  private readonly p_world = new Vector3();
  private readonly q_world = new Quaternion();
  private readonly q_start = new Quaternion();
  private readonly toGo = new Quaternion();

  constructor(camera: Camera, onChange: () => void) {
    this.object.name = "gizmo";
    this.object.visible = false;
    // TransformControls places its parts in the axes of three.js, whatever they are in.
    const three = new Group();
    three.matrixAutoUpdate = false;
    three.matrix.copy(new Matrix4().copy(T_THREE_WORLD).invert());
    three.matrixWorldNeedsUpdate = true;
    this.object.add(this.pivot, three);
    const size = matchMedia("(pointer: coarse)").matches ? FINGER_SIZE : SIZE;
    this.reach = size / 8;
    const make = (mode: "translate" | "rotate"): TransformControls => {
      const controls = new TransformControls(camera);
      controls.setMode(mode);
      controls.setSpace("local"); // of the pivot: the axes of the session's world
      controls.setSize(mode === "rotate" ? RING_SHARE * size : size);
      controls.attach(this.pivot);
      controls.addEventListener("change", onChange);
      three.add(controls.getHelper());
      return controls;
    };
    this.turner = make("rotate");
    this.mover = make("translate");
    // A ring around the picture's axis and a ball turn about no axis that has a name.
    this.turner.showE = this.turner.showXYZE = false;
  }

  /** Move the handles to the gripper, unless they are held: then they stay where they are dragged. */
  place(p_world: Vector3, q_world: Quaternion, camera: Camera): void {
    this.p_world.copy(p_world);
    this.q_world.copy(q_world);
    this.mover.camera = this.turner.camera = camera;
    if (this.isHeld) return;
    this.pivot.position.copy(p_world);
    this.pivot.quaternion.identity();
  }

  /** Light up the handle at a place. Returns whether there is one. */
  hover(at: PicturePlace): boolean {
    if (!this.object.visible || this.isHeld) return this.isHeld;
    this.mover.pointerHover(asPointer(at, NO_BUTTON));
    this.turner.pointerHover(asPointer(at, NO_BUTTON));
    if (this.mover.axis !== null) this.turner.axis = null; // arrows are before rings
    return this.mover.axis !== null || this.turner.axis !== null;
  }

  /** Hold the handle at a place. Returns whether there is one. */
  grab(at: PicturePlace): boolean {
    if (this.isHeld || !this.hover(at)) return false;
    this.held.getHelper().updateMatrixWorld(); // the plane of the drag is that of the handle, also without a frame since
    this.held.pointerDown(asPointer(at, LEFT_BUTTON));
    this.isHeld = this.held.dragging;
    this.other.getHelper().visible = !this.isHeld;
    this.q_start.copy(this.q_world);
    return this.isHeld;
  }

  drag(at: PicturePlace): void {
    if (this.isHeld) this.held.pointerMove(asPointer(at, NO_BUTTON));
  }

  /** Hold no handle: they are at the gripper again. */
  letGo(): void {
    for (const controls of [this.mover, this.turner]) {
      controls.pointerUp(asPointer({ x: 0, y: 0 }, LEFT_BUTTON));
      controls.axis = null;
      controls.getHelper().visible = true;
    }
    this.isHeld = false;
    this.place(this.p_world, this.q_world, this.mover.camera);
  }

  /** Draw the handle that is held grey: the robot does not follow it. */
  setHeldBack(isHeldBack: boolean): void {
    for (const controls of [this.mover, this.turner]) controls.setColors("#ff0000", "#00ff00", "#0000ff", isHeldBack ? "#8a8f99" : "#ffff00");
  }

  /** Set the way from the gripper to where it is dragged, in the world: `move` [m] or `turn` [rad], the other one zero. */
  readWay(move: [number, number, number], turn: [number, number, number]): void {
    move.fill(0);
    turn.fill(0);
    if (!this.isHeld) return;
    if (this.held === this.mover) {
      const { x, y, z } = this.pivot.position;
      [move[0], move[1], move[2]] = [x - this.p_world.x, y - this.p_world.y, z - this.p_world.z];
      return;
    }
    const q = this.toGo.copy(this.q_world).invert().premultiply(this.q_start).premultiply(this.pivot.quaternion);
    const half = Math.hypot(q.x, q.y, q.z);
    const angle = 2 * Math.atan2(half, Math.abs(q.w));
    const scale = half > 1e-9 ? (Math.sign(q.w) || 1) * (angle / half) : 0;
    [turn[0], turn[1], turn[2]] = [scale * q.x, scale * q.y, scale * q.z];
  }

  private get held(): TransformControls {
    return this.mover.axis !== null ? this.mover : this.turner;
  }

  private get other(): TransformControls {
    return this.held === this.mover ? this.turner : this.mover;
  }
}

/** Return what TransformControls reads of a pointer. */
function asPointer({ x, y }: PicturePlace, button: number): PointerEvent {
  return { x, y, button } as PointerEvent;
}
