// State, deformables, arrays, scenes and axes against docs/protocol.

import { constants, deflateRawSync } from "node:zlib";
import { describe, expect, test } from "vitest";
import { decodeArrays, requireArray } from "../src/core/arrays.ts";
import { fromThree, toThree } from "../src/core/axes.ts";
import { decodeStruct, encodeStruct } from "../src/core/codec.ts";
import { decodeCloud } from "../src/core/cloud.ts";
import { crc32, DeformableDecoder, decodeTopology } from "../src/core/deformable.ts";
import { MalformedError, WireError } from "../src/core/errors.ts";
import { inflate } from "../src/core/inflate.ts";
import { RigidDecoder } from "../src/core/rigid.ts";
import { decodeScene } from "../src/core/scene.ts";
import { fromHex, readGolden, toHex, toJson, type Vector } from "./golden.ts";

interface RigidVector {
  name: string;
  n_bodies: number;
  hex: string;
  poses: Record<string, (number | null)[]>;
}

describe("rigid state", () => {
  const { rigid, conversions } = readGolden<{ rigid: RigidVector[]; conversions: { world: number[]; three: number[] }[] }>("golden");

  test.each(rigid)("$name", ({ n_bodies, hex, poses }) => {
    const decoder = new RigidDecoder(n_bodies);
    decoder.apply(1, 0, fromHex(hex));
    for (let body = 0; body < n_bodies; body++) {
      const row = [...decoder.poses.subarray(7 * body, 7 * body + 7)];
      const expected = poses[body] ?? new Array(7).fill(null);
      for (const [k, value] of expected.entries()) {
        if (value === null) expect(row[k]).toBeNaN();
        else expect(Math.abs((row[k] as number) - value)).toBeLessThanOrEqual(1e-12 * Math.max(1, Math.abs(value)));
      }
    }
    expect(decoder.complete).toBe(Object.keys(poses).length === n_bodies);
  });

  const room = rigid.find(({ n_bodies, poses }) => n_bodies === 5 && Object.keys(poses).length === 5) as RigidVector;
  const two = rigid.find(({ n_bodies }) => n_bodies === 19) as RigidVector;
  const escapes = rigid.find(({ name }) => name === "escapes") as RigidVector;

  test.each<[string, RigidVector, (bytes: Uint8Array) => Uint8Array]>([
    ["nothing", room, () => new Uint8Array()],
    ["a byte less", room, (bytes) => bytes.subarray(0, -1)],
    ["a byte more", room, (bytes) => new Uint8Array([...bytes, 0])],
    ["another format", room, (bytes) => withByte(bytes, 0, 1)],
    ["another layout", room, (bytes) => withByte(bytes, 1, 2)],
    ["another number of bodies", room, (bytes) => withByte(bytes, 2, 6)],
    ["more quantised than bodies", room, (bytes) => withByte(bytes, 4, 6)],
    ["no rotation", room, (bytes) => withByte(bytes, 23, 0xff)],
    ["a mask with a bit too many", two, (bytes) => withByte(bytes, 44, (bytes[44] as number) | 1)],
    ["a mask beyond the bodies", two, (bytes) => withByte(withByte(bytes, 44, 0), bytes.length - 1, 0x0c)],
    ["an escape that is in the mask", escapes, (bytes) => withByte(bytes, 34, 3)],
    ["escapes that descend", escapes, (bytes) => withByte(bytes, 34, 11)],
    ["an escape beyond the bodies", escapes, (bytes) => withByte(bytes, 34 + 58, 12)],
  ])("refuses %s, and changes nothing", (_name, vector, change) => {
    const decoder = new RigidDecoder(vector.n_bodies);
    decoder.apply(1, 0, fromHex(vector.hex));
    const before = [...decoder.poses];
    expect(() => decoder.apply(2, 0, change(fromHex(vector.hex)))).toThrow(MalformedError);
    expect(decoder.stateSeq).toBe(1);
    expect([...decoder.poses]).toEqual(before);
  });

  test("a body is valid in a frame, or where it was since the base", () => {
    const decoder = new RigidDecoder(19);
    expect(decoder.apply(5, 3, fromHex(two.hex))).toBe(false);
    expect(decoder.loadKeyframe(4, new Float64Array(7 * 19))).toBe(true);
    expect(decoder.poses[0]).toBe(0);
    expect(decoder.poses[7 * 7]).toBeCloseTo(9.9, 3);
    expect(decoder.apply(6, 5, fromHex(two.hex))).toBe(true);
    expect(decoder.apply(40, 30, fromHex(two.hex))).toBe(false);
    expect(decoder.apply(39, 0, fromHex(two.hex))).toBe(false);
    expect(decoder.staleFrames).toBe(1);
    expect(() => decoder.loadKeyframe(50, new Float64Array(7))).toThrow(MalformedError);
    expect(() => decoder.apply(50, 51, fromHex(two.hex))).toThrow(MalformedError);
  });

  test.each(conversions)("axes of three.js: $world", ({ world, three }) => {
    const there: number[] = [];
    const back: number[] = [];
    toThree(world, there);
    fromThree(three, back);
    for (let i = 0; i < 7; i++) {
      expect(there[i]).toBeCloseTo(three[i] as number, 14);
      expect(back[i]).toBeCloseTo(world[i] as number, 14);
    }
  });
});

