// Raw deflate (RFC 1951) of a known size. fflate decodes; here is what it leaves open: the size, and typed errors.

import { inflateSync } from "fflate";
import { MalformedError } from "./errors.ts";

/** Most bytes that one byte of a stream can hold: 258 for two bits, the longest match. */
const MAX_RATIO = 1032;

/** Return the content of one stream, which must be `size` bytes. Bytes behind it count as nothing: fflate does not say where a stream ends, and
 * to find out takes as long again. Throws `MalformedError`. */
export function inflate(packed: Uint8Array, size: number): Uint8Array<ArrayBuffer> {
  if (packed.length === 0 || size > packed.length * MAX_RATIO) throw new MalformedError(`${packed.length} packed bytes cannot hold ${size}`);
  let plain: Uint8Array;
  try {
    plain = inflateSync(packed, { out: new Uint8Array(size + 1) }); // room to see that there is more than was asked for
  } catch (error) {
    throw new MalformedError(`packed bytes are damaged: ${(error as Error).message}`);
  }
  if (plain.length !== size) throw new MalformedError(`packed bytes hold ${plain.length > size ? "more" : "less"} than ${size}`);
  return plain.slice() as Uint8Array<ArrayBuffer>;
}
