// Triangles, texture coordinates and cube directions of every geometry, by the formulas of docs/scene.md.
//
// A port of iris_session/scene/shapes.py: round shapes have as many slices and stacks as MuJoCo's, so that silhouettes
// agree. Pure: arrays in, arrays out. No three.js here.

import type { Geometry, HeightField, Material } from "./spec.ts";
import type { MeshArrays } from "./arrays.ts";

const SLICES = 28;
const STACKS = 16;
/** Half the side of an infinite plane [m]. */
export const ENDLESS_M = 50;
/** Distance from the axis, in radii, below which the angle around it is undefined. */
const POLE = 1e-6;

type Vec2 = [number, number];
type Vec3 = [number, number, number];

/** Shapes of geometries as arrays of corners, three per triangle, without an index. */
interface Corners {
  position: number[];
  normal: number[];
}

/** Return the mesh of a shape that needs no asset. Unknown kinds are drawn as a box of their size. */
export function buildPrimitive(geometry: Geometry): MeshArrays {
  const [x, y, z] = geometry.size;
  switch (geometry.kind) {
    case "plane": {
      const [a, b] = [x || ENDLESS_M, y || ENDLESS_M];
      const corners = emptyCorners();
      addQuad(corners, [-a, -b, 0], [a, -b, 0], [a, b, 0], [-a, b, 0]);
      return toMesh(corners);
    }
    case "sphere":
    case "ellipsoid": {
      const arc = makeArc(STACKS + 1, -1, 1);
      return toMesh(revolve(arc, arc, [x, y, z]));
    }
    case "cylinder": {
      const profile: Vec2[] = [[0, -1], [1, -1], [1, -1], [1, 1], [1, 1], [0, 1]];
      const normals: Vec2[] = [[0, -1], [0, -1], [1, 0], [1, 0], [0, 1], [0, 1]];
      return toMesh(revolve(profile, normals, [x, y, z]));
    }
    case "capsule": {
      const [low, high] = [makeArc(STACKS / 2 + 1, -1, 0), makeArc(STACKS / 2 + 1, 0, 1)];
      const middle = x ? z / x : 0;
      const profile = [...low.map(([r, h]): Vec2 => [r, h - middle]), ...high.map(([r, h]): Vec2 => [r, h + middle])];
      return toMesh(revolve(profile, [...low, ...high], [x, x, x]));
    }
    default:
      return toMesh(buildBox(x, y, z));
  }
}

function buildBox(x: number, y: number, z: number): Corners {
  const corners = emptyCorners();
  const at = (i: number, j: number, k: number): Vec3 => [i * x, j * y, k * z];
  addQuad(corners, at(-1, -1, 1), at(1, -1, 1), at(1, 1, 1), at(-1, 1, 1));
  addQuad(corners, at(-1, 1, -1), at(1, 1, -1), at(1, -1, -1), at(-1, -1, -1));
  addQuad(corners, at(1, -1, -1), at(1, 1, -1), at(1, 1, 1), at(1, -1, 1));
  addQuad(corners, at(-1, 1, -1), at(-1, -1, -1), at(-1, -1, 1), at(-1, 1, 1));
  addQuad(corners, at(-1, -1, -1), at(1, -1, -1), at(1, -1, 1), at(-1, -1, 1));
  addQuad(corners, at(1, 1, -1), at(-1, 1, -1), at(-1, 1, 1), at(1, 1, 1));
  return corners;
}

