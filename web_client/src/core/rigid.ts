// Rigid-state stream: payloads to poses. docs/protocol.md, section 8, is normative.

import { RIGID_FORMAT, RIGID_LATTICE_M, RIGID_POSITION_BITS, RIGID_ROTATION_CENTRE } from "../protocol/messages.g.ts";
import { MalformedError } from "./errors.ts";

/** Rows `x y z qw qx qy qz`. */
export type Poses = Float64Array<ArrayBuffer>;

const HEADER_BYTES = 20;
const ESCAPE_BYTES = 58;
const NARROW_BYTES = 12;
const WIDE_BYTES = 18;
const POSITION_MASK = 2 ** RIGID_POSITION_BITS - 1;
const STEP = 1 / RIGID_ROTATION_CENTRE;
/** Squared length of rotation parameters that still is a rotation, with a little for rounding. */
const MAX_SQUARES = (1 + (Math.sqrt(3) * 0.5) / RIGID_ROTATION_CENTRE) ** 2 + 1e-12;

/** A payload, taken apart. `bodies`: index of each row of `poses`; null: all in their order. */
interface Frame {
  bodies: Uint16Array | null;
  poses: Poses;
}

/**
 * Poses of `bodyCount` bodies, kept up to date by frames and keyframes.
 *
 * `poses` are NaN until first received; every frame makes a new array, so an earlier one may be kept. `stateSeq`: the
 * newest frame, 0 for none.
 */
export class RigidDecoder {
  poses: Poses;
  stateSeq = 0;
  baseSeq = 0;
  staleFrames = 0;
  /** Newest frame at which the pose of a body was known to be within the bound, -1 for none. */
  private readonly held: Float64Array;

  constructor(readonly bodyCount: number) {
    this.poses = new Float64Array(7 * bodyCount).fill(Number.NaN);
    this.held = new Float64Array(bodyCount).fill(-1);
  }

  /** True if every body is within the bound at `stateSeq`. */
  get complete(): boolean {
    return this.stateSeq > 0 && this.held.every((seq) => seq >= this.stateSeq);
  }

  /** Apply one frame. Returns false when a snapshot is needed. Throws `MalformedError`, and nothing has changed then. */
  apply(stateSeq: number, baseSeq: number, payload: Uint8Array): boolean {
    if (!(baseSeq >= 0 && baseSeq <= stateSeq)) throw new MalformedError(`base_seq ${baseSeq} and state_seq ${stateSeq}`);
    if (stateSeq <= this.stateSeq) {
      this.staleFrames += 1;
      return this.complete;
    }
    const { bodies, poses } = unpack(payload, this.bodyCount);
    this.stateSeq = stateSeq;
    this.baseSeq = baseSeq;
    if (bodies === null) {
      this.poses = poses;
      this.held.fill(stateSeq);
      return this.complete;
    }
    this.poses = this.poses.slice();
    for (const [row, body] of bodies.entries()) {
      this.poses.set(poses.subarray(7 * row, 7 * row + 7), 7 * body);
      this.held[body] = stateSeq;
    }
    this.carryOver();
    return this.complete;
  }

  /** Take the poses of a snapshot; newer poses are kept. Returns true when complete. */
  loadKeyframe(stateSeq: number, poses: Float64Array): boolean {
    if (poses.length !== 7 * this.bodyCount) throw new MalformedError(`keyframe of ${poses.length} numbers, expected ${7 * this.bodyCount}`);
    this.poses = this.poses.slice();
    for (let body = 0; body < this.bodyCount; body++) {
      if ((this.held[body] as number) >= stateSeq) continue;
      this.poses.set(poses.subarray(7 * body, 7 * body + 7), 7 * body);
      this.held[body] = stateSeq;
    }
    if (stateSeq > this.stateSeq) this.stateSeq = this.baseSeq = stateSeq;
    this.carryOver();
    return this.complete;
  }

  /** Mark as current what was known at `baseSeq` or later: what is not in the newest frame has not changed. */
  private carryOver(): void {
    const least = Math.max(this.baseSeq, 1);
    for (const [body, seq] of this.held.entries()) if (seq >= least) this.held[body] = this.stateSeq;
  }
}

