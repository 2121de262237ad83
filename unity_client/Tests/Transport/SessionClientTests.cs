// A client on its threads: an engine's calls never wait for sockets, and starts and stops leave nothing behind.
using System;
using System.Collections.Generic;
using System.Diagnostics;
using System.Net;
using System.Net.Sockets;
using System.Threading;
using IrisSession.Core;
using IrisSession.Protocol;
using NUnit.Framework;

namespace IrisSession.Transport.Tests
{
    [TestFixture]
    public class SessionClientTests
    {
        internal static Hello MakeHello()
        {
            return new Hello { Role = Role.Operator, Name = "ann", Devices = new[] { Device.ControllerRight } };
        }

        internal static void WaitUntil(Func<bool> condition, string what)
        {
            Stopwatch watch = Stopwatch.StartNew();
            while (!condition())
            {
                Assert.Less(watch.ElapsedMilliseconds, Patience.Ms, what);
                Thread.Yield();
            }
        }

        /// <summary>Answer hello, ping and snapshot of one WebSocket, then send states until the client closes.</summary>
        private static void Serve(Peer peer, ManualResetEvent stalls)
        {
            Serve(peer, stalls, null, "");
        }

        /// <summary>The same with a scene, whose assets are fetched with a ticket; `request`: that was read; `answer`: comes before the usual answer.</summary>
        internal static void Serve(Peer peer, ManualResetEvent stalls, string[] request, string sceneHash, Func<ClientMessage, ServerMessage> answer = null)
        {
            peer.AcceptWebSocket(int.MaxValue, request);
            WireReader reader = new WireReader();
            while (true)
            {
                KeyValuePair<int, byte[]> frame = peer.ReadFrame();
                if (frame.Key == 0x88) return;
                stalls?.WaitOne();
                if (frame.Key != 0x82 || frame.Value[0] != WebMessage.Control) continue;
                reader.Reset(frame.Value, 6, frame.Value.Length - 6);
                ClientMessage message = ClientEnvelope.Read(reader).Message;
                ServerMessage own = answer?.Invoke(message);
                if (own != null) Send(peer, own);
                else if (message is Hello)
                {
                    Send(peer, new Welcome { SessionId = "s1", ParticipantId = "p1", ConnectionEpoch = 1, Role = Role.Operator, ResumeToken = new byte[] { 1 }, HeartbeatNs = 1_000_000_000 });
                    WireWriter ticket = new WireWriter();
                    ticket.WriteMapHeader(3);
                    foreach (string text in new[] { "type", "ticket", "ticket", "T1", "expires_s" }) ticket.Write(text);
                    ticket.Write(600);
                    peer.Send(Peer.MakeFrame(0x82, Peer.MakeMessage(WebMessage.Gateway, ticket.ToArray())));
                }
                else if (message is ClockPing ping)
                {
                    Send(peer, new ClockPong { T0Ns = ping.T0Ns, T1Ns = ping.T0Ns, T2Ns = ping.T0Ns });
                    SendState(peer, ping.T0Ns);
                }
                else if (message is GetSnapshot) Send(peer, new Snapshot { EventSeq = 10, SceneEpoch = 3, ConsentTimeoutNs = 4_000_000_000, SceneHash = sceneHash, Robots = new[] { new RobotInfo { Name = "left" } }, Bodies = new[] { new BodyInfo { Id = 1, Name = "a" } } }, new byte[56]);
                else if (message is Acquire acquire) Send(peer, new Reply { RequestId = acquire.RequestId });
            }
        }

        private static long stateSeq = 1;

        private static void SendState(Peer peer, long sessionNs)
        {
            long seq = Interlocked.Increment(ref stateSeq);
            StateHeader header = new StateHeader { SceneEpoch = 3, StateSeq = seq, BaseSeq = 0, SessionTime = sessionNs, PublishedNs = sessionNs };
            byte[] escape = new byte[58];
            BitConverter.GetBytes(1.0 + seq).CopyTo(escape, 2);
            byte[] payload = Peer.Join(LoopRig.EmptyPayload(1), escape);
            payload[6] = 1;
            peer.Send(Peer.MakeFrame(0x82, Peer.MakeMessage(WebMessage.State, new[] { (byte)'r', (byte)'i', (byte)'g', (byte)'i', (byte)'d' }, header.Encode(), payload)));
        }

