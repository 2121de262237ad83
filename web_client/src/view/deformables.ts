// Cloths, soft bodies and ropes: vertices that come with every frame of a stream, interpolated like bodies. The surface
// of cloths and soft bodies is computed in the worker, and interpolated by the graphics card.

import {
  BufferAttribute,
  BufferGeometry,
  DynamicDrawUsage,
  InstancedMesh,
  Matrix4,
  Mesh,
  MeshDepthMaterial,
  type Object3D,
  Quaternion,
  type ShaderMaterial,
  Vector3,
} from "three";

import { SheetBuilder, type Surface } from "../core/sheet.ts";
import type { DeformableArrays } from "./arrays.ts";
import { type Between, interpolateValues, type TimedFrame } from "./interpolation.ts";
import { buildPrimitive } from "./shapes.ts";
import type { Deformable } from "./spec.ts";

/**
 * A frame of a deformable. `values`: its vertices, in the session's world. `surface`: what is drawn of them, as in
 * `DeformableUpdate`. `content`: frames with the same number have the same vertices.
 */
export interface DeformableFrame extends TimedFrame {
  surface: Surface | null;
  content: number;
}

/** One deformable. */
export interface DeformableView {
  readonly object: Object3D;
  readonly stream: string;
  /** Show what lies between two frames, unless they are of another topology. Returns whether the picture has changed. */
  show(found: Between<DeformableFrame>): boolean;
  dispose(): void;
}

/** Make a deformable as it lies at first. `material`: of `makeSurface`, where it is no rope with `isInterpolated`. */
export function makeDeformable(part: Deformable, arrays: DeformableArrays, material: ShaderMaterial): DeformableView {
  const view = part.dim === 1 ? new RopeView(part, arrays, material) : new SheetView(part, arrays, material);
  view.object.name = part.name;
  view.object.frustumCulled = false;
  view.object.castShadow = true;
  view.object.receiveShadow = true;
  return view;
}

/** Points and normals of one frame on the graphics card. `content`: of the frame, -1 for the sheet as it lies at first. */
interface UploadedFrame {
  position: BufferAttribute;
  normal: BufferAttribute;
  content: number;
}

/** A cloth or soft body: the frames before and after are on the graphics card, and a uniform says what is between. */
class SheetView implements DeformableView {
  readonly object: Mesh;
  readonly stream: string;
  private readonly geometry = new BufferGeometry();
  private readonly builder: SheetBuilder;
  private readonly vertexValues: number;
  private readonly depthMaterial: MeshDepthMaterial;
  private readonly share = { value: 0 };
  private before: UploadedFrame;
  private after: UploadedFrame;

  constructor(part: Deformable, arrays: DeformableArrays, material: ShaderMaterial) {
    this.stream = part.stream;
    const { position } = arrays;
    this.vertexValues = position.length;
    this.builder = new SheetBuilder(part, position.length / 3, arrays);
    const rest = this.builder.build(position)!;
    this.before = makeAttributes(rest);
    this.after = makeAttributes(rest);
    this.geometry.setIndex(new BufferAttribute(this.builder.index, 1));
    if (this.builder.uv) this.geometry.setAttribute("uv", new BufferAttribute(this.builder.uv, 2));
    this.setAttributes();
    this.object = new Mesh(this.geometry, material);
    // Sheets that look alike share their material, so the uniform is set for each. Masks have a material without it.
    this.object.onBeforeRender = (_renderer, _scene, _camera, _geometry, drawnWith) => {
      const { uniforms } = drawnWith as ShaderMaterial;
      if (!uniforms?.share) return;
      uniforms.share.value = this.share.value;
      (drawnWith as ShaderMaterial).uniformsNeedUpdate = true;
    };
    this.depthMaterial = makeDepthMaterial(this.share);
    this.object.customDepthMaterial = this.depthMaterial;
  }

  show({ before, after, share }: Between<DeformableFrame>): boolean {
    if (before.values.length !== this.vertexValues || after.values.length !== this.vertexValues) return false;
    let isChanged = before.content !== this.before.content;
    if (isChanged) {
      if (before.content === this.after.content) [this.before, this.after] = [this.after, this.before];
      else this.upload(this.before, before);
      this.setAttributes();
    }
    const shareNow = after.content === before.content ? 0 : share;
    if (shareNow > 0 && after.content !== this.after.content) {
      this.upload(this.after, after);
      isChanged = true;
    }
    isChanged ||= shareNow !== this.share.value;
    this.share.value = shareNow;
    return isChanged;
  }

