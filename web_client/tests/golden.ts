// Golden vectors of docs/protocol, with integers beyond 2^53 as bigints.

import { readFileSync } from "node:fs";

/** Bytes as hex, and the value that they have. */
export interface Vector {
  name: string;
  hex: string;
  value: unknown;
}

/** Return the content of a file of docs/protocol. */
export function readGolden<T>(name: string): T {
  const text = readFileSync(new URL(`../../docs/protocol/${name}.json`, import.meta.url), "utf-8");
  type Reviver = (key: string, value: unknown, context: { source?: string }) => unknown;
  const revive: Reviver = (_key, value, context) =>
    typeof value === "number" && /^-?\d+$/.test(context.source ?? "") && !Number.isSafeInteger(value)
      ? BigInt(context.source as string)
      : value;
  return JSON.parse(text, revive as (key: string, value: unknown) => unknown) as T;
}

export function fromHex(hex: string): Uint8Array<ArrayBuffer> {
  return new Uint8Array(Buffer.from(hex, "hex"));
}

export function toHex(bytes: Uint8Array): string {
  return Buffer.from(bytes).toString("hex");
}

/** Return a decoded value as golden files write it: bytes in base64, floats that are not finite as null. */
export function toJson(value: unknown): unknown {
  if (value instanceof Uint8Array) return Buffer.from(value).toString("base64");
  if (typeof value === "number" && !Number.isFinite(value)) return null;
  if (Array.isArray(value)) return value.map(toJson);
  if (typeof value === "object" && value !== null) {
    return Object.fromEntries(Object.entries(value).map(([key, item]) => [key, toJson(item)]));
  }
  return value;
}