        private static void Send(Peer peer, ServerMessage message, params byte[][] bulk)
        {
            byte[] envelope = new ServerEnvelope { Version = 1, ConnectionEpoch = 1, Message = message }.Encode();
            List<byte[]> frames = new List<byte[]> { envelope };
            frames.AddRange(bulk);
            peer.Send(Peer.MakeFrame(0x82, Peer.MakeMessage(WebMessage.Control, frames.ToArray())));
        }

        [TestCase(false)]
        [TestCase(true)]
        public void StatesRepliesAndSessionReachTheEngine(bool isSecure)
        {
            using (FakeGateway gateway = new FakeGateway(peer => Serve(peer, null), isSecure ? TestCertificate.First : null))
            {
                SessionClient client = new SessionClient(
                    MakeHello(), new MemoryIdentity(), new EndpointChooser(gateway.MakeEndpoint(TestCertificate.First)), new WebTransport());
                client.Start();
                WaitUntil(() => client.View.Phase == ConnectionPhase.Ready && client.TakeState(), "no state");
                Assert.AreEqual(client.View.BodiesVersion, client.State.BodiesVersion);
                Assert.AreEqual(1, client.View.Bodies.Length);
                Assert.AreEqual(4_000_000_000, client.View.ConsentTimeoutNs);
                Assert.AreEqual(1.0 + client.State.StateSeq, client.State.Poses[0]);
                Assert.IsTrue(client.HasClock);
                long ticket = client.Request(new Acquire { Robots = new[] { "left" } });
                SessionNews one = default;
                WaitUntil(() => client.TryTakeNews(out one) && one.Kind == NewsKind.Reply, "no reply");
                Assert.AreEqual(ticket, one.Ticket);
                Assert.IsNotNull(one.Reply);
                Assert.AreEqual("", client.Crash);
                Assert.IsTrue(client.Stop());
                Assert.AreEqual(ConnectionPhase.Closed, client.View.Phase);
            }
        }

        [Test]
        public void SamplesThatCannotBeSentAreCountedAndOneNoticeSaysWhy()
        {
            using (FakeGateway gateway = new FakeGateway(peer => Serve(peer, null)))
            {
                SessionClient client = new SessionClient(MakeHello(), new MemoryIdentity(), new EndpointChooser(gateway.MakeEndpoint()), new WebTransport());
                client.Start();
                WaitUntil(() => client.View.Phase == ConnectionPhase.Ready, "not ready");
                SampleInput sample = new SampleInput { Device = Device.ControllerRight, HasPose = false };
                sample.Robots.Add("none");
                for (int i = 0; i < 3; i++) Assert.IsTrue(client.TrySendSample(sample));
                WaitUntil(() => client.CallsInvalid == 3, "they are not counted");
                Assert.IsTrue(client.Stop());
                int notices = 0;
                while (client.TryTakeNews(out SessionNews one)) if (one.Kind == NewsKind.Notice) notices++;
                Assert.AreEqual(1, notices);
                Assert.AreEqual("calls that could not be done: 3", client.DescribeLosses());
                Assert.IsNull(client.DescribeLosses());
            }
        }

        [Test]
        public void NoCallOfTheEngineWaitsForASocketThatStalls()
        {
            // A send blocks until the test lets it go: had one of the calls below waited for it, the test would never end.
            FakeTransport transport = new FakeTransport();
            using (ManualResetEvent isBlocked = new ManualResetEvent(false))
            using (ManualResetEvent isReleased = new ManualResetEvent(false))
            {
                transport.OnSend = () =>
                {
                    isBlocked.Set();
                    isReleased.WaitOne();
                };
                SessionClient client = new SessionClient(MakeHello(), new MemoryIdentity(), new EndpointChooser(new WebEndpoint(false, "localhost", 7725)), transport);
                client.Start();
                Assert.IsTrue(isBlocked.WaitOne(Patience.Ms));
                SampleInput input = new SampleInput { Device = Device.ControllerRight, Pose = new RigidTransform(new Double3(0.1, 0.2, 1), DoubleQuaternion.Identity) };
                int refused = 0;
                Multipart media = new Multipart();
                for (int frame = 0; frame < 2000; frame++)
                {
                    client.TakeState();
                    client.TakePresence();
                    client.TryTakeMedia(ref media);
                    while (client.TryTakeNews(out SessionNews _))
                    {
                    }
                    if (!client.TrySendSample(input)) refused++;
                    client.ToSessionNs(frame);
                    Assert.AreNotEqual(ConnectionPhase.Ready, client.View.Phase);
                }
                client.EStop("test");
                Assert.AreEqual(0, client.Request(new Acquire()));
                Assert.Greater(refused, 900);
                Assert.AreEqual(refused + 1, client.CallsDropped);
                isReleased.Set();
                Assert.IsTrue(client.Stop());
                Assert.IsTrue(transport.IsDisposed);
            }
        }

