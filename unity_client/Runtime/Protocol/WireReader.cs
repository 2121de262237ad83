// Reads MessagePack, and messages from it. Strict: docs/protocol.md, section 3.
using System;
using System.Collections.Generic;
using System.Text;

namespace IrisSession.Protocol
{
    /// <summary>Reads MessagePack from a byte array. Throws WireException for all but what was asked for.</summary>
    public sealed class WireReader : WireCodec
    {
        const int KnownStrings = 256, KnownLength = 40, MaxDepth = 256;
        static readonly Encoding Utf8 = new UTF8Encoding(false, true);

        enum Mode { Map, Array, Defaults }

        readonly string[] known = new string[KnownStrings];
        readonly long[] open = new long[MaxDepth]; // values left in the arrays and maps around the one that is skipped
        byte[] data = Array.Empty<byte>();
        int end;

        // Of the map or array that is being read. The fields of a map are visited again and again, from the first to the
        // last, until all entries are used: in the order of the wire once suffices.
        Mode mode;
        int left; // entries or elements
        int index; // of the field that comes next
        ulong seen; // one bit for each field of a map that was there
        int keyStart, keyLength; // of the present entry
        bool isPending; // the value of the present entry is being read

        /// <summary>Index of the next byte.</summary>
        public int Position;

        public WireReader() { }
        public WireReader(byte[] bytes) { Reset(bytes, 0, bytes.Length); }

        /// <summary>Read from now on bytes[offset .. offset + count), without a copy.</summary>
        public void Reset(byte[] bytes, int offset, int count)
        {
            if (offset < 0 || count < 0 || offset > bytes.Length - count) throw new ArgumentOutOfRangeException(nameof(count));
            data = bytes;
            Position = offset;
            end = offset + count;
        }

        /// <summary>Throw unless everything was read.</summary>
        public void ExpectEnd()
        {
            if (Position != end) throw new WireException((end - Position) + " bytes after the message");
        }

        /// <summary>Read into a message that exists, and return it. Its strings, arrays and parts are used again where they
        /// fit; what the bytes leave out gets its default. After an exception its fields are a mixture.</summary>
        public T ReadInto<T>(T value) where T : WireValue
        {
            ReadFields(value);
            return value;
        }

        internal void ReadFields(WireValue value)
        {
            Mode outerMode = mode;
            int outerLeft = left, outerIndex = index;
            ulong outerSeen = seen;
            bool outerPending = isPending;
            index = 0;
            isPending = false;
            if (value.IsArray)
            {
                left = ReadArrayHeader();
                mode = Mode.Array;
                value.Visit(this);
                for (; left > 0; left--) Skip();
            }
            else
            {
                left = ReadMapHeader();
                ReadEntries(value);
            }
            mode = outerMode;
            left = outerLeft;
            index = outerIndex;
            seen = outerSeen;
            isPending = outerPending;
        }

        void ReadEntries(WireValue value)
        {
            mode = Mode.Map;
            seen = 0;
            if (left > 0) ReadKey();
            while (left > 0)
            {
                if (value.TagField != null && IsKey(value.TagField))
                {
                    if (ReadString(value.Tag, 0) != value.Tag) throw new WireException("another " + value.TagField + " than " + value.Tag);
                    EndEntry();
                    continue;
                }
                int before = left;
                index = 0;
                value.Visit(this);
                if (isPending) EndEntry();
                if (left != before) continue;
                Skip(); // no field has this key
                EndEntry();
            }
            if (index != 0 && seen == ulong.MaxValue >> (64 - index)) return; // all fields were visited and there
            mode = Mode.Defaults;
            index = 0;
            value.Visit(this);
        }

        internal Step BeginField(string key, bool required)
        {
            if (mode == Mode.Map)
            {
                if (isPending) EndEntry();
                int field = index++;
                if (left == 0 || !IsKey(key)) return Step.Pass;
                seen |= 1UL << field;
                isPending = true;
                return Step.Read;
            }
            if (mode == Mode.Array ? left > 0 : (seen >> index++ & 1) != 0)
            {
                if (mode == Mode.Defaults) return Step.Pass;
                left--;
                return Step.Read;
            }
            if (required) throw new WireException("missing field " + key);
            return Step.Default;
        }

        internal void SetDefaults(WireValue value)
        {
            Mode outerMode = mode;
            int outerLeft = left, outerIndex = index;
            ulong outerSeen = seen;
            mode = Mode.Defaults;
            left = 0;
            index = 0;
            seen = 0;
            value.Visit(this);
            mode = outerMode;
            left = outerLeft;
            index = outerIndex;
            seen = outerSeen;
        }

        void ReadKey()
        {
            keyLength = ReadStringHeader();
            keyStart = Take(keyLength);
        }

        void EndEntry()
        {
            isPending = false;
            if (--left > 0) ReadKey();
        }

        bool IsKey(string key)
        {
            return keyLength == key.Length && IsAscii(key, keyStart);
        }

