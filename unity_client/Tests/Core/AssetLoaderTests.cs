// Order, number and size of chunk requests against a session of plain values, and its misbehaviour.
using System;
using System.Collections.Generic;
using IrisSession.Protocol;
using NUnit.Framework;

namespace IrisSession.Core.Tests
{
    [TestFixture]
    public class AssetLoaderTests
    {
        private const int Chunk = 512 << 10;
        private const int Window = 6 << 20;
        private const long Ms = 1_000_000;

        [Test]
        public void ChunkSizeFollowsTheLinkRate()
        {
            AssetLoader loader = Start("a");
            long now = 0;
            List<int> lengths = new List<int>();
            foreach (long took in new[] { 1, 1, 100 * Ms, 2001 * Ms, 2001 * Ms, 2001 * Ms, 2001 * Ms, 2001 * Ms, 2001 * Ms, 1, 0 })
            {
                ChunkRequest ask = Take(loader, now)[0];
                lengths.Add(ask.Length >> 10);
                now += took;
                Assert.AreEqual(AssetOutcome.Store, Answer(loader, ask, 100L * Window, now));
                loader.OnStored(ask.Length);
                loader.OnLinkClosed();
            }
            Assert.AreEqual(new[] { 512, 1024, 1024, 1024, 512, 256, 128, 64, 64, 64, 128 }, lengths);
        }

        [Test]
        public void TemporaryRefusalsAreRetriedWithGrowingDelay()
        {
            AssetLoader loader = Start("a");
            long now = 0;
            foreach (long pause in new[] { 50 * Ms, 100 * Ms, 200 * Ms })
            {
                ChunkRequest ask = Take(loader, now)[0];
                Assert.AreEqual(AssetOutcome.Later, loader.ProcessRefusal(ask.RequestId, AssetRefusal.Busy, "advice", now, out _));
                Assert.AreEqual("busy: advice", loader.Refusal);
                Assert.AreEqual(0, Take(loader, now + pause - 1).Count);
                now += pause;
            }
            Assert.AreEqual(AssetOutcome.Store, Answer(loader, Take(loader, now)[0], Chunk + 5, now + 100 * Ms));
            Assert.AreEqual("", loader.Refusal);
            Answer(loader, Take(loader, now)[0], Chunk + 5, now);
            Assert.IsTrue(loader.IsComplete("a"));
        }

        [Test]
        public void PartIsDiscardedOnce()
        {
            AssetLoader loader = Start("a", 1000);
            Assert.AreEqual(AssetOutcome.Restart, loader.ProcessRefusal(Take(loader, 0)[0].RequestId, AssetRefusal.BadRange, "", 0, out string address));
            Assert.AreEqual("a", address);
            loader.OnMissing("a", 0);
            ChunkRequest ask = Take(loader, 0)[0];
            Assert.AreEqual(AssetOutcome.Store, loader.ProcessChunk(ask.RequestId, "a", 0, 1_000_000_000, 1000, 0));
            Assert.AreEqual(AssetOutcome.Failed, loader.ProcessRefusal(Take(loader, 0)[0].RequestId, AssetRefusal.BadRange, "", 0, out _));
            Assert.AreEqual(AssetRefusal.BadRange, loader.FailureReason);
            Assert.IsTrue(loader.Add("a"));
        }

        [TestCase(100, 0)] // nothing, where there is something
        [TestCase(1L << 30, Chunk + 1)] // more than requested
        [TestCase(4, 5)] // more than there is
        [TestCase((1L << 30) + (1L << 20) + 1, Chunk)] // above the maximum
        [TestCase(-5L, 0)]
        public void ContradictingAnswersAreRejected(long total, int size)
        {
            AssetLoader loader = Start("a");
            ChunkRequest ask = Take(loader, 0)[0];
            Assert.AreEqual(AssetOutcome.Failed, loader.ProcessChunk(ask.RequestId, "a", 0, total, size, 0));
            Assert.AreEqual("protocol", loader.FailureReason);
            Assert.IsTrue(loader.IsIdle);
            Assert.AreEqual(AssetOutcome.Unasked, loader.ProcessChunk(ask.RequestId, "a", 0, total, size, 0));
            Assert.AreEqual(AssetOutcome.Unasked, loader.ProcessRefusal(99, AssetRefusal.Unknown, "", 0, out _));
        }

