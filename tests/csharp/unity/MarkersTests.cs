// QR codes of AR Foundation and of HoloLens on stand-ins: their poses, and what is said where they cannot be read.
using System.Collections.Generic;
using IrisSession.Core;
using IrisSession.HoloLens;
using IrisSession.Interaction;
using IrisSession.Interaction.Tests;
using IrisSession.Transport;
using IrisSession.Unity.ArFoundation;
using IrisSession.Unity.Input;
using NUnit.Framework;
using Standins;
using Unity.XR.CoreUtils;
using UnityEngine;
using UnityEngine.Android;
using UnityEngine.XR.ARFoundation;
using UnityEngine.XR.ARSubsystems;
using MicrosoftMarker = Microsoft.MixedReality.OpenXR.ARMarker;
using MicrosoftMarkerManager = Microsoft.MixedReality.OpenXR.ARMarkerManager;

namespace IrisSession.Unity.StandinTests
{
    [TestFixture]
    public sealed class MarkersTests
    {
        [SetUp]
        public void Begin()
        {
            Engine.Reset();
            Subsystems.Running.Clear();
            Subsystems.Loaded.Clear();
        }

        [Test]
        public void CodesAreReportedInTheTrackingFrame()
        {
            Transform offset = new GameObject("offset").transform;
            offset.SetPositionAndRotation(new Vector3(3f, 1f, -2f), Quaternion.AngleAxis(30f, Vector3.up));
            XROrigin origin = new GameObject("origin").AddComponent<XROrigin>();
            origin.Trackables = new GameObject("trackables").transform;
            ARMarkerManager manager = origin.gameObject.AddComponent<ARMarkerManager>();
            ArMarkers source = new ArMarkers(origin, manager, offset);
            ARMarker marker = new GameObject("marker").AddComponent<ARMarker>();
            marker.transform.SetParent(origin.Trackables, false);
            // Upright on a wall 1 m ahead, 0.2 m to the right: its normal, local Y, points back to the person.
            Vector3 position = new Vector3(0.2f, 1.1f, 1f);
            Quaternion rotation = Quaternion.AngleAxis(-90f, Vector3.right);
            marker.transform.SetPositionAndRotation(offset.TransformPoint(position), offset.rotation * rotation);
            marker.size = new Vector2(0.15f, 0.15f);
            List<MarkerReport> reports = new List<MarkerReport>();
            Assert.AreEqual(1, source.Read(reports));
            Assert.AreEqual("", reports[0].Text, "not decoded yet");
            marker.Data = "table";
            for (int i = 0; i < 100; i++) source.Read(reports);
            Assert.AreEqual("table", reports[0].Text);
            Assert.LessOrEqual(marker.Reads, 3, "the text is asked for rarely, and never again");
            RigidTransform sheet = reports[0].Pose.T_tracking_anchor;
            InputTests.AssertNear(new Double3(1, -0.2, 1.1), sheet.Position);
            InputTests.AssertNear(new Double3(-1, 0, 0), sheet.Rotation.Rotate(new Double3(0, 0, 1)));
            InputTests.AssertNear(new Double3(0, 0, 1), sheet.Rotation.Rotate(new Double3(0, 1, 0)));
            Assert.AreEqual(0.15, reports[0].Pose.SizeM, 1e-6);
            marker.trackingState = TrackingState.Limited;
            source.Read(reports);
            Assert.IsFalse(reports[0].IsTracked);
            source.SetActive(false);
            Assert.IsFalse(manager.enabled);
            source.IsAllowed = false;
            source.SetActive(true);
            Assert.IsFalse(manager.enabled, "it stays off until the person has allowed it");
            Assert.AreEqual(MarkerSupport.NotAllowed, source.Support);
            Assert.AreEqual(MarkerSupport.Missing, new ArMarkers(origin, null, offset).Support);
        }

        /// <summary>What a runtime has that reads no QR codes.</summary>
        public enum Lack
        {
            NoSubsystem,
            OtherCodes,
            NoAnswer,
            NoStart,
        }

