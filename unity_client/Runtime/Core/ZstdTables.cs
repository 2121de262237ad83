// Tables of Zstandard (RFC 8878, section 4): finite state entropy and Huffman codes. Their arrays have the largest size from the
// start and are filled again for every block, so that decoding allocates nothing. Frames are in ZstdDecoder.cs.
//
// `bytes` is the buffer of a block with ZstdBits.Padding bytes behind it: reads may pass its end by so many, and are checked after.
using System;

namespace IrisSession.Core
{
    /// <summary>Reads bits from the end of a part of a block to its beginning.</summary>
    internal static class ZstdBits
    {
        /// <summary>Bytes behind a block that are read with its last ones.</summary>
        public const int Padding = 8;

        /// <summary>Return the number of bits from `start` to the marker in the last byte, a 1 above the first bit.</summary>
        public static int CountBits(byte[] bytes, int start, int end)
        {
            int last = end > start ? bytes[end - 1] : 0;
            if (last == 0) throw new DecodeException("Zstandard: a bit stream without an end");
            return 8 * (end - start - 1) + FloorLog2(last);
        }

        /// <summary>Return the next `count` bits, at most 31, of `left`. Beyond the beginning they are 0.</summary>
        public static int Peek(byte[] bytes, int start, int left, int count)
        {
            int low = left - count;
            if (low >= 0) return (int)((BitConverter.ToUInt64(bytes, start + (low >> 3)) >> (low & 7)) & ((1UL << count) - 1));
            if (left <= 0) return 0;
            return (int)((BitConverter.ToUInt64(bytes, start) & ((1UL << left) - 1)) << (count - left));
        }

        /// <summary>Return the position of the highest 1 of a number above 0.</summary>
        public static int FloorLog2(int value)
        {
            int log = 0;
            while (value > 1)
            {
                value >>= 1;
                log++;
            }
            return log;
        }
    }

    /// <summary>Decoding table of finite state entropy: symbol, bits to read and base of the next state, by state.</summary>
    internal sealed class FseTable
    {
        private const int MaxCodes = 64;

        public readonly byte[] Symbols;
        public readonly byte[] Bits;
        public readonly ushort[] Bases;
        public int Log;
        private readonly int maxLog;
        private readonly int codes;
        private readonly short[] counts = new short[MaxCodes];
        private readonly short[] following = new short[MaxCodes];

        public FseTable(int maxLog, int codes)
        {
            this.maxLog = maxLog;
            this.codes = codes;
            Symbols = new byte[1 << maxLog];
            Bits = new byte[1 << maxLog];
            Bases = new ushort[1 << maxLog];
        }

        /// <summary>Make a table of one state, which has `symbol`.</summary>
        public void FillSingle(int symbol)
        {
            if (symbol >= codes) throw new DecodeException("Zstandard: an unknown code of sequences");
            Log = 0;
            Symbols[0] = (byte)symbol;
            Bits[0] = 0;
            Bases[0] = 0;
        }

        /// <summary>Make the table of a distribution: -1 is a share of less than one state.</summary>
        public void Fill(short[] distribution, int log)
        {
            Array.Copy(distribution, counts, distribution.Length);
            Build(distribution.Length, log);
        }

        /// <summary>Read a distribution, and make its table. Returns the offset behind it.</summary>
        public int Read(byte[] bytes, int start, int end)
        {
            if (start >= end) throw new DecodeException("Zstandard: a table is truncated");
            int bit = 8 * start;
            int limit = 8 * end;
            int log = (Peek(bytes, bit) & 15) + 5;
            bit += 4;
            if (log > maxLog) throw new DecodeException("Zstandard: a table of too many states");
            int found = 0;
            int left = (1 << log) + 1;
            while (left > 1)
            {
                if (found >= codes || bit > limit) throw new DecodeException("Zstandard: a table of unknown codes, or truncated");
                int width = ZstdBits.FloorLog2(left) + 1;
                int value = Peek(bytes, bit) & ((1 << width) - 1);
                int low = value & ((1 << (width - 1)) - 1);
                int spare = (1 << width) - 1 - left;
                int count;
                if (low < spare)
                {
                    count = low - 1;
                    bit += width - 1;
                }
                else
                {
                    count = (value >= 1 << (width - 1) ? value - spare : value) - 1;
                    bit += width;
                }
                counts[found++] = (short)count;
                left -= Math.Abs(count);
                if (count == 0) found = ReadZeros(bytes, ref bit, limit, found);
            }
            int next = (bit + 7) >> 3;
            if (left != 1 || next > end) throw new DecodeException("Zstandard: a table is truncated");
            Build(found, log);
            return next;
        }