        [Test]
        public void NewsThatNothingTakesIsBoundedAndCounted()
        {
            const int Posted = 1200;
            SessionClient client = new SessionClient(
                MakeHello(), new MemoryIdentity(), new EndpointChooser(new WebEndpoint(false, "localhost", 7725)), new FakeTransport());
            client.Start();
            int ran = 0;
            for (int i = 0; i < Posted;)
            {
                if (client.TryPost(loop => { ran++; throw new NotConnectedException("no"); })) i++;
                else Thread.Yield();
            }
            WaitUntil(() => Volatile.Read(ref ran) == Posted && client.NewsDropped > 0, "nothing is dropped");
            Assert.IsTrue(client.Stop());
            int kept = 0;
            while (client.TryTakeNews(out SessionNews _)) kept++;
            Assert.LessOrEqual(kept, Posted - client.NewsDropped);
            Assert.AreEqual("", client.Crash);
        }

        private static SessionClient Start(FakeTransport transport)
        {
            SessionClient client = new SessionClient(MakeHello(), new MemoryIdentity(), new EndpointChooser(new WebEndpoint(false, "localhost", 7725)), transport);
            client.Start();
            WaitUntil(() => CountSent<Hello>(transport) > 0, "no hello");
            return client;
        }

        private static int CountSent<T>(FakeTransport transport)
        {
            lock (transport.Sent) return transport.Sent.FindAll(each => each.Message is T).Count;
        }

        [Test]
        public void MistakesOfTheApplicationDoNotEndTheSession()
        {
            FakeTransport transport = new FakeTransport();
            SessionClient client = Start(transport);
            client.TryPost(loop => throw new InvalidOperationException("of the application"));
            client.Post(loop => throw new InvalidOperationException("of the application"));
            client.TrySendSample(new SampleInput { Device = null });
            client.EStop(null);
            WaitUntil(() => CountSent<EStop>(transport) > 0, "no e-stop: " + client.Crash);
            SessionNews news = default;
            WaitUntil(() => client.TryTakeNews(out news), "no notice");
            Assert.AreEqual("of the application", news.Text);
            Assert.IsTrue(client.Stop());
            Assert.AreEqual("", client.Crash);
        }

        [Test]
        public void AnEStopJustBeforeTheEndIsSent()
        {
            FakeTransport transport = new FakeTransport();
            SessionClient client = Start(transport);
            Thread stopper = new Thread(() => client.Stop());
            client.TryPost(loop =>
            {
                client.EStop("the last");
                int before = transport.Wakes;
                stopper.Start();
                WaitUntil(() => Volatile.Read(ref transport.Wakes) > before, "not stopped");
            });
            WaitUntil(() => client.HasEnded, "not ended");
            stopper.Join();
            Assert.AreEqual(1, CountSent<EStop>(transport));
        }

        [Test]
        public void AReportThatMustNotBeLostIsKeptInOrderWhileTooMuchWaits()
        {
            FakeTransport transport = new FakeTransport();
            using (ManualResetEvent isReleased = new ManualResetEvent(false))
            {
                SessionClient client = Start(transport);
                string order = "";
                client.TryPost(loop => isReleased.WaitOne());
                while (client.TryPost(loop => order = "before "))
                {
                }
                client.Post(loop => order += "report ");
                isReleased.Set();
                WaitUntil(() => client.TryPost(loop => order += "after"), "no room");
                WaitUntil(() => Volatile.Read(ref order) == "before report after", "another order");
                client.Stop();
            }
        }

        [Test]
        public void ADefectEndsTheSessionInWords()
        {
            FakeTransport transport = new FakeTransport();
            SessionClient client = Start(transport);
            transport.OnSend = () => throw new InvalidOperationException("a defect");
            client.EStop("now");
            WaitUntil(() => client.HasEnded, "still runs");
            StringAssert.Contains("a defect", client.Crash);
            Assert.IsTrue(transport.IsDisposed);
            Assert.AreEqual(LinkFailure.Defect, client.View.Problem.Failure);
            Assert.AreEqual(AdviceKind.Link, client.Advice[0].Kind);
            Assert.IsFalse(client.EStop("nothing is left that could stop"));
        }

