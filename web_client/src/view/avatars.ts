// People in the scene: heads and hands where the session has them, with name, colour and what they hold.

import {
  BoxGeometry,
  BufferGeometry,
  Color,
  Float32BufferAttribute,
  Group,
  Line,
  LineBasicMaterial,
  Mesh,
  MeshBasicMaterial,
  type Object3D,
  ShaderMaterial,
  SphereGeometry,
  Vector3,
} from "three";

import type { PresenceItem } from "../core/api.ts";
import { FrameBuffer, interpolatePoses, POSE_FLOATS } from "./interpolation.ts";
import { Label } from "./labels.ts";

/** Colours of participants, distinguishable with common colour blindness (Okabe and Ito 2008). */
export const PARTICIPANT_COLORS = ["#3d9be9", "#e69f00", "#00b388", "#d673ab", "#f0e442", "#56b4e9", "#d55e00"] as const;
const UNKNOWN_COLOR = "#8a93a3";
/** A device that reported nothing for this long is not drawn any more [ms]. */
const STALE_MS = 1500;
const RAY_M = 1.5;
const NAME_ABOVE_HEAD_M = 0.19;

export interface AvatarInfo {
  name: string;
  color: string;
  /** Second line of the label. */
  detail: string;
  isSelf: boolean;
}

interface DeviceAvatar {
  object: Group;
  buffer: FrameBuffer;
  pose: Float32Array;
  label: Label | null;
  newest_ms: number;
}

/** Return the colour of a participant: by the number in its id, so that it never changes and all clients show the same. */
export function participantColor(id: string): string {
  const number = /(\d+)$/.exec(id)?.[1];
  if (number === undefined) return UNKNOWN_COLOR;
  return PARTICIPANT_COLORS[(Number(number) + PARTICIPANT_COLORS.length - 1) % PARTICIPANT_COLORS.length]!;
}

/** All avatars. Add `group` to the session's world. */
export class Avatars {
  readonly group = new Group();
  private readonly devices = new Map<string, DeviceAvatar>();
  private people = new Map<string, AvatarInfo>();
  private readonly shapes = makeShapes();

  constructor() {
    this.group.name = "avatars";
  }

  /** Set who there is. Avatars of others disappear. */
  setPeople(people: Map<string, AvatarInfo>): void {
    const before = this.people;
    this.people = people;
    for (const [key, avatar] of this.devices) {
      const [participant = "", device = ""] = splitKey(key);
      const info = people.get(participant);
      if (!info || info.color !== before.get(participant)?.color) {
        this.remove(key);
      } else {
        avatar.label?.setText(labelLines(info), info.color);
        avatar.object.visible = isDrawn(info, device);
      }
    }
  }

  /** Take new poses. */
  setPresence(items: readonly PresenceItem[], session_ms: number): void {
    for (const [participant, device, pose, capture_ns] of items) {
      const info = this.people.get(participant);
      if (!info || !isDrawn(info, device)) continue;
      const key = makeKey(participant, device);
      const avatar = this.devices.get(key) ?? this.add(key, device, info);
      const at = capture_ns > 0 ? capture_ns / 1e6 : session_ms;
      if (at <= avatar.newest_ms) continue;
      avatar.newest_ms = at;
      avatar.buffer.push({ session_ms: at, values: new Float32Array([...pose[0], ...pose[1]]) });
    }
  }

  /** Move avatars to where they were at a session time. Returns whether something moved. */
  update(session_ms: number): boolean {
    let isMoved = false;
    for (const [key, avatar] of this.devices) {
      // What is far ahead is of a session before, whose clock was another one.
      if (Math.abs(session_ms - avatar.newest_ms) > STALE_MS) {
        this.remove(key);
        isMoved = true;
        continue;
      }
      const found = avatar.buffer.around(session_ms);
      if (!found) continue;
      const before = avatar.pose.slice();
      interpolatePoses(found.before.values, found.after.values, found.share, avatar.pose);
      if (!avatar.pose.every(Number.isFinite)) continue;
      isMoved ||= before.some((value, i) => Math.abs(value - avatar.pose[i]!) > 1e-5);
      const [x, y, z, qw, qx, qy, qz] = avatar.pose as unknown as number[];
      avatar.object.position.set(x!, y!, z!);
      avatar.object.quaternion.set(qx!, qy!, qz!, qw!);
      avatar.label?.sprite.position.set(x!, y!, z! + NAME_ABOVE_HEAD_M);
    }
    return isMoved;
  }