        /// <summary>Read how many codes without a share follow one. Returns the number of codes so far.</summary>
        private int ReadZeros(byte[] bytes, ref int bit, int limit, int found)
        {
            int repeat = 3;
            while (repeat == 3)
            {
                if (bit > limit) throw new DecodeException("Zstandard: a table is truncated");
                repeat = Peek(bytes, bit) & 3;
                bit += 2;
                if (found + repeat > codes) throw new DecodeException("Zstandard: a table of unknown codes");
                for (int i = 0; i < repeat; i++) counts[found++] = 0;
            }
            return found;
        }

        /// <summary>Return 17 bits or more from bit `bit` on, lowest first.</summary>
        private static int Peek(byte[] bytes, int bit)
        {
            int at = bit >> 3;
            return (bytes[at] | (bytes[at + 1] << 8) | (bytes[at + 2] << 16)) >> (bit & 7);
        }

        private void Build(int found, int log)
        {
            int size = 1 << log;
            Log = log;
            int high = size;
            for (int symbol = 0; symbol < found; symbol++)
            {
                following[symbol] = Math.Abs(counts[symbol]);
                if (counts[symbol] == -1) Symbols[--high] = (byte)symbol;
            }
            int step = (size >> 1) + (size >> 3) + 3;
            int at = 0;
            for (int symbol = 0; symbol < found; symbol++)
            {
                for (int i = 0; i < counts[symbol]; i++)
                {
                    Symbols[at] = (byte)symbol;
                    do at = (at + step) & (size - 1);
                    while (at >= high);
                }
            }
            for (int state = 0; state < size; state++)
            {
                int number = following[Symbols[state]]++;
                int bits = log - ZstdBits.FloorLog2(number);
                Bits[state] = (byte)bits;
                Bases[state] = (ushort)((number << bits) - size);
            }
        }
    }

    /// <summary>Decoding table of Huffman codes, by the next `Log` bits.</summary>
    internal sealed class HuffmanTable
    {
        private const int MaxBits = 11;
        private const int MaxWeights = 256;

        /// <summary>Symbol, and above it the length of its code.</summary>
        public readonly ushort[] Entries = new ushort[1 << MaxBits];

        /// <summary>Length of the longest code; 0 while there is no table.</summary>
        public int Log;
        private readonly byte[] weights = new byte[MaxWeights];
        private readonly FseTable weightTable = new FseTable(6, MaxBits + 2);
        private int count;

        /// <summary>Read the weights of the codes, and make their table. Returns the offset behind them.</summary>
        public int Read(byte[] bytes, int start, int end)
        {
            Log = 0;
            if (start >= end) throw new DecodeException("Zstandard: a Huffman table is truncated");
            int head = bytes[start];
            int size = head < 128 ? head : (head - 126) >> 1;
            int next = start + 1 + size;
            if (next > end) throw new DecodeException("Zstandard: a Huffman table is truncated");
            count = 0;
            if (head < 128) ReadWeights(bytes, start + 1, next);
            else
            {
                for (; count < head - 127; count++)
                {
                    int two = bytes[start + 1 + (count >> 1)];
                    weights[count] = (byte)(count % 2 == 0 ? two >> 4 : two & 15);
                }
            }
            Build();
            return next;
        }

        /// <summary>Read weights that are coded by two states in turn.</summary>
        private void ReadWeights(byte[] bytes, int start, int end)
        {
            int at = weightTable.Read(bytes, start, end);
            int left = ZstdBits.CountBits(bytes, at, end);
            int log = weightTable.Log;
            int first = ZstdBits.Peek(bytes, at, left, log);
            int second = ZstdBits.Peek(bytes, at, left - log, log);
            left -= 2 * log;
            if (left < 0) throw new DecodeException("Zstandard: Huffman weights are truncated");
            while (true)
            {
                if (count > MaxWeights - 3) throw new DecodeException("Zstandard: too many Huffman weights");
                weights[count++] = weightTable.Symbols[first];
                int bits = weightTable.Bits[first];
                if (left < bits)
                {
                    weights[count++] = weightTable.Symbols[second];
                    return;
                }
                int following = weightTable.Bases[first] + ZstdBits.Peek(bytes, at, left, bits);
                left -= bits;
                first = second;
                second = following;
            }
        }