describe("point clouds", () => {
  interface Cloud {
    name: string;
    hex: string;
    error_m: number | null;
    voxel_m: number;
    positions: number[][];
    colors: number[][];
  }
  const { frames } = readGolden<{ frames: Cloud[] }>("cloud");

  /** Red, green and blue of a colour of 16 bits, 0 to 255. */
  const unpackColor = (packed: number) => [packed >> 11, (packed >> 5) & 63, packed & 31].map((level, i) => Math.round((level * 255) / (i === 1 ? 63 : 31)));

  test.each(frames)("$name", (frame) => {
    const { points, origin, step_m, error_m, voxel_m } = decodeCloud(fromHex(frame.hex));
    const rows = frame.positions.map((_, i) => origin.map((node, axis) => Math.fround((node + (points[4 * i + axis] as number)) * step_m)));
    expect(rows).toEqual(frame.positions);
    expect(frame.positions.map((_, i) => unpackColor(points[4 * i + 3] as number))).toEqual(frame.colors);
    expect([error_m, voxel_m]).toEqual([frame.error_m ?? Number.POSITIVE_INFINITY, frame.voxel_m]);
  });

  const frame = fromHex((frames[0] as Cloud).hex);

  test.each<[string, Uint8Array]>([
    ["nothing", new Uint8Array()],
    ["another format", withByte(frame, 0, 2)],
    ["flags", withByte(frame, 1, 1)],
    ["a lattice of 2^-40 m", withByte(frame, 2, 0xd8)],
    ["reserved bytes", withByte(frame, 3, 1)],
    ["another number of points", withByte(frame, 4, 23)],
    ["2^31 points", withByte(frame, 7, 0x80)],
    ["an origin far away", withByte(frame, 11, 0x7f)],
    ["no error", frame.map((byte, i) => (i >= 20 && i < 24 ? 0 : byte))],
    ["voxels of no size", frame.map((byte, i) => (i >= 24 && i < 28 ? 0xff : byte))],
    ["a byte less", frame.subarray(0, -1)],
    ["a byte more", new Uint8Array([...frame, 0])],
  ])("refuses a frame: %s", (_name, bytes) => {
    expect(() => decodeCloud(bytes)).toThrow(MalformedError);
  });
});

