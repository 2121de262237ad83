// Zstandard (RFC 8878): one frame of a known size, without a dictionary. Strict and bounded.
//
// A frame is walked block by block before anything is allocated: what its blocks can hold at most must reach the size that
// is expected, and that size must be stated in its header. Every read and write is checked, so that damaged bytes are
// refused and cost no more time than their size. Checksums are not verified: assets are hashed, frames come over TCP.

import { MalformedError } from "./errors.ts";

const MAGIC = 0xfd2fb528;
/** Most bytes of one block after decompression. */
const MAX_BLOCK = 128 << 10;
const MAX_HUFFMAN_BITS = 11;
/** Bytes that are copied one by one: a call costs more. */
const SHORT = 48;

/** Decoding table of finite state entropy: symbol, bits to read and base of the next state, by state. */
interface FseTable {
  log: number;
  symbols: Uint8Array;
  bits: Uint8Array;
  bases: Uint16Array;
}

/** Decoding table of Huffman codes: symbol and length, by the next `log` bits. */
interface HuffmanTable {
  log: number;
  symbols: Uint8Array;
  lengths: Uint8Array;
}

/** Kinds of sequence codes: their default distribution, largest accuracy and number of codes. */
interface CodeKind {
  defaults: FseTable;
  mostLog: number;
  codes: number;
}

/** Return the content of one frame, which must be `size` bytes. Throws `MalformedError`. */
export function decompressFrame(frame: Uint8Array, size: number): Uint8Array<ArrayBuffer> {
  const blocks = listBlocks(frame, size);
  const decoder = new FrameDecoder(frame, new Uint8Array(size));
  for (const block of blocks) decoder.decodeBlock(block);
  return decoder.finish();
}

interface Block {
  kind: number;
  start: number;
  length: number;
}

/** Return the blocks of a frame. Throws unless it is one whole frame that states `size`, and can hold so much. */
function listBlocks(frame: Uint8Array, size: number): Block[] {
  const view = new DataView(frame.buffer, frame.byteOffset, frame.byteLength);
  if (frame.length < 6 || view.getUint32(0, true) !== MAGIC) throw damaged("it does not begin like one");
  const flags = view.getUint8(4);
  const single = (flags & 0x20) !== 0;
  if ((flags & 0x08) !== 0 || (flags & 0x03) !== 0) throw damaged("reserved bits, or a dictionary");
  const sizeBytes = flags >> 6 === 0 ? (single ? 1 : 0) : 1 << (flags >> 6);
  let at = 5 + (single ? 0 : 1);
  if (sizeBytes === 0 || at + sizeBytes > frame.length) throw damaged("it does not state its size");
  if (readSize(view, at, sizeBytes) !== size) throw damaged(`its size is another one than ${size}`);
  at += sizeBytes;
  const blocks: Block[] = [];
  let room = 0;
  for (let last = false; !last; ) {
    if (at + 3 > frame.length) throw damaged("it is truncated");
    const head = view.getUint16(at, true) | (view.getUint8(at + 2) << 16);
    last = (head & 1) !== 0;
    const kind = (head >> 1) & 3;
    const length = head >> 3;
    if (kind === 3 || length > MAX_BLOCK) throw damaged("a block of an unknown kind or size");
    blocks.push({ kind, start: at + 3, length });
    at += 3 + (kind === 1 ? 1 : length);
    room += kind === 2 ? MAX_BLOCK : length;
  }
  if (at + ((flags & 0x04) !== 0 ? 4 : 0) !== frame.length) throw damaged("it is truncated, or bytes follow it");
  if (room < size) throw damaged(`its blocks cannot hold ${size} bytes`);
  return blocks;
}

function readSize(view: DataView, at: number, bytes: number): number {
  switch (bytes) {
    case 1:
      return view.getUint8(at);
    case 2:
      return view.getUint16(at, true) + 256;
    case 4:
      return view.getUint32(at, true);
    default:
      return Number(view.getBigUint64(at, true));
  }
}

