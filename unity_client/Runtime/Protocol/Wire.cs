// MessagePack and the rules of docs/protocol.md, section 3, for the classes of Messages.g.cs.
//
// A class names its fields once, in Visit. The codec that it is given reads or writes them in turn, or sets those that
// a message leaves out to their defaults. Nothing here uses reflection, and no method is both generic and virtual:
// IL2CPP compiles all of it. Reading into an object that exists reuses its strings, arrays and parts where they fit, so
// that what arrives often allocates nothing.
using System;
using System.Collections.Generic;

namespace IrisSession.Protocol
{
    /// <summary>The bytes are not MessagePack, or not a message of the schema; or a value cannot be written.</summary>
    public sealed class WireException : Exception
    {
        public WireException(string text) : base(text) { }
    }

    /// <summary>Anything that is a MessagePack map or array of its own.</summary>
    public abstract class WireValue
    {
        /// <summary>Value of the field that distinguishes the members of a union; null of other types.</summary>
        public virtual string Tag => null;

        internal virtual string TagField => null;
        internal virtual bool IsArray => false;

        /// <summary>Name every field once, in the order of the wire.</summary>
        internal abstract void Visit(WireCodec codec);

        public void WriteTo(WireWriter writer) { writer.WriteFields(this); }

        /// <summary>Return the MessagePack bytes.</summary>
        public byte[] Encode()
        {
            var writer = new WireWriter();
            writer.WriteFields(this);
            return writer.ToArray();
        }
    }

    /// <summary>Makes the member of a union that a tag names, or null.</summary>
    internal sealed class UnionMaker<T> where T : WireValue
    {
        public readonly string TagField;
        public readonly Func<string, T> Make;

        public UnionMaker(string tagField, Func<string, T> make)
        {
            TagField = tagField;
            Make = make;
        }
    }

    /// <summary>What Visit calls for each field: Require one that must be there, Allow one that may be missing.</summary>
    public abstract class WireCodec
    {
        internal enum Step { Pass, Read, Default, Write }

        readonly WireReader reader;
        readonly WireWriter writer;

        internal WireCodec()
        {
            reader = this as WireReader;
            writer = this as WireWriter;
        }

        Step Begin(string key, bool required)
        {
            return reader != null ? reader.BeginField(key, required) : writer.BeginField(key);
        }

        internal void Require(string key, ref bool value) { Visit(Begin(key, true), ref value, false); }
        internal void Allow(string key, ref bool value, bool missing) { Visit(Begin(key, false), ref value, missing); }

        void Visit(Step step, ref bool value, bool missing)
        {
            if (step == Step.Read) value = reader.ReadBool();
            else if (step == Step.Write) writer.Write(value);
            else if (step == Step.Default) value = missing;
        }

        internal void Require(string key, ref long value, long low, long high) { Visit(Begin(key, true), ref value, low, high, 0); }
        internal void Allow(string key, ref long value, long low, long high, long missing) { Visit(Begin(key, false), ref value, low, high, missing); }

        void Visit(Step step, ref long value, long low, long high, long missing)
        {
            if (step == Step.Read) value = reader.ReadLong(low, high);
            else if (step == Step.Write) writer.Write(value);
            else if (step == Step.Default) value = missing;
        }

        internal void Allow(string key, ref long? value, long low, long high)
        {
            Step step = Begin(key, false);
            if (step == Step.Read) value = reader.TryReadNil() ? (long?)null : reader.ReadLong(low, high);
            else if (step == Step.Default) value = null;
            else if (step == Step.Write)
            {
                if (value.HasValue) writer.Write(value.Value);
                else writer.WriteNil();
            }
        }

        internal void Require(string key, ref double value) { Visit(Begin(key, true), ref value, 0.0); }
        internal void Allow(string key, ref double value, double missing) { Visit(Begin(key, false), ref value, missing); }

