// The whole app on stand-ins, with sessions over real sockets: what the wearer reads and can do, whatever is wrong. Nothing is thrown.
using System;
using System.Collections.Generic;
using System.Linq;
using IrisSession.Core;
using IrisSession.Interaction;
using IrisSession.Protocol;
using IrisSession.Transport;
using IrisSession.Transport.Tests;
using IrisSession.Unity.Input;
using NUnit.Framework;
using Standins;
using UnityEngine;
using UnityEngine.Android;
using UnityEngine.XR;

namespace IrisSession.Unity.StandinTests
{
    [TestFixture]
    public sealed class AppTests
    {
        /// <summary>What is wrong before there is a session, and what the app says then.</summary>
        public enum Wrong
        {
            NoSession,
            Unreachable,
            NoGateway,
            CodeUsed,
            Revoked,
            NotPaired,
            OtherVersion,
            OtherVersionOfGateway,
            DamagedFile,
        }

        [TestCase(Wrong.NoSession, ConnectorPhase.Searching)]
        [TestCase(Wrong.Unreachable, ConnectorPhase.Searching)]
        [TestCase(Wrong.NoGateway, ConnectorPhase.Searching)]
        [TestCase(Wrong.CodeUsed, ConnectorPhase.Failed)]
        [TestCase(Wrong.Revoked, ConnectorPhase.Failed)]
        [TestCase(Wrong.NotPaired, ConnectorPhase.Failed)]
        [TestCase(Wrong.OtherVersion, ConnectorPhase.Failed)]
        [TestCase(Wrong.OtherVersionOfGateway, ConnectorPhase.Failed)]
        [TestCase(Wrong.DamagedFile, ConnectorPhase.Failed)]
        public void WithoutASessionThePanelSaysWhyAndWhatToDo(Wrong wrong, ConnectorPhase phase)
        {
            TestCertificate certificate = wrong == Wrong.CodeUsed ? TestCertificate.First : null;
            using (GatewaySession session = new GatewaySession(certificate))
            using (FakeGateway other = new FakeGateway(peer => peer.SendText("HTTP/1.1 404 Not Found\r\nContent-Length: 0\r\n\r\n")))
            using (AppStage stage = new AppStage(false))
            {
                stage.App.Address = wrong == Wrong.NoSession ? "" : wrong == Wrong.Unreachable ? "http://localhost:1" : wrong == Wrong.NoGateway ? other.MakeEndpoint().ToString() : session.Address;
                if (wrong == Wrong.CodeUsed) stage.App.Address += "/#c=" + GatewaySession.Code;
                if (wrong == Wrong.DamagedFile) stage.WriteFile(PairingFile.Name, "{");
                string code = wrong == Wrong.CodeUsed ? RefusalCode.Code : wrong == Wrong.NotPaired ? RefusalCode.Unpaired : wrong == Wrong.OtherVersion ? RefusalCode.Version : "";
                if (code.Length > 0) session.Refuse = message => new Refused { Code = code, SupportedVersions = new long[] { 2 } };
                if (wrong == Wrong.Revoked) session.Last = new ProtocolFault { Code = FaultCode.Revoked };
                if (wrong == Wrong.OtherVersionOfGateway) session.CloseCode = CloseCode.Version;
                stage.StepUntil(() => stage.App.View != null && stage.App.View.Phase == phase && stage.App.View.Phrase.What.Length > 0, "it says what is wrong");
                Assert.IsNotEmpty(stage.App.View.Phrase.Remedy + (wrong == Wrong.DamagedFile ? "in the same sentence" : ""));
                stage.StepUntil(() => stage.Text.Length > 0, "the panel has it");
                Assert.IsNull(stage.App.Client);
                Refused refusal = stage.App.View.Pairing != null ? stage.App.View.Pairing.Refusal : stage.App.View.Refusal;
                if (wrong == Wrong.Revoked) code = FaultCode.Revoked;
                Assert.AreEqual(code, refusal == null ? "" : refusal.Code);
                Assert.AreEqual(wrong == Wrong.OtherVersionOfGateway ? CloseCode.Version : 0, stage.App.View.Problem.Code);
                if (phase != ConnectorPhase.Failed || wrong == Wrong.DamagedFile) return;
                int before = session.Count<Hello>() + session.Count<Pair>();
                session.Refuse = message => null;
                session.Last = null;
                session.CloseCode = 0;
                stage.Press("Try again", () => session.Count<Hello>() + session.Count<Pair>() > before, "another attempt");
            }
        }

