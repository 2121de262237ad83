// The rounds of a client over a transport and a clock of the test: reconnects, addresses, certificates, media.
using System.Collections.Generic;
using System.Linq;
using IrisSession.Core;
using IrisSession.Protocol;
using NUnit.Framework;

namespace IrisSession.Transport.Tests
{
    [TestFixture]
    public class SessionLoopTests
    {
        private const long Ms = LoopRig.Ms;
        private const long Second = LoopRig.Second;
        private static readonly WebEndpoint Cable = new WebEndpoint(false, "localhost", 7725);
        private static readonly WebEndpoint Wifi = new WebEndpoint(true, "192.168.0.10", 7725, new byte[32]);

        private static List<Hello> Hellos(LoopRig rig)
        {
            return rig.Transport.Sent.Select(each => each.Message).OfType<Hello>().ToList();
        }

        [Test]
        public void JoinsAndHandsOutStates()
        {
            LoopRig rig = new LoopRig(Cable);
            rig.Join();
            for (int i = 0; i < 5; i++)
            {
                rig.SendState();
                rig.Run(5 * Ms);
            }
            Assert.AreEqual(5, rig.States);
            Assert.AreEqual(1, rig.Transport.Opened.Count);
            rig.Run(3 * Second);
            Assert.GreaterOrEqual(rig.Received.OfType<ClientReport>().Count(), 2);
            Assert.GreaterOrEqual(rig.Received.OfType<Heartbeat>().Count(), 4);
        }

        [TestCase(LinkFailure.Unreachable, 0)]
        [TestCase(LinkFailure.Closed, CloseCode.Restart)]
        [TestCase(LinkFailure.Closed, CloseCode.TooSlow)]
        [TestCase(LinkFailure.Overflow, 0)]
        public void LostConnectionIsResumedAtOnceWithItsToken(LinkFailure failure, int code)
        {
            LoopRig rig = new LoopRig(Cable);
            rig.Join();
            rig.Run(2 * Second);
            rig.Transport.Break(failure, code);
            rig.Loop.Step();
            rig.Loop.Step();
            Assert.AreEqual(2, rig.Transport.Opened.Count);
            CollectionAssert.AreEqual(new byte[] { 1 }, Hellos(rig)[1].ResumeToken);
            rig.Run(200 * Ms);
            Assert.AreEqual(ConnectionPhase.Ready, rig.Phase);
            Assert.AreEqual(1, rig.Loop.Connection.Counters.Reconnects);
        }

        [TestCase(true)]
        [TestCase(false)]
        public void ASessionThatIsLeftWhileItIsLostCanBeResumed(bool isLost)
        {
            LoopRig rig = new LoopRig(Cable);
            rig.Join();
            rig.Run(2 * Second);
            if (isLost) rig.Transport.Break(LinkFailure.Unreachable, 0);
            rig.Loop.Step();
            rig.Loop.Close();
            CollectionAssert.AreEqual(isLost ? new byte[] { 1 } : new byte[0], rig.Loop.Connection.Identity.ResumeToken);
        }

        [Test]
        public void SilentSessionIsJoinedAgain()
        {
            LoopRig rig = new LoopRig(Cable);
            rig.Join();
            rig.Run(6 * Second, false);
            Assert.AreEqual(1, rig.Loop.Connection.Counters.Reconnects);
            Assert.GreaterOrEqual(rig.Transport.Opened.Count, 2);
            rig.Run(5 * Second);
            Assert.AreEqual(ConnectionPhase.Ready, rig.Phase);
        }

