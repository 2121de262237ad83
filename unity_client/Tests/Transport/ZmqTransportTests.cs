// The transport over ZeroMQ with the sockets of a session, on loopback.
using System;
using System.Net;
using System.Net.Sockets;
using System.Runtime.InteropServices;
using System.Text;
using IrisSession.Core;
using IrisSession.Protocol;
using NUnit.Framework;

namespace IrisSession.Transport.Tests
{
    [TestFixture]
    public class ZmqTransportTests
    {
        private const int Pub = 1, Router = 6, Xpub = 9, LastEndpoint = 32, CurveServer = 47;

        /// <summary>Sockets of a session. `secret`: encrypted.</summary>
        private sealed class Session : IDisposable
        {
            private readonly IntPtr context = LibZmq.zmq_ctx_new();
            private readonly Multipart message = new Multipart();
            public readonly LibZmqSocket Control, State, Media, Assets;
            public readonly Welcome Welcome = new Welcome { SessionId = "s1", ConnectionEpoch = 12 };
            public readonly WebEndpoint Endpoint;

            public Session(string secret = null)
            {
                LibZmqSocket Bind(int kind, Action<int> tell)
                {
                    LibZmqSocket socket = new LibZmqSocket(context, kind);
                    if (secret != null) socket.Set(CurveServer, 1);
                    if (secret != null) socket.Set(LibZmq.CurveSecretKey, Encoding.ASCII.GetBytes(secret));
                    tell(BindLoopback(socket));
                    return socket;
                }

                int port = 0;
                Control = Bind(Router, found => port = found);
                State = Bind(Pub, found => Welcome.Endpoints.State = found);
                Media = Bind(Xpub, found => Welcome.Endpoints.Media = found);
                Assets = Bind(Router, found => Welcome.Endpoints.Assets = found);
                Endpoint = new WebEndpoint(false, "127.0.0.1", port);
            }

            /// <summary>Take the frames of a message as text, null for none.</summary>
            public string[] Take(LibZmqSocket socket)
            {
                if (!socket.TryReceive(message)) return null;
                string[] frames = new string[message.Count];
                for (int i = 0; i < frames.Length; i++) frames[i] = Encoding.GetEncoding(28591).GetString(message.Buffer, message.OffsetOf(i), message.LengthOf(i));
                return frames;
            }

            public void Send(LibZmqSocket socket, params object[] frames)
            {
                for (int i = 0; i < frames.Length; i++)
                {
                    byte[] bytes = frames[i] as byte[] ?? Encoding.GetEncoding(28591).GetBytes((string)frames[i]);
                    Assert.IsTrue(socket.TrySend(bytes, bytes.Length, i < frames.Length - 1));
                }
            }

            public byte[] Encode(ServerMessage one)
            {
                WireWriter writer = new WireWriter();
                new ServerEnvelope { Version = Wire.Version, ConnectionEpoch = 12, Message = one }.WriteTo(writer);
                return writer.ToArray();
            }

            public void Dispose()
            {
                foreach (LibZmqSocket socket in new[] { Control, State, Media, Assets }) socket.Dispose();
                LibZmq.zmq_ctx_term(context);
            }
        }

        [DllImport(LibZmq.Library)]
        private static extern int zmq_getsockopt(IntPtr socket, int option, byte[] value, ref UIntPtr length);

        [DllImport(LibZmq.Library)]
        private static extern int zmq_curve_keypair(byte[] publicKey, byte[] secretKey);

        /// <summary>Bind to a free port. Returns it.</summary>
        private static int BindLoopback(LibZmqSocket socket)
        {
            LibZmq.zmq_bind(socket.Handle, Encoding.ASCII.GetBytes("tcp://127.0.0.1:*\0"));
            byte[] address = new byte[64];
            UIntPtr length = (UIntPtr)address.Length;
            zmq_getsockopt(socket.Handle, LastEndpoint, address, ref length);
            string text = Encoding.ASCII.GetString(address, 0, (int)length - 1);
            return int.Parse(text.Substring(text.LastIndexOf(':') + 1));
        }

