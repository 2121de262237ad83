// Scene specifications: bytes to a description whose references all have their target.

import { MAX_SCENE_BYTES, SCENE_VERSION } from "../protocol/messages.g.ts";
import type { SceneSpec } from "./api.ts";
import { decodeStruct } from "./codec.ts";
import { MalformedError, TooLargeError } from "./errors.ts";

/** Decode and check a specification. Throws a `WireError`. */
export function decodeScene(bytes: Uint8Array): SceneSpec {
  if (bytes.length > MAX_SCENE_BYTES) throw new TooLargeError("a scene specification", bytes.length, MAX_SCENE_BYTES);
  const spec = decodeStruct("SceneSpec", bytes) as SceneSpec;
  if (spec.version !== SCENE_VERSION) {
    throw new MalformedError(`scene specification version ${spec.version}, this page reads ${SCENE_VERSION}: reload it`);
  }
  checkScene(spec);
  return spec;
}

/** Throw `MalformedError` unless every reference has its target and every id is unique. */
export function checkScene(spec: SceneSpec): void {
  const bodies = checkIds("bodies", spec.bodies);
  const sites = checkIds("sites", spec.sites);
  checkIds("visuals", spec.visuals);
  const before = new Set([-1]);
  for (const body of spec.bodies) {
    if (!before.has(body.parent)) throw new MalformedError(`body ${body.id} has the parent ${body.parent}, which is not listed before it`);
    before.add(body.id);
  }
  for (const thing of [...spec.visuals, ...spec.sites, ...spec.lights, ...spec.cameras]) {
    if (!bodies.has(thing.body)) throw new MalformedError(`${thing.name} is on body ${thing.body}: no such body`);
  }
  for (const watcher of [...spec.lights, ...spec.cameras]) {
    if (watcher.target !== -1 && !bodies.has(watcher.target)) throw new MalformedError(`${watcher.name} looks at body ${watcher.target}: no such body`);
  }
  for (const { geometry } of [...spec.visuals, ...spec.sites]) {
    checkReference("mesh", geometry.mesh, spec.meshes.length);
    checkReference("height field", geometry.hfield, spec.hfields.length);
  }
  for (const one of [...spec.visuals, ...spec.sites, ...spec.tendons, ...spec.deformables]) {
    checkReference("material", one.material, spec.materials.length);
  }
  for (const material of spec.materials) {
    for (const use of material.textures) checkReference("texture", use.texture, spec.textures.length);
  }
  for (const light of spec.lights) checkReference("texture", light.texture, spec.textures.length);
  checkReference("texture", spec.environment.skybox, spec.textures.length);
  for (const tendon of spec.tendons) {
    if (!tendon.sites.every((site) => sites.has(site))) throw new MalformedError(`tendon ${tendon.name} runs through a site that is not there`);
  }
  if ([...spec.meshes, ...spec.textures].some((entry) => entry.levels.length === 0)) throw new MalformedError("a mesh or texture has no level");
}

function checkIds(what: string, things: readonly { id: number }[]): Set<number> {
  const ids = new Set(things.map((thing) => thing.id));
  if (ids.size !== things.length) throw new MalformedError(`two ${what} have the same id`);
  return ids;
}

function checkReference(what: string, index: number, count: number): void {
  if (index >= count) throw new MalformedError(`reference to ${what} ${index}, but there are ${count}`);
}