        [TestCase(Lack.NoSubsystem)]
        [TestCase(Lack.OtherCodes)]
        [TestCase(Lack.NoAnswer)]
        [TestCase(Lack.NoStart)]
        public void ARuntimeThatReadsNoCodesIsNoticedAndTriedAgainRarely(Lack lack)
        {
            XRMarkerSubsystem subsystem = XRMarkerSubsystem.Make(lack == Lack.OtherCodes ? XRMarkerType.ArUco : XRMarkerType.QRCode);
            if (lack == Lack.NoStart) subsystem.Failure = "the runtime says no";
            if (lack == Lack.NoAnswer) subsystem.subsystemDescriptor = new XRMarkerSubsystemDescriptor();
            if (lack != Lack.NoSubsystem) Subsystems.Loaded.Add(subsystem);
            ARMarkerManager manager = AddManager(out ArMarkers source);
            Seek(source, 29.0);
            Assert.AreEqual(MarkerSupport.Missing, source.Support);
            Assert.IsFalse(manager.enabled);
            Assert.AreEqual(lack == Lack.NoSubsystem ? 0 : 1, subsystem.Starts);
            Assert.AreEqual(lack == Lack.NoStart ? 1 : 0, Engine.Log.Count);
            Seek(source, 3.0);
            Assert.AreEqual(MarkerSupport.Missing, source.Support);
            Assert.AreEqual(lack == Lack.NoSubsystem ? 0 : 2, subsystem.Starts);
            subsystem.Failure = null;
            Subsystems.Loaded.Clear();
            Subsystems.Loaded.Add(XRMarkerSubsystem.Make(XRMarkerType.ArUco, XRMarkerType.QRCode));
            Seek(source, 30.0);
            Assert.AreEqual(MarkerSupport.Ready, source.Support, "it was not ready before");
            Assert.IsTrue(manager.enabled);
        }

        [Test]
        public void ASearchThatStartsSlowlyIsNotMissing()
        {
            XRMarkerSubsystem subsystem = XRMarkerSubsystem.Make(XRMarkerType.QRCode);
            subsystem.IsSlow = true;
            Subsystems.Loaded.Add(subsystem);
            ARMarkerManager manager = AddManager(out ArMarkers source);
            Assert.AreEqual(MarkerSupport.Ready, source.Support, "nothing is known against it");
            Seek(source, 60.0);
            Assert.AreEqual(MarkerSupport.Starting, source.Support);
            Assert.AreEqual(1, subsystem.Starts);
            subsystem.Start();
            Seek(source, 0.1);
            Assert.AreEqual(MarkerSupport.Ready, source.Support);
            source.SetActive(false);
            Assert.IsFalse(manager.enabled);
            Assert.AreEqual(MarkerSupport.Ready, source.Support);
        }

        [Test]
        public void AHoloLensWithoutTheSubsystemReadsNoCodes()
        {
            XROrigin origin = new GameObject("origin").AddComponent<XROrigin>();
            HoloLensMarkers source = new HoloLensMarkers(origin, origin.gameObject.AddComponent<MicrosoftMarkerManager>(), origin.transform);
            Seek(source, 1.0);
            Assert.AreEqual(MarkerSupport.Missing, source.Support);
            Subsystems.Loaded.Add(XRMarkerSubsystem.Make());
            Seek(source, 30.0);
            Assert.AreEqual(MarkerSupport.Ready, source.Support);
        }

        [Test]
        public void ThePanelBeforeASessionAsksForACodeOnlyWhereOneIsRead()
        {
            using (AppStage stage = new AppStage(true))
            {
                Permission.Granted.Add(ScenePermission.UseScene);
                XRMarkerSubsystem subsystem = (XRMarkerSubsystem)Subsystems.Loaded[0];
                subsystem.Failure = "the runtime says no";
                int before = subsystem.Starts;
                bool AsksForCode() { return stage.Text.Replace('\n', ' ').Contains("Or look at the code"); }
                stage.StepUntil(AsksForCode, "it may read codes");
                stage.StepUntil(() => !AsksForCode(), "it has failed");
                Assert.AreEqual(before + 1, subsystem.Starts);
                subsystem.Failure = null;
                Engine.Step(30.0);
                stage.StepUntil(() => AsksForCode() && subsystem.running, "it reads codes now");
            }
        }

