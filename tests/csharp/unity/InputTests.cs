// The input layer on stand-ins: devices are read in the axes of the wire, and panels stand where the core says.
using System;
using System.Collections.Generic;
using System.Diagnostics;
using System.Threading;
using IrisSession.Core;
using IrisSession.HoloLens;
using IrisSession.Interaction;
using IrisSession.Interaction.Tests;
using IrisSession.Protocol;
using IrisSession.Transport;
using IrisSession.Unity.App;
using IrisSession.Unity.Input;
using NUnit.Framework;
using Standins;
using Unity.XR.CoreUtils;
using UnityEngine;
using UnityEngine.Android;
using UnityEngine.XR;

namespace IrisSession.Unity.StandinTests
{
    [TestFixture]
    public sealed class InputTests
    {
        [SetUp]
        public void Begin()
        {
            Engine.Reset();
            Controls.Clear();
            Subsystems.Running.Clear();
            SystemInfo.Battery = -1f;
            SystemInfo.Status = BatteryStatus.Unknown;
        }

        [Test]
        public void ControllersAreReadInTheAxesOfTheWire()
        {
            SetPose("<XRHMD>/", "centerEyePosition", "centerEyeRotation", new Vector3(0.1f, 1.6f, 0.2f), Quaternion.AngleAxis(90f, Vector3.up));
            SetPose("<XRController>{RightHand}/", "devicePosition", "deviceRotation", new Vector3(0.3f, 1.2f, 0.5f), Quaternion.AngleAxis(40f, Vector3.right));
            SetPose("<XRController>{RightHand}/pointer/", "position", "rotation", new Vector3(0.3f, 1.25f, 0.55f), Quaternion.AngleAxis(90f, Vector3.up)); // points to the right
            Controls.Set("<XRController>{RightHand}/trigger", 0.75f);
            Controls.Set("<XRController>{RightHand}/grip", 0.25f);
            Controls.Set("<XRController>{RightHand}/thumbstickClicked", 1f);
            using (ControlReader reader = new ControlReader(ControlNames.Controllers))
            {
                HeadsetReading reading = new HeadsetReading();
                reader.Read(reading);
                AssertNear(new Double3(0.2, -0.1, 1.6), reading.Head.Position);
                AssertNear(new Double3(0, -1, 0), reading.Head.Rotation.Rotate(new Double3(1, 0, 0))); // looks to the right
                InputReading right = reading[Side.Right];
                Assert.AreEqual(InputKind.Controller, right.Kind);
                AssertNear(new Double3(0.5, -0.3, 1.2), right.Pose.Position);
                AssertNear(new Double3(0.55, -0.3, 1.25), right.Ray.Origin);
                AssertNear(new Double3(0, -1, 0), right.Ray.Direction);
                AssertNear(right.Ray.Direction, right.Pose.Rotation.Rotate(new Double3(1, 0, 0)));
                Assert.AreEqual(0.75, right.Trigger);
                Assert.AreEqual(0.25, right.Squeeze);
                Assert.AreEqual(ButtonBits.Thumbstick | ButtonBits.Trigger, right.Buttons);
                Assert.IsTrue(right.IsTracked);
                Assert.IsFalse(reading[Side.Left].IsPresent);
                Assert.IsFalse(reading.HasGaze);

                foreach (string pose in new[] { "pointer/", "" }) // its rotation is that of the pointer
                {
                    Controls.Set("<XRController>{RightHand}/" + pose + "isTracked", 0f); // valid, not tracked: an estimate
                    reader.Read(reading);
                    Assert.AreEqual(PoseValidity.Emulated, right.Validity);
                    Controls.Set("<XRController>{RightHand}/" + pose + "isTracked", 1f);
                }
                Controls.Set("<XRController>{RightHand}/pointer/trackingState", 0);
                Controls.Set("<XRController>{RightHand}/pointer/rotation", default(Quaternion));
                reader.Read(reading);
                Assert.AreEqual(PoseValidity.NotSeen, right.Validity);
                AssertNear(new Double3(0, -1, 0), right.Pose.Rotation.Rotate(new Double3(1, 0, 0))); // as it was
                Controls.Set("<XRController>{RightHand}/pointer/trackingState", 3);
                Controls.Set("<XRController>{RightHand}/trackingState", 0);
                Controls.Set("<XRController>{RightHand}/devicePosition", Vector3.zero);
                reader.Read(reading);
                Assert.AreEqual(PoseValidity.NotSeen, right.Validity);
                AssertNear(new Double3(0.5, -0.3, 1.2), right.Pose.Position); // where it was
                Assert.AreEqual(0, right.Trigger);
                Assert.AreEqual(ButtonBits.Thumbstick, right.Buttons & ButtonBits.Stop, "one that is lost stops too");
            }
        }

