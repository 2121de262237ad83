// Assets with the encoding `arrays`: containers to typed arrays. docs/scene.md is normative.

import type * as wire from "../protocol/messages.g.ts";
import { ARRAYS_MAGIC } from "../protocol/messages.g.ts";
import { MAX_ARRAY_BYTES, MAX_ARRAY_HEADER_BYTES } from "../protocol/schema.g.ts";
import type { AnyArray, DecodedArray, Filled } from "./api.ts";
import { decodeStruct } from "./codec.ts";
import { MalformedError } from "./errors.ts";
import { inflate } from "./inflate.ts";

type ArrayInfo = Filled<wire.ArrayInfo>;

/** Arrays of an asset by name. `maxError`: stated bound on the values, 0: exact. */
export interface DecodedArrays {
  kind: string;
  maxError: number;
  arrays: Record<string, DecodedArray>;
}

const PREFIX_BYTES = 8;
const ITEM_BYTES: Readonly<Record<string, number>> = { u1: 1, i1: 1, u2: 2, u4: 4, f4: 4 };
const FILTERS = ["none", "shuffle", "delta", "up"];

/**
 * Decode an asset; quantised arrays become float32. `maxBytes`: limit of all decoded arrays together.
 *
 * Throws `MalformedError`, and allocates no more than the asset states, which is checked first.
 */
export function decodeArrays(data: Uint8Array, maxBytes = MAX_ARRAY_BYTES): DecodedArrays {
  const { header, start } = readHeader(data);
  let total = 0;
  for (const info of header.arrays) total += stateBytes(info) * (info.scale.length > 0 ? 4 / (ITEM_BYTES[info.dtype] as number) : 1);
  if (total > maxBytes) throw new MalformedError(`arrays of ${total} bytes, at most ${maxBytes} are read`);
  const entries: [string, DecodedArray][] = [];
  let at = start;
  for (const info of header.arrays) {
    const stored = decodeArray(info, data.subarray(at, at + info.bytes));
    entries.push([info.name, { shape: info.shape, data: applyScale(info, stored) }]);
    at += info.bytes;
  }
  return { kind: header.kind, maxError: header.max_error, arrays: Object.fromEntries(entries) };
}

/** Return the array `name`. Throws `MalformedError` unless its type and shape fit (null: any length). */
export function requireArray<T extends AnyArray>(
  arrays: Record<string, DecodedArray>,
  name: string,
  kinds: readonly (new (length: number) => T)[],
  shape: readonly (number | null)[],
): { shape: number[]; data: T } {
  const array = Object.hasOwn(arrays, name) ? arrays[name] : undefined;
  if (array === undefined) throw new MalformedError(`the array ${name} is missing`);
  const fits = array.shape.length === shape.length && shape.every((n, i) => n === null || n === array.shape[i]);
  if (!fits || !kinds.some((kind) => array.data instanceof kind)) {
    throw new MalformedError(`the array ${name} is ${array.data.constructor.name} (${array.shape.join(", ")})`);
  }
  return array as { shape: number[]; data: T };
}

function readHeader(data: Uint8Array): { header: Filled<wire.ArrayHeader>; start: number } {
  if (data.length < PREFIX_BYTES) throw new MalformedError(`${data.length} bytes are no asset of arrays`);
  const view = new DataView(data.buffer, data.byteOffset, data.byteLength);
  for (let i = 0; i < 4; i++) if (data[i] !== ARRAYS_MAGIC.charCodeAt(i)) throw new MalformedError(`no asset of arrays: it does not begin with ${ARRAYS_MAGIC}`);
  const length = view.getUint32(4, true);
  const start = PREFIX_BYTES + length;
  if (length > MAX_ARRAY_HEADER_BYTES || start > data.length) throw new MalformedError(`a header of ${length} bytes in an asset of ${data.length}`);
  const header = decodeStruct("ArrayHeader", data.subarray(PREFIX_BYTES, start)) as Filled<wire.ArrayHeader>;
  let end = start;
  for (const info of header.arrays) end += info.bytes;
  if (end !== data.length) throw new MalformedError("the lengths in the header are not those of the asset");
  if (new Set(header.arrays.map((info) => info.name)).size !== header.arrays.length) throw new MalformedError("two arrays of the same name");
  return { header, start };
}