describe("deformables", () => {
  interface Mesh {
    name: string;
    topology: string;
    frames: { name: string; bound_m: number; hex: string; vertices: (number | null)[][] }[];
  }
  const { meshes } = readGolden<{ meshes: Mesh[] }>("deformable");

  for (const mesh of meshes) {
    test.each(mesh.frames)(`${mesh.name}: $name`, (frame) => {
      const decoder = new DeformableDecoder(decodeTopology(fromHex(mesh.topology)));
      const vertices = decoder.decode(fromHex(frame.hex));
      const rows = frame.vertices.map((_, i) => [...vertices.subarray(3 * i, 3 * i + 3)].map((v) => (Number.isFinite(v) ? v : null)));
      expect(rows).toEqual(frame.vertices);
      expect(decoder.boundM).toBe(frame.bound_m);
    });
  }

  const cloth = meshes[0] as Mesh;
  const frame = fromHex((cloth.frames[0] as { hex: string }).hex);

  test.each<[string, Uint8Array]>([
    ["nothing", new Uint8Array()],
    ["another format", withByte(frame, 0, 1)],
    ["other flags", withByte(frame, 1, 2)],
    ["five planes", withByte(frame, 2, 5)],
    ["another number of planes", withByte(frame, 2, 2)],
    ["a lattice of 2^-40 m", withByte(frame, 3, 0xd8)],
    ["no bound", frame.map((byte, i) => (i >= 4 && i < 8 ? 0 : byte))],
    ["another mesh", withByte(frame, 12, (frame[12] as number) ^ 1)],
    ["escapes beyond the frame", withByte(frame, 16, 30)],
    ["a byte less", frame.subarray(0, -1)],
    ["planes that are no deflate", withByte(frame, 32, 7)],
  ])("refuses a frame: %s", (_name, bytes) => {
    const decoder = new DeformableDecoder(decodeTopology(fromHex(cloth.topology)));
    expect(() => decoder.decode(bytes)).toThrow(MalformedError);
  });

  const topology = fromHex(cloth.topology);
  const tree = fromHex((meshes.find(({ topology }) => topology.startsWith("0101")) as Mesh).topology);

  test.each<[string, Uint8Array]>([
    ["nothing", new Uint8Array()],
    ["another format", withByte(topology, 0, 2)],
    ["another plan", withByte(topology, 1, 2)],
    ["other flags", withByte(topology, 2, 2)],
    ["no vertex", topology.map((byte, i) => (i >= 4 && i < 8 ? 0 : byte))],
    ["2^31 vertices", withByte(topology, 7, 0x80)],
    ["2^31 faces", withByte(topology, 19, 0x80)],
    ["rows that do not fit", withByte(topology, 8, 7)],
    ["a face beyond the vertices", withByte(topology, 24, 30)],
    ["a parent that comes later", withByte(tree, tree.length - 4 * (3 * new DataView(tree.buffer).getUint32(16, true)) - 4, 0xff)],
    ["a byte more", new Uint8Array([...topology, 0])],
  ])("refuses a topology: %s", (_name, bytes) => {
    expect(() => decodeTopology(bytes)).toThrow(MalformedError);
  });

  test("an order must have every vertex once", () => {
    const one = new Uint8Array(24 + 8);
    const view = new DataView(one.buffer);
    for (const [at, value] of [[0, 1], [4, 2], [8, 1], [12, 2]] as const) view.setUint32(at, value, true);
    view.setUint16(2, 1, true);
    expect(() => decodeTopology(one)).toThrow(/each once/);
    view.setUint32(24, 1, true);
    expect([...(decodeTopology(one).order as Uint32Array)]).toEqual([1, 0]);
  });

  test("CRC-32 is that of zlib", () => expect(crc32(new TextEncoder().encode("123456789"))).toBe(0xcbf43926));
});

