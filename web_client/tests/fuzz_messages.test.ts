// Hostile bytes for the decoders of messages but those of the control channel.

import { describe, test } from "vitest";
import * as codec from "../src/core/codec.ts";
import { decodeValue, encodeValue } from "../src/core/msgpack.ts";
import { decodeGatewayMessage, packMessage, unpackMessage } from "../src/core/wire.ts";
import { fuzz } from "./fuzz.ts";
import { fromHex, readGolden, type Vector } from "./golden.ts";

const golden = readGolden<Record<string, Vector[]>>("golden");
const LONGEST = 600;

function seedsOf(group: string): Uint8Array[] {
  return (golden[group] ?? []).map(({ hex }) => fromHex(hex)).filter((bytes) => bytes.length <= LONGEST);
}

describe("hostile bytes", () => {
  test("state header", () => fuzz(codec.decodeStateHeader, seedsOf("state_header")));
  test("presence", () => fuzz(codec.decodePresence, seedsOf("presence")));
  test("media header", () => fuzz(codec.decodeMediaHeader, seedsOf("media_header")));
  test("values without a schema", () => fuzz(decodeValue, [...seedsOf("client"), ...seedsOf("presence")]));
  test("web messages", () => fuzz(unpackMessage, seedsOf("state_header").map((frame) => packMessage(2, [frame, frame.subarray(3)]))));
  test("messages of the gateway", () => {
    fuzz(decodeGatewayMessage, [encodeValue({ type: "ticket", ticket: "abcdefgh", expires_s: 600 }), encodeValue({ type: "notice", text: "words" })]);
  });
});