        [Test]
        public void WornIsBelievedOnceTheRuntimeHasSaidSo()
        {
            using (ControlReader reader = new ControlReader(ControlNames.Controllers))
            {
                Assert.IsTrue(reader.IsOnHead, "this runtime does not know");
                Controls.Set("<XRHMD>/userPresence", 1f);
                Assert.IsTrue(reader.IsOnHead);
                Controls.Set("<XRHMD>/userPresence", 0f);
                Assert.IsFalse(reader.IsOnHead);
            }
        }

        [Test]
        public void PanelsStandWhereTheyBelongAndFaceTheEyes()
        {
            Wearer wearer = new Wearer();
            HeadsetPanels panels = new HeadsetPanels(wearer.Input, wearer.Session, wearer.Bodies);
            Transform frame = new GameObject("frame").transform;
            PanelViews views = new PanelViews(panels, frame, null);
            wearer.Run();
            panels.Update(new Advice[0], "");
            views.Update(wearer.Input.Reading.Head.Position);
            TextMesh robot = FindText(frame, "left: free");
            Assert.IsNotNull(robot);
            Vector3 expected = EnginePoses.ToEngine(new Double3(1.0, 0.3, 1.4 + 0.18));
            StandinTests.AssertNear(expected, robot.transform.localPosition);
            Vector3 head = EnginePoses.ToEngine(wearer.Input.Reading.Head.Position);
            Vector3 away = robot.transform.localRotation * Vector3.forward;
            Assert.Greater(Vector3.Dot(away, expected - head) / (expected - head).magnitude, 0.999f, "it is read from the eyes");
            StringAssert.Contains("press the trigger to take it", robot.text);
            Assert.IsFalse(robot.richText, "a name is no markup");
            Assert.AreSame(robot.font.material, robot.GetComponent<MeshRenderer>().sharedMaterial, "letters are drawn");
            Assert.IsNull(FindText(frame, "STOP"));
            wearer.Session.Give("left", "p1");
            wearer.PointUp(Side.Left);
            wearer.Run(10);
            panels.Update(new Advice[0], "well done");
            views.Update(wearer.Input.Reading.Head.Position);
            Assert.AreEqual("left: you", robot.text);
            Assert.IsNotNull(FindText(frame, "well done"));
        }

        [Test]
        public void ComponentReadsAHeadsetWithoutASessionAndSaysSo()
        {
            SetPose("<XRHMD>/", "centerEyePosition", "centerEyeRotation", new Vector3(0f, 1.6f, 0f), Quaternion.identity);
            IrisHeadset headset = new GameObject("offset").AddComponent<IrisHeadset>();
            SessionClient client = MakeClient();
            try
            {
                XRInputSubsystem subsystem = new XRInputSubsystem();
                Subsystems.Running.Add(subsystem);
                SystemInfo.Battery = 0.4f;
                headset.Connect(client, new FakeBodies());
                for (int i = 0; i < 100; i++) Engine.Step();
                Assert.AreEqual(0.4f, headset.Condition.Read().Battery, 1e-6);
                subsystem.Recentre();
                Engine.Pause(true);
                Engine.Focus(false);
                for (int i = 0; i < 10; i++) Engine.Step();
                Assert.IsEmpty(Engine.Errors);
                Assert.AreEqual("", headset.Problem);
                Assert.AreEqual(0, client.CallsDropped);
                Assert.Greater(headset.transform.childCount, 0);
                headset.Connect(null, null);
                Engine.Step();
                Assert.AreEqual(0, headset.transform.childCount, "panels of a session that is left are not shown");
            }
            finally
            {
                client.Stop();
            }
        }

        private static SessionClient MakeClient()
        {
            return new SessionClient(new Hello { Role = Role.Operator }, new NoIdentity(), new EndpointChooser(new[] { new WebEndpoint(false, "localhost", 1) }), new WebTransport());
        }

        private static void StepUntil(Func<bool> condition)
        {
            Stopwatch watch = Stopwatch.StartNew();
            while (!condition())
            {
                Assert.Less(watch.Elapsed.TotalSeconds, 30.0);
                Engine.Step();
                Thread.Yield();
            }
        }

