"""The part of the generated C# that does not depend on the messages: a MessagePack reader."""

from __future__ import annotations

from typing import Final

READER: Final = r"""
/// <summary>The bytes are not MessagePack, or not a message of the schema.</summary>
public sealed class WireException : Exception
{
    public WireException(string text) : base(text) { }
}

/// <summary>Reads MessagePack from a byte array. Throws WireException for all but what was asked for.</summary>
public sealed class WireReader
{
    byte[] data = new byte[0];
    int end;

    /// <summary>Index of the next byte.</summary>
    public int Position;

    public WireReader() { }
    public WireReader(byte[] bytes) { Reset(bytes, 0, bytes.Length); }

    /// <summary>Reads from now on bytes[offset .. offset + count), without a copy.</summary>
    public void Reset(byte[] bytes, int offset, int count)
    {
        if (offset < 0 || count < 0 || offset > bytes.Length - count) throw new ArgumentOutOfRangeException("count");
        data = bytes;
        Position = offset;
        end = offset + count;
    }

    /// <summary>Throws unless everything was read.</summary>
    public void ExpectEnd()
    {
        if (Position != end) throw new WireException((end - Position) + " bytes after the message");
    }

    byte Next()
    {
        if (Position >= end) throw new WireException("the message is truncated");
        return data[Position++];
    }

    int Take(long count)
    {
        if (count > end - Position) throw new WireException("the message is truncated");
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

    static WireException Unexpected(string wanted, byte code)
    {
        return new WireException("expected " + wanted + ", found MessagePack type 0x" + code.ToString("x2"));
    }

    /// <summary>Consumes a nil, if the next value is one.</summary>
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

    public double ReadDouble()
    {
        byte code = Next();
        if (code == 0xcb) return BitConverter.Int64BitsToDouble((long)Big(8));
        if (code == 0xca)
        {
            byte[] single = BitConverter.GetBytes((uint)Big(4));
            return BitConverter.ToSingle(single, 0);
        }
        Position--;
        return ReadLong();
    }

    public string ReadString()
    {
        byte code = Next();
        long count;
        if ((code & 0xe0) == 0xa0) count = code & 0x1f;
        else if (code == 0xd9) count = (long)Big(1);
        else if (code == 0xda) count = (long)Big(2);
        else if (code == 0xdb) count = (long)Big(4);
        else throw Unexpected("a string", code);
        int start = Take(count);
        try { return Utf8.GetString(data, start, (int)count); }
        catch (ArgumentException) { throw new WireException("a string that is not UTF-8"); }
    }

    static readonly Encoding Utf8 = new UTF8Encoding(false, true);

    public byte[] ReadBytes()
    {
        byte code = Next();
        if (code < 0xc4 || code > 0xc6) throw Unexpected("bytes", code);
        long count = (long)Big(1 << (code - 0xc4));
        int start = Take(count);
        byte[] value = new byte[count];
        Buffer.BlockCopy(data, start, value, 0, (int)count);
        return value;
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
        if (count * bytesEach > end - Position) throw new WireException("the message is truncated");
        return (int)count;
    }

    /// <summary>Passes over one value of any type, without recursion.</summary>
    public void Skip()
    {
        for (long left = 1; left > 0; left--)
        {
            byte code = Next();
            if (code < 0x80 || code >= 0xe0) continue;
            if (code < 0x90) { left += 2 * (code & 0x0f); continue; }
            if (code < 0xa0) { left += code & 0x0f; continue; }
            if (code < 0xc0) { Take(code & 0x1f); continue; }
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
                case 0xdc: left += (long)Big(2); break;
                case 0xdd: left += (long)Big(4); break;
                case 0xde: left += 2 * (long)Big(2); break;
                case 0xdf: left += 2 * (long)Big(4); break;
                default: throw Unexpected("a value", code);
            }
        }
    }

    /// <summary>Numbers; length 0: any number of them.</summary>
    public double[] ReadDoubles(int length)
    {
        int n = ReadArrayHeader();
        if (length != 0 && n != length) throw new WireException("expected " + length + " numbers, found " + n);
        double[] values = new double[n];
        for (int i = 0; i < n; i++) values[i] = ReadDouble();
        return values;
    }

    public long[] ReadLongs()
    {
        long[] values = new long[ReadArrayHeader()];
        for (int i = 0; i < values.Length; i++) values[i] = ReadLong();
        return values;
    }

    public string[] ReadStrings()
    {
        string[] values = new string[ReadArrayHeader()];
        for (int i = 0; i < values.Length; i++) values[i] = ReadString();
        return values;
    }

    public T[] ReadArray<T>(Func<WireReader, T> read)
    {
        T[] values = new T[ReadArrayHeader()];
        for (int i = 0; i < values.Length; i++) values[i] = read(this);
        return values;
    }

    public Dictionary<string, long> ReadCounts()
    {
        Dictionary<string, long> values = new Dictionary<string, long>();
        for (int n = ReadMapHeader(); n > 0; n--)
        {
            string key = ReadString();
            values[key] = ReadLong();
        }
        return values;
    }

    /// <summary>Value of a key of the map that comes next, which is not consumed.</summary>
    public string PeekTag(string key)
    {
        int start = Position;
        for (int n = ReadMapHeader(); n > 0; n--)
        {
            if (ReadString() == key)
            {
                string tag = ReadString();
                Position = start;
                return tag;
            }
            Skip();
        }
        throw new WireException("missing field " + key);
    }
}
"""
