// Deformable streams: topologies, and frames to vertices. docs/deformables.md is normative.

import { MalformedError } from "./errors.ts";
import { inflate } from "./inflate.ts";

const TOPOLOGY_BYTES = 24;
const FRAME_BYTES = 32;
const ESCAPE_BYTES = 16;
const MAX_VERTICES = 2 ** 18;
export const MAX_FACES = 2 ** 20;
const PLAN_TREE = 1;
/** Exponents of the lattice for bounds from 10 um to 4 m. */
const MIN_EXPONENT = -17;
const MAX_EXPONENT = 2;

/** The mesh of a stream, and the order in which its vertices are predicted. Tables are read-only. */
export interface Topology {
  vertexCount: number;
  /** CRC-32 of its bytes: it is in every frame. */
  identity: number;
  /** Vertex at each place; null: place and vertex are the same. */
  order: Uint32Array | null;
  rows: number;
  cols: number;
  /** For a tree: the parents a, b, c of every place. */
  parents: readonly [Uint32Array, Uint32Array, Uint32Array] | null;
  /** Triangles, three vertices each. */
  faces: Uint32Array;
  /** Lines, two vertices each. */
  edges: Uint32Array;
}

/** Decode a topology. Throws `MalformedError`. */
export function decodeTopology(bytes: Uint8Array): Topology {
  if (bytes.length < TOPOLOGY_BYTES) throw new MalformedError(`topology of ${bytes.length} bytes`);
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  const plan = view.getUint8(1);
  const flags = view.getUint16(2, true);
  if (view.getUint8(0) !== 1 || plan > PLAN_TREE || flags > 1) throw new MalformedError(`topology of format ${view.getUint8(0)}, plan ${plan}, flags ${flags}`);
  const vertexCount = view.getUint32(4, true);
  const rows = view.getUint32(8, true);
  const cols = view.getUint32(12, true);
  const faceCount = view.getUint32(16, true);
  const edgeCount = view.getUint32(20, true);
  if (vertexCount < 1 || vertexCount > MAX_VERTICES || Math.max(faceCount, edgeCount) > MAX_FACES) {
    throw new MalformedError(`topology of ${vertexCount} vertices, ${faceCount} faces, ${edgeCount} edges`);
  }
  const isTree = plan === PLAN_TREE;
  if (isTree ? rows !== 0 || cols !== 0 : rows * cols !== vertexCount) throw new MalformedError(`${rows} rows of ${cols} for ${vertexCount} vertices`);
  const words = (flags + (isTree ? 3 : 0)) * vertexCount + 3 * faceCount + 2 * edgeCount;
  if (bytes.length !== TOPOLOGY_BYTES + 4 * words) throw new MalformedError(`topology of ${bytes.length} bytes: its header asks for another number`);
  let at = TOPOLOGY_BYTES;
  const readTable = (count: number): Uint32Array => {
    const table = new Uint32Array(count);
    for (let i = 0; i < count; i++, at += 4) {
      const vertex = view.getUint32(at, true);
      if (vertex >= vertexCount) throw new MalformedError(`topology names vertex ${vertex} of ${vertexCount}`);
      table[i] = vertex;
    }
    return table;
  };
  const order = flags === 1 ? readTable(vertexCount) : null;
  if (order !== null) checkOrder(order);
  const parents = isTree ? ([readTable(vertexCount), readTable(vertexCount), readTable(vertexCount)] as const) : null;
  for (const table of parents ?? []) checkParents(table);
  return { vertexCount, identity: crc32(bytes), order, rows, cols, parents, faces: readTable(3 * faceCount), edges: readTable(2 * edgeCount) };
}

function checkOrder(order: Uint32Array): void {
  const seen = new Uint8Array(order.length);
  for (const vertex of order) seen[vertex] = 1;
  if (seen.includes(0)) throw new MalformedError("the order of a topology is not one of all vertices, each once");
}

function checkParents(table: Uint32Array): void {
  for (const [place, parent] of table.entries()) {
    if (parent >= place && parent + place > 0) throw new MalformedError(`place ${place} has the parent ${parent}, which is not before it`);
  }
}

/** Decodes the frames of one mesh; keeps nothing between frames but the bound of the newest [m]. */
export class DeformableDecoder {
  boundM = 0;

  constructor(readonly topology: Topology) {}