        private Session session;
        private ZmqTransport transport;
        private Multipart message;

        [Test]
        public void ChannelsAreThoseThatTheWelcomeNames()
        {
            using (session = new Session())
            using (transport = new ZmqTransport(null))
            {
                message = new Multipart();
                Join(out string client);
                session.Send(session.Control, client, session.Encode(new Feedback { Robot = "left" }), "bulk");
                WaitFor(() => transport.TryTakeControl(ref message), "the next message");
                Assert.AreEqual(2, message.Count);

                int published = 0;
                WaitFor(() =>
                {
                    session.Send(session.State, "rigid", new[] { (byte)++published }, "x");
                    session.Send(session.State, "other", "0", "x");
                    return transport.TryTakeState(ref message);
                }, "state");
                Assert.AreEqual("rigid", Text(0));

                transport.SetMedia(new[] { "cloud" }, 12);
                transport.SetMedia(new[] { "cloud" }, 12);
                string[] asked = null;
                WaitFor(() => (asked = session.Take(session.Media)) != null, "a subscription");
                Assert.AreEqual("\u0001media/12/cloud/", asked[0]);
                session.Send(session.Media, "media/12/cloud/full", "header", "old");
                session.Send(session.Media, "media/12/cloud/full", "header", "new");
                WaitFor(() => transport.TryTakeMedia(ref message) && Text(2) == "new", "the newest frame");
                transport.SetMedia(new string[0], 12);
                WaitFor(() => (asked = session.Take(session.Media)) != null, "its end");
                Assert.AreEqual("\u0000media/12/cloud/", asked[0]);

                session.Control.Dispose();
                WaitFor(() => !transport.TryTakeControl(ref message) && transport.State == TransportState.Closed, "the end");
                Assert.AreEqual(LinkFailure.Unreachable, transport.End.Failure);
            }
        }

        [Test]
        public void AssetsAreAnsweredInTheOrderOfTheirRequests()
        {
            using (session = new Session())
            using (transport = new ZmqTransport(null))
            {
                message = new Multipart();
                Assert.IsNull(transport.OpenAssets());
                Join(out _);
                using (IAssetChannel channel = transport.OpenAssets())
                {
                    Assert.IsTrue(channel.TryRequest(new ChunkRequest(7, "aa", 2, 10)));
                    Assert.IsTrue(channel.TryRequest(new ChunkRequest(8, "bb", 0, 10)));
                    string[] asked = null;
                    WaitFor(() => (asked = session.Take(session.Assets)) != null, "a request");
                    session.Send(session.Assets, asked[0], new AssetChunk { Version = 1, RequestId = 7, Address = "aa", Offset = 2, Total = 5 }.Encode(), "abc");
                    session.Send(session.Assets, asked[0], new AssetRefused { Version = 1, RequestId = 8, Address = "bb", Reason = AssetRefusal.Unknown }.Encode());
                    AssetAnswer answer = new AssetAnswer();
                    Assert.IsTrue(channel.TryReceive(answer));
                    Assert.AreEqual(5, answer.Total);
                    Assert.AreEqual("abc", Encoding.ASCII.GetString(answer.Bytes, 0, answer.Count));
                    Assert.IsTrue(channel.TryReceive(answer));
                    Assert.AreEqual(AssetRefusal.Unknown, answer.Reason);
                    Assert.IsTrue(channel.IsCurrent);
                    transport.Close();
                    Assert.IsFalse(channel.IsCurrent);
                    Assert.IsFalse(channel.TryRequest(new ChunkRequest(9, "aa", 0, 1)));
                }
            }
        }

