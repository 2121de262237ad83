// Zstandard (RFC 8878): one frame of a known size, without a dictionary. Strict and bounded.
//
// A frame is walked block by block before anything of it is decoded: it must state the size that is expected, and its blocks must
// be able to hold so much. Every read and write is checked, so that damaged bytes are refused and cost no more time than their size.
// Checksums are not verified: assets are hashed, frames come over TCP.
using System;

namespace IrisSession.Core
{
    /// <summary>Decodes frames. Keeps its buffers (about 300 kB), so that decoding allocates nothing. Not for several threads at once.</summary>
    public sealed class ZstdDecoder
    {
        /// <summary>Most bytes of one block after decompression.</summary>
        public const int MaxBlock = 128 << 10;
        private const uint Magic = 0xfd2fb528;

        /// <summary>Bytes that are copied one by one: a call costs more.</summary>
        private const int Short = 32;

        // Literal lengths, offsets, match lengths, in the order of their tables.
        private static readonly int[] MaxLogs = { 9, 8, 9 };
        private static readonly int[] Codes = { 36, 32, 53 };

        private readonly ZstdCodes codes = new ZstdCodes();
        private readonly FseTable[] defaults = new FseTable[3];
        private readonly FseTable[] own = new FseTable[3];

        /// <summary>Tables in use; null before the first block with sequences.</summary>
        private readonly FseTable[] tables = new FseTable[3];
        private readonly HuffmanTable huffman = new HuffmanTable();
        private readonly byte[] block = new byte[MaxBlock + ZstdBits.Padding];
        private readonly byte[] literalBuffer = new byte[MaxBlock];

        // Literals of the block: raw ones stay where they are.
        private byte[] literals;
        private int literalStart;
        private int literalCount;
        private byte[] content;
        private int size;
        private int at;
        private int blockBegin;

        // The last three distances of matches.
        private int first;
        private int second;
        private int third;

        public ZstdDecoder()
        {
            for (int i = 0; i < 3; i++)
            {
                own[i] = new FseTable(MaxLogs[i], Codes[i]);
                defaults[i] = new FseTable(MaxLogs[i], Codes[i]);
                defaults[i].Fill(ZstdCodes.DefaultDistributions[i], ZstdCodes.DefaultLogs[i]);
            }
        }

        /// <summary>Throw <see cref="DecodeException"/> unless the bytes are one whole frame that states `size` and can hold so much.</summary>
        public static void CheckFrame(byte[] source, int offset, int count, long size)
        {
            int at = ReadHeader(source, offset, count, size, out bool hasChecksum);
            int end = offset + count;
            long room = 0;
            for (bool last = false; !last;)
            {
                if (end - at < 3) throw new DecodeException("Zstandard: the frame is truncated");
                int head = source[at] | (source[at + 1] << 8) | (source[at + 2] << 16);
                last = (head & 1) != 0;
                int kind = (head >> 1) & 3;
                int length = head >> 3;
                if (kind == 3 || length > MaxBlock) throw new DecodeException("Zstandard: a block of an unknown kind or size");
                int stored = kind == 1 ? 1 : length;
                if (stored > end - at - 3) throw new DecodeException("Zstandard: the frame is truncated");
                at += 3 + stored;
                room += kind == 2 ? MaxBlock : length;
            }
            if (at + (hasChecksum ? 4 : 0) != end) throw new DecodeException("Zstandard: the frame is truncated, or bytes follow it");
            if (room < size) throw new DecodeException("Zstandard: the blocks cannot hold the stated size");
        }

        /// <summary>Decode one frame to the first `size` bytes of `target`; the frame must state just this size.</summary>
        /// <exception cref="DecodeException">Damaged bytes, or another size. `target` is undefined then.</exception>
        public void Decode(byte[] source, int offset, int count, byte[] target, int size)
        {
            if (size < 0 || size > target.Length) throw new ArgumentOutOfRangeException(nameof(size));
            CheckFrame(source, offset, count, size);
            content = target;
            this.size = size;
            at = 0;
            first = 1;
            second = 4;
            third = 8;
            huffman.Log = 0;
            Array.Clear(tables, 0, 3);
            try
            {
                DecodeBlocks(source, ReadHeader(source, offset, count, size, out _));
            }
            finally
            {
                content = literals = null;
            }
        }

        /// <summary>Return the offset of the first block.</summary>
        private static int ReadHeader(byte[] source, int offset, int count, long size, out bool hasChecksum)
        {
            if (count < 6 || BitConverter.ToUInt32(source, offset) != Magic) throw new DecodeException("Zstandard: no frame");
            int flags = source[offset + 4];
            bool single = (flags & 0x20) != 0;
            hasChecksum = (flags & 0x04) != 0;
            if ((flags & 0x08) != 0 || (flags & 0x03) != 0) throw new DecodeException("Zstandard: reserved bits, or a dictionary");
            int sizeBytes = flags >> 6 == 0 ? (single ? 1 : 0) : 1 << (flags >> 6);
            int at = 5 + (single ? 0 : 1);
            if (sizeBytes == 0 || at + sizeBytes > count) throw new DecodeException("Zstandard: the frame does not state its size");
            ulong stated = sizeBytes == 2 ? 256u : 0u;
            for (int i = 0; i < sizeBytes; i++) stated += (ulong)source[offset + at + i] << (8 * i);
            if (stated != (ulong)size) throw new DecodeException("Zstandard: the frame states another size than is expected");
            return offset + at + sizeBytes;
        }

