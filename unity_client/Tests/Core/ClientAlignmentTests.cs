using System.Collections.Generic;
using IrisSession.Protocol;
using NUnit.Framework;

namespace IrisSession.Core.Tests
{
    [TestFixture]
    public class ClientAlignmentTests
    {
        private FakeSession session;
        private ClientAlignment alignment;

        [SetUp]
        public void Join()
        {
            session = FakeSession.Join();
            alignment = new ClientAlignment(session.Client);
        }

        [Test]
        public void SightingsAreReportedWithTheirViewpoint()
        {
            Assert.IsTrue(alignment.Observe(MakeSighting(0.0)));
            Assert.IsTrue(alignment.Observe(MakeSighting(0.1)));
            Assert.IsTrue(alignment.Observe(MakeSighting(0.5)));
            List<Observation> sent = session.TakeSent().ConvertAll(message => (Observation)message);
            Assert.AreEqual(sent[0].ViewpointId, sent[1].ViewpointId);
            Assert.AreNotEqual(sent[0].ViewpointId, sent[2].ViewpointId);
            Assert.AreEqual("table", sent[0].AnchorId);
            Assert.AreEqual(0.16, sent[0].SizeM);
            Assert.AreEqual(ObservationSource.QrSystem, sent[0].Source);
            Assert.AreEqual(new[] { 0.5, 0.0, 1.0 }, sent[0].T_tracking_anchor.P);
            session.Client.ReportTrackingJump();
            alignment.Observe(MakeSighting(0.5));
            Observation after = (Observation)session.TakeSent()[1];
            Assert.AreEqual(1, after.TrackingEpoch);
            Assert.AreNotEqual(sent[2].ViewpointId, after.ViewpointId);
        }

        [Test]
        public void MarkersThatAreNotSeenOrNotLocatedSendNothing()
        {
            SheetSighting remembered = MakeSighting(0);
            remembered.IsSeen = false;
            SheetSighting atOrigin = MakeSighting(0);
            atOrigin.T_tracking_anchor = RigidTransform.Identity;
            SheetSighting withoutSize = MakeSighting(0);
            withoutSize.SizeM = 0;
            SheetSighting lost = MakeSighting(0);
            lost.T_tracking_anchor = new RigidTransform(new Double3(double.NaN, 0, 0), DoubleQuaternion.Identity);
            SheetSighting unturned = MakeSighting(0);
            unturned.T_tracking_anchor = new RigidTransform(new Double3(1, 0, 0), default);
            foreach (SheetSighting sighting in new[] { remembered, atOrigin, withoutSize, lost, unturned }) Assert.IsFalse(alignment.Observe(sighting));
            Assert.AreEqual(0, session.TakeSent().Count);
            Assert.AreEqual(5, alignment.Ignored);
        }

        [Test]
        public void AlignmentOfAnEarlierTrackingFrameIsVoid()
        {
            Assert.AreEqual(AlignmentState.None, alignment.State);
            session.SendEvent(new AlignmentChanged { Participant = "p1", Alignment = MakeAlignment(AlignmentKind.Fingertip, 1) });
            Assert.AreEqual(AlignmentState.Provisional, alignment.State);
            session.SendEvent(new AlignmentChanged { Participant = "p1", Alignment = MakeAlignment(AlignmentKind.Measured, 2) });
            Assert.AreEqual(AlignmentState.Aligned, alignment.State);
            Assert.IsTrue(alignment.TryGetTransform(out RigidTransform T_world_tracking));
            Assert.AreEqual(2.0, T_world_tracking.Position.X);
            SampleInput input = new SampleInput { Device = Device.Head };
            Assert.AreEqual(2, new SampleBuilder(session.Client).MakeSample(input).AlignmentVersion);
            session.Client.ReportTrackingJump();
            Assert.AreEqual(AlignmentState.None, alignment.State);
            Assert.IsFalse(alignment.TryGetTransform(out _));
        }

        [Test]
        public void TouchesAndTipsAreReported()
        {
            RigidTransform grip = new RigidTransform(new Double3(0.1, 0.2, 0.3), DoubleQuaternion.Identity);
            TouchReport touch = new TouchReport { Device = Device.ControllerRight, AnchorId = "table", Mark = "a", T_tracking_tip = grip };
            Assert.IsTrue(alignment.ReportTouch(touch));
            Assert.IsTrue(alignment.ReportTipPoses(Device.ControllerRight, new RigidTransform[250], 6));
            List<ClientMessage> sent = session.TakeSent();
            Assert.AreEqual(AnchorKind.Touch, ((Observation)sent[0]).Kind);
            Assert.AreEqual(100, ((Observation)sent[1]).GripPoses.Length);
            touch.T_tracking_tip = RigidTransform.Identity;
            Assert.IsFalse(alignment.ReportTouch(touch));
            alignment.StartRun();
            Assert.AreEqual(AlignAction.Start, ((Align)session.TakeSent()[0]).Action);
        }

        private static SheetSighting MakeSighting(double cameraX)
        {
            return new SheetSighting
            {
                AnchorId = "table",
                T_tracking_anchor = new RigidTransform(new Double3(0.5, 0, 1), DoubleQuaternion.Identity),
                T_tracking_camera = new RigidTransform(new Double3(cameraX, 0, 1.5), DoubleQuaternion.Identity),
                SizeM = 0.16,
                CaptureNs = 4,
            };
        }

        private static Alignment MakeAlignment(string kind, long version)
        {
            return new Alignment { Version = version, Kind = kind, T_world_tracking = new Pose { P = new[] { 2.0, 0, 0 }, Q = new[] { 1.0, 0, 0, 0 } } };
        }
    }
}