        private static ARMarkerManager AddManager(out ArMarkers source)
        {
            XROrigin origin = new GameObject("origin").AddComponent<XROrigin>();
            GameObject one = new GameObject("manager");
            one.SetActive(false);
            ARMarkerManager manager = one.AddComponent<ARMarkerManager>();
            manager.enabled = false; // as in the scene
            one.SetActive(true);
            source = new ArMarkers(origin, manager, origin.transform);
            return manager;
        }

        private static void Seek(IMarkerSource source, double seconds)
        {
            for (double s = 0.0; s < seconds; s += 0.1)
            {
                Engine.Step(0.1);
                source.SetActive(true);
            }
        }

        [Test]
        public void CodesThatAHoloLensRemembersAreNoLooks()
        {
            Transform offset = new GameObject("offset").transform;
            XROrigin origin = new GameObject("origin").AddComponent<XROrigin>();
            origin.Trackables = new GameObject("trackables").transform;
            HoloLensMarkers source = new HoloLensMarkers(origin, origin.gameObject.AddComponent<MicrosoftMarkerManager>(), offset);
            MicrosoftMarker marker = new GameObject("marker").AddComponent<MicrosoftMarker>();
            marker.transform.SetParent(origin.Trackables, false);
            // Upright on a wall 1 m ahead: local X right, Y down, Z back to the person.
            marker.transform.SetPositionAndRotation(new Vector3(0.1f, 1.4f, 1f), Quaternion.AngleAxis(180f, Vector3.right));
            marker.Data = "table";
            marker.size = new Vector2(0.15f, 0.15f);
            Wearer wearer = new Wearer();
            wearer.Session.T_world_tracking = null;
            wearer.Input.Markers = new MarkerLooks(source);
            for (int i = 0; i < 60; i++)
            {
                Engine.Step();
                marker.transform.SetPositionAndRotation(new Vector3(0.1f + 1e-5f * i, 1.4f, 1f), Quaternion.AngleAxis(180f, Vector3.right));
                wearer.Input.Reading.CaptureNs = MonotonicClock.NowNs + i * Wearer.FrameNs; // the engine's clock is that of the steps
                marker.lastSeenTime = -100f; // of another app, before this one was started
                wearer.Input.Update(true, 0);
            }
            Assert.AreEqual(0, wearer.Session.Looks.Count);
            Assert.AreEqual(60, wearer.Input.Markers.Filter.Count(MarkerVerdict.Remembered));
            List<MarkerReport> reports = new List<MarkerReport>();
            marker.lastSeenTime = (float)Time.realtimeSinceStartupAsDouble;
            source.Read(reports);
            Assert.LessOrEqual(System.Math.Abs(MonotonicClock.NowNs - reports[0].SeenNs), 10_000_000_000, "now, on our clock");
            InputTests.AssertNear(new Double3(1, -0.1, 1.4), new Double3(reports[0].Pose.T_tracking_anchor.Position.X, -0.1, reports[0].Pose.T_tracking_anchor.Position.Z));
            InputTests.AssertNear(new Double3(-1, 0, 0), reports[0].Pose.T_tracking_anchor.Rotation.Rotate(new Double3(0, 0, 1)));
            InputTests.AssertNear(new Double3(0, 0, 1), reports[0].Pose.T_tracking_anchor.Rotation.Rotate(new Double3(0, 1, 0)));
            Assert.AreEqual(Microsoft.MixedReality.OpenXR.TransformMode.Center, marker.transformMode);
        }
    }
}