        bool IsAscii(string text, int start)
        {
            for (int i = 0; i < text.Length; i++)
            {
                byte unit = data[start + i];
                if (unit != text[i] || unit >= 0x80) return false;
            }
            return true;
        }

        internal T ReadUnion<T>(T value, UnionMaker<T> maker) where T : WireValue
        {
            string tag = PeekTag(maker.TagField);
            if (value == null || value.Tag != tag) value = maker.Make(tag);
            if (value == null) throw new WireException("unknown " + maker.TagField + " " + tag);
            ReadFields(value);
            return value;
        }

        /// <summary>Value of a key of the map that comes next, which is not consumed.</summary>
        string PeekTag(string key)
        {
            int start = Position;
            for (int n = ReadMapHeader(); n > 0; n--)
            {
                int length = ReadStringHeader();
                int at = Take(length);
                if (length == key.Length && IsAscii(key, at))
                {
                    string tag = ReadString(null, 0);
                    Position = start;
                    return tag;
                }
                Skip();
            }
            throw new WireException("missing field " + key);
        }

        byte Next()
        {
            if (Position >= end) throw Truncated();
            return data[Position++];
        }

        int Take(long count)
        {
            if (count > end - Position) throw Truncated();
            int start = Position;
            Position += (int)count;
            return start;
        }

        ulong Big(int bytes)
        {
            int start = Take(bytes);
            ulong value = 0;
            for (int i = 0; i < bytes; i++) value = value << 8 | data[start + i];
            return value;
        }

        static WireException Truncated() { return new WireException("the message is truncated"); }

        static WireException Unexpected(string wanted, byte code)
        {
            return new WireException("expected " + wanted + ", found MessagePack type 0x" + code.ToString("x2"));
        }

        /// <summary>Consume a nil, if the next value is one.</summary>
        public bool TryReadNil()
        {
            if (Position >= end || data[Position] != 0xc0) return false;
            Position++;
            return true;
        }

        public bool ReadBool()
        {
            byte code = Next();
            if (code == 0xc2) return false;
            if (code == 0xc3) return true;
            throw Unexpected("a bool", code);
        }

        public long ReadLong()
        {
            byte code = Next();
            if (code < 0x80) return code;
            if (code >= 0xe0) return (sbyte)code;
            switch (code)
            {
                case 0xcc: return (long)Big(1);
                case 0xcd: return (long)Big(2);
                case 0xce: return (long)Big(4);
                case 0xcf:
                    ulong value = Big(8);
                    if (value > long.MaxValue) throw new WireException("an integer above int64");
                    return (long)value;
                case 0xd0: return (sbyte)Big(1);
                case 0xd1: return (short)Big(2);
                case 0xd2: return (int)Big(4);
                case 0xd3: return (long)Big(8);
            }
            throw Unexpected("an integer", code);
        }

        /// <summary>An integer from low to high.</summary>
        public long ReadLong(long low, long high)
        {
            long value = ReadLong();
            if (value < low || value > high) throw new WireException(value + " is not from " + low + " to " + high);
            return value;
        }

        public double ReadDouble()
        {
            byte code = Next();
            if (code == 0xcb) return BitConverter.Int64BitsToDouble((long)Big(8));
            if (code == 0xca) return BitConverter.Int32BitsToSingle((int)Big(4));
            if (code == 0xcf) return Big(8); // also above int64
            Position--;
            return ReadLong();
        }

        int ReadStringHeader()
        {
            byte code = Next();
            long count;
            if ((code & 0xe0) == 0xa0) count = code & 0x1f;
            else if (code == 0xd9) count = (long)Big(1);
            else if (code == 0xda) count = (long)Big(2);
            else if (code == 0xdb) count = (long)Big(4);
            else throw Unexpected("a string", code);
            if (count > end - Position) throw Truncated();
            return (int)count;
        }

        public string ReadString() { return ReadString(null, 0); }

        /// <summary>A string of at most so many characters (code points; 0: any number). The one given if it is the same.</summary>
        internal string ReadString(string present, int most)
        {
            int count = ReadStringHeader(), start = Take(count);
            if (present == null || present.Length != count || !IsAscii(present, start)) present = FindString(start, count);
            if (most == 0 || count <= most) return present;
            int characters = 0;
            foreach (char unit in present) if (!char.IsLowSurrogate(unit)) characters++;
            if (characters > most) throw new WireException("a string of more than " + most + " characters");
            return present;
        }

        // Names and values of enumerations come again and again: those of late are kept.
        string FindString(int start, int count)
        {
            if (count == 0) return "";
            if (count > KnownLength) return Decode(start, count);
            uint hash = 2166136261;
            for (int i = start; i < start + count; i++) hash = (hash ^ data[i]) * 16777619;
            ref string kept = ref known[(hash ^ hash >> 16) % KnownStrings];
            if (kept == null || kept.Length != count || !IsAscii(kept, start)) kept = Decode(start, count);
            return kept;
        }