/** Reads bits from the end of a part of the frame to its beginning. The last byte has a 1 above the first bit. */
class BackwardBits {
  /** Bits that are left; below 0 when more were read than there are: those are 0. */
  left: number;

  constructor(
    private readonly bytes: Uint8Array,
    private readonly start: number,
    end: number,
  ) {
    const last = end > start ? (bytes[end - 1] as number) : 0;
    if (last === 0) throw damaged("a bit stream without an end");
    this.left = 8 * (end - start) - 1 - Math.clz32(last) + 24;
  }

  /** Return the next `count` bits, at most 24, without reading them. Beyond the beginning they are 0. */
  peek(count: number): number {
    if (count === 0) return 0;
    const low = this.left - count;
    if (low >= 0) return this.read(low) & ((1 << count) - 1);
    const have = Math.max(0, this.left);
    return have === 0 ? 0 : (this.read(0) & ((1 << have) - 1)) << (count - have);
  }

  /** Read `count` bits, at most 24. */
  take(count: number): number {
    const value = this.peek(count);
    this.left -= count;
    if (this.left < 0) throw damaged("a bit stream is truncated");
    return value;
  }

  /** Return bits from bit `low` on, 24 or more. */
  private read(low: number): number {
    const at = this.start + (low >> 3);
    const { bytes } = this;
    // Beyond the end of the frame bytes are undefined, which counts as 0; none of these bits is used.
    const word = (bytes[at] as number) | ((bytes[at + 1] as number) << 8) | ((bytes[at + 2] as number) << 16) | ((bytes[at + 3] as number) << 24);
    return word >>> (low & 7);
  }
}

/** State from block to block: tables, repeated offsets, output. */
class FrameDecoder {
  private at = 0;
  private huffman: HuffmanTable | null = null;
  /** Tables of the block before: literal lengths, offsets, match lengths. */
  private readonly tables: (FseTable | null)[] = [null, null, null];
  /** The last three distances of matches. */
  private first = 1;
  private second = 4;
  private third = 8;
  private readonly literals: Uint8Array;

  constructor(
    private readonly frame: Uint8Array,
    private readonly content: Uint8Array<ArrayBuffer>,
  ) {
    this.literals = new Uint8Array(Math.min(MAX_BLOCK, content.length));
  }

  /** Return the content. Throws unless it is whole. */
  finish(): Uint8Array<ArrayBuffer> {
    if (this.at !== this.content.length) throw damaged(`it holds ${this.at} bytes, and states ${this.content.length}`);
    return this.content;
  }

  decodeBlock({ kind, start, length }: Block): void {
    if (kind === 2) {
      this.decodeSequences(start, start + length);
      return;
    }
    if (length > this.content.length - this.at) throw damaged("it holds more than it states");
    if (kind === 0) this.content.set(this.frame.subarray(start, start + length), this.at);
    else this.content.fill(this.frame[start] as number, this.at, this.at + length);
    this.at += length;
  }

  /** Return byte `at` of a block that ends at `end`. */
  private byte(at: number, end: number): number {
    if (at >= end) throw damaged("a block is truncated");
    return this.frame[at] as number;
  }

  private decodeSequences(start: number, end: number): void {
    const begin = this.at;
    const { next, count: literalCount } = this.readLiterals(start, end);
    let at = next;
    const first = this.byte(at++, end);
    let count = first;
    if (first >= 128) {
      count = first < 255 ? ((first - 128) << 8) + this.byte(at++, end) : this.byte(at, end) + (this.byte(at + 1, end) << 8) + 0x7f00;
      if (first === 255) at += 2;
    }
    if (count === 0) {
      if (at !== end) throw damaged("bytes after the literals of a block");
      this.copyLiterals(0, literalCount, begin);
      return;
    }
    const modes = this.byte(at++, end);
    if ((modes & 3) !== 0) throw damaged("reserved bits of sequences");
    for (const [i, kind] of KINDS.entries()) {
      const mode = (modes >> (6 - 2 * i)) & 3;
      at = this.readTable(i, kind, mode, at, end);
    }
    this.runSequences(count, literalCount, begin, new BackwardBits(this.frame, at, end));
  }

