using System;
using IrisSession.Core;
using IrisSession.Protocol;
using IrisSession.Transport;
using NUnit.Framework;

namespace IrisSession.Interaction.Tests
{
    [TestFixture]
    public class HeadsetInputTests
    {
        private const long Second = 1_000_000_000;

        [Test]
        public void RayFindsTheNearestRobotAndHowFarItIs()
        {
            Wearer wearer = new Wearer();
            wearer.Bodies.Version = 0;
            wearer.Run();
            Assert.AreEqual("", wearer.Input.FindPointed(Side.Left), "its links are not known yet");
            wearer.Bodies.Version = 1;
            wearer.Run();
            Assert.AreEqual("left", wearer.Input.FindPointed(Side.Left));
            Assert.AreEqual(0.8, wearer.Input.FindHit(Side.Left), 1e-6);
            wearer.PointUp(Side.Left);
            wearer.Run();
            Assert.AreEqual("", wearer.Input.FindPointed(Side.Left));
            wearer.PointAhead(Side.Left);
            wearer.Session.T_world_tracking = null;
            wearer.Run();
            Assert.AreEqual("", wearer.Input.FindPointed(Side.Left), "without an alignment nothing is where one points");
            // The room is turned: what is ahead is another robot.
            wearer.Session.T_world_tracking = new RigidTransform(new Double3(0, -0.6, 0), DoubleQuaternion.Identity);
            wearer.Run();
            Assert.AreEqual("right", wearer.Input.FindPointed(Side.Left));
            Assert.IsTrue(wearer.Input.Pointing.TryFindTop("left", wearer.Bodies, out Double3 top));
            Assert.AreEqual(1.4, top.Z, 1e-9);
        }

        [Test]
        [TestCase(true)]
        [TestCase(false)]
        public void QuestionOfConsentIsAnsweredByPointing(bool grants)
        {
            Wearer wearer = new Wearer();
            wearer.Session.Give("right", "p1");
            wearer.Input.Take(new Event { Body = new ConsentRequested { ConsentId = 7, Target = "right", Requester = "p2", Holder = "p1" } }, 0);
            wearer.Input.Take(new Event { Body = new ConsentRequested { ConsentId = 8, Target = "left", Requester = "p1", Holder = "p2" } }, 0);
            wearer.Run(2);
            Assert.AreEqual(7, wearer.Input.Question.ConsentId);
            Assert.AreEqual(0, wearer.Input.Buttons.Shown.Count, "a press that was meant for a robot is no answer");
            wearer.RunFor(Second);
            Assert.AreEqual(2, wearer.Input.Buttons.Shown.Count);
            foreach (ShownButton one in wearer.Input.Buttons.Shown)
            {
                if (one.Button.Id != (grants ? Button.Grant : Button.Refuse)) continue;
                Double3 line = one.At - wearer[Side.Right].Pose.Position;
                wearer[Side.Right].Ray = new AimRay(wearer[Side.Right].Pose.Position, (1 / line.Length) * line);
            }
            wearer.Run();
            wearer.Tap(Side.Right);
            Consent consent = (Consent)wearer.Session.Requests[0];
            Assert.AreEqual(7, consent.ConsentId);
            Assert.AreEqual(grants, consent.Grant);
            Assert.IsNull(wearer.Input.Question);
        }

        [Test]
        public void WhatAnotherSessionSaidIsForgotten()
        {
            Wearer wearer = new Wearer();
            wearer.Input.Take(new Event { Body = new ConsentRequested { ConsentId = 7, Target = "right", Requester = "p2", Holder = "p1" } }, 0);
            wearer.Input.Take(new Feedback { Robot = "right" }, 0);
            wearer.Run();
            Assert.IsNotNull(wearer.Input.Question);
            Assert.IsNotNull(wearer.Input.FindFeedback("right"));
            wearer.Session.SessionId = "s2";
            wearer.Run();
            Assert.IsNull(wearer.Input.Question);
            Assert.IsNull(wearer.Input.FindFeedback("right"));
        }

