// Secret, token and known keys of gateways in one folder of the app. Files are written whole or not at all, and are private.
using System;
using System.Collections.Generic;
using System.IO;
using System.Runtime.InteropServices;
using System.Security.Cryptography;
using System.Text;
using IrisSession.Core;

namespace IrisSession.Transport
{
    /// <summary>Who this app is, kept on files. For one thread at a time; the secret must not leave the device.</summary>
    public sealed class FileIdentityStore : IIdentityStore
    {
        private const int SecretBytes = 32;
        private const int MaxTokenBytes = 4096;
        private const int MaxPins = 64;
        private const string SecretFile = "secret";
        private const string TokenFile = "token";
        private const string PinsFile = "gateways";

        private readonly string folder;

        /// <summary>Read the identity; make it the first time.</summary>
        /// <param name="folder">Made where it is missing. In Unity: a folder of `Application.persistentDataPath`, which is the app's own.</param>
        public FileIdentityStore(string folder)
        {
            this.folder = folder;
            byte[] secret = Read(SecretFile, SecretBytes);
            if (secret == null || secret.Length != SecretBytes)
            {
                secret = new byte[SecretBytes];
                using (RandomNumberGenerator random = RandomNumberGenerator.Create()) random.GetBytes(secret);
                if (Problem.Length == 0) Write(SecretFile, secret); // else one is there that cannot be read now: it is what sessions know
            }
            Secret = secret;
            ResumeToken = Read(TokenFile, MaxTokenBytes) ?? new byte[0];
        }

        public byte[] Secret { get; }

        public byte[] ResumeToken { get; private set; }

        /// <summary>Why the system refused the last time, for a log; empty when it has not. What was to be kept lasts as long as the app runs.</summary>
        public string Problem { get; private set; } = "";

        /// <summary>C: what stands for our key, SHA-256 of the secret.</summary>
        public byte[] KeyHash
        {
            get
            {
                using (SHA256 sha = SHA256.Create()) return sha.ComputeHash(Secret);
            }
        }

        public void Remember(byte[] token)
        {
            ResumeToken = token;
            Write(TokenFile, token);
        }

        /// <summary>Return the key that a gateway was known by, null for a new one.</summary>
        public byte[] FindPin(string authority)
        {
            return ReadPins().TryGetValue(authority, out byte[] pin) ? pin : null;
        }

        /// <summary>
        /// Return an address with the key that it was known by. One that was known by a key is never plain http again: another program of
        /// this device may listen at the port of the cable, and our secret goes to what listens there.
        /// </summary>
        public WebEndpoint WithKnownPin(WebEndpoint endpoint)
        {
            byte[] pin = FindPin(endpoint.Authority);
            return pin == null ? endpoint : new WebEndpoint(true, endpoint.Host, endpoint.Port, pin);
        }

        /// <summary>Return whether some gateway was known by a key: one that proves to have it is that gateway, also at another address.</summary>
        public bool IsKnownPin(byte[] pin)
        {
            foreach (byte[] known in ReadPins().Values) if (CertificateHash.AreEqual(known, pin)) return true;
            return false;
        }

        /// <summary>Keep the key of a gateway, which was paired, or which the person has compared.</summary>
        public void KeepPin(string authority, byte[] pin)
        {
            Dictionary<string, byte[]> pins = ReadPins();
            pins.Remove(authority);
            StringBuilder text = new StringBuilder();
            int left = pins.Count - (MaxPins - 1); // those that were kept first go first
            foreach (KeyValuePair<string, byte[]> one in pins) if (left-- <= 0) text.Append(one.Key).Append(' ').Append(CertificateHash.ToKey(one.Value)).Append('\n');
            text.Append(authority).Append(' ').Append(CertificateHash.ToKey(pin)).Append('\n');
            Write(PinsFile, Encoding.UTF8.GetBytes(text.ToString()));
        }

        private Dictionary<string, byte[]> ReadPins()
        {
            Dictionary<string, byte[]> pins = new Dictionary<string, byte[]>();
            byte[] bytes = Read(PinsFile, 64 << 10);
            if (bytes == null) return pins;
            foreach (string line in Encoding.UTF8.GetString(bytes).Split('\n'))
            {
                string[] parts = line.Split(' ');
                byte[] pin = parts.Length == 2 ? CertificateHash.FromKey(parts[1]) : null;
                if (pin != null) pins[parts[0]] = pin;
            }
            return pins;
        }

        private byte[] Read(string name, int maxBytes)
        {
            byte[] bytes = null;
            Try(() =>
            {
                FileInfo file = new FileInfo(Path.Combine(folder, name));
                if (file.Exists && file.Length <= maxBytes) bytes = File.ReadAllBytes(file.FullName);
            });
            return bytes;
        }

        private void Write(string name, byte[] bytes)
        {
            Try(() =>
            {
                Directory.CreateDirectory(folder);
                string target = Path.Combine(folder, name);
                string temporary = target + ".new";
                File.Delete(temporary);
                using (FileStream file = new FileStream(temporary, FileMode.CreateNew, FileAccess.Write, FileShare.None))
                {
                    PrivateFile.Restrict(temporary); // before anything is in it
                    file.Write(bytes, 0, bytes.Length);
                    file.Flush(true);
                }
                if (File.Exists(target)) File.Replace(temporary, target, null);
                else File.Move(temporary, target);
            });
        }

        private void Try(Action action)
        {
            try
            {
                action();
            }
            catch (Exception error) when (error is IOException || error is UnauthorizedAccessException || error is NotSupportedException || error is ArgumentException)
            {
                Problem = error.Message;
            }
        }
    }

    /// <summary>Takes the rights of others from a file, where the system has such rights.</summary>
    internal static class PrivateFile
    {
        private const int OwnerOnly = 0x180; // rw-------

        public static void Restrict(string path)
        {
            try
            {
                if (Path.DirectorySeparatorChar == '/') chmod(path, OwnerOnly);
            }
            catch (Exception error) when (error is DllNotFoundException || error is EntryPointNotFoundException)
            {
                // another system: folders of apps are private there
            }
        }

        [DllImport("libc", SetLastError = true)]
        private static extern int chmod(string path, int mode);
    }
}
