// Sizes of JPEG images. tests/fuzz_streams.test.ts has hostile ones.

import { expect, test } from "vitest";

import { readJpegSize } from "../src/core/jpeg.ts";
import { makeJpeg, makeSegment } from "./jpegs.ts";

test.each([
  ["baseline", makeJpeg(640, 480)],
  ["progressive", makeJpeg(640, 480, { marker: 0xc2 })],
  ["without a segment before", makeJpeg(640, 480, { before: [] })],
  ["after tables, and a byte that fills", makeJpeg(640, 480, { before: [...makeSegment(0xdb, [0, 1]), ...makeSegment(0xc4, [2]), 0xff] })],
])("the size of an image: %s", (_name, bytes) => {
  expect(readJpegSize(bytes)).toEqual({ width: 640, height: 480 });
});

test.each([
  ["nothing", new Uint8Array(), /no JPEG/],
  ["a PNG image", Uint8Array.of(0x89, 0x50, 0x4e, 0x47), /no JPEG/],
  ["too wide", makeJpeg(4097, 1), /4097 x 1 pixels, at most 4096/],
  ["too high", makeJpeg(1, 65_535), /1 x 65535 pixels/],
  ["no rows, as they may come later", makeJpeg(640, 0), /640 x 0/],
  ["no size before the data", makeJpeg(640, 480, { before: makeSegment(0xda, [0]) }), /without a size/],
  ["bytes between segments", makeJpeg(640, 480, { before: [0] }), /without a size/],
  ["a length that reaches no further", makeJpeg(640, 480, { before: [0xff, 0xe0, 0, 0] }), /without a size/],
  ["a length beyond the end", makeJpeg(640, 480, { before: [0xff, 0xe0, 0xff, 0xff] }), /without a size/],
  ["cut within the frame header", makeJpeg(640, 480).subarray(0, -6), /without a size/],
])("refused: %s", (_name, bytes, words) => {
  expect(() => readJpegSize(bytes)).toThrow(words);
});