/** Return the surface of a height field with its four walls and floor. `elevation`: rows along y, values 0 to 1. */
export function buildHeightField(field: HeightField, elevation: Float32Array): MeshArrays {
  const { rows, columns } = field;
  const [halfX, halfY, top, base] = field.size;
  const point = (r: number, c: number): Vec3 => [
    columns > 1 ? ((2 * c) / (columns - 1) - 1) * halfX : -halfX,
    rows > 1 ? ((2 * r) / (rows - 1) - 1) * halfY : -halfY,
    (elevation[r * columns + c] ?? 0) * top,
  ];
  const corners = emptyCorners();
  for (let r = 0; r + 1 < rows; r++) {
    for (let c = 0; c + 1 < columns; c++) {
      const [a, b, d] = [point(r, c), point(r, c + 1), point(r + 1, c)];
      const far = point(r + 1, c + 1);
      addTriangle(corners, d, a, far);
      addTriangle(corners, a, b, far);
    }
  }
  const addWall = (edge: Vec3[]): void => {
    for (let i = 0; i + 1 < edge.length; i++) {
      const [from, to] = [edge[i]!, edge[i + 1]!];
      addQuad(corners, [from[0], from[1], -base], [to[0], to[1], -base], to, from);
    }
  };
  const along = (n: number, get: (i: number) => Vec3): Vec3[] => Array.from({ length: n }, (_, i) => get(i));
  addWall(along(columns, (c) => point(0, c)));
  addWall(along(rows, (r) => point(r, columns - 1)));
  addWall(along(columns, (c) => point(rows - 1, columns - 1 - c)));
  addWall(along(rows, (r) => point(rows - 1 - r, 0)));
  addQuad(corners, [-halfX, -halfY, -base], [-halfX, halfY, -base], [halfX, halfY, -base], [halfX, -halfY, -base]);
  return toMesh(corners);
}

function emptyCorners(): Corners {
  return { position: [], normal: [] };
}

function addQuad(corners: Corners, a: Vec3, b: Vec3, c: Vec3, d: Vec3): void {
  addTriangle(corners, a, b, c);
  addTriangle(corners, a, c, d);
}

function addTriangle(corners: Corners, a: Vec3, b: Vec3, c: Vec3): void {
  const normal = normalize(cross(subtract(b, a), subtract(c, a)));
  corners.position.push(...a, ...b, ...c);
  corners.normal.push(...normal, ...normal, ...normal);
}

/** Return (distance from the axis, height) on a half circle of radius 1, from `low` to `high` quarter turns. */
function makeArc(points: number, low: number, high: number): Vec2[] {
  return Array.from({ length: points }, (_, i): Vec2 => {
    const angle = ((low + ((high - low) * i) / (points - 1)) * Math.PI) / 2;
    return [Math.cos(angle), Math.sin(angle)];
  });
}

/** Revolve a profile (distance, height) around z and scale it by `size`; `normals` are before scaling. */
function revolve(profile: Vec2[], normals: Vec2[], size: Vec3): Corners {
  const turns = Array.from({ length: SLICES + 1 }, (_, i) => ((i % SLICES) * 2 * Math.PI) / SLICES);
  const around = ([r, h]: Vec2, angle: number): Vec3 => [r * Math.cos(angle), r * Math.sin(angle), h];
  const point = (i: number, j: number): Vec3 => {
    const [px, py, pz] = around(profile[i]!, turns[j]!);
    return [px * size[0], py * size[1], pz * size[2]];
  };
  const across = (i: number, j: number): Vec3 => {
    const [nx, ny, nz] = around(normals[i]!, turns[j]!);
    return normalize([nx / (size[0] || 1), ny / (size[1] || 1), nz / (size[2] || 1)]);
  };
  const corners = emptyCorners();
  const add = (...at: [number, number][]): void => {
    const [a, b, c] = at.map(([i, j]) => point(i, j)) as [Vec3, Vec3, Vec3];
    const area = cross(subtract(b, a), subtract(c, a));
    if (Math.hypot(...area) <= 1e-16) return; // at poles, and between the parts of a profile
    corners.position.push(...a, ...b, ...c);
    for (const [i, j] of at) corners.normal.push(...across(i, j));
  };
  for (let i = 0; i + 1 < profile.length; i++) {
    for (let j = 0; j < SLICES; j++) {
      add([i, j], [i, j + 1], [i + 1, j + 1]);
      add([i, j], [i + 1, j + 1], [i + 1, j]);
    }
  }
  return corners;
}

function toMesh(corners: Corners): MeshArrays {
  const position = new Float32Array(corners.position);
  const index = new Uint32Array(position.length / 3).map((_, i) => i);
  return { position, normal: new Float32Array(corners.normal), index };
}

// --- texture coordinates --------------------------------------------------------------------------------------------