        [TestCase(AdviceKind.Permission, "scene")]
        [TestCase(AdviceKind.Permission, "camera")]
        [TestCase(AdviceKind.NoMarkers, "")]
        [TestCase(AdviceKind.NoMarkers, "scene")]
        [TestCase(AdviceKind.CacheFull, "")]
        [TestCase(AdviceKind.OverBudget, "")]
        public void InASessionThePanelSaysWhatIsMissing(AdviceKind kind, string permission)
        {
            void Set(ConnectorSettings settings)
            {
                if (kind == AdviceKind.CacheFull) settings.Cache = new AssetCache(new Storage.DiskAssetFiles(UnityEngine.Application.persistentDataPath), 1);
                if (kind == AdviceKind.OverBudget) settings.Budget = new SceneBudget(1, 0, 1, 0);
            }

            bool hasScene = kind == AdviceKind.CacheFull || kind == AdviceKind.OverBudget;
            using (GatewaySession session = new GatewaySession(null, hasScene ? "lab" : null))
            using (AppStage stage = new AppStage(permission.Length > 0, Set))
            {
                if (kind == AdviceKind.NoMarkers)
                {
                    Permission.Granted.Add(ScenePermission.UseScene);
                    Subsystems.Loaded.Clear();
                }
                stage.App.Address = session.Address;
                stage.WaitFor(ConnectorPhase.Running);
                if (permission == "camera") stage.Headset.SetPermission(HeadsetPermission.Camera, false);
                stage.StepUntil(() => stage.App.Client.Advice.Any(one => one.Kind == kind), kind.ToString());
                Advice advice = stage.App.Client.Advice.First(one => one.Kind == kind);
                Assert.IsNotEmpty(advice.Phrase.What);
                Assert.IsNotEmpty(advice.Phrase.Remedy);
                stage.StepUntil(() => stage.Urgent.Length > 0, "it stands before the eyes");
                Assert.IsFalse(IsDrawn(stage, stage.Text), "the panel before a session is gone");
            }
        }

        [Test]
        public void SessionsAreButtonsAndAKeyIsComparedByThePerson()
        {
            using (GatewaySession first = new GatewaySession(TestCertificate.First))
            using (GatewaySession second = new GatewaySession(TestCertificate.Second))
            using (AppStage stage = new AppStage(false))
            {
                bool HasBoth()
                {
                    return stage.Announce("lab", first) && stage.Announce("other", second) && stage.App.View != null && stage.App.View.Phase == ConnectorPhase.Choosing && stage.App.View.Sessions.Length == 2;
                }

                stage.StepUntil(HasBoth, "two sessions");
                stage.Press("other", () => !HasBoth() && stage.App.View.Phase == ConnectorPhase.Untrusted, "the key is shown");
                stage.StepUntil(() => stage.Text.Replace("\n", ":").Contains(stage.App.View.Fingerprint), "it can be compared");
                stage.Press("No", () => !IsDrawn(stage, "Yes"), "it is declined");
                Assert.AreEqual(ConnectorPhase.Untrusted, stage.App.View.Phase);
                Assert.IsNotEmpty(stage.Text);
                Assert.AreEqual(0, second.Count<Hello>(), "nothing was sent");
                stage.Press("Try again", () => stage.App.View.Phase != ConnectorPhase.Untrusted, "it begins again");
                stage.StepUntil(HasBoth, "two sessions");
                stage.Press("other", () => !HasBoth() && stage.App.View.Phase == ConnectorPhase.Untrusted, "the key is shown again");
                stage.Press("Yes", () => stage.App.View.Phase == ConnectorPhase.Running, "it is joined");
                Assert.AreEqual(0, first.Count<Hello>());
                Assert.Greater(second.Count<Hello>(), 0);
            }
        }

