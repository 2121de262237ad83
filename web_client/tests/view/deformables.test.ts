// Cloths: what is drawn of a sheet of vertices.

import { type BufferAttribute, type Mesh, ShaderLib, type ShaderMaterial, type WebGLRenderer } from "three";
import { expect, test } from "vitest";

import { SheetBuilder } from "../../src/core/sheet.ts";
import { type DeformableFrame, type DeformableView, makeDeformable } from "../../src/view/deformables.ts";
import type { Deformable } from "../../src/view/spec.ts";

const SIDE = 3;
const RADIUS = 0.01;
/** A grid of vertices in the plane z = 0, two triangles for each square. */
const POSITION = Float32Array.from({ length: 3 * SIDE * SIDE }, (_, i) => [Math.floor(i / 3) % SIDE, Math.floor(i / 3 / SIDE), 0][i % 3]!);
const ELEMENTS = Uint16Array.from(
  [0, 1].flatMap((y) => [0, 1].flatMap((x) => [0, 1, SIDE + 1, 0, SIDE + 1, SIDE].map((k) => k + x + SIDE * y))),
);
const FACES = ELEMENTS.length / 3;
const RIM = 4 * (SIDE - 1);

/** A cloth, and its frames at heights [m]. */
class Cloth {
  private readonly part: Deformable;
  readonly view: DeformableView;
  private readonly builder: SheetBuilder;

  constructor(part: Partial<Deformable>, uv?: Float32Array) {
    this.part = { name: "cloth", stream: "flex-0", vertices: SIDE * SIDE, dim: 2, radius: RADIUS, flat: false, ...part } as Deformable;
    this.view = makeDeformable(this.part, { position: POSITION, elements: ELEMENTS, uv }, {} as ShaderMaterial);
    this.builder = new SheetBuilder(this.part, SIDE * SIDE, { elements: ELEMENTS, uv });
  }

  makeFrame(height: number, content: number): DeformableFrame {
    const values = POSITION.map((value, i) => (i % 3 === 2 ? height : value));
    return { session_ms: 0, values, surface: this.builder.build(values), content };
  }

  get(name: string): BufferAttribute {
    const { geometry } = this.view.object as Mesh;
    return (name === "index" ? geometry.index! : geometry.getAttribute(name)) as BufferAttribute;
  }

  /** Heights of the first point in the frame before and after, and the uniform, as the graphics card gets them. */
  get drawn(): number[] {
    const material = { uniforms: { share: { value: -1 } } };
    const { object } = this.view;
    object.onBeforeRender(null!, null!, null!, null!, material as unknown as ShaderMaterial, null!);
    const heights = ["position", "nextPosition"].map((name) => Math.round(100 * (this.get(name).getZ(0) - RADIUS)) / 100 + 0); // -0 is 0
    return [...heights, material.uniforms.share.value];
  }
}

function draw(part: Partial<Deformable>, uv?: Float32Array): (name: string) => BufferAttribute {
  const cloth = new Cloth(part, uv);
  const frame = cloth.makeFrame(0.5, 1);
  expect(cloth.view.show({ before: frame, after: frame, share: 0 })).toBe(true);
  return (name) => cloth.get(name);
}

test.each([false, true])("both sides of a thick sheet follow its vertices, flat: %s", (flat) => {
  const get = draw({ flat });
  expect(get("index").count).toBe(2 * 3 * FACES + 6 * RIM);
  const [positions, normals] = [get("position"), get("normal")];
  for (let k = 0; k < 2 * 3 * FACES; k++) {
    const at = get("index").getX(k);
    const side = k < 3 * FACES ? 1 : -1;
    expect(normals.getZ(at)).toBeCloseTo(side);
    expect(positions.getZ(at)).toBeCloseTo(0.5 + side * RADIUS);
  }
  for (let k = 2 * 3 * FACES; k < get("index").count; k++) expect(normals.getZ(get("index").getX(k))).toBeCloseTo(0);
});

test("triangles share their vertices, unless they are flat or the texture has a seam", () => {
  expect(draw({})("position").count).toBe(2 * SIDE * SIDE + 6 * RIM);
  expect(draw({ flat: true })("position").count).toBe(2 * 3 * FACES + 6 * RIM);
  const uv = Float32Array.from({ length: 2 * ELEMENTS.length }, (_, i) => Math.floor(i / 6)); // each triangle elsewhere
  expect(draw({}, uv)("position").count).toBe(2 * 3 * FACES + 6 * RIM);
  expect(draw({ radius: 0 })("position").count).toBe(SIDE * SIDE);
});

