// What reports of the headset do to worn, tracking epoch, clutches and samples.
using System;
using System.Collections.Generic;
using System.Linq;
using IrisSession.Protocol;
using NUnit.Framework;

namespace IrisSession.Core.Tests
{
    [TestFixture]
    public class HeadsetStateTests
    {
        private static readonly RigidTransform Here = new RigidTransform(new Double3(1.0, 2.0, 3.0), DoubleQuaternion.Identity);
        private static readonly RigidTransform There = new RigidTransform(new Double3(4.0, 5.0, 6.0), DoubleQuaternion.Identity);

        private FakeSession session;
        private HeadsetState headset;

        [SetUp]
        public void Prepare()
        {
            session = FakeSession.Join();
            session.TakeSent();
            headset = new HeadsetState(session.Client);
        }

        [TestCase(AppFocus.Background, false)]
        [TestCase(AppFocus.Covered, true)]
        public void WhatCoversTheAppHoldsRobotsUntilTheClutchIsLetGo(AppFocus focus, bool isWorn)
        {
            Assert.IsFalse(Judge(Here, clutch: false).Clutch);
            Assert.IsTrue(Judge(Here, clutch: true).Clutch);
            headset.SetFocus(focus);
            Assert.AreEqual(isWorn, session.Client.IsWorn);
            Assert.AreEqual(isWorn ? 0 : 1, session.TakeSent().OfType<Heartbeat>().Count(beat => !beat.Worn), "said at once");
            SampleInput hidden = Judge(There, clutch: true);
            Assert.AreEqual(PoseValidity.NotSeen, hidden.Validity);
            Assert.AreEqual(Here, hidden.Pose, "where it was");
            Assert.IsFalse(hidden.Clutch);
            Assert.AreEqual(0, hidden.Buttons);
            Assert.IsNull(hidden.Gripper);
            headset.SetFocus(AppFocus.Focused);
            Assert.IsTrue(session.Client.IsWorn);
            Assert.IsFalse(Judge(There, clutch: true).Clutch, "it was held all the time");
            Assert.IsFalse(Judge(There, clutch: false).Clutch);
            Assert.IsTrue(Judge(There, clutch: true).Clutch);
            Assert.AreEqual(new[] { focus == AppFocus.Covered ? HeadsetEvent.Covered : HeadsetEvent.Background, HeadsetEvent.Focused }, TakeEvents());
        }

        [Test]
        public void OffTheHeadIsNotWornWhateverTheFocusIs()
        {
            Judge(Here, clutch: false);
            headset.SetOnHead(false);
            headset.SetFocus(AppFocus.Background);
            headset.SetFocus(AppFocus.Focused);
            Assert.IsFalse(session.Client.IsWorn);
            Assert.AreEqual(PoseValidity.NotSeen, Judge(Here, clutch: false).Validity);
            headset.SetOnHead(true);
            headset.SetOnHead(true);
            Assert.IsTrue(session.Client.IsWorn);
            Assert.AreEqual(PoseValidity.Measured, Judge(Here, clutch: false).Validity);
            Assert.AreEqual(4, TakeEvents().Count);
        }

        [Test]
        public void RecentringIsANewTrackingFrame()
        {
            Judge(Here, clutch: false);
            Assert.IsTrue(Judge(Here, clutch: true).Clutch);
            headset.OnRecentred();
            Assert.AreEqual(1, session.Client.TrackingEpoch);
            Assert.AreEqual(1, session.TakeSent().OfType<TrackingEpoch>().Single().TrackingEpochValue);
            SampleInput lost = Make(default, PoseValidity.NotSeen);
            lost.Clutch = true;
            Assert.IsFalse(headset.Judge(lost), "the last pose is of the old frame");
            SampleInput input = Judge(There, clutch: true);
            Assert.AreEqual(PoseValidity.Measured, input.Validity);
            Assert.IsFalse(input.Clutch);
            Assert.AreEqual(1, headset.Suspensions);
        }

