using IrisSession.Core;
using IrisSession.Protocol;
using NUnit.Framework;

namespace IrisSession.Interaction.Tests
{
    /// <summary>What hands mean: as the browser's client has it (web_client/tests/xr/hands.test.ts).</summary>
    [TestFixture]
    public class HandInputTests
    {
        [Test]
        public void TriggerAtARobotTakesItAndTheHandDrivesIt()
        {
            Wearer wearer = new Wearer();
            wearer.Run();
            Assert.AreEqual("right", wearer.Input.FindPointed(Side.Right));
            wearer.Tap(Side.Right);
            Assert.AreEqual(new[] { "right" }, ((Acquire)wearer.Session.Requests[0]).Robots);
            Assert.IsTrue(wearer.Input.IsRequested("right"));
            wearer.Session.Give("right", "p1");
            wearer.Input.TakeReply(1, new Reply { Ok = true }, wearer.Input.Reading.CaptureNs);
            wearer.Run();
            Assert.AreEqual("right", wearer.Input.Hands.FindDriven(Side.Right));
            wearer[Side.Right].Squeeze = 1;
            wearer.Run(12);
            SampleInput sample = wearer.Session.Find(Device.ControllerRight);
            Assert.IsTrue(sample.Clutch);
            Assert.AreEqual(new[] { "right" }, sample.Robots.ToArray());
            Assert.AreEqual(wearer.Input.Reading.CaptureNs + FakePort.SessionOffset, sample.CaptureNs);
            Assert.AreEqual(0, wearer.Session.Find(Device.ControllerLeft).Robots.Count);
        }

        [Test]
        public void DenialIsSaidAndTheHandGetsNothing()
        {
            Wearer wearer = new Wearer();
            wearer.Run();
            wearer.Tap(Side.Right);
            wearer.Input.TakeReply(1, new Reply { Denial = new Denial { Reason = DenialReason.Held } }, 0);
            Assert.AreEqual(DenialReason.Held, wearer.Input.News.Denial.Reason);
            wearer.Session.Give("right", "p1");
            wearer.Run();
            Assert.AreEqual("", wearer.Input.Hands.FindDriven(Side.Right), "it came by other ways: a hand that works does not find itself at it");
        }

        [Test]
        public void TriggerHeldAtOnesRobotReleasesIt()
        {
            Wearer wearer = new Wearer();
            wearer.Take(Side.Right, "right");
            int before = wearer.Session.Requests.Count;
            wearer[Side.Right].Trigger = 1;
            wearer.RunFor(HandInput.ReleaseNs / 2);
            Assert.AreEqual(0.5, wearer.Input.Hands.FindReleaseShare(Side.Right, wearer.Input.Reading.CaptureNs), 0.05);
            Assert.AreEqual(before, wearer.Session.Requests.Count);
            wearer.RunFor(HandInput.ReleaseNs);
            Release release = (Release)wearer.Session.Requests[before];
            Assert.AreEqual("right", release.Targets[0].Name);
            Assert.AreEqual(5, release.Targets[0].LeaseVersion);
            Assert.AreEqual(before + 1, wearer.Session.Requests.Count, "once");
        }

        [Test]
        public void ClutchStaysOpenUntilTheSessionHasSeenItOpen()
        {
            Wearer wearer = new Wearer();
            wearer[Side.Right].Squeeze = 0;
            wearer.Session.Give("right", "p1");
            wearer.Run(2);
            wearer[Side.Right].Squeeze = 1; // takes the robot that is named after its side
            wearer.Run();
            Assert.AreEqual("right", wearer.Input.Hands.FindDriven(Side.Right));
            Assert.IsFalse(wearer.Session.Find(Device.ControllerRight).Clutch);
            wearer.Run(10);
            Assert.IsTrue(wearer.Session.Find(Device.ControllerRight).Clutch);
        }

        [Test]
        public void WhatIsHeldWhenAHandAppearsCountsFromItsNextPress()
        {
            Wearer wearer = new Wearer();
            wearer.Take(Side.Right, "right");
            wearer[Side.Right].Squeeze = 1;
            wearer.Run(10);
            Assert.IsTrue(wearer.Session.Find(Device.ControllerRight).Clutch);
            wearer[Side.Right].Validity = PoseValidity.NotSeen;
            wearer.Run(3);
            Assert.IsFalse(wearer.Session.Find(Device.ControllerRight).Clutch);
            wearer[Side.Right].Validity = PoseValidity.Measured;
            wearer.Run(20);
            Assert.IsFalse(wearer.Session.Find(Device.ControllerRight).Clutch);
            Assert.AreEqual(Ignored.Squeeze, wearer.Input.Hands.FindIgnored(Side.Right));
            wearer[Side.Right].Squeeze = 0;
            wearer.Run(2);
            wearer[Side.Right].Squeeze = 1;
            wearer.Run(2);
            Assert.IsTrue(wearer.Session.Find(Device.ControllerRight).Clutch);
        }

        [TestCase(0)]
        [TestCase(1)]
        [TestCase(2)]
        public void InputThatDoesNotReachTheSceneOpensTheClutch(int way)
        {
            Wearer wearer = new Wearer();
            wearer.Take(Side.Right, "right");
            wearer[Side.Right].Squeeze = 1;
            wearer.Run(10);
            if (way == 0) wearer.IsLive = false; // a menu, or the headset is off
            else if (way == 1) wearer.Suspensions++; // the runtime said so between two frames
            else wearer.Input.Reading.CaptureNs += 600_000_000; // it stood still
            wearer.Run();
            wearer.IsLive = true;
            wearer.Run(20);
            Assert.IsFalse(wearer.Session.Find(Device.ControllerRight).Clutch);
        }

