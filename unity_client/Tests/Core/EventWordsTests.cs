using System;
using System.Collections.Generic;
using System.Linq;
using IrisSession.Protocol;
using NUnit.Framework;

namespace IrisSession.Core.Tests
{
    [TestFixture]
    public class EventWordsTests
    {
        /// <summary>Events that only change what the mirror shows.</summary>
        private static readonly Type[] Silent = { typeof(ParticipantChanged), typeof(TipCalibrated), typeof(HeadsetsCompared) };

        [Test]
        public void EveryEventHasASentenceOrIsKnownToNeedNone()
        {
            List<Type> kinds = typeof(EventKind).Assembly.GetTypes().Where(type => type.IsSubclassOf(typeof(EventKind))).ToList();
            Assert.Greater(kinds.Count, 20);
            foreach (Type kind in kinds)
            {
                EventKind body = (EventKind)Activator.CreateInstance(kind);
                if (body is Notice notice) notice.Text = "a text of the session";
                if (body is Audited audited) audited.Kind = AuditKind.Flood;
                if (body is LeasesChanged leases) leases.Leases = new[] { new Lease { Target = "left" } };
                string text = Describe(body).Text;
                Assert.AreEqual(Silent.Contains(kind), string.IsNullOrEmpty(text), kind.Name);
            }
        }

        [Test]
        public void LeasesNameBoth()
        {
            Lease lease = new Lease { Target = "left", Holder = "p2", Mode = LeaseMode.Takeover, Queue = new[] { "p1" } };
            Assert.AreEqual("ben took over left from ann", Describe(new LeaseChanged { Lease = lease, Cause = "takeover", PreviousHolder = "p1" }).Text);
            Assert.AreEqual("ann wait for left", Describe(new LeaseChanged { Lease = lease, Cause = "queue" }).Text);
            Assert.AreEqual("left is now takeover", Describe(new LeaseChanged { Lease = lease, Cause = "mode" }).Text);
            Assert.AreEqual("ben has left; left is free (was held by ben)", Describe(new LeasesChanged { Leases = new[] { lease, new Lease { Target = "left" } }, Cause = "later", PreviousHolders = new[] { "p2", "p2" } }).Text);
        }

        [Test]
        public void StopsAndAlarmsSayWhoAndWhy()
        {
            EventSentence stop = Describe(new EStopChanged { Active = true, Participant = "p1", Reason = "too close" });
            Assert.AreEqual(EventLevel.Error, stop.Level);
            Assert.AreEqual("e-stop by ann: too close", stop.Text);
            Assert.AreEqual("e-stop by a connection that has not joined", Describe(new EStopChanged { Active = true }).Text);
            AlignmentAlarmed alarm = new AlignmentAlarmed { Participant = "p1", Kind = AlarmKind.Changed, AnchorId = "table", SizeM = 0.041 };
            Assert.AreEqual("ann sees table 41 mm from where it was", Describe(alarm).Text);
            alarm.Witnesses = new[] { "p2" };
            Assert.IsTrue(string.IsNullOrEmpty(Describe(alarm).Text));
            HeadsetsCompared compared = new HeadsetsCompared { A = "p1", B = "p2", AnchorId = "table", ErrorM = 0.03, ExpectedP95M = 0.01 };
            Assert.AreEqual(EventLevel.Warning, Describe(compared).Level);
            Assert.AreEqual("the session stood still for 3 s", Describe(new Gap { DurationNs = 3_000_000_000 }).Text);
        }

        private static EventSentence Describe(EventKind body) { return EventWords.Describe(body, id => id == "p1" ? "ann" : id == "p2" ? "ben" : ""); }
    }
}