        [Test]
        public void AGatewayThatReadsAndWritesNothingStopsNoFrame()
        {
            using (ManualResetEvent goesOn = new ManualResetEvent(true))
            using (FakeGateway gateway = new FakeGateway(peer => Serve(peer, goesOn)))
            {
                SessionClient client = new SessionClient(MakeHello(), new MemoryIdentity(), new EndpointChooser(gateway.MakeEndpoint()), new WebTransport());
                client.Start();
                WaitUntil(() => client.View.Phase == ConnectionPhase.Ready, "not ready");
                goesOn.Reset();
                SampleInput input = new SampleInput { Device = Device.ControllerRight, Pose = new RigidTransform(new Double3(0.1, 0.2, 1), DoubleQuaternion.Identity), HandJoints = new double[26 * 7] };
                for (int frame = 0; frame < 5000; frame++)
                {
                    client.TakeState();
                    client.TrySendSample(input);
                    if (frame % 100 == 0) Thread.Sleep(0);
                }
                Assert.IsTrue(client.Stop());
                goesOn.Set();
            }
        }

        [Test]
        public void TwoHundredStartsAndStopsWithADeadServerLeaveNoThread()
        {
            // Accepts by its backlog and never answers; and a port where nothing listens.
            TcpListener dead = new TcpListener(IPAddress.Loopback, 0);
            dead.Start(512);
            TcpListener gone = new TcpListener(IPAddress.Loopback, 0);
            gone.Start();
            int closedPort = ((IPEndPoint)gone.LocalEndpoint).Port;
            gone.Stop();
            int port = ((IPEndPoint)dead.LocalEndpoint).Port;
            try
            {
                for (int i = 0; i < 200; i++)
                {
                    WebEndpoint endpoint = i % 4 == 3 ? new WebEndpoint(false, "localhost", closedPort) : new WebEndpoint(i % 2 == 0, "localhost", port, i % 2 == 0 ? new byte[32] : null);
                    WebTransport transport = new WebTransport();
                    SessionClient client = new SessionClient(MakeHello(), new MemoryIdentity(), new EndpointChooser(endpoint), transport);
                    client.Start();
                    if (i % 3 == 0) WaitUntil(() => transport.Counters.Opened > 0, "not opened"); // else it is stopped at any moment
                    bool hasEnded = client.Stop();
                    // `Stop` gives up after less than a second; on a machine that stood still meanwhile the threads need their time.
                    WaitUntil(() => hasEnded || client.HasEnded, "the thread of the session is left");
                    WaitUntil(() => transport.HasEnded, "a thread of a socket is left");
                    Assert.AreEqual("", client.Crash);
                }
            }
            finally
            {
                dead.Stop();
            }
        }

        [Test]
        public void AFrameLoopAllocatesNothing()
        {
            using (FakeGateway gateway = new FakeGateway(peer => Serve(peer, null)))
            {
                SessionClient client = new SessionClient(MakeHello(), new MemoryIdentity(), new EndpointChooser(gateway.MakeEndpoint()), new WebTransport());
                client.Start();
                WaitUntil(() => client.View.Phase == ConnectionPhase.Ready && client.TakeState(), "no state");
                SampleInput input = new SampleInput { Device = Device.ControllerRight, Pose = new RigidTransform(new Double3(0.1, 0.2, 1), DoubleQuaternion.Identity), HandJoints = new double[26 * 7] };
                long allocated = 0;
                for (int frame = 0; frame < 4000; frame++)
                {
                    long before = GC.GetAllocatedBytesForCurrentThread();
                    client.TakeState();
                    client.TakePresence();
                    client.TrySendSample(input);
                    client.ToSessionNs(MonotonicClock.NowNs);
                    // The first ones fill what is used again.
                    if (frame >= 2048) allocated += GC.GetAllocatedBytesForCurrentThread() - before;
                    if (frame % 64 == 0) Thread.Sleep(1);
                }
                Assert.AreEqual(0, allocated);
                Assert.IsTrue(client.Stop());
            }
        }
    }
}