        [Test]
        public void ALinkThatIsSeenIsAButtonAndOthersAreNot()
        {
            using (GatewaySession session = new GatewaySession(TestCertificate.First))
            using (GatewaySession other = new GatewaySession(TestCertificate.Second))
            using (AppStage stage = new AppStage(true))
            {
                Permission.Granted.Add(ScenePermission.UseScene);
                stage.ShowCode("https://localhost:" + session.Port + "/about");
                stage.ShowCode("table");
                stage.ShowCode(session.Address + "/#c=" + GatewaySession.Code);
                stage.StepUntil(() => IsDrawn(stage, "Join localhost"), "a button");
                Assert.IsFalse(IsDrawn(stage, "about"));
                Assert.AreEqual(0, session.Count<Pair>(), "nothing is entered unasked");
                stage.ShowCode("https://127.0.0.1:" + other.Port + "/#c=" + GatewaySession.Code);
                stage.Press("Join localhost", () => stage.App.View.Phase == ConnectorPhase.Running, "it is joined");
                Assert.AreEqual(PairingOutcome.Paired, stage.App.View.Pairing.Outcome);
                Assert.AreEqual(0, other.Count<Pair>(), "a code that is seen later is not entered");
            }
        }

        [TestCase("Type an address", false)]
        [TestCase("Type a join code", false)]
        [TestCase("Type a join code", true)]
        public void WhatIsTypedIsEntered(string button, bool hasDamagedFile)
        {
            bool isCode = button != "Type an address";
            using (GatewaySession session = new GatewaySession(TestCertificate.First))
            using (AppStage stage = new AppStage(false))
            {
                TouchScreenKeyboard.IsThere = true;
                TouchScreenKeyboard.Newest = null;
                session.Refuse = message => new Refused { Code = RefusalCode.Code };
                if (hasDamagedFile) stage.WriteFile(PairingFile.Name, "{");
                else if (isCode) stage.App.Address = session.Address + "/#c=AAAA-AAAA-AAAA";
                ConnectorView before = null;
                if (hasDamagedFile) stage.WaitFor(ConnectorPhase.Failed);
                if (hasDamagedFile) stage.Press("Try again", () => stage.App.View != (before = before ?? stage.App.View), "the same answer");
                stage.Press(button, () => TouchScreenKeyboard.Newest != null, "a keyboard");
                session.Refuse = message => null;
                TouchScreenKeyboard.Newest.text = isCode ? GatewaySession.Code : session.Address;
                TouchScreenKeyboard.Newest.status = TouchScreenKeyboard.Status.Done;
                stage.StepUntil(() => stage.Announce("lab", session) && stage.App.View.Phase == (isCode ? ConnectorPhase.Running : ConnectorPhase.Untrusted), "it is entered");
            }
        }

        [TestCase(false)]
        [TestCase(true)]
        public void AnEStopThatDidNotArriveIsSaid(bool isInSession)
        {
            using (GatewaySession session = new GatewaySession { Stops = false })
            using (AppStage stage = new AppStage(false))
            {
                if (isInSession) stage.App.Address = session.Address;
                stage.WaitFor(isInSession ? ConnectorPhase.Running : ConnectorPhase.Searching);
                Controls.Set("<XRController>{LeftHand}/thumbstickClicked", 1f);
                string said = Unwrap(StopReport.Unconfirmed.ToString());
                stage.StepUntil(() => Unwrap(isInSession ? stage.Urgent : stage.Text).Contains(said), "it is said");
                Assert.AreEqual(isInSession, session.Count<EStop>() > 0);
                if (!isInSession) return;
                session.Stops = true;
                Controls.Set("<XRController>{LeftHand}/thumbstickClicked", 0f);
                Engine.Step();
                Controls.Set("<XRController>{LeftHand}/thumbstickClicked", 1f);
                stage.StepUntil(() => !Unwrap(stage.Urgent).Contains(said) && stage.App.Client.View.IsStopped, "it has arrived");
            }
        }

