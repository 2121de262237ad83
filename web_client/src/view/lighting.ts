// Lights of a scene as uniforms of `surface.ts`, in the world frame of three.js, so that every eye of a headset sees
// them alike. Lights that cast shadows have a light of three.js beside them, of which only the shadow map is used.

import { DirectionalLight, Matrix4, type Object3D, Quaternion, SpotLight, Vector3 } from "three";

import type { Environment, Light, SceneSpec } from "./spec.ts";

/** Lights beyond these are left out, the last first. MuJoCo draws eight. */
const MAX_LIGHTS = 12;
const MAX_SHADOWS = 4;
const SHADOW_MAP_SIDE = 2048;

export interface LightUniform {
  position: Vector3;
  direction: Vector3;
  ambient: Vector3;
  diffuse: Vector3;
  specular: Vector3;
  attenuation: Vector3;
  /** Cosine of the half angle of a spot; -2: shines to all sides. */
  cutoff: number;
  exponent: number;
  /** 1: from infinitely far. */
  directional: number;
}

/** What the shader has to know when it is compiled: the kind of shadow map of each light, by its number. */
export interface LightLayout {
  /** Per light: "" without a shadow, else `directional` or `spot`. */
  shadows: ("" | "directional" | "spot")[];
}

interface Placed {
  spec: Light;
  uniform: LightUniform;
  shadow: DirectionalLight | SpotLight | null;
}

/** Something on a body that follows it as `Follow` says. */
export interface Follower {
  body: number;
  p_body: readonly [number, number, number];
  follow: string;
  target: number;
}

/** The lights of one scene. */
export class Lighting {
  readonly uniforms: { lights: { value: LightUniform[] }; headlight: { value: Record<string, Vector3> } };
  readonly layout: LightLayout;
  private readonly placed: Placed[];

  /** `bodies`: frames of bodies by id, below `root`. `withShadows`: draw shadow maps. */
  constructor(
    spec: SceneSpec,
    private readonly root: Object3D,
    private readonly bodies: ReadonlyMap<number, Object3D>,
    withShadows: boolean,
  ) {
    let shadows = 0;
    const lights = spec.lights.filter((light) => light.active && light.kind !== "image").slice(0, MAX_LIGHTS);
    this.placed = lights.map((light) => {
      const casts = withShadows && light.castshadow && light.kind !== "point" && shadows < MAX_SHADOWS;
      if (casts) shadows += 1;
      const shadow = casts ? makeShadowLight(light, spec.environment) : null;
      if (shadow) root.add(shadow, shadow.target);
      return { spec: light, uniform: toUniform(light), shadow };
    });
    const { headlight } = spec.environment;
    const on = headlight.active ? 1 : 0;
    this.uniforms = {
      lights: { value: this.placed.map((light) => light.uniform) },
      headlight: {
        value: {
          ambient: new Vector3(...headlight.ambient).multiplyScalar(on),
          diffuse: new Vector3(...headlight.diffuse).multiplyScalar(on),
          specular: new Vector3(...headlight.specular).multiplyScalar(on),
        },
      },
    };
    this.layout = {
      shadows: this.placed.map(({ shadow }) => (!shadow ? "" : shadow instanceof SpotLight ? "spot" : "directional")),
    };
  }

  /** Move lights to where their bodies are. Call it after the poses of bodies were set. */
  update(rest: ReadonlyMap<number, Matrix4>): void {
    for (const { spec, uniform, shadow } of this.placed) {
      const at = { ...spec, p_body: spec.p_body };
      const p_world = placeFollower(at, this.bodies, rest, uniform.position);
      directFollower(at, spec.direction_body, p_world, this.bodies, rest, uniform.direction);
      if (shadow) {
        const back = spec.kind === "directional" ? shadowDistance(spec) : 0;
        shadow.position.copy(p_world).addScaledVector(uniform.direction, -back);
        shadow.target.position.copy(shadow.position).add(uniform.direction);
      }
      uniform.position.applyMatrix4(this.root.matrix);
      uniform.direction.transformDirection(this.root.matrix);
    }
  }

  /** Remove what was added to the root. */
  dispose(): void {
    for (const { shadow } of this.placed) {
      if (!shadow) continue;
      this.root.remove(shadow, shadow.target);
      shadow.dispose();
    }
  }
}

