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

    /// <summary>A string of at most so many characters (code points); 0: of any length.</summary>
    public string ReadString(int most)
    {
        string value = ReadString();
        if (most == 0 || value.Length <= most) return value;
        int pairs = 0;
        foreach (char unit in value) if (char.IsLowSurrogate(unit)) pairs++;
        if (value.Length - pairs > most) throw new WireException("a string of more than " + most + " characters");
        return value;
    }

    /// <summary>The address of an asset: 64 digits 0-9, a-f.</summary>
    public string ReadAddress()
    {
        string value = ReadString();
        bool good = value.Length == 64;
        foreach (char unit in value) good &= unit >= '0' && unit <= '9' || unit >= 'a' && unit <= 'f';
        if (!good) throw new WireException("a string that is no address");
        return value;
    }

    static readonly Encoding Utf8 = new UTF8Encoding(false, true);

    /// <summary>At most so many bytes; 0: any number.</summary>
    public byte[] ReadBytes(int most)
    {
        byte code = Next();
        if (code < 0xc4 || code > 0xc6) throw Unexpected("bytes", code);
        long count = (long)Big(1 << (code - 0xc4));
        if (most != 0 && count > most) throw new WireException("more than " + most + " bytes");
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

    // Of arrays: exactly length elements, and at most so many; 0: any number.

    public double[] ReadDoubles(int length, int most)
    {
        double[] values = new double[ReadLength(length, most)];
        for (int i = 0; i < values.Length; i++) values[i] = ReadDouble();
        return values;
    }

    public long[] ReadLongs(int length, int most, long low, long high)
    {
        long[] values = new long[ReadLength(length, most)];
        for (int i = 0; i < values.Length; i++) values[i] = ReadLong(low, high);
        return values;
    }

    public string[] ReadStrings(int most, int characters)
    {
        string[] values = new string[ReadLength(0, most)];
        for (int i = 0; i < values.Length; i++) values[i] = ReadString(characters);
        return values;
    }

    public T[] ReadArray<T>(Func<WireReader, T> read, int most)
    {
        T[] values = new T[ReadLength(0, most)];
        for (int i = 0; i < values.Length; i++) values[i] = read(this);
        return values;
    }

    int ReadLength(int length, int most)
    {
        int n = ReadArrayHeader();
        if (length != 0 && n != length) throw new WireException("expected " + length + " elements, found " + n);
        if (most != 0 && n > most) throw new WireException("at most " + most + " elements, found " + n);
        return n;
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