function stateBytes(info: ArrayInfo): number {
  const item = Object.hasOwn(ITEM_BYTES, info.dtype) ? ITEM_BYTES[info.dtype] : undefined;
  if (item === undefined) throw new MalformedError(`unknown dtype ${JSON.stringify(info.dtype)}`);
  if (info.shape.length === 0) throw new MalformedError(`array ${info.name} has no shape`);
  let size = item;
  for (const n of info.shape) {
    if (n > MAX_ARRAY_BYTES) throw new MalformedError(`array ${info.name} has ${n} entries along an axis`);
    size *= n;
  }
  return size;
}

function decodeArray(info: ArrayInfo, packed: Uint8Array): AnyArray {
  if (!FILTERS.includes(info.filter)) throw new MalformedError(`unknown filter ${JSON.stringify(info.filter)}`);
  if (info.filter === "delta" && info.dtype === "f4") throw new MalformedError("differences of float32 are not exact");
  const size = stateBytes(info);
  let plain: Uint8Array<ArrayBuffer>;
  if (info.codec === "deflate") plain = inflate(packed, size);
  else if (info.codec === "none") {
    if (packed.length !== size) throw new MalformedError(`array ${info.name} has ${packed.length} bytes, its shape and dtype need ${size}`);
    plain = packed.slice();
  } else throw new MalformedError(`unknown compression ${JSON.stringify(info.codec)}`);
  const item = ITEM_BYTES[info.dtype] as number;
  if (size === 0) return viewAs(info.dtype, plain);
  if (info.filter === "none") return viewAs(info.dtype, plain);
  if (info.filter === "up") {
    const row = size / (info.shape[0] as number);
    for (let i = row; i < size; i++) plain[i] = (plain[i] as number) + (plain[i - row] as number);
    return viewAs(info.dtype, plain);
  }
  const values = viewAs(info.dtype, item === 1 ? plain : unshuffle(plain, item));
  if (info.filter === "delta") for (let i = 1; i < values.length; i++) values[i] = (values[i] as number) + (values[i - 1] as number);
  return values;
}

/** Return elements of `item` bytes from their first bytes, their second bytes, and so on. */
function unshuffle(planes: Uint8Array, item: number): Uint8Array<ArrayBuffer> {
  const count = planes.length / item;
  const plain = new Uint8Array(planes.length);
  for (let k = 0; k < item; k++) {
    for (let i = 0, from = k * count, to = k; i < count; i++, from++, to += item) plain[to] = planes[from] as number;
  }
  return plain;
}

/** View bytes as elements. Every machine that runs a browser is little-endian. */
function viewAs(dtype: string, bytes: Uint8Array<ArrayBuffer>): AnyArray {
  switch (dtype) {
    case "u1":
      return bytes;
    case "i1":
      return new Int8Array(bytes.buffer);
    case "u2":
      return new Uint16Array(bytes.buffer);
    case "u4":
      return new Uint32Array(bytes.buffer);
    default:
      return new Float32Array(bytes.buffer);
  }
}

function applyScale(info: ArrayInfo, stored: AnyArray): AnyArray {
  const { scale, offset } = info;
  if (scale.length === 0) return stored;
  const last = info.shape.at(-1) as number;
  if (scale.length !== last || offset.length !== last) throw new MalformedError(`array ${info.name}: scale and offset need ${last} values each`);
  if (![...scale, ...offset].every(Number.isFinite)) throw new MalformedError(`array ${info.name}: scale and offset are not finite`);
  const values = new Float32Array(stored.length);
  const scale32 = Float32Array.from(scale);
  const offset32 = Float32Array.from(offset);
  for (let i = 0; i < values.length; i++) {
    const k = i % last;
    values[i] = Math.fround((stored[i] as number) * (scale32[k] as number)) + (offset32[k] as number);
  }
  return values;
}