        [Test]
        public void QuestionEndsWithItsTimeOrItsLease()
        {
            Wearer wearer = new Wearer();
            Event asked = new Event { Body = new ConsentRequested { ConsentId = 7, Target = "right", Requester = "p2", Holder = "p1" } };
            wearer.Input.Take(asked, wearer.Input.Reading.CaptureNs);
            wearer.Run();
            Assert.IsNotNull(wearer.Input.Question);
            wearer.Input.Take(new Event { Body = new LeaseChanged { Lease = wearer.Session.LeaseTable["right"], Cause = "queue" } }, 0);
            wearer.Run();
            Assert.IsNotNull(wearer.Input.Question);
            wearer.Input.Take(new Event { Body = new LeaseChanged { Lease = wearer.Session.LeaseTable["right"], Cause = "acquired" } }, 0);
            wearer.Run();
            Assert.IsNull(wearer.Input.Question);
            wearer.Input.Take(asked, wearer.Input.Reading.CaptureNs);
            wearer.RunFor(16 * Second);
            Assert.IsNull(wearer.Input.Question);
            wearer.Session.ConsentTimeoutNs = 40 * Second;
            wearer.Input.Take(asked, wearer.Input.Reading.CaptureNs);
            wearer.RunFor(39 * Second);
            Assert.IsNotNull(wearer.Input.Question, "the session waits so long");
            wearer.RunFor(2 * Second);
            Assert.IsNull(wearer.Input.Question);
        }

        [Test]
        public void OwnRequestThatWaitsForConsentIsNamed()
        {
            Wearer wearer = new Wearer();
            wearer.Session.LeaseTable["right"].Mode = LeaseMode.Request;
            wearer.Session.Give("right", "p2");
            wearer.Run();
            wearer.Tap(Side.Right);
            Assert.AreEqual("right", wearer.Input.AwaitedRobot);
            wearer.Input.TakeReply(1, null, 0);
            wearer.Run();
            Assert.AreEqual("", wearer.Input.AwaitedRobot);
        }

        [Test]
        public void CommandsOfTheApplicationAreButtonsAboveTheLeftHand()
        {
            Wearer wearer = new Wearer();
            int runs = 0;
            Command command = new Command("Next object", () =>
            {
                runs++;
                throw new InvalidOperationException("of the application");
            });
            wearer.Input.Buttons.AddCommand(command);
            wearer[Side.Left].Pose = new RigidTransform(new Double3(0.1, 0.05, 1.3), DoubleQuaternion.FromAxisAngle(new Double3(1, 0, 0), 1.5));
            wearer.Run();
            Assert.AreEqual(0, wearer.Input.Buttons.Shown.Count, "the face of the controller does not look at the eyes");
            wearer[Side.Left].Pose = new RigidTransform(new Double3(0.1, 0.05, 1.3), DoubleQuaternion.Identity);
            wearer.Run();
            Assert.AreEqual("Next object", wearer.Input.Buttons.Shown[0].Text);
            Double3 line = wearer.Input.Buttons.Shown[0].At - wearer[Side.Right].Pose.Position;
            wearer[Side.Right].Ray = new AimRay(wearer[Side.Right].Pose.Position, (1 / line.Length) * line);
            wearer.Run();
            Assert.IsTrue(wearer.Input.Buttons.Shown[0].IsAimed);
            wearer.Tap(Side.Right);
            Assert.AreEqual(1, runs);
            Assert.IsInstanceOf<InvalidOperationException>(wearer.Input.CommandError);
            Assert.AreEqual(0, wearer.Session.Requests.Count, "no robot behind it is taken");
            for (int i = 1; i < ButtonPanel.MaxCommands; i++) wearer.Input.Buttons.AddCommand(command);
            Assert.Throws<InvalidOperationException>(() => wearer.Input.Buttons.AddCommand(command));
        }

