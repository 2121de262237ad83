// Bare hands on stand-ins: joints, gestures, where they point, and the e-stop of a controller in such a hand.
using System.Collections.Generic;
using IrisSession.Core;
using IrisSession.Interaction;
using IrisSession.Protocol;
using IrisSession.Unity.ArFoundation;
using IrisSession.Unity.Input;
using NUnit.Framework;
using Standins;
using UnityEngine;
using UnityEngine.XR.Hands;
using EnginePose = UnityEngine.Pose;

namespace IrisSession.Unity.StandinTests
{
    [TestFixture]
    public sealed class HandsTests
    {
        [SetUp]
        public void Begin()
        {
            Engine.Reset();
            Controls.Clear();
            Subsystems.Running.Clear();
        }

        [Test]
        public void BareHandsPinchAndHaveJoints()
        {
            XRHandSubsystem subsystem = new XRHandSubsystem();
            XrHands hands = new XrHands();
            Assert.IsFalse(hands.IsSupported);
            Subsystems.Running.Add(subsystem);
            Assert.IsTrue(hands.IsSupported);
            InputReading reading = new InputReading();
            Assert.IsFalse(hands.TryRead(Side.Left, true, reading));
            Dictionary<XRHandJointID, EnginePose> joints = new Dictionary<XRHandJointID, EnginePose>();
            for (XRHandJointID id = XRHandJointID.Wrist; id < XRHandJointID.EndMarker; id++) joints[id] = At(0.01f * (int)id, 1f, 0.3f);
            joints[XRHandJointID.ThumbTip] = joints[XRHandJointID.IndexTip] = At(0.2f, 1.1f, 0.4f);
            subsystem.leftHand = new XRHand { isTracked = true, Joints = joints };
            Assert.IsTrue(hands.TryRead(Side.Left, true, reading));
            Assert.AreEqual(InputKind.Hand, reading.Kind);
            Assert.AreEqual(1, reading.Trigger, "thumb and index finger touch");
            InputTests.AssertNear(new Double3(0.4, -0.2, 1.1), reading.Tip);
            InputTests.AssertNear(new Double3(0.3, -0.01, 1), reading.Pose.Position); // of the wrist
            Assert.AreEqual(26 * 7, reading.Joints.Length);
            Assert.AreEqual(-0.02, reading.Joints[1], 1e-6, "the palm first");
            Assert.AreEqual(-0.01, reading.Joints[8], 1e-6);
            Assert.AreEqual(-0.26, reading.Joints[25 * 7 + 1], 1e-6);
            joints.Remove(XRHandJointID.MiddleTip);
            hands.TryRead(Side.Left, true, reading);
            Assert.AreEqual(PoseValidity.NotSeen, reading.Validity);
        }

        [Test]
        public void BareHandsPointByTheirAimDevice()
        {
            XrHands hands = TrackLeftHand(out XRHandSubsystem subsystem);
            subsystem.leftHandCommonGestures.Aim = At(0.5f, 1f, 0.3f);
            InputReading reading = new InputReading();
            hands.TryRead(Side.Left, false, reading);
            Assert.IsFalse(reading.HasRay, "gestures need a feature that is off");
            Controls.Set("<MetaAimHand>{LeftHand}/devicePosition", new Vector3(0.1f, 1f, 0.3f));
            Controls.Set("<MetaAimHand>{LeftHand}/deviceRotation", Quaternion.AngleAxis(90f, Vector3.up)); // to the right
            Controls.Set("<MetaAimHand>{LeftHand}/aimFlags", 1); // computed, not valid
            hands.TryRead(Side.Left, false, reading);
            Assert.IsFalse(reading.HasRay, "it points at the face");
            Controls.Set("<MetaAimHand>{LeftHand}/aimFlags", 3);
            hands.TryRead(Side.Left, false, reading);
            Assert.IsTrue(reading.HasRay);
            InputTests.AssertNear(new Double3(0.3, -0.1, 1), reading.Ray.Origin);
            InputTests.AssertNear(new Double3(0, -1, 0), reading.Ray.Direction);
            hands.Dispose();
            hands.TryRead(Side.Left, false, reading);
            Assert.IsFalse(reading.HasRay);
            XRCommonHandGestures.HasProfile = true;
            hands.TryRead(Side.Left, false, reading);
            XRCommonHandGestures.HasProfile = false;
            InputTests.AssertNear(new Double3(0.3, -0.5, 1), reading.Ray.Origin); // another runtime
        }

        [Test]
        public void AThumbstickStopsAlsoInAHandThatIsTrackedAsBare()
        {
            using (ControlReader reader = new ControlReader(ControlNames.Controllers) { BareHands = TrackLeftHand(out _) })
            {
                Controls.Set("<XRController>{LeftHand}/thumbstickClicked", 1f);
                Controls.Set("<XRController>{LeftHand}/trigger", 1f);
                HeadsetReading reading = new HeadsetReading();
                reader.Read(reading);
                Assert.AreEqual(InputKind.Hand, reading[Side.Left].Kind);
                Assert.AreEqual(ButtonBits.Thumbstick, reading[Side.Left].Buttons, "the e-stop and nothing else");
            }
        }

        private static XrHands TrackLeftHand(out XRHandSubsystem subsystem)
        {
            Dictionary<XRHandJointID, EnginePose> joints = new Dictionary<XRHandJointID, EnginePose>();
            for (XRHandJointID id = XRHandJointID.Wrist; id < XRHandJointID.EndMarker; id++) joints[id] = At(0.01f * (int)id, 1f, 0.3f);
            subsystem = new XRHandSubsystem { leftHand = new XRHand { isTracked = true, Joints = joints } };
            Subsystems.Running.Add(subsystem);
            XrHands hands = new XrHands();
            Assert.IsTrue(hands.IsSupported);
            return hands;
        }

        private static EnginePose At(float x, float y, float z) { return new EnginePose(new Vector3(x, y, z), Quaternion.identity); }
    }
}
