// Messages both ways against docs/protocol/golden.json, refusals, and exact integers.

import { describe, expect, test } from "vitest";
import * as codec from "../src/core/codec.ts";
import { InvalidMessageError, MalformedError, TooLargeError, VersionError, WireError } from "../src/core/errors.ts";
import { STRUCTS } from "../src/protocol/schema.g.ts";
import { fromHex, readGolden, toHex, toJson, type Vector } from "./golden.ts";

const golden = readGolden<Record<string, Vector[]> & { malformed: { name: string; code: string; hex: string }[] }>("golden");

/** Structs that a browser never gets are decoded by the same tables. */
const asStruct = (name: string) => (bytes: Uint8Array, exact: boolean) => codec.decodeStruct(name, bytes, exact);
const GROUPS: [string, string, (bytes: Uint8Array, exact: boolean) => unknown][] = [
  ["client", "ClientEnvelope", codec.decodeClient],
  ["server", "ServerEnvelope", codec.decodeServer],
  ["state_header", "StateHeader", codec.decodeStateHeader],
  ["presence", "Presence", codec.decodePresence],
  ["media_header", "MediaHeader", codec.decodeMediaHeader],
  ["media_push", "MediaPush", asStruct("MediaPush")],
  ["asset_request", "AssetRequest", asStruct("AssetRequest")],
  ["asset_chunk", "AssetChunk", asStruct("AssetChunk")],
  ["asset_refused", "AssetRefused", asStruct("AssetRefused")],
  ["beacon", "Beacon", asStruct("Beacon")],
];

describe("golden vectors", () => {
  for (const [group, struct, decode] of GROUPS) {
    test(`${group}: bytes to value and back`, () => {
      const vectors = golden[group] ?? [];
      expect(vectors.length).toBeGreaterThan(1);
      for (const { name, hex, value } of vectors) {
        const decoded = decode(fromHex(hex), true);
        expect(toJson(decoded), name).toEqual(value);
        expect(toHex(codec.encodeStruct(struct, decoded)), name).toBe(hex);
      }
    });
  }

  test("every struct of the tables that is a message has a vector", () => {
    const seen = new Set([...(golden.client ?? []), ...(golden.server ?? [])].map(({ name }) => name.split("/").slice(0, -1).join("/")));
    for (const table of Object.values(STRUCTS)) {
      const [field, tag] = table.tag ?? ["", ""];
      if (field === "type") expect(seen).toContain(tag);
      if (field === "event") expect(seen).toContain(`event/${tag}`);
    }
  });

  test("what other encoders may write is read", () => {
    for (const { name, hex, value } of golden.decode_only ?? []) {
      expect(toJson(codec.decodeClient(fromHex(hex))), name).toEqual(value);
    }
    for (const { name, hex, value } of golden.decode_only_server ?? []) {
      expect(toJson(codec.decodeServer(fromHex(hex))), name).toEqual(value);
    }
    for (const { name, hex, value } of golden.decode_only_media_header ?? []) {
      expect(toJson(codec.decodeMediaHeader(fromHex(hex))), name).toEqual(value);
    }
  });

  test("arrays with a least length are read and written no shorter", () => {
    const info = { name: "a", dtype: "u1", shape: [1], bytes: 0 };
    expect(codec.decodeStruct("ArrayInfo", codec.encodeStruct("ArrayInfo", info))).toMatchObject(info);
    expect(() => codec.encodeStruct("ArrayInfo", { ...info, shape: [] })).toThrow(MalformedError);
    const bytes = toHex(codec.encodeStruct("ArrayInfo", info));
    expect(() => codec.decodeStruct("ArrayInfo", fromHex(bytes.replace("a5736861706591" + "01", "a5736861706590")))).toThrow(MalformedError);
  });

  test("what must be refused is refused, with its code", () => {
    for (const { name, hex, code } of golden.malformed) {
      let error: unknown;
      try {
        codec.decodeClient(fromHex(hex));
      } catch (caught) {
        error = caught;
      }
      expect(error, name).toBeInstanceOf(WireError);
      expect((error as WireError).code, name).toBe(code);
    }
  });

  test("every message cut anywhere is refused", () => {
    for (const { name, hex } of [...(golden.client ?? []), ...(golden.server ?? [])].filter(({ name }) => name.endsWith("/full"))) {
      const bytes = fromHex(hex);
      const decode = (golden.client ?? []).some((vector) => vector.name === name) ? codec.decodeClient : codec.decodeServer;
      for (let end = 0; end < bytes.length; end++) expect(() => decode(bytes.subarray(0, end)), name).toThrow(WireError);
    }
  });
});