        private void DecodeBlocks(byte[] source, int from)
        {
            for (bool last = false; !last;)
            {
                int head = source[from] | (source[from + 1] << 8) | (source[from + 2] << 16);
                last = (head & 1) != 0;
                int kind = (head >> 1) & 3;
                int length = head >> 3;
                from += 3;
                if (kind == 2)
                {
                    Buffer.BlockCopy(source, from, block, 0, length);
                    Array.Clear(block, length, ZstdBits.Padding);
                    DecodeSequences(length);
                    from += length;
                    continue;
                }
                if (length > size - at) throw new DecodeException("Zstandard: the frame holds more than it states");
                if (kind == 0) Buffer.BlockCopy(source, from, content, at, length);
                else FillBytes(content, at, length, source[from]);
                at += length;
                from += kind == 0 ? length : 1;
            }
            if (at != size) throw new DecodeException("Zstandard: the frame holds less than it states");
        }

        private static void FillBytes(byte[] target, int from, int length, byte value)
        {
            for (int i = from; i < from + length; i++) target[i] = value;
        }

        /// <summary>Return byte `index` of the block, which ends at `end`.</summary>
        private int ByteAt(int index, int end)
        {
            if (index >= end) throw new DecodeException("Zstandard: a block is truncated");
            return block[index];
        }

        private void DecodeSequences(int end)
        {
            blockBegin = at;
            int from = ReadLiterals(end);
            int head = ByteAt(from++, end);
            int count = head;
            if (head >= 128)
            {
                if (head < 255) count = ((head - 128) << 8) + ByteAt(from++, end);
                else
                {
                    count = ByteAt(from, end) + (ByteAt(from + 1, end) << 8) + 0x7f00;
                    from += 2;
                }
            }
            if (count == 0)
            {
                if (from != end) throw new DecodeException("Zstandard: bytes after the literals of a block");
                CopyLiterals(literalStart, literalCount);
                return;
            }
            int modes = ByteAt(from++, end);
            if ((modes & 3) != 0) throw new DecodeException("Zstandard: reserved bits of sequences");
            for (int i = 0; i < 3; i++)
            {
                switch ((modes >> (6 - 2 * i)) & 3)
                {
                    case 0:
                        tables[i] = defaults[i];
                        break;
                    case 1:
                        own[i].FillSingle(ByteAt(from++, end));
                        tables[i] = own[i];
                        break;
                    case 2:
                        from = own[i].Read(block, from, end);
                        tables[i] = own[i];
                        break;
                    default:
                        if (tables[i] == null) throw new DecodeException("Zstandard: a table of a block before the first");
                        break;
                }
            }
            RunSequences(count, from, ZstdBits.CountBits(block, from, end));
        }

        private void RunSequences(int count, int start, int left)
        {
            FseTable lengths = tables[0];
            FseTable distances = tables[1];
            FseTable matches = tables[2];
            byte[] bytes = block;
            int lengthState = ZstdBits.Peek(bytes, start, left, lengths.Log);
            left -= lengths.Log;
            int distanceState = ZstdBits.Peek(bytes, start, left, distances.Log);
            left -= distances.Log;
            int matchState = ZstdBits.Peek(bytes, start, left, matches.Log);
            left -= matches.Log;
            int used = literalStart;
            int usedEnd = literalStart + literalCount;
            for (; count > 0; count--)
            {
                int distanceBits = distances.Symbols[distanceState];
                int matchCode = matches.Symbols[matchState];
                int lengthCode = lengths.Symbols[lengthState];
                long value = (1L << distanceBits) + ZstdBits.Peek(bytes, start, left, distanceBits);
                left -= distanceBits;
                int match = codes.MatchBases[matchCode];
                int bits = codes.MatchBits[matchCode];
                if (bits > 0)
                {
                    match += ZstdBits.Peek(bytes, start, left, bits);
                    left -= bits;
                }
                int length = codes.LengthBases[lengthCode];
                bits = codes.LengthBits[lengthCode];
                if (bits > 0)
                {
                    length += ZstdBits.Peek(bytes, start, left, bits);
                    left -= bits;
                }
                if (count > 1)
                {
                    bits = lengths.Bits[lengthState];
                    lengthState = lengths.Bases[lengthState] + ZstdBits.Peek(bytes, start, left, bits);
                    left -= bits;
                    bits = matches.Bits[matchState];
                    matchState = matches.Bases[matchState] + ZstdBits.Peek(bytes, start, left, bits);
                    left -= bits;
                    bits = distances.Bits[distanceState];
                    distanceState = distances.Bases[distanceState] + ZstdBits.Peek(bytes, start, left, bits);
                    left -= bits;
                }
                if (left < 0) throw new DecodeException("Zstandard: sequences are truncated");
                if (length > usedEnd - used) throw new DecodeException("Zstandard: sequences of more literals than there are");
                CopyLiterals(used, length);
                used += length;
                CopyMatch(ResolveOffset(value, length), match);
            }
            if (left != 0) throw new DecodeException("Zstandard: bits are left after the sequences");
            CopyLiterals(used, usedEnd - used);
        }

