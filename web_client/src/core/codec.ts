// Messages to bytes and back, by the generated tables of `schema.g.ts`: the trust boundary of the browser.
//
// For any bytes every `decode...` returns a value or throws a `WireError`, nothing else. It accepts on purpose: unknown
// fields, unknown values of open enumerations, and floats that are not finite. Decoded values have every field.
//
// 64-bit integers are numbers. Where a value passes 2^53 it is rounded (`protocol.md` names the fields that may); tests
// decode them exactly, as bigints.

import type * as wire from "../protocol/messages.g.ts";
import { PROTOCOL_VERSION } from "../protocol/messages.g.ts";
import {
  CLIENT_LIMITS,
  type FieldType,
  MAX_CLIENT_BYTES,
  MAX_MEDIA_HEADER_BYTES,
  MAX_PRESENCE_BYTES,
  MAX_SERVER_BYTES,
  MAX_STATE_HEADER_BYTES,
  SERVER_LIMITS,
  STRUCTS,
  type StructTable,
  UNIONS,
} from "../protocol/schema.g.ts";
import type { Filled } from "./api.ts";
import { InvalidMessageError, MalformedError, TooLargeError, VersionError, WireError } from "./errors.ts";
import { Reader, Writer } from "./msgpack.ts";

export { CLIENT_LIMITS, SERVER_LIMITS };
export type ClientEnvelope = Filled<wire.ClientEnvelope>;
export type ServerEnvelope = Filled<wire.ServerEnvelope>;
export type ServerMessage = Filled<wire.ServerMessage>;
export type StateHeader = Filled<wire.StateHeader>;
export type Presence = Filled<wire.Presence>;
export type MediaHeader = Filled<wire.MediaHeader>;

type Decode = (reader: Reader) => unknown;
type Encode = (writer: Writer, value: unknown) => void;

/** Decoders of one treatment of integers, compiled from the tables on first use. */
class Decoders {
  private readonly structs = new Map<string, Decode>();

  constructor(private readonly exact: boolean) {}

  /** Return the decoder of a struct. */
  struct(name: string): Decode {
    let decode = this.structs.get(name);
    if (decode === undefined) {
      const table = findStruct(name);
      let compiled: Decode | undefined;
      // Structs may contain each other: compiled when first used.
      decode = (reader) => (compiled ??= table.array ? this.compileTuple(table) : this.compileMap(table))(reader);
      this.structs.set(name, decode);
    }
    return decode;
  }

  private compile(type: FieldType): Decode {
    switch (type[0]) {
      case "bool":
        return (reader) => reader.readBool();
      case "float":
        return (reader) => reader.readFloat();
      case "int":
        return compileInt(type[1], type[2], this.exact);
      case "str":
        return compileString(type[1], type[2]);
      case "bytes":
        return compileBytes(type[1]);
      case "array":
        return this.compileArray(type[1], type[2], type[3], type[4] ?? 0);
      case "map":
        return this.compileDictionary(type[1]);
      case "struct":
        return this.struct(type[1]);
      case "union":
        return this.compileUnion(type[1]);
      case "null": {
        const inner = this.compile(type[1]);
        return (reader) => (reader.readNull() ? null : inner(reader));
      }
    }
  }

  private compileArray(item: FieldType, length: number, longest: number, shortest: number): Decode {
    const decode = this.compile(item);
    return (reader) => {
      const count = reader.readArrayHead();
      if (length > 0 && count !== length) throw new MalformedError(`${count} items, expected ${length}`);
      if (longest > 0 && count > longest) throw new MalformedError(`${count} items, at most ${longest} are read`);
      if (count < shortest) throw new MalformedError(`${count} items, expected ${shortest} at least`);
      const items: unknown[] = [];
      for (let i = 0; i < count; i++) {
        try {
          items.push(decode(reader));
        } catch (error) {
          throw within(error, i);
        }
      }
      return items;
    };
  }

  private compileDictionary(item: FieldType): Decode {
    const decode = this.compile(item);
    return (reader) => {
      const entries: [string, unknown][] = [];
      for (let left = reader.readMapHead(); left > 0; left--) entries.push([reader.readString(), decode(reader)]);
      return Object.fromEntries(entries); // also a key `__proto__` is a key like others
    };
  }

  private compileUnion(name: string): Decode {
    const { tagField, structs } = findUnion(name);
    const members = new Map(structs.map(([tag, struct]) => [tag, this.struct(struct)]));
    return (reader) => {
      const tag = peekTag(reader, tagField);
      const decode = members.get(tag);
      if (decode === undefined) {
        throw new MalformedError(`unknown ${tagField} ${JSON.stringify(tag.slice(0, 64))}, expected one of ${[...members.keys()].join(", ")}`);
      }
      return decode(reader);
    };
  }