test("integers beyond 2^53 are rounded, unless exact ones are asked for", () => {
  const bytes = codec.encodeStruct("ClientEnvelope", [1, 0, "", { type: "clock_ping", t0_ns: 2n ** 53n + 1n }]);
  expect(codec.decodeClient(bytes)[3]).toEqual({ type: "clock_ping", t0_ns: 2 ** 53 });
  expect(codec.decodeClient(bytes, true)[3]).toEqual({ type: "clock_ping", t0_ns: 2n ** 53n + 1n });
});

describe("encoding", () => {
  test("writes defaults for what is left out", () => {
    const bytes = codec.encodeClient({ type: "hello", role: "observer", name: "Ada" });
    expect(codec.decodeClient(bytes)[3]).toMatchObject({ devices: [], alignment: "measured", secret: new Uint8Array() });
  });

  test.each([
    ["a field is missing", { type: "hello", role: "observer" }, /hello.*name/],
    ["a number for a text", { type: "hello", role: "observer", name: 3 }, /name/],
    ["65 characters", { type: "hello", role: "observer", name: "x".repeat(65) }, /65 characters/],
    ["half a number", { type: "clock_ping", t0_ns: 0.5 }, /t0_ns.*0.5/],
    ["beyond 2^53", { type: "clock_ping", t0_ns: 2 ** 60 }, /exact/],
    ["below zero", { type: "get_snapshot", request_id: -1 }, /request_id/],
    ["half a surrogate pair", { type: "bye", reason: "\ud83e" }, /surrogate/],
    ["an unknown type", { type: "teleport" }, /teleport/],
    ["no type", {}, /unknown type/],
    ["two quaternion numbers", { type: "observation", anchor_id: "a", kind: "qr", T_tracking_anchor: [[0, 0, 0], [1, 0]], capture_ns: 0, tracking_epoch: 0 }, /T_tracking_anchor.q/],
    ["too large", { type: "samples", samples: Array.from({ length: 16 }, () => ({ type: "sample", device: "head", kind: "pose", seq: 1, capture_ns: 1, scene_epoch: 1, tracking_epoch: 1, alignment_version: 1, hand_joints: new Array(182).fill(0.5), q: new Array(64).fill(0.5), qd: new Array(64).fill(0.5) })) }, /samples/],
  ])("refuses %s", (_name, message, text) => {
    expect(() => codec.encodeClient(message as never)).toThrow(InvalidMessageError);
    expect(() => codec.encodeClient(message as never)).toThrow(text);
  });

  test("the limits of every client message are known", () => {
    for (const table of Object.values(STRUCTS)) {
      if (table.tag?.[0] === "type") expect({ ...codec.CLIENT_LIMITS, ...codec.SERVER_LIMITS }).toHaveProperty(table.tag[1]);
    }
  });
});

test("errors name the field", () => {
  const bad = codec.encodeStruct("Presence", [1, 2, [["ann", "head", [[0, 0, 0], [1, 0, 0, 0]]]]]);
  bad[bad.length - 1] = 0xc0;
  expect(() => codec.decodePresence(bad)).toThrow(/items.0.capture_ns/);
  expect(() => codec.decodePresence(bad)).toThrow(MalformedError);
});

test("sizes are checked before anything is read", () => {
  expect(() => codec.decodeServer(new Uint8Array(32_000_001))).toThrow(TooLargeError);
  expect(() => codec.decodePresence(new Uint8Array(256_001))).toThrow(TooLargeError);
  expect(() => codec.decodeServer(fromHex("9302008100"))).toThrow(VersionError);
});

test("a key named __proto__ is a key like others", () => {
  const entries = Object.fromEntries([["__proto__", 1]]);
  const bytes = codec.encodeStruct("ServerEnvelope", [1, 7, { type: "feedback", robot: "left", state: "hold", rejected: entries }]);
  const message = codec.decodeServer(bytes)[2] as { rejected: Record<string, number> };
  expect(Object.keys(message.rejected)).toEqual(["__proto__"]);
  expect(Object.getPrototypeOf(message.rejected)).toBe(Object.prototype);
});