        [Test]
        public void WhatIsNotMeasuredIsNotSaidToBe()
        {
            Assert.IsFalse(headset.Judge(Make(Here, PoseValidity.NotSeen)), "there was no pose yet");
            Judge(Here, clutch: false);
            foreach (RigidTransform bad in new[]
            {
                RigidTransform.Identity, default, new RigidTransform(new Double3(double.NaN, 0.0, 0.0), DoubleQuaternion.Identity),
                new RigidTransform(new Double3(1.0, 0.0, 0.0), default), new RigidTransform(new Double3(double.PositiveInfinity, 0.0, 0.0), DoubleQuaternion.Identity),
            })
            {
                SampleInput input = Judge(bad, clutch: true);
                Assert.AreEqual(PoseValidity.NotSeen, input.Validity);
                Assert.AreEqual(Here, input.Pose);
                Assert.IsFalse(input.Clutch);
            }
            Assert.AreEqual(5, headset.ImplausiblePoses);
            Judge(Here, clutch: false);
            SampleInput guess = Make(There, PoseValidity.Emulated);
            guess.Clutch = true;
            Assert.IsTrue(headset.Judge(guess));
            Assert.AreEqual(PoseValidity.Emulated, guess.Validity);
            Assert.IsFalse(guess.Clutch);
            Assert.IsFalse(Judge(There, clutch: true).Clutch, "measured again, and not let go");
        }

        [Test]
        public void AGuessNamesItsRobotUntilTheSessionHoldsForIt()
        {
            Assert.AreEqual(1, Guess().Robots.Count);
            headset.TakeFeedback(new Feedback { Robot = "left", HoldReason = HoldReason.Emulated });
            Assert.AreEqual(0, Guess().Robots.Count);
            Assert.AreEqual(1, Judge(Here, clutch: false).Robots.Count, "a measured pose does");
            headset.TakeFeedback(new Feedback { Robot = "left", HoldReason = "" });
            Assert.AreEqual(1, Guess().Robots.Count);
        }

        [Test]
        public void HandsWithoutPermissionAreNotSeen()
        {
            headset.SetPermission(HeadsetPermission.Hands, true);
            SampleInput hand = Make(Here, PoseValidity.Measured);
            hand.Device = Device.HandLeft;
            hand.HandJoints = new double[7];
            headset.Judge(hand);
            Assert.AreEqual(PoseValidity.Measured, hand.Validity);
            headset.SetPermission(HeadsetPermission.Hands, false);
            headset.Judge(hand);
            Assert.AreEqual(PoseValidity.NotSeen, hand.Validity);
            Assert.AreEqual(0, hand.HandJoints.Length);
            Assert.AreEqual(PoseValidity.Measured, Judge(Here, clutch: false).Validity, "controllers are");
            Assert.IsTrue(headset.CanSeeSheets);
            headset.SetPermission(HeadsetPermission.Camera, false);
            Assert.IsFalse(headset.CanSeeSheets);
            headset.SetPermission(HeadsetPermission.Scene, true);
            Assert.IsTrue(headset.CanSeeSheets);
            for (int i = 0; i < 100; i++) headset.SetPermission(HeadsetPermission.Scene, i % 2 == 0);
            Assert.AreEqual(32, TakeEvents().Count);
            Assert.Greater(headset.DroppedEvents, 50);
        }

        [Test]
        public void JudgingAllocatesNothing()
        {
            SampleInput input = Make(Here, PoseValidity.Measured);
            headset.TakeFeedback(new Feedback { Robot = "left", HoldReason = HoldReason.Emulated });
            long before = 0;
            for (int i = -100; i < 10_000; i++)
            {
                if (i == 0) before = GC.GetAllocatedBytesForCurrentThread();
                if (input.Robots.Count == 0) input.Robots.Add("left");
                input.Pose = new RigidTransform(new Double3(i, 1.0, 2.0), DoubleQuaternion.Identity);
                input.Validity = (PoseValidity)((i + 100) % 3);
                input.Clutch = i % 7 < 4;
                headset.Judge(input);
            }
            Assert.AreEqual(0, GC.GetAllocatedBytesForCurrentThread() - before);
        }

        private SampleInput Guess()
        {
            SampleInput input = Make(There, PoseValidity.Emulated);
            headset.Judge(input);
            return input;
        }

        private SampleInput Judge(RigidTransform pose, bool clutch)
        {
            SampleInput input = Make(pose, PoseValidity.Measured);
            input.Clutch = clutch;
            Assert.IsTrue(headset.Judge(input));
            return input;
        }

        private static SampleInput Make(RigidTransform pose, PoseValidity validity)
        {
            SampleInput input = new SampleInput { Device = Device.ControllerRight, Pose = pose, Validity = validity, Gripper = 0.5, Buttons = 3 };
            input.Robots.Add("left");
            return input;
        }

        private List<HeadsetEvent> TakeEvents()
        {
            List<HeadsetEvent> events = new List<HeadsetEvent>();
            while (headset.TryTakeEvent(out HeadsetEvent one)) events.Add(one);
            return events;
        }
    }
}
