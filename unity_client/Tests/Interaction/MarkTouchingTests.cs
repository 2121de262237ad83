using System;
using System.Collections.Generic;
using IrisSession.Core;
using IrisSession.Protocol;
using NUnit.Framework;

namespace IrisSession.Interaction.Tests
{
    [TestFixture]
    public class MarkTouchingTests
    {
        private const long Second = 1_000_000_000;
        private static readonly Double3 Tip = new Double3(0.1, 0, -0.02);

        /// <summary>Where the tracking frame really is: the session learns it from touches alone.</summary>
        private static readonly RigidTransform Truth = new RigidTransform(new Double3(0.5, -0.3, 0.1), DoubleQuaternion.FromAxisAngle(new Double3(0, 0, 1), 0.8));
        private static readonly RigidTransform Sheet = new RigidTransform(new Double3(1, 2, 0.7), DoubleQuaternion.FromAxisAngle(new Double3(0, 0, 1), -0.4));
        private static readonly double[][] Places = { new[] { 0.1, 0.1, 0 }, new[] { -0.1, -0.1, 0 }, new[] { 0.1, -0.1, 0.0 }, new[] { -0.1, 0.1, 0 } };
        private Wearer wearer;
        private MarkTouching touching;

        [SetUp]
        public void Begin()
        {
            wearer = new Wearer();
            touching = wearer.Input.Touching;
            AnchorMark[] marks = Array.ConvertAll(Places, place => new AnchorMark { PAnchor = place });
            for (int i = 0; i < marks.Length; i++) marks[i].Id = (i + 1).ToString();
            wearer.Session.AnchorTable["table"] = new AnchorInfo { Id = "table", T_world_anchor = ToPose(Sheet), SizeM = 0.14, Marks = marks };
            wearer.Session.T_world_tracking = null;
        }

        [Test]
        public void TipIsCalibratedByDifferentTurns()
        {
            wearer.Run();
            Assert.AreEqual(TouchStage.Tip, touching.Stage);
            wearer.Tap(Side.Right);
            wearer.Run(100);
            wearer.Tap(Side.Right);
            Assert.AreEqual(0, wearer.Session.TipPoses.Count, "one turn is too little");
            Double3 hole = new Double3(0.5, 0, 0.7);
            PutTip(hole, DoubleQuaternion.Identity);
            wearer.Tap(Side.Right);
            int frames = 0;
            for (; frames < 3000 && touching.Stage == TouchStage.Turn; frames++)
            {
                double tilt = 0.6 * Math.Sqrt(frames / 3 % 300 / 300.0);
                Double3 axis = new Double3(Math.Cos(0.1 * frames), Math.Sin(0.1 * frames), 0);
                PutTip(hole, DoubleQuaternion.FromAxisAngle(axis, tilt));
                wearer.Run();
            }
            RigidTransform[] poses = wearer.Session.TipPoses[0];
            Assert.AreEqual(TipTurns.Enough, poses.Length);
            Assert.Greater(frames, poses.Length, "equal turns do not count");
            foreach (RigidTransform pose in poses) AssertAt(hole, pose.TransformPoint(Tip));
            Answer(new TipCalibrated { Participant = "p1", Device = Device.ControllerRight, Refused = true, Advice = "the tip slipped" });
            Assert.AreEqual(TouchStage.Tip, touching.Stage);
            Assert.AreEqual("the tip slipped", touching.News);
        }

        [Test]
        public void EachMarkIsReportedWhereTheTipRests()
        {
            KnowTip();
            wearer.Run();
            for (int i = 0; i < 4; i++)
            {
                string mark = (i + 1).ToString();
                Assert.AreEqual(mark, touching.Marks.Next);
                bool isExpected = touching.TryFindExpected(wearer.Session, out RigidTransform expected);
                Assert.AreEqual(i >= 2, isExpected, "two marks tell where the others are");
                if (isExpected) AssertAt(At(i), expected.Position);
                Touch(At(i));
                TouchReport report = wearer.Session.Touches[i];
                Assert.AreEqual(mark, report.Mark);
                Assert.AreEqual("table", report.AnchorId);
                Assert.AreEqual(Device.ControllerRight, report.Device);
                AssertAt(At(i), report.T_tracking_tip.Position);
                Assert.AreEqual(0.0016, Math.Sqrt(report.Covariance[0]), 1e-4);
                Assert.AreEqual(wearer.Input.Reading.CaptureNs + FakePort.SessionOffset, report.CaptureNs + Wearer.FrameNs, "of the frame in which it is taken");
            }
            Assert.AreEqual(TouchStage.Wait, touching.Stage);
            Align(AlignmentKind.Measured);
            wearer.RunFor(2 * Second);
            Assert.AreEqual(TouchStage.Done, touching.Stage);
            wearer.RunFor(9 * Second);
            Assert.AreEqual(TouchStage.Off, touching.Stage);
            Assert.AreEqual(0, wearer.Session.Requests.Count, "no robot was taken, no run was begun");
        }