        string Decode(int start, int count)
        {
            try { return Utf8.GetString(data, start, count); }
            catch (ArgumentException) { throw new WireException("a string that is not UTF-8"); }
        }

        /// <summary>At most so many bytes (0: any number), in the array given if it has their length.</summary>
        internal byte[] ReadBytes(byte[] present, int most)
        {
            byte code = Next();
            if (code < 0xc4 || code > 0xc6) throw Unexpected("bytes", code);
            long count = (long)Big(1 << (code - 0xc4));
            if (most != 0 && count > most) throw new WireException("more than " + most + " bytes");
            int start = Take(count);
            present = present != null && present.Length == count ? present : count == 0 ? Array.Empty<byte>() : new byte[count];
            Buffer.BlockCopy(data, start, present, 0, (int)count);
            return present;
        }

        public int ReadArrayHeader()
        {
            byte code = Next();
            if ((code & 0xf0) == 0x90) return Count(code & 0x0f, 1);
            if (code == 0xdc) return Count((long)Big(2), 1);
            if (code == 0xdd) return Count((long)Big(4), 1);
            throw Unexpected("an array", code);
        }

        public int ReadMapHeader()
        {
            byte code = Next();
            if ((code & 0xf0) == 0x80) return Count(code & 0x0f, 2);
            if (code == 0xde) return Count((long)Big(2), 2);
            if (code == 0xdf) return Count((long)Big(4), 2);
            throw Unexpected("a map", code);
        }

        // Every element takes a byte at least: a length that cannot be true is refused before anything is allocated.
        int Count(long count, int bytesEach)
        {
            if (count * bytesEach > end - Position) throw Truncated();
            return (int)count;
        }

        /// <summary>Pass over one value of any type, without recursion.</summary>
        public void Skip()
        {
            int depth = 0;
            for (long inner = 1; ;)
            {
                while (inner == 0)
                {
                    if (depth == 0) return;
                    inner = open[--depth];
                }
                inner--;
                byte code = Next();
                long items = CountItems(code);
                if (items == 0) continue;
                if (depth == MaxDepth) throw new WireException("more than " + MaxDepth + " levels of nesting");
                open[depth++] = inner;
                inner = items;
            }
        }

        // Number of values in an array or map; anything else is passed over.
        long CountItems(byte code)
        {
            if (code < 0x80 || code >= 0xe0) return 0;
            if (code < 0x90) return 2 * (code & 0x0f);
            if (code < 0xa0) return code & 0x0f;
            if (code < 0xc0) { Take(code & 0x1f); return 0; }
            switch (code)
            {
                case 0xc0: case 0xc2: case 0xc3: break;
                case 0xc4: case 0xd9: Take((long)Big(1)); break;
                case 0xc5: case 0xda: Take((long)Big(2)); break;
                case 0xc6: case 0xdb: Take((long)Big(4)); break;
                case 0xc7: Take((long)Big(1) + 1); break;
                case 0xc8: Take((long)Big(2) + 1); break;
                case 0xc9: Take((long)Big(4) + 1); break;
                case 0xcc: case 0xd0: Take(1); break;
                case 0xcd: case 0xd1: case 0xd4: Take(2); break;
                case 0xca: case 0xce: case 0xd2: Take(4); break;
                case 0xcb: case 0xcf: case 0xd3: Take(8); break;
                case 0xd5: Take(3); break;
                case 0xd6: Take(5); break;
                case 0xd7: Take(9); break;
                case 0xd8: Take(17); break;
                case 0xdc: return (long)Big(2);
                case 0xdd: return (long)Big(4);
                case 0xde: return 2 * (long)Big(2);
                case 0xdf: return 2 * (long)Big(4);
                default: throw Unexpected("a value", code);
            }
            return 0;
        }

        // Of arrays: at least and at most so many elements; most 0: any number. In the array given if it has that length.

        internal double[] ReadDoubles(double[] values, int least, int most)
        {
            values = Fit(values, ReadLength(least, most));
            for (int i = 0; i < values.Length; i++) values[i] = ReadDouble();
            return values;
        }

        internal long[] ReadLongs(long[] values, int least, int most, long low, long high)
        {
            values = Fit(values, ReadLength(least, most));
            for (int i = 0; i < values.Length; i++) values[i] = ReadLong(low, high);
            return values;
        }

        internal string[] ReadStrings(string[] values, int least, int most, int characters)
        {
            values = Fit(values, ReadLength(least, most));
            for (int i = 0; i < values.Length; i++) values[i] = ReadString(values[i], characters);
            return values;
        }

        internal int ReadLength(int least, int most)
        {
            int n = ReadArrayHeader();
            if (n < least || most != 0 && n > most) throw new WireException("expected " + least + " to " + most + " elements, found " + n);
            return n;
        }

        internal void ReadCounts(Dictionary<string, long> values)
        {
            values.Clear();
            for (int n = ReadMapHeader(); n > 0; n--)
            {
                string key = ReadString();
                values[key] = ReadLong();
            }
        }
    }
}