        private void Build()
        {
            int sum = 0;
            for (int i = 0; i < count; i++)
            {
                if (weights[i] > MaxBits) throw new DecodeException("Zstandard: a Huffman code of too many bits");
                sum += weights[i] == 0 ? 0 : 1 << (weights[i] - 1);
            }
            if (sum == 0) throw new DecodeException("Zstandard: a Huffman table without codes");
            int log = ZstdBits.FloorLog2(sum) + 1;
            int rest = (1 << log) - sum;
            if (log > MaxBits || (rest & (rest - 1)) != 0) throw new DecodeException("Zstandard: Huffman weights that are no power of two");
            weights[count++] = (byte)(ZstdBits.FloorLog2(rest) + 1);
            int at = 0;
            for (int weight = 1; weight <= log; weight++)
            {
                int span = 1 << (weight - 1);
                for (int symbol = 0; symbol < count; symbol++)
                {
                    if (weights[symbol] != weight) continue;
                    ushort entry = (ushort)(symbol | ((log + 1 - weight) << 8));
                    for (int i = 0; i < span; i++) Entries[at++] = entry;
                }
            }
            Log = log;
        }

        /// <summary>Decode `length` symbols of one stream to `target`, which must use up its bits.</summary>
        public void ReadStream(byte[] bytes, int start, int end, byte[] target, int offset, int length)
        {
            const int Window = 56;
            int left = ZstdBits.CountBits(bytes, start, end);
            int log = Log;
            int mask = (1 << log) - 1;
            ushort[] entries = Entries;
            int at = offset;
            int last = offset + length;
            for (; left >= Window && at + 5 <= last; at += 5)
            {
                int low = left - Window;
                ulong window = BitConverter.ToUInt64(bytes, start + (low >> 3)) >> (low & 7);
                int shift = Window - log;
                int entry = entries[(int)(window >> shift) & mask];
                target[at] = (byte)entry;
                shift -= entry >> 8;
                entry = entries[(int)(window >> shift) & mask];
                target[at + 1] = (byte)entry;
                shift -= entry >> 8;
                entry = entries[(int)(window >> shift) & mask];
                target[at + 2] = (byte)entry;
                shift -= entry >> 8;
                entry = entries[(int)(window >> shift) & mask];
                target[at + 3] = (byte)entry;
                shift -= entry >> 8;
                entry = entries[(int)(window >> shift) & mask];
                target[at + 4] = (byte)entry;
                shift -= entry >> 8;
                left -= Window - log - shift;
            }
            for (; at < last; at++)
            {
                int entry = entries[ZstdBits.Peek(bytes, start, left, log)];
                target[at] = (byte)entry;
                left -= entry >> 8;
                if (left < 0) throw new DecodeException("Zstandard: literals are truncated");
            }
            if (left != 0) throw new DecodeException("Zstandard: bits are left after the literals");
        }
    }

    /// <summary>Codes of sequences: bits behind every code and its least value, and the distributions of frames that state none.</summary>
    internal sealed class ZstdCodes
    {
        public static readonly int[] DefaultLogs = { 6, 5, 6 };
        public static readonly short[][] DefaultDistributions =
        {
            new short[] { 4, 3, 2, 2, 2, 2, 2, 2, 2, 2, 2, 2, 2, 1, 1, 1, 2, 2, 2, 2, 2, 2, 2, 2, 2, 3, 2, 1, 1, 1, 1, 1, -1, -1, -1, -1 },
            new short[] { 1, 1, 1, 1, 1, 1, 2, 2, 2, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, -1, -1, -1, -1, -1 },
            new short[]
            {
                1, 4, 3, 2, 2, 2, 2, 2, 2, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, -1, -1, -1,
                -1, -1, -1, -1,
            },
        };

        public readonly byte[] LengthBits = ListBits(16, new byte[] { 1, 1, 1, 1, 2, 2, 3, 3, 4, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16 });
        public readonly byte[] MatchBits = ListBits(32, new byte[] { 1, 1, 1, 1, 2, 2, 3, 3, 4, 4, 5, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16 });
        public readonly int[] LengthBases;
        public readonly int[] MatchBases;

        public ZstdCodes()
        {
            LengthBases = ListBases(LengthBits, 0);
            MatchBases = ListBases(MatchBits, 3);
        }

        private static byte[] ListBits(int plain, byte[] others)
        {
            byte[] bits = new byte[plain + others.Length];
            Array.Copy(others, 0, bits, plain, others.Length);
            return bits;
        }

        private static int[] ListBases(byte[] bits, int least)
        {
            int[] bases = new int[bits.Length];
            for (int i = 0; i < bits.Length; i++)
            {
                bases[i] = least;
                least += 1 << bits[i];
            }
            return bases;
        }
    }
}
