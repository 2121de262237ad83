// How a person names a session: a scanned link of `iris-session pair`, the address of its page, or an address as typed.
using System;
using System.Collections.Generic;
using System.Text;

namespace IrisSession.Core
{
    /// <summary>Why a text names no session.</summary>
    public enum LinkFault
    {
        /// <summary>Nothing was typed.</summary>
        Empty,

        /// <summary>Longer than any link.</summary>
        TooLong,

        /// <summary>A link of something else.</summary>
        Scheme,
        Host,
        Port,
        Key,
        JoinCode,

        /// <summary>`http://` of another machine.</summary>
        NotEncrypted,
    }

    /// <summary>A text that names no session. The message says why, for people, and what would be right.</summary>
    public sealed class LinkException : ClientException
    {
        public readonly LinkFault Fault;

        public LinkException(LinkFault fault, string message) : base(message)
        {
            Fault = fault;
        }

        internal static LinkException ForCode(string text)
        {
            return new LinkException(LinkFault.JoinCode, PairingLink.Quote(text) + " is not a join code: twelve letters and digits, like 7KQ2-M4XD-9PTR");
        }
    }

    /// <summary>Where a link comes from, and so what is in it.</summary>
    public enum LinkKind
    {
        /// <summary>`HOST` or `HOST:PORT` with the port of the control channel, as `iris-session pair` prints it.</summary>
        Address,

        /// <summary>`iris://HOST:CONTROL/?k=KEY&amp;c=CODE&amp;n=NAME`.</summary>
        Invitation,

        /// <summary>`https://HOST:WEB/#c=CODE`.</summary>
        Page,
    }

    /// <summary>Address of a session, and what a link says about it.</summary>
    public sealed class PairingLink
    {
        public const int DefaultControlPort = 7721;

        /// <summary>Port of the page minus that of the control channel, in the ports that `serve` takes by default.</summary>
        public const int WebFromControl = 4;
        private const int DefaultHttpsPort = 443;
        private const int DefaultHttpPort = 80;

        /// <summary>Longest link: a QR code that a headset reads has less.</summary>
        private const int MaxText = 2_000;
        private const string Examples = "type an address like 192.168.0.10, or scan the code that `iris-session pair` shows";

        public readonly LinkKind Kind;

        /// <summary>Name or address, IPv6 without brackets.</summary>
        public readonly string Host;

        /// <summary>Port of the control channel, 0 when only that of the page is known.</summary>
        public readonly int ControlPort;

        /// <summary>Port of the page and of the web wire. Of an address or invitation it is a guess: `Beacon.Web` of the introduction is right.</summary>
        public readonly int WebPort;

        /// <summary>False only for a page on this machine with `http`.</summary>
        public readonly bool IsEncrypted;

        /// <summary>The session's CURVE key, 32 bytes, null when the link has none.</summary>
        public readonly byte[] ServerKey;

        /// <summary>Join code in the form that is stretched, empty when the link has none.</summary>
        public readonly string Code;

        /// <summary>Name of the session, for people; empty when the link has none.</summary>
        public readonly string SessionName;

        private PairingLink(LinkKind kind, string host, int control, int web, bool encrypted, byte[] key, string code, string name)
        {
            Kind = kind;
            Host = host;
            ControlPort = control;
            WebPort = web;
            IsEncrypted = encrypted;
            ServerKey = key;
            Code = code;
            SessionName = name;
        }

        /// <summary>True when the link names this machine, as through a cable (`adb reverse`).</summary>
        public bool IsLoopback { get { return HostName.IsLoopback(Host); } }

        /// <summary>`HOST:PORT` of the control channel or the page.</summary>
        public override string ToString() { return HostName.Format(Host, ControlPort != 0 ? ControlPort : WebPort); }

        /// <summary>Parse a link or an address.</summary>
        /// <exception cref="LinkException">It is none; `Fault` says why.</exception>
        public static PairingLink Parse(string text)
        {
            string trimmed = (text ?? "").Trim();
            if (trimmed.Length == 0) throw new LinkException(LinkFault.Empty, "no address: " + Examples);
            if (trimmed.Length > MaxText) throw new LinkException(LinkFault.TooLong, "a text of " + trimmed.Length + " characters is not the link of a session: " + Examples);
            int at = trimmed.IndexOf("://", StringComparison.Ordinal);
            string scheme = at < 0 ? "tcp" : trimmed.Substring(0, at).ToLowerInvariant();
            string rest = at < 0 ? trimmed : trimmed.Substring(at + 3);
            switch (scheme)
            {
                case "tcp": return ParseAddress(rest);
                case "iris": return ParseInvitation(rest);
                case "https": return ParsePage(rest, true);
                case "http": return ParsePage(rest, false);
                default: throw new LinkException(LinkFault.Scheme, Quote(trimmed) + " is not the link of a session: " + Examples);
            }
        }

        /// <summary>Return a text of others in quotes, short and on one line.</summary>
        internal static string Quote(string text)
        {
            StringBuilder quoted = new StringBuilder("\"");
            foreach (char c in text ?? "")
            {
                if (quoted.Length > 60)
                {
                    quoted.Append("...");
                    break;
                }
                quoted.Append(char.IsControl(c) || char.IsSurrogate(c) || c == '\u2028' || c == '\u2029' ? '?' : c);
            }
            return quoted.Append('"').ToString();
        }

        private static PairingLink ParseAddress(string text)
        {
            SplitHost(text.TrimEnd('/'), DefaultControlPort, out string host, out int port);
            return new PairingLink(LinkKind.Address, host, port, GuessWebPort(port), true, null, "", "");
        }