        void Visit(Step step, ref double value, double missing)
        {
            if (step == Step.Read) value = reader.ReadDouble();
            else if (step == Step.Write) writer.Write(value);
            else if (step == Step.Default) value = missing;
        }

        internal void Allow(string key, ref double? value)
        {
            Step step = Begin(key, false);
            if (step == Step.Read) value = reader.TryReadNil() ? (double?)null : reader.ReadDouble();
            else if (step == Step.Default) value = null;
            else if (step == Step.Write)
            {
                if (value.HasValue) writer.Write(value.Value);
                else writer.WriteNil();
            }
        }

        // Of strings and bytes: at most so many characters (code points) or bytes; 0: any number.

        internal void Require(string key, ref string value, int most) { Visit(Begin(key, true), key, ref value, most, ""); }
        internal void Allow(string key, ref string value, int most, string missing) { Visit(Begin(key, false), key, ref value, most, missing); }

        void Visit(Step step, string key, ref string value, int most, string missing)
        {
            if (step == Step.Read) value = reader.ReadString(value, most);
            else if (step == Step.Write) writer.Write(Check(key, value));
            else if (step == Step.Default) value = missing;
        }

        /// <summary>The address of an asset: 64 digits 0-9, a-f.</summary>
        internal void RequireAddress(string key, ref string value)
        {
            Step step = Begin(key, true);
            if (step == Step.Write) writer.Write(Check(key, value));
            if (step != Step.Read) return;
            value = reader.ReadString(value, 0);
            bool good = value.Length == 64;
            foreach (char unit in value) good &= unit >= '0' && unit <= '9' || unit >= 'a' && unit <= 'f';
            if (!good) throw new WireException(key + " is no address");
        }

        internal void Require(string key, ref byte[] value, int most) { Visit(Begin(key, true), key, ref value, most); }
        internal void Allow(string key, ref byte[] value, int most) { Visit(Begin(key, false), key, ref value, most); }

        void Visit(Step step, string key, ref byte[] value, int most)
        {
            if (step == Step.Read) value = reader.ReadBytes(value, most);
            else if (step == Step.Write) writer.Write(Check(key, value));
            else if (step == Step.Default) value = Array.Empty<byte>();
        }

        // Of arrays: at least and at most so many elements; most 0: any number.

        internal void Require(string key, ref double[] value, int least, int most) { Visit(Begin(key, true), key, ref value, least, most, null); }
        internal void Allow(string key, ref double[] value, int least, int most, double[] missing = null) { Visit(Begin(key, false), key, ref value, least, most, missing); }

        void Visit(Step step, string key, ref double[] value, int least, int most, double[] missing)
        {
            if (step == Step.Read) value = reader.ReadDoubles(value, least, most);
            else if (step == Step.Write) writer.Write(Check(key, value));
            else if (step == Step.Default) value = missing == null ? Empty<double>(least == most ? least : 0) : (double[])missing.Clone();
        }

        internal void AllowNull(string key, ref double[] value, int least, int most)
        {
            Step step = Begin(key, false);
            if (step == Step.Read) value = reader.TryReadNil() ? null : reader.ReadDoubles(value, least, most);
            else if (step == Step.Default) value = null;
            else if (step == Step.Write)
            {
                if (value == null) writer.WriteNil();
                else writer.Write(value);
            }
        }

        internal void Require(string key, ref long[] value, int least, int most, long low, long high) { Visit(Begin(key, true), key, ref value, least, most, low, high, null); }
        internal void Allow(string key, ref long[] value, int least, int most, long low, long high, long[] missing = null) { Visit(Begin(key, false), key, ref value, least, most, low, high, missing); }

        void Visit(Step step, string key, ref long[] value, int least, int most, long low, long high, long[] missing)
        {
            if (step == Step.Read) value = reader.ReadLongs(value, least, most, low, high);
            else if (step == Step.Write) writer.Write(Check(key, value));
            else if (step == Step.Default) value = missing == null ? Empty<long>(least == most ? least : 0) : (long[])missing.Clone();
        }