        [Test]
        public void HandFeelsContactsRefusalsAndLimitsOfItsRobot()
        {
            Wearer wearer = new Wearer();
            wearer.Take(Side.Right, "right");
            wearer.Input.Take(new Feedback { Robot = "left", ContactN = 5 }, 0);
            Assert.AreEqual(0, wearer.Haptics.Played.Count, "no hand of ours drives it");
            wearer.Input.Take(new Feedback { Robot = "right", ContactN = 10 }, 0);
            Assert.AreEqual(Side.Right, wearer.Haptics.Played[0].Key);
            Assert.AreEqual(0.7f, wearer.Haptics.Played[0].Value.Intensity, 1e-6);
            wearer.Input.Take(new Feedback { Robot = "right", ContactN = 40 }, 0);
            Assert.AreEqual(1f, wearer.Haptics.Played[1].Value.Intensity);
            wearer.Input.Take(new Feedback { Robot = "right", ContactN = 3 }, 0);
            Assert.AreEqual(2, wearer.Haptics.Played.Count, "less force is not felt");
            wearer.Input.Take(new Feedback { Robot = "right", HoldReason = HoldReason.Jump }, 0);
            Assert.AreEqual(0.8f, wearer.Haptics.Played[2].Value.Intensity);
            wearer.Input.Take(new Feedback { Robot = "right", HoldReason = HoldReason.ClutchOpen, Limits = new[] { "j1" } }, 0);
            Assert.AreEqual(0.4f, wearer.Haptics.Played[3].Value.Intensity);
            wearer.Input.Take(new Feedback { Robot = "right", HoldReason = HoldReason.ClutchOpen, Limits = new[] { "j1" } }, 0);
            Assert.AreEqual(4, wearer.Haptics.Played.Count);
        }

        [Test]
        public void LooksCarryTheHeadOfTheirMoment()
        {
            Wearer wearer = new Wearer();
            FakeMarkers source = new FakeMarkers();
            wearer.Input.Markers = new MarkerLooks(source);
            wearer.Session.T_world_tracking = null;
            wearer.Run(10);
            RigidTransform sheet = new RigidTransform(new Double3(0.6, 0, 1.2), DoubleQuaternion.FromAxisAngle(new Double3(0, 1, 0), -0.9));
            MarkerReport report = new MarkerReport { Id = "1", Text = "table", SeenNs = wearer.Input.Reading.CaptureNs - Wearer.FrameNs };
            report.Pose = new MarkerPose(sheet, 0.15);
            source.Now.Add(report);
            Double3 headThen = default;
            for (int i = 0; i < 40; i++)
            {
                headThen = wearer.Input.Reading.Head.Position; // the frame before: when the runtime saw the code
                wearer.Input.Reading.Head = new RigidTransform(headThen + new Double3(0.001, 0, 0), DoubleQuaternion.Identity);
                report.SeenNs = wearer.Input.Reading.CaptureNs;
                report.Pose = new MarkerPose(new RigidTransform(sheet.Position + new Double3(0, 1e-5 * i, 0), sheet.Rotation), 0.15);
                wearer.Run();
            }
            Assert.GreaterOrEqual(wearer.Session.Looks.Count, 4);
            SheetSighting look = wearer.Session.Looks[wearer.Session.Looks.Count - 1];
            Assert.AreEqual("table", look.AnchorId);
            Assert.AreEqual(0.15, look.SizeM);
            SampleInput head = wearer.Session.Samples.Find(one => one.Device == Device.Head && one.CaptureNs == look.CaptureNs);
            Assert.IsNotNull(head, "the head's sample of the same moment was sent");
            Assert.AreEqual(head.Pose, look.T_tracking_camera);
        }

        [Test]
        public void CodesAreLookedForWithoutAnAlignmentAndWhereASheetIs()
        {
            Wearer wearer = new Wearer();
            FakeMarkers source = new FakeMarkers();
            wearer.Input.Markers = new MarkerLooks(source);
            wearer.Session.T_world_tracking = null;
            wearer.Run();
            Assert.IsTrue(source.IsActive);
            wearer.Session.T_world_tracking = RigidTransform.Identity; // the sheet is 0.7 m ahead, 0.8 m below the eyes
            wearer.RunFor(6 * Second);
            Assert.IsFalse(source.IsActive);
            wearer.Input.Reading.Head = new RigidTransform(wearer.Input.Reading.Head.Position, DoubleQuaternion.FromAxisAngle(new Double3(0, 1, 0), 0.8));
            wearer.Run();
            Assert.IsTrue(source.IsActive, "the head looks down at it");
        }

