// Where the robots are in the picture: their grippers, the places of their labels, and which one is at a place.

import { type Camera, Matrix4, Quaternion, Raycaster, Vector2, Vector3 } from "three";

import type { RobotInfo, SceneSpec } from "../core/api.ts";
import { type Chain, findPointed, listChains } from "../xr/pointing.ts";
import { T_THREE_WORLD } from "./axes.ts";
import type { PicturePlace } from "./gizmo.ts";
import type { View } from "./view.ts";

/** Height of a robot's label above its highest link [m]. */
const LABEL_ABOVE_M = 0.12;
const T_WORLD_THREE = new Matrix4().copy(T_THREE_WORLD).invert();

interface Place {
  info: RobotInfo;
  chain: Chain;
  p_body_site: Vector3;
  q_body_site: Quaternion;
}

/** The robots of the scene that is in the picture. */
export class RobotPlaces {
  private readonly places = new Map<string, Place>();
  private of: readonly [readonly RobotInfo[], SceneSpec] | null = null;
  private readonly caster = new Raycaster();

  constructor(private readonly view: View) {}

  /** Set which robots there are. */
  set(robots: readonly RobotInfo[], spec: SceneSpec): void {
    if (this.of?.[0] === robots && this.of[1] === spec) return;
    this.of = [robots, spec];
    this.places.clear();
    const chains = listChains(robots, spec.bodies);
    for (const info of robots) {
      const [p, [w, x, y, z]] = info.T_body_site;
      const place = { info, chain: chains.get(info.name) ?? [], p_body_site: new Vector3(...p), q_body_site: new Quaternion(x, y, z, w) };
      this.places.set(info.name, place);
    }
  }

  /** Set the pose of a robot's gripper in the world. Returns false where it is not in the picture. */
  readTip(robot: string, p_world: Vector3, q_world: Quaternion): boolean {
    const place = this.places.get(robot);
    const body = place && this.view.scene?.bodies.get(place.info.site_body);
    if (!place || !body?.visible) return false;
    p_world.copy(place.p_body_site).applyQuaternion(body.quaternion).add(body.position);
    q_world.copy(body.quaternion).multiply(place.q_body_site);
    return true;
  }

  /** Set where the label of a robot is, in the world. Returns false where it is not in the picture. */
  readLabel(robot: string, p_world: Vector3): boolean {
    const { bodies } = this.view.scene ?? {};
    let height = Number.NEGATIVE_INFINITY;
    for (const id of this.places.get(robot)?.chain ?? []) {
      const position = bodies?.get(id)?.position;
      if (!position) continue;
      height = Math.max(height, position.z);
      p_world.copy(position); // the last one is the base
    }
    p_world.z = height + LABEL_ABOVE_M;
    return Number.isFinite(height);
  }

  /** Return the robot at a place of the picture, null for none. */
  pick({ x, y }: PicturePlace, camera: Camera): string | null {
    const { ray } = this.caster;
    this.caster.setFromCamera(new Vector2(x, y), camera);
    const origin = ray.origin.clone().applyMatrix4(T_WORLD_THREE).toArray();
    const direction = ray.direction.clone().transformDirection(T_WORLD_THREE).toArray();
    const chains = new Map([...this.places].map(([name, { chain }]) => [name, chain]));
    return findPointed({ origin, direction }, chains, (body) => this.view.scene?.bodies.get(body)?.position.toArray() ?? null)?.robot ?? null;
  }
}
