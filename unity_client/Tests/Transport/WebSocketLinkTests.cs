// The WebSocket over real sockets on loopback, plain and by TLS.
using System;
using System.Collections.Generic;
using System.Threading;
using IrisSession.Core;
using IrisSession.Core.Tests;
using NUnit.Framework;

namespace IrisSession.Transport.Tests
{
    /// <summary>Collects what a link says.</summary>
    internal sealed class Collector : ILinkListener
    {
        public readonly List<string> Messages = new List<string>();
        public bool TakesMessages = true;
        private bool isOpen;
        private bool hasEnded;

        public void OnOpen(WebSocketLink link)
        {
            lock (this)
            {
                isOpen = true;
                Monitor.PulseAll(this);
            }
        }

        public bool OnMessage(WebSocketLink link, int channel, ref Multipart message)
        {
            lock (this)
            {
                string text = channel.ToString();
                for (int i = 0; i < message.Count; i++)
                {
                    int length = message.LengthOf(i);
                    text += " " + (length > 100 ? length + " bytes" : Golden.ToHex(message.Buffer, message.OffsetOf(i), length));
                }
                Messages.Add(text);
                Monitor.PulseAll(this);
                return TakesMessages;
            }
        }

        public void OnEnd(WebSocketLink link)
        {
            lock (this)
            {
                hasEnded = true;
                Monitor.PulseAll(this);
            }
        }

        public void WaitForOpen()
        {
            Wait(() => isOpen || hasEnded);
            Assert.IsTrue(isOpen);
        }

        public void WaitForEnd()
        {
            Wait(() => hasEnded);
        }

        public void WaitForMessages(int count)
        {
            Wait(() => Messages.Count >= count || hasEnded);
        }

        private void Wait(Func<bool> condition)
        {
            lock (this) while (!condition()) Assert.IsTrue(Monitor.Wait(this, Patience.Ms), "nothing happened");
        }
    }

    /// <summary>How long a test waits for what must happen: a generous limit, not a measurement.</summary>
    internal static class Patience
    {
        public const int Ms = 30_000;
    }

    [TestFixture]
    public class WebSocketLinkTests
    {
        private static WebSocketLink StartLink(WebEndpoint endpoint, Collector collector, int maxBytes = 1 << 20, int lingerMs = 300)
        {
            WebSocketLink link = new WebSocketLink(endpoint, "/v1/session", maxBytes, collector, false, 1_000_000L * lingerMs);
            link.Start();
            return link;
        }

        private static LinkEnd GetEnd(WebSocketLink link, Collector collector)
        {
            collector.WaitForEnd();
            Assert.IsTrue(link.Join(Patience.Ms), "a thread is left");
            return link.End;
        }

        [TestCase(false)]
        [TestCase(true)]
        public void MessagesGoBothWays(bool isSecure)
        {
            byte[] large = new byte[300_000];
            void Serve(Peer peer)
            {
                Assert.AreEqual("/v1/session", peer.AcceptWebSocket());
                byte[] got = peer.ReadFrame().Value;
                byte[] ours = Peer.MakeMessage(2, got, large);
                peer.Send(Peer.MakeFrame(0x89, new byte[] { 7 }));
                byte[] pong = peer.ReadFrame().Value;
                peer.Send(Peer.MakeFrame(0x82, Peer.MakeMessage(5, pong)));
                peer.Send(Peer.MakeFrame(0x82, ours));
                peer.Send(Peer.MakeFrame(0x88, new byte[] { 0x0f, 0xa0, (byte)'x' }));
                peer.ReadToEnd();
            }

            using (FakeGateway gateway = new FakeGateway(Serve, isSecure ? TestCertificate.First : null))
            {
                Collector collector = new Collector();
                WebSocketLink link = StartLink(gateway.MakeEndpoint(TestCertificate.First), collector);
                collector.WaitForOpen();
                Assert.AreEqual(isSecure, link.CertificateKey != null);
                Assert.IsTrue(link.TrySend(1, new byte[] { 1, 2 }, 2));
                LinkEnd end = GetEnd(link, collector);
                CollectionAssert.AreEqual(new[] { "5 07", "2 0101020000000102 300000 bytes" }, collector.Messages);
                Assert.AreEqual(LinkFailure.Closed, end.Failure);
                Assert.AreEqual(4000, end.Code);
                Assert.AreEqual("x", end.Text);
                Assert.IsFalse(link.TrySend(1, new byte[1], 1));
            }
        }

