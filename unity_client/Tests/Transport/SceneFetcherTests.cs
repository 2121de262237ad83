// Assets over real sockets: in chunks, with connections that end, refusals, and bytes that are not those of their address.
using System;
using System.Collections.Generic;
using System.Security.Cryptography;
using System.Text;
using System.Threading;
using IrisSession.Core;
using IrisSession.Core.Tests;
using NUnit.Framework;

namespace IrisSession.Transport.Tests
{
    [TestFixture]
    public class SceneFetcherTests
    {
        private static readonly byte[] Asset = MakeAsset(1_700_000);
        private static readonly string Address = AddressOf(Asset);

        private static byte[] MakeAsset(int count)
        {
            byte[] bytes = new byte[count];
            new Random(5).NextBytes(bytes);
            return bytes;
        }

        private static string AddressOf(byte[] bytes)
        {
            using (SHA256 sha = SHA256.Create()) return Golden.ToHex(sha.ComputeHash(bytes), 0, 32);
        }

        /// <summary>Files in memory.</summary>
        internal sealed class MemoryFiles : IAssetFiles
        {
            public readonly Dictionary<string, byte[]> Files = new Dictionary<string, byte[]>();

            /// <summary>Called within every reading: a test may block there.</summary>
            public Action OnRead = () => { };

            public IReadOnlyList<AssetFile> List()
            {
                List<AssetFile> files = new List<AssetFile>();
                foreach (KeyValuePair<string, byte[]> one in Files) files.Add(new AssetFile(one.Key, one.Value.Length, 0));
                return files;
            }

            public byte[] Read(string name, long maxBytes)
            {
                OnRead();
                return Files.TryGetValue(name, out byte[] bytes) ? bytes : null;
            }

            public bool Write(string name, byte[] bytes, int offset, int count)
            {
                Files[name] = new byte[count];
                Buffer.BlockCopy(bytes, offset, Files[name], 0, count);
                return true;
            }

            public void Touch(string name)
            {
            }

            public bool Delete(string name)
            {
                Files.Remove(name);
                return true;
            }
        }

        /// <summary>Let a client follow the scene of a gateway until a condition holds. Its specification is random bytes: they arrive, and cannot be read.</summary>
        private static SceneFetcher Fetch(Action<Peer, string[], int> answer, MemoryFiles files, Func<SceneFetcher, bool> condition, TestCertificate certificate = null)
        {
            int asked = 0;
            void Serve(Peer peer)
            {
                string[] request = peer.ReadRequest();
                if (request[0].StartsWith("GET /v1/session", StringComparison.Ordinal))
                {
                    SessionClientTests.Serve(peer, null, request, Address);
                    return;
                }
                while (true)
                {
                    StringAssert.StartsWith("GET /v1/asset/" + Address + " ", request[0]);
                    answer(peer, request, asked++);
                    request = peer.ReadRequest();
                }
            }

            using (FakeGateway gateway = new FakeGateway(Serve, certificate))
            {
                SessionClient client = new SessionClient(
                    SessionClientTests.MakeHello(), new MemoryIdentity(), new EndpointChooser(gateway.MakeEndpoint(TestCertificate.First)), new WebTransport());
                SceneFetcher scene = new SceneFetcher(client, new AssetCache(files), SceneBudget.Quest3);
                client.Start();
                scene.Start();
                SessionClientTests.WaitUntil(() => condition(scene), "the scene does not get there");
                Assert.IsTrue(scene.Stop());
                Assert.IsTrue(client.Stop());
                Assert.AreEqual("", scene.Crash + client.Crash);
                return scene;
            }
        }

        [Test]
        public void WhatIsInMemoryDoesNotWaitForAFile()
        {
            MemoryFiles files = new MemoryFiles();
            string other = AddressOf(new byte[] { 1 });
            files.Files[other] = new byte[] { 1 };
            using (ManualResetEvent isBlocked = new ManualResetEvent(false))
            using (ManualResetEvent isReleased = new ManualResetEvent(false))
            {
                Fetch((peer, request, n) => SendPart(peer, request, Asset), files, scene =>
                {
                    if (!IsUnreadable(scene)) return false;
                    files.OnRead = () =>
                    {
                        isBlocked.Set();
                        isReleased.WaitOne();
                    };
                    Thread reader = new Thread(() => scene.Find(other));
                    reader.Start();
                    isBlocked.WaitOne();
                    Assert.IsNotNull(scene.Find(Address)); // had it waited for the file, the test would never end
                    isReleased.Set();
                    reader.Join();
                    return true;
                });
            }
        }

        [Test]
        public void FetchersOfOneCacheKeepEachOtherOut()
        {
            MemoryFiles files = new MemoryFiles();
            files.Files[Address] = Asset;
            AssetCache cache = new AssetCache(files);
            bool isLocked = false;
            files.OnRead = () => isLocked = Monitor.IsEntered(cache); // after a retry the one before may still read
            Assert.IsNotNull(new SceneFetcher(null, cache, SceneBudget.Quest3).Find(Address));
            Assert.IsTrue(isLocked);
        }

        private static bool IsUnreadable(SceneFetcher scene)
        {
            return scene.Progress.State == SceneState.Unreadable;
        }

