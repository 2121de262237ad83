// Raw deflate (RFC 1951) of a known size. fflate decodes; here is what it leaves open: the size, and typed errors.

import { inflateSync } from "fflate";
import { MalformedError } from "./errors.ts";

/** Most bytes that one byte of a stream can hold: 258 for two bits, the longest match. */
const MAX_RATIO = 1032;

/** Return the content of one stream, which must be `size` bytes and end where `packed` ends. Throws `MalformedError`. */
export function inflate(packed: Uint8Array, size: number): Uint8Array<ArrayBuffer> {
  if (packed.length === 0 || size > packed.length * MAX_RATIO) throw new MalformedError(`${packed.length} packed bytes cannot hold ${size}`);
  const out = new Uint8Array(size + 1); // room to see that there is more than was asked for
  let plain: Uint8Array;
  try {
    plain = inflateSync(packed, { out });
  } catch (error) {
    throw new MalformedError(`packed bytes are damaged: ${(error as Error).message}`);
  }
  if (plain.length !== size) throw new MalformedError(`packed bytes hold ${plain.length > size ? "more" : "less"} than ${size}`);
  const content = plain.slice() as Uint8Array<ArrayBuffer>;
  if (endsEarly(packed, out)) throw new MalformedError("bytes behind packed ones");
  return content;
}

/** Return whether a stream is complete without its last byte. fflate does not say where it ended; 60 kB take 0.3 ms. */
function endsEarly(packed: Uint8Array, out: Uint8Array): boolean {
  try {
    inflateSync(packed.subarray(0, -1), { out });
    return packed.length > 1;
  } catch {
    return false;
  }
}