/** Return `mesh`, the mesh of `geometry`, with the texture coordinates that `material` gives it for 2d textures. */
export function addTextureCoordinates(
  mesh: MeshArrays,
  geometry: Geometry,
  material: Material,
): MeshArrays {
  const [sx, sy] = geometry.size;
  const repeat = material.repeat;
  const times: Vec2 = material.uniform ? [repeat[0] * sx, repeat[1] * sy] : [repeat[0], repeat[1]];
  if (mesh.uv) return { ...mesh, uv: mesh.uv.map((value, i) => value * times[i % 2]!) };
  if (geometry.mesh >= 0 || geometry.hfield >= 0) {
    return { ...mesh, uv: projectAlongZ(mesh.position, geometry, material) };
  }
  const flat = splitCorners(mesh);
  const uv = shapeCoordinates(flat, geometry);
  const projected = geometry.kind === "plane" ? projectAlongZ(flat.position, geometry, material) : null;
  for (let i = 0; i < uv.length; i++) {
    const endless = projected !== null && !(geometry.size[i % 2 as 0 | 1] > 0);
    uv[i] = endless ? projected[i]! : uv[i]! * times[i % 2]!;
  }
  return { ...flat, uv };
}

/** Return texture coordinates projected along z. */
function projectAlongZ(position: Float32Array, geometry: Geometry, material: Material): Float32Array {
  const repeat = material.repeat;
  const per = (axis: 0 | 1): number => {
    const size = geometry.size[axis];
    return repeat[axis] / (material.uniform || !(size > 0) ? 1 : size);
  };
  const [kx, ky] = [per(0), per(1)];
  const uv = new Float32Array((position.length / 3) * 2);
  for (let i = 0; i < position.length / 3; i++) {
    uv[2 * i] = 0.5 * kx * position[3 * i]! - 0.5;
    uv[2 * i + 1] = -0.5 * ky * position[3 * i + 1]! - 0.5;
  }
  return uv;
}

/** Return texture coordinates of corners, 0 to 1 to the right and down. `flat`: three corners per triangle. */
function shapeCoordinates(flat: MeshArrays, geometry: Geometry): Float32Array {
  const { position, normal } = flat;
  const [sx, sy, sz] = geometry.size.map((s) => (s > 0 ? s : 1)) as Vec3;
  const n = position.length / 3;
  const uv = new Float32Array(2 * n);
  const round = ["sphere", "ellipsoid", "cylinder", "capsule"].includes(geometry.kind);
  for (let t = 0; t < n; t += 3) {
    const turns = round ? anglesAroundZ(position, t, sx, sy) : null;
    const middle = (position[3 * t + 2]! + position[3 * t + 5]! + position[3 * t + 8]!) / 3;
    for (let k = 0; k < 3; k++) {
      const i = t + k;
      const [x, y, z] = [position[3 * i]! / sx, position[3 * i + 1]! / sy, position[3 * i + 2]! / sz];
      const [nx, ny, nz] = [normal[3 * i]!, normal[3 * i + 1]!, normal[3 * i + 2]!];
      let [u, v] = [0, 0];
      switch (geometry.kind) {
        case "sphere":
        case "ellipsoid":
          [u, v] = [turns![k]!, 0.5 - latitude(z)];
          break;
        case "cylinder":
          [u, v] = Math.abs(nz) > 0.5 ? [(x + 1) / 2, (y + 1) / 2] : [turns![k]!, 0.5 - z / 2];
          break;
        case "capsule": {
          const [radius, , half] = geometry.size;
          const end = Math.abs(middle) > half ? Math.sign(middle) : 0;
          const cap = (end > 0 ? 1 : 0) - 2 * latitude((position[3 * i + 2]! - end * half) / radius);
          [u, v] = [turns![k]!, end === 0 ? 0.5 - z / 2 : cap];
          break;
        }
        default: {
          const across = largest(Math.abs(nx), Math.abs(ny), Math.abs(nz));
          const right = across === 0 ? y : x;
          const up = across === 2 ? y : z;
          [u, v] = [(1 + right) / 2, (1 - up) / 2];
        }
      }
      uv[2 * i] = u;
      uv[2 * i + 1] = v;
    }
  }
  return uv;
}

