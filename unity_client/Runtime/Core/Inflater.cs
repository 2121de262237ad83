// Raw deflate (RFC 1951) of a known size. Strict and bounded: the whole input is one stream that gives exactly this size. Every read
// and write is checked, so that damaged bytes are refused and cost no more time than their size and that of the output.
using System;

namespace IrisSession.Core
{
    /// <summary>Decompresses raw deflate. Keeps its tables, so that it allocates nothing. Not for several threads at once.</summary>
    public sealed class Inflater
    {
        private const int MaxLengthCodes = 286;
        private const int MaxDistanceCodes = 30;
        private const int EndOfBlock = 256;

        /// <summary>Most bits of one length and its distance: 15 + 5 + 15 + 13.</summary>
        private const int PairBits = 48;

        /// <summary>Bytes that are copied one by one: a call costs more.</summary>
        private const int Short = 32;

        /// <summary>Most output of a byte of input: a length of 258 from two bits.</summary>
        private const int MaxRatio = 1032;

        private static readonly byte[] CodeOrder = { 16, 17, 18, 0, 8, 7, 9, 6, 10, 5, 11, 4, 12, 3, 13, 2, 14, 1, 15 };
        private static readonly ushort[] LengthBases =
        {
            3, 4, 5, 6, 7, 8, 9, 10, 11, 13, 15, 17, 19, 23, 27, 31, 35, 43, 51, 59, 67, 83, 99, 115, 131, 163, 195, 227, 258,
        };

        private static readonly byte[] LengthBits = { 0, 0, 0, 0, 0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3, 4, 4, 4, 4, 5, 5, 5, 5, 0 };
        private static readonly ushort[] DistanceBases =
        {
            1, 2, 3, 4, 5, 7, 9, 13, 17, 25, 33, 49, 65, 97, 129, 193, 257, 385, 513, 769, 1025, 1537, 2049, 3073, 4097, 6145, 8193, 12289, 16385, 24577,
        };

        private static readonly byte[] DistanceBits = { 0, 0, 0, 0, 1, 1, 2, 2, 3, 3, 4, 4, 5, 5, 6, 6, 7, 7, 8, 8, 9, 9, 10, 10, 11, 11, 12, 12, 13, 13 };

        private readonly DeflateCode fixedLengths = new DeflateCode(10, 288);
        private readonly DeflateCode fixedDistances = new DeflateCode(8, 32);
        private readonly DeflateCode lengths = new DeflateCode(10, 288);
        private readonly DeflateCode distances = new DeflateCode(8, 32);
        private readonly DeflateCode codes = new DeflateCode(7, 19);
        private readonly byte[] widths = new byte[MaxLengthCodes + MaxDistanceCodes + 4];
        private byte[] source;
        private int from;
        private int end;

        // Bits that were read and not used yet, the next one lowest.
        private ulong bits;
        private int have;
        private byte[] target;
        private int at;
        private int size;

        public Inflater()
        {
            byte[] all = new byte[288];
            for (int i = 0; i < all.Length; i++) all[i] = (byte)(i < 144 ? 8 : i < 256 ? 9 : i < 280 ? 7 : 8);
            fixedLengths.Build(all, 0, all.Length);
            for (int i = 0; i < 32; i++) all[i] = 5;
            fixedDistances.Build(all, 0, 32);
        }

        /// <summary>Throw unless so much input can give `size` bytes: to be asked before a target is allocated.</summary>
        public static void CheckSize(int count, long size)
        {
            if (size < 0 || size > (long)MaxRatio * count) throw new DecodeException("deflate: " + count + " bytes cannot hold " + size);
        }

        /// <summary>Decompress one stream to the first `size` bytes of `target`; it must give just this size.</summary>
        /// <exception cref="DecodeException">Damaged bytes, or another size. `target` is undefined then.</exception>
        public void Inflate(byte[] source, int offset, int count, byte[] target, int size)
        {
            if (size < 0 || size > target.Length) throw new ArgumentOutOfRangeException(nameof(size));
            CheckSize(count, size);
            this.source = source;
            this.target = target;
            this.size = size;
            from = offset;
            end = offset + count;
            bits = 0;
            have = at = 0;
            try
            {
                while (!InflateBlock())
                {
                }
            }
            finally
            {
                this.source = this.target = null;
            }
            if (at != size) throw new DecodeException("deflate: it holds " + at + " bytes, expected " + size);
            if (from - (have >> 3) != end) throw new DecodeException("deflate: bytes follow the stream");
        }

