// The file of `iris-session pair --unity FILE`, which an app reads at its start: it pairs by itself, for fleets of headsets.
using System;
using System.Collections.Generic;
using System.Globalization;
using System.Text;

namespace IrisSession.Core
{
    /// <summary>A pairing file that cannot be used. The message says why, for people.</summary>
    public sealed class PairingFileException : ClientException
    {
        public PairingFileException(string message) : base(message)
        {
        }
    }

    /// <summary>Addresses, key and join code of a session. Immutable.</summary>
    public sealed class PairingFile
    {
        /// <summary>Where an app looks for it, below its own folder (`Application.persistentDataPath`).</summary>
        public const string Name = "pairing.json";
        public const int Format = 1;
        private const int MaxCharacters = 65_536;
        private const int MaxDepth = 8;
        private const int MaxAddresses = 16;
        private const int PinBytes = 32;

        /// <summary>Name of the session.</summary>
        public readonly string Session;

        /// <summary>`https://HOST:PORT/` of its gateway, best first.</summary>
        public readonly string[] Addresses;

        /// <summary>SHA-256 of the public key in its certificate.</summary>
        public readonly byte[] Pin;
        public readonly string Code;

        /// <summary>When the code expires [s, UTC].</summary>
        public readonly double ExpiresS;

        private PairingFile(Dictionary<string, object> fields)
        {
            double format = Find<double>(fields, "format");
            if (format != Format) throw new PairingFileException("the pairing file has format " + format.ToString(CultureInfo.InvariantCulture) + ", this app reads " + Format + ": update the older of app and session");
            Session = Find<string>(fields, "session");
            Addresses = Find<List<string>>(fields, "addresses").ToArray();
            if (Addresses.Length == 0 || Addresses.Length > MaxAddresses) throw new PairingFileException("the pairing file has " + Addresses.Length + " addresses: 1 to " + MaxAddresses + " are right");
            Pin = DecodePin(Find<string>(fields, "pin"));
            Code = Find<string>(fields, "code");
            ExpiresS = Find<double>(fields, "expires");
        }

        /// <summary>Return whether the code was valid for a while after `nowS` [s, UTC]: a device whose clock is wrong tries it anyway.</summary>
        public bool HasExpired(double nowS)
        {
            return nowS > ExpiresS;
        }

        /// <summary>Read a file. Keys that are not known are passed over.</summary>
        /// <exception cref="PairingFileException">It is none, or is damaged.</exception>
        public static PairingFile Parse(string text)
        {
            if (text.Length > MaxCharacters) throw new PairingFileException("the pairing file is larger than any");
            Scanner scanner = new Scanner(text);
            Dictionary<string, object> fields = scanner.ReadValue(0) as Dictionary<string, object>;
            if (fields == null || !scanner.IsAtEnd) throw Scanner.Damaged();
            return new PairingFile(fields);
        }

        private static T Find<T>(Dictionary<string, object> fields, string name)
        {
            if (fields.TryGetValue(name, out object value) && value is T found) return found;
            throw new PairingFileException("the pairing file has no right \"" + name + "\": make it again with iris-session pair --unity");
        }

        private static byte[] DecodePin(string text)
        {
            try
            {
                byte[] pin = Convert.FromBase64String(text.Replace('-', '+').Replace('_', '/') + "=");
                if (pin.Length == PinBytes) return pin;
            }
            catch (FormatException)
            {
            }
            throw new PairingFileException("the pairing file has no right \"pin\": make it again with iris-session pair --unity");
        }

        /// <summary>Reads JSON: objects, lists of strings (others become null), strings, numbers, true, false, null.</summary>
        private sealed class Scanner
        {
            private readonly string text;
            private int at;

            public Scanner(string text)
            {
                this.text = text;
            }

            public bool IsAtEnd
            {
                get
                {
                    SkipSpace();
                    return at == text.Length;
                }
            }

            public static PairingFileException Damaged()
            {
                return new PairingFileException("the pairing file is damaged: make it again with iris-session pair --unity");
            }

            public object ReadValue(int depth)
            {
                if (depth > MaxDepth) throw Damaged();
                char first = Peek();
                if (first == '{') return ReadObject(depth);
                if (first == '[') return ReadList(depth);
                if (first == '"') return ReadString();
                foreach (string word in new[] { "true", "false", "null" }) if (TryTake(word)) return null;
                return ReadNumber();
            }

            private Dictionary<string, object> ReadObject(int depth)
            {
                Dictionary<string, object> fields = new Dictionary<string, object>();
                Take('{');
                for (bool isFirst = true; Peek() != '}'; isFirst = false)
                {
                    if (!isFirst) Take(',');
                    string name = ReadString();
                    Take(':');
                    fields[name] = ReadValue(depth + 1);
                }
                Take('}');
                return fields;
            }

            private List<string> ReadList(int depth)
            {
                List<string> items = new List<string>();
                bool areStrings = true;
                Take('[');
                for (bool isFirst = true; Peek() != ']'; isFirst = false)
                {
                    if (!isFirst) Take(',');
                    string item = ReadValue(depth + 1) as string;
                    areStrings &= item != null;
                    items.Add(item);
                }
                Take(']');
                return areStrings ? items : null;
            }

            private string ReadString()
            {
                StringBuilder read = new StringBuilder();
                Take('"');
                while (true)
                {
                    if (at >= text.Length || text[at] < ' ') throw Damaged();
                    char one = text[at++];
                    if (one == '"') return read.ToString();
                    read.Append(one == '\\' ? ReadEscape() : one);
                }
            }

            private char ReadEscape()
            {
                if (at >= text.Length) throw Damaged();
                char one = text[at++];
                int known = "\"\\/bfnrt".IndexOf(one);
                if (known >= 0) return "\"\\/\b\f\n\r\t"[known];
                if (one != 'u' || at + 4 > text.Length || !ushort.TryParse(text.Substring(at, 4), NumberStyles.AllowHexSpecifier, CultureInfo.InvariantCulture, out ushort unit)) throw Damaged();
                at += 4;
                return (char)unit;
            }

            private object ReadNumber()
            {
                int from = at;
                while (at < text.Length && "+-.0123456789eE".IndexOf(text[at]) >= 0) at++;
                bool isNumber = double.TryParse(text.Substring(from, at - from), NumberStyles.Float, CultureInfo.InvariantCulture, out double value);
                if (!isNumber || double.IsInfinity(value)) throw Damaged();
                return value;
            }

            private bool TryTake(string word)
            {
                if (string.CompareOrdinal(text, at, word, 0, word.Length) != 0) return false;
                at += word.Length;
                return true;
            }

            private void Take(char wanted)
            {
                if (Peek() != wanted) throw Damaged();
                at++;
            }

            private char Peek()
            {
                SkipSpace();
                if (at >= text.Length) throw Damaged();
                return text[at];
            }

            private void SkipSpace()
            {
                while (at < text.Length && " \t\r\n".IndexOf(text[at]) >= 0) at++;
            }
        }
    }
}