  /** Return vertices, three numbers each [m], world frame, in a new array. Throws `MalformedError`. */
  decode(frame: Uint8Array): Float32Array<ArrayBuffer> {
    const { vertexCount } = this.topology;
    if (frame.length < FRAME_BYTES) throw new MalformedError(`frame of ${frame.length} bytes, shorter than its header`);
    const view = new DataView(frame.buffer, frame.byteOffset, frame.byteLength);
    const [format, flags, planes] = [view.getUint8(0), view.getUint8(1), view.getUint8(2)];
    const exponent = view.getInt8(3);
    const boundM = view.getFloat32(4, true);
    if (format !== 2 || flags > 1 || planes > 4) throw new MalformedError(`frame of format ${format}, flags ${flags}, ${planes} planes`);
    if (exponent < MIN_EXPONENT || exponent > MAX_EXPONENT || !(boundM > 0 && boundM < Number.POSITIVE_INFINITY)) {
      throw new MalformedError(`frame with a lattice of 2^${exponent} m and a bound of ${boundM} m`);
    }
    if (view.getUint32(8, true) !== vertexCount || view.getUint32(12, true) !== this.topology.identity) {
      throw new MalformedError("frame of another mesh: use the topology of the present scene");
    }
    const escaped = view.getUint32(16, true);
    const atPlanes = FRAME_BYTES + escaped * ESCAPE_BYTES;
    if (escaped > vertexCount || frame.length < atPlanes) throw new MalformedError(`${escaped} escapes do not fit ${frame.length} bytes`);
    checkEscapes(view, escaped, vertexCount);
    const size = 3 * vertexCount * planes;
    const packed = frame.subarray(atPlanes);
    const coded = flags === 1 ? inflate(packed, size) : packed;
    if (coded.length !== size) throw new MalformedError(`planes of ${coded.length} bytes, their header asks for ${size}`);
    const positions = new Float32Array(3 * vertexCount);
    const step = 2 ** exponent;
    for (let axis = 0; axis < 3; axis++) {
      const nodes = readResiduals(coded, planes, axis, vertexCount);
      undoPrediction(this.topology, nodes);
      writeAxis(positions, axis, nodes, view.getInt32(20 + 4 * axis, true), step, this.topology.order);
    }
    for (let i = 0, at = FRAME_BYTES; i < escaped; i++, at += ESCAPE_BYTES) {
      const vertex = view.getUint32(at, true);
      for (let axis = 0; axis < 3; axis++) positions[3 * vertex + axis] = view.getFloat32(at + 4 + 4 * axis, true);
    }
    this.boundM = boundM;
    return positions;
  }
}

function checkEscapes(view: DataView, count: number, vertexCount: number): void {
  let before = -1;
  for (let i = 0; i < count; i++) {
    const vertex = view.getUint32(FRAME_BYTES + i * ESCAPE_BYTES, true);
    if (vertex <= before || vertex >= vertexCount) throw new MalformedError("escaped vertices are not ascending and in range");
    before = vertex;
  }
}

function readResiduals(coded: Uint8Array, planes: number, axis: number, count: number): Int32Array {
  const residuals = new Int32Array(count);
  for (let plane = 0; plane < planes; plane++) {
    const at = (3 * plane + axis) * count;
    const shift = 8 * plane;
    for (let i = 0; i < count; i++) residuals[i] = (residuals[i] as number) | ((coded[at + i] as number) << shift);
  }
  for (let i = 0; i < count; i++) {
    const u = residuals[i] as number;
    residuals[i] = (u >>> 1) ^ -(u & 1);
  }
  return residuals;
}

/** Turn residuals into nodes, in place. Sums wrap, as those of `Int32Array` do. */
function undoPrediction(topology: Topology, nodes: Int32Array): void {
  if (topology.parents !== null) {
    const [a, b, c] = topology.parents;
    for (let i = 1; i < nodes.length; i++) {
      const predicted = (nodes[a[i] as number] as number) + (nodes[b[i] as number] as number) - (nodes[c[i] as number] as number);
      nodes[i] = (nodes[i] as number) + predicted;
    }
    return;
  }
  const { cols } = topology;
  for (let i = cols; i < nodes.length; i++) nodes[i] = (nodes[i] as number) + (nodes[i - cols] as number);
  for (let i = 1; i < nodes.length; i++) {
    if (i % cols !== 0) nodes[i] = (nodes[i] as number) + (nodes[i - 1] as number);
  }
}

function writeAxis(positions: Float32Array, axis: number, nodes: Int32Array, origin: number, step: number, order: Uint32Array | null): void {
  for (let i = 0; i < nodes.length; i++) {
    const node = ((nodes[i] as number) + origin) | 0;
    positions[3 * (order === null ? i : (order[i] as number)) + axis] = Math.fround(node) * step;
  }
}

let crcTable: Uint32Array | null = null;

/** Return the CRC-32 of zlib. */
export function crc32(bytes: Uint8Array): number {
  crcTable ??= Uint32Array.from({ length: 256 }, (_, i) => {
    let value = i;
    for (let bit = 0; bit < 8; bit++) value = (value & 1) === 0 ? value >>> 1 : (value >>> 1) ^ 0xedb88320;
    return value;
  });
  let crc = 0xffffffff;
  for (const byte of bytes) crc = (crc >>> 8) ^ (crcTable[(crc ^ byte) & 0xff] as number);
  return (crc ^ 0xffffffff) >>> 0;
}