  private readTable(i: number, kind: CodeKind, mode: number, at: number, end: number): number {
    if (mode === 0) this.tables[i] = kind.defaults;
    else if (mode === 1) {
      const symbol = this.byte(at, end);
      if (symbol >= kind.codes) throw damaged("an unknown code of sequences");
      this.tables[i] = { log: 0, symbols: Uint8Array.of(symbol), bits: new Uint8Array(1), bases: new Uint16Array(1) };
      return at + 1;
    } else if (mode === 2) {
      const { table, next } = readFseTable(this.frame, at, end, kind.mostLog, kind.codes);
      this.tables[i] = table;
      return next;
    } else if (this.tables[i] === null) throw damaged("a table of a block before the first");
    return at;
  }

  private runSequences(count: number, literalCount: number, begin: number, bits: BackwardBits): void {
    const [lengths, distances, matches] = this.tables as [FseTable, FseTable, FseTable];
    let lengthState = bits.take(lengths.log);
    let distanceState = bits.take(distances.log);
    let matchState = bits.take(matches.log);
    let used = 0;
    for (let left = count; left > 0; left--) {
      const distanceCode = distances.symbols[distanceState] as number;
      const matchCode = matches.symbols[matchState] as number;
      const lengthCode = lengths.symbols[lengthState] as number;
      // Offsets of more than 24 bits are beyond every frame that is read here, but their bits are there.
      const high = distanceCode > 24 ? bits.take(distanceCode - 24) * 2 ** 24 : 0;
      const value = 2 ** distanceCode + high + bits.take(Math.min(distanceCode, 24));
      const match = (MATCH_BASES[matchCode] as number) + bits.take(MATCH_BITS[matchCode] as number);
      const length = (LENGTH_BASES[lengthCode] as number) + bits.take(LENGTH_BITS[lengthCode] as number);
      if (left > 1) {
        lengthState = (lengths.bases[lengthState] as number) + bits.take(lengths.bits[lengthState] as number);
        matchState = (matches.bases[matchState] as number) + bits.take(matches.bits[matchState] as number);
        distanceState = (distances.bases[distanceState] as number) + bits.take(distances.bits[distanceState] as number);
      }
      if (length > literalCount - used) throw damaged("sequences of more literals than there are");
      this.copyLiterals(used, used + length, begin);
      used += length;
      this.copyMatch(this.resolveOffset(value, length), match, begin);
    }
    if (bits.left !== 0) throw damaged("bits are left after the sequences");
    this.copyLiterals(used, literalCount, begin);
  }

  /** Return the distance of a match: a new one, or one of the last three. */
  private resolveOffset(value: number, literalLength: number): number {
    const { first, second, third } = this;
    if (value > 3) {
      this.third = second;
      this.second = first;
      this.first = value - 3;
      return this.first;
    }
    const i = value - 1 + (literalLength === 0 ? 1 : 0);
    if (i === 0) return first;
    this.first = i === 1 ? second : i === 2 ? third : first - 1;
    this.second = first;
    if (i > 1) this.third = second;
    if (this.first === 0) throw damaged("a match at no distance");
    return this.first;
  }

  private copyLiterals(from: number, to: number, begin: number): void {
    const { content, literals } = this;
    this.checkRoom(to - from, begin);
    if (to - from > SHORT) content.set(literals.subarray(from, to), this.at);
    else for (let i = from, at = this.at; i < to; i++, at++) content[at] = literals[i] as number;
    this.at += to - from;
  }

