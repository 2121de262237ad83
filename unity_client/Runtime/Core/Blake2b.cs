// BLAKE2b (RFC 7693) without a key: digests of the session state, fingerprints of identities.
using System;

namespace IrisSession.Core
{
    /// <summary>Computes BLAKE2b digests.</summary>
    public static class Blake2b
    {
        private const int BlockBytes = 128;
        private const int Rounds = 12;

        private static readonly ulong[] InitialState =
        {
            0x6a09e667f3bcc908, 0xbb67ae8584caa73b, 0x3c6ef372fe94f82b, 0xa54ff53a5f1d36f1, 0x510e527fade682d1, 0x9b05688c2b3e6c1f, 0x1f83d9abfb41bd6b, 0x5be0cd19137e2179,
        };

        private static readonly byte[] Order =
        {
            0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15,
            14, 10, 4, 8, 9, 15, 13, 6, 1, 12, 0, 2, 11, 7, 5, 3,
            11, 8, 12, 0, 5, 2, 15, 13, 10, 14, 3, 6, 7, 1, 9, 4,
            7, 9, 3, 1, 13, 12, 11, 14, 2, 6, 5, 10, 4, 0, 15, 8,
            9, 0, 5, 7, 2, 4, 10, 15, 14, 1, 11, 12, 6, 8, 3, 13,
            2, 12, 6, 10, 0, 11, 8, 3, 4, 13, 7, 5, 15, 14, 1, 9,
            12, 5, 1, 15, 14, 13, 4, 10, 0, 7, 6, 3, 9, 2, 8, 11,
            13, 11, 7, 14, 12, 1, 3, 9, 5, 0, 15, 4, 8, 6, 2, 10,
            6, 15, 14, 9, 11, 3, 0, 8, 12, 2, 13, 7, 1, 4, 10, 5,
            10, 2, 8, 4, 7, 6, 1, 5, 15, 11, 9, 14, 3, 12, 13, 0,
        };

        /// <summary>Return the digest of `size` bytes (1 to 64). `person`: personalisation, at most 16 characters of ASCII.</summary>
        public static byte[] Compute(byte[] data, int offset, int count, int size, string person = "")
        {
            if (size < 1 || size > 64 || person.Length > 16) throw new ArgumentOutOfRangeException(nameof(size));
            ulong[] state = (ulong[])InitialState.Clone();
            state[0] ^= 0x01010000 ^ (ulong)size;
            for (int i = 0; i < person.Length; i++) state[6 + i / 8] ^= (ulong)(byte)person[i] << (8 * (i % 8));
            ulong[] work = new ulong[16];
            ulong[] words = new ulong[16];
            byte[] block = new byte[BlockBytes];
            int done = 0;
            do
            {
                int length = Math.Min(BlockBytes, count - done);
                Array.Clear(block, 0, BlockBytes);
                Buffer.BlockCopy(data, offset + done, block, 0, length);
                done += length;
                for (int i = 0; i < 16; i++) words[i] = BitConverter.ToUInt64(block, 8 * i);
                Compress(state, work, words, (ulong)done, done == count);
            }
            while (done < count);
            byte[] digest = new byte[64];
            for (int i = 0; i < 8; i++) BitConverter.GetBytes(state[i]).CopyTo(digest, 8 * i);
            Array.Resize(ref digest, size);
            return digest;
        }

        private static void Compress(ulong[] state, ulong[] v, ulong[] m, ulong done, bool last)
        {
            Array.Copy(state, v, 8);
            Array.Copy(InitialState, 0, v, 8, 8);
            v[12] ^= done;
            if (last) v[14] = ~v[14];
            for (int round = 0; round < Rounds; round++)
            {
                int at = 16 * (round % 10);
                for (int i = 0; i < 4; i++) Mix(v, i, i + 4, i + 8, i + 12, m[Order[at + 2 * i]], m[Order[at + 2 * i + 1]]);
                for (int i = 0; i < 4; i++) Mix(v, i, 4 + (i + 1) % 4, 8 + (i + 2) % 4, 12 + (i + 3) % 4, m[Order[at + 8 + 2 * i]], m[Order[at + 9 + 2 * i]]);
            }
            for (int i = 0; i < 8; i++) state[i] ^= v[i] ^ v[i + 8];
        }

        private static void Mix(ulong[] v, int a, int b, int c, int d, ulong x, ulong y)
        {
            unchecked
            {
                v[a] += v[b] + x;
                v[d] = RotateRight(v[d] ^ v[a], 32);
                v[c] += v[d];
                v[b] = RotateRight(v[b] ^ v[c], 24);
                v[a] += v[b] + y;
                v[d] = RotateRight(v[d] ^ v[a], 16);
                v[c] += v[d];
                v[b] = RotateRight(v[b] ^ v[c], 63);
            }
        }

        private static ulong RotateRight(ulong value, int bits)
        {
            return (value >> bits) | (value << (64 - bits));
        }
    }
}
