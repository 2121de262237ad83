// Merged meshes show what they showed before: the same triangles at the same places.

import { BoxGeometry, type BufferGeometry, Group, Mesh, ShaderMaterial, SphereGeometry, Vector3 } from "three";
import { expect, test } from "vitest";

import { mergeMeshes } from "../../src/view/merging.ts";

function addMesh(body: Group, geometry: BufferGeometry, material: ShaderMaterial, x: number): Mesh {
  const mesh = new Mesh(geometry, material);
  mesh.position.set(x, 0, 0);
  mesh.rotation.set(0, 0, Math.PI / 2);
  mesh.updateMatrix();
  body.add(mesh);
  return mesh;
}

/** Return the vertices of all meshes of a body, and their normals, in the body's frame, sorted. */
function listVertices(body: Group): string[] {
  const found: string[] = [];
  for (const child of body.children as Mesh[]) {
    const { position, normal } = child.geometry.attributes;
    const index = child.geometry.getIndex()!;
    for (let k = 0; k < index.count; k++) {
      const at = new Vector3().fromBufferAttribute(position!, index.getX(k)).applyMatrix4(child.matrix);
      const to = new Vector3().fromBufferAttribute(normal!, index.getX(k)).transformDirection(child.matrix);
      found.push([...at.toArray(), ...to.toArray()].map((value) => (Math.round(value * 1e4) / 1e4 + 0).toFixed(4)).join());
    }
  }
  return found.sort();
}

test("meshes that look the same become one, and nothing moves", () => {
  const [grey, red, glass] = [new ShaderMaterial(), new ShaderMaterial(), new ShaderMaterial({ transparent: true })];
  const [body, shared] = [new Group(), new BoxGeometry(1, 2, 3)];
  for (const x of [0, 1, 2]) addMesh(body, shared, grey, x);
  addMesh(body, new SphereGeometry(0.5), grey, 3);
  addMesh(body, shared, red, 4);
  for (const x of [5, 6]) addMesh(body, shared, glass, x);
  const before = listVertices(body);

  const made = mergeMeshes(body);

  expect(made).toHaveLength(1);
  expect(body.children).toHaveLength(4); // the grey ones, the red one, two of glass
  expect(listVertices(body)).toEqual(before);
  expect(shared.getAttribute("position").getX(0)).toBe(0.5); // the source is as it was
});

test("many meshes that share many vertices go on sharing them", () => {
  const [body, material, shared] = [new Group(), new ShaderMaterial(), new SphereGeometry(1, 100, 100)];
  for (let x = 0; x < 30; x++) addMesh(body, shared, material, x);
  expect(mergeMeshes(body)).toHaveLength(0);
  expect(body.children).toHaveLength(30);
});

test("planes, what casts a shadow and what does not, and large meshes stay apart", () => {
  const [body, material, box] = [new Group(), new ShaderMaterial(), new BoxGeometry()];
  const [plane, shaded] = [addMesh(body, box, material, 0), addMesh(body, box, material, 1)];
  const [plain, large] = [addMesh(body, box, material, 2), addMesh(body, new SphereGeometry(1, 200, 200), material, 3)];
  plane.userData.isPlane = true;
  shaded.castShadow = true;

  expect(mergeMeshes(body)).toHaveLength(0);
  expect(body.children).toEqual([plane, shaded, plain, large]);
});
