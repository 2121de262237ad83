// Lights of a scene as uniforms of `surface.ts`, in the world frame of three.js, so that every eye of a headset sees
// them alike. Lights that cast shadows have a light of three.js beside them, of which only the shadow map is used.

import { Box3, DirectionalLight, Matrix4, type Object3D, Quaternion, Sphere, SpotLight, Vector3 } from "three";

import type { Budget } from "./budget.ts";
import { findWholeBox, type Placed } from "./framing.ts";
import type { Light } from "./spec.ts";

/** Lights beyond these are left out, the last first. MuJoCo draws eight. */
const MAX_LIGHTS = 12;
/** Light on everything in a scene without any: MuJoCo 4 draws 0.3 of the colour there. */
const UNLIT = 0.3;

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
  /** No light casts a shadow, so what is below something is darker: objects would seem to float. The last shadow map. */
  isShaded: boolean;
}

interface PlacedLight {
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
  private readonly placed: PlacedLight[];
  private readonly bodies: ReadonlyMap<number, Object3D>;
  /** What shadows are drawn of: a ball around all that is drawn when the scene begins. */
  private readonly ball: Sphere;
  /** Light from straight above, without a light. */
  private readonly shade: DirectionalLight | null;

  /** `place`: bodies are below `root`. */
  constructor(place: Placed, private readonly root: Object3D, budget: Pick<Budget, "shadows" | "shadowSide">) {
    const { spec } = place;
    this.bodies = place.bodies;
    this.ball = findWholeBox(place, new Box3()).getBoundingSphere(new Sphere());
    let shadows = 0;
    const lights = spec.lights.filter((light) => light.active && light.kind !== "image").slice(0, MAX_LIGHTS);
    this.placed = lights.map((light) => {
      const casts = light.castshadow && light.kind !== "point" && shadows < budget.shadows;
      if (casts) shadows += 1;
      const shadow = casts ? makeShadowLight(light, this.ball.radius, budget.shadowSide) : null;
      if (shadow) root.add(shadow, shadow.target);
      return { spec: light, uniform: toUniform(light), shadow };
    });
    const { headlight } = spec.environment;
    const on = headlight.active ? 1 : 0;
    const isUnlit = !headlight.active && lights.length === 0;
    this.shade = budget.shadows > 0 && shadows === 0 && !isUnlit ? this.makeShade(budget.shadowSide) : null;
    this.uniforms = {
      lights: { value: this.placed.map((light) => light.uniform) },
      headlight: {
        value: {
          ambient: isUnlit ? new Vector3().setScalar(UNLIT) : new Vector3(...headlight.ambient).multiplyScalar(on),
          diffuse: new Vector3(...headlight.diffuse).multiplyScalar(on),
          specular: new Vector3(...headlight.specular).multiplyScalar(on),
        },
      },
    };
    this.layout = {
      shadows: this.placed.map(({ shadow }) => (!shadow ? "" : shadow instanceof SpotLight ? "spot" : "directional")),
      isShaded: this.shade !== null,
    };
  }

  /** Move lights to where their bodies are. Call it after the poses of bodies were set. */
  update(rest: ReadonlyMap<number, Matrix4>): void {
    for (const { spec, uniform, shadow } of this.placed) {
      const p_world = placeFollower(spec, this.bodies, rest, uniform.position);
      directFollower(spec, spec.direction_body, p_world, this.bodies, rest, uniform.direction);
      if (shadow instanceof DirectionalLight) this.pointFromOutside(shadow, uniform.direction);
      else if (shadow) {
        shadow.position.copy(p_world);
        shadow.target.position.copy(p_world).add(uniform.direction);
      }
      uniform.position.applyMatrix4(this.root.matrix);
      uniform.direction.transformDirection(this.root.matrix);
    }
  }

  /** Show shadows, or light everything as if nothing were in the way. */
  showShadows(isShown: boolean): void {
    for (const { shadow } of this.casting) shadow.intensity = isShown ? 1 : 0;
  }

  /** Remove what was added to the root. */
  dispose(): void {
    for (const light of this.casting) {
      this.root.remove(light, light.target);
      light.dispose();
    }
  }

  private get casting(): (DirectionalLight | SpotLight)[] {
    return [this.shade, ...this.placed.map((light) => light.shadow)].filter((light) => light !== null);
  }

  private makeShade(side: number): DirectionalLight {
    const shade = makeDirectionalShadow(this.ball.radius, side);
    shade.shadow.radius = 4;
    this.pointFromOutside(shade, new Vector3(0, 0, -1));
    this.root.add(shade, shade.target);
    return shade;
  }

  /** Let the shadows of a light that is infinitely far away begin before everything that is drawn. */
  private pointFromOutside(shadow: DirectionalLight, direction: Vector3): void {
    shadow.target.position.copy(this.ball.center);
    shadow.position.copy(this.ball.center).addScaledVector(direction, -2 * this.ball.radius);
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

/** `reach`: radius of what is drawn [m]. */
function makeShadowLight(light: Light, reach: number, side: number): DirectionalLight | SpotLight {
  if (light.kind === "directional") return makeDirectionalShadow(reach, side);
  const made = new SpotLight();
  made.angle = Math.min((Math.max(light.cutoff, 5) * Math.PI) / 180, 1.2);
  [made.shadow.camera.near, made.shadow.camera.far] = [Math.min(0.05, reach / 20), light.range > 0 ? light.range : 20 * Math.max(reach, 1)];
  return withShadowMap(made, side, -0.0002, 0.004);
}

function makeDirectionalShadow(reach: number, side: number): DirectionalLight {
  const made = new DirectionalLight();
  const { camera } = made.shadow;
  [camera.left, camera.right, camera.bottom, camera.top] = [-reach, reach, -reach, reach];
  [camera.near, camera.far] = [0.01 * reach, 4 * reach];
  return withShadowMap(made, side, -0.0005, (3 * reach) / side); // one and a half pixels of the map
}

function withShadowMap<T extends DirectionalLight | SpotLight>(light: T, side: number, bias: number, normalBias: number): T {
  light.castShadow = true;
  light.shadow.mapSize.set(side, side);
  light.shadow.bias = bias;
  light.shadow.normalBias = normalBias;
  light.shadow.radius = 1.5;
  return light;
}