  private compileTuple(table: StructTable): Decode {
    const fields = table.fields.map(([name, type, fallback]) => ({ name, decode: this.compile(type), fallback }));
    const least = fields.filter((field) => field.fallback.length === 0).length;
    return (reader) => {
      const count = reader.readArrayHead();
      if (count < least) throw new MalformedError(`an array of ${count} items, expected ${least}`);
      const items: unknown[] = [];
      for (const [i, field] of fields.entries()) {
        try {
          items.push(i < count ? field.decode(reader) : copyDefault(field.fallback[0]));
        } catch (error) {
          throw within(error, field.name);
        }
      }
      for (let i = fields.length; i < count; i++) reader.skip();
      return items;
    };
  }

  private compileMap(table: StructTable): Decode {
    const fields = table.fields.map(([name, type, fallback]) => ({ name, decode: this.compile(type), fallback }));
    const index = new Map(fields.map((field, i) => [field.name, i]));
    const tag = table.tag;
    return (reader) => {
      const values = new Array<unknown>(fields.length).fill(undefined);
      let tagged = tag === null;
      for (let left = reader.readMapHead(); left > 0; left--) {
        const key = reader.readString();
        if (tag !== null && key === tag[0]) {
          if (reader.readString() !== tag[1]) throw new MalformedError(`expected the ${tag[0]} ${tag[1]}`);
          tagged = true;
          continue;
        }
        const i = index.get(key);
        const field = i === undefined ? undefined : fields[i];
        if (i === undefined || field === undefined) {
          reader.skip();
          continue;
        }
        try {
          values[i] = field.decode(reader);
        } catch (error) {
          throw within(error, key);
        }
      }
      if (!tagged) throw new MalformedError(`the field ${tag?.[0]} is missing`);
      const result: Record<string, unknown> = tag === null ? {} : { [tag[0]]: tag[1] };
      for (const [i, field] of fields.entries()) {
        let value = values[i];
        if (value === undefined) {
          if (field.fallback.length === 0) throw new MalformedError(`the field ${field.name} is missing`);
          value = copyDefault(field.fallback[0]);
        }
        result[field.name] = value;
      }
      return result;
    };
  }
}

function compileInt(lowest: number | null, highest: number | null, exact: boolean): Decode {
  const low = lowest ?? -(2n ** 63n);
  const high = highest ?? 2n ** 63n - 1n;
  return (reader) => {
    const value = reader.readInt();
    if (value < low || value > high) throw new MalformedError(`${value} is not from ${low} to ${high}`);
    return exact ? value : Number(value);
  };
}

function compileString(longest: number, pattern: string): Decode {
  const form = pattern === "" ? null : new RegExp(pattern, "u");
  return (reader) => {
    const text = reader.readString();
    checkText(text, longest, form);
    return text;
  };
}

function compileBytes(longest: number): Decode {
  return (reader) => {
    const bytes = reader.readBytes();
    if (longest > 0 && bytes.length > longest) throw new MalformedError(`${bytes.length} bytes, at most ${longest} are read`);
    return bytes.slice();
  };
}

function checkText(text: string, longest: number, form: RegExp | null): void {
  if (longest > 0 && text.length > longest) {
    let characters = 0;
    for (const _ of text) characters += 1;
    if (characters > longest) throw new MalformedError(`${characters} characters, at most ${longest} are read`);
  }
  if (form !== null && !form.test(text)) throw new MalformedError(`the text has not the form ${form.source}`);
}

/** Return the tag of the map that is next, without reading it. */
function peekTag(reader: Reader, field: string): string {
  const start = reader.position;
  let tag: string | undefined;
  for (let left = reader.readMapHead(); left > 0 && tag === undefined; left--) {
    if (reader.readString() === field) tag = reader.readString();
    else reader.skip();
  }
  reader.position = start;
  if (tag === undefined) throw new MalformedError(`the field ${field} is missing`);
  return tag;
}

/** Return a default that the application may change. */
function copyDefault(value: unknown): unknown {
  return typeof value === "object" && value !== null ? structuredClone(value) : value;
}

function within(error: unknown, field: string | number): unknown {
  return error instanceof MalformedError ? error.within(field) : error;
}

function findStruct(name: string): StructTable {
  const table = STRUCTS[name];
  if (table === undefined) throw new Error(`no struct ${name} in the tables`);
  return table;
}

/** Return the tag field of a union, and the tag and name of each of its structs. */
function findUnion(name: string): { tagField: string; structs: [tag: string, struct: string][] } {
  const members = UNIONS[name];
  if (members === undefined) throw new Error(`no union ${name} in the tables`);
  const tags = members.map((member) => findStruct(member).tag as readonly [string, string]);
  return { tagField: tags[0]?.[0] ?? "", structs: members.map((member, i) => [tags[i]?.[1] ?? "", member]) };
}

