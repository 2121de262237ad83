// The asset cache on files that fail.
using System;
using System.Collections.Generic;
using System.Security.Cryptography;
using NUnit.Framework;

namespace IrisSession.Core.Tests
{
    [TestFixture]
    public class AssetCacheTests
    {
        private sealed class Files : IAssetFiles
        {
            public readonly Dictionary<string, byte[]> Content = new Dictionary<string, byte[]>();
            public bool IsFull;
            public bool IsReadOnly;

            public IReadOnlyList<AssetFile> List()
            {
                List<AssetFile> found = new List<AssetFile>();
                foreach (KeyValuePair<string, byte[]> one in Content) found.Add(new AssetFile(one.Key, one.Value.Length, found.Count));
                return found;
            }

            public byte[] Read(string name, long maxBytes) { return Content.TryGetValue(name, out byte[] bytes) ? bytes : null; }

            public bool Write(string name, byte[] bytes, int offset, int count)
            {
                if (IsFull) return false;
                Content[name] = new byte[count];
                Array.Copy(bytes, offset, Content[name], 0, count);
                return true;
            }

            public void Touch(string name) { }

            public bool Delete(string name)
            {
                if (IsReadOnly) return false;
                Content.Remove(name);
                return true;
            }
        }

        [Test]
        public void WhatIsDamagedIsNeitherKeptNorRead()
        {
            Files files = new Files();
            AssetCache cache = new AssetCache(files);
            byte[] bytes = MakeAsset(1, 100);
            string address = Hash(bytes);
            Assert.AreEqual(CacheResult.Damaged, cache.Store(Hash(new byte[1]), bytes, 0, 100));
            Assert.AreEqual(CacheResult.Damaged, cache.Store("../" + address.Substring(3), bytes, 0, 100));
            Assert.AreEqual(CacheResult.Kept, cache.Store(address, bytes, 0, 100));
            Assert.AreEqual(bytes, cache.Read(address));
            files.Content[address][50] ^= 1;
            Assert.IsNull(cache.Read(address));
            Assert.AreEqual(1, cache.DamagedCount);
            Assert.AreEqual(0, cache.TotalBytes + files.Content.Count);
            Assert.AreEqual(CacheResult.Kept, cache.Store(address, bytes, 0, 100), "it can be fetched again");
        }

        [Test]
        public void AFullCacheIsAStateAndKeepsThePresentScene()
        {
            AssetCache cache = new AssetCache(new Files(), 250);
            byte[][] assets = { MakeAsset(1, 100), MakeAsset(2, 100), MakeAsset(3, 100), MakeAsset(4, 60) };
            for (int i = 0; i < 2; i++) cache.Store(Hash(assets[i]), assets[i], 0, 100);
            cache.Pin(new[] { new SceneAsset(Hash(assets[0]), 100, ""), new SceneAsset(Hash(assets[1]), 100, ""), new SceneAsset(Hash(assets[2]), 100, "") });
            Assert.AreEqual(CacheResult.Full, cache.Store(Hash(assets[2]), assets[2], 0, 100));
            Assert.AreEqual(CacheResult.Full, cache.State);
            Assert.AreEqual(2, cache.Count);
            Assert.AreEqual(0, cache.EvictedCount);
            Assert.AreEqual(CacheResult.Full, cache.Store(Hash(assets[3]), assets[3], 0, 60));
            cache.Pin(new SceneAsset[0]);
            Assert.AreEqual(CacheResult.Kept, cache.State, "another scene");
            Assert.AreEqual(CacheResult.Kept, cache.Store(Hash(assets[2]), assets[2], 0, 100));
            Assert.IsFalse(cache.Contains(Hash(assets[0])), "the one that was not used for longest");
            Assert.AreEqual(CacheResult.Full, cache.Store(Hash(MakeAsset(5, 251)), MakeAsset(5, 251), 0, 251), "larger than the cache");
            Assert.AreEqual(2, cache.Count, "nothing is evicted for what never fits");
            Assert.AreEqual(3, cache.UnkeptCount);
        }

        [Test]
        public void WhatTheSystemRefusesIsCounted()
        {
            Files files = new Files { IsFull = true };
            AssetCache cache = new AssetCache(files, 150);
            byte[] a = MakeAsset(1, 100);
            byte[] b = MakeAsset(2, 100);
            Assert.AreEqual(CacheResult.Unwritable, cache.Store(Hash(a), a, 0, 100));
            Assert.AreEqual(0, cache.TotalBytes);
            files.IsFull = false;
            Assert.AreEqual(CacheResult.Kept, cache.Store(Hash(a), a, 0, 100));
            files.IsReadOnly = true;
            Assert.AreEqual(CacheResult.Full, cache.Store(Hash(b), b, 0, 100), "nothing can be removed for it");
            Assert.AreEqual(100, cache.TotalBytes);
            files.IsReadOnly = false;
            cache.Clear();
            Assert.AreEqual(0, cache.TotalBytes + files.Content.Count);
        }

        private static byte[] MakeAsset(int seed, int count)
        {
            byte[] bytes = new byte[count];
            new Random(seed).NextBytes(bytes);
            return bytes;
        }

        private static string Hash(byte[] bytes)
        {
            using (SHA256 hash = SHA256.Create())
            {
                byte[] digest = hash.ComputeHash(bytes);
                return Golden.ToHex(digest, 0, digest.Length);
            }
        }
    }
}
