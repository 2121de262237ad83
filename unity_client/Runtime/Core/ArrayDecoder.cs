// Bytes of assets with the encoding `arrays`. docs/scene.md is normative. What an asset asks for is checked before it is allocated.
using System;
using System.Collections.Generic;
using IrisSession.Protocol;

namespace IrisSession.Core
{
    /// <summary>Decodes assets. Not for several threads at once.</summary>
    public sealed class ArrayDecoder
    {
        /// <summary>Most bytes of the arrays of an asset.</summary>
        public const long MaxBytes = 1L << 30;
        private const int MaxHeaderBytes = 16384;
        private const int PrefixBytes = 8;

        private readonly WireReader reader = new WireReader();
        private readonly Inflater inflater = new Inflater();

        /// <summary>Decode an asset; quantised arrays become floats.</summary>
        /// <param name="data">The bytes of the asset.</param>
        /// <param name="maxBytes">Limit of all decoded arrays together.</param>
        /// <exception cref="DecodeException">It must be refused.</exception>
        public ArrayAsset Decode(byte[] data, long maxBytes = MaxBytes)
        {
            ArrayHeader header = ReadHeader(data, out int at);
            long total = 0;
            foreach (ArrayInfo info in header.Arrays)
            {
                long size = CountBytes(info);
                if (info.Scale.Length > 0) size = 4 * (size / ItemBytes(info));
                total += size;
                if (total > maxBytes) throw new DecodeException("arrays of more than " + maxBytes + " bytes");
            }
            Dictionary<string, DecodedArray> arrays = new Dictionary<string, DecodedArray>();
            foreach (ArrayInfo info in header.Arrays)
            {
                int length = (int)info.Bytes;
                if (arrays.ContainsKey(info.Name)) throw new DecodeException("two arrays of the name " + info.Name);
                Array stored = DecodeArray(info, data, at, length);
                int[] shape = Array.ConvertAll(info.Shape, n => (int)n);
                arrays[info.Name] = new DecodedArray(info.Name, shape, ApplyScale(info, stored));
                at += length;
            }
            return new ArrayAsset(header.Kind, header.MaxError, arrays);
        }

        private ArrayHeader ReadHeader(byte[] data, out int start)
        {
            if (data.Length < PrefixBytes) throw new DecodeException(data.Length + " bytes are no asset of arrays");
            for (int i = 0; i < Wire.ArraysMagic.Length; i++)
            {
                if (data[i] != Wire.ArraysMagic[i]) throw new DecodeException("no asset of arrays: it does not begin with " + Wire.ArraysMagic);
            }
            uint length = BitConverter.ToUInt32(data, 4);
            if (length > MaxHeaderBytes || length > data.Length - PrefixBytes) throw new DecodeException("a header of " + length + " bytes in an asset of " + data.Length);
            start = PrefixBytes + (int)length;
            ArrayHeader header;
            try
            {
                reader.Reset(data, PrefixBytes, (int)length);
                header = ArrayHeader.Read(reader);
                reader.ExpectEnd();
            }
            catch (WireException error)
            {
                throw new DecodeException("header of arrays: " + error.Message, error);
            }
            long left = data.Length - start;
            foreach (ArrayInfo info in header.Arrays)
            {
                if (info.Bytes > left) throw new DecodeException("the lengths in the header are not those of the asset");
                left -= info.Bytes;
            }
            if (left != 0) throw new DecodeException("the lengths in the header are not those of the asset");
            return header;
        }

        private static int ItemBytes(ArrayInfo info)
        {
            switch (info.Dtype)
            {
                case "u1":
                case "i1":
                    return 1;
                case "u2":
                    return 2;
                case "u4":
                case "f4":
                    return 4;
                default:
                    throw new DecodeException("unknown dtype " + info.Dtype);
            }
        }

        /// <summary>Return the bytes of an array, at most `MaxBytes`.</summary>
        private static long CountBytes(ArrayInfo info)
        {
            if (info.Shape.Length == 0) throw new DecodeException("the array " + info.Name + " has no shape");
            bool isEmpty = false;
            foreach (long n in info.Shape)
            {
                if (n > MaxBytes) throw new DecodeException("the array " + info.Name + " has " + n + " entries along an axis");
                isEmpty |= n == 0;
            }
            long size = ItemBytes(info);
            foreach (long n in info.Shape)
            {
                if (isEmpty) return 0;
                if (size > MaxBytes / n) throw new DecodeException("the array " + info.Name + " has more than " + MaxBytes + " bytes");
                size *= n;
            }
            return size;
        }

