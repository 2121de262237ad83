// What a headset shows of its own: controllers, hands, rays, and panels. All in the tracking frame, in the axes of
// three.js, below one group that is placed in the world by the alignment.

import { BufferGeometry, CapsuleGeometry, Float32BufferAttribute, Group, Line, LineBasicMaterial, type Material, Mesh, MeshBasicMaterial, type Object3D, PerspectiveCamera, SphereGeometry, Vector3 } from "three";

import type * as wire from "../protocol/messages.g.ts";
import { Label } from "../view/labels.ts";
import { type FrameReading, type InputReading, type Ray, type Side, toRow, type Vec3 } from "./reading.ts";
import { STOP_RADIUS_M } from "./stop.ts";

const COLOR = 0x8fa3bf;
/** Of a device whose position is an estimate, and how much of it covers what is behind. */
const EMULATED_COLOR = 0x8c8c8c;
const EMULATED_OPACITY = 0.4;
const WORDS_COLOR = "#e0a33a";
const RAY_COLOR = 0xc9d2e0;
const HIT_COLOR = 0x35d0ba;
const STOP_COLOR = "#d9363e";
/** Length of a ray that meets nothing [m]. */
const RAY_M = 2;
const NEAR_M = 0.03;
const FAR_M = 200;
/** Place of the urgent panel before the eyes, and of the other one above a hand [m]. */
const URGENT_AT = new Vector3(0, -0.22, -0.9);
/** The same while the eyes look at what the hands do. */
const RAISED_AT = new Vector3(0, 0.27, -0.9);
const ABOVE_HAND_M = 0.13;
/** Place of the words about a hand, below it [m]. */
const BELOW_HAND_M = 0.06;

interface Prop {
  object: Group;
  controller: Mesh;
  hand: Mesh;
  ray: Line;
  /** What the person has to know about this hand. */
  words: Label;
}

/** The props of one headset. `rig` is the tracking frame. */
export class Props {
  readonly rig = new Group();
  readonly camera = new PerspectiveCamera(70, 1, NEAR_M, FAR_M);
  /** Before the eyes: what cannot wait. */
  readonly urgent = new Label(0.042);
  /** Above a hand: who one is, alignment, what the buttons do. */
  readonly status = new Label(0.016);
  /** The urgent panel is above what the eyes look at. */
  isRaised = false;
  /** The ball at the wrist that stops. */
  readonly stop = new Mesh(new SphereGeometry(STOP_RADIUS_M, 24, 16), new MeshBasicMaterial({ color: STOP_COLOR, transparent: true, opacity: 0.8 }));
  private readonly stopLabel = new Label(0.018);
  private readonly props = new Map<Side, Prop>();

  constructor() {
    this.rig.name = "headset";
    this.stopLabel.setText(["STOP"], STOP_COLOR);
    this.stop.add(this.stopLabel.sprite);
    for (const label of [this.urgent, this.status, this.stopLabel]) showThrough(label);
    this.urgent.sprite.renderOrder += 1; // what cannot wait is before all other panels
    this.rig.add(this.camera, this.urgent.sprite, this.status.sprite, this.stop);
  }

  /** Place the tracking frame: everything of this headset moves with it. */
  place(T_world_tracking: wire.Pose): void {
    const [x, y, z, qx, qy, qz, qw] = toRow(T_world_tracking) as [number, number, number, number, number, number, number];
    this.rig.position.set(x, y, z);
    this.rig.quaternion.set(qx, qy, qz, qw);
    this.rig.updateMatrixWorld();
  }

  /** Say something about a hand, beside it. */
  describeHand(side: Side, lines: readonly string[]): void {
    this.props.get(side)?.words.setText(lines, WORDS_COLOR);
  }

