// What is wrong has words; every reason of the protocol does.
using System;
using System.Collections.Generic;
using System.Linq;
using System.Reflection;
using IrisSession.Protocol;
using NUnit.Framework;

namespace IrisSession.Core.Tests
{
    [TestFixture]
    public class ClientAdviceTests
    {
        private static readonly Func<string, Phrase>[] Tables =
        {
            Words.OfHold, reason => Words.OfDenial(new Denial { Reason = reason }), code => Words.OfRefusal(new Refused { Code = code, SupportedVersions = new long[0] }),
            Words.OfFault, Words.OfAsset, Words.OfStream,
        };

        [TestCase(typeof(HoldReason), 0)]
        [TestCase(typeof(DenialReason), 1)]
        [TestCase(typeof(RefusalCode), 2)]
        [TestCase(typeof(FaultCode), 3)]
        [TestCase(typeof(AssetRefusal), 4)]
        [TestCase(typeof(StreamFault), 5)]
        public void EveryReasonHasWords(Type names, int table)
        {
            List<string> reasons = names.GetFields(BindingFlags.Public | BindingFlags.Static).Select(field => (string)field.GetRawConstantValue()).ToList();
            Assert.Greater(reasons.Count, 5);
            foreach (string reason in reasons)
            {
                Phrase phrase = Tables[table](reason);
                Assert.Greater(phrase.What.Split(' ').Length, 1, reason);
            }
            Assert.AreEqual("some later reason", Tables[table]("some_later_reason").What);
        }

        [Test]
        public void WordsOfTheSessionComeFirst()
        {
            Phrase phrase = Words.OfDenial(new Denial { Reason = DenialReason.Held, Message = "left is in use", Advice = "ask bob", HolderName = "bob" });
            Assert.AreEqual("Left is in use (held by bob). Ask bob.", phrase.ToString());
            Assert.AreEqual("Bob has it.", Words.OfDenial(new Denial { Reason = "later", Message = "Bob has it.", HolderName = "Bob" }).ToString());
            Assert.IsTrue(Words.OfRefusal(new Refused { Code = RefusalCode.Version, SupportedVersions = new long[] { 2, 3 } }).What.Contains("2, 3"));
        }

        [TestCase(0.00751, "7.5 mm")]
        [TestCase(0.041, "41 mm")]
        [TestCase(0.123, "12 cm")]
        [TestCase(2.04, "2.0 m")]
        public void Lengths(double metres, string text) { Assert.AreEqual(text, Words.FormatLength(metres)); }

        [Test]
        public void AHealthySessionHasOnlyTheAlignmentToSay()
        {
            FakeSession session = FakeSession.Join();
            Assert.AreEqual(new[] { AdviceKind.NotAligned }, List(session, out _).Select(one => one.Kind));
            Align(session, AlignmentKind.Measured);
            Assert.AreEqual(0, List(session, out _).Count);
            Align(session, AlignmentKind.Fingertip);
            Assert.AreEqual(new[] { AdviceKind.ViewOnly }, List(session, out _).Select(one => one.Kind));
            session.Client.ReportTrackingJump();
            Assert.AreEqual(new[] { AdviceKind.NotAligned }, List(session, out _).Select(one => one.Kind), "the alignment was of the frame before");
        }

        [Test]
        public void TheNearestSheetIsNamedWithItsDistance()
        {
            FakeSession session = FakeSession.Join();
            foreach (double x in new[] { 1.0, 3.0, 7.0, 9.0 })
            {
                Pose pose = new Pose();
                pose.P[0] = x;
                pose.Q[0] = 1.0;
                session.SendEvent(new AnchorMoved { AnchorId = "sheet-" + x, T_world_anchor = pose });
            }
            string text = List(session, out _)[0].Phrase.Remedy;
            Assert.IsTrue(text.Contains("sheet-1") && text.Contains("sheet-7") && !text.Contains("sheet-9"), text);
            Align(session, AlignmentKind.Persistent);
            text = List(session, out _, head: new RigidTransform(new Double3(2.5, 0.0, 0.0), DoubleQuaternion.Identity))[0].Phrase.Remedy;
            Assert.IsTrue(text.Contains("sheet-3") && text.Contains("50 cm") && !text.Contains("sheet-1"), text);
        }

        [Test]
        public void ConnectionsThatFailSayWhy()
        {
            FakeSession session = new FakeSession();
            Assert.AreEqual(AdviceKind.Joining, List(session, out _).Single().Kind);
            session.Client.Open(0);
            session.Receive(new Refused { Code = RefusalCode.Unpaired });
            Advice advice = List(session, out _).Single();
            Assert.AreEqual(AdviceKind.Refused, advice.Kind);
            Assert.AreEqual(RefusalCode.Unpaired, advice.Reason);
            session.Client.Open(0);
            session.Receive(new Refused { Code = RefusalCode.Version, SupportedVersions = new long[] { 2 } });
            Assert.AreEqual(AdviceKind.OtherVersion, List(session, out _).Single().Kind);
            session.Client.Open(0);
            ClientAdvice panel = new ClientAdvice(session.Client, new ClientAlignment(session.Client)) { Link = new Phrase("the certificate is another one", "pair again") };
            List<Advice> list = new List<Advice>();
            panel.List(session.NowNs, list);
            Assert.AreEqual(AdviceKind.Link, list.Single().Kind);
        }

