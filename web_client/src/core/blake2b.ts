// BLAKE2b (RFC 7693) of short inputs: fingerprints of identities, digests of session mirrors. WebCrypto has none.

const IV = [
  0x6a09e667f3bcc908n,
  0xbb67ae8584caa73bn,
  0x3c6ef372fe94f82bn,
  0xa54ff53a5f1d36f1n,
  0x510e527fade682d1n,
  0x9b05688c2b3e6c1fn,
  0x1f83d9abfb41bd6bn,
  0x5be0cd19137e2179n,
] as const;

/** Order of the words of a block in each round. */
const SIGMA = [
  [0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15],
  [14, 10, 4, 8, 9, 15, 13, 6, 1, 12, 0, 2, 11, 7, 5, 3],
  [11, 8, 12, 0, 5, 2, 15, 13, 10, 14, 3, 6, 7, 1, 9, 4],
  [7, 9, 3, 1, 13, 12, 11, 14, 2, 6, 5, 10, 4, 0, 15, 8],
  [9, 0, 5, 7, 2, 4, 10, 15, 14, 1, 11, 12, 6, 8, 3, 13],
  [2, 12, 6, 10, 0, 11, 8, 3, 4, 13, 7, 5, 15, 14, 1, 9],
  [12, 5, 1, 15, 14, 13, 4, 10, 0, 7, 6, 3, 9, 2, 8, 11],
  [13, 11, 7, 14, 12, 1, 3, 9, 5, 0, 15, 4, 8, 6, 2, 10],
  [6, 15, 14, 9, 11, 3, 0, 8, 12, 2, 13, 7, 1, 4, 10, 5],
  [10, 2, 8, 4, 7, 6, 1, 5, 15, 11, 9, 14, 3, 12, 13, 0],
] as const;

/** Words that a round mixes: four columns, then four diagonals. */
const MIXES = [
  [0, 4, 8, 12],
  [1, 5, 9, 13],
  [2, 6, 10, 14],
  [3, 7, 11, 15],
  [0, 5, 10, 15],
  [1, 6, 11, 12],
  [2, 7, 8, 13],
  [3, 4, 9, 14],
] as const;

const BLOCK_BYTES = 128;
const ROUNDS = 12;

/** Return the digest of `size` bytes. `person`: up to 16 bytes that set uses apart. */
export function blake2b(data: Uint8Array, size: number, person: Uint8Array = new Uint8Array()): Uint8Array<ArrayBuffer> {
  const parameters = new Uint8Array(64);
  parameters.set([size, 0, 1, 1]);
  parameters.set(person, 48);
  const words = new DataView(parameters.buffer);
  const state = BigUint64Array.from(IV, (word, i) => word ^ words.getBigUint64(8 * i, true));
  const blocks = Math.max(1, Math.ceil(data.length / BLOCK_BYTES));
  for (let i = 0; i < blocks; i++) {
    const block = new Uint8Array(BLOCK_BYTES);
    block.set(data.subarray(i * BLOCK_BYTES, (i + 1) * BLOCK_BYTES));
    compress(state, new DataView(block.buffer), Math.min((i + 1) * BLOCK_BYTES, data.length), i === blocks - 1);
  }
  const digest = new Uint8Array(64);
  const out = new DataView(digest.buffer);
  for (const [i, word] of state.entries()) out.setBigUint64(8 * i, word, true);
  return digest.slice(0, size);
}

function compress(state: BigUint64Array, block: DataView, count: number, last: boolean): void {
  const v = BigUint64Array.from([...state, ...IV]);
  v[12] = (v[12] as bigint) ^ BigInt(count);
  if (last) v[14] = ~(v[14] as bigint);
  for (let round = 0; round < ROUNDS; round++) {
    const order = SIGMA[round % SIGMA.length] as (typeof SIGMA)[number];
    for (const [i, [a, b, c, d]] of MIXES.entries()) {
      const x = block.getBigUint64(8 * (order[2 * i] as number), true);
      const y = block.getBigUint64(8 * (order[2 * i + 1] as number), true);
      mix(v, a, b, c, d, x, y);
    }
  }
  for (let i = 0; i < 8; i++) state[i] = (state[i] as bigint) ^ (v[i] as bigint) ^ (v[i + 8] as bigint);
}

function mix(v: BigUint64Array, a: number, b: number, c: number, d: number, x: bigint, y: bigint): void {
  v[a] = (v[a] as bigint) + (v[b] as bigint) + x;
  v[d] = rotate((v[d] as bigint) ^ (v[a] as bigint), 32n);
  v[c] = (v[c] as bigint) + (v[d] as bigint);
  v[b] = rotate((v[b] as bigint) ^ (v[c] as bigint), 24n);
  v[a] = (v[a] as bigint) + (v[b] as bigint) + y;
  v[d] = rotate((v[d] as bigint) ^ (v[a] as bigint), 16n);
  v[c] = (v[c] as bigint) + (v[d] as bigint);
  v[b] = rotate((v[b] as bigint) ^ (v[c] as bigint), 63n);
}

function rotate(word: bigint, bits: bigint): bigint {
  return (word >> bits) | BigInt.asUintN(64, word << (64n - bits));
}