        [Test]
        public void NotLiveIsReportedAsNotSeenWhereItWas()
        {
            Wearer wearer = new Wearer();
            wearer.Run();
            wearer.IsLive = false;
            wearer.Run();
            foreach (string device in new[] { Device.Head, Device.ControllerLeft, Device.ControllerRight })
            {
                Assert.AreEqual(PoseValidity.NotSeen, wearer.Session.Find(device).Validity);
            }
            Assert.AreEqual(1.6, wearer.Session.Find(Device.Head).Pose.Position.Z);
        }

        [Test]
        public void GripperFollowsOnlyOnceTheTriggerIsAsFarAsItMayBe()
        {
            Wearer wearer = new Wearer();
            wearer.Take(Side.Right, "right");
            wearer.Input.Take(new Feedback { Robot = "right" }, 0); // the session moves it
            wearer.PointUp(Side.Right);
            wearer[Side.Right].Squeeze = 1;
            wearer.Run(12);
            Assert.IsNull(wearer.Session.Find(Device.ControllerRight).Gripper, "it may hold an object");
            wearer[Side.Right].Trigger = 1;
            wearer.Run(2);
            Assert.AreEqual(1, wearer.Session.Find(Device.ControllerRight).Gripper);
            wearer[Side.Right].Trigger = 0.2;
            wearer.Run(2);
            Assert.AreEqual(0.2, wearer.Session.Find(Device.ControllerRight).Gripper);
        }

        [Test]
        public void EstimatedPoseNamesItsRobotUntilTheSessionHolds()
        {
            Wearer wearer = new Wearer();
            wearer.Take(Side.Right, "right");
            wearer[Side.Right].Validity = PoseValidity.Emulated;
            wearer.Run(2);
            SampleInput sample = wearer.Session.Find(Device.ControllerRight);
            Assert.AreEqual(PoseValidity.Emulated, sample.Validity);
            Assert.IsFalse(sample.Clutch);
            Assert.AreEqual(1, sample.Robots.Count);
            wearer.Input.Take(new Feedback { Robot = "right", HoldReason = HoldReason.Emulated }, 0);
            wearer.Run(2);
            Assert.AreEqual(0, wearer.Session.Find(Device.ControllerRight).Robots.Count);
        }

        [Test]
        public void TwoHandsDriveTwoRobots()
        {
            Wearer wearer = new Wearer();
            wearer.Session.Give("left", "p1");
            wearer.Session.Give("right", "p1");
            wearer.Run(2);
            wearer[Side.Left].Squeeze = wearer[Side.Right].Squeeze = 1;
            wearer.Run(12);
            Assert.AreEqual(new[] { "left" }, wearer.Session.Find(Device.ControllerLeft).Robots.ToArray());
            Assert.AreEqual(new[] { "right" }, wearer.Session.Find(Device.ControllerRight).Robots.ToArray());
            Assert.IsTrue(wearer.Input.Hands.TryFindDriver("left", out Side side));
            Assert.AreEqual(Side.Left, side);
        }

        [Test]
        public void ButtonOfTheEStopCountsOnceAndAlsoOnALostController()
        {
            Wearer wearer = new Wearer();
            wearer.Run();
            wearer[Side.Left].Validity = PoseValidity.NotSeen;
            wearer[Side.Left].Buttons = ButtonBits.Thumbstick;
            wearer.Run(5);
            Assert.AreEqual(1, wearer.Session.Stops.Count);
            wearer[Side.Left].Buttons = 0;
            wearer.Run();
            wearer[Side.Left].Buttons = ButtonBits.Touchpad;
            wearer.Run();
            Assert.AreEqual(2, wearer.Session.Stops.Count);
        }

        [TestCase(0)]
        [TestCase(1)]
        [TestCase(2)]
        public void ButtonOfTheEStopCountsWhateverElseDoesNot(int way)
        {
            Wearer wearer = new Wearer();
            wearer.Run();
            if (way == 0) wearer.IsLive = false; // tracking is lost: the wearer has all the more reason
            else if (way == 1) wearer.Suspensions++; // recentred in this frame
            else wearer.Input.OnRecentred();
            wearer[Side.Right].Buttons = ButtonBits.Thumbstick;
            wearer.Run();
            wearer.IsLive = true;
            wearer.Run(5);
            Assert.AreEqual(1, wearer.Session.Stops.Count);
        }

        [Test]
        public void PinchAndFistAreTriggerAndSqueeze()
        {
            Double3 wrist = default, knuckle = new Double3(0.1, 0, 0);
            Assert.AreEqual(1, Gestures.Pinch(new Double3(0, 0, 0), new Double3(0, 0.01, 0)));
            Assert.AreEqual(0.5, Gestures.Pinch(new Double3(0, 0, 0), new Double3(0, 0.03, 0)), 1e-9);
            Assert.AreEqual(0, Gestures.Pinch(new Double3(0, 0, 0), new Double3(0, 0.1, 0)));
            Assert.AreEqual(0, Gestures.Fist(wrist, knuckle, new Double3(0.18, 0, 0)), 1e-9);
            Assert.AreEqual(1, Gestures.Fist(wrist, knuckle, new Double3(0.08, 0, 0)));
            Assert.AreEqual(0, Gestures.Fist(wrist, wrist, new Double3(0.08, 0, 0)), "a hand without length");
        }
    }
}