        [Test]
        public void ADeadServerIsTriedAgainWithPauses()
        {
            LoopRig rig = new LoopRig(Cable);
            rig.Loop.Open();
            long until = rig.NowNs + 60 * Second;
            while (rig.NowNs < until)
            {
                rig.Loop.Step();
                if (rig.Transport.State == TransportState.Open) rig.Transport.Break(LinkFailure.Unreachable);
                rig.NowNs += Ms;
            }
            Assert.That(rig.Transport.Opened.Count, Is.InRange(60, 200)); // a gateway that restarts is back within seconds
            Assert.AreEqual(AdviceKind.Link, FirstAdvice(rig));
            rig.Run(2 * Second);
            Assert.AreEqual(ConnectionPhase.Ready, rig.Phase);
            Assert.AreNotEqual(AdviceKind.Link, FirstAdvice(rig));
        }

        [Test]
        public void AfterAFloodItComesLater()
        {
            LoopRig rig = new LoopRig(Cable);
            rig.Join();
            rig.Run(2 * Second);
            rig.Transport.Break(LinkFailure.Closed, CloseCode.Flood);
            rig.Run(1900 * Ms);
            Assert.AreEqual(1, rig.Transport.Opened.Count);
            rig.Run(300 * Ms);
            Assert.AreEqual(2, rig.Transport.Opened.Count);
        }

        [TestCase(CloseCode.Version)]
        [TestCase(CloseCode.NotAllowed)]
        public void WhatIsNotAllowedIsNotTriedAgainUntilAsked(int code)
        {
            LoopRig rig = new LoopRig(Cable);
            rig.Join();
            rig.Transport.Break(LinkFailure.Closed, code);
            rig.Run(30 * Second);
            Assert.AreEqual(1, rig.Transport.Opened.Count);
            Assert.AreEqual(code, rig.Loop.Problem.Code);
            Assert.AreEqual(code == CloseCode.Version ? AdviceKind.OtherVersion : AdviceKind.Link, FirstAdvice(rig));
            rig.Loop.Open();
            rig.Run(200 * Ms);
            Assert.AreEqual(ConnectionPhase.Ready, rig.Phase);
            Assert.AreEqual(LinkFailure.None, rig.Loop.Problem.Failure);
        }

        [Test]
        public void AnUnknownCertificateWaitsForThePerson()
        {
            byte[] shown = TestCertificate.First.Hash;
            LoopRig rig = new LoopRig(new WebEndpoint(true, "192.168.0.10", 7725));
            rig.Loop.Open();
            rig.Loop.Step();
            rig.Transport.Break(LinkFailure.UnknownCertificate, 0, shown);
            rig.Run(30 * Second);
            Assert.AreEqual(1, rig.Transport.Opened.Count);
            Assert.AreEqual(LinkFailure.UnknownCertificate, rig.Loop.Problem.Failure);
            CollectionAssert.AreEqual(shown, rig.Loop.Problem.CertificateHash);
            rig.Loop.Trust(TestCertificate.Second.Hash);
            Assert.AreEqual(LinkFailure.UnknownCertificate, rig.Loop.Problem.Failure);
            rig.Loop.Trust(shown);
            rig.Run(200 * Ms);
            Assert.AreEqual(ConnectionPhase.Ready, rig.Phase);
            CollectionAssert.AreEqual(shown, rig.Transport.Newest.Pin);
        }

