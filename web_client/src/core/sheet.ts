// The surface of a sheet of vertices: points and normals as a graphics card takes them. Pure; for every frame, so loops
// are written out: arrays in between take V8 four times as long.

/** How a sheet is drawn: as in `Deformable`. */
export interface SheetLook {
  dim: number;
  radius: number;
  flat: boolean;
}

/** Triangles of a sheet. `uv`: two per corner. */
export interface SheetArrays {
  elements: Uint16Array | Uint32Array;
  uv?: Float32Array | undefined;
}

/** Three numbers for every drawn point. */
export interface Surface {
  position: Float32Array<ArrayBuffer>;
  normal: Float32Array<ArrayBuffer>;
}

/**
 * Triangles with normals computed here: per vertex, or per triangle where `flat`. A cloth has its thickness as MuJoCo
 * draws it: both sides are `radius` away from the vertices, with a rim between them.
 */
export class SheetBuilder {
  /** Three drawn points for each triangle. */
  readonly index: Uint32Array<ArrayBuffer>;
  /** Place in the texture of every drawn point. */
  readonly uv: Float32Array<ArrayBuffer> | null;
  /** Number of drawn points. */
  readonly count: number;
  private readonly radius: number;
  private readonly isFlat: boolean;
  /** Drawn points of one side, and where the rim begins. */
  private readonly upper: number;
  private readonly rimStart: number;
  /** Places in the array of vertices: of the corners of the triangles, of the points of one side, of those of the rim. */
  private readonly corners: Uint32Array;
  private readonly from: Uint32Array;
  private readonly rimFrom: Uint32Array;
  /** Distances of the points of the rim from their vertices [m]. */
  private readonly offset: Float32Array;
  private readonly smooth: Float32Array;

  constructor(look: SheetLook, private readonly vertexCount: number, { elements, uv }: SheetArrays) {
    const isThick = look.dim === 2 && look.radius > 0;
    this.radius = isThick ? look.radius : 0;
    this.isFlat = look.flat;
    // Drawn points of one side: the vertices, once for each of their places in a texture, or every corner where it is flat.
    const vertex: number[] = [];
    const coordinate: number[] = [];
    const index: number[] = [];
    const known = new Map<number | string, number>();
    for (let c = 0; c < elements.length; c++) {
      const v = elements[c]!;
      const key = uv ? `${v} ${uv[2 * c]!} ${uv[2 * c + 1]!}` : v;
      const before = look.flat ? undefined : known.get(key);
      index.push(before ?? vertex.length);
      if (before !== undefined) continue;
      known.set(key, vertex.length);
      vertex.push(v);
      if (uv) coordinate.push(uv[2 * c]!, uv[2 * c + 1]!);
    }
    this.upper = vertex.length;
    if (isThick) {
      for (let c = 0; c < elements.length; c += 3) for (const k of [0, 2, 1]) index.push(this.upper + index[c + k]!);
      for (let i = 0, n = coordinate.length; i < n; i++) coordinate.push(coordinate[i]!);
    }
    // Then the points of the rim, which share nothing: vertices and distances from them.
    this.rimStart = isThick ? 2 * this.upper : this.upper;
    const rim: number[] = [];
    const offset: number[] = [];
    for (const [a, b, ca, cb] of isThick ? findRim(elements, vertexCount) : []) {
      for (const [v, sign, c] of [[a, 1, ca], [a, -1, ca], [b, -1, cb], [a, 1, ca], [b, -1, cb], [b, 1, cb]] as const) {
        index.push(this.rimStart + offset.length);
        rim.push(v);
        offset.push(sign * look.radius);
        if (uv) coordinate.push(uv[2 * c]!, uv[2 * c + 1]!);
      }
    }
    this.count = this.rimStart + offset.length;
    this.index = new Uint32Array(index);
    this.uv = uv ? new Float32Array(coordinate) : null;
    this.corners = Uint32Array.from(elements, (v) => 3 * v);
    this.from = Uint32Array.from(vertex, (v) => 3 * v);
    this.rimFrom = Uint32Array.from(rim, (v) => 3 * v);
    this.offset = new Float32Array(offset);
    this.smooth = new Float32Array(3 * vertexCount);
  }

  /**
   * Return the surface of vertices, null if they are of another sheet. It is written into `spare`, a surface that is not
   * needed any more, if that has as many points.
   */
  build(vertices: Float32Array, spare?: Surface): Surface | null {
    if (vertices.length !== 3 * this.vertexCount) return null;
    const { count, rimStart, smooth, offset, rimFrom } = this;
    const isSpare = spare?.position.length === 3 * count;
    const { position, normal } = isSpare ? spare : { position: new Float32Array(3 * count), normal: new Float32Array(3 * count) };
    addUpNormals(vertices, this.corners, smooth);
    placeSides(vertices, smooth, this.from, this.radius, position, normal);
    for (let i = 0, at = 3 * rimStart; i < offset.length; i++) {
      const v = rimFrom[i]!;
      for (let k = 0; k < 3; k++) position[at++] = vertices[v + k]! + offset[i]! * smooth[v + k]!;
    }
    for (let i = this.isFlat ? 0 : rimStart; i < count; i += 3) {
      setFlatNormal(position, normal, i, i >= this.upper && i < rimStart ? -1 : 1);
    }
    return { position, normal };
  }
}

/** Return the edges of one triangle only, as (vertex, vertex, corner, corner), in its winding. */
function findRim(elements: Uint16Array | Uint32Array, vertexCount: number): [number, number, number, number][] {
  const edges = new Map<number, [number, number, number, number] | null>();
  for (let c = 0; c < elements.length; c += 3) {
    for (const [i, j] of [[0, 1], [1, 2], [2, 0]] as const) {
      const [a, b] = [elements[c + i]!, elements[c + j]!];
      const key = a < b ? a * vertexCount + b : b * vertexCount + a;
      edges.set(key, edges.has(key) ? null : [a, b, c + i, c + j]);
    }
  }
  return [...edges.values()].filter((edge) => edge !== null);
}

/**
 * Write the unit normals of vertices to `out`: the sum over their triangles, weighed by area. `corners`: where each corner
 * of the triangles begins in `p`.
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
