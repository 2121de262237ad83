// Frames of the state channel: only the newest is decoded, old ones after a stall are dropped, nothing is allocated.
using System;
using System.Collections.Generic;
using System.Text;
using IrisSession.Protocol;
using NUnit.Framework;

namespace IrisSession.Core.Tests
{
    [TestFixture]
    public class StateStreamTests
    {
        private const long Ms = FakeSession.Ms;
        private const int Bodies = 300;

        [Test]
        public void OnlyTheNewestFrameOfADrainIsDecoded()
        {
            StateStream stream = MakeStream();
            Assert.IsTrue(stream.Drain(new[] { Rigid(1, 100), Rigid(2, 116), Rigid(3, 132) }, 140 * Ms, 0));
            Assert.AreEqual(3, stream.Header.StateSeq);
            Assert.AreEqual(8 * Ms, stream.AgeNs);
            Assert.AreEqual(2, stream.Counters.Superseded);
            Assert.AreEqual("left", stream.Header.Applied[0].Robot);
            Assert.AreEqual(0.0, stream.Poses[7 * (Bodies - 1) + 1] - (2 * Bodies - 1) * 31 * Wire.RigidLatticeM, 1e-9);
            Assert.IsFalse(stream.Drain(new[] { Rigid(2, 116) }, 150 * Ms, 10 * Ms));
            Assert.AreEqual(1, stream.Counters.OutOfOrder);
        }

        [Test]
        public void FramesThatWaitedInQueuesAreDroppedUntilAFreshOneComes()
        {
            StateStream stream = MakeStream();
            stream.Drain(new[] { Rigid(1, 0) }, 10 * Ms, 0);
            Assert.IsFalse(stream.Drain(new[] { Rigid(2, 16) }, 500 * Ms, 490 * Ms));
            Assert.IsFalse(stream.Drain(new[] { Rigid(9, 200) }, 510 * Ms, 500 * Ms));
            Assert.IsTrue(stream.Drain(new[] { Rigid(30, 505) }, 515 * Ms, 505 * Ms));
            Assert.AreEqual(2, stream.Counters.QueuedOld);
        }

        [Test]
        public void OnASlowLinkTheNewestIsShown()
        {
            StateStream stream = MakeStream();
            stream.Drain(new[] { Rigid(1, 0) }, 10 * Ms, 0);
            int shown = 0;
            for (int i = 0; i < 20; i++) if (stream.Drain(new[] { Rigid(2 + i, 100 + 20 * i) }, (500 + 20 * i) * Ms, (490 + 20 * i) * Ms)) shown++;
            Assert.Greater(shown, 10);
            stream = MakeStream();
            stream.Drain(new[] { Rigid(1, 0) }, 10 * Ms, 0);
            shown = 0;
            for (int i = 0; i < 10; i++) if (stream.Drain(new[] { Rigid(2 + i, 100 + 100 * i) }, (500 + 100 * i) * Ms, (490 + 100 * i) * Ms)) shown++;
            Assert.Greater(shown, 6); // though every one comes after a silence
        }

        [Test]
        public void OtherScenesAndDamagedFramesAreCounted()
        {
            StateStream stream = MakeStream();
            stream.SceneEpoch = 2;
            Assert.IsFalse(stream.Drain(new[] { Rigid(1, 0) }, 10 * Ms, 0));
            Assert.AreEqual(1, stream.Counters.OtherEpoch);
            Multipart bad = FakeSession.MakeMessage(Encoding.ASCII.GetBytes("rigid"), Header(2, 10), new byte[9]);
            Assert.IsFalse(stream.Drain(new[] { bad }, 20 * Ms, 10 * Ms));
            Assert.IsTrue(stream.WantsSnapshot);
            Multipart noHeader = FakeSession.MakeMessage(Encoding.ASCII.GetBytes("rigid"), new byte[] { 0xc1 }, new byte[9]);
            Multipart other = FakeSession.MakeMessage(Encoding.ASCII.GetBytes("rigidity"), new byte[1]);
            stream.Drain(new[] { noHeader, other, new Multipart() }, 30 * Ms, 20 * Ms);
            Assert.AreEqual(2, stream.Counters.Malformed);
            Assert.AreEqual(2, stream.Counters.UnknownTopic);
            Assert.IsFalse(new StateStream().Drain(new[] { Rigid(1, 0) }, 0, 0));
        }

        [Test]
        public void PresenceIsTheNewestOfEachDevice()
        {
            StateStream stream = MakeStream();
            stream.Drain(new[] { MakePresence(1, 0.1), MakePresence(3, 0.3), MakePresence(2, 0.2), FakeSession.MakeMessage(Encoding.ASCII.GetBytes("presence"), new byte[2]) }, 0, 0);
            Assert.IsTrue(stream.Presence.TakeNews());
            Assert.IsFalse(stream.Presence.TakeNews());
            Assert.AreEqual(2, stream.Presence.ListItems().Count);
            Assert.AreEqual(0.3, stream.Presence.ListItems()[1].Pose.P[0]);
            Assert.AreEqual(1, stream.Counters.OutOfOrder);
            Assert.AreEqual(1, stream.Counters.Malformed);
            stream.Presence.Remove("p2");
            Assert.AreEqual(0, stream.Presence.ListItems().Count);
        }