        [Test]
        public void ACableThatIsNotThereGivesWayAndIsPreferredWhenItAnswers()
        {
            LoopRig rig = new LoopRig(Cable, Wifi);
            rig.Loop.Open();
            rig.Loop.Step();
            rig.Transport.Break(LinkFailure.Unreachable);
            rig.Run(500 * Ms);
            Assert.AreEqual(ConnectionPhase.Ready, rig.Phase);
            Assert.AreSame(Wifi, rig.Transport.Newest);
            rig.Run(3 * Second);
            CollectionAssert.AreEqual(new[] { Cable }, rig.Transport.Probes);
            rig.Transport.ProbeAnswers.Enqueue(new ProbeAnswer(Cable, new LinkEnd(LinkFailure.Unreachable, 0, ""), ""));
            rig.Run(3 * Second);
            Assert.AreEqual(2, rig.Transport.Probes.Count);
            Assert.AreEqual(2, rig.Transport.Opened.Count);
            rig.Transport.ProbeAnswers.Enqueue(new ProbeAnswer(Cable, default, "another session"));
            rig.Run(3 * Second);
            Assert.AreEqual(2, rig.Transport.Opened.Count);
            rig.Transport.ProbeAnswers.Enqueue(new ProbeAnswer(Cable, default, "s1"));
            byte[] token = rig.Identity.ResumeToken;
            rig.Run(500 * Ms);
            Assert.AreEqual(ConnectionPhase.Ready, rig.Phase);
            Assert.AreSame(Cable, rig.Transport.Newest);
            CollectionAssert.AreEqual(token, Hellos(rig)[Hellos(rig).Count - 1].ResumeToken);
            Assert.AreEqual(1, rig.Endpoints.Moves);
            rig.Run(2 * Second);
            rig.Transport.Break(LinkFailure.Unreachable); // unplugged
            rig.Loop.Step();
            rig.Loop.Step();
            rig.Transport.Break(LinkFailure.Unreachable);
            rig.Run(500 * Ms);
            Assert.AreEqual(ConnectionPhase.Ready, rig.Phase);
            Assert.AreSame(Wifi, rig.Transport.Newest);
        }

        [Test]
        public void AnAddressThatAnswersOnlyProbesIsLeftAloneForAWhile()
        {
            LoopRig rig = new LoopRig(Cable, Wifi);
            rig.Loop.Open();
            rig.Loop.Step();
            rig.Transport.Break(LinkFailure.Unreachable);
            rig.Run(3 * Second);
            rig.Transport.ProbeAnswers.Enqueue(new ProbeAnswer(Cable, default, "s1"));
            rig.Loop.Step();
            rig.Loop.Step();
            Assert.AreSame(Cable, rig.Transport.Newest);
            rig.Transport.Break(LinkFailure.Unreachable);
            rig.Run(20 * Second);
            Assert.AreSame(Wifi, rig.Transport.Newest);
            Assert.AreEqual(ConnectionPhase.Ready, rig.Phase);
            Assert.AreEqual(1, rig.Transport.Probes.Count);
            rig.Run(15 * Second);
            Assert.AreEqual(2, rig.Transport.Probes.Count);
        }

        [Test]
        public void AnAnswerThatComesBetweenConnectionsMovesNothingAndProbesGoOn()
        {
            LoopRig rig = new LoopRig(Cable, Wifi);
            rig.Loop.Open();
            rig.Loop.Step();
            rig.Transport.Break(LinkFailure.Unreachable);
            rig.Run(3 * Second);
            Assert.AreEqual(1, rig.Transport.Probes.Count);
            rig.Transport.Break(LinkFailure.Unreachable);
            rig.Transport.ProbeAnswers.Enqueue(new ProbeAnswer(Cable, default, "s1"));
            rig.Loop.Step(); // lost, and an answer at the same time
            rig.Loop.Step();
            rig.Transport.Break(LinkFailure.Unreachable);
            rig.Run(5 * Second);
            Assert.AreSame(Wifi, rig.Transport.Newest);
            Assert.AreEqual(2, rig.Transport.Probes.Count);
            Assert.AreEqual(0, rig.Endpoints.Moves);
        }

        [Test]
        public void NothingMovesWhileARobotFollows()
        {
            LoopRig rig = new LoopRig(Cable, Wifi);
            rig.Loop.Open();
            rig.Loop.Step();
            rig.Transport.Break(LinkFailure.Unreachable);
            rig.Run(500 * Ms);
            SampleInput input = new SampleInput { Device = Device.ControllerRight, Pose = new RigidTransform(new Double3(0.1, 0.2, 1), DoubleQuaternion.Identity) };
            input.Robots.Add("left");
            rig.Loop.SendSample(input);
            input.Clutch = true; // one that is closed from the first on is open
            for (int i = 0; i < 500; i++)
            {
                rig.Loop.SendSample(input);
                rig.Run(10 * Ms);
            }
            CollectionAssert.IsEmpty(rig.Transport.Probes);
            rig.Run(2 * Second);
            Assert.AreEqual(1, rig.Transport.Probes.Count);
        }

