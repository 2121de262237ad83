// Cloths, soft bodies and ropes: vertices that come with every frame of a stream, interpolated like bodies.

import {
  BufferAttribute,
  BufferGeometry,
  DynamicDrawUsage,
  InstancedMesh,
  Matrix4,
  Mesh,
  type Object3D,
  type ShaderMaterial,
  Vector3,
} from "three";

import type { DeformableArrays } from "./arrays.ts";
import { pieceBetween } from "./scene_view.ts";
import { buildPrimitive } from "./shapes.ts";
import type { Deformable } from "./spec.ts";

/** One deformable. `setVertices` takes the vertices of the whole, in the session's world. */
export class DeformableView {
  readonly object: Object3D;
  readonly stream: string;
  readonly vertices: number;
  private readonly geometry: BufferGeometry;
  private readonly write: (vertices: Float32Array) => void;

  constructor(part: Deformable, arrays: DeformableArrays, material: ShaderMaterial) {
    this.stream = part.stream;
    this.vertices = part.vertices;
    if (part.dim === 1) {
      [this.object, this.geometry, this.write] = makeRope(part, arrays, material);
    } else {
      [this.object, this.geometry, this.write] = makeSheet(part, arrays, material);
    }
    this.object.name = part.name;
    this.object.frustumCulled = false;
    this.object.castShadow = true;
    this.object.receiveShadow = true;
    this.write(arrays.position);
  }

  /** Move the vertices. Frames of another topology are ignored. */
  setVertices(vertices: Float32Array): void {
    if (vertices.length === 3 * this.vertices) this.write(vertices);
  }

  dispose(): void {
    this.geometry.dispose();
  }
}

type Made = [Object3D, BufferGeometry, (vertices: Float32Array) => void];

function makeRope(part: Deformable, arrays: DeformableArrays, material: ShaderMaterial): Made {
  const shape = buildPrimitive({ kind: "cylinder", size: [1, 1, 0.5], mesh: -1, hfield: -1 });
  const geometry = new BufferGeometry();
  geometry.setAttribute("position", new BufferAttribute(shape.position, 3));
  geometry.setAttribute("normal", new BufferAttribute(shape.normal, 3));
  geometry.setIndex(new BufferAttribute(shape.index, 1));
  const { elements } = arrays;
  const pieces = new InstancedMesh(geometry, material, elements.length / 2);
  const [a, b, matrix] = [new Vector3(), new Vector3(), new Matrix4()];
  const write = (vertices: Float32Array): void => {
    for (let i = 0; i < elements.length / 2; i++) {
      a.fromArray(vertices, 3 * elements[2 * i]!);
      b.fromArray(vertices, 3 * elements[2 * i + 1]!);
      pieces.setMatrixAt(i, pieceBetween(a, b, Math.max(part.radius, 0.001), matrix));
    }
    pieces.instanceMatrix.needsUpdate = true;
  };
  return [pieces, geometry, write];
}

/**
 * Triangles with normals computed here: per vertex, or per triangle where `flat`. A cloth has its thickness as MuJoCo
 * draws it: both sides are `radius` away from the vertices, with a rim between them.
 */
function makeSheet(part: Deformable, arrays: DeformableArrays, material: ShaderMaterial): Made {
  const { elements, uv } = arrays;
  const isThick = part.dim === 2 && part.radius > 0;
  const rim = isThick ? findRim(elements) : [];
  // Drawn points of one side: the vertices, once for each of their places in a texture, or every corner where it is flat.
  const vertex: number[] = [];
  const coordinate: number[] = [];
  const index: number[] = [];
  const known = new Map<string, number>();
  for (let c = 0; c < elements.length; c++) {
    const at = uv ? [uv[2 * c]!, uv[2 * c + 1]!] : [];
    const key = `${elements[c]!} ${at.join(" ")}`;
    const before = part.flat ? undefined : known.get(key);
    index.push(before ?? vertex.length);
    if (before !== undefined) continue;
    known.set(key, vertex.length);
    vertex.push(elements[c]!);
    coordinate.push(...at);
  }
  const upper = vertex.length;
  if (isThick) {
    for (let c = 0; c < elements.length; c += 3) for (const k of [0, 2, 1]) index.push(upper + index[c + k]!);
    for (let i = 0, n = coordinate.length; i < n; i++) coordinate.push(coordinate[i]!);
  }
  // Then the points of the rim, which share nothing: vertices and distances from them.
  const rimStart = isThick ? 2 * upper : upper;
  const offset: number[] = [];
  for (const [a, b, ca, cb] of rim) {
    for (const [v, sign, c] of [[a, 1, ca], [a, -1, ca], [b, -1, cb], [a, 1, ca], [b, -1, cb], [b, 1, cb]] as const) {
      index.push(rimStart + offset.length);
      vertex.push(v);
      offset.push(sign * part.radius);
      if (uv) coordinate.push(uv[2 * c]!, uv[2 * c + 1]!);
    }
  }
  const count = rimStart + offset.length;
  const position = new Float32Array(3 * count);
  const normal = new Float32Array(3 * count);
  const smooth = new Float32Array(3 * part.vertices);
  const geometry = new BufferGeometry();
  const positions = new BufferAttribute(position, 3).setUsage(DynamicDrawUsage);
  const normals = new BufferAttribute(normal, 3).setUsage(DynamicDrawUsage);
  geometry.setAttribute("position", positions);
  geometry.setAttribute("normal", normals);
  if (uv) geometry.setAttribute("uv", new BufferAttribute(new Float32Array(coordinate), 2));
  geometry.setIndex(new BufferAttribute(new Uint32Array(index), 1));
  const corners = Uint32Array.from(elements, (v) => 3 * v);
  const from = Uint32Array.from(vertex, (v) => 3 * v);
  const write = (p: Float32Array): void => {
    addUpNormals(p, corners, smooth);
    placeSides(p, smooth, from.subarray(0, upper), isThick ? part.radius : 0, position, normal);
    for (let i = 0, at = 3 * rimStart; i < offset.length; i++) {
      const v = from[upper + i]!;
      for (let k = 0; k < 3; k++) position[at++] = p[v + k]! + offset[i]! * smooth[v + k]!;
    }
    for (let i = part.flat ? 0 : rimStart; i < count; i += 3) {
      setFlatNormal(position, normal, i, i >= upper && i < rimStart ? -1 : 1);
    }
    positions.needsUpdate = normals.needsUpdate = true;
  };
  return [new Mesh(geometry, material), geometry, write];
}

