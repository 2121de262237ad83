// What conversations do not say: order and bounds of queues, validity, refusals, hostile bytes, allocation.
using System;
using System.Collections.Generic;
using IrisSession.Protocol;
using NUnit.Framework;

namespace IrisSession.Core.Tests
{
    [TestFixture]
    public class ClientConnectionTests
    {
        private const long Ms = FakeSession.Ms;
        private const long Second = FakeSession.Second;

        [Test]
        public void JoinsAndIsReady()
        {
            FakeSession session = FakeSession.Join();
            Assert.AreEqual(ConnectionPhase.Ready, session.Client.Phase);
            Assert.AreEqual(7, session.Client.FindLeaseVersion("left"));
            Assert.AreEqual(-1, session.Client.FindLeaseVersion("right"));
            Assert.AreEqual(1, session.Client.Mirror.IndexOfId[4]);
            Assert.AreEqual("connected", session.Client.Describe());
        }

        [Test]
        public void SilentSessionIsJoinedAgainWithTheToken()
        {
            FakeSession session = FakeSession.Join();
            session.NowNs += 5 * Second;
            session.Client.Tick(session.NowNs); // we stood still ourselves: messages may wait
            Assert.AreEqual(ConnectionPhase.Ready, session.Client.Phase);
            for (int i = 0; i < 9 && session.Client.IsJoined; i++)
            {
                session.NowNs += Second / 2;
                session.Client.Tick(session.NowNs);
            }
            Assert.AreEqual(ConnectionPhase.Joining, session.Client.Phase);
            Assert.AreEqual(2, session.Client.Generation);
            Assert.AreEqual(new byte[] { 1 }, ((Hello)session.TakeSent()[0]).ResumeToken);
            session.AnswerHello();
            Assert.AreEqual(ConnectionPhase.Ready, session.Client.Phase);
            Assert.AreEqual(1, session.Client.Counters.Reconnects);
        }

        [Test]
        public void WithoutASessionAttemptsGetRare()
        {
            FakeSession session = new FakeSession();
            session.Client.Open(0);
            for (long now = 0; now < 60 * Second; now = Math.Max(now + Ms, session.Client.NextDeadlineNs(now))) session.Client.Tick(now);
            Assert.IsTrue(session.Client.Generation > 8 && session.Client.Generation < 20, session.Client.Generation.ToString());
            Assert.Throws<NotConnectedException>(() => session.Client.Request(new Acquire()));
            Assert.Throws<NotConnectedException>(() => session.Client.Send(new TrackingEpoch()));
        }

        [TestCase("revoked", "")]
        [TestCase("dropped", "replaced")]
        public void SomeFaultsEndIt(string code, string reason)
        {
            FakeSession session = FakeSession.Join();
            session.Receive(new ProtocolFault { Code = code, Reason = reason, Message = "words" });
            Assert.AreEqual(ConnectionPhase.Refused, session.Client.Phase);
            int generation = session.Client.Generation;
            for (int i = 0; i < 50; i++) session.Advance(Second);
            Assert.AreEqual(generation, session.Client.Generation);
            Assert.IsTrue(session.Client.Describe().Length > 10);
            session.Client.Open(session.NowNs);
            session.AnswerHello();
            Assert.AreEqual(ConnectionPhase.Ready, session.Client.Phase);
        }

        [Test]
        public void StopsPassEverythingAndReleasesPassSamples()
        {
            FakeSession session = FakeSession.Join();
            ClientConnection client = session.Client;
            client.Request(new Acquire { Robots = new[] { "left" } });
            client.Send(MakeSample(client));
            client.Send(MakeSample(client));
            client.Request(new Release { Targets = new[] { new Target { Name = "left", LeaseVersion = 7 } } });
            client.Send(new EStop { Reason = "people" });
            Assert.AreEqual("estop acquire release sample sample", string.Join(" ", session.TakeSent().ConvertAll(one => one.Tag)));
        }

        [Test]
        public void StopIsSentAgainUntilTheSessionIsKnownToHaveIt()
        {
            FakeSession session = FakeSession.Join();
            ClientConnection client = session.Client;
            session.SendEvent(new EStopChanged { Active = true, Participant = "p2", StopSeq = 1 }); // of another: no proof
            client.Send(new EStop { Reason = "people" });
            session.Receive(new ClockPong { T0Ns = session.NowNs - Ms, T1Ns = 5 * Second, T2Ns = 5 * Second }); // of a ping before it
            session.NowNs += 2 * Second;
            client.HandleDisconnect(session.NowNs);
            List<ClientMessage> sent = session.TakeSent();
            Assert.AreEqual("hello estop", sent[0].Tag + " " + sent[1].Tag);
            session.AnswerHello();
            Assert.AreEqual(1, session.Sent.FindAll(message => message is EStop).Count);
            // The snapshot does not say that the session is stopped, so its pongs prove nothing; its event does.
            Assert.IsNotNull(client.PendingEStop.Message);
            session.SendEvent(new EStopChanged { Active = true, Participant = "p1", StopSeq = 2 });
            Assert.IsNull(client.PendingEStop.Message);
            client.Send(new EStop());
            for (int i = 0; i < 4; i++) session.Advance(Second / 2); // a pong of a ping after it, while stopped
            Assert.IsNull(client.PendingEStop.Message);
        }

