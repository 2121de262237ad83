// Fewer objects to draw: visuals of one body that look the same become one mesh. Drawing a mesh costs three.js some
// microseconds on the main thread, however small it is.

import { type BufferGeometry, type Group, Mesh, type ShaderMaterial } from "three";
import { mergeGeometries } from "three/examples/jsm/utils/BufferGeometryUtils.js";

/** Vertices of a mesh, and of a merged one, at most: meshes share their vertices with others, and merging copies them. */
const MAX_VERTICES = 20_000;
const MAX_MERGED_VERTICES = 200_000;

/**
 * Merge the opaque meshes of one body that share material and attributes. What is transparent stays apart, because it
 * is sorted by distance, and so do planes, which are hidden by themselves.
 *
 * Returns the geometries that were made; the caller disposes of them.
 */
export function mergeMeshes(body: Group): BufferGeometry[] {
  const alike = new Map<string, Mesh<BufferGeometry, ShaderMaterial>[]>();
  for (const child of body.children) {
    if (!(child instanceof Mesh) || child.userData.isPlane || child.children.length > 0) continue;
    const { geometry, material, castShadow } = child as Mesh<BufferGeometry, ShaderMaterial>;
    if (material.transparent || geometry.getAttribute("position").count > MAX_VERTICES) continue;
    const attributes = Object.entries(geometry.attributes).map(([name, { array }]) => `${name} ${array.constructor.name}`);
    const key = [material.uuid, castShadow, ...attributes.sort()].join();
    alike.set(key, [...(alike.get(key) ?? []), child as Mesh<BufferGeometry, ShaderMaterial>]);
  }
  const made: BufferGeometry[] = [];
  for (const meshes of alike.values()) {
    const [first] = meshes;
    const vertices = meshes.reduce((sum, mesh) => sum + mesh.geometry.getAttribute("position").count, 0);
    if (!first || meshes.length < 2 || vertices > MAX_MERGED_VERTICES) continue;
    const placed = meshes.map((mesh) => mesh.geometry.clone().applyMatrix4(mesh.matrix));
    const geometry = mergeGeometries(placed);
    const merged = new Mesh(geometry, first.material);
    merged.matrixAutoUpdate = false;
    merged.matrixWorldNeedsUpdate = true;
    merged.name = meshes.map((mesh) => mesh.name).join(" ");
    merged.castShadow = first.castShadow;
    merged.receiveShadow = true;
    body.remove(...meshes);
    body.add(merged);
    made.push(geometry);
  }
  return made;
}