        [Test]
        public void AProbeThatIsAnsweredDuringAReconnectIsNotTheLast()
        {
            LoopRig rig = new LoopRig(Cable, Wifi);
            rig.Loop.Open();
            rig.Loop.Step();
            rig.Transport.Break(LinkFailure.Unreachable);
            rig.Run(3 * Second);
            Assert.AreEqual(1, rig.Transport.Probes.Count);
            rig.Transport.Break(LinkFailure.Unreachable);
            rig.Loop.Step();
            rig.Transport.ProbeAnswers.Enqueue(new ProbeAnswer(Cable, new LinkEnd(LinkFailure.Unreachable, 0, ""), ""));
            rig.Loop.Step();
            rig.Transport.Break(LinkFailure.Unreachable);
            rig.Run(5 * Second);
            Assert.AreSame(Wifi, rig.Transport.Newest);
            Assert.Greater(rig.Transport.Probes.Count, 1);
        }

        [Test]
        public void AProbeThatIsAnsweredWhileARobotFollowsMovesNothing()
        {
            LoopRig rig = new LoopRig(Cable, Wifi);
            rig.Loop.Open();
            rig.Loop.Step();
            rig.Transport.Break(LinkFailure.Unreachable);
            rig.Run(3 * Second);
            Assert.AreEqual(1, rig.Transport.Probes.Count);
            SampleInput input = new SampleInput { Device = Device.ControllerRight, Pose = new RigidTransform(new Double3(0.1, 0.2, 1), DoubleQuaternion.Identity) };
            input.Robots.Add("left");
            rig.Loop.SendSample(input);
            input.Clutch = true;
            rig.Loop.SendSample(input);
            rig.Transport.ProbeAnswers.Enqueue(new ProbeAnswer(Cable, default, "s1"));
            rig.Run(500 * Ms);
            Assert.AreSame(Wifi, rig.Transport.Newest);
            rig.Run(4 * Second);
            Assert.AreEqual(2, rig.Transport.Probes.Count, "it is tried again later");
        }

        [Test]
        public void AnAddressThatIsPairedAnewHasItsNewKey()
        {
            LoopRig rig = new LoopRig(Wifi);
            rig.Loop.Open();
            rig.Loop.Step();
            rig.Transport.Break(LinkFailure.WrongCertificate, 0, TestCertificate.First.Hash);
            rig.Run(Second);
            rig.Endpoints.Add(Wifi.WithPin(TestCertificate.First.Hash));
            rig.Join();
            CollectionAssert.AreEqual(TestCertificate.First.Hash, rig.Transport.Newest.Pin);
        }

        [Test]
        public void AnotherCertificateOnOneAddressDoesNotStopTheOther()
        {
            LoopRig rig = new LoopRig(Wifi, Cable);
            rig.Loop.Open();
            rig.Loop.Step();
            rig.Transport.Break(LinkFailure.WrongCertificate, 0, TestCertificate.First.Hash);
            rig.Run(5 * Second);
            Assert.AreEqual(ConnectionPhase.Ready, rig.Phase);
            CollectionAssert.AreEqual(new[] { Wifi, Cable }, rig.Transport.Opened);
            CollectionAssert.IsEmpty(rig.Transport.Probes);
        }

