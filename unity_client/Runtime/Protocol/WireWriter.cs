// Writes MessagePack, and messages to it, with the same bytes as the encoder of the session.
using System;
using System.Collections.Generic;
using System.Text;

namespace IrisSession.Protocol
{
    /// <summary>Writes MessagePack in its shortest form. The buffer is kept from message to message.</summary>
    public sealed class WireWriter : WireCodec
    {
        byte[] data = new byte[256];
        int fields; // written of the map or array that is being written
        bool isArray;

        /// <summary>Bytes written since Clear.</summary>
        public int Length { get; private set; }

        /// <summary>The bytes, of which the first Length are valid until the next call.</summary>
        public byte[] Data => data;

        public void Clear() { Length = 0; }

        public byte[] ToArray()
        {
            byte[] copy = new byte[Length];
            Buffer.BlockCopy(data, 0, copy, 0, Length);
            return copy;
        }

        /// <summary>A message, or nil for null.</summary>
        public void Write(WireValue value)
        {
            if (value == null) WriteNil();
            else WriteFields(value);
        }

        internal void WriteFields(WireValue value)
        {
            int outerFields = fields;
            bool outerIsArray = isArray;
            int header = Room(1);
            fields = 0;
            isArray = value.IsArray;
            if (value.TagField != null)
            {
                BeginField(value.TagField);
                Write(value.Tag);
            }
            value.Visit(this);
            if (fields < 0x10) data[header] = (byte)((isArray ? 0x90 : 0x80) | fields);
            else
            {
                int count = Length - header - 1;
                Room(2);
                Buffer.BlockCopy(data, header + 1, data, header + 3, count);
                data[header] = (byte)(isArray ? 0xdc : 0xde);
                data[header + 1] = (byte)(fields >> 8);
                data[header + 2] = (byte)fields;
            }
            fields = outerFields;
            isArray = outerIsArray;
        }

        internal Step BeginField(string key)
        {
            fields++;
            if (!isArray) Write(key);
            return Step.Write;
        }

        int Room(int count)
        {
            if (Length + count > data.Length) Array.Resize(ref data, Math.Max(2 * data.Length, Length + count));
            int start = Length;
            Length += count;
            return start;
        }

        void Code(int code)
        {
            int start = Room(1);
            data[start] = (byte)code;
        }

        void Big(int code, ulong value, int bytes)
        {
            int start = Room(1 + bytes);
            data[start] = (byte)code;
            for (int i = bytes; i > 0; i--, value >>= 8) data[start + i] = (byte)value;
        }

        public void WriteNil() { Code(0xc0); }

        public void Write(bool value) { Code(value ? 0xc3 : 0xc2); }

        public void Write(long value)
        {
            if (value >= 0)
            {
                if (value < 0x80) Code((int)value);
                else if (value <= 0xff) Big(0xcc, (ulong)value, 1);
                else if (value <= 0xffff) Big(0xcd, (ulong)value, 2);
                else if (value <= 0xffffffff) Big(0xce, (ulong)value, 4);
                else Big(0xcf, (ulong)value, 8);
            }
            else if (value >= -0x20) Code((int)(value & 0xff));
            else if (value >= sbyte.MinValue) Big(0xd0, (ulong)value, 1);
            else if (value >= short.MinValue) Big(0xd1, (ulong)value, 2);
            else if (value >= int.MinValue) Big(0xd2, (ulong)value, 4);
            else Big(0xd3, (ulong)value, 8);
        }

        public void Write(double value) { Big(0xcb, (ulong)BitConverter.DoubleToInt64Bits(value), 8); }

        public void Write(string value)
        {
            int count = Encoding.UTF8.GetByteCount(value);
            if (count < 0x20) Code(0xa0 | count);
            else if (count <= 0xff) Big(0xd9, (ulong)count, 1);
            else if (count <= 0xffff) Big(0xda, (ulong)count, 2);
            else Big(0xdb, (ulong)count, 4);
            int start = Room(count);
            Encoding.UTF8.GetBytes(value, 0, value.Length, data, start);
        }

        public void Write(byte[] value)
        {
            if (value.Length <= 0xff) Big(0xc4, (ulong)value.Length, 1);
            else if (value.Length <= 0xffff) Big(0xc5, (ulong)value.Length, 2);
            else Big(0xc6, (ulong)value.Length, 4);
            int start = Room(value.Length);
            Buffer.BlockCopy(value, 0, data, start, value.Length);
        }

        public void WriteArrayHeader(int count)
        {
            if (count < 0x10) Code(0x90 | count);
            else if (count <= 0xffff) Big(0xdc, (ulong)count, 2);
            else Big(0xdd, (ulong)count, 4);
        }

        public void WriteMapHeader(int count)
        {
            if (count < 0x10) Code(0x80 | count);
            else if (count <= 0xffff) Big(0xde, (ulong)count, 2);
            else Big(0xdf, (ulong)count, 4);
        }

        internal void Write(double[] values)
        {
            WriteArrayHeader(values.Length);
            foreach (double value in values) Write(value);
        }

        internal void Write(long[] values)
        {
            WriteArrayHeader(values.Length);
            foreach (long value in values) Write(value);
        }

        internal void Write(string[] values)
        {
            WriteArrayHeader(values.Length);
            foreach (string value in values) Write(value ?? throw new WireException("a string of an array is null"));
        }

        internal void Write(Dictionary<string, long> values)
        {
            WriteMapHeader(values.Count);
            foreach (KeyValuePair<string, long> pair in values)
            {
                Write(pair.Key);
                Write(pair.Value);
            }
        }
    }
}