        [Test]
        public void OnlyARestIsATouch()
        {
            KnowTip();
            wearer.Run();
            PutTip(At(0), DoubleQuaternion.Identity);
            wearer[Side.Right].Trigger = 1;
            wearer.Run(10);
            wearer[Side.Right].Trigger = 0;
            wearer.Run();
            wearer[Side.Right].Trigger = 1;
            for (int i = 0; i < 100; i++)
            {
                PutTip(At(0) + new Double3(0.001 * i, 0, 0), DoubleQuaternion.Identity);
                wearer.Run();
            }
            Assert.AreEqual(0, wearer.Session.Touches.Count);
            wearer.RunFor(MarkTouching.RestNs);
            AssertAt(At(0) + new Double3(0.099, 0, 0), wearer.Session.Touches[0].T_tracking_tip.Position, 0.004);
        }

        [Test]
        public void HandsDriveNothingMeanwhile()
        {
            KnowTip();
            Align(AlignmentKind.Measured);
            wearer.Take(Side.Right, "right");
            touching.Begin();
            wearer[Side.Right].Squeeze = 1;
            wearer.PressButton(Side.Left, ButtonBits.Lower);
            wearer.Run(10);
            SampleInput sample = wearer.Session.Find(Device.ControllerRight);
            Assert.IsFalse(sample.Clutch);
            Assert.AreEqual(0, wearer.Session.Find(Device.ControllerLeft).Buttons & ButtonBits.Lower, "the session begins no episode");
            wearer.PressButton(Side.Left, ButtonBits.Upper);
            wearer.Run(10);
            Assert.IsFalse(touching.IsActive);
            Assert.IsFalse(wearer.Session.Find(Device.ControllerRight).Clutch, "it counts from the next squeeze");
            Assert.IsEmpty(wearer.Session.Samples.FindAll(one => (one.Buttons & (ButtonBits.Lower | ButtonBits.Upper)) != 0));
            wearer[Side.Right].Squeeze = 0;
            wearer.Run(10);
            wearer[Side.Right].Squeeze = 1;
            wearer.Run(10);
            Assert.IsTrue(wearer.Session.Find(Device.ControllerRight).Clutch);
        }

        [Test]
        public void MarksOfARefusalComeNextAndOnceMoreLast()
        {
            KnowTip();
            wearer.Run();
            for (int i = 0; i < 4; i++) Touch(At(i));
            Answer(new Notice { Participant = "p1", Reason = DenialReason.AlignmentRefused, Text = "alignment of ann refused: touch 'table/3' again" });
            Assert.AreEqual("3", touching.Marks.Next);
            Assert.AreEqual("touch 'table/3' again", touching.News);
            wearer.Run();
            Touch(At(2));
            Assert.AreEqual("3", wearer.Session.Touches[4].Mark);
            Answer(new Notice { Participant = "p1", Reason = DenialReason.AlignmentRefused, Text = "'table/2' and 'table/3' do not fit" });
            Assert.AreEqual("2", touching.Marks.Next);
            Answer(new Notice { Participant = "p2", Reason = DenialReason.AlignmentRefused, Text = "'table/1'" });
            Assert.AreEqual("2", touching.Marks.Next);
        }

        [Test]
        public void CommonPointIsTouchedUnderTheSqueezeOfAnAlignedWearer()
        {
            KnowTip();
            wearer.Session.PeopleTable["p2"] = new ParticipantInfo { Id = "p2", Name = "bob" };
            touching.Begin();
            Touch(At(1), true);
            Assert.AreEqual(0, wearer.Session.Touches.Count, "there is nothing to compare");
            Align(AlignmentKind.Measured);
            Touch(At(1), true);
            TouchReport point = wearer.Session.Touches[0];
            Assert.IsNull(point.Mark);
            Assert.AreEqual("point", point.AnchorId);
            AssertAt(At(1), point.T_tracking_tip.Position);
            Answer(new HeadsetsCompared { A = "p2", B = "p1", AnchorId = "point", Touched = true, ErrorM = 0.0062, ExpectedP95M = 0.014 });
            StringAssert.Contains("bob are 6.2 mm apart", touching.News);
            Assert.AreEqual("1", touching.Marks.Next, "marks go on");
        }

        [Test]
        public void BareHandTouchesWhileTheOtherPinches()
        {
            foreach (InputReading hand in wearer.Input.Reading.Inputs)
            {
                hand.Kind = InputKind.Hand;
                hand.HasTip = true;
            }
            wearer.Run();
            Assert.AreEqual(TouchStage.Touch, touching.Stage);
            wearer[Side.Left].Trigger = 1;
            wearer[Side.Right].Tip = At(0);
            wearer.RunFor(MarkTouching.RestNs + 2 * Wearer.FrameNs);
            Assert.AreEqual(Device.HandRight, wearer.Session.Touches[0].Device);
            AssertAt(At(0), wearer.Session.Touches[0].T_tracking_tip.Position);
            Assert.AreEqual(0, wearer.Session.Touches[0].Covariance.Length);
        }

