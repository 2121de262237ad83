// The asset cache on a real folder.
using System;
using System.IO;
using System.Security.Cryptography;
using System.Text;
using IrisSession.Core;
using NUnit.Framework;

namespace IrisSession.Storage.Tests
{
    [TestFixture]
    public class DiskAssetFilesTests
    {
        private string folder;

        [SetUp]
        public void Prepare() { folder = Path.Combine(Path.GetTempPath(), "iris-cache-" + Guid.NewGuid().ToString("N")); }

        [TearDown]
        public void Clean()
        {
            if (Directory.Exists(folder)) Directory.Delete(folder, true);
            if (File.Exists(folder)) File.Delete(folder);
        }

        [Test]
        public void WhatWasKeptIsThereAfterARestart()
        {
            string a = Store(Open(), "first");
            string b = Store(Open(), "second");
            AssetCache cache = Open();
            Assert.AreEqual(2, cache.Count);
            Assert.AreEqual(11, cache.TotalBytes);
            Assert.AreEqual("first", Encoding.ASCII.GetString(cache.Read(a)));
            Assert.AreEqual("second", Encoding.ASCII.GetString(cache.Read(b)));
        }

        [Test]
        public void WhatAKillHasLeftIsNeverRead()
        {
            string a = Store(Open(), "first");
            File.WriteAllText(Path.Combine(folder, a.Replace('0', '1') + ".7.part"), "fir");
            File.WriteAllText(Path.Combine(folder, "notes.txt"), "of a person");
            AssetCache cache = Open();
            Assert.AreEqual(1, cache.Count);
            Assert.AreEqual(2, Directory.GetFiles(folder).Length, "what was half-written is removed, other files stay");
            File.WriteAllText(Path.Combine(folder, a), "fir"); // as after a crash of the system
            Assert.IsNull(Open().Read(a));
            Assert.IsFalse(File.Exists(Path.Combine(folder, a)));
        }

        [Test]
        public void LeastRecentlyUsedGoesFirstAlsoAfterARestart()
        {
            AssetCache cache = Open();
            string a = Store(cache, "aaaa");
            string b = Store(cache, "bbbb");
            File.SetLastWriteTimeUtc(Path.Combine(folder, a), DateTime.UtcNow.AddHours(-2));
            File.SetLastWriteTimeUtc(Path.Combine(folder, b), DateTime.UtcNow.AddHours(-1));
            Assert.IsNotNull(Open().Read(a)); // used now
            cache = Open(10);
            string c = Store(cache, "cccc");
            Assert.IsTrue(cache.Contains(a) && cache.Contains(c));
            Assert.IsFalse(cache.Contains(b));
            Assert.AreEqual(1, Open(4).Count, "a smaller limit holds from the start");
        }

        [Test]
        public void AFolderThatCannotBeWrittenIsAState()
        {
            File.WriteAllText(folder, "a file in its place");
            DiskAssetFiles files = new DiskAssetFiles(folder);
            AssetCache cache = new AssetCache(files);
            byte[] bytes = { 1, 2, 3 };
            Assert.AreEqual(CacheResult.Unwritable, cache.Store(Hash(bytes), bytes, 0, 3));
            Assert.AreEqual(CacheResult.Unwritable, cache.State);
            Assert.IsNotEmpty(files.Problem);
            Assert.IsNull(cache.Read(Hash(bytes)));
        }

        private AssetCache Open(long limit = 1_000) { return new AssetCache(new DiskAssetFiles(folder), limit); }

        private static string Store(AssetCache cache, string text)
        {
            byte[] bytes = Encoding.ASCII.GetBytes(text);
            Assert.AreEqual(CacheResult.Kept, cache.Store(Hash(bytes), bytes, 0, bytes.Length));
            return Hash(bytes);
        }

        private static string Hash(byte[] bytes)
        {
            using (SHA256 hash = SHA256.Create()) return BitConverter.ToString(hash.ComputeHash(bytes)).Replace("-", "").ToLowerInvariant();
        }
    }
}
