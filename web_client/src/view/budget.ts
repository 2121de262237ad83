// Levels of detail that fit what a device can draw. A port of iris_session/scene/budget.py: what loses least detail per
// triangle saved is coarsened first. Pure.

import { findForm, LEAST_EQUAL } from "./instancing.ts";
import type { Mesh, SceneSpec, Texture } from "./spec.ts";

/** Limits of what is drawn; but for `points`, 0 means no limit. */
export interface Budget {
  triangles: number;
  textureBytes: number;
  objects: number;
  /** Points of all clouds together. */
  points: number;
  /** Lights that cast shadows, each of which costs the scene drawn once more while something moves. */
  shadows: number;
  /** Side of a shadow map [pixels], and the shortest time between two of a light [ms]. */
  shadowSide: number;
  shadowPeriod_ms: number;
}

export interface LevelChoice {
  meshLevels: number[];
  textureLevels: number[];
  /** Ids of visuals that are left out, the smallest ones. */
  hidden: Set<number>;
  triangles: number;
  textureBytes: number;
}

/** Where a Quest 3 begins to struggle; good for phones too. */
export const HEADSET: Budget = {
  triangles: 750_000, textureBytes: 700 * 2 ** 20, objects: 200, points: 100_000,
  shadows: 1, shadowSide: 1024, shadowPeriod_ms: 30,
};
/** A desktop with a graphics card. */
export const DESKTOP: Budget = {
  triangles: 6_000_000, textureBytes: 2 ** 31, objects: 0, points: 1_000_000,
  shadows: 4, shadowSide: 2048, shadowPeriod_ms: 0,
};
/** No graphics card: the processor draws. */
export const SOFTWARE: Budget = {
  triangles: 300_000, textureBytes: 256 * 2 ** 20, objects: 0, points: 20_000,
  shadows: 1, shadowSide: 1024, shadowPeriod_ms: 100,
};

const PRIMITIVE_TRIANGLES: Record<string, number> = {
  plane: 2,
  box: 12,
  sphere: 960,
  ellipsoid: 960,
  cylinder: 128,
  capsule: 1024,
};

/** Return how many draw calls visuals take at most: equal shapes of many bodies are drawn at once. */
export function countDraws(shown: SceneSpec["visuals"], textured: ReadonlySet<number>): number {
  const equal = new Map<string, number>();
  for (const { geometry, material, rgba } of shown) {
    const isApart = rgba[3] < 1 || geometry.kind === "plane";
    const form = textured.has(material) ? null : findForm(geometry);
    const key = isApart ? "" : `${form?.key ?? JSON.stringify(geometry)} ${material}`;
    equal.set(key, (equal.get(key) ?? 0) + 1);
  }
  return [...equal].reduce((sum, [key, count]) => sum + (key === "" || count < LEAST_EQUAL ? count : 1), 0);
}

/** Choose the finest levels that fit. Deformables have no levels and are never left out. */
export function chooseLevels(spec: SceneSpec, budget: Budget): LevelChoice {
  const shown = spec.visuals.filter((v) => v.rgba[3] > 0 && spec.groups_shown.includes(v.group));
  const hidden = new Set<number>();
  const textured = new Set(spec.materials.flatMap(({ textures }, i) => (textures.length > 0 ? [i] : [])));
  if (budget.objects && countDraws(shown, textured) > budget.objects) {
    const bySize = [...shown].sort((a, b) => visualSize(spec, a) - visualSize(spec, b));
    for (const visual of bySize.slice(0, shown.length - budget.objects)) hidden.add(visual.id);
  }
  const kept = shown.filter((v) => !hidden.has(v.id));
  const uses = spec.meshes.map(() => 0);
  let triangles = spec.deformables.reduce((sum, part) => sum + (part.dim > 1 ? part.elements : 0), 0);
  for (const { geometry } of kept) {
    if (geometry.mesh >= 0) uses[geometry.mesh]! += 1;
    triangles += countTriangles(spec, geometry.mesh, geometry.hfield, geometry.kind);
  }
  const meshLevels = spec.meshes.map(() => 0);
  const textureLevels = spec.textures.map(() => 0);
  while (budget.triangles && triangles > budget.triangles) {
    const next = findCheapest(spec.meshes, meshLevels, uses);
    if (next < 0) break;
    const { levels } = spec.meshes[next]!;
    const level = meshLevels[next]!;
    triangles -= uses[next]! * (levels[level]!.triangles - levels[level + 1]!.triangles);
    meshLevels[next] = level + 1;
  }
  let textureBytes = spec.textures.reduce((sum, texture) => sum + textureMemory(texture, 0), 0);
  while (budget.textureBytes && textureBytes > budget.textureBytes) {
    const next = findLargest(spec.textures, textureLevels);
    if (next < 0) break;
    const texture = spec.textures[next]!;
    const level = textureLevels[next]!;
    textureBytes -= textureMemory(texture, level) - textureMemory(texture, level + 1);
    textureLevels[next] = level + 1;
  }
  return { meshLevels, textureLevels, hidden, triangles, textureBytes };
}

function countTriangles(spec: SceneSpec, mesh: number, hfield: number, kind: string): number {
  if (mesh >= 0) return spec.meshes[mesh]?.levels[0]?.triangles ?? 0;
  const field = hfield >= 0 ? spec.hfields[hfield] : undefined;
  if (field) return 2 * Math.max(0, field.rows - 1) * Math.max(0, field.columns - 1);
  return PRIMITIVE_TRIANGLES[kind] ?? 0;
}

function visualSize(spec: SceneSpec, { geometry }: SceneSpec["visuals"][number]): number {
  if (geometry.kind === "plane") return Infinity;
  const mesh = spec.meshes[geometry.mesh];
  if (mesh) return longestSide(mesh);
  return 2 * (Math.max(...geometry.size) + (geometry.kind === "capsule" ? geometry.size[0] : 0));
}

function longestSide(mesh: Mesh): number {
  return Math.max(...mesh.high.map((high, axis) => high - mesh.low[axis as 0 | 1 | 2]));
}

/** Return the mesh whose next level loses least of its size per triangle saved, -1 for none. */
function findCheapest(meshes: Mesh[], chosen: number[], uses: number[]): number {
  let [best, least] = [-1, Infinity];
  meshes.forEach((mesh, i) => {
    const [now, next] = [mesh.levels[chosen[i]!], mesh.levels[chosen[i]! + 1]];
    const saved = now && next ? uses[i]! * (now.triangles - next.triangles) : 0;
    if (saved <= 0) return;
    const loss = (next!.max_error_m + 1e-9) / Math.max(longestSide(mesh), 1e-6) / saved;
    if (loss < least) [best, least] = [i, loss];
  });
  return best;
}

function findLargest(textures: Texture[], chosen: number[]): number {
  let [best, most] = [-1, 0];
  textures.forEach((texture, i) => {
    const size = textureMemory(texture, chosen[i]!);
    if (chosen[i]! + 1 < texture.levels.length && size > most) [best, most] = [i, size];
  });
  return best;
}

/** Return the bytes on a graphics card: four a pixel, and a third more for mipmaps. */
function textureMemory(texture: Texture, level: number): number {
  const size = texture.levels[level];
  return size ? (size.width * size.height * 4 * (texture.kind === "2d" ? 1 : 6) * 4) / 3 : 0;
}