        [Test]
        public void SteadyStateAllocatesNothing()
        {
            StateStream stream = MakeStream();
            List<Multipart> messages = new List<Multipart>();
            Multipart[] frames = new Multipart[1100];
            for (int i = 0; i < frames.Length; i++) frames[i] = Rigid(1 + i, 16 * i);
            Multipart presence = MakePresence(1, 0.5);
            PoseBuffer buffer = new PoseBuffer();
            double[] shown = new double[7 * Bodies];
            Action<int> step = i =>
            {
                messages.Clear();
                messages.Add(frames[i]);
                messages.Add(presence);
                if (!stream.Drain(messages, (16 * i + 5) * Ms, (16 * i + 5) * Ms)) Assert.Fail("frame " + i);
                buffer.Add(stream.Header.SessionTime, stream.Poses);
                buffer.TryGetPoses((16 * i + 5) * Ms, shown, out _);
                stream.Presence.ListItems();
            };
            for (int i = 0; i < 100; i++) step(i);
            long before = GC.GetAllocatedBytesForCurrentThread();
            for (int i = 100; i < frames.Length; i++) step(i);
            long allocated = GC.GetAllocatedBytesForCurrentThread() - before;
            Assert.AreEqual(0, allocated);
        }

        [Test]
        public void ReportHasAgesAndGaps()
        {
            StateStream stream = MakeStream();
            ArrivalMeter meter = new ArrivalMeter();
            Assert.IsNull(meter.Poll(stream, 0, 0));
            for (int i = 0; i < 51; i++)
            {
                int seq = i < 40 ? i + 1 : i + 4; // three are lost
                stream.Drain(new[] { Rigid(seq, 16 * i) }, (16 * i + (i == 30 ? 40 : 5)) * Ms, 16 * i * Ms);
                meter.RecordState(stream);
                meter.RecordDrawn();
            }
            stream.Drain(new[] { Rigid(60, 16 * 50) }, 1400 * Ms, 850 * Ms); // the same state again: its source is silent
            meter.RecordState(stream);
            meter.RecordMedia(1000, 20 * Ms);
            Assert.IsNull(meter.Poll(stream, 0, 999 * Ms));
            ClientReport report = meter.Poll(stream, 3 * Ms, 1000 * Ms);
            Assert.AreEqual(5.0, report.AgeMsP50, 1e-9);
            Assert.AreEqual(40.0, report.AgeMsP99, 1e-9);
            Assert.AreEqual(52, report.Delivered);
            Assert.AreEqual(3 + 5, report.Missed);
            Assert.AreEqual(3.0, report.RttMs, 1e-9);
            Assert.AreEqual(51.0, report.DisplayHz, 1e-9);
            Assert.AreEqual(20.0, report.MediaAgeMs, 1e-9);
            Assert.AreEqual((double)stream.Counters.BytesReceived, report.BytesPerS, 1e-6);
            report = meter.Poll(stream, 0, 2000 * Ms);
            Assert.AreEqual(0.0, report.AgeMsP99);
        }

        private static StateStream MakeStream()
        {
            StateStream stream = new StateStream { SceneEpoch = 1 };
            stream.LoadKeyframe(0, Bodies, new byte[56 * Bodies], 0, 56 * Bodies);
            return stream;
        }

        private static byte[] Header(long seq, long publishedMs)
        {
            Applied applied = new Applied { Robot = "left", Participant = "p1", Device = "right", Seq = seq };
            return new StateHeader { SceneEpoch = 1, Tick = seq, SessionTime = publishedMs * Ms, PublishedNs = publishedMs * Ms, StateSeq = seq, Applied = new[] { applied } }.Encode();
        }

        private static Multipart Rigid(long seq, long publishedMs)
        {
            return FakeSession.MakeMessage(Encoding.ASCII.GetBytes("rigid"), Header(seq, publishedMs), RigidDecoderTests.MakeFrame(Bodies));
        }

        private static Multipart MakePresence(long time, double x)
        {
            PresenceItem[] items = new PresenceItem[2];
            for (int i = 0; i < 2; i++) items[i] = new PresenceItem { Participant = "p2", Device = i == 0 ? "head" : "hand/left", Pose = new Pose { P = new[] { x, 0, 0 }, Q = new[] { 1.0, 0, 0, 0 } } };
            return FakeSession.MakeMessage(Encoding.ASCII.GetBytes("presence"), new Presence { SessionTime = time, Items = items }.Encode());
        }
    }
}