        internal void Require(string key, ref string[] value, int least, int most, int characters) { Visit(Begin(key, true), key, ref value, least, most, characters); }
        internal void Allow(string key, ref string[] value, int least, int most, int characters) { Visit(Begin(key, false), key, ref value, least, most, characters); }

        void Visit(Step step, string key, ref string[] value, int least, int most, int characters)
        {
            if (step == Step.Read) value = reader.ReadStrings(value, least, most, characters);
            else if (step == Step.Write) writer.Write(Check(key, value));
            else if (step == Step.Default) value = Array.Empty<string>();
        }

        internal void Require(string key, ref Dictionary<string, long> value) { Visit(Begin(key, true), key, ref value); }
        internal void Allow(string key, ref Dictionary<string, long> value) { Visit(Begin(key, false), key, ref value); }

        void Visit(Step step, string key, ref Dictionary<string, long> value)
        {
            if (step == Step.Read) reader.ReadCounts(value = value ?? new Dictionary<string, long>());
            else if (step == Step.Write) writer.Write(Check(key, value));
            else if (step == Step.Default)
            {
                if (value == null) value = new Dictionary<string, long>();
                else value.Clear();
            }
        }

        internal void Require<T>(string key, ref T value, Func<T> make) where T : WireValue { Visit(Begin(key, true), key, ref value, make); }
        internal void Allow<T>(string key, ref T value, Func<T> make) where T : WireValue { Visit(Begin(key, false), key, ref value, make); }

        void Visit<T>(Step step, string key, ref T value, Func<T> make) where T : WireValue
        {
            if (step == Step.Read) reader.ReadFields(value = value ?? make());
            else if (step == Step.Write) writer.WriteFields(Check(key, value));
            else if (step == Step.Default) reader.SetDefaults(value = value ?? make());
        }

        internal void AllowNull<T>(string key, ref T value, Func<T> make) where T : WireValue
        {
            Step step = Begin(key, false);
            if (step == Step.Read)
            {
                if (reader.TryReadNil()) value = null;
                else reader.ReadFields(value = value ?? make());
            }
            else if (step == Step.Default) value = null;
            else if (step == Step.Write) writer.Write(value);
        }

        internal void Require<T>(string key, ref T value, UnionMaker<T> maker) where T : WireValue
        {
            Step step = Begin(key, true);
            if (step == Step.Read) value = reader.ReadUnion(value, maker);
            else if (step == Step.Write) writer.WriteFields(Check(key, value));
        }

        internal void Require<T>(string key, ref T[] value, int least, int most, Func<T> make) where T : WireValue { Visit(Begin(key, true), key, ref value, least, most, make); }
        internal void Allow<T>(string key, ref T[] value, int least, int most, Func<T> make) where T : WireValue { Visit(Begin(key, false), key, ref value, least, most, make); }

        void Visit<T>(Step step, string key, ref T[] value, int least, int most, Func<T> make) where T : WireValue
        {
            if (step == Step.Read)
            {
                int n = reader.ReadLength(least, most);
                value = Fit(value, n);
                for (int i = 0; i < n; i++) reader.ReadFields(value[i] = value[i] ?? make());
            }
            else if (step == Step.Default) value = Array.Empty<T>();
            else if (step == Step.Write)
            {
                writer.WriteArrayHeader(Check(key, value).Length);
                foreach (T each in value) writer.WriteFields(Check(key, each));
            }
        }

        static T[] Empty<T>(int length) { return length == 0 ? Array.Empty<T>() : new T[length]; }

        /// <summary>Return the array, or one of another length with the elements that it has room for.</summary>
        internal static T[] Fit<T>(T[] value, int length)
        {
            if (value != null && value.Length == length) return value;
            T[] other = Empty<T>(length);
            if (value != null) Array.Copy(value, other, Math.Min(length, value.Length));
            return other;
        }

        static T Check<T>(string key, T value) where T : class
        {
            return value ?? throw new WireException(key + " is null");
        }
    }
}
