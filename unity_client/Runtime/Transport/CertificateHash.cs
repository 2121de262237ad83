// The pin of a gateway: SHA-256 of the SubjectPublicKeyInfo (DER) of its certificate, which stays when the certificate is renewed.
//
// The key is found in the DER itself: runtimes disagree on which kinds of keys their certificate classes can hand out.
using System;
using System.Security.Cryptography;

namespace IrisSession.Transport
{
    /// <summary>Hashes of public keys.</summary>
    public static class CertificateHash
    {
        public const int Bytes = 32;
        private const int Sequence = 0x30;
        private const int Version = 0xa0;

        /// <summary>Return the hash of a certificate's public key, null for bytes that are no certificate (RFC 5280, section 4.1).</summary>
        public static byte[] Compute(byte[] der)
        {
            int at = 0;
            int end = der.Length;
            if (!Enter(der, Sequence, ref at, ref end) || !Enter(der, Sequence, ref at, ref end)) return null;
            if (at < end && der[at] == Version && !Skip(der, ref at, end)) return null;
            for (int i = 0; i < 5; i++) if (!Skip(der, ref at, end)) return null; // serial, signature, issuer, validity, subject
            int from = at;
            if (at >= end || der[at] != Sequence || !Skip(der, ref at, end)) return null;
            using (SHA256 sha = SHA256.Create()) return sha.ComputeHash(der, from, at - from);
        }

        /// <summary>Return a hash as `GET /v1/info` has it: base64url without padding.</summary>
        public static string ToKey(byte[] hash)
        {
            return Convert.ToBase64String(hash).TrimEnd('=').Replace('+', '-').Replace('/', '_');
        }

        /// <summary>Return the hash that a text of <see cref="ToKey"/> stands for, null for other texts.</summary>
        public static byte[] FromKey(string key)
        {
            if (key.Length != 43) return null;
            try
            {
                byte[] hash = Convert.FromBase64String(key.Replace('-', '+').Replace('_', '/') + "=");
                return ToKey(hash) == key ? hash : null;
            }
            catch (FormatException)
            {
                return null;
            }
        }

        /// <summary>Return whether two hashes are equal; null equals nothing.</summary>
        public static bool AreEqual(byte[] a, byte[] b)
        {
            if (a == null || b == null || a.Length != b.Length) return false;
            int difference = 0;
            for (int i = 0; i < a.Length; i++) difference |= a[i] ^ b[i];
            return difference == 0;
        }

        /// <summary>Enter an element: `at` and `end` become those of its content.</summary>
        private static bool Enter(byte[] der, int tag, ref int at, ref int end)
        {
            if (at >= end || der[at] != tag || !ReadLength(der, at + 1, end, out int begin, out int length)) return false;
            at = begin;
            end = begin + length;
            return true;
        }

        private static bool Skip(byte[] der, ref int at, int end)
        {
            if (at >= end || !ReadLength(der, at + 1, end, out int begin, out int length)) return false;
            at = begin + length;
            return true;
        }

        /// <summary>Read the length of an element, which must lie before `end`.</summary>
        private static bool ReadLength(byte[] der, int at, int end, out int begin, out int length)
        {
            begin = length = 0;
            if (at >= end) return false;
            int first = der[at++];
            int digits = first < 0x80 ? 0 : first & 0x7f;
            if (digits > 3 || first == 0x80 || at + digits > end) return false;
            length = digits == 0 ? first : 0;
            for (int i = 0; i < digits; i++) length = length << 8 | der[at++];
            begin = at;
            return length <= end - at;
        }
    }
}