const rounded = new Decoders(false);
const exactly = new Decoders(true);

// --- encoding ---------------------------------------------------------------------------------------------------------

const encoders = new Map<string, Encode>();

function structEncoder(name: string): Encode {
  let encode = encoders.get(name);
  if (encode === undefined) {
    const table = findStruct(name);
    let compiled: Encode | undefined;
    encode = (writer, value) => (compiled ??= compileStructEncoder(table))(writer, value);
    encoders.set(name, encode);
  }
  return encode;
}

function compileStructEncoder(table: StructTable): Encode {
  const fields = table.fields.map(([name, type, fallback]) => ({ name, encode: compileEncoder(type), fallback }));
  const tag = table.tag;
  return (writer, value) => {
    if (typeof value !== "object" || value === null) throw new MalformedError("expected an object or array");
    if (table.array) {
      if (!Array.isArray(value) || value.length > fields.length) throw new MalformedError(`expected an array of ${fields.length} items`);
      writer.writeArrayHead(fields.length);
    } else {
      writer.writeMapHead(fields.length + (tag === null ? 0 : 1));
      if (tag !== null) {
        writer.writeString(tag[0]);
        writer.writeString(tag[1]);
      }
    }
    for (const [i, field] of fields.entries()) {
      let item = table.array ? (value as unknown[])[i] : (value as Record<string, unknown>)[field.name];
      if (item === undefined && field.fallback.length > 0) item = field.fallback[0];
      if (!table.array) writer.writeString(field.name);
      try {
        field.encode(writer, item);
      } catch (error) {
        throw within(error, field.name);
      }
    }
  };
}

function compileEncoder(type: FieldType): Encode {
  switch (type[0]) {
    case "bool":
      return (writer, value) => writer.writeBool(expectType(value, "boolean"));
    case "float":
      return (writer, value) => writer.writeFloat(expectType(value, "number"));
    case "int":
      return encodeInt(type[1], type[2]);
    case "str":
      return encodeString(type[1], type[2]);
    case "bytes":
      return encodeBytes(type[1]);
    case "array":
      return encodeArray(type[1], type[2], type[3], type[4] ?? 0);
    case "map":
      return encodeDictionary(type[1]);
    case "struct":
      return structEncoder(type[1]);
    case "union":
      return encodeUnion(type[1]);
    case "null": {
      const inner = compileEncoder(type[1]);
      return (writer, value) => (value === null ? writer.writeNull() : inner(writer, value));
    }
  }
}

function encodeInt(lowest: number | null, highest: number | null): Encode {
  return (writer, value) => {
    if (typeof value !== "number" && typeof value !== "bigint") throw new MalformedError(`expected an integer, got ${describe(value)}`);
    if ((lowest !== null && value < lowest) || (highest !== null && value > highest)) {
      throw new MalformedError(`${value} is not from ${lowest ?? "-2^63"} to ${highest ?? "2^63 - 1"}`);
    }
    writer.writeInt(value);
  };
}

function encodeString(longest: number, pattern: string): Encode {
  const form = pattern === "" ? null : new RegExp(pattern, "u");
  return (writer, value) => {
    const text = expectType<string>(value, "string");
    checkText(text, longest, form);
    writer.writeString(text);
  };
}

function encodeBytes(longest: number): Encode {
  return (writer, value) => {
    if (!(value instanceof Uint8Array)) throw new MalformedError(`expected bytes, got ${describe(value)}`);
    if (longest > 0 && value.length > longest) throw new MalformedError(`${value.length} bytes, at most ${longest} are read`);
    writer.writeBytes(value);
  };
}

function encodeArray(item: FieldType, length: number, longest: number, shortest: number): Encode {
  const encode = compileEncoder(item);
  return (writer, value) => {
    if (!Array.isArray(value)) throw new MalformedError(`expected an array, got ${describe(value)}`);
    if (length > 0 && value.length !== length) throw new MalformedError(`${value.length} items, expected ${length}`);
    if (longest > 0 && value.length > longest) throw new MalformedError(`${value.length} items, at most ${longest} are read`);
    if (value.length < shortest) throw new MalformedError(`${value.length} items, expected ${shortest} at least`);
    writer.writeArrayHead(value.length);
    for (const [i, one] of value.entries()) {
      try {
        encode(writer, one);
      } catch (error) {
        throw within(error, i);
      }
    }
  };
}

function encodeDictionary(item: FieldType): Encode {
  const encode = compileEncoder(item);
  return (writer, value) => {
    if (typeof value !== "object" || value === null) throw new MalformedError(`expected an object, got ${describe(value)}`);
    const entries = Object.entries(value);
    writer.writeMapHead(entries.length);
    for (const [key, one] of entries) {
      writer.writeString(key);
      encode(writer, one);
    }
  };
}

