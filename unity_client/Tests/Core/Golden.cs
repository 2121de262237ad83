// Golden vectors of docs/protocol, and the JSON that they are written in.
using System;
using System.Collections.Generic;
using System.Globalization;
using System.IO;
using System.Runtime.CompilerServices;
using System.Text;

namespace IrisSession.Core.Tests
{
    /// <summary>Files of the checkout.</summary>
    public static class Golden
    {
        private static readonly Dictionary<string, Json> Loaded = new Dictionary<string, Json>();

        /// <summary>Return the content of a file of docs/protocol.</summary>
        public static Json Load(string name)
        {
            if (!Loaded.TryGetValue(name, out Json content))
            {
                content = Json.Parse(File.ReadAllText(Path.Combine(FindCheckout(), "docs", "protocol", name + ".json")));
                Loaded[name] = content;
            }
            return content;
        }

        public static byte[] FromHex(string hex)
        {
            byte[] bytes = new byte[hex.Length / 2];
            for (int i = 0; i < bytes.Length; i++) bytes[i] = Convert.ToByte(hex.Substring(2 * i, 2), 16);
            return bytes;
        }

        public static string ToHex(byte[] bytes, int offset, int count)
        {
            return count == 0 ? "" : BitConverter.ToString(bytes, offset, count).Replace("-", "").ToLowerInvariant();
        }

        private static string FindCheckout([CallerFilePath] string source = "")
        {
            string at = Environment.GetEnvironmentVariable("IRIS_REPO") ?? source;
            while (at != null && !Directory.Exists(Path.Combine(at, "docs", "protocol"))) at = Path.GetDirectoryName(at);
            return at ?? throw new DirectoryNotFoundException("docs/protocol: run the tests in a checkout, or set IRIS_REPO");
        }
    }

    /// <summary>A value of JSON: null, bool, long, ulong, double, string, list or map in order.</summary>
    public sealed class Json
    {
        public readonly object Value;

        private Json(object value)
        {
            Value = value;
        }

        public List<Json> Items { get { return (List<Json>)Value; } }

        public List<KeyValuePair<string, Json>> Fields { get { return (List<KeyValuePair<string, Json>>)Value; } }

        public bool IsNull { get { return Value == null; } }

        public string Text { get { return (string)Value; } }

        public long Long { get { return Convert.ToInt64(Value, CultureInfo.InvariantCulture); } }

        public int Int { get { return (int)Long; } }

        /// <summary>The number; NaN for null, as golden files write what is not finite.</summary>
        public double Double { get { return Value == null ? double.NaN : Convert.ToDouble(Value, CultureInfo.InvariantCulture); } }

        public Json this[string name] { get { return Find(name) ?? throw new KeyNotFoundException(name); } }

        public Json Find(string name)
        {
            foreach (KeyValuePair<string, Json> field in Fields) if (field.Key == name) return field.Value;
            return null;
        }

        public double[] Doubles()
        {
            double[] values = new double[Items.Count];
            for (int i = 0; i < values.Length; i++) values[i] = Items[i].Double;
            return values;
        }

        public static Json Parse(string text)
        {
            int at = 0;
            return ReadValue(text, ref at);
        }

        private static Json ReadValue(string text, ref int at)
        {
            SkipSpace(text, ref at);
            switch (text[at])
            {
                case '{':
                    List<KeyValuePair<string, Json>> fields = new List<KeyValuePair<string, Json>>();
                    while (HasNext(text, ref at, '}'))
                    {
                        SkipSpace(text, ref at);
                        string name = ReadString(text, ref at);
                        SkipSpace(text, ref at);
                        at++; // the colon
                        fields.Add(new KeyValuePair<string, Json>(name, ReadValue(text, ref at)));
                    }
                    return new Json(fields);
                case '[':
                    List<Json> items = new List<Json>();
                    while (HasNext(text, ref at, ']')) items.Add(ReadValue(text, ref at));
                    return new Json(items);
                case '"':
                    return new Json(ReadString(text, ref at));
                case 't':
                    at += 4;
                    return new Json(true);
                case 'f':
                    at += 5;
                    return new Json(false);
                case 'n':
                    at += 4;
                    return new Json(null);
                default:
                    return new Json(ReadNumber(text, ref at));
            }
        }

        /// <summary>Step over the bracket that opens or the comma; false behind the one that closes.</summary>
        private static bool HasNext(string text, ref int at, char close)
        {
            bool first = text[at] == '{' || text[at] == '[';
            if (first) at++;
            SkipSpace(text, ref at);
            if (text[at] == close)
            {
                at++;
                return false;
            }
            if (!first) at++;
            return true;
        }

        private static void SkipSpace(string text, ref int at)
        {
            while (at < text.Length && text[at] <= ' ') at++;
        }

        private static object ReadNumber(string text, ref int at)
        {
            int start = at;
            while (at < text.Length && "+-.0123456789eE".IndexOf(text[at]) >= 0) at++;
            string number = text.Substring(start, at - start);
            if (long.TryParse(number, NumberStyles.AllowLeadingSign, CultureInfo.InvariantCulture, out long whole)) return whole;
            if (ulong.TryParse(number, NumberStyles.None, CultureInfo.InvariantCulture, out ulong large)) return large;
            return double.Parse(number, NumberStyles.Float, CultureInfo.InvariantCulture);
        }

        private static string ReadString(string text, ref int at)
        {
            StringBuilder value = new StringBuilder();
            for (at++; text[at] != '"'; at++)
            {
                if (text[at] != '\\')
                {
                    value.Append(text[at]);
                    continue;
                }
                at++;
                if (text[at] == 'u')
                {
                    value.Append((char)Convert.ToInt32(text.Substring(at + 1, 4), 16));
                    at += 4;
                }
                else value.Append("\"\\/\b\f\n\r\t"["\"\\/bfnrt".IndexOf(text[at])]);
            }
            at++;
            return value.ToString();
        }
    }
}