        [TestCase(false)]
        [TestCase(true)]
        public void StopWithAReasonThatDoesNotFitIsNotRefusedForIt(bool isLong)
        {
            FakeSession session = FakeSession.Join();
            Assert.IsTrue(session.Client.Send(new EStop { Reason = isLong ? new string('x', 600) : null }));
            EStop stop = (EStop)session.TakeSent()[0]; // read by the rules of the wire
            Assert.AreEqual(isLong ? 512 : 0, stop.Reason.Length);
        }

        [Test]
        public void FullQueueDropsSamplesAndKeepsWhatIsUrgent()
        {
            FakeSession session = FakeSession.Join();
            ClientConnection client = session.Client;
            for (int i = 0; i < 255; i++) client.Send(MakeSample(client));
            client.Request(new Acquire { Robots = new[] { "left" } });
            Assert.IsFalse(client.Send(MakeSample(client)));
            Assert.Throws<NotConnectedException>(() => client.Request(new Acquire { Robots = new[] { "left" } }));
            Assert.IsTrue(client.Send(new EStop()));
            client.Request(new Release { Targets = new[] { new Target { Name = "left", LeaseVersion = 7 } } });
            List<ClientMessage> sent = session.TakeSent();
            Assert.AreEqual(256, sent.Count);
            Assert.AreEqual("estop", sent[0].Tag);
            Assert.AreEqual(253, sent.FindAll(message => message is Sample).Count);
            Assert.AreEqual("acquire release", sent[254].Tag + " " + sent[255].Tag);
            Assert.AreEqual(3, client.Counters.SamplesNotSent);
            Assert.AreEqual(1, client.Counters.OutgoingDropped);
        }

        [Test]
        public void UnreadEventsAreNamedAsMissed()
        {
            FakeSession session = FakeSession.Join();
            while (session.Client.Inbox.TryTake(out _))
            {
            }
            for (int i = 0; i < 1500; i++) session.SendEvent(new MarkerAdded());
            Assert.AreEqual(1024, session.Client.Inbox.Count);
            Assert.IsTrue(session.Client.Inbox.TryTake(out InboxMessage first));
            Assert.IsTrue(first.IsMissed);
            Assert.AreEqual(11, first.First);
            Assert.IsTrue(session.Client.Inbox.TryTake(out InboxMessage second));
            Assert.AreEqual(first.Last + 1, second.First);
            Assert.AreEqual(session.EventSeq - 1022, second.First);
        }

        [Test]
        public void HeadsetOffIsToldAtOnceAndAfterAReconnect()
        {
            FakeSession session = FakeSession.Join();
            session.Client.SetWorn(false);
            Assert.IsFalse(((Heartbeat)session.TakeSent()[0]).Worn);
            Assert.IsFalse(MakeSample(session.Client).Worn);
            session.NowNs += 2 * Second;
            session.Client.HandleDisconnect(session.NowNs);
            session.AnswerHello();
            Assert.IsFalse(((Heartbeat)session.Sent.Find(message => message is Heartbeat)).Worn);
            session.Client.SetWorn(true);
            Assert.IsTrue(((Heartbeat)session.TakeSent()[0]).Worn);
        }

        [Test]
        public void JumpOfTheTrackingFrameIsToldBeforeAnythingElseAndAfterAReconnect()
        {
            FakeSession session = FakeSession.Join();
            session.Client.ReportTrackingJump();
            session.Client.Send(MakeSample(session.Client));
            List<ClientMessage> sent = session.TakeSent();
            Assert.AreEqual(1, ((TrackingEpoch)sent[0]).TrackingEpochValue);
            Assert.AreEqual(1, ((Sample)sent[1]).TrackingEpoch);
            session.NowNs += 2 * Second;
            session.Client.HandleDisconnect(session.NowNs);
            session.AnswerHello();
            Assert.AreEqual(1, ((TrackingEpoch)session.Sent.Find(message => message is TrackingEpoch)).TrackingEpochValue);
        }