        [Test]
        public void ADefectOfTheInputEndsSamplesAndNotTheEStop()
        {
            using (GatewaySession session = new GatewaySession())
            using (AppStage stage = new AppStage(false))
            {
                stage.App.Address = session.Address;
                stage.StepUntil(() => session.Count<Sample>() > 0, "samples");
                Controls.Set("<XRHMD>/centerEyePosition", 1f); // a value of another type: reading it throws
                stage.StepUntil(() => stage.Headset.Input == null, "the defect");
                Assert.AreEqual(1, Engine.Errors.Count, "logged once");
                Engine.Errors.Clear();
                stage.StepUntil(() => stage.Text.Contains(stage.Headset.Problem.Substring(0, 20)), "the wearer reads it");
                Controls.Set("<XRController>{RightHand}/thumbstickClicked", 1f);
                stage.StepUntil(() => stage.App.Client.View.IsStopped, "robots are stopped");
                int[] samples = new int[2];
                for (int i = 0; i < 2; i++) // what was on its way comes before the first of these
                {
                    int stops = session.Count<EStop>();
                    Controls.Set("<XRController>{RightHand}/thumbstickClicked", 0f);
                    Engine.Step();
                    Controls.Set("<XRController>{RightHand}/thumbstickClicked", 1f);
                    stage.StepUntil(() => session.Count<EStop>() > stops, "another stop");
                    samples[i] = session.Count<Sample>();
                }
                Assert.AreEqual(samples[0], samples[1]);
                Controls.Set("<XRHMD>/centerEyePosition", new Vector3(0f, 1.6f, 0f));
                int before = session.Count<EStop>();
                stage.Press("STOP all robots", () => session.Count<EStop>() > before, "a hand without a stick");
                Controls.Set("<XRHMD>/centerEyePosition", 1f);
                Engine.Step();
                Assert.AreEqual(0, stage.App.Panel.Rays[(int)Side.Right].LengthM, "a hand that cannot be read points at nothing");
                Assert.IsNotNull(stage.App.Client);
            }
        }

        [Test]
        public void ADefectOfTheInputIsSaidBeforeASessionToo()
        {
            using (AppStage stage = new AppStage(false))
            {
                Controls.Set("<XRController>{RightHand}/trackingState", 1f); // a value of another type: reading it throws
                stage.StepUntil(() => IsDrawn(stage, "the headset cannot be read"), "the wearer reads it");
                Assert.AreEqual(1, Engine.Errors.Count, "logged once");
                Engine.Errors.Clear();
            }
        }

        [Test]
        public void ADefectOfTheAppIsSaidAndLeavesTheSession()
        {
            using (AppStage stage = new AppStage(false, settings => throw new InvalidOperationException("of the application")))
            {
                stage.StepUntil(() => stage.App.Problem.Length > 0, "it is said");
                Assert.AreEqual(1, Engine.Errors.Count);
                Engine.Errors.Clear();
                stage.StepUntil(() => Unwrap(stage.Text).Contains(stage.App.Problem), "the wearer reads it");
                Assert.IsFalse(IsDrawn(stage, "Try again"), "nothing can be done here");
                Assert.IsNull(stage.App.Client);
            }
        }

        [Test]
        public void AnIdentityThatCannotBeKeptIsSaid()
        {
            using (AppStage stage = new AppStage(false))
            {
                stage.WriteFile("identity", "a file where the folder would be");
                stage.StepUntil(() => Unwrap(stage.Text).Contains("cannot keep its identity"), "it is said");
                Assert.IsNotNull(stage.App.View, "it goes on");
            }
        }

        [Test]
        public void InTheBackgroundASearchEndsAndASessionIsKept()
        {
            using (GatewaySession session = new GatewaySession())
            using (AppStage stage = new AppStage(true))
            {
                stage.WaitFor(ConnectorPhase.Searching);
                stage.StepUntil(() => JavaCalls.All.Contains("acquire"), "beacons are passed on");
                Engine.Pause(true);
                Assert.IsNull(stage.App.View);
                Assert.AreEqual(1, JavaCalls.All.Count(one => one == "release"));
                stage.App.Address = session.Address;
                Engine.Pause(false);
                stage.WaitFor(ConnectorPhase.Running);
                Assert.AreEqual(JavaCalls.All.Count(one => one == "acquire"), JavaCalls.All.Count(one => one == "release"));
                SessionClient client = stage.App.Client;
                Engine.Pause(true);
                stage.StepUntil(() => !client.IsLive, "robots hold");
                Engine.Pause(false);
                stage.StepUntil(() => client.IsLive, "they may move");
                Assert.AreSame(client, stage.App.Client);
            }
        }

