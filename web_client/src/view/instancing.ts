// Fewer objects to draw: shapes of different bodies that are equal become one draw call, each with its own colour. Boxes,
// round shapes and capsules of one form are equal whatever their size.

import {
  BufferGeometry,
  DynamicDrawUsage,
  type Group,
  InstancedBufferAttribute,
  InstancedMesh,
  Matrix4,
  Mesh,
  type ShaderMaterial,
  StaticDrawUsage,
  Vector3,
} from "three";

import type { Geometry } from "./spec.ts";
import { type Look, PLAIN } from "./surface.ts";

/** Fewer than these are merged with what else is on their bodies, or drawn as they are. */
export const LEAST_EQUAL = 4;
const GONE = new Matrix4().makeScale(0, 0, 0);
const scratch = new Matrix4();

/** Equal shapes on several bodies. `userData.bodies`: id of the body of each instance, for picking. */
export interface Instances {
  readonly object: InstancedMesh;
  /** Move those that move to where their bodies are. */
  place(): void;
}

/** What `instanceMeshes` makes. `made`: to be disposed of by the caller. */
export interface InstancedShapes {
  instances: Instances[];
  made: { dispose(): void }[];
}

/** One instance: its number, and where it is on its body. */
interface Row {
  i: number;
  body: Group;
  T_body_unit: Matrix4;
}

/** The form of a shape, and its size in units of that. */
interface Form {
  key: string;
  unit: Geometry;
  scale: Vector3;
}

/** Return the form of a shape without an asset, null for one with it: that is equal only to itself. */
export function findForm(geometry: Geometry): Form | null {
  const [x, y, z] = geometry.size;
  if (geometry.mesh >= 0 || geometry.hfield >= 0 || !(Math.min(x, y, z) > 0)) return null;
  const shape = (kind: string, size: [number, number, number], scale: Vector3): Form => ({
    key: `${kind} ${size.join()}`,
    unit: { ...geometry, kind, size },
    scale,
  });
  switch (geometry.kind) {
    case "sphere":
    case "ellipsoid":
      return shape("ellipsoid", [1, 1, 1], new Vector3(x, y, z));
    case "cylinder":
    case "box":
      return shape(geometry.kind, [1, 1, 1], new Vector3(x, y, z));
    case "capsule":
      return shape("capsule", [1, 1, Number((z / x).toPrecision(6))], new Vector3(x, x, x));
    default:
      return null;
  }
}

/**
 * Replace equal opaque meshes of bodies by instances. What is transparent stays apart, because it is sorted by distance,
 * and so do planes, which are hidden by themselves.
 *
 * `bodies`: by id. `moving`: those that may move. `makeTinted` returns the material of a look whose colour each instance brings; `makeUnit` the
 * geometry of a form.
 */
export function instanceMeshes(
  bodies: ReadonlyMap<number, Group>,
  moving: ReadonlySet<number>,
  makeTinted: (look: Look) => ShaderMaterial,
  makeUnit: (unit: Geometry) => BufferGeometry,
): InstancedShapes {
  const equal = new Map<string, { id: number; body: Group; mesh: Mesh<BufferGeometry, ShaderMaterial>; form: Form | null }[]>();
  for (const [id, body] of bodies) {
    for (const child of body.children) {
      if (!(child instanceof Mesh) || child.userData.isPlane || child.children.length > 0) continue;
      const mesh = child as Mesh<BufferGeometry, ShaderMaterial>;
      const look = mesh.material.userData.look as Look | undefined;
      if (!look || mesh.material.transparent) continue;
      const form = look.map || look.cube ? null : findForm(mesh.userData.geometry as Geometry);
      const key = `${form ? form.key : mesh.geometry.uuid} ${keyOfLook(look)} ${mesh.castShadow}`;
      const found = equal.get(key) ?? [];
      found.push({ id, body, mesh, form });
      equal.set(key, found);
    }
  }
  const result: InstancedShapes = { instances: [], made: [] };
  for (const parts of equal.values()) {
    // What is of one material on one body can be merged.
    if (new Set(parts.map(({ id, mesh }) => `${id} ${mesh.material.uuid}`)).size < LEAST_EQUAL) continue;
    const { mesh: first, form } = parts[0]!;
    const material = makeTinted(first.material.userData.look as Look);
    const geometry = form ? makeUnit(form.unit) : shareGeometry(first.geometry);
    const tints = new Float32Array(3 * parts.length);
    parts.forEach(({ mesh }, i) => tints.set((mesh.material.userData.look as Look).rgba.slice(0, 3), 3 * i));
    geometry.setAttribute("tint", new InstancedBufferAttribute(tints, 3));
    const object = new InstancedMesh(geometry, material, parts.length);
    object.name = first.name;
    object.castShadow = first.castShadow;
    object.receiveShadow = true;
    object.frustumCulled = false; // its instances are everywhere
    object.matrixAutoUpdate = false;
    object.matrixWorldNeedsUpdate = true;
    object.userData.bodies = parts.map(({ id }) => id);
    const rows = parts.map(({ id, body, mesh, form: own }, i) => ({ i, id, body, T_body_unit: own ? mesh.matrix.clone().scale(own.scale) : mesh.matrix }));
    for (const { body, mesh } of parts) body.remove(mesh);
    placeRows(object, rows);
    const moved = rows.filter(({ id }) => moving.has(id));
    object.instanceMatrix.setUsage(moved.length > 0 ? DynamicDrawUsage : StaticDrawUsage);
    result.instances.push({ object, place: () => placeRows(object, moved) });
    result.made.push(geometry, object);
  }
  return result;
}

function placeRows({ instanceMatrix }: InstancedMesh, rows: readonly Row[]): void {
  for (const { i, body, T_body_unit } of rows) {
    (body.visible ? scratch.multiplyMatrices(body.matrix, T_body_unit) : GONE).toArray(instanceMatrix.array, 16 * i);
  }
  if (rows.length > 0) instanceMatrix.needsUpdate = true;
}

/** Return a geometry with the vertices of another one, to which more attributes can be added. */
function shareGeometry({ attributes, index }: BufferGeometry): BufferGeometry {
  const made = new BufferGeometry().setIndex(index);
  for (const [name, attribute] of Object.entries(attributes)) made.setAttribute(name, attribute);
  return made;
}

/** Return what two looks have in common that may differ in colour only. A metal's highlights have its colour. */
function keyOfLook({ rgba, material, map, cube, ...flags }: Look): string {
  const { emission, specular, shininess, metallic, roughness } = material ?? PLAIN;
  const color = metallic > 0 ? rgba : [];
  return JSON.stringify([emission, specular, shininess, metallic, roughness, color, map?.uuid, cube?.uuid, flags]);
}