        [TestCase(PoseValidity.Measured, true, false)]
        [TestCase(PoseValidity.Emulated, true, true)]
        [TestCase(PoseValidity.NotSeen, false, false)]
        public void SamplesSayWhatTheRuntimeKnows(PoseValidity validity, bool tracked, bool emulated)
        {
            FakeSession session = FakeSession.Join();
            SampleInput input = new SampleInput { Device = Device.ControllerRight, Validity = validity, Pose = RigidTransform.Identity, CaptureNs = 5 };
            input.Robots.Add("left");
            input.Robots.Add("right"); // another's
            Sample sample = new SampleBuilder(session.Client).MakeSample(input);
            Assert.AreEqual(tracked, sample.Tracked);
            Assert.AreEqual(emulated, sample.Emulated);
            Assert.AreEqual(3, sample.SceneEpoch);
            Assert.AreEqual(1, sample.Targets.Length);
            Assert.AreEqual(7, sample.Targets[0].LeaseVersion);
            Assert.AreEqual(1, session.Client.Counters.SamplesWithoutLease);
            input.Robots.Add("middle");
            Assert.Throws<InvalidMessageException>(() => new SampleBuilder(session.Client).MakeSample(input));
        }

        [Test]
        public void RequestsHaveTheirReplyOnce()
        {
            FakeSession session = FakeSession.Join();
            long id = session.Client.Request(new Acquire { Robots = new[] { "right" } });
            Assert.IsTrue(session.Client.Requests.IsPending(id));
            session.Receive(new Reply { RequestId = id, Ok = true, Leases = new[] { new Lease { Target = "right", Holder = "p1", LeaseVersion = 5 } } });
            Assert.AreEqual(5, session.Client.FindLeaseVersion("right")); // ahead of the event
            Assert.IsTrue(session.Client.Requests.PopReply(id).Ok);
            Assert.IsNull(session.Client.Requests.PopReply(id));
            session.Receive(new Reply { RequestId = id });
            Assert.AreEqual(1, session.Client.Counters.UnexpectedReplies);
            Assert.Throws<InvalidMessageException>(() => session.Client.Request(new EStop()));
        }

        [Test]
        public void EventsChangeTheMirrorAndNotWhatWasHandedOut()
        {
            FakeSession session = FakeSession.Join();
            Lease before = session.Client.Mirror.Leases["left"];
            session.SendEvent(new ScaleChanged { Robot = "left", Scale = 0.5 });
            Assert.AreEqual(0.5, session.Client.Mirror.Leases["left"].Scale);
            Assert.AreEqual(1.0, before.Scale);
            session.SendEvent(new ParticipantLeft { Participant = "p2", Grace = true });
            Assert.IsFalse(session.Client.Mirror.Participants["p2"].Connected);
            session.SendEvent(new ParticipantLeft { Participant = "p2" });
            Assert.IsFalse(session.Client.Mirror.Participants.ContainsKey("p2"));
            session.SendEvent(new SceneChanged { SceneEpoch = 4, Cause = "new_scene" });
            Assert.IsFalse(session.Client.Mirror.IsSynced);
        }

        [Test]
        public void NothingThatASessionSendsThrows()
        {
            Random random = new Random(37);
            List<byte[]> frames = new List<byte[]>();
            foreach (Json vector in Golden.Load("golden")["server"].Items) frames.Add(Golden.FromHex(vector["hex"].Text));
            int rounds = int.Parse(System.Environment.GetEnvironmentVariable("IRIS_FUZZ") ?? "3000");
            FakeSession session = FakeSession.Join();
            for (int round = 0; round < rounds; round++)
            {
                if (round % 100 == 0) session = FakeSession.Join();
                byte[] frame = frames[random.Next(frames.Count)];
                byte[] bulk = random.Next(2) == 0 ? null : new byte[random.Next(4) * 56];
                session.Client.Receive(FakeSession.MakeMessage(random.Next(3) == 0 ? frame : RigidDecoderTests.Damage(random, frame), bulk), session.NowNs);
                session.NowNs += random.Next(50) * Ms;
                session.Client.Tick(session.NowNs);
                session.TakeSent();
            }
            session.Client.Receive(new Multipart(), session.NowNs);
        }

        [Test]
        public void SendingSamplesAllocatesNothing()
        {
            FakeSession session = FakeSession.Join();
            SampleBuilder builder = new SampleBuilder(session.Client);
            SampleInput input = new SampleInput { Device = Device.ControllerRight, Gripper = 0.5, HandJoints = new double[175] };
            input.Robots.Add("left");
            Action send = () =>
            {
                input.Pose = RigidTransform.Identity;
                session.Client.Send(builder.MakeSample(input));
                session.Client.PeekOutgoing();
                session.Client.PopOutgoing(true);
            };
            for (int i = 0; i < 10; i++) send();
            long before = GC.GetAllocatedBytesForCurrentThread();
            for (int i = 0; i < 1000; i++) send();
            long allocated = GC.GetAllocatedBytesForCurrentThread() - before;
            Assert.AreEqual(0, allocated);
        }

        private static Sample MakeSample(ClientConnection client)
        {
            SampleInput input = new SampleInput { Device = Device.Head, Pose = RigidTransform.Identity };
            return new SampleBuilder(client).MakeSample(input);
        }
    }
}