        /// <summary>Decompress a block. Returns whether it is the last one.</summary>
        private bool InflateBlock()
        {
            bool last = Take(1) == 1;
            switch (Take(2))
            {
                case 0:
                    CopyStored();
                    break;
                case 1:
                    InflateCodes(fixedLengths, fixedDistances);
                    break;
                case 2:
                    ReadCodes();
                    InflateCodes(lengths, distances);
                    break;
                default:
                    throw new DecodeException("deflate: a block of an unknown kind");
            }
            return last;
        }

        private void Refill()
        {
            if (end - from >= 8)
            {
                bits |= BitConverter.ToUInt64(source, from) << have;
                from += (63 - have) >> 3;
                have |= 56;
                return;
            }
            for (; have <= 56 && from < end; have += 8) bits |= (ulong)source[from++] << have;
        }

        private int Take(int count)
        {
            if (have < count) Refill();
            int value = (int)(bits & ((1UL << count) - 1));
            Drop(count);
            return value;
        }

        private void Drop(int count)
        {
            bits >>= count;
            have -= count;
            if (have < 0) throw new DecodeException("deflate: the stream is truncated");
        }

        private int TakeSymbol(DeflateCode code)
        {
            if (have < DeflateCode.MaxBits) Refill();
            int entry = code.Find(bits);
            Drop(entry & 15);
            return entry >> 4;
        }

        private void CopyStored()
        {
            Drop(have & 7);
            from -= have >> 3;
            bits = 0;
            have = 0;
            if (end - from < 4) throw new DecodeException("deflate: the stream is truncated");
            int length = source[from] | (source[from + 1] << 8);
            if ((length ^ 0xffff) != (source[from + 2] | (source[from + 3] << 8))) throw new DecodeException("deflate: a stored block of unclear length");
            from += 4;
            if (length > end - from) throw new DecodeException("deflate: the stream is truncated");
            CheckRoom(length);
            Buffer.BlockCopy(source, from, target, at, length);
            from += length;
            at += length;
        }

        private void ReadCodes()
        {
            int lengthCount = Take(5) + 257;
            int distanceCount = Take(5) + 1;
            int codeCount = Take(4) + 4;
            if (lengthCount > MaxLengthCodes || distanceCount > MaxDistanceCodes) throw new DecodeException("deflate: too many codes");
            Array.Clear(widths, 0, CodeOrder.Length);
            for (int i = 0; i < codeCount; i++) widths[CodeOrder[i]] = (byte)Take(3);
            if (!codes.Build(widths, 0, CodeOrder.Length)) throw new DecodeException("deflate: codes that are no complete set");
            int total = lengthCount + distanceCount;
            for (int found = 0; found < total;)
            {
                int symbol = TakeSymbol(codes);
                if (symbol < 16)
                {
                    widths[found++] = (byte)symbol;
                    continue;
                }
                if (symbol == 16 && found == 0) throw new DecodeException("deflate: a repetition of nothing");
                byte width = symbol == 16 ? widths[found - 1] : (byte)0;
                int repeat = symbol == 16 ? 3 + Take(2) : symbol == 17 ? 3 + Take(3) : 11 + Take(7);
                if (repeat > total - found) throw new DecodeException("deflate: too many codes");
                for (; repeat > 0; repeat--) widths[found++] = width;
            }
            if (widths[EndOfBlock] == 0) throw new DecodeException("deflate: a block without an end");
            // A code of one symbol may leave half of its bits unused; there may be no distances at all.
            if (!lengths.Build(widths, 0, lengthCount) && lengths.Longest > 1) throw new DecodeException("deflate: codes that are no complete set");
            if (!distances.Build(widths, lengthCount, distanceCount) && distances.Longest > 1) throw new DecodeException("deflate: codes that are no complete set");
        }

        private void InflateCodes(DeflateCode lengthCode, DeflateCode distanceCode)
        {
            byte[] output = target;
            while (true)
            {
                if (have < PairBits) Refill();
                int entry = lengthCode.Find(bits);
                Drop(entry & 15);
                int symbol = entry >> 4;
                if (symbol < EndOfBlock)
                {
                    if (at == size) throw new DecodeException("deflate: it holds more than is expected");
                    output[at++] = (byte)symbol;
                    continue;
                }
                if (symbol == EndOfBlock) return;
                symbol -= EndOfBlock + 1;
                if (symbol >= LengthBases.Length) throw new DecodeException("deflate: an unknown length");
                int length = LengthBases[symbol] + Take(LengthBits[symbol]);
                symbol = TakeSymbol(distanceCode);
                if (symbol >= MaxDistanceCodes) throw new DecodeException("deflate: an unknown distance");
                CopyMatch(DistanceBases[symbol] + Take(DistanceBits[symbol]), length);
            }
        }