/** Return the angles around z of a triangle's corners, from x, in turns; across the seam they continue beyond 1. */
function anglesAroundZ(position: Float32Array, first: number, sx: number, sy: number): Vec3 {
  const turns: Vec3 = [0, 0, 0];
  const defined = [false, false, false];
  for (let k = 0; k < 3; k++) {
    const [x, y] = [position[3 * (first + k)]! / sx, position[3 * (first + k) + 1]! / sy];
    defined[k] = Math.hypot(x, y) > POLE;
    turns[k as 0 | 1 | 2] = (Math.atan2(y, x) / (2 * Math.PI) + 1) % 1;
  }
  const high = Math.max(...turns.map((turn, k) => (defined[k] ? turn : 0)));
  let [sum, count] = [0, 0];
  for (const k of [0, 1, 2] as const) {
    if (high - turns[k] > 0.5) turns[k] += 1;
    if (defined[k]) [sum, count] = [sum + turns[k], count + 1];
  }
  return turns.map((turn, k) => (defined[k] ? turn : sum / Math.max(count, 1))) as Vec3;
}

function latitude(height: number): number {
  return Math.asin(Math.min(1, Math.max(-1, height))) / Math.PI;
}

function largest(a: number, b: number, c: number): number {
  return a >= b && a >= c ? 0 : b >= c ? 1 : 2;
}

/** Return the mesh with three corners of its own per triangle. */
function splitCorners(mesh: MeshArrays): MeshArrays {
  const n = mesh.index.length;
  const position = new Float32Array(3 * n);
  const normal = new Float32Array(3 * n);
  for (let i = 0; i < n; i++) {
    const from = mesh.index[i]!;
    position.set(mesh.position.subarray(3 * from, 3 * from + 3), 3 * i);
    normal.set(mesh.normal.subarray(3 * from, 3 * from + 3), 3 * i);
  }
  return { position, normal, index: new Uint32Array(n).map((_, i) => i) };
}

// --- cube textures --------------------------------------------------------------------------------------------------

/** Return the direction by which each vertex samples a cube texture, and the mesh that they belong to. */
export function cubeDirections(
  mesh: MeshArrays,
  geometry: Geometry,
  material: Material,
  hfield: HeightField | undefined,
): { mesh: MeshArrays; direction: Float32Array } {
  const scale = directionScale(geometry, material, hfield);
  const capsule = geometry.kind === "capsule";
  const source = capsule ? splitCorners(mesh) : mesh; // caps and middle differ where they meet
  const direction = new Float32Array(source.position.length);
  for (let i = 0; i < direction.length; i++) direction[i] = source.position[i]! * scale[(i % 3) as 0 | 1 | 2];
  if (capsule) {
    const [radius, , half] = geometry.size;
    const stretch = material.uniform ? half : 1;
    for (let t = 0; t < source.position.length / 3; t += 3) {
      const z = (k: number): number => source.position[3 * (t + k) + 2]!;
      const middle = (z(0) + z(1) + z(2)) / 3;
      if (Math.abs(middle) <= half) continue;
      const end = Math.sign(middle);
      for (let k = 0; k < 3; k++) direction[3 * (t + k) + 2] = ((z(k) - end * half) / radius + end) * stretch;
    }
  }
  return { mesh: source, direction };
}

function directionScale(geometry: Geometry, material: Material, hfield?: HeightField): Vec3 {
  const [x, y, z] = geometry.size;
  const uniform = material.uniform;
  if (geometry.kind === "plane") return uniform && (x || y) ? [x, y, 0] : [1, 1, 0];
  if (hfield) return uniform ? [x, y, 0.25 * hfield.size[2] + 0.5 * hfield.size[3]] : [1, 1, 1];
  if (geometry.mesh >= 0) return uniform ? [x, y, z] : [1, 1, 1];
  return uniform ? [1, 1, 1] : [x ? 1 / x : 1, y ? 1 / y : 1, z ? 1 / z : 1];
}

// --- vectors --------------------------------------------------------------------------------------------------------

function subtract(a: Vec3, b: Vec3): Vec3 {
  return [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
}

function cross(a: Vec3, b: Vec3): Vec3 {
  return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
}

function normalize(a: Vec3): Vec3 {
  const length = Math.hypot(...a) || 1;
  return [a[0] / length, a[1] / length, a[2] / length];
}