        [Test]
        public void ALostSessionIsLookedForAnewAndTheWearerCanGoElsewhere()
        {
            ConnectorSettings kept = null;
            using (GatewaySession session = new GatewaySession())
            using (GatewaySession next = new GatewaySession())
            using (AppStage stage = new AppStage(false, settings => kept = settings))
            {
                stage.App.Address = session.Address;
                stage.WaitFor(ConnectorPhase.Running);
                Assert.IsTrue(session.Received.OfType<Hello>().All(hello => hello.Capabilities.Any(one => one.StartsWith("run:"))), "its alignment outlives a loss");
                session.CloseCode = 1013; // try again later (RFC 6455, section 7.4, registry)
                SessionClient client = stage.App.Client;
                client.Post(loop => loop.Connection.HandleDisconnect(MonotonicClock.NowNs));
                stage.StepUntil(() => !client.View.IsJoined, "the connection is lost");
                Controls.Set("<XRController>{LeftHand}/thumbstickClicked", 1f);
                stage.StepUntil(() => Unwrap(stage.Urgent).Contains(Unwrap(StopReport.Unconfirmed.ToString())), "nothing is stopped yet");
                Controls.Set("<XRController>{LeftHand}/thumbstickClicked", 0f);
                Engine.Pause(true);
                kept.LostNs = 1;
                int before = session.Count<Hello>();
                stage.StepUntil(() => session.Count<Hello>() >= before + 4, "it tries again");
                Assert.AreSame(client, stage.App.Client, "and looks for nothing else in the background");
                Engine.Pause(false);
                stage.StepUntil(() => stage.App.Client == null && stage.App.View.Phrase.What.Length > 0, "it is lost, and the panel says why");
                stage.Press("Look for sessions", () => stage.App.View.Endpoint.Length == 0, "those that announce themselves");
                stage.StepUntil(() => stage.Announce("next", next) && stage.App.View.Phase == ConnectorPhase.Running, "another one is joined");
                stage.StepUntil(() => next.Count<EStop>() > 0, "the same session, which gets the e-stop of before");
            }
        }

        [Test]
        public void AnotherSessionThanTheOneThatIsWantedIsLeft()
        {
            using (GatewaySession session = new GatewaySession())
            using (AppStage stage = new AppStage(false, settings => settings.SessionName = "lab"))
            {
                stage.App.Address = session.Address;
                stage.WaitFor(ConnectorPhase.Failed);
                Assert.IsNotEmpty(stage.App.View.Phrase.Remedy);
                stage.StepUntil(() => session.Count<Bye>() > 0, "it has left");
                Assert.AreEqual(0, session.Count<Sample>());
            }
        }

        [Test]
        public void DestroyedItLeavesTheSession()
        {
            using (GatewaySession session = new GatewaySession())
            {
                SessionClient client;
                using (AppStage stage = new AppStage(false))
                {
                    stage.App.Address = session.Address;
                    stage.WaitFor(ConnectorPhase.Running);
                    client = stage.App.Client;
                }
                Assert.IsTrue(client.HasEnded);
            }
        }

        [Test]
        public void ALoaderThatStartsAnewIsARecentring()
        {
            Engine.Reset();
            Subsystems.Running.Clear();
            using (DeviceCondition condition = new DeviceCondition())
            {
                XRInputSubsystem first = new XRInputSubsystem(), second = new XRInputSubsystem();
                Subsystems.Running.Add(first);
                condition.Refresh();
                Assert.IsFalse(condition.HasMoved, "the first one is where everything begins");
                Subsystems.Running.Clear();
                Subsystems.Running.Add(second);
                condition.Refresh();
                Assert.IsTrue(condition.HasMoved);
                condition.HasMoved = false;
                second.Recentre();
                Assert.IsTrue(condition.HasMoved);
            }
        }

        private static string Unwrap(string text) { return text.Replace('\n', ' '); }

        /// <summary>Return whether a text that begins so is drawn.</summary>
        private static bool IsDrawn(AppStage stage, string text)
        {
            Transform parent = stage.Offset.transform;
            for (int i = 0; i < parent.childCount; i++)
            {
                TextMesh one = parent.GetChild(i).GetComponent<TextMesh>();
                if (one != null && one.gameObject.activeSelf && one.text.StartsWith(text, StringComparison.Ordinal)) return true;
            }
            return false;
        }
    }
}