  private copyMatch(offset: number, length: number, begin: number): void {
    this.checkRoom(length, begin);
    if (offset > this.at) throw damaged("a match before the beginning");
    const { content } = this;
    const from = this.at - offset;
    if (offset >= length && length > SHORT) content.copyWithin(this.at, from, from + length);
    else for (let i = 0; i < length; i++) content[this.at + i] = content[from + i] as number;
    this.at += length;
  }

  private checkRoom(length: number, begin: number): void {
    if (length > this.content.length - this.at || this.at + length - begin > MAX_BLOCK) throw damaged("it holds more than it states");
  }

  /** Read the literals of a block to `literals`. Returns where the sequences begin, and their number. */
  private readLiterals(start: number, end: number): { next: number; count: number } {
    const head = this.byte(start, end);
    const kind = head & 3;
    const format = (head >> 2) & 3;
    const packed = kind >= 2;
    const headBytes = packed ? [3, 3, 4, 5][format] as number : [1, 2, 1, 3][format] as number;
    let value = 0;
    for (let i = headBytes - 1; i >= 0; i--) value = value * 256 + this.byte(start + i, end);
    const at = start + headBytes;
    if (!packed) {
      const count = Math.floor(value / (format % 2 === 0 ? 8 : 16));
      this.checkLiterals(count);
      const size = kind === 0 ? count : 1;
      if (size > end - at) throw damaged("literals are truncated");
      if (kind === 0) this.literals.set(this.frame.subarray(at, at + count));
      else this.literals.fill(this.frame[at] as number, 0, count);
      return { next: at + size, count };
    }
    const sizeBits = [10, 10, 14, 18][format] as number;
    const count = Math.floor(value / 16) % 2 ** sizeBits;
    const size = Math.floor(value / 2 ** (4 + sizeBits));
    this.checkLiterals(count);
    if (size > end - at) throw damaged("literals are truncated");
    let from = at;
    if (kind === 2) {
      const { table, next } = readHuffmanTable(this.frame, at, at + size);
      this.huffman = table;
      from = next;
    }
    if (this.huffman === null) throw damaged("a Huffman table of a block before the first");
    this.readStreams(this.huffman, format === 0 ? 1 : 4, from, at + size, count);
    return { next: at + size, count };
  }

  private checkLiterals(count: number): void {
    if (count > this.literals.length) throw damaged("more literals than it can hold");
  }

  private readStreams(table: HuffmanTable, streams: number, at: number, end: number, count: number): void {
    if (streams === 1) {
      readHuffmanStream(table, this.frame, at, end, this.literals.subarray(0, count));
      return;
    }
    let from = at + 6;
    if (from > end) throw damaged("literals are truncated");
    const part = (count + 3) >> 2;
    if (3 * part > count) throw damaged("four streams of too few literals");
    for (let i = 0; i < 4; i++) {
      const size = (this.frame[at + 2 * i] as number) | ((this.frame[at + 2 * i + 1] as number) << 8);
      const to = i === 3 ? end : from + size;
      if (to > end) throw damaged("literals are truncated");
      readHuffmanStream(table, this.frame, from, to, this.literals.subarray(i * part, i === 3 ? count : (i + 1) * part));
      from = to;
    }
  }
}

function readHuffmanStream({ log, symbols, lengths }: HuffmanTable, frame: Uint8Array, start: number, end: number, out: Uint8Array): void {
  const bits = new BackwardBits(frame, start, end);
  const mask = (1 << log) - 1;
  const first = 8 * start;
  let i = 0;
  let { left } = bits;
  for (; i < out.length && left >= log; i++) {
    const low = left - log;
    const at = (first + low) >> 3;
    const code = (((frame[at] as number) | ((frame[at + 1] as number) << 8) | ((frame[at + 2] as number) << 16)) >>> (low & 7)) & mask;
    out[i] = symbols[code] as number;
    left -= lengths[code] as number;
  }
  bits.left = left;
  for (; i < out.length; i++) {
    const code = bits.peek(log);
    out[i] = symbols[code] as number;
    bits.left -= lengths[code] as number;
    if (bits.left < 0) throw damaged("literals are truncated");
  }
  if (bits.left !== 0) throw damaged("bits are left after the literals");
}