        private void CopyMatch(int distance, int length)
        {
            CheckRoom(length);
            if (distance > at) throw new DecodeException("deflate: a match before the beginning");
            byte[] output = target;
            int to = at;
            int begin = at - distance;
            at += length;
            if (length <= Short)
            {
                for (int i = 0; i < length; i++) output[to + i] = output[begin + i];
                return;
            }
            // Where a match overlaps itself, what has been copied doubles the piece that can be copied next.
            while (length > 0)
            {
                int piece = Math.Min(length, to - begin);
                Buffer.BlockCopy(output, begin, output, to, piece);
                to += piece;
                length -= piece;
            }
        }

        private void CheckRoom(int length)
        {
            if (length > size - at) throw new DecodeException("deflate: it holds more than is expected");
        }
    }

    /// <summary>A canonical Huffman code: short codes by a table, long ones by counting.</summary>
    internal sealed class DeflateCode
    {
        public const int MaxBits = 15;

        private readonly int tableBits;

        // By the next bits, the first one lowest: symbol and, in the lowest four bits, the length of its code; 0: a longer code, or none.
        private readonly ushort[] table;

        // Number of codes of each length, and symbols in the order of their codes.
        private readonly int[] counts = new int[MaxBits + 1];
        private readonly int[] offsets = new int[MaxBits + 2];
        private readonly ushort[] symbols;

        public DeflateCode(int tableBits, int symbolCount)
        {
            this.tableBits = tableBits;
            table = new ushort[1 << tableBits];
            symbols = new ushort[symbolCount];
        }

        /// <summary>Length of the longest code, 0 without any.</summary>
        public int Longest { get; private set; }

        /// <summary>Make the code of lengths by symbol. Returns whether every sequence of bits has a meaning.</summary>
        /// <exception cref="DecodeException">Some sequence has two.</exception>
        public bool Build(byte[] widths, int from, int count)
        {
            Array.Clear(counts, 0, counts.Length);
            Array.Clear(offsets, 0, offsets.Length);
            Array.Clear(table, 0, table.Length);
            for (int i = 0; i < count; i++) counts[widths[from + i]]++;
            counts[0] = 0;
            Longest = 0;
            int left = 1;
            for (int width = 1; width <= MaxBits; width++)
            {
                left = 2 * left - counts[width];
                if (left < 0) throw new DecodeException("deflate: too many codes of a length");
                if (counts[width] > 0) Longest = width;
                offsets[width + 1] = offsets[width] + counts[width];
            }
            for (int i = 0; i < count; i++) if (widths[from + i] != 0) symbols[offsets[widths[from + i]]++] = (ushort)i;
            FillTable();
            return left == 0;
        }

        /// <summary>Return symbol and, in the lowest four bits, length of the code that the bits begin with.</summary>
        public int Find(ulong bits)
        {
            int entry = table[(int)bits & (table.Length - 1)];
            return entry != 0 ? entry : FindLong(bits);
        }

        private void FillTable()
        {
            int code = 0;
            int index = 0;
            for (int width = 1; width <= tableBits; width++, code <<= 1)
            {
                for (int i = 0; i < counts[width]; i++, code++)
                {
                    int reversed = 0;
                    for (int bit = 0; bit < width; bit++) reversed |= ((code >> bit) & 1) << (width - 1 - bit);
                    ushort entry = (ushort)((symbols[index++] << 4) | width);
                    for (int at = reversed; at < table.Length; at += 1 << width) table[at] = entry;
                }
            }
        }

        private int FindLong(ulong bits)
        {
            int code = 0;
            int first = 0;
            int index = 0;
            for (int width = 1; width <= Longest; width++)
            {
                code |= (int)(bits & 1);
                bits >>= 1;
                if (code - counts[width] < first) return (symbols[index + code - first] << 4) | width;
                index += counts[width];
                first = (first + counts[width]) << 1;
                code <<= 1;
            }
            throw new DecodeException("deflate: an unknown code");
        }
    }
}