        [Test]
        public void AllAssetsCompleteDespiteRandomFaults()
        {
            for (int seed = 0; seed < 8; seed++)
            {
                Random random = new Random(seed);
                int[] choices = { 0, 5, Chunk, 3 * Chunk + 1, 2 * Window };
                Dictionary<string, long> sizes = new Dictionary<string, long>();
                Dictionary<string, long> got = new Dictionary<string, long>();
                AssetLoader loader = new AssetLoader();
                for (int i = 0; i < 40; i++)
                {
                    sizes["" + i] = choices[random.Next(choices.Length)];
                    got["" + i] = 0;
                    loader.Add("" + i);
                }
                List<ChunkRequest> asks = new List<ChunkRequest>();
                Queue<int> unstored = new Queue<int>();
                List<string> lookups = new List<string>();
                for (long now = 0; !loader.IsIdle; now += 20 * Ms)
                {
                    Assert.Less(now, 3600 * 1000 * Ms, "it does not end");
                    lookups.Clear();
                    loader.TakeLookups(lookups);
                    foreach (string address in lookups) loader.OnMissing(address, 0);
                    loader.TakeRequests(now, asks);
                    long outstanding = 0;
                    foreach (ChunkRequest ask in asks) outstanding += ask.Length;
                    foreach (int size in unstored) outstanding += size;
                    Assert.LessOrEqual(outstanding, (long)Window);
                    for (int n = random.Next(6); n > 0 && asks.Count > 0; n--)
                    {
                        ChunkRequest ask = asks[0];
                        asks.RemoveAt(0);
                        int fault = random.Next(20);
                        if (fault == 0)
                        {
                            asks.Clear();
                            loader.OnLinkLost(now);
                        }
                        else if (fault == 1) loader.ProcessRefusal(ask.RequestId, AssetRefusal.Busy, "", now, out _);
                        else if (fault == 2 && asks.Count > 0) continue; // lost: its successor is answered
                        else
                        {
                            long total = sizes[ask.Address];
                            int size = (int)Math.Max(0, Math.Min(ask.Length, total - ask.Offset));
                            if (fault == 3 && size > 1) size /= 2;
                            if (loader.ProcessChunk(ask.RequestId, ask.Address, ask.Offset, total, size, now) != AssetOutcome.Store) continue;
                            Assert.AreEqual(got[ask.Address], ask.Offset);
                            got[ask.Address] += size;
                            unstored.Enqueue(size);
                            if (loader.IsComplete(ask.Address)) loader.Remove(ask.Address);
                        }
                    }
                    while (unstored.Count > 0 && random.Next(3) > 0) loader.OnStored(unstored.Dequeue());
                }
                Assert.AreEqual(sizes, got);
            }
        }

        private static AssetLoader Start(string address, long offset = 0)
        {
            AssetLoader loader = new AssetLoader();
            Assert.IsTrue(loader.Add(address));
            Assert.IsFalse(loader.Add(address));
            loader.TakeLookups(new List<string>());
            loader.OnMissing(address, offset);
            return loader;
        }

        private static List<ChunkRequest> Take(AssetLoader loader, long now)
        {
            List<ChunkRequest> requests = new List<ChunkRequest>();
            loader.TakeRequests(now, requests);
            return requests;
        }

        private static AssetOutcome Answer(AssetLoader loader, ChunkRequest ask, long total, long now)
        {
            return loader.ProcessChunk(ask.RequestId, ask.Address, ask.Offset, total, (int)Math.Min(ask.Length, total - ask.Offset), now);
        }
    }
}