describe("arrays", () => {
  interface Asset {
    name: string;
    kind: string;
    hex: string;
    arrays: Record<string, { dtype: string; shape: number[]; values: (number | null)[] }>;
  }
  const { assets, malformed } = readGolden<{ assets: Asset[]; malformed: { name: string; hex: string }[] }>("arrays");

  test.each(assets)("$name", ({ kind, hex, arrays }) => {
    const decoded = decodeArrays(fromHex(hex));
    expect(decoded.kind).toBe(kind);
    expect(Object.keys(decoded.arrays).sort()).toEqual(Object.keys(arrays).sort());
    for (const [name, { shape, values }] of Object.entries(arrays)) {
      const array = decoded.arrays[name];
      expect(array?.shape).toEqual(shape);
      expect(array?.data.length).toBe(values.length);
      const ulp = decoded.maxError > 0 ? 2 ** -23 : 0;
      for (const [i, value] of values.entries()) {
        const read = array?.data[i] as number;
        if (value === null) expect(Number.isFinite(read)).toBe(false);
        else expect(Math.abs(read - value)).toBeLessThanOrEqual(ulp * Math.max(1, Math.abs(value)));
      }
    }
  });

  test.each(malformed.filter(({ name }) => name !== "another kind"))("refuses $name", ({ hex }) => {
    expect(() => decodeArrays(fromHex(hex))).toThrow(MalformedError);
  });

  test("another kind is told by its name", () => {
    const { hex } = malformed.find(({ name }) => name === "another kind") as { hex: string };
    expect(decodeArrays(fromHex(hex)).kind).toBe("image");
  });

  test("what is asked for must fit", () => {
    const { arrays } = decodeArrays(fromHex((assets.find(({ name }) => name === "a mesh, exact") as Asset).hex));
    expect(requireArray(arrays, "position", [Float32Array], [null, 3]).data).toHaveLength(96);
    expect(() => requireArray(arrays, "position", [Float32Array], [null, 2])).toThrow(MalformedError);
    expect(() => requireArray(arrays, "position", [Uint16Array], [null, 3])).toThrow(MalformedError);
    expect(() => requireArray(arrays, "toString", [Uint16Array], [null, 3])).toThrow(MalformedError);
  });

  test("more than the limit is not read", () => {
    expect(() => decodeArrays(fromHex((assets[0] as Asset).hex), 10)).toThrow(/at most 10/);
  });
});

describe("deflate", () => {
  const text = new Uint8Array(Buffer.from("a stream of a known size ".repeat(400)));
  const stream = new Uint8Array(deflateRawSync(text));

  test.each([constants.Z_DEFAULT_STRATEGY, constants.Z_HUFFMAN_ONLY, constants.Z_RLE, constants.Z_FIXED])("streams of strategy %i", (strategy) => {
    for (const content of [text, text.subarray(0, 1), new Uint8Array(70_000)]) {
      expect(Buffer.compare(inflate(new Uint8Array(deflateRawSync(content, { strategy })), content.length), content)).toBe(0);
    }
  });

  test("every stream with a bit changed is refused, or has the stated size", () => {
    for (let i = 0; i < 8 * stream.length; i++) {
      const changed = withByte(stream, i >> 3, (stream[i >> 3] as number) ^ (1 << (i & 7)));
      try {
        expect(inflate(changed, text.length)).toHaveLength(text.length);
      } catch (error) {
        expect(error).toBeInstanceOf(MalformedError);
      }
    }
  });

  test.each<[string, Uint8Array, number]>([
    ["nothing", new Uint8Array(), 5],
    ["a byte more than is asked for", stream, text.length - 1],
    ["a byte less than is asked for", stream, text.length + 1],
    ["the end missing", stream.subarray(0, -1), text.length],
    ["a size that the stream cannot hold", stream, 2 ** 30],
  ])("refuses %s", (_name, bytes, size) => {
    expect(() => inflate(bytes, size)).toThrow(MalformedError);
  });
});

describe("scenes", () => {
  interface Golden {
    structs: (Vector & { type: string })[];
    scenes: (Vector & { canonical: boolean; address: string })[];
    malformed: { name: string; hex: string }[];
  }
  const golden = readGolden<Golden>("scene");

  test.each(golden.structs)("$name", ({ type, hex, value }) => {
    const decoded = decodeStruct(type, fromHex(hex), true);
    expect(toJson(decoded)).toEqual(value);
    expect(toHex(encodeStruct(type, decoded))).toBe(hex);
  });

  test.each(golden.scenes)("$name", async ({ hex, value, canonical, address }) => {
    const spec = decodeScene(fromHex(hex));
    expect(toJson(spec)).toEqual(value);
    if (canonical) expect(toHex(encodeStruct("SceneSpec", spec))).toBe(hex);
    const digest = await crypto.subtle.digest("SHA-256", fromHex(hex));
    expect(toHex(new Uint8Array(digest))).toBe(address);
  });

  test.each(golden.malformed)("refuses $name", ({ hex }) => {
    expect(() => decodeScene(fromHex(hex))).toThrow(WireError);
  });
});

function withByte(bytes: Uint8Array, at: number, value: number): Uint8Array {
  const changed = bytes.slice();
  changed[at] = value;
  return changed;
}