        [Test]
        public void StateThatIsOldIsSaidToBe()
        {
            FakeSession session = FakeSession.Join();
            Align(session, AlignmentKind.Measured);
            List<Advice> list = List(session, out ClientAdvice panel);
            Assert.AreEqual(0, list.Count);
            Assert.IsFalse(panel.IsStale(session.NowNs + ClientAdvice.StaleNs));
            Assert.IsTrue(panel.IsStale(session.NowNs + ClientAdvice.StaleNs + 1));
            panel.List(session.NowNs + FakeSession.Second, list);
            Assert.AreEqual(AdviceKind.Stale, list.Single().Kind);
            session.Receive(new ProtocolFault { Code = FaultCode.Stalled });
            Assert.IsTrue(List(session, out _).Any(one => one.Kind == AdviceKind.Stalled));
        }

        [Test]
        public void EverythingElseIsListedByUrgency()
        {
            FakeSession session = FakeSession.Join();
            Align(session, AlignmentKind.Measured);
            HeadsetState headset = new HeadsetState(session.Client);
            headset.SetFocus(AppFocus.Covered);
            headset.SetTracking(false);
            headset.SetPermission(HeadsetPermission.Camera, false);
            headset.SetPermission(HeadsetPermission.Hands, false);
            session.SendEvent(new EStopChanged { Active = true });
            session.SendEvent(new PauseChanged { Paused = true });
            session.Receive(new DeliveryBudget { BudgetClass = BudgetClass.Half });
            ClientAdvice panel = new ClientAdvice(session.Client, new ClientAlignment(session.Client)) { Headset = headset };
            panel.TakeFeedback(new Feedback { Robot = "left", HoldReason = HoldReason.Frozen });
            panel.TakeFeedback(new Feedback { Robot = "right", HoldReason = HoldReason.Frozen });
            panel.TakeDenial(new Denial { Reason = DenialReason.Held }, session.NowNs);
            List<Advice> list = new List<Advice>();
            panel.List(session.NowNs, list);
            Assert.AreEqual(
                new[]
                {
                    AdviceKind.Stopped, AdviceKind.TrackingLost, AdviceKind.Covered, AdviceKind.Holding, AdviceKind.Denied, AdviceKind.Permission, AdviceKind.Permission,
                    AdviceKind.LinkSlow, AdviceKind.Paused,
                },
                list.Select(one => one.Kind));
            Assert.AreEqual(HoldReason.Frozen, list[3].Reason);
            headset.HasMarkerSupport = false;
            panel.TakeFeedback(new Feedback { Robot = "left", HoldReason = HoldReason.Unconfirmed });
            panel.List(session.NowNs + 6 * FakeSession.Second, list);
            Assert.IsTrue(list.Any(one => one.Kind == AdviceKind.Unconfirmed) && list.Any(one => one.Kind == AdviceKind.NoMarkers));
            Assert.AreEqual(1, list.Count(one => one.Kind == AdviceKind.Permission), "hands; which sheets it may see does not matter");
            Assert.IsFalse(list.Any(one => one.Kind == AdviceKind.Holding || one.Kind == AdviceKind.Denied));
        }

        [Test]
        public void ScenesAndCachesThatDoNotFitAreSaidToBe()
        {
            FakeSession session = FakeSession.Join();
            Align(session, AlignmentKind.Measured);
            SceneFollower scene = new SceneFollower(new SceneBudget(1, 0, 1, 0));
            session.SendEvent(new SceneChanged { SceneEpoch = 3, SceneHash = new string('a', 64), Cause = "patch" });
            scene.Follow(session.Client.Mirror, 0);
            byte[] bytes = Golden.FromHex(Golden.Load("scene")["scenes"].Items[0]["hex"].Text);
            scene.OnAsset(new string('a', 64), bytes, 0, bytes.Length);
            ClientAdvice panel = new ClientAdvice(session.Client, new ClientAlignment(session.Client)) { Scene = new SceneFacts(scene, CacheResult.Full) };
            List<Advice> list = new List<Advice>();
            panel.List(session.NowNs, list);
            Assert.AreEqual(new[] { AdviceKind.OverBudget, AdviceKind.CacheFull }, list.Select(one => one.Kind));
            session.SendEvent(new SceneChanged { SceneEpoch = 4, SceneHash = new string('b', 64), Cause = "patch" });
            scene.Follow(session.Client.Mirror, 0);
            scene.OnAsset(new string('b', 64), bytes, 0, 5);
            panel.Scene = new SceneFacts(scene, CacheResult.Kept);
            panel.List(session.NowNs, list);
            Assert.AreEqual(new[] { AdviceKind.SceneUnreadable }, list.Select(one => one.Kind));
        }

        private static List<Advice> List(FakeSession session, out ClientAdvice panel, RigidTransform? head = null)
        {
            panel = new ClientAdvice(session.Client, new ClientAlignment(session.Client)) { Head = head };
            List<Advice> list = new List<Advice>();
            panel.List(session.NowNs, list);
            return list;
        }

        private static void Align(FakeSession session, string kind)
        {
            Pose pose = new Pose();
            pose.Q[0] = 1.0;
            session.SendEvent(new AlignmentChanged { Participant = "p1", Alignment = new Alignment { Version = 1, Kind = kind, T_world_tracking = pose, TrackingEpoch = session.Client.TrackingEpoch } });
        }
    }
}