/** Read the weights of Huffman codes, and make their table. */
function readHuffmanTable(frame: Uint8Array, start: number, end: number): { table: HuffmanTable; next: number } {
  if (start >= end) throw damaged("a Huffman table is truncated");
  const head = frame[start] as number;
  const size = head < 128 ? head : (head - 126) >> 1;
  const next = start + 1 + size;
  if (next > end) throw damaged("a Huffman table is truncated");
  const weights: number[] = [];
  if (head < 128) readWeights(frame, start + 1, next, weights);
  else {
    for (let i = 0; i < head - 127; i++) {
      const byte = frame[start + 1 + (i >> 1)] as number;
      weights.push(i % 2 === 0 ? byte >> 4 : byte & 15);
    }
  }
  return { table: makeHuffmanTable(weights), next };
}

/** Read weights that are coded by two states in turn. */
function readWeights(frame: Uint8Array, start: number, end: number, weights: number[]): void {
  const { table, next } = readFseTable(frame, start, end, 6, MAX_HUFFMAN_BITS + 2);
  const bits = new BackwardBits(frame, next, end);
  const states = [bits.take(table.log), bits.take(table.log)];
  for (let turn = 0; ; turn ^= 1) {
    const state = states[turn] as number;
    weights.push(table.symbols[state] as number);
    const count = table.bits[state] as number;
    if (weights.length > 254) throw damaged("too many Huffman weights");
    if (bits.left < count) {
      weights.push(table.symbols[states[turn ^ 1] as number] as number);
      return;
    }
    states[turn] = (table.bases[state] as number) + bits.take(count);
  }
}

function makeHuffmanTable(weights: number[]): HuffmanTable {
  let sum = 0;
  for (const weight of weights) {
    if (weight > MAX_HUFFMAN_BITS) throw damaged("a Huffman code of too many bits");
    sum += weight === 0 ? 0 : 1 << (weight - 1);
  }
  const log = 32 - Math.clz32(sum);
  const rest = (1 << log) - sum;
  if (sum === 0 || log > MAX_HUFFMAN_BITS || (rest & (rest - 1)) !== 0) throw damaged("Huffman weights that are no power of two");
  const all = [...weights, 32 - Math.clz32(rest)];
  const symbols = new Uint8Array(1 << log);
  const lengths = new Uint8Array(1 << log);
  let at = 0;
  for (let weight = 1; weight <= log; weight++) {
    for (const [symbol, other] of all.entries()) {
      if (other !== weight) continue;
      const span = 1 << (weight - 1);
      symbols.fill(symbol, at, at + span);
      lengths.fill(log + 1 - weight, at, at + span);
      at += span;
    }
  }
  return { log, symbols, lengths };
}

/** Read a distribution, and make its table. */
function readFseTable(frame: Uint8Array, start: number, end: number, mostLog: number, codes: number): { table: FseTable; next: number } {
  let bit = 8 * start;
  const peek = (): number => {
    const at = bit >> 3;
    const read = (i: number): number => (i < end ? (frame[i] as number) : 0);
    return (read(at) | (read(at + 1) << 8) | (read(at + 2) << 16)) >>> (bit & 7);
  };
  const log = (peek() & 15) + 5;
  bit += 4;
  if (log > mostLog) throw damaged("a table of too many states");
  const counts: number[] = [];
  let left = (1 << log) + 1;
  while (left > 1) {
    if (counts.length >= codes) throw damaged("a table of unknown codes");
    const width = 32 - Math.clz32(left);
    const value = peek() & ((1 << width) - 1);
    const low = value & ((1 << (width - 1)) - 1);
    const spare = (1 << width) - 1 - left;
    let count: number;
    if (low < spare) {
      count = low;
      bit += width - 1;
    } else {
      count = value >= 1 << (width - 1) ? value - spare : value;
      bit += width;
    }
    count -= 1;
    counts.push(count);
    left -= Math.abs(count);
    if (count !== 0) continue;
    for (let repeat = 3; repeat === 3; ) {
      repeat = peek() & 3;
      bit += 2;
      for (let i = 0; i < repeat; i++) counts.push(0);
      if (counts.length > codes) throw damaged("a table of unknown codes");
    }
  }
  const next = (bit + 7) >> 3;
  if (left !== 1 || next > end) throw damaged("a table is truncated");
  return { table: makeFseTable(counts, log), next };
}

