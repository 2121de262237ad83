// Hostile bytes for a decoder: golden vectors with changes, and random ones. The same inputs every time.
//
// IRIS_FUZZ=100000 sets how many inputs each decoder gets; 10,000 by default, which a busy machine too does within the limit of a test.

import { expect } from "vitest";
import { WireError } from "../src/core/errors.ts";

const INPUTS = Number(process.env["IRIS_FUZZ"] ?? 10_000);
const SEED = 20_261_123;
/** Bytes that mean something in MessagePack, lengths and headers. */
const TELLING = [0x00, 0x01, 0x7f, 0x80, 0x81, 0x90, 0x91, 0xa0, 0xc0, 0xc1, 0xc4, 0xc6, 0xca, 0xcb, 0xcf, 0xd3, 0xd9, 0xdb, 0xdc, 0xdd, 0xde, 0xdf, 0xe0, 0xff];
/** What a decoder may allocate at once: so much for each byte of its input, and this besides. */
const BYTES_PER_BYTE = 64;
const BYTES_BESIDES = 1 << 16;

type AnyConstructor = new (...values: never[]) => ArrayBufferView;
const WATCHED = ["Uint8Array", "Int8Array", "Uint16Array", "Uint32Array", "Int32Array", "Float32Array", "Float64Array"] as const;

/** Numbers from 0 to 2^32 - 1, by a linear congruence and a finaliser. */
function makeRandom(seed: number): (below: number) => number {
  let state = seed >>> 0;
  return (below) => {
    state = (Math.imul(state, 1664525) + 1013904223) >>> 0;
    let value = state;
    value = Math.imul(value ^ (value >>> 16), 0x45d9f3b);
    value = Math.imul(value ^ (value >>> 16), 0x45d9f3b);
    return ((value ^ (value >>> 16)) >>> 0) % below;
  };
}

/** Return one hostile input. */
function makeInput(random: (below: number) => number, seeds: readonly Uint8Array[]): Uint8Array {
  if (random(8) === 0) return Uint8Array.from({ length: random(64) }, () => random(256));
  const seed = seeds[random(seeds.length)] as Uint8Array;
  let bytes = seed.slice();
  for (let changes = 1 + random(4); changes > 0; changes--) {
    const at = random(bytes.length + 1);
    switch (random(6)) {
      case 0:
        bytes = bytes.slice(0, at);
        break;
      case 1:
        bytes[at] = random(256);
        break;
      case 2:
        bytes[at] = (bytes[at] ?? 0) ^ (1 << random(8));
        break;
      case 3:
        bytes[at] = TELLING[random(TELLING.length)] as number;
        break;
      case 4:
        for (let i = 0; i < 4; i++) bytes[at + i] = random(3) === 0 ? 0x7f : 0xff;
        break;
      default: {
        const other = seeds[random(seeds.length)] as Uint8Array;
        const from = random(other.length + 1);
        const part = other.subarray(from, from + random(32));
        const joined = new Uint8Array(bytes.length + part.length);
        joined.set(bytes.subarray(0, at));
        joined.set(part, at);
        joined.set(bytes.subarray(at), at + part.length);
        bytes = joined;
      }
    }
  }
  return bytes;
}

/**
 * Give a decoder hostile inputs: it must return or throw a `WireError`, and allocate in proportion to its input.
 *
 * `unpacks`: it may allocate what its compressed blocks can hold.
 */
export function fuzz(decode: (bytes: Uint8Array) => unknown, seeds: readonly Uint8Array[], unpacks = false): void {
  const random = makeRandom(SEED);
  const watch = watchAllocations();
  let refused = 0;
  try {
    for (let i = 0; i < INPUTS; i++) {
      const bytes = makeInput(random, seeds);
      watch.largest = 0;
      try {
        decode(bytes);
      } catch (error) {
        if (!(error instanceof WireError)) throw new Error(`input ${i}: ${toHex(bytes)}`, { cause: error });
        refused += 1;
      }
      const most = unpacks ? (128 << 10) * (2 + bytes.length / 4) : BYTES_BESIDES + BYTES_PER_BYTE * bytes.length;
      if (watch.largest > most) throw new Error(`input ${i} of ${bytes.length} bytes made it allocate ${watch.largest}: ${toHex(bytes)}`);
    }
  } finally {
    watch.end();
  }
  expect(refused).toBeGreaterThan(INPUTS / 4); // the inputs are hostile
  expect(refused).toBeLessThan(INPUTS); // and not hopeless
}

/** Record the largest typed array that is made by its length. */
function watchAllocations(): { largest: number; end(): void } {
  const originals = WATCHED.map((name) => globalThis[name] as unknown as AnyConstructor & { BYTES_PER_ELEMENT: number });
  const watch = {
    largest: 0,
    end: (): void => {
      for (const [i, name] of WATCHED.entries()) Object.assign(globalThis, { [name]: originals[i] });
    },
  };
  for (const [i, name] of WATCHED.entries()) {
    const original = originals[i] as (typeof originals)[number];
    const construct = (target: AnyConstructor, values: never[], newTarget: AnyConstructor): ArrayBufferView => {
      if (typeof values[0] === "number") watch.largest = Math.max(watch.largest, (values[0] as number) * original.BYTES_PER_ELEMENT);
      return Reflect.construct(target, values, newTarget === proxy ? target : newTarget) as ArrayBufferView;
    };
    const proxy: AnyConstructor = new Proxy(original, { construct: construct as never });
    Object.assign(globalThis, { [name]: proxy });
  }
  return watch;
}

function toHex(bytes: Uint8Array): string {
  return Buffer.from(bytes).toString("hex");
}