        [TestCase(true)]
        [TestCase(false)]
        public void AnotherSessionHearsThatTheHeadsetIsOffOrCovered(bool isOff)
        {
            Controls.Set("<XRHMD>/userPresence", 1f);
            IrisHeadset headset = new GameObject("offset").AddComponent<IrisHeadset>();
            SessionClient first = MakeClient(), second = MakeClient();
            headset.Connect(first, new FakeBodies());
            Engine.Step();
            if (isOff) Controls.Set("<XRHMD>/userPresence", 0f);
            else Engine.Focus(false);
            Engine.Step();
            headset.Connect(second, new FakeBodies());
            second.Start();
            try
            {
                StepUntil(() => !second.IsLive);
            }
            finally
            {
                first.Stop();
                second.Stop();
            }
        }

        /// <summary>Throws from the second frame on.</summary>
        private sealed class BrokenSubsystem : XRInputSubsystem
        {
            public override bool Equals(object other) { throw new InvalidOperationException("of the runtime"); }

            public override int GetHashCode() { return 0; }
        }

        [Test]
        public void ADefectBesideTheControlsLeavesTheEStop()
        {
            IrisHeadset headset = new GameObject("offset").AddComponent<IrisHeadset>();
            headset.StartPanel = new StartPanel();
            SessionClient client = MakeClient();
            headset.Connect(client, new FakeBodies());
            Subsystems.Running.Add(new BrokenSubsystem());
            for (int i = 0; i < 3; i++) Engine.Step();
            Assert.IsNull(headset.Input);
            Assert.AreEqual(1, Engine.Errors.Count, "logged once");
            Assert.IsFalse(headset.StartPanel.Stop.IsUnconfirmed);
            Controls.Set("<XRController>{LeftHand}/thumbstickClicked", 1f);
            Engine.Step();
            Assert.IsTrue(headset.StartPanel.Stop.IsUnconfirmed, "it was pressed, and no session has it");
            client.Stop();
        }

        [Test]
        public void AnEStopThatDidNotArriveIsSaidAlsoAfterTheSessionAndInTheNextOne()
        {
            IrisHeadset headset = new GameObject("offset").AddComponent<IrisHeadset>();
            headset.StartPanel = new StartPanel();
            SessionClient first = MakeClient(), second = MakeClient();
            headset.Connect(first, new FakeBodies());
            SetPose("<XRHMD>/", "centerEyePosition", "centerEyeRotation", new Vector3(0f, 1.6f, 0f), Quaternion.identity);
            Controls.Set("<XRController>{LeftHand}/thumbstickClicked", 1f);
            Engine.Step();
            headset.Connect(null, null);
            Engine.Step();
            StringAssert.Contains(StopReport.Unconfirmed.ToString(), headset.StartPanel.Text.Replace('\n', ' '));
            headset.Connect(second, new FakeBodies());
            Engine.Step();
            StringAssert.Contains(StopReport.Unconfirmed.ToString(), headset.Panels.Urgent.Text.Replace('\n', ' '));
            first.Stop();
            second.Stop();
        }

        [Test]
        public void MistakesOfTheApplicationDoNotEndTheInput()
        {
            IrisHeadset headset = new GameObject("offset").AddComponent<IrisHeadset>();
            SessionClient client = MakeClient();
            headset.News += news => throw new InvalidOperationException("of the application");
            headset.Connect(client, new FakeBodies());
            client.TryPost(loop => throw new InvalidOperationException("which is news"));
            client.Start();
            try
            {
                StepUntil(() => Engine.Errors.Count > 0);
                StepUntil(() => headset.Panels.Urgent.Text.Contains("which is news"));
                StepUntil(() => Engine.Log.Count > 0);
                Assert.AreEqual("warning: iris-session: calls that could not be done: 1", Engine.Log[0]);
                for (int i = 0; i < 200; i++) Engine.Step();
                Assert.AreEqual(1, Engine.Log.Count, "once");
                Assert.IsNotNull(headset.Input);
                Assert.AreEqual("", headset.Problem);
            }
            finally
            {
                client.Stop();
            }
        }

