// MessagePack, strict and bounded: reading and writing of single values, and of values without a schema.
//
// The reader allocates nothing by a length that the bytes cannot hold, and does not recurse. Integers that a number does
// not hold exactly are bigints. `codec.ts` puts the schema on top.

import { MalformedError } from "./errors.ts";

/** Levels of nesting in a value that is skipped or read without a schema. */
const MAX_DEPTH = 256;
const SHORT_TEXT = 32;

const textDecoder = new TextDecoder("utf-8", { fatal: true, ignoreBOM: true });
const textEncoder = new TextEncoder();

/** A value without a schema. */
export type Value = null | boolean | number | bigint | string | Uint8Array | Value[] | { [key: string]: Value };

/** Reads values from bytes. Throws `MalformedError` for all but what is asked for. */
export class Reader {
  /** Index of the next byte. */
  position = 0;
  private readonly view: DataView;

  constructor(readonly bytes: Uint8Array) {
    this.view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  }

  /** Throw unless everything was read. */
  expectEnd(): void {
    const left = this.bytes.length - this.position;
    if (left > 0) throw new MalformedError(`${left} bytes after the message`);
  }

  /** Return the next byte without reading it. */
  peek(): number {
    const byte = this.bytes[this.position];
    if (byte === undefined) throw truncated();
    return byte;
  }

  /** Read null if it is next. Returns whether it was. */
  readNull(): boolean {
    if (this.peek() !== 0xc0) return false;
    this.position += 1;
    return true;
  }

  readBool(): boolean {
    const byte = this.peek();
    if (byte !== 0xc2 && byte !== 0xc3) throw expected("bool", byte);
    this.position += 1;
    return byte === 0xc3;
  }

  /** Read an integer of any width: a number if it is exact, else a bigint. */
  readInt(): number | bigint {
    const byte = this.peek();
    if (!isInt(byte)) throw expected("int", byte);
    return this.readNumber();
  }

  /** Read a float, or an integer as a float. */
  readFloat(): number {
    const byte = this.peek();
    if (byte === 0xcb) {
      const at = this.take(9);
      return this.view.getFloat64(at + 1);
    }
    if (byte === 0xca) {
      const at = this.take(5);
      return this.view.getFloat32(at + 1);
    }
    if (!isInt(byte)) throw expected("float", byte);
    return Number(this.readNumber());
  }

  readString(): string {
    const byte = this.peek();
    let length: number;
    if ((byte & 0xe0) === 0xa0) {
      this.position += 1;
      length = byte & 0x1f;
    } else if (byte >= 0xd9 && byte <= 0xdb) {
      length = this.readLength(1 << (byte - 0xd9));
    } else {
      throw expected("string", byte);
    }
    const at = this.take(length);
    return this.decodeText(at, length);
  }

  /** Read bytes: a view of the message. */
  readBytes(): Uint8Array {
    const byte = this.peek();
    if (byte < 0xc4 || byte > 0xc6) throw expected("bytes", byte);
    const length = this.readLength(1 << (byte - 0xc4));
    const at = this.take(length);
    return this.bytes.subarray(at, at + length);
  }

  /** Read the head of an array. Its length is no more than the bytes that are left. */
  readArrayHead(): number {
    const byte = this.peek();
    if ((byte & 0xf0) === 0x90) {
      this.position += 1;
      return this.checkCount(byte & 0x0f);
    }
    if (byte !== 0xdc && byte !== 0xdd) throw expected("array", byte);
    return this.checkCount(this.readLength(byte === 0xdc ? 2 : 4));
  }

  /** Read the head of a map: the number of its pairs. */
  readMapHead(): number {
    const byte = this.peek();
    if ((byte & 0xf0) === 0x80) {
      this.position += 1;
      return this.checkCount(byte & 0x0f, 2);
    }
    if (byte !== 0xde && byte !== 0xdf) throw expected("map", byte);
    return this.checkCount(this.readLength(byte === 0xde ? 2 : 4), 2);
  }

  /** Pass over one value of any type. */
  skip(): void {
    const open: number[] = [];
    let left = 1;
    for (;;) {
      while (left === 0) {
        const outer = open.pop();
        if (outer === undefined) return;
        left = outer;
      }
      left -= 1;
      const inner = this.skipHead();
      if (inner > 0) {
        if (open.length >= MAX_DEPTH) throw new MalformedError(`more than ${MAX_DEPTH} levels of nesting`);
        open.push(left);
        left = inner;
      }
    }
  }

  /** Read one value of any type but extensions. Keys of maps must be strings. */
  readValue(depth = 0): Value {
    if (depth > MAX_DEPTH) throw new MalformedError(`more than ${MAX_DEPTH} levels of nesting`);
    const byte = this.peek();
    if (isInt(byte)) return this.readNumber();
    if (isString(byte)) return this.readString();
    if (isArray(byte)) {
      const items: Value[] = [];
      for (let left = this.readArrayHead(); left > 0; left--) items.push(this.readValue(depth + 1));
      return items;
    }
    if (isMap(byte)) {
      const entries: [string, Value][] = [];
      for (let left = this.readMapHead(); left > 0; left--) entries.push([this.readString(), this.readValue(depth + 1)]);
      return Object.fromEntries(entries);
    }
    if (byte === 0xca || byte === 0xcb) return this.readFloat();
    if (byte === 0xc2 || byte === 0xc3) return this.readBool();
    if (byte >= 0xc4 && byte <= 0xc6) return this.readBytes();
    if (this.readNull()) return null;
    throw expected("value", byte);
  }

