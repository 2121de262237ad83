// Names and addresses of hosts, by the rules of iris_session/link/discovery.py: the same texts count as hosts on both sides.
namespace IrisSession.Core
{
    /// <summary>Checks and formats hosts.</summary>
    public static class HostName
    {
        private const int MaxName = 253;
        private const int MaxLabel = 63;
        private const int MaxScope = 32;

        /// <summary>Return whether a text can be the name or address of a host: the system's resolver is given no other.</summary>
        public static bool IsHost(string host)
        {
            if (host.IndexOf(':') >= 0)
            {
                int percent = host.IndexOf('%');
                if (percent < 0) return IsAddress6(host);
                string scope = host.Substring(percent + 1);
                return IsAddress6(host.Substring(0, percent)) && IsScope(scope);
            }
            if (host.Length == 0 || host.Length > MaxName || host[0] == '_') return false;
            if (host.EndsWith(".")) host = host.Substring(0, host.Length - 1);
            foreach (string label in host.Split('.')) if (!IsLabel(label)) return false;
            return true;
        }

        /// <summary>Return whether a host is this machine, by its text alone.</summary>
        public static bool IsLoopback(string host)
        {
            if (string.Equals(host, "localhost", System.StringComparison.OrdinalIgnoreCase)) return true;
            if (host.IndexOf(':') < 0) return host.StartsWith("127.") && IsAddress4(host);
            int percent = host.IndexOf('%');
            ushort[] groups = new ushort[8];
            if (!TryParseAddress6(percent < 0 ? host : host.Substring(0, percent), groups)) return false;
            for (int i = 0; i < 5; i++) if (groups[i] != 0) return false;
            bool isMapped = groups[5] == 0xffff; // an IPv4 address
            return isMapped ? groups[6] >> 8 == 127 : groups[5] == 0 && groups[6] == 0 && groups[7] == 1;
        }

        /// <summary>Return `HOST:PORT`, IPv6 in brackets.</summary>
        public static string Format(string host, int port)
        {
            return host.IndexOf(':') >= 0 ? "[" + host + "]:" + port : host + ":" + port;
        }

        private static bool IsLabel(string label)
        {
            if (label.Length == 0 || label.Length > MaxLabel || label[0] == '-' || label[label.Length - 1] == '-') return false;
            foreach (char c in label) if (!IsAlphanumeric(c) && c != '_' && c != '-') return false;
            return true;
        }

        private static bool IsScope(string scope)
        {
            if (scope.Length > MaxScope) return false;
            foreach (char c in scope) if (!IsAlphanumeric(c) && c != '.' && c != '_' && c != '-') return false;
            return true;
        }

        private static bool IsAddress6(string text)
        {
            return TryParseAddress6(text, new ushort[8]);
        }

        /// <summary>Parse an IPv6 address (RFC 4291, section 2.2) without scope.</summary>
        private static bool TryParseAddress6(string text, ushort[] groups)
        {
            if (text.Length > 45) return false;
            int gap = text.IndexOf("::", System.StringComparison.Ordinal);
            if (gap < 0) return ParseGroups(text, groups, 0) == 8;
            string after = text.Substring(gap + 2);
            int before = gap == 0 ? 0 : ParseGroups(text.Substring(0, gap), groups, 0, allowsAddress4: false);
            if (before < 0 || before > 7) return false;
            if (after.Length == 0) return true;
            ushort[] tail = new ushort[8];
            int count = ParseGroups(after, tail, 0);
            if (count < 0 || before + count > 7) return false;
            for (int i = 0; i < count; i++) groups[8 - count + i] = tail[i];
            return true;
        }

        /// <summary>Parse groups between colons; the last may be an IPv4 address. Returns how many, -1 for other text or too many.</summary>
        private static int ParseGroups(string text, ushort[] groups, int count, bool allowsAddress4 = true)
        {
            string[] parts = text.Split(':');
            for (int i = 0; i < parts.Length; i++)
            {
                string part = parts[i];
                if (allowsAddress4 && i == parts.Length - 1 && part.IndexOf('.') >= 0)
                {
                    if (count > 6 || !IsAddress4(part)) return -1;
                    string[] bytes = part.Split('.');
                    groups[count++] = (ushort)((int.Parse(bytes[0]) << 8) | int.Parse(bytes[1]));
                    groups[count++] = (ushort)((int.Parse(bytes[2]) << 8) | int.Parse(bytes[3]));
                    continue;
                }
                if (count > 7 || part.Length == 0 || part.Length > 4) return -1;
                int value = 0;
                foreach (char c in part)
                {
                    int digit = c >= '0' && c <= '9' ? c - '0' : c >= 'a' && c <= 'f' ? c - 'a' + 10 : c >= 'A' && c <= 'F' ? c - 'A' + 10 : -1;
                    if (digit < 0) return -1;
                    value = (value << 4) | digit;
                }
                groups[count++] = (ushort)value;
            }
            return count;
        }

        /// <summary>Return whether a text is four numbers to 255 without leading zeros.</summary>
        private static bool IsAddress4(string text)
        {
            string[] parts = text.Split('.');
            if (parts.Length != 4) return false;
            foreach (string part in parts)
            {
                if (part.Length == 0 || part.Length > 3 || (part.Length > 1 && part[0] == '0')) return false;
                int value = 0;
                foreach (char c in part)
                {
                    if (c < '0' || c > '9') return false;
                    value = 10 * value + (c - '0');
                }
                if (value > 255) return false;
            }
            return true;
        }

        private static bool IsAlphanumeric(char c)
        {
            return (c >= '0' && c <= '9') || (c >= 'A' && c <= 'Z') || (c >= 'a' && c <= 'z');
        }
    }
}