function encodeUnion(name: string): Encode {
  const { tagField, structs } = findUnion(name);
  const members = new Map<unknown, Encode>(structs.map(([tag, struct]) => [tag, structEncoder(struct)]));
  return (writer, value) => {
    const tag = typeof value === "object" && value !== null ? (value as Record<string, unknown>)[tagField] : undefined;
    const encode = members.get(tag);
    if (encode === undefined) throw new MalformedError(`unknown ${tagField} ${describe(tag)}, expected one of ${[...members.keys()].join(", ")}`);
    encode(writer, value);
  };
}

function expectType<T extends boolean | number | string>(value: unknown, type: string): T {
  if (typeof value !== type) throw new MalformedError(`expected a ${type}, got ${describe(value)}`);
  return value as T;
}

function describe(value: unknown): string {
  return value === undefined ? "nothing" : typeof value === "string" ? JSON.stringify(value.slice(0, 40)) : typeof value;
}

// --- whole messages ---------------------------------------------------------------------------------------------------

/** Decode the bytes of any struct. `exact`: integers beyond 2^53 are bigints. */
export function decodeStruct(name: string, bytes: Uint8Array, exact = false): unknown {
  const reader = new Reader(bytes);
  const value = (exact ? exactly : rounded).struct(name)(reader);
  reader.expectEnd();
  return value;
}

/** Write the value of any struct. Throws `MalformedError` for one that does not fit. */
export function writeStruct(writer: Writer, name: string, value: unknown): void {
  structEncoder(name)(writer, value);
}

/** Encode the value of any struct. Throws `MalformedError` for one that does not fit. */
export function encodeStruct(name: string, value: unknown): Uint8Array<ArrayBuffer> {
  const writer = new Writer();
  writeStruct(writer, name, value);
  return writer.finish();
}

function checkSize(what: string, size: number, limit: number): void {
  if (size > limit) throw new TooLargeError(what, size, limit);
}

/** Throw unless the bytes begin like an envelope of this version. */
function checkVersion(bytes: Uint8Array): void {
  const reader = new Reader(bytes);
  if (reader.readArrayHead() < 1) throw new MalformedError("an envelope without a version");
  const version = Number(reader.readInt());
  if (version !== PROTOCOL_VERSION) throw new VersionError(version);
}

function decodeEnvelope(name: string, bytes: Uint8Array, most: number, limits: Readonly<Record<string, number>>, exact: boolean): unknown[] {
  checkSize("message", bytes.length, most);
  checkVersion(bytes);
  const envelope = decodeStruct(name, bytes, exact) as unknown[];
  const tag = (envelope.at(-1) as { type: string }).type;
  checkSize(tag, bytes.length, limits[tag] ?? most);
  return envelope;
}

/** Decode a message to a client. */
export function decodeServer(bytes: Uint8Array, exact = false): ServerEnvelope {
  return decodeEnvelope("ServerEnvelope", bytes, MAX_SERVER_BYTES, SERVER_LIMITS, exact) as ServerEnvelope;
}

/** Decode a message to the session. */
export function decodeClient(bytes: Uint8Array, exact = false): ClientEnvelope {
  return decodeEnvelope("ClientEnvelope", bytes, MAX_CLIENT_BYTES, CLIENT_LIMITS, exact) as ClientEnvelope;
}

/** Encode a message in its envelope. Throws `InvalidMessageError`, which names the field, for one that the session would refuse. */
export function encodeClient(message: wire.ClientMessage, connectionEpoch = 0): Uint8Array<ArrayBuffer> {
  try {
    const bytes = encodeStruct("ClientEnvelope", [PROTOCOL_VERSION, connectionEpoch, "", message]);
    checkSize(message.type, bytes.length, CLIENT_LIMITS[message.type] ?? MAX_CLIENT_BYTES);
    return bytes;
  } catch (error) {
    if (!(error instanceof WireError)) throw error;
    throw new InvalidMessageError(`${String(message?.type).slice(0, 64)} cannot be sent: ${error.message.replace(/^message[.:] ?/, "")}`);
  }
}

function decodeSized<T>(name: string, what: string, bytes: Uint8Array, limit: number, exact: boolean): T {
  checkSize(what, bytes.length, limit);
  return decodeStruct(name, bytes, exact) as T;
}

export function decodeStateHeader(bytes: Uint8Array, exact = false): StateHeader {
  return decodeSized("StateHeader", "state header", bytes, MAX_STATE_HEADER_BYTES, exact);
}

export function decodePresence(bytes: Uint8Array, exact = false): Presence {
  return decodeSized("Presence", "presence", bytes, MAX_PRESENCE_BYTES, exact);
}

export function decodeMediaHeader(bytes: Uint8Array, exact = false): MediaHeader {
  return decodeSized("MediaHeader", "media header", bytes, MAX_MEDIA_HEADER_BYTES, exact);
}
