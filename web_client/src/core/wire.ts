// Binary messages of the two WebSockets: channel u8, count u8, `count` lengths u32 little-endian, then the frames, which
// are those of ZeroMQ. docs/protocol.md, section "Web channel", is normative.

import { MalformedError, TooLargeError } from "./errors.ts";
import { type Value, decodeValue, encodeValue } from "./msgpack.ts";
import { MAX_CLIENT_BYTES } from "../protocol/schema.g.ts";

/** Channels of a message. */
export const Channel = { CONTROL: 1, STATE: 2, MEDIA: 3, WISHES: 4, GATEWAY: 5 } as const;

/** Subprotocol of both WebSockets. */
export const SUBPROTOCOL = "iris-session.1";
/** Most bytes of a message from a client: one frame of what the session takes. */
export const MAX_CLIENT_MESSAGE_BYTES = 2 + 4 + MAX_CLIENT_BYTES;

/** Reasons for which the gateway closes a WebSocket. */
export const CloseCode = {
  SESSION_ENDED: 4000,
  VERSION: 4001,
  NOT_ALLOWED: 4003,
  TOO_SLOW: 4008,
  FLOOD: 4009,
  RESTART: 1012,
} as const;

/** A message taken apart. `frames` are views of it. */
export interface WebMessage {
  channel: number;
  frames: Uint8Array[];
}

/** Take a message apart. Throws `MalformedError` unless the lengths fit its bytes exactly. */
export function unpackMessage(bytes: Uint8Array): WebMessage {
  if (bytes.length < 2) throw new MalformedError(`a message of ${bytes.length} bytes`);
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  const count = view.getUint8(1);
  let at = 2 + 4 * count;
  if (count === 0 || at > bytes.length) throw new MalformedError(`a message of ${bytes.length} bytes with ${count} frames`);
  const frames: Uint8Array[] = [];
  for (let i = 0; i < count; i++) {
    const length = view.getUint32(2 + 4 * i, true);
    if (length > bytes.length - at) throw new MalformedError(`a frame of ${length} bytes in a message of ${bytes.length}`);
    frames.push(bytes.subarray(at, at + length));
    at += length;
  }
  if (at !== bytes.length) throw new MalformedError(`${bytes.length - at} bytes after the last frame`);
  return { channel: view.getUint8(0), frames };
}

/** Put a message of a client together. Throws `TooLargeError`. */
export function packMessage(channel: number, frames: readonly Uint8Array[]): Uint8Array<ArrayBuffer> {
  const head = 2 + 4 * frames.length;
  const size = frames.reduce((sum, frame) => sum + frame.length, head);
  if (size > MAX_CLIENT_MESSAGE_BYTES) throw new TooLargeError("a message", size, MAX_CLIENT_MESSAGE_BYTES);
  const bytes = new Uint8Array(size);
  const view = new DataView(bytes.buffer);
  view.setUint8(0, channel);
  view.setUint8(1, frames.length);
  let at = head;
  for (const [i, frame] of frames.entries()) {
    view.setUint32(2 + 4 * i, frame.length, true);
    bytes.set(frame, at);
    at += frame.length;
  }
  return bytes;
}

/** A message of the gateway itself. */
export type GatewayMessage =
  | { type: "ticket"; ticket: string; expiresS: number }
  | { type: "notice"; text: string }
  /** Of a newer gateway. */
  | { type: "unknown" };

/** Decode the frame of a message on the gateway's channel. Throws `MalformedError`. */
export function decodeGatewayMessage(frame: Uint8Array): GatewayMessage {
  const value = decodeValue(frame);
  if (typeof value !== "object" || value === null || Array.isArray(value) || value instanceof Uint8Array) {
    throw new MalformedError("a message of the gateway that is no map");
  }
  const { type, ticket, text } = value;
  const expiresS = value["expires_s"];
  if (type === "ticket" && typeof ticket === "string" && typeof expiresS === "number") return { type, ticket, expiresS };
  if (type === "notice" && typeof text === "string") return { type, text };
  if (type === "ticket" || type === "notice" || typeof type !== "string") throw new MalformedError(`a message of the gateway with fields missing`);
  return { type: "unknown" };
}

/** Encode the first message of /v1/media. */
export function encodeTicket(ticket: string): Uint8Array<ArrayBuffer> {
  return packMessage(Channel.GATEWAY, [encodeValue({ type: "ticket", ticket })]);
}

/** Encode the list of media streams that are wanted. */
export function encodeWishes(streams: readonly string[]): Uint8Array<ArrayBuffer> {
  return packMessage(Channel.WISHES, [encodeValue([...streams] as Value[])]);
}
