// CURVE keys of a connection, as iris-session keeps them in files.
using System;
using System.IO;

namespace IrisSession.Transport
{
    /// <summary>Key of the session and our own pair, as Z85 text of 40 characters each. Without keys only a session on loopback answers.</summary>
    public sealed class ZmqKeys
    {
        private const int Characters = 40;
        public readonly string ServerPublic;
        public readonly string Public;
        internal readonly string Secret;

        /// <exception cref="ArgumentException">A text is no key.</exception>
        public ZmqKeys(string serverPublic, string ownPublic, string ownSecret)
        {
            foreach (string key in new[] { serverPublic, ownPublic, ownSecret })
                if (key.Length != Characters) throw new ArgumentException("a key of " + key.Length + " characters: 40 are right");
            ServerPublic = serverPublic;
            Public = ownPublic;
            Secret = ownSecret;
        }

        /// <summary>Read the certificate `*.key` of a session and our own `*.key_secret`.</summary>
        /// <exception cref="ArgumentException">A file holds no such key.</exception>
        /// <exception cref="IOException">A file cannot be read.</exception>
        public static ZmqKeys Read(string serverFile, string ownFile)
        {
            string own = File.ReadAllText(ownFile);
            return new ZmqKeys(Find(File.ReadAllText(serverFile), "public-key"), Find(own, "public-key"), Find(own, "secret-key"));
        }

        private static string Find(string certificate, string name)
        {
            foreach (string line in certificate.Split('\n'))
            {
                int equals = line.IndexOf('=');
                if (equals > 0 && line.Substring(0, equals).Trim() == name) return line.Substring(equals + 1).Trim().Trim('"', '\'');
            }
            return "";
        }
    }
}