        private Array DecodeArray(ArrayInfo info, byte[] data, int at, int length)
        {
            if (info.Filter != "none" && info.Filter != "shuffle" && info.Filter != "delta" && info.Filter != "up") throw new DecodeException("unknown filter " + info.Filter);
            if (info.Filter == "delta" && info.Dtype == "f4") throw new DecodeException("differences of float32 are not exact");
            int size = (int)CountBytes(info);
            byte[] plain = Decompress(info, data, at, length, size);
            if (info.Filter == "up" && size > 0)
            {
                int row = size / (int)info.Shape[0];
                for (int i = row; i < size; i++) plain[i] = unchecked((byte)(plain[i] + plain[i - row]));
            }
            else if (info.Filter == "shuffle" || info.Filter == "delta") plain = Unshuffle(plain, ItemBytes(info));
            Array values = ToItems(info.Dtype, plain);
            if (info.Filter == "delta") Accumulate(info.Dtype, values);
            return values;
        }

        private byte[] Decompress(ArrayInfo info, byte[] data, int at, int length, int size)
        {
            byte[] plain;
            switch (info.Codec)
            {
                case "none":
                    if (length != size) throw new DecodeException("the array " + info.Name + " has " + length + " bytes, its shape and dtype need " + size);
                    plain = new byte[size];
                    Buffer.BlockCopy(data, at, plain, 0, size);
                    return plain;
                case "deflate":
                    Inflater.CheckSize(length, size);
                    plain = new byte[size];
                    inflater.Inflate(data, at, length, plain, size);
                    return plain;
                default:
                    throw new DecodeException("unknown compression " + info.Codec);
            }
        }

        /// <summary>Return elements of `item` bytes from their first bytes, their second bytes, and so on.</summary>
        private static byte[] Unshuffle(byte[] planes, int item)
        {
            if (item == 1) return planes;
            int count = planes.Length / item;
            byte[] plain = new byte[planes.Length];
            for (int k = 0; k < item; k++)
            {
                for (int i = 0, from = k * count, to = k; i < count; i++, from++, to += item) plain[to] = planes[from];
            }
            return plain;
        }

        /// <summary>Return bytes as elements. Every machine that Unity runs on is little-endian.</summary>
        private static Array ToItems(string dtype, byte[] bytes)
        {
            Array items;
            switch (dtype)
            {
                case "u1":
                    return bytes;
                case "i1":
                    items = new sbyte[bytes.Length];
                    break;
                case "u2":
                    items = new ushort[bytes.Length / 2];
                    break;
                case "u4":
                    items = new uint[bytes.Length / 4];
                    break;
                default:
                    items = new float[bytes.Length / 4];
                    break;
            }
            Buffer.BlockCopy(bytes, 0, items, 0, bytes.Length);
            return items;
        }

        /// <summary>Turn differences into values, in place. Sums wrap.</summary>
        private static void Accumulate(string dtype, Array values)
        {
            unchecked
            {
                switch (dtype)
                {
                    case "u1":
                        byte[] u1 = (byte[])values;
                        for (int i = 1; i < u1.Length; i++) u1[i] += u1[i - 1];
                        break;
                    case "i1":
                        sbyte[] i1 = (sbyte[])values;
                        for (int i = 1; i < i1.Length; i++) i1[i] += i1[i - 1];
                        break;
                    case "u2":
                        ushort[] u2 = (ushort[])values;
                        for (int i = 1; i < u2.Length; i++) u2[i] += u2[i - 1];
                        break;
                    default:
                        uint[] u4 = (uint[])values;
                        for (int i = 1; i < u4.Length; i++) u4[i] += u4[i - 1];
                        break;
                }
            }
        }

        private static Array ApplyScale(ArrayInfo info, Array stored)
        {
            if (info.Scale.Length == 0) return stored;
            long last = info.Shape[info.Shape.Length - 1];
            if (info.Scale.Length != last || info.Offset.Length != last) throw new DecodeException("the array " + info.Name + ": scale and offset need " + last + " values each");
            float[] scale = ToFloats(info, info.Scale);
            float[] offset = ToFloats(info, info.Offset);
            float[] values = new float[stored.Length];
            for (int i = 0, k = 0; i < values.Length; i++, k = k + 1 == last ? 0 : k + 1)
            {
                float product = (float)(ItemAt(info.Dtype, stored, i) * scale[k]);
                values[i] = product + offset[k];
            }
            return values;
        }

        private static double ItemAt(string dtype, Array stored, int index)
        {
            switch (dtype)
            {
                case "u1":
                    return ((byte[])stored)[index];
                case "i1":
                    return ((sbyte[])stored)[index];
                case "u2":
                    return ((ushort[])stored)[index];
                case "u4":
                    return ((uint[])stored)[index];
                default:
                    return ((float[])stored)[index];
            }
        }

        private static float[] ToFloats(ArrayInfo info, double[] values)
        {
            float[] floats = new float[values.Length];
            for (int i = 0; i < floats.Length; i++)
            {
                if (double.IsNaN(values[i]) || double.IsInfinity(values[i])) throw new DecodeException("the array " + info.Name + ": scale and offset are not finite");
                floats[i] = (float)values[i];
            }
            return floats;
        }
    }
}
