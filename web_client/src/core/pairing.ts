// Join codes: proofs by which this client and a session show each other that they know the same code, without sending it;
// and the identity of a browser. docs/protocol.md, sections "Pairing" and "Web channel", are normative. WebCrypto needs a
// secure context: HTTPS, or a loopback address.
//
// S is the SHA-256 of the public key of the gateway's certificate, C the SHA-256 of this client's secret.

import { blake2b } from "@noble/hashes/blake2.js";

import { PairingError } from "./errors.ts";

const ALPHABET = "0123456789ABCDEFGHJKMNPQRSTVWXYZ";
const CODE_CHARACTERS = 12;
const KEY_BYTES = 32;
const ITERATIONS = 200_000;
/** Bytes of the secret that a browser makes once. */
export const SECRET_BYTES = 32;
const BASE32 = "abcdefghijklmnopqrstuvwxyz234567";

const encoder = new TextEncoder();
/** Sets fingerprints apart from other digests: 16 bytes. */
const FINGERPRINT = encoder.encode("iris-key".padEnd(16, "\0"));

/** Return a typed code in the one form that is stretched. Throws `PairingError` for any other text. */
export function normaliseCode(text: string): string {
  const code = text
    .toUpperCase()
    .replace(/[- ]/g, "")
    .replace(/[OILU]/g, (character) => ({ O: "0", I: "1", L: "1", U: "V" })[character] as string);
  if (code.length !== CODE_CHARACTERS || ![...code].every((character) => ALPHABET.includes(character))) {
    throw new PairingError(`${JSON.stringify(text.slice(0, 40))} is not a join code: twelve letters and digits, like 7KQ2-M4XD-9PTR`, "code");
  }
  return code;
}

/** Derive the secret that both sides share from `code` (any spelling): takes about 0.1 s, on purpose. */
export async function stretchCode(code: string, server: Uint8Array): Promise<Uint8Array<ArrayBuffer>> {
  checkKey(server);
  const password = await crypto.subtle.importKey("raw", encoder.encode(normaliseCode(code)), "PBKDF2", false, ["deriveBits"]);
  const salt = concat(encoder.encode("iris-pair-1"), server);
  return new Uint8Array(await crypto.subtle.deriveBits({ name: "PBKDF2", hash: "SHA-256", salt, iterations: ITERATIONS }, password, 256));
}

/** Return the proof that the client sends in `pair` (`side` client), or that the session answers (`side` server). */
export async function makeProof(
  stretched: Uint8Array<ArrayBuffer>,
  side: "client" | "server",
  server: Uint8Array,
  client: Uint8Array,
): Promise<Uint8Array<ArrayBuffer>> {
  checkKey(server);
  checkKey(client);
  const key = await crypto.subtle.importKey("raw", stretched, { name: "HMAC", hash: "SHA-256" }, false, ["sign"]);
  return new Uint8Array(await crypto.subtle.sign("HMAC", key, concat(encoder.encode(side), server, client)));
}

/** Compare two proofs in constant time. */
export function isSameProof(a: Uint8Array, b: Uint8Array): boolean {
  let difference = a.length ^ b.length;
  for (const [i, byte] of a.entries()) difference |= byte ^ (b[i] ?? 0);
  return difference === 0;
}

/** Return C of a secret. */
export async function hashSecret(secret: Uint8Array<ArrayBuffer>): Promise<Uint8Array<ArrayBuffer>> {
  return new Uint8Array(await crypto.subtle.digest("SHA-256", secret));
}

/** Return the public identifier of a key, or of C: 128-bit BLAKE2b in base32. */
export function computeFingerprint(key: Uint8Array): string {
  let text = "";
  let bits = 0;
  let held = 0;
  for (const byte of blake2b(key, { dkLen: 16, personalization: FINGERPRINT })) {
    held = (held << 8) | byte;
    for (bits += 8; bits >= 5; bits -= 5) text += BASE32[(held >> (bits - 5)) & 31];
    held &= 31;
  }
  return bits > 0 ? text + BASE32[(held << (5 - bits)) & 31] : text;
}

/** Return the bytes of base64url without padding. Throws `PairingError` unless they are 32. */
export function decodeKey(text: string): Uint8Array<ArrayBuffer> {
  let bytes: Uint8Array<ArrayBuffer>;
  try {
    const binary = atob(text.replaceAll("-", "+").replaceAll("_", "/"));
    bytes = Uint8Array.from(binary, (character) => character.charCodeAt(0));
  } catch {
    bytes = new Uint8Array();
  }
  if (bytes.length !== KEY_BYTES) throw new PairingError("the session states no hash of its certificate: it is of another version");
  return bytes;
}

function checkKey(key: Uint8Array): void {
  if (key.length !== KEY_BYTES) throw new PairingError(`a key has ${KEY_BYTES} bytes, got ${key.length}`);
}

function concat(...parts: readonly Uint8Array[]): Uint8Array<ArrayBuffer> {
  const bytes = new Uint8Array(parts.reduce((sum, part) => sum + part.length, 0));
  let at = 0;
  for (const part of parts) {
    bytes.set(part, at);
    at += part.length;
  }
  return bytes;
}
