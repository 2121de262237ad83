// Zstandard frames of a known size, without a dictionary. The decoder is fzstd; this file decides what it is given.
//
// A frame is walked block by block before anything is allocated: what its blocks can hold at most must reach the size
// that is expected, and that size must be stated in its header.

import { decompress } from "fzstd";
import { MalformedError } from "./errors.ts";

const MAGIC = 0xfd2fb528;
/** Most bytes of one block after decompression. */
const MAX_BLOCK = 128 << 10;

/** Return the content of one frame, which must be `size` bytes. Throws `MalformedError`. */
export function decompressFrame(frame: Uint8Array, size: number): Uint8Array<ArrayBuffer> {
  checkFrame(frame, size);
  const content = new Uint8Array(size);
  try {
    decompress(frame, content);
  } catch (error) {
    throw new MalformedError(`damaged Zstandard frame: ${error instanceof Error ? error.message : String(error)}`);
  }
  return content;
}

/** Throw unless `frame` is one whole frame that states `size`, and whose blocks can hold so much. */
function checkFrame(frame: Uint8Array, size: number): void {
  const view = new DataView(frame.buffer, frame.byteOffset, frame.byteLength);
  if (frame.length < 6 || view.getUint32(0, true) !== MAGIC) throw new MalformedError("no Zstandard frame");
  const flags = view.getUint8(4);
  const single = (flags & 0x20) !== 0;
  if ((flags & 0x08) !== 0 || (flags & 0x03) !== 0) throw new MalformedError("a Zstandard frame with reserved bits or a dictionary");
  const sizeBytes = flags >> 6 === 0 ? (single ? 1 : 0) : 1 << (flags >> 6);
  let at = 5 + (single ? 0 : 1);
  if (sizeBytes === 0 || at + sizeBytes > frame.length) throw new MalformedError("a Zstandard frame that does not state its size");
  if (readSize(view, at, sizeBytes) !== size) throw new MalformedError(`a Zstandard frame of another size than ${size}`);
  at += sizeBytes;
  let room = 0;
  for (let last = false; !last; ) {
    if (at + 3 > frame.length) throw new MalformedError("a Zstandard frame that is truncated");
    const head = view.getUint16(at, true) | (view.getUint8(at + 2) << 16);
    last = (head & 1) !== 0;
    const kind = (head >> 1) & 3;
    const length = head >> 3;
    if (kind === 3 || length > MAX_BLOCK) throw new MalformedError("a Zstandard block of an unknown kind or size");
    at += 3 + (kind === 1 ? 1 : length);
    room += kind === 2 ? MAX_BLOCK : length;
  }
  if (at + ((flags & 0x04) !== 0 ? 4 : 0) !== frame.length) throw new MalformedError("a Zstandard frame that is truncated, or with bytes after it");
  if (room < size) throw new MalformedError(`a Zstandard frame whose blocks cannot hold ${size} bytes`);
}

function readSize(view: DataView, at: number, bytes: number): number {
  switch (bytes) {
    case 1:
      return view.getUint8(at);
    case 2:
      return view.getUint16(at, true) + 256;
    case 4:
      return view.getUint32(at, true);
    default:
      return Number(view.getBigUint64(at, true));
  }
}
