// Hostile bytes for the decoders of state, deformables, clouds, pictures, arrays and scenes.

import { deflateRawSync } from "node:zlib";
import { describe, test } from "vitest";
import { decodeArrays } from "../src/core/arrays.ts";
import { decodeCloud } from "../src/core/cloud.ts";
import { encodeStruct } from "../src/core/codec.ts";
import { DeformableDecoder, decodeTopology } from "../src/core/deformable.ts";
import { inflate } from "../src/core/inflate.ts";
import { readJpegSize } from "../src/core/jpeg.ts";
import { RigidDecoder } from "../src/core/rigid.ts";
import { decodeScene } from "../src/core/scene.ts";
import { fuzz } from "./fuzz.ts";
import { fromHex, readGolden } from "./golden.ts";
import { makeJpeg, makeSegment } from "./jpegs.ts";

const { rigid } = readGolden<{ rigid: { n_bodies: number; hex: string }[] }>("golden");
const { meshes } = readGolden<{ meshes: { name: string; topology: string; frames: { hex: string }[] }[] }>("deformable");
const { frames: clouds } = readGolden<{ frames: { hex: string }[] }>("cloud");
const { assets } = readGolden<{ assets: { hex: string }[] }>("arrays");
const { scenes } = readGolden<{ scenes: { hex: string }[] }>("scene");

describe("hostile bytes", () => {
  test("rigid state", () => {
    const decoders = rigid.map(({ n_bodies }) => new RigidDecoder(n_bodies));
    let seq = 0;
    fuzz((bytes) => {
      seq += 1;
      (decoders.find(({ bodyCount }) => bodyCount === bytes[2]) ?? (decoders[0] as RigidDecoder)).apply(seq, Math.max(0, seq - 2), bytes);
    }, rigid.map(({ hex }) => fromHex(hex)));
  });

  test("topologies", () => fuzz(decodeTopology, meshes.map(({ topology }) => fromHex(topology)).filter((bytes) => bytes.length < 3000)));

  test("frames of deformables", () => {
    const cloth = meshes[0] as (typeof meshes)[number];
    const decoder = new DeformableDecoder(decodeTopology(fromHex(cloth.topology)));
    fuzz((bytes) => decoder.decode(bytes), cloth.frames.map(({ hex }) => fromHex(hex)), true);
  });

  test("point clouds", () => fuzz(decodeCloud, clouds.map(({ hex }) => fromHex(hex)), true));

  test("sizes of pictures", () => {
    const seeds = [makeJpeg(640, 480), makeJpeg(4096, 4096, { marker: 0xc2, before: [...makeSegment(0xdb, [0, 1]), 0xff] })];
    fuzz((bytes) => {
      const { width, height } = readJpegSize(bytes);
      if (Math.min(width, height) < 1 || Math.max(width, height) > 4096) throw new Error(`${width} x ${height}`);
    }, seeds);
  });

  test("arrays", () => fuzz((bytes) => decodeArrays(bytes), assets.map(({ hex }) => fromHex(hex)), true));

  test("deflate", () => {
    const text = Buffer.from("a stream of a known size, and one more ".repeat(12));
    const noise = Buffer.from(Uint8Array.from({ length: 512 }, (_, i) => (i * i * 31) % 23));
    const streams = [text, noise].map((data) => new Uint8Array(deflateRawSync(data)));
    fuzz((bytes) => inflate(bytes, bytes.length % 2 === 0 ? text.length : noise.length), streams, true);
  });

  test("scenes", () => {
    const small = { bodies: [{ id: 1, name: "a", parent: -1, T_parent_body: [[0, 0, 0], [1, 0, 0, 0]], T_world_body: [[0, 0, 0], [1, 0, 0, 0]], moving: true }] };
    const light = { name: "sun", kind: "spot", body: 1, p_body: [0, 0, 3], direction_body: [0, 0, -1], ambient: [0, 0, 0], diffuse: [1, 1, 1], specular: [0, 0, 0] };
    const seeds = [fromHex((scenes[2] as { hex: string }).hex), encodeStruct("SceneSpec", small), encodeStruct("SceneSpec", { ...small, lights: [light] })];
    fuzz(decodeScene, seeds.filter((bytes) => bytes.length < 3000));
  });
});