        [Test]
        public void WhereCodesAreReadAHeldTriggerBegins()
        {
            wearer.Input.Markers = new MarkerLooks(new FakeMarkers());
            KnowTip();
            wearer.RunFor(Second);
            Assert.IsFalse(touching.IsActive);
            Answer(new AlignmentRun { Participant = "p1", Running = true });
            Assert.IsFalse(touching.IsActive, "a director's run is by codes");
            wearer[Side.Right].Trigger = 1;
            wearer.RunFor(HandPress.HoldNs + Wearer.FrameNs);
            Assert.AreEqual(AlignAction.Start, ((Align)wearer.Session.Requests[0]).Action);
            Answer(new AlignmentRun { Participant = "p1", Running = true });
            Assert.IsTrue(touching.IsActive);
            wearer.RunFor(3 * Second);
            Assert.AreEqual(1, wearer.Session.Requests.Count);
            Assert.AreEqual(0, wearer.Session.Touches.Count, "the trigger that began touches nothing");
            wearer[Side.Right].Trigger = 0;
            wearer.Run();
            Touch(At(0));
            Assert.AreEqual(1, touching.Marks.TouchedCount);
            wearer.Input.OnRecentred();
            Assert.AreEqual(0, touching.Marks.TouchedCount, "what was touched is in another frame");
        }

        [Test]
        public void PanelsShowWhereTheNextMarkIs()
        {
            KnowTip();
            HeadsetPanels panels = new HeadsetPanels(wearer.Input, wearer.Session, wearer.Bodies);
            wearer.Run();
            Touch(At(0));
            Touch(At(1));
            panels.Update(new List<Advice>(), "");
            Assert.AreEqual("3", panels.Mark.Text);
            PanelRay pole = panels.Rays[2];
            AssertAt(At(2), pole.Ray.Origin + pole.LengthM * pole.Ray.Direction);
            AssertAt(wearer[Side.Right].Pose.TransformPoint(Tip), panels.Rays[1].Ray.Origin + panels.Rays[1].LengthM * panels.Rays[1].Ray.Direction);
            StringAssert.Contains("mark 3", panels.Urgent.Text);
        }

        [Test]
        public void FramesAllocateNothing()
        {
            KnowTip();
            wearer.Session.KeepsSamples = false;
            wearer.Run();
            Touch(At(0));
            Touch(At(1));
            wearer.Run(100);
            touching.TryFindExpected(wearer.Session, out _);
            long before = GC.GetAllocatedBytesForCurrentThread();
            for (int i = 0; i < 1000; i++)
            {
                wearer.Run();
                touching.TryFindExpected(wearer.Session, out _);
            }
            Assert.AreEqual(0, GC.GetAllocatedBytesForCurrentThread() - before);
        }

        private static Double3 At(int mark)
        {
            return Truth.Inverse.TransformPoint(Sheet.TransformPoint(new Double3(Places[mark][0], Places[mark][1], Places[mark][2])));
        }

        private static void AssertAt(Double3 expected, Double3 actual, double withinM = 1e-9)
        {
            Assert.LessOrEqual((expected - actual).Length, withinM, expected + " " + actual);
        }

        private static Pose ToPose(RigidTransform transform)
        {
            Pose pose = new Pose();
            Double3 p = transform.Position;
            DoubleQuaternion q = transform.Rotation;
            pose.P = new[] { p.X, p.Y, p.Z };
            pose.Q = new[] { q.W, q.X, q.Y, q.Z };
            return pose;
        }

        private void Answer(EventKind body)
        {
            wearer.Input.Take(new Event { Body = body }, wearer.Input.Reading.CaptureNs);
        }

        private void KnowTip()
        {
            double[] covariance = { 1e-7, 0, 0, 0, 1e-7, 0, 0, 0, 1e-7 };
            Answer(new TipCalibrated { Participant = "p1", Device = Device.ControllerRight, PGripTip = new[] { Tip.X, Tip.Y, Tip.Z }, Covariance = covariance });
        }

        private void Align(string kind)
        {
            wearer.Session.T_world_tracking = Truth;
            wearer.Session.PeopleTable["p1"].Alignment = new Alignment { Kind = kind, T_world_tracking = ToPose(Truth) };
        }

        private void PutTip(Double3 at, DoubleQuaternion rotation)
        {
            wearer[Side.Right].Pose = new RigidTransform(at - rotation.Rotate(Tip), rotation);
        }

        /// <summary>Hold the trigger, or the squeeze, with the tip at a point until it is taken.</summary>
        private void Touch(Double3 at, bool isSqueeze = false)
        {
            PutTip(at, DoubleQuaternion.FromAxisAngle(new Double3(0, 1, 0), 0.7));
            if (isSqueeze) wearer[Side.Right].Squeeze = 1;
            else wearer[Side.Right].Trigger = 1;
            int before = wearer.Session.Touches.Count;
            for (int i = 0; i < 40 && wearer.Session.Touches.Count == before; i++) wearer.Run();
            wearer[Side.Right].Squeeze = wearer[Side.Right].Trigger = 0;
            wearer.Run();
        }
    }
}