        /// <summary>Return the distance of a match: a new one, or one of the last three.</summary>
        private int ResolveOffset(long value, int literalLength)
        {
            if (value > 3)
            {
                third = second;
                second = first;
                first = (int)Math.Min(value - 3, int.MaxValue); // beyond every frame
                return first;
            }
            int i = (int)value - 1 + (literalLength == 0 ? 1 : 0);
            if (i == 0) return first;
            int distance = i == 1 ? second : i == 2 ? third : first - 1;
            if (i > 1) third = second;
            second = first;
            first = distance;
            if (distance == 0) throw new DecodeException("Zstandard: a match at no distance");
            return distance;
        }

        private void CopyLiterals(int from, int length)
        {
            CheckRoom(length);
            byte[] target = content;
            if (length > Short) Buffer.BlockCopy(literals, from, target, at, length);
            else
            {
                byte[] source = literals;
                for (int i = 0, to = at; i < length; i++) target[to + i] = source[from + i];
            }
            at += length;
        }

        private void CopyMatch(int distance, int length)
        {
            CheckRoom(length);
            if (distance > at) throw new DecodeException("Zstandard: a match before the beginning");
            byte[] target = content;
            int to = at;
            int from = at - distance;
            at += length;
            if (length <= Short)
            {
                for (int i = 0; i < length; i++) target[to + i] = target[from + i];
                return;
            }
            // Where a match overlaps itself, what has been copied doubles the piece that can be copied next.
            while (length > 0)
            {
                int piece = Math.Min(length, to - from);
                Buffer.BlockCopy(target, from, target, to, piece);
                to += piece;
                length -= piece;
            }
        }

        private void CheckRoom(int length)
        {
            if (length > size - at || at + length - blockBegin > MaxBlock) throw new DecodeException("Zstandard: the frame holds more than it states");
        }

        /// <summary>Read the literals of the block. Returns where the sequences begin.</summary>
        private int ReadLiterals(int end)
        {
            int head = ByteAt(0, end);
            int kind = head & 3;
            int format = (head >> 2) & 3;
            bool packed = kind >= 2;
            int headBytes = packed ? (format < 2 ? 3 : format + 2) : (format == 1 ? 2 : format == 3 ? 3 : 1);
            long value = 0;
            for (int i = headBytes - 1; i >= 0; i--) value = (value << 8) | (long)ByteAt(i, end);
            literals = literalBuffer;
            literalStart = 0;
            if (!packed) return ReadPlainLiterals(kind, (int)(value >> (format % 2 == 0 ? 3 : 4)), headBytes, end);
            int sizeBits = format < 2 ? 10 : format == 2 ? 14 : 18;
            literalCount = (int)(value >> 4) & ((1 << sizeBits) - 1);
            int stored = (int)(value >> (4 + sizeBits));
            CheckLiterals();
            if (stored > end - headBytes) throw new DecodeException("Zstandard: literals are truncated");
            int from = headBytes;
            int next = headBytes + stored;
            if (kind == 2) from = huffman.Read(block, from, next);
            if (huffman.Log == 0) throw new DecodeException("Zstandard: a Huffman table of a block before the first");
            if (format == 0) huffman.ReadStream(block, from, next, literalBuffer, 0, literalCount);
            else ReadFourStreams(from, next);
            return next;
        }

        /// <summary>Read literals that are stored as they are (kind 0), or one that is repeated (kind 1).</summary>
        private int ReadPlainLiterals(int kind, int count, int from, int end)
        {
            literalCount = count;
            CheckLiterals();
            int stored = kind == 0 ? count : 1;
            if (stored > end - from) throw new DecodeException("Zstandard: literals are truncated");
            if (kind == 0)
            {
                literals = block;
                literalStart = from;
            }
            else FillBytes(literalBuffer, 0, count, block[from]);
            return from + stored;
        }

        private void CheckLiterals()
        {
            if (literalCount > MaxBlock || literalCount > size - at) throw new DecodeException("Zstandard: more literals than the frame can hold");
        }

        private void ReadFourStreams(int start, int end)
        {
            int from = start + 6;
            if (from > end) throw new DecodeException("Zstandard: literals are truncated");
            int part = (literalCount + 3) >> 2;
            if (3 * part > literalCount) throw new DecodeException("Zstandard: four streams of too few literals");
            for (int i = 0; i < 4; i++)
            {
                int to = i == 3 ? end : from + (block[start + 2 * i] | (block[start + 2 * i + 1] << 8));
                if (to > end) throw new DecodeException("Zstandard: literals are truncated");
                huffman.ReadStream(block, from, to, literalBuffer, i * part, i == 3 ? literalCount - 3 * part : part);
                from = to;
            }
        }
    }
}