/** Return the edges of one triangle only, as (vertex, vertex, corner, corner), in its winding. */
function findRim(elements: Uint16Array | Uint32Array): [number, number, number, number][] {
  const edges = new Map<string, [number, number, number, number] | null>();
  for (let c = 0; c < elements.length; c += 3) {
    for (const [i, j] of [[0, 1], [1, 2], [2, 0]] as const) {
      const [a, b] = [elements[c + i]!, elements[c + j]!];
      const key = a < b ? `${a} ${b}` : `${b} ${a}`;
      edges.set(key, edges.has(key) ? null : [a, b, c + i, c + j]);
    }
  }
  return [...edges.values()].filter((edge) => edge !== null);
}

/**
 * Write the unit normals of vertices to `out`: the sum over their triangles, weighed by area. `corners`: where each corner
 * of the triangles begins in `p`. For every frame: written out, since arrays in between take V8 four times as long.
 */
function addUpNormals(p: Float32Array, corners: Uint32Array, out: Float32Array): void {
  out.fill(0);
  for (let c = 0; c < corners.length; c += 3) {
    const a = corners[c]!;
    const b = corners[c + 1]!;
    const d = corners[c + 2]!;
    const px = p[a]!;
    const py = p[a + 1]!;
    const pz = p[a + 2]!;
    const ux = p[b]! - px;
    const uy = p[b + 1]! - py;
    const uz = p[b + 2]! - pz;
    const vx = p[d]! - px;
    const vy = p[d + 1]! - py;
    const vz = p[d + 2]! - pz;
    const x = uy * vz - uz * vy;
    const y = uz * vx - ux * vz;
    const z = ux * vy - uy * vx;
    out[a]! += x;
    out[a + 1]! += y;
    out[a + 2]! += z;
    out[b]! += x;
    out[b + 1]! += y;
    out[b + 2]! += z;
    out[d]! += x;
    out[d + 1]! += y;
    out[d + 2]! += z;
  }
  for (let i = 0; i < out.length; i += 3) {
    const length = measure(out[i]!, out[i + 1]!, out[i + 2]!);
    out[i]! /= length;
    out[i + 1]! /= length;
    out[i + 2]! /= length;
  }
}

/**
 * Write points and normals of the upper side, and after them those of the lower side where there is a radius. `from`:
 * where the vertex of each point begins in `p`.
 */
function placeSides(
  p: Float32Array,
  smooth: Float32Array,
  from: Uint32Array,
  radius: number,
  position: Float32Array,
  normal: Float32Array,
): void {
  const size = 3 * from.length;
  for (let i = 0, at = 0; i < from.length; i++, at += 3) {
    const v = from[i]!;
    const nx = smooth[v]!;
    const ny = smooth[v + 1]!;
    const nz = smooth[v + 2]!;
    const x = p[v]!;
    const y = p[v + 1]!;
    const z = p[v + 2]!;
    position[at] = x + radius * nx;
    position[at + 1] = y + radius * ny;
    position[at + 2] = z + radius * nz;
    normal[at] = nx;
    normal[at + 1] = ny;
    normal[at + 2] = nz;
    if (radius === 0) continue;
    position[size + at] = x - radius * nx;
    position[size + at + 1] = y - radius * ny;
    position[size + at + 2] = z - radius * nz;
    normal[size + at] = -nx;
    normal[size + at + 1] = -ny;
    normal[size + at + 2] = -nz;
  }
}

/** Return the length of a vector, 1 of none. `Math.hypot` takes ten times as long. */
function measure(x: number, y: number, z: number): number {
  return Math.sqrt(x * x + y * y + z * z) || 1;
}

/** Write the normal of the triangle of three points. `sign`: -1 where it is drawn in the other order. */
function setFlatNormal(p: Float32Array, normal: Float32Array, corner: number, sign: number): void {
  const a = 3 * corner;
  const ux = p[a + 3]! - p[a]!;
  const uy = p[a + 4]! - p[a + 1]!;
  const uz = p[a + 5]! - p[a + 2]!;
  const vx = p[a + 6]! - p[a]!;
  const vy = p[a + 7]! - p[a + 1]!;
  const vz = p[a + 8]! - p[a + 2]!;
  const x = uy * vz - uz * vy;
  const y = uz * vx - ux * vz;
  const z = ux * vy - uy * vx;
  const length = sign * measure(x, y, z);
  for (let at = a; at < a + 9; at += 3) {
    normal[at] = x / length;
    normal[at + 1] = y / length;
    normal[at + 2] = z / length;
  }
}