        [TestCase(false)]
        [TestCase(true)]
        public void BytesThatComeOneByOneAreRead(bool isSecure)
        {
            void Serve(Peer peer)
            {
                peer.AcceptWebSocket(1);
                peer.Send(Peer.MakeFrame(0x02, new byte[] { 2, 1 }), 1);
                peer.Send(Peer.MakeFrame(0x80, new byte[] { 1, 0, 0, 0, 9 }), 1);
                peer.ReadToEnd();
            }

            using (FakeGateway gateway = new FakeGateway(Serve, isSecure ? TestCertificate.First : null))
            {
                Collector collector = new Collector();
                WebSocketLink link = StartLink(gateway.MakeEndpoint(TestCertificate.First), collector);
                collector.WaitForMessages(1);
                CollectionAssert.AreEqual(new[] { "2 09" }, collector.Messages);
                link.Stop();
                Assert.AreEqual(LinkFailure.None, GetEnd(link, collector).Failure);
            }
        }

        [TestCase(true, LinkFailure.WrongCertificate)]
        [TestCase(false, LinkFailure.UnknownCertificate)]
        public void AnotherKeyIsRefusedBeforeAnythingIsSent(bool isPinned, LinkFailure expected)
        {
            bool isAsked = false;
            using (FakeGateway gateway = new FakeGateway(peer => { peer.ReadRequest(); isAsked = true; }, TestCertificate.Second))
            {
                Collector collector = new Collector();
                WebSocketLink link = StartLink(gateway.MakeEndpoint(isPinned ? TestCertificate.First : null), collector);
                LinkEnd end = GetEnd(link, collector);
                Assert.AreEqual(expected, end.Failure, end.ToString());
                CollectionAssert.AreEqual(TestCertificate.Second.Hash, end.CertificateHash);
                Assert.AreEqual(Fingerprint.OfCertificate(TestCertificate.Second.Load().GetRawCertData()), end.Fingerprint);
            }
            Assert.IsFalse(isAsked);
        }

        [TestCase("HTTP/1.1 421 Misdirected Request\r\nContent-Length: 5\r\n\r\nother", LinkFailure.NotAGateway, 421)]
        [TestCase("HTTP/1.1 101 Switching Protocols\r\nUpgrade: websocket\r\nConnection: upgrade\r\nSec-WebSocket-Accept: x\r\nSec-WebSocket-Protocol: iris-session.1\r\n\r\n", LinkFailure.NotAGateway, 0)]
        [TestCase("SSH-2.0-OpenSSH_9.2\r\n\r\n", LinkFailure.NotAGateway, 0)]
        [TestCase("", LinkFailure.Unreachable, 0)]
        public void WhatIsNoGatewayIsSaid(string answer, LinkFailure expected, int code)
        {
            void Serve(Peer peer)
            {
                peer.ReadRequest();
                peer.SendText(answer);
            }

            using (FakeGateway gateway = new FakeGateway(Serve))
            {
                Collector collector = new Collector();
                LinkEnd end = GetEnd(StartLink(gateway.MakeEndpoint(), collector), collector);
                Assert.AreEqual(expected, end.Failure, end.ToString());
                Assert.AreEqual(code, end.Code);
            }
        }

        [Test]
        public void AServerWithoutTlsIsSaid()
        {
            using (FakeGateway gateway = new FakeGateway(peer => peer.SendText("HTTP/1.1 400 Bad Request\r\n\r\n")))
            {
                Collector collector = new Collector();
                LinkEnd end = GetEnd(StartLink(new WebEndpoint(true, "localhost", gateway.Port, TestCertificate.First.Hash), collector), collector);
                Assert.AreEqual(LinkFailure.NotAGateway, end.Failure, end.ToString());
            }
        }

        [Test]
        public void ARefusedConnectionIsSaid()
        {
            int port;
            using (FakeGateway gateway = new FakeGateway(peer => { })) port = gateway.Port;
            Collector collector = new Collector();
            Assert.AreEqual(LinkFailure.Unreachable, GetEnd(StartLink(new WebEndpoint(false, "localhost", port), collector), collector).Failure);
        }

        [Test]
        public void AMessageAboveTheLimitEndsIt()
        {
            int closeCode = 0;
            using (ManualResetEvent closed = new ManualResetEvent(false))
            {
                void Serve(Peer peer)
                {
                    peer.AcceptWebSocket();
                    peer.Send(Peer.MakeFrame(0x82, new byte[2000]));
                    byte[] close = peer.ReadFrame().Value;
                    closeCode = close[0] << 8 | close[1];
                    closed.Set();
                }

                using (FakeGateway gateway = new FakeGateway(Serve))
                {
                    Collector collector = new Collector();
                    LinkEnd end = GetEnd(StartLink(gateway.MakeEndpoint(), collector, 1000, Patience.Ms), collector);
                    Assert.AreEqual(LinkFailure.Protocol, end.Failure);
                    Assert.IsTrue(closed.WaitOne(Patience.Ms));
                    Assert.AreEqual(1009, closeCode);
                }
            }
        }

