// The transport over real sockets, without a session.
using System;
using System.Collections.Generic;
using System.Net;
using System.Net.Sockets;
using System.Threading;
using IrisSession.Protocol;
using NUnit.Framework;

namespace IrisSession.Transport.Tests
{
    [TestFixture]
    public class WebTransportTests
    {
        [Test]
        public void WishesAreSentWhenTheyChangeHoweverManyThereAre()
        {
            int wishes = 0;
            int newest = 0;
            void Serve(Peer peer)
            {
                string[] request = peer.ReadRequest();
                bool isMedia = request[0].StartsWith("GET /v1/media", StringComparison.Ordinal);
                peer.AcceptWebSocket(int.MaxValue, request);
                if (!isMedia)
                {
                    WireWriter ticket = new WireWriter();
                    ticket.WriteMapHeader(2);
                    foreach (string text in new[] { "type", "ticket", "ticket", "T1" }) ticket.Write(text);
                    peer.Send(Peer.MakeFrame(0x82, Peer.MakeMessage(WebMessage.Gateway, ticket.ToArray())));
                }
                while (true)
                {
                    KeyValuePair<int, byte[]> frame = peer.ReadFrame();
                    if (frame.Key == 0x88) return;
                    if (!isMedia || frame.Key != 0x82 || frame.Value[0] != WebMessage.Wishes) continue;
                    Interlocked.Increment(ref wishes);
                    Volatile.Write(ref newest, frame.Value[WebMessage.HeadBytes]);
                }
            }

            List<string> many = new List<string>();
            for (int i = 0; i < 17; i++) many.Add("cloud/" + i);
            using (FakeGateway gateway = new FakeGateway(Serve))
            using (WebTransport transport = new WebTransport())
            {
                transport.Open(gateway.MakeEndpoint());
                void Run(IReadOnlyList<string> streams, Func<bool> condition)
                {
                    SessionClientTests.WaitUntil(() =>
                    {
                        transport.SetMedia(streams, 1);
                        transport.Tick(MonotonicClock.NowNs);
                        return condition();
                    }, "no wishes");
                }

                Run(many, () => Volatile.Read(ref wishes) > 0);
                for (int i = 0; i < 100; i++) transport.SetMedia(many, 1);
                Run(new[] { "cloud/0" }, () => Volatile.Read(ref newest) == 0x91);
                Assert.AreEqual(2, wishes);
            }
        }

        [Test]
        public void AnAddressThatSwallowsEverythingLeavesTimeForTheNext()
        {
            TcpListener right = new TcpListener(IPAddress.Loopback, 0);
            right.Start();
            int port = ((IPEndPoint)right.LocalEndpoint).Port;
            IPAddress other = IPAddress.Parse("127.0.0.2");
            List<Socket> sockets = new List<Socket>();
            Socket Make()
            {
                Socket made = new Socket(AddressFamily.InterNetwork, SocketType.Stream, ProtocolType.Tcp) { Blocking = false };
                sockets.Add(made);
                return made;
            }

            try
            {
                Socket full = Make();
                full.Bind(new IPEndPoint(other, port));
                full.Listen(1);
                for (int i = 0; i < 8; i++) // they fill its backlog: the system answers no more
                {
                    try
                    {
                        Make().Connect(new IPEndPoint(other, port));
                    }
                    catch (SocketException)
                    {
                        // it is on its way
                    }
                }
                long deadlineNs = MonotonicClock.NowNs + 20_000_000_000;
                using (InterruptibleStream stream = InterruptibleStream.Connect("lab", new[] { other, IPAddress.Loopback }, port, deadlineNs, new Interrupt()))
                {
                    Assert.AreEqual(deadlineNs, stream.DeadlineNs);
                    Assert.Less(MonotonicClock.NowNs, deadlineNs);
                }
            }
            finally
            {
                foreach (Socket one in sockets) one.Close();
                right.Stop();
            }
        }
    }
}