  private add(key: string, device: string, info: AvatarInfo): DeviceAvatar {
    const object = new Group();
    const color = this.shapes.colored(info.color);
    for (const part of device === "head" ? this.shapes.head(color) : this.shapes.hand(color, info.color)) {
      object.add(part);
    }
    const label = device === "head" ? new Label(0.045) : null;
    label?.setText(labelLines(info), info.color);
    this.group.add(object);
    if (label) this.group.add(label.sprite);
    const avatar = { object, buffer: new FrameBuffer(), pose: new Float32Array(POSE_FLOATS), label, newest_ms: 0 };
    this.devices.set(key, avatar);
    return avatar;
  }

  private remove(key: string): void {
    const avatar = this.devices.get(key);
    if (!avatar) return;
    avatar.object.removeFromParent();
    avatar.label?.dispose();
    this.devices.delete(key);
  }
}

/** Devices of other kinds than heads, hands and controllers have no place in the room. One's own are where they are. */
function isDrawn(info: AvatarInfo, device: string): boolean {
  return !info.isSelf && (device === "head" || device.startsWith("hand/") || device.startsWith("controller/"));
}

function labelLines(info: AvatarInfo): string[] {
  return info.detail ? [info.name, info.detail] : [info.name];
}

function makeKey(participant: string, device: string): string {
  return JSON.stringify([participant, device]);
}

function splitKey(key: string): string[] {
  return JSON.parse(key) as string[];
}

/** Shapes that all avatars share. Frames of devices: x forward, y left, z up. */
function makeShapes(): {
  colored: (color: string) => ShaderMaterial;
  head: (material: ShaderMaterial) => Object3D[];
  hand: (material: ShaderMaterial, color: string) => Object3D[];
} {
  const sphere = new SphereGeometry(1, 28, 18);
  const box = new BoxGeometry(2, 2, 2);
  const visor = new MeshBasicMaterial({ color: 0x15171c });
  const ray = new BufferGeometry();
  ray.setAttribute("position", new Float32BufferAttribute([0, 0, 0, RAY_M, 0, 0], 3));
  const materials = new Map<string, ShaderMaterial>();
  const part = (geometry: BufferGeometry, material: ShaderMaterial | MeshBasicMaterial, half: number[], at: number[]) => {
    const mesh = new Mesh(geometry, material);
    mesh.scale.set(half[0]!, half[1]!, half[2]!);
    mesh.position.set(at[0]!, at[1]!, at[2]!);
    return mesh;
  };
  return {
    colored: (color) => {
      const known = materials.get(color);
      if (known) return known;
      const made = makeAvatarMaterial(color);
      materials.set(color, made);
      return made;
    },
    head: (material) => [
      part(sphere, material, [0.085, 0.07, 0.1], [-0.06, 0, 0]),
      part(box, visor, [0.035, 0.065, 0.04], [0.01, 0, 0.01]),
    ],
    hand: (material, color) => [
      part(sphere, material, [0.05, 0.04, 0.025], [0, 0, 0]),
      part(sphere, material, [0.018, 0.018, 0.06], [0, 0, -0.03]),
      new Line(ray, new LineBasicMaterial({ color: new Color(color), transparent: true, opacity: 0.55 })),
    ],
  };
}

/** Return a material that is shaded from the viewer, whatever the lights of the scene are. */
function makeAvatarMaterial(color: string): ShaderMaterial {
  const parsed = new Color().setStyle(color);
  return new ShaderMaterial({
    uniforms: { color: { value: new Vector3(parsed.r, parsed.g, parsed.b) } },
    vertexShader: /* glsl */ `
varying vec3 vNormal;
void main() {
  vNormal = normalMatrix * normal;
  gl_Position = projectionMatrix * modelViewMatrix * vec4(position, 1.0);
}`,
    fragmentShader: /* glsl */ `
uniform vec3 color;
varying vec3 vNormal;
void main() {
  vec3 n = normalize(vNormal);
  gl_FragColor = vec4(color * (0.45 + 0.55 * max(dot(n, normalize(vec3(0.3, 0.6, 1.0))), 0.0)), 1.0);
  #include <colorspace_fragment>
}`,
  });
}
