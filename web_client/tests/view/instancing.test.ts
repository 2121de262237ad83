// Equal shapes of many bodies are drawn at once, and look as they did before.

import { BufferGeometry, Color, Group, InstancedMesh, Matrix4, Mesh, Vector3 } from "three";
import { expect, test } from "vitest";

import type { SceneSpec } from "../../src/core/api.ts";
import { encodeStruct } from "../../src/core/codec.ts";
import { decodeScene } from "../../src/core/scene.ts";
import type { AssetSource } from "../../src/view/arrays.ts";
import { DESKTOP } from "../../src/view/budget.ts";
import { SceneView } from "../../src/view/scene_view.ts";

interface Part {
  kind: string;
  size: [number, number, number];
  rgba: [number, number, number, number];
}

/** A scene in which every part is a body of its own, at (i, 2 i, 0), its shape turned and 0.5 above it. */
async function makeScene(parts: readonly Part[]): Promise<SceneView> {
  const half = Math.SQRT1_2;
  const spec: SceneSpec = decodeScene(
    encodeStruct("SceneSpec", {
      name: "many",
      bodies: parts.map((_, i) => {
        const place = [[i, 2 * i, 0], [1, 0, 0, 0]];
        return { id: i + 1, name: `body ${i}`, parent: -1, T_parent_body: place, T_world_body: place, moving: true };
      }),
      visuals: parts.map(({ kind, size, rgba }, i) => ({
        id: i, body: i + 1, name: `part ${i}`, T_body_visual: [[0, 0, 0.5], [half, 0, 0, half]], group: 0,
        geometry: { kind, size, mesh: -1 }, material: -1, rgba,
      })),
    }),
  );
  const view = new SceneView(spec, {} as AssetSource, { budget: DESKTOP, anisotropy: 1, onProblem: (text) => expect.fail(text) });
  await view.complete;
  view.world.updateMatrixWorld(true);
  return view;
}

/** Return the meshes that are drawn. */
function listDrawn(view: SceneView): Mesh[] {
  const found: Mesh[] = [];
  view.world.traverse((object) => object instanceof Mesh && found.push(object));
  return found;
}

/** Return the corners of instance `i` in the world with their normals, each once: triangles without an area may be missing. */
function readInstance(object: InstancedMesh, i: number): string[] {
  const matrix = new Matrix4();
  object.getMatrixAt(i, matrix);
  return readCorners(object.geometry, matrix);
}

function readCorners(geometry: BufferGeometry, matrix: Matrix4): string[] {
  const { position, normal } = geometry.attributes;
  const turn = matrix.clone().invert().transpose();
  const index = geometry.getIndex()!;
  const found = Array.from({ length: index.count }, (_, k) => {
    const at = new Vector3().fromBufferAttribute(position!, index.getX(k)).applyMatrix4(matrix);
    const to = new Vector3().fromBufferAttribute(normal!, index.getX(k)).transformDirection(turn);
    return [...at.toArray(), ...to.toArray()].map((value) => (Math.round(value * 1e3) / 1e3 + 0).toFixed(3)).join();
  });
  return [...new Set(found)].sort();
}

const COLORS = ["red", "lime", "blue", "gray", "teal"].map((name): Part["rgba"] => [...new Color(name).toArray(), 1] as Part["rgba"]);

test("shapes of one kind are one object, whatever their sizes and colours, and follow their bodies", async () => {
  for (const kind of ["box", "ellipsoid", "cylinder", "capsule"]) {
    const sizes = COLORS.map((_, i): Part["size"] => (kind === "capsule" ? [0.1 + i, 0.1 + i, 0.2 + 2 * i] : [1 + i, 2, 3]));
    const parts = COLORS.map((rgba, i): Part => ({ kind, size: sizes[i]!, rgba }));
    const view = await makeScene(parts);
    const [object, ...others] = listDrawn(view) as InstancedMesh[];
    expect(others).toEqual([]);
    const alone = await Promise.all(parts.map((part) => makeScene([part])));
    const tints = object!.geometry.getAttribute("tint");
    for (const [i, one] of alone.entries()) {
      const body = view.bodies.get(i + 1)!;
      body.position.set(-i, 0.5, 1);
      body.updateMatrix();
      const [mesh] = listDrawn(one);
      view.placeInstances();
      expect(readInstance(object!, i)).toEqual(readCorners(mesh!.geometry, body.matrix.clone().multiply(mesh!.matrix)));
      expect([tints.getX(i), tints.getY(i), tints.getZ(i)]).toEqual([...new Float32Array(parts[i]!.rgba)].slice(0, 3));
      expect(object!.userData.bodies[i]).toBe(i + 1);
    }
  }
});

test("a body that has diverged is not drawn, and comes back", async () => {
  const view = await makeScene(COLORS.map((rgba) => ({ kind: "box", size: [1, 1, 1], rgba })));
  const [object] = listDrawn(view) as [InstancedMesh];
  const matrix = new Matrix4();
  const isDrawn = (): boolean => (object.getMatrixAt(2, matrix), matrix.determinant() !== 0);
  for (const visible of [true, false, true]) {
    view.bodies.get(3)!.visible = visible;
    view.placeInstances();
    expect(isDrawn()).toBe(visible);
  }
});

test("what is transparent, or rare, is drawn as it was", async () => {
  const glass = COLORS.map(([r, g, b]): Part => ({ kind: "sphere", size: [1, 1, 1], rgba: [r, g, b, 0.5] }));
  const few = COLORS.slice(0, 3).map((rgba): Part => ({ kind: "box", size: [1, 1, 1], rgba }));
  const view = await makeScene([...glass, ...few]);
  const drawn = listDrawn(view);
  expect(drawn).toHaveLength(8);
  expect(drawn.every((mesh) => !(mesh instanceof InstancedMesh) && mesh.parent instanceof Group)).toBe(true);
});
