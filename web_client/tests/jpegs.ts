// Beginnings of JPEG images, as far as their size.

/** Return a segment: marker, length, and what it holds. */
export function makeSegment(marker: number, content: readonly number[]): number[] {
  return [0xff, marker, (content.length + 2) >> 8, (content.length + 2) & 255, ...content];
}

/** Return the beginning of an image: start, `before`, and the frame header, which `marker` begins. */
export function makeJpeg(width: number, height: number, { marker = 0xc0, before = makeSegment(0xe0, [74, 70, 73, 70, 0]) } = {}): Uint8Array {
  const size = [height >> 8, height & 255, width >> 8, width & 255];
  return Uint8Array.from([0xff, 0xd8, ...before, ...makeSegment(marker, [8, ...size, 1, 1, 0x11, 0])]);
}
