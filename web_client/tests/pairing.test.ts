// Join codes with the vector of docs/protocol.md, fingerprints, and the web wire.

import { describe, expect, test } from "vitest";
import { MalformedError, PairingError, TooLargeError } from "../src/core/errors.ts";
import { decodeValue, encodeValue, type Value } from "../src/core/msgpack.ts";
import { computeFingerprint, decodeKey, hashSecret, isSameProof, makeProof, normaliseCode, stretchCode } from "../src/core/pairing.ts";
import { decodeGatewayMessage, encodeTicket, encodeWishes, packMessage, unpackMessage } from "../src/core/wire.ts";
import { fromHex, readGolden, toHex } from "./golden.ts";

const S = Uint8Array.from({ length: 32 }, (_, i) => i);
const C = Uint8Array.from({ length: 32 }, (_, i) => 32 + i);

describe("join codes", () => {
  test("vector of protocol.md", async () => {
    const stretched = await stretchCode("7kq2-m4xd 9ptr", S);
    expect(toHex(stretched)).toBe("ff40943fd93ee724848c6e03f14b08ec117af71f2216e08dd9ebc75813f36adf");
    expect(toHex(await makeProof(stretched, "client", S, C))).toBe("549701f2c78692c4dc0ed4c0735c886617780b613392c2b86bc0945f831db2e8");
    expect(toHex(await makeProof(stretched, "server", S, C))).toBe("640bf557398302e535b136f8df7b7acb233d49e8d805e62f279f15eac0b12550");
  });

  test("what resembles a character is read as it", () => {
    expect(normaliseCode("oil0-1uuu-abcd")).toBe("01101VVVABCD");
    for (const text of ["", "7KQ2", "7KQ2-M4XD-9PT!", "7KQ2-M4XD-9PTRX"]) expect(() => normaliseCode(text)).toThrow(PairingError);
  });

  test("keys have 32 bytes", async () => {
    await expect(stretchCode("7KQ2-M4XD-9PTR", S.subarray(1))).rejects.toThrow(PairingError);
    await expect(makeProof(new Uint8Array(32), "client", S, C.subarray(1))).rejects.toThrow(PairingError);
    expect(toHex(decodeKey(Buffer.from(S).toString("base64url")))).toBe(toHex(S));
    for (const text of ["", "AAAA", "!"]) expect(() => decodeKey(text)).toThrow(PairingError);
  });

  test("proofs are compared whole", () => {
    expect(isSameProof(S, S.slice())).toBe(true);
    expect(isSameProof(S, C)).toBe(false);
    expect(isSameProof(S, S.subarray(1))).toBe(false);
    expect(isSameProof(new Uint8Array(), S)).toBe(false);
  });

  test("a secret has an identity", async () => {
    expect(toHex(await hashSecret(new Uint8Array(32)))).toBe("66687aadf862bd776c8fc18b8e9f8e20089714856ee233b3902a591d0d5f2925");
  });
});

// Of Python: `compute_fingerprint(data)`, of bytes that count up.
test.each([
  [0, "kgjnrf5mpxjkamo4heeynbrwpy"],
  [32, "rj42l6s44zme3572gvxblrmqfq"],
  [129, "dtzskvj47wtim4c2mfdodbbpbu"],
])("the fingerprint of %i bytes is that of Python", (length, fingerprint) => {
  expect(computeFingerprint(Uint8Array.from({ length }, (_, i) => i))).toBe(fingerprint);
});

describe("web wire", () => {
  test("frames there and back", () => {
    const frames = [new Uint8Array(), fromHex("00ff"), new Uint8Array(300).fill(7)];
    const bytes = packMessage(2, frames);
    expect(toHex(bytes.subarray(0, 14))).toBe("0203" + "00000000" + "02000000" + "2c010000");
    const { channel, frames: read } = unpackMessage(bytes);
    expect(channel).toBe(2);
    expect(read.map(toHex)).toEqual(frames.map(toHex));
  });

  interface WebGolden {
    messages: { name: string; channel: number; frames: string[]; hex: string }[];
    refused: { name: string; hex: string }[];
    gateway: { name: string; hex: string; value: unknown }[];
  }
  const golden = readGolden<WebGolden>("web");

  test.each(golden.messages)("golden: $name", ({ channel, frames, hex }) => {
    expect(unpackMessage(fromHex(hex))).toEqual({ channel, frames: frames.map(fromHex) });
    expect(toHex(packMessage(channel, frames.map(fromHex)))).toBe(hex);
  });

  test.each(golden.refused)("golden, refused: $name", ({ hex }) => expect(() => unpackMessage(fromHex(hex))).toThrow(MalformedError));

  test.each(golden.gateway)("golden: $name", ({ hex, value }) => {
    expect(decodeValue(fromHex(hex))).toEqual(value);
    expect(toHex(encodeValue(value as Value))).toBe(hex);
    if (Array.isArray(value)) expect(toHex(unpackMessage(encodeWishes(value)).frames[0] as Uint8Array)).toBe(hex);
    else if ((value as { type: string }).type === "notice") expect(decodeGatewayMessage(fromHex(hex))).toEqual(value);
  });

  test.each(["", "01", "0500", "0101", "010101000000", "01010100000000ff", "0101ffffffff00", "01ff00000000"])("refuses %s", (hex) => {
    expect(() => unpackMessage(fromHex(hex))).toThrow(MalformedError);
  });

  test("a client sends what the session takes", () => {
    expect(packMessage(1, [new Uint8Array(48_000)]).length).toBe(48_006);
    expect(() => packMessage(1, [new Uint8Array(48_001)])).toThrow(TooLargeError);
  });

  test("messages of the gateway", () => {
    expect(decodeGatewayMessage(encodeValue({ type: "ticket", ticket: "abc", expires_s: 600, later: null }))).toEqual({ type: "ticket", ticket: "abc", expiresS: 600 });
    expect(decodeGatewayMessage(encodeValue({ type: "notice", text: "hi" }))).toEqual({ type: "notice", text: "hi" });
    expect(decodeGatewayMessage(encodeValue({ type: "later" }))).toEqual({ type: "unknown" });
    for (const value of [null, [], 1, {}, { type: 1 }, { type: "ticket" }, { type: "notice", text: 1 }]) {
      expect(() => decodeGatewayMessage(encodeValue(value))).toThrow(MalformedError);
    }
  });

  test("messages to the gateway", () => {
    expect(decodeValue(unpackMessage(encodeTicket("abc")).frames[0] as Uint8Array)).toEqual({ type: "ticket", ticket: "abc" });
    expect(unpackMessage(encodeWishes(["a", "b"])).channel).toBe(4);
    expect(decodeValue(unpackMessage(encodeWishes(["a", "b"])).frames[0] as Uint8Array)).toEqual(["a", "b"]);
  });
});