  dispose(): void {
    this.geometry.dispose();
    this.depthMaterial.dispose();
  }

  /** Copy a surface, since it is given back. That of a frame from before the scene was changed may not be of this sheet. */
  private upload(target: UploadedFrame, { surface, values, content }: DeformableFrame): void {
    const isMine = surface?.position.length === target.position.array.length;
    const { position, normal } = isMine ? surface : this.builder.build(values)!;
    (target.position.array as Float32Array).set(position);
    (target.normal.array as Float32Array).set(normal);
    target.position.needsUpdate = target.normal.needsUpdate = true;
    target.content = content;
  }

  private setAttributes(): void {
    this.geometry.setAttribute("position", this.before.position);
    this.geometry.setAttribute("normal", this.before.normal);
    this.geometry.setAttribute("nextPosition", this.after.position);
    this.geometry.setAttribute("nextNormal", this.after.normal);
  }
}

function makeAttributes(surface: Surface): UploadedFrame {
  const make = (values: Float32Array): BufferAttribute => new BufferAttribute(values.slice(), 3).setUsage(DynamicDrawUsage);
  return { position: make(surface.position), normal: make(surface.normal), content: -1 };
}

/** Return the material of shadow maps: points lie where `surface.ts` draws them, or a sheet in motion would shade itself. */
function makeDepthMaterial(share: { value: number }): MeshDepthMaterial {
  const material = new MeshDepthMaterial();
  material.onBeforeCompile = (shader) => {
    shader.uniforms.share = share;
    shader.vertexShader = shader.vertexShader
      .replace("#include <common>", "#include <common>\nattribute vec3 nextPosition;\nuniform float share;")
      .replace("#include <begin_vertex>", "#include <begin_vertex>\nif (share > 0.0) transformed = mix(transformed, nextPosition, share);");
  };
  return material;
}

/** A rope: a cylinder for each piece. */
class RopeView implements DeformableView {
  readonly object: InstancedMesh;
  readonly stream: string;
  private readonly geometry = new BufferGeometry();
  private readonly elements: Uint16Array | Uint32Array;
  private readonly radius: number;
  private readonly vertices: Float32Array;

  constructor(part: Deformable, arrays: DeformableArrays, material: ShaderMaterial) {
    this.stream = part.stream;
    this.elements = arrays.elements;
    this.radius = Math.max(part.radius, 0.001);
    this.vertices = arrays.position.slice();
    const shape = buildPrimitive({ kind: "cylinder", size: [1, 1, 0.5], mesh: -1, hfield: -1 });
    this.geometry.setAttribute("position", new BufferAttribute(shape.position, 3));
    this.geometry.setAttribute("normal", new BufferAttribute(shape.normal, 3));
    this.geometry.setIndex(new BufferAttribute(shape.index, 1));
    this.object = new InstancedMesh(this.geometry, material, this.elements.length / 2);
    this.place();
  }

  show({ before, after, share }: Between<DeformableFrame>): boolean {
    if (before.values.length !== this.vertices.length || after.values.length !== this.vertices.length) return false;
    const isChanged = interpolateValues(before.values, after.values, share, this.vertices);
    if (isChanged) this.place();
    return isChanged;
  }

  dispose(): void {
    this.geometry.dispose();
  }

  private place(): void {
    const [a, b, matrix] = [new Vector3(), new Vector3(), new Matrix4()];
    for (let i = 0; i < this.elements.length / 2; i++) {
      a.fromArray(this.vertices, 3 * this.elements[2 * i]!);
      b.fromArray(this.vertices, 3 * this.elements[2 * i + 1]!);
      this.object.setMatrixAt(i, spanPiece(a, b, this.radius, matrix));
    }
    this.object.instanceMatrix.needsUpdate = true;
  }
}

const Z = new Vector3(0, 0, 1);

/** Return the matrix that lays a cylinder of radius 1 and height 1 between two points: a piece of a rope or tendon. */
export function spanPiece(a: Vector3, b: Vector3, radius: number, out = new Matrix4()): Matrix4 {
  const along = new Vector3().subVectors(b, a);
  const length = along.length();
  const turn = new Quaternion().setFromUnitVectors(Z, length > 0 ? along.divideScalar(length) : Z);
  return out.compose(new Vector3().addVectors(a, b).multiplyScalar(0.5), turn, new Vector3(radius, radius, length));
}