        [Test]
        public void EncryptedSessionAnswersThoseWhoKnowItsKey()
        {
            ZmqKeys server = MakePair("");
            using (session = new Session(server.Secret))
            {
                message = new Multipart();
                using (transport = new ZmqTransport(MakePair(server.Public))) Join(out _);
                using (transport = new ZmqTransport(null))
                {
                    transport.Open(session.Endpoint);
                    WaitFor(() => !transport.TryTakeControl(ref message) && transport.State == TransportState.Closed, "a refusal");
                    Assert.AreNotEqual(LinkFailure.None, transport.End.Failure);
                }
            }
        }

        [Test]
        public void NothingIsSentInTheClearToASessionThatIsEncrypted()
        {
            using (session = new Session())
            using (transport = new ZmqTransport(null))
            {
                transport.Open(new WebEndpoint(true, session.Endpoint.Host, session.Endpoint.Port));
                Assert.AreEqual(TransportState.Closed, transport.State);
                Assert.AreEqual(CloseCode.NotAllowed, transport.End.Code);
                message = new Multipart();
                Join(out _); // another endpoint, without encryption
            }
            string bad = new string('~', 40);
            Assert.Throws<ArgumentException>(() => new ZmqTransport(new ZmqKeys(bad, bad, bad)));
        }

        [Test]
        public void APeerThatCannotEncryptIsTakenForNoSession()
        {
            byte[] spoken = { 0xff, 0, 0, 0, 0, 0, 0, 0, 1, 0x7f, 1, 6, 0, 0, 0, 2, 0x68, 0x69 }; // ZMTP 2.0 (RFC 15): signature, revision, ROUTER, no identity; "hi"
            TcpListener listener = new TcpListener(IPAddress.Loopback, 0);
            listener.Start();
            using (transport = new ZmqTransport(MakePair("")))
            {
                message = new Multipart();
                transport.Open(new WebEndpoint(true, "127.0.0.1", ((IPEndPoint)listener.LocalEndpoint).Port));
                using (TcpClient peer = listener.AcceptTcpClient())
                {
                    peer.Client.Send(spoken);
                    WaitFor(() =>
                    {
                        Assert.IsFalse(transport.TryTakeControl(ref message), "what was not encrypted");
                        Assert.AreNotEqual(TransportState.Open, transport.State);
                        return transport.State == TransportState.Closed;
                    }, "an end");
                    Assert.AreNotEqual(LinkFailure.None, transport.End.Failure);
                }
            }
            listener.Stop();
        }

        private static ZmqKeys MakePair(string serverPublic)
        {
            byte[] own = new byte[41];
            byte[] secret = new byte[41];
            zmq_curve_keypair(own, secret);
            string name = Encoding.ASCII.GetString(own, 0, 40);
            return new ZmqKeys(serverPublic.Length == 0 ? name : serverPublic, name, Encoding.ASCII.GetString(secret, 0, 40));
        }

        private void Join(out string client)
        {
            transport.Open(session.Endpoint);
            Assert.IsFalse(transport.TrySend(new byte[1], 1), "it is not open yet");
            string[] early = null;
            WaitFor(() =>
            {
                if ((early = session.Take(session.Control)) != null) session.Send(session.Control, early[0], session.Encode(new ProtocolFault { Code = FaultCode.Hello }));
                return !transport.TryTakeControl(ref message) && transport.State == TransportState.Open;
            }, "the channel");
            Assert.IsTrue(transport.TrySend(Encoding.ASCII.GetBytes("hello"), 5));
            string[] hello = null;
            WaitFor(() => (hello = session.Take(session.Control)) != null, "the hello");
            Assert.AreEqual("hello", hello[1]);
            client = hello[0];
            session.Send(session.Control, client, session.Encode(session.Welcome));
            WaitFor(() => transport.TryTakeControl(ref message), "the welcome");
        }

        private string Text(int frame)
        {
            return Encoding.ASCII.GetString(message.Buffer, message.OffsetOf(frame), message.LengthOf(frame));
        }

        private void WaitFor(Func<bool> condition, string what)
        {
            SessionClientTests.WaitUntil(() =>
            {
                if (condition()) return true;
                transport.Wait(5);
                return false;
            }, "no " + what);
        }
    }
}