        [Test]
        public void RecentringForgetsWhatWasMeasured()
        {
            Wearer wearer = new Wearer();
            wearer.Input.Markers = new MarkerLooks(new FakeMarkers());
            wearer.Take(Side.Right, "right");
            wearer[Side.Right].Squeeze = 1;
            wearer.Run(10);
            wearer.Input.OnRecentred();
            Assert.AreEqual(1, wearer.Session.Recentred);
            wearer.Session.Samples.Clear();
            wearer.Run();
            Assert.IsNull(wearer.Session.Find(Device.ControllerRight), "poses of the old frame are none of the new one");
        }

        [Test]
        public void DirectorInVirtualRealityStaysWhereTheSceneIsShown()
        {
            Wearer wearer = new Wearer();
            wearer.Session.T_world_tracking = null;
            wearer.Input.OwnPlace = new RigidTransform(new Double3(-2, 0, 0), DoubleQuaternion.Identity);
            wearer.PointUp(Side.Right);
            wearer.Run();
            wearer.Tap(Side.Right);
            Assert.AreEqual(0, wearer.Session.Requests.Count, "only directors are believed");
            wearer.Session.PeopleTable["p1"].Role = Role.Director;
            wearer.Run();
            wearer.Tap(Side.Right);
            Assert.AreEqual(-2, ((PlaceAlignment)wearer.Session.Requests[0]).T_world_tracking.P[0]);
        }

        [Test]
        public void WordsForTheWearerAreShownForFiveSeconds()
        {
            Wearer wearer = new Wearer();
            HeadsetPanels panels = new HeadsetPanels(wearer.Input, wearer.Session, wearer.Bodies);
            wearer.Run();
            foreach (string id in new[] { "p1", "p2" }) wearer.Input.Take(new Event { Body = new Notice { Participant = id, Text = "look longer, " + id } }, wearer.Input.Reading.CaptureNs);
            panels.Update(new Advice[0], "");
            Assert.AreEqual("look longer, p1", panels.Urgent.Text);
            wearer.RunFor(Second);
            wearer.Input.Take(new SessionNews { Kind = NewsKind.Reply, Text = "not sent" }, wearer.Input.Reading.CaptureNs);
            panels.Update(new Advice[0], "");
            Assert.AreEqual("not sent", panels.Urgent.Text);
            wearer.RunFor(5 * Second);
            panels.Update(new Advice[0], "");
            Assert.AreEqual("", panels.Urgent.Text);
        }

        [Test]
        public void FingertipAtTheWristStops()
        {
            Wearer wearer = new Wearer();
            foreach (InputReading hand in wearer.Input.Reading.Inputs)
            {
                hand.Kind = InputKind.Hand;
                hand.HasTip = true;
            }
            InputReading right = wearer[Side.Right];
            right.Tip = new Double3(0.6, -0.3, 1.1);
            wearer.Run(2);
            Double3 ball = wearer.Input.WristStop.Center;
            right.Tip = ball;
            right.Pose = new RigidTransform(ball - new Double3(0.05, 0, 0), DoubleQuaternion.Identity);
            wearer.Run(10);
            Assert.AreEqual(0, wearer.Session.Stops.Count, "a fist is no finger");
            right.Pose = new RigidTransform(ball - new Double3(0.17, 0, 0), DoubleQuaternion.Identity);
            wearer.Run(2);
            Assert.AreEqual(0, wearer.Session.Stops.Count, "too short");
            wearer.Run(4);
            Assert.AreEqual(1, wearer.Session.Stops.Count);
            wearer.Run(20);
            Assert.AreEqual(1, wearer.Session.Stops.Count, "once");
        }

        [Test]
        public void FramesAllocateNothing()
        {
            Wearer wearer = new Wearer();
            wearer.Session.KeepsSamples = false;
            FakeMarkers source = new FakeMarkers();
            source.Now.Add(new MarkerReport { Id = "1", Text = "table", Pose = new MarkerPose(new RigidTransform(new Double3(0.6, 0, 1.2), DoubleQuaternion.Identity), 0.15) });
            wearer.Input.Markers = new MarkerLooks(source);
            wearer.Input.Buttons.AddCommand(new Command("Next", () => { }));
            wearer.Session.Give("right", "p1");
            wearer[Side.Right].Squeeze = 1;
            wearer.Run(200);
            long before = GC.GetAllocatedBytesForCurrentThread();
            wearer.Run(1000);
            Assert.AreEqual(0, GC.GetAllocatedBytesForCurrentThread() - before);
        }
    }
}
