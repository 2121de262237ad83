// Point cloud frames: a header and points that a graphics card takes as they are. docs/clouds.md is normative.

import { MalformedError } from "./errors.ts";

const HEADER_BYTES = 32;
/** Bytes of a point: three u16 on the lattice, and a colour of 16 bits. */
export const POINT_BYTES = 8;
const MAX_POINTS = 2 ** 21;
const MIN_EXPONENT = -14;
const MAX_EXPONENT = -4;
const MAX_ORIGIN = 2 ** 23;
const MAX_VOXEL_M = 10;

/** A frame. A point is at (origin + node) * step [m], world frame; every beginning is a fair sample of the whole. */
export interface CloudFrame {
  /** Four numbers a point: x, y and z of its node, and its colour, 5 bits of red (the highest), 6 of green, 5 of blue. */
  points: Uint16Array<ArrayBuffer>;
  origin: [number, number, number];
  step_m: number;
  /** Error that its source states, 95 % [m]; infinite where that is not known. */
  error_m: number;
  /** Edge of the cell that a point stands for, 0 where it stands for itself [m]. */
  voxel_m: number;
}

/** Decode a frame into buffers of its own. Throws `MalformedError`. */
export function decodeCloud(frame: Uint8Array): CloudFrame {
  if (frame.length < HEADER_BYTES) throw new MalformedError(`cloud of ${frame.length} bytes, shorter than its header`);
  const view = new DataView(frame.buffer, frame.byteOffset, frame.byteLength);
  const [format, flags, exponent, reserved] = [view.getUint8(0), view.getUint8(1), view.getInt8(2), view.getUint8(3)];
  if (format !== 1 || flags !== 0 || reserved !== 0 || view.getUint32(28, true) !== 0) throw new MalformedError(`cloud of format ${format}, flags ${flags}`);
  const count = view.getUint32(4, true);
  const origin: [number, number, number] = [view.getInt32(8, true), view.getInt32(12, true), view.getInt32(16, true)];
  if (exponent < MIN_EXPONENT || exponent > MAX_EXPONENT || origin.some((node) => Math.abs(node) > MAX_ORIGIN)) {
    throw new MalformedError(`cloud with a lattice of 2^${exponent} m from node ${origin.join(", ")}`);
  }
  const [error_m, voxel_m] = [view.getFloat32(20, true), view.getFloat32(24, true)];
  if (!(error_m > 0) || !(voxel_m >= 0 && voxel_m <= MAX_VOXEL_M)) {
    throw new MalformedError(`cloud with an error of ${error_m} m and voxels of ${voxel_m} m`);
  }
  if (count > MAX_POINTS || frame.length !== HEADER_BYTES + POINT_BYTES * count) {
    throw new MalformedError(`${count} points do not make a cloud of ${frame.length} bytes`);
  }
  const points = new Uint16Array(4 * count); // typed arrays are little-endian wherever browsers run
  new Uint8Array(points.buffer).set(frame.subarray(HEADER_BYTES));
  return { points, origin, step_m: 2 ** exponent, error_m, voxel_m };
}
