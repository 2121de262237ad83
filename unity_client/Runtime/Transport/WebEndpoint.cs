// Where a gateway is, and by which key it is known.
using System;
using IrisSession.Core;

namespace IrisSession.Transport
{
    /// <summary>Address of a gateway. Immutable.</summary>
    public sealed class WebEndpoint
    {
        public readonly bool IsSecure;

        /// <summary>Host name or address, of IPv6 without brackets.</summary>
        public readonly string Host;
        public readonly int Port;

        /// <summary>SHA-256 of the public key of its certificate; null: not known yet.</summary>
        public readonly byte[] Pin;

        /// <exception cref="ArgumentException">It is no address, or one without TLS that is not this machine's own.</exception>
        public WebEndpoint(bool isSecure, string host, int port, byte[] pin = null)
        {
            if (host.Length == 0 || host.Length > 253 || port < 1 || port > 65535) throw new ArgumentException("\"" + host + ":" + port + "\" is no address");
            foreach (char unit in host) if (unit <= ' ' || unit == '/' || unit == '@' || unit > '~') throw new ArgumentException("\"" + host + "\" is no host");
            if (pin != null && pin.Length != CertificateHash.Bytes) throw new ArgumentException("a pin of " + pin.Length + " bytes");
            if (!isSecure && !HostName.IsLoopback(host)) throw new ArgumentException("http is for localhost alone: https://" + host);
            IsSecure = isSecure;
            Host = host;
            Port = port;
            Pin = pin;
        }

        /// <summary>True for this machine: the cable of a headset (`adb reverse`), or a session beside us.</summary>
        public bool IsLoopback { get { return HostName.IsLoopback(Host); } }

        /// <summary>`host:port` as in addresses and in the header `Host`.</summary>
        public string Authority { get { return (Host.IndexOf(':') >= 0 ? "[" + Host + "]" : Host) + ":" + Port; } }

        public WebEndpoint WithPin(byte[] pin)
        {
            return new WebEndpoint(IsSecure, Host, Port, pin);
        }

        /// <summary>Return the endpoint of `https://host:port` or `http://localhost:port`, null for other texts. What follows is ignored.</summary>
        public static WebEndpoint Parse(string address)
        {
            string text = address.Trim();
            bool isSecure = text.StartsWith("https://", StringComparison.OrdinalIgnoreCase);
            if (!isSecure && !text.StartsWith("http://", StringComparison.OrdinalIgnoreCase)) return null;
            int from = isSecure ? 8 : 7;
            int end = text.IndexOfAny(new[] { '/', '#', '?' }, from);
            string authority = end < 0 ? text.Substring(from) : text.Substring(from, end - from);
            int colon = authority.LastIndexOf(':');
            if (authority.StartsWith("[", StringComparison.Ordinal))
            {
                int close = authority.IndexOf(']');
                if (close < 0 || (close + 1 != authority.Length && close + 1 != colon)) return null;
                if (close + 1 == authority.Length) colon = -1;
            }
            string host = (colon < 0 ? authority : authority.Substring(0, colon)).Trim('[', ']');
            int port = isSecure ? 443 : 80;
            if (colon >= 0 && !int.TryParse(authority.Substring(colon + 1), out port)) return null;
            try
            {
                return new WebEndpoint(isSecure, host, port);
            }
            catch (ArgumentException)
            {
                return null;
            }
        }

        public override string ToString()
        {
            return (IsSecure ? "https://" : "http://") + Authority;
        }
    }
}
