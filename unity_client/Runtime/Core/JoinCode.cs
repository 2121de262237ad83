// Join codes, the proofs by which a client and a session show each other that they know the same code, and the fingerprints that
// people compare. docs/protocol.md, sections "Pairing" and "Gateways", are normative; the texts are those that
// `iris-session pair` prints.
using System;
using System.Security.Cryptography;
using System.Text;

namespace IrisSession.Core
{
    /// <summary>Join codes and their proofs. `S` and `C`: hash of the gateway's key and of this client's secret, 32 bytes each.</summary>
    public static class JoinCode
    {
        public const int KeyBytes = 32;
        private const string Alphabet = "0123456789ABCDEFGHJKMNPQRSTVWXYZ";
        private const int Characters = 12;
        private const int Iterations = 200_000;

        /// <summary>Longest text that is looked at: twelve characters with spaces and hyphens between.</summary>
        private const int MaxText = 64;

        /// <summary>Return a typed code in the one form that is stretched, null for any other text.</summary>
        public static string Normalise(string text)
        {
            if (text == null || text.Length > MaxText) return null;
            StringBuilder code = new StringBuilder(Characters);
            foreach (char typed in text)
            {
                if (typed == '-' || typed == ' ') continue;
                char c = typed >= 'a' && typed <= 'z' ? (char)(typed - 32) : typed;
                c = c == 'O' ? '0' : c == 'I' || c == 'L' ? '1' : c == 'U' ? 'V' : c;
                if (code.Length == Characters || Alphabet.IndexOf(c) < 0) return null;
                code.Append(c);
            }
            return code.Length == Characters ? code.ToString() : null;
        }

        /// <summary>Return a normalised code as it is shown: `XXXX-XXXX-XXXX`.</summary>
        public static string Format(string code)
        {
            return code.Length == Characters ? code.Substring(0, 4) + "-" + code.Substring(4, 4) + "-" + code.Substring(8) : code;
        }

        /// <summary>Derive the secret that both sides share. Takes about 0.1 s, on purpose: not on the engine's thread.</summary>
        /// <exception cref="LinkException">The text is not a join code.</exception>
        public static byte[] Stretch(string code, byte[] s)
        {
            CheckKey(s);
            string normal = Normalise(code) ?? throw LinkException.ForCode(code);
            byte[] salt = Join(Encoding.ASCII.GetBytes("iris-pair-1"), s);
            using (Rfc2898DeriveBytes derive = new Rfc2898DeriveBytes(Encoding.ASCII.GetBytes(normal), salt, Iterations, HashAlgorithmName.SHA256))
            {
                return derive.GetBytes(32);
            }
        }

        /// <summary>Return the proof that a client sends in `pair`.</summary>
        public static byte[] MakeClientProof(byte[] stretched, byte[] s, byte[] c) { return MakeProof("client", stretched, s, c); }

        /// <summary>Return the proof that a session answers in `paired`.</summary>
        public static byte[] MakeServerProof(byte[] stretched, byte[] s, byte[] c) { return MakeProof("server", stretched, s, c); }

        /// <summary>Compare two proofs in constant time.</summary>
        public static bool IsSameProof(byte[] a, byte[] b)
        {
            int difference = a.Length ^ b.Length;
            for (int i = 0; i < a.Length; i++) difference |= a[i] ^ (i < b.Length ? b[i] : 0);
            return difference == 0;
        }

        private static byte[] MakeProof(string side, byte[] stretched, byte[] s, byte[] c)
        {
            CheckKey(s);
            CheckKey(c);
            using (HMACSHA256 hash = new HMACSHA256(stretched))
            {
                return hash.ComputeHash(Join(Encoding.ASCII.GetBytes(side), Join(s, c)));
            }
        }

        private static void CheckKey(byte[] key)
        {
            if (key.Length != KeyBytes) throw new ArgumentException("a key has " + KeyBytes + " bytes, got " + key.Length);
        }

        private static byte[] Join(byte[] a, byte[] b)
        {
            byte[] joined = new byte[a.Length + b.Length];
            a.CopyTo(joined, 0);
            b.CopyTo(joined, a.Length);
            return joined;
        }
    }

    /// <summary>Public identifiers of keys, as people compare them.</summary>
    public static class Fingerprint
    {
        private const string Base32 = "abcdefghijklmnopqrstuvwxyz234567";

        /// <summary>Return the fingerprint of a key, or of `C`: 128-bit BLAKE2b in base32, 26 characters.</summary>
        public static string OfKey(byte[] key)
        {
            StringBuilder text = new StringBuilder(26);
            int bits = 0;
            int kept = 0;
            foreach (byte one in Blake2b.Compute(key, 0, key.Length, 16, "iris-key"))
            {
                kept = (kept << 8) | one;
                for (bits += 8; bits >= 5; bits -= 5) text.Append(Base32[(kept >> (bits - 5)) & 31]);
                kept &= 31;
            }
            if (bits > 0) text.Append(Base32[(kept << (5 - bits)) & 31]);
            return text.ToString();
        }

        /// <summary>Return the SHA-256 of a certificate (DER) as browsers and `iris-session pair` show it: `3F:A2:...`.</summary>
        public static string OfCertificate(byte[] certificate)
        {
            using (SHA256 hash = SHA256.Create()) return BitConverter.ToString(hash.ComputeHash(certificate)).Replace('-', ':');
        }
    }
}