const matrix = new Matrix4();
const quaternion = new Quaternion();
const scale = new Vector3();
const origin = new Vector3();

/** Write the place of a light or camera in the session's world to `out`, and return it. */
export function placeFollower(
  at: Follower,
  bodies: ReadonlyMap<number, Object3D>,
  rest: ReadonlyMap<number, Matrix4>,
  out: Vector3,
): Vector3 {
  out.set(...at.p_body);
  const body = bodies.get(at.body);
  if (!body) return out;
  if (tracks(at)) {
    // Keeps its orientation and its offset from the body, both of the pose in which the scene begins.
    out.applyQuaternion(restRotation(at.body, rest));
    return out.add(body.position);
  }
  return out.applyMatrix4(matrix.compose(body.position, body.quaternion, scale.set(1, 1, 1)));
}

/** Write the direction of a light or camera in the session's world to `out`, a unit vector. */
export function directFollower(
  at: Follower,
  direction_body: readonly [number, number, number],
  p_world: Vector3,
  bodies: ReadonlyMap<number, Object3D>,
  rest: ReadonlyMap<number, Matrix4>,
  out: Vector3,
): void {
  const target = watches(at) ? bodies.get(at.target) : undefined;
  if (target) {
    out.copy(target.position).sub(p_world);
    if (out.lengthSq() > 1e-12) {
      out.normalize();
      return;
    }
  }
  out.set(...direction_body);
  const body = bodies.get(at.body);
  if (tracks(at)) out.applyQuaternion(restRotation(at.body, rest));
  else if (body) out.applyQuaternion(body.quaternion);
  out.normalize();
}

export function tracks(at: { follow: string }): boolean {
  return at.follow === "track" || at.follow === "trackcom";
}

export function watches(at: { follow: string }): boolean {
  return at.follow === "targetbody" || at.follow === "targetbodycom";
}

/** Return the rotation in which a body begins, in the session's world. */
export function restRotation(body: number, rest: ReadonlyMap<number, Matrix4>): Quaternion {
  const T = rest.get(body);
  if (!T) return quaternion.identity();
  T.decompose(origin, quaternion, scale);
  return quaternion;
}

function toUniform(light: Light): LightUniform {
  const isSpot = light.kind !== "directional" && light.kind !== "point";
  return {
    position: new Vector3(),
    direction: new Vector3(0, -1, 0),
    ambient: new Vector3(...light.ambient),
    diffuse: new Vector3(...light.diffuse),
    specular: new Vector3(...light.specular),
    attenuation: new Vector3(...light.attenuation),
    cutoff: isSpot && light.cutoff < 180 ? Math.cos((light.cutoff * Math.PI) / 180) : -2,
    exponent: isSpot ? light.exponent : 0,
    directional: light.kind === "directional" ? 1 : 0,
  };
}

/** Distance behind a directional light from where its shadows are drawn [m]. */
function shadowDistance(light: Light): number {
  return Math.max(0, 4 - Math.hypot(...light.p_body));
}

function makeShadowLight(light: Light, environment: Environment): DirectionalLight | SpotLight {
  const reach = Math.max(environment.extent, 1);
  if (light.kind === "directional") {
    const made = new DirectionalLight();
    const { camera } = made.shadow;
    [camera.left, camera.right, camera.bottom, camera.top] = [-reach * 1.5, reach * 1.5, -reach * 1.5, reach * 1.5];
    [camera.near, camera.far] = [0.01, 20 * reach];
    return withShadowMap(made, -0.0004, 0.004);
  }
  const made = new SpotLight();
  made.angle = Math.min((Math.max(light.cutoff, 5) * Math.PI) / 180, 1.2);
  [made.shadow.camera.near, made.shadow.camera.far] = [0.05, light.range > 0 ? light.range : 20 * reach];
  return withShadowMap(made, -0.0002, 0.004);
}

function withShadowMap<T extends DirectionalLight | SpotLight>(light: T, bias: number, normalBias: number): T {
  light.castShadow = true;
  light.shadow.mapSize.set(SHADOW_MAP_SIDE, SHADOW_MAP_SIDE);
  light.shadow.bias = bias;
  light.shadow.normalBias = normalBias;
  light.shadow.radius = 1.5;
  return light;
}