/** Make the table of a distribution: -1 is a share of less than one state. */
function makeFseTable(counts: readonly number[], log: number): FseTable {
  const size = 1 << log;
  const symbols = new Uint8Array(size);
  const following = counts.map((count) => Math.abs(count));
  let high = size;
  for (const [symbol, count] of counts.entries()) if (count === -1) symbols[--high] = symbol;
  const step = (size >> 1) + (size >> 3) + 3;
  let at = 0;
  for (const [symbol, count] of counts.entries()) {
    for (let i = 0; i < count; i++) {
      symbols[at] = symbol;
      do at = (at + step) & (size - 1);
      while (at >= high);
    }
  }
  const bits = new Uint8Array(size);
  const bases = new Uint16Array(size);
  for (const [state, symbol] of symbols.entries()) {
    const number = following[symbol] as number;
    following[symbol] = number + 1;
    const count = log - (31 - Math.clz32(number));
    bits[state] = count;
    bases[state] = (number << count) - size;
  }
  return { log, symbols, bits, bases };
}

// --- codes of sequences -----------------------------------------------------------------------------------------------

/** Return the bits behind every code: so many codes of each number of bits. */
function listBits(runs: readonly (readonly [codes: number, bits: number])[]): number[] {
  return runs.flatMap(([codes, bits]) => new Array<number>(codes).fill(bits));
}

/** Return the least value of every code. */
function listBases(bits: readonly number[], first: number): number[] {
  const bases: number[] = [];
  let base = first;
  for (const count of bits) {
    bases.push(base);
    base += 2 ** count;
  }
  return bases;
}

const LENGTH_BITS = listBits([[16, 0], [4, 1], [2, 2], [2, 3], [1, 4], [1, 6], [1, 7], [1, 8], [1, 9], [1, 10], [1, 11], [1, 12], [1, 13], [1, 14], [1, 15], [1, 16]]);
const LENGTH_BASES = listBases(LENGTH_BITS, 0);
const MATCH_BITS = listBits([[32, 0], [4, 1], [2, 2], [2, 3], [2, 4], [1, 5], [1, 7], [1, 8], [1, 9], [1, 10], [1, 11], [1, 12], [1, 13], [1, 14], [1, 15], [1, 16]]);
const MATCH_BASES = listBases(MATCH_BITS, 3);

/** Literal lengths, offsets, match lengths, in the order of their tables. */
const KINDS: readonly CodeKind[] = [
  {
    defaults: makeFseTable([4, 3, 2, 2, 2, 2, 2, 2, 2, 2, 2, 2, 2, 1, 1, 1, 2, 2, 2, 2, 2, 2, 2, 2, 2, 3, 2, 1, 1, 1, 1, 1, -1, -1, -1, -1], 6),
    mostLog: 9,
    codes: 36,
  },
  {
    defaults: makeFseTable([1, 1, 1, 1, 1, 1, 2, 2, 2, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, -1, -1, -1, -1, -1], 5),
    mostLog: 8,
    codes: 32,
  },
  {
    defaults: makeFseTable(
      [1, 4, 3, 2, 2, 2, 2, 2, 2, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, -1, -1, -1, -1, -1, -1, -1],
      6,
    ),
    mostLog: 9,
    codes: 53,
  },
];

function damaged(why: string): MalformedError {
  return new MalformedError(`damaged Zstandard frame: ${why}`);
}