  /** Pass over the head of a value, and its bytes. Returns the number of values inside. */
  private skipHead(): number {
    const byte = this.peek();
    if (isArray(byte)) return this.readArrayHead();
    if (isMap(byte)) return 2 * this.readMapHead();
    if (isString(byte)) this.readString();
    else if (byte >= 0xc4 && byte <= 0xc6) this.readBytes();
    else if (isInt(byte) || byte === 0xca || byte === 0xcb) this.take(1 + widthOf(byte));
    else if (byte === 0xc0 || byte === 0xc2 || byte === 0xc3) this.position += 1;
    else if (byte >= 0xd4 && byte <= 0xd8) this.take(2 + (1 << (byte - 0xd4)));
    else if (byte >= 0xc7 && byte <= 0xc9) this.take(1 + this.readLength(1 << (byte - 0xc7)));
    else throw expected("value", byte);
    return 0;
  }

  private readNumber(): number | bigint {
    const byte = this.peek();
    const at = this.take(1 + widthOf(byte)) + 1;
    if (byte < 0x80) return byte;
    if (byte >= 0xe0) return byte - 0x100;
    switch (byte) {
      case 0xcc:
        return this.view.getUint8(at);
      case 0xcd:
        return this.view.getUint16(at);
      case 0xce:
        return this.view.getUint32(at);
      case 0xd0:
        return this.view.getInt8(at);
      case 0xd1:
        return this.view.getInt16(at);
      case 0xd2:
        return this.view.getInt32(at);
    }
    const high = byte === 0xcf ? this.view.getUint32(at) : this.view.getInt32(at);
    const value = high * 2 ** 32 + this.view.getUint32(at + 4);
    if (Number.isSafeInteger(value)) return value;
    return byte === 0xcf ? this.view.getBigUint64(at) : this.view.getBigInt64(at);
  }

  private decodeText(at: number, length: number): string {
    if (length <= SHORT_TEXT) {
      let text = "";
      let i = at;
      for (const end = at + length; i < end; i++) {
        const byte = this.bytes[i] as number;
        if (byte >= 0x80) break;
        text += String.fromCharCode(byte);
      }
      if (i === at + length) return text;
    }
    try {
      return textDecoder.decode(this.bytes.subarray(at, at + length));
    } catch {
      throw new MalformedError("text that is not UTF-8");
    }
  }

  private readLength(width: number): number {
    const at = this.take(1 + width) + 1;
    return width === 1 ? this.view.getUint8(at) : width === 2 ? this.view.getUint16(at) : this.view.getUint32(at);
  }

  /** Return a count of values that each take `bytes` bytes at least. */
  private checkCount(count: number, bytes = 1): number {
    if (count * bytes > this.bytes.length - this.position) throw truncated();
    return count;
  }

  private take(length: number): number {
    const at = this.position;
    if (length > this.bytes.length - at) throw truncated();
    this.position = at + length;
    return at;
  }
}

/** Writes values in their shortest form. */
export class Writer {
  private bytes = new Uint8Array(256);
  private view = new DataView(this.bytes.buffer);
  private length = 0;

  /** Return what was written, in an array of its own. */
  finish(): Uint8Array<ArrayBuffer> {
    return this.bytes.slice(0, this.length);
  }

  writeNull(): void {
    this.writeByte(0xc0);
  }

  writeBool(value: boolean): void {
    this.writeByte(value ? 0xc3 : 0xc2);
  }

  writeFloat(value: number): void {
    const at = this.grow(9);
    this.view.setUint8(at, 0xcb);
    this.view.setFloat64(at + 1, value);
  }

  /** Write an integer of int64. Numbers must be exact. */
  writeInt(value: number | bigint): void {
    if (typeof value === "bigint") {
      if (value >= BigInt(Number.MIN_SAFE_INTEGER) && value <= BigInt(Number.MAX_SAFE_INTEGER)) {
        this.writeInt(Number(value));
        return;
      }
      if (BigInt.asIntN(64, value) !== value) throw new MalformedError(`${value} is outside of int64`);
      const at = this.grow(9);
      this.view.setUint8(at, value < 0n ? 0xd3 : 0xcf);
      this.view.setBigInt64(at + 1, value);
      return;
    }
    if (!Number.isSafeInteger(value)) throw new MalformedError(`${value} is no exact integer`);
    if (value >= -32 && value < 0x80) this.writeByte(value & 0xff);
    else if (value >= 0) this.writeHead(value, 0xcc);
    else this.writeNegative(value);
  }

  writeString(value: string): void {
    if (!value.isWellFormed()) throw new MalformedError("text with half a surrogate pair");
    const data = textEncoder.encode(value);
    if (data.length < 32) this.writeByte(0xa0 | data.length);
    else this.writeHead(data.length, 0xd9);
    this.append(data);
  }