        [Test]
        public void HoloLensIsAHeadsetWithCommandsAndFewDrawCalls()
        {
            foreach (string hand in new[] { "{LeftHand}", "{RightHand}" })
            {
                SetPose("<XRController>" + hand + "/", "devicePosition", "deviceRotation", new Vector3(0.1f, 1.3f, 0.3f), Quaternion.AngleAxis(90f, Vector3.up));
                SetPose("<XRController>" + hand + "/pointer/", "position", "rotation", new Vector3(0.1f, 1.3f, 0.4f), Quaternion.identity);
            }
            SetPose("<XRHMD>/", "centerEyePosition", "centerEyeRotation", new Vector3(0f, 1.6f, 0f), Quaternion.identity);
            GameObject offset = new GameObject("offset");
            IrisHeadset headset = offset.AddComponent<IrisHeadset>();
            IrisHoloLens hololens = offset.AddComponent<IrisHoloLens>();
            offset.GetComponent<IrisApp>().enabled = false; // this test does what it does
            XROrigin origin = new GameObject("origin").AddComponent<XROrigin>();
            origin.Trackables = new GameObject("trackables").transform;
            hololens.SetUp(origin, null);
            SessionClient client = new SessionClient(new Hello { Role = Role.Operator }, new NoIdentity(), new EndpointChooser(new[] { new WebEndpoint(false, "localhost", 1) }), new WebTransport());
            try
            {
                hololens.Prepare(headset);
                headset.RobotPanels = hololens.Draws.RobotPanels;
                headset.Connect(client, new FakeBodies());
                hololens.OnConnected(headset);
                for (int i = 0; i < 20; i++) Engine.Step();
                Assert.IsEmpty(Engine.Errors);
                Assert.IsNotNull(FindText(offset.transform, "STOP all robots"));
                Assert.AreEqual("", headset.Panels.Stop.Text, "no finger is read that could touch it");
                InputReading left = headset.Input.Reading[Side.Left];
                Assert.AreEqual(InputKind.Hand, left.Kind);
                AssertNear(new Double3(0, -1, 0), left.Pose.Rotation.Rotate(new Double3(1, 0, 0))); // the hand's, not that of its ray
                AssertNear(new Double3(1, 0, 0), left.Ray.Direction);
                int most = hololens.Draws.Scene.Objects + headset.Panels.All.Count + headset.Panels.Rays.Length + hololens.Draws.Avatars + hololens.Draws.Clouds;
                Assert.LessOrEqual(most, hololens.Draws.Calls, "were all panels shown, and both rays");
            }
            finally
            {
                client.Stop();
            }
        }

        [Test]
        public void ApplicationMayLeaveTheSessionWhenItHearsNews()
        {
            IrisHeadset headset = new GameObject("offset").AddComponent<IrisHeadset>();
            SessionClient client = MakeClient();
            headset.News += news => headset.Connect(null, null);
            headset.Connect(client, new FakeBodies());
            client.TryPost(loop => throw new InvalidOperationException("which is news"));
            client.Start();
            try
            {
                StepUntil(() => headset.Input == null);
                Assert.AreEqual("", headset.Problem);
                Assert.IsEmpty(Engine.Errors);
            }
            finally
            {
                client.Stop();
            }
        }

        [Test]
        public void PermissionIsAskedForOnceAndItsAnswerFollowed()
        {
            Permission.Granted.Clear();
            Permission.Requested.Clear();
            List<bool> answers = new List<bool>();
            ScenePermission permission = new ScenePermission(answers.Add);
            permission.Poll();
            Assert.AreEqual(new[] { ScenePermission.UseScene }, Permission.Requested.ToArray());
            Assert.IsEmpty(answers);
            Permission.Granted.Add(ScenePermission.UseScene);
            permission.Poll();
            permission.Poll();
            Assert.IsTrue(permission.IsAllowed);
            Permission.Granted.Clear(); // in the settings
            permission.Poll();
            Assert.AreEqual(new[] { true, false }, answers.ToArray());
            Assert.AreEqual(1, Permission.Requested.Count);
        }

        [Test]
        public void PulsesAreFeltByTheHandThatDrives()
        {
            using (ControllerHaptics haptics = new ControllerHaptics()) haptics.Play(Side.Right, new Pulse(0.5f, 0.25f));
            Assert.AreEqual(1, Controls.Pulses.Count);
            StringAssert.StartsWith("<XRController>{RightHand}/haptic", Controls.Pulses[0]);
        }

        private sealed class NoIdentity : IIdentityStore
        {
            public byte[] Secret { get; } = new byte[32];

            public byte[] ResumeToken { get; private set; } = new byte[0];

            public void Remember(byte[] token) { ResumeToken = token; }
        }

        private static void SetPose(string device, string position, string rotation, Vector3 at, Quaternion turn)
        {
            Controls.Set(device + position, at);
            Controls.Set(device + rotation, turn);
            Controls.Set(device + "isTracked", 1f);
            Controls.Set(device + "trackingState", 3);
        }

        private static TextMesh FindText(Transform parent, string text)
        {
            for (int i = 0; i < parent.childCount; i++)
            {
                TextMesh one = parent.GetChild(i).GetComponent<TextMesh>();
                if (one != null && one.gameObject.activeSelf && one.text.Contains(text)) return one;
            }
            return null;
        }

        internal static void AssertNear(Double3 expected, Double3 actual)
        {
            Assert.LessOrEqual((expected - actual).Length, 1e-5, expected + " is not " + actual);
        }
    }
}