        private static void SendPart(Peer peer, string[] request, byte[] asset, int most = int.MaxValue)
        {
            string range = Array.Find(request, line => line.StartsWith("Range: bytes=", StringComparison.Ordinal)).Substring(13);
            Assert.Contains("X-Iris-Ticket: T1", request);
            int first = int.Parse(range.Split('-')[0]);
            int count = Math.Min(most, Math.Min(asset.Length - 1, int.Parse(range.Split('-')[1])) - first + 1);
            byte[] part = new byte[count];
            Buffer.BlockCopy(asset, first, part, 0, count);
            peer.SendText("HTTP/1.1 206 Partial Content\r\nContent-Length: " + count + "\r\nContent-Range: bytes " + first + "-" + (first + count - 1) + "/" + asset.Length + "\r\n\r\n");
            peer.Send(part);
        }

        private static void Refuse(Peer peer, int status)
        {
            peer.SendText("HTTP/1.1 " + status + " No\r\nContent-Length: 4\r\n\r\nwhy.");
        }

        [TestCase(false)]
        [TestCase(true)]
        public void AnAssetComesInPartsAndIsKept(bool isSecure)
        {
            MemoryFiles files = new MemoryFiles();
            TestCertificate certificate = isSecure ? TestCertificate.First : null;
            SceneFetcher scene = Fetch((peer, request, i) => SendPart(peer, request, Asset), files, IsUnreadable, certificate);
            Assert.AreEqual(Asset.Length, scene.FetchedBytes);
            CollectionAssert.AreEqual(Asset, files.Files[Address]);
            // Another run of the app: nothing is requested.
            Assert.AreEqual(0, Fetch((peer, request, i) => Refuse(peer, 404), files, IsUnreadable, certificate).FetchedCount);
        }

        [Test]
        public void BytesThatTheCacheHasAreNotHeldOnceTheyAreBuilt()
        {
            bool IsReleased(SceneFetcher one)
            {
                if (!IsUnreadable(one)) return false;
                one.ReleaseBytes();
                return one.HeldBytes == 0;
            }

            SceneFetcher scene = Fetch((peer, request, i) => SendPart(peer, request, Asset), new MemoryFiles(), IsReleased);
            CollectionAssert.AreEqual(Asset, scene.Find(Address));
        }

        [Test]
        public void ShortPartsAndEndsOfConnectionsAreContinued()
        {
            void Answer(Peer peer, string[] request, int i)
            {
                SendPart(peer, request, Asset, 200_000);
                if (i % 4 == 3) throw new InvalidOperationException("the connection ends here");
            }

            SceneFetcher scene = Fetch(Answer, new MemoryFiles(), IsUnreadable);
            Assert.AreEqual(Asset.Length, scene.FetchedBytes);
            Assert.AreEqual(0, scene.DamagedCount);
        }

        [TestCase(503)]
        [TestCase(429)]
        [TestCase(401)]
        public void ARefusalThatPassesIsWaitedFor(int status)
        {
            void Answer(Peer peer, string[] request, int i)
            {
                if (i < 3) Refuse(peer, status);
                else SendPart(peer, request, Asset);
            }

            Assert.AreEqual(1, Fetch(Answer, new MemoryFiles(), IsUnreadable).FetchedCount);
        }

        [Test]
        public void OneThatIsNotThereIsSaid()
        {
            SceneFetcher scene = Fetch((peer, request, i) => Refuse(peer, 404), new MemoryFiles(), each => each.Progress.Text.Length > 0);
            Assert.AreEqual(SceneState.Fetching, scene.Progress.State);
        }

        [Test]
        public void OtherBytesAreRefusedTwiceAndNotKept()
        {
            byte[] other = (byte[])Asset.Clone();
            other[1_000_000] ^= 1;
            MemoryFiles files = new MemoryFiles();
            SceneFetcher scene = Fetch((peer, request, i) => SendPart(peer, request, other), files, each => each.Progress.Text.Length > 0);
            Assert.GreaterOrEqual(scene.DamagedCount, 2);
            Assert.AreEqual(0, scene.FetchedCount);
            CollectionAssert.IsEmpty(files.Files);
        }

        [TestCase("Content-Range: bytes 0-9/1700000")] // of another length
        [TestCase("Content-Range: bytes 5-14/1700000")]
        [TestCase("Content-Range: bytes 0-9/5")]
        [TestCase("Content-Range: x")]
        [TestCase("X: y")]
        public void AnswersThatContradictThemselvesEndTheConnection(string header)
        {
            int answers = 0;
            HashSet<Peer> seen = new HashSet<Peer>();
            void Answer(Peer peer, string[] request, int i)
            {
                lock (seen) Assert.IsTrue(seen.Add(peer), "another request on the same connection");
                Interlocked.Exchange(ref answers, i + 1);
                peer.SendText("HTTP/1.1 206 Partial Content\r\nContent-Length: 11\r\n" + header + "\r\n\r\n");
                peer.Send(new byte[11]);
            }

            SceneFetcher scene = Fetch(Answer, new MemoryFiles(), each => Volatile.Read(ref answers) > 2);
            Assert.AreEqual(0, scene.FetchedBytes);
        }

        [Test]
        public void AGatewayThatStallsWithinAnAnswerDoesNotDelayTheEnd()
        {
            using (ManualResetEvent isAsked = new ManualResetEvent(false))
            using (ManualResetEvent isOver = new ManualResetEvent(false))
            {
                void Answer(Peer peer, string[] request, int i)
                {
                    peer.SendText("HTTP/1.1 206 Partial Content\r\nContent-Length: 100\r\nContent-Range: bytes 0-99/1700000\r\n\r\nxyz");
                    isAsked.Set();
                    isOver.WaitOne();
                }

                Fetch(Answer, new MemoryFiles(), each => isAsked.WaitOne(0));
                isOver.Set();
            }
        }
    }
}