function unpack(payload: Uint8Array, bodyCount: number): Frame {
  if (payload.length < HEADER_BYTES) throw new MalformedError(`payload of ${payload.length} bytes, shorter than its header`);
  const view = new DataView(payload.buffer, payload.byteOffset, payload.byteLength);
  const layout = payload[1] as number;
  const stated = view.getUint16(2, true);
  const count = view.getUint16(4, true);
  const escaped = view.getUint16(6, true);
  if (payload[0] !== RIGID_FORMAT || stated !== bodyCount) {
    throw new MalformedError(`payload of format ${payload[0]} for ${stated} bodies, expected format ${RIGID_FORMAT} for ${bodyCount}`);
  }
  if (layout > 1 || count > bodyCount) throw new MalformedError(`layout ${layout} of ${count} bodies`);
  const atMask = HEADER_BYTES + count * (layout === 0 ? NARROW_BYTES : WIDE_BYTES);
  const atEscapes = atMask + (count === bodyCount ? 0 : Math.ceil(bodyCount / 8));
  const end = atEscapes + escaped * ESCAPE_BYTES;
  if (payload.length !== end) throw new MalformedError(`payload of ${payload.length} bytes, its header asks for ${end}`);
  if (count === bodyCount) {
    if (escaped > 0) throw new MalformedError("escapes of bodies that are quantised");
    return { bodies: null, poses: readCodes(view, layout, count, count) };
  }
  const bodies = new Uint16Array(count + escaped);
  readMask(payload.subarray(atMask, atEscapes), bodyCount, count, bodies);
  readEscapedBodies(view, payload, atMask, atEscapes, bodyCount, bodies.subarray(count));
  const poses = readCodes(view, layout, count, count + escaped);
  for (let i = 0; i < escaped; i++) {
    for (let k = 0; k < 7; k++) poses[7 * (count + i) + k] = view.getFloat64(atEscapes + i * ESCAPE_BYTES + 2 + 8 * k, true);
  }
  return { bodies, poses };
}

/** Write the bodies of the mask to `bodies`. */
function readMask(mask: Uint8Array, bodyCount: number, count: number, bodies: Uint16Array): void {
  let found = 0;
  for (const [i, byte] of mask.entries()) {
    for (let bit = 0; bit < 8; bit++) {
      if ((byte & (1 << bit)) === 0) continue;
      const body = 8 * i + bit;
      if (found === count || body >= bodyCount) throw new MalformedError(`mask marks other than ${count} of ${bodyCount} bodies`);
      bodies[found++] = body;
    }
  }
  if (found !== count) throw new MalformedError(`mask marks ${found} bodies, expected ${count}`);
}

function readEscapedBodies(
  view: DataView,
  payload: Uint8Array,
  atMask: number,
  atEscapes: number,
  bodyCount: number,
  bodies: Uint16Array,
): void {
  let before = -1;
  for (let i = 0; i < bodies.length; i++) {
    const body = view.getUint16(atEscapes + i * ESCAPE_BYTES, true);
    const masked = body < bodyCount && ((payload[atMask + (body >> 3)] as number) & (1 << (body & 7))) !== 0;
    if (body <= before || body >= bodyCount || masked) throw new MalformedError("escaped bodies are not ascending, in range and apart from the mask");
    bodies[i] = before = body;
  }
}

/** Return the poses of the `count` quantised bodies, in an array with room for `rows`. */
function readCodes(view: DataView, layout: number, count: number, rows: number): Poses {
  const poses = new Float64Array(7 * rows);
  const atLevels = HEADER_BYTES + 12 * count;
  for (let i = 0; i < count; i++) {
    let squares = 0;
    for (let axis = 0; axis < 3; axis++) {
      const word = view.getUint32(HEADER_BYTES + 4 * (axis * count + i), true);
      const position = layout === 0 ? word & POSITION_MASK : word;
      const level = layout === 0 ? word >>> RIGID_POSITION_BITS : view.getUint16(atLevels + 2 * (axis * count + i), true);
      const m = (level - RIGID_ROTATION_CENTRE) * STEP;
      squares += m * m;
      poses[7 * i + axis] = (position + view.getInt32(8 + 4 * axis, true)) * RIGID_LATTICE_M;
      poses[7 * i + 4 + axis] = m;
    }
    if (squares > MAX_SQUARES) throw new MalformedError("rotation levels do not encode a rotation");
    const scale = 2 / (1 + squares);
    poses[7 * i + 3] = scale - 1;
    for (let k = 4; k < 7; k++) (poses[7 * i + k] as number) *= scale;
  }
  return poses;
}