        [Test]
        public void MediaAreForConnectionsWithABudget()
        {
            LoopRig rig = new LoopRig(Cable);
            rig.Loop.SetMediaWishes(new[] { "cloud" });
            rig.Join();
            Assert.AreEqual(0, rig.Transport.MediaEpoch);
            rig.Send(new DeliveryBudget { BudgetClass = "full" });
            rig.Run(10 * Ms);
            Assert.AreEqual(1, rig.Transport.MediaEpoch);
            CollectionAssert.AreEqual(new[] { "cloud" }, rig.Transport.Wishes);
            rig.Run(2 * Second);
            rig.Transport.Break(LinkFailure.Unreachable);
            rig.Run(300 * Ms);
            Assert.AreEqual(ConnectionPhase.Ready, rig.Phase);
            Assert.AreEqual(0, rig.Transport.MediaEpoch);
            rig.Send(new DeliveryBudget { BudgetClass = "full" });
            rig.Run(10 * Ms);
            Assert.AreEqual(2, rig.Transport.MediaEpoch);
        }

        [Test]
        public void SamplesReportsAndAdviceFollowTheHeadset()
        {
            LoopRig rig = new LoopRig(Cable);
            rig.Join();
            SampleInput input = new SampleInput { Device = Device.ControllerRight, Pose = new RigidTransform(new Double3(0.1, 0.2, 1), DoubleQuaternion.Identity) };
            rig.Loop.SendSample(input);
            rig.Loop.Headset.SetFocus(AppFocus.Covered);
            rig.Loop.Health.Newest = new DeviceHealth { Battery = 0.25, Thermal = ThermalState.Warm };
            rig.Loop.SendSample(input);
            rig.Run(2 * Second);
            List<ClientMessage> sent = rig.Transport.Sent.ConvertAll(one => one.Message);
            List<ClientMessage> samples = sent.FindAll(one => one is Sample);
            Assert.IsTrue(((Sample)samples[0]).Tracked);
            Assert.IsFalse(((Sample)samples[1]).Tracked);
            Assert.AreEqual(0.25, ((ClientReport)sent.FindLast(one => one is ClientReport)).Battery);
            rig.Loop.Note(new Reply { Denial = new Denial { Reason = DenialReason.Held } });
            List<Advice> advice = new List<Advice>();
            rig.Loop.ListAdvice(advice);
            Assert.IsTrue(advice.Exists(one => one.Kind == AdviceKind.Covered));
            Assert.IsTrue(advice.Exists(one => one.Kind == AdviceKind.Denied));
        }

        [Test]
        public void WhileTheSocketIsFullSamplesAreDroppedAndTheRestWaits()
        {
            LoopRig rig = new LoopRig(Cable);
            rig.Join();
            rig.Transport.IsFull = true;
            SampleInput input = new SampleInput { Device = Device.ControllerRight, Pose = new RigidTransform(new Double3(0.1, 0.2, 1), DoubleQuaternion.Identity) };
            rig.Loop.SendSample(input);
            long before = rig.Loop.Connection.Counters.SamplesNotSent;
            rig.Loop.Step();
            Assert.AreEqual(before + 1, rig.Loop.Connection.Counters.SamplesNotSent);
            rig.Loop.Connection.Send(new EStop { Reason = "test" });
            rig.Loop.Step();
            Assert.LessOrEqual(rig.Loop.NextWaitNs(), 10 * Ms);
            rig.Transport.IsFull = false;
            rig.Loop.Step();
            Assert.AreEqual(1, rig.Transport.Sent.Count(each => each.Message is EStop));
        }

        private static AdviceKind FirstAdvice(LoopRig rig)
        {
            List<Advice> advice = new List<Advice>();
            rig.Loop.ListAdvice(advice);
            return advice[0].Kind;
        }

        [Test]
        public void ClosingSaysBye()
        {
            LoopRig rig = new LoopRig(Cable);
            rig.Join();
            rig.Loop.Close();
            Assert.IsInstanceOf<Bye>(rig.Transport.Sent[rig.Transport.Sent.Count - 1].Message);
            Assert.AreEqual(TransportState.Closed, rig.Transport.State);
            CollectionAssert.IsEmpty(rig.Identity.ResumeToken);
        }
    }
}
