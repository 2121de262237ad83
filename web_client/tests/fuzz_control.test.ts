// Hostile bytes for the decoders of the control channel.

import { describe, test } from "vitest";
import { decodeClient, decodeServer } from "../src/core/codec.ts";
import { fuzz } from "./fuzz.ts";
import { fromHex, readGolden, type Vector } from "./golden.ts";

const golden = readGolden<{ client: Vector[]; server: Vector[] }>("golden");
const LONGEST = 600;

function seedsOf(vectors: readonly Vector[]): Uint8Array[] {
  return vectors.map(({ hex }) => fromHex(hex)).filter((bytes) => bytes.length <= LONGEST);
}

describe("hostile bytes", () => {
  test("from the session", () => fuzz(decodeServer, seedsOf(golden.server)));
  test("to the session", () => fuzz(decodeClient, seedsOf(golden.client)));
});