  /** Move everything to where a frame has it. `hits`: how far the ray of a hand goes until it meets something [m]. `stop`: centre of the ball. */
  move(reading: FrameReading, hits: Partial<Record<Side, number>>, stop: Vec3 | null): void {
    this.stop.visible = stop !== null;
    if (stop) moveTo(this.stop, stop);
    for (const { object, ray } of this.props.values()) object.visible = ray.visible = false;
    for (const input of reading.inputs) this.moveInput(input, hits[input.side]);
    if (reading.head) {
      const [x, y, z, qx, qy, qz, qw] = toRow(reading.head) as [number, number, number, number, number, number, number];
      const { position } = this.urgent.sprite;
      position.copy(this.isRaised ? RAISED_AT : URGENT_AT).applyQuaternion({ x: qx, y: qy, z: qz, w: qw });
      position.set(position.x + x, position.y + y, position.z + z);
    }
    const hand = this.props.get("left")?.object.visible ? this.props.get("left") : this.props.get("right");
    this.status.sprite.visible = hand?.object.visible ?? false;
    if (hand) this.status.sprite.position.copy(hand.object.position).y += ABOVE_HAND_M;
  }

  dispose(): void {
    for (const label of [this.urgent, this.status, this.stopLabel, ...[...this.props.values()].map(({ words }) => words)]) label.dispose();
    this.stop.geometry.dispose();
    this.stop.material.dispose();
    this.rig.removeFromParent();
    for (const { controller, hand, ray } of this.props.values()) {
      for (const { geometry, material } of [controller, hand, ray]) {
        geometry.dispose();
        (material as Material).dispose();
      }
    }
  }

  private moveInput({ side, kind, pose, tracked, emulated, ray }: InputReading, hit: number | undefined): void {
    const prop = this.props.get(side) ?? this.addProp(side);
    if (pose) {
      const [x, y, z, qx, qy, qz, qw] = toRow(pose) as [number, number, number, number, number, number, number];
      prop.object.position.set(x, y, z);
      prop.object.quaternion.set(qx, qy, qz, qw);
    }
    prop.object.visible = pose !== null && (tracked || emulated);
    const material = prop.controller.material as MeshBasicMaterial;
    material.color.set(emulated ? EMULATED_COLOR : COLOR);
    material.opacity = emulated ? EMULATED_OPACITY : 1;
    prop.words.sprite.position.copy(prop.object.position).y -= BELOW_HAND_M;
    prop.controller.visible = kind === "controller";
    prop.hand.visible = kind === "hand";
    prop.ray.visible = ray !== null && tracked;
    if (ray) layRay(prop.ray, ray, hit);
  }

  private addProp(side: Side): Prop {
    const material = new MeshBasicMaterial({ transparent: true });
    const controller = new Mesh(new CapsuleGeometry(0.018, 0.09, 4, 12).rotateX(Math.PI / 2), material);
    const hand = new Mesh(new SphereGeometry(0.025, 16, 12), material);
    const geometry = new BufferGeometry();
    geometry.setAttribute("position", new Float32BufferAttribute([0, 0, 0, 0, 0, -1], 3));
    const ray = new Line(geometry, new LineBasicMaterial({ color: RAY_COLOR, transparent: true, opacity: 0.7 }));
    ray.frustumCulled = false;
    const object = new Group();
    object.add(controller, hand);
    const words = new Label(0.012);
    showThrough(words);
    this.rig.add(object, ray, words.sprite);
    const prop = { object, controller, hand, ray, words };
    this.props.set(side, prop);
    return prop;
  }
}

/** Draw a label over everything that is before it. */
function showThrough({ sprite }: Label): void {
  sprite.material.depthTest = false;
  sprite.renderOrder = 20;
}

/** Place an object at a point of the wire's axes. */
export function moveTo(object: Object3D, at: Vec3): void {
  const [x, y, z] = toRow([[...at], [1, 0, 0, 0]]) as [number, number, number];
  object.position.set(x, y, z);
}

function layRay(line: Line, { origin, direction }: Ray, hit: number | undefined): void {
  const length = hit ?? RAY_M;
  const end = [0, 1, 2].map((i) => origin[i]! + length * direction[i]!) as [number, number, number];
  const rows = [origin, end].map((point) => toRow([[...point], [1, 0, 0, 0]]));
  const places = line.geometry.getAttribute("position");
  rows.forEach((row, i) => places.setXYZ(i, row[0]!, row[1]!, row[2]!));
  places.needsUpdate = true;
  (line.material as LineBasicMaterial).color.set(hit === undefined ? RAY_COLOR : HIT_COLOR);
}