test("the graphics card gets every frame once, and what is between two by a number", () => {
  const cloth = new Cloth({});
  const [first, second, third] = [cloth.makeFrame(1, 1), cloth.makeFrame(2, 2), cloth.makeFrame(3, 3)];
  expect(cloth.view.show({ before: first, after: second, share: 0.25 })).toBe(true);
  expect(cloth.drawn).toEqual([1, 2, 0.25]);
  const versions = (): number[] => ["position", "nextPosition"].map((name) => cloth.get(name).version);
  const before = versions();
  expect(cloth.view.show({ before: first, after: second, share: 0.75 })).toBe(true);
  expect(cloth.drawn).toEqual([1, 2, 0.75]);
  expect(versions()).toEqual(before);
  expect(cloth.view.show({ before: second, after: third, share: 0.5 })).toBe(true);
  expect(cloth.drawn).toEqual([2, 3, 0.5]);
  expect(cloth.get("position").version).toBe(before[1]); // it was there already
});

test("a sheet that lies still changes nothing", () => {
  const cloth = new Cloth({});
  const rest = cloth.makeFrame(1, 1);
  expect(cloth.view.show({ before: rest, after: { ...rest, session_ms: 1000 }, share: 0.3 })).toBe(true);
  expect(cloth.view.show({ before: rest, after: { ...rest, session_ms: 1000 }, share: 0.6 })).toBe(false);
  expect(cloth.view.show({ before: { ...rest, session_ms: 1000 }, after: { ...rest, session_ms: 2000 }, share: 0.1 })).toBe(false);
  expect(cloth.drawn).toEqual([1, 0, 0]);
});

test("a surface that is missing, or of a sheet that is drawn otherwise, is built of the vertices", () => {
  const cloth = new Cloth({});
  const frames = [{ ...cloth.makeFrame(2, 1), surface: null }, { ...new Cloth({ flat: true }).makeFrame(3, 2) }] as const;
  expect(cloth.view.show({ before: frames[0], after: frames[1], share: 0.5 })).toBe(true);
  expect(cloth.drawn).toEqual([2, 3, 0.5]);
});

test("frames of another topology are ignored", () => {
  const cloth = new Cloth({});
  const other: DeformableFrame = { session_ms: 0, values: new Float32Array(3), surface: null, content: 1 };
  expect(cloth.view.show({ before: other, after: other, share: 0 })).toBe(false);
  expect(cloth.drawn).toEqual([0, 0, 0]);
});

test("a surface is written into one that is not needed any more, if that has as many points", () => {
  const [thick, flat] = [new SheetBuilder({ dim: 2, radius: RADIUS, flat: false }, SIDE * SIDE, { elements: ELEMENTS }), new SheetBuilder({ dim: 2, radius: RADIUS, flat: true }, SIDE * SIDE, { elements: ELEMENTS })];
  const spare = thick.build(POSITION)!;
  const expected = thick.build(POSITION.map((value) => value + 1))!;
  const surface = thick.build(POSITION.map((value) => value + 1), spare)!;
  expect(surface.position).toBe(spare.position);
  expect([surface.position, surface.normal]).toEqual([expected.position, expected.normal]);
  expect(flat.build(POSITION, spare)!.position).not.toBe(spare.position);
});

test("shadow maps show a sheet where it is drawn: between two frames", () => {
  const cloth = new Cloth({});
  const shader = { ...ShaderLib.depth, uniforms: {} as Record<string, { value: number }> };
  const material = (cloth.view.object as Mesh).customDepthMaterial!;
  material.onBeforeCompile(shader as unknown as Parameters<typeof material.onBeforeCompile>[0], {} as WebGLRenderer);
  expect(shader.vertexShader).toContain("attribute vec3 nextPosition;");
  expect(shader.vertexShader).toContain("mix(transformed, nextPosition, share)");
  cloth.view.show({ before: cloth.makeFrame(1, 1), after: cloth.makeFrame(2, 2), share: 0.25 });
  expect(shader.uniforms.share!.value).toBe(0.25);
});
