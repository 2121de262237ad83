// What arrives or is sent many times a second allocates nothing, once the first of its size was there.
using System;
using System.Collections.Generic;
using System.Linq;
using NUnit.Framework;

namespace IrisSession.Protocol.Tests
{
    [TestFixture]
    public class AllocationTests
    {
        const int Rounds = 10_000;

        static IEnumerable<object[]> HotMessages
        {
            get
            {
                string[] devices = { Device.ControllerLeft, Device.ControllerRight, Device.Head, Device.HandLeft };
                yield return Two("state header", n => new StateHeader
                {
                    Tick = 100_000 + n, SimTime = 0.1 * n, SessionTime = 5_000_000_000 + n, StateSeq = 7 + n,
                    Applied = Enumerable.Range(0, 8).Select(i => new Applied { Robot = "panda" + i, Participant = "participant" + i % 3, Device = devices[(i + n) % 4], Seq = n }).ToArray(),
                });
                yield return Two("presence", n => new Presence
                {
                    SessionTime = 5_000_000_000 + n,
                    Items = Enumerable.Range(0, 24).Select(i => new PresenceItem { Participant = "participant" + (i + n) % 8, Device = devices[i % 4], Pose = new Pose { P = new[] { 0.1, 0.2, n } } }).ToArray(),
                });
                yield return Two("feedback", n => new ServerEnvelope
                {
                    Message = new Feedback { Robot = "panda" + n, State = "tracking", ContactN = n, Limits = new[] { "joint1", "joint2" }, Rejected = { ["stale"] = n, ["seq"] = 1 } },
                });
                yield return Two("clock", n => new ServerEnvelope { Message = new ClockPong { T0Ns = n, T1Ns = 2, T2Ns = 3 } });
                yield return Two("delivery", n => new ServerEnvelope
                {
                    Message = new DeliveryBudget { BudgetClass = "quest_3", MbitPerS = n, Streams = new[] { new StreamBudget { Stream = "cloth", Camera = new StreamCamera { Width = 640 } } } },
                });
                yield return Two("media header", n => new MediaHeader { Stream = "cloud/table", BudgetClass = "quest_3", Seq = n });
                yield return Two("samples", n => new ClientEnvelope
                {
                    Message = new Samples { SamplesValue = Enumerable.Range(0, 3).Select(i => new Sample { Device = devices[i], Kind = SampleKind.Pose, Seq = n, Gripper = 0.5, Pose = new Pose(), HandJoints = new double[175] }).ToArray() },
                });
            }
        }

        static object[] Two(string label, Func<int, WireValue> make) { return new object[] { label, make(0), make(1) }; }

        [TestCaseSource("HotMessages")]
        public void ReadingAgainAndWritingAllocateNothing(string label, WireValue one, WireValue other)
        {
            byte[][] bytes = { one.Encode(), other.Encode() };
            WireValue into = Vectors.Create(one.GetType().Name);
            var reader = new WireReader();
            var writer = new WireWriter();
            long begin = 0;
            for (int i = -100; i < Rounds; i++)
            {
                if (i == 0) begin = GC.GetAllocatedBytesForCurrentThread();
                byte[] message = bytes[i & 1];
                reader.Reset(message, 0, message.Length);
                reader.ReadInto(into);
                reader.ExpectEnd();
                writer.Clear();
                into.WriteTo(writer);
            }
            Assert.AreEqual(0, GC.GetAllocatedBytesForCurrentThread() - begin);
            CollectionAssert.AreEqual(bytes[(Rounds - 1) & 1], writer.ToArray());
        }

        [Test]
        public void AllocationsAreCounted()
        {
            // Mono counts them, too; a runtime that does not would let all tests here pass.
            long before = GC.GetAllocatedBytesForCurrentThread();
            GC.KeepAlive(new byte[1_000_000]);
            long allocated = GC.GetAllocatedBytesForCurrentThread() - before;
            if (allocated == 0) Assert.Ignore("this runtime does not count what it allocates");
            Assert.GreaterOrEqual(allocated, 1_000_000);
        }
    }
}