  writeBytes(value: Uint8Array): void {
    this.writeHead(value.length, 0xc4);
    this.append(value);
  }

  writeArrayHead(length: number): void {
    if (length < 16) this.writeByte(0x90 | length);
    else this.writeWideHead(length, 0xdc);
  }

  writeMapHead(length: number): void {
    if (length < 16) this.writeByte(0x80 | length);
    else this.writeWideHead(length, 0xde);
  }

  /** Write a value without a schema. Numbers that are integers are written as integers. */
  writeValue(value: Value): void {
    if (value === null) this.writeNull();
    else if (typeof value === "boolean") this.writeBool(value);
    else if (typeof value === "string") this.writeString(value);
    else if (typeof value === "bigint" || Number.isSafeInteger(value)) this.writeInt(value as number | bigint);
    else if (typeof value === "number") this.writeFloat(value);
    else if (value instanceof Uint8Array) this.writeBytes(value);
    else if (Array.isArray(value)) {
      this.writeArrayHead(value.length);
      for (const item of value) this.writeValue(item);
    } else {
      const entries = Object.entries(value);
      this.writeMapHead(entries.length);
      for (const [key, item] of entries) {
        this.writeString(key);
        this.writeValue(item);
      }
    }
  }

  private writeNegative(value: number): void {
    if (value >= -0x80) {
      const at = this.grow(2);
      this.view.setUint8(at, 0xd0);
      this.view.setInt8(at + 1, value);
    } else if (value >= -0x8000) {
      const at = this.grow(3);
      this.view.setUint8(at, 0xd1);
      this.view.setInt16(at + 1, value);
    } else if (value >= -0x80000000) {
      const at = this.grow(5);
      this.view.setUint8(at, 0xd2);
      this.view.setInt32(at + 1, value);
    } else {
      const at = this.grow(9);
      this.view.setUint8(at, 0xd3);
      this.view.setBigInt64(at + 1, BigInt(value));
    }
  }

  /** Write a head of 8, 16, 32 or 64 bits: `first` is the one of 8 bits. */
  private writeHead(value: number, first: number): void {
    if (value < 0x100) {
      const at = this.grow(2);
      this.view.setUint8(at, first);
      this.view.setUint8(at + 1, value);
    } else if (value < 2 ** 32) {
      this.writeWideHead(value, first + 1);
    } else {
      const at = this.grow(9);
      this.view.setUint8(at, first + 3);
      this.view.setBigUint64(at + 1, BigInt(value));
    }
  }

  /** Write a head of 16 or 32 bits: `first` is the one of 16 bits. */
  private writeWideHead(value: number, first: number): void {
    if (value < 0x10000) {
      const at = this.grow(3);
      this.view.setUint8(at, first);
      this.view.setUint16(at + 1, value);
    } else {
      const at = this.grow(5);
      this.view.setUint8(at, first + 1);
      this.view.setUint32(at + 1, value);
    }
  }

  private writeByte(value: number): void {
    const at = this.grow(1);
    this.bytes[at] = value;
  }

  private append(data: Uint8Array): void {
    const at = this.grow(data.length);
    this.bytes.set(data, at);
  }

  private grow(length: number): number {
    const at = this.length;
    this.length += length;
    if (this.length > this.bytes.length) {
      const bytes = new Uint8Array(Math.max(this.length, 2 * this.bytes.length));
      bytes.set(this.bytes.subarray(0, at));
      this.bytes = bytes;
      this.view = new DataView(bytes.buffer);
    }
    return at;
  }
}

/** Decode one value without a schema. Throws `MalformedError` for anything else. */
export function decodeValue(bytes: Uint8Array): Value {
  const reader = new Reader(bytes);
  const value = reader.readValue();
  reader.expectEnd();
  return value;
}

/** Encode a value without a schema. */
export function encodeValue(value: Value): Uint8Array<ArrayBuffer> {
  const writer = new Writer();
  writer.writeValue(value);
  return writer.finish();
}

function isInt(byte: number): boolean {
  return byte < 0x80 || byte >= 0xe0 || (byte >= 0xcc && byte <= 0xd3);
}

function isString(byte: number): boolean {
  return (byte & 0xe0) === 0xa0 || (byte >= 0xd9 && byte <= 0xdb);
}

function isArray(byte: number): boolean {
  return (byte & 0xf0) === 0x90 || byte === 0xdc || byte === 0xdd;
}

function isMap(byte: number): boolean {
  return (byte & 0xf0) === 0x80 || byte === 0xde || byte === 0xdf;
}

/** Return the bytes of a number after its head. */
function widthOf(byte: number): number {
  if (byte < 0x80 || byte >= 0xe0) return 0;
  if (byte === 0xca) return 4;
  if (byte === 0xcb) return 8;
  return 1 << (byte & 3);
}

function truncated(): MalformedError {
  return new MalformedError("the message is truncated");
}

function expected(what: string, byte: number): MalformedError {
  return new MalformedError(`expected ${what}, got byte 0x${byte.toString(16).padStart(2, "0")}`);
}