        [Test]
        public void AReaderThatTakesNothingEndsIt()
        {
            void Serve(Peer peer)
            {
                peer.AcceptWebSocket();
                peer.Send(Peer.MakeFrame(0x82, Peer.MakeMessage(1, new byte[1])));
                peer.ReadToEnd();
            }

            using (FakeGateway gateway = new FakeGateway(Serve))
            {
                Collector collector = new Collector { TakesMessages = false };
                Assert.AreEqual(LinkFailure.Overflow, GetEnd(StartLink(gateway.MakeEndpoint(), collector), collector).Failure);
            }
        }

        [TestCase(false)]
        [TestCase(true)]
        public void AServerThatReadsNothingFillsABoundedQueueAndStopEndsIt(bool isSecure)
        {
            using (ManualResetEvent done = new ManualResetEvent(false))
            using (FakeGateway gateway = new FakeGateway(peer => { peer.AcceptWebSocket(); done.WaitOne(); }, isSecure ? TestCertificate.First : null))
            {
                Collector collector = new Collector();
                WebSocketLink link = StartLink(gateway.MakeEndpoint(TestCertificate.First), collector);
                collector.WaitForOpen();
                byte[] bytes = new byte[8000];
                int taken = 0;
                int full = 0;
                while (full < 1000) // what the system keeps for a socket is bounded too
                {
                    if (link.TrySend(1, bytes, bytes.Length))
                    {
                        taken++;
                        full = 0;
                    }
                    else
                    {
                        full++;
                        Thread.Yield();
                    }
                    Assert.Less(taken, 20_000);
                }
                link.Stop();
                GetEnd(link, collector);
                done.Set();
            }
        }

        [TestCase(false)]
        [TestCase(true)]
        public void PartialWritesAreContinued(bool isSecure)
        {
            const int Total = 200;
            List<int> wrong = new List<int>();
            int read = 0;
            using (ManualResetEvent isFull = new ManualResetEvent(false))
            {
                void Serve(Peer peer)
                {
                    peer.AcceptWebSocket();
                    isFull.WaitOne(); // until then it reads nothing
                    for (; read < Total; read++)
                    {
                        byte[] got = peer.ReadFrame().Value;
                        for (int i = 6; i < got.Length; i++) if (got[i] != (byte)(read + i - 6)) wrong.Add(read);
                    }
                    peer.Send(Peer.MakeFrame(0x88, new byte[] { 3, 0xe8 }));
                    peer.ReadToEnd();
                }

                using (FakeGateway gateway = new FakeGateway(Serve, isSecure ? TestCertificate.First : null))
                {
                    Collector collector = new Collector();
                    WebSocketLink link = StartLink(gateway.MakeEndpoint(TestCertificate.First), collector);
                    collector.WaitForOpen();
                    byte[] bytes = new byte[40_000];
                    for (int sent = 0, full = 0; sent < Total;)
                    {
                        for (int i = 0; i < bytes.Length; i++) bytes[i] = (byte)(sent + i);
                        if (link.TrySend(1, bytes, bytes.Length)) sent++;
                        else if (++full > 2000) isFull.Set();
                        Thread.Yield();
                    }
                    isFull.Set();
                    GetEnd(link, collector);
                    Assert.AreEqual(Total, read);
                    CollectionAssert.IsEmpty(wrong);
                }
            }
        }

        [Test]
        public void WhatWaitsIsSentBeforeTheEnd()
        {
            List<int> opcodes = new List<int>();
            using (ManualResetEvent closed = new ManualResetEvent(false))
            {
                void Serve(Peer peer)
                {
                    peer.AcceptWebSocket();
                    for (int i = 0; i < 4; i++) opcodes.Add(peer.ReadFrame().Key);
                    closed.Set();
                }

                using (FakeGateway gateway = new FakeGateway(Serve))
                {
                    Collector collector = new Collector();
                    WebSocketLink link = StartLink(gateway.MakeEndpoint(), collector, lingerMs: Patience.Ms);
                    collector.WaitForOpen();
                    for (int i = 0; i < 3; i++) Assert.IsTrue(link.TrySend(1, new byte[1], 1));
                    link.Stop();
                    Assert.AreEqual(LinkFailure.None, GetEnd(link, collector).Failure);
                    Assert.IsTrue(closed.WaitOne(Patience.Ms));
                    CollectionAssert.AreEqual(new[] { 0x82, 0x82, 0x82, 0x88 }, opcodes);
                }
            }
        }
    }
}
