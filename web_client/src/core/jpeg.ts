// The size of a JPEG image, read before anything is decoded: a few hundred bytes can claim any size.

import { MalformedError } from "./errors.ts";

/** Largest width and height that is decoded [pixels]. */
const MAX_SIZE = 4096;
const START_OF_IMAGE = 0xd8;
const START_OF_SCAN = 0xda;
/** Markers from 0xC0 to 0xCF begin a frame, but for tables of Huffman codes, arithmetic conditioning, and one reserved. */
const NO_FRAMES = [0xc4, 0xc8, 0xcc];
/** Length, precision, height, width and number of components. */
const FRAME_HEADER_BYTES = 8;

/** Return the size that a JPEG image states [pixels]. Throws `MalformedError` for one that should not be decoded. */
export function readJpegSize(bytes: Uint8Array): { width: number; height: number } {
  if (bytes[0] !== 0xff || bytes[1] !== START_OF_IMAGE) throw new MalformedError(`${bytes.length} bytes that are no JPEG image`);
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  let at = 2;
  while (at + 4 <= bytes.length) {
    if (bytes[at] !== 0xff) break;
    const marker = bytes[at + 1]!;
    if (marker === 0xff) {
      at += 1; // a byte that fills
      continue;
    }
    const length = view.getUint16(at + 2);
    // Before the frame header, all markers have a length.
    if (marker < 0xc0 || (marker >= 0xd0 && marker <= START_OF_SCAN) || length < 2) break;
    if (marker <= 0xcf && !NO_FRAMES.includes(marker)) {
      if (length < FRAME_HEADER_BYTES || at + 2 + length > bytes.length) break;
      const [height, width] = [view.getUint16(at + 5), view.getUint16(at + 7)];
      if (width >= 1 && height >= 1 && width <= MAX_SIZE && height <= MAX_SIZE) return { width, height };
      throw new MalformedError(`JPEG image of ${width} x ${height} pixels, at most ${MAX_SIZE} x ${MAX_SIZE} are decoded`);
    }
    at += 2 + length;
  }
  throw new MalformedError(`JPEG image of ${bytes.length} bytes without a size`);
}