        private static PairingLink ParseInvitation(string rest)
        {
            SplitLink(rest, out string authority, out string query, out _);
            SplitHost(authority, DefaultControlPort, out string host, out int port);
            Dictionary<string, string> fields = ParseFields(query);
            byte[] key = fields.TryGetValue("k", out string k) ? DecodeKey(k) : null;
            fields.TryGetValue("n", out string name);
            return new PairingLink(LinkKind.Invitation, host, port, GuessWebPort(port), true, key, ReadCode(fields), name ?? "");
        }

        private static PairingLink ParsePage(string rest, bool encrypted)
        {
            SplitLink(rest, out string authority, out _, out string fragment);
            SplitHost(authority, encrypted ? DefaultHttpsPort : DefaultHttpPort, out string host, out int port);
            if (!encrypted && !HostName.IsLoopback(host))
            {
                throw new LinkException(LinkFault.NotEncrypted, Quote("http://" + authority) + " is not encrypted: over a network the page of a session begins with https");
            }
            return new PairingLink(LinkKind.Page, host, 0, port, encrypted, null, ReadCode(ParseFields(fragment)), "");
        }

        private static int GuessWebPort(int control)
        {
            return control + WebFromControl < 65536 ? control + WebFromControl : 0;
        }

        private static void SplitLink(string rest, out string authority, out string query, out string fragment)
        {
            int hash = rest.IndexOf('#');
            fragment = hash < 0 ? "" : rest.Substring(hash + 1);
            if (hash >= 0) rest = rest.Substring(0, hash);
            int mark = rest.IndexOf('?');
            query = mark < 0 ? "" : rest.Substring(mark + 1);
            if (mark >= 0) rest = rest.Substring(0, mark);
            int slash = rest.IndexOf('/');
            authority = slash < 0 ? rest : rest.Substring(0, slash);
        }

        /// <summary>Split `HOST`, `HOST:PORT`, `[IPV6]:PORT` or `IPV6`.</summary>
        private static void SplitHost(string text, int defaultPort, out string host, out int port)
        {
            int colon = text.LastIndexOf(':');
            bool isOnlyHost = colon < 0 || (text.IndexOf(':') != colon && !text.StartsWith("[")) || text.EndsWith("]");
            host = (isOnlyHost ? text : text.Substring(0, colon)).Trim('[', ']');
            if (!HostName.IsHost(host)) throw new LinkException(LinkFault.Host, Quote(text) + " is not the address of a machine: " + Examples);
            port = defaultPort;
            if (!isOnlyHost && !TryParsePort(text.Substring(colon + 1), out port))
            {
                throw new LinkException(LinkFault.Port, Quote(text.Substring(colon + 1)) + " is not a port: give 1 to 65535, or leave it out");
            }
        }

        private static bool TryParsePort(string text, out int port)
        {
            port = 0;
            if (text.Length == 0 || text.Length > 5) return false;
            foreach (char c in text)
            {
                if (c < '0' || c > '9') return false;
                port = 10 * port + (c - '0');
            }
            return port > 0 && port < 65536;
        }

        /// <summary>Return the fields `name=value` of a query; of several with a name, the last. Empty values are left out.</summary>
        private static Dictionary<string, string> ParseFields(string query)
        {
            Dictionary<string, string> fields = new Dictionary<string, string>();
            foreach (string part in query.Split('&'))
            {
                int equals = part.IndexOf('=');
                if (equals < 0 || equals == part.Length - 1) continue;
                fields[Unescape(part.Substring(0, equals))] = Unescape(part.Substring(equals + 1));
            }
            return fields;
        }

        /// <summary>Decode `%XX` as UTF-8 and `+` as a space; what does not fit is kept or replaced.</summary>
        private static string Unescape(string text)
        {
            byte[] bytes = Encoding.UTF8.GetBytes(text.Replace('+', ' '));
            int count = 0;
            for (int i = 0; i < bytes.Length; i++)
            {
                int high = bytes[i] == '%' && i + 2 < bytes.Length ? ParseHex(bytes[i + 1]) : -1;
                int low = high < 0 ? -1 : ParseHex(bytes[i + 2]);
                if (low >= 0) i += 2;
                bytes[count++] = low >= 0 ? (byte)(16 * high + low) : bytes[i];
            }
            return Encoding.UTF8.GetString(bytes, 0, count);
        }

        private static int ParseHex(byte c)
        {
            return c >= '0' && c <= '9' ? c - '0' : c >= 'a' && c <= 'f' ? c - 'a' + 10 : c >= 'A' && c <= 'F' ? c - 'A' + 10 : -1;
        }

        private static string ReadCode(Dictionary<string, string> fields)
        {
            if (!fields.TryGetValue("c", out string code)) return "";
            return JoinCode.Normalise(code) ?? throw LinkException.ForCode(code);
        }

        private static byte[] DecodeKey(string text)
        {
            byte[] key = null;
            // 43 characters are 32 bytes: the last has two bits of nothing.
            if (text.Length == 43 && text.IndexOfAny(new[] { '+', '/', '=' }) < 0)
            {
                try
                {
                    key = Convert.FromBase64String(text.Replace('-', '+').Replace('_', '/') + "=");
                }
                catch (FormatException)
                {
                }
            }
            if (key != null && key.Length == JoinCode.KeyBytes) return key;
            throw new LinkException(LinkFault.Key, "the key in this link is damaged: scan the code again");
        }
    }
}
